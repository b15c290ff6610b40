"""Gymnasium environments and vectors: spaces, seeds, terminations, rendering, checkers, SB3."""

import subprocess
import sys
import warnings
from importlib import import_module

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import morphgen
from morphgen.errors import CompositionError, MissingDependencyError, MorphgenError, TaskError
from morphgen.progress import show_progress
from morphgen.tasks import make_batch
from morphgen.tasks.actions import BINS
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.gym.sb3 import sb3_vector
from morphgen.tasks.gym.vector import TaskVector, observation_space
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.sim.base import Contacts
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation
from morphgen.tasks.task import BOUND, ObservationField

STEPS = 8
REACH, PUSH = (
    ReachConfig(max_episode_steps=STEPS, num_goals=5),
    PushConfig(max_episode_steps=STEPS, num_goals=5),
)


@pytest.fixture
def make(cache, opened):
    def of(name, robot="arm3-stick", **options):
        config = REACH if name == "morphgen/Reach-v0" else PUSH
        given = {"config": config, "sim": "mujoco", "cache": cache} | options
        env = gym.make(name, robot=robot, **given)
        opened(env.unwrapped)
        return env

    return of


@pytest.mark.parametrize(
    "imports",
    [
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


ROBOTS, TASKS = ["arm3-stick", "prims"], ["reach", "push"]
LONG_REACH, LONG_PUSH = (
    ReachConfig(max_episode_steps=12, num_goals=5),
    PushConfig(max_episode_steps=9, num_goals=5),
)


@pytest.fixture
def batch_from_specs(cache, opened):
    """Create batches of two robots with two tasks, one with obstacles."""

    def of(num_envs=4, **options):
        given = {"sim": "mujoco", "configs": (LONG_REACH, LONG_PUSH), "cache": cache} | options
        return opened(make_batch(TASKS, ROBOTS, num_envs, obstacles=[True, False], **given))

    return of


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_spaces_contain_observations_and_actions(batch_from_specs, kind):
    batch = batch_from_specs(kind=kind)
    envs = TaskVector(batch)
    links = int(batch.action_mask.any(dim=0).sum())  # without those that no robot has
    if kind == "discrete":
        assert envs.single_action_space.nvec.tolist() == [len(BINS)] * links
    else:
        assert envs.single_action_space.shape == (links,)
    seen, infos = envs.reset(seed=0)
    assert infos == {}
    assert "obstacles" in seen
    for _ in range(15):
        assert seen in envs.observation_space
        assert {name: v.shape for name, v in seen.items()} == {
            name: (4, *space.shape) for name, space in envs.single_observation_space.items()
        }
        seen, *_ = envs.step(envs.action_space.sample())


def test_autoreset_returns_the_final_observation(batch_from_specs):
    envs = TaskVector(batch_from_specs())
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.reset(seed=0)
    actions = np.full(envs.action_space.shape, 0.3, dtype=np.float32)
    for k in range(1, LONG_REACH.max_episode_steps + 1):
        seen, _, terminated, truncated, infos = envs.step(actions)
        over = np.array([k == LONG_REACH.max_episode_steps, k == LONG_PUSH.max_episode_steps] * 2)
        assert not terminated.any()
        assert np.array_equal(truncated, over)
        assert np.array_equal(infos["_success"], ~over)
        assert ("final_obs" in infos) == over.any()
        if not over.any():
            continue
        assert np.array_equal(infos["_final_obs"], over)
        assert np.array_equal(infos["final_info"]["_score"], over)
        assert np.array_equal(infos["final_info"]["terms"]["_distance"], over)
        for env, final in enumerate(infos["final_obs"]):
            assert (final is not None) == over[env]
            if over[env]:
                assert final in envs.single_observation_space
                assert not np.array_equal(final["tokens"], seen["tokens"][env])


def test_returned_arrays_are_copies(batch_from_specs):
    envs = TaskVector(batch_from_specs())
    kept = []
    seen, _ = envs.reset(seed=0)
    for _ in range(LONG_REACH.max_episode_steps + 1):
        kept.append((seen, {name: values.copy() for name, values in seen.items()}))
        seen, *_ = envs.step(envs.action_space.sample())
    for later, then in kept:
        assert all(np.array_equal(later[name], then[name]) for name in then)
    first, second = (envs.step(envs.action_space.sample())[0] for _ in range(2))
    assert not any(np.shares_memory(first[name], second[name]) for name in first)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_stable_baselines3_ppo_learns(batch_from_specs, kind):
    envs = VecMonitor(sb3_vector(batch_from_specs(kind=kind)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = PPO("MultiInputPolicy", envs, n_steps=24, batch_size=48, n_epochs=1, seed=0)
        before = torch.cat([each.detach().flatten() for each in model.policy.parameters()])
        model.learn(2 * 24 * 4)
    after = torch.cat([each.detach().flatten() for each in model.policy.parameters()])
    assert not torch.equal(before, after)
    assert torch.isfinite(after).all()
    assert model.num_timesteps == 2 * 24 * 4
    assert {episode["l"] for episode in model.ep_info_buffer} == {
        LONG_REACH.max_episode_steps,
        LONG_PUSH.max_episode_steps,
    }
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


def test_stable_baselines3_infos_distinguish_truncation(batch_from_specs):
    envs = sb3_vector(batch_from_specs())
    envs.seed(3)
    first = envs.reset()["goal"]
    assert np.array_equal(first, TaskVector(batch_from_specs(seed=3)).reset()[0]["goal"])
    for _ in range(LONG_PUSH.max_episode_steps):
        seen, _, dones, infos = envs.step(np.zeros((4, 5), dtype=np.float32))
    assert dones.tolist() == [False, True] * 2
    for env, info in enumerate(infos):
        assert {"distance", "score"} <= set(info)
        assert ("terminal_observation" in info) == dones[env]
        if dones[env]:
            assert info["TimeLimit.truncated"] is True
            assert info["is_success"] is False
            assert set(info["terminal_observation"]) == set(seen)


def test_stable_baselines3_can_read_attributes(batch_from_specs):
    envs = sb3_vector(batch_from_specs())
    assert envs.get_attr("num_envs", [0, 2]) == [4, 4]
    assert envs.env_is_wrapped(gym.Wrapper) == [False] * 4
    envs.set_attr("label", "x")
    assert envs.get_attr("label") == ["x"] * 4
    seen, _ = envs.env_method("reset", seed=1)[0]
    assert seen in envs.vector.observation_space
    with pytest.raises(TaskError, match="share their attributes"):
        envs.set_attr("label", "y", indices=0)


def test_missing_stable_baselines3_error_says_what_to_install(batch_from_specs, monkeypatch):
    monkeypatch.delitem(sys.modules, "morphgen.tasks.gym.sb3", raising=False)
    for name in [name for name in sys.modules if name.startswith("stable_baselines3")]:
        monkeypatch.delitem(sys.modules, name)

    class Missing:
        def find_spec(self, name, path=None, target=None):
            if name == "stable_baselines3":
                raise ModuleNotFoundError(name, name=name)

    monkeypatch.setattr(sys, "meta_path", [Missing(), *sys.meta_path])
    with pytest.raises(MissingDependencyError, match="pip install stable-baselines3"):
        import_module("morphgen.tasks.gym.sb3")


def test_gymnasium_makes_vector_envs_of_several_robots(cache):
    options = {
        "robots": ["prims", "arm3-stick"],
        "sim": "mujoco",
        "configs": (LONG_PUSH,),
        "cache": cache,
    }
    reports = []
    with show_progress(lambda *now: reports.append(now)):
        envs = gym.make_vec("morphgen/Push-v0", num_envs=3, **options)
    assert reports == [(0, 2), (1, 2), (2, 2)]
    assert [each.robot.name for each in envs.batch.specs] == ["prims", "arm3-stick"]
    assert envs.reset(seed=0)[0] in envs.observation_space
    envs.close()
    envs.close()
    with pytest.raises(TaskError, match="these environments are closed"):
        envs.step(envs.action_space.sample())
    with pytest.raises(TaskError, match="these environments are closed"):
        envs.reset()


def test_spaces_have_the_bounds_declared_by_the_task():
    values = {"speed": np.zeros((3, 2), np.float32), "goal": np.zeros((3, 7), np.float32)}
    fields = (ObservationField("speed", 2, "speed_mask", low=0.0, high=5.0),)
    space = observation_space(values, fields)
    assert (space["speed"].low.min(), space["speed"].high.max()) == (0.0, 5.0)
    assert (space["goal"].low.min(), space["goal"].high.max()) == (-BOUND, BOUND)
