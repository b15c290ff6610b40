"""Episodes of controllers: they run in one thread, and may end early."""

from contextlib import closing

import pytest
import torch

from morphgen.rl.baselines.simple import Zero
from morphgen.rl.play import make_env_and_controller, play, read_controller
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.scenes.make import make_batch


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
