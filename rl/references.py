"""Controllers that learn nothing: they show that a task can be done, and policies beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch

from morphgen.tasks.bodies import Bodies
from morphgen.tasks.config import BINS
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.kinematics import tool_frames, tool_jacobians

STARTS = 16
"""Configurations from which inverse kinematics is tried for every goal."""
ITERATIONS = 60
STOPS = 12
"""Free configurations by way of which a goal may be reached, besides home."""
DAMPING = 0.05
"""Of the least squares, in units of joints over metres."""
STRIDE = 0.1
"""Largest change of a joint between configurations of a way that are tested, rad or m."""
CLOSE = 0.003
"""Distance from a goal that counts as solved, metres."""


class Task(Protocol):
    """What controllers need of a batch of environments."""

    bodies: Bodies
    body: torch.Tensor
    mask: torch.Tensor
    targets: torch.Tensor
    elapsed: torch.Tensor

    @property
    def goal(self) -> torch.Tensor:
        """Wanted poses of the tools, shape (n, 7)."""

    @property
    def kind(self) -> str:
        """Of the actions."""


class Zero:
    """Does nothing."""

    def act(self, task: Task) -> torch.Tensor:
        """No change of any target."""
        return as_actions(torch.zeros(task.mask.shape, device=task.mask.device), task.kind)


class Random:
    """Draws every action evenly from all there are; its stream is its own."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, task: Task) -> torch.Tensor:
        """Even over [-1, 1], or over the bins."""
        if task.kind == "discrete":
            drawn = torch.randint(len(BINS), task.mask.shape, generator=self._generator)
        else:
            drawn = 2 * torch.rand(task.mask.shape, generator=self._generator) - 1
        return drawn.to(task.mask.device)


class InverseKinematics:
    """Finds a configuration whose tool is at the goal when an episode begins, and goes there.

    Damped least squares (Wampler 1986) from several starts within the joints' limits; the nearest
    that arrives is taken. With ``spaces`` it is the nearest to which a straight way in joint space
    is free, or one by way of home or another free configuration; only if there is none, any.
    """

    def __init__(self, seed: int, spaces: Sequence[FreeSpace] = ()) -> None:
        """Prepare.

        Args:
            seed: Of the starts that are tried.
            spaces: What is free, by robot; nothing is looked at without.
        """
        self._generator = torch.Generator().manual_seed(seed)
        self._spaces = spaces
        rng = np.random.default_rng(seed)
        self._stops = [torch.from_numpy(space.draw(STOPS, rng)[0]).float() for space in spaces]
        self._way = torch.zeros(0, 0, 0)
        self._leg = torch.zeros(0, dtype=torch.int64)

    def act(self, task: Task) -> torch.Tensor:
        """A step along the way, all joints in proportion."""
        n, joints = task.targets.shape
        if self._way.shape != (n, 2, joints):
            self._way = task.targets[:, None].repeat(1, 2, 1)
            self._leg = torch.zeros_like(task.elapsed)
        new = torch.nonzero(task.elapsed == 0)[:, 0]
        if len(new):
            self._plan(task, new)
        rows = torch.arange(n, device=task.targets.device)
        ahead = self._way[rows, self._leg] - task.targets
        self._leg = torch.where(ahead.abs().amax(dim=1) < 1e-5, 1, self._leg)
        ahead = self._way[rows, self._leg] - task.targets
        step = task.bodies.step[task.body]
        shares = torch.where(step > 0, ahead / step.clamp(min=1e-9), torch.zeros_like(ahead))
        shares = shares / shares.abs().amax(dim=1, keepdim=True).clamp(min=1)
        joint = task.bodies.joint_of_link[task.body]
        actions = torch.gather(shares, 1, joint.clamp(min=0)) * (joint >= 0)
        return as_actions(actions, task.kind)

    def _plan(self, task: Task, envs: torch.Tensor) -> None:
        body, starts = task.body[envs], task.targets[envs]
        found, left = solve(task.bodies, body, task.goal[envs, :3], starts, self._generator)
        step = task.bodies.step[body].clamp(min=1e-9)
        far = ((found - starts) / step).abs().amax(dim=2)
        order = torch.where(left < CLOSE, far, 1e9 * (1 + left)).argsort(dim=0)
        for i, env in enumerate(envs.tolist()):
            ends = found[order[:, i], i]
            arrived = int((left[:, i] < CLOSE).sum())
            robot = int(body[i])
            via, end = starts[i], ends[0]
            if self._spaces and arrived:
                stops = task.bodies.home[robot].repeat(STOPS + 1, 1)
                drawn = self._stops[robot]
                stops[1:, : drawn.shape[1]] = drawn
                via, end = _free_way(self._spaces[robot], starts[i], stops, ends[:arrived])
            self._way[env] = torch.stack([via, end])
            self._leg[env] = 0


def solve(
    bodies: Bodies,
    body: torch.Tensor,
    position: torch.Tensor,
    near: torch.Tensor,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Configurations whose tools are at given positions, from ``STARTS`` starts.

    Args:
        bodies: The robots.
        body: Which robot each row is, shape (n,), int64.
        position: Where the tools are to be in the root frame, shape (n, 3), metres.
        near: The first start, shape (n, J).
        generator: Draws the other starts.

    Returns:
        Configurations within limits, shape (STARTS, n, J), and how far from their goals the tools
        then are, shape (STARTS, n), metres.
    """
    n, joints = near.shape
    lower, upper = bodies.lower[body], bodies.upper[body]
    drawn = torch.rand(STARTS - 1, n, joints, generator=generator).to(near.device)
    starts = torch.cat([near[None], lower + (upper - lower) * drawn])
    moves = bodies.moves_tool[body]
    q = torch.where(moves, starts, near).reshape(-1, joints)
    rows = body.repeat(STARTS)
    goal = position.repeat(STARTS, 1)
    low, high, free = lower.repeat(STARTS, 1), upper.repeat(STARTS, 1), moves.repeat(STARTS, 1)
    eye = DAMPING**2 * torch.eye(3, device=near.device)
    for _ in range(ITERATIONS):
        error = goal - tool_frames(bodies.chain, rows, q)[:, -1, :3, 3]
        J = tool_jacobians(bodies.chain, rows, q)[:, :3] * free[:, None]
        lever = torch.linalg.solve(J @ J.transpose(1, 2) + eye, error[..., None])
        q = torch.clamp(q + (J.transpose(1, 2) @ lever)[..., 0].clamp(-0.5, 0.5), low, high)
    apart = goal - tool_frames(bodies.chain, rows, q)[:, -1, :3, 3]
    left = torch.linalg.vector_norm(apart, dim=1)
    return q.reshape(STARTS, n, joints), left.reshape(STARTS, n)


def _free_way(
    space: FreeSpace, start: torch.Tensor, stops: torch.Tensor, ends: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where to go first, and then: to the first end that is reached freely."""
    for end in ends:
        if _is_free(space, start, end):
            return start, end
    for stop in stops:
        if _is_free(space, start, stop):
            for end in ends:
                if _is_free(space, stop, end):
                    return stop, end
    return start, ends[0]


def _is_free(space: FreeSpace, start: torch.Tensor, end: torch.Tensor) -> bool:
    """Whether the straight way between two configurations, shape (J,), is free."""
    parts = max(int((end - start).abs().max() / STRIDE) + 1, 2)
    way = start + torch.linspace(0, 1, parts, device=start.device)[:, None] * (end - start)
    dof = space.scene.robot.dof
    return bool(space.free(way[:, :dof].double().cpu().numpy()).all())


def as_actions(shares: torch.Tensor, kind: str) -> torch.Tensor:
    """Shares of the joints' steps as actions: themselves, or the nearest bins towards zero."""
    if kind == "continuous":
        return shares
    bins = torch.tensor(BINS, device=shares.device)
    fits = (bins.abs() <= shares[..., None].abs() + 1e-6) & (bins * shares[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)
