"""Environments as Gymnasium and Stable-Baselines3 expect them: spaces, seeds, ends, vectors."""

import copy
import subprocess
import sys
import warnings
from contextlib import closing
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

import morphgen
from morphgen.errors import CompositionError, MorphgenError, TaskError
from morphgen.progress import show_progress
from morphgen.tasks import make_batch
from morphgen.tasks.actions import BINS
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.gym.sb3 import SB3Vector
from morphgen.tasks.gym.vector import TaskVector, task_vector
from morphgen.tasks.observation import ObservationConfig, observation_config
from morphgen.tasks.sim.base import Contacts
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

REACH, PUSH = "morphgen/Reach-v0", "morphgen/Push-v0"
STEPS = 8
CONFIGS = {
    REACH: ReachConfig(max_episode_steps=STEPS, num_goals=5),
    PUSH: PushConfig(max_episode_steps=STEPS, num_goals=5),
}
POSE = ReachConfig(max_episode_steps=STEPS, num_goals=5, goal="pose")
FRAME = (64, 48)


pytestmark = pytest.mark.usefixtures("module_cache")


def make(name=REACH, **options):
    sim = "kinematic" if name == REACH else "mujoco"
    return gym.make(name, **{"robot": "arm3-stick", "config": CONFIGS[name], "sim": sim} | options)


def make_vec(name=REACH, num_envs=3, **options):
    given = {"robots": ["arm3-stick", "prims"], "config": CONFIGS[name]}
    sim = "kinematic" if name == REACH else "mujoco"
    return gym.make_vec(name, num_envs, **given | {"sim": sim} | options)


def run(env, episodes=2):
    """Run whole episodes of random actions; every observation must be in the space."""
    with closing(env):
        seen, _ = env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(200):
            assert seen in env.observation_space
            seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert np.isfinite(np.asarray(reward)).all()
            ended = np.any(terminated | truncated)
            episodes -= bool(ended)
            if not episodes:
                return
            if ended and not isinstance(env.unwrapped, gym.vector.VectorEnv):
                seen, _ = env.reset()
        raise AssertionError("no episode ended")


WRAPPERS = {
    "AddRenderObservation": wrappers.AddRenderObservation,
    "Autoreset": wrappers.Autoreset,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(0), np.float32(1)),
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 5),
}
"""Wrappers that look at spaces, pictures, copies or the ends of episodes."""
OF_VECTORS = {
    "ClipReward": lambda envs: vector.ClipReward(envs, -1, 1),
    "DictInfoToList": vector.DictInfoToList,
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
@pytest.mark.parametrize("name", OF_VECTORS)
def test_vector_wrapper(name):
    run(OF_VECTORS[name](make_vec()))


def rows(env, steps=2 * STEPS):
    """Return all numbers of some steps, of several episodes."""
    numbers = []
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        if not isinstance(env.unwrapped, TaskVector) and (terminated or truncated):
            seen, _ = env.reset()
        numbers += [*(values.ravel() for values in seen.values()), np.ravel(reward)]
    return np.concatenate(numbers)


@pytest.mark.parametrize("make_any", [make, make_vec])
def test_copies_are_refused(make_any):
    with closing(make_any()) as env, pytest.raises(TaskError, match="cannot be copied"):
        copy.deepcopy(env)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"kind": "discrete", "obstacles": True, "sim": "mujoco"},
        {"render_mode": "rgb_array", "size": FRAME},
        {"contacts": Contacts(False, False), "layouts": "eval", "max_links": 40},
        {"observe": ObservationConfig(velocity=True), "config": {"max_episode_steps": 5}},
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
    with warnings.catch_warnings():  # flattened, there is nothing to warn of
        warnings.simplefilter("error")
        check_for_sb3(wrappers.FlattenObservation(make(name, **options)))
    said = {str(each.message).partition(":")[0] for each in caught}
    assert all("unconventional shape" in text for text in said), said
    again = gym.make(env.spec)
    assert again.observation_space == env.observation_space
    assert again.unwrapped.env_spec.config == env.unwrapped.env_spec.config
    assert np.array_equal(*(rows_of_seed(each) for each in (env, again)))


def rows_of_seed(env):
    with closing(env):
        env.reset(seed=5)
        env.action_space.seed(5)
        return rows(env)


@pytest.mark.parametrize(("name", "config"), [(REACH, None), (PUSH, None), (REACH, POSE)])
def test_time_limit(name, config):
    given = {"config": config or CONFIGS[name]}
    with closing(make(name, **given)) as env:
        assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == STEPS
    with closing(make(name, **given, max_episode_steps=3)) as env:
        assert env.spec.max_episode_steps == 3
        env.reset(seed=0)
        ends = [env.step(np.zeros(env.action_space.shape, np.float32))[3] for _ in range(3)]
        assert ends == [False, False, True]
    make(name, **given, max_episode_steps=STEPS).close()
    sync = partial(gym.make_vec, vectorization_mode="sync", robot="arm3-stick")
    for make_any in (make, sync):
        with pytest.raises(TaskError, match=f"max_episode_steps {STEPS + 1}: episodes end after"):
            make_any(name, **given, max_episode_steps=STEPS + 1)
    with closing(make_vec(name, **given)) as envs:
        assert envs.max_episode_steps == envs.spec.max_episode_steps == STEPS
    with pytest.raises(TaskError, match="unknown option 'max_episode_steps'"):
        make_vec(name, **given, max_episode_steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_vectors(context):
    run(AsyncVectorEnv([partial(make, PUSH)] * 2, context=context))


@pytest.mark.parametrize("name", [REACH, PUSH])
def test_vectors_equal_those_of_gymnasium(name):
    """With the same seeds they give what single environments in a SyncVectorEnv do."""
    ours = make_vec(name, robots=["arm3-stick"])
    sync = SyncVectorEnv([partial(make, name)] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.metadata["autoreset_mode"] == sync.metadata["autoreset_mode"]
    assert ours.action_space == sync.action_space
    with closing(ours), closing(sync):
        seen, expected = (each.reset(seed=[7, 8, 2**40])[0] for each in (ours, sync))
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
            for part in (lambda info: info, lambda info: info.get("final_info", {})):
                info, want = part(infos), part(sync_infos)
                if "is_success" in want:
                    assert np.array_equal(info["is_success"], want["is_success"])
                    held = want["_is_success"]
                    assert np.array_equal(info["_is_success"], held)
                    distance = pytest.approx(want["distance"][held], abs=1e-5)
                    assert info["distance"][held] == distance


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
    observe = ObservationConfig(velocity=True, previous_action=True)
    with closing(make_vec(PUSH, robots=robots, num_envs=2, observe=observe)) as envs:
        seen, _ = envs.reset(seed=0)
        assert seen["actions"].any(axis=0).all()
        assert seen["links"].any(axis=0).all()
        assert seen["tokens"].shape[:2] == seen["links"].shape == seen["velocity"].shape
        assert envs.action_space.shape == seen["actions"].shape == seen["previous_action"].shape
        assert envs.action_space.shape[1] == max(int(mask.sum()) for mask in envs.batch.action_mask)
        with pytest.raises(TaskError, match=r"the actions have shape \(2, 23\)"):
            envs.step(np.zeros((2, 23), np.float32))


def test_options_of_reset_are_refused():
    for env in (make(), make_vec()):
        with closing(env):
            env.reset(seed=0, options={})
            with pytest.raises(TaskError, match=r"options {'goal': 1}: expected none"):
                env.reset(options={"goal": 1})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: task_vector(1, task="reach", size=4), "'size'; .*: cache, .*robot, seed, sim, w"),
        (lambda: make(render_mode="rgb"), "'rgb'; expected rgb_array"),
        (lambda: make(size=4), r"size 4: expected width and height \[pixels\]"),
        (lambda: make(observe={"velocity": True}), "'velocity': True}: expected an ObservationCo"),
        (lambda: make(contacts={"scene": False}), "contacts {'scene': False}: expected Contacts"),
        (lambda: make(config={"gaol": "pose"}), "config {'gaol': 'pose'}: .*'gaol'"),
        (lambda: make(config=CONFIGS[PUSH]), "PushConfig is not the config of reach"),
        (lambda: make(robot="ur5-plain"), "did you mean 'plane'"),
        (lambda: make(sim="bullet"), "did you mean 'pybullet'"),
        (lambda: make(kind="discreet"), "did you mean 'discrete'"),
        (lambda: TaskEnv("raech", "prims"), "unknown task 'raech'; did you mean 'reach'"),
    ],
)
def test_invalid_arguments_are_refused(call, message):
    with pytest.raises((TaskError, CompositionError), match=message):
        call()


@pytest.mark.parametrize("kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)])
def test_vectors_of_stable_baselines3(kind):
    options = {"robot": "arm3-stick", "config": CONFIGS[REACH], "sim": "kinematic"}
    name = f"morphgen.tasks.gym.env:{REACH}"
    vec = make_vec_env(name, n_envs=2, seed=1, env_kwargs=options, vec_env_cls=kind)
    vec.reset()
    for _ in range(STEPS):
        _, _, dones, infos = vec.step(np.zeros((2, *vec.action_space.shape), np.float32))
    assert dones.all()
    assert all(info["is_success"] == info["success"] for info in infos)
    vec.close()


REGISTERED = (
    "assert gymnasium.spec('morphgen/Reach-v0').entry_point\n"
    "assert gymnasium.spec('morphgen/Push-v0').entry_point\n"
    "from morphgen.tasks.registry import register_gym_envs; register_gym_envs()\n"
)
UNLOADED = "assert not {'gymnasium', 'numpy', 'torch'} & {*sys.modules}\n"


@pytest.mark.parametrize(
    "script",
    [
        f"import gymnasium, morphgen.tasks\n{REGISTERED}",
        f"import sys, morphgen.tasks\n{UNLOADED}"
        f"import gymnasium, morphgen.tasks.gym.env\n{REGISTERED}",
    ],
)
def test_imports_register_the_ids_and_load_no_heavy_package(script):
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)


@pytest.fixture
def made(opened):
    return lambda name=REACH, **options: opened(make(name, **{"sim": "mujoco", **options}))


def test_push_observation_has_block_line_and_obstacles(made):
    channels = ObservationConfig(velocity=True, previous_action=True, points=12)
    env = made(PUSH, robot="prims", obstacles=True, observe=channels, kind="discrete")
    links, joints = len(env.unwrapped.env_spec.robot.links), len(env.unwrapped.action_joints)
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        "tokens": (links, 48),
        "object": (13,),
        "line": (1,),
        "obstacles": (CONFIGS[PUSH].obstacles, 13),
        "velocity": (links,),
        "previous_action": (joints,),
        "points": (12, 3),
    }
    assert env.action_space.nvec.tolist() == [len(BINS)] * joints


def test_action_moves_its_own_joint(made):
    env = made(observe=ObservationConfig(previous_action=True)).unwrapped
    robot = env.env_spec.robot
    for k, name in enumerate(env.action_joints):
        env.reset(seed=0)
        before = env.batch.targets.clone()
        action = np.zeros(len(env.action_joints), np.float32)
        action[k] = 0.5 if before[0, k] < env.batch.robot_tables.home[0, k] else -0.5
        seen, *_ = env.step(action)
        (moved,) = torch.nonzero(env.batch.targets[0] != before[0])[:, 0].tolist()
        assert robot.joints[robot.independent_joints[moved]].name == name
        assert seen["previous_action"].tolist() == action.tolist()


def test_unseeded_resets_continue_the_random_sequence(made):
    env = made()
    goals, again = (
        [tuple(env.reset(seed=seed)[0]["goal"]) for seed in (1, *[None] * 7)] for _ in range(2)
    )
    assert len(set(goals)) > 1
    assert again == goals
    starts = {tuple(made().reset()[0]["tokens"].ravel()) for _ in range(6)}
    assert len(starts) > 1


def test_robot_above_the_default_max_links_needs_the_option(made):
    body = morphgen.compose("chain beads=7", geometry="primitive")
    with pytest.raises(MorphgenError, match="max_links 25 or more"):
        made(robot=body, max_links=24)
    assert made(robot=body, max_links=25).reset(seed=0)
    for robot, links, numbered in ((body, 25, 25), ("arm3-stick", 7, 23)):
        seen, _ = made(robot=robot).reset(seed=0)
        assert seen["tokens"][:, 0] * (numbered - 1) == pytest.approx(range(links))


def test_last_observation_of_an_episode_is_returned(made):
    env = made(PUSH, robot="prims", observe=ObservationConfig(velocity=True)).unwrapped
    env.reset(seed=0)
    steps = [env.step(np.ones(5, dtype=np.float32)) for _ in range(STEPS)]
    assert [step[2:4] for step in steps] == [(False, k == STEPS - 1) for k in range(STEPS)]
    seen, *_, info = steps[-1]
    assert np.abs(seen["velocity"]).max() > 0
    names = {"success", "is_success", "distance", "score", "diverged", "terms"}
    assert set(info) == names
    assert info["terms"]["distance"] == pytest.approx(-info["distance"])
    with pytest.raises(TaskError, match="no episode is running; call reset"):
        env.step(np.ones(5, dtype=np.float32))


@pytest.mark.parametrize(("name", "robot"), [(REACH, "arm3-stick"), (PUSH, "prims")])
def test_last_state_of_an_episode_can_be_rendered(made, name, robot):
    env = made(name, robot=robot, render_mode="rgb_array", size=(160, 120)).unwrapped
    env.reset(seed=3)
    with pytest.warns(UserWarning, match="render_mode"):
        assert made(name, robot=robot).unwrapped.render() is None
    frames = [env.render().astype(int)]
    for _ in range(STEPS):
        env.step(np.zeros(env.action_space.shape, np.float32))
        frames.append(env.render().astype(int))
    env.reset()
    still, moved = (np.abs(frames[-1] - other).mean() for other in (frames[-2], env.render()))
    assert still < moved / 5


def test_closed_environment_raises_a_clear_error(made):
    env = made(render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    env.render()
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.step(np.zeros(5, np.float32))):
        with pytest.raises(TaskError, match="this environment is closed"):
            use()


def test_invalid_actions_are_rejected(made):
    env = made()
    env.reset(seed=0)
    with pytest.raises(TaskError, match=r"shape \(23,\); expected \(5,\): arm_base, arm_shoulder"):
        env.unwrapped.step(np.zeros(23, np.float32))
    with pytest.raises(TaskError, match="not finite"):
        env.unwrapped.step(np.full(5, np.nan, np.float32))


def test_mujoco_is_the_default_whatever_is_installed(made):
    assert isinstance(made(sim=None).unwrapped.batch.simulation, MujocoSimulation)


LONG_REACH = ReachConfig(max_episode_steps=12, num_goals=5)
LONG_PUSH = PushConfig(max_episode_steps=9, num_goals=5)


@pytest.fixture
def mixed_batch(cache, opened):
    """Create batches of two robots with two tasks, one with obstacles."""
    mixed = {"robots": ["arm3-stick", "prims"], "num_envs": 4, "obstacles": [True, False]}
    given = {"sim": "mujoco", "configs": (LONG_REACH, LONG_PUSH), "cache": cache} | mixed
    return lambda **options: opened(make_batch(["reach", "push"], **given | options))


def test_autoreset_returns_the_final_observation(mixed_batch):
    envs = TaskVector(mixed_batch())
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.reset(seed=0)
    actions = np.full(envs.action_space.shape, 0.3, dtype=np.float32)
    ends = np.array([LONG_REACH.max_episode_steps, LONG_PUSH.max_episode_steps] * 2)
    for k in range(1, LONG_REACH.max_episode_steps + 1):
        seen, _, terminated, truncated, infos = envs.step(actions)
        over = ends == k
        assert not terminated.any()
        assert np.array_equal(truncated, over)
        assert np.array_equal(infos["_success"], ~over)
        assert ("final_obs" in infos) == over.any()
        if over.any():
            assert np.array_equal(infos["_final_obs"], over)
            assert np.array_equal(infos["final_info"]["_score"], over)
            assert np.array_equal(infos["final_info"]["terms"]["_distance"], over)
        for env, final in enumerate(infos.get("final_obs", ())):
            assert (final is not None) == over[env]
            if over[env]:
                assert final in envs.single_observation_space
                assert not np.array_equal(final["tokens"], seen["tokens"][env])


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_stable_baselines3_ppo_learns(mixed_batch, kind):
    envs = VecMonitor(SB3Vector(TaskVector(mixed_batch(kind=kind))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = PPO("MultiInputPolicy", envs, n_steps=12, batch_size=48, n_epochs=1, seed=0)
        before = torch.cat([each.detach().flatten() for each in model.policy.parameters()])
        model.learn(2 * 12 * 4)
    after = torch.cat([each.detach().flatten() for each in model.policy.parameters()])
    assert not torch.equal(before, after)
    assert torch.isfinite(after).all()
    assert model.num_timesteps == 2 * 12 * 4
    lengths = {episode["l"] for episode in model.ep_info_buffer}
    assert lengths == {LONG_REACH.max_episode_steps, LONG_PUSH.max_episode_steps}
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


def test_stable_baselines3_infos_distinguish_truncation(mixed_batch):
    envs = SB3Vector(TaskVector(mixed_batch()))
    envs.seed(3)
    first = envs.reset()["goal"]
    assert np.array_equal(first, TaskVector(mixed_batch(seed=3)).reset()[0]["goal"])
    for _ in range(LONG_PUSH.max_episode_steps):
        seen, _, dones, infos = envs.step(np.zeros((4, 5), dtype=np.float32))
    assert dones.tolist() == [False, True] * 2
    for over, info in zip(dones, infos, strict=True):
        assert {"distance", "score"} <= set(info)
        assert ("terminal_observation" in info) == over
        if over:
            assert info["TimeLimit.truncated"] is True
            assert info["is_success"] is False
            assert set(info["terminal_observation"]) == set(seen)


def test_stable_baselines3_can_read_attributes(mixed_batch):
    envs = SB3Vector(TaskVector(mixed_batch()))
    assert envs.get_attr("num_envs", [0, 2]) == [4, 4]
    assert envs.env_is_wrapped(gym.Wrapper) == [False] * 4
    envs.set_attr("label", "x")
    assert envs.get_attr("label") == ["x"] * 4
    seen, _ = envs.env_method("reset", seed=1)[0]
    assert seen in envs.vector.observation_space
    with pytest.raises(TaskError, match="share their attributes"):
        envs.set_attr("label", "y", indices=0)
    envs.set_options({"goal": 1})  # stable-baselines3 hands them to the next reset
    with pytest.raises(TaskError, match="goal"):
        envs.reset()


def test_making_vectors_shows_progress_and_closed_ones_raise_a_clear_error():
    reports = []
    with show_progress(lambda *now: reports.append(now)):
        envs = make_vec(PUSH)
    assert reports == [(0, 2), (1, 2), (2, 2)]
    assert [each.robot.name for each in envs.batch.specs] == ["arm3-stick", "prims"]
    envs.close()
    envs.close()
    for use in (envs.reset, lambda: envs.step(envs.action_space.sample())):
        with pytest.raises(TaskError, match="this environment is closed"):
            use()
