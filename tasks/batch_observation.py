"""Observations of a batch: entries that never change, fields of tasks, and optional entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from morphgen.model.kinematics_torch import FramePositions
from morphgen.tasks.episode_layouts import EpisodeLayouts
from morphgen.tasks.kinematic_channels import KinematicChannels
from morphgen.tasks.observation import (
    LinkTokens,
    Observation,
    ObservationConfig,
    joint_to_link,
    tree_entries,
)
from morphgen.tasks.point_clouds import PointClouds
from morphgen.tasks.random_numbers import EpisodeRandom
from morphgen.tasks.robot_tables import RobotTables
from morphgen.tasks.straight_paths import StraightPaths
from morphgen.tasks.task import OBJECT, EnvSpec
from morphgen.tasks.task_groups import TaskGroups


@dataclass(frozen=True, eq=False)
class PhysicsState:
    """State of the robots and blocks of n environments."""

    q: torch.Tensor
    """Positions of the independent joints, shape (n, J) [rad or m]."""
    qd: torch.Tensor
    """Velocities of the independent joints, shape (n, J) [rad/s or m/s]."""
    block_pose: torch.Tensor
    """Poses of the blocks, shape (n, 7); zeros without one."""


class BatchObservation:
    """Computes the observations of a batch.

    Attributes:
        tool_positions: Function that returns the positions of the tools (n, 3) [m] at joint
            positions (n, J).
    """

    def __init__(
        self,
        robot_tables: RobotTables,
        specs: Sequence[EnvSpec],
        env_robot_index: torch.Tensor,
        groups: TaskGroups,
        layouts: EpisodeLayouts,
        action_mask: torch.Tensor,
        config: ObservationConfig,
        paths: StraightPaths,
    ) -> None:
        """Gather the tables of all environments.

        Args:
            robot_tables: The robots.
            specs: Specification of the environments of each robot.
            env_robot_index: Index of each environment's robot and specification, (n,), int64.
            groups: The environments grouped by task.
            layouts: Layouts of the obstacles in the running episodes.
            action_mask: Links whose joint obeys actions, shape (n, L), bool.
            config: Optional entries.
            paths: Tests of straight paths.
        """
        self._tables, self._index, self._config = robot_tables, env_robot_index, config
        self._groups, self._layouts = groups, layouts
        index, device = env_robot_index, env_robot_index.device
        self._tokens = LinkTokens(robot_tables, index)
        self.tool_positions = FramePositions(robot_tables.tool_chain, index)
        scenes = [specs[i].scene for i in index.tolist()]
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
            has_block = torch.tensor([scene.block is not None for scene in scenes], device=device)
            self._kinematics = KinematicChannels(
                robot_tables, index, names, has_block=has_block, first_free=paths
            )
        self._points: PointClouds | None = None
        if config.points:
            self._points = PointClouds(scenes, config.points, device)
            self._constant_entries["point_mask"] = self._points.mask

    def begin(self, mask: torch.Tensor, random: EpisodeRandom) -> None:
        """Begin episodes, whose layouts are drawn.

        Args:
            mask: Environments whose episodes begin, shape (n,), bool.
            random: Random numbers of the episodes.
        """
        if self._points is not None:
            self._points.begin(mask, random, self._layouts.poses)
        if self._kinematics is not None:
            self._kinematics.begin(mask)

    def __call__(
        self, state: PhysicsState, targets: torch.Tensor, previous_action: torch.Tensor
    ) -> Observation:
        """Return the observation in a state, in tensors that the caller owns.

        Args:
            state: The state.
            targets: Targets of the independent joints, shape (n, J) [rad or m].
            previous_action: Normalized actions of the last step, shape (n, L).
        """
        return {
            "tokens": self._tokens(state.q),
            **self._groups.fields(state.block_pose),
            **copied(self._constant_entries),
            **self.requested(state, targets, previous_action),
        }

    def requested(
        self, state: PhysicsState, targets: torch.Tensor, previous_action: torch.Tensor
    ) -> Observation:
        """Return the entries that the configuration asks for; the arguments are those of a call."""
        q, block_pose, config = state.q, state.block_pose, self._config
        observation: Observation = {}
        if not config.state:
            observation["object"] = torch.zeros(len(q), OBJECT.size, device=q.device)
        if config.velocity:
            observation["velocity"] = joint_to_link(self._tables, self._index, state.qd)
        if config.previous_action:
            observation["previous_action"] = previous_action.clone()
        if config.tool:
            observation["tool"] = self.tool_positions(q)
        if self._kinematics is not None:
            goals = self._groups.tool_targets(block_pose)
            observation |= self._kinematics(q, targets, goals, block_pose)
        if self._points is not None:
            observation["points"] = self._points(block_pose)
        return observation


def copied(observation: Observation) -> Observation:
    """Return an observation in new tensors."""
    return {name: values.clone() for name, values in observation.items()}
