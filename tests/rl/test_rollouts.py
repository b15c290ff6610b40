"""Episodes and rollouts: threads, early ends, and when tensors are read."""

from contextlib import closing

import pytest
import torch

from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from helpers.learners import learner
from helpers.scenes import robot
from morphgen.rl.baselines.simple import Zero
from morphgen.rl.inference import make_env_and_controller, play, read_controller, run_episodes
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs, make_batch
from morphgen.tasks.sim import base


@pytest.fixture
def two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)


class Counting(Zero):
    """Controller that records the number of threads in which it acts."""

    def __init__(self):
        super().__init__(0)
        self.threads = set()

    def act(self, task):
        self.threads.add(torch.get_num_threads())
        return super().act(task)


def test_episodes_run_in_one_thread(two_threads):
    controller = Counting()
    run_episodes(make_batch("reach", ["stick"], 1, sim="mujoco"), controller, 1)
    assert controller.threads == {1}


def test_played_episodes_run_in_one_thread(two_threads, tmp_path):
    spec = read_controller("zero", "reach")
    env, _ = make_env_and_controller(spec, "stick", 0, sim="mujoco", cache=tmp_path)
    controller = Counting()
    with closing(env):
        list(play(env, controller, 1, 0, lambda episode: None))
    assert controller.threads == {1}


def test_an_episode_ends_early_after_successes_in_a_row(tmp_path):
    spec = read_controller("ik", "reach")
    env, controller = make_env_and_controller(spec, "arm3-stick", 0, sim="mujoco", cache=tmp_path)
    with closing(env):
        early, whole = [], []
        list(play(env, controller, 2, 0, early.append, max_successes=5))
        list(play(env, controller, 2, 0, whole.append))
    assert [episode.steps for episode in whole] == [300, 300]
    for episode in early:
        assert episode.success
        assert 5 <= episode.steps < 300


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
    few, many = (reads_of_a_rollout(spec, agent, discrete, steps) for steps in (4, 16))
    assert few == many
    assert few  # the metrics


def test_final_observations_are_the_same_on_every_device(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    student = learner()
    masks = student.truncated = torch.rand(7, 5, generator=generator) < 0.3
    values = torch.rand(7, 5, 2, generator=generator)

    def gathered():
        seen = [{"goal": value, "sum": value.sum(dim=1)} for value in values]
        return student._truncated_rows(list(map(student._rows_to_keep, seen, masks)))

    on_host = gathered()
    monkeypatch.setattr(base, "HOST_DEVICES", ())
    elsewhere = gathered()
    assert torch.equal(on_host["goal"], values[masks])
    assert all(torch.equal(on_host[name], elsewhere[name]) for name in on_host)
