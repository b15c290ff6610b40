"""The scenarios of the paper: the shipped files hold what their tables of robots generate."""

import pytest

from morphgen.benchmark.generate import (
    ComposedRecipe,
    RobotFactory,
    SampledRecipe,
    members,
    stream_seed,
)
from morphgen.benchmark.regimes import regime_findings
from morphgen.benchmark.split import SIDES
from morphgen.benchmark.split_file import find_split, read_split, split_names, split_text
from morphgen.benchmark.survey import statistics
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import pin

LIBRARY = default_library()
NAMES = [
    "composition/ee-arm/push",
    "composition/ee-arm/reach",
    "composition/ee-task",
    "extrapolation/arms-small/push",
    "extrapolation/arms-small/reach",
    "extrapolation/arms/push",
    "extrapolation/arms/reach",
    "extrapolation/primitives/push",
    "extrapolation/primitives/reach",
    "interpolation/arm3/push",
    "interpolation/arm3/push-obstacles",
    "interpolation/arm3/reach",
    "interpolation/arm3/reach-obstacles",
    "interpolation/panda/push",
    "interpolation/panda/reach",
]
QUICK = ["composition/ee-task", "extrapolation/primitives/reach"]


def generated(split, side):
    """Yield the members of a side as the rows of ``made`` in the split's file describe them."""
    factory, folders = RobotFactory(LIBRARY), LIBRARY.folders
    stored = iter(split.side(side))
    for row in split.provenance[side]:
        for number in range(row.get("first", 0), row.get("first", 0) + row.get("robots", 1)):
            member = next(stored)
            if "words" in row:
                recipe = ComposedRecipe(tuple(row["words"].split()), row["robot"])
            else:
                loaded = load_grammar(find_grammar(row["grammar"], folders), folders)
                pinned = pin(loaded, row.get("pinned", "").split(), LIBRARY)
                assert row["seed"] == stream_seed(0, member.name.removesuffix(f"-{number:06d}"))
                recipe = SampledRecipe(pinned, number, row["seed"], member.name)
            yield from members([factory(recipe)], [member.task], member.obstacles)
    assert next(stored, None) is None


def test_there_are_fifteen_scenarios():
    assert split_names() == NAMES


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_the_shipped_files_equal_the_generated_splits(name):
    split = read_split(name)
    for side in SIDES:
        assert tuple(generated(split, side)) == split.side(side)
    assert statistics(split, LIBRARY) == split.statistics


@pytest.mark.parametrize("name", NAMES)
def test_the_shipped_files_round_trip(name):
    text = find_split(name).read_text(encoding="utf-8")
    split = read_split(name)
    assert split_text(split) == text
    assert split.name == name
    assert split.regime == name.partition("/")[0]
    assert "arXiv 2505.14986" in split.reference or "AnyBody" in split.reference


@pytest.mark.parametrize("name", NAMES)
def test_regime_findings_are_only_the_accepted_ones(name):
    split = read_split(name)
    assert {each.code for each in regime_findings(split, LIBRARY)} == set(split.accepted)


@pytest.mark.parametrize(
    ("name", "links", "movable"),
    [
        ("interpolation/arm3/reach", 10, 9),
        ("interpolation/panda/reach", 11, 9),
        ("composition/ee-task", 7.75, 5.25),
        ("extrapolation/primitives/reach", 6.6, 4.6),
    ],
)
def test_link_and_joint_counts_match_the_paper(name, links, movable):
    train = read_split(name).statistics["train"]
    assert (train["links"], train["movable"]) == (links, movable)
