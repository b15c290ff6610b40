"""Collision tests of configurations in a scene, and sampling of free configurations."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, pairwise, product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Box, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import (
    driving_joints,
    forward_kinematics,
    joint_limits,
    periodic_joints,
    random_configurations,
)
from morphgen.model.robot import TOOL, Joint, JointKind, Link, Pair, Robot, sorted_pair
from morphgen.model.rotation import Vec3, normalize, to_rpy
from morphgen.model.tree import rigid_groups, take_name
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Scene
from morphgen.typing import Array

CELL = 0.1  # width of a grid cell [rad or m]
FEWEST, MOST = 16, 128  # smallest and largest number of cells along a joint
SAMPLES = 256  # number of random configurations that reveal which links touch
OFTEN = 0.02  # fraction of these in which two links must touch for their plane to be tested


@dataclass(frozen=True, eq=False)
class JointPlane:
    """Plane of one or two joints in which free configurations form several components."""

    pairs: tuple[Pair, ...]  # links whose contact separates the components
    joints: tuple[int, ...]  # indices of the independent joints, one or two
    lower: Array  # lower end of the grid for each joint [rad or m]
    upper: Array  # upper end of the grid for each joint [rad or m]
    main: NDArray[np.bool_]  # cells of the largest component, an axis for each joint
    turns: tuple[float, ...]  # period of each joint [rad]; 0 if it does not wrap


def cspace_components(robot: Robot) -> tuple[JointPlane, ...]:
    """Find the joint planes in which free configurations form several components, mostly none."""
    checker = SelfCollisionChecker(robot, untested_pairs(robot))
    q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
    counts = Counter(pair for contacts in checker.penetrations(q) for pair in contacts)
    pairs_of: dict[tuple[int, ...], list[Pair]] = defaultdict(list)
    for a, b in sorted(pair for pair, count in counts.items() if count >= OFTEN * SAMPLES):
        chains = {*robot.joint_chain(a)} ^ {*robot.joint_chain(b)}
        pairs_of[tuple(sorted(driving_joints(robot, chains)))].append((a, b))
    tool_joints = {*driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))}
    planes = [
        _joint_plane(robot, joints, pairs)
        for joints, pairs in pairs_of.items()
        if 0 < len(joints) <= 2 and {*joints} <= tool_joints
    ]
    return tuple(plane for plane in planes if plane is not None)


def in_other_component(planes: Sequence[JointPlane], q: Array) -> NDArray[np.bool_]:
    """Return in which planes a free configuration (dof,) is outside of the largest component."""
    return np.array([_is_outside(plane, q) for plane in planes], dtype=np.bool_)


def _is_outside(plane: JointPlane, q: Array) -> bool:
    """Return whether no equivalent of q within the limits, up to full turns, is in ``main``."""
    position, count = q[[*plane.joints]], np.array(plane.main.shape)
    # Limits of real joints span two turns at most, so two turns lead from any end to the other.
    for times in product(*((-2, -1, 0, 1, 2) if turn else (0,) for turn in plane.turns)):
        fraction = (position + np.multiply(times, plane.turns) - plane.lower) / (
            plane.upper - plane.lower
        )
        if ((fraction >= 0) & (fraction <= 1)).all():
            cell = np.minimum((fraction * count).astype(int), count - 1)
            if plane.main[tuple(cell.tolist())]:
                return False
    return True


def _joint_plane(robot: Robot, joints: tuple[int, ...], pairs: Sequence[Pair]) -> JointPlane | None:
    """Return the plane of joints; None if its free cells form one component."""
    columns = [*joints]
    lower, upper = joint_limits(robot).T[:, columns]
    count = np.clip(np.ceil((upper - lower) / CELL), FEWEST, MOST).astype(int)
    cell_centres = [
        lo + (np.arange(n) + 0.5) / n * (up - lo)
        for lo, up, n in zip(lower, upper, count, strict=True)
    ]
    q = np.tile(robot.home, (int(count.prod()), 1))
    q[:, columns] = np.stack(np.meshgrid(*cell_centres, indexing="ij"), axis=-1).reshape(len(q), -1)
    names = [link.name for link in robot.links]
    others = {sorted_pair(a, b) for a, b in combinations(names, 2)} - {*pairs}
    free = SelfCollisionChecker(robot, sorted(others)).free(q).reshape(count)
    continuous = [robot.joints[robot.independent_joints[j]].kind == "continuous" for j in joints]
    components = _components(free, continuous)
    if components.max() < 2:
        return None
    largest = int(np.bincount(components[components > 0]).argmax())
    # A free configuration may be in a cell whose centre is not: it belongs to the nearest free one.
    nearest = ndimage.distance_transform_edt(~free, return_distances=False, return_indices=True)
    periods = np.where(periodic_joints(robot)[columns], 2 * np.pi, 0.0)
    main = components[tuple(nearest)] == largest
    return JointPlane(tuple(pairs), joints, lower, upper, main, tuple(periods.tolist()))


def _components(free: NDArray[np.bool_], continuous: Sequence[bool]) -> NDArray[np.int64]:
    """Label the component of each free cell, from 1; continuous joints wrap around."""
    labels, count = ndimage.label(free, np.ones((3,) * free.ndim))  # diagonal neighbours count
    merged_label = np.arange(count + 1)
    for axis, wraps in enumerate(continuous):
        if wraps:
            first, last = (np.take(labels, i, axis=axis) for i in (0, -1))
            for a, b in zip(np.ravel(first).tolist(), np.ravel(last).tolist(), strict=True):
                if a and b:
                    merged_label[merged_label == merged_label[b]] = merged_label[a]
    return np.asarray(np.unique(merged_label, return_inverse=True)[1][labels], dtype=np.int64)


TRIES = 1000  # configurations to test per required free one before giving up
RESOLUTION = 0.05  # largest change of a joint between tested configurations of a path [rad or m]

SAME = 0.02  # largest difference of joints between configurations that count as the same [rad or m]
COMPARED = 12  # number of different configurations whose paths are tested

_GROUND_SIZE = (200.0, 200.0, 20.0)  # size of the box whose top is the ground [m]
_POINT = 1e-3  # radius of the ball that represents the tool point [m]
_CHUNK = 256
"""Configurations drawn at a time; part of the random stream, so a change gives other goals."""
_MOTIONS: tuple[tuple[JointKind, Vec3], ...] = (
    ("prismatic", (1.0, 0.0, 0.0)),
    ("prismatic", (0.0, 1.0, 0.0)),
    ("prismatic", (0.0, 0.0, 1.0)),
    ("continuous", (0.0, 0.0, 1.0)),
    ("continuous", (0.0, 1.0, 0.0)),
    ("continuous", (1.0, 0.0, 0.0)),
)
"""Kinds and axes of the block's virtual joints: x, y, z, then yaw, pitch and roll."""
_AWAY = (0.0, 0.0, 1e4, 0.0, 0.0, 0.0)
"""Positions of the block's virtual joints without a pose of the block: far above everything."""


class FreeSpace:
    """A scene's robot, ground and obstacles, compiled once and tested at many configurations.

    A configuration is free if none of these pairs penetrates deeper than
    ``self_collision.PENETRATION``: two links, except for ``untested_pairs``; a link and the ground,
    except for the root link and links fixed to it; a link and an obstacle; the tool point and an
    obstacle (the point may be where no link is, as between the fingers of a hand). The block counts
    as an obstacle where its pose is given; it may stand on the ground, or in it.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        link_names = {link.name for link in scene.robot.links}
        self._obstacles = [
            take_name(f"obstacle{k}", link_names) for k in range(len(scene.obstacles))
        ]
        self._block = take_name("block", link_names)
        is_articulated = isinstance(scene.object, ArticulatedObject)
        bases = [take_name("base", link_names)] if is_articulated else []
        self._num_static = len(self._obstacles) + len(bases)
        self._checker = SelfCollisionChecker(
            _with_surroundings(scene, self._obstacles, bases, self._block)
        )

    def free(
        self, q: ArrayLike, blocks: ArrayLike | None = None, *, stop: bool = False
    ) -> NDArray[np.bool_]:
        """Return which configurations (n, dof) [rad or m] are free, shape (n,).

        Where a block, at poses (n, 7) in the world, penetrates an obstacle or the root link, no
        configuration is free. With ``stop`` those after the first that is not free are not tested.
        """
        return self._checker.free(self._positions(q, blocks), stop=stop)

    def free_fraction(
        self, start: Array, end: Array, block: Array | None = None, resolution: float = RESOLUTION
    ) -> float:
        """Return the fraction of a straight path between configurations that is free, from 0 to 1.

        The path is tested at points that no joint moves more than ``resolution`` between, with the
        block at a pose (7,) if there is one.
        """
        count = max(math.ceil(np.abs(end - start).max() / resolution), 1) + 1
        line = start + np.linspace(0, 1, count)[:, None] * (end - start)
        blocks = None if block is None else np.broadcast_to(block, (count, 7))
        free = self.free(line, blocks, stop=True)
        return 1.0 if free.all() else max(int(free.argmin()) - 1, 0) / (count - 1)

    def best_path(self, start: Array, paths: Array, blocks: Array | None = None) -> int | None:
        """Return the first free one of some paths (k, W, J) from a configuration (J,).

        If none is free, the first that was tested; None if there is none. A path is straight from
        waypoint to waypoint. Numbers beyond the robot's joints are padding. ``COMPARED`` paths that
        differ are tested: many starts of inverse kinematics end in one configuration.

        ``blocks`` are two poses of the block, (2, 7): where it is, and where it should not touch
        the robot at the path's end. Paths whose ends collide, which are most where a block is near,
        are then left out, and those with ends that touch it at its second pose come last.
        """
        paths, start = paths[..., : self.scene.robot.dof], start[: self.scene.robot.dof]
        difference = np.abs(paths[:, None] - paths).max(axis=(2, 3), initial=0.0)
        chosen = np.flatnonzero(~np.tril(difference < SAME, -1).any(axis=1))
        block = None
        if blocks is not None:
            block, second = blocks
            chosen = chosen[self.free(paths[chosen, -1], np.tile(block, (len(chosen), 1)))]
            is_clear = self.free(paths[chosen, -1], np.tile(second, (len(chosen), 1)))
            chosen = np.concatenate([chosen[is_clear], chosen[~is_clear]])
        for i in chosen[:COMPARED].tolist():
            points = [start, *paths[i]]
            if all(self.free_fraction(a, b, block) == 1 for a, b in pairwise(points)):
                return int(i)
        return int(chosen[0]) if len(chosen) else None

    def place_obstacles(self, poses: Sequence[Pose]) -> None:
        """Move the obstacles of the scene to other poses in the world."""
        moved = zip(self.scene.obstacles, poses, strict=True)
        obstacles = tuple(replace(obstacle, pose=pose) for obstacle, pose in moved)
        self.scene = replace(self.scene, obstacles=obstacles)
        for name, pose in zip(self._obstacles, poses, strict=True):
            self._checker.place(name, pose)

    def block_is_clear(self, blocks: ArrayLike) -> NDArray[np.bool_]:
        """Return at which poses (n, 7) the block penetrates neither an obstacle nor the base."""
        robot, poses = self.scene.robot, np.asarray(blocks, dtype=np.float64)
        fixed_names = {*self._obstacles, *(link.name for link in rigid_groups(robot)[0].links)}
        near = np.flatnonzero(_may_touch(self.scene, poses))
        clear = np.ones(len(poses), dtype=np.bool_)
        clear[near] = [
            not any(self._block in pair and fixed_names & {*pair} for pair in contacts)
            for contacts in self._penetrations(np.tile(robot.home, (len(near), 1)), poses[near])
        ]
        return clear

    def obstacle_hits(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Return which obstacles the robot penetrates, whatever else collides, (n, obstacles)."""
        rows = [{name for pair in contacts for name in pair} for contacts in self._penetrations(q)]
        hits = [[name in row for name in self._obstacles] for row in rows]
        return np.array(hits, dtype=np.bool_).reshape(len(rows), len(self._obstacles))

    def sample(
        self, n: int, rng: np.random.Generator, accept: Callable[[Array], bool] = lambda q: True
    ) -> tuple[Array, int]:
        """Sample free configurations (n, dof), uniformly; return also the number of tested ones.

        ``accept`` is a further condition on each. A smaller sample is the beginning of a larger
        one. ``rng`` advances by whole chunks.
        """
        accepted: list[Array] = []
        collisions: Counter[Pair] = Counter()
        tried = num_refused = 0
        while len(accepted) < n:
            if tried >= n * TRIES:
                raise self._too_few(len(accepted), num_refused, n, tried, collisions)
            q = random_configurations(self.scene.robot, _CHUNK, rng)[: n * TRIES - tried]
            for row, contacts in zip(q, self._penetrations(q), strict=True):
                tried += 1
                collisions.update(contacts.keys())
                if not contacts and accept(row):
                    accepted.append(row)
                    if len(accepted) == n:
                        break
                elif not contacts:
                    num_refused += 1
        return np.array(accepted).reshape(n, self.scene.robot.dof), tried

    def _too_few(
        self, num_accepted: int, num_refused: int, n: int, tried: int, collisions: Counter[Pair]
    ) -> BenchmarkError:
        """Return the error that too few random configurations are free."""
        ((a, b), count), *_ = collisions.most_common(1)
        more = ""
        if num_refused:
            more = (
                f" and {num_refused:,} more are, but cut off by links that touch, or refused by "
                "the task"
            )
        return BenchmarkError(
            f"robot {self.scene.robot.name!r}: only {num_accepted} of {tried:,} random "
            f"configurations are free of collisions{more} (acceptance rate "
            f"{num_accepted / tried:.2g}), {n} are needed; most often {a!r} and {b!r} collide, in "
            f"{count / tried:.0%}: lift the robot off the ground, by a base or its place in the "
            "world, or narrow the limits of its joints"
        )

    def _penetrations(
        self, q: ArrayLike, blocks: ArrayLike | None = None
    ) -> Iterator[dict[Pair, float]]:
        """Yield the penetration depths [m] by pair of links at each configuration."""
        return self._checker.penetrations(self._positions(q, blocks))

    def _positions(self, q: ArrayLike, blocks: ArrayLike | None) -> Array:
        """Return joint positions of the robot with its surroundings, shape (n, dof + more)."""
        q = np.asarray(q, dtype=np.float64)
        robot = self.scene.robot
        if q.ndim != 2 or q.shape[1] != robot.dof:
            raise ValueError(f"q has shape {q.shape}; {robot.name} needs (n, {robot.dof})")
        if not np.isfinite(q).all():  # NaN collides with nothing, and would be free
            raise ValueError(f"q of {robot.name} is not finite")
        parts = [q, np.zeros((len(q), self._num_static))]
        if blocks is not None:
            blocks = np.asarray(blocks, dtype=np.float64)
            rpy = np.array([_rpy(*rotation) for rotation in blocks[:, 3:].tolist()]).reshape(-1, 3)
            parts += [blocks[:, :3], rpy[:, ::-1]]
        elif self.scene.object:
            parts.append(np.tile(_AWAY, (len(q), 1)))
        return np.concatenate(parts, axis=1)


@lru_cache(maxsize=256)  # a plan tests a block at a thousand places with one rotation
def _rpy(w: float, x: float, y: float, z: float) -> Vec3:
    """Return roll, pitch and yaw of a quaternion [rad]."""
    return to_rpy(normalize((w, x, y, z)))


def outside_limits(robot: Robot, q: Array) -> Iterator[tuple[int, str]]:
    """Yield the row of each of the configurations (n, dof) outside of joint limits, and why."""
    names = [robot.joints[k].name for k in robot.independent_joints]
    low, high = joint_limits(robot).T
    outside = (q < low) | (q > high) | ~np.isfinite(q)
    for i, j in np.argwhere(outside).tolist():
        yield i, f"joint {names[j]!r} is at {q[i, j]:g}, outside ({low[j]:g}, {high[j]:g})"


def _may_touch(scene: Scene, blocks: Array) -> NDArray[np.bool_]:
    """Return where the block's sphere meets a box around the robot's base or an obstacle, (n,)."""
    radius = float(np.linalg.norm(np.abs(bounding_box(scene.object_shapes)).max(axis=0)))
    T_world_root, robot = scene.T_world_root.matrix, scene.robot
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    boxes = [
        (T_world_root @ T_root_link[robot.link_index[link.name]], bounding_box(link.collisions))
        for link in rigid_groups(robot)[0].links
        if link.collisions
    ]
    for obstacle in scene.obstacles:
        half = np.array(obstacle.size) / 2
        boxes.append((obstacle.pose.matrix, np.stack([-half, half])))
    near = np.zeros(len(blocks), dtype=np.bool_)
    for T_world_box, (low, high) in boxes:
        centres = (blocks[:, :3] - T_world_box[:3, 3]) @ T_world_box[:3, :3]
        gap = np.maximum(np.maximum(low - centres, centres - high), 0)
        near |= np.linalg.norm(gap, axis=1) <= radius
    return near


def _with_surroundings(
    scene: Scene, obstacles: Sequence[str], bases: Sequence[str], block: str
) -> Robot:
    """Return the robot with ground, obstacles, block and tool point as further links.

    Links that are fixed to each other are never tested, as the ground and the root. Obstacles and
    bases of objects must be tested against the root: they are on virtual slides that stay at zero.
    The block, or the link of the object that moves, has virtual joints for every direction.
    """
    robot = scene.robot
    link_names = {link.name for link in robot.links}
    joint_names = {joint.name for joint in robot.joints}
    world = Link(take_name("world", link_names))

    def joint_name(child: str) -> str:
        return take_name(f"to_{child}", joint_names)

    root = robot.root.name
    to_root = Joint(joint_name("root"), "fixed", world.name, root, scene.T_world_root)
    static_links: list[Link] = []
    new_joints: list[Joint] = []
    if scene.ground is not None:
        slab = Shape(Box(_GROUND_SIZE), Pose((0.0, 0.0, scene.ground - _GROUND_SIZE[2] / 2)))
        ground = Link(take_name("ground", link_names), collisions=(slab,))
        static_links.append(ground)
        new_joints.append(Joint(joint_name("ground"), "fixed", world.name, ground.name))
    boxes: list[tuple[tuple[Shape, ...], Pose]]
    boxes = [((Shape(Box(each.size)),), each.pose) for each in scene.obstacles]
    standing = [*zip(obstacles, boxes, strict=True)]
    if isinstance(scene.object, ArticulatedObject):
        standing += [(base, (scene.object.base_shapes, scene.object.pose)) for base in bases]
    for name, (shapes, pose) in standing:
        static_links.append(Link(name, collisions=shapes))
        at = (world.name, name, pose)
        new_joints.append(Joint(joint_name(name), "prismatic", *at, limits=(0.0, 0.0)))
    ignored = [*untested_pairs(robot), *((base, block) for base in bases)]
    ignored += [*combinations([link.name for link in static_links], 2)]
    block_links: list[Link] = []
    if scene.object is not None:
        if scene.ground is not None:
            ignored.append((block, static_links[0].name))
        for kind, axis in _MOTIONS:
            is_last = len(block_links) == len(_MOTIONS) - 1
            name = block if is_last else take_name(f"carrier{len(block_links)}", link_names)
            shapes = scene.object_shapes if is_last else ()
            parent = block_links[-1].name if block_links else world.name
            block_links.append(Link(name, collisions=shapes))
            new_joints.append(Joint(joint_name(name), kind, parent, name, axis=axis))
    tool_links: list[Link] = []
    for frame in robot.frames:
        if frame.name == TOOL and (obstacles or block_links):
            ball = Shape(Sphere(_POINT), frame.T_link_frame)
            point = Link(take_name("point", link_names), collisions=(ball,))
            tool_links.append(point)
            new_joints.append(Joint(joint_name("point"), "fixed", frame.link, point.name))
            ignored += [
                (point.name, link.name)
                for link in (*robot.links, *static_links)
                if link.name not in (*obstacles, *bases)
            ]
    return replace(
        robot,
        links=(world, *robot.links, *static_links, *block_links, *tool_links),
        joints=(to_root, *robot.joints, *new_joints),
        home=(*robot.home, *(0.0 for _ in (*obstacles, *bases)), *(_AWAY if block_links else ())),
        ignore_pairs=tuple(ignored),
    )
