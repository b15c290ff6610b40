"""Simulation of episodes: robots at a task, each in an environment of its own.

It needs PyTorch and the simulators, which take seconds to load: only the process of simulations
imports this module.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from morphgen.errors import MorphgenError, SimulationError
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.robot_source import is_robot_file
from morphgen.rl.baselines import BASELINES, Controller
from morphgen.rl.inference import ControllerSpec, make_env_and_controller, read_controller
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.robot_source import (
    FILE,
    GrammarSource,
    OneRobot,
    members,
    read_drawn,
    tasks_of,
)
from morphgen.rl.shipped_policies import is_named, policies_for
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.registry import TASKS
from morphgen.tasks.render.renderer import render_state
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block
from morphgen.viewer.app.address import MAX_PLAYED
from morphgen.viewer.episode import BLOCK, Array, Episode, Track
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    DERIVATION,
    WORDS,
    FileAccess,
    UriError,
    read_robot_uri,
    with_library_meshes,
)
from morphgen.viewer.rollout import EpisodeSource, RolloutConfig, checkpoint_path


@dataclass(eq=False)
class _SimulatedRobot:
    """A robot in its environment, and its track so far."""

    env: TaskEnv
    controller: Controller
    track: Track
    is_running: bool = True


class Rollout(EpisodeSource):
    """Robots under a policy; each has the episode of ``morphgen play`` with the same seed."""

    def __init__(self, config: RolloutConfig, files: FileAccess) -> None:
        """Start an episode."""
        faults: dict[str, MorphgenError] = {}
        self._robots: list[_SimulatedRobot] = []
        spec = _read_controller(config.policy, config.task, files)
        for uri in config.robots[:MAX_PLAYED]:
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


def _read_controller(policy: str, task: str, files: FileAccess) -> ControllerSpec:
    """Return the controller that a page names."""
    if not is_named(policy):
        policy = str(checkpoint_path(policy, policies_for(task), files))
    return read_controller(policy, task)


def training_robots(policy: str, files: FileAccess) -> tuple[str, bool, list[tuple[str, str]]]:
    """Return task, obstacles, and names and URIs of the robots of a checkpoint's training.

    It has obstacles if any robot had, because then the policy observes them. There are no robots
    if they were drawn and their list is missing.
    """
    path = checkpoint_path(policy, BASELINES, files)
    source = read_checkpoint(path)[0].source
    rows = members(source)
    if isinstance(source, GrammarSource):
        folder = path if path.is_dir() else path.parent
        rows = read_drawn(folder) if (folder / FILE).is_file() else ()
        if not rows:
            return tasks_of(source)[0], source.obstacles, []
    if rows:
        robots = [(row.name, f"{DERIVATION}{row.derivation}") for row in rows]
        return rows[0].task, any(row.obstacles for row in rows), robots
    assert isinstance(source, OneRobot)  # splits and grammars have members
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
        thing = env_spec.scene.object
        poses = {**start.markers} | ({} if start.block is None else {BLOCK: start.block})
        track = Track(
            split_colours(robot),
            uri,
            env_spec.scene.ground,
            env.batch.layouts.obstacles(0),
            TASKS[env_spec.task].markers(env_spec.config, env_spec.goals),
            thing.size if isinstance(thing, Block) else None,
            thing if isinstance(thing, ArticulatedObject) else None,
            [start.q],
            {name: [pose] for name, pose in poses.items()},
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
    if BLOCK in track.poses:
        track.poses[BLOCK].append(_to_numpy(step.object_pose[0]))
    ended = bool(step.terminated[0] | step.truncated[0])
    for name, pose in batch.groups.marker_poses(0).items():
        poses = track.poses[name]
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


STEPS_AHEAD = 5  # control steps that are simulated at once, while the ones before are shown
_rollouts: dict[str, Rollout] = {}  # those that run in this process, by key


def start(key: str, config: RolloutConfig, files: FileAccess) -> EpisodeSource:
    """Start a rollout; return its robots at their start."""
    rollout = _rollouts[key] = Rollout(config, files)
    source = EpisodeSource(rollout.episode, rollout.max_steps)
    source.faults = rollout.faults
    return source


def advance(key: str) -> tuple[bool, list[tuple[dict[str, Any], str]]]:
    """Simulate some steps; return whether a robot is running, and each robot's steps and fault."""
    if key not in _rollouts:  # this process has replaced that of the start
        raise SimulationError("the process that simulated this episode has died; start it again")
    rollout = _rollouts[key]
    before = [track.num_steps for track in rollout.episode.tracks]
    is_running = all([rollout.advance() for _ in range(STEPS_AHEAD)])
    tracks = zip(rollout.episode.tracks, before, strict=True)
    return is_running, [(track.recorded(num_steps), track.fault) for track, num_steps in tracks]


def close(key: str) -> None:
    """End a rollout, unless its start has failed."""
    if rollout := _rollouts.pop(key, None):
        rollout.close()


def warm_up(files: FileAccess) -> None:
    """Load what the first rollout needs."""
    robots = (WORDS + DEFAULT_WORDS,)
    with contextlib.suppress(MorphgenError):
        start("", RolloutConfig("reach", robots, "zero-shot"), files)
        advance("")
        close("")
