"""Playback of an episode: a thread that simulates ahead, shows steps in time and takes commands."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Protocol

from morphgen.errors import MorphgenError
from morphgen.viewer.rollout import EpisodeSource

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Speeds of playback [simulated seconds per second]."""
FRAME_TIME = 0.04
"""Time between two frames in a browser: 25 per second [s]."""
MAX_SIMULATION_TIME = 0.12
"""Time after which simulated steps are shown, and commands handled, however far behind [s]."""


class Display(Protocol):
    """Shows an episode; every method is called on the player's thread."""

    def show_start(self, source: EpisodeSource) -> None:
        """Show a new episode at its start."""

    def show_step(self, step: int) -> None:
        """Show the episode after a number of control steps."""

    def show_stopped(self) -> None:
        """Show that the episode has ended or is paused."""

    def show_position(self, step: int | None) -> None:
        """Remember the step at which the user paused; None while the episode plays."""

    def show_failure(self, reason: str) -> None:
        """Show why a command has failed."""


class Player:
    """Playback for one browser; ``stop`` ends its thread and frees the simulation."""

    def __init__(self, display: Display) -> None:
        self.is_playing, self.step = False, 0
        self._display = display
        self._source: EpisodeSource | None = None
        self._speed = 1.0
        self._clock_start, self._step_start = 0.0, 0.0
        self._commands: dict[str, Callable[[], object]] = {}
        self._counter = itertools.count()
        self._ended = False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="morphgen-player", daemon=True)
        self._thread.start()

    def load(self, make_source: Callable[[], EpisodeSource], *, start: float | None = None) -> None:
        """Show another episode; of several that are requested meanwhile, the last.

        Args:
            make_source: Makes the episode.
            start: Time at which it is paused [s]; by default it plays from its beginning.
        """
        self._command("load", lambda: self._load(make_source, start))

    def play(self) -> None:
        """Continue; restart an episode that was shown to its end."""
        self._command("play", self._play)

    def pause(self) -> None:
        """Pause at the current step."""
        self._command("play", self._pause)

    def go_to(self, step: int) -> None:
        """Pause at a step, or at the last simulated one before it."""
        self._command("step", lambda: self._go_to(step))

    def go_by(self, num_steps: int) -> None:
        """Pause a number of steps forward or back; simulate missing steps."""
        # Each press of a button counts, so each command has a key of its own.
        self._command(f"by {next(self._counter)}", lambda: self._go_by(num_steps))

    def set_speed(self, speed: float) -> None:
        """Set the speed of playback [simulated seconds per second]."""
        self._command("speed", lambda: self._set_speed(speed))

    def stop(self) -> None:
        """End the thread after its current work."""
        with self._wake:
            self._ended = True
            self._wake.notify()

    def join(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds for the thread to end; return whether it has."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _command(self, key: str, work: Callable[[], object]) -> None:
        """Queue a command at the end; it replaces a waiting command of the same key."""
        with self._wake:
            self._commands.pop(key, None)
            self._commands[key] = work
            self._wake.notify()

    def _run(self) -> None:
        try:
            while work := self._next_work():
                for call in work:
                    self._call(call)
        finally:
            if self._source is not None:
                self._source.close()

    def _next_work(self) -> list[Callable[[], object]]:
        """Wait for commands or the next frame; return nothing when the player is stopped."""
        with self._wake:
            if not self._commands and not self._ended:
                self._wake.wait(FRAME_TIME if self.is_playing else None)
            commands, self._commands = list(self._commands.values()), {}
            if self._ended:
                return []
        return commands or [self._tick]

    def _call(self, work: Callable[[], object]) -> None:
        """Run work; show a failure, and ignore errors after the browser has disconnected."""
        try:
            work()
        except MorphgenError as error:
            self.is_playing = False
            self._display.show_failure(str(error))
        except (RuntimeError, TimeoutError):
            if not self._ended:  # expected from a browser that has disconnected
                raise

    def _load(self, make_source: Callable[[], EpisodeSource], start: float | None) -> None:
        """Replace the episode by a new one, and show its start."""
        self.is_playing = False
        previous, self._source = self._source, None
        if previous is not None:
            previous.close()
        self._source = make_source()
        self.step = 0
        self._display.show_start(self._source)
        self._display.show_step(0)
        if start is None:
            self._play()
        else:
            self._go_by(round(start / self._source.episode.period))

    def _play(self) -> None:
        if self._source is None:
            return
        if self.step >= self._source.episode.num_steps and not self._source.advance():
            self.step = 0
        self.is_playing = True
        self._display.show_position(None)
        self._restart_clock()

    def _pause(self) -> None:
        self.is_playing = False
        self._display.show_position(self.step)
        self._display.show_stopped()

    def _go_to(self, step: int) -> None:
        if self._source is None:
            return
        self.step = max(0, min(step, self._source.episode.num_steps))
        self.is_playing = False
        self._display.show_step(self.step)
        self._display.show_position(self.step)
        self._display.show_stopped()

    def _go_by(self, num_steps: int) -> None:
        source, target = self._source, self.step + num_steps
        if source is None:
            return
        while source.episode.num_steps < target and not self._ended and source.advance():
            pass
        self._go_to(target)

    def _set_speed(self, speed: float) -> None:
        self._speed = speed
        self._restart_clock()

    def _restart_clock(self) -> None:
        """Measure playback time from now and from the current step."""
        self._clock_start, self._step_start = time.monotonic(), float(self.step)

    def _tick(self) -> None:
        """Show the step that is due, simulating as needed; a slow simulation delays the clock."""
        source = self._source
        if source is None or not self.is_playing:
            return
        now = time.monotonic()
        elapsed = (now - self._clock_start) * self._speed
        due = int(self._step_start + elapsed / source.episode.period)
        is_running, deadline = True, now + MAX_SIMULATION_TIME
        while is_running and source.episode.num_steps < due and time.monotonic() < deadline:
            is_running = source.advance()
        last = source.episode.num_steps
        step = min(due, last)
        if step != self.step:
            self.step = step
            self._display.show_step(step)
        if due > last:
            self._restart_clock()
            if not is_running:
                self.is_playing = False
                self._display.show_stopped()
