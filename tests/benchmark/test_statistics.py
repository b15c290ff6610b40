"""Statistics of splits, compared with the tables of the paper."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.splits import LIBRARY, combined, member, split
from morphgen.benchmark.similarity import cosine, features
from morphgen.benchmark.split import compose_member
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.benchmark.survey import PAPER, paper_row, robot_set, statistics
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


def test_joints_beyond_the_tool_and_mimic_joints_do_not_count_as_movable_to_tool():
    summary = statistics(split(["arm=lwr ee=claw"], ["arm=lwr ee=plane"]), LIBRARY)
    assert (summary["train"]["movable"], summary["train"]["movable_to_tool"]) == (11, 7)
    assert (summary["test"]["movable"], summary["test"]["movable_to_tool"]) == (7, 7)


def test_masses_reaches_and_cosine_similarities_have_mean_and_range():
    example_split = combined()
    summary = statistics(example_split, LIBRARY)
    robots = [compose_member(m, LIBRARY) for m in example_split.train]
    (test,) = (compose_member(m, LIBRARY) for m in example_split.test)
    alike = [
        cosine(features(test, token_shapes(test)), features(robot, token_shapes(robot)))
        for robot in robots
    ]
    for got, values in (
        (summary["train"]["mass"], [robot.mass for robot in robots]),
        (summary["train"]["reach"], [reach(robot) for robot in robots]),
        (summary["cosine"], alike),
    ):
        expected = {"mean": np.mean(values), "min": min(values), "max": max(values)}
        assert got == pytest.approx(expected, abs=5e-5)


def test_a_robot_with_two_tasks_is_counted_twice():
    reaching = replace(member("cubes"), name="reaching", task="reach")
    summary = statistics(split(["cubes", reaching], ["base=gantry ee=cube"]), LIBRARY)
    assert (summary["train"]["robots"], summary["train"]["bodies"]) == (2, 1)


@pytest.mark.slow
def test_the_number_of_processes_does_not_matter():
    cubes = [member(f"cubes cubes.size={20 + i}mm", f"cube-{i}") for i in range(9)]
    example_split = split(cubes, ["base=gantry ee=cube"])
    assert statistics(example_split, LIBRARY, jobs=2) == statistics(example_split, LIBRARY)


def test_a_robot_that_cannot_be_composed_is_an_error():
    wrong = replace(member("cubes"), derivation="cubes=cubez")
    with pytest.raises(
        BenchmarkError, match=r"'mine/some': robot 'cubes': .*'cubez'; did you mean"
    ):
        statistics(split([wrong], ["chain"]), LIBRARY)
    with pytest.raises(BenchmarkError, match="a side without robots"):
        statistics(split(["cubes"], []), LIBRARY)


def test_rows_of_the_paper_and_scenarios_match():
    sets = {robot_set(name) for name in split_names()}
    assert set(PAPER) <= sets
    assert sets - set(PAPER) == {"extrapolation/arms-small"}
    assert paper_row("extrapolation/arms/push") is PAPER["extrapolation/arms"]
    assert paper_row("mine/arms/push") is None


@pytest.mark.parametrize("name", ["extrapolation/primitives/reach", "composition/ee-task"])
def test_scenarios_have_the_counts_of_the_paper(name):
    ours, theirs = statistics(read_split(name), LIBRARY)["train"], paper_row(name)
    assert (ours["links"], ours["movable"]) == (theirs.links, theirs.movable)
