"""Simulation of episodes: robots at a task, each in an environment of its own.

It needs PyTorch and the simulators, which take seconds to load: only the process of simulations
imports this module.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from morphgen.errors import MorphgenError, SimulationError
from morphgen.files import file_stamp
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.robot_source import is_robot_file
from morphgen.model.robot import Robot
from morphgen.processes import one_torch_thread
from morphgen.rl.baselines import BASELINES, Controller
from morphgen.rl.demonstrations.lerobot import BODIES, INFO
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.inference import ControllerSpec, make_env_and_controller, read_controller
from morphgen.rl.runs import robot_source
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.shipped_policies import is_named, policies_for
from morphgen.tasks.batch import BeforePhysics, TaskBatch
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.registry import TASKS
from morphgen.tasks.renderer import RenderState, render_state
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block
from morphgen.viewer.app.address import MAX_PLAYED
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    DERIVATION,
    WORDS,
    FileAccess,
    UriError,
    read_robot_uri,
    with_library_meshes,
)
from morphgen.viewer.rollout import (
    BLOCK,
    Array,
    Episode,
    EpisodeSource,
    RolloutConfig,
    Track,
    checkpoint_path,
)


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
        super().__init__(episode, max_steps, {uri: str(error) for uri, error in faults.items()})

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
    if not is_named(policy):
        policy = str(checkpoint_path(policy, policies_for(task), files))
    return read_controller(policy, task)


def training_robots(policy: str, files: FileAccess) -> tuple[str, bool, list[tuple[str, str]]]:
    """Return task, obstacles, names and URIs of a checkpoint's robots; none if not listed."""
    path = checkpoint_path(policy, BASELINES, files)
    source = read_checkpoint(path)[0].source
    rows = robot_source.members(source)
    if isinstance(source, robot_source.GrammarSource):
        folder = path if path.is_dir() else path.parent
        rows = robot_source.read_drawn(folder) if (folder / robot_source.FILE).is_file() else ()
        if not rows:
            return robot_source.tasks_of(source)[0], source.obstacles, []
    if rows:
        robots = [(row.name, f"{DERIVATION}{row.derivation}") for row in rows]
        return rows[0].task, any(row.obstacles for row in rows), robots
    assert isinstance(source, robot_source.OneRobot)  # splits and grammars have members
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
        track = _track(robot, uri, env.batch)
        stack.pop_all()  # keeps the environment open
        return _SimulatedRobot(env, controller, track)


def _track(robot: Robot, uri: str, batch: TaskBatch) -> Track:
    """Return the track of a robot at the start of its episode in the first environment."""
    start, spec = render_state(batch), batch.specs[0]
    thing = spec.scene.object
    return Track(
        split_colours(robot),
        uri,
        spec.scene.ground,
        batch.layouts.obstacles(0),
        TASKS[spec.task].markers(spec.config, spec.goals),
        thing.size if isinstance(thing, Block) else None,
        thing if isinstance(thing, ArticulatedObject) else None,
        [start.q],
        {name: [pose] for name, pose in _poses(start).items()},
    )


def _poses(state: RenderState) -> dict[str, Array]:
    return {**state.markers} | ({} if state.block is None else {BLOCK: state.block})


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


@lru_cache(maxsize=1)
def _read_demonstrations(folder: Path, stamp: object) -> Demonstrations:
    del stamp  # a data set that was recorded anew is read again
    return Demonstrations(folder)


def _demonstrations(folder: str, files: FileAccess) -> Demonstrations:
    path = files.path(folder)
    return _read_demonstrations(path, file_stamp(path / INFO))


def list_episodes(
    folder: str, files: FileAccess
) -> tuple[list[tuple[str, str]], list[tuple[int, bool]]]:
    """Return the robots of demonstrations, and the robot's number and success of each episode."""
    demos = _demonstrations(folder, files)
    episodes = [(each.robot_index, each.success) for each in demos.episodes]
    return [*zip(demos.robot_names, demos.robot_hashes, strict=True)], episodes


@one_torch_thread()
def recorded_episode(folder: str, index: int, files: FileAccess) -> Episode:
    """Return an episode as recorded; the state before the last step stands for the last."""
    demos = _demonstrations(folder, files)
    if not 0 <= index < len(demos.episodes):
        last = len(demos.episodes) - 1
        raise UriError(f"{folder} has no episode {index}; expected a number from 0 to {last}")
    recorded, batch = demos.episodes[index], demos.episode_batch(index)
    uri = f"{folder.rstrip('/')}/{BODIES}/{recorded.robot_hash}"
    if not (batch.q.isfinite().all() and batch.simulation.object_pose.isfinite().all()):
        raise SimulationError(f"{folder}: the states of episode {index} are not finite")
    track, steps = _track(read_robot_uri(uri, files), uri, batch), recorded.length
    for env in (*range(1, steps), steps - 1):
        state = render_state(batch, env)
        track.q.append(state.q)
        for name, pose in _poses(state).items():
            track.poses[name].append(pose)
    # What the task says of a state is the result of the step that led there.
    still = BeforePhysics(batch.targets, batch.q, batch.simulation.object_pose)
    results = batch.finish(still, torch.zeros(batch.num_envs, dtype=torch.bool))
    track.distance = [*results.distance[1:].tolist(), recorded.distance]
    track.score = results.score[1:].tolist()
    score_of, total = TASKS[recorded.task].episode_score, sum(track.score)
    at_zero, at_one = (score_of(total + last, last, steps) for last in (0.0, 1.0))
    track.score.append((recorded.score - at_zero) / (at_one - at_zero))
    rows = slice(recorded.first, recorded.first + steps)
    track.success = demos.columns["next.success"][rows].tolist()
    track.reward = demos.columns["next.reward"][rows].tolist()
    return Episode(
        recorded.task,
        recorded.policy,
        recorded.seed,
        bool(track.obstacles),
        demos.settings["sim"],
        CONTROL_PERIOD,
        [track],
    )


STEPS_AHEAD = 5  # control steps that are simulated at once, while the ones before are shown
_rollouts: dict[str, Rollout] = {}  # those that run in this process, by key


def start(key: str, config: RolloutConfig, files: FileAccess) -> EpisodeSource:
    """Start a rollout; return its robots at their start."""
    rollout = _rollouts[key] = Rollout(config, files)
    return EpisodeSource(rollout.episode, rollout.max_steps, rollout.faults)


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
