"""The interface of tasks: morphgen's own, and those of other packages.

A ``Task`` is one object. It samples and certifies the goal sets of robots (``sample``,
``certify``), defines the scene (``scene``), and makes ``TaskEnvs``, which hold the goals of a
batch's environments at this task and evaluate every step of them as tensors.
``morphgen.tasks.registry`` finds tasks by name.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3
from morphgen.tasks.sim.base import Block, Scene
from morphgen.typing import Array

if TYPE_CHECKING:  # tasks are also used by processes that need no torch, which is slow to load
    import torch

    from morphgen.tasks.random_numbers import EpisodeRandom


A = TypeVar("A", "torch.Tensor", NDArray[Any])
"""Tensors of a batch with an axis of rows, or NumPy values of one environment without it."""


@dataclass(eq=False)  # not frozen: every step makes one, which would take four times as long
class TaskState(Generic[A]):
    """State after a step for its evaluation: rows of k environments; positions in root frames."""

    tool: A
    """Position of the tool, shape (k, 3) [m]."""
    object_pose: A
    """Pose of the object, shape (k, 7); zeros if there is none."""
    limit_violation: A
    """Sum over joints of their distance outside of the limits, shape (k,) [rad and m]."""
    acceleration: A
    """Sum over joints of the absolute mean acceleration in the step, shape (k,)."""
    diverged: A
    """Whether the simulation diverged, shape (k,), bool; such a step is never a success."""
    tool_rotation: A | None = None
    """Rotation matrix of the tool, shape (k, 3, 3); None if no task ``needs_tool_rotation``."""


@dataclass(eq=False)  # not frozen, as TaskState
class StepResult(Generic[A]):
    """Result of a step: rows of k environments."""

    success: A
    """Whether the task is fulfilled, shape (k,), bool."""
    terminated: A
    """Whether the task ends the episode, shape (k,), bool."""
    distance: A
    """Distance from success, shape (k,) [m]."""
    score: A
    """Score of the step, shape (k,); see ``Task.episode_score``."""
    terms: dict[str, A]
    """Weighted reward terms by name, each of shape (k,); the reward is their sum."""
    angle: A | None = None
    """Angle from success, shape (k,) [rad]; None if the task wants no orientation."""

    def __post_init__(self) -> None:
        if not self.terms:
            raise TaskError("a StepResult without terms: expected at least one reward term")


class StepFormulas(ABC, Generic[A]):
    """The formulas of a task's step, for tensors of k environments and for NumPy arrays alike.

    They use operators, functions that torch and NumPy share, and those of ``morphgen.tasks.rows``.
    Arrays that they need are attributes with a row per environment, which ``TaskEnvs`` updates in
    place.
    """

    @abstractmethod
    def evaluate(self, state: TaskState[A]) -> StepResult[A]:
        """Return the result of a step, and advance whatever depends on time."""

    @abstractmethod
    def observe(self, object_pose: A) -> dict[str, A]:
        """Return the task's observation fields by name, shape (k, size) each.

        Args:
            object_pose: Poses of the object, shape (k, 7).
        """


class TaskConfig:
    """Constants of a task: base of a frozen dataclass whose fields all have defaults."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    task: ClassVar[str]
    """Name of the task."""
    file_keys: ClassVar[Mapping[str, str]] = {}
    """Keys in files of the fields that have another name there."""
    max_episode_steps: int
    """Time limit of an episode [control steps]."""
    num_goals: int
    """Number of goals in a robot's goal set."""
    obstacles: int = 0
    """Number of boxes in the scene if obstacles are requested; a task without any may leave out
    this field and those that follow."""
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    """Range of the edge lengths of these boxes, relative to the robot's reach."""
    train_layouts: int = 1
    """Number of layouts of these boxes that training draws its episodes from."""
    eval_layouts: int = 1
    """Number of further layouts that evaluation draws its episodes from."""

    def __post_init__(self) -> None:
        """Require valid values of the constants of every task, and only finite numbers or text."""
        name = type(self).__name__
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str) and isinstance(field.default, str):
                continue
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(isinstance(each, int | float) and math.isfinite(each) for each in numbers):
                raise TaskError(f"{name}: {field.name} {value!r}: expected finite numbers")
        # The largest are far above all uses: a file from elsewhere shall not fill the memory.
        for field_name, minimum, maximum in (
            ("max_episode_steps", 1, 1_000_000),
            ("num_goals", 1, 1_000_000),
            ("obstacles", 0, 1_000),
            ("train_layouts", 1, 1_000_000),
            ("eval_layouts", 1, 1_000_000),
        ):
            value = getattr(self, field_name)
            if not isinstance(value, int) or not minimum <= value <= maximum:
                raise TaskError(
                    f"{name}: {field_name} {value!r}: expected an integer >= {minimum} and "
                    f"<= {maximum:,}"
                )
        low, high = self.obstacle_size
        if not 0 < low <= high:
            raise TaskError(
                f"{name}: obstacle_size {self.obstacle_size}: expected 0 < lowest <= highest"
            )


class ObjectTaskConfig(TaskConfig):
    """Constants of a task of moving an object: its curriculum, and weights of its reward terms."""

    curriculum_steps: int
    """Number of equal steps in which the way grows during the first half of the training."""
    curriculum_start: float
    """Way at the start of the training, relative to its final value."""
    joint_limit_weight: float
    distance_weight: float
    success_weight: float
    approach_weight: float

    def __post_init__(self) -> None:
        """Require a curriculum of one step or more."""
        super().__post_init__()
        if self.curriculum_steps < 1:
            raise TaskError(f"a curriculum of {self.curriculum_steps} steps: expected 1 or more")


class GoalSet:
    """Starts and goals of a robot's episodes: base of a frozen dataclass.

    Its fields are arrays, boxes and numbers.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    robot: str
    """Name of the robot."""
    key: str
    """Hash of everything that the set depends on: 64 hexadecimal digits."""
    q: Array
    """Start configurations of episodes, shape (G, dof) [rad or m]."""
    obstacles: tuple[Block, ...]
    """Boxes in the robot's workspace, at the poses of the first layout."""
    layouts: Array
    """Poses of the boxes in the world in each layout, those for training first, (L, O, 7)."""
    usable: NDArray[np.bool_]
    """Whether each layout leaves each goal possible, shape (L, G)."""
    tried: int
    """Number of tested candidates."""
    accepted: int
    """Number of candidates that became goals: G."""
    seed: int
    """Seed of the random numbers."""

    @property
    def goal_poses(self) -> Array:
        """Pose that identifies each goal, position and quaternion wxyz, shape (G, 7)."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class EnvSpec:
    """A kind of environment: robot, task, scene, and the goal set that episodes draw from."""

    robot: Robot
    task: str
    """Name of the task."""
    scene: Scene
    """The robot with its ground, obstacles and block; it stands at the origin."""
    goals: GoalSet
    config: TaskConfig
    """Constants of the task."""


BOUND = 1000.0
"""Largest magnitude of an observed number [m, rad, m/s or rad/s]; episodes stay far below it."""


@dataclass(frozen=True)
class ObservationField:
    """A vector in the observation, filled by tasks that declare it and zero in other rows."""

    name: str
    """Name of the entry, shape (n, size)."""
    size: int
    """Length of the vector."""
    mask: str
    """Name of the entry that marks environments with the field, shape (n,), bool."""


GOAL = ObservationField("goal", 7, "goal_mask")
"""Wanted pose of the tool in the root frame: x, y, z, qw, qx, qy, qz."""
OBJECT = ObservationField("object", 13, "object_mask")
"""Token of the block, see ``observation.box_tokens``."""
LINE = ObservationField("line", 1, "object_mask")
"""y coordinate that the block must cross [m]."""
STANDARD_FIELDS = (GOAL, OBJECT, LINE)
"""Fields that every observation has, so that a policy fits batches of all tasks that use them."""


@dataclass(frozen=True)
class Marker:
    """A shape that a renderer draws to show a goal; it follows a pose and touches nothing."""

    name: str
    shape: Literal["frame", "box"]
    """``frame``: axes inside a translucent ball. ``box``: a box."""
    size: Vec3
    """Edge lengths of the box, or diameters of the ball [m]."""


class TaskEnvs(ABC):
    """The environments of one task in a batch, k rows.

    Methods that a step calls compute all rows as tensors on the batch's device and read none: no
    loops over environments, no ``nonzero``, no boolean index and no ``item``. So a step on a GPU
    never waits for it.
    """

    needs_tool_rotation: bool = False
    """Whether the formulas need ``TaskState.tool_rotation``."""
    formulas: StepFormulas[torch.Tensor]
    """Functions of the task on tensors; ``TaskEnv`` calls the same ones with arrays of NumPy."""

    @abstractmethod
    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, layout: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Begin episodes in some of the environments.

        Compute all rows, and change the own state only where the mask is set (``torch.where``).

        Args:
            mask: Environments whose episodes begin, shape (k,), bool.
            random: Random numbers of the episodes; rows outside of the mask hold any.
            layout: Layout of the obstacles in each environment, an index of ``GoalSet.layouts``,
                shape (k,), int64, -1 without obstacles; None if no environment has any.

        Returns:
            Joint positions at the start, shape (k, J), and poses of the object, shape (k, 7), zeros
            if there is none. Rows outside of the mask are ignored.
        """

    def target_points(self, object_pose: torch.Tensor) -> torch.Tensor:
        """Return points that the tool should visit, shape (k, P, 3) [m]; P is 0 by default.

        Of a task with an object the first is behind it, and the second on or in it: paths of the
        channel ``ik`` end away from the second.

        Args:
            object_pose: Pose of the object, shape (k, 7).
        """
        return object_pose.new_zeros(len(object_pose), 0, 3)

    def target_rotations(self) -> torch.Tensor | None:
        """Return orientations for the tool, shape (k, 3, 3); None if the task wants none."""
        return None

    def marker_poses(self, row: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of each of the task's markers in an environment, shape (7,) each."""
        return {}

    def advance(self, progress: float) -> None:
        """Advance the curriculum, if there is one; progress of the training is from 0 to 1."""
        return

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that the next episodes depend on besides random numbers; k rows each."""
        return {}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        return


C = TypeVar("C", bound=TaskConfig)
G = TypeVar("G", bound=GoalSet)


class Task(ABC, Generic[C, G]):
    """A task; the class attributes describe it to commands, evaluation and viewer."""

    name: str
    """Name in the registry, in splits and on the command line: lower-case letters and digits."""
    config_type: type[C]
    goal_set_type: type[G]
    goal_format: int
    """Version of ``sample``, part of every key; increase it when sampled sets change."""
    cache_folder: str
    """Name of the folder of goal sets in the user's cache."""
    fields: tuple[ObservationField, ...]
    """Observation fields that the task fills."""
    moves_fingers: bool = False
    """Whether actions also move joints beyond the tool."""
    discrete_actions: bool = False
    """Whether agents use discrete actions by default."""
    relative_to_random: bool = True
    """Whether the reported score is the difference from the random policy's score."""
    relative_distance: bool = True
    """Whether the final distance is also reported relative to the robot's reach."""
    num_targets: int = 0
    """Number of points that ``TaskEnvs.target_points`` returns."""
    moves_object: bool = False
    """Whether its scenes have an object."""
    target: str = "goal"
    """Noun for the thing that ``StepResult.distance`` is measured from."""

    @abstractmethod
    def sample(
        self,
        robot: Robot,
        config: C,
        *,
        obstacles: bool,
        ground: float,
        seeds: np.random.SeedSequence,
        identity: Mapping[str, Any],
    ) -> G:
        """Sample a robot's goal set.

        Args:
            robot: The robot, with a tool.
            config: Constants of the task.
            obstacles: Whether there are obstacles.
            ground: Height of the ground in the root frame [m].
            seeds: Source of all random numbers.
            identity: The fields ``robot``, ``key`` and ``seed`` of the set.

        Raises:
            BenchmarkError: If the robot cannot have such a set; the message says why.
            TaskError: If the robot does not suit the task; the message says why.
        """

    @abstractmethod
    def certify(self, goals: G, robot: Robot, scene: Scene) -> list[str]:
        """Test the goals of a set; return its faults, a line each.

        Args:
            goals: The set.
            robot: The robot.
            scene: Its scene, with the obstacles of the set.
        """

    @abstractmethod
    def make_envs(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> TaskEnvs:
        """Make the environments of a batch that are at this task.

        Args:
            specs: Specifications of environments, all at this task.
            env_spec_index: Index in ``specs`` of each environment, shape (k,), int64.
            num_joints: Independent joints of a row, padding included, J.
        """

    def check(self, robot: Robot, config: C) -> None:
        """Refuse robots that cannot have a goal set, before anything is sampled.

        Raises:
            TaskError: If the robot does not suit the constants.
            BenchmarkError: If the robot's tool does not move.
        """

    def key_parts(self, config: C) -> list[object]:
        """Return what the goal set depends on besides robot, obstacles, seed and ground."""
        return [config.num_goals]

    def scene(self, robot: Robot, goals: G, ground: float) -> Scene:
        """Return the scene of an environment."""
        return Scene(robot, obstacles=goals.obstacles, ground=ground)

    def episode_score(self, total: float, last: float, steps: int) -> float:
        """Return the score of an episode: the mean of its steps' scores.

        Args:
            total: Sum of the steps' scores.
            last: Score of the last step.
            steps: Number of steps.
        """
        return total / steps

    def score_range(self, config: C, reach: float) -> tuple[float, float]:
        """Return the lowest and the highest score that an episode can have.

        Args:
            config: Constants of the task.
            reach: Largest distance of the robot's tool from its root [m].
        """
        return -math.inf, math.inf

    def outcome_fault(self, config: C, success: bool, score: float, distance: float) -> str:
        """Return why an episode cannot have ended so, or nothing; submissions are checked with it.

        Args:
            config: Constants of the task.
            success: Whether it ended in success.
            score: See ``episode_score``.
            distance: Distance from success at the end [m].
        """
        return ""

    def markers(self, config: C, goals: G) -> tuple[Marker, ...]:
        """Return the shapes that show a robot's goal."""
        return ()

    def points_in_view(self, goals: G) -> Array:
        """Return points that a camera should see besides robot and obstacles, shape (m, 3)."""
        return goals.goal_poses[:, :3]


OC = TypeVar("OC", bound=ObjectTaskConfig)


class ObjectTask(Task[OC, G]):
    """A task of moving an object, which ends with its success; the score is the success."""

    moves_fingers = True
    moves_object = True
    relative_to_random = False
    relative_distance = False
    num_targets = 3

    def episode_score(self, total: float, last: float, steps: int) -> float:
        """Return 1 for success at the end, else 0."""
        return last

    def score_range(self, config: OC, reach: float) -> tuple[float, float]:
        """Return the score of a failure and that of a success."""
        return 0.0, 1.0

    def outcome_fault(self, config: OC, success: bool, score: float, distance: float) -> str:
        """Compare success with the score and with the final distance."""
        if score != float(success):
            return f"score {score:g} with success {str(success).lower()}; expected {success:d}"
        if success and distance > 0:
            return f"success at {distance:g} m from the {self.target}; expected 0"
        return ""
