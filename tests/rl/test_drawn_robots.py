"""Training robots drawn from grammars: which they are, and which are never among them."""

import json
from dataclasses import replace

import pytest

from helpers.grammars import shipped
from helpers.splits import member, split
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import GrammarError, TaskError
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robots
from morphgen.progress import show_progress
from morphgen.rl.runs import robot_source as drawn_robots
from morphgen.rl.runs.robot_source import (
    FILE,
    draw,
    drawn_source,
    num_drawn,
    other_side,
    read_drawn,
    robot_source,
    specs_of,
    split_source,
    tasks_of,
    trained_on,
    write_drawn,
)
from morphgen.splits.split import Member, compose_member
from morphgen.splits.split_file import read_split, split_names, write_split
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import GoalConfig

LIBRARY = default_library()
FEW = GoalConfig(tasks=(ReachConfig(num_goals=3),))


pytestmark = pytest.mark.usefixtures("module_cache")


@pytest.fixture(autouse=True)
def _nothing_drawn(monkeypatch):
    monkeypatch.setattr(drawn_robots, "_drawn", {})


@pytest.fixture
def grammar_file(tmp_path):
    def write(*lines, name="mine"):
        path = tmp_path / f"{name}.grammar"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


def hashes(robots):
    return [each.robot_hash for each in robots.members]


def test_robots_are_those_of_sample_with_their_goals():
    source = drawn_source("cubes:3, stick:2", "reach", seed=4)
    assert (source.name, num_drawn(source), tasks_of(source)) == ("cubes:3,stick:2", 5, ("reach",))
    robots = draw(source, FEW)
    sampled = [
        each.robot
        for name, count in source.grammars
        for each in sample_robots(shipped(name), LIBRARY, count, seed=4)
    ]
    assert [each.name for each in robots.members] == [each.name for each in sampled]
    assert hashes(robots) == [robot_hash(each) for each in sampled]
    assert [each.category for each in robots.members] == ["cubes"] * 3 + ["stick"] * 2
    assert robots.most_links == 5
    assert robots.skipped == {}
    for each, spec in zip(robots.members, robots.specs, strict=True):
        assert robot_hash(compose_member(each, LIBRARY)) == each.robot_hash
        assert (spec.robot.name, spec.task, len(spec.goals.q)) == (each.name, "reach", 3)


def test_robots_depend_on_the_seed_and_not_on_their_number():
    source = drawn_source("cubes:3", "reach")
    robots = draw(source, FEW)
    assert draw(source, FEW) is robots  # once per process
    others = draw(drawn_source("cubes:3", "reach", seed=1), FEW)
    assert not set(hashes(others)) & set(hashes(robots))
    assert hashes(draw(drawn_source("cubes:2", "reach"), FEW)) == hashes(robots)[:2]


@pytest.mark.slow
def test_robots_do_not_depend_on_the_processes(monkeypatch):
    source = drawn_source("cubes:3", "reach")
    robots = draw(source, FEW)
    monkeypatch.setattr(drawn_robots, "_drawn", {})
    monkeypatch.setattr(drawn_robots, "ROBOTS_PER_JOB", 2)
    progress = []
    with show_progress(lambda *now: progress.append(now)):
        again = draw(source, FEW, jobs=2)
    assert (hashes(again), again.hash) == (hashes(robots), robots.hash)
    assert progress == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_test_robots_of_splits_are_never_drawn(tmp_path):
    free = draw(drawn_source("cubes:3", "reach"), FEW)
    test = Member("other-name", "cubes", free.members[1].derivation, "push", True, hashes(free)[1])
    write_split(split((member("base=planar ee=cube"),), (test,)), tmp_path / "own.yaml")
    source = drawn_source("cubes:3", "reach", held_out=[tmp_path / "own.yaml"])
    assert source.held_out == (str(tmp_path / "own.yaml"),)
    robots = draw(source, FEW)
    assert [each.name[-1] for each in robots.members] == ["0", "2", "3"]
    assert hashes(robots)[:2] == [hashes(free)[0], hashes(free)[2]]
    assert robots.skipped == {"held out": 1}
    assert test.robot_hash in robots.held_out
    assert test.robot_hash not in free.held_out
    shipped = {each.robot_hash for name in split_names() for each in read_split(name).test}
    assert shipped
    assert shipped < set(robots.held_out)


def test_equal_robots_are_drawn_once(grammar_file):
    path = grammar_file("robot -> cubes(size=0.1) | cubes(size=0.2)")
    robots = draw(drawn_source(f"{path}:2", "reach"), FEW)
    assert len(set(hashes(robots))) == 2
    ((name, count),) = robots.skipped.items()
    assert (name, count > 0) == ("drawn before", True)
    with pytest.raises(
        TaskError, match="2 of 20 robots of mine can be used, expected 3; mine-0000"
    ):
        draw(drawn_source(f"{path}:3", "reach"), FEW)


def test_robots_that_cannot_do_the_task_are_skipped(grammar_file):
    path = grammar_file(
        "robot -> cubes(size=uniform(0.1, 0.2)) | cartpole(length=uniform(0.5, 1.5), mass=1)"
    )
    robots = draw(drawn_source(f"{path}:3", "push"), GoalConfig())
    assert {spec.robot.dof for spec in robots.specs} == {2}
    assert robots.skipped.keys() == {"without goals"}
    with pytest.raises(TaskError, match=r"0 of 21 robots of cartpole .*tool does not move along y"):
        draw(drawn_source("cartpole:3", "push"), GoalConfig())


def test_grammar_files_are_named_by_their_absolute_path(grammar_file, monkeypatch):
    path = grammar_file("robot -> cubes(size=uniform(0.1, 0.2))")
    monkeypatch.chdir(path.parent)
    source = drawn_source("mine.grammar:2", "reach")
    assert source.grammars == ((str(path), 2),)
    assert source.name == "mine:2"
    robots = draw(source, FEW)
    grammar_file("robot -> cubes(size=uniform(0.1, 0.19))")
    drawn_robots._drawn.clear()
    with pytest.raises(TaskError, match="mine:2 with seed 0 have changed since the run began"):
        draw(replace(source, drawn_hash=robots.hash), FEW)


@pytest.mark.parametrize(
    ("request_text", "error"),
    [
        ("cubes", "'cubes' is not a grammar and a number of robots"),
        ("cubes:0", "'cubes:0' is not a grammar"),
        ("cubes:2,", "'' is not a grammar"),
        ("cubes:2,cubes:3", "names the grammar 'cubes' 2 times"),
        ("cubs:2", "unknown grammar 'cubs'"),
    ],
)
def test_malformed_requests_are_refused(request_text, error):
    with pytest.raises((TaskError, GrammarError), match=error):
        drawn_source(request_text, "reach")


def test_drawn_robots_have_no_test_side():
    source = drawn_source("cubes:2", "reach")
    assert other_side(source, "train") is source
    for refused in (lambda: other_side(source, "test"), lambda: specs_of(source, FEW)):
        with pytest.raises(TaskError, match="no test side: name other robots with --split"):
            refused()


def test_the_list_of_robots_builds_them_again(tmp_path):
    source = drawn_source("cubes:2,stick:1", "reach")
    robots = draw(source, FEW)
    write_drawn(tmp_path, source, robots)
    content = (tmp_path / FILE).read_bytes()
    data = json.loads(content)
    assert (data["robots"], data["seed"], data["hash"]) == (source.name, 0, robots.hash)
    assert data["held_out"] == split_names()
    assert data["held_out_bodies"] == list(robots.held_out)
    assert read_drawn(tmp_path) == robots.members
    write_drawn(tmp_path, source, robots)
    assert (tmp_path / FILE).read_bytes() == content


def test_robots_that_were_trained_on_are_named(tmp_path):
    source = drawn_source("cubes:2", "reach")
    robots = draw(source, FEW)
    write_drawn(tmp_path, source, robots)
    drawn, new = replace(robots.members[0], name="a"), member("base=gantry ee=plane", name="b")
    test_side = split_source(split((new,), (drawn, new)), side="test")
    assert trained_on(tmp_path, test_side) == ["a"]
    assert trained_on(tmp_path, replace(test_side, side="train")) == []
    one = robot_source("planar-cube", "reach")
    assert trained_on(tmp_path, one) == []
    assert trained_on(tmp_path, replace(one, robot_hash=drawn.robot_hash)) == ["planar-cube"]


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (None, "no list of drawn robots"),
        ("{", "no list of drawn robots"),
        ("[]", "expected the key 'drawn'"),
        ('{"drawn": [7]}', r"drawn: \[0\]: invalid value 7"),
        ('{"drawn": [{"name": "a"}]}', r"drawn: \[0\]: missing key 'category'"),
        ('{"drawn": [{"name": "a", "body": 7}]}', r"drawn: \[0\]\.body: invalid value 7"),
    ],
)
def test_malformed_lists_are_refused(tmp_path, content, error):
    if content is not None:
        (tmp_path / FILE).write_text(content)
    with pytest.raises(TaskError, match=error):
        read_drawn(tmp_path)
