"""Observations of a batch: optional entries, tokens, layouts of obstacles, points and paths."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.encoding.tokens import FREQUENCIES, POSITION
from morphgen.errors import TaskError, nearest
from morphgen.model.kinematics_torch import FramePositions, matrix_from_quaternion
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.kinematic_channels import KinematicChannels
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.registry import CHANNELS, KINEMATIC_CHANNELS
from morphgen.tasks.rows import at, duplicate, flat_index, namespace_of, numpy_row
from morphgen.tasks.scenes.obstacles import LayoutSide, layouts_of, place_boxes
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import OBJECT, A, EnvSpec
from morphgen.tasks.task_groups import TaskGroups

Observation = dict[str, torch.Tensor]
"""``tokens`` (n, L, 48), ``links`` and ``actions`` (n, L) bool; ``obstacles`` (n, O, 13) and
``obstacle_mask`` (n, O) bool; the fields of tasks with their masks, of ``task.STANDARD_FIELDS``:
``goal`` (n, 7), ``object`` (n, 13) and ``line`` (n, 1), ``goal_mask`` and ``object_mask`` (n,)
bool. On request: ``velocity`` (n, L), ``previous_action`` (n, L), ``tool`` (n, 3), ``points``
(n, P, 3) and ``point_mask`` (n, P) bool, the channels of ``kinematic_channels``, (n, L, size), and
the entries of ``tree_entries``."""

NUM_POINTS = 128  # number of points of a cloud that is asked for by name


@dataclass(frozen=True)
class ObservationConfig:
    """Entries of an observation; the paper uses none of those that are off by default but points.

    ``observation_config`` makes one of names, such as those of ``morphgen train --observe``.
    """

    velocity: bool = False
    """Whether to observe the velocities of the links' independent joints [rad/s or m/s]."""
    previous_action: bool = False
    """Whether to observe the previous normalized action."""
    tool: bool = False
    """Whether to observe the position of the tool in the world [m]."""
    points: int = 0
    """Number of points of a point cloud of block and obstacles."""
    lag: bool = False
    """Whether to observe how far joints are behind their targets; see ``kinematic_channels``."""
    joint: bool = False
    """Whether to observe position, limits and largest step of joints in physical units."""
    poses: bool = False
    """Whether to observe the poses of links, and tool and target points relative to them."""
    jacobian: bool = False
    """Whether to observe the tool's Jacobian and its products with the errors."""
    dls: bool = False
    """Whether to observe a damped least-squares step towards the targets."""
    ik: bool = False
    """Whether to observe the straight path to a configuration that reaches the target. It is
    planned on the CPU: steps of a batch on a GPU then wait for copies."""
    clearance: bool = False
    """Whether to observe how near the links that a joint moves are to obstacles."""
    contact: bool = False
    """Whether to observe how near those links are to the object, and where."""
    pace: bool = False
    """Whether kinematic channels show all robots as equally fast; see ``kinematic_channels``."""
    tree: bool = False
    """Whether to observe how the actuated joints are connected; see ``tree_entries``."""
    state: bool = True
    """Whether to observe block and obstacles as boxes; without it they need points."""
    obstacles: int = 0
    """Minimum number of obstacle rows, for policies that meet more obstacles elsewhere."""
    targets: int = 0
    """Minimum number of target points in kinematic channels, for policies of several tasks."""
    objects: bool = False
    """Whether kinematic channels have columns of objects also where no scene has one, likewise."""
    tree_joints: int = 0
    """Minimum number of joints of ``tree_entries``, for batches after which others have more."""

    def __post_init__(self) -> None:
        if self.points < 0 or self.obstacles < 0:
            raise TaskError(
                f"observation of {self.points} points and {self.obstacles} obstacles; "
                "expected 0 or more"
            )
        if not self.state and not self.points:
            raise TaskError("observation without state: expected points, which replace it")
        if self.pace and not self.kinematic_channels:
            names = ", ".join(KINEMATIC_CHANNELS)
            raise TaskError(f"observation channel pace: expected one that it changes: {names}")

    @property
    def kinematic_channels(self) -> tuple[str, ...]:
        """Names of the channels that come from ``kinematic_channels``."""
        return tuple(name for name in KINEMATIC_CHANNELS if getattr(self, name))


def observation_config(names: Collection[str], *, obstacles: int = 0) -> ObservationConfig:
    """Return the config of observations with some entries of ``CHANNELS``."""
    entries: dict[str, Any] = {"obstacles": obstacles}
    special: dict[str, dict[str, Any]] = {
        "points": {"points": NUM_POINTS},
        "no_state": {"state": False},
    }
    for name in names:
        if name not in CHANNELS:
            raise TaskError(f"unknown observation channel {name!r}{nearest(name, CHANNELS)}")
        entries |= special.get(name, {name: True})
    return ObservationConfig(**entries)


class LinkTokens(Generic[A]):
    """Tokens of the links of a batch's environments; only codes of joint positions change."""

    # Places of the codes in flattened tokens, of a row in NumPy only.
    _sines: Any
    _cosines: Any

    def __init__(self, tables: RobotTables, env_robot_index: torch.Tensor) -> None:
        movable = tables.movable_links[env_robot_index]
        max_movable = int(movable.sum(dim=1).max())
        # Indices of movable links (n, M); robots with fewer are filled up with other links.
        links = (~movable).int().argsort(dim=1, stable=True)[:, :max_movable]
        rows = env_robot_index[:, None]
        gains, is_movable = tables.position_gain[rows, links], tables.movable_links[rows, links]
        joint = gains.abs().argmax(dim=2)  # each link follows one independent joint
        self._constant: Any = tables.tokens[env_robot_index]
        self._joint: Any = flat_index(joint, tables.max_joints)[..., None]
        self._gain: Any = torch.gather(gains, 2, joint[..., None])
        self._offset: Any = tables.position_offset[rows, links][..., None]
        self._wraps: Any = tables.wraps[rows, links][..., None]
        self._frequencies: Any = torch.from_numpy(FREQUENCIES[None, None]).float().to(rows.device)
        self._is_movable: Any = is_movable[..., None]
        self._some_wrap, self._all_movable = bool(self._wraps.any()), bool(is_movable.all())
        self._links: Any = flat_index(links, tables.max_links)

    def numpy_row(self) -> LinkTokens[NDArray[Any]]:
        """Return the tokens of the first environment in NumPy; see ``rows.numpy_row``.

        Its tables have a number for each code: a product with broadcasting takes NumPy ten times as
        long.
        """
        row: LinkTokens[NDArray[Any]] = numpy_row(self)
        half = POSITION.start + np.arange(len(FREQUENCIES))
        row._sines = row._links[..., None] * row._constant.shape[1] + half
        row._cosines = row._sines + len(FREQUENCIES)
        for name in ("_joint", "_gain", "_offset", "_wraps", "_frequencies", "_is_movable"):
            setattr(row, name, np.broadcast_to(vars(row)[name], row._sines.shape).copy())
        return row

    def __call__(self, q: A) -> A:
        """Return the tokens (n, L, 48) at independent joint positions (n, J)."""
        xp = namespace_of(q)
        x = at(q, self._joint) * self._gain + self._offset
        if self._some_wrap:
            x = xp.where(self._wraps, x - 2 * xp.ceil((x - 1) / 2), x)
        angles = x * self._frequencies
        sines, cosines = xp.sin(angles), xp.cos(angles)
        if not self._all_movable:
            sines, cosines = sines * self._is_movable, cosines * self._is_movable
        tokens: A = duplicate(self._constant)
        if isinstance(tokens, torch.Tensor):  # rows of codes: single numbers take twice as long
            codes = torch.cat([sines, cosines], dim=-1).flatten(0, 1)
            tokens.flatten(0, 1)[:, POSITION.columns].index_copy_(0, self._links.flatten(), codes)
        else:  # single numbers: rows take NumPy three times as long
            flat = tokens.reshape(-1)
            flat[self._sines], flat[self._cosines] = sines, cosines
        return tokens


class LinkJoints(Generic[A]):
    """The independent joints that move the links of a batch's environments."""

    def __init__(self, tables: RobotTables, env_robot_index: torch.Tensor) -> None:
        joint = tables.joint_of_link[env_robot_index]
        self._joint: Any = flat_index(joint.clamp(min=0), tables.max_joints)
        self._has_joint: Any = joint >= 0

    def __call__(self, values: A) -> A:
        """Return values of independent joints (n, J) at the links that they move, (n, L)."""
        at_links: A = at(values, self._joint) * self._has_joint
        return at_links


def box_tokens(pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Return tokens of boxes, shape (..., 13), from poses (..., 7) and edge lengths (..., 3)."""
    shape = torch.zeros_like(size)
    shape[..., 2].fill_(1)
    return torch.cat([pose, shape, size], dim=-1)


def obstacle_tokens(scenes: Sequence[Scene], min_rows: int, device: torch.device) -> Observation:
    """Return tokens of the obstacles in scenes, (n, O, 13), and the mask of real ones, (n, O).

    The poses are zeros.
    """
    num_rows = max(min_rows, *(len(scene.obstacles) for scene in scenes))
    size = torch.zeros(len(scenes), num_rows, 3)
    for i, scene in enumerate(scenes):
        for k, block in enumerate(scene.obstacles):
            size[i, k] = torch.tensor(block.size)
    mask = size[..., 0] > 0
    tokens = box_tokens(size.new_zeros(*mask.shape, 7), size) * mask[..., None]
    return {"obstacles": tokens.to(device), "obstacle_mask": mask.to(device)}


MAX_TREE_DISTANCE = 8  # largest number of joints between two joints that observations tell apart
TREE_RELATIONS = 4 * (MAX_TREE_DISTANCE + 1)
"""Number of relations between two joints; see ``tree_entries``."""


def tree_entries(
    tables: RobotTables,
    env_robot_index: torch.Tensor,
    action_mask: torch.Tensor,
    least_joints: int = 0,
) -> Observation:
    """Return how the K joints that actions move are connected, with padding; all int64.

    ``joints`` (n, K): the link of each joint, root first, -1 for padding. ``joint_parents`` (n, K):
    the place in ``joints`` of the joint above, -1 without one. ``joint_relations`` (n, K, K): a
    number below ``TREE_RELATIONS`` for each pair, its distance in joints up to
    ``MAX_TREE_DISTANCE``, plus a multiple of ``MAX_TREE_DISTANCE + 1`` that says whether the second
    joint is the first one, above it, below it, or on another branch.
    """
    K = max(int(action_mask.sum(dim=1).max()), least_joints)
    order = (~action_mask).int().argsort(dim=1, stable=True)[:, :K]
    exists = torch.gather(action_mask, 1, order)
    rows = torch.arange(len(order), device=order.device)[:, None]
    # above[i, a]: joint a is joint i or above it; links come after their parents
    ancestors = tables.ancestors[env_robot_index]
    above = ancestors[rows[..., None], order[:, :, None], order[:, None, :]]
    above &= exists[:, :, None] & exists[:, None, :]
    depth = above.sum(dim=2)
    common = (above.float() @ above.float().transpose(1, 2)).long()  # torch multiplies no bools
    distance = (depth[:, :, None] + depth[:, None, :] - 2 * common).clamp(max=MAX_TREE_DISTANCE)
    same = torch.eye(K, dtype=torch.bool, device=order.device)
    kind = torch.where(above, 1, torch.where(above.transpose(1, 2), 2, 3))
    kind = torch.where(same, 0, kind)
    is_parent = above & (depth[:, :, None] - depth[:, None, :] == 1)
    parents = torch.where(is_parent.any(dim=2), is_parent.int().argmax(dim=2), -1)
    return {
        "joints": torch.where(exists, order, -1),
        "joint_parents": parents,
        "joint_relations": distance + (MAX_TREE_DISTANCE + 1) * kind,
    }


class EpisodeLayouts:
    """Draws the layout of every episode, and holds the current poses of all obstacles.

    Attributes:
        specs: Specification of each environment.
        poses: Current poses of the obstacles in the world, shape (n, O, 7); zeros where an
            environment has fewer than O. Updated in place.
        sizes: Edge lengths of the obstacles, shape (n, O, 3) [m]; zeros where it has fewer.
        entries: Observation of the obstacles, ``obstacles`` and ``obstacle_mask``; all padding if
            the state is not observed. Updated in place.
        current: Layout of each environment, an index of ``GoalSet.layouts``, shape (n,), int64; -1
            without obstacles. Updated in place.
    """

    def __init__(
        self,
        specs: Sequence[EnvSpec],
        env_robot_index: torch.Tensor,
        side: LayoutSide,
        observe: ObservationConfig,
    ) -> None:
        """Begin with the first layout of every environment."""
        device = env_robot_index.device
        self._robots = env_robot_index.tolist()
        self.specs = [specs[i] for i in self._robots]
        self._index = env_robot_index
        self._spaces: dict[int, FreeSpace] = {}
        scenes = [spec.scene for spec in self.specs]
        choices = [layouts_of(spec.config, side) for spec in specs]
        first, count = torch.tensor([(each.start, len(each)) for each in choices]).T.to(device)
        self._first, self._count = first[env_robot_index], count[env_robot_index]
        has_obstacles = torch.tensor([bool(scene.obstacles) for scene in scenes], device=device)
        self._has_obstacles = has_obstacles
        self.current = torch.where(has_obstacles, self._first, -1)
        self.entries = obstacle_tokens(scenes, observe.obstacles, device)
        num_obstacles = max(len(scene.obstacles) for scene in scenes)
        self.sizes = self.entries["obstacles"][:, :num_obstacles, 10:].clone()
        self._is_observed = observe.state
        if not observe.state:
            self.entries = {name: torch.zeros_like(v) for name, v in self.entries.items()}
        self._layout_poses = _layout_poses(specs, num_obstacles).to(device)
        self.poses = torch.zeros(len(scenes), num_obstacles, 7, device=device)
        self._place()

    @property
    def any(self) -> bool:
        """Whether an environment has obstacles."""
        return self.poses.shape[1] > 0

    def draw(self, mask: torch.Tensor, random: EpisodeRandom) -> None:
        """Draw the layouts of new episodes."""
        if self.any:
            layout = self._first + random.integers(Stream.LAYOUT, self._count)
            self.current.copy_(torch.where(mask & self._has_obstacles, layout, self.current))
            self._place()

    def obstacles(self, env: int) -> tuple[Block, ...]:
        """Return the obstacles of an environment at their current poses."""
        spec, layout = self.specs[env], int(self.current[env])
        if layout < 0:
            return ()
        return place_boxes(spec.scene.obstacles, spec.goals.layouts[layout])

    def scene(self, env: int) -> Scene:
        """Return the scene of an environment with its obstacles at their current poses."""
        scene: Scene = self.specs[env].scene
        return replace(scene, obstacles=self.obstacles(env))

    def space(self, env: int) -> FreeSpace:
        """Return the scene of an environment for tests of collisions; the next call may move it."""
        robot = self._robots[env]
        if robot not in self._spaces:
            self._spaces[robot] = FreeSpace(self.scene(env))
        elif obstacles := self.obstacles(env):
            self._spaces[robot].place_obstacles([obstacle.pose for obstacle in obstacles])
        return self._spaces[robot]

    def _place(self) -> None:
        """Put the obstacles where the current layouts have them."""
        self.poses.copy_(self._layout_poses[self._index, self.current.clamp(min=0)])  # -1: zeros
        if self._is_observed:
            self.entries["obstacles"][:, : self.poses.shape[1], :7] = self.poses


def _layout_poses(specs: Sequence[EnvSpec], num_obstacles: int) -> torch.Tensor:
    """Return the poses of the obstacles of S specifications in all L layouts, (S, L, O, 7).

    There are zeros where a specification has fewer obstacles or layouts.
    """
    layouts = {
        i: torch.from_numpy(spec.goals.layouts[:, :num_obstacles])
        for i, spec in enumerate(specs)
        if spec.scene.obstacles
    }
    num_layouts = max(map(len, layouts.values()), default=1)
    table = torch.zeros(len(specs), num_layouts, num_obstacles, 7)
    for i, poses in layouts.items():
        table[i, : len(poses), : poses.shape[1]] = poses
    return table


def _object_boxes(scenes: Sequence[Scene]) -> torch.Tensor:
    """Return edges and centres of ``Scene.object_box``, (n, 2, 3) [m]; zeros without an object."""
    nothing = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return torch.tensor([scene.object_box or nothing for scene in scenes])


NOISE = 0.005  # standard deviation of a point's position along each axis, as of a depth camera [m]
_NUMBERS = 8
"""Random numbers of a point: its face, its position in the box, and two pairs for noise."""


class PointClouds:
    """P points on the surfaces of every environment's object and obstacles.

    Of an articulated object they are on the box around the shape that tools push.

    Each episode draws its points and their noise at its beginning, uniformly over all surfaces.

    Attributes:
        mask: Existing points, shape (n, P), bool.
    """

    def __init__(
        self, scenes: Sequence[Scene], obstacle_sizes: torch.Tensor, num_points: int
    ) -> None:
        n, device = len(scenes), obstacle_sizes.device
        self._local = torch.zeros(n, num_points, 3, device=device)
        self._on_block = torch.zeros(n, num_points, dtype=torch.bool, device=device)
        # Box 0 is the object, and the others are the obstacles; missing ones have no size.
        edges, centres = _object_boxes(scenes).unbind(1)
        sizes = torch.cat([edges[:, None], obstacle_sizes.cpu()], dim=1)
        self._sizes, self._centre = sizes.to(device), centres[:, None].to(device)
        x, y, z = sizes.double().unbind(2)
        # Areas of the faces across x, y and z of all boxes, added up, as fractions of their sum.
        areas = torch.stack([y * z, x * z, x * y], dim=2).flatten(1).cumsum(dim=1)
        has_boxes = areas[:, -1:] > 0
        self._area = torch.where(has_boxes, areas / areas[:, -1:], 1.0).float().to(device)
        self.mask = has_boxes.repeat(1, num_points).to(device)

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, obstacle_poses: torch.Tensor
    ) -> None:
        """Draw the points of new episodes among obstacles at poses in the world, (n, O, 7)."""
        n, P = self._on_block.shape
        numbers = random.uniform(Stream.POINTS, P * _NUMBERS).view(n, P, _NUMBERS)
        # right=True: a face without area has the end of the one before, and is never drawn.
        face = torch.searchsorted(self._area, numbers[..., 0].contiguous(), right=True)
        box, axis = face // 3, face % 3
        position = numbers[..., 1:4] - 0.5
        is_across = torch.arange(3, device=axis.device) == axis[..., None]
        position = torch.where(is_across, torch.where(position < 0, -0.5, 0.5), position)
        rows = torch.arange(n, device=axis.device)[:, None]
        local = position * self._sizes[rows, box] + NOISE * _normal(numbers[..., 4:])[..., :3]
        on_block = box == 0
        local = torch.where(on_block[..., None], local + self._centre, local)
        if obstacle_poses.shape[1]:
            pose = obstacle_poses[rows, (box - 1).clamp(min=0)]
            R = matrix_from_quaternion(pose[..., 3:])
            world = (R * local[..., None, :]).sum(dim=-1) + pose[..., :3]
            local = torch.where(on_block[..., None], local, world)
        self._local.copy_(torch.where((mask[:, None] & self.mask)[..., None], local, self._local))
        self._on_block.copy_(torch.where(mask[:, None], on_block & self.mask, self._on_block))

    def __call__(self, object_pose: torch.Tensor) -> torch.Tensor:
        """Return the points in the root frame, shape (n, P, 3) [m]; zeros without boxes."""
        R = matrix_from_quaternion(object_pose[:, 3:])
        moved = self._local @ R.transpose(1, 2) + object_pose[:, None, :3]
        return torch.where(self._on_block[..., None], moved, self._local)


def _normal(uniform: torch.Tensor) -> torch.Tensor:
    """Return normal numbers from uniform ones in [0, 1) (Box and Muller 1958), shape (..., 2 m)."""
    first, second = uniform.chunk(2, dim=-1)
    radius = torch.sqrt(-2 * torch.log1p(-first))  # 1 - first is never zero
    angle = 2 * math.pi * second
    return torch.cat([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1)


@dataclass(frozen=True, eq=False)
class PhysicsState:
    """State of the robots and blocks of n environments; see ``Simulation``."""

    q: torch.Tensor
    qd: torch.Tensor
    object_pose: torch.Tensor


class BatchObservation:
    """Computes the observations of a batch.

    Attributes:
        tokens: Function that returns the tokens (n, L, 48) at joint positions (n, J).
        link_joints: Function that returns values of joints at the links that they move.
        tool_positions: Function that returns the positions of the tools (n, 3) [m] at joint
            positions (n, J).
    """

    def __init__(
        self,
        robot_tables: RobotTables,
        env_robot_index: torch.Tensor,
        groups: TaskGroups,
        layouts: EpisodeLayouts,
        action_mask: torch.Tensor,
        config: ObservationConfig,
    ) -> None:
        self._config, self._groups, self._layouts = config, groups, layouts
        index, device = env_robot_index, env_robot_index.device
        self.tokens: LinkTokens[torch.Tensor] = LinkTokens(robot_tables, index)
        self.link_joints: LinkJoints[torch.Tensor] = LinkJoints(robot_tables, index)
        self.tool_positions = FramePositions(robot_tables.tool_chain, index)
        scenes = [spec.scene for spec in layouts.specs]
        self._constant_entries = {
            "links": robot_tables.link_mask[index],
            "actions": action_mask,
            **groups.masks,
            **layouts.entries,
        }
        if config.tree:
            self._constant_entries |= tree_entries(
                robot_tables, index, action_mask, config.tree_joints
            )
        self._kinematics: KinematicChannels | None = None
        if names := config.kinematic_channels:
            has_object = torch.tensor([scene.object is not None for scene in scenes], device=device)
            self._kinematics = KinematicChannels(
                robot_tables,
                index,
                names,
                pace=config.pace,
                has_object=has_object if config.objects or bool(has_object.any()) else None,
                obstacles=layouts.poses,
                obstacle_sizes=layouts.sizes,
                object_boxes=_object_boxes(scenes).to(device),
                space_of=layouts.space,
            )
        self._points: PointClouds | None = None
        if config.points:
            self._points = PointClouds(scenes, layouts.sizes, config.points)
            self._constant_entries["point_mask"] = self._points.mask

    def begin(self, mask: torch.Tensor, random: EpisodeRandom) -> None:
        """Begin episodes, whose layouts are drawn."""
        if self._points is not None:
            self._points.begin(mask, random, self._layouts.poses)
        if self._kinematics is not None:
            self._kinematics.begin(mask)

    def __call__(
        self, state: PhysicsState, targets: torch.Tensor, previous_action: torch.Tensor
    ) -> Observation:
        """Return the observation in a state, in tensors that the caller owns."""
        return {
            "tokens": self.tokens(state.q),
            **self._groups.fields(state.object_pose),
            **copied(self._constant_entries),
            **self.requested(state, targets, previous_action),
        }

    def requested(
        self, state: PhysicsState, targets: torch.Tensor, previous_action: torch.Tensor
    ) -> Observation:
        """Return the entries that the configuration asks for; the arguments are those of a call."""
        q, object_pose, config = state.q, state.object_pose, self._config
        observation: Observation = {}
        if not config.state:
            observation["object"] = torch.zeros(len(q), OBJECT.size, device=q.device)
        if config.velocity:
            observation["velocity"] = self.link_joints(state.qd)
        if config.previous_action:
            observation["previous_action"] = previous_action.clone()
        if config.tool:
            observation["tool"] = self.tool_positions(q)
        if self._kinematics is not None:
            goals = self._groups.tool_targets(object_pose, config.targets)
            observation |= self._kinematics(q, targets, goals, object_pose)
        if self._points is not None:
            observation["points"] = self._points(object_pose)
        return observation


def copied(observation: Observation) -> Observation:
    """Return an observation in new tensors."""
    return {name: values.clone() for name, values in observation.items()}
