"""The scenarios of the paper: the shipped files equal what their definitions generate."""

import re

import pytest

from morphgen.benchmark.regimes import regime_findings
from morphgen.benchmark.scenarios import SCENARIOS, scenario_splits, write_scenarios
from morphgen.benchmark.split import SIDES, compose_member
from morphgen.benchmark.split_file import find_split, read_split, split_names, split_text
from morphgen.benchmark.tokens import MAX_LINKS
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import default_library

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
QUICK = ["composition/ee-task", "extrapolation/primitives"]


def versionless(text):
    """Return the text of a split file without the version of morphgen that wrote it."""
    return re.sub(r"(?m)^morphgen: .*\n", "", text)


def test_there_are_fifteen_scenarios():
    assert split_names() == NAMES


@pytest.mark.parametrize(
    "name",
    [pytest.param(s.name, marks=[] if s.name in QUICK else [pytest.mark.slow]) for s in SCENARIOS],
)
def test_the_shipped_files_equal_the_generated_splits(name, tmp_path):
    paths = write_scenarios(tmp_path, [name])
    assert [path for path in paths if not path.is_file()] == []
    for path in paths:
        shipped_path = find_split(path.relative_to(tmp_path).with_suffix("").as_posix())
        generated_text = path.read_text(encoding="utf-8")
        assert versionless(shipped_path.read_text(encoding="utf-8")) == versionless(generated_text)


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


def test_ee_task_combines_robots_and_tasks():
    split = read_split("composition/ee-task")
    assert [(m.category, m.task) for m in split.train] == [("prims", "push")] * 3 + [
        ("composed", "reach")
    ]
    assert [(m.name, m.task) for m in split.test] == [("ur5-plane", "push")]


@pytest.mark.parametrize("name", [name for name in NAMES if "push" in name])
def test_reach_and_push_share_their_robots(name):
    split, other = read_split(name), read_split(name.replace("push", "reach"))
    for side in SIDES:
        assert {m.task for m in split.side(side)} == {"push"}
        assert [(m.name, m.robot_hash) for m in split.side(side)] == [
            (m.name, m.robot_hash) for m in other.side(side)
        ]
        assert {m.task for m in other.side(side)} == {"reach"}
        assert {m.obstacles for m in split.side(side)} == {name.endswith("obstacles")}


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


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_robot_has_its_recorded_hash_and_fits_into_the_tokens(name):
    split = read_split(name)
    for member in (*split.train, *split.test):
        assert len(compose_member(member, LIBRARY).links) <= MAX_LINKS


def test_robots_of_a_file_have_their_recorded_hashes():
    split = read_split("extrapolation/arms/push")
    named = {member.name: member for member in (*split.train, *split.test)}
    for name in ("ur5-stick", "lwr", "widowx", "arm5-000000"):
        assert compose_member(named[name], LIBRARY).name == name


def test_an_unknown_scenario_suggests_the_nearest():
    with pytest.raises(BenchmarkError, match="did you mean 'extrapolation/arms'"):
        scenario_splits("extrapolation/armz", LIBRARY)
