"""A learner's rollout reads its tensors at the end only, and finds the truncated episodes."""

import pytest
import torch

from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from helpers.learners import learner
from helpers.scenes import robot
from morphgen.rl.ppo import FinalObservations
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim import base

REACH = ReachConfig(num_goals=6, max_episode_steps=5)


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return draw_spec(robot("arm3"), REACH, cache=tmp_path_factory.mktemp("goals"))


def reads_of_a_rollout(spec, agent, discrete, num_steps):
    """Return what the second rollout of a learner reads, treating the CPU as a GPU."""
    observe = ObservationConfig(velocity=True, jacobian=True, dls=True, tree=True)
    kind = "discrete" if discrete else "continuous"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())
        batch = batch_from_specs([spec], 8, sim="kinematic", kind=kind, observe=observe)
        student = learner(batch, agent=agent, discrete=discrete, num_steps=num_steps)
        student._collect_rollout()
    with device_reads() as reads:
        metrics = student._collect_rollout()
    assert metrics["episodes"] > 0
    assert len(student.final_observations["tokens"]) == metrics["episodes"]
    return reads.found


@pytest.mark.parametrize(
    ("agent", "discrete"), [("me-mlp", False), ("me-mlp", True), ("me-graph", False)]
)
def test_reads_of_a_rollout_do_not_grow_with_its_steps(spec, agent, discrete):
    few, many = (reads_of_a_rollout(spec, agent, discrete, steps) for steps in (8, 32))
    assert few == many
    assert few  # the metrics


def test_final_observations_are_the_same_on_every_device(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    masks = torch.rand(7, 5, generator=generator) < 0.3
    values = torch.rand(7, 5, 2, generator=generator)

    def gathered():
        finals = FinalObservations()
        for value, mask in zip(values, masks, strict=True):
            finals.add({"goal": value, "sum": value.sum(dim=1)}, mask)
        return finals.gather()

    on_host = gathered()
    monkeypatch.setattr(base, "HOST_DEVICES", ())
    elsewhere = gathered()
    assert torch.equal(on_host["goal"], values[masks])
    assert all(torch.equal(on_host[name], elsewhere[name]) for name in on_host)
