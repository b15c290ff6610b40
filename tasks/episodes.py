"""What reach and push say of a step, and how their episodes begin; written over the batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.tasks.config import PushConfig, ReachConfig
from morphgen.tasks.rewards import (
    Terms,
    anybody_score,
    lengths,
    moved_line,
    push_terms,
    reach_terms,
)
from morphgen.tasks.settings import Setting


@dataclass(frozen=True, eq=False)
class State:
    """What a step is judged by; a row an environment, positions in the root frame."""

    tool: torch.Tensor
    """Of the tool, shape (n, 3), metres."""
    block: torch.Tensor
    """Of the block's centre, shape (n, 3), metres; zeros if there is none."""
    beyond: torch.Tensor
    """See ``beyond_limits``, shape (n,)."""
    acceleration: torch.Tensor
    """Mean over the control step, absolute, all joints together, shape (n,)."""
    unstable: torch.Tensor
    """Whether the simulation diverged in the step, shape (n,), bool; this is never a success."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a task says of a step; shapes (n,)."""

    success: torch.Tensor
    terminated: torch.Tensor
    distance: torch.Tensor
    """Metres from success: of tool and goal, or of block and line."""
    score: torch.Tensor
    """``anybody_score`` of reach; 1 for success of push, which is when its episode ends."""
    terms: Terms


Starts = tuple[torch.Tensor, torch.Tensor]
"""Where episodes begin, a row each: joint positions (k, J) and poses of blocks (k, 7)."""


class Reach:
    """Environments that reach; rows of those that push are zero."""

    def __init__(
        self,
        settings: Sequence[Setting],
        setting: torch.Tensor,
        config: ReachConfig,
        joints: int,
    ) -> None:
        """Set up.

        Args:
            settings: All there are.
            setting: Which of them each environment has, shape (n,), int64.
            config: The task.
            joints: Independent joints of a row, J.

        Raises:
            TaskError: If a robot has fewer than two goals.
        """
        self._config, self._setting = config, setting
        sets = [each.goals for each in settings]
        for goals in sets:
            if goals is not None and len(goals.q) < 2:
                raise TaskError(f"robot {goals.robot!r}: a goal set needs two goals")
        device = setting.device
        self._count = [0 if goals is None else len(goals.q) for goals in sets]
        self._q = _padded([None if goals is None else goals.q for goals in sets], joints, device)
        self._poses = _padded([None if goals is None else goals.poses for goals in sets], 7, device)
        self.goal = torch.zeros(len(setting), 7, device=device)
        self.witness = torch.zeros(len(setting), joints, device=device)

    def begin(self, envs: torch.Tensor, random: Sequence[np.random.Generator]) -> Starts:
        """Draw starts and goals of the robots' sets, never the same.

        Args:
            envs: Which episodes begin, shape (k,), int64.
            random: Where each of these draws from.
        """
        of = self._setting[envs]
        pairs = [
            stream.choice(self._count[i], size=2, replace=False)
            for stream, i in zip(random, of.tolist(), strict=True)
        ]
        start, goal = torch.tensor(np.array(pairs), device=of.device).T
        self.witness[envs] = self._q[of, goal]
        self.goal[envs] = self._poses[of, goal]
        return self._q[of, start], torch.zeros(len(envs), 7, device=of.device)

    def judge(self, state: State) -> Verdict:
        """Judge all rows as if they reached."""
        distance = lengths(state.tool - self.goal[:, :3])
        terms = reach_terms(self._config, distance, state.beyond, state.acceleration)
        success = (distance < self._config.near) & ~state.unstable
        score = anybody_score(self._config, distance)
        return Verdict(success, torch.zeros_like(success), distance, score, terms)


class Push:
    """Environments that push; rows of those that reach are zero."""

    def __init__(
        self,
        settings: Sequence[Setting],
        setting: torch.Tensor,
        config: PushConfig,
        joints: int,
    ) -> None:
        """Set up; the line is in its place. Arguments as of ``Reach``."""
        self._config, self._setting = config, setting
        sets = [each.pushes for each in settings]
        device = setting.device
        self._count = [0 if pushes is None else len(pushes.q) for pushes in sets]
        self._q = _padded([None if pushes is None else pushes.q for pushes in sets], joints, device)
        blocks = [None if pushes is None else pushes.blocks for pushes in sets]
        self._blocks = _padded(blocks, 7, device)
        lines = [0.0 if pushes is None else pushes.line for pushes in sets]
        sizes = [(0.0, 0.0, 0.0) if pushes is None else pushes.block.size for pushes in sets]
        self._place = torch.tensor(lines, device=device)[setting]
        self.size = torch.tensor(sizes, device=device)[setting]
        self.line = self._place.clone()

    def begin(self, envs: torch.Tensor, random: Sequence[np.random.Generator]) -> Starts:
        """Draw starts of the robots' sets: configurations and where blocks are."""
        of = self._setting[envs]
        drawn = [
            int(stream.integers(self._count[i]))
            for stream, i in zip(random, of.tolist(), strict=True)
        ]
        start = torch.tensor(drawn, device=of.device)
        return self._q[of, start], self._blocks[of, start]

    def advance(self, progress: float) -> None:
        """Move the line as the curriculum has it; see ``moved_line``."""
        self.line = moved_line(self._config, self._place, progress)

    def judge(self, state: State) -> Verdict:
        """Judge all rows as if they pushed."""
        to_go = torch.clamp(self.line - state.block[:, 1], min=0)
        success = (state.block[:, 1] > self.line) & ~state.unstable
        approach = lengths(state.tool - state.block)
        terms = push_terms(self._config, to_go, approach, state.beyond, success)
        return Verdict(success, success.clone(), to_go, success.float(), terms)


def _padded(
    rows: Sequence[NDArray[np.float64] | None], width: int, device: torch.device
) -> torch.Tensor:
    """Tables (S, w) of every setting in one, shape (R, largest S, width); zeros elsewhere."""
    most = max((0 if each is None else len(each) for each in rows), default=0)
    found = torch.zeros(len(rows), most, width)
    for row, each in zip(found, rows, strict=True):
        if each is not None:
            row[: each.shape[0], : each.shape[1]] = torch.from_numpy(each)
    return found.to(device)


def chosen(pushes: torch.Tensor, reach: Verdict, push: Verdict) -> Verdict:
    """Rows of one or the other.

    Args:
        pushes: Which rows push, shape (n,), bool.
        reach: Judgement of reach.
        push: Judgement of push.

    Returns:
        Terms of both; where a task has no such term, it is zero.
    """
    names = [*reach.terms, *(name for name in push.terms if name not in reach.terms)]
    none = torch.zeros_like(reach.distance)
    terms = {
        name: torch.where(pushes, push.terms.get(name, none), reach.terms.get(name, none))
        for name in names
    }
    return Verdict(
        torch.where(pushes, push.success, reach.success),
        torch.where(pushes, push.terminated, reach.terminated),
        torch.where(pushes, push.distance, reach.distance),
        torch.where(pushes, push.score, reach.score),
        terms,
    )
