"""Single-robot Gymnasium environments: spaces, seeds, terminations, rendering and checkers."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch

import morphgen
from morphgen.errors import CompositionError, MorphgenError, TaskError
from morphgen.tasks.actions import BINS
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.sim.base import Contacts
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

STEPS = 8
REACH, PUSH = (
    ReachConfig(max_episode_steps=STEPS, num_goals=5),
    PushConfig(max_episode_steps=STEPS, num_goals=5),
)


@pytest.fixture
def make(cache):
    """Create environments and close them after the test."""
    envs = []

    def of(name, robot="arm3-stick", **options):
        config = REACH if name == "morphgen/Reach-v0" else PUSH
        given = {"config": config, "sim": "mujoco", "cache": cache} | options
        envs.append(gym.make(name, robot=robot, **given))
        return envs[-1]

    yield of
    for env in envs:
        env.unwrapped.close()


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, morphgen",
        "import gymnasium, morphgen.tasks",
        "import morphgen, gymnasium, morphgen.tasks",
        "import morphgen.tasks, gymnasium, morphgen.tasks.gym.env",
    ],
)
def test_ids_are_registered_after_importing_gymnasium_and_tasks(imports):
    code = (
        f"{imports}\n"
        "assert gymnasium.spec('morphgen/Reach-v0').entry_point\n"
        "assert gymnasium.spec('morphgen/Push-v0').entry_point\n"
        "from morphgen.tasks.registry import register_gym_envs; register_gym_envs()\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_importing_tasks_loads_no_heavy_packages():
    code = (
        "import sys; import morphgen.tasks\n"
        "assert not {'gymnasium', 'numpy', 'torch'} & set(sys.modules), 'loaded'\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_push_observation_has_block_line_and_obstacles(make):
    channels = ObservationConfig(velocity=True, previous_action=True, points=12)
    env = make("morphgen/Push-v0", "prims", obstacles=True, observe=channels, kind="discrete")
    links, joints = len(env.unwrapped.env_spec.robot.links), len(env.unwrapped.action_joints)
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        "tokens": (links, 48),
        "object": (13,),
        "line": (1,),
        "obstacles": (PUSH.obstacles, 13),
        "velocity": (links,),
        "previous_action": (joints,),
        "points": (12, 3),
    }
    assert env.action_space.nvec.tolist() == [len(BINS)] * joints


def test_action_moves_its_own_joint(make):
    env = make("morphgen/Reach-v0", observe=ObservationConfig(previous_action=True)).unwrapped
    for k, name in enumerate(env.action_joints):
        env.reset(seed=0)
        before = env.batch.targets.clone()
        action = np.zeros(len(env.action_joints), dtype=np.float32)
        action[k] = 0.5 if before[0, k] < env.batch.robot_tables.home[0, k] else -0.5
        seen, *_ = env.step(action)
        moved = torch.nonzero(env.batch.targets[0] != before[0])[:, 0].tolist()
        robot = env.env_spec.robot
        assert [robot.joints[robot.independent_joints[j]].name for j in moved] == [name]
        assert seen["previous_action"].tolist() == action.tolist()


def test_unseeded_resets_continue_the_random_sequence(make):
    env = make("morphgen/Reach-v0")
    goals = [tuple(env.reset(seed=1)[0]["goal"])]
    goals += [tuple(env.reset()[0]["goal"]) for _ in range(7)]
    assert len(set(goals)) > 1
    again = [tuple(env.reset(seed=1)[0]["goal"])]
    assert again + [tuple(env.reset()[0]["goal"]) for _ in range(7)] == goals
    starts = {tuple(make("morphgen/Reach-v0").reset()[0]["tokens"].ravel()) for _ in range(6)}
    assert len(starts) > 1


def test_robot_above_the_default_max_links_needs_the_option(make):
    body = morphgen.compose("chain beads=7", geometry="primitive")
    with pytest.raises(MorphgenError, match="max_links 25 or more"):
        make("morphgen/Reach-v0", robot=body, max_links=24)
    assert make("morphgen/Reach-v0", robot=body, max_links=25).reset(seed=0)
    for robot, links, numbered in ((body, 25, 25), ("arm3-stick", 7, 23)):
        seen, _ = make("morphgen/Reach-v0", robot=robot).reset(seed=0)
        assert seen["tokens"][:, 0] * (numbered - 1) == pytest.approx(range(links))


def test_last_observation_of_an_episode_is_returned(make):
    env = make("morphgen/Push-v0", "prims", observe=ObservationConfig(velocity=True)).unwrapped
    env.reset(seed=0)
    for k in range(STEPS):
        seen, _, terminated, truncated, info = env.step(np.ones(5, dtype=np.float32))
        assert (terminated, truncated) == (False, k == STEPS - 1)
    assert np.abs(seen["velocity"]).max() > 0
    names = {"success", "is_success", "distance", "score", "diverged", "terms", "self_collision"}
    assert set(info) == names
    assert info["terms"]["distance"] == pytest.approx(-info["distance"])
    with pytest.raises(TaskError, match="no episode is running; call reset"):
        env.step(np.ones(5, dtype=np.float32))


@pytest.mark.parametrize(
    "options", [{"contacts": Contacts(self_collision=False)}, {"sim": "kinematic"}]
)
def test_info_describes_the_contact_settings(make, options):
    env = make("morphgen/Reach-v0", **options)
    assert env.reset(seed=0)[1] == {"self_collision": False}
    assert env.step(env.action_space.sample())[4]["self_collision"] is False


@pytest.mark.parametrize(
    ("name", "robot"), [("morphgen/Reach-v0", "arm3-stick"), ("morphgen/Push-v0", "prims")]
)
def test_last_state_of_an_episode_can_be_rendered(make, name, robot):
    """The batch itself has already started the next episode."""
    env = make(name, robot, render_mode="rgb_array", size=(160, 120)).unwrapped
    env.reset(seed=3)
    with pytest.warns(UserWarning, match="render_mode"):
        assert make(name, robot).unwrapped.render() is None
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    frames = [env.render()]
    for _ in range(STEPS):
        env.step(action)
        frames.append(env.render())
    still = np.abs(frames[-1].astype(int) - frames[-2]).mean()
    env.reset()
    moved = np.abs(env.render().astype(int) - frames[-1]).mean()
    assert still < moved / 5


def test_closed_environment_raises_a_clear_error(make):
    env = make("morphgen/Reach-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    env.render()
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.step(np.zeros(5, dtype=np.float32))):
        with pytest.raises(TaskError, match="this environment is closed"):
            use()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(23, dtype=np.float32), r"shape \(23,\); expected \(5,\): arm_base, arm_shoulder"),
        (np.float32(0), r"shape \(\); expected \(5,\)"),
        (np.full(5, np.nan, dtype=np.float32), "not finite"),
    ],
)
def test_invalid_actions_are_rejected(make, action, message):
    env = make("morphgen/Reach-v0").unwrapped
    env.reset(seed=0)
    with pytest.raises(TaskError, match=message):
        env.step(action)


@pytest.mark.parametrize(
    ("task", "options", "error", "message"),
    [
        ("raech", {}, TaskError, "unknown task 'raech'; did you mean 'reach'"),
        ("reach", {"robot": "ur5-plain"}, CompositionError, "did you mean 'plane'"),
        ("reach", {"sim": "bullet"}, TaskError, "did you mean 'pybullet'"),
        ("reach", {"kind": "discreet"}, TaskError, "did you mean 'discrete'"),
    ],
)
def test_invalid_options_are_rejected(task, options, error, message, cache):
    config = REACH if task == "reach" else PUSH
    given = {"robot": "arm3-stick", "config": config, "cache": cache} | options
    with pytest.raises(error, match=message):
        TaskEnv(task, **given)


def test_mujoco_is_the_default_whatever_is_installed(make):
    assert isinstance(
        make("morphgen/Reach-v0", sim=None).unwrapped.batch.simulation, MujocoSimulation
    )
