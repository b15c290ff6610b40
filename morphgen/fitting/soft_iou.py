"""Gradient ascent on the intersection over union of primitives with a solid.

The membership of a point in a primitive is ``sigmoid(-distance / tau)``, so that the ratio of
volumes has a gradient; ``tau`` decreases during the ascent. The membership in a union is
``1 - prod(1 - membership)``, so overlaps count once. Many candidates, of one or several primitives
each, are optimised at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.fitting.canonical import KINDS
from morphgen.typing import Array

_SPHERE = KINDS.index("sphere")
_MAX_DISTANCES = 96_000
"""Number of distances that are evaluated together; bounds memory."""


@dataclass(frozen=True)
class Candidates:
    """``n`` candidates of ``k`` primitives each."""

    kinds: NDArray[np.int64]
    """Indices into ``KINDS``, shape (n, k)."""
    centres: Array
    """Centres, shape (n, k, 3)."""
    quaternions: Array
    """Rotations (w, x, y, z) of any norm, shape (n, k, 4)."""
    halves: Array
    """Half extents, shape (n, k, 3). A cylinder has its radius first and half its length third; a
    sphere's radius is the first."""

    def take(self, rows: NDArray[np.intp]) -> Candidates:
        """Return the candidates of some rows."""
        return Candidates(
            self.kinds[rows], self.centres[rows], self.quaternions[rows], self.halves[rows]
        )

    @staticmethod
    def stack(blocks: list[Candidates]) -> Candidates:
        """Concatenate candidates with the same number of primitives."""
        return Candidates._concatenate(blocks, axis=0)

    @staticmethod
    def join(blocks: list[Candidates]) -> Candidates:
        """Concatenate primitives: candidate i of the result has those of every candidate i."""
        return Candidates._concatenate(blocks, axis=1)

    @staticmethod
    def _concatenate(blocks: list[Candidates], axis: int) -> Candidates:
        arrays = zip(*(vars(candidates).values() for candidates in blocks), strict=True)
        return Candidates(*(np.concatenate(array, axis=axis) for array in arrays))


def ascend(
    candidates: Candidates,
    points: Array,
    inside: NDArray[np.bool_],
    *,
    weights: Array | None = None,
    num_steps: int,
    tau: tuple[float, float],
    rate: tuple[float, float],
) -> Candidates:
    """Improve candidates by gradient ascent (Adam) on the soft IoU.

    points: Points over the solid and its surroundings, shape (m, 3).
    inside: Points that are inside the solid, shape (m,).
    weights: Weights of the points, shape (m,), or per candidate, (n, m); by default 1.

    Returns:
        The candidates after the last step.
    """
    kinds = torch.from_numpy(candidates.kinds)
    x = torch.from_numpy(points.astype(np.float32))
    target = torch.from_numpy(inside.astype(np.float32))
    weight = torch.ones(1) if weights is None else torch.from_numpy(weights.astype(np.float32))
    parameters = [
        torch.from_numpy(start.astype(np.float32)).requires_grad_()
        for start in (candidates.centres, candidates.quaternions, np.log(candidates.halves))
    ]
    centres, quaternions, logs = parameters
    # One step of a rotation or of a logarithm moves the surface about as far as one of a centre.
    size = float(np.exp(np.log(candidates.halves).mean()))
    groups = [
        {"params": [centres], "unit": 1.0},
        {"params": [quaternions], "unit": 0.5 / size},
        {"params": [logs], "unit": 1.0 / size},
    ]
    optimizer = torch.optim.Adam(groups, lr=rate[0], betas=(0.8, 0.98))
    for step in range(num_steps):
        progress = step / max(num_steps - 1, 1)
        softness = tau[0] * (tau[1] / tau[0]) ** progress
        for group in optimizer.param_groups:
            group["lr"] = group["unit"] * rate[0] * (rate[1] / rate[0]) ** progress
        optimizer.zero_grad(set_to_none=True)
        distance = _distance(x, kinds, centres, quaternions, logs.exp())
        member = 1 - torch.exp(-torch.nn.functional.softplus(-distance / softness).sum(dim=1))
        member, weighted_target = member * weight, (target * weight).expand_as(member)
        intersection = (member * target).sum(dim=1)
        union = member.sum(dim=1) + weighted_target.sum(dim=1) - intersection
        loss = -(intersection / (union + 1e-9)).sum()
        torch.autograd.backward(loss)
        optimizer.step()
    with torch.no_grad():
        centres, quaternions, logs = (tensor.double() for tensor in parameters)
        unit = quaternions / quaternions.norm(dim=-1, keepdim=True)
    return Candidates(candidates.kinds, centres.numpy(), unit.numpy(), logs.exp().numpy())


def overlaps(
    candidates: Candidates,
    points: Array,
    inside: NDArray[np.bool_],
    weights: Array | None = None,
) -> Array:
    """Return the IoU of each candidate by counting points, shape (n,).

    points: Points over the solid and its surroundings, shape (m, 3).
    inside: Points that are inside the solid, shape (m,).
    weights: Weights of the points, shape (m,); by default 1.
    """
    target = torch.from_numpy(inside)
    weight = torch.from_numpy(np.ones(len(points)) if weights is None else weights)
    n, k = candidates.kinds.shape
    rows = max(_MAX_DISTANCES // (k * len(points)), 1)
    ious = []
    for start in range(0, n, rows):
        member = _members(candidates.take(np.arange(start, min(start + rows, n))), points)
        both, either = (count.double() @ weight for count in (member & target, member | target))
        ious.append(both / either.clamp(min=1e-12))
    return np.asarray(torch.cat(ious).numpy())


def covered(candidates: Candidates, points: Array) -> NDArray[np.bool_]:
    """Return which points (m, 3) are inside any primitive of each candidate, shape (n, m)."""
    return np.asarray(_members(candidates, points).numpy())


def distances(candidates: Candidates, points: Array) -> Array:
    """Return the signed distances of points (m, 3) to the union of each candidate, shape (n, m)."""
    return np.asarray(_distances(candidates, points).amin(dim=1).double().numpy())


def _members(candidates: Candidates, points: Array) -> torch.Tensor:
    return (_distances(candidates, points) <= 0).any(dim=1)


@torch.no_grad()
def _distances(candidates: Candidates, points: Array) -> torch.Tensor:
    """Return signed distances, shape (n, k, m), without gradients."""
    arrays = (candidates.centres, candidates.quaternions, candidates.halves)
    return _distance(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(candidates.kinds),
        *(torch.from_numpy(array.astype(np.float32)) for array in arrays),
    )


def _distance(
    x: torch.Tensor,
    kinds: torch.Tensor,
    centres: torch.Tensor,
    quaternions: torch.Tensor,
    halves: torch.Tensor,
) -> torch.Tensor:
    """Return signed distances (n, k, m) of points (m, 3) to primitives (n, k)."""
    n, k = kinds.shape
    if bool((kinds == _SPHERE).all()):
        # Spheres need no rotation of the points, which is most of the work.
        from_centres = torch.cdist(centres.reshape(1, n * k, 3), x[None])
        return from_centres.reshape(n, k, -1) - halves[:, :, :1]
    # Primitives are sorted by kind, so that each kind is one block of tensor operations.
    flat = kinds.reshape(-1)
    order = torch.argsort(flat, stable=True)
    local = _local(x, centres.reshape(-1, 3)[order], quaternions.reshape(-1, 4)[order])
    size = halves.reshape(-1, 3)[order][:, :, None]
    boxes, cylinders = (int((flat == KINDS.index(kind)).sum()) for kind in ("box", "cylinder"))
    end = boxes + cylinders
    distances = []
    if boxes:
        distances.append(_rounded(local[:boxes].abs() - size[:boxes]))
    if cylinders:
        points, half = local[boxes:end], size[boxes:end]
        radial = (points[:, :2].square().sum(dim=1) + 1e-12).sqrt() - half[:, 0]
        axial = points[:, 2].abs() - half[:, 2]
        distances.append(_rounded(torch.stack([radial, axial], dim=1)))
    if end < len(flat):
        distances.append((local[end:].square().sum(dim=1) + 1e-12).sqrt() - size[end:, 0])
    return torch.cat(distances)[torch.argsort(order)].reshape(n, k, -1)


def _rounded(beyond: torch.Tensor) -> torch.Tensor:
    """Return signed distances from the distances beyond each pair of faces, (p, faces, m)."""
    outside = (beyond.clamp(min=0).square().sum(dim=1) + 1e-16).sqrt()
    return outside + beyond.amax(dim=1).clamp(max=0)


def _local(x: torch.Tensor, centres: torch.Tensor, quaternions: torch.Tensor) -> torch.Tensor:
    """Return points (m, 3) in the frames of primitives, shape (p, 3, m)."""
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
