"""The interface of simulators: scenes, batches that step together, and the law of their motors."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.model import rotation
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.dynamics import GRAVITY as GRAVITY  # robots carry their own weight
from morphgen.model.geometry import IDENTITY, Box, Pose, Shape
from morphgen.model.robot import Joint, Robot
from morphgen.model.rotation import Vec3
from morphgen.processes import usable_cores
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.typing import Array

if TYPE_CHECKING:  # processes that sample goals need no torch, which takes seconds to load
    import torch

TIMESTEP = 0.005  # physics step: 200 Hz, as in AnyBody [s]
SUBSTEPS = 4  # number of physics steps per control step
CONTROL_PERIOD = TIMESTEP * SUBSTEPS  # duration of a control step: actions come at 50 Hz [s]

MOST_WORKERS = 8  # more threads would wait for Python's lock

HOST_DEVICES = ("cpu",)
"""Types of devices whose tensors the processor reads without waiting.

Reading a tensor of a GPU waits for all of its work. Steps of a batch therefore read none, but on
a host device they may look at a tensor to skip work that changes nothing.
"""


def is_host(device: torch.device) -> bool:
    """Return whether the processor reads tensors of a device without waiting."""
    return device.type in HOST_DEVICES


@dataclass(frozen=True)
class Block:
    """A box in a scene, in the world frame."""

    size: Vec3
    """Edge lengths [m]."""
    pose: Pose = IDENTITY
    """Pose of its centre in the world."""
    mass: float = 0.0
    """Mass [kg]; only the movable block of a scene has one."""
    friction: float = 1.0
    """Friction coefficient."""


@dataclass(frozen=True)
class Scene:
    """Content of an environment: a robot with a fixed root, an object that moves and obstacles."""

    robot: Robot
    T_world_root: Pose = IDENTITY
    object: Block | ArticulatedObject | None = None
    """Thing that the robot can move: a box with a mass, or an articulated object."""
    obstacles: tuple[Block, ...] = ()
    ground: float | None = 0.0
    """Height of a ground plane, or None without one [m]; the root link does not collide with it."""

    @property
    def block(self) -> Block | None:
        """The object, if it is a box."""
        return self.object if isinstance(self.object, Block) else None

    @property
    def object_shapes(self) -> tuple[Shape, ...]:
        """Collision shapes of the object that move, in the frame of its pose; none without one."""
        if isinstance(self.object, ArticulatedObject):
            return self.object.contact_shapes
        return () if self.object is None else (Shape(Box(self.object.size)),)

    @property
    def object_box(self) -> tuple[Vec3, Vec3] | None:
        """Edges of the block and zeros, or ``ArticulatedObject.contact_box``; None without one."""
        if isinstance(self.object, ArticulatedObject):
            return self.object.contact_box
        return None if self.object is None else (self.object.size, (0.0, 0.0, 0.0))

    @property
    def object_pose(self) -> Pose | None:
        """Pose of the object in the world at home, as ``Simulation.object_pose``; None without."""
        if not isinstance(self.object, ArticulatedObject):
            return None if self.object is None else self.object.pose
        home = np.array(self.object.body.home)
        x, y, z, *quaternion = self.object.placed_joint.poses(home)[0].tolist()
        return Pose((x, y, z), rotation.normalize((*quaternion,)))


def all_finite(values: NDArray[Any]) -> bool:
    """Return whether all values are finite."""
    flat = values.ravel()
    # They are if the sum of their squares is; it may also overflow.
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())


@dataclass(frozen=True)
class Contacts:
    """Pairs of things that collide."""

    scene: bool = True
    """Whether the robot collides with the ground, the object and obstacles."""
    self_collision: bool = True
    """Whether links collide with each other, except neighbours and ``Robot.ignore_pairs``."""


class Simulation(ABC):
    """Environments with a scene each, stepped together.

    Tensors are on ``device``; numbers are float32, padded with zeros to the largest number of
    independent joints, J. They are updated in place. Environments do not influence each other: each
    gives the same numbers whatever else is in the batch.

    On a GPU, ``reset`` and ``step`` read no tensor, so that the caller never waits for them.

    A new simulation is at rest at the home positions and at the poses of its scenes. Subclasses
    implement ``_reset`` and ``_step``.
    """

    q: torch.Tensor
    """Positions of the independent joints, shape (n, J) [rad or m]."""
    qd: torch.Tensor
    """Velocities of the independent joints, shape (n, J) [rad/s or m/s]."""
    object_pose: torch.Tensor
    """Poses in the world of the blocks, or of articulated objects at their contact points, which
    determine their joints: x, y, z, qw, qx, qy, qz, (n, 7); zeros without an object."""
    object_velocity: torch.Tensor
    """Linear velocities of the blocks in the world, (n, 3); zeros without one [m/s]."""

    def __init__(self, scenes: Sequence[Scene], device: torch.device) -> None:
        self.scenes, self.device = tuple(scenes), device
        self._num_obstacles = max(len(scene.obstacles) for scene in scenes)
        self._is_closed = False

    def reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        object_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None = None,
    ) -> None:
        """Put some environments at rest; clear everything that earlier steps left behind.

        All other arguments have a row for each environment, of which those outside of the mask may
        hold anything.

        Args:
            mask: Environments to reset, shape (n,), bool.
            q: Positions of the independent joints, which become the targets, shape (n, J).
            object_pose: Poses of the blocks, shape (n, 7); ignored without a block.
            obstacle_poses: Poses of the obstacles in the world, shape (n, O, 7), padded to the
                largest number of obstacles; None leaves them where they are.

        Raises:
            ValueError: On the CPU, if a number is not finite.
        """
        self._require_open()
        self._reset(mask, q, object_pose, obstacle_poses)

    def step(self, targets: torch.Tensor) -> torch.Tensor:
        """Advance all environments by one control step.

        Args:
            targets: Target positions of the independent joints, shape (n, J).

        Returns:
            Environments that diverged, shape (n,), bool: each must be reset before the next step.
            All others have moved. On a GPU, targets that are not finite diverge, too.

        Raises:
            ValueError: If the shape is wrong or, on the CPU, a target is not finite.
            SimulationError: If a worker died.
        """
        self._require_open()
        if targets.shape != self.q.shape:
            raise ValueError(
                f"targets have shape {tuple(targets.shape)}; expected {tuple(self.q.shape)}"
            )
        return self._step(targets)

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        self._is_closed = True

    @abstractmethod
    def _reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        object_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None,
    ) -> None: ...

    @abstractmethod
    def _step(self, targets: torch.Tensor) -> torch.Tensor: ...

    def _go_home(self) -> None:
        """Reset all environments to the home positions and to the poses of their scenes."""
        import torch

        n = len(self.scenes)
        q, block = torch.zeros(self.q.shape), torch.zeros(n, 7)
        obstacles = torch.zeros(n, self._num_obstacles, 7)
        for env, scene in enumerate(self.scenes):
            q[env, : scene.robot.dof] = torch.tensor(scene.robot.home)
            poses = [obstacle.pose for obstacle in scene.obstacles]
            moving = [] if scene.object_pose is None else [(block[env], scene.object_pose)]
            for row, pose in (*moving, *zip(obstacles[env], poses, strict=False)):
                row[:] = torch.tensor((*pose.position, *pose.quaternion))
        tensors = (torch.ones(n, dtype=torch.bool), q, block, obstacles)
        self.reset(*(tensor.to(self.device) for tensor in tensors))

    def _require_open(self) -> None:
        if self._is_closed:
            raise SimulationError("the simulation is closed")

    def _label(self, env: int) -> str:
        return f"environment {env} (robot {self.scenes[env].robot.name!r})"

    def _require_finite(self, what: str, rows: NDArray[Any]) -> None:
        """Require finite numbers in the row of each environment."""
        if not all_finite(rows):
            env = int(np.isfinite(rows.reshape(len(rows), -1)).all(axis=1).argmin())
            raise ValueError(
                f"{self._label(env)}: {what} {rows[env].tolist()}; expected finite numbers"
            )


class HostSimulation(Simulation):
    """A simulation on the CPU by a library that takes arrays of NumPy."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        import torch

        super().__init__(scenes, torch.device("cpu"))
        dofs = np.array([scene.robot.dof for scene in scenes])
        self._is_joint: NDArray[np.bool_] = np.arange(dofs.max()) < dofs[:, None]
        self._has_object = np.array([[scene.object is not None] for scene in scenes])
        self._targets: Array = np.zeros(self._is_joint.shape)
        self._seen: torch.Tensor | None = None
        self._diverged, self._any_diverged = torch.zeros(len(scenes), dtype=torch.bool), False

    @abstractmethod
    def _put(
        self,
        envs: NDArray[np.int64],
        q: NDArray[Any],
        object_pose: NDArray[Any],
        obstacle_poses: NDArray[Any] | None,
    ) -> None:
        """Put k environments at rest; all other arguments have k rows."""

    @abstractmethod
    def _advance(self) -> Collection[int]:
        """Step towards ``self._targets``; return the environments that diverged."""

    def _reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        object_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None,
    ) -> None:
        """See ``reset``."""
        rows = mask.numpy()[:, None]
        # Padding, poses without a block, and rows that are not reset may hold anything.
        positions = np.where(rows & self._is_joint, q.numpy(), 0)
        blocks = np.where(rows & self._has_object, object_pose.numpy(), 0)
        self._require_finite("reset to q", positions)
        self._require_finite("reset to block", blocks)
        obstacles = None
        envs = np.flatnonzero(rows)
        if obstacle_poses is not None:
            moved = np.where(rows[:, None], obstacle_poses.numpy(), 0)
            self._require_finite("reset to obstacles", moved)
            obstacles = moved[envs]
        self._put(envs, positions[envs], blocks[envs], obstacles)

    def _step(self, targets: torch.Tensor) -> torch.Tensor:
        """See ``step``."""
        if targets is not self._seen:  # to make a view takes 1 to 3 us
            self._seen, self._given = targets, targets.numpy()
        np.copyto(self._targets, self._given, where=self._is_joint)  # padding may be anything
        self._require_finite("targets", self._targets)
        diverged = self._advance()
        if diverged or self._any_diverged:
            self._any_diverged = bool(diverged)
            self._diverged = self._diverged.new_zeros(len(self.scenes))
            for env in diverged:
                self._diverged[env] = True
        return self._diverged


# The law of joint motors in all simulators: lag, speed limits and force limits.


def constant(value: float) -> Array:
    """Return a number as an array without axes, with which NumPy takes half of the time."""
    return np.array(value, np.float64)


def clamp(values: Array, bound: Array) -> Array:
    """Return values within +-bound: ``np.clip`` at a quarter of its overhead."""
    return np.minimum(np.maximum(values, -bound), bound)


def is_within(values: NDArray[Any], bound: float) -> bool:
    """Return whether all magnitudes are at most a bound; NaN is not."""
    flat = values.ravel()
    # They are if the root of the sum of their squares is, which is fast to test.
    return float(flat.dot(flat)) <= bound**2 or bool(np.abs(flat).max(initial=0.0) <= bound)


LAG = 2 / BANDWIDTH + TIMESTEP * SUBSTEPS
"""Largest delay of a joint behind a target that moves steadily in control steps [s]."""
FASTEST_TURN, FASTEST_SLIDE = 10.0, 1.0
"""Speed of joints without a limit [rad/s, m/s]: the benchmark's largest steps at 50 Hz."""
GAIN = 1 / (1 - 2 * BANDWIDTH * TIMESTEP)
"""Factor of the law's gains in MuJoCo, and so of the force of a held joint in all simulators.

MuJoCo integrates damping implicitly, v' = (v + dt s e) / (1 + dt d) at unit inertia. With
s = ``GAIN`` omega^2 and d = ``GAIN`` 2 omega this is v' = v + dt (omega^2 e - 2 omega v), as in
other simulators.
"""


_KEEP, _PULL = 1 - 2 * BANDWIDTH * TIMESTEP, BANDWIDTH**2 * TIMESTEP
CONTROL_STEP = np.linalg.matrix_power(
    np.array([[1 - TIMESTEP * _PULL, -TIMESTEP * _KEEP], [_PULL, _KEEP]]), SUBSTEPS
)
"""Matrix A of a control step with a constant target: (error, velocity) at the end are A times those
at the beginning, shape (2, 2).

A physics step is v' = v + dt (omega^2 e - 2 omega v), q' = q + dt v', as in MuJoCo. Tools that
follow the exact solution of the differential equation are several times as far from MuJoCo's.
"""


def speed_limit(joint: Joint) -> float:
    """Return the largest speed of a joint [rad/s or m/s]."""
    return joint.velocity or (FASTEST_SLIDE if joint.kind == "prismatic" else FASTEST_TURN)


def farthest_targets(robot: Robot, joints: Sequence[int]) -> list[float]:
    """Return the largest distance of some joints from their targets that pulls [rad or m]."""
    return [LAG * speed_limit(robot.joints[k]) for k in joints]


@dataclass(frozen=True)
class Simulator:
    """A simulator of the registry ``morphgen.tasks.registry.SIMULATORS``."""

    name: str
    """Name in the registry and on the command line."""
    load: Callable[[Sequence[Scene], Contacts | None, int, torch.device], Simulation]
    """Function that loads a scene for each environment.

    Its arguments are the scenes, the contacts, the number of workers and the device of the tensors.
    It raises a SimulationError if the simulator cannot hold a scene."""
    max_envs: int
    """Largest number of environments to hold at once, where work can be divided."""
    devices: tuple[str, ...] = ("cpu",)
    """Types of the devices that its tensors can be on, as of ``torch.device.type``."""
    simulates_contacts: bool = True
    """Whether the simulator has contacts; one without takes no scenes with a block or obstacles."""
    takes_workers: bool = True
    """Whether threads share its work; PyBullet has none, and others step all at once."""
    worker_envs: int = 0
    """Environments for which another worker is worth its cost: by default there are as many workers
    as these allow and cores can be used; 0 for one."""

    def default_workers(self, num_envs: int) -> int:
        """Return the number of workers if none is asked for; no result depends on it."""
        most = num_envs // self.worker_envs if self.worker_envs else 1
        return max(min(most, usable_cores(), MOST_WORKERS), 1)
