"""Episodes while they are simulated: bodies at a task, each in an environment of its own."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from morphgen.errors import MissingDependencyError, MorphgenError, TaskError, nearest
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.robot_source import is_robot_file
from morphgen.rl.baselines import BASELINES, baselines_for
from morphgen.rl.play import interface_of, make_controller, require_policy
from morphgen.rl.robot_source import members
from morphgen.rl.rollouts import Controller
from morphgen.rl.runs import read_checkpoint
from morphgen.tasks.batch import Step
from morphgen.tasks.env_specs import load_robot
from morphgen.tasks.gym_env import TaskEnv
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.renderer import render_state
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.viewer.episode import Array, Episode, Track
from morphgen.viewer.robot_uri import (
    CHECKPOINT,
    DERIVED,
    WORDS,
    FileAccess,
    UriError,
    name_of,
    read_robot_uri,
    shortened,
    with_library_meshes,
)

MOST = 9
"""Bodies that play at once."""


@dataclass(frozen=True)
class RolloutConfig:
    """What is to be played."""

    task: str
    places: tuple[str, ...]
    """Of the bodies."""
    policy: str
    """A name of ``morphgen.rl.play``, or the path of a checkpoint as an address has it."""
    seed: int = 0
    obstacles: bool = False
    simulator: str = "mujoco"


class Source(Protocol):
    """What an episode comes from."""

    episode: Episode
    longest: int
    """Control steps of the episode at most."""
    faults: dict[str, str]
    """Why bodies that were wanted cannot play, by place."""

    def advance(self) -> bool:
        """Simulate a control step more; false if the episode is over."""

    def close(self) -> None:
        """Free everything."""


class Recorded:
    """An episode that is over."""

    def __init__(self, episode: Episode) -> None:
        self.episode, self.longest = episode, episode.steps
        self.faults: dict[str, str] = {}

    def advance(self) -> bool:
        """There is no more."""
        return False

    def close(self) -> None:
        """There is nothing to free."""


@dataclass(eq=False)
class _Player:
    """A body in its environment."""

    env: TaskEnv
    acting: Controller
    track: Track
    running: bool = True


class Rollout:
    """Bodies under a policy; each has the episode that ``morphgen play`` has of the same seed."""

    def __init__(
        self,
        wanted: RolloutConfig,
        places: FileAccess,
        progress: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Begin an episode.

        Args:
            wanted: What is to be played.
            places: Where robots and checkpoints are.
            progress: Told what is being done.

        Raises:
            MorphgenError: If none of the bodies can play; if only some cannot, ``faults`` says why.
        """
        self.faults: dict[str, str] = {}
        self._players: list[_Player] = []
        policy = policy_file(wanted.policy, wanted.task, places)
        first: MorphgenError | None = None
        for place in wanted.places[:MOST]:
            progress(f"preparing {name_of(place)}")
            try:
                self._players.append(_player(wanted, place, policy, places))
            except MorphgenError as error:
                first = first or error
                self.faults[place] = str(error)
        if not self._players:
            raise first or UriError("no robot is named: add one with &robot=")
        self.longest = max(int(each.env.batch.max_episode_steps[0]) for each in self._players)
        self.episode = Episode(
            wanted.task,
            wanted.policy,
            wanted.seed,
            wanted.obstacles,
            wanted.simulator,
            CONTROL_PERIOD,
            [each.track for each in self._players],
        )

    def advance(self) -> bool:
        """Simulate a control step more of all that are not over; false if all are."""
        running = [each for each in self._players if each.running]
        for each in running:
            _step(each)
        return bool(running)

    def close(self) -> None:
        """Free the simulations."""
        for each in self._players:
            each.env.close()


def simulators() -> list[str]:
    """Return the names of the simulators that are installed, MuJoCo first."""
    installed = []
    for name in SIMULATORS:
        with contextlib.suppress(MissingDependencyError):
            installed.append(SIMULATORS[name].name)
    return sorted(installed, key=lambda name: name != "mujoco")


def policy_file(policy: str, task: str, places: FileAccess) -> str:
    """A policy as ``morphgen.rl.play`` knows it; the path of a checkpoint becomes absolute.

    Raises:
        TaskError: If there is none of that name, or it is for the other task.
        UriError: If it is a file that may not be looked at.
    """
    if policy not in BASELINES:
        return str(_checkpoint_file(policy, baselines_for(task), places))
    require_policy(policy, task)
    return policy


def _checkpoint_file(policy: str, references: Iterable[str], places: FileAccess) -> Path:
    """The file or folder of a checkpoint."""
    try:
        return places.path(policy)
    except UriError as error:
        if "/" in policy or policy.endswith(".pt"):
            raise
        raise TaskError(
            f"{shortened(policy)!r} is no checkpoint, and no policy{nearest(policy, references)}"
        ) from error


def checkpoints(places: FileAccess, most: int = 50) -> list[str]:
    """The first checkpoints below the folder ``runs``, as addresses have them."""
    root = places.roots[0]
    found = sorted((root / "runs").rglob(CHECKPOINT))
    return [path.relative_to(root).as_posix() for path in found[:most]]


def trained_with(policy: str, places: FileAccess) -> tuple[str, bool, list[tuple[str, str]]]:
    """What the policy of a checkpoint was trained on.

    Returns:
        The task of the first body, whether any had obstacles (then the policy sees where some are),
        and names and places of all.

    Raises:
        MorphgenError: If it is no checkpoint, or its robot has no parts to be made of.
    """
    source = read_checkpoint(_checkpoint_file(policy, BASELINES, places))[0].source
    rows = members(source)
    if rows:
        named = [(row.name, f"{DERIVED}{row.derivation}") for row in rows]
        return rows[0].task, any(row.obstacles for row in rows), named
    words = source.name.split()
    if is_robot_file(source.name):
        robot = read_robot_uri(source.name, places)
    elif words and words[0].endswith(SUFFIX):
        robot = read_robot_uri(WORDS + source.name, places)
    else:
        robot = load_robot(source.name, library=places.folders)
    derivation = robot.provenance.get("derivation")
    place = f"{DERIVED}{derivation}" if derivation else source.name
    assert source.task is not None  # a split says it of its robots, which are looked at above
    return source.task, source.obstacles, [(source.name, place)]


def _player(wanted: RolloutConfig, place: str, policy: str, places: FileAccess) -> _Player:
    read = read_robot_uri(place, places)
    body = as_primitives(with_library_meshes(read, places.library), places.folders)
    seen = interface_of(policy)
    env = TaskEnv(
        wanted.task,
        body,
        sim=wanted.simulator,
        obstacles=wanted.obstacles,
        kind=seen.kind,
        observe=seen.channels,
        max_links=seen.max_links,
        library=places.folders,
    )
    try:
        acting = make_controller(policy, env, wanted.seed)
        env.batch.reset(wanted.seed)
    except MorphgenError:
        env.close()
        raise
    now, spec = render_state(env.batch), env.env_spec
    track = Track(
        split_colours(read),
        place,
        spec.scene.ground,
        spec.scene.obstacles,
        TASKS[spec.task].markers(spec.config, spec.goals),
        spec.scene.block.size if spec.scene.block else None,
        [now.q],
        [] if now.block is None else [now.block],
        {name: [pose] for name, pose in now.markers.items()},
    )
    return _Player(env, acting, track)


def _step(player: _Player) -> None:
    """Act once; an episode that ends is not followed by another."""
    batch, track = player.env.batch, player.track
    try:
        step: Step = batch.step(player.acting.act(batch))
    except MorphgenError as error:
        player.running, track.fault = False, str(error)
        return
    if track.block:
        track.block.append(_numbers(step.block_pose[0]))
    over = bool(step.terminated[0] | step.truncated[0])  # then the batch is at the next episode
    for name, pose in batch.groups.marker_poses(0).items():
        poses = track.marker_poses[name]
        poses.append(poses[-1] if over else pose)
    track.score.append(float(step.score[0]))
    track.distance.append(float(step.distance[0]))
    track.success.append(bool(step.success[0]))
    track.q.append(_numbers(step.q[0, : track.robot.dof]))
    player.running = not over
    if step.diverged[0]:
        track.fault = "the simulation became unstable"


def _numbers(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy(), dtype=np.float32)
