"""Robots that `morphgen sample` draws from each category of the benchmark."""

import pytest

from helpers.grammars import CATEGORIES, LIBRARY, benchmark_counts, shipped, unphysical
from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.sampling import Sample, sample_robot

RANGES = {
    "nlink": ({4, 5, 6, 7}, {2, 3, 4, 5}),
    "chain": ({10, 13, 16, 19, 22, 25}, {7, 9, 11, 13, 15, 17}),
    "planar_arm": (set(range(6, 11)), set(range(4, 10))),
    "multi_finger": (set(range(8, 20)), set(range(5, 19))),
    "tongs": ({10, 12}, {7, 9}),
}
"""Links and movable joints that the benchmark's table names for categories of several sizes."""


def robot_faults(drawn: Sample, category):
    """Return the faults of a robot of a category."""
    robot = drawn.robot
    counts = (len(robot.links), len(robot.movable_joints))
    faults = unphysical(robot)
    if counts != benchmark_counts(category, drawn.derivation):
        faults.append(f"{counts} links and movable joints: {drawn.derivation}")
    if category in RANGES:
        faults += [
            f"{n} not in {ok}"
            for n, ok in zip(counts, RANGES[category], strict=True)
            if n not in ok
        ]
    faults += [f"{f.code} {f.where}" for f in check(robot) if f.severity != "info"]
    if [frame.name for frame in robot.frames] != ["tool"]:
        faults.append(f"frames {robot.frames}")
    return faults


@pytest.mark.parametrize("category", CATEGORIES)
def test_robots_have_the_counts_of_the_benchmark_and_all_loaders_agree(category, tmp_path):
    grammar = shipped(category)
    drawn = [sample_robot(grammar, LIBRARY, index, seed=11) for index in range(3)]
    assert [trouble for one in drawn for trouble in robot_faults(one, category)] == []
    folder = write_bundle(drawn[0].robot, tmp_path / "robot", picture=False)
    report = conformance(folder, 20)
    assert report.passed, report
    assert [f.code for f in check(read_bundle(folder)) if f.severity != "info"] == []


@pytest.mark.slow
@pytest.mark.parametrize("category", CATEGORIES)
def test_a_hundred_robots_have_no_errors_and_all_loaders_agree(category, tmp_path):
    grammar = shipped(category)
    for index in range(100):
        drawn = sample_robot(grammar, LIBRARY, index, seed=12)
        assert robot_faults(drawn, category) == []
        folder = write_bundle(drawn.robot, tmp_path / "robot", picture=False)
        report = conformance(folder, 20)
        assert report.passed, report
