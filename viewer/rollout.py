"""Episodes that are being simulated: robots at a task, each in an environment of its own."""

from __future__ import annotations

import contextlib
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
from morphgen.rl.baselines import BASELINES
from morphgen.rl.drawn_robots import FILE, read_drawn
from morphgen.rl.play import ControllerSpec, make_env_and_controller, read_controller
from morphgen.rl.robot_source import members
from morphgen.rl.rollouts import Controller
from morphgen.rl.runs import read_checkpoint
from morphgen.rl.shipped_policies import is_named, policies_for
from morphgen.tasks.env_specs import load_robot
from morphgen.tasks.gym_env import TaskEnv
from morphgen.tasks.registry import TASKS, installed_simulators
from morphgen.tasks.renderer import render_state
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.viewer.address import MAX_PLAYED
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

MAX_CHECKPOINTS = 50
"""Checkpoints that a page offers."""


@dataclass(frozen=True)
class RolloutConfig:
    """A task, robots and the policy that acts on them."""

    task: str
    robots: tuple[str, ...]
    """URIs of the robots."""
    policy: str
    """Name of a baseline, or the path of a checkpoint as an address names it."""
    seed: int = 0
    obstacles: bool = False
    simulator: str = "mujoco"


class EpisodeSource(Protocol):
    """Source of an episode: a simulation or a file."""

    episode: Episode
    max_steps: int
    """Longest possible episode [control steps]."""
    faults: dict[str, str]
    """Errors of robots that cannot do the task, by URI."""

    def advance(self) -> bool:
        """Simulate one more control step; return False if the episode has ended."""

    def close(self) -> None:
        """Free the simulation."""


class RecordedEpisode:
    """An episode from a file."""

    def __init__(self, episode: Episode) -> None:
        self.episode, self.max_steps = episode, episode.num_steps
        self.faults: dict[str, str] = {}

    def advance(self) -> bool:
        """Return False: a recorded episode has ended."""
        return False

    def close(self) -> None:
        """Do nothing: there is no simulation."""


@dataclass(eq=False)
class _SimulatedRobot:
    """A robot in its environment, and its track so far."""

    env: TaskEnv
    controller: Controller
    track: Track
    is_running: bool = True


class Rollout:
    """Robots under a policy; each has the episode of ``morphgen play`` with the same seed."""

    def __init__(
        self,
        config: RolloutConfig,
        files: FileAccess,
        progress: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Start an episode.

        Args:
            config: Task, robots and policy.
            files: Robots and checkpoints that may be read.
            progress: Called with the current activity.

        Raises:
            MorphgenError: If the policy is unknown, or none of the robots can do the task; if only
                some cannot, ``faults`` says why.
        """
        self.faults: dict[str, str] = {}
        self._robots: list[_SimulatedRobot] = []
        spec = _read_controller(config.policy, config.task, files)
        first_error: MorphgenError | None = None
        for uri in config.robots[:MAX_PLAYED]:
            progress(f"preparing {uri_name(uri)}")
            try:
                self._robots.append(_start_robot(config, uri, spec, files))
            except MorphgenError as error:
                first_error = first_error or error
                self.faults[uri] = str(error)
        if not self._robots:
            raise first_error or UriError("no robot is named: add one with &robot=")
        self.max_steps = max(int(robot.env.batch.max_episode_steps[0]) for robot in self._robots)
        self.episode = Episode(
            config.task,
            config.policy,
            config.seed,
            config.obstacles,
            config.simulator,
            CONTROL_PERIOD,
            [robot.track for robot in self._robots],
        )

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
    """Return the controller that a page names.

    Raises:
        TaskError: If the policy is unknown, is for another task, or is not a checkpoint.
        UriError: If it is a file that may not be read.
    """
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
    """Return what the policy of a checkpoint was trained on.

    Returns:
        Task of the first robot; whether any robot had obstacles, because then the policy observes
        them; names and URIs of all robots, or none if they were drawn and their list is missing.

    Raises:
        MorphgenError: If the file is not a checkpoint, or its robot cannot be read or composed.
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
