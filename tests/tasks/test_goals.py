"""Goal sets, free configurations, and paths between them."""

import math
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from helpers.goal_sets import CONFIG, LIFTED, draw_goals, sample_goals
from helpers.scenes import ball, push_scene, reach_scene, real_arm_scene, robot
from morphgen.checks.self_collision import PENETRATION
from morphgen.encoding.similarity import shoulder, workspace
from morphgen.errors import BenchmarkError, NoGoalsError, TaskError
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.geometry import IDENTITY, Box, Pose, Shape, Sphere
from morphgen.model.kinematics import (
    frame_pose,
    joint_limits,
    movable_positions,
    random_configurations,
)
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.model.tree import rename
from morphgen.tasks import free_space as of_free_space
from morphgen.tasks import goal_sets
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.free_space import SAME, FreeSpace, cspace_components, in_other_component
from morphgen.tasks.goal_sets import set_npz
from morphgen.tasks.push import task as starts
from morphgen.tasks.push.task import push_region
from morphgen.tasks.reach import task as module
from morphgen.tasks.reach.task import REACH
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes import obstacles
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.scenes.obstacles import KEPT, fewest_goals, layouts_of, place_boxes
from morphgen.tasks.sim.articulated import ground_contact_links
from morphgen.tasks.sim.base import Block, Scene

WORDS = (
    "arm=ur5 ee=plane",
    "arm=panda ee=panda_hand",
    "chain beads=3",
    "prims",
    "arm=arm3 ee=claw",
)


@pytest.fixture
def folder(tmp_path):
    """Folder of stored goal sets, which does not exist yet."""
    return tmp_path / "goals"


def scene_of(body, goal_set, ground=LIFTED, layout=0):
    boxes = goal_set.obstacles
    if boxes:
        boxes = place_boxes(boxes, goal_set.layouts[layout])
    return Scene(body, obstacles=boxes, ground=ground)


@pytest.mark.parametrize("words", WORDS)
@pytest.mark.parametrize("boxes", [False, True])
def test_every_goal_is_proven_by_its_goal_configuration(words, boxes, folder):
    body = robot(words)
    goal_set = sample_goals(body, folder, obstacles=boxes, ground=0.0)
    assert goal_set.q.shape == (12, body.dof)
    assert goal_set.poses.shape == (12, 7)
    assert (goal_set.poses[:, 3] >= 0).all()
    assert len(goal_set.obstacles) == (3 if boxes else 0)
    assert goal_set.layouts.shape == ((5, 3, 7) if boxes else (0, 0, 7))
    assert goal_set.usable.shape == ((5, 12) if boxes else (0, 12))
    assert REACH.certify(goal_set, body, scene_of(body, goal_set, 0.0)) == []
    assert 12 == goal_set.accepted <= goal_set.tried
    assert len(np.unique(goal_set.q, axis=0)) == 12


def test_goals_are_above_the_ground_at_any_height(body, folder):
    here, there = (sample_goals(body, folder, ground=ground) for ground in (0.0, LIFTED))
    assert there.poses[:, :3] == pytest.approx(frame_pose(body, there.q)[:, :3, 3])
    assert REACH.certify(there, body, scene_of(body, there)) == []
    assert REACH.certify(there, body, scene_of(body, there, 0.5)) != []
    assert here.key != there.key


@pytest.mark.parametrize("words", WORDS)
def test_goals_are_never_inside_an_obstacle(words, folder):
    """Neither the links at a usable configuration nor the tool point are inside an obstacle."""
    body = robot(words)
    config = replace(CONFIG, num_goals=60, obstacles=5, obstacle_size=(0.1, 0.15))
    goal_set = sample_goals(body, folder, obstacles=True, config=config, ground=0.0)
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
def test_obstacles_are_in_the_workspace_and_clear_of_the_home_pose(words, ground, folder):
    body, config = robot(words), replace(CONFIG, obstacles=6)
    goal_set = sample_goals(body, folder, obstacles=True, ground=ground, config=config)
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


def test_missing_room_for_obstacles_is_an_error(body, folder):
    config = replace(CONFIG, obstacles=2, obstacle_size=(3.0, 4.0))
    with pytest.raises(BenchmarkError, match=r"'arm': each of 16 .* home, .* fewer or smaller"):
        sample_goals(body, folder, obstacles=True, config=config)
    assert not folder.exists()


def test_no_obstacles_are_rejected_where_there_shall_be_some(body, folder):
    with pytest.raises(BenchmarkError, match="0 obstacles: expected at least one"):
        sample_goals(body, folder, obstacles=True, config=replace(CONFIG, obstacles=0))


def test_cache_key_depends_on_exactly_the_relevant_inputs(body, folder):
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
        sample_goals(**{"body": body, "cache": folder, **change}) for change in changes
    ]
    assert len({goals.key for goals in sets}) == len(changes)
    assert not np.isin(first.q, second.q).any()
    assert (first.seed, second.seed) == (0, 1)
    count = len(list(folder.iterdir()))
    same = replace(CONFIG, near=0.1, max_episode_steps=5, obstacles=7)
    other = replace(body, name="other")
    assert sample_goals(other, folder, config=same).robot == "other"
    assert (sample_goals(other, folder).q == sample_goals(body, folder).q).all()
    assert len(list(folder.iterdir())) == count


def test_stored_set_equals_the_sampled_set(body, folder, monkeypatch):
    fresh = sample_goals(body, folder, obstacles=True)
    monkeypatch.setattr(module, "FreeSpace", None)  # it is not made again
    assert set_npz(sample_goals(body, folder, obstacles=True)) == set_npz(fresh)


def test_fixed_tool_is_rejected(body, folder):
    fixed = replace(body, frames=(replace(body.frame("tool"), link="base"),))
    with pytest.raises(BenchmarkError, match="no joint moves its tool"):
        sample_goals(fixed, folder)
    with pytest.raises(BenchmarkError, match="no frame 'tool'"):
        sample_goals(replace(body, frames=()), folder)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"num_goals": 0}, "num_goals 0: expected an integer >= 1"),
        ({"num_goals": 10**9}, "num_goals 1000000000: expected an integer >= 1 and <= 1,000,000"),
        ({"obstacles": 1001}, "obstacles 1001: expected an integer >= 0 and <= 1,000"),
        ({"num_goals": 2.5}, "num_goals 2.5: expected an integer >= 1"),
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
def test_broken_file_is_named(body, folder, change):
    goal_set = sample_goals(body, folder)
    (path,) = folder.iterdir()
    path.write_bytes(change(path.read_bytes(), goal_set))
    with pytest.raises(TaskError, match=f"{path.name}: not a ReachGoalSet: .*; delete it"):
        sample_goals(body, folder)
    path.unlink()
    first, second = sample_goals(body, folder), sample_goals(body, folder, seed=1)
    path.replace(folder / f"{second.key}.npz")
    with pytest.raises(TaskError, match=f"its key is {first.key}, not"):
        sample_goals(body, folder, seed=1)


def test_unwritable_cache_is_a_warning(body, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(goal_sets, "user_cache_path", lambda name: tmp_path / name)
    assert (tmp_path / "morphgen" / "goals-5" / f"{sample_goals(body, None).key}.npz").is_file()
    (tmp_path / "file").write_text("in the way")
    goal_set = sample_goals(body, tmp_path / "file" / "goals")
    assert "cannot keep goals in" in caplog.text
    assert len(goal_set.q) == 12


def test_certificate_names_every_fault(body, folder):
    goal_set = sample_goals(body, folder, obstacles=True)
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
        sample_goals(body, folder), walled, scene_of(walled, sample_goals(body, folder))
    )


def test_a_robot_whose_tool_stays_in_place_has_no_goals(folder):
    joint = Joint("turn", "revolute", "base", "rod", IDENTITY, (0.0, 0.0, 1.0), limits=(-1.0, 1.0))
    rod = Link("rod", collisions=(Shape(Box((0.1, 0.1, 0.1))),))
    tool = Frame("tool", "rod", Pose((0.0, 0.0, 0.5)))
    body = Robot("spinner", (Link("base"), rod), (joint,), (tool,), (0.0,))
    with pytest.raises(TaskError, match="'spinner' cannot reach: over 12 configurations its tool"):
        sample_goals(body, folder)


def test_layouts_do_not_depend_on_the_numbers_of_goals_and_layouts(body, folder):
    config = replace(CONFIG, num_goals=30)
    more = replace(config, num_goals=60, train_layouts=5, eval_layouts=4)
    small, large = (sample_goals(body, folder, obstacles=True, config=c) for c in (config, more))
    assert small.obstacles == large.obstacles
    for side in ("train", "eval"):
        few = layouts_of(config, side)
        many = layouts_of(more, side)[: len(few)]
        np.testing.assert_array_equal(small.layouts[few], large.layouts[many], err_msg=side)
        np.testing.assert_array_equal(small.usable[few], large.usable[many][:, :30])
    assert len(np.unique(large.layouts[:, 0], axis=0)) == 9
    assert (large.layouts == large.layouts.astype(np.float32)).all()


PUSH = PushConfig(num_goals=5, train_layouts=3, eval_layouts=2)
ARMS = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "arm=arm3 ee=claw")
FREE = ("prims", "cubes", "chain beads=3")
SWEEPS = ("stick", "nlink")
SHORT = "stick beam.length=0.15"


def sample_starts(words, cache, *, config=PUSH, **options):
    return draw_goals(robot(words), config, ground=0.0, cache=cache, **options)


def space_of(words, push_set):
    return FreeSpace(Scene(robot(words), object=push_set.block, ground=push_set.ground))


@pytest.mark.parametrize("words", [*ARMS, *FREE, *SWEEPS, SHORT])
@pytest.mark.parametrize("boxes", [False, True])
def test_every_block_can_be_pushed_across_the_line(words, boxes, cache):
    push_set = sample_starts(words, cache, obstacles=boxes)
    body, space = robot(words), space_of(words, push_set)
    edge, y = push_set.block.size[0], push_set.blocks[:, 1]
    assert len(push_set.obstacles) == (3 if boxes else 0)
    assert push_set.usable.shape == ((5, 5) if boxes else (0, 5))
    scene = Scene(body, object=push_set.block, obstacles=push_set.obstacles)
    assert TASKS["push"].certify(push_set, body, scene) == []
    assert (push_set.usable.sum(axis=1) >= 2).all()
    assert 5 == push_set.accepted == len(push_set.q) <= push_set.tried
    assert push_set.blocks[:, 2] == pytest.approx(edge / 2)
    assert np.linalg.norm(push_set.blocks[:, 3:], axis=1) == pytest.approx(1.0)
    assert ((-0.2 * push_set.scale <= y) & (y <= -0.15 * push_set.scale)).all()
    assert push_set.line == pytest.approx(0.2 * push_set.scale)
    behind, across = (frame_pose(body, q)[:, :3, 3] for q in (push_set.behind, push_set.across))
    assert (behind[:, 1] < y - edge / 2).all()
    for tools in (behind, across):
        assert ((tools[:, 2] > 0) & (tools[:, 2] < edge)).all()
    for share in np.linspace(0, 1, 9):
        on_its_way = push_set.blocks.copy()
        on_its_way[:, 1] += share * (push_set.line - y)
        assert space.block_is_clear(on_its_way).all()


@pytest.mark.parametrize("words", ARMS)
def test_arm_block_distance_scales_with_effective_reach(words, cache):
    push_set, work = sample_starts(words, cache), workspace(robot(words))
    edge = push_set.block.size[0]
    reach = np.sqrt(work.reach**2 - (work.shoulder[2] - edge / 2) ** 2)
    assert 0.15 * reach <= edge <= 0.2 * reach
    x = push_set.blocks[:, 0] - work.shoulder[0]
    assert ((0.4 * reach <= x) & (x <= 0.6 * reach)).all()
    assert push_set.scale == 1


@pytest.mark.parametrize("words", FREE)
def test_mobile_bases_have_the_block_at_a_fixed_distance(words, cache):
    push_set = sample_starts(words, cache)
    assert 0.15 <= push_set.block.size[0] <= 0.2
    assert (np.abs(push_set.blocks[:, 0]) <= 0.2).all()
    assert push_set.scale == 1


def test_short_robots_have_a_scaled_down_push_region(cache):
    """A 0.15 m rod with a 0.03 m ball swings on a slide."""
    push_set = sample_starts(SHORT, cache)
    assert push_set.scale == pytest.approx(0.18 / np.sqrt(2) / 0.4, rel=0.2)
    assert 0.15 * push_set.scale <= push_set.block.size[0] <= 0.2 * push_set.scale
    assert push_set.line == pytest.approx(0.2 * push_set.scale)


def test_block_matches_the_config(cache):
    config = replace(PUSH, block_mass=0.3, friction=0.6, line=0.1, start=-0.1, start_depth=0.0)
    push_set = sample_starts("prims", cache, config=config)
    assert (push_set.block.mass, push_set.block.friction, push_set.line) == (0.3, 0.6, 0.1)
    assert push_set.blocks[:, 1] == pytest.approx(-0.1)
    x, y, z, *turn = push_set.blocks[0].tolist()
    assert push_set.block.pose == Pose((x, y, z), tuple(turn))


def test_block_positions_and_orientations_are_random(cache):
    push_set = sample_starts("prims", cache, config=replace(PUSH, num_goals=60))
    assert np.histogram(push_set.blocks[:, 0], 3, (-0.2, 0.2))[0] == pytest.approx(20, abs=12)
    yaw = 2 * np.arctan2(push_set.blocks[:, 6], push_set.blocks[:, 3])
    assert np.histogram(yaw, 3, (-np.pi, np.pi))[0] == pytest.approx(20, abs=12)


def test_robot_that_cannot_push_is_rejected_with_the_reason(tmp_path, monkeypatch):
    cache, behind = tmp_path / "pushes", replace(PUSH, start=-0.9)
    with pytest.raises(TaskError, match=r"'cartpole.*' cannot push: its tool does not move along"):
        sample_starts("cartpole", cache)
    monkeypatch.setattr(starts, "TRIES", 2)
    with pytest.raises(TaskError, match="'prims' can hardly push: only 0 of 10 poses") as caught:
        sample_starts("prims", cache, config=behind)
    reason = "acceptance rate 0), 5 are needed; the tool does not get behind it (100%)"
    assert reason in str(caught.value)
    with pytest.raises(TaskError, match="its tool does not get down to the ground"):
        push_region(robot(ARMS[0]), PUSH, -3.0, np.random.default_rng(0))
    with pytest.raises(TaskError, match="its tool is never as low as a block"):
        push_region(robot("nlink"), PUSH, -0.5, np.random.default_rng(0))
    (stored,) = cache.iterdir()
    assert stored.suffix == ".txt"
    monkeypatch.setattr(starts, "draw_feasible", None)  # nothing is tested again
    with pytest.raises(NoGoalsError) as again:
        draw_goals(replace(robot("prims"), name="other"), behind, ground=0.0, cache=cache)
    assert str(again.value) == str(caught.value).replace("'prims'", "'other'")


def test_obstacles_that_block_every_push_are_an_error(tmp_path, monkeypatch):
    across_the_way = np.array([[0.0, 0.1, 0.05, 1.0, 0.0, 0.0, 0.0]])
    monkeypatch.setattr(obstacles, "draw_boxes", lambda *_: (Block((9.0, 0.1, 0.1)),))
    monkeypatch.setattr(obstacles, "_draw_poses", lambda *_: across_the_way)
    with pytest.raises(BenchmarkError, match="of its first 20 goals only 0 or fewer: take"):
        sample_starts("prims", tmp_path, obstacles=True)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"num_goals": 0}, "PushConfig: num_goals 0: expected an integer >= 1"),
        ({"block_size": (0.2, 0.1)}, "a block of 0.2 to 0.1"),
        ({"start": 0.3}, "is to cross 0.2: sizes must be positive, and the start"),
        ({"line": -0.3}, "starts 0.05 below -0.15 and is to cross -0.3"),
    ],
)
def test_invalid_pushes_are_rejected(changes, text, cache):
    with pytest.raises((TaskError, BenchmarkError), match=text):
        sample_starts("prims", cache, config=replace(PUSH, **changes))
    with pytest.raises(TaskError, match="goal seed -1: expected a whole number, 0 or more"):
        GoalConfig(-1)


DEEP, SHALLOW = 2 * PENETRATION, PENETRATION / 2
HALF_TURN = Pose.from_xyz_rpy((0.0, 0.0, 1.0), (np.pi, 0.0, 0.0))
SLAB = Block((0.2, 0.2, 0.2), Pose((0.5, 0.0, 0.5)))


def lift(**changes):
    """A ball of 0.1 m on a vertical slide, starting 0.5 m above a plate on the ground."""
    plate = Link("plate", collisions=(Shape(Box((0.1, 0.1, 0.1))),))
    ball = Link("ball", collisions=(Shape(Sphere(0.1)),))
    slide = Joint("z", "prismatic", "plate", "ball", Pose((0, 0, 0.5)), (0, 0, 1), (-1.0, 1.0))
    lift_robot = Robot("lift", (plate, ball), (slide,), (Frame("tool", "ball"),), (0.0,))
    return replace(lift_robot, **changes)


def aside():
    """The same robot with the ball 0.5 m beside its plate."""
    (slide,) = lift().joints
    return lift(joints=(replace(slide, T_parent_joint=Pose((0.5, 0.0, 0.5))),))


def free(scene, *q):
    return FreeSpace(scene).free([[value] for value in q]).tolist()


def pointing(z):
    """The robot whose tool is above or below its ball."""
    return replace(aside(), frames=(Frame("tool", "ball", Pose((0.0, 0.0, z))),))


LOWEST, UNDER_SLAB = -0.5 + 0.1, 1.0 - 0.1 - 0.1 - 0.5
HIGH_SLAB = replace(SLAB, pose=Pose((0.5, 0.0, 1.0)))
THIN = Block((0.1,) * 3, Pose((0.5, 0.0, 0.9)))
# A ball below the ground that is fixed to the plate.
FOOT = Link("foot", collisions=(Shape(Sphere(0.2)),))
TO_FOOT = Joint("to_foot", "fixed", "plate", "foot", Pose((0.0, 0.5, 0.0)))
WITH_FOOT = replace(aside(), links=(*aside().links, FOOT), joints=(*aside().joints, TO_FOOT))
LIKE_SURROUNDINGS = rename(aside(), {"plate": "world", "ball": "ground"}, {"z": "to_root"})


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (Scene(aside()), {0.0: True, LOWEST - SHALLOW: True, LOWEST - DEEP: False}),
        (Scene(aside(), ground=None), {LOWEST - DEEP: True}),
        (Scene(aside(), Pose((0.0, 0.0, -3.0))), {0.0: False}),
        (Scene(WITH_FOOT), {0.0: True}),
        (
            Scene(aside(), obstacles=(HIGH_SLAB,)),
            {UNDER_SLAB + SHALLOW: True, UNDER_SLAB + DEEP: False},
        ),
        # Simulators do not test contacts between static objects, so FreeSpace must.
        (Scene(aside(), obstacles=(Block((0.05,) * 3),)), {0.0: False, 0.5: False}),
        (Scene(pointing(0.3), obstacles=(THIN,)), {0.0: True, 0.1: False, 0.2: True}),
        (Scene(replace(aside(), frames=()), obstacles=(THIN,)), {0.1: True}),
        (Scene(pointing(-0.3), obstacles=(THIN,)), {-0.25: True}),
        (Scene(aside(), HALF_TURN), {0.0: True, 0.5: False, -0.5: True}),  # the slide points down
        (Scene(aside(), Pose((0.0, 0.0, 1.0))), {0.5: True, -0.5: True}),
        (Scene(aside(), object=replace(SLAB, mass=0.1)), {0.0: True}),
        (Scene(aside(), obstacles=(replace(SLAB, mass=0.1),)), {0.0: False}),
        (Scene(LIKE_SURROUNDINGS, obstacles=(SLAB,)), {0.0: False, -0.41: False, 0.9: True}),
    ],
)
def test_configurations_are_free_where_nothing_penetrates(scene, expected):
    assert free(scene, *expected) == list(expected.values())


def test_links_collide_unless_adjacent_or_their_pair_is_ignored():
    touching = -0.5 + 0.05 + 0.1
    q = (touching - SHALLOW, touching - DEEP)
    above = Pose((0.0, 0.0, 0.3))
    assert free(Scene(lift(), above), *q) == [True, True]
    plate, ball = lift().links
    carriage = Link("carriage", collisions=(Shape(Sphere(0.1), Pose((5.0, 0.0, 0.0))),))
    aside = Joint("y", "prismatic", "plate", "carriage", axis=(0, 1, 0), limits=(-1.0, 1.0))
    rising = replace(lift().joints[0], parent="carriage")
    far = lift(links=(plate, carriage, ball), joints=(aside, rising), home=(0.0, 0.0))
    known = replace(far, ignore_pairs=(("ball", "plate"),))
    for body, expected in ((far, [True, False]), (known, [True, True])):
        assert FreeSpace(Scene(body, above)).free([[0.0, z] for z in q]).tolist() == expected


def test_obstacle_hits_are_named_and_obstacles_may_overlap():
    near, far = SLAB, replace(SLAB, pose=Pose((0.5, 0.0, 0.35)))
    sunk = Block((1.0, 1.0, 1.0), Pose((5.0, 0.0, 0.0)))
    space = FreeSpace(Scene(aside(), obstacles=(near, sunk, far)))
    hits = space.obstacle_hits([[0.0], [0.15], [-0.2], [0.5]])
    assert hits.tolist() == [
        [True, False, True],
        [True, False, False],
        [False, False, True],
        [False, False, False],
    ]
    assert space.free([[0.5]]).all()


@pytest.mark.filterwarnings("ignore:Attach conflict")
@pytest.mark.parametrize("scene", [reach_scene, real_arm_scene, push_scene])
def test_results_agree_with_mujoco_plane_contacts(scene):
    """The reference model is the exported MJCF in a world with a plane."""
    scene = scene()
    q = random_configurations(scene.robot, 300, np.random.default_rng(1))
    free_mask = FreeSpace(scene).free(q)
    assert 0.1 < free_mask.mean() < 0.95
    assert free_mask.tolist() == [not hit for hit in plane_hits(scene, q)]


def plane_hits(scene, q):
    """Return whether MuJoCo finds contacts, except of level links with the plane."""
    robot = scene.robot
    spec, child = mujoco.MjSpec(), to_spec(robot)
    # Otherwise MuJoCo writes a log file to the working directory.
    spec.option.timestep, spec.option.integrator = child.option.timestep, child.option.integrator
    place = {"pos": scene.T_world_root.position, "quat": scene.T_world_root.quaternion}
    spec.attach(child, frame=spec.worldbody.add_frame(**place), prefix="robot/")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for block in scene.obstacles:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in block.size],
            pos=block.pose.position,
            quat=block.pose.quaternion,
        )
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    model = spec.compile()
    data = mujoco.MjData(model)
    level = {f"robot/{name}" for name in ground_contact_links(robot, scene.T_world_root)}
    turntable = np.array([model.body(i).name in level for i in model.geom_bodyid])
    flat = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    at = [model.joint(f"robot/{robot.joints[k].name}").qposadr[0] for k in robot.movable_joints]
    for positions in movable_positions(robot, q):
        data.qpos[at] = positions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        first, second = data.contact.geom.T
        counts = ~(flat[first] & turntable[second])
        yield bool((data.contact.dist[counts] < -PENETRATION).any())


def test_samples_are_free_uniform_and_a_prefix_of_larger_samples():
    space = FreeSpace(Scene(aside()))
    q, tried = space.sample(400, np.random.default_rng(0))
    assert q.shape == (400, 1)
    assert space.free(q).all()
    assert 400 / tried == pytest.approx(1.4 / 2, abs=0.05)
    assert np.histogram(q, 4, (-0.4, 1.0))[0] == pytest.approx(100, abs=35)
    few, fewer = space.sample(30, np.random.default_rng(0))
    assert (few == q[:30]).all()
    assert fewer < tried
    drawn = random_configurations(aside(), tried, np.random.default_rng(0))
    assert space.free(drawn).sum() == 400
    assert (drawn[tried - 1] == q[-1]).all()


def test_robot_without_free_configuration_is_named_with_its_collisions(monkeypatch):
    monkeypatch.setattr(of_free_space, "TRIES", 20)
    message = r"'lift': only 0 of 200 random.*rate 0\).*'ball' and 'ground' collide, in 100%"
    with pytest.raises(BenchmarkError, match=message):
        FreeSpace(Scene(aside(), Pose((0.0, 0.0, -3.0)))).sample(10, np.random.default_rng(0))


def block_at(x, z, *, yaw=0.0, pitch=0.0):
    pose = Pose.from_xyz_rpy((x, 0.0, z), (0.0, pitch, yaw))
    return [*pose.position, *pose.quaternion]


def pushed(robot=None, **changes):
    block = Block((0.2, 0.2, 0.2), mass=0.1)
    return FreeSpace(Scene(robot or aside(), object=block, **changes))


ABOVE = 0.5 + 0.1 + 0.1
"""Height of a block that touches the ball of 0.1 m, 0.5 m beside the plate and above the ground."""
DIAGONAL = 0.1 * np.sqrt(2)
TILTED, ASIDE = 0.5 + 0.1 + DIAGONAL - DEEP, 0.5 - 0.1 - DIAGONAL + DEEP
WALL = Block((0.2, 0.2, 0.2), Pose((1.6, 0.0, 0.1)))


@pytest.mark.parametrize(
    ("block", "q", "is_free"),
    [
        (block_at(0.5, ABOVE + SHALLOW), 0.0, True),
        (block_at(0.5, ABOVE - SHALLOW), 0.0, True),
        (block_at(0.5, ABOVE - DEEP), 0.0, False),
        (block_at(0.5, ABOVE), 0.3, False),
        (block_at(0.5, TILTED, yaw=np.pi / 4), 0.0, True),
        (block_at(0.5, TILTED, pitch=np.pi / 4), 0.0, False),
        (block_at(ASIDE, 0.5), 0.0, True),
        (block_at(ASIDE, 0.5, yaw=np.pi / 4), 0.0, False),
        (block_at(2.0, 0.1), 0.0, True),
        (block_at(2.0, 0.0), 0.0, True),  # it may stand on the ground, or in it
        (block_at(0.0, 0.1), 0.0, False),  # in the plate
        (block_at(1.5, 0.1), 0.0, False),  # in the wall
    ],
)
def test_a_block_is_an_obstacle_where_it_is(block, q, is_free):
    space = pushed(obstacles=(WALL,))
    assert space.free([[q]], [block]).tolist() == [is_free]
    assert space.free([[q]])[0]


def test_block_clearance_ignores_moving_links_and_the_tool_point_does_not():
    clear = pushed().block_is_clear([block_at(0.5, 0.5), block_at(0.1, 0.1)])
    assert clear.tolist() == [True, False]
    fingertip = Frame("tool", "ball", Pose((0.0, 0.0, 0.3)))
    space = pushed(replace(aside(), frames=(fingertip,)))
    blocks = [block_at(0.5, 0.85), block_at(0.5, 0.95)]
    assert space.free([[0.0]] * 2, blocks).tolist() == [False, True]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pushed().free([0.0]), r"needs \(n, 1\)"),
        (lambda: pushed(obstacles=(SLAB,)).free([[0.0, 0.0]]), r"needs \(n, 1\)"),
        (lambda: pushed().free([[np.nan]]), "q of lift is not finite"),
        (lambda: pushed().obstacle_hits([[np.inf]]), "q of lift is not finite"),
    ],
)
def test_invalid_input_is_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_block_clearance_far_away_equals_the_full_test():
    """Poses whose block is surely far from everything fixed are not tested one by one."""
    wall = Block((0.2, 0.4, 0.2), Pose.from_xyz_rpy((1.6, 0.0, 0.1), (0.0, 0.0, 0.5)))
    space = pushed(obstacles=(wall,))
    rng = np.random.default_rng(0)
    blocks = np.array([block_at(*rng.uniform((-2, 0), (2, 0.4)), yaw=yaw) for yaw in range(200)])
    away = np.tile([[1.0]], (len(blocks), 1))  # no block is as high as the ball at its limit
    clear = space.block_is_clear(blocks)
    assert clear.tolist() == space.free(away, blocks).tolist()
    assert 0 < clear.sum() < len(clear)


ACROSS = ((0.5, 0.0), (0.12, 6.0))
GAP = (((0.5, -1.2), (0.1, 2.0)), ((0.5, 1.2), (0.1, 2.0)))
HERE, THERE = np.array([-1.5, 1.0]), np.array([1.5, 1.0])


def walled(*walls):
    """A ball on slides, among walls: (x, y) of their middles and edges.

    The cart has a shape, far above, lest ball and base are neighbours, which may touch.
    """
    shapes = tuple(Shape(Box((*edges, 0.4)), Pose((*middle, 0.2))) for middle, edges in walls)
    above = Shape(Sphere(0.01), Pose((0.0, 0.0, 5.0)))
    links = [Link("base", collisions=shapes), Link("cart", collisions=(above,))]
    return ball(0.2).with_links(links)


def hinged(kind, *walls):
    """The same robot with a hinge as first joint, so that the ball circles the origin."""
    body = walled(*walls)
    first, second = body.joints
    limits = None if kind == "continuous" else (-2 * math.pi, 2 * math.pi)
    turning = replace(first, kind=kind, axis=(0.0, 0.0, 1.0), limits=limits)
    sliding = replace(second, axis=(1.0, 0.0, 0.0), limits=(0.6, 1.2))
    return replace(body, joints=(turning, sliding), home=(0.0, 0.9))


def test_wall_splits_the_joint_range():
    body = walled(ACROSS)
    (component,) = cspace_components(body)
    assert component.pairs == (("ball", "base"),)
    assert component.joints == (0, 1)
    assert in_other_component([component], THERE).tolist() == [True]
    assert in_other_component([component], HERE).tolist() == [False]
    for x, far in ((0.33, False), (0.67, True)):
        assert FreeSpace(Scene(body)).free([[x, 0.0]])[0]
        assert in_other_component([component], np.array([x, 0.0]))[0] == far


@pytest.mark.parametrize("walls", [(), GAP])
def test_passable_obstacle_does_not_split_the_range(walls):
    assert cspace_components(walled(*walls)) == ()


def test_continuous_joint_wraps_around():
    """Two walls split a continuous joint; with joint limits one wall is enough."""
    left, right = ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0))
    assert cspace_components(hinged("continuous", left)) == ()
    body = hinged("continuous", left, right)
    components = cspace_components(body)
    assert in_other_component(components, np.array([math.pi - 0.1, 0.9])).all()
    assert in_other_component(components, np.array([0.1 - math.pi, 0.9])).all()
    assert not in_other_component(components, np.array([0.5, 0.9])).any()


def test_ranges_of_full_turns_are_not_split():
    """For a hinge with two turns, the angle matters and not the turn."""
    body = hinged("revolute", ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0)))
    found = cspace_components(body)
    for turns in (-1, 0):
        assert not in_other_component(found, np.array([0.5 + 2 * math.pi * turns, 0.9])).any()
    assert in_other_component(found, np.array([math.pi, 0.9])).all()


def test_goals_are_in_the_larger_component(tmp_path):
    body = walled(ACROSS)
    both, _ = FreeSpace(Scene(body)).sample(40, np.random.default_rng(0))
    assert 5 < (both[:, 0] > 0.5).sum() < 35
    goals, few = (draw_goals(body, ReachConfig(num_goals=n), cache=tmp_path) for n in (40, 7))
    assert (goals.q[:, 0] < 0.5).all()
    assert goals.accepted == 40 < goals.tried
    assert (few.q == goals.q[:7]).all()
    assert REACH.certify(goals, body, Scene(body)) == []


def test_too_few_goals_error_counts_the_unreachable_ones():
    space = FreeSpace(Scene(walled(ACROSS)))
    q = random_configurations(space.scene.robot, 1000, np.random.default_rng(0))
    count = space.free(q).sum()
    assert count > 100
    message = rf"only 0 of 1,000 .* free of collisions and {count} more are, but cut"
    with pytest.raises(BenchmarkError, match=message):
        space.sample(1, np.random.default_rng(0), lambda q: False)


def test_certificate_detects_goals_in_another_component(tmp_path):
    goals, body = draw_goals(ball(0.2), ReachConfig(num_goals=12), cache=tmp_path), walled(ACROSS)
    lines = REACH.certify(goals, body, Scene(body))
    there = [i for i, q in enumerate(goals.q) if q[0] > 0.65]
    assert there
    said = "'ball' and 'base' touch on every path to most others"
    assert [line for line in lines if "touch" in line] == [f"goal {i}: {said}" for i in there]


def test_joints_that_do_not_move_the_tool_are_not_split():
    body = walled(ACROSS)
    (frame,) = body.frames
    assert cspace_components(replace(body, frames=(replace(frame, link="cart"),))) == ()


START, BEHIND, BESIDE = np.array([-0.5, 0.0]), np.array([0.5, 0.0]), np.array([-0.5, 0.5])


def paths(*ends):
    """Return straight paths to ends (J,)."""
    return np.array(ends)[:, None]


def test_the_first_free_path_is_found():
    wall = Block((0.2, 0.4, 0.4), Pose((0.0, 0.0, 0.2)))
    space, empty = FreeSpace(Scene(ball(0.2), obstacles=(wall,))), FreeSpace(Scene(ball(0.2)))
    assert space.best_path(START, paths(BEHIND, BESIDE)) == 1
    assert space.best_path(START, paths(BEHIND, BEHIND + SAME / 2, BESIDE)) == 2
    through, around = [BEHIND, BESIDE], [BESIDE, np.array([0.5, 0.5])]
    assert space.best_path(START, np.array([through, around])) == 1
    assert space.best_path(START, paths(BEHIND)) == 0  # for want of a free one
    assert space.best_path(START, np.zeros((0, 1, 2))) is None
    assert empty.best_path(START, paths(BEHIND, BESIDE)) == 0
    padded = paths([*BEHIND, 0.0], [*BESIDE, 0.0])
    assert space.best_path(np.array([*START, 9.0]), padded) == 1
    space.place_obstacles([Pose((0.0, 2.0, 0.2))])  # obstacles count where they are
    assert space.best_path(START, paths(BEHIND, BESIDE)) == 0


def test_paths_end_clear_of_the_block_and_of_where_it_must_not_be():
    block = Block((0.2, 0.2, 0.4), Pose((0.0, 0.0, 0.2)))
    space = FreeSpace(Scene(ball(0.2), object=block))
    places = {x: np.array([x, 0.5, 0.2, 1, 0, 0, 0]) for x in (-0.5, 0.5, 5.0)}
    ends = paths([0.5, 0.5], BESIDE, BEHIND)  # the first two are in the way of the block
    for blocks, best in (((5.0, 5.0), 0), ((0.5, 5.0), 1), ((0.5, -0.5), 2), ((5.0, 0.5), 1)):
        assert space.best_path(START, ends, np.array([places[x] for x in blocks])) == best
    both = np.array([places[0.5], places[0.5]])
    assert space.best_path(START, ends[:1], both) is None
