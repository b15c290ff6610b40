"""Audit a split: leaks between train and test, violated rules, and nearest train robots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
from morphgen.encoding.similarity import NEAR_THRESHOLDS, is_same_reach
from morphgen.errors import nearest
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding
from morphgen.splits.split import SIDES, Member, Side, Split, sided_members
from morphgen.tasks.registry import TASKS


@dataclass(frozen=True)
class Audit:
    """Result of an audit."""

    split: str
    findings: tuple[Finding, ...]
    accepted: tuple[tuple[Finding, str], ...]
    """Findings that the split's author accepts, each with the reason."""
    nearest: Mapping[str, Mapping[str, NearestTrain]]
    """Nearest train robot by test robot and measure, without robots that cannot be composed."""

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
        }


def audit(split: Split, library: Library, *, jobs: int = 1) -> Audit:
    """Find leaks between train and test robots, and violations of the regime (docs/splits.md)."""
    return audit_survey(survey_split(split, library, jobs=jobs), library)


def audit_survey(survey: SplitSurvey, library: Library) -> Audit:
    """Audit a split from its survey; see ``audit``."""
    split = survey.split
    findings = [
        *_robot_findings(survey),
        *_leaks(survey),
        *_repeated(split),
        *_regime_findings(survey, library),
        *_unknown_tasks(split),
    ]
    n = len(split.train)
    nearest_by_test = {
        member.name: trains
        for j, member in enumerate(split.test, n)
        if (trains := nearest_train(split.train, survey.similarity[:n, j]))
    }
    codes = {finding.code for finding in findings}
    unused = (
        found("accepted-unused", f"accepted {code}") for code in split.accepted if code not in codes
    )
    remaining = (finding for finding in findings if finding.code not in split.accepted)
    accepted = (finding for finding in findings if finding.code in split.accepted)
    return Audit(
        split.name,
        (*remaining, *unused),
        tuple((finding, split.accepted[finding.code]) for finding in accepted),
        nearest_by_test,
    )


def _robot_findings(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield robots that cannot be composed, or that have changed."""
    for side, member, robot in _robots(survey):
        where = f"{side} robot {member.name}"
        if isinstance(robot, Fault):
            yield found(robot.code, where, why=robot.why)
        elif (given := robot.robot_hash) != member.robot_hash:
            yield found("body-changed", where, named=member.robot_hash, given=given)


def _leaks(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield test robots that are train robots, or near duplicates of them."""
    split, near = survey.split, NEAR_THRESHOLDS
    names = {member.name: member for member in split.train}
    tree, cosine, workspace = map(survey.by_measure, ("tree", "cosine", "workspace"))
    is_one_workspace = _same_reach(survey) & (workspace > near.workspace)
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


def _same_reach(survey: SplitSurvey) -> NDArray[np.bool_]:
    """Return which pairs have nearly one reach, shape (n_train, n_test)."""
    n = len(survey.split.train)
    train, test = (
        np.array([each.workspace.reach if each else np.nan for each in known])
        for known in (survey.features[:n], survey.features[n:])
    )
    return is_same_reach(train[:, None], test[None, :])


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


def _unknown_tasks(split: Split) -> Iterator[Finding]:
    """Yield robots whose task no installed package has."""
    for side, member in sided_members(split):
        if (task := member.task) not in TASKS:
            where = f"{side} robot {member.name}"
            yield found("task-unknown", where, task=task, nearest=nearest(task, TASKS))


def _robots(survey: SplitSurvey) -> Iterator[tuple[Side, Member, SurveyedRobot | Fault]]:
    for (side, member), robot in zip(sided_members(survey.split), survey.robots, strict=True):
        yield side, member, robot


def _first_of(split: Split, indices: Sequence[int]) -> str:
    """Return the name of the first of some train robots, and how many more there are."""
    more = f" (and {len(indices) - 1} more)" if indices[1:] else ""
    return split.train[indices[0]].name + more
