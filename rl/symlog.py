"""A logarithm for returns of any sign and size."""

from __future__ import annotations

import torch


def symlog(x: torch.Tensor) -> torch.Tensor:
    """``sign(x) ln(1 + |x|)`` (Hafner et al. 2023, DreamerV3, equation 9)."""
    return torch.sign(x) * torch.log1p(torch.abs(x))


def symexp(x: torch.Tensor) -> torch.Tensor:
    """``sign(x) (exp |x| - 1)``: the inverse of ``symlog``."""
    return torch.sign(x) * torch.expm1(torch.abs(x))
