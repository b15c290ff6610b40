"""Fixtures shared by the tests of splits."""

import pytest

from helpers.splits import LIBRARY, combined
from morphgen.benchmark.split_folder import build_split


@pytest.fixture
def example_split():
    """A split of four robots."""
    return combined()


@pytest.fixture
def whole(tmp_path, example_split):
    """A built split."""
    return build_split(example_split, tmp_path / "whole", LIBRARY).folder
