"""A scene that PyBullet simulates in a client of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from morphgen.errors import MissingDependencyError, SimulationError
from morphgen.formats.quiet import quiet
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.model.tree import rigid_groups
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP, Block, Contacts, Scene
from morphgen.tasks.sim.motor_law import limited_speeds
from morphgen.tasks.sim.rigid_bodies import ground_contact_links

try:
    with quiet():
        import pybullet
except ImportError as error:
    raise MissingDependencyError(
        "the simulator PyBullet is not installed: pip install pybullet (it has wheels up to "
        "Python 3.11), or take another simulator"
    ) from error

MAX_CLIENTS = 1024
"""Number of clients that PyBullet supports in a process."""
UNLIMITED = 1e6
"""Effort of a joint without an effort limit [N m or N]."""
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
_LINKS, _ROOT, _STATIC, _BLOCK = 1, 2, 4, 8
"""Collision groups: movable links, fixed links, ground and obstacles, block."""


class BulletScene:
    """A scene in its own PyBullet client.

    Motors. PyBullet's position control, v' = v - kd v + kp e / dt in every physics step, follows
    the control law only where nothing else moves the joint: the v on the right already includes the
    step's gravity and Coriolis acceleration, of which kd removes only a part. So motors control the
    velocity during a control step, with no more force than a spring and a damper would exert;
    ``BulletBatch`` computes the velocity, ``MotorForces`` the force. The robot carries its own
    weight: the world has no gravity, and the block's weight is an external force. One call makes
    all substeps; the motors act in each, but PyBullet computes their impulse limits with the time
    of the whole call, hence forces are divided by ``SUBSTEPS``. A mimic joint is a motor that
    follows its leader.

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

    def __init__(self, scene: Scene, urdf: Path, merged: Robot, contacts: Contacts) -> None:
        """Load the robot and its surroundings.

        Args:
            scene: The scene.
            urdf: URDF of ``merged``, as ``export_robots`` writes it.
            merged: The scene's robot after ``merge_rigid_links``.
            contacts: Pairs of things that collide.

        Raises:
            SimulationError: If PyBullet has no client left, or cannot load the robot.
        """
        self._scene, self._contacts = scene, contacts
        self.id: int = pybullet.connect(pybullet.DIRECT)
        if self.id < 0:
            raise SimulationError(
                f"PyBullet has no client left: a process has {MAX_CLIENTS}, one for each "
                "environment; use more worker processes or fewer environments"
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
                **({"constraintSolverType": direct} if scene.block is None else {}),
                **self._client,
            )
        self._groups: list[tuple[int, int, int, int]] = []
        self._load_robot(urdf, merged)
        self._load_surroundings()

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
        self.efforts = [_effort(merged, k) for k in merged.movable_joints]
        fastest = max(limited_speeds(merged), default=math.inf)
        if math.isfinite(fastest):
            pybullet.changeDynamics(
                self.robot, -1, maxJointVelocity=OVERSPEED * fastest, **self._client
            )
        root_links = {link.name for link in rigid_groups(merged)[0].links}
        level = ground_contact_links(merged, self._scene.T_world_root)
        self._level = [link for name, link in links.items() if name in level]
        for name, link in links.items():
            pybullet.changeDynamics(
                self.robot,
                link,
                lateralFriction=FRICTION,
                linearDamping=0,
                angularDamping=0,
                jointDamping=0,
                **self._client,
            )
            self._assign(self.robot, link, _ROOT if name in root_links else _LINKS)
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
            ground = pybullet.createMultiBody(0, plane, basePosition=at, **self._client)
            self._add(ground, FRICTION, _STATIC)
            for link in self._level:
                pybullet.setCollisionFilterPair(self.robot, ground, link, -1, 0, **self._client)
        self._obstacles = [
            self._add(self._box(obstacle), obstacle.friction, _STATIC)
            for obstacle in self._scene.obstacles
        ]
        block = self._scene.block
        self.block = -1
        self._weight: tuple[float, float, float] | None = None
        if block is not None:
            self.block = self._add(self._box(block), block.friction, _BLOCK)
            if block.mass > 0:
                self._weight = (0.0, 0.0, -GRAVITY * block.mass)

    def _box(self, block: Block) -> int:
        """Add a box; return PyBullet's body."""
        half = [edge / 2 for edge in block.size]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self._client)
        position, quaternion = _pose(block.pose)
        body: int = pybullet.createMultiBody(
            block.mass,
            shape,
            basePosition=position,
            baseOrientation=quaternion,
            **self._client,
        )
        return body

    def _add(self, body: int, friction: float, group: int) -> int:
        """Set a body's friction and collision group; return the body."""
        pybullet.changeDynamics(
            body, -1, lateralFriction=friction, linearDamping=0, angularDamping=0, **self._client
        )
        self._assign(body, -1, group)
        return body

    def _assign(self, body: int, link: int, group: int) -> None:
        """Record a link's collision group and the groups it collides with, for ``reset``."""
        robot = _LINKS | _ROOT
        surroundings = _STATIC | _BLOCK if self._contacts.scene else 0
        mask = {
            _LINKS: robot | surroundings,
            _ROOT: _LINKS | (surroundings & _BLOCK),
            _STATIC: _BLOCK | (_LINKS if self._contacts.scene else 0),
            _BLOCK: _STATIC | (robot if self._contacts.scene else 0),
        }[group]
        self._groups.append((body, link, group, mask))

    def reset(
        self,
        positions: Sequence[float],
        block_pose: Sequence[float],
        obstacle_poses: Sequence[Sequence[float]] | None = None,
    ) -> None:
        """Put robot and block at rest, and clear the contact history.

        Args:
            positions: Positions of all movable joints [rad or m].
            block_pose: Pose of the block, (x, y, z, qw, qx, qy, qz); ignored without a block.
            obstacle_poses: Poses of the obstacles; None leaves them where they are.
        """
        for joint, position in zip(self.driven, positions, strict=True):
            pybullet.resetJointState(self.robot, joint, position, **self._client)
        if self.block >= 0:
            x, y, z, qw, qx, qy, qz = block_pose
            pybullet.resetBasePositionAndOrientation(
                self.block, (x, y, z), (qx, qy, qz, qw), **self._client
            )
            pybullet.resetBaseVelocity(self.block, (0, 0, 0), (0, 0, 0), **self._client)
            self._block_position = (x, y, z)
        if obstacle_poses is not None:
            for body, pose in zip(self._obstacles, obstacle_poses, strict=True):
                x, y, z, qw, qx, qy, qz = pose
                pybullet.resetBasePositionAndOrientation(
                    body, (x, y, z), (qx, qy, qz, qw), **self._client
                )
        for entry in self._groups:
            pybullet.setCollisionFilterGroupMask(*entry, **self._client)

    def step(self, velocities: list[float], forces: list[float]) -> None:
        """Advance by a control step, given velocities and force limits of all movable joints."""
        if velocities:
            pybullet.setJointMotorControlArray(
                self.robot,
                self.driven,
                pybullet.VELOCITY_CONTROL,
                targetVelocities=velocities,
                forces=forces,
                **self._motors,
            )
        if self._weight is not None:
            pybullet.applyExternalForce(
                self.block,
                -1,
                self._weight,
                self._block_position,
                pybullet.WORLD_FRAME,
                **self._client,
            )
        pybullet.stepSimulation(**self._client)

    def joint_states(self) -> Sequence[tuple[float, float]]:
        """Return tuples that begin with position and velocity of the movable joints."""
        if not self.driven:
            return ()
        states: Sequence[tuple[float, float]] = pybullet.getJointStates(
            self.robot, self.driven, **self._client
        )
        return states

    def block_state(self) -> tuple[float, ...]:
        """Return position, quaternion (x, y, z, w), linear and angular velocity of the block."""
        position, quaternion = pybullet.getBasePositionAndOrientation(self.block, **self._client)
        linear, angular = pybullet.getBaseVelocity(self.block, **self._client)
        self._block_position = position
        return (*position, *quaternion, *linear, *angular)

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
