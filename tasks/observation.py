"""What an agent sees: tokens of links, the goal, the block and obstacles, with masks."""

from __future__ import annotations

import torch

from morphgen.benchmark.token_layout import FREQUENCIES, POSITION
from morphgen.tasks.bodies import Bodies


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
