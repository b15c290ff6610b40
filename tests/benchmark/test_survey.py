"""The statistics of a split, and the difficulty of its robots one by one."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from helpers.splits import LIBRARY, TEST, TRAIN, combined, member, split
from morphgen.benchmark.audit import audit
from morphgen.benchmark.similarity import MEASURES, cosine, features
from morphgen.benchmark.split import SIDES, compose_member
from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.survey import (
    PAPER,
    STRUCTURAL,
    BaselineResult,
    NearestTrain,
    RobotDifficulty,
    difficulty_csv,
    difficulty_table,
    paper_row,
    robot_stats,
    split_difficulty,
    statistics,
    survey_difficulty,
    survey_split,
)
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.kinematics import reach


def test_link_and_joint_counts_are_means_over_train_or_test():
    summary = statistics(split(["base=gantry ee=plane", "cubes"], ["chain beads=2"]), LIBRARY)
    assert (summary["train"]["robots"], summary["test"]["robots"]) == (2, 1)
    for key, gantry, cubes, chain in (
        ("links", 7, 3, 10),
        ("movable", 5, 2, 7),
        ("movable_to_tool", 5, 2, 7),
    ):
        assert summary["train"][key] == (gantry + cubes) / 2
        assert summary["test"][key] == chain
    # Mimic joints, and those beyond the tool, are movable, but not to the tool.
    reaching = member("arm=lwr ee=claw", "reaching", task="reach")
    summary = statistics(split(["arm=lwr ee=claw", reaching], ["arm=lwr ee=plane"]), LIBRARY)
    assert (summary["train"]["movable"], summary["train"]["movable_to_tool"]) == (11, 7)
    assert (summary["test"]["movable"], summary["test"]["movable_to_tool"]) == (7, 7)
    assert (summary["train"]["robots"], summary["train"]["bodies"]) == (2, 1)


def test_masses_reaches_and_cosine_similarities_have_mean_and_range():
    example_split = combined()
    summary = statistics(example_split, LIBRARY)
    robots = [compose_member(m, LIBRARY) for m in example_split.train]
    (test,) = (compose_member(m, LIBRARY) for m in example_split.test)
    known = [features(robot, token_shapes(robot)) for robot in (test, *robots)]
    alike = [cosine(known[0], other) for other in known[1:]]
    for got, values in (
        (summary["train"]["mass"], [robot.mass for robot in robots]),
        (summary["train"]["reach"], [reach(robot) for robot in robots]),
        (summary["cosine"], alike),
    ):
        expected = {"mean": np.mean(values), "min": min(values), "max": max(values)}
        assert got == pytest.approx(expected, abs=5e-5)


def test_a_robot_that_cannot_be_composed_is_an_error():
    wrong = replace(member("cubes"), derivation="cubes=cubez")
    with pytest.raises(BenchmarkError, match=r"'mine/some': robot 'cubes': .*'cubez'; did you me"):
        statistics(split([wrong], ["chain"]), LIBRARY)
    with pytest.raises(BenchmarkError, match="a side without robots"):
        statistics(split(["cubes"], []), LIBRARY)


def test_rows_of_the_paper_and_scenarios_match():
    sets = {"/".join(name.split("/")[:2]) for name in split_names()}
    assert set(PAPER) <= sets
    assert sets - set(PAPER) == {"extrapolation/arms-small"}
    assert paper_row("extrapolation/arms/push") is PAPER["extrapolation/arms"]
    assert paper_row("mine/arms/push") is None


RESULTS = {
    "random": {("train", "gantry-plane"): BaselineResult(0.0, 0.25)},
    "ik": {("test", "planar-plane"): BaselineResult(-1e-9, 1 / 3)},
}


@pytest.fixture(scope="module")
def rows():
    return split_difficulty(combined(), LIBRARY, results=RESULTS)


def test_a_row_has_the_size_of_its_robot_and_the_nearest_other_train_robot(rows):
    example = combined()
    members = [(side, each) for side in SIDES for each in example.side(side)]
    robots = {each.name: compose_member(each, LIBRARY) for _, each in members}
    known = {name: features(robot, token_shapes(robot)) for name, robot in robots.items()}
    assert [(row.side, row.robot) for row in rows] == [(side, each.name) for side, each in members]
    for row in rows:
        stats = robot_stats(robots[row.robot])
        assert (row.split, row.task, row.obstacles) == ("mine/some", "push", False)
        assert (row.movable_to_tool, row.links) == (stats.movable_to_tool, stats.links)
        assert row.reach == pytest.approx(stats.reach, abs=1e-6)
        for name, measure in MEASURES.items():
            values = {
                each.name: measure.function(known[row.robot], known[each.name])
                for each in example.train
                if each.name != row.robot
            }
            best = (max if measure.larger_is_more_alike else min)(values.values())
            assert row.nearest[name].value == pytest.approx(best, abs=1e-6)
            assert values[row.nearest[name].train] == pytest.approx(best, abs=1e-9)


def test_the_nearest_of_a_test_robot_is_that_of_the_audit(rows):
    neighbours = audit(combined(), LIBRARY).neighbours
    nearest = {each.measure: (each.train, round(each.value, 6)) for each in neighbours}
    assert {name: (each.train, each.value) for name, each in rows[-1].nearest.items()} == nearest


def test_the_same_robot_at_another_task_is_no_other_train_robot():
    twin = member(TRAIN[0], "twin", task="reach")
    twin = replace(twin, derivation=twin.derivation.replace("size=0.1", "size=0.10"))
    example = split([TRAIN[0], twin], TEST)
    assert example.train[0].robot_hash == twin.robot_hash
    assert example.train[0].derivation != twin.derivation
    first, second, *_, test = split_difficulty(example, LIBRARY)
    assert (first.nearest, second.nearest) == ({}, {})
    assert test.nearest["tree"].train == "gantry-plane"
    cells = dict(zip(STRUCTURAL, difficulty_csv([first]).splitlines()[1].split(","), strict=True))
    assert {cells[name] for name in MEASURES} == {""}
    assert difficulty_table([first]).splitlines()[-1].split()[-3:] == ["-", "-", "-"]


def test_results_of_baselines_belong_to_side_and_robot(rows):
    assert [list(row.baselines) for row in rows] == [["random"], [], [], ["ik"]]
    assert rows[-1].baselines["ik"] == BaselineResult(0.0, 0.333333)
    assert str(rows[-1].baselines["ik"].score) == "0.0"  # not -0.0
    assert rows[-1].as_dict()["baselines"] == {"ik": {"score": 0.0, "success": 0.333333}}
    assert "baselines" not in rows[1].as_dict()


def test_the_csv_has_the_same_bytes_with_any_number_of_jobs(rows):
    again = split_difficulty(combined(), LIBRARY, results=RESULTS, jobs=2)
    assert difficulty_csv(again, ("ik",)) == difficulty_csv(rows, ("ik",))
    header, *lines = csv.reader(difficulty_csv(rows, ("random", "ik")).splitlines())
    results = ["random_score", "random_success", "ik_score", "ik_success"]
    assert header == [*STRUCTURAL, *results]
    cells = [",".join(line[-4:]) for line in lines]
    assert cells == ["0.000000,0.250000,,", ",,,", ",,,", ",,0.000000,0.333333"]
    nearest = {name: NearestTrain("a,b", 1e-6) for name in MEASURES}
    row = RobotDifficulty("s", "test", "r", "reach", True, 2, 3, 0.1 + 0.2, nearest)
    (line,) = csv.reader(difficulty_csv([row]).splitlines()[1:])
    assert line[:8] == ["s", "test", "r", "reach", "true", "2", "3", "0.300000"]
    assert line[8:] == ["a,b", "0.000001"] * len(MEASURES)  # no exponent


def test_train_robots_are_compared_symmetrically_and_not_with_themselves():
    twins = split([*TRAIN, member(TRAIN[0], "twin")], TEST)
    survey = survey_split(twins, LIBRARY, within_train=True)
    pairs = survey.train_similarity
    assert pairs.shape == (4, 4, len(MEASURES))
    assert (pairs[0, 1:3] == pairs[1:3, 0]).all()
    assert (pairs[0, 1:3] == pairs[3, 1:3]).all()
    assert (pairs[0, [0, 3]] != pairs[0, [0, 3]]).all()  # NaN
    assert survey_split(combined(), LIBRARY).train_similarity is None


def test_robots_that_changed_or_cannot_be_composed_are_refused():
    other = replace(member(TRAIN[0]), name="other", robot_hash="0" * 32)
    with pytest.raises(BenchmarkError, match=r"robot 'other': the split names body 0{32}, but"):
        split_difficulty(combined([*TRAIN, other]), LIBRARY)
    missing = replace(other, derivation=other.derivation.replace("plane", "planf"))
    with pytest.raises(BenchmarkError, match=r"'mine/some': robot 'other': .* no part 'planf'"):
        split_difficulty(combined([*TRAIN, missing]), LIBRARY)
    with pytest.raises(ValueError, match="within_train"):
        survey_difficulty(survey_split(combined(), LIBRARY))
