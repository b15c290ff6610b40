"""Goal sets of splits: sampling, storage with a built split, loading, and those of the package."""

import hashlib
import importlib.util
import json
import re
import shutil
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from helpers.commands import tree
from helpers.scenes import robot
from helpers.splits import LIBRARY, TEST, TRAIN, member, split
from morphgen.benchmark import release
from morphgen.benchmark.release import build_with_goals, verify, write_goals
from morphgen.benchmark.split_folder import build_split, require_split_folder
from morphgen.errors import BenchmarkError, MorphgenError, TaskError
from morphgen.grammar.library import default_library
from morphgen.progress import show_progress
from morphgen.splits.split import read_split, split_names
from morphgen.tasks import free_space
from morphgen.tasks import goal_sets as packaged_sets
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.goal_sets import (
    FOLDER,
    INDEX,
    arrays_of,
    goal_set_key,
    goals_from_npz,
    packaged_index,
    packaged_set,
    set_npz,
)
from morphgen.tasks.reach import task as reach_goals
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import (
    GoalConfig,
    env_spec,
    ground_under,
    member_with_primitives,
)
from morphgen.tasks.scenes.make import make_split_batch
from morphgen.tasks.split_goals import (
    certify_goal_set,
    read_goals,
    read_split_goals,
    sample_robot_goals,
)
from morphgen.tasks.split_goals import sample_split_goals as make

RECIPE = GoalConfig(0, (ReachConfig(num_goals=12), PushConfig(num_goals=4)))


@pytest.mark.parametrize("side", ["Train", "tests", None])
def test_unknown_sides_are_refused(side, tmp_path):
    for call in (
        lambda: make_split_batch(mixed(), side, 9),
        lambda: read_goals(tmp_path, side),
        lambda: mixed().side(side),
    ):
        with pytest.raises(BenchmarkError, match=f"unknown side {side!r}.* valid: test, train"):
            call()


def test_a_batch_is_of_a_split_and_not_of_its_name():
    with pytest.raises(TaskError, match="split 'interpolation/arm3/reach': expected a Split, as"):
        make_split_batch("interpolation/arm3/reach", "train", 10)


def reaching(train=TRAIN, test=TEST, **more):
    """A split of reach robots, the last one with obstacles."""
    sides = [[member(words, task="reach") for words in side] for side in (train, test)]
    sides[1][-1] = replace(sides[1][-1], obstacles=True)
    return split(*sides, **more)


def mixed():
    """A split with reach and push members and one name on both sides."""
    train = [member(TRAIN[0], task="reach"), member(TRAIN[2], obstacles=True)]
    return split(train, [member(TRAIN[0])])


def sample_sets(which, cache, config=RECIPE, **options):
    return make(which, LIBRARY, config, cache=cache, **options)


def same(a, b):
    first, second = arrays_of(a), arrays_of(b)
    return first.keys() == second.keys() and all((first[k] == second[k]).all() for k in first)


def forbidden(*_, **__):
    raise AssertionError("it was made again")


def test_single_and_multi_embodiment_have_the_same_goals(tmp_path):
    """A goal set depends on its robot and not on the split, the side or other robots."""
    one = member(TRAIN[1], "alone", task="reach")
    single = sample_sets(split([one], [one]), tmp_path / "single")
    multi = sample_sets(reaching(train=TRAIN[::-1]), tmp_path / "multi")
    (among,) = [each for each in multi if each.robot == "planar-cube"]
    assert among.goals.key == single[0].goals.key == single[1].goals.key
    assert (among.goals.q == single[0].goals.q).all()
    assert (among.goals.poses == single[1].goals.poses).all()
    body = robot(TRAIN[1])
    alone = sample_robot_goals(body, "reach", RECIPE, obstacles=False, cache=tmp_path / "alone")
    assert (alone.side, alone.goals.key) == (None, among.goals.key)
    toolless = replace(body, frames=())
    wrong = sample_robot_goals(toolless, "push", RECIPE, obstacles=False, cache=tmp_path)
    assert "no frame 'tool'" in wrong.error


def test_every_member_has_a_set_in_train_test_order(cache, monkeypatch):
    member_sets = sample_sets(mixed(), cache, certified=True)
    assert [(one.side, one.robot, one.task) for one in member_sets] == [
        ("train", "gantry-plane", "reach"),
        ("train", "gantry-cylinder", "push"),
        ("test", "gantry-plane", "push"),
    ]
    assert [len(one.goals.q) for one in member_sets] == [12, 4, 4]
    assert [len(one.goals.obstacles) for one in member_sets] == [0, 3, 0]
    assert [one.certificate_errors for one in member_sets] == [(), (), ()]
    assert [0 < one.acceptance <= 1 for one in member_sets] == [True] * 3
    assert [one.certificate_errors for one in sample_sets(mixed(), cache)] == [None] * 3
    line = "goal 3: its configuration is in collision"
    monkeypatch.setattr(TASKS["reach"], "certify", lambda *_: [line])
    assert sample_sets(mixed(), cache, certified=True)[0].certificate_errors == (line,)


@pytest.mark.slow
def test_sets_drawn_in_several_processes_are_the_same_bytes(tmp_path):
    here, there = (
        [set_npz(one.goals) for one in sample_sets(mixed(), tmp_path / str(jobs), jobs=jobs)]
        for jobs in (1, 2)
    )
    assert here == there


def test_robot_without_goals_does_not_stop_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(free_space, "TRIES", 1)
    words = ("arm=arm3 ee=claw", TRAIN[1], TRAIN[0])
    few, part, fine = (member(each, task="reach") for each in words)
    part = replace(part, derivation="base=planar[top: ee=cubw]")
    member_sets = sample_sets(split([few, part], [fine]), tmp_path)
    assert [one.goals is None for one in member_sets] == [True, True, False]
    assert [one.acceptance for one in member_sets] == [None, None, 1.0]
    few, part, fine = (one.error for one in member_sets)
    assert re.search(r"only \d of 12 random configurations .* \(acceptance rate 0\.\d+\)", few)
    assert "unknown part 'cubw'" in part
    assert fine == ""


def test_interrupted_run_reuses_completed_sets(tmp_path, monkeypatch):
    cache = tmp_path / "cache"

    def interrupt(done, total):
        assert total == 4
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), show_progress(interrupt):
        sample_sets(reaching(), cache)
    assert len(list(cache.iterdir())) == 2
    member_sets = sample_sets(reaching(), cache)
    monkeypatch.setattr(reach_goals, "FreeSpace", forbidden)
    again = sample_sets(reaching(), cache)
    assert all(same(a.goals, b.goals) for a, b in zip(member_sets, again, strict=True))


@pytest.fixture(scope="module")
def built_once(tmp_path_factory):
    return built(tmp_path_factory.mktemp("built"), mixed())


@pytest.fixture
def home(built_once, tmp_path):
    """A built split without goals."""
    shutil.copytree(built_once.parents[1], tmp_path / "here")
    return tmp_path / "here" / built_once.relative_to(built_once.parents[1])


def built(folder, which):
    return build_split(which, folder, LIBRARY).folder


def test_stored_sets_are_read_back_unchanged(home, cache):
    member_sets = sample_sets(mixed(), cache)
    assert write_goals(home, member_sets, RECIPE) == home / "goals"
    read = read_split_goals(home)
    assert read.config == RECIPE
    index = json.loads((home / "goals" / "index.json").read_text())
    assert (index["format"], index["seed"], index["reach"]["goals"]) == (2, 0, 12)
    for record, one in zip(index["sets"], member_sets, strict=True):
        keys = ("robot", "side", "body", "key", "seed", "acceptance")
        expected = [one.robot, one.side, one.robot_hash, one.goals.key, 0, one.acceptance]
        assert [record[key] for key in keys] == expected
    assert read.sets.keys() == {(each.side, each.robot) for each in member_sets if each.goals}
    for one in member_sets:
        again = read.sets[one.side, one.robot]
        assert same(again.goals, one.goals)
        assert again.goals.obstacles == one.goals.obstacles
        assert (again.robot_hash, again.task) == (one.robot_hash, one.task)
        assert again.obstacles == one.obstacles
        for name in (each.name for each in fields(one.goals)):
            assert type(getattr(again.goals, name)) is type(getattr(one.goals, name)), name
    assert read_goals(home, "train")["gantry-cylinder"].block == member_sets[1].goals.block
    assert read_goals(home, "test").keys() == {"gantry-plane"}
    assert type(read_goals(home, "train")["gantry-plane"]) is reach_goals.ReachGoalSet


def test_builds_are_byte_identical_and_keep_no_earlier_goals(home, tmp_path, monkeypatch):
    other = built(tmp_path / "there", mixed())
    for i, folder in enumerate((home, other)):
        write_goals(folder, sample_sets(mixed(), tmp_path / f"cache{i}"), RECIPE)
    assert tree(home) == tree(other)
    write_goals(home, sample_sets(mixed(), tmp_path / "cache0"), RECIPE)
    assert tree(home) == tree(other)
    names = sorted(path.name for path in (home / "goals").iterdir())
    assert names == ["index.json", "test", "train"]
    monkeypatch.setattr(shutil, "rmtree", Mock(side_effect=PermissionError(13, "denied", "goals")))
    with pytest.raises(BenchmarkError, match="cannot write goals: denied"):
        write_goals(home, sample_sets(mixed(), tmp_path / "cache0"), RECIPE)


def test_batch_uses_stored_sets_and_rejects_others(home, cache, monkeypatch):
    which = mixed()
    write_goals(home, sample_sets(which, cache), RECIPE)
    monkeypatch.setattr(TASKS["push"], "sample", forbidden)
    options = {"sim": "mujoco", "configs": RECIPE.tasks, "goals": home}
    for side in ("train", "test"):
        shipped = read_goals(home, side)
        with closing(make_split_batch(which, side, 2, cache=home / "none", **options)) as batch:
            for setting in batch.specs:
                own = setting.goals or setting.pushes
                assert same(own, shipped[setting.robot.name])
    few = (ReachConfig(num_goals=3),)
    for wrong, words in (({"goal_seed": 1}, "seed"), ({"configs": few}, "constants")):
        with pytest.raises(MorphgenError, match=f"gantry-plane': the shipped goal set .* {words}"):
            make_split_batch(which, "train", 2, **{**options, **wrong})


def test_checksums_of_a_build_cover_its_goals(home, cache):
    write_goals(home, sample_sets(mixed(), cache), RECIPE)
    assert verify(home, LIBRARY).differences == ()
    path = home / "goals" / "train" / "gantry-cylinder.npz"
    path.write_bytes(path.read_bytes()[:-1])
    ((where, why),) = [(each.where, each.why) for each in verify(home, LIBRARY).differences]
    assert where == "goals/train/gantry-cylinder.npz"
    assert "is not what SHA256SUMS was written for" in why


def with_a_raised_goal(sets):
    """A reach goal that its configuration does not reach, under the key of the set."""
    poses = sets[0].goals.poses.copy()
    poses[3, 2] += 0.1
    return replace(sets[0].goals, poses=poses)


@pytest.mark.parametrize(
    ("position", "forge", "message"),
    [
        (0, with_a_raised_goal, "goal 3: the tool of its configuration is 0.1 m away"),
        (0, lambda sets: replace(sets[0].goals, key="0" * 64), "is of another robot, seed, ground"),
        (1, lambda sets: replace(sets[1].goals, obstacles=()), "it is for a robot without obstacl"),
        (2, lambda sets: sets[1].goals, "it is for a robot with obstacles"),
        (2, lambda sets: sets[0].goals, "is not for task push"),
    ],
)
def test_verify_certifies_goals_whose_checksums_are_right(home, cache, position, forge, message):
    """A stranger's folder: all hashes are those of its files, but its goals are made up."""
    sets = sample_sets(mixed(), cache)
    sets[position] = replace(sets[position], goals=forge(sets))
    if sets[position].task == "push" and hasattr(sets[position].goals, "poses"):
        sets[position] = replace(sets[position], task="reach")  # which the file is read as
    write_goals(home, sets, RECIPE)
    (found,) = verify(home, LIBRARY).differences
    assert found.where == sets[position].robot
    assert found.why.startswith(f"its goal set on side {sets[position].side}: ")
    assert message in found.why


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("q", "x", "q has type <U1 and shape"),
        ("line", np.zeros(1), r"line has type float64 and shape \(1,\)"),
        ("ground", "x", "ground has type <U1"),
        ("blocks", np.full((4, 7), 1e9), "blocks has a number beyond 1000"),
        ("block", np.zeros((12, 1)), r"block has type float64 and shape \(12, 1\)"),
        ("obstacles", np.zeros(12), r"obstacles has type float64 and shape \(12,\)"),
        ("layouts", 5, r"layouts has type int64 and shape \(\)"),
    ],
)
def test_fields_of_a_wrong_type_or_shape_are_refused(cache, name, value, message, tmp_path):
    arrays = arrays_of(sample_sets(mixed(), cache)[1].goals) | {name: value}
    np.savez(tmp_path / "set.npz", **arrays)
    with pytest.raises(BenchmarkError, match=f"not a goal set for push: {message}"):
        goals_from_npz((tmp_path / "set.npz").read_bytes(), "push", Path("set.npz"))


def test_verify_requires_a_goal_set_of_every_member(home, cache):
    write_goals(home, sample_sets(mixed(), cache)[:2], RECIPE)
    (found,) = verify(home, LIBRARY).differences
    assert (found.where, found.why) == ("gantry-plane", "its goal set on side test: there is none")


def test_interrupted_build_is_not_marked_finished(home, cache, monkeypatch):
    member_sets = sample_sets(mixed(), cache)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(release, "sums_text", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write_goals(home, member_sets, RECIPE)
    with pytest.raises(BenchmarkError, match="is not finished"):
        require_split_folder(home)
    build_split(mixed(), home.parents[1], LIBRARY)
    write_goals(home, member_sets, RECIPE)
    assert verify(home, LIBRARY).differences == ()


def test_missing_set_is_rejected_before_writing(home, cache):
    member_sets = sample_sets(mixed(), cache)
    before = tree(home)
    failed = [replace(one, goals=None, error="too few") for one in member_sets[:2]]
    with pytest.raises(BenchmarkError) as caught:
        build_with_goals(mixed(), home.parents[1], LIBRARY, [*failed, *member_sets[2:]], RECIPE)
    text = "train robot gantry-plane has no goal set: too few; nor has gantry-cylinder"
    assert str(caught.value) == text
    assert tree(home) == before
    with pytest.raises(BenchmarkError, match=r"index\.json: no such file; morphgen split build --"):
        read_goals(home, "train")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"format": 2', '"format": 1', "format 1; this version reads 2: build the goal sets again"),
        ('"format": 2,', "", "not an index of goal sets: KeyError"),
        ('"goals": 12,', '"golas": 12,', "not an index of goal sets: TypeError"),
        ('"sets": [', '"sets": [3,', "not an index of goal sets: TypeError"),
        ("{", "{{", "invalid JSON"),
        ('"task": "push"', '"task": "reach"', "not a goal set for reach: 'poses"),
        ("train/gantry-cylinder", "train/gantry-cylinde", "gantry-cylinde.npz: no such file"),
        ("train/gantry-cylinder", "test/gantry-plane", "is not the file that index.json was"),
    ],
)
def test_broken_index_is_named(home, cache, old, new, message):
    write_goals(home, sample_sets(mixed(), cache), RECIPE)
    path = home / "goals" / "index.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(MorphgenError) as caught:
        read_goals(home, "train")
    assert message in str(caught.value)
    assert str(home / "goals") in str(caught.value)


def with_number(goals, name, value):
    values = getattr(goals, name).copy()
    values[1, 2] = value
    return set_npz(replace(goals, **{name: values}))


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda goals: b"", "not a goal set for reach"),
        (lambda goals: set_npz(goals)[:-200], "not a goal set for reach"),
        (lambda goals: set_npz(replace(goals, poses=goals.poses[1:])), "configurations and poses"),
        (lambda goals: set_npz(replace(goals, q=goals.q[0])), "configurations and poses have"),
        (lambda goals: with_number(goals, "q", np.nan), ".*: q has .* beyond 1000, or not finite"),
        (lambda goals: with_number(goals, "poses", np.inf), ".*: poses has a number beyond 1000"),
    ],
)
def test_broken_file_is_named(cache, tmp_path, broken, message):
    content = broken(sample_sets(reaching(), cache)[0].goals)
    with pytest.raises(BenchmarkError, match=rf"some\.npz: {message}"):
        goals_from_npz(content, "reach", tmp_path / "some.npz")


PATH = Path(__file__).parents[2] / "benchmarks" / "package_goal_sets.py"
SPEC = importlib.util.spec_from_file_location(PATH.stem, PATH)
script = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(script)
identity, write_sets = script.identity, script.write_sets
MEMBERS = script.shipped_members()
PUSH, REACH = (
    next(member for member in MEMBERS.values() if (member.name, member.task) == ("widowx", task))
    for task in ("push", "reach")
)
OBSTACLES = next(member for member in MEMBERS.values() if member.obstacles)


def robot_of(member):
    return member_with_primitives(member, default_library(()))


def key_of(member):
    """Return the key of a member's goal set, of a robot composed now."""
    body, config = robot_of(member), GoalConfig().task_config(member.task)
    options = {"obstacles": member.obstacles, "seed": 0, "ground": ground_under(body)}
    return goal_set_key(body, TASKS[member.task], config, **options)


def test_every_member_of_a_shipped_split_has_one_set():
    records = packaged_index().values()
    described = [(record["robot"], record["task"], record["obstacles"]) for record in records]
    assert sorted(described) == sorted(MEMBERS)
    splits = map(read_split, split_names())
    members = [member for split in splits for member in (*split.train, *split.test)]
    assert {identity(member) for member in members} == set(MEMBERS)
    assert len(members) > len(MEMBERS)


def test_files_are_those_of_the_index():
    files = {path.name for path in FOLDER.iterdir()} - {INDEX}
    assert files == {record["file"] for record in packaged_index().values()}
    for record in packaged_index().values():
        content = (FOLDER / record["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == record["sha256"]
        assert len(content) == record["bytes"]


@pytest.mark.parametrize("member", [PUSH, REACH, OBSTACLES], ids=lambda m: f"{m.name}-{m.task}")
def test_keys_are_those_of_robots_composed_now_and_certificates_hold(member):
    record = packaged_index()[key_of(member)]
    assert (record["robot"], record["task"], record["obstacles"]) == identity(member)
    spec = env_spec(robot_of(member), member.task, obstacles=member.obstacles)
    assert spec.goals.key in packaged_index()
    assert certify_goal_set(spec.goals, spec) == ()


@pytest.mark.slow
def test_all_keys_are_those_of_robots_composed_now():
    keys = {key_of(member): identity(member) for member in MEMBERS.values()}
    assert keys == {
        key: (record["robot"], record["task"], record["obstacles"])
        for key, record in packaged_index().items()
    }


def test_packaged_sets_are_used_before_the_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(TASKS["reach"], "sample", forbidden)
    body = replace(robot_of(REACH), name="mine")
    spec = env_spec(body, "reach", cache=tmp_path)
    assert (spec.goals.robot, len(spec.goals.q)) == ("mine", 100)
    assert not list(tmp_path.iterdir())
    with pytest.raises(AssertionError, match="it was made again"):
        env_spec(body, "reach", cache=tmp_path, anew=True)
    with pytest.raises(AssertionError, match="it was made again"):
        env_spec(body, "reach", GoalConfig(seed=1), cache=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "member", list(MEMBERS.values())[::25], ids=lambda m: f"{m.name}-{m.task}-{m.obstacles}"
)
def test_sets_are_reproduced_to_the_byte(member):
    """Except for certificates: processors round the products of inverse kinematics apart."""
    spec = env_spec(robot_of(member), member.task, obstacles=member.obstacles, anew=True)
    goals = replace(spec.goals, robot=member.name)
    made, stored = set_npz(goals), packaged_set(goals.key)
    assert script.set_differences(made, stored) == []


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of packaged sets of one robot."""
    home = tmp_path / "sets"
    members = {identity(REACH): REACH}
    monkeypatch.setattr(script, "shipped_members", lambda: members)
    monkeypatch.setattr(packaged_sets, "FOLDER", home)
    write_sets(home)
    packaged_index.cache_clear()
    yield home
    monkeypatch.undo()
    packaged_index.cache_clear()


def test_written_sets_are_the_packaged_ones(folder):
    (path,) = folder.glob("*.xz")
    packaged = packaged_sets.lzma.decompress((FOLDER / path.name).read_bytes())
    assert bytes(packaged_set(key_of(REACH))) == packaged
    before = path.stat().st_mtime_ns
    (folder / "0000.npz.xz").write_bytes(b"of an earlier robot")
    write_sets(folder)
    assert [file.name for file in folder.glob("*.xz")] == [path.name]
    assert path.stat().st_mtime_ns == before


def test_damaged_files_are_refused(folder):
    (path,) = folder.glob("*.xz")
    body = robot_of(REACH)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(TaskError, match=r"\.npz\.xz: not the file that index\.json lists; install"):
        env_spec(body, "reach")
    path.unlink()
    with pytest.raises(TaskError, match=r"\.npz\.xz: No such file or directory; install"):
        env_spec(body, "reach")
