"""What the goal sets of a split give away, or promise and do not keep."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.audit import Audit
from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.split import Member, Side, Split, sided_members
from morphgen.errors import MorphgenError
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding, Severity
from morphgen.processes import Progress, mapped, unseen
from morphgen.tasks.env_specs import GoalConfig, env_spec, member_with_primitives
from morphgen.tasks.goal_leaks import repeated, shared
from morphgen.tasks.goal_making import Made, SplitGoals, unproven
from morphgen.tasks.goal_sets import arrays_of
from morphgen.tasks.task import GoalSet

_FIXES = {
    "goals-missing": "leave the robot out, or build again: morphgen split build --goals",
    "goals-unknown": "build the goal sets again",
    "goals-body": "build the goal sets again",
    "goals-seed": "build the goal sets again, with the seed of the split",
    "goals-config": "build the goal sets again, with one morphgen",
    "goals-changed": "build the goal sets again",
    "goals-unproven": "build the goal sets again",
    "goals-shared": "leave the robot out of one side, or accept it with a reason",
    "goals-repeated": "take another --goal-seed, or accept it with a reason",
}
CODES = frozenset(_FIXES)

_EXACT = 1e-6
"""Largest difference of numbers of a set from those of a set drawn anew."""


def audit_goals(
    split: Split,
    found: SplitGoals,
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = unseen,
) -> tuple[Finding, ...]:
    """Look for goals that leak, and for sets that are not those of the split's robots.

    Every set is drawn anew for comparison, and every goal tested with its configuration. Errors:
    ``goals-missing`` (a member has no set, or none can be drawn), ``goals-unknown`` (a set of no
    member), ``goals-body`` (of another body), ``goals-seed`` and ``goals-config`` (made with
    another seed or other constants than those of the split's sets), ``goals-changed`` (not what is
    drawn), ``goals-unproven`` (out of reach or in collision), ``goals-shared`` (by train and test,
    see ``goal_leaks``). Warning: ``goals-repeated`` (within a set).

    Args:
        split: The split.
        found: Its goal sets, and with what they are said to be made.
        library: Where its parts are.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Raises:
        MorphgenError: If ``jobs`` is below 1, or a process died.
    """
    members = sided_members(split)
    look = _Examination(library.folders, found)
    seen = list(mapped(look, members, jobs, progress))
    return tuple(
        [
            *_set_findings(split, found, members, seen),
            *(_finding("goals-shared", *each) for each in shared(split, found)),
            *(_finding("goals-repeated", *each, "warning") for each in repeated(split, found)),
        ]
    )


def with_goals(done: Audit, split: Split, findings: Sequence[Finding] | None) -> Audit:
    """An audit with findings about goals, of which the split accepts what it accepts.

    Args:
        done: The audit of the robots.
        split: What it is of.
        findings: About goals; None if nobody looked, so that nothing is known of those accepted.
    """
    codes = CODES if findings is None else {finding.code for finding in findings}
    looked_for = {f"accepted {code}" for code in codes}
    left = [
        each
        for each in done.findings
        if not (each.code == "accepted-unused" and each.where in looked_for)
    ]
    new = findings or ()
    known = tuple((each, split.accepted[each.code]) for each in new if each.code in split.accepted)
    left += [each for each in new if each.code not in split.accepted]
    return replace(done, findings=tuple(left), accepted=(*done.accepted, *known))


@dataclass(frozen=True)
class _Seen:
    """What a worker finds of a member's set."""

    key: str = ""
    """Of the set as it is drawn today; empty if it cannot be."""
    body: str = ""
    """Hash of the body that it is drawn for."""
    why: str = ""
    """Why it cannot be drawn."""
    is_same: bool = False
    """Whether the set is as it is drawn."""
    unproven: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Examination:
    """How a worker sees to the set of a member."""

    folders: tuple[Path, ...]
    found: SplitGoals

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, sided_member: tuple[Side, Member]) -> _Seen:
        side, member = sided_member
        made = self.found.sets.get((side, member.name))
        try:
            robot = member_with_primitives(member, self.library)
            body = robot_hash(robot, visuals=False)
            with tempfile.TemporaryDirectory() as folder:
                spec = env_spec(
                    robot,
                    member.task,
                    self.found.config,
                    obstacles=member.obstacles,
                    cache=Path(folder),
                )
            drawn = spec.goals
            if made is None or made.goals is None:
                return _Seen(drawn.key, body)
            lines = () if made.body != body else unproven(made.goals, spec)
            return _Seen(drawn.key, body, "", _same(made.goals, drawn), lines)
        except MorphgenError as error:
            return _Seen(why=str(error))


def _same(a: GoalSet, b: GoalSet) -> bool:
    """Whether two sets are the same but for rounding; proofs of pushes are tested on their own."""
    if type(a) is not type(b):
        return False
    ours, theirs = arrays_of(a), arrays_of(b)
    return all(_close(ours[name], theirs[name]) for name in ours.keys() - a.not_compared)


def _close(a: NDArray[Any], b: NDArray[Any]) -> bool:
    if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
        return False
    return bool(np.allclose(a, b, 0, _EXACT) if a.dtype.kind == "f" else (a == b).all())


def _set_findings(
    split: Split,
    found: SplitGoals,
    members: Sequence[tuple[Side, Member]],
    seen: Sequence[_Seen],
) -> Iterator[Finding]:
    """Sets that are missing, or not those that belong to the robots, or cannot be proven."""
    owners = {
        one.key: f"{side} robot {member.name}"
        for (side, member), one in zip(members, seen, strict=True)
        if one.key
    }
    for (side, member), one in zip(members, seen, strict=True):
        made = found.sets.get((side, member.name))
        if one.why or made is None or made.goals is None:
            why = one.why or "there is no set of it"
            yield _finding("goals-missing", side, member.name, why)
            continue
        told = _foreign(made, made.goals, member, one, owners, found.config)
        if told:
            yield _finding(told[0], side, member.name, told[1])
        if one.unproven:
            more = f" (and {len(one.unproven) - 1} more)" if one.unproven[1:] else ""
            yield _finding("goals-unproven", side, member.name, one.unproven[0] + more)
    known = {(side, member.name) for side, member in members}
    for side, name in sorted(found.sets.keys() - known):
        yield _finding("goals-unknown", side, name, f"split {split.name} has no such robot")


def _foreign(
    made: Made,
    goals: GoalSet,
    member: Member,
    seen: _Seen,
    owners: Mapping[str, str],
    config: GoalConfig,
) -> tuple[str, str] | None:
    """Code and reason if a set is not the one that is drawn for its member."""
    if goals.key == seen.key and made.body == seen.body:
        changed = f"its goals are not those that seed {config.seed} gives"
        return None if seen.is_same else ("goals-changed", changed)
    if goals.key != seen.key and goals.key in owners:
        return "goals-body", f"its set is that of {owners[goals.key]}"
    if made.body != seen.body:
        return "goals-body", f"its set is of body {made.body}, not of {seen.body}"
    if goals.seed != config.seed:
        return (
            "goals-seed",
            f"its set was made with seed {goals.seed}, the split's with {config.seed}",
        )
    if (made.task, bool(goals.obstacles)) != (member.task, member.obstacles):
        wanted = _task_text(member.task, member.obstacles)
        return (
            "goals-config",
            f"its set is for {_task_text(made.task, bool(goals.obstacles))}, not {wanted}",
        )
    return "goals-config", (
        f"its set, of {len(goals.q)} goals, was made with other constants or another version: its "
        f"key is {goals.key[:8]}, not {seen.key[:8]}"
    )


def _task_text(task: str, obstacles: bool) -> str:
    return f"{task} with obstacles" if obstacles else task


def _finding(code: str, side: Side, name: str, why: str, severity: Severity = "error") -> Finding:
    return Finding(code, severity, f"{side} robot {name}", why, _FIXES[code])
