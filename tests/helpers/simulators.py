"""Names of simulators as parameters of tests."""

from importlib.util import find_spec

import pytest

needs_pybullet = pytest.mark.skipif(
    find_spec("pybullet") is None, reason="PyBullet has no wheel for this Python"
)
PYBULLET = pytest.param("pybullet", marks=needs_pybullet)
