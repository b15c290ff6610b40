"""A layer of a transformer over a dozen tokens."""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional


def attend(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Attention (Vaswani et al. 2017, equation 1) to the tokens of a mask alone.

    Args:
        q: What heads ask for, shape (n, heads, T, features of a head).
        k: What they find, of the same shape.
        v: What they take from it, of the same shape.
        mask: Tokens that there are, shape (n, T), bool; one at least.
    """
    if q.device.type == "cpu":
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None])
    return attend_to_few(q, k, v, mask)


def attend_to_few(
    q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: torch.Tensor
) -> torch.Tensor:
    """As ``attend``, a product of matrices after the other.

    For GPUs: their kernels that do all of it at once are for long sequences, and take several times
    as long for a dozen tokens.
    """
    scores = (q @ k.transpose(-2, -1)) / math.sqrt(q.shape[-1])
    weights = torch.where(mask[:, None, None], scores, -torch.inf).softmax(dim=-1)
    return weights.to(v.dtype) @ v


class Block(nn.Module):
    """A layer of a transformer, normalised before each half (Xiong et al. 2020)."""

    def __init__(self, features: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(features)
        self.qkv = nn.Linear(features, 3 * features)
        self.merge = nn.Linear(features, features)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(features),
            nn.Linear(features, feedforward),
            nn.GELU(),
            nn.Linear(feedforward, features),
        )

    def forward(self, x: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Mix x (n, T, features); nobody attends to what is not in the mask (n, T)."""
        qkv = self.qkv(self.norm_attention(x)).unflatten(2, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mixed = attend(q, k, v, mask)
        x = x + self.merge(mixed.transpose(1, 2).flatten(2))
        found: torch.Tensor = x + self.feedforward(x)
        return found
