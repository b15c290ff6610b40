"""Observations: what they have besides the fields of tasks, and tokens of links and boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from morphgen.benchmark.token_layout import FREQUENCIES, POSITION
from morphgen.tasks.bodies import Bodies
from morphgen.tasks.sim.base import Scene

Observation = dict[str, torch.Tensor]
"""``tokens`` (n, L, 48), ``links`` and ``actions`` (n, L) bool; ``obstacles`` (n, O, 13) and
``obstacle_mask`` (n, O) bool; the fields of tasks with their masks: of ``task.STANDARD_FIELDS``
``goal`` (n, 7), ``object`` (n, 13) and ``line`` (n, 1), ``goal_mask`` and ``object_mask`` (n,)
bool. If asked for, ``velocity`` (n, L), ``previous_action`` (n, L), ``tool`` (n, 3), ``points``
(n, P, 3) and ``point_mask`` (n, P) bool."""


@dataclass(frozen=True)
class ObservationConfig:
    """Entries of an observation that are not there by default; the paper has only the points."""

    velocity: bool = False
    """Velocities of the links' independent joints, rad/s or m/s."""
    previous_action: bool = False
    """The action before, as shares of the joints' largest steps."""
    tool: bool = False
    """Position of the tool in the world, metres."""
    points: int = 0
    """Number of points of a point cloud of block and obstacles."""
    obstacles: int = 0
    """Least number of rows for obstacles: for policies that meet more of them elsewhere."""


class LinkTokens:
    """Tokens of the links of a batch's environments; only codes of joint positions move."""

    def __init__(self, bodies: Bodies, body: torch.Tensor) -> None:
        """Prepare.

        Args:
            bodies: The robots.
            body: Which robot each row is, shape (n,), int64.
        """
        moving = bodies.moving[body]
        most = int(moving.sum(dim=1).max())
        self._links = (~moving).int().argsort(dim=1, stable=True)[:, :most]
        """Links that move, before others where a robot has fewer, shape (n, M)."""
        self._rows = torch.arange(len(body), device=body.device)[:, None]
        self._still = bodies.tokens[body]
        each = body[:, None], self._links
        gains = bodies.to_link[each]
        self._joint = gains.abs().argmax(dim=2)
        self._gain = torch.gather(gains, 2, self._joint[..., None])[..., 0]
        self._offset, self._turns = bodies.at_link[each], bodies.turns[each]
        self._counts = bodies.moving[each][..., None]
        self._frequencies = torch.from_numpy(FREQUENCIES).float().to(body.device)

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        """Tokens (n, L, 48) at independent joint positions (n, J)."""
        x = self._gain * torch.gather(q, 1, self._joint) + self._offset
        x = torch.where(self._turns, x - 2 * torch.ceil((x - 1) / 2), x)
        angles = x[..., None] * self._frequencies
        codes = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1) * self._counts
        made = self._still.clone()
        made[..., POSITION.columns][self._rows, self._links] = codes
        return made


def of_links(bodies: Bodies, body: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Values of independent joints (n, J) as those of the links that they move, shape (n, L)."""
    joint = bodies.joint_of_link[body]
    return torch.gather(values, 1, joint.clamp(min=0)) * (joint >= 0)


def box_tokens(pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Tokens of boxes: pose (..., 7) and edges (..., 3) to (..., 13)."""
    shape = torch.zeros_like(size)
    shape[..., 2] = 1
    return torch.cat([pose, shape, size], dim=-1)


def obstacle_tokens(scenes: Sequence[Scene], least: int, device: torch.device) -> Observation:
    """Return tokens of the obstacles in scenes, (n, O, 13), and which there are, (n, O).

    Args:
        scenes: One for each environment.
        least: Least number of rows, O.
        device: Device of the tensors.
    """
    most = max(least, *(len(scene.obstacles) for scene in scenes))
    pose, size = torch.zeros(len(scenes), most, 7), torch.zeros(len(scenes), most, 3)
    mask = torch.zeros(len(scenes), most, dtype=torch.bool)
    for i, scene in enumerate(scenes):
        for k, block in enumerate(scene.obstacles):
            pose[i, k] = torch.tensor([*block.pose.position, *block.pose.quaternion])
            size[i, k] = torch.tensor(block.size)
            mask[i, k] = True
    tokens = box_tokens(pose, size) * mask[..., None]
    return {"obstacles": tokens.to(device), "obstacle_mask": mask.to(device)}
