"""Plays an episode on a thread of its own: simulates ahead, shows moments in time, obeys orders."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Protocol

from morphgen.errors import MorphgenError
from morphgen.viewer.rollout import Source

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)
REFRESH = 0.04
"""Seconds between two pictures of a browser: 25 a second."""
BUSY = 0.12
"""Seconds after which what was simulated is shown, and orders are looked at, however far behind."""


class Screen(Protocol):
    """Where episodes are shown; all of it is called by the player's thread."""

    def prepared(self, source: Source) -> None:
        """There is another episode, at its start."""

    def shown(self, step: int) -> None:
        """A moment of the episode is shown: its start at 0, or after that many control steps."""

    def stopped(self) -> None:
        """It is over, or paused."""

    def failed(self, why: str) -> None:
        """What was ordered cannot be done."""


class Player:
    """One browser's playback; ``stop`` ends its thread and frees the simulation."""

    def __init__(self, screen: Screen) -> None:
        self.playing, self.step = False, 0
        self._screen = screen
        self._source: Source | None = None
        self._speed = 1.0
        self._since, self._from = 0.0, 0.0
        self._orders: dict[str, Callable[[], object]] = {}
        self._count = itertools.count()
        self._ended = False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="morphgen-player", daemon=True)
        self._thread.start()

    def prepare(self, make: Callable[[], Source], *, play: bool = True) -> None:
        """Show another episode; of several that are asked for meanwhile the last."""
        self._order("prepare", lambda: self._prepare(make, play))

    def play(self) -> None:
        """Go on; from the start if all of it was shown."""
        self._order("play", self._play)

    def pause(self) -> None:
        """Stay where it is."""
        self._order("play", self._pause)

    def go_to(self, step: int) -> None:
        """Show a moment, as far as there is one yet, and stay there."""
        self._order("step", lambda: self._go_to(step))

    def go_by(self, steps: int) -> None:
        """Pause, and show a moment before or after; what is not there yet is simulated."""
        self._order(f"by {next(self._count)}", lambda: self._go_by(steps))

    def at_speed(self, speed: float) -> None:
        """Play at so many simulated seconds a second."""
        self._order("speed", lambda: self._at_speed(speed))

    def stop(self) -> None:
        """End the thread, as soon as what it does is done."""
        with self._wake:
            self._ended = True
            self._wake.notify()

    def join(self, seconds: float) -> bool:
        """Wait for the thread to end; whether it did."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _order(self, key: str, work: Callable[[], object]) -> None:
        with self._wake:
            self._orders.pop(key, None)
            self._orders[key] = work
            self._wake.notify()

    def _run(self) -> None:
        try:
            while orders := self._next():
                for work in orders:
                    self._do(work)
        finally:
            if self._source is not None:
                self._source.close()

    def _next(self) -> list[Callable[[], object]]:
        """What is to be done now; nothing at the end."""
        with self._wake:
            if not self._orders and not self._ended:
                self._wake.wait(REFRESH if self.playing else None)
            orders, self._orders = list(self._orders.values()), {}
            if self._ended:
                return []
        return orders or [self._tick]

    def _do(self, work: Callable[[], object]) -> None:
        try:
            work()
        except MorphgenError as error:
            self.playing = False
            self._screen.failed(str(error))
        except (RuntimeError, TimeoutError):
            if not self._ended:  # those of a browser that has gone are none
                raise

    def _prepare(self, make: Callable[[], Source], play: bool) -> None:
        self.playing = False
        old, self._source = self._source, None
        if old is not None:
            old.close()
        self._source = make()
        self.step = 0
        self._screen.prepared(self._source)
        self._screen.shown(0)
        if play:
            self._play()

    def _play(self) -> None:
        if self._source is None:
            return
        if self.step >= self._source.episode.steps and not self._source.advance():
            self.step = 0
        self.playing = True
        self._anchor()

    def _pause(self) -> None:
        self.playing = False
        self._screen.stopped()

    def _go_to(self, step: int) -> None:
        if self._source is None:
            return
        self.step = max(0, min(step, self._source.episode.steps))
        self.playing = False
        self._screen.shown(self.step)
        self._screen.stopped()

    def _go_by(self, steps: int) -> None:
        source, wanted = self._source, self.step + steps
        if source is None:
            return
        while source.episode.steps < wanted and source.advance():
            pass
        self._go_to(wanted)

    def _at_speed(self, speed: float) -> None:
        self._speed = speed
        self._anchor()

    def _anchor(self) -> None:
        """Count time from here and now."""
        self._since, self._from = time.monotonic(), float(self.step)

    def _tick(self) -> None:
        """Show what is due, simulated if need be; if that takes too long, time has to wait."""
        source = self._source
        if source is None or not self.playing:
            return
        begun = time.monotonic()
        due = int(self._from + (begun - self._since) * self._speed / source.episode.period)
        more = True
        while more and source.episode.steps < due and time.monotonic() - begun < BUSY:
            more = source.advance()
        last = source.episode.steps
        step = min(due, last)
        if step != self.step:
            self.step = step
            self._screen.shown(step)
        if due > last:
            self._anchor()
            if not more:
                self.playing = False
                self._screen.stopped()
