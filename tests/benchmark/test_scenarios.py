"""The shipped splits are what their tables of robots generate; licences of parts."""

from dataclasses import replace

import pytest

from helpers.splits import combined
from morphgen.benchmark.licences import (
    UNKNOWN,
    find_licence,
    known_licences,
    licence_ids,
    licenced_parts,
    require_allowed,
    restricted,
)
from morphgen.benchmark.regimes import regime_findings, stream_seed
from morphgen.benchmark.survey import statistics
from morphgen.errors import BenchmarkError
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import pin
from morphgen.splits.split import (
    SIDES,
    RobotFactory,
    SampledRecipe,
    find_split,
    read_split,
    recipe_of,
    split_names,
    split_text,
)

LIBRARY = default_library()
ARTICULATED = ("dial", "door", "drawer")
PAPER_NAMES = [
    *(f"composition/{name}" for name in ("ee-arm/push", "ee-arm/reach", "ee-task")),
    *(f"extrapolation/{robots}/{task}" for robots in ("arms-small", "arms", "primitives")
      for task in ("push", "reach")),
    *(f"interpolation/arm3/{task}{boxes}" for task in ("push", "reach")
      for boxes in ("", "-obstacles")),
    *(f"interpolation/panda/{task}" for task in ("push", "reach")),
]  # fmt: skip
ROBOTS = {
    "composition/ee-arm": "composition/ee-arm/push",
    "composition/ur5-plane": "composition/ee-task",
    "extrapolation/arms-small": "extrapolation/arms-small/push",
    "extrapolation/arms": "extrapolation/arms/push",
    "extrapolation/primitives-sliding": "extrapolation/primitives/push",
    "interpolation/arm3": "interpolation/arm3/push",
    "interpolation/panda": "interpolation/panda/push",
}
"""The split of the paper that has the robots of those with articulated objects."""
LEFT_OUT = {"extrapolation/primitives-sliding": {"nlink"}}
"""Categories of robots without feasible starts."""
NAMES = PAPER_NAMES + [f"{robots}/{task}" for robots in ROBOTS for task in ARTICULATED]
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
                recipe = replace(recipe_of(row["words"].split(), LIBRARY), name=row["robot"])
            else:
                loaded = load_grammar(find_grammar(row["grammar"], folders), folders)
                pinned = pin(loaded, row.get("pinned", "").split(), LIBRARY)
                assert row["seed"] == stream_seed(0, member.name.removesuffix(f"-{number:06d}"))
                recipe = SampledRecipe(pinned, number, row["seed"], member.name)
            yield factory(recipe).member(member.task, [member.task], member.obstacles)
    assert next(stored, None) is None


def test_there_are_fifteen_scenarios_of_the_paper_and_three_tasks_with_their_robots():
    assert split_names() == sorted(NAMES)


@pytest.mark.parametrize("robots", ROBOTS)
@pytest.mark.parametrize("task", ARTICULATED)
def test_splits_with_articulated_objects_have_the_robots_of_the_paper(robots, task):
    split, paper = read_split(f"{robots}/{task}"), read_split(ROBOTS[robots])
    for side in SIDES:
        assert split.side(side) == tuple(
            replace(member, task=task)
            for member in paper.side(side)
            if member.category not in LEFT_OUT.get(robots, ())
        )


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


RESTRICTED_SPLITS = {
    f"{name}/{task}"
    for name in ("composition/ee-arm", "extrapolation/arms")
    for task in ("reach", "push", *ARTICULATED)
}


def test_every_licence_of_the_library_is_known():
    used = {LIBRARY.manifest(name).licence for name in LIBRARY.names()}
    assert used - set(known_licences()) == set()
    for name in used:
        licence = find_licence(name)
        assert ("NC" in name.split("-")) == ("non-commercial" in licence.restrictions)
        assert ("ND" in name.split("-")) == ("no derivatives" in licence.restrictions)
        assert licence.is_spdx == (not name.startswith("LicenseRef-"))


def test_an_unlisted_licence_counts_as_unknown():
    licence = find_licence("Proprietary")
    assert (licence.restrictions, licence.url, licence.hub_id) == ((UNKNOWN,), "", "unknown")


def test_ten_scenarios_have_a_restricted_part():
    found = {}
    for name in split_names():
        for part in restricted(licenced_parts(read_split(name), LIBRARY)):
            found[name] = (part.part, part.licence.id, part.robots)
    assert set(found) == RESTRICTED_SPLITS
    assert set(found.values()) == {("sake_ez", "CC-BY-NC-ND-4.0", (("train", "ur5-ez"),))}


def test_parts_name_every_robot_of_both_sides():
    parts = {part.part: part for part in licenced_parts(combined(), LIBRARY)}
    assert set(parts) == {"gantry", "planar", "plane", "cube", "cylinder"}
    assert parts["plane"].as_dict() == {
        "part": "plane",
        "licence": "MIT",
        "restrictions": [],
        "source": LIBRARY.manifest("plane").citation,
        "robots": {"train": ["gantry-plane"], "test": ["planar-plane"]},
    }


def test_a_restricted_licence_must_be_allowed():
    split = read_split("composition/ee-arm/reach")
    parts = licenced_parts(split, LIBRARY)
    assert licence_ids(parts) == ("BSD-3-Clause", "CC-BY-NC-ND-4.0", "MIT")
    with pytest.raises(BenchmarkError) as caught:
        require_allowed(split, parts, ())
    assert str(caught.value) == (
        "composition/ee-arm/reach: sake_ez (CC-BY-NC-ND-4.0: non-commercial, no derivatives) in "
        "robots ur5-ez; release a split without these parts, or allow the licence with "
        "--licence-allow CC-BY-NC-ND-4.0"
    )
    require_allowed(split, parts, ("CC-BY-NC-ND-4.0",))
    with pytest.raises(BenchmarkError, match=r"no part of .* has this licence; did you mean 'CC-"):
        require_allowed(split, parts, ("CC-BY-NC-ND-3.0",))
