"""Controllers that learn nothing: they show that a task can be done, and policies beside them."""

from __future__ import annotations

from typing import Protocol

import torch

from morphgen.tasks.bodies import Bodies
from morphgen.tasks.config import BINS
from morphgen.tasks.kinematics import tool_frames, tool_jacobians

STARTS = 16
"""Configurations from which inverse kinematics is tried for every goal."""
ITERATIONS = 60
DAMPING = 0.05
"""Of the least squares, in units of joints over metres."""
CLOSE = 0.003
"""Distance from a goal that counts as solved, metres."""


class Task(Protocol):
    """What controllers need of a batch of environments."""

    bodies: Bodies
    body: torch.Tensor
    mask: torch.Tensor
    targets: torch.Tensor
    goal: torch.Tensor
    elapsed: torch.Tensor
    kind: str


class Controller(Protocol):
    """Decides on actions for a whole batch."""

    def act(self, task: Task) -> torch.Tensor:
        """Actions, shape (n, L)."""


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

    Damped least squares (Wampler 1986) from several starts within the joints' limits; of those that
    arrive, the nearest to where the joints are. It knows of no obstacle and of no other link.
    """

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._plan = torch.zeros(0, 0)

    def act(self, task: Task) -> torch.Tensor:
        """A step towards the plan with every joint."""
        if self._plan.shape != task.targets.shape:
            self._plan = task.targets.clone()
        new = torch.nonzero(task.elapsed == 0)[:, 0]
        if len(new):
            self._plan[new] = solve(
                task.bodies,
                task.body[new],
                task.goal[new, :3],
                task.targets[new],
                self._generator,
            )
        step = task.bodies.step[task.body]
        wanted = (self._plan - task.targets) / step.clamp(min=1e-9)
        shares = torch.where(step > 0, wanted, torch.zeros_like(wanted)).clamp(-1, 1)
        joint = task.bodies.joint_of_link[task.body]
        return as_actions(torch.gather(shares, 1, joint.clamp(min=0)) * (joint >= 0), task.kind)


def solve(
    bodies: Bodies,
    body: torch.Tensor,
    position: torch.Tensor,
    near: torch.Tensor,
    generator: torch.Generator,
) -> torch.Tensor:
    """Configurations whose tools are at given positions.

    Args:
        bodies: The robots.
        body: Which robot each row is, shape (n,), int64.
        position: Where the tools are to be in the root frame, shape (n, 3), metres.
        near: Configurations that solutions should be near to, one of the starts, shape (n, J).
        generator: Draws the other starts.

    Returns:
        Shape (n, J), within limits: the nearest of those that arrive, else the one that ends
        nearest to its goal.
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
    left = (goal - tool_frames(bodies.chain, rows, q)[:, -1, :3, 3]).norm(dim=1)
    found, left = q.reshape(STARTS, n, joints), left.reshape(STARTS, n)
    way = ((found - near).abs() / bodies.step[body].clamp(min=1e-9)).amax(dim=2)
    worth = torch.where(left < CLOSE, way, 1e9 * (1 + left))
    return found[worth.argmin(dim=0), torch.arange(n, device=near.device)]


def as_actions(shares: torch.Tensor, kind: str) -> torch.Tensor:
    """Shares of the joints' steps as actions: themselves, or the nearest bins towards zero."""
    if kind == "continuous":
        return shares
    bins = torch.tensor(BINS, device=shares.device)
    fits = (bins.abs() <= shares[..., None].abs() + 1e-6) & (bins * shares[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)
