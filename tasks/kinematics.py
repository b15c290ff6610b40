"""Where tools are, and how their joints move them, for a batch of different bodies at once."""

from __future__ import annotations

import torch

from morphgen.tasks.bodies import Chain


def tool_frames(chain: Chain, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Frames along the way from the root to the tool.

    Args:
        chain: The bodies' chains.
        body: Which body each row is, shape (n,), int64.
        q: Independent joint positions, shape (n, J).

    Returns:
        In the root frame, shape (n, D + 1, 4, 4): each joint's after its motion, the tool's last.
    """
    positions = (chain.gain[body] @ q[:, :, None])[:, :, 0] + chain.offset[body]
    motion = _motions(chain.axis[body], chain.slides[body], positions)
    origin = chain.origin[body]
    steps = origin[:, :-1] @ motion
    frames = [steps[:, 0]]
    for d in range(1, steps.shape[1]):
        frames.append(frames[-1] @ steps[:, d])
    frames.append(frames[-1] @ origin[:, -1])
    return torch.stack(frames, dim=1)


def tool_poses(chain: Chain, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Pose of each tool in its root frame: (x, y, z, qw, qx, qy, qz), shape (n, 7)."""
    T = tool_frames(chain, body, q)[:, -1]
    return torch.cat([T[:, :3, 3], quaternions(T[:, :3, :3])], dim=1)


def tool_jacobians(chain: Chain, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """How tools move with the independent joints, (n, 6, J): linear, then angular velocity."""
    frames = tool_frames(chain, body, q)
    axis = (frames[:, :-1, :3, :3] @ chain.axis[body][..., None])[..., 0]
    arm = frames[:, -1:, :3, 3] - frames[:, :-1, :3, 3]
    slides = chain.slides[body][..., None]
    linear = torch.where(slides, axis, torch.linalg.cross(axis, arm))
    angular = torch.where(slides, torch.zeros_like(axis), axis)
    columns = torch.cat([linear, angular], dim=2).transpose(1, 2)
    jacobians: torch.Tensor = columns @ chain.gain[body]
    return jacobians


def quaternions(R: torch.Tensor) -> torch.Tensor:
    """Rotations (..., 3, 3) as (w, x, y, z), w >= 0, by the method of Bar-Itzhack (2000).

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix of entries.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(-2).unbind(-1)
    rows = (
        (xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, xx - yy - zz, yx + xy, zx + xz),
        (xz - zx, yx + xy, yy - xx - zz, zy + yz),
        (yx - xy, zx + xz, zy + yz, zz - xx - yy),
    )
    K = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    q = torch.linalg.eigh(K).eigenvectors[..., -1]
    return torch.where(q[..., :1] < 0, -q, q)


def _motions(axis: torch.Tensor, slides: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """Transforms of joints moved to positions (...,): Rodrigues' formula, or a shift."""
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(
        *axis.shape[:-1], 3, 3
    )
    angle = torch.where(slides, torch.zeros_like(positions), positions)[..., None, None]
    turn = torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)
    shift = torch.where(slides, positions, torch.zeros_like(positions))[..., None] * axis
    T = torch.zeros(*positions.shape, 4, 4, dtype=positions.dtype, device=positions.device)
    T[..., :3, :3] = turn + torch.eye(3, dtype=positions.dtype, device=positions.device)
    T[..., :3, 3] = shift
    T[..., 3, 3] = 1
    return T
