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
    steps = _steps(chain, body, q)
    frames = [steps[:, 0]]
    for d in range(1, steps.shape[1]):
        frames.append(frames[-1] @ steps[:, d])
    frames.append(frames[-1] @ chain.origin[body, -1])
    return torch.stack(frames, dim=1)


class ToolPositions:
    """Where the tools of a batch's environments are; much faster than all frames."""

    def __init__(self, chain: Chain, body: torch.Tensor) -> None:
        """Prepare; arguments as of ``tool_frames``."""
        still = chain.origin[:, :-1]
        parts = torch.stack([still, *chain.motion])[:, body, :, :3]
        self._still, self._by_first, self._by_second = parts.permute(0, 2, 3, 4, 1).contiguous()
        """Frames of the joints at zero, and what their motions add; each (D, 3, 4, n)."""
        self._tool = chain.origin[body, -1, :3, 3].T.contiguous()
        gain = chain.gain[body].transpose(0, 1)
        self._joint = gain.abs().argmax(dim=2)
        self._gain = torch.gather(gain, 2, self._joint[..., None])[..., 0].contiguous()
        self._offset = chain.offset[body].T.contiguous()
        self._slides = chain.slides[body].T.contiguous()

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        """In the root frames, shape (n, 3), metres, at independent joint positions (n, J)."""
        moved = self._gain * torch.gather(q.T, 0, self._joint) + self._offset
        first = torch.where(self._slides, moved, torch.sin(moved))[:, None, None]
        second = torch.where(self._slides, 0.0, 1 - torch.cos(moved))[:, None, None]
        frames = self._still + first * self._by_first + second * self._by_second
        turns, shifts = frames[:, :, :3].unbind(), frames[:, :, 3].unbind()
        point = self._tool
        for turn, shift in zip(reversed(turns), reversed(shifts), strict=True):
            point = (turn * point).sum(dim=1) + shift
        return point.T


def tool_positions(chain: Chain, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Where tools are in their root frames, shape (n, 3), metres, once."""
    return ToolPositions(chain, body)(q)


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


def quaternion_matrices(quaternion: torch.Tensor) -> torch.Tensor:
    """Rotations (..., 3, 3) of unit quaternions (w, x, y, z), shape (..., 4)."""
    w, v = quaternion[..., :1, None], quaternion[..., 1:]
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*x.shape, 3, 3)
    eye = torch.eye(3, device=quaternion.device)
    return eye + 2 * w * cross + 2 * cross @ cross


def _steps(chain: Chain, body: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Frame of each joint after its motion in the frame of the one before, shape (n, D, 4, 4)."""
    positions = (chain.gain[body] @ q[:, :, None])[:, :, 0] + chain.offset[body]
    slides = chain.slides[body]
    first = torch.where(slides, positions, torch.sin(positions))[..., None, None]
    second = torch.where(slides, torch.zeros_like(positions), 1 - torch.cos(positions))
    by_first, by_second = chain.motion
    moved = first * by_first[body] + second[..., None, None] * by_second[body]
    return chain.origin[body, :-1] + moved
