"""Goal sets and their obstacles, and faults of goal sets of the original released code."""

import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.goal_sets import CONFIG, LIFTED, sample_goals
from helpers.scenes import robot
from morphgen.benchmark.similarity import shoulder, workspace
from morphgen.errors import BenchmarkError, TaskError
from morphgen.model.geometry import IDENTITY, Box, Pose, Shape
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.tasks import free_space
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goals import goal_sets
from morphgen.tasks.reach import task as module
from morphgen.tasks.reach.task import REACH
from morphgen.tasks.scenes import obstacles
from morphgen.tasks.scenes.obstacles import (
    KEPT,
    draw_boxes,
    draw_layouts,
    fewest_goals,
    layouts_of,
    place_boxes,
)
from morphgen.tasks.sim.base import Scene

WORDS = (
    "arm=ur5 ee=plane",
    "arm=panda ee=panda_hand",
    "chain beads=3",
    "prims",
    "arm=arm3 ee=claw",
)


@pytest.fixture
def cache(tmp_path):
    """Folder of stored goal sets, which does not exist yet."""
    return tmp_path / "goals"


def scene_of(body, goal_set, ground=LIFTED, layout=0):
    boxes = goal_set.obstacles
    if boxes:
        boxes = place_boxes(boxes, goal_set.layouts[layout])
    return Scene(body, obstacles=boxes, ground=ground)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("words", WORDS)
@pytest.mark.parametrize("boxes", [False, True])
def test_every_goal_is_proven_by_its_goal_configuration(words, boxes, cache):
    body = robot(words)
    goal_set = sample_goals(body, cache, obstacles=boxes, ground=0.0)
    assert goal_set.q.shape == (12, body.dof)
    assert goal_set.poses.shape == (12, 7)
    assert (goal_set.poses[:, 3] >= 0).all()
    assert len(goal_set.obstacles) == (3 if boxes else 0)
    assert goal_set.layouts.shape == ((5, 3, 7) if boxes else (0, 0, 7))
    assert goal_set.usable.shape == ((5, 12) if boxes else (0, 12))
    assert REACH.certify(goal_set, body, scene_of(body, goal_set, 0.0)) == []
    assert 12 == goal_set.accepted <= goal_set.tried
    assert len(np.unique(goal_set.q, axis=0)) == 12


def test_goals_are_above_the_ground_at_any_height(body, cache):
    here, there = (sample_goals(body, cache, ground=ground) for ground in (0.0, LIFTED))
    assert there.poses[:, :3] == pytest.approx(frame_pose(body, there.q)[:, :3, 3])
    assert REACH.certify(there, body, scene_of(body, there)) == []
    assert REACH.certify(there, body, scene_of(body, there, 0.5)) != []
    assert here.key != there.key


@pytest.mark.parametrize("words", WORDS)
def test_goals_are_never_inside_an_obstacle(words, cache):
    """Neither the links at a usable configuration nor the tool point are inside an obstacle."""
    body = robot(words)
    config = replace(CONFIG, num_goals=60, obstacles=5, obstacle_size=(0.1, 0.15))
    goal_set = sample_goals(body, cache, obstacles=True, config=config, ground=0.0)
    for layout, usable in enumerate(goal_set.usable):
        scene = scene_of(body, goal_set, 0.0, layout)
        hits = FreeSpace(scene).obstacle_hits(goal_set.q).any(axis=1)
        assert usable.tolist() == (~hits).tolist()
        assert usable[:20].sum() >= fewest_goals(60) == 5 > fewest_goals(1) == 1
        for box in scene.obstacles:
            T = box.pose.inverse().matrix
            local = goal_set.poses[usable, :3] @ T[:3, :3].T + T[:3, 3]
            assert not (np.abs(local) <= np.array(box.size) / 2).all(axis=1).any()
    assert not goal_set.usable.all()


@pytest.mark.parametrize("ground", [0.0, -0.4])
@pytest.mark.parametrize("words", WORDS)
def test_obstacles_are_in_the_workspace_and_clear_of_the_home_pose(words, ground, cache):
    body = robot(words)
    goal_set = sample_goals(
        body, cache, obstacles=True, ground=ground, config=replace(CONFIG, obstacles=6)
    )
    reach, centre = workspace(body).reach, shoulder(body)
    q, _ = FreeSpace(Scene(body, ground=ground)).sample(300, np.random.default_rng(9))
    for layout in range(len(goal_set.layouts)):
        scene = scene_of(body, goal_set, ground, layout)
        space = FreeSpace(scene)
        assert not space.obstacle_hits([body.home]).any()
        for box in scene.obstacles:
            assert all(0.06 * reach <= edge <= 0.15 * reach for edge in box.size)
            assert box.pose.position[2] >= ground + box.size[2] / 2 - 1e-6
            assert np.linalg.norm(np.subtract(centre, box.pose.position)) <= reach
        assert space.free(q).mean() > KEPT - 0.15


def test_missing_room_for_obstacles_is_an_error(body, cache):
    config = replace(CONFIG, obstacles=2, obstacle_size=(3.0, 4.0))
    with pytest.raises(BenchmarkError, match=r"'arm': each of 16 .* home, .* fewer or smaller"):
        sample_goals(body, cache, obstacles=True, config=config)
    assert not cache.exists()


@pytest.mark.parametrize(
    ("count", "size"), [(0, (0.1, 0.2)), (1, (0.0, 0.1)), (1, (0.2, 0.1)), (1, (0.1, np.inf))]
)
def test_invalid_obstacles_are_rejected(body, count, size):
    with pytest.raises(BenchmarkError, match=f"{count} obstacles of size"):
        draw_boxes(body, count, size, np.random.default_rng(0))


def test_cache_key_depends_on_exactly_the_relevant_inputs(body, cache):
    changes = [
        {},
        {"seed": 1},
        {"obstacles": True},
        {"config": replace(CONFIG, num_goals=13)},
        {"ground": -0.2},
        {"body": replace(body, home=(0.0, *body.home[1:]))},
        {"body": replace(body, ignore_pairs=(*body.ignore_pairs, ("base", "slider")))},
        {"obstacles": True, "config": replace(CONFIG, eval_layouts=3)},
        {"obstacles": True, "config": replace(CONFIG, obstacles=2)},
        {"obstacles": True, "config": replace(CONFIG, obstacle_size=(0.06, 0.1))},
    ]
    first, second, *_ = sets = [
        sample_goals(**{"body": body, "cache": cache, **change}) for change in changes
    ]
    assert len({goals.key for goals in sets}) == len(changes)
    assert not np.isin(first.q, second.q).any()
    assert (first.seed, second.seed) == (0, 1)
    count = len(files(cache))
    same = replace(CONFIG, near=0.1, max_episode_steps=5, obstacles=7)
    other = replace(body, name="other")
    assert sample_goals(other, cache, config=same).robot == "other"
    assert (sample_goals(other, cache).q == sample_goals(body, cache).q).all()
    assert len(files(cache)) == count


def test_stored_set_equals_the_sampled_set(body, cache, monkeypatch):
    fresh = sample_goals(body, cache, obstacles=True)

    def forbidden(*_):
        raise AssertionError("it was made again")

    monkeypatch.setattr(module, "FreeSpace", forbidden)
    stored = sample_goals(body, cache, obstacles=True)
    for name in ("robot", "key", "obstacles", "tried", "accepted", "seed"):
        assert getattr(stored, name) == getattr(fresh, name)
    assert (stored.q == fresh.q).all()
    assert (stored.poses == fresh.poses).all()


def test_too_few_goals_error_has_the_acceptance_rate(body, cache, monkeypatch):
    monkeypatch.setattr(free_space, "TRIES", 20)
    with pytest.raises(BenchmarkError) as caught:
        sample_goals(body, cache, ground=5.0)
    text = str(caught.value)
    assert "robot 'arm': only 0 of 240 random configurations" in text
    assert "acceptance rate 0), 12 are needed" in text
    assert "lift the robot off the ground" in text
    assert not cache.exists()


def test_fixed_tool_is_rejected(body, cache):
    fixed = replace(body, frames=(replace(body.frame("tool"), link="base"),))
    with pytest.raises(BenchmarkError, match="no joint moves its tool"):
        sample_goals(fixed, cache)
    with pytest.raises(BenchmarkError, match="no frame 'tool'"):
        sample_goals(replace(body, frames=()), cache)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"num_goals": 0}, "num_goals 0: expected an integer >= 1"),
        ({"num_goals": 10**9}, "num_goals 1000000000: expected an integer >= 1 and <= 1,000,000"),
        ({"obstacles": 1001}, "obstacles 1001: expected an integer >= 0 and <= 1,000"),
        ({"num_goals": 2.5}, "num_goals 2.5: expected an integer >= 1"),
        ({"max_episode_steps": 0}, "max_episode_steps 0: expected an integer >= 1"),
        ({"obstacles": -1}, "obstacles -1: expected an integer >= 0"),
        ({"near": 0.0}, "near 0: expected a positive distance"),
        ({"distance_weight": np.nan}, "distance_weight nan: expected finite numbers"),
        ({"near_weight": "1"}, "near_weight '1': expected finite numbers"),
        ({"obstacle_size": (0.0, 0.1)}, "expected 0 < lowest <= highest"),
        ({"obstacle_size": (0.2, 0.1)}, "expected 0 < lowest <= highest"),
        ({"obstacle_size": (0.1, np.inf)}, "expected finite numbers"),
        ({"goal": "poses"}, "unknown goal of reach 'poses'"),
        ({"near_angle": 0.0}, "near_angle 0: expected more than 0, up to pi"),
        ({"near_angle": 4.0}, "near_angle 4: expected more than 0, up to pi"),
    ],
)
def test_invalid_constants_are_rejected(changes, text):
    with pytest.raises(TaskError, match=re.escape(text)):
        replace(CONFIG, **changes)


def changed_byte(data, goal_set):
    at = data.index(goal_set.q.tobytes()) + 5
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize(
    "change",
    [lambda *_: b"", lambda data, _: data[:100], lambda data, _: data[:-200], changed_byte],
)
def test_broken_file_is_named(body, cache, change):
    goal_set = sample_goals(body, cache)
    (path,) = cache.iterdir()
    path.write_bytes(change(path.read_bytes(), goal_set))
    with pytest.raises(TaskError, match=f"{path.name}: not a ReachGoalSet: .*; delete it"):
        sample_goals(body, cache)
    path.unlink()
    first, second = sample_goals(body, cache), sample_goals(body, cache, seed=1)
    path.replace(cache / f"{second.key}.npz")
    with pytest.raises(TaskError, match=f"its key is {first.key}, not"):
        sample_goals(body, cache, seed=1)


def test_unwritable_cache_is_a_warning(body, tmp_path, monkeypatch):
    monkeypatch.setattr(goal_sets, "user_cache_path", lambda name: tmp_path / name)
    assert (tmp_path / "morphgen" / "goals-5" / f"{sample_goals(body, None).key}.npz").is_file()
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(UserWarning, match="cannot store a ReachGoalSet"):
        goal_set = sample_goals(body, tmp_path / "file" / "goals")
    assert len(goal_set.q) == 12


def test_certificate_names_every_fault(body, cache):
    goal_set = sample_goals(body, cache, obstacles=True)
    scene = scene_of(body, goal_set)

    def faults(**changes):
        return REACH.certify(replace(goal_set, **changes), body, scene)

    q, poses = goal_set.q.copy(), goal_set.poses.copy()
    q[3, 1] = joint_limits(body)[1, 1] + 0.1
    assert faults(q=q)[0].startswith("goal 3: joint 'elbow' is at 2.1, outside (-2, 2)")
    q[3, 1] = np.nan
    assert len(faults(q=q)) == 1
    poses[4, 0] += 2e-6
    assert [line.split(":")[0] for line in faults(poses=poses)] == ["goal 4"]
    poses = goal_set.poses.copy()
    poses[5, 4:] *= -1
    assert "goal 5: the tool" in faults(poses=poses)[0]
    assert faults(poses=goal_set.poses * [1, 1, 1, -1, -1, -1, -1]) == []
    assert faults(obstacles=()) == ["the obstacles of the scene are not those of the goal set"]
    assert "not goals of robot 'arm'" in faults(q=goal_set.q[:, :2])[0]
    assert "not goals of robot 'arm'" in faults(poses=goal_set.poses[1:])[0]
    around = (Shape(Box((2.0, 2.0, 2.0))),)
    walled = body.with_links([Link("base", body.link("base").inertial, (), around)])
    assert "goal 0: its configuration is in collision" in REACH.certify(
        sample_goals(body, cache), walled, scene_of(walled, sample_goals(body, cache))
    )


def test_a_robot_whose_tool_stays_in_place_has_no_goals(cache):
    joint = Joint("turn", "revolute", "base", "rod", IDENTITY, (0.0, 0.0, 1.0), limits=(-1.0, 1.0))
    rod = Link("rod", collisions=(Shape(Box((0.1, 0.1, 0.1))),))
    tool = Frame("tool", "rod", Pose((0.0, 0.0, 0.5)))
    body = Robot("spinner", (Link("base"), rod), (joint,), (tool,), (0.0,))
    with pytest.raises(TaskError, match="'spinner' cannot reach: over 12 configurations its tool"):
        sample_goals(body, cache)


def layouts_in(body, count=8, size=(0.5, 0.7), usable=lambda space: np.ones(1, bool)):
    boxes = draw_boxes(body, count, size, np.random.default_rng(0))
    space = FreeSpace(Scene(body, obstacles=boxes, ground=LIFTED))
    return draw_layouts(space, (1, 1), np.random.SeedSequence(0), usable)


def test_obstacles_that_block_too_much_space_are_redrawn(body, monkeypatch):
    boxes = draw_boxes(body, 8, (0.5, 0.7), np.random.default_rng(0))

    def left(share):
        monkeypatch.setattr(obstacles, "KEPT", share)
        layouts, _ = layouts_in(body)
        q, _ = FreeSpace(Scene(body, ground=LIFTED)).sample(200, np.random.default_rng(1))
        placed = place_boxes(boxes, layouts[0])
        return FreeSpace(Scene(body, obstacles=placed, ground=LIFTED)).free(q).mean()

    assert left(0.0) < 0.6
    assert left(0.7) > 0.6


def test_layouts_do_not_depend_on_the_numbers_of_goals_and_layouts(body, cache):
    config = replace(CONFIG, num_goals=30)
    more = replace(config, num_goals=60, train_layouts=5, eval_layouts=4)
    small, large = (sample_goals(body, cache, obstacles=True, config=one) for one in (config, more))
    assert small.obstacles == large.obstacles
    for side in ("train", "eval"):
        few, many = layouts_of(config, side), layouts_of(more, side)
        np.testing.assert_array_equal(
            small.layouts[few], large.layouts[many][: len(few)], err_msg=side
        )
        np.testing.assert_array_equal(small.usable[few], large.usable[many][: len(few), :30])
    assert len(np.unique(large.layouts[:, 0], axis=0)) == 9
    assert (large.layouts == large.layouts.astype(np.float32)).all()


def test_a_layout_without_goals_is_an_error(body):
    def usable(space):
        return np.arange(40) >= 16  # 4 of the first 20, of which 5 are needed

    with pytest.raises(BenchmarkError, match=r"of its first 20 goals only 4 or fewer"):
        layouts_in(body, 1, (0.05, 0.1), usable=usable)
