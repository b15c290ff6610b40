"""Playback of episodes: their sources, and the player that shows them in one browser."""

from __future__ import annotations

import itertools
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from morphgen.errors import MorphgenError, TaskError, nearest
from morphgen.viewer.app.workers import Workers, named
from morphgen.viewer.episode import Episode
from morphgen.viewer.robot_uri import CHECKPOINT, FileAccess, UriError, shorten

MAX_CHECKPOINTS = 50  # checkpoints that a page offers


@dataclass(frozen=True)
class RolloutConfig:
    """A task, robots and the policy that acts on them."""

    task: str
    robots: tuple[str, ...]  # URIs of the robots
    policy: str  # name of a baseline, or the path of a checkpoint as an address names it
    seed: int = 0
    obstacles: bool = False
    simulator: str = "mujoco"


@dataclass(eq=False)
class EpisodeSource:
    """Source of an episode: a recording, which is complete, or a simulation."""

    episode: Episode
    max_steps: int  # longest possible duration [control steps]
    faults: Mapping[str, str] = field(default_factory=dict)
    """Errors of robots that cannot do the task, by URI."""

    def advance(self) -> bool:
        """Simulate one more control step; return False if the episode has ended."""
        return False

    def close(self) -> None:
        """Free the simulation."""


def simulation(function: str) -> Callable[..., Any]:
    """Return a function of the module of simulations for their process."""
    return named(f"morphgen.viewer.simulation:{function}")


class RemoteRollout(EpisodeSource):
    """A ``simulation.Rollout`` in the process of simulations, some steps ahead of what is shown."""

    def __init__(self, config: RolloutConfig, files: FileAccess, process: Workers) -> None:
        """Start an episode."""
        self._process, self._key = process, secrets.token_hex(8)
        source = process.call(simulation("start"), self._key, config, files)
        super().__init__(source.episode, source.max_steps, source.faults)
        self._next: Future[Any] | None = process.submit(simulation("advance"), self._key)

    def advance(self) -> bool:
        """Take over the next steps; return False if no robot is running."""
        if self._next is None:
            return False
        is_running, tracks = self._process.result(self._next)
        self._next = None
        for track, (lists, fault) in zip(self.episode.tracks, tracks, strict=True):
            track.extend(lists)
            track.fault = fault
        if is_running:
            self._next = self._process.submit(simulation("advance"), self._key)
        return self._next is not None

    def close(self) -> None:
        """Free the simulation."""
        with suppress(RuntimeError):  # the viewer has ended, and the process with it
            self._process.submit(simulation("close"), self._key)


def checkpoint_path(policy: str, baselines: Iterable[str], files: FileAccess) -> Path:
    """Return the file or run folder of a checkpoint."""
    try:
        return files.path(policy)
    except UriError as error:
        if "/" in policy or policy.endswith(".pt"):
            raise
        raise TaskError(
            f"{shorten(policy)!r} is neither a checkpoint nor a policy{nearest(policy, baselines)}"
        ) from error


def list_checkpoints(files: FileAccess) -> list[str]:
    """Return the first checkpoints below the folder ``runs``, as addresses name them."""
    root = files.roots[0]
    paths = sorted((root / "runs").rglob(CHECKPOINT))
    return [path.relative_to(root).as_posix() for path in paths[:MAX_CHECKPOINTS]]


SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)  # speeds of playback [simulated seconds per second]
FRAME_TIME = 0.04  # time between two frames in a browser: 25 per second [s]
MAX_SIMULATION_TIME = 0.12  # longest time until commands are handled [s]


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
        """Show the episode that was requested last, paused at a time [s] or playing from 0."""

        def load() -> None:
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
                self._simulate_to(round(start / self._source.episode.period))

        self._command("load", load)

    def play(self) -> None:
        """Continue; restart an episode that was shown to its end."""
        self._command("play", self._play)

    def pause(self) -> None:
        """Pause at the current step."""

        def pause() -> None:
            self.is_playing = False
            self._display.show_position(self.step)
            self._display.show_stopped()

        self._command("play", pause)

    def go_to(self, step: int) -> None:
        """Pause at a step, or at the last simulated one before it."""
        self._command("step", lambda: self._go_to(step))

    def go_by(self, num_steps: int) -> None:
        """Pause a number of steps forward or back; simulate missing steps."""
        # Each press of a button counts, so each command has a key of its own.
        key = f"by {next(self._counter)}"
        self._command(key, lambda: self._simulate_to(self.step + num_steps))

    def set_speed(self, speed: float) -> None:
        """Set the speed of playback [simulated seconds per second]."""

        def change() -> None:
            self._speed = speed
            self._restart_clock()

        self._command("speed", change)

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
        """Run commands as they come, and show frames between them, until the player is stopped."""
        try:
            while True:
                with self._wake:
                    if not self._commands and not self._ended:
                        self._wake.wait(FRAME_TIME if self.is_playing else None)
                    commands, self._commands = list(self._commands.values()), {}
                    if self._ended:
                        return
                for work in commands or [self._tick]:
                    self._call(work)
        finally:
            if self._source is not None:
                self._source.close()

    def _call(self, work: Callable[[], object]) -> None:
        """Run work; show a failure, and ignore errors after the browser has disconnected."""
        try:
            work()
        except MorphgenError as error:
            self.is_playing = False
            self._display.show_failure(str(error))
        except (CancelledError, RuntimeError, TimeoutError):
            if not self._ended:  # expected from a browser that has disconnected
                raise

    def _play(self) -> None:
        if self._source is None:
            return
        if self.step >= self._source.episode.num_steps and not self._source.advance():
            self.step = 0
        self.is_playing = True
        self._display.show_position(None)
        self._restart_clock()

    def _go_to(self, step: int) -> None:
        if self._source is None:
            return
        self.step = max(0, min(step, self._source.episode.num_steps))
        self.is_playing = False
        self._display.show_step(self.step)
        self._display.show_position(self.step)
        self._display.show_stopped()

    def _simulate_to(self, step: int) -> None:
        source = self._source
        if source is None:
            return
        while source.episode.num_steps < step and not self._ended and source.advance():
            pass
        self._go_to(step)

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
