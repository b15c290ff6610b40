"""Batches of environments in the kinematic simulation, on the CPU and on a GPU."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_spec
from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.rl.baselines import BASELINES
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.device import batch_device
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.registry import SIMULATORS, evaluation_simulator, installed_simulators
from morphgen.tasks.scenes.make import batch_from_specs, make_batch

REVOLUTE, PRISMATIC = "arm=ur5 ee=plane", "prims"
CONFIG = replace(ReachConfig(), num_goals=20)
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.fixture(scope="module")
def specs(tmp_path_factory):
    cache = tmp_path_factory.mktemp("goals")
    return [draw_spec(robot(words), CONFIG, cache=cache) for words in ("arm3", REVOLUTE, PRISMATIC)]


def make_kinematic(specs, num_envs, **options):
    return batch_from_specs(specs, num_envs, sim="kinematic", **options)


def rollout(batch, steps=40):
    """Return all numbers of steps with random actions of each environment, as bytes."""
    n, L = batch.action_mask.shape
    with closing(batch):
        batch.reset()
        actions = 2 * torch.rand(steps, L, generator=torch.Generator().manual_seed(0)) - 1
        results = [batch.step(action.expand(n, L).to(batch.device)) for action in actions]
    keys = sorted(results[0].observation)
    rows = [
        torch.cat(
            [step.reward[:, None], step.q, step.distance[:, None]]
            + [step.observation[key].float().reshape(n, -1) for key in keys],
            dim=1,
        )
        for step in results
    ]
    return torch.stack(rows).cpu().numpy()


def test_batches_reproduce_to_the_byte(specs):
    first = rollout(make_kinematic(specs, 12, seed=3))
    assert first.tobytes() == rollout(make_kinematic(specs, 12, seed=3)).tobytes()
    assert first.tobytes() != rollout(make_kinematic(specs, 12, seed=4)).tobytes()
    part = rollout(make_kinematic(specs, 3, seed=3, first=6))
    assert first[:, 6:9].tobytes() == part.tobytes()


def test_inverse_kinematics_reaches_its_goals(specs):
    with closing(make_kinematic(specs, 12)) as batch:
        episodes = run_episodes(batch, BASELINES["ik"].make(0), 1)
    assert len(episodes) == 12
    assert all(episode.success for episode in episodes)
    assert max(episode.distance for episode in episodes) < 0.01


def test_single_environments_report_no_self_collision(tmp_path):
    config = replace(ReachConfig(), num_goals=2)
    with closing(
        TaskEnv("reach", robot("cubes"), sim="kinematic", config=config, cache=tmp_path)
    ) as env:
        _, info = env.reset(seed=0)
        observation, *_, step_info = env.step(env.action_space.sample())
    assert not info["self_collision"]
    assert not step_info["self_collision"]
    assert observation in env.observation_space


def test_kinematic_is_a_registered_simulator_that_mujoco_judges():
    assert "kinematic" in SIMULATORS.builtin
    assert {"mujoco", "kinematic"} <= set(installed_simulators())
    assert evaluation_simulator("kinematic") == "mujoco"
    for name in {"mujoco", "pybullet"}.intersection(installed_simulators()):
        assert evaluation_simulator(name) == name


def test_batches_with_something_to_touch_are_refused(tmp_path):
    body = robot("prims")
    configs = (replace(PushConfig(), num_goals=2), replace(ReachConfig(), num_goals=2))
    for task, obstacles, thing in (("push", False, "a block"), ("reach", True, "obstacles")):
        with pytest.raises(
            TaskError, match=f"{task} of .* has {thing}; expected simulator .*mujoco"
        ):
            make_batch(
                task,
                [body],
                1,
                obstacles=obstacles,
                sim="kinematic",
                configs=configs,
                cache=tmp_path,
            )


def test_invalid_batch_options_are_rejected(specs):
    with pytest.raises(TaskError, match="2 workers; expected 1"):
        make_kinematic(specs, 3, workers=2)
    with pytest.raises(TaskError, match="unknown device 'tpu'"):
        make_kinematic(specs, 3, device="tpu")


def test_devices_of_batches(specs, monkeypatch):
    assert batch_device("kinematic", "cuda:1") == "cuda:1"
    assert batch_device("mujoco", "cuda") == "cpu"
    if not torch.cuda.is_available():
        with pytest.raises(TaskError, match="this machine has no CUDA device"):
            make_kinematic(specs, 3, device="cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(
        TaskError, match="device 'cuda'; expected device cpu, or simulator warp or k"
    ):
        batch_from_specs(specs, 3, sim="mujoco", device="cuda")


@needs_cuda
def test_cuda_batches_follow_those_of_the_cpu(specs):
    cpu, cuda = (rollout(make_kinematic(specs, 12, device=name)) for name in ("cpu", "cuda"))
    np.testing.assert_allclose(cuda, cpu, atol=1e-3)
    again = rollout(make_kinematic(specs, 12, device="cuda"))
    assert again.tobytes() == cuda.tobytes()


@needs_cuda
def test_inverse_kinematics_reaches_its_goals_on_cuda(specs):
    with closing(make_kinematic(specs, 12, device="cuda")) as batch:
        episodes = run_episodes(batch, BASELINES["ik"].make(0), 1)
    assert all(episode.success for episode in episodes)
