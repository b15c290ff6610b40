"""``import morphgen`` is enough, and costs nothing until it is used."""

import subprocess
import sys

import pytest

import morphgen
from morphgen.errors import MorphgenError


def test_compose_write_read_and_check(tmp_path):
    robot = morphgen.compose("arm=lwr ee=plane ee.size=80mm", name="pusher")
    folder = morphgen.write(robot, tmp_path, picture=False)
    assert folder == tmp_path / "pusher"
    back = morphgen.read(folder)
    assert back.home == robot.home
    assert back.ignore_pairs == robot.ignore_pairs
    assert [f for f in morphgen.check(back) if f.severity != "info"] == []


def test_a_mistake_is_one_clear_error():
    with pytest.raises(MorphgenError, match="did you mean 'lwr'"):
        morphgen.compose("arm=lwrr")


def test_importing_it_loads_no_heavy_package():
    heavy = {"numpy", "torch", "trimesh", "pybullet", "mujoco", "yourdfpy", "scipy"}
    code = f"import sys, morphgen; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
