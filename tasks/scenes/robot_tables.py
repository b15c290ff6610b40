"""Robots of a batch as padded tensors, which observations, actions and rewards index."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.encoding.tokens import MAX_LINKS, POSITION, pad_tokens, tokens
from morphgen.errors import RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.kinematics import driving_joints, joint_limits
from morphgen.model.kinematics_torch import FrameChain, compile_chain
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.sim.base import CONTROL_PERIOD

STEP_TURN, STEP_SLIDE = 0.2, 0.02
"""Largest change of a joint target per control step [rad, m], if the joint is fast enough."""


@dataclass(frozen=True, eq=False)
class RobotTables:
    """Tensors of R robots with L links and J independent joints, padded; float32, one device."""

    robots: tuple[Robot, ...]
    tokens: torch.Tensor  # link tokens, shape (R, L, 48); the codes of joint positions are zero
    link_mask: torch.Tensor  # existing links, shape (R, L), bool
    joint_of_link: torch.Tensor
    """Index of the independent joint that moves each link, shape (R, L), int64; -1 if none does."""
    link_of_joint: torch.Tensor
    """Index of the link that each independent joint moves, shape (R, J), int64; padding is 0."""
    lower: torch.Tensor
    """Lower limits of the independent joints, shape (R, J) [rad or m]; padding is 0."""
    upper: torch.Tensor
    """Upper limits of the independent joints, shape (R, J) [rad or m]; padding is 0."""
    max_step: torch.Tensor
    """Largest change of a target per control step, shape (R, J) [rad or m]; padding is 0."""
    is_prismatic: torch.Tensor  # independent joints that slide, shape (R, J), bool
    effort: torch.Tensor
    """Largest forces of the independent joints, shape (R, J) [N m or N]; 0 for none and padding."""
    home: torch.Tensor  # home configurations, shape (R, J) [rad or m]; padding is 0
    moves_tool: torch.Tensor  # independent joints that move the tool, shape (R, J), bool
    position_gain: torch.Tensor
    """Matrix G, shape (R, L, J): the joint of each link has the scaled position G q + offset."""
    position_offset: torch.Tensor  # offset of the scaled joint positions, shape (R, L)
    wraps: torch.Tensor
    """Links whose joint turns without limits, so that its position wraps, shape (R, L), bool."""
    movable_links: torch.Tensor
    """Links that a joint moves, mimic joints included, shape (R, L), bool."""
    ancestors: torch.Tensor
    """Whether link j is link i or a link between it and the root, shape (R, L, L), bool."""
    tool_chain: FrameChain  # joints between root and tool of each robot

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.tokens.device

    @property
    def max_links(self) -> int:
        """Number of links with padding, L."""
        return self.tokens.shape[1]

    @property
    def max_joints(self) -> int:
        """Number of independent joints with padding, J."""
        return self.home.shape[1]

    def action_mask(self, *, fingers: bool) -> torch.Tensor:
        """Return the links whose joint an action moves, shape (R, L), bool."""
        joint = self.joint_of_link.clamp(min=0)
        mask = self.joint_of_link >= 0
        return mask if fingers else mask & torch.gather(self.moves_tool, 1, joint)

    def nearest_turns(
        self, robots: torch.Tensor, q: torch.Tensor, near: torch.Tensor
    ) -> torch.Tensor:
        """Return configurations (..., n, J) turned by full turns, to be nearer to others (n, J).

        Joints stay within their limits. Only joints that move the tool turn.
        """
        nearer = q - 2 * math.pi * torch.round((q - near) / (2 * math.pi))
        turns = ~self.is_prismatic[robots] & self.moves_tool[robots]
        allowed = turns & (nearer >= self.lower[robots]) & (nearer <= self.upper[robots])
        return torch.where(allowed, nearer, q)


def build_robot_tables(
    robots: Sequence[Robot],
    folders: Sequence[Path] = (),
    *,
    max_links: int = MAX_LINKS,
    device: torch.device | str = "cpu",
) -> RobotTables:
    """Build the tables of robots."""
    for robot in robots:
        robot.frame(TOOL)
        if robot.dof == 0:
            raise RobotError(f"robot {robot.name!r}: no joint moves")
    num_joints = max(robot.dof for robot in robots)
    rows = [_table_rows(robot, folders, max_links, num_joints) for robot in robots]
    tables = {}
    for name in rows[0]:
        table = torch.from_numpy(np.stack([row[name] for row in rows])).to(device)
        tables[name] = table.float() if table.is_floating_point() else table
    return RobotTables(tuple(robots), tool_chain=compile_chain(robots, device=device), **tables)


def _table_rows(
    robot: Robot, folders: Sequence[Path], max_links: int, num_joints: int
) -> dict[str, NDArray[Any]]:
    """Return one robot's row of each table."""
    # First, as it requires few enough links for the memory.
    link_tokens = tokens(robot, token_shapes(robot, folders), max_links=max_links)
    rows: dict[str, NDArray[Any]] = {
        name: np.zeros(num_joints) for name in ("lower", "upper", "max_step", "effort", "home")
    }
    rows |= {name: np.zeros(max_links, dtype=bool) for name in ("wraps", "movable_links")}
    rows["joint_of_link"] = np.full(max_links, -1)
    rows["link_of_joint"] = np.zeros(num_joints, dtype=np.int64)
    rows["position_gain"] = np.zeros((max_links, num_joints))
    rows["position_offset"] = np.zeros(max_links)
    rows |= {name: np.zeros(num_joints, dtype=bool) for name in ("moves_tool", "is_prismatic")}
    rows["ancestors"] = np.eye(max_links, dtype=bool)

    rows["tokens"], rows["link_mask"] = pad_tokens(link_tokens, max_links)
    rows["tokens"][:, POSITION.columns] = 0  # they change with every step; see ``LinkTokens``
    dof = robot.dof
    rows["lower"][:dof], rows["upper"][:dof] = joint_limits(robot).T
    rows["home"][:dof] = robot.home
    rows["moves_tool"][[*driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))]] = True
    for i, k in enumerate(robot.independent_joints):
        joint = robot.joints[k]
        rows["joint_of_link"][k + 1], rows["link_of_joint"][i] = i, k + 1
        max_step = STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN
        if joint.velocity:  # 0 is "unknown" in many URDFs
            max_step = min(max_step, joint.velocity * CONTROL_PERIOD)
        rows["max_step"][i], rows["is_prismatic"][i] = max_step, joint.kind == "prismatic"
        rows["effort"][i] = joint.effort or 0.0
    for i, parent in enumerate(robot.parents[1:], start=1):  # parents come before their children
        rows["ancestors"][i] |= rows["ancestors"][parent]

    # Tokens code a joint position p scaled to [-1, 1]; p = mimic_matrix q + mimic_offset.
    mimic_matrix, mimic_offset = robot.mimic_map
    for row, k in enumerate(robot.movable_joints):
        joint = robot.joints[k]
        low, high = joint.effective_limits
        half_range, centre = (high - low) / 2, (high + low) / 2
        rows["position_gain"][k + 1, :dof] = mimic_matrix[row] / half_range
        rows["position_offset"][k + 1] = (mimic_offset[row] - centre) / half_range
        rows["movable_links"][k + 1] = True
        rows["wraps"][k + 1] = joint.kind == "continuous" or (
            joint.kind == "revolute" and joint.limits is None
        )
    return rows
