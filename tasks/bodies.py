"""The robots of a batch as padded tensors: what observations, actions and rewards need of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from morphgen.benchmark.token_layout import POSITION
from morphgen.benchmark.tokens import MAX_LINKS, pad_tokens, tokens
from morphgen.errors import BenchmarkError, RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.kinematics import driving_joints, joint_limits
from morphgen.model.kinematics_torch import FrameChain, compile_chain
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.config import CONTROL_PERIOD, STEP_SLIDE, STEP_TURN


@dataclass(frozen=True, eq=False)
class Bodies:
    """R robots; L links and J independent joints, padded. All tensors are float32 on one device."""

    robots: tuple[Robot, ...]
    tokens: torch.Tensor
    """At home, shape (R, L, 48), the code of the joint position zero."""
    links: torch.Tensor
    """Which links there are, shape (R, L), bool."""
    joint_of_link: torch.Tensor
    """Index of the independent joint that moves each link, (R, L), int64; -1 where none does."""
    link_of_joint: torch.Tensor
    """The link that each independent joint moves, shape (R, J), int64; padding is 0."""
    lower: torch.Tensor
    upper: torch.Tensor
    """Limits of the independent joints, shape (R, J); padding is 0."""
    step: torch.Tensor
    """Largest change of a target in a control step, shape (R, J); padding is 0."""
    home: torch.Tensor
    """Shape (R, J)."""
    moves_tool: torch.Tensor
    """Independent joints on the way to the tool, shape (R, J), bool."""
    to_link: torch.Tensor
    """Scaled positions of the links' joints are ``to_link @ q + at_link``: shape (R, L, J)."""
    at_link: torch.Tensor
    """Shape (R, L)."""
    turns: torch.Tensor
    """Links whose position wraps, shape (R, L), bool."""
    moving: torch.Tensor
    """Links that a joint moves, mimic ones among them, shape (R, L), bool."""
    chain: FrameChain
    """The joints between the root and the tool of each robot."""

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.tokens.device

    @cached_property
    def max_links(self) -> int:
        """L."""
        return self.tokens.shape[1]

    @cached_property
    def max_joints(self) -> int:
        """J."""
        return self.home.shape[1]

    def action_mask(self, *, fingers: bool) -> torch.Tensor:
        """Links whose joint an action moves, shape (R, L), bool.

        Args:
            fingers: Whether joints beyond the tool count, as in push.
        """
        joint = self.joint_of_link.clamp(min=0)
        mask = self.joint_of_link >= 0
        return mask if fingers else mask & torch.gather(self.moves_tool, 1, joint)


def bodies_of(
    robots: Sequence[Robot],
    folders: Sequence[Path] = (),
    *,
    max_links: int = MAX_LINKS,
    device: torch.device | str = "cpu",
) -> Bodies:
    """Prepare the robots of a batch.

    Args:
        robots: Each with a tool frame and at least one joint that moves.
        folders: Folders of parts, for their stored fits.
        max_links: L; a robot may not have more.
        device: Where to put the tensors.

    Raises:
        BenchmarkError: If there are no robots, or one has too many links.
        RobotError: If a robot has no tool frame, or nothing moves.
    """
    if not robots:
        raise BenchmarkError("there are no robots")
    for robot in robots:
        robot.frame(TOOL)
        if robot.dof == 0:
            raise RobotError(f"robot {robot.name!r}: no joint moves")
    joints = max(robot.dof for robot in robots)
    rows = [_body(robot, folders, max_links, joints) for robot in robots]
    made = {
        name: torch.from_numpy(np.stack([row[name] for row in rows])).to(device) for name in rows[0]
    }
    made = {k: v.float() if v.is_floating_point() else v for k, v in made.items()}
    return Bodies(tuple(robots), chain=compile_chain(robots, device=device), **made)


def _body(
    robot: Robot, folders: Sequence[Path], max_links: int, joints: int
) -> dict[str, np.ndarray]:
    made, links = pad_tokens(
        tokens(robot, token_shapes(robot, folders), max_links=max_links), max_links
    )
    made[:, POSITION.columns] = 0
    dof = robot.dof
    limits = np.zeros((joints, 2))
    limits[:dof] = joint_limits(robot)
    home = np.zeros(joints)
    home[:dof] = robot.home
    joint_of_link, link_of_joint = np.full(max_links, -1), np.zeros(joints, dtype=np.int64)
    for i, k in enumerate(robot.independent_joints):
        joint_of_link[k + 1] = i
        link_of_joint[i] = k + 1
    moves_tool = np.zeros(joints, dtype=bool)
    moves_tool[[*driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))]] = True
    return {
        "tokens": made,
        "links": links,
        "joint_of_link": joint_of_link,
        "link_of_joint": link_of_joint,
        "lower": limits[:, 0],
        "upper": limits[:, 1],
        "step": _steps(robot, joints),
        "home": home,
        "moves_tool": moves_tool,
        **_scales(robot, max_links, joints),
    }


def _steps(robot: Robot, joints: int) -> np.ndarray:
    steps = np.zeros(joints)
    for i, k in enumerate(robot.independent_joints):
        joint = robot.joints[k]
        most = STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN
        steps[i] = min(most, joint.velocity * CONTROL_PERIOD) if joint.velocity else most
    return steps


def _scales(robot: Robot, max_links: int, joints: int) -> dict[str, np.ndarray]:
    """The scaled position of every link's joint as a linear map of q."""
    matrix, offset = robot.mimic_map
    to_link, at_link = np.zeros((max_links, joints)), np.zeros(max_links)
    turns, moving = np.zeros(max_links, dtype=bool), np.zeros(max_links, dtype=bool)
    for row, k in enumerate(robot.movable_joints):
        joint = robot.joints[k]
        low, high = joint.effective_limits
        half, middle = (high - low) / 2, (high + low) / 2
        to_link[k + 1, : robot.dof] = matrix[row] / half
        at_link[k + 1] = (offset[row] - middle) / half
        moving[k + 1] = True
        turns[k + 1] = joint.kind == "continuous" or (
            joint.kind == "revolute" and joint.limits is None
        )
    return {"to_link": to_link, "at_link": at_link, "turns": turns, "moving": moving}
