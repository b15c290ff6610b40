"""Kinematic channels agree with kinematics, are canonical, and show the path to the target."""

import itertools
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_spec
from helpers.scenes import robot as compose
from morphgen.errors import TaskError
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, half_extents
from morphgen.model.kinematics import forward_kinematics, frame_jacobian
from morphgen.model.kinematics_torch import frame_pose
from morphgen.rl.config import PolicyConfig
from morphgen.rl.inference import run_episodes
from morphgen.rl.observation_layout import layout_of
from morphgen.rl.policies import make_networks
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.kinematic_channels import (
    CLEARANCES,
    COLUMN_SCALE,
    IK_SHARE,
    MAX_PLACE,
    POSITION_SCALE,
    ROTATION_SCALE,
    SOLVED,
    box_distance,
    capsule_box_distance,
    compile_capsules,
)
from morphgen.tasks.observation import MAX_TREE_DISTANCE, NUM_POINTS, observation_config
from morphgen.tasks.reach.envs import ReachEnvs
from morphgen.tasks.registry import CHANNELS, KINEMATIC_CHANNELS
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import TaskEnvs

WORDS = ("arm3", "arm=ur5 ee=stick")
ALL = observation_config((*KINEMATIC_CHANNELS, "tree"))
SIZES = {"lag": 1, "joint": 10, "poses": 15, "jacobian": 20, "dls": 3, "ik": 6}


@pytest.fixture(scope="module")
def specs(cache):
    return [draw_spec(compose(words), ReachConfig(num_goals=10), cache=cache) for words in WORDS]


@pytest.fixture(scope="module")
def moved(specs):
    """A batch of two environments of each robot after ten random steps, and its observation."""
    batch = batch_from_specs(specs, 4, sim="kinematic", observe=ALL, seed=3)
    batch.reset()
    random = torch.Generator().manual_seed(0)
    for _ in range(10):
        actions = torch.rand(batch.action_mask.shape, generator=random) * 2 - 1
        batch.step(actions)
    return batch, batch.observe()


def test_all_channels_have_a_vector_for_each_link(moved):
    batch, observation = moved
    for name, size in SIZES.items():
        assert observation[name].shape == (4, batch.robot_tables.max_links, size), name
        assert observation[name].isfinite().all(), name
        assert not observation[name][~observation["links"]].any(), name


def test_the_jacobian_channel_has_the_columns_of_the_numpy_jacobian(moved):
    batch, observation = moved
    for env, spec in enumerate(batch.specs * 2):
        robot = spec.robot
        q = batch.q[env, : robot.dof].double().numpy()
        T_root_tool, J = frame_jacobian(robot, q, "tool")
        error = batch.field("goal")[env, :3].numpy() - T_root_tool[:3, 3]
        for joint in range(robot.dof):
            link = int(batch.robot_tables.link_of_joint[batch.env_robot_index[env], joint])
            step = float(batch.robot_tables.max_step[batch.env_robot_index[env], joint])
            row = observation["jacobian"][env, link].numpy()
            np.testing.assert_allclose(row[:3], COLUMN_SCALE * step * J[:3, joint], atol=2e-4)
            np.testing.assert_allclose(row[3:6], ROTATION_SCALE * step * J[3:, joint], atol=2e-4)
            if J[:3, joint].any():
                np.testing.assert_allclose(row[7:10], POSITION_SCALE * error, atol=2e-4)


def test_the_dls_step_of_small_errors_reaches_the_goal(specs):
    batch = batch_from_specs(specs, 2, sim="kinematic", observe=observation_config(["dls"]))
    batch.reset()
    q = batch.q
    batch.groups["reach"].goal[:, :3] = batch.observation.tool_positions(q) + torch.tensor(
        [0.003, 0, 0.002]
    )
    dls = torch.atanh(batch.observe()["dls"][..., 1])  # the gain 1, in largest steps
    step = batch.robot_tables.max_step[batch.env_robot_index]
    joints = torch.gather(dls, 1, batch.robot_tables.link_of_joint[batch.env_robot_index]) * step
    error = batch.groups["reach"].goal[:, :3] - batch.observation.tool_positions(q + joints)
    assert (torch.linalg.vector_norm(error, dim=1) < 0.001).all()


def test_equal_joints_look_equal_whatever_the_convention_of_frames(specs):
    """A robot whose joint frames are turned about the origin, with axes to match, is the same."""
    robot = specs[0].robot
    turn = Pose.from_xyz_rpy((0.0, 0.0, 0.0), (0.4, -0.3, 1.1))
    turned = _with_turned_frames(robot, turn)
    np.testing.assert_allclose(
        forward_kinematics(turned, np.array(robot.home))[:, :3, 3],
        forward_kinematics(robot, np.array(robot.home))[:, :3, 3],
        atol=1e-9,
    )
    rows = []
    for same in (robot, turned):
        spec = replace(specs[0], robot=same, scene=replace(specs[0].scene, robot=same))
        batch = batch_from_specs([spec], 1, sim="kinematic", observe=ALL, seed=0)
        rows.append(batch.reset())
    for name in ("joint", "jacobian", "dls", "lag"):
        # Steps of columns that are almost zero are quotients of small numbers.
        torch.testing.assert_close(rows[0][name], rows[1][name], rtol=1e-4, atol=2e-3)
    # The axis (z) and all vectors agree; x depends on the convention by a turn about the axis.
    axis_and_vectors = [*range(3, 15)]
    moves = rows[0]["joints"][0].tolist()
    one, other = (row["poses"][0, moves][:, axis_and_vectors] for row in rows)
    torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def _with_turned_frames(robot, turn):
    """Turn the frame of every link but the root about its origin; shapes and axes follow."""
    back = turn.inverse()
    links, joints = [robot.links[0]], []
    for link in robot.links[1:]:
        shapes = tuple(replace(s, T_link_shape=back @ s.T_link_shape) for s in link.collisions)
        links.append(replace(link, visuals=(), collisions=shapes))
    for joint in robot.joints:
        parent_turn = Pose() if joint.parent == robot.links[0].name else back
        T = parent_turn @ joint.T_parent_joint @ turn
        axis = back.matrix[:3, :3] @ np.array(joint.axis)
        joints.append(replace(joint, T_parent_joint=T, axis=tuple(axis.tolist())))
    frames = tuple(replace(f, T_link_frame=back @ f.T_link_frame) for f in robot.frames)
    return replace(robot, links=tuple(links), joints=tuple(joints), frames=frames)


def test_the_lag_is_the_distance_of_joints_from_their_targets(moved):
    batch, observation = moved
    index = batch.env_robot_index
    lag = (batch.targets - batch.q) / batch.robot_tables.max_step[index].clamp(min=1e-6)
    links = batch.robot_tables.link_of_joint[index]
    observed = torch.gather(observation["lag"][..., 0], 1, links)
    exists = batch.robot_tables.max_step[index] > 0
    torch.testing.assert_close(observed[exists], lag.clamp(-3, 3)[exists])
    assert observed[exists].abs().max() > 0.5, "the joints lag"


def test_tasks_without_target_points_have_no_errors_and_no_way(specs, monkeypatch):
    monkeypatch.setattr(ReachEnvs, "target_points", TaskEnvs.target_points)
    observe = observation_config(("lag", "joint", "poses", "jacobian", "dls"))
    batch = batch_from_specs(specs, len(specs), sim="mujoco", observe=observe)
    sizes = {name: batch.reset()[name].shape[-1] for name in ("jacobian", "dls", "poses")}
    batch.close()
    assert sizes == {"jacobian": 7, "dls": 0, "poses": 12}
    batch = batch_from_specs(specs, len(specs), sim="mujoco", observe=observation_config(("ik",)))
    with pytest.raises(TaskError, match="channel ik: no task here has target points"):
        batch.reset()
    batch.close()


def test_tree_entries_of_a_serial_arm(moved):
    _, observation = moved
    joints = observation["joints"][1]
    count = int((joints >= 0).sum())
    assert count == 6
    assert observation["joint_parents"][1, :count].tolist() == [-1, 0, 1, 2, 3, 4]
    relations = observation["joint_relations"][1, :count, :count]
    kinds, distances = relations // (MAX_TREE_DISTANCE + 1), relations % (MAX_TREE_DISTANCE + 1)
    places = torch.arange(count)
    assert distances.equal((places[:, None] - places).abs())
    sign = (places[:, None] - places).sign()
    assert kinds.equal(torch.where(sign == 0, 0, torch.where(sign > 0, 1, 2)))


def test_push_observes_the_block_from_the_nearest_point_of_the_robot(cache):
    spec = draw_spec(compose("arm3"), PushConfig(num_goals=3), cache=cache)
    batch = batch_from_specs([spec], 2, sim="mujoco", observe=ALL)
    observation, points = batch.reset(), 3
    assert observation["jacobian"].shape[2] == 7 + 13 * points + 11
    assert observation["poses"].shape[2] == 12 + 3 * points
    offset = observation["jacobian"][..., 7 + 13 * points : 10 + 13 * points]
    moving = observation["jacobian"][..., 6] > 0
    distance = torch.linalg.vector_norm(offset[moving] / POSITION_SCALE, dim=-1)
    tool = batch.observation.tool_positions(batch.q)
    to_block = torch.linalg.vector_norm(tool - batch.simulation.object_pose[:, :3], dim=1)
    assert (distance <= to_block.max() + 1e-4).all()
    assert (distance > 0).all()


def test_a_task_with_fewer_target_points_than_another_repeats_its_last(specs, cache):
    push = draw_spec(compose("arm3"), PushConfig(num_goals=5), cache=cache)
    batch = batch_from_specs([specs[0], push], 4, sim="mujoco", observe=ALL)
    batch.reset()
    goals = batch.groups.tool_targets(batch.simulation.object_pose)
    reach = batch.task_mask("reach")
    goal = batch.field("goal")[reach, None, :3]
    assert goals.exists.all()
    torch.testing.assert_close(goals.points[reach], goal.expand(-1, 3, 3))
    assert (goals.points[~reach, 2, 1] > goals.points[~reach, 1, 1]).all()


def test_channels_are_asked_for_by_name():
    asked = observation_config(["lag", "points", "no_state"], obstacles=3)
    assert (asked.lag, asked.points, asked.state, asked.obstacles) == (True, NUM_POINTS, False, 3)
    for name in CHANNELS:
        if name not in ("no_state", "pace"):
            assert observation_config([name]) != observation_config([])
    for names, message in (
        (["jacobain"], r"unknown observation channel 'jacobain'.*jacobian"),
        (["no_state"], "expected points"),
        (["velocity", "pace"], "channel pace: expected one that it changes: lag"),
    ):
        with pytest.raises(TaskError, match=message):
            observation_config(names)


def test_with_pace_a_slow_arm_looks_like_a_fast_one(specs):
    names = ("lag", "joint", "jacobian", "dls", "contact", "pace")
    fast = specs[1].robot
    joints = (replace(each, velocity=each.velocity and each.velocity / 5) for each in fast.joints)
    slow = replace(fast, joints=tuple(joints))
    seen = {}
    for robot, channels in itertools.product((fast, slow), (names[:-1], names)):
        pair, observe = [specs[0], replace(specs[1], robot=robot)], observation_config(channels)
        batch = batch_from_specs(pair, 4, sim="kinematic", observe=observe, seed=3)
        seen[robot is slow, "pace" in channels] = batch.reset()
    for name in names[:-1]:
        torch.testing.assert_close(seen[False, True][name], seen[True, True][name], msg=name)
    steps = [seen[is_slow, False]["jacobian"][1::2] for is_slow in (False, True)]
    assert not torch.allclose(*steps)
    turning = batch.robot_tables.max_step[batch.env_robot_index] > 0
    largest = batch.observation._kinematics._max_step
    assert torch.allclose((largest * turning).sum(dim=1) / turning.sum(dim=1), torch.tensor(0.045))


CHANGE = 3
"""Column of the channel with the displacement of the joint in rad or m."""


def batch_of(specs, envs=6):
    observe = observation_config(["ik"])
    return batch_from_specs(specs, envs, sim="kinematic", observe=observe, seed=2)


def solution_of(batch, observation):
    """Return the configurations that the channel points to, shape (n, J)."""
    links = batch.robot_tables.link_of_joint[batch.env_robot_index]
    exists = batch.robot_tables.max_step[batch.env_robot_index] > 0
    change = torch.gather(observation["ik"][..., CHANGE], 1, links) * exists
    return batch.targets + change


def distance_to_goal(batch, q):
    tool = frame_pose(batch.robot_tables.tool_chain, batch.env_robot_index, q)[:, :3, 3]
    return torch.linalg.vector_norm(tool - batch.field("goal")[:, :3], dim=1)


def test_the_tool_is_at_the_goal_where_the_channel_points_to(specs):
    batch = batch_of(specs)
    q = solution_of(batch, batch.reset())
    assert (distance_to_goal(batch, q) < SOLVED).all()
    tables, index = batch.robot_tables, batch.env_robot_index
    assert (q >= tables.lower[index] - 1e-5).all()
    assert (q <= tables.upper[index] + 1e-5).all()


def test_the_configuration_stays_within_an_episode_and_is_new_in_the_next(specs):
    batch = batch_of(specs)
    first = solution_of(batch, batch.reset())
    random = torch.Generator().manual_seed(0)
    for _ in range(5):
        actions = torch.rand(batch.action_mask.shape, generator=random) * 2 - 1
        observation = batch.step(actions).observation
        torch.testing.assert_close(solution_of(batch, observation), first, atol=1e-4, rtol=0)
    q = solution_of(batch, batch.reset())
    assert (q - first).abs().amax() > 0.1
    assert (distance_to_goal(batch, q) < SOLVED).all()


def test_episodes_do_not_depend_on_what_was_solved_before(specs):
    used, fresh = batch_of(specs), batch_of(specs)
    used.reset(seed=1)
    used.step(torch.ones(used.action_mask.shape))
    assert used.reset(seed=5)["ik"].equal(fresh.reset(seed=5)["ik"])


class Follower:
    """Moves all joints along the straight path."""

    def act(self, task):
        return task.observe()["ik"][..., IK_SHARE]


def test_following_the_channel_reaches_every_goal_without_contacts(specs):
    episodes = run_episodes(batch_of(specs, 20), Follower(), 1)
    assert all(episode.success for episode in episodes)


def test_a_residual_policy_begins_with_the_path_that_the_channel_shows(specs):
    policy = PolicyConfig(
        "me-graph", discrete=False, observe=("ik",), normalize=True, residual=True
    )
    observe = observation_config(policy.channels)
    observation = batch_from_specs(specs, 4, sim="kinematic", observe=observe).reset()
    actor, _ = make_networks(policy, layout_of(observation), 0)
    path = observation["ik"][..., IK_SHARE]
    assert path.abs().max() > 0.5
    actions = actor.distribution(observation).mode()
    assert actions.shape == path.shape
    assert (actions - path * observation["actions"]).abs().max() < 0.05


def test_goals_that_are_poses_are_solved_with_their_orientation(specs):
    poses = [replace(spec, config=replace(spec.config, goal="pose")) for spec in specs]
    batch = batch_of(poses, 10)
    q = solution_of(batch, batch.reset())
    near = distance_to_goal(batch, q) < SOLVED
    T_root_tool = frame_pose(batch.robot_tables.tool_chain, batch.env_robot_index, q)
    wanted = batch.groups.tool_targets(batch.simulation.object_pose).rotations
    trace = (wanted * T_root_tool[:, :3, :3]).sum(dim=(1, 2))
    angle = torch.arccos(((trace - 1) / 2).clamp(-1, 1))
    # Most poses are found, not all.
    assert (near & (angle < 0.05)).float().mean() >= 0.8


OBSERVE = observation_config(["clearance", "contact"])
NEAR_ERROR, FAR_ERROR = 0.012, 0.036
"""Largest error of distances below `NEAR`, and of others [m]."""
NEAR = 0.05
CONFIG = ReachConfig(num_goals=20, train_layouts=3, eval_layouts=2)


@pytest.fixture(scope="module")
def among_obstacles(cache):
    return [draw_spec(compose(words), CONFIG, obstacles=True, cache=cache) for words in WORDS]


@pytest.fixture(scope="module")
def batch(among_obstacles):
    return batch_from_specs(among_obstacles, 20, sim="mujoco", observe=OBSERVE, seed=1)


def channel(batch, q=None, name="clearance", object_pose=None):
    """Return a channel at the joints, shape (n, J, size)."""
    q = batch.q if q is None else q
    object_pose = batch.simulation.object_pose if object_pose is None else object_pose
    goals = batch.groups.tool_targets(object_pose, 0)
    values = batch.observation._kinematics(q, q, goals, object_pose)[name]
    links = batch.robot_tables.link_of_joint[batch.env_robot_index]
    return torch.gather(values, 1, links[..., None].expand(-1, -1, values.shape[2]))


def mujoco_geom(shape, T_world_link):
    geometry, pose = shape.geometry, Pose.from_matrix(T_world_link @ shape.T_link_shape.matrix)
    kind, size = {
        Box: ("box", half_extents(geometry)),
        Sphere: ("sphere", half_extents(geometry)[:1]),
        Cylinder: ("cylinder", half_extents(geometry)[1:]),
        Capsule: ("capsule", (half_extents(geometry)[0], getattr(geometry, "length", 0.0) / 2)),
    }[type(geometry)]
    numbers = (" ".join(map(str, each)) for each in (size, pose.position, pose.quaternion))
    return '<geom type="{}" size="{}" pos="{}" quat="{}"/>'.format(kind, *numbers)


def mujoco_distances(shapes, boxes):
    """Return distances (S, O) of posed shapes from boxes by MuJoCo."""
    posed = [mujoco_geom(shape, T) for shape, T in shapes]
    posed += [mujoco_geom(Shape(Box(box.size)), box.pose.matrix) for box in boxes]
    xml = f"<mujoco><worldbody>{''.join(posed)}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    n = len(shapes)
    pairs = itertools.product(range(n), range(n, len(posed)))
    found = [mujoco.mj_geomDistance(model, data, s, o, 10.0, None) for s, o in pairs]
    return np.reshape(found, (n, -1))


def joint_distances(batch, env, boxes):
    """Return the distance of boxes from the nearest shape that each joint moves."""
    robot = batch.specs[int(batch.env_robot_index[env])].robot
    T = forward_kinematics(robot, batch.q[env, : robot.dof].double().numpy())
    shapes = [(i, shape) for i, link in enumerate(robot.links) for shape in link.collisions]
    distances = mujoco_distances([(shape, T[i]) for i, shape in shapes], boxes).min(axis=1)
    chains = [robot.joint_chain(robot.links[i].name) for i, _ in shapes]
    for k in robot.independent_joints:
        yield min(
            (d for d, chain in zip(distances, chains, strict=True) if k in chain), default=np.inf
        )


def test_capsules_are_as_far_from_boxes_as_in_mujoco():
    rng = np.random.default_rng(0)
    for _ in range(100):
        capsule = Capsule(rng.uniform(0.01, 0.1), rng.uniform(0.0, 0.4))
        pose = Pose.from_xyz_rpy(tuple(rng.uniform(-0.5, 0.5, 3)), tuple(rng.uniform(-3, 3, 3)))
        box = Block(tuple(rng.uniform(0.05, 0.3, 3)))
        expected = mujoco_distances([(Shape(capsule), pose.matrix)], [box])[0, 0]
        z = pose.matrix[:3, 2] * capsule.length / 2
        ends = torch.tensor(np.stack([pose.matrix[:3, 3] - z, pose.matrix[:3, 3] + z]))
        half = torch.tensor(box.size, dtype=torch.float64) / 2
        distance, point, normal = capsule_box_distance(ends, torch.tensor(capsule.radius), half)
        assert torch.linalg.vector_norm(normal) == pytest.approx(1)
        along = torch.linalg.cross(point - ends[0], ends[1] - ends[0])
        assert torch.linalg.vector_norm(along) == pytest.approx(0, abs=1e-6)
        if expected > 0:  # of an axis in the box, MuJoCo has another depth
            assert float(distance) == pytest.approx(expected, abs=1e-3)
        else:
            assert distance < 1e-3


def test_inside_a_box_the_distance_is_that_of_the_nearest_face():
    points, half = torch.tensor([[0.0, -0.15, 0.0], [0.0] * 3]), torch.tensor([0.1, 0.2, 0.3])
    distance, gradient = box_distance(points, half)
    torch.testing.assert_close(distance, torch.tensor([-0.05, -0.1]))
    assert gradient.tolist() == [[0, -1, 0], [1, 0, 0]]


def test_the_closeness_is_that_of_the_collision_shapes(batch):
    """The nearest shape that each joint moves is as far away as in MuJoCo, to a stated error."""
    batch.reset()
    limit, errors = CLEARANCES[-1], []
    observed = channel(batch)[..., len(CLEARANCES) - 1].tolist()
    for env in range(batch.num_envs):
        boxes = batch.layouts.obstacles(env)
        for joint, distance in enumerate(joint_distances(batch, env, boxes)):
            closeness = observed[env][joint]
            if closeness == 0:
                assert distance > limit - FAR_ERROR
            else:
                error = abs((1 - closeness) * limit - distance)
                assert error < (NEAR_ERROR if distance < NEAR else FAR_ERROR)
                errors.append(error)
    assert len(errors) > 50
    assert np.mean(errors) < 0.008


def test_environments_without_obstacles_see_zeros_and_the_others_what_they_see_alone(
    among_obstacles, cache
):
    specs = among_obstacles
    free = draw_spec(specs[1].robot, CONFIG, obstacles=False, cache=cache)
    mixed = batch_from_specs([*specs, free], 6, sim="mujoco", observe=OBSERVE, seed=1)
    observed = mixed.reset()["clearance"]
    assert not observed[2::3].any()
    assert not mixed.observe()["contact"].any()
    assert not observed[~mixed.observe()["links"]].any()
    for env in (0, 1):
        alone = batch_from_specs(
            [specs[env]], 1, sim="mujoco", observe=OBSERVE, max_links=observed.shape[1]
        )
        alone.layouts.poses.copy_(mixed.layouts.poses[env : env + 1])
        q = mixed.q[env : env + 1, : alone.robot_tables.max_joints]
        torch.testing.assert_close(channel(alone, q)[0], channel(mixed)[env, : q.shape[1]])
    alone = batch_from_specs([free], 1, sim="mujoco", observe=OBSERVE)
    assert not alone.reset()["clearance"].any()


def test_meshes_are_refused(specs, tmp_path):
    robot = specs[1].robot
    mesh = (Shape(Mesh(tmp_path / "link.stl")),)
    links = tuple(replace(link, collisions=mesh if i else ()) for i, link in enumerate(robot.links))
    with pytest.raises(TaskError, match=r"clearance: link .* has a mesh"):
        compile_capsules([replace(robot, links=links)], "cpu")


@pytest.fixture(scope="module")
def pushes(cache):
    robots = [compose(words) for words in ("arm3-stick", WORDS[1])]
    push = [draw_spec(robot, PushConfig(num_goals=5), cache=cache) for robot in robots]
    return batch_from_specs(push, 40, sim="mujoco", observe=OBSERVE, seed=1)


@pytest.fixture
def near(pushes):
    """Return the batch, and poses of its blocks near the tools."""
    pushes.reset()
    random = torch.Generator().manual_seed(0)
    pose = pushes.simulation.object_pose.clone()
    tool = pushes.observation.tool_positions(pushes.q)
    away = torch.nn.functional.normalize(torch.randn(len(pose), 3, generator=random))
    pose[:, :3] = tool + (0.15 + 0.2 * torch.rand(len(pose), 1, generator=random)) * away
    pose[:, 3:] = torch.nn.functional.normalize(torch.randn(len(pose), 4, generator=random))
    return pushes, pose


def contact(near, *, q=None, moved=None):
    batch, pose = near
    pose = pose.clone()
    if moved is not None:
        pose[:, :3] += moved
    return channel(batch, q, "contact", pose)


def test_contact_is_as_near_to_the_block_as_the_collision_shapes(near):
    batch, poses = near
    limit, observed, checked = CLEARANCES[-1], contact(near)[..., 1].tolist(), 0
    for env in range(batch.num_envs):
        block = batch.specs[int(batch.env_robot_index[env])].scene.block
        x, y, z, *quaternion = poses[env].tolist()
        box = replace(block, pose=Pose((x, y, z), tuple(quaternion)))
        for joint, distance in enumerate(joint_distances(batch, env, [box])):
            closeness = observed[env][joint]
            if 0 < closeness < 1 and distance > 0:
                assert abs((1 - closeness) * limit - distance) < FAR_ERROR
                checked += 1
    assert checked > 50


def test_contact_changes_with_the_joints_and_along_its_direction(near):
    batch, limit = near[0], CLEARANCES[-1]
    observed, step = contact(near), batch.robot_tables.max_step[batch.env_robot_index]
    closeness = observed[..., 1]
    direction = observed[..., 3:6] / closeness.clamp(min=1e-3)[..., None]
    seen = (closeness > 0.05) & (closeness < 1)
    torch.testing.assert_close(
        torch.linalg.vector_norm(direction[seen], dim=-1), torch.ones(int(seen.sum()))
    )
    checked = 0
    for joint in range(batch.q.shape[1]):
        change = torch.zeros_like(batch.q)
        change[:, joint] = 1e-3
        turned = [contact(near, q=batch.q + sign * change)[:, joint, 1] for sign in (-1, 1)]
        moved = direction[:, joint] * 1e-3
        shifted = [contact(near, moved=sign * moved)[:, joint, 1] for sign in (-1, 1)]
        rate = -(turned[1] - turned[0]) * limit / 2e-3
        expected = observed[:, joint, 2] / (COLUMN_SCALE * step[:, joint] * closeness[:, joint])
        # Where the nearest pair changes in between, both ends are farther than the middle says.
        middle = closeness[:, joint]
        smooth = [((a + b) / 2 - middle).abs() < 1e-4 for a, b in (turned, shifted)]
        here = seen[:, joint]
        both = here & smooth[0]
        torch.testing.assert_close(expected[both], rate[both], atol=0.02, rtol=0.05)
        towards = here & smooth[1]
        change_by_metre = (shifted[1] - shifted[0])[towards] * limit / 2e-3
        torch.testing.assert_close(
            change_by_metre, torch.ones_like(change_by_metre), atol=0.02, rtol=0
        )
        checked += int(both.sum() + towards.sum())
    assert checked > 200


def test_contact_says_where_the_link_is_on_the_block(near):
    """The place is as far from the box as the closeness says, but for a capsule's radius."""
    batch, observed = near[0], contact(near)
    closeness, limit = observed[..., 1], CLEARANCES[-1]
    place = observed[..., 6:] / closeness.clamp(min=1e-3)[..., None]
    seen = (closeness > 0.05) & (closeness < 1) & (place.abs().amax(dim=-1) < MAX_PLACE)
    for env, joint in torch.nonzero(seen).tolist():
        spec = batch.specs[int(batch.env_robot_index[env])]
        half = torch.tensor(spec.scene.block.size) / 2
        distance, _ = box_distance(place[env, joint] * half, half)
        radius = float(distance) - (1 - float(closeness[env, joint])) * limit
        radii = compile_capsules([spec.robot], "cpu").radius[0]
        assert (radii - radius).abs().min() < 1e-4
    assert int(seen.sum()) > 50
