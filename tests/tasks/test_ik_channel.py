"""The channel ``ik`` shows the path to a configuration with the tool at the target."""

from dataclasses import replace

import pytest
import torch

import morphgen
from helpers.goal_sets import draw_spec
from morphgen.model.kinematics_torch import frame_pose
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import layout_of
from morphgen.rl.policies import make_networks
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.kinematic_channels import IK_SHARE, SOLVED
from morphgen.tasks.observation import observation_config
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs

CHANGE = 3
"""Column of the channel with the displacement of the joint in rad or m."""


def specs_of(cache, **config):
    robots = [
        morphgen.compose(words, geometry="primitive") for words in ("arm3", "arm=ur5 ee=stick")
    ]
    reach = replace(ReachConfig(), num_goals=10, **config)
    return [draw_spec(robot, reach, obstacles=False, seed=0, cache=cache) for robot in robots]


@pytest.fixture(scope="module")
def specs(tmp_path_factory):
    return specs_of(tmp_path_factory.mktemp("goals"))


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


def test_the_path_is_free_of_collisions(specs):
    batch = batch_of(specs[1:], 30)
    ends = solution_of(batch, batch.reset()).double().numpy()
    space = FreeSpace(specs[1].scene)
    starts = batch.targets.double().numpy()
    free = [space.free_fraction(*path) == 1 for path in zip(starts, ends, strict=True)]
    assert sum(free) >= 29


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


def test_goals_that_are_poses_are_solved_with_their_orientation(tmp_path):
    batch = batch_of(specs_of(tmp_path, goal="pose"), 10)
    q = solution_of(batch, batch.reset())
    near = distance_to_goal(batch, q) < SOLVED
    T_root_tool = frame_pose(batch.robot_tables.tool_chain, batch.env_robot_index, q)
    wanted = batch.groups.tool_targets(batch.simulation.block_pose).rotations
    trace = (wanted * T_root_tool[:, :3, :3]).sum(dim=(1, 2))
    angle = torch.arccos(((trace - 1) / 2).clamp(-1, 1))
    # Most poses are found, not all.
    assert (near & (angle < 0.05)).float().mean() >= 0.8


def test_push_shows_the_path_to_its_first_point_wherever_the_block_is(tmp_path):
    robot = morphgen.compose("arm3", geometry="primitive")
    config = replace(PushConfig(), num_goals=3)
    spec = draw_spec(robot, config, obstacles=False, seed=0, cache=tmp_path)
    batch = batch_from_specs([spec], 2, sim="mujoco", observe=observation_config(["ik"]))
    q = solution_of(batch, batch.reset())
    points = batch.groups.tool_targets(batch.simulation.block_pose).points[:, 0]
    tool = frame_pose(batch.robot_tables.tool_chain, batch.env_robot_index, q)[:, :3, 3]
    assert (torch.linalg.vector_norm(tool - points, dim=1) < 0.05).all()
