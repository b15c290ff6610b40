"""Goals that train and test share, or that a set has twice.

A goal of a test robot has leaked if a robot that learns the same task has it too. For the same body
any such goal counts. Other bodies reach a pose in other ways, so a goal that two of them share
tells nothing, and where little moves it happens by chance; but if most of a set is shared, in its
goals or in the configurations that take them, the two sets were not drawn apart, and what is
learned by heart for one passes for skill with the other.

A goal of reach is the pose of the tool; of push, the pose of the block at the start, with the
configuration there if the bodies are the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import Side, Split, sided_members
from morphgen.tasks.goal_making import SplitGoals
from morphgen.tasks.task import GoalSet
from morphgen.typing import Array

Mask = NDArray[np.bool_]
Told = tuple[Side, str, str]
"""Side and name of a robot, and what is the case."""

NEAR = 1e-3
"""Metres: positions of goals, or of blocks, that are nearer are the same."""
NEAR_TURN = math.radians(1)
"""Radians: the same of directions."""
NEAR_JOINT = 1e-3
"""Rad or m: configurations whose joints are all nearer are the same."""
MOST = 0.5
"""Share of a set that two different bodies may have in common."""


def shared(split: Split, found: SplitGoals) -> Iterator[Told]:
    """Test sets that a train robot has, in part (the same body) or for the most part (another)."""
    for member in split.test:
        test = found.of("test", member.name)
        leaks: list[tuple[int, str, str]] = []
        for rival in split.train:
            train = found.of("train", rival.name)
            if test is not None and train is not None and rival.task == member.task:
                count, what = _common(test, train, rival.robot_hash == member.robot_hash)
                leaks += [(count, what, rival.name)] if count else []
        if test is not None and leaks:
            count, what, name = max(leaks, key=lambda leak: leak[0])
            more = f" (and {len(leaks) - 1} more)" if leaks[1:] else ""
            why = f"train robot {name}{more} has {count} of its {len(test.q)} {what}"
            yield "test", member.name, why


def _common(test: GoalSet, train: GoalSet, same_body: bool) -> tuple[int, str]:
    """How many goals of a test set leaked into a train set, and what they are; see the module."""
    same_q = _near_joints(test.q, train.q)
    same_pose = _near(test.goal_poses, train.goal_poses)
    if same_body:
        same = same_pose & same_q if test.start_belongs_to_goal else same_pose
        return int(same.any(axis=1).sum()), "goals"
    counts = {"goals": same_pose, "configurations": same_q}
    what, same = max(counts.items(), key=lambda each: each[1].any(axis=1).sum())
    count = int(same.any(axis=1).sum())
    return (count, what) if count > MOST * len(test.q) else (0, what)


def repeated(split: Split, found: SplitGoals) -> Iterator[Told]:
    """Goals that a set has twice."""
    for side, member in sided_members(split):
        goals = found.of(side, member.name)
        if goals is None:
            continue
        same = _near(goals.goal_poses, goals.goal_poses)
        if goals.start_belongs_to_goal:
            same &= _near_joints(goals.q, goals.q)
        pairs = np.argwhere(np.triu(same, 1)).tolist()
        if pairs:
            more = f" (and {len(pairs) - 1} more pairs)" if pairs[1:] else ""
            why = f"goals {pairs[0][0]} and {pairs[0][1]} of its set are the same{more}"
            yield side, member.name, why


def _near(a: Array, b: Array) -> Mask:
    """Which poses (n, 7) and (m, 7) are the same, to a millimetre and a degree, (n, m)."""
    apart = np.linalg.norm(a[:, None, :3] - b[None, :, :3], axis=2)
    aligned = np.abs(a[:, 3:] @ b[:, 3:].T)
    return np.asarray((apart <= NEAR) & (aligned >= math.cos(NEAR_TURN / 2)))


def _near_joints(a: Array, b: Array) -> Mask:
    """Which configurations (n, dof) and (m, dof) are the same, (n, m)."""
    if a.shape[1] != b.shape[1]:
        return np.zeros((len(a), len(b)), dtype=np.bool_)
    return np.asarray((np.abs(a[:, None] - b[None]) <= NEAR_JOINT).all(axis=2))
