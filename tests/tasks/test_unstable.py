"""A diverged simulation ends only its own episode, in every simulator."""

import math

import mujoco
import pytest
import torch

from helpers.goal_sets import draw_spec
from morphgen.rl.baselines.simple import Random
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.scenes.make import batch_from_specs

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import client_of

REACH, PUSH = ReachConfig(num_goals=5), PushConfig(num_goals=5)
CHANNELS = ObservationConfig(velocity=True, previous_action=True, tool=True)
ENVS = 4


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Environment specs of a reach robot and a push robot."""
    cache = tmp_path_factory.mktemp("goals")
    chosen = {"obstacles": False, "seed": 0, "cache": cache}
    reaching = draw_spec(load_robot("arm3-stick"), REACH, **chosen)
    return [reaching, draw_spec(load_robot("prims"), PUSH, **chosen)]


@pytest.fixture(params=["pybullet", "mujoco"])
def build_batch(request, settings):
    """Create batches whose even environments reach and odd environments push."""
    opened = []

    def make():
        options = {"observe": CHANNELS, "seed": 1}
        opened.append(batch_from_specs(settings, ENVS, sim=request.param, **options))
        assert opened[-1].task_mask("push").tolist() == [False, True, False, True]
        return opened[-1]

    yield make
    for batch in opened:
        batch.close()


def break_physics(batch, env):
    """Set a velocity to nan."""
    if hasattr(batch.simulation, "_data"):
        batch.simulation._data[env].qvel[0] = math.nan
        return
    loaded = client_of(batch.simulation, env)
    pybullet.resetJointState(loaded.robot, loaded.driven[0], math.nan, physicsClientId=loaded.id)


def numbers(step):
    """Return all step results of each environment."""
    current = {**step.terms, "reward": step.reward, "score": step.score, "distance": step.distance}
    seen = {f"next {name}": value for name, value in step.observation.items()}
    final = {f"final {name}": value for name, value in step.final_observation.items()}
    return {**current, **seen, **final, "q": step.q, "block": step.block_pose}


@pytest.mark.parametrize("lost", [[0], [1], [0, 1, 2, 3]], ids=["reach", "push", "all"])
def test_diverged_environment_is_reset_and_the_others_continue(build_batch, lost):
    batch, whole = build_batch(), build_batch()
    batch.reset()
    whole.reset()
    chance = Random(0)
    for _ in range(5):
        actions = chance.act(batch)
        before = batch.step(actions)
        whole.step(actions)
    for env in lost:
        break_physics(batch, env)
    actions = chance.act(batch)
    result, other = batch.step(actions), whole.step(actions)
    kept = [env for env in range(ENVS) if env not in lost]
    assert result.diverged.tolist() == [env in lost for env in range(ENVS)]
    assert torch.equal(result.truncated, result.diverged)
    assert not result.terminated.any()
    for name, each in numbers(result).items():
        assert each.isfinite().all(), name
        assert torch.equal(each[kept], numbers(other)[name][kept]), name
    assert torch.equal(result.q[lost], before.q[lost])
    torch.testing.assert_close(result.block_pose[lost], before.block_pose[lost])
    assert not result.final_observation["velocity"][lost].any()
    assert not batch.episode_step[lost].any()
    assert (batch.episode_step[kept] == 6).all()
    result, other = batch.step(actions), whole.step(actions)
    assert not result.diverged.any()
    for name, each in numbers(result).items():
        assert each.isfinite().all(), name
        assert torch.equal(each[kept], numbers(other)[name][kept]), name


def test_episode_after_divergence_is_unchanged(build_batch):
    batch, whole = build_batch(), build_batch()
    batch.reset()
    whole.reset()
    assert torch.equal(batch.field("goal"), whole.field("goal"))
    break_physics(batch, 0)
    step = batch.step(Random(0).act(batch))
    whole.reset()
    assert step.diverged.tolist() == [True, False, False, False]
    assert torch.equal(batch.field("goal")[0], whole.field("goal")[0])
    assert torch.equal(batch.targets[0], whole.targets[0])


@pytest.mark.parametrize("build_batch", ["mujoco"], indirect=True)
@pytest.mark.parametrize("warning", ["CONTACTFULL", "CNSTRFULL"])
def test_contact_overflow_ends_one_episode(build_batch, warning):
    batch, whole = build_batch(), build_batch()
    batch.reset()
    whole.reset()
    number = getattr(mujoco.mjtWarning, f"mjWARN_{warning}").value
    batch.simulation._data[1].warning[number].number = 1
    actions = Random(0).act(batch)
    step, other = batch.step(actions), whole.step(actions)
    assert step.diverged.tolist() == step.truncated.tolist() == [False, True, False, False]
    for name, each in numbers(step).items():
        assert torch.equal(each[[0, 2, 3]], numbers(other)[name][[0, 2, 3]]), name
    assert not batch.step(actions).diverged.any()
