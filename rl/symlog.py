"""A logarithm for returns of any sign and size, and what a critic of such numbers learns by."""

from __future__ import annotations

import torch


def symlog(x: torch.Tensor) -> torch.Tensor:
    """``sign(x) ln(1 + |x|)`` (Hafner et al. 2023, DreamerV3, equation 9)."""
    return torch.sign(x) * torch.log1p(torch.abs(x))


def symexp(x: torch.Tensor) -> torch.Tensor:
    """``sign(x) (exp |x| - 1)``: the inverse of ``symlog``."""
    return torch.sign(x) * torch.expm1(torch.abs(x))


def matching_loss(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """How far ``symexp(x)`` is from ``y``: 0 where they agree, else more; all shapes alike.

    Its slope in ``x`` is ``symexp(x) - y``. So it is convex, and what is learned of many ``y`` is
    the symlog of their mean; the squared error of symlogs has the mean of the symlogs, which is
    nearer to zero. (The matching loss of Auer, Herbster and Warmuth 1996, "Exponentially many local
    minima for single neurons", for the transfer function ``symexp``.)
    """
    best = symlog(y)
    return _potential(x) - _potential(best) - y * (x - best)


def half_square(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """How far ``x`` is from ``y``; its slope is ``x - y``, as ``matching_loss`` without symlog."""
    return 0.5 * (x - y).square()


def _potential(x: torch.Tensor) -> torch.Tensor:
    """The integral of ``symexp``."""
    return torch.expm1(torch.abs(x)) - torch.abs(x)
