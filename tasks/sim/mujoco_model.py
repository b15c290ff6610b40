"""Scenes as MuJoCo models, with the indices of joints and block in their state."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.dynamics import armature, movable_mass_matrix
from morphgen.model.geometry import IDENTITY, Box, Capsule, Cylinder, Mesh, Shape, Sphere
from morphgen.model.robot import Robot
from morphgen.tasks.sim.articulated import (
    ArticulatedObject,
    ground_contact_links,
    merge_rigid_links,
)
from morphgen.tasks.sim.base import GAIN, GRAVITY, TIMESTEP, Block, Contacts, Scene
from morphgen.typing import Array

Indices = NDArray[np.int64]

PASSIVE = 0.2
"""Fraction of the damping that belongs to joints instead of actuators; see ``PositionControl``."""
IMPEDANCE_RATIO = 100.0  # ratio of friction to normal impedance of contacts (MuJoCo's `impratio`)
BLOCK_IMPEDANCE = (0.1, 0.95, 0.001, 0.5, 2.0)
"""Impedance of the block's contacts (MuJoCo's ``solimp``): soft at touch, hard 1 mm deeper.

MuJoCo pushes sliding bodies apart, in proportion to friction, speed and damping of the contact: a
block pushed at 0.3 m/s hopped, and was on the ground for two fifths of the time. In a soft contact
its weight prevails.
"""
BLOCK_MARGIN = 6e-4
"""Distance at which contacts of the block become active [m]: as far as its weight presses it into
the ground, so that it stands on the surface."""

LEAST_EIGENVALUE = 0.02
"""Smallest eigenvalue of the joint-space inertia at home, scaled to a diagonal of ones.

Two joints with nearly one axis have almost no inertia against each other. Contacts then make the
solver's matrix ill-conditioned beyond single precision, and the Cholesky factor of MuJoCo Warp is
not a number: all drawn arms that diverged, 26 of 300, were below 0.004. Real motors have rotors.
"""

_BY_LINKS, _BY_SCENE, _BY_BLOCK, _BY_GROUND = 1, 2, 4, 8
"""Collision bits: links with links; links with obstacles and block; block with ground and
obstacles; links with ground."""
_OBSTACLE_PRIORITY, _BLOCK_PRIORITY = 1, 2


@dataclass(frozen=True, eq=False)
class World:
    """A compiled scene."""

    robot: Robot  # the robot after `merge_rigid_links`
    model: mujoco.MjModel
    movable_q_at: Indices
    """Indices in ``qpos`` of the movable joints, in the order of ``robot.movable_joints``."""
    movable_qd_at: Indices  # indices in `qvel` of the movable joints
    q_at: Indices  # indices in `qpos` of the independent joints
    qd_at: Indices  # indices in `qvel` of the independent joints
    block_q_at: Indices  # indices in `qpos` of the block's pose, (7,), or none
    block_qd_at: Indices  # indices in `qvel` of the block's linear velocity, (3,), or none
    object: ArticulatedObject | None
    object_q_at: Indices  # index in `qpos` of the joint of the articulated object, (1,), or none
    obstacles: Indices  # indices in `mocap_pos` of the obstacles, which are mocap bodies


def worlds(scenes: Sequence[Scene], contacts: Contacts) -> list[World]:
    """Compile scenes; those that differ only in poses of block and obstacles share a model.

    Contacts have elliptic cones, solved with Newton's method; damping is integrated implicitly, as
    in every MJCF of morphgen. MuJoCo's default contact, critically damped in 20 ms, lasts four
    steps, which is stable: blocks come to rest. A pyramidal cone would hold more along its edges
    than between them, and friction as soft as the normal direction lets a pushed block creep; the
    softer contact of blocks (``BLOCK_IMPEDANCE``) needs a hundred times the impedance. The default
    tolerance takes two or three iterations. Solving constraint islands separately costs more than
    it saves, since a scene has at most two that matter; so islands are off.

    MuJoCo uses the larger friction of two geoms of the same priority, else that of the higher
    priority: the block's friction acts in all of its contacts, an obstacle's in contacts with
    links, and links have a friction of 1 on the ground and on each other.

    ``untested_pairs`` alone determines which links collide: MuJoCo's exception for neighbours is
    off. MuJoCo never tests static geoms against each other: the root link and links fixed to it do
    not collide with the ground, obstacles or a block without mass.
    """
    specs: dict[int, tuple[Robot, mujoco.MjSpec]] = {}
    models: dict[object, World] = {}
    compiled = []
    for env, scene in enumerate(scenes):
        thing = scene.object
        placed = replace(thing, pose=IDENTITY) if isinstance(thing, Block) else id(thing)
        obstacles = tuple(replace(obstacle, pose=IDENTITY) for obstacle in scene.obstacles)
        key = (id(scene.robot), scene.T_world_root, placed, obstacles, scene.ground)
        if key not in models:
            if id(scene.robot) not in specs:
                specs[id(scene.robot)] = _robot_spec(scene.robot, contacts)
            robot, spec = specs[id(scene.robot)]
            try:
                models[key] = _world(scene, robot, spec.copy())
            except ValueError as error:
                reason = " ".join(str(error).split())
                raise SimulationError(
                    f"environment {env}, robot {robot.name!r}: MuJoCo refuses the scene: {reason}"
                ) from error
        compiled.append(models[key])
    return compiled


def _robot_spec(robot: Robot, contacts: Contacts) -> tuple[Robot, mujoco.MjSpec]:
    """Return the robot after ``merge_rigid_links`` and its spec, whose root can be moved."""
    robot = merge_rigid_links(robot)
    # Joints have no friction and damping of their own: the law of position control moves them.
    bare = replace(
        robot, joints=tuple(replace(joint, damping=0.0, friction=0.0) for joint in robot.joints)
    )
    spec = to_spec(bare)
    for actuator in spec.actuators:
        damping = -GAIN * actuator.biasprm[2]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.gainprm[0] *= GAIN
        actuator.biasprm[1] *= GAIN
        actuator.biasprm[2] = -(1 - PASSIVE) * damping
        spec.joint(actuator.target).damping[0] = PASSIVE * damping
    for k, added in zip(robot.movable_joints, _missing_inertia(robot).tolist(), strict=True):
        spec.joint(robot.joints[k].name).armature += added
    for geom in spec.geoms:
        # Two geoms collide if a bit of one's contype is in the other's conaffinity.
        geom.contype = _BY_LINKS if contacts.self_collision else 0
        geom.conaffinity = geom.contype | (_BY_SCENE | _BY_GROUND if contacts.scene else 0)
    option = spec.option
    option.timestep = TIMESTEP
    option.gravity = [0.0, 0.0, -GRAVITY]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = IMPEDANCE_RATIO
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return robot, spec


def _missing_inertia(robot: Robot) -> Array:
    """Return the armature that joints need for ``LEAST_EIGENVALUE``, (n_movable,) [kg m^2 or kg].

    Nothing for the library's arms with a plane: 0.037 for arm3, at least 0.06 for real ones.
    """
    if not robot.movable_joints:
        return np.zeros(0)
    inertia = movable_mass_matrix(robot, robot.home) + np.diag(armature(robot))
    diagonal = np.diag(inertia)
    least = np.linalg.eigvalsh(inertia / np.sqrt(np.outer(diagonal, diagonal)))[0]
    # A share x of the diagonal, added to it, makes an eigenvalue e of the scaled matrix
    # (e + x) / (1 + x).
    return np.asarray(diagonal * max(0.0, LEAST_EIGENVALUE - least) / (1 - LEAST_EIGENVALUE))


def _world(scene: Scene, robot: Robot, spec: mujoco.MjSpec) -> World:
    """Add ground, obstacles and object to a robot's spec, and compile it."""
    root = spec.body(robot.root.name)
    root.pos, root.quat = scene.T_world_root.position, scene.T_world_root.quaternion
    for name in ground_contact_links(robot, scene.T_world_root) - {robot.root.name}:
        for geom in spec.body(name).geoms:
            geom.conaffinity &= ~_BY_GROUND
    if scene.ground is not None:
        # Without extent a plane is infinite; MuJoCo only requires the third number, for its grid.
        plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        plane.pos = [0.0, 0.0, scene.ground]
        plane.contype, plane.conaffinity = _BY_GROUND | _BY_BLOCK, 0
    obstacles = []
    for obstacle in scene.obstacles:
        obstacles.append(spec.worldbody.add_body(mocap=True))
        obstacles[-1].pos, obstacles[-1].quat = obstacle.pose.position, obstacle.pose.quaternion
        geom = add_shape(obstacles[-1], Shape(Box(obstacle.size)))
        geom.priority, geom.friction[0] = _OBSTACLE_PRIORITY, obstacle.friction
        geom.contype, geom.conaffinity = _BY_SCENE | _BY_BLOCK, 0
    thing = scene.object if isinstance(scene.object, ArticulatedObject) else None
    if scene.block is not None:
        _add_block(spec, scene.block)
    if thing is not None:
        _add_articulated(spec, thing)
    model = spec.compile()

    def at(joints: Iterable[int], attribute: str) -> Indices:
        each = (getattr(model.joint(robot.joints[k].name), attribute)[0] for k in joints)
        return np.array([*each], dtype=np.int64)

    # The object's joint is the last one of the model.
    pose = np.arange(7 if scene.block is not None else 0)
    return World(
        robot,
        model,
        movable_q_at=at(robot.movable_joints, "qposadr"),
        movable_qd_at=at(robot.movable_joints, "dofadr"),
        q_at=at(robot.independent_joints, "qposadr"),
        qd_at=at(robot.independent_joints, "dofadr"),
        block_q_at=model.nq - len(pose) + pose,
        block_qd_at=model.nv - 6 + pose[:3],
        object=thing,
        object_q_at=np.arange(model.nq - (thing is not None), model.nq),
        obstacles=model.body_mocapid[[obstacle.id for obstacle in obstacles]].astype(np.int64),
    )


def _add_block(spec: mujoco.MjSpec, block: Block) -> None:
    """Add the block, a free body."""
    body = spec.worldbody.add_body()
    body.add_freejoint()
    x, y, z = (edge * edge for edge in block.size)
    body.explicitinertial = True  # else MuJoCo computes them from the geom's density
    body.mass = block.mass
    body.inertia = [block.mass * total / 12 for total in (y + z, x + z, x + y)]
    geom = add_shape(body, Shape(Box(block.size)))
    geom.priority, geom.friction[0] = _BLOCK_PRIORITY, block.friction
    geom.contype, geom.conaffinity = _BY_SCENE, _BY_BLOCK
    geom.solimp, geom.margin = BLOCK_IMPEDANCE, BLOCK_MARGIN


def _add_articulated(spec: mujoco.MjSpec, thing: ArticulatedObject) -> None:
    """Add an articulated object; it collides with links of the robot alone."""
    base = spec.worldbody.add_body()
    base.pos, base.quat = thing.pose.position, thing.pose.quaternion
    joint = thing.joint
    link = base.add_body()
    link.pos, link.quat = joint.T_parent_joint.position, joint.T_parent_joint.quaternion
    inertial = thing.moving_inertial
    assert inertial is not None
    link.gravcomp = 1.0  # as links of robots
    link.explicitinertial = True
    link.mass, link.ipos = inertial.mass, inertial.com
    xx, xy, xz, yy, yz, zz = inertial.inertia
    link.fullinertia = [xx, yy, zz, xy, xz, yz]  # MuJoCo's order
    is_slide = joint.kind == "prismatic"
    kind = mujoco.mjtJoint.mjJNT_SLIDE if is_slide else mujoco.mjtJoint.mjJNT_HINGE
    moved = link.add_joint(type=kind, axis=joint.unit_axis)
    moved.damping[0], moved.frictionloss = joint.damping, joint.friction
    if joint.limits is not None and not joint.is_continuous:
        moved.limited, moved.range = mujoco.mjtLimited.mjLIMITED_TRUE, joint.limits
    for body, shapes in ((base, thing.base_shapes), (link, thing.moving_shapes)):
        for shape in shapes:
            geom = add_shape(body, shape)
            geom.priority, geom.friction[0] = _BLOCK_PRIORITY, thing.friction
            geom.contype, geom.conaffinity = _BY_SCENE, 0


def add_shape(body: mujoco.MjsBody, shape: Shape) -> mujoco.MjsGeom:
    """Add a primitive shape to a body."""
    kinds = mujoco.mjtGeom
    match shape.geometry:
        case Box((x, y, z)):
            geom = body.add_geom(type=kinds.mjGEOM_BOX, size=[x / 2, y / 2, z / 2])
        case Sphere(radius):
            geom = body.add_geom(type=kinds.mjGEOM_SPHERE, size=[radius, 0, 0])
        case Cylinder(radius, length):
            geom = body.add_geom(type=kinds.mjGEOM_CYLINDER, size=[radius, length / 2, 0])
        case Capsule(radius, length):
            geom = body.add_geom(type=kinds.mjGEOM_CAPSULE, size=[radius, length / 2, 0])
        case Mesh():
            raise TypeError(f"{shape.geometry.path}: a mesh is no primitive shape")
    geom.pos, geom.quat = shape.T_link_shape.position, shape.T_link_shape.quaternion
    return geom
