"""The symmetric logarithm of returns, and the losses of critics with and without it."""

from __future__ import annotations

import torch


def symlog(x: torch.Tensor) -> torch.Tensor:
    """Return ``sign(x) ln(1 + |x|)`` (Hafner et al. 2023, DreamerV3, equation 9)."""
    return torch.sign(x) * torch.log1p(torch.abs(x))


def symexp(x: torch.Tensor) -> torch.Tensor:
    """Return ``sign(x) (exp |x| - 1)``, the inverse of ``symlog``."""
    return torch.sign(x) * torch.expm1(torch.abs(x))


def matching_loss(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the loss of predictions ``x`` of ``symlog(y)``: 0 if ``symexp(x)`` is ``y``.

    Its derivative in ``x`` is ``symexp(x) - y``. It is convex; for many ``y`` its minimum is the
    symlog of their mean. The squared error of symlogs would learn the mean of the symlogs,
    which is nearer to zero. This is the matching loss of the transfer function ``symexp`` (Auer,
    Herbster and Warmuth 1996, "Exponentially many local minima for single neurons").
    """
    best = symlog(y)
    return _potential(x) - _potential(best) - y * (x - best)


def half_square(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return half the squared error, the ``matching_loss`` of a critic without symlog."""
    return 0.5 * (x - y).square()


def _potential(x: torch.Tensor) -> torch.Tensor:
    """Return the integral of ``symexp`` from 0 to x."""
    return torch.expm1(torch.abs(x)) - torch.abs(x)
