"""Bodies of compiled MuJoCo models that are the robot."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from morphgen.errors import nearest
from morphgen.formats.mjcf_document import MjcfDocument, listed
from morphgen.model.findings import Finding

WORLD = 0
"""Index of the world body."""
_JOINT = mujoco.mjtJoint
FLOOR_GEOMS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
"""Types of geoms that are a floor where the world has them."""


@dataclass(frozen=True)
class RobotBodies:
    """The bodies of a robot."""

    bodies: tuple[int, ...]
    """Indices of the bodies, root first, parents before children."""
    joints: frozenset[int]
    """Indices of the joints between these bodies."""
    findings: tuple[Finding, ...] = ()
    """Findings about shapes of the world that were left out of the robot."""

    @property
    def root(self) -> int:
        """Index of the root's body."""
        return self.bodies[0]


def robot_bodies(
    model: mujoco.MjModel, document: MjcfDocument, root_body: str | None = None
) -> RobotBodies:
    """Return the bodies that are the robot.

    With ``root_body`` it is that body with all below it; its own joints are left out. Otherwise it
    is the one body in the world: with a free joint, which is left out, or welded to the world at
    its origin. If that body is elsewhere or moves, or the world has shapes other than planes, the
    world is the root. It is also the root of several bodies that all have joints, as of two arms.

    Raises:
        FormatError: If the body is unknown, the world holds other bodies besides the robot, or a
            joint is a ball.
    """
    findings: tuple[Finding, ...] = ()
    if root_body is not None:
        root = _named_body(model, root_body, document)
    else:
        top = [body for body in range(1, model.nbody) if model.body_parentid[body] == WORLD]
        root, findings = _root(model, top, document)
    bodies = _below(model, root)
    kept = set(bodies)
    joints = frozenset(
        joint
        for joint in range(model.njnt)
        if model.jnt_bodyid[joint] in kept and model.jnt_bodyid[joint] != root
    )
    balls = [j for j in sorted(joints) if model.jnt_type[j] == _JOINT.mjJNT_BALL]
    if balls:
        raise document.error(
            f"joint {listed(joint_label(model, j) for j in balls)}: type ball; expected hinge or "
            "slide, such as three hinges at one place"
        )
    free = [j for j in sorted(joints) if model.jnt_type[j] == _JOINT.mjJNT_FREE]
    if free:
        raise document.error(
            f"joint {listed(joint_label(model, j) for j in free)}: type free, which only the "
            "root of a robot may have; name it by --root-link BODY of morphgen import"
        )
    return RobotBodies(bodies, joints, findings)


def joint_label(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or for one without a name its body's."""
    return model.joint(joint).name or f"(of {body_label(model, int(model.jnt_bodyid[joint]))})"


def body_label(model: mujoco.MjModel, body: int) -> str:
    """Return a body's name, or for one without a name its number."""
    return model.body(body).name or f"(body {body})"


def _root(
    model: mujoco.MjModel, top: list[int], document: MjcfDocument
) -> tuple[int, tuple[Finding, ...]]:
    if not top:
        raise document.error("it has no bodies; expected at least one in <worldbody>")
    if len(top) > 1:
        still = [body for body in top if not _has_joints(model, body)]
        loose = [body for body in top if _is_free(model, body)]
        if still or loose:
            names = listed(body_label(model, body) for body in top)
            raise document.error(
                f"the world holds the bodies {names}, of which {_label(model, still or loose)}; "
                "name the robot's by --root-link BODY of morphgen import"
            )
        return WORLD, ()
    body = top[0]
    shapes = [
        g for g in _geoms(model, WORLD) if mujoco.mjtGeom(model.geom_type[g]) not in FLOOR_GEOMS
    ]
    if _is_free(model, body):
        return body, _left_out(model, shapes, document)
    is_welded = (
        model.body_jntnum[body] == 0
        and not shapes
        and not model.body_pos[body].any()
        and np.array_equal(model.body_quat[body], (1, 0, 0, 0))
    )
    return (body if is_welded else WORLD), ()


def _label(model: mujoco.MjModel, bodies: list[int]) -> str:
    word = "is free" if _is_free(model, bodies[0]) else "has no joints"
    return f"{body_label(model, bodies[0])!r} {word}"


def _left_out(
    model: mujoco.MjModel, geoms: list[int], document: MjcfDocument
) -> tuple[Finding, ...]:
    if not geoms:
        return ()
    return (
        Finding(
            "world-shapes",
            "warning",
            f"{document.path.name}: worldbody",
            f"{len(geoms)} geoms of the world stand beside a robot with a free base",
            "put them into a body of the robot, if they belong to it",
            f"{len(geoms)} geoms of the world were left out",
        ),
    )


def _geoms(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_geomadr[body])
    return range(first, first + int(model.body_geomnum[body]))


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    joint = model.body_jntadr[body]
    return bool(joint >= 0 and model.jnt_type[joint] == _JOINT.mjJNT_FREE)


def _has_joints(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body or one below it has a joint."""
    return any(model.body_jntnum[other] for other in _below(model, body))


def _below(model: mujoco.MjModel, body: int) -> tuple[int, ...]:
    """Return a body and those below it, parents before children."""
    kept = {body: None}
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in kept:
            kept[other] = None
    return tuple(kept)


def _named_body(model: mujoco.MjModel, name: str, document: MjcfDocument) -> int:
    names = [model.body(body).name for body in range(model.nbody)]
    if name not in names:
        raise document.error(f"no body {name!r} for root link{nearest(name, names)}")
    return names.index(name)
