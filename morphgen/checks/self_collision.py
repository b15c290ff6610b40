"""Self-collision: which links penetrate each other, and which pairs of links are not tested.

MuJoCo tests the collision shapes; as in MuJoCo and PyBullet, a mesh counts as its convex hull.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.errors import RobotError
from morphgen.formats.quiet import MujocoWarnings
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import movable_positions, random_configurations
from morphgen.model.robot import Pair, Robot, sorted_pair
from morphgen.model.tree import rigid_groups
from morphgen.typing import Array

if TYPE_CHECKING:
    import mujoco

PENETRATION = 1e-4
"""Smallest overlap that counts as penetration [m]; faces that only touch stay below it."""
ALWAYS_SHARE = 0.95
"""Share of random configurations in which a pair must penetrate to count as always penetrating."""
SAMPLES = 128  # number of random configurations that survey_collisions tests
_MUJOCO_MEMORY = "16M"
_EPA_WARNING = "EPA"
"""Part of MuJoCo's warning that its penetration-depth algorithm (EPA) did not converge."""
_PERTURBATIONS = (0.0, *(sign * 10.0**k for k in range(-9, -4) for sign in (1, -1)))
"""Offsets of the first joint [rad or m] that are tried in turn when EPA fails.

The other joints get less, down to half of it for the last one, because equal offsets would leave
shapes on parallel slides as they are. Even the largest offset is below ``PENETRATION``.
"""


class SelfCollisionChecker:
    """A robot's collision shapes, compiled once and tested at many configurations."""

    def __init__(self, robot: Robot, ignore: Iterable[Pair] | None = None) -> None:
        """Compile the model."""
        import mujoco  # here, because commands that test no collisions should start quickly

        self._robot = robot
        self._model = _compile(robot, robot.ignore_pairs if ignore is None else ignore)
        self._data = mujoco.MjData(self._model)
        self._geom_links = [
            robot.links[int(self._model.body(i).name)].name
            for i in self._model.geom_bodyid.tolist()
        ]
        self._qpos = np.array(
            [self._model.joint(robot.joints[k].name).qposadr[0] for k in robot.movable_joints],
            np.intp,
        )
        self._perturbation = np.linspace(1.0, 0.5, len(self._qpos))

    def place(self, link: str, T_parent_joint: Pose) -> None:
        """Move the joint of a link in its parent, from now on."""
        body = self._model.body(str(self._robot.link_index[link])).id
        self._model.body_pos[body] = T_parent_joint.position
        self._model.body_quat[body] = T_parent_joint.quaternion

    def penetrations(self, q: ArrayLike) -> Iterator[dict[Pair, float]]:
        """Yield, when asked, links that penetrate at each of q (n, dof), with depths [m]."""
        rows = self._require_rows(q)
        return (self._test(positions) for positions in movable_positions(self._robot, rows))

    def free(self, q: ArrayLike, *, stop: bool = False) -> NDArray[np.bool_]:
        """Return which of q (n, dof) have no penetration, faster than ``penetrations``.

        With ``stop`` those after the first that is not free are not tested, and count as not free.
        """
        import mujoco

        model, data, qpos = self._model, self._data, self._data.qpos
        full = data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL]
        positions = movable_positions(self._robot, self._require_rows(q))
        free = np.ones(len(positions), dtype=np.bool_)
        with MujocoWarnings() as warnings:
            for i, row in enumerate(positions):
                qpos[self._qpos] = row
                mujoco.mj_kinematics(model, data)
                mujoco.mj_collision(model, data)
                if warnings or full.number:  # the full test decides what to do about them
                    warnings.clear()
                    free[i] = not self._test(row)
                elif data.ncon:  # few contacts: faster than the minimum of an array
                    free[i] = min(data.contact.dist.tolist()) >= -PENETRATION
                if stop and not free[i]:
                    free[i:] = False
                    break
        return free

    def _require_rows(self, q: ArrayLike) -> Array:
        q = np.asarray(q, dtype=np.float64)
        if q.ndim != 2:
            raise ValueError(f"q has shape {q.shape}; {self._robot.name} needs (n, dof)")
        return q

    def _test(self, positions: Array) -> dict[Pair, float]:
        import mujoco

        self._collide(positions)
        depths: dict[Pair, float] = {}
        if self._data.ncon == 0:
            return depths
        if self._data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number:
            raise RobotError(
                f"robot {self._robot.name!r}: its contacts at one configuration exceed "
                f"{_MUJOCO_MEMORY}; ignore the pairs that always overlap"
            )
        contact = self._data.contact
        for (a, b), distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            if distance < -PENETRATION:
                pair = sorted_pair(self._geom_links[a], self._geom_links[b])
                depths[pair] = max(depths.get(pair, -distance), -distance)
        return depths

    def _collide(self, positions: Array) -> None:
        """Find the contacts at movable joint positions, perturbed slightly where EPA fails."""
        import mujoco

        for offset in _PERTURBATIONS:
            self._data.qpos[self._qpos] = positions + offset * self._perturbation
            mujoco.mj_kinematics(self._model, self._data)
            with MujocoWarnings() as warnings:
                mujoco.mj_collision(self._model, self._data)
            if not any(_EPA_WARNING in warning for warning in warnings):
                return
        raise RobotError(
            f"robot {self._robot.name!r}: MuJoCo finds no penetration depth of two overlapping "
            f"shapes at movable joint positions {positions.tolist()}: {warnings[0]}"
        )


@dataclass(frozen=True)
class CollisionSurvey:
    """Pairs of links to ignore, and the penetrations at the home configuration."""

    ignore_pairs: tuple[Pair, ...]  # pairs whose contact is not a self-collision, sorted
    home_penetrations: Mapping[Pair, float]
    """Depth [m] of the pairs that penetrate at home; adjacent and known pairs are not tested."""


def survey_collisions(
    robot: Robot,
    *,
    known_pairs: Iterable[Pair] = (),
    should_test: Callable[[str, str], bool] | None = None,
) -> CollisionSurvey:
    """Find pairs of links whose contact is no self-collision: adjacent, at home, nearly always.

    So a robot with these pairs ignored is free of self-collision at home. A robot of parts costs
    less with their ``known_pairs`` and, as ``should_test``, whether two links are of different
    parts.
    """
    ignore = {sorted_pair(*pair) for pair in known_pairs} | set(adjacent_pairs(robot))
    collidable = [link.name for link in robot.links if link.collisions]
    remaining = set(_pairs(collidable)) - ignore
    if not remaining:
        return CollisionSurvey(tuple(sorted(ignore)), {})
    checker = SelfCollisionChecker(robot, ignore)
    (home_penetrations,) = checker.penetrations([robot.home])
    ignore.update(home_penetrations)
    remaining = {pair for pair in remaining - ignore if should_test is None or should_test(*pair)}
    if remaining and robot.dof:
        q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
        ignore.update(_always_penetrating(checker, q, remaining))
    return CollisionSurvey(tuple(sorted(ignore)), home_penetrations)


def _always_penetrating(checker: SelfCollisionChecker, q: Array, pairs: set[Pair]) -> set[Pair]:
    """Return the pairs that penetrate in at least ``ALWAYS_SHARE`` of the configurations."""
    separations = dict.fromkeys(pairs, 0)
    for depths in checker.penetrations(q):
        for pair in separations.keys() - depths.keys():
            separations[pair] += 1
            if len(q) - separations[pair] < ALWAYS_SHARE * len(q):
                del separations[pair]
        if not separations:  # most pairs separate at once, which spares the other configurations
            break
    return set(separations)


def untested_pairs(robot: Robot) -> tuple[Pair, ...]:
    """Return the pairs that no collision test considers: ``ignore_pairs`` and adjacent links."""
    return tuple(sorted({*robot.ignore_pairs, *adjacent_pairs(robot)}))


def adjacent_pairs(robot: Robot) -> tuple[Pair, ...]:
    """Return the pairs of links in one rigid group or across one movable joint, sorted.

    Only links with collision shapes count; groups on both sides of one without any are adjacent.
    """
    groups = rigid_groups(robot)
    group_of = {link.name: i for i, group in enumerate(groups) for link in group.links}
    nearest: list[list[str]] = []  # of each group, or of the next one above that has shapes
    pairs: set[Pair] = set()
    for group in groups:
        names = [link.name for link in group.links if link.collisions]
        parent = robot.parents[robot.link_index[group.links[0].name]]
        above = nearest[group_of[robot.links[parent].name]] if parent >= 0 else []
        pairs.update(_pairs(names))
        pairs.update(sorted_pair(a, b) for a, b in product(names, above))
        nearest.append(names or above)
    return tuple(sorted(pairs))


def _pairs(names: Iterable[str]) -> Iterator[Pair]:
    return (sorted_pair(a, b) for a, b in combinations(names, 2))


def _compile(robot: Robot, ignore: Iterable[Pair]) -> mujoco.MjModel:
    """Compile a model of collision shapes and joints only; bodies are named by link index."""
    import mujoco
    from lxml import etree

    from morphgen.formats.mjcf.write import (
        MJCF_COMPILER,
        Meshes,
        geom_attributes,
        joint_attributes,
        pose_attributes,
    )

    meshes = Meshes(None)
    root = etree.Element("mujoco")
    etree.SubElement(root, "compiler", MJCF_COMPILER)
    etree.SubElement(root, "size", memory=_MUJOCO_MEMORY)
    # By default MuJoCo tests no body that is welded to the world against its children.
    etree.SubElement(etree.SubElement(root, "option"), "flag", filterparent="disable")
    asset = etree.SubElement(root, "asset")
    bodies = [etree.SubElement(root, "worldbody")]
    for i, link in enumerate(robot.links):
        joint = robot.joints[i - 1] if i else None
        pose = pose_attributes(joint.T_parent_joint) if joint else {}
        parent = bodies[robot.parents[i] + 1]
        body = etree.SubElement(parent, "body", {"name": str(i)} | pose)
        if joint is not None and joint.is_movable:
            etree.SubElement(body, "joint", joint_attributes(joint))
        for shape in link.collisions:
            etree.SubElement(body, "geom", geom_attributes(shape, meshes, collision=True))
        bodies.append(body)
    meshes.write(asset)
    contact = etree.SubElement(root, "contact")
    for a, b in ignore:
        indices = [str(robot.link_index[robot.link(name).name]) for name in (a, b)]
        etree.SubElement(contact, "exclude", body1=indices[0], body2=indices[1])
    try:
        spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
        meshes.add_to(spec)
        return spec.compile()
    except ValueError as error:
        raise RobotError(
            f"robot {robot.name!r} has a shape or depth that MuJoCo refuses: {error}"
        ) from error
