"""A player simulates, shows and obeys on a thread of its own."""

import threading
import time
from types import SimpleNamespace

import pytest

from morphgen.errors import TaskError
from morphgen.viewer.player import Player

WAIT = 30


class Counting:
    """An episode of so many steps, each of which takes a while."""

    longest = 100

    def __init__(self, steps=100, pause=0.0, fault=None):
        self.episode = SimpleNamespace(steps=0, period=0.02)
        self.closed = False
        self._steps, self._pause, self._fault = steps, pause, fault

    def advance(self):
        time.sleep(self._pause)
        if self._fault is not None:
            raise self._fault
        more = self.episode.steps < self._steps
        self.episode.steps += more
        return more

    def close(self):
        self.closed = True


class Screen:
    def __init__(self):
        self.steps, self.faults, self.threads = [], [], set()
        self.changed = threading.Condition()

    def prepared(self, source):
        self._tell(lambda: self.steps.append("prepared"))

    def shown(self, step):
        self.threads.add(threading.current_thread())
        self._tell(lambda: self.steps.append(step))

    def stopped(self):
        self._tell(lambda: self.steps.append("stopped"))

    def failed(self, why):
        self._tell(lambda: self.faults.append(why))

    def _tell(self, change):
        with self.changed:
            change()
            self.changed.notify_all()

    def wait_for(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, WAIT), (self.steps, self.faults)


@pytest.fixture
def screen():
    return Screen()


@pytest.fixture
def player(screen):
    made = Player(screen)
    yield made
    made.stop()
    assert made.join(WAIT)


def test_it_plays_to_the_end_in_order_and_again_from_the_start(player, screen):
    source = Counting()
    player.at_speed(4.0)
    player.prepare(lambda: source)
    screen.wait_for(lambda: screen.steps[-1:] == ["stopped"])
    assert screen.steps[:2] == ["prepared", 0]
    numbers = screen.steps[1:-1]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == source.episode.steps == 100
    screen.steps.clear()
    player.play()
    screen.wait_for(lambda: screen.steps[-1:] == ["stopped"])
    assert screen.steps[0] < 100
    assert screen.threads == {player._thread}


def test_it_is_paused_stepped_and_scrubbed(player, screen):
    source = Counting()
    player.prepare(lambda: source, play=False)
    for _ in range(3):
        player.go_by(1)
    screen.wait_for(lambda: 3 in screen.steps)
    assert source.episode.steps == 3
    player.go_by(-2)
    screen.wait_for(lambda: screen.steps[-2:] == [1, "stopped"])
    player.go_to(50)
    screen.wait_for(lambda: screen.steps[-2:] == [3, "stopped"])
    assert source.episode.steps == 3
    player.go_by(-9)
    screen.wait_for(lambda: screen.steps[-2:] == [0, "stopped"])


def test_what_is_slow_is_shown_as_it_comes(player, screen):
    source = Counting(steps=8, pause=0.1)
    player.at_speed(4.0)
    player.prepare(lambda: source)
    screen.wait_for(lambda: screen.steps[-1:] == ["stopped"])
    assert len(screen.steps) >= 6


def test_another_episode_frees_the_one_before(player, screen):
    sources = [Counting(), Counting()]
    for source in sources:
        player.prepare(lambda source=source: source, play=False)
        screen.wait_for(lambda: "prepared" in screen.steps)
        screen.steps.clear()
    assert [source.closed for source in sources] == [True, False]
    player.stop()
    assert player.join(WAIT)
    assert sources[1].closed


def test_what_fails_is_told_and_the_next_can_play(player, screen):
    def fail():
        raise TaskError("no such body")

    player.prepare(fail)
    screen.wait_for(lambda: screen.faults == ["no such body"])
    player.play()
    player.go_by(1)
    player.prepare(lambda: Counting(fault=TaskError("unstable")))
    screen.wait_for(lambda: screen.faults == ["no such body", "unstable"])
    player.prepare(Counting, play=False)
    screen.wait_for(lambda: screen.steps[-2:] == ["prepared", 0])


def test_it_ends_while_it_prepares(screen):
    begun, source = threading.Event(), Counting()

    def slow():
        begun.set()
        time.sleep(0.3)
        return source

    player = Player(screen)
    player.prepare(slow)
    assert begun.wait(WAIT)
    player.stop()
    assert player.join(WAIT)
    assert source.closed
