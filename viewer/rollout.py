"""Episodes, their sources, and the player that shows them in one browser."""

from __future__ import annotations

import itertools
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import MorphgenError, TaskError, nearest
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import Marker
from morphgen.viewer.app.workers import Workers, named
from morphgen.viewer.robot_uri import CHECKPOINT, FileAccess, UriError, shorten

Array = NDArray[np.float32]

BLOCK = "block"  # name of the block, or of the articulated object, among the poses of a track
_OF_STEPS = ("score", "distance", "success")  # values of a track that every step has


@dataclass(eq=False)
class Track:
    """Motion and scores of one robot; it grows while its episode is simulated."""

    robot: Robot
    uri: str
    ground: float | None  # height of the ground [m]; None without ground
    obstacles: tuple[Block, ...] = ()
    markers: tuple[Marker, ...] = ()  # shapes that show the goal
    block_size: tuple[float, float, float] | None = None
    object: ArticulatedObject | None = None
    q: list[Array] = field(default_factory=list)  # positions (J,) at the start and every step
    poses: dict[str, list[Array]] = field(default_factory=dict)
    """Poses in the world at the same times, (x, y, z, qw, qx, qy, qz): of each marker by its name,
    and of ``block`` if any, or of the object's contact point and the link that moves."""
    score: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)  # to success [m]
    success: list[bool] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)  # of demonstrations, which have them
    fault: str = ""  # error that ended the episode early; empty without error

    @property
    def num_steps(self) -> int:
        """Control steps so far."""
        return len(self.q) - 1

    def recorded(self, after: int = -1) -> dict[str, Any]:
        """Return copies of the lists after a number of steps, by default with the start."""
        last = min(self.num_steps, len(self.score))
        moments, steps = slice(after + 1, last + 1), slice(max(after, 0), last)
        lists: dict[str, Any] = {"q": self.q[moments]}
        lists["poses"] = {name: poses[moments] for name, poses in self.poses.items()}
        return lists | {name: getattr(self, name)[steps] for name in _OF_STEPS}

    def extend(self, lists: Mapping[str, Any]) -> None:
        """Append what ``recorded`` of the same robot has returned."""
        for name, poses in lists["poses"].items():
            self.poses[name] += poses
        # Last, because other threads read a track up to the length of q meanwhile.
        for name in (*_OF_STEPS, "q"):
            getattr(self, name).extend(lists[name])


@dataclass(eq=False)
class Episode:
    """Robots at the same task under the same policy."""

    task: str
    policy: str
    seed: int
    obstacles: bool  # whether obstacles were requested
    simulator: str
    period: float  # time of a control step [s]
    tracks: list[Track]

    @property
    def num_steps(self) -> int:
        """Control steps so far of the longest track."""
        return max((track.num_steps for track in self.tracks), default=0)


def score_until(track: Track, task: str, step: int) -> float | None:
    """Return an episode's score as if it had ended at a step of its track; None at the start."""
    scores = track.score[:step]
    if not scores:
        return None
    return TASKS[task].episode_score(sum(scores), scores[-1], len(scores))


def snapshot(episode: Episode) -> Episode:
    """Return a copy of an episode that does not grow while the simulation continues."""
    tracks = [replace(track, **track.recorded()) for track in episode.tracks]
    return replace(episode, tracks=tracks)


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

    def stop(self) -> None:
        """End the thread after its current work."""
        with self._wake:
            self._ended = True
            self._wake.notify()

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
        due = int(self._step_start + (now - self._clock_start) / source.episode.period)
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
