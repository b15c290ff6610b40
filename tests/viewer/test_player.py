"""The player simulates, shows steps and handles commands in its own thread; curves of episodes."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.errors import TaskError
from morphgen.tasks.registry import TASKS
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.episode import Episode, Track, score_until
from morphgen.viewer.pages.play import curves, parse_time
from morphgen.viewer.rollout import Player

WAIT = 30


class Counting:
    """An episode with a fixed number of slow steps."""

    max_steps = 100

    def __init__(self, steps=100, pause=0.0, fault=None):
        self.episode = SimpleNamespace(num_steps=0, period=0.02)
        self.closed = False
        self._steps, self._pause, self._fault = steps, pause, fault

    def advance(self):
        time.sleep(self._pause)
        if self._fault is not None:
            raise self._fault
        more = self.episode.num_steps < self._steps
        self.episode.num_steps += more
        return more

    def close(self):
        self.closed = True


class Display:
    def __init__(self):
        self.steps, self.faults, self.threads = [], [], set()
        self.positions = []
        self.changed = threading.Condition()

    def show_start(self, source):
        self._record(lambda: self.steps.append("start"))

    def show_step(self, step):
        self.threads.add(threading.current_thread())
        self._record(lambda: self.steps.append(step))

    def show_stopped(self):
        self._record(lambda: self.steps.append("stopped"))

    def show_position(self, step):
        self.positions.append(step)

    def show_failure(self, why):
        self._record(lambda: self.faults.append(why))

    def _record(self, change):
        with self.changed:
            change()
            self.changed.notify_all()

    def wait_for(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, WAIT), (self.steps, self.faults)


@pytest.fixture
def display():
    return Display()


@pytest.fixture
def player(display):
    made = Player(display)
    yield made
    made.stop()
    assert made.join(WAIT)


def test_an_episode_plays_to_its_end_and_restarts(player, display):
    source = Counting()
    player.set_speed(4.0)
    player.load(lambda: source)
    display.wait_for(lambda: display.steps[-1:] == ["stopped"])
    assert display.steps[:2] == ["start", 0]
    numbers = display.steps[1:-1]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == source.episode.num_steps == 100
    display.steps.clear()
    player.play()
    display.wait_for(lambda: display.steps[-1:] == ["stopped"])
    assert display.steps[0] < 100
    assert display.threads == {player._thread}


def test_playback_is_paused_stepped_and_scrubbed(player, display):
    source = Counting()
    player.load(lambda: source, start=0.0)
    for _ in range(3):
        player.go_by(1)
    display.wait_for(lambda: 3 in display.steps)
    assert source.episode.num_steps == 3
    player.go_by(-2)
    display.wait_for(lambda: display.steps[-2:] == [1, "stopped"])
    player.go_to(50)
    display.wait_for(lambda: display.steps[-2:] == [3, "stopped"])
    assert source.episode.num_steps == 3
    player.go_by(-9)
    display.wait_for(lambda: display.steps[-2:] == [0, "stopped"])


def test_an_episode_is_loaded_at_a_time_and_simulated_until_then(player, display):
    source = Counting()
    player.load(lambda: source, start=0.5)
    display.wait_for(lambda: display.steps[-2:] == [25, "stopped"])
    assert source.episode.num_steps == 25
    assert display.positions == [25]
    player.play()
    display.wait_for(lambda: 27 in display.steps)
    player.pause()
    display.wait_for(lambda: display.positions[-1:] != [None])
    assert display.positions[:2] == [25, None]
    assert display.positions[2] >= 27


@pytest.mark.slow
def test_slow_steps_are_shown_as_they_arrive(player, display):
    source = Counting(steps=8, pause=0.1)
    player.set_speed(4.0)
    player.load(lambda: source)
    display.wait_for(lambda: display.steps[-1:] == ["stopped"])
    assert len(display.steps) >= 6


def test_another_episode_frees_the_previous_one(player, display):
    sources = [Counting(), Counting()]
    for source in sources:
        player.load(lambda source=source: source, start=0.0)
        display.wait_for(lambda: "start" in display.steps)
        display.steps.clear()
    assert [source.closed for source in sources] == [True, False]
    player.stop()
    assert player.join(WAIT)
    assert sources[1].closed


def test_a_failure_is_shown_and_the_next_episode_can_play(player, display):
    def fail():
        raise TaskError("no such body")

    player.load(fail)
    display.wait_for(lambda: display.faults == ["no such body"])
    player.play()
    player.go_by(1)
    player.load(lambda: Counting(fault=TaskError("unstable")))
    display.wait_for(lambda: display.faults == ["no such body", "unstable"])
    player.load(Counting, start=0.0)
    display.wait_for(lambda: display.steps[-4:] == ["start", 0, 0, "stopped"])


def test_a_player_stops_while_it_loads(display):
    begun, source = threading.Event(), Counting()

    def slow():
        begun.set()
        time.sleep(0.3)
        return source

    player = Player(display)
    player.load(slow)
    assert begun.wait(WAIT)
    player.stop()
    assert player.join(WAIT)
    assert source.closed


def test_times_of_addresses():
    assert parse_time("1.5") == 1.5
    for text in ("-1", "soon", "nan", "inf"):
        with pytest.raises(AddressError, match=f"t={text} is no time; expected seconds, 0 or more"):
            parse_time(text)


def track(num_steps):
    """A robot whose distance falls from 1 m."""
    values = [1 - 0.1 * i for i in range(num_steps)]
    q = [np.zeros(4)] * (num_steps + 1)
    return Track(arm(), "x", None, q=q, score=values, distance=values, success=[False] * num_steps)


def episode(*num_steps):
    return Episode("reach", "zero", 0, False, "mujoco", 0.02, [track(n) for n in num_steps])


def test_curves_have_distance_score_and_a_line_at_the_step():
    distances, totals = curves(episode(5, 3), 2)
    assert distances[0] == pytest.approx([0.02, 0.04, 0.04, 0.04, 0.06, 0.08, 0.1])
    assert distances[1] == pytest.approx([1, 0.9, 0.9, 0.9, 0.8, 0.7, 0.6])
    assert distances[2] == pytest.approx([1, 0.9, 0.9, 0.9, 0.8, 0.8, 0.8])  # it ended earlier
    assert distances[3] == pytest.approx([0.6, 0.6, 1, 0.6, 0.6, 0.6, 0.6])
    expected = [score_until(track(5), "reach", i) for i in (1, 2, 2, 2, 3, 4, 5)]
    assert totals[1] == pytest.approx(expected)
    assert len(totals) == 4


def test_curves_are_finite_before_the_first_step():
    for data in curves(episode(0, 0), 0):
        assert all(np.isfinite(line).all() for line in data)
        assert {len(line) for line in data} == {3}


@pytest.mark.slow
def test_an_episode_has_curves_under_the_time_slider(see, picture):
    page = see("?play=reach&robot=robots/some-arm&policy=jacobian")
    page.get_by_text(f"m from {TASKS['reach'].target}").first.wait_for()
    page.locator(".uplot canvas").nth(1).wait_for()
    page.wait_for_function(
        "Object.values(window.__viserTestpoints?.uplots ?? {}).some("
        "(plot) => plot.chart.data[0].length > 50)"
    )
    picture(page, "curves")
    assert page.failures == []
