"""What an agent sees: tokens of links, the goal, the block and obstacles, with masks."""

from __future__ import annotations

import numpy as np
import torch

from morphgen.benchmark.token_layout import FREQUENCIES, POSITION
from morphgen.tasks.bodies import Bodies


def joint_positions(bodies: Bodies, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """The part of the tokens that moves: codes of the links' joint positions.

    Args:
        bodies: The robots.
        body: Which robot each row is, shape (n,), int64.
        q: Independent joint positions, shape (n, J).

    Returns:
        Shape (n, L, 16); zeros for links that do not move.
    """
    x = (bodies.to_link[body] @ q[:, :, None])[:, :, 0] + bodies.at_link[body]
    wrapped = x - 2 * torch.ceil((x - 1) / 2)
    x = torch.where(bodies.turns[body], wrapped, x)
    angles = x[..., None] * _frequencies(x.device)
    codes = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)
    return codes * bodies.moving[body][..., None]


def link_tokens(bodies: Bodies, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Tokens of all links in their configuration, shape (n, L, 48)."""
    made = bodies.tokens[body]
    made[..., POSITION.columns] = joint_positions(bodies, body, q)
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


def _frequencies(device: torch.device) -> torch.Tensor:
    return torch.from_numpy(np.asarray(FREQUENCIES, dtype=np.float32)).to(device)
