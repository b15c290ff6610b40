"""PyBullet as a simulator: a client for every environment, stepped one after the other."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import filterfalse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import MissingDependencyError, SimulationError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.formats.quiet import quiet
from morphgen.model.dynamics import BANDWIDTH, actuation, movable_mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.model.tree import rigid_groups
from morphgen.tasks.sim.articulated import (
    ArticulatedObject,
    ground_contact_links,
    merge_rigid_links,
)
from morphgen.tasks.sim.base import (
    CONTROL_PERIOD,
    GAIN,
    GRAVITY,
    SUBSTEPS,
    TIMESTEP,
    Block,
    Contacts,
    HostSimulation,
    Scene,
    Simulator,
    clamp,
    constant,
    farthest_targets,
    is_within,
)
from morphgen.typing import Array

try:
    with quiet():
        import pybullet
except ImportError as error:
    raise MissingDependencyError(
        "the simulator PyBullet is not installed: pip install pybullet (it has wheels up to "
        "Python 3.11), or take another simulator"
    ) from error

MAX_CLIENTS = 1024  # number of clients that PyBullet supports in a process
UNLIMITED = 1e6  # effort of a joint without an effort limit [N m or N]
FRICTION = 1.0
"""Friction coefficient of ground, robots and obstacles. PyBullet multiplies the coefficients of two
bodies, so that the block's own coefficient acts."""
VELOCITY_GAIN = 0.6
"""Fraction of the velocity error that motors correct in a physics step: 1 would exceed their
effort, a small fraction would leave Coriolis forces uncompensated."""
ITERATIONS = 200
"""Iterations of the constraint solver; with PyBullet's 50, light chains and wrists are centimetres
off."""
RESIDUAL = 1e-4
"""Sum of squared residuals at which the solver stops [m/s, rad/s]: tools are within a tenth of a
millimetre of their positions after all iterations, in half of the time."""
OVERSPEED = 1.5
"""Largest speed of joints under contact, relative to the robot's fastest joint. If a joint has no
speed limit, all joints of the robot get PyBullet's limit, 100 rad/s or m/s."""
_LINKS, _ROOT, _STATIC, _BLOCK, _ARTICULATED = 1, 2, 4, 8, 16
"""Collision groups: movable links, fixed links, ground and obstacles, block, and the links of an
articulated object."""


_FINAL_RESPONSE = constant(1 - (1 - VELOCITY_GAIN) ** SUBSTEPS)
"""Fraction of a velocity change that motors have made at the end of a control step."""
_MEAN_RESPONSE = constant(
    1 - sum((1 - VELOCITY_GAIN) ** k for k in range(1, SUBSTEPS + 1)) / SUBSTEPS
)
"""Mean of that fraction over the physics steps of a control step."""
_RESPONSE, _BANDWIDTH, _TWO = map(constant, (TIMESTEP * BANDWIDTH, BANDWIDTH, 2))
_TIMESTEP, _SUBSTEPS, _PERIOD = map(constant, (TIMESTEP, SUBSTEPS, CONTROL_PERIOD))


_MOVABLE = (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)
FROM_BULLET, _TO_BULLET = [0, 1, 2, 6, 3, 4, 5], [0, 1, 2, 4, 5, 6, 3]
"""Columns of a pose in morphgen's order, and in PyBullet's, whose quaternions have w last."""


@dataclass(frozen=True)
class Exported:
    """Files of a scene, which PyBullet loads."""

    urdf: Path  # the robot, with rigid links merged
    merged: Robot  # that robot
    object_urdf: Path | None  # the articulated object, if the scene has one


SLACK = 0.2
"""Additional motor force, as a fraction of the spring's plus the damper's force: the inertia
differs away from home, and rotation about several axes takes some force."""
_SLACK, _SPRING, _DAMPER = map(constant, (SLACK, BANDWIDTH**2, 2 * BANDWIDTH))


def limited_speeds(robot: Robot) -> list[float]:
    """Return the speed limits of the movable joints, infinite without one [rad/s or m/s].

    A mimic joint has that of its leader: its own would part them.
    """
    matrix, _ = robot.mimic_map
    leaders = [robot.joints[k].velocity or np.inf for k in robot.independent_joints]
    return [
        max((abs(gain) * v for gain, v in zip(row, leaders, strict=True) if gain), default=0.0)
        for row in matrix.tolist()
    ]


def _motor_rows(robot: Robot, width: int) -> dict[str, Array]:
    """Return tables of a robot with a row for each movable joint, for ``MotorLaw``.

    Every movable joint follows one independent joint, its leader: a row of the map has one number
    that is not zero. A matrix product might round differently in another batch.
    """
    matrix, offset = robot.mimic_map
    leaders, independent = np.abs(matrix).argmax(axis=1), np.array(robot.independent_rows, int)
    padding = (0, 0), (0, width - robot.dof)
    others = np.pad(np.tile(independent, (len(matrix), 1)), padding)
    pull, swing = (np.pad(GAIN * table.T, padding) for table in _inertia(robot))
    return {
        "source": leaders,
        "leader": independent[leaders],
        "independent": independent,
        "others": others,
        "gain": matrix[np.arange(len(matrix)), leaders],
        "offset": offset,
        "pull": pull,
        "swing": swing,
        "fastest": np.array(limited_speeds(robot)),
        "farthest": np.array(farthest_targets(robot, robot.movable_joints)),
        "effort": np.array([_effort(robot, k) for k in robot.movable_joints]),
    }


class MotorLaw:
    """Velocities and force limits of the motors of all robots, so that arms yield under contact.

    There is a row for each movable joint of each robot: NumPy takes hardly longer for many rows.
    A velocity motor pulls with all its effort, as if it were rigid. The law of
    ``morphgen.model.dynamics`` is a spring and a damper; so a motor j may pull as hard as these do
    with the joint-space inertia M at home: the sum over joints k of |M_jk a_k| with the law's
    acceleration a_k = omega^2 e_k - 2 omega v_k, plus ``SLACK``, times ``GAIN``. Free motion needs
    no more. A mimic joint also needs the force that keeps it with its leader while others swing it
    around: up to sqrt(M_jj M_kk) v_k^2.
    """

    def __init__(self, robots: Sequence[Robot], width: int) -> None:
        """Gather the rows; targets have the shape (n, width)."""
        distinct = {id(robot): robot for robot in robots}
        tables = {key: _motor_rows(robot, width) for key, robot in distinct.items()}
        each = [tables[id(robot)] for robot in robots]

        ends = np.cumsum([len(table["gain"]) for table in each]).tolist()
        starts = [0, *ends[:-1]]
        self.spans = [slice(*span) for span in zip(starts, ends, strict=True)]

        def rows(name: str) -> Array:
            return np.concatenate([table[name] for table in each])

        def indices(name: str, firsts: Sequence[int]) -> NDArray[np.intp]:
            """Turn indices of each robot's rows, or targets, into those of all robots'."""
            parts = [table[name] + first for table, first in zip(each, firsts, strict=True)]
            return np.concatenate(parts).astype(np.intp)

        self._source = indices("source", range(0, width * len(robots), width))
        self._leader, self._independent = indices("leader", starts), indices("independent", starts)
        self._others = np.ascontiguousarray(indices("others", starts).T)
        self._gain, self._offset, self._effort = rows("gain"), rows("offset"), rows("effort")
        self._fastest, self._farthest = rows("fastest"), rows("farthest")
        self._pull, self._swing = (np.ascontiguousarray(rows(k).T) for k in ("pull", "swing"))
        self._has_mimic_joints = bool(self._swing.any())
        self._positions, self._velocities, self._measured = np.zeros((3, len(self._gain)))

    def reset(self, i: int, positions: Array) -> None:
        """Put a robot at rest, at positions of all its movable joints."""
        self._positions[self.spans[i]] = positions
        self._velocities[self.spans[i]] = self._measured[self.spans[i]] = 0

    def command(self, targets: Array) -> tuple[list[float], list[float]]:
        """Return velocities and force limits of all motors, at targets (n, width)."""
        desired = targets.reshape(-1)[self._source] * self._gain + self._offset
        ends, self._last = self._undisturbed(desired)
        mean, before = (ends - self._positions) / _PERIOD, self._measured
        self._commanded = clamp(before + (mean - before) / _MEAN_RESPONSE, self._fastest)
        errors = desired - self._positions, desired - ends
        limits = self._limits(errors, (self._velocities, self._last))
        return self._commanded.tolist(), (limits / _SUBSTEPS).tolist()

    def measure(self, states: Sequence[Sequence[float]]) -> tuple[Array, Array]:
        """Note states that begin with position and velocity; return the independent joints'."""
        before = self._measured
        self._positions = np.array([state[0] for state in states])
        self._measured = np.array([state[1] for state in states])
        expected: Array = before + (self._commanded - before) * _FINAL_RESPONSE
        self._velocities = self._last + (self._measured - expected)
        return self._positions[self._independent], self._measured[self._independent]

    def _undisturbed(self, desired: Array) -> tuple[Array, Array]:
        """Return positions and velocities at the end of a control step without disturbances.

        Integrates the critically damped law of ``morphgen.model.dynamics`` in physics steps. Effort
        limits and contacts are not modelled: they show in the velocity that is measured afterwards,
        and carry over to the next step.
        """
        q, v = self._positions, self._velocities
        for _ in range(SUBSTEPS):
            v = clamp(v + _RESPONSE * (_BANDWIDTH * (desired - q) - _TWO * v), self._fastest)
            q = q + _TIMESTEP * v
        # Mimic joints follow where their leaders are: a leader at its effort limit is late.
        return q[self._leader] * self._gain + self._offset, v[self._leader] * self._gain

    def _limits(self, errors: Sequence[Array], velocities: Sequence[Array]) -> Array:
        """Return the largest forces in a control step [N m or N].

        Errors [rad or m] and velocities are those at the beginning, and at the end without
        contacts.
        """
        springs = [_SPRING * clamp(e, self._farthest) for e in errors]
        dampers = [_DAMPER * v for v in velocities]
        begin, end = (np.abs(k - d) for k, d in zip(springs, dampers, strict=True))
        accelerations = np.maximum(begin, end) + _SLACK * (np.abs(springs[0]) + np.abs(dampers[0]))
        forces = self._pull * accelerations[self._others]
        if self._has_mimic_joints:
            fastest = np.maximum(np.abs(velocities[0]), np.abs(velocities[1]))
            forces += self._swing * (fastest**2)[self._others]
        limits: Array = np.minimum(np.add.reduce(forces, axis=0), self._effort)
        return limits


def _inertia(robot: Robot) -> tuple[Array, Array]:
    """Return forces on movable joints per acceleration of independent joints, (dof, movable).

    The second array is that per squared velocity, which is zero but for mimic joints. Each joint of
    a mimic group has a motor of its own: it carries what accelerates its own link, while in the
    inertia of the group two fingers that move apart cancel. It also carries what others do to a
    part of the group, such as the reaction of a motor on the rod of a parallelogram: up to
    sqrt(M_jj M_kk), which bounds M_jk away from home.
    """
    matrix, _ = robot.mimic_map
    gains = np.abs(matrix)
    armatures = np.diag([motor.armature for motor in actuation(robot)])
    of_movable = movable_mass_matrix(robot, robot.home)
    inertia = np.abs(matrix.T @ of_movable @ matrix) + armatures
    bound = np.sqrt(np.outer(np.diag(inertia), np.diag(of_movable)))
    of_group = np.maximum(np.abs(of_movable @ matrix).T, bound * (gains.T > 0))
    is_grouped = (gains > 0) @ ((gains > 0).sum(axis=0) > 1)
    alone = inertia @ gains.T
    is_mimic = [robot.joints[k].mimic is not None for k in robot.movable_joints]
    return np.where(is_grouped, np.maximum(alone, of_group), alone), np.where(is_mimic, bound, 0.0)


class BulletScene:
    """A scene in its own PyBullet client.

    Motors. PyBullet's position control, v' = v - kd v + kp e / dt in every physics step, follows
    the control law only where nothing else moves the joint: the v on the right already includes the
    step's gravity and Coriolis acceleration, of which kd removes only a part. So motors control the
    velocity during a control step, with no more force than a spring and a damper would exert
    (``MotorLaw``). The robot carries its own weight: the world has no gravity, and the block's
    weight is an external force. One call makes all substeps; the motors act in each, but PyBullet
    computes their impulse limits with the time of the whole call, hence forces are divided by
    ``SUBSTEPS``. A mimic joint is a motor that follows its leader.

    Solver. It needs many iterations because motors of one arm pull against each other. Dantzig's
    direct method does not, and is faster, but has no friction cone; so it is used without a block.

    Speeds. Contacts that press links against each other sometimes have no solution, and the
    solver's result then throws a joint a radian in a step; so speeds are limited by ``OVERSPEED``.

    Limits. A joint that was pushed past its limit has to return. By default PyBullet leaves this
    to its split impulse beyond 0.04 m or rad, which articulated bodies do not have, so that a joint
    can be pushed on and on; ``useSplitImpulse`` is off.

    Friction. By default PyBullet limits friction along two axes separately, so that a block that
    slides diagonally stops 30 % too early and turns aside; ``enableConeFriction`` gives Coulomb
    friction.

    Resets. Contact points and the broad phase's pairs, in the order of their creation, survive a
    change of state, and ``saveState`` and ``restoreState`` keep them. Setting every part's
    collision group again creates its broad-phase entry anew, without pairs, and
    ``deterministicOverlappingPairs`` then orders pairs by entry. After both, a used client gives
    the same bits as a fresh one.
    """

    def __init__(self, scene: Scene, exported: Exported, contacts: Contacts) -> None:
        self._scene, self._contacts = scene, contacts
        self.id: int = pybullet.connect(pybullet.DIRECT)
        if self.id < 0:
            raise SimulationError(
                f"PyBullet has no client left: a process has {MAX_CLIENTS}, one for each "
                "environment; use fewer environments"
            )
        self._client = {"physicsClientId": self.id}
        direct = pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
        with quiet():
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=TIMESTEP * SUBSTEPS,
                numSolverIterations=ITERATIONS,
                solverResidualThreshold=RESIDUAL,
                numSubSteps=SUBSTEPS,
                deterministicOverlappingPairs=1,
                enableConeFriction=1,
                useSplitImpulse=0,
                **({"constraintSolverType": direct} if scene.object is None else {}),
                **self._client,
            )
        self._groups: list[tuple[int, int, int, int]] = []
        self._load_robot(exported.urdf, exported.merged)
        self._load_surroundings()
        self.object_joint: int | None = None
        if isinstance(scene.object, ArticulatedObject):
            self._load_articulated(scene.object, exported.object_urdf)

    def _load_robot(self, urdf: Path, merged: Robot) -> None:
        """Load the robot, and set its contacts, friction, damping and speed limit."""
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
        if self._contacts.self_collision:
            flags |= pybullet.URDF_USE_SELF_COLLISION
        try:
            with quiet():
                self.robot: int = pybullet.loadURDF(
                    str(urdf),
                    *_pose(self._scene.T_world_root),
                    useFixedBase=True,
                    flags=flags,
                    **self._client,
                )
        except pybullet.error as error:
            raise SimulationError(
                f"robot {merged.name!r}: PyBullet cannot load it: {error}"
            ) from error
        count = pybullet.getNumJoints(self.robot, **self._client)
        infos = [pybullet.getJointInfo(self.robot, i, **self._client) for i in range(count)]
        joints = {info[1].decode(): info[0] for info in infos}
        links = {merged.root.name: -1} | {info[12].decode(): info[0] for info in infos}
        self.driven = [joints[merged.joints[k].name] for k in merged.movable_joints]
        speeds = limited_speeds(merged)
        fastest = max(speeds, default=math.inf)  # PyBullet has one limit a robot
        if math.isfinite(fastest):
            pybullet.changeDynamics(
                self.robot, -1, maxJointVelocity=OVERSPEED * fastest, **self._client
            )
        root_links = {link.name for link in rigid_groups(merged)[0].links}
        level = ground_contact_links(merged, self._scene.T_world_root)
        self._level = [link for name, link in links.items() if name in level]
        for name, link in links.items():
            group = _ROOT if name in root_links else _LINKS
            self._add(self.robot, FRICTION, group, link, jointDamping=0)
        if self._contacts.self_collision:
            for a, b in merged.ignore_pairs:
                pybullet.setCollisionFilterPair(
                    self.robot, self.robot, links[a], links[b], 0, **self._client
                )
        self._motors: dict[str, Any] = {
            "velocityGains": [VELOCITY_GAIN] * len(self.driven),
            **self._client,
        }

    def _load_surroundings(self) -> None:
        """Load ground, obstacles and block."""
        if self._scene.ground is not None:
            plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, **self._client)
            at = (0.0, 0.0, self._scene.ground)
            ground = pybullet.createMultiBody(0, plane, basePosition=at, **self._client)  # static
            self._add(ground, FRICTION, _STATIC)
            for link in self._level:
                pybullet.setCollisionFilterPair(self.robot, ground, link, -1, 0, **self._client)
        self._obstacles = [
            self._add(self._box(obstacle), obstacle.friction, _STATIC)
            for obstacle in self._scene.obstacles
        ]
        block = self._scene.block
        self.block = -1
        if block is not None:
            self.block = self._add(self._box(block), block.friction, _BLOCK)
            self._weight = (0.0, 0.0, -GRAVITY * block.mass)

    def _load_articulated(self, thing: ArticulatedObject, urdf: Path | None) -> None:
        """Load an articulated object, whose dry friction is a motor that wants to stand still."""
        with quiet():
            self.object: int = pybullet.loadURDF(
                str(urdf),
                *_pose(thing.pose),
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER,
                **self._client,
            )
        self._placed_joint = thing.placed_joint
        self._add(self.object, thing.friction, _ARTICULATED)
        for i in range(pybullet.getNumJoints(self.object, **self._client)):
            self._add(self.object, thing.friction, _ARTICULATED, i)
            if pybullet.getJointInfo(self.object, i, **self._client)[2] in _MOVABLE:
                self.object_joint = i
        pybullet.changeDynamics(
            self.object, self.object_joint, jointDamping=thing.joint.damping, **self._client
        )
        pybullet.setJointMotorControl2(
            self.object,
            self.object_joint,
            pybullet.VELOCITY_CONTROL,
            force=thing.joint.friction,
            **self._client,
        )

    def _box(self, block: Block) -> int:
        """Add a box; return PyBullet's body."""
        half = [edge / 2 for edge in block.size]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self._client)
        position, quaternion = _pose(block.pose)
        body: int = pybullet.createMultiBody(
            block.mass, shape, basePosition=position, baseOrientation=quaternion, **self._client
        )
        return body

    def _add(
        self, body: int, friction: float, group: int, link: int = -1, **dynamics: float
    ) -> int:
        """Set friction, damping and collisions of a body's base, or of a link; return the body."""
        still = {"linearDamping": 0, "angularDamping": 0, **dynamics}
        pybullet.changeDynamics(body, link, lateralFriction=friction, **still, **self._client)
        robot = _LINKS | _ROOT
        surroundings = _STATIC | _BLOCK | _ARTICULATED if self._contacts.scene else 0
        mask = {
            _LINKS: robot | surroundings,
            _ROOT: _LINKS | (surroundings & (_BLOCK | _ARTICULATED)),
            _ARTICULATED: robot if self._contacts.scene else 0,
            _STATIC: _BLOCK | (_LINKS if self._contacts.scene else 0),
            _BLOCK: _STATIC | (robot if self._contacts.scene else 0),
        }[group]
        self._groups.append((body, link, group, mask))  # for ``reset``
        return body

    def reset(
        self,
        positions: Array,
        object_pose: Sequence[float],
        obstacle_poses: Sequence[Sequence[float]] | None = None,
    ) -> None:
        """Put robot, at positions of all movable joints, and block at rest; clear contacts."""
        for joint, position in zip(self.driven, positions.tolist(), strict=True):
            pybullet.resetJointState(self.robot, joint, position, **self._client)
        moved = (
            [] if obstacle_poses is None else [*zip(self._obstacles, obstacle_poses, strict=True)]
        )
        if self.block >= 0:
            moved.append((self.block, object_pose))
            pybullet.resetBaseVelocity(self.block, (0, 0, 0), (0, 0, 0), **self._client)
            self._object_position = tuple(object_pose[:3])  # where its weight acts in the next step
        if self.object_joint is not None:
            position = self._placed_joint.positions(np.array([object_pose], np.float64))[0]
            pybullet.resetJointState(self.object, self.object_joint, position, **self._client)
        for body, (x, y, z, qw, qx, qy, qz) in moved:
            pybullet.resetBasePositionAndOrientation(
                body, (x, y, z), (qx, qy, qz, qw), **self._client
            )
        for entry in self._groups:
            pybullet.setCollisionFilterGroupMask(*entry, **self._client)

    def step(self, velocities: list[float], forces: list[float]) -> Sequence[Sequence[float]]:
        """Make a control step, given velocities and force limits of all movable joints.

        Return tuples that begin with their positions and velocities.
        """
        pybullet.setJointMotorControlArray(
            self.robot,
            self.driven,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=velocities,
            forces=forces,
            **self._motors,
        )
        if self.block >= 0:
            pybullet.applyExternalForce(
                self.block,
                -1,
                self._weight,
                self._object_position,
                pybullet.WORLD_FRAME,
                **self._client,
            )
        pybullet.stepSimulation(**self._client)
        states: Sequence[Sequence[float]] = pybullet.getJointStates(
            self.robot, self.driven, **self._client
        )
        return states

    def object_state(self) -> Array:
        """Return position, quaternion (x, y, z, w), linear and angular velocity of the object.

        An articulated object has one velocity, that of its joint, which comes last.
        """
        if self.object_joint is not None:
            q, qd, *_ = pybullet.getJointState(self.object, self.object_joint, **self._client)
            pose = self._placed_joint.poses(np.array([q]))[0, _TO_BULLET]
            return np.array([*pose, *(0.0,) * 5, qd])
        position, quaternion = pybullet.getBasePositionAndOrientation(self.block, **self._client)
        linear, angular = pybullet.getBaseVelocity(self.block, **self._client)
        self._object_position = position
        return np.array([*position, *quaternion, *linear, *angular])

    def close(self) -> None:
        """Free the client; a second call does nothing."""
        if self.id >= 0:
            pybullet.disconnect(**self._client)
            self.id = -1


def _pose(pose: Pose) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Return position and quaternion in PyBullet's order, (x, y, z, w)."""
    w, x, y, z = pose.quaternion
    return pose.position, (x, y, z, w)


def _effort(robot: Robot, k: int) -> float:
    """Return the effort limit of a movable joint; a linkage that moves a mimic joint has none."""
    joint = robot.joints[k]
    return (joint.effort if joint.mimic is None else None) or UNLIMITED


MAX_VELOCITY = 1e4
"""Speed of joints and blocks [rad/s or m/s] and distance of blocks [m] that count as diverged."""
MAX_POSITION = float(np.finfo(np.float32).max)
"""Joint positions may be any finite number: continuous joints turn without end."""
Float32 = NDArray[np.float32]


class BulletSimulation(HostSimulation):
    """Environments in PyBullet; a ``Simulation``.

    Every environment has its own client, so that none can influence another. A client takes 36 MB
    and some 25 ms to start, whatever is in it; a process can have 1024.
    """

    def __init__(self, scenes: Sequence[Scene], contacts: Contacts | None = None) -> None:
        super().__init__(scenes)
        self._contacts = contacts or Contacts()
        n, joints = self._targets.shape
        self._q, self._qd = np.zeros((2, n, joints), np.float32)
        self._pose, self._velocity = np.zeros((n, 7), np.float32), np.zeros((n, 3), np.float32)
        self.q, self.qd = torch.from_numpy(self._q), torch.from_numpy(self._qd)
        self.object_pose = torch.from_numpy(self._pose)
        self.object_velocity = torch.from_numpy(self._velocity)
        self._unreset: set[int] = set()
        self._obstacle_poses: list[list[list[float]] | None] = [None] * n
        self._loaded: list[BulletScene] = []
        resources = ExitStack()
        self._free = weakref.finalize(self, resources.close)
        try:
            folder = resources.enter_context(tempfile.TemporaryDirectory(prefix="morphgen-"))
            resources.callback(_close, self._loaded)
            self._exported = export_scenes(scenes, Path(folder))
            self._law = MotorLaw([scene.robot for scene in scenes], joints)
            self._sink = np.flatnonzero(self._is_joint)
            has_object = [scene.object is not None for scene in scenes]
            self._with_object = np.flatnonzero(has_object)
            self._loaded.extend(map(self._load, range(n)))
            self._go_home()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the clients; a second call does nothing."""
        super().close()
        self._free()

    def _load(self, i: int) -> BulletScene:
        return BulletScene(self.scenes[i], self._exported[i], self._contacts)

    def _put(
        self,
        envs: NDArray[np.int64],
        q: Float32,
        object_pose: Float32,
        obstacle_poses: Float32 | None,
    ) -> None:
        for row, i in enumerate(envs.tolist()):
            scene = self.scenes[i]
            if obstacle_poses is not None:
                count = len(scene.obstacles)
                self._obstacle_poses[i] = obstacle_poses[row, :count].tolist()
            if i in self._unreset:
                self._loaded[i].close()  # numbers that are not finite stay in a client
                self._loaded[i] = self._load(i)
                self._unreset.remove(i)
            positions = movable_positions(scene.robot, q[row, : scene.robot.dof])
            self._law.reset(i, positions)
            self._loaded[i].reset(positions, object_pose[row].tolist(), self._obstacle_poses[i])
            self._q[i], self._qd[i] = q[row], 0
            if scene.object is not None:
                self._pose[i] = self._loaded[i].object_state()[FROM_BULLET]
                self._velocity[i] = 0

    def _advance(self) -> Collection[int]:
        """Step; a scene diverges if its state is not finite, or faster than ``MAX_VELOCITY``."""
        if self._unreset:
            where = self._label(min(self._unreset))
            raise SimulationError(f"{where} diverged; expected a reset before the next step")
        velocities, forces = self._law.command(self._targets)
        states: list[Sequence[float]] = []
        for loaded, span in zip(self._loaded, self._law.spans, strict=True):
            states += loaded.step(velocities[span], forces[span])
        q, qd = self._law.measure(states)
        self._q.reshape(-1)[self._sink], self._qd.reshape(-1)[self._sink] = q, qd
        is_sane = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
        if len(self._with_object):
            objects = np.array([self._loaded[i].object_state() for i in self._with_object])
            self._pose[self._with_object] = objects[:, FROM_BULLET]
            self._velocity[self._with_object] = objects[:, 7:10]
            is_sane = is_sane and is_within(objects, MAX_VELOCITY)
        if not is_sane:
            self._unreset.update(filterfalse(self._is_sane, range(len(self.scenes))))
        return self._unreset

    def _is_sane(self, i: int) -> bool:
        is_sane = is_within(self._q[i], MAX_POSITION) and is_within(self._qd[i], MAX_VELOCITY)
        if self.scenes[i].object is not None:
            is_sane = is_sane and is_within(self._loaded[i].object_state(), MAX_VELOCITY)
        return is_sane


def _close(loaded: Sequence[BulletScene]) -> None:
    for each in loaded:
        each.close()


def export_scenes(scenes: Sequence[Scene], folder: Path) -> list[Exported]:
    """Write the URDF of every robot and object once; return what each scene loads."""
    written: dict[int, tuple[Path, Robot]] = {}

    def export(robot: Robot) -> tuple[Path, Robot]:
        if id(robot) not in written:
            merged = merge_rigid_links(robot)
            bundle = write_bundle(merged, folder / f"robot{len(written)}", picture=False)
            written[id(robot)] = bundle / URDF, merged
        return written[id(robot)]

    return [
        Exported(
            *export(scene.robot),
            export(scene.object.body)[0] if isinstance(scene.object, ArticulatedObject) else None,
        )
        for scene in scenes
    ]


SIMULATOR = Simulator(
    "pybullet",
    lambda scenes, contacts, *_: BulletSimulation(scenes, contacts),
    max_envs=128,  # an environment takes 36 MB
    takes_workers=False,
)
