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
    *(f"composition/{name}" for name in ("ee-arm/push", "ee-arm/reach", "ee-task")),
    *(f"extrapolation/{robots}/{task}" for robots in ("arms-small", "arms", "primitives")
      for task in ("push", "reach")),
    *(f"interpolation/arm3/{task}{boxes}" for task in ("push", "reach")
      for boxes in ("", "-obstacles")),
    *(f"interpolation/panda/{task}" for task in ("push", "reach")),
]  # fmt: skip
PAPER_COUNTS = {
    "interpolation/arm3/reach": (10, 9),
    "interpolation/panda/reach": (11, 9),
    "composition/ee-task": (7.75, 5.25),
    "extrapolation/primitives/reach": (6.6, 4.6),
}
"""Links and movable joints of train robots in the paper."""
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
    if name in PAPER_COUNTS:
        train = split.statistics["train"]
        assert (train["links"], train["movable"]) == PAPER_COUNTS[name]


@pytest.mark.parametrize("name", NAMES)
def test_regime_findings_are_only_the_accepted_ones(name):
    split = read_split(name)
    assert {each.code for each in regime_findings(split, LIBRARY)} == set(split.accepted)
