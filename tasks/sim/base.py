"""The interface of simulators: scenes, and a batch of them that steps together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from morphgen.model.dynamics import GRAVITY as GRAVITY  # robots carry their own weight
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3

if TYPE_CHECKING:  # processes of PyBullet need no torch, which takes seconds to load and 200 MB
    import torch

TIMESTEP = 0.005  # physics step: 200 Hz, as in AnyBody [s]
SUBSTEPS = 4  # number of physics steps per control step
CONTROL_PERIOD = TIMESTEP * SUBSTEPS  # duration of a control step: actions come at 50 Hz [s]

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
    """Mass [kg]; a block without mass does not move."""
    friction: float = 1.0
    """Friction coefficient."""


@dataclass(frozen=True)
class Scene:
    """Content of an environment: a robot with a fixed root, a movable block and obstacles."""

    robot: Robot
    T_world_root: Pose = IDENTITY
    block: Block | None = None
    """Box that the robot can push; None without one."""
    obstacles: tuple[Block, ...] = ()
    ground: float | None = 0.0
    """Height of a ground plane, or None without one [m]; the root link does not collide with it."""


@dataclass(frozen=True)
class Contacts:
    """Pairs of things that collide."""

    scene: bool = True
    """Whether the robot collides with the ground, the block and obstacles."""
    self_collision: bool = True
    """Whether links collide with each other, except neighbours and ``Robot.ignore_pairs``."""


class Simulation(Protocol):
    """Environments with a scene each, stepped together.

    Tensors are on ``device``; numbers are float32, padded with zeros to the largest number of
    independent joints, J. They are views that the next call may overwrite. Environments do not
    influence each other: each gives the same numbers whatever else is in the batch.

    On a GPU, ``reset`` and ``step`` read no tensor, so that the caller never waits for them.
    """

    device: torch.device

    @property
    def scenes(self) -> Sequence[Scene]:
        """Scene of each environment."""

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J) [rad or m]."""

    @property
    def qd(self) -> torch.Tensor:
        """Velocities of the independent joints, shape (n, J) [rad/s or m/s]."""

    @property
    def block_pose(self) -> torch.Tensor:
        """Poses of the blocks in the world: x, y, z, qw, qx, qy, qz, (n, 7); zeros without one."""

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocities of the blocks in the world, (n, 6); zeros without one."""

    def reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        block_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None = None,
    ) -> None:
        """Put some environments at rest; clear everything that earlier steps left behind.

        All other arguments have a row for each environment, of which those outside of the mask may
        hold anything.

        Args:
            mask: Environments to reset, shape (n,), bool.
            q: Positions of the independent joints, which become the targets, shape (n, J).
            block_pose: Poses of the blocks, shape (n, 7); ignored without a block.
            obstacle_poses: Poses of the obstacles in the world, shape (n, O, 7), padded to the
                largest number of obstacles; None leaves them where they are.

        Raises:
            ValueError: If a shape is wrong or, on the CPU, a number is not finite.
        """

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

    def faults(self) -> dict[int, str]:
        """Return why each environment diverged in the last step; waits for the device."""

    def close(self) -> None:
        """Free everything; a second call does nothing."""


@dataclass(frozen=True)
class Simulator:
    """A simulator of the registry ``morphgen.tasks.registry.SIMULATORS``."""

    name: str
    """Name in the registry and on the command line."""
    load: Callable[[Sequence[Scene], Contacts | None, int, torch.device], Simulation]
    """Function that loads a scene for each environment.

    Its arguments are the scenes, the contacts, the number of workers and the device of the tensors.
    It raises a SimulationError if the simulator cannot hold a scene."""
    native_step: tuple[str, str] | None
    """Module and function of the library's own step, which ``speed`` measures; None without one."""
    max_envs: int
    """Largest number of environments to hold at once, where work can be divided."""
    devices: tuple[str, ...] = ("cpu",)
    """Types of the devices that its tensors can be on, as of ``torch.device.type``."""
    simulates_contacts: bool = True
    """Whether the simulator has contacts; one without takes no scenes with a block or obstacles."""
    contact_margin: float = 0.0
    """Distance within which convex meshes push each other away, although they do not touch [m]."""
    takes_workers: bool = True
    """Whether processes or threads share its work; one without steps all environments at once."""


def require_finite(scenes: Sequence[Scene], what: str, rows: NDArray[Any]) -> None:
    """Require finite numbers in the row of each environment."""
    finite = np.isfinite(rows.reshape(len(rows), -1)).all(axis=1)
    if not finite.all():
        env = int(finite.argmin())
        raise ValueError(
            f"environment {env} (robot {scenes[env].robot.name!r}): {what} {rows[env].tolist()}; "
            "expected finite numbers"
        )


def require_reset_shapes(
    scenes: Sequence[Scene],
    num_joints: int,
    mask: torch.Tensor,
    q: torch.Tensor,
    block_pose: torch.Tensor,
    obstacle_poses: torch.Tensor | None,
) -> None:
    """Require that arguments of ``Simulation.reset`` have the right shapes."""
    n = len(scenes)
    if tuple(mask.shape) != (n,) or str(mask.dtype) != "torch.bool":
        raise ValueError(
            f"reset with a mask of shape {tuple(mask.shape)} and type {mask.dtype}; expected "
            f"({n},) and torch.bool"
        )
    if tuple(q.shape) != (n, num_joints) or tuple(block_pose.shape) != (n, 7):
        raise ValueError(
            f"reset to q of shape {tuple(q.shape)} and blocks of shape {tuple(block_pose.shape)}; "
            f"expected ({n}, {num_joints}) and ({n}, 7)"
        )
    if obstacle_poses is None:
        return
    most = max(len(scene.obstacles) for scene in scenes)
    if tuple(obstacle_poses.shape) != (n, most, 7):
        raise ValueError(
            f"reset to obstacles of shape {tuple(obstacle_poses.shape)}; expected ({n}, {most}, 7)"
        )
