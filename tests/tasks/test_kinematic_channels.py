"""Kinematic channels agree with kinematics, are canonical, and show the path to the target."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import morphgen
from helpers.goal_sets import draw_spec
from morphgen.errors import TaskError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import forward_kinematics, frame_jacobian
from morphgen.model.kinematics_torch import frame_pose
from morphgen.rl.config import PolicyConfig
from morphgen.rl.inference import run_episodes
from morphgen.rl.observation_layout import layout_of
from morphgen.rl.policies import make_networks
from morphgen.tasks.kinematic_channels import (
    COLUMN_SCALE,
    IK_SHARE,
    POSITION_SCALE,
    ROTATION_SCALE,
    SOLVED,
)
from morphgen.tasks.observation import MAX_TREE_DISTANCE, NUM_POINTS, observation_config
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import ReachEnvs
from morphgen.tasks.registry import CHANNELS, KINEMATIC_CHANNELS
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.task import TaskEnvs

WORDS = ("arm3", "arm=ur5 ee=stick")
ALL = observation_config((*KINEMATIC_CHANNELS, "tree"))
SIZES = {"lag": 1, "joint": 10, "poses": 15, "jacobian": 20, "dls": 3, "ik": 6}


@pytest.fixture(scope="module")
def specs(cache):
    robots = [morphgen.compose(words, geometry="primitive") for words in WORDS]
    config = replace(ReachConfig(), num_goals=10)
    return [draw_spec(robot, config, obstacles=False, seed=0, cache=cache) for robot in robots]


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
    robot = specs[1].robot
    turn = Pose.from_xyz_rpy((0.0, 0.0, 0.0), (0.4, -0.3, 1.1))
    turned = _with_turned_frames(robot, turn)
    np.testing.assert_allclose(
        forward_kinematics(turned, np.array(robot.home))[:, :3, 3],
        forward_kinematics(robot, np.array(robot.home))[:, :3, 3],
        atol=1e-9,
    )
    rows = []
    for same in (robot, turned):
        spec = replace(specs[1], robot=same, scene=replace(specs[1].scene, robot=same))
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


def test_push_observes_the_block_from_the_nearest_point_of_the_robot(tmp_path):
    robot = morphgen.compose("arm3", geometry="primitive")
    config = replace(PushConfig(), num_goals=3)
    spec = draw_spec(robot, config, obstacles=False, seed=0, cache=tmp_path)
    batch = batch_from_specs([spec], 2, sim="mujoco", observe=ALL)
    observation = batch.reset()
    P = 3
    assert observation["jacobian"].shape[2] == 7 + 13 * P + 11
    assert observation["poses"].shape[2] == 12 + 3 * P
    offset = observation["jacobian"][..., 7 + 13 * P : 10 + 13 * P]
    moving = observation["jacobian"][..., 6] > 0
    distance = torch.linalg.vector_norm(offset[moving] / POSITION_SCALE, dim=-1)
    tool = batch.observation.tool_positions(batch.q)
    to_block = torch.linalg.vector_norm(tool - batch.simulation.object_pose[:, :3], dim=1)
    assert (distance <= to_block.max() + 1e-4).all()
    assert (distance > 0).all()


def test_a_task_with_fewer_target_points_than_another_repeats_its_last(specs, tmp_path):
    robot = morphgen.compose("arm3", geometry="primitive")
    config = replace(PushConfig(), num_goals=5)
    push = draw_spec(robot, config, obstacles=False, seed=0, cache=tmp_path)
    batch = batch_from_specs([specs[0], push], 4, sim="mujoco", observe=ALL)
    batch.reset()
    goals = batch.groups.tool_targets(batch.simulation.object_pose)
    reach = batch.task_mask("reach")
    goal = batch.field("goal")[reach, None, :3]
    assert goals.exists.all()
    torch.testing.assert_close(goals.points[reach], goal.expand(-1, 3, 3))
    beyond = goals.points[~reach, 2, 1] - goals.points[~reach, 1, 1]
    assert (beyond > 0).all()


def test_channels_are_asked_for_by_name():
    config = observation_config(["lag", "points", "no_state"], obstacles=3)
    assert (config.lag, config.points, config.state, config.obstacles) == (
        True,
        NUM_POINTS,
        False,
        3,
    )
    for name in CHANNELS:
        if name not in ("no_state", "pace"):
            assert observation_config([name]) != observation_config([])
    with pytest.raises(TaskError, match=r"unknown observation channel 'jacobain'.*jacobian"):
        observation_config(["jacobain"])
    with pytest.raises(TaskError, match="expected points"):
        observation_config(["no_state"])
    with pytest.raises(TaskError, match="channel pace: expected one that it changes: lag"):
        observation_config(["velocity", "pace"])


def test_with_pace_a_slow_arm_looks_like_a_fast_one(specs):
    names = ("lag", "joint", "jacobian", "dls", "contact", "pace")
    fast = specs[1].robot
    joints = (replace(each, velocity=each.velocity and each.velocity / 5) for each in fast.joints)
    slow = replace(fast, joints=tuple(joints))
    seen = {}
    for robot in (fast, slow):
        pair = [specs[0], replace(specs[1], robot=robot)]
        for channels in (names[:-1], names):
            batch = batch_from_specs(
                pair, 4, sim="kinematic", observe=observation_config(channels), seed=3
            )
            observation = batch.reset()
            seen[robot is slow, "pace" in channels] = observation
    for name in names[:-1]:
        ours = [seen[is_slow, True][name] for is_slow in (False, True)]
        torch.testing.assert_close(*ours, msg=name)
    steps = [seen[is_slow, False]["jacobian"][1::2] for is_slow in (False, True)]
    assert not torch.allclose(*steps)
    turning = batch.robot_tables.max_step[batch.env_robot_index] > 0
    largest = batch.observation._kinematics._max_step
    assert torch.allclose((largest * turning).sum(dim=1) / turning.sum(dim=1), torch.tensor(0.045))


CHANGE = 3
"""Column of the channel with the displacement of the joint in rad or m."""


def batch_of(specs, envs=6):
    return batch_from_specs(
        specs, envs, sim="kinematic", observe=observation_config(["ik"]), seed=2
    )


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
