"""Regimes of splits and their rules; splits by interpolation and extrapolation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay

import morphgen
from helpers.grammars import grammar, shipped
from helpers.splits import LIBRARY, derivations, names, order, require_sound
from morphgen.benchmark import regimes
from morphgen.benchmark.composition import composition
from morphgen.benchmark.regimes import (
    combination,
    extrapolation,
    hull_distance,
    interpolation,
    parameters,
    regime_findings,
    structure,
)
from morphgen.benchmark.survey import audit
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import BenchmarkError
from morphgen.grammar.request import parse_words
from morphgen.grammar.syntax import parse_derivation
from morphgen.model.findings import Finding
from morphgen.progress import show_progress
from morphgen.splits import split as split_module
from morphgen.splits.split import Member, RobotFactory, SampledRecipe, Split, recipe_of


def points(members):
    return np.array([list(parameters(d, LIBRARY).values()) for d in derivations(members)])


def test_robots_equal_those_of_sample():
    (split,) = interpolation(order(3), shipped("cubes"), LIBRARY)
    seeds = split.provenance["seeds"]
    drawn = morphgen.sample("cubes", 3, seed=seeds["cubes"])
    assert [m.robot_hash for m in split.train] == [robot_hash(robot) for robot in drawn]
    first = next(morphgen.sample("cubes", 1, seed=seeds["cubes-test"]))
    assert split.test[0].robot_hash == robot_hash(first)
    assert names(split.train) == ["cubes-000000", "cubes-000001", "cubes-000002"]
    assert names(split.test) == ["cubes-test-000000"]
    assert {m.category for m in (*split.train, *split.test)} == {"cubes"}
    require_sound(split)


def test_robots_depend_on_the_seed_not_on_their_number():
    few, again, other = (
        interpolation(order(n, seed=seed), shipped("cubes"), LIBRARY)[0]
        for n, seed in ((2, 5), (6, 5), (2, 6))
    )
    assert few.train == again.train[:2]
    assert few.test == again.test
    bodies = {m.robot_hash for m in (*few.train, *few.test)}
    assert bodies.isdisjoint(m.robot_hash for m in (*other.train, *other.test))


@pytest.mark.parametrize("hull", ["inside", "outside"])
def test_test_robots_of_every_size_obey_the_hull_option(hull):
    splits = interpolation(order(6, 12, test=2), shipped("arm3"), LIBRARY, hull=hull)
    assert [split.name for split in splits] == ["mine-train6", "mine-train12"]
    assert [split.provenance["train"] for split in splits] == [6, 12]
    assert splits[0].train == splits[1].train[:6]
    assert len({split.test for split in splits}) == 1
    for split in splits:
        train, test = points(split.train), points(split.test)
        varied = np.ptp(train, axis=0) > 0
        assert varied.sum() == 3
        inside = Delaunay(train[:, varied]).find_simplex(test[:, varied]) >= 0
        assert list(inside) == [hull == "inside"] * 2
        assert regime_findings(split, LIBRARY) == ()
        assert split.provenance["hull"] == hull
        assert split.provenance["nested"] == [6, 12]


def test_interpolation_tests_only_trained_structures():
    (split,) = interpolation(order(2, test=6), shipped("prims"), LIBRARY)
    trained = {structure(d, LIBRARY) for d in derivations(split.train)}
    assert len(trained) <= 2
    assert {structure(d, LIBRARY) for d in derivations(split.test)} <= trained
    require_sound(split)


def test_every_robot_does_every_task():
    request = order(1, 2, tasks=("reach", "push"), obstacles=True)
    splits = interpolation(request, shipped("cubes"), LIBRARY)
    wanted = [f"cubes-00000{i}-{task}" for i in (0, 1) for task in ("reach", "push")]
    assert [names(split.train) for split in splits] == [wanted[:2], wanted]
    assert [m.task for m in splits[0].test] == ["reach", "push"]
    assert len({m.robot_hash for m in splits[0].test}) == 1
    assert all(m.obstacles for m in splits[0].train)


def test_progress_reaches_the_total():
    told = []
    with show_progress(lambda done, total: told.append(done)):
        interpolation(order(3, test=2), shipped("cubes"), LIBRARY)
    assert told == [1, 2, 3, 4, 5]
    told.clear()
    patterns = ["base=gantry ee={plane,cube}", "base=fixed arm=lwr ee={plane,cube}"]
    with show_progress(lambda done, total: told.append(done)):
        composition(order(2), patterns, LIBRARY)
    assert told == [1, 2, 3]


def test_train_robots_are_never_test_robots(monkeypatch):
    monkeypatch.setattr(regimes, "MAX_DRAWS", 50)
    few = grammar("robot -> gantry plane(size=choice(0.1, 0.2, 0.3))")
    (split,) = interpolation(order(2), few, LIBRARY)
    bodies = {m.robot_hash for m in split.train}
    assert bodies.isdisjoint(m.robot_hash for m in split.test)
    with pytest.raises(BenchmarkError, match=r"0 of 1 .* in 50 draws; \d+ had the body of g-"):
        interpolation(order(9), few, LIBRARY)


def test_an_empty_hull_is_an_error(monkeypatch):
    monkeypatch.setattr(regimes, "MAX_DRAWS", 100)
    with pytest.raises(BenchmarkError) as caught:
        interpolation(order(3), shipped("arm3"), LIBRARY, hull="inside")
    assert str(caught.value) == (
        "arm3: 0 of 1 test robots found in 100 draws; 100 had parameters on the other side of the "
        "hull of the train robots; ask for more train robots, or for --hull any"
    )
    with pytest.raises(BenchmarkError, match="--hull insid: unknown; did you mean 'inside'"):
        interpolation(order(3), shipped("arm3"), LIBRARY, hull="insid")


CATEGORIES = ("stick", "nlink", "prims")


def grammars(*wanted):
    return [shipped(name) for name in wanted]


def test_extrapolation_cycles_through_the_categories():
    sides = grammars(*CATEGORIES), grammars("chain", "cubes")
    few, many = extrapolation(order(4, 7, test=2), *sides, LIBRARY)
    assert [m.category for m in many.train] == [*CATEGORIES, *CATEGORIES, "stick"]
    assert names(many.train)[3:] == ["stick-000001", "nlink-000001", "prims-000001", "stick-000002"]
    assert few.train == many.train[:4]
    assert names(many.test) == ["chain-000000", "cubes-000000"]
    require_sound(many)
    (other,) = extrapolation(order(2), grammars("cubes", "stick"), grammars("chain"), LIBRARY)
    assert other.train[0] == many.test[1]  # whatever the other categories are


def test_extrapolation_never_tests_trained_structures(monkeypatch):
    mine = grammar(
        "robot -> post links sphere(radius=0.02)",
        "links -> beam(length=uniform(0.1, 0.5)){2,7}",
        name="mine",
    )
    (split,) = extrapolation(order(8, test=3), grammars("nlink"), [mine], LIBRARY)
    trained = {structure(d, LIBRARY) for d in derivations(split.train)}
    assert trained.isdisjoint(structure(d, LIBRARY) for d in derivations(split.test))
    assert names(split.test) != ["mine-000000", "mine-000001", "mine-000002"]
    same = replace(shipped("nlink"), name="mine")
    monkeypatch.setattr(regimes, "MAX_DRAWS", 60)
    with pytest.raises(BenchmarkError, match=r"60 draws; .* had the structure of a train robot"):
        extrapolation(order(20), grammars("nlink"), [same], LIBRARY)


def test_too_many_links_are_a_finding_unless_max_links_is_raised():
    wanted, sides = order(2, test=6), (grammars("stick"), grammars("chain"))
    with pytest.raises(BenchmarkError, match=r"robot 'chain-\d+' has 25 links, more than max_li"):
        extrapolation(wanted, *sides, LIBRARY)
    (made,) = extrapolation(replace(wanted, max_links=25), *sides, LIBRARY)
    assert made.provenance["max_links"] == made.max_links == 25
    assert "links-many" not in {each.code for each in audit(made, LIBRARY).findings}
    narrower = {k: v for k, v in made.provenance.items() if k != "max_links"}
    narrow = replace(made, provenance=narrower)
    findings = [each for each in audit(narrow, LIBRARY).findings if each.code == "links-many"]
    assert findings
    assert {each.why for each in findings} == {"it has 25 links, more than max_links 23"}
    assert all("--max-links" in each.fix for each in findings)


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (("stick", "chain"), ("chain",), "--test-category chain: the category is on both sides"),
        (("stick", "stick"), ("chain",), "--train-category stick: the category is there twice"),
        (("stick",), ("chain", "chain"), "--test-category chain: the category is"),
    ],
)
def test_duplicate_categories_are_errors(train, test, message):
    with pytest.raises(BenchmarkError, match=message):
        extrapolation(order(4), grammars(*train), grammars(*test), LIBRARY)


@pytest.mark.parametrize(
    ("sizes", "changes", "message"),
    [
        ((0,), {}, "--train 0 --test 1 --seed 0: --train and --test start at 1"),
        ((1,), {"test": 0}, "--train 1 --test 0 --seed 0: --train and --test start at 1"),
        ((1,), {"seed": -1}, "--seed at 0"),
        ((3, 2), {}, "--train 3,2: expected sizes that grow, such as 10,30,100"),
    ],
)
def test_invalid_orders_are_errors(sizes, changes, message):
    with pytest.raises(BenchmarkError, match=message):
        order(*sizes, **changes)


def test_robots_are_built_from_the_rounded_numbers_of_their_derivation():
    """The default of the base has 16 digits; the hash is that of the printed derivation."""
    body = RobotFactory(LIBRARY)(recipe_of(("base=planar", "ee=cube"), LIBRARY))
    assert "travel_yaw=3.14159265359" in str(body.derivation)
    assert dict(body.derivation.parameters)["travel_yaw"] == 3.14159265359
    robot_grammar = grammar("robot -> planar ee", "ee -> cube(size=uniform(0.05, 0.1))")
    drawn = RobotFactory(LIBRARY)(SampledRecipe(robot_grammar, 0, 1, "x"))
    again = parse_derivation(str(drawn.derivation))
    assert again == drawn.derivation


def test_a_robot_that_fails_its_checks_is_an_error(monkeypatch):
    findings = [Finding("overlap", "error", "link a", "too deep", "move it")]
    monkeypatch.setattr(split_module, "check", lambda robot: findings)
    with pytest.raises(BenchmarkError, match="gantry-cube: overlap at link a: too deep"):
        RobotFactory(LIBRARY)(recipe_of(("base=gantry", "ee=cube"), LIBRARY))


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
    named = derivation("arm=ur5 ee=tongs")
    bare = parse_derivation("base=fixed[top: arm=ur5[flange: ee=tongs]]")
    assert structure(bare, LIBRARY) == structure(named, LIBRARY)  # omitted counts are defaults
    assert parameters(bare, LIBRARY) == parameters(named, LIBRARY)


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


ARM3 = "arm=arm3 arm.length={} ee=claw"
SHORT, LONG = member("a", ARM3.format(0.1)), member("b", ARM3.format(0.4))
UR5, LWR = member("a", "arm=ur5 ee=plane"), member("b", "arm=lwr ee=stick")
PUSHING = [
    member("a", "base=gantry ee=plane", "push"),
    member("b", "arm=ur5 ee=stick"),
    member("c", "arm=lwr ee=stick"),
]
CUBE = member("d", "arm=ur5 ee=cube", "push")
NLINK = [member("a", "nlink links=3", category="nlink"), member("b", "arm=ur5")]
RULES = [
    ("interpolation", [SHORT, LONG], (ARM3.format(0.3),), []),
    ("interpolation", [SHORT, LONG], ("arm=arm5 ee=claw",), ["structure-unseen"]),
    ("interpolation", [SHORT, LONG], ("arm=arm3 arm.wrist=0 ee=claw",), ["structure-unseen"]),
    ("composition", [UR5, LWR], ("arm=ur5 ee=stick",), []),
    ("composition", [UR5, LWR], ("arm=ur5 ee=cube",), ["part-unseen"]),
    ("composition", [UR5, LWR], ("arm=ur5 ee=plane ee.size=0.3",), ["combination-seen"]),
    ("composition", PUSHING, ("arm=ur5 ee=plane", "push"), []),
    ("composition", PUSHING, ("arm=ur5 ee=stick", "push"), ["combination-seen"]),
    ("composition", [*PUSHING, CUBE], ("arm=ur5 ee=plane", "push"), ["pair-seen"]),
    ("composition", [*PUSHING, CUBE], ("arm=ur5 ee=plane", "reach"), []),
    ("extrapolation", NLINK, ("chain", "reach", "chain"), []),
    ("extrapolation", NLINK, ("nlink links=4", "reach", "nlink"), ["category-seen"]),
    ("extrapolation", NLINK, ("nlink links=3", "reach", "mine"), ["structure-seen"]),
    ("extrapolation", NLINK, ("arm=lwr",), []),  # composed is no category
]


@pytest.mark.parametrize(("regime", "train", "test", "expected"), RULES)
def test_each_regime_has_its_rules(regime, train, test, expected):
    assert codes(regime, train, [member("t", *test)]) == expected


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
    train, test = [SHORT, LONG, member("c", "arm=ur5")], [member("t", ARM3.format(length))]
    assert codes("interpolation", train, test, hull=hull) == expected
    assert codes("interpolation", train, test) == []


@pytest.mark.parametrize("regime", ["interpolation", "extrapolation", "composition"])
def test_a_test_task_must_be_trained(regime):
    test = member("t", "arm=ur5 ee=stick", "push")
    assert "task-unseen" in codes(regime, [UR5, LWR], [test])
    assert "task-unseen" not in codes(regime, [UR5, LWR], [replace(test, task="reach")])
