"""Regimes of splits: structures, parameter hulls, and findings about broken rules."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from morphgen.benchmark.regimes import (
    ON_HULL,
    combination,
    hull_distance,
    parameters,
    parts,
    regime_findings,
    structure,
)
from morphgen.benchmark.split import Member, Split
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words

LIBRARY = default_library()


def derivation(words):
    return parse_words(words.split(), LIBRARY)[0]


def member(name, words, task="reach", category="composed"):
    return Member(name, category, str(derivation(words)), task, False, "0" * 32)


def codes(regime, train, test, **provenance):
    split = Split("s", regime, "", tuple(train), tuple(test), provenance)
    findings = regime_findings(split, LIBRARY)
    assert all(each.severity == "error" and each.fix for each in findings)
    return [each.code for each in findings]


def test_a_structure_has_parts_and_counts_but_no_sizes_and_labels():
    assert structure(derivation("arm=ur5 ee=plane"), LIBRARY) == "fixed[top: ur5[flange: plane]]"
    large = derivation("arm=ur5 ee=plane ee.size=0.2 ee.mount_yaw=45deg")
    assert structure(large, LIBRARY) == structure(derivation("arm=ur5 ee=plane"), LIBRARY)
    labelled = parse_derivation("b=fixed[top: a=ur5[flange: e=plane(size=0.3)]]")
    assert structure(labelled, LIBRARY) == structure(large, LIBRARY)
    other = "arm=ur5 ee=hand ee.fingers=4"
    assert structure(derivation(other), LIBRARY) != structure(derivation(other[:-1] + "5"), LIBRARY)
    assert combination(derivation(other)) == combination(derivation(other[:-1] + "5"))
    named, bare = (
        derivation("arm=ur5 ee=tongs"),
        parse_derivation("base=fixed[top: arm=ur5[flange: ee=tongs]]"),
    )
    assert structure(bare, LIBRARY) == structure(named, LIBRARY)  # omitted counts are defaults
    assert parameters(bare, LIBRARY) == parameters(named, LIBRARY)


def test_parts_include_the_default_base():
    assert parts(derivation("arm=ur5 ee=plane")) == {"fixed", "ur5", "plane"}
    assert parts(derivation("arm=ur5")) == {"fixed", "ur5"}
    two = derivation("base=pedestal left.arm=ur5 left.ee=plane right.arm=lwr")
    assert parts(two) == {"pedestal", "ur5", "plane", "lwr"}


def test_parameters_are_in_tree_order():
    values = parameters(derivation("arm=arm3 arm.length=0.3 ee=claw ee.mount_yaw=1"), LIBRARY)
    assert values["1.length"] == 0.3
    assert values["2.mount_yaw"] == 1.0
    assert values["1.mount_yaw"] == 0.0
    assert "1.wrist" not in values, "a count is part of the structure"
    assert "0.mount_yaw" not in values, "the root hangs on nothing"


def test_hull_distances_are_in_units_of_the_parameter_range():
    square = [(0, 0), (2, 0), (0, 2), (2, 2)]
    assert hull_distance((1, 0.5), square) == pytest.approx(0, abs=1e-9)
    assert hull_distance((2, 2), square) == pytest.approx(0, abs=1e-9)
    assert hull_distance((3, 1), square) == pytest.approx(0.5), "half the range of 2"
    assert hull_distance((3, 4), square) == pytest.approx(1.5)


def test_constant_parameters_are_ignored_unless_they_differ():
    flat = [(0.0, 5.0, 1e-3), (1.0, 5.0, 3e-3)]
    assert hull_distance((0.5, 5.0, 2e-3), flat) == pytest.approx(0, abs=1e-9)
    assert hull_distance((0.5, 5.1, 2e-3), flat) == np.inf
    assert hull_distance((0.5, 5.0, 1e-3), flat) == pytest.approx(0.5), "off the line of the two"
    assert hull_distance((0.0, 5.0), [(0.0, 5.0)]) == 0
    assert hull_distance((0.1, 5.0), [(0.0, 5.0)]) == np.inf


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 4), st.integers(6, 40), st.floats(0.4, 1.4))
def test_points_inside_the_hull_agree_with_a_delaunay_triangulation(seed, d, n, spread):
    rng = np.random.default_rng(seed)
    points = rng.random((n, d)) * 10.0 ** rng.integers(-3, 3, d)
    centre = points.mean(axis=0)
    point = centre + spread * (points[0] - centre) * rng.random(d)
    inside = Delaunay(points, qhull_options="Qbb Qc Qz Q12 QbB").find_simplex(point) >= 0
    assert (hull_distance(point, points) <= ON_HULL) == inside


ARM3 = "arm=arm3 arm.length={} ee=claw"


def test_interpolation_requires_a_trained_structure():
    train = [member("a", ARM3.format(0.1)), member("b", ARM3.format(0.4))]
    assert codes("interpolation", train, [member("t", ARM3.format(0.3))]) == []
    assert codes("interpolation", train, [member("t", "arm=arm5 ee=claw")]) == ["structure-unseen"]
    counted = [member("t", "arm=arm3 arm.wrist=0 ee=claw")]
    assert codes("interpolation", train, counted) == ["structure-unseen"]


@pytest.mark.parametrize(
    ("length", "hull", "expected"),
    [
        (0.3, "inside", []),
        (0.45, "inside", ["hull"]),
        (0.3, "outside", ["hull"]),
        (0.45, "outside", []),
        (0.45, "any", []),
        (0.3, "any", []),
    ],
)
def test_interpolation_requires_parameters_within_the_hull(length, hull, expected):
    train = [member("a", ARM3.format(0.1)), member("b", ARM3.format(0.4)), member("c", "arm=ur5")]
    test = [member("t", ARM3.format(length))]
    assert codes("interpolation", train, test, hull=hull) == expected
    assert codes("interpolation", train, test) == []


def test_composition_requires_trained_parts_in_a_new_combination():
    train = [member("a", "arm=ur5 ee=plane"), member("b", "arm=lwr ee=stick")]
    assert codes("composition", train, [member("t", "arm=ur5 ee=stick")]) == []
    assert codes("composition", train, [member("t", "arm=ur5 ee=cube")]) == ["part-unseen"]
    sized = [member("t", "arm=ur5 ee=plane ee.size=0.3")]
    assert codes("composition", train, sized) == ["combination-seen"]


def test_composition_with_tasks_requires_a_new_pair_of_robot_and_task():
    train = [
        member("a", "base=gantry ee=plane", "push"),
        member("b", "arm=ur5 ee=stick", "reach"),
        member("c", "arm=lwr ee=stick", "reach"),
    ]
    assert codes("composition", train, [member("t", "arm=ur5 ee=plane", "push")]) == []
    pushing = [*train, member("d", "arm=ur5 ee=cube", "push")]
    assert codes("composition", pushing, [member("t", "arm=ur5 ee=plane", "push")]) == ["pair-seen"]
    assert codes("composition", pushing, [member("t", "arm=ur5 ee=plane", "reach")]) == []
    seen = [member("t", "arm=ur5 ee=stick", "push")]
    assert codes("composition", train, seen) == ["combination-seen"]


def test_extrapolation_requires_a_new_category_and_structure():
    train = [member("a", "nlink links=3", category="nlink"), member("b", "arm=ur5")]
    assert codes("extrapolation", train, [member("t", "chain", category="chain")]) == []
    same = [member("t", "nlink links=4", category="nlink")]
    assert codes("extrapolation", train, same) == ["category-seen"]
    same = [member("t", "nlink links=3", category="mine")]
    assert codes("extrapolation", train, same) == ["structure-seen"]
    assert codes("extrapolation", train, [member("t", "arm=lwr")]) == [], "composed is no category"


@pytest.mark.parametrize("regime", ["interpolation", "extrapolation", "composition"])
def test_a_test_task_must_be_trained(regime):
    train = [member("a", "arm=ur5 ee=plane"), member("b", "arm=lwr ee=stick")]
    test = [member("t", "arm=ur5 ee=stick", "push")]
    assert "task-unseen" in codes(regime, train, test)
    assert "task-unseen" not in codes(regime, train, [replace(test[0], task="reach")])
