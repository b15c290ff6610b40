"""All that a task knows of physics: scenes, and a batch of them that steps together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3

if TYPE_CHECKING:  # processes of PyBullet need no torch, which takes seconds to load and 200 MB
    import torch

TIMESTEP = 0.005
"""Physics step: 200 Hz, as in AnyBody [s]."""
SUBSTEPS = 4
"""Number of physics steps per control step."""
CONTROL_PERIOD = TIMESTEP * SUBSTEPS
"""Duration of a control step: actions come at 50 Hz [s]."""
GRAVITY = 9.81
"""m/s^2, along -z. Robots carry their own weight, as the controllers of real arms see to it."""


@dataclass(frozen=True)
class Block:
    """A box in a scene, in the world frame."""

    size: Vec3
    """Edges, metres."""
    pose: Pose = IDENTITY
    mass: float = 0.0
    """Kilograms; a block without mass does not move."""
    friction: float = 1.0


@dataclass(frozen=True)
class Scene:
    """What one environment holds: a robot whose root is held, what it may move, what it may not."""

    robot: Robot
    T_world_root: Pose = IDENTITY
    block: Block | None = None
    """The one thing that can be moved."""
    obstacles: tuple[Block, ...] = ()
    ground: float | None = 0.0
    """Height of a plane, metres, if there is one; the root link does not touch it."""


@dataclass(frozen=True)
class Contacts:
    """What may touch what."""

    scene: bool = True
    """The robot touches the ground, the block and obstacles."""
    self_collision: bool = True
    """Links touch each other, but for neighbours and ``Robot.ignore_pairs``."""


class Simulation(Protocol):
    """Environments, each with its scene, stepped together.

    Tensors live on ``device``, float32, and are padded to the largest number of independent joints,
    J; padding is zero. They are views that the next call may overwrite. Environments do not
    influence each other: one gives the same numbers whatever else is in the batch.
    """

    device: torch.device

    @property
    def scenes(self) -> Sequence[Scene]:
        """One for every environment."""

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J), rad or m."""

    @property
    def qd(self) -> torch.Tensor:
        """Their velocities, shape (n, J)."""

    @property
    def block_pose(self) -> torch.Tensor:
        """Pose of the block in the world, (x, y, z, qw, qx, qy, qz), (n, 7); zeros if none."""

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocity of the block in the world, shape (n, 6); zeros if none."""

    def reset(self, envs: torch.Tensor, q: torch.Tensor, block_pose: torch.Tensor) -> None:
        """Put some environments at rest; nothing of their past has an influence any more.

        Args:
            envs: Indices, shape (k,), int64.
            q: Positions of their independent joints, which become the targets, shape (k, J).
            block_pose: Poses of their blocks, shape (k, 7); ignored where there is none.
        """

    def step(self, targets: torch.Tensor) -> None:
        """Move all by one control step.

        Args:
            targets: Target positions of the independent joints, shape (n, J).

        Raises:
            DivergedError: If environments diverged; it names them, and each must be reset before
                the next step. All others have moved.
            SimulationError: If a worker died.
        """

    def close(self) -> None:
        """Free everything; a second time does nothing."""


@dataclass(frozen=True)
class Simulator:
    """A simulator behind the registry ``morphgen.tasks.registry.SIMULATORS``."""

    name: str
    load: Callable[[Sequence[Scene], Contacts | None, int], Simulation]
    """Loads scenes: one for each environment, what may touch what, and the number of workers.

    It raises a SimulationError if the simulator cannot hold a scene."""
    native_step: tuple[str, str]
    """Names of the module and function of the library's own step, which ``speed`` times."""
    max_envs: int
    """Number of environments that are held at once at most, where a task can be divided."""
