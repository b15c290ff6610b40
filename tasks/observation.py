"""Observations: optional entries, and tokens of links and boxes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from morphgen.benchmark.tokens import FREQUENCIES, POSITION
from morphgen.errors import TaskError, nearest
from morphgen.tasks.registry import CHANNELS, KINEMATIC_CHANNELS
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import Scene

Observation = dict[str, torch.Tensor]
"""``tokens`` (n, L, 48), ``links`` and ``actions`` (n, L) bool; ``obstacles`` (n, O, 13) and
``obstacle_mask`` (n, O) bool; the fields of tasks with their masks, of ``task.STANDARD_FIELDS``:
``goal`` (n, 7), ``object`` (n, 13) and ``line`` (n, 1), ``goal_mask`` and ``object_mask`` (n,)
bool. On request: ``velocity`` (n, L), ``previous_action`` (n, L), ``tool`` (n, 3), ``points``
(n, P, 3) and ``point_mask`` (n, P) bool, the channels of ``kinematic_channels``, (n, L, size), and
the entries of ``tree_entries``."""

NUM_POINTS = 128
"""Number of points of a cloud that is asked for by name."""


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
    tree: bool = False
    """Whether to observe how the actuated joints are connected; see ``tree_entries``."""
    state: bool = True
    """Whether to observe block and obstacles as boxes; without it they need points."""
    obstacles: int = 0
    """Minimum number of obstacle rows, for policies that meet more obstacles elsewhere."""
    tree_joints: int = 0
    """Minimum number of joints of ``tree_entries``, for batches after which others have more."""

    def __post_init__(self) -> None:
        """Require counts."""
        if self.points < 0 or self.obstacles < 0:
            raise TaskError(
                f"observation of {self.points} points and {self.obstacles} obstacles; "
                "expected 0 or more"
            )
        if not self.state and not self.points:
            raise TaskError("observation without state: expected points, which replace it")

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


class LinkTokens:
    """Tokens of the links of a batch's environments; only codes of joint positions change."""

    def __init__(self, tables: RobotTables, env_robot_index: torch.Tensor) -> None:
        """Gather the tables of every environment."""
        device = env_robot_index.device
        movable = tables.movable_links[env_robot_index]
        max_movable = int(movable.sum(dim=1).max())
        # Indices of movable links (n, M); robots with fewer are filled up with other links.
        self._links = (~movable).int().argsort(dim=1, stable=True)[:, :max_movable]
        self._rows = torch.arange(len(env_robot_index), device=device)[:, None]
        self._constant = tables.tokens[env_robot_index]
        index = env_robot_index[:, None], self._links
        gains = tables.position_gain[index]
        self._joint = gains.abs().argmax(dim=2)  # each link follows one independent joint
        self._gain = torch.gather(gains, 2, self._joint[..., None])[..., 0]
        self._offset, self._wraps = tables.position_offset[index], tables.wraps[index]
        self._is_movable = tables.movable_links[index][..., None]
        self._frequencies = torch.from_numpy(FREQUENCIES).float().to(device)

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        """Return the tokens (n, L, 48) at independent joint positions (n, J)."""
        x = self._gain * torch.gather(q, 1, self._joint) + self._offset
        x = torch.where(self._wraps, x - 2 * torch.ceil((x - 1) / 2), x)
        angles = x[..., None] * self._frequencies
        codes = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1) * self._is_movable
        tokens = self._constant.clone()
        tokens[..., POSITION.columns][self._rows, self._links] = codes
        return tokens


def joint_to_link(
    tables: RobotTables, env_robot_index: torch.Tensor, values: torch.Tensor
) -> torch.Tensor:
    """Return values of independent joints (n, J) at the links that they move, shape (n, L)."""
    joint = tables.joint_of_link[env_robot_index]
    return torch.gather(values, 1, joint.clamp(min=0)) * (joint >= 0)


def box_tokens(pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Return tokens of boxes, shape (..., 13), from poses (..., 7) and edge lengths (..., 3)."""
    shape = torch.zeros_like(size)
    shape[..., 2].fill_(1)
    return torch.cat([pose, shape, size], dim=-1)


def obstacle_tokens(scenes: Sequence[Scene], min_rows: int, device: torch.device) -> Observation:
    """Return tokens of the obstacles in scenes, (n, O, 13), and the mask of real ones, (n, O)."""
    num_rows = max(min_rows, *(len(scene.obstacles) for scene in scenes))
    pose, size = torch.zeros(len(scenes), num_rows, 7), torch.zeros(len(scenes), num_rows, 3)
    mask = torch.zeros(len(scenes), num_rows, dtype=torch.bool)
    for i, scene in enumerate(scenes):
        for k, block in enumerate(scene.obstacles):
            pose[i, k] = torch.tensor([*block.pose.position, *block.pose.quaternion])
            size[i, k] = torch.tensor(block.size)
            mask[i, k] = True
    tokens = box_tokens(pose, size) * mask[..., None]
    return {"obstacles": tokens.to(device), "obstacle_mask": mask.to(device)}


MAX_TREE_DISTANCE = 8
"""Largest number of joints between two joints that observations tell apart."""
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
    common = (above.float() @ above.float().transpose(1, 2)).long()
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
