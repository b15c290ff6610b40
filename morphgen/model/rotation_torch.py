"""Rotations as batches of torch tensors: quaternions (w, x, y, z), matrices, rotation vectors."""

from __future__ import annotations

import torch


def quaternion_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions (w, x, y, z), w >= 0, (..., 4) of rotation matrices (..., 3, 3).

    Shepperd, Quaternion from rotation matrix, 1978: the products of a quaternion's components with
    its largest one are sums of the matrix's elements.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(-2).unbind(-1)
    rows = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, yx + xy, zx + xz),
        (xz - zx, yx + xy, 1 + yy - xx - zz, zy + yz),
        (yx - xy, zx + xz, zy + yz, 1 + zz - xx - yy),
    )
    products = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    row = torch.gather(products, -2, index).squeeze(-2)
    q = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def matrix_from_quaternion(quaternion: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of unit quaternions (w, x, y, z), shape (..., 4)."""
    w, v = quaternion[..., :1, None], quaternion[..., 1:]
    cross = skew(v)
    eye = torch.eye(3, device=quaternion.device)
    return eye + 2 * w * cross + 2 * cross @ cross


def skew(v: torch.Tensor) -> torch.Tensor:
    """Return the skew-symmetric matrices K (..., 3, 3) of vectors v (..., 3): K u = v x u."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*x.shape, 3, 3)


def rotation_from_z(axes: torch.Tensor) -> torch.Tensor:
    """Return the smallest rotations that turn z into unit vectors (..., 3), shape (..., 3, 3).

    For the opposite of z it is half a turn about x.
    """
    z = torch.zeros_like(axes)
    z[..., 2] = 1
    cross, cosine = torch.linalg.cross(z, axes), axes[..., 2]
    K = skew(cross)
    opposite = cosine < -1 + 1e-6
    factor = 1 / torch.where(opposite, torch.ones_like(cosine), 1 + cosine)
    eye = torch.eye(3, device=axes.device)
    R = eye + K + K @ K * factor[..., None, None]
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], device=axes.device))
    return torch.where(opposite[..., None, None], half_turn, R)


def angle_between(A: torch.Tensor, B: torch.Tensor) -> torch.Tensor:
    """Return the angles between rotation matrices (n, 3, 3), shape (n,) [rad].

    The Frobenius norm of A - B is sqrt(8) sin(angle / 2), which is well-conditioned at 0.
    """
    norm = (A - B).double().square().sum(dim=(1, 2)).sqrt().float()
    return 2 * torch.asin((norm / 8**0.5).clamp(max=1))


def rotvec_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """Return rotation vectors, angle times axis, (n, 3) [rad] of rotation matrices (n, 3, 3).

    Computed as the logarithm of the unit quaternion, which is well-conditioned at 0 and at pi.
    """
    quaternion = quaternion_from_matrix(R)
    w, v = quaternion[:, :1], quaternion[:, 1:]
    sine = torch.linalg.vector_norm(v, dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    # The limit of angle / sine at 0 is 2.
    return v * torch.where(sine > 0, angle / sine.clamp(min=1e-30), 2.0)
