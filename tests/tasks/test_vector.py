"""Vector environments for Gymnasium loops and stable-baselines3."""

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

from morphgen.errors import MissingDependencyError, TaskError
from morphgen.tasks import make_batch
from morphgen.tasks.actions import BINS
from morphgen.tasks.gym.sb3 import sb3_vector
from morphgen.tasks.gym.vector import TaskVector, observation_space
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.task import BOUND, ObservationField

ROBOTS, TASKS = ["arm3-stick", "prims"], ["reach", "push"]
REACH, PUSH = (
    ReachConfig(max_episode_steps=12, num_goals=5),
    PushConfig(max_episode_steps=9, num_goals=5),
)


@pytest.fixture
def batch_from_specs(cache):
    """Create batches of two robots with two tasks, one with obstacles."""
    made = []

    def of(num_envs=4, **options):
        given = {"sim": "mujoco", "configs": (REACH, PUSH), "cache": cache} | options
        made.append(make_batch(TASKS, ROBOTS, num_envs, obstacles=[True, False], **given))
        return made[-1]

    yield of
    for batch in made:
        batch.close()


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
    for k in range(1, REACH.max_episode_steps + 1):
        seen, _, terminated, truncated, infos = envs.step(actions)
        over = np.array([k == REACH.max_episode_steps, k == PUSH.max_episode_steps] * 2)
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
    for _ in range(REACH.max_episode_steps + 1):
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
        REACH.max_episode_steps,
        PUSH.max_episode_steps,
    }
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


def test_stable_baselines3_infos_distinguish_truncation(batch_from_specs):
    envs = sb3_vector(batch_from_specs())
    envs.seed(3)
    first = envs.reset()["goal"]
    assert np.array_equal(first, TaskVector(batch_from_specs(seed=3)).reset()[0]["goal"])
    for _ in range(PUSH.max_episode_steps):
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
        "configs": (PUSH,),
        "cache": cache,
    }
    envs = gym.make_vec("morphgen/Push-v0", num_envs=3, **options)
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
