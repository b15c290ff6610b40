"""``import morphgen`` gives the public API and loads packages only when used."""

import doctest
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


@pytest.mark.parametrize(
    ("request_text", "words"),
    [
        ("arm=lwr ee=plane ee.size=80mm", {"arm": "lwr", "ee": "plane", "ee.size": 0.08}),
        ("lwr-plane", {"arm": "lwr", "ee": "plane"}),
    ],
)
def test_parts_may_be_keywords_or_joined_by_dashes(request_text, words):
    robot, same = morphgen.compose(request_text), morphgen.compose(**words)
    assert (robot.name, robot.links, robot.joints) == (same.name, same.links, same.joints)


def test_dir_lists_the_public_names():
    assert dir(morphgen) == sorted(morphgen.__all__)
    assert {"Robot", "MorphgenError", "__version__", "compose", "tasks"} <= set(dir(morphgen))
    assert all(getattr(morphgen, name) is not None for name in dir(morphgen))
    assert morphgen.MorphgenError is MorphgenError
    with pytest.raises(AttributeError, match="no attribute 'composed'"):
        _ = morphgen.composed


def test_a_robot_prints_as_one_line():
    robot = morphgen.compose("lwr-plane")
    assert (
        repr(robot)
        == f"Robot('lwr-plane': {len(robot.links)} links, 7 independent joints, 16.11 kg)"
    )


@pytest.mark.parametrize("name", ["compose", "sample", "read", "write"])
def test_documentation_examples_work(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder().find(getattr(morphgen, name), name, globs={})
    example.globs["morphgen"] = morphgen
    assert doctest.DocTestRunner().run(example).failed == 0


def test_invalid_arguments_give_one_clear_error():
    with pytest.raises(MorphgenError, match="did you mean 'lwr'"):
        morphgen.compose("arm=lwrr")


def test_importing_morphgen_loads_no_heavy_package():
    heavy = {"numpy", "torch", "trimesh", "pybullet", "mujoco", "yourdfpy", "scipy"}
    code = f"import sys, morphgen; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
