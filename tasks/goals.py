"""Goal sets: tool poses that are known to be reachable, each with a configuration that proves it.

The configurations are the starts of episodes too.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from morphgen.benchmark.split import robot_hash
from morphgen.benchmark.workspace import shoulder
from morphgen.errors import BenchmarkError
from morphgen.formats.mujoco_kinematics import MujocoKinematics
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import bounds, frame_pose
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.barriers import barriers, beyond
from morphgen.tasks.config import ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.obstacles import draw_obstacles
from morphgen.tasks.set_files import cached, require_own
from morphgen.tasks.sim.base import Block, Scene

Array = NDArray[np.float64]

FORMAT = 4
"""Of a stored set; a change of how sets are drawn needs another."""
EXACT = 1e-6
"""Largest deviation of a goal from its witness's tool, metres and of a quaternion."""


@dataclass(frozen=True, eq=False)
class GoalSet:
    """Goals of a robot, which are its starts too, and the obstacles that they are free of."""

    robot: str
    key: str
    """Hash of all that the set follows from: 64 hexadecimal digits."""
    q: Array
    """Witnesses: free configurations, none beyond a barrier, shape (G, dof), rad or m."""
    poses: Array
    """Of the tool at them in the root frame: (x, y, z, qw, qx, qy, qz), qw >= 0, shape (G, 7)."""
    obstacles: tuple[Block, ...]
    tried: int
    """Random configurations that were tested."""
    accepted: int
    """How many of these are such: G."""
    seed: int


def goal_set(
    robot: Robot,
    config: ReachConfig,
    *,
    obstacles: bool,
    seed: int,
    ground: float = 0.0,
    cache: Path | None = None,
    shipped: GoalSet | None = None,
) -> GoalSet:
    """A robot's goal set: one that came with a split, or from the cache, or made and kept there.

    Configurations are drawn uniformly within the joint limits; what collides, with the ground and
    obstacles too, is drawn again, and so is what the robot's own links part from the rest (see
    ``barriers``). The same body, pairs to ignore, seed, ground, goals and obstacles give the same
    set, whatever the robot is called; fewer goals are the first of more.

    Args:
        robot: The body, with a tool.
        config: How many goals, and what obstacles.
        obstacles: Whether there are any.
        seed: Of all that is drawn, at least 0.
        ground: Height of the ground in the root frame, metres.
        cache: Folder of stored sets; by default ``goals`` in the user's cache.
        shipped: The set to take, which must be of all this.

    Raises:
        BenchmarkError: If the set cannot be drawn: the robot has no tool that moves, hardly a free
            configuration, or no room for obstacles.
        TaskError: If its file is broken, or the one that is shipped is another.
        MeshError: If a mesh cannot be read.
    """
    if seed < 0 or config.goals < 1:
        raise BenchmarkError(
            f"{config.goals} goals with seed {seed}: at least one goal, and no negative seed"
        )
    shoulder(robot)  # refuses a robot whose tool does not move
    body = robot_hash(robot, visuals=False)
    key = _key(robot, body, config, obstacles, seed, ground)
    if shipped is not None:
        require_own(shipped, key, robot.name)
        return shipped
    folder = user_cache_path("morphgen") / "goals-4" if cache is None else cache
    make = partial(_made, robot, body, config, obstacles, seed, ground)
    return cached(GoalSet, folder / f"{key}.npz", robot.name, make)


def _made(
    robot: Robot,
    body: str,
    config: ReachConfig,
    obstacles: bool,
    seed: int,
    ground: float,
    key: str,
) -> GoalSet:
    seeds = np.random.SeedSequence([seed, int(body, 16), int(obstacles)])
    of_goals, of_obstacles = (np.random.default_rng(child) for child in seeds.spawn(2))
    placed: tuple[Block, ...] = ()
    if obstacles:
        count, size = config.obstacles, config.obstacle_size
        placed = draw_obstacles(robot, count, size, of_obstacles, ground=ground)
    space = FreeSpace(Scene(robot, obstacles=placed, ground=ground))
    parted = barriers(robot)
    q, tried = space.draw(config.goals, of_goals, lambda each: not beyond(parted, each).any())
    poses = _vectors(frame_pose(robot, q, TOOL))
    return GoalSet(robot.name, key, q, poses, placed, tried, len(q), seed)


def certify(goals: GoalSet, robot: Robot, scene: Scene) -> list[str]:
    """Prove that every goal can be taken.

    Tool poses are MuJoCo's, not those of our kinematics, which the goals are made with.

    Args:
        goals: The set.
        robot: The body.
        scene: Where it stands, and among which obstacles.

    Returns:
        What is wrong, a line each: a witness out of limits, in collision or beyond a barrier, or
        whose tool is not at the goal; a set of another robot or other obstacles.

    Raises:
        FormatError: If MJCF cannot express the robot.
        MeshError: If a mesh cannot be read.
    """
    if goals.q.shape != (len(goals.poses), robot.dof) or goals.poses.shape[1:] != (7,):
        return [
            f"witnesses {goals.q.shape} and poses {goals.poses.shape} are no goals of robot "
            f"{robot.name!r} with {robot.dof} joints"
        ]
    wrong = []
    if scene.obstacles != goals.obstacles:
        wrong.append("the obstacles of the scene are not those of the goal set")
    wrong += [f"goal {i}: {why}" for i, why in outside_limits(robot, goals.q)]
    usable = np.flatnonzero(np.isfinite(goals.q).all(axis=1))
    free = FreeSpace(replace(scene, robot=robot)).free(goals.q[usable])
    wrong += [f"goal {i}: its witness is in collision" for i in usable[~free].tolist()]
    parted = barriers(robot)
    for i in usable[free].tolist():
        for k in np.flatnonzero(beyond(parted, goals.q[i])).tolist():
            a, b = parted[k].pairs[0]
            wrong.append(f"goal {i}: {a!r} and {b!r} touch on all ways to most others")
    tools = _vectors(MujocoKinematics(robot).frame_pose(goals.q[usable]))
    for i, tool in zip(usable.tolist(), tools, strict=True):
        away, turned = _deviation(goals.poses[i], tool)
        if not (away <= EXACT and turned <= EXACT):
            wrong.append(
                f"goal {i}: the tool of its witness is {away:.2g} m away, and its quaternion "
                f"{turned:.2g}"
            )
    return wrong


def outside_limits(robot: Robot, q: Array) -> Iterator[tuple[int, str]]:
    """Joints that are out of their limits in configurations (n, dof): the row, and what is so."""
    names = [robot.joints[k].name for k in robot.independent]
    low, high = bounds(robot).T
    outside = (q < low) | (q > high) | ~np.isfinite(q)
    for i, j in np.argwhere(outside).tolist():
        yield i, f"joint {names[j]!r} is at {q[i, j]:g}, outside ({low[j]:g}, {high[j]:g})"


def _deviation(a: Array, b: Array) -> tuple[float, float]:
    """Distance of two poses (7,), metres, and of their quaternions, whose sign means nothing."""
    turned = min(float(np.linalg.norm(a[3:] - sign * b[3:])) for sign in (1, -1))
    return float(np.linalg.norm(a[:3] - b[:3])), turned


def _vectors(T: Array) -> Array:
    """Poses (n, 4, 4) as (x, y, z, qw, qx, qy, qz), shape (n, 7)."""
    poses = [Pose.from_matrix(each) for each in T]
    return np.array([[*pose.position, *pose.quaternion] for pose in poses]).reshape(len(T), 7)


def _key(
    robot: Robot, body: str, config: ReachConfig, obstacles: bool, seed: int, ground: float
) -> str:
    index = robot.link_index
    ignored = sorted(sorted((index[a], index[b])) for a, b in robot.ignore_pairs)
    boxes = [config.obstacles, *map(float, config.obstacle_size)] if obstacles else None
    parts = [FORMAT, body, ignored, config.goals, boxes, seed, float(ground)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
