"""Each command-line test runs in its own temporary folder."""

import math
from pathlib import Path

import pytest
import trimesh

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member
from morphgen.cli import main, progress
from morphgen.grammar.library import LIBRARY_VARIABLE
from morphgen.splits.split import write_split


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(progress, "FIRST_LINE", math.inf)  # on a busy machine all work is long
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)


@pytest.fixture
def run(capfd):
    """Run a command in this process; return its exit code, stdout and stderr."""

    def command(*argv):
        code = main([str(word) for word in argv])
        out, err = capfd.readouterr()
        return code, out, err

    return command


@pytest.fixture
def ok(run):
    """Run a command that must succeed and print nothing but its result, which is returned."""

    def command(*argv):
        code, out, err = run(*argv)
        assert (code, err) == (0, "")
        return out

    return command


@pytest.fixture
def refused(run, tmp_path):
    """Run a command that must be rejected: exit code 2, one line, no changes on disk."""

    def command(*argv):
        before = tree(tmp_path)
        code, out, err = run(*argv)
        assert (code, out) == (2, "")
        assert err.startswith("morphgen: ")
        assert err.index("\n") == len(err) - 1
        assert tree(tmp_path) == before
        return err

    return command


@pytest.fixture
def urdf(tmp_path):
    """Write XML to ``urdf/broken.urdf``, the only file of its folder."""

    def write(content):
        path = tmp_path / "urdf" / "broken.urdf"
        path.parent.mkdir()
        path.write_text(content)
        return path

    return write


@pytest.fixture
def own_cache(cache, monkeypatch):
    """Keep goal sets in the cache of the tests."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


@pytest.fixture
def goal_cache(tmp_path, monkeypatch):
    """A temporary goal cache; fits use the user's cache."""
    from morphgen.tasks import goal_sets  # loads torch, which few of the tests need

    monkeypatch.setattr(goal_sets, "user_cache_path", lambda name: tmp_path / "cache" / name)
    return tmp_path / "cache" / "morphgen"


@pytest.fixture
def split_yaml(tmp_path):
    """Write a small split as ``split.yaml``."""
    from helpers.runs import small_split  # loads torch, which few of the tests need

    write_split(small_split(), tmp_path / "split.yaml")
    return "split.yaml"


@pytest.fixture
def small(tmp_path):
    """Write a split of robots without meshes at reach as ``small.yaml``."""
    train, test = ([member(words, task="reach") for words in side] for side in (TRAIN, TEST))
    write_split(combined(train, test, name="mine/small"), tmp_path / "small.yaml")
    return "small.yaml"


@pytest.fixture
def nothing_is_stored(monkeypatch):
    """Forbid storing fits, which would write into the library's folder."""

    def forbidden(*_, **__):
        raise AssertionError("a test was about to store the fits of the library's parts")

    monkeypatch.setattr("morphgen.cli.fit.parts_without_fits", forbidden)
    monkeypatch.setattr("morphgen.cli.fit.store_part", forbidden)


@pytest.fixture
def box(tmp_path):
    """``link.stl``, a box centred at (1, 2, 3)."""
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.apply_translation((1.0, 2.0, 3.0))
    mesh.export(tmp_path / "link.stl")
    return Path("link.stl")
