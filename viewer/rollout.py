"""Episodes that are being simulated: robots at a task, each in an environment of its own."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from morphgen.errors import MorphgenError, TaskError, nearest
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.robot_source import is_robot_file
from morphgen.rl.baselines import BASELINES, Controller
from morphgen.rl.inference import ControllerSpec, make_env_and_controller, read_controller
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.robot_source import FILE, members, read_drawn
from morphgen.rl.shipped_policies import is_named, policies_for
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.registry import TASKS, installed_simulators
from morphgen.tasks.render.renderer import render_state
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.viewer.app.address import MAX_PLAYED
from morphgen.viewer.episode import Array, Episode, Track
from morphgen.viewer.robot_uri import (
    CHECKPOINT,
    DERIVATION,
    WORDS,
    FileAccess,
    UriError,
    read_robot_uri,
    shorten,
    uri_name,
    with_library_meshes,
)

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


class EpisodeSource:
    """Source of an episode: a file, whose episode is complete, or a simulation."""

    def __init__(self, episode: Episode, max_steps: int) -> None:
        """Take over an episode with its longest possible duration [control steps]."""
        self.episode, self.max_steps = episode, max_steps
        self.faults: dict[str, str] = {}  # errors of robots that cannot do the task, by URI

    def advance(self) -> bool:
        """Simulate one more control step; return False if the episode has ended."""
        return False

    def close(self) -> None:
        """Free the simulation."""


@dataclass(eq=False)
class _SimulatedRobot:
    """A robot in its environment, and its track so far."""

    env: TaskEnv
    controller: Controller
    track: Track
    is_running: bool = True


class Rollout(EpisodeSource):
    """Robots under a policy; each has the episode of ``morphgen play`` with the same seed."""

    def __init__(
        self,
        config: RolloutConfig,
        files: FileAccess,
        progress: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Start an episode."""
        faults: dict[str, MorphgenError] = {}
        self._robots: list[_SimulatedRobot] = []
        spec = _read_controller(config.policy, config.task, files)
        for uri in config.robots[:MAX_PLAYED]:
            progress(f"preparing {uri_name(uri)}")
            try:
                self._robots.append(_start_robot(config, uri, spec, files))
            except MorphgenError as error:
                faults[uri] = error
        if not self._robots:
            none = UriError("no robot is named: add one with &robot=")
            raise next(iter(faults.values()), none)
        episode = Episode(
            config.task,
            config.policy,
            config.seed,
            config.obstacles,
            config.simulator,
            CONTROL_PERIOD,
            [robot.track for robot in self._robots],
        )
        max_steps = max(int(robot.env.batch.max_episode_steps[0]) for robot in self._robots)
        super().__init__(episode, max_steps)
        self.faults |= {uri: str(error) for uri, error in faults.items()}

    def advance(self) -> bool:
        """Simulate one control step of every running robot; return False if none is running."""
        running = [robot for robot in self._robots if robot.is_running]
        for robot in running:
            _step(robot)
        return bool(running)

    def close(self) -> None:
        """Free the simulations."""
        for robot in self._robots:
            robot.env.close()


def simulators() -> list[str]:
    """Return the names of the installed simulators, MuJoCo first."""
    usable = installed_simulators(lambda simulator: "cpu" in simulator.devices)
    return sorted(usable, key=lambda name: name != "mujoco")


def _read_controller(policy: str, task: str, files: FileAccess) -> ControllerSpec:
    """Return the controller that a page names."""
    if not is_named(policy):
        policy = str(_checkpoint_path(policy, policies_for(task), files))
    return read_controller(policy, task)


def _checkpoint_path(policy: str, baselines: Iterable[str], files: FileAccess) -> Path:
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


def training_robots(policy: str, files: FileAccess) -> tuple[str, bool, list[tuple[str, str]]]:
    """Return task, obstacles, and names and URIs of the robots of a checkpoint's training.

    It has obstacles if any robot had, because then the policy observes them. There are no robots
    if they were drawn and their list is missing.
    """
    path = _checkpoint_path(policy, BASELINES, files)
    source = read_checkpoint(path)[0].source
    rows = members(source)
    if source.grammars:
        folder = path if path.is_dir() else path.parent
        rows = read_drawn(folder) if (folder / FILE).is_file() else ()
        if not rows:
            return str(source.task), source.obstacles, []
    if rows:
        robots = [(row.name, f"{DERIVATION}{row.derivation}") for row in rows]
        return rows[0].task, any(row.obstacles for row in rows), robots
    # The name comes from a file, so paths in it are read only through ``files``.
    words = source.name.split()
    if is_robot_file(source.name):
        robot = read_robot_uri(source.name, files)
    elif words and words[0].endswith(SUFFIX):
        robot = read_robot_uri(WORDS + source.name, files)
    else:
        robot = load_robot(source.name, library=files.library_folders)
    derivation = robot.provenance.get("derivation")
    uri = f"{DERIVATION}{derivation}" if derivation else source.name
    assert source.task is not None  # only a split has none, and its robots were returned above
    return source.task, source.obstacles, [(source.name, uri)]


def _start_robot(
    config: RolloutConfig, uri: str, spec: ControllerSpec, files: FileAccess
) -> _SimulatedRobot:
    """Begin the episode of a robot in an environment of its own."""
    robot = read_robot_uri(uri, files)
    env, controller = make_env_and_controller(
        spec,
        as_primitives(with_library_meshes(robot, files.library), files.library_folders),
        config.seed,
        sim=config.simulator,
        obstacles=config.obstacles,
        library=files.library_folders,
    )
    with contextlib.ExitStack() as stack:
        stack.callback(env.close)
        env.batch.reset(config.seed)
        start, env_spec = render_state(env.batch), env.env_spec
        track = Track(
            split_colours(robot),
            uri,
            env_spec.scene.ground,
            env.batch.layouts.obstacles(0),
            TASKS[env_spec.task].markers(env_spec.config, env_spec.goals),
            env_spec.scene.block.size if env_spec.scene.block else None,
            [start.q],
            [] if start.block is None else [start.block],
            {name: [pose] for name, pose in start.markers.items()},
        )
        stack.pop_all()  # keeps the environment open
        return _SimulatedRobot(env, controller, track)


def _step(robot: _SimulatedRobot) -> None:
    """Simulate one control step; the robot stops at the end of its episode."""
    batch, track = robot.env.batch, robot.track
    try:
        step = batch.step(robot.controller.act(batch))
    except MorphgenError as error:
        robot.is_running, track.fault = False, str(error)
        return
    if track.block:
        track.block.append(_to_numpy(step.block_pose[0]))
    ended = bool(step.terminated[0] | step.truncated[0])
    for name, pose in batch.groups.marker_poses(0).items():
        poses = track.marker_poses[name]
        # A batch resets an environment that ends, so its markers are those of the next episode.
        poses.append(poses[-1] if ended else pose)
    track.score.append(float(step.score[0]))
    track.distance.append(float(step.distance[0]))
    track.success.append(bool(step.success[0]))
    # Last, because other threads read a track up to the length of q meanwhile.
    track.q.append(_to_numpy(step.q[0, : track.robot.dof]))
    robot.is_running = not ended
    if step.diverged[0]:
        track.fault = "the simulation diverged"


def _to_numpy(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy(), dtype=np.float32)


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
        except (RuntimeError, TimeoutError):
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
