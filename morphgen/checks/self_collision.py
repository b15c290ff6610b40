"""Self-collision: which links penetrate each other, and which pairs do so by design.

Collision shapes are tested by MuJoCo; a mesh counts as its convex hull, as in every simulator
that these robots run in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations, product

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike, NDArray

from morphgen.errors import RobotError
from morphgen.formats.mjcf_elements import (
    Meshes,
    geom_attributes,
    joint_attributes,
    pose_attributes,
)
from morphgen.formats.mujoco_urdf import MJCF_COMPILER_ATTRIBUTES
from morphgen.model.kinematics import movable_positions, random_configurations
from morphgen.model.robot import Pair, Robot, sorted_pair
from morphgen.model.tree import RigidGroup, rigid_groups

PENETRATION = 1e-4
"""Depth from which an overlap counts as penetration, metres; faces that only meet do not."""
MOSTLY = 0.95
"""Share of random configurations from which a penetrating pair counts as never separating."""
SAMPLES = 128
"""Random configurations that ``ignore_pairs`` draws."""
_MEMORY = "16M"
_GAVE_UP = "EPA"
"""What a warning of MuJoCo's has if the depth of two shapes that overlap was not found."""
_NUDGES = (0.0, *(sign * 10.0**k for k in range(-9, -4) for sign in (1, -1)))
"""By how much the first joint is moved then, rad or m, and the last by half of it, lest shapes on
parallel slides stay as they are: the least that helps, and nothing as far as depths that count."""


class SelfCollisionChecker:
    """A robot's collision shapes, compiled once and tested at many configurations."""

    def __init__(self, robot: Robot, ignore: Iterable[Pair] | None = None) -> None:
        """Compile.

        Args:
            robot: The body.
            ignore: Pairs of links that are not tested; by default ``robot.ignore_pairs``. Links
                joined by fixed joints are one body and never tested against each other.

        Raises:
            MeshError: If a collision mesh cannot be read.
            RobotError: If ``ignore`` names a link that the robot does not have.
        """
        self._robot = robot
        self._model = _model(robot, robot.ignore_pairs if ignore is None else ignore)
        self._data = mujoco.MjData(self._model)
        self._links = [int(self._model.body(i).name) for i in self._model.geom_bodyid.tolist()]
        self._addresses = np.array(
            [self._model.joint(robot.joints[k].name).qposadr[0] for k in robot.movable_joints],
            np.intp,
        )
        self._shares = np.linspace(1.0, 0.5, len(self._addresses))

    def penetrations(self, q: ArrayLike) -> list[dict[Pair, float]]:
        """Test configurations.

        Args:
            q: Independent joint positions, shape (n, dof), rad or m.

        Returns:
            For every configuration, the depth (metres, more than ``PENETRATION``) of every
            penetrating pair of links.

        Raises:
            ValueError: If ``q`` has another shape.
            RobotError: If the contacts of one configuration do not fit into memory, or MuJoCo
                finds no depth of two shapes that overlap.
        """
        return list(self.each(q))

    def each(self, q: ArrayLike) -> Iterator[dict[Pair, float]]:
        """What ``penetrations`` returns, one configuration at a time."""
        q = np.asarray(q, dtype=np.float64)
        if q.ndim != 2:
            raise ValueError(f"q has shape {q.shape}; {self._robot.name} needs (n, dof)")
        return (self._test(positions) for positions in movable_positions(self._robot, q))

    def _test(self, positions: NDArray[np.float64]) -> dict[Pair, float]:
        data = self._data
        self._collide(positions)
        depths: dict[Pair, float] = {}
        if data.ncon == 0:
            return depths
        if data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number:
            raise RobotError(
                f"robot {self._robot.name!r}: its contacts at one configuration exceed {_MEMORY}; "
                "ignore the pairs that always overlap"
            )
        contact = data.contact
        for (a, b), distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            if distance < -PENETRATION:
                links = self._robot.links
                pair = sorted_pair(links[self._links[a]].name, links[self._links[b]].name)
                depths[pair] = max(depths.get(pair, 0.0), -distance)
        return depths

    def _collide(self, positions: NDArray[np.float64]) -> None:
        """Find contacts, a hair beside the configuration if MuJoCo gives up on a pair there."""
        for nudge in _NUDGES:
            self._data.qpos[self._addresses] = positions + nudge * self._shares
            mujoco.mj_kinematics(self._model, self._data)
            with capture_mujoco_warnings() as told:
                mujoco.mj_collision(self._model, self._data)
            if not any(_GAVE_UP in each for each in told):
                return
        raise RobotError(
            f"robot {self._robot.name!r}: MuJoCo cannot say how deep two of its shapes overlap at "
            f"movable joint positions {positions.tolist()}: {told[0]}"
        )


@dataclass(frozen=True)
class CollisionSurvey:
    """The pairs whose contact is no self-collision, and why home is without any."""

    ignored: tuple[Pair, ...]
    """Sorted pairs, in alphabetical order."""
    at_home: Mapping[Pair, float]
    """Depth of pairs that penetrate at home, but for neighbours and known pairs, metres."""


def self_collisions(robot: Robot, q: ArrayLike) -> list[dict[Pair, float]]:
    """Penetrating pairs of links, less ``robot.ignore_pairs``, at configurations.

    Args:
        robot: The body.
        q: Independent joint positions, shape (n, dof), rad or m.

    Returns:
        For every configuration, the depth of every penetrating pair, metres.

    Raises:
        MeshError: If a collision mesh cannot be read.
        ValueError: If ``q`` has another shape.
    """
    return SelfCollisionChecker(robot).penetrations(q)


def ignore_pairs(
    robot: Robot,
    *,
    known: Iterable[Pair] = (),
    check: Callable[[str, str], bool] | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
) -> tuple[Pair, ...]:
    """Pairs of links whose contact is no self-collision.

    They are the links of one rigid body (joined by fixed joints), the neighbours across one
    movable joint (links without collision shapes between them do not part them), the pairs that
    penetrate at home, and those that do in at least ``MOSTLY`` of random configurations. So
    nothing is in self-collision at home.

    A robot composed of parts whose own pairs are known costs less: pass these as ``known`` and,
    as ``check``, whether two links belong to different parts.

    Args:
        robot: The body.
        known: Pairs to ignore without a test; they are in the result.
        check: Whether a pair is tested at random configurations; by default every pair is. All
            pairs are tested at home.
        samples: Random configurations; none are drawn if no pair is left to test.
        seed: Seed of the random configurations.

    Returns:
        Sorted pairs, in alphabetical order.

    Raises:
        MeshError: If a collision mesh cannot be read.
    """
    return survey_collisions(robot, known=known, check=check, samples=samples, seed=seed).ignored


def survey_collisions(
    robot: Robot,
    *,
    known: Iterable[Pair] = (),
    check: Callable[[str, str], bool] | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
) -> CollisionSurvey:
    """What ``ignore_pairs`` returns, with what it saw at home; see there."""
    ignored = {sorted_pair(*pair) for pair in known} | set(adjacent_pairs(robot))
    left = set(_pairs(_touchable(robot))) - ignored
    if not left:
        return CollisionSurvey(tuple(sorted(ignored)), {})
    tested = SelfCollisionChecker(robot, ignored)
    (at_home,) = tested.penetrations([robot.home])
    ignored.update(at_home)
    left = {pair for pair in left - ignored if check is None or check(*pair)}
    if left and robot.dof:
        q = random_configurations(robot, samples, np.random.default_rng(seed))
        ignored.update(_mostly_penetrating(tested, q, left))
    return CollisionSurvey(tuple(sorted(ignored)), at_home)


def _mostly_penetrating(
    tested: SelfCollisionChecker, q: NDArray[np.float64], pairs: set[Pair]
) -> set[Pair]:
    """Those of the pairs that penetrate in at least ``MOSTLY`` of the configurations.

    Most pairs part at once, so the rest of the configurations is seldom needed.
    """
    apart = dict.fromkeys(pairs, 0)
    for found in tested.each(q):
        for pair in apart.keys() - found.keys():
            apart[pair] += 1
            if len(q) - apart[pair] < MOSTLY * len(q):
                del apart[pair]
        if not apart:
            break
    return set(apart)


def untested_pairs(robot: Robot) -> tuple[Pair, ...]:
    """Pairs of links that nothing tests: those the robot ignores, and neighbours across joints.

    Robots that morphgen made ignore neighbours already; one that was read as it stands may not.
    """
    return tuple(sorted({*robot.ignore_pairs, *adjacent_pairs(robot)}))


def adjacent_pairs(robot: Robot) -> tuple[Pair, ...]:
    """Pairs of links in one rigid body or across one movable joint, sorted.

    Only links with collision shapes are named. A rigid body without any is passed through, so
    that the bodies on both sides of it are neighbours.
    """
    groups = rigid_groups(robot)
    owner = {link.name: i for i, group in enumerate(groups) for link in group.links}
    members = [[link.name for link in group.links if link.collisions] for group in groups]
    pairs: set[Pair] = set()
    for i, group in enumerate(groups):
        pairs.update(_pairs(members[i]))
        above = _group_above(robot, group, owner)
        while above is not None and not members[above]:
            above = _group_above(robot, groups[above], owner)
        if above is not None:
            pairs.update(sorted_pair(*names) for names in product(members[i], members[above]))
    return tuple(sorted(pairs))


def _group_above(robot: Robot, group: RigidGroup, owner: Mapping[str, int]) -> int | None:
    parent = robot.parents[robot.link_index[group.links[0].name]]
    return owner[robot.links[parent].name] if parent >= 0 else None


def _touchable(robot: Robot) -> list[str]:
    return [link.name for link in robot.links if link.collisions]


def _pairs(names: Iterable[str]) -> Iterator[Pair]:
    return (sorted_pair(a, b) for a, b in combinations(names, 2))


def _index(robot: Robot, name: str) -> int:
    robot.link(name)
    return robot.link_index[name]


def _model(robot: Robot, ignore: Iterable[Pair]) -> mujoco.MjModel:
    """Collision shapes and joints only: what it takes to place and intersect shapes."""
    meshes = Meshes(None)
    root = etree.Element("mujoco")
    etree.SubElement(root, "compiler", MJCF_COMPILER_ATTRIBUTES)
    etree.SubElement(root, "size", memory=_MEMORY)
    etree.SubElement(etree.SubElement(root, "option"), "flag", filterparent="disable")
    asset = etree.SubElement(root, "asset")
    world = etree.SubElement(root, "worldbody")
    bodies: list[etree._Element] = []
    for i, link in enumerate(robot.links):
        parent = bodies[robot.parents[i]] if i else world
        joint = robot.joints[i - 1] if i else None
        placed = pose_attributes(joint.T_parent_joint) if joint else {}
        body = etree.SubElement(parent, "body", {"name": str(i)} | placed)
        if joint is not None and joint.is_movable:
            etree.SubElement(body, "joint", joint_attributes(joint))
        for shape in link.collisions:
            etree.SubElement(body, "geom", geom_attributes(shape, meshes, collision=True))
        bodies.append(body)
    meshes.write(asset)
    contact = etree.SubElement(root, "contact")
    for pair in ignore:
        a, b = (_index(robot, name) for name in pair)
        etree.SubElement(contact, "exclude", body1=str(a), body2=str(b))
    try:
        spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
        meshes.add_to(spec)
        return spec.compile()
    except ValueError as error:
        raise RobotError(
            f"robot {robot.name!r} has a shape or depth that MuJoCo refuses: {error}"
        ) from error


@contextmanager
def capture_mujoco_warnings() -> Iterator[list[str]]:
    """Collect warnings while this lasts; they are MuJoCo's own, of all threads."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield told
    finally:
        mujoco.set_mju_user_warning(before)
