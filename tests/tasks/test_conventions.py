"""Environments as others expect them: wrappers, copies, specs, vectors, options, hindsight."""

import copy
import json
import pickle
import warnings
from contextlib import closing
from functools import partial
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import morphgen
from helpers.simulators import needs_pybullet
from morphgen.errors import MorphgenError, TaskError
from morphgen.tasks.gym.sb3 import SB3Vector
from morphgen.tasks.gym.vector import TaskVector, task_vector
from morphgen.tasks.observation import ObservationConfig, observation_config
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.sim.base import Contacts

REACH, PUSH = "morphgen/Reach-v0", "morphgen/Push-v0"
STEPS = 8
CONFIGS = {
    REACH: ReachConfig(max_episode_steps=STEPS, num_goals=5),
    PUSH: PushConfig(max_episode_steps=STEPS, num_goals=5),
}
POSE = ReachConfig(max_episode_steps=STEPS, num_goals=5, goal="pose")
FRAME = (64, 48)


@pytest.fixture(scope="module", autouse=True)
def goals_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def make(name=REACH, **options):
    given = {"config": CONFIGS[name], "sim": "kinematic" if name == REACH else "mujoco"}
    return gym.make(name, robot="arm3-stick", **given | options)


def make_vec(name=REACH, num_envs=3, **options):
    given = {"robots": ["arm3-stick", "prims"], "config": CONFIGS[name]}
    sim = "kinematic" if name == REACH else "mujoco"
    return gym.make_vec(name, num_envs, **{**given, "sim": sim, **options})


def run(env, episodes=2):
    """Run whole episodes of random actions; every observation must be in the space."""
    with closing(env):
        seen, _ = env.reset(seed=0)
        env.action_space.seed(0)
        done = 0
        for _ in range(200):
            assert seen in env.observation_space
            seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert np.isfinite(np.asarray(reward)).all()
            ended = np.atleast_1d(np.asarray(terminated) | np.asarray(truncated))
            done += bool(ended.any())
            if done == episodes:
                return
            if ended.any() and not isinstance(env.unwrapped, gym.vector.VectorEnv):
                seen, _ = env.reset()
        raise AssertionError("no episode ended")


def normalized(env):
    return wrappers.NormalizeObservation(wrappers.FlattenObservation(env))


WRAPPERS = {
    "AddRenderObservation": wrappers.AddRenderObservation,
    "AddWhiteNoise": lambda env: wrappers.AddWhiteNoise(env, 0.2),
    "Autoreset": wrappers.Autoreset,
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 3, multidiscrete=True),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "NormalizeObservation": normalized,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(0), np.float32(1)),
    "RenderCollection": wrappers.RenderCollection,
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 5),
}
"""Wrappers that look at spaces, pictures, copies or the ends of episodes."""
OF_VECTORS = {
    "ClipReward": lambda envs: vector.ClipReward(envs, -1, 1),
    "DictInfoToList": vector.DictInfoToList,
    "NormalizeObservation": lambda e: vector.NormalizeObservation(vector.FlattenObservation(e)),
    "NormalizeReward": vector.NormalizeReward,
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "VectorizeTransformAction": lambda envs: vector.VectorizeTransformAction(
        envs, wrappers.TransformAction, func=lambda a: -a, action_space=envs.single_action_space
    ),
}


@pytest.mark.filterwarnings("ignore")  # Gymnasium's, of shapes and of arrays that it converts
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrapper(name):
    run(WRAPPERS[name](make(render_mode="rgb_array", size=FRAME)))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
@pytest.mark.parametrize("name", OF_VECTORS)
def test_vector_wrapper(name, mode):
    envs = make_vec(autoreset_mode=mode)
    if mode == "SameStep" and name == "NormalizeObservation":
        with closing(envs), pytest.raises(ValueError, match="Expected autoreset_mode to be NEXT"):
            OF_VECTORS[name](envs)  # Gymnasium has it for the other mode alone
    else:
        run(OF_VECTORS[name](envs))


CHANNELS = ObservationConfig(velocity=True, previous_action=True, points=5, ik=True, tool=True)
COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
}
KINDS = {
    "kinematic": make,
    "mujoco": partial(make, sim="mujoco", obstacles=True),
    "push": partial(make, PUSH, observe=CHANNELS),
    "discrete": partial(make, PUSH, kind="discrete"),
    "pose": partial(make, config=POSE, sim="mujoco"),  # steps in torch
    "goals": partial(make, PUSH, goal_env=True),
    "vector": partial(make_vec, seed=2),
    "vector of push": partial(make_vec, PUSH, seed=2, autoreset_mode="NextStep"),
}


def rows(env, steps=2 * STEPS):
    """Return all numbers of some steps, of several episodes."""
    numbers = []
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        if not isinstance(env.unwrapped, TaskVector) and (terminated or truncated):
            seen, _ = env.reset()
        numbers += [*(values.ravel() for values in seen.values()), np.ravel(reward)]
    return np.concatenate(numbers)


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("steps", [0, 3, STEPS])
def test_a_copy_goes_on_as_the_original(kind, how, steps):
    env = KINDS[kind]()
    env.reset(seed=3)
    env.action_space.seed(0)
    is_vector = isinstance(env.unwrapped, TaskVector)
    for k in range(steps):
        ended = np.any(env.step(env.action_space.sample())[2:4])
        if ended and k < steps - 1 and not is_vector:
            env.reset()
    copied = COPIES[how](env)
    if steps == STEPS:
        env.reset(), copied.reset()
    expected = rows(env)
    assert np.array_equal(rows(copied), expected)  # although the original has moved on
    assert len(np.unique(expected)) > 100
    copied.close()
    env.reset(seed=1)  # the original is not closed with its copy
    env.close()


@needs_pybullet
@pytest.mark.parametrize("how", COPIES)
def test_copies_are_refused_where_the_state_is_elsewhere(how):
    env = make(sim="pybullet")
    env.reset(seed=0)
    with pytest.raises(TaskError, match="a BulletSimulation cannot be copied: make another"):
        COPIES[how](env)
    env.step(env.action_space.sample())
    env.close()
    with pytest.raises(TaskError, match="this environment is closed"):
        COPIES[how](env)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"kind": "discrete", "obstacles": True, "sim": "mujoco"},
        {"render_mode": "rgb_array", "size": FRAME, "goal_env": True},
        {"observe": {"velocity": True}, "config": {"max_episode_steps": 5}},
        {"contacts": {"scene": False, "self_collision": False}, "layouts": "eval", "max_links": 40},
        {"observe": observation_config(["jacobian"]), "contacts": Contacts(), "cache": Path("c")},
    ],
)
@pytest.mark.parametrize("name", [REACH, PUSH])
def test_checkers_accept_every_option(name, options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"sim": "mujoco"} | options
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = make(name, **options)
        check_env(env.unwrapped, skip_render_check=True)
        check_for_sb3(env.unwrapped, skip_render_check=True)
    if "goal_env" not in options:
        with warnings.catch_warnings():  # flattened, there is nothing to warn of
            warnings.simplefilter("error")
            check_for_sb3(wrappers.FlattenObservation(make(name, **options)))
    said = {str(each.message).partition(":")[0] for each in caught}
    assert all("unconventional shape" in text for text in said), said
    assert json.loads(env.spec.to_json())["kwargs"]["robot"] == "arm3-stick"
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    assert again.unwrapped.env_spec.config == env.unwrapped.env_spec.config
    assert np.array_equal(*(rows_of_seed(each) for each in (env, again)))


def rows_of_seed(env):
    with closing(env):
        env.reset(seed=5)
        env.action_space.seed(5)
        return rows(env)


def test_the_spec_of_a_robot_without_a_name_is_json(tmp_path):
    robot = morphgen.compose("arm3-stick")
    with closing(gym.make(REACH, robot=robot, config=CONFIGS[REACH])) as env:
        text = env.spec.to_json()
        assert gym.make(env.spec).unwrapped.env_spec.robot.name == robot.name
    with pytest.raises(MorphgenError, match="<Robot"):
        gym.make(EnvSpec.from_json(text))
    options = {"config": {"max_episode_steps": 5}, "observe": {"velocity": True}}
    with closing(make_vec(**options)) as envs:
        spec = EnvSpec.from_json(envs.spec.to_json())
        with closing(gym.make_vec(spec)) as again:
            assert again.observation_space == envs.observation_space
            assert again.max_episode_steps == envs.max_episode_steps == 5
    with closing(make_vec(robots=[robot], num_envs=2)) as envs:
        assert "<Robot" in envs.spec.to_json()


@pytest.mark.parametrize(("name", "config"), [(REACH, None), (PUSH, None), (REACH, POSE)])
def test_time_limit(name, config):
    config = config or CONFIGS[name]
    with closing(make(name, config=config)) as env:
        assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == STEPS
    with closing(make(name, config=config, max_episode_steps=3)) as env:
        assert env.spec.max_episode_steps == 3
        env.reset(seed=0)
        ends = [env.step(np.zeros(env.action_space.shape, np.float32))[3] for _ in range(3)]
        assert ends == [False, False, True]
    with closing(make(name, config=config, max_episode_steps=STEPS)):
        pass
    sync = partial(gym.make_vec, vectorization_mode="sync", robot="arm3-stick")
    for make_any in (make, make_vec, sync):
        options = {"config": config, "max_episode_steps": STEPS + 1}
        with pytest.raises(TaskError, match=f"max_episode_steps {STEPS + 1}: episodes end after"):
            make_any(name, **options)
    with closing(make_vec(name, config=config, max_episode_steps=2)) as envs:
        assert (envs.max_episode_steps, envs.spec.max_episode_steps) == (2, 2)
        envs.reset(seed=0)
        zero = np.zeros(envs.action_space.shape, np.float32)
        assert not envs.step(zero)[3].any()
        assert envs.step(zero)[3].all()


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_vectors(context):
    run(AsyncVectorEnv([partial(make, PUSH)] * 2, context=context))


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
@pytest.mark.parametrize("name", [REACH, PUSH])
def test_vectors_equal_those_of_gymnasium(name, mode):
    """With the same seeds, both modes give what single environments in a SyncVectorEnv do."""
    options = {"robots": ["arm3-stick"], "num_envs": 3, "autoreset_mode": mode}
    ours = make_vec(name, **options)
    sync = SyncVectorEnv([partial(make, name)] * 3, autoreset_mode=mode)
    assert ours.autoreset_mode == sync.autoreset_mode == ours.metadata["autoreset_mode"]
    assert ours.action_space == sync.action_space
    with closing(ours), closing(sync):
        seen, _ = ours.reset(seed=[7, 8, 2**40])
        expected, _ = sync.reset(seed=[7, 8, 2**40])
        ours.action_space.seed(1)
        for _ in range(3 * STEPS):
            for key in expected:
                links = expected[key].shape[1]
                assert seen[key][:, :links] == pytest.approx(expected[key], abs=1e-5), key
            actions = ours.action_space.sample()
            seen, *results, infos = ours.step(actions)
            expected, *wanted, sync_infos = sync.step(actions)
            for result, want in zip(results, wanted, strict=True):
                assert result == pytest.approx(want, abs=1e-5)
            for where in (lambda i: i, lambda i: i.get("final_info", {})):
                if "is_success" in where(sync_infos):
                    for key in ("is_success", "_is_success"):
                        assert np.array_equal(where(infos)[key], where(sync_infos)[key])
                    held = where(infos)["_distance"]
                    assert where(infos)["distance"][held] == pytest.approx(
                        where(sync_infos)["distance"][held], abs=1e-5
                    )


def test_vectors_begin_at_random_unless_they_have_a_seed():
    goals = set()
    for _ in range(5):
        with closing(make_vec(robots=["arm3-stick"], num_envs=2)) as envs:
            goals.add(envs.reset()[0]["tokens"].tobytes())
    assert len(goals) > 1
    with closing(make_vec(seed=4)) as first, closing(make_vec(seed=4)) as second:
        assert np.array_equal(first.reset()[0]["tokens"], second.reset()[0]["tokens"])
        first.reset(seed=[3, None, 5])
        with pytest.raises(TaskError, match="2 seeds for 3 environments"):
            first.reset(seed=[1, 2])
        with pytest.raises(TaskError, match="seed -1"):
            first.reset(seed=[1, 2, -1])
        with pytest.raises(TaskError, match="no episode is running; call reset"):
            first.step(first.action_space.sample())


@pytest.mark.parametrize("robots", [["arm3-stick"], ["prims", "arm3-stick"], ["ur5-stick"]])
def test_vectors_have_no_columns_of_joints_that_no_robot_has(robots):
    with closing(make_vec(PUSH, robots=robots, num_envs=2, observe=CHANNELS)) as envs:
        seen, _ = envs.reset(seed=0)
        assert seen["actions"].any(axis=0).all()
        assert seen["links"].any(axis=0).all()
        assert seen["tokens"].shape[:2] == seen["links"].shape == seen["velocity"].shape
        assert envs.action_space.shape == seen["actions"].shape == seen["previous_action"].shape
        assert envs.action_space.shape[1] == max(int(mask.sum()) for mask in envs.batch.action_mask)
        with pytest.raises(TaskError, match=r"the actions have shape \(2, 23\)"):
            envs.step(np.zeros((2, 23), np.float32))


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_vectors_render(mode):
    envs = make_vec(autoreset_mode=mode, render_mode="rgb_array", size=FRAME)
    with closing(envs):
        envs.reset(seed=0)
        last = envs.render()
        assert [frame.shape for frame in last] == [(48, 64, 3)] * 3
        zero = np.zeros(envs.action_space.shape, np.float32)
        for _ in range(STEPS):
            envs.step(zero)
        same = [np.array_equal(*frames) for frames in zip(last, envs.render(), strict=True)]
        assert all(same) == (mode == "NextStep")  # the end of the episode, or the next one's start


def option(env, name):
    goals = env.unwrapped.env_spec.goals
    return {"q": goals.q[3], "goal": getattr(goals, "poses", goals.q)[2]} | (
        {"block": goals.blocks[3]} if name == PUSH else {}
    )


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        (REACH, ["q"]),
        (REACH, ["goal"]),
        (REACH, ["goal", "q"]),
        (PUSH, ["q", "block"]),
        (PUSH, ["block"]),
    ],
)
def test_options_begin_an_episode_there(name, keys):
    with closing(make(name)) as env:
        options = {key: option(env, name)[key] for key in keys}
        seen, _ = env.reset(seed=1, options=options)
        batch, field = env.unwrapped.batch, {"goal": "goal", "block": "object"}
        if "q" in keys:
            assert batch.q[0].numpy() == pytest.approx(options["q"], abs=1e-6)
        for key in {*keys} - {"q"}:
            assert seen[field[key]][:7] == pytest.approx(options[key], abs=1e-6)
            position = options[key][:3].tolist()
            seen, _ = env.reset(options={key: position})
            assert seen[field[key]][:3] == pytest.approx(position, abs=1e-6)
        after = [env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(2)]
        assert all(np.isfinite(reward) for _, reward, *_ in after)
        seen, _ = env.reset(seed=1)  # without options the episodes are as before
        fresh = make(name)
        assert np.array_equal(seen["tokens"], fresh.reset(seed=1)[0]["tokens"])
        fresh.close()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (REACH, {"gaol": [0, 0, 1]}, "unknown option 'gaol' of reach; did you mean 'goal'"),
        (PUSH, {"blok": [0, 0, 1]}, "did you mean 'block'"),
        (REACH, {3: 4}, "unknown option 3"),
        (REACH, [1], "expected a dictionary"),
        (REACH, {"q": [0.0] * 4}, r"has shape \(4,\); expected \(5,\)"),
        (REACH, {"q": [np.nan] * 5}, "expected finite numbers"),
        (REACH, {"q": [9.0] * 5}, r"joint 'arm_base' is at 9, outside \(0, 3.14159\)"),
        (REACH, {"q": "home"}, "option 'q' 'home': expected numbers"),
        (REACH, {"q": [1.5, -1.5, 1.6, 3.1, 0.0]}, "collides|outside"),
        (REACH, {"goal": [9, 9, 9]}, "no configuration that is free of collisions"),
        (REACH, {"goal": [0.3, 0, 0.3, 5, 0, 0, 0]}, "quaternion"),
        (REACH, {"goal": [1, 2]}, r"has shape \(2,\); expected \(3,\) or \(7,\)"),
        (PUSH, {"block": [0.4, -0.2, 5]}, "stands upright on the ground"),
        (PUSH, {"block": [9, -0.2, 0.1]}, "upright|no configuration"),
        (PUSH, {"block": [0.4, np.inf, 0.1]}, "expected finite numbers"),
    ],
)
def test_options_that_cannot_be_met_are_refused(name, options, message):
    with closing(make(name)) as env:
        env.reset(seed=2)
        with pytest.raises(TaskError, match=message) as caught:
            env.reset(seed=1, options=options)
        assert "\n" not in str(caught.value)
        with pytest.raises(TaskError, match="no episode is running"):
            env.step(env.action_space.sample())
        env.reset(seed=2)
    with closing(make_vec(name)) as envs:
        envs.reset(seed=0)
        with pytest.raises(TaskError):
            envs.reset(options=options)


def test_options_of_a_vector_are_for_all_or_each():
    with closing(make_vec(robots=["arm3-stick"])) as envs:
        goals = envs.batch.specs[0].goals.poses
        seen, _ = envs.reset(seed=0, options={"goal": goals[1]})
        assert seen["goal"] == pytest.approx(np.tile(goals[1], (3, 1)), abs=1e-6)
        seen, _ = envs.reset(seed=0, options={"goal": goals[:3], "q": envs.batch.q.tolist()})
        assert seen["goal"] == pytest.approx(goals[:3], abs=1e-6)


def test_a_goal_that_is_a_pose_needs_the_orientation():
    with closing(make(config=POSE)) as env:
        pose = env.unwrapped.env_spec.goals.poses[1]
        seen, _ = env.reset(seed=0, options={"goal": pose})
        assert seen["goal"] == pytest.approx(pose, abs=1e-6)
        with pytest.raises(TaskError, match=r"a goal that is a pose needs \(7,\)"):
            env.reset(options={"goal": pose[:3]})


@pytest.mark.parametrize(
    ("name", "config", "terms"),
    [
        (REACH, None, ("distance", "near")),
        (REACH, POSE, ("distance", "near", "rotation")),
        (PUSH, None, ("distance", "success")),
    ],
)
def test_goal_environments(name, config, terms):
    env = make(name, config=config or CONFIGS[name], goal_env=True, sim="mujoco")
    with closing(env):
        assert set(env.observation_space) == {"achieved_goal", "desired_goal", "observation"}
        compute_reward = env.get_wrapper_attr("compute_reward")
        achieved, desired, rewards = [], [], []
        env.reset(seed=0)
        for _ in range(2 * STEPS):
            seen, reward, _, over, info = env.step(env.action_space.sample())
            assert reward == float(
                compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
            )
            assert reward == pytest.approx(sum(info["terms"][term] for term in terms), abs=1e-5)
            achieved.append(seen["achieved_goal"])
            desired.append(seen["desired_goal"])
            rewards.append(reward)
            if over:
                env.reset()
        rows = compute_reward(np.array(achieved), np.array(desired), [{}] * len(rewards))
        assert rows.shape == (2 * STEPS,)
        assert rows == pytest.approx(rewards)
        hindsight = compute_reward(np.array(achieved), np.array(achieved), {})
        assert (hindsight >= rows).all()
        with pytest.raises(TaskError, match="goals of shapes"):
            compute_reward(np.zeros(2), np.zeros(9), {})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: task_vector(1, task="reach", robto="x"), "'robto'; did you mean 'robot"),
        (lambda: make_vec(goal_env=True), "unknown option 'goal_env'"),
        (lambda: make_vec(render_mode="rgb"), "did you mean 'rgb_array'"),
        (lambda: make_vec(autoreset_mode="same"), "same: expected SAME_STEP or NEXT_STEP"),
        (lambda: SB3Vector(make_vec(autoreset_mode="NextStep")), "needs a vector with autoreset_"),
        (lambda: make_vec(size=4), r"size 4: expected width and height \[pixels\]"),
        (lambda: make(observe={"velocty": True}), r"observe \{'velocty': True\}"),
        (lambda: make(config=CONFIGS[PUSH]), "PushConfig is not the config of reach"),
    ],
)
def test_invalid_arguments_are_refused(call, message):
    with pytest.raises(TaskError, match=message):
        call()


def test_goal_environments_compute_rewards_of_other_goals():
    with closing(make()) as env:
        assert not env.has_wrapper_attr("compute_reward")
        assert isinstance(env.observation_space["goal"], Box)


@pytest.mark.parametrize("kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)])
def test_vectors_of_stable_baselines3(kind):
    options = {"robot": "arm3-stick", "config": CONFIGS[REACH], "sim": "kinematic"}
    vec = make_vec_env(
        f"morphgen.tasks.gym.env:{REACH}", n_envs=2, seed=1, env_kwargs=options, vec_env_cls=kind
    )
    vec.reset()
    for _ in range(STEPS):
        _, _, dones, infos = vec.step(np.zeros((2, *vec.action_space.shape), np.float32))
    assert dones.all()
    assert all(info["is_success"] == info["success"] for info in infos)
    vec.close()
