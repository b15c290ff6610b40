"""Gradient ascent on the intersection over union of primitives with a solid.

Membership of a point in a primitive is softened, ``sigmoid(-distance / tau)``, so that the volume
ratio has a gradient; ``tau`` shrinks while the search goes on. A union's membership is
``1 - prod(1 - membership)``, so overlap counts once. Many candidates, of one or several primitives
each, are moved at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.typing import Array

_BUNCH = 96
"""Primitives times thousand points that are evaluated together; bounds memory."""


@dataclass(frozen=True)
class Candidates:
    """``n`` guesses of ``k`` primitives each; arrays are (n, k, ...)."""

    kinds: NDArray[np.int64]
    """Index into ``canonical.KINDS``, shape (n, k)."""
    centres: Array
    """Shape (n, k, 3)."""
    quaternions: Array
    """(w, x, y, z), of any length, shape (n, k, 4)."""
    halves: Array
    """Half extents, shape (n, k, 3): a cylinder's radius is the first, half its length the third;
    a sphere's radius is the first."""

    def take(self, rows: NDArray[np.intp]) -> Candidates:
        """Some of the guesses."""
        return Candidates(
            self.kinds[rows], self.centres[rows], self.quaternions[rows], self.halves[rows]
        )

    @staticmethod
    def stack(several: list[Candidates]) -> Candidates:
        """All guesses of several, of the same ``k``."""
        return Candidates(
            *(
                np.concatenate([getattr(each, name) for each in several])
                for name in ("kinds", "centres", "quaternions", "halves")
            )
        )

    @staticmethod
    def join(several: list[Candidates]) -> Candidates:
        """Guesses side by side: each has the primitives of all, row by row."""
        return Candidates(
            *(
                np.concatenate([getattr(each, name) for each in several], axis=1)
                for name in ("kinds", "centres", "quaternions", "halves")
            )
        )


def ascend(
    candidates: Candidates,
    points: Array,
    inside: NDArray[np.bool_],
    *,
    weights: Array | None = None,
    steps: int,
    tau: tuple[float, float],
    rate: tuple[float, float],
) -> Candidates:
    """Move candidates uphill.

    Args:
        candidates: Where to start.
        points: Shape (m, 3), evenly spread over the solid and around it.
        inside: Whether each lies in the solid, shape (m,).
        weights: What each point counts, shape (m,), or for each candidate, (n, m); by default 1.
        steps: How many steps.
        tau: Softness at the first and at the last step, metres.
        rate: Step sizes at the first and at the last step, for coordinates in metres.

    Returns:
        The candidates where they ended.
    """
    kinds = torch.from_numpy(candidates.kinds)
    x = torch.from_numpy(points.astype(np.float32))
    target = torch.from_numpy(inside.astype(np.float32))
    weight = torch.ones(1) if weights is None else torch.from_numpy(weights.astype(np.float32))
    moved = [
        torch.from_numpy(start.astype(np.float32)).requires_grad_()
        for start in (candidates.centres, candidates.quaternions, np.log(candidates.halves))
    ]
    centres, quaternions, logs = moved
    size = float(np.exp(np.log(candidates.halves).mean()))
    groups = [
        {"params": [centres], "unit": 1.0},
        {"params": [quaternions], "unit": 0.5 / size},
        {"params": [logs], "unit": 1.0 / size},
    ]
    optimiser = torch.optim.Adam(groups, lr=rate[0], betas=(0.8, 0.98))
    for step in range(steps):
        part = step / max(steps - 1, 1)
        softness = tau[0] * (tau[1] / tau[0]) ** part
        for group in optimiser.param_groups:
            group["lr"] = group["unit"] * rate[0] * (rate[1] / rate[0]) ** part
        optimiser.zero_grad(set_to_none=True)
        distance = _distance(x, kinds, centres, quaternions, logs.exp())
        member = 1 - torch.exp(-torch.nn.functional.softplus(-distance / softness).sum(dim=1))
        member, wanted = member * weight, (target * weight).expand_as(member)
        both = (member * target).sum(dim=1)
        loss = -(both / (member.sum(dim=1) + wanted.sum(dim=1) - both + 1e-9)).sum()
        torch.autograd.backward(loss)
        optimiser.step()
    with torch.no_grad():
        centres, quaternions, logs = (tensor.double() for tensor in moved)
        unit = quaternions / quaternions.norm(dim=-1, keepdim=True)
    return Candidates(candidates.kinds, centres.numpy(), unit.numpy(), logs.exp().numpy())


def overlaps(
    candidates: Candidates,
    points: Array,
    inside: NDArray[np.bool_],
    weights: Array | None = None,
) -> Array:
    """Intersection over union of every candidate, by counting points; shape (n,).

    Args:
        candidates: What is measured.
        points: Shape (m, 3).
        inside: Whether each lies in the solid, shape (m,).
        weights: What each point counts, shape (m,); by default 1.
    """
    target = torch.from_numpy(inside)
    weight = torch.from_numpy(np.ones(len(points)) if weights is None else weights)
    n, k = candidates.kinds.shape
    rows = max(_BUNCH * 1000 // (k * len(points)), 1)
    found = []
    for start in range(0, n, rows):
        member = _members(candidates.take(np.arange(start, min(start + rows, n))), points)
        both, either = (count.double() @ weight for count in (member & target, member | target))
        found.append(both / either.clamp(min=1e-12))
    return np.asarray(torch.cat(found).numpy())


def covered(candidates: Candidates, points: Array) -> NDArray[np.bool_]:
    """Which points (m, 3) lie in any primitive of each candidate, shape (n, m)."""
    return np.asarray(_members(candidates, points).numpy())


@torch.no_grad()
def _members(candidates: Candidates, points: Array) -> torch.Tensor:
    arrays = (candidates.centres, candidates.quaternions, candidates.halves)
    distance = _distance(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(candidates.kinds),
        *(torch.from_numpy(array.astype(np.float32)) for array in arrays),
    )
    return (distance <= 0).any(dim=1)


def _distance(
    x: torch.Tensor,
    kinds: torch.Tensor,
    centres: torch.Tensor,
    quaternions: torch.Tensor,
    halves: torch.Tensor,
) -> torch.Tensor:
    """Signed distances (n, k, m) of points (m, 3) to primitives (n, k)."""
    n, k = kinds.shape
    flat = kinds.reshape(-1)
    order = torch.argsort(flat, stable=True)
    local = _local(x, centres.reshape(-1, 3)[order], quaternions.reshape(-1, 4)[order])
    size = halves.reshape(-1, 3)[order][:, :, None]
    boxes, cylinders = (int((flat == i).sum()) for i in (0, 1))
    found = []
    if boxes:
        found.append(_rounded(local[:boxes].abs() - size[:boxes]))
    if cylinders:
        some, h = local[boxes : boxes + cylinders], size[boxes : boxes + cylinders]
        radial = (some[:, :2].square().sum(dim=1) + 1e-12).sqrt() - h[:, 0]
        found.append(_rounded(torch.stack([radial, some[:, 2].abs() - h[:, 2]], dim=1)))
    if boxes + cylinders < len(flat):
        some, h = local[boxes + cylinders :], size[boxes + cylinders :]
        found.append((some.square().sum(dim=1) + 1e-12).sqrt() - h[:, 0])
    return torch.cat(found)[torch.argsort(order)].reshape(n, k, -1)


def _rounded(beyond: torch.Tensor) -> torch.Tensor:
    """Signed distance from how far a point is beyond each pair of faces, shape (p, faces, m)."""
    outside = (beyond.clamp(min=0).square().sum(dim=1) + 1e-16).sqrt()
    return outside + beyond.amax(dim=1).clamp(max=0)


def _local(x: torch.Tensor, centres: torch.Tensor, quaternions: torch.Tensor) -> torch.Tensor:
    """Points (m, 3) in the frames of primitives: (p, 3, m)."""
    w, a, b, c = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(dim=-1)
    inverse = torch.stack(
        [
            torch.stack([1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)], -1),
            torch.stack([2 * (a * b - w * c), 1 - 2 * (a * a + c * c), 2 * (b * c + w * a)], -1),
            torch.stack([2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)], -1),
        ],
        dim=1,
    )
    return inverse @ x.T - (inverse @ centres[:, :, None])
