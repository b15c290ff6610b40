"""Audit a split: leaks between train and test, violated rules, and nearest train robots.

The audit of goal sets finds sets that do not match their robots, and goals that leak. A goal of a
test robot has leaked if a train robot at the same task has it too. For the same robot, any such
goal counts. Different robots reach a pose in different configurations, so a shared goal reveals
nothing, and robots that can move little share some by chance. But if most of a set is shared, in
its goals or in its configurations, then the two sets were not drawn independently, and memorised
goals of one would count as skill with the other.

The goal of reach is the pose of the tool; of push, the pose of the block at the start; of drawer,
door and dial, that of the object at the end. With the last four, the start configuration belongs to
it if the robots are the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.generate import parse_bound
from morphgen.benchmark.hold_out import has_hold_out_rules, hold_out_findings
from morphgen.benchmark.regimes import found, regime_findings
from morphgen.benchmark.survey import (
    Fault,
    NearestTrain,
    SplitSurvey,
    SurveyedRobot,
    nearest_train,
    survey_split,
)
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.similarity import NEAR_THRESHOLDS, NearThresholds, is_same_reach
from morphgen.errors import MorphgenError, nearest
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding
from morphgen.processes import parallel_map
from morphgen.progress import stage
from morphgen.splits.split import SIDES, Member, Side, Split, sided_members
from morphgen.tasks.goals.goal_sets import arrays_of
from morphgen.tasks.goals.split_goals import (
    GoalResult,
    SplitGoals,
    certify_goal_set,
    has_goals,
    read_split_goals,
    sample_split_goals,
)
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, member_with_primitives
from morphgen.tasks.task import GoalSet
from morphgen.typing import Array


@dataclass(frozen=True)
class Audit:
    """Result of an audit."""

    split: str
    findings: tuple[Finding, ...]
    accepted: tuple[tuple[Finding, str], ...]
    """Findings that the split's author accepts, each with the reason."""
    nearest: Mapping[str, Mapping[str, NearestTrain]]
    """Nearest train robot by test robot and measure, without robots that cannot be composed."""
    goals: Mapping[str, int] | None = None
    """Number of goal ``sets`` that were audited, and their ``seed``; None if there were none."""

    def passed(self, *, strict: bool = False) -> bool:
        """Return True if there are no unaccepted errors; ``strict``: and no warnings."""
        failing = ("error", "warning") if strict else ("error",)
        return not any(finding.severity in failing for finding in self.findings)

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        accepted = [{**finding.as_dict(), "reason": reason} for finding, reason in self.accepted]
        return {
            "split": self.split,
            "findings": [finding.as_dict() for finding in self.findings],
            "accepted": accepted,
            "nearest": {
                test: {measure: vars(found) for measure, found in trains.items()}
                for test, trains in self.nearest.items()
            },
            "goals": self.goals,
        }


def audit(
    split: Split, library: Library, *, near: NearThresholds = NEAR_THRESHOLDS, jobs: int = 1
) -> Audit:
    """Find leaks between train and test robots, and violations of the regime (docs/splits.md)."""
    return audit_survey(survey_split(split, library, jobs=jobs), library, near)


def audit_survey(
    survey: SplitSurvey, library: Library, near: NearThresholds = NEAR_THRESHOLDS
) -> Audit:
    """Audit a split from its survey; see ``audit``."""
    split = survey.split
    findings = [
        *_robot_findings(survey),
        *_leaks(survey, near),
        *_repeated(split),
        *_regime_findings(survey, library),
        *_bound_findings(survey),
    ]
    n = len(split.train)
    nearest = {
        member.name: trains
        for j, member in enumerate(split.test, n)
        if (trains := nearest_train(split.train, survey.similarity[:n, j]))
    }
    return _conclude(split, findings, nearest)


def _conclude(
    split: Split,
    findings: Sequence[Finding],
    nearest: Mapping[str, Mapping[str, NearestTrain]],
    not_audited: tuple[str, ...] = (),  # beginnings of codes that nothing looked for
) -> Audit:
    """Return an audit from all findings: those that the split accepts are set apart."""
    codes = {finding.code for finding in findings}
    unused = (
        found("accepted-unused", f"accepted {code}")
        for code in split.accepted
        if code not in codes and not code.startswith(not_audited)
    )
    remaining = (finding for finding in findings if finding.code not in split.accepted)
    accepted = (finding for finding in findings if finding.code in split.accepted)
    return Audit(
        split.name,
        (*remaining, *unused),
        tuple((finding, split.accepted[finding.code]) for finding in accepted),
        nearest,
    )


def _robot_findings(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield robots that cannot be composed, or that have changed."""
    for side, member, robot in _robots(survey):
        where = f"{side} robot {member.name}"
        if isinstance(robot, Fault):
            yield found(robot.code, where, why=robot.why)
        elif (given := robot.robot_hash) != member.robot_hash:
            yield found("body-changed", where, named=member.robot_hash, given=given)


def _leaks(survey: SplitSurvey, near: NearThresholds) -> Iterator[Finding]:
    """Yield test robots that are train robots, or near duplicates of them."""
    split = survey.split
    names = {member.name: member for member in split.train}
    tree, cosine, workspace = map(survey.by_measure, ("tree", "cosine", "workspace"))
    is_one_workspace = _same_reach(survey, near) & (workspace > near.workspace)
    is_near = (tree < near.tree) & ((cosine > near.cosine) | is_one_workspace)
    for j, member in enumerate(split.test):
        where = f"test robot {member.name}"
        rivals = [i for i, other in enumerate(split.train) if other.task == member.task]
        shared = [i for i in rivals if split.train[i].robot_hash == member.robot_hash]
        if shared:
            yield found("body-shared", where, twin=_first_of(split, shared))
        duplicates = sorted(
            (i for i in rivals if is_near[i, j] and i not in shared), key=tree[:, j].item
        )
        if duplicates:
            first = duplicates[0]
            measures = {"tree": tree, "cosine": cosine, "workspace": workspace}
            values = {name: matrix[first, j] for name, matrix in measures.items()}
            twin = _first_of(split, duplicates)
            yield found("body-near", where, twin=twin, near=near, **values)
        other = names.get(member.name)
        if other is not None and other.robot_hash != member.robot_hash:
            yield found("name-shared", where)


def _same_reach(survey: SplitSurvey, near: NearThresholds) -> NDArray[np.bool_]:
    """Return which pairs have nearly one reach, shape (n_train, n_test)."""
    n = len(survey.split.train)
    train, test = (
        np.array([each.workspace.reach if each else np.nan for each in known])
        for known in (survey.features[:n], survey.features[n:])
    )
    return is_same_reach(train[:, None], test[None, :], near)


def _repeated(split: Split) -> Iterator[Finding]:
    """Yield robots that a side has twice."""
    row = "body-repeated" if has_hold_out_rules(split) else "body-repeated/chosen"
    for side in SIDES:
        first: dict[tuple[object, ...], str] = {}
        for member in split.side(side):
            key = (member.robot_hash, member.task, member.obstacles)
            earlier = first.setdefault(key, member.name)
            if earlier != member.name:
                yield found(row, f"{side} robot {member.name}", side=side, earlier=earlier)


def _regime_findings(survey: SplitSurvey, library: Library) -> tuple[Finding, ...]:
    """Return violations of the regime by the robots that can be composed."""
    composable: dict[Side, list[Member]] = {"train": [], "test": []}
    for side, member, robot in _robots(survey):
        if isinstance(robot, SurveyedRobot):
            composable[side].append(member)
    if not composable["train"]:
        return ()
    split = replace(survey.split, train=tuple(composable["train"]), test=tuple(composable["test"]))
    findings = regime_findings(split, library)
    if has_hold_out_rules(survey.split):
        return (*findings, *hold_out_findings(split, library))
    return findings


def _bound_findings(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield test robots that violate the similarity bound that the split was made with."""
    text = survey.split.provenance.get("similarity")
    if text is None:
        return
    bound = parse_bound(str(text), f"split {survey.split.name!r}: made: similarity")
    for member, cosines in zip(survey.split.test, survey.by_measure("cosine").T, strict=True):
        largest = max(cosines[~np.isnan(cosines)].tolist(), default=None)
        if largest is not None and not bound.holds(largest):
            where = f"test robot {member.name}"
            yield found("similarity-bound", where, cosine=largest, bound=bound)


def _robots(survey: SplitSurvey) -> Iterator[tuple[Side, Member, SurveyedRobot | Fault]]:
    for (side, member), robot in zip(sided_members(survey.split), survey.robots, strict=True):
        yield side, member, robot


def _first_of(split: Split, indices: Sequence[int]) -> str:
    """Return the name of the first of some train robots, and how many more there are."""
    more = f" (and {len(indices) - 1} more)" if indices[1:] else ""
    return split.train[indices[0]].name + more


Mask = NDArray[np.bool_]

EXACT = 1e-6  # largest difference between numbers of a set and those of the same set sampled anew
NEAR = 1e-3  # distance below which positions of goals or blocks are the same [m]
NEAR_TURN = math.radians(1)  # angle below which orientations are the same [rad]
NEAR_JOINT = 1e-3  # difference of every joint below which configurations are the same [rad or m]
MAX_SHARED = 0.5  # fraction of a set that two different robots may have in common


def audit_with_goals(
    split: Split,
    library: Library,
    folder: Path | None = None,
    *,
    near: NearThresholds = NEAR_THRESHOLDS,
    goals: bool = False,
    goal_seed: int | None = None,
    jobs: int = 1,
) -> Audit:
    """Audit a split and the goal sets that its folder ships; see ``audit`` and ``audit_goals``.

    goals: Whether to audit goal sets even if there are no shipped ones.
    goal_seed: Seed that the goal sets must have; by default that of the shipped ones, or 0.
    """
    result, sets, findings = audit(split, library, near=near, jobs=jobs), None, None
    if folder is not None and has_goals(folder):
        sets = read_split_goals(folder)
        seed = sets.config.seed if goal_seed is None else goal_seed
        sets = replace(sets, config=replace(sets.config, seed=seed))
    elif goals:
        config = GoalConfig(goal_seed or 0)
        with stage("sampling goals"):
            sampled = sample_split_goals(split, library, config, jobs=jobs)
        sets = SplitGoals.from_results(sampled, config)
    if sets is not None:
        with stage("auditing goals"):
            findings = audit_goals(split, sets, library, jobs=jobs)
        result = replace(result, goals={"sets": len(sets.sets), "seed": sets.config.seed})
    return with_goal_findings(result, split, findings)


def audit_goals(
    split: Split, goals: SplitGoals, library: Library, *, jobs: int = 1
) -> tuple[Finding, ...]:
    """Find leaked goals, and sets that differ from those sampled anew or do not match robots."""
    members = sided_members(split)
    examined = list(parallel_map(partial(_examine, library, goals), members, jobs))
    return (
        *_set_findings(split, goals, members, examined),
        *_shared_goals(split, goals),
        *_repeated_goals(split, goals),
    )


def with_goal_findings(audit: Audit, split: Split, findings: Sequence[Finding] | None) -> Audit:
    """Return an audit with findings about goals and unknown tasks, accepted ones set apart."""
    known = [finding for finding in audit.findings if finding.code != "accepted-unused"]
    known += [finding for finding, _ in audit.accepted]
    for side, member in sided_members(split):
        if (task := member.task) not in TASKS:
            where = f"{side} robot {member.name}"
            known.append(found("task-unknown", where, task=task, nearest=nearest(task, TASKS)))
    not_audited = ("goals-", "task-unknown") if findings is None else ()
    joined = _conclude(split, [*known, *(findings or ())], audit.nearest, not_audited)
    return replace(joined, goals=audit.goals)


@dataclass(frozen=True)
class _Examination:
    """A member's goal set, compared with the same set sampled anew."""

    key: str = ""  # key of the set sampled anew; empty if it cannot be sampled
    robot_hash: str = ""  # hash of the member's robot
    error: str = ""  # reason why the set cannot be sampled
    is_same: bool = False  # whether the set equals the one sampled anew
    certificate_errors: tuple[str, ...] = ()


def _examine(
    library: Library, goals: SplitGoals, sided_member: tuple[Side, Member]
) -> _Examination:
    """Sample the goal set of a member anew and compare, in a worker process."""
    side, member = sided_member
    stored = goals.sets.get((side, member.name))
    try:
        robot = member_with_primitives(member, library)
        digest = robot_hash(robot, visuals=False)
        spec = env_spec(robot, member.task, goals.config, obstacles=member.obstacles, anew=True)
        key = spec.goals.key
        if stored is None or stored.goals is None:
            return _Examination(key, digest)
        errors = certify_goal_set(stored.goals, spec) if stored.robot_hash == digest else ()
        return _Examination(key, digest, "", _are_equal(stored.goals, spec.goals), errors)
    except MorphgenError as error:
        return _Examination(error=str(error))


def _are_equal(a: GoalSet, b: GoalSet) -> bool:
    """Return whether two sets are equal up to rounding, in the fields that are compared."""
    if type(a) is not type(b):
        return False
    arrays_a, arrays_b = arrays_of(a), arrays_of(b)
    for name in arrays_a.keys() - a.not_compared:
        x, y = arrays_a[name], arrays_b[name]
        if x.shape != y.shape or x.dtype.kind != y.dtype.kind:
            return False
        if not (np.allclose(x, y, 0, EXACT) if x.dtype.kind == "f" else (x == y).all()):
            return False
    return True


def _set_findings(
    split: Split,
    goals: SplitGoals,
    members: Sequence[tuple[Side, Member]],
    examined: Sequence[_Examination],
) -> Iterator[Finding]:
    """Yield findings about sets that are missing, of another robot or config, or uncertified."""
    owners = {
        one.key: f"{side} robot {member.name}"
        for (side, member), one in zip(members, examined, strict=True)
        if one.key
    }
    for (side, member), one in zip(members, examined, strict=True):
        result, where = goals.sets.get((side, member.name)), f"{side} robot {member.name}"
        if one.error or result is None or result.goals is None:
            yield found("goals-missing", where, why=one.error or "it has no goal set")
            continue
        if mismatch := _mismatch(result, result.goals, member, one, owners, goals.config):
            yield found(mismatch[0], where, **mismatch[1])
        if errors := one.certificate_errors:
            more = f" (and {len(errors) - 1} more)" if errors[1:] else ""
            yield found("goals-unproven", where, error=errors[0], more=more)
    members_of_split = {(side, member.name) for side, member in members}
    for side, name in sorted(goals.sets.keys() - members_of_split):
        yield found("goals-unknown", f"{side} robot {name}", split=split.name)


def _mismatch(
    result: GoalResult,
    goals: GoalSet,
    member: Member,
    examined: _Examination,
    owners: Mapping[str, str],
    config: GoalConfig,
) -> tuple[str, dict[str, object]] | None:
    """Return the finding and its values if a set is not the one sampled for its member."""
    if goals.key == examined.key and result.robot_hash == examined.robot_hash:
        return None if examined.is_same else ("goals-changed", {"seed": config.seed})
    if goals.key != examined.key and goals.key in owners:
        return "goals-body/other", {"owner": owners[goals.key]}
    if result.robot_hash != examined.robot_hash:
        return "goals-body", {"stored": result.robot_hash, "expected": examined.robot_hash}
    if goals.seed != config.seed:
        return "goals-seed", {"seed": goals.seed, "expected": config.seed}
    made_for = _task_text(result.task, bool(goals.obstacles))
    expected = _task_text(member.task, member.obstacles)
    if made_for != expected:
        return "goals-config/task", {"made_for": made_for, "expected": expected}
    values = {"count": len(goals.q), "key": goals.key, "expected": examined.key}
    return "goals-config", values


def _task_text(task: str, obstacles: bool) -> str:
    return f"{task} with obstacles" if obstacles else task


def _shared_goals(split: Split, goals: SplitGoals) -> Iterator[Finding]:
    """Yield test robots whose goals leaked into the set of a train robot."""
    for member in split.test:
        test = goals.get("test", member.name)
        leaks: list[tuple[int, str, str]] = []
        for rival in split.train:
            train = goals.get("train", rival.name)
            if test is not None and train is not None and rival.task == member.task:
                count, noun = _num_shared(test, train, rival.robot_hash == member.robot_hash)
                leaks += [(count, noun, rival.name)] if count else []
        if test is not None and leaks:
            count, noun, train_name = max(leaks, key=lambda leak: leak[0])
            train_name += f" (and {len(leaks) - 1} more)" if leaks[1:] else ""
            values = {"train": train_name, "count": count, "of": len(test.q), "noun": noun}
            yield found("goals-shared", f"test robot {member.name}", **values)


def _num_shared(test: GoalSet, train: GoalSet, same_robot: bool) -> tuple[int, str]:
    """Return how many goals of a test set leaked into a train set, and a noun for them."""
    same_q = _near_joints(test.q, train.q)
    same_pose = _near(test.goal_poses, train.goal_poses)
    if same_robot:
        same = same_pose & same_q if test.start_belongs_to_goal else same_pose
        return int(same.any(axis=1).sum()), "goals"
    counts = {
        "goals": int(same_pose.any(axis=1).sum()),
        "configurations": int(same_q.any(axis=1).sum()),
    }
    noun, count = max(counts.items(), key=lambda item: item[1])
    return (count, noun) if count > MAX_SHARED * len(test.q) else (0, noun)


def _repeated_goals(split: Split, goals: SplitGoals) -> Iterator[Finding]:
    """Yield robots whose set has a goal twice."""
    for side, member in sided_members(split):
        goal_set = goals.get(side, member.name)
        if goal_set is None:
            continue
        same = _near(goal_set.goal_poses, goal_set.goal_poses)
        if goal_set.start_belongs_to_goal:
            same &= _near_joints(goal_set.q, goal_set.q)
        pairs = np.argwhere(np.triu(same, 1)).tolist()
        if pairs:
            more = f" (and {len(pairs) - 1} more pairs)" if pairs[1:] else ""
            where = f"{side} robot {member.name}"
            yield found("goals-repeated", where, first=pairs[0], more=more)


def _near(a: Array, b: Array) -> Mask:
    """Return which poses (n, 7) and (m, 7) are the same, shape (n, m)."""
    distance = np.linalg.norm(a[:, None, :3] - b[None, :, :3], axis=2)
    aligned = np.abs(a[:, 3:] @ b[:, 3:].T)
    return np.asarray((distance <= NEAR) & (aligned >= math.cos(NEAR_TURN / 2)))


def _near_joints(a: Array, b: Array) -> Mask:
    """Return which configurations (n, dof) and (m, dof) are the same, shape (n, m)."""
    if a.shape[1] != b.shape[1]:
        return np.zeros((len(a), len(b)), dtype=np.bool_)
    return np.asarray((np.abs(a[:, None] - b[None]) <= NEAR_JOINT).all(axis=2))
