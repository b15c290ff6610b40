"""``morphgen similarity``: output, written files and rejected input."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import morphgen
from helpers.commands import tree
from helpers.robots import arm
from morphgen.benchmark.similarity import MEASURES, features, similarity_matrix
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


def test_folder_of_bundles_gives_one_matrix_per_measure(run, bundles, tmp_path):
    before = tree(tmp_path)
    code, out, err = run(*("similarity", *ARGUMENTS))
    assert (code, err) == (0, "")
    assert tree(tmp_path) == before
    blocks = out.rstrip("\n").split("\n\n")
    robot_features = [features(robot, token_shapes(robot)) for robot in bundles]
    for block, measure in zip(blocks, MEASURES.values(), strict=True):
        title, header, _, *rows, statistics = block.splitlines()
        assert title.startswith(f"{measure.name}: {measure.meaning}")
        assert title.endswith(
            "larger is more alike" if measure.larger_is_more_alike else "smaller is more alike"
        )
        assert header.split() == ["#", "robot", "0", "1", "2"]
        values = similarity_matrix(robot_features, measure.name)
        for i, row in enumerate(rows):
            number, name, *numbers = row.split()
            assert (number, name) == (str(i), bundles[i].name)
            np.testing.assert_allclose(np.array(numbers, float), values[i], atol=6e-4)
        assert statistics.startswith("3 pairs: mean ")


def test_json_holds_the_matrices(run, bundles):
    code, out, err = run("similarity", *ARGUMENTS, "--json")
    assert (code, err) == (0, "")
    data = json.loads(out)
    assert data["robots"] == ["arm", "lwr-claw", "lwr-plane"]
    assert data["files"] == []
    assert list(data["measures"]) == list(MEASURES)
    robot_features = [features(robot, token_shapes(robot)) for robot in bundles]
    for name, about in data["measures"].items():
        assert about["larger_is_more_alike"] == MEASURES[name].larger_is_more_alike
        np.testing.assert_allclose(
            about["matrix"], similarity_matrix(robot_features, name), atol=1e-6
        )


def test_one_file_for_two_pictures_is_refused(refused, bundles):
    words = ("--heatmap", "x.png", "--map", "./x.png")
    assert "x.png: is named for two files" in refused("similarity", "robots", *words)


def test_tree_is_the_default_measure(run, bundles):
    _, out, _ = run("similarity", "robots", "--json")
    assert list(json.loads(out)["measures"]) == ["tree"]
    _, out, _ = run("similarity", "robots", "--measure", "cosine", "--json")
    assert list(json.loads(out)["measures"]) == ["cosine"]


def test_paths_can_be_mixed_and_duplicates_are_dropped(run, bundles, light_set):
    lwr = Path("robots/lwr-plane")
    paths = (lwr, lwr / "robot.urdf", light_set / "cubes-000001", light_set)
    code, out, _ = run("similarity", *paths, "robots", "--json")
    assert code == 0
    names = json.loads(out)["robots"]
    assert len(names) == len(set(names)) == 8
    assert names[0] == "robots/lwr-plane"  # two robots are called lwr-plane


def test_more_than_twenty_robots_list_the_nearest_of_each(run):
    run("sample", "stick", "-n", "21", "--light", "--out", "set", "--json")
    code, out, _ = run("similarity", "set", "--measure", "workspace")
    assert code == 0
    _, header, _, *rows, statistics = out.splitlines()
    assert header.split() == ["robot", "nearest", "workspace", "mean", "of", "others"]
    values = np.array(
        json.loads(run("similarity", "set", "--measure", "workspace", "--json")[1])["measures"][
            "workspace"
        ]["matrix"]
    )
    np.fill_diagonal(values, np.nan)
    assert len(rows) == 21
    for i, row in enumerate(rows):
        name, near, value, mean = row.split()
        assert name == f"stick-{i:06d}"
        assert near == f"stick-{np.nanargmax(values[i]):06d}"
        assert float(value) == pytest.approx(np.nanmax(values[i]), abs=6e-4)
        assert float(mean) == pytest.approx(np.nanmean(values[i]), abs=6e-4)
    assert statistics.startswith("210 pairs: ")


def test_csv_has_one_line_per_pair(run, bundles):
    code, out, _ = run("similarity", *ARGUMENTS, "--csv", "pairs.csv", "--json")
    assert code == 0
    assert json.loads(out)["files"] == ["pairs.csv"]
    with Path("pairs.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [(row["robot"], row["other"]) for row in rows] == [
        ("arm", "lwr-claw"),
        ("arm", "lwr-plane"),
        ("lwr-claw", "lwr-plane"),
    ]
    for name, about in json.loads(out)["measures"].items():
        values = np.array(about["matrix"])[np.triu_indices(3, 1)]
        assert [float(row[name]) for row in rows] == values.tolist()


def test_pictures_are_reproducible(run, bundles, tmp_path):
    pictures = ("--heatmap", "heat.png", "--map", "map.png")
    code, out, _ = run("similarity", *ARGUMENTS, *pictures)
    assert code == 0
    assert out.splitlines()[-2:] == ["heat.png", "map.png"]
    first = tree(tmp_path)
    assert first["heat.png"].startswith(b"\x89PNG")
    assert first["map.png"].startswith(b"\x89PNG")
    assert run("similarity", *ARGUMENTS, *pictures)[0] == 0
    assert tree(tmp_path) == first


def test_single_robot_is_rejected(refused, bundles):
    assert "robots/arm is one robot; name others" in refused("similarity", "robots/arm")
    assert "is one robot" in refused("similarity", "robots/arm", "robots/arm")


def test_robot_without_a_tool_is_rejected_with_its_path(refused, robot_urdf, bundles):
    path = robot_urdf(replace(arm(), frames=()))
    error = refused("similarity", path, "robots")
    assert f"{path}: robot 'arm' has no frame 'tool'" in error
    assert "morphgen import FILE --tool LINK" in error


@pytest.mark.parametrize(
    ("paths", "reason"),
    [
        (("nowhere/",), "nowhere: no such file or folder"),
        (("empty/",), "empty holds no robot; expected a bundle, a URDF, a set"),
        (("begun",), "begun is not a finished set: it has no index.jsonl"),
        (("robots/notes.txt",), "notes.txt"),
    ],
)
def test_paths_that_are_not_robots_are_rejected(paths, reason, refused, bundles, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "set.json").write_text("{}")
    assert reason in refused("similarity", *paths, "robots")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--heatmap", "a.jpg"), "--heatmap a.jpg: expected a name that ends in .png"),
        (("--map", "a"), "--map a: expected a name that ends in .png"),
        (("--map", "no/a.png"), "--map no/a.png: there is no folder no"),
        (("--csv", "robots"), "--csv robots: expected a name that ends in .csv"),
        (("--csv", "a.png"), "--csv a.png: expected a name that ends in .csv"),
    ],
)
def test_unwritable_output_is_rejected_before_computing(arguments, reason, refused, bundles):
    assert reason in refused("similarity", "robots", *arguments)
