"""Single environments in NumPy: everything equals the batch's."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.scenes import needs_pybullet
from morphgen.tasks import make_batch
from morphgen.tasks.actions import BINS
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.registry import TASKS

ROUNDING = 1e-5
"""Largest difference of numbers of order one; codes of joint positions have angles up to 200 rad,
which are exact to 1e-5."""
STEPS = 20
OBJECTS = ("drawer", "door", "dial")
ROBOTS = {"reach": "arm=panda ee=panda_hand", "push": "prims"} | dict.fromkeys(
    OBJECTS, "arm3-stick"
)
CONFIGS = {
    "reach": ReachConfig(max_episode_steps=STEPS, num_goals=5, near=0.7),
    "push": PushConfig(max_episode_steps=STEPS, num_goals=5, line=-0.1),
    **{task: TASKS[task].config_type(max_episode_steps=STEPS, num_goals=5) for task in OBJECTS},
}
VELOCITY = ObservationConfig(velocity=True, previous_action=True, tool=True)
KINEMATIC = ("lag", "joint", "poses", "jacobian", "dls", "ik", "tree")
CHANNELS = replace(VELOCITY, points=7, **dict.fromkeys(KINEMATIC, True))


@pytest.fixture
def make(cache, opened):
    """Create an environment and a batch of the same one."""

    def pair(task, robot=None, config=None, **options):
        robot, config = robot or ROBOTS[task], config or CONFIGS[task]
        options = {"sim": "mujoco", "cache": cache} | options
        env = opened(TaskEnv(task, robot, config=config, **options))
        return env, opened(make_batch(task, [robot], 1, configs=(config,), **options))

    return pair


def assert_observation_equals(seen, env, expected):
    assert seen.keys() == env.observation_space.spaces.keys()
    assert env.observation_space.contains(seen)
    for name, values in seen.items():
        batch_values = expected[name][0].numpy()
        if name == "previous_action":
            batch_values = batch_values[list(env.action_links)]
        assert values.shape == env.observation_space[name].shape
        links = len(env.env_spec.robot.links)
        if name in ("tokens", "velocity", *KINEMATIC[:-1]):
            assert not batch_values[links:].any()
            batch_values = batch_values[:links]
        np.testing.assert_allclose(values, batch_values, rtol=1e-5, atol=ROUNDING, err_msg=name)


def assert_step_equals(result, env, step):
    seen, reward, terminated, truncated, info = result
    assert_observation_equals(seen, env, step.final_observation)
    assert reward == pytest.approx(float(step.reward[0]), rel=1e-5, abs=1e-5)
    assert (terminated, truncated) == (bool(step.terminated[0]), bool(step.truncated[0]))
    for name in ("success", "diverged"):
        assert info[name] is bool(getattr(step, name)[0])
    for name in ("distance", "score"):
        assert info[name] == pytest.approx(float(getattr(step, name)[0]), rel=1e-5, abs=1e-5)
    assert info["terms"].keys() == step.terms.keys()
    assert reward == pytest.approx(sum(info["terms"].values()), rel=1e-5, abs=1e-5)
    for name, term in info["terms"].items():
        assert term == pytest.approx(float(step.terms[name][0]), rel=1e-5, abs=1e-5), name
    assert ("angle" in info) == (step.angle is not None)
    if step.angle is not None:
        assert info["angle"] == pytest.approx(float(step.angle[0]), rel=1e-5, abs=1e-5)


def run_both(env, batch, episodes, seed=2):
    """Run episodes of the environment and of the batch; return which terminated and succeeded."""
    rng = np.random.default_rng(seed)
    seen, _ = env.reset(seed=seed)
    assert_observation_equals(seen, env, batch.reset(seed))
    ends, successes = [], 0
    while len(ends) < episodes:
        if env.batch.action_kind == "discrete":
            action = rng.integers(len(BINS), size=env.action_space.shape)
        else:
            action = rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)
        actions = torch.zeros(batch.action_mask.shape, dtype=torch.from_numpy(action).dtype)
        actions[0, list(env.action_links)] = torch.from_numpy(action)
        result, step = env.step(action), batch.step(actions)
        assert_step_equals(result, env, step)
        successes += result[4]["success"]
        if result[2] or result[3]:
            ends.append(result[2])
            seen, _ = env.reset()
            assert_observation_equals(seen, env, step.observation)
        for name in ("targets", "previous_action", "previous_qd", "episode_step"):
            assert torch.equal(getattr(env.batch, name), getattr(batch, name)), name
        assert torch.equal(env.batch.q, batch.q)
    return ends, successes


POSE = ReachConfig(max_episode_steps=STEPS, num_goals=5, goal="pose")


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize(
    ("task", "sim"),
    [
        ("reach", "kinematic"),
        *((task, "mujoco") for task in CONFIGS),
        *(pytest.param(task, "pybullet", marks=needs_pybullet) for task in ("reach", "push")),
    ],
)
def test_steps_equal_those_of_the_batch(make, task, sim, kind):
    obstacles = sim != "kinematic" and kind == "discrete" and task not in OBJECTS
    env, batch = make(task, sim=sim, kind=kind, obstacles=obstacles)
    ends, successes = run_both(env, batch, 4)
    if task == "reach":
        assert ends == [False] * 4
        assert 0 < successes < 4 * STEPS


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("reach", {"robot": "arm=jaco2 ee=stick"}),  # joints without limits
        ("reach", {"robot": "planar-cube"}),  # slides
        ("reach", {"config": POSE}),
        ("reach", {"observe": VELOCITY}),
        ("push", {"observe": ObservationConfig(points=5, state=False), "obstacles": True}),
    ],
)
def test_other_environments_equal_the_batch(make, task, options):
    env, batch = make(task, **options)
    run_both(env, batch, 2)
    assert task == "reach" or not env.reset()[0]["object"].any()


@pytest.mark.parametrize(
    ("task", "number", "beyond", "here"),
    [("push", lambda envs: envs.line, 1.0, -2.0), ("door", lambda e: e.formulas.travel, 0.1, -0.1)],
)
def test_an_object_at_its_goal_terminates_as_in_the_batch(make, task, number, beyond, here):
    env, batch = make(task)
    env.reset(seed=1)
    batch.reset(1)
    action = np.zeros(env.action_space.shape, np.float32)
    for goal, succeeds in ((beyond, False), (here, True)):
        for each in (env.batch, batch):
            number(each.groups[task]).fill_(goal)
        result = env.step(action)
        assert_step_equals(result, env, batch.step(torch.zeros(batch.action_mask.shape)))
        assert result[2] is result[4]["success"] is succeeds


@pytest.mark.parametrize("task", ["reach", "push", "door"])
def test_all_channels_equal_those_of_the_batch(make, task):
    run_both(*make(task, observe=CHANNELS, obstacles=task not in OBJECTS), 1)


def test_divergence_is_undone_as_in_the_batch(make):
    env, batch = make("push")
    env.reset(seed=0)
    batch.reset(0)
    action = np.full(env.action_space.shape, 0.3, np.float32)
    actions = torch.zeros(batch.action_mask.shape)
    actions[0, list(env.action_links)] = 0.3
    assert_step_equals(env.step(action), env, batch.step(actions))
    before = env.batch.q
    for each in (env.batch, batch):
        each.simulation._data[0].qvel[0] = math.nan
    result, step = env.step(action), batch.step(actions)
    assert_step_equals(result, env, step)
    assert result[4]["diverged"]
    assert result[3]
    assert torch.equal(env.batch.q, before)
    assert_observation_equals(env.reset()[0], env, step.observation)


def test_observations_are_the_callers(make):
    env, _ = make("push", obstacles=True)
    seen, _ = env.reset(seed=0)
    first = {name: values.copy() for name, values in seen.items()}
    action = np.ones(env.action_space.shape, np.float32)
    second = env.step(action)[0]
    kept = {name: values.copy() for name, values in second.items()}
    for values in seen.values():
        values[:] = math.nan
    third = env.step(action)[0]
    assert all(np.array_equal(second[name], kept[name]) for name in kept)
    assert all(np.isfinite(values).all() for values in third.values())
    assert all(np.array_equal(env.reset(seed=0)[0][name], first[name]) for name in first)
