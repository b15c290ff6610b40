"""Goal sets that come with the package: they are those of the shipped splits, to the byte."""

import hashlib
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morphgen.benchmark.split_file import read_split, split_names
from morphgen.errors import TaskError
from morphgen.grammar.library import default_library
from morphgen.tasks.goals import goal_sets as packaged_sets
from morphgen.tasks.goals.goal_sets import (
    FOLDER,
    INDEX,
    goal_set_key,
    packaged_index,
    packaged_set,
    set_npz,
)
from morphgen.tasks.goals.split_goals import certify_goal_set
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import (
    GoalConfig,
    env_spec,
    ground_under,
    member_with_primitives,
)

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
    body = robot_of(member)
    task = TASKS[member.task]
    return goal_set_key(
        body,
        task,
        GoalConfig().task_config(member.task),
        obstacles=member.obstacles,
        seed=0,
        ground=ground_under(body),
    )


def test_every_member_of_a_shipped_split_has_one_set():
    records = packaged_index().values()
    described = [(record["robot"], record["task"], record["obstacles"]) for record in records]
    assert sorted(described) == sorted(MEMBERS)
    members = [
        m for name in split_names() for m in (*read_split(name).train, *read_split(name).test)
    ]
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
    def forbidden(*_, **__):
        raise AssertionError("it was sampled")

    monkeypatch.setattr(TASKS["reach"], "sample", forbidden)
    body = replace(robot_of(REACH), name="mine")
    spec = env_spec(body, "reach", cache=tmp_path)
    assert (spec.goals.robot, len(spec.goals.q)) == ("mine", 100)
    assert not list(tmp_path.iterdir())
    with pytest.raises(AssertionError, match="it was sampled"):
        env_spec(body, "reach", cache=tmp_path, anew=True)
    with pytest.raises(AssertionError, match="it was sampled"):
        env_spec(body, "reach", GoalConfig(seed=1), cache=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "member", list(MEMBERS.values())[::25], ids=lambda m: f"{m.name}-{m.task}-{m.obstacles}"
)
def test_sets_are_reproduced_to_the_byte(member):
    spec = env_spec(robot_of(member), member.task, obstacles=member.obstacles, anew=True)
    goals = replace(spec.goals, robot=member.name)
    assert set_npz(goals) == packaged_set(goals.key)


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
    assert np.array_equal(
        np.frombuffer(packaged_set(key_of(REACH)), np.uint8),
        np.frombuffer(packaged_sets.lzma.decompress((FOLDER / path.name).read_bytes()), np.uint8),
    )
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


def test_sizes_are_those_of_the_files():
    lines = script.sizes_text().splitlines()
    assert len(lines) == 2 + len(split_names())
    total = sum(path.stat().st_size for path in FOLDER.glob("*.xz"))
    assert lines[-1].split()[-3:] == [str(len(MEMBERS)), f"{total / 1000:.0f}", "kB"]
