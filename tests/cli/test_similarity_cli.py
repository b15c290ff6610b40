"""``morphgen similarity``: output, written files and rejected input."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import morphgen
from helpers.commands import tree
from helpers.robots import arm
from morphgen.benchmark import figures
from morphgen.encoding.similarity import MEASURES
from morphgen.encoding.tokens import LAYOUT, tokens
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import write_bundle

ARGUMENTS = ("robots", "--measure", "all")


@pytest.fixture
def bundles(tmp_path):
    """``robots``: three bundles."""
    robots = [
        morphgen.compose("arm=lwr ee=plane", name="lwr-plane"),
        morphgen.compose("arm=lwr ee=claw", name="lwr-claw"),
        arm(),
    ]
    for robot in robots:
        write_bundle(robot, tmp_path / "robots" / robot.name, picture=False)
    (tmp_path / "robots" / "notes.txt").write_text("no robot")
    return sorted(robots, key=lambda robot: robot.name)


@pytest.fixture
def light_set(run):
    """``set``: four cubes of a light set."""
    assert run("sample", "cubes", "-n", "4", "--light", "--out", "set", "--json")[0] == 0
    return Path("set")


def test_folder_of_bundles_gives_one_table_per_measure(ok, bundles, tmp_path):
    before = tree(tmp_path)
    assert list(json.loads(ok("similarity", "robots", "--json"))["measures"]) == ["tree"]
    out = ok("similarity", *ARGUMENTS, "--map", "map.png")
    written = {name: data for name, data in tree(tmp_path).items() if name not in before}
    assert {name: data[:4] for name, data in written.items()} == {"map.png": b"\x89PNG"}
    for block, measure in zip(out.split("\n\n"), MEASURES.values(), strict=True):
        title, _, _, *rows, statistics = block.removesuffix("\nmap.png\n").splitlines()
        assert title.startswith(f"{measure.name}: {measure.meaning}")
        order = "larger" if measure.larger_is_more_alike else "smaller"
        assert title.endswith(f"{order} is more alike")
        assert [row.split()[0] for row in rows] == [robot.name for robot in bundles]
        assert statistics.startswith("3 pairs: mean ")


def test_paths_can_be_mixed_and_duplicates_are_dropped(ok, bundles, light_set):
    lwr = Path("robots/lwr-plane")
    paths = (lwr, lwr / "robot.urdf", light_set / "cubes-000001", light_set)
    out = ok("similarity", *paths, "robots", "--json")
    names = json.loads(out)["robots"]
    assert len(names) == len(set(names)) == 8
    assert names[0] == "robots/lwr-plane"  # two robots are called lwr-plane


def test_the_nearest_of_each_robot_is_listed(run, ok):
    run("sample", "stick", "-n", "7", "--light", "--out", "set", "--json")
    out = ok("similarity", "set", "--measure", "workspace")
    _, header, _, *rows, statistics = out.splitlines()
    assert header.split() == ["robot", "nearest", "workspace", "mean", "of", "others"]
    data = json.loads(ok("similarity", "set", "--measure", "workspace", "--json"))
    assert data["measures"]["workspace"]["larger_is_more_alike"]
    values = np.array(data["measures"]["workspace"]["matrix"])
    np.fill_diagonal(values, np.nan)
    assert len(rows) == 7
    for i, row in enumerate(rows):
        name, near, value, mean = row.split()
        assert name == f"stick-{i:06d}"
        assert near == f"stick-{np.nanargmax(values[i]):06d}"
        assert float(value) == pytest.approx(np.nanmax(values[i]), abs=6e-4)
        assert float(mean) == pytest.approx(np.nanmean(values[i]), abs=6e-4)
    assert statistics.startswith("21 pairs: ")


def test_a_map_is_coloured_by_structure(ok, bundles, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "map_png", lambda *arguments: drawn.append(arguments) or b"png")
    ok("similarity", "robots", "--map", "map.png")
    assert drawn[0][2] == ["imported, 4 DoF", "lwr-claw, 11 DoF", "lwr-plane, 7 DoF"]


def test_robot_without_a_tool_is_rejected_with_its_path(refused, robot_urdf, bundles):
    path = robot_urdf(replace(arm(), frames=()))
    error = refused("similarity", path, "robots")
    assert f"{path}: robot 'arm' has no frame 'tool'" in error
    assert "morphgen import FILE --tool LINK" in error


WORDS = ("base=gantry", "ee=plane")


@pytest.fixture
def bundle(tmp_path):
    return write_bundle(arm(), tmp_path / "arm", picture=False).relative_to(tmp_path)


def test_robot_can_be_given_as_urdf_or_parts(ok, robot_urdf):
    assert ok("tokens", robot_urdf(arm())).startswith("arm: tokens (6, 48)\n")
    assert ": tokens (7, 48)\n" in ok("tokens", *WORDS, "ee.size=0.2")
    assert ": tokens (10, 48)\n" in ok("tokens", "chain", "beads=2")


def test_options_may_stand_between_parts(run):
    assert run("tokens", WORDS[0], "--max-links", 7, WORDS[1])[0] == 0


def test_json_option_prints_only_json(ok):
    out = ok("tokens", *WORDS, "--json", "--max-links", 10)
    data = json.loads(out)
    robot = morphgen.compose(" ".join(WORDS))
    expected = tokens(robot, token_shapes(robot), max_links=10)
    np.testing.assert_array_equal(np.array(data["tokens"]), expected)
    assert data["links"] == [link.name for link in robot.links]
    assert (data["name"], data["shape"], data["max_links"]) == (robot.name, [7, 48], 10)
    assert [field["name"] for field in data["layout"]] == [field.name for field in LAYOUT]


def test_written_file_is_reproducible(run, ok, bundle, tmp_path):
    before = set(tree(tmp_path))
    out = ok("tokens", bundle, "--out", "arm.npz")
    assert out.endswith("\narm.npz\n")
    assert set(tree(tmp_path)) - before == {"arm.npz"}
    first = Path("arm.npz").read_bytes()
    assert json.loads(run("tokens", bundle, "--out", "arm.npz", "--json")[1])["file"] == "arm.npz"
    assert Path("arm.npz").read_bytes() == first
    with np.load("arm.npz", allow_pickle=False) as data:
        assert data["tokens"].shape == (6, 48)
        assert data["links"].tolist() == [link.name for link in arm().links]
