"""Audit a split: leaks between train and test, violated rules, and nearest train robots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.generate import parse_bound
from morphgen.benchmark.hold_out import has_hold_out_rules, hold_out_findings
from morphgen.benchmark.regimes import regime_findings
from morphgen.benchmark.survey import Fault, SplitSurvey, SurveyedRobot, nearest_train, survey_split
from morphgen.encoding.similarity import NEAR_THRESHOLDS, NearThresholds, is_same_reach
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding, Severity
from morphgen.splits.split import SIDES, Member, Side, Split, sided_members

_FIXES = {
    "part-missing": "name the folder of your parts with --library, or correct the derivation",
    "links-many": "leave it out, or make the split with --max-links, the same for all robots",
    "body-broken": "correct the derivation, or the part",
    "body-changed": "use the morphgen that the split was made with, or make the split anew",
    "body-shared": "leave it out of one side",
    "body-near": "draw another test robot, or accept it with a reason",
    "body-repeated": "leave one out",
    "similarity-bound": "draw another test robot, or correct what the split says of its making",
    "name-shared": "rename one: what is stored by name, such as goals, would pass for the other's",
}


@dataclass(frozen=True)
class Neighbour:
    """The train robot that is most similar to a test robot by one measure."""

    test: str
    measure: str
    """Name of the measure, a key of ``MEASURES``."""
    train: str
    value: float


@dataclass(frozen=True)
class Audit:
    """Result of an audit."""

    split: str
    findings: tuple[Finding, ...]
    accepted: tuple[tuple[Finding, str], ...]
    """Findings that the split's author accepts, each with the reason."""
    neighbours: tuple[Neighbour, ...]
    """Nearest train robots by test robot, then measure, without robots that cannot be composed."""

    def passed(self, *, strict: bool = False) -> bool:
        """Return True if there are no unaccepted errors; ``strict``: and no warnings."""
        failing = ("error", "warning") if strict else ("error",)
        return not any(finding.severity in failing for finding in self.findings)

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        accepted = [{**finding.as_dict(), "reason": reason} for finding, reason in self.accepted]
        nearest: dict[str, dict[str, object]] = defaultdict(dict)
        for neighbour in self.neighbours:
            entry = {"train": neighbour.train, "value": neighbour.value}
            nearest[neighbour.test][neighbour.measure] = entry
        return {
            "split": self.split,
            "findings": [finding.as_dict() for finding in self.findings],
            "accepted": accepted,
            "nearest": dict(nearest),
        }


def audit(
    split: Split, library: Library, *, near: NearThresholds = NEAR_THRESHOLDS, jobs: int = 1
) -> Audit:
    """Find leaks between train and test robots, and violations of the regime.

    Errors:

    - ``part-missing``, ``body-broken``: a robot cannot be composed;
    - ``links-many``: a robot has more links than the split's ``max_links``;
    - ``body-changed``: a robot is not the one that the split names;
    - ``body-shared``: a test robot is a train robot of the same task;
    - ``body-near``: a test robot is a near duplicate of one, see ``NearThresholds``;
    - ``name-shared``: a train and a test robot with the same name are different;
    - ``similarity-bound``: a test robot violates the bound that the split was made with;
    - those of ``regime_findings``;
    - those of ``hold_out_findings``, if the split says what it holds out.

    ``body-repeated`` (a side has a robot twice at one task) is an error if the split says what it
    holds out, because such splits are made without repeated robots; else it is a warning. So is
    ``accepted-unused`` (the split accepts a finding that does not occur).
    """
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
    return conclude(split, findings, tuple(_neighbours(survey)))


def conclude(
    split: Split,
    findings: Sequence[Finding],
    neighbours: tuple[Neighbour, ...],
    not_audited: Collection[str] = (),
) -> Audit:
    """Return an audit from all findings: those that the split accepts are set apart.

    not_audited: Codes that may be accepted although nothing looked for them.
    """
    codes = {finding.code for finding in findings}
    why = "the split accepts it, but nothing of that code is found"
    unused = (
        Finding("accepted-unused", "warning", f"accepted {code}", why, "delete the entry")
        for code in split.accepted
        if code not in codes and code not in not_audited
    )
    remaining = (finding for finding in findings if finding.code not in split.accepted)
    accepted = (finding for finding in findings if finding.code in split.accepted)
    return Audit(
        split.name,
        (*remaining, *unused),
        tuple((finding, split.accepted[finding.code]) for finding in accepted),
        neighbours,
    )


def _robot_findings(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield robots that cannot be composed, or that have changed."""
    for side, member, robot in _robots(survey):
        if isinstance(robot, Fault):
            yield _finding(robot.code, side, member, robot.why)
        elif robot.robot_hash != member.robot_hash:
            why = (
                f"the split names body {member.robot_hash}, its derivation gives {robot.robot_hash}"
            )
            yield _finding("body-changed", side, member, why)


def _leaks(survey: SplitSurvey, near: NearThresholds) -> Iterator[Finding]:
    """Yield test robots that are train robots, or near duplicates of them."""
    split = survey.split
    names = {member.name: member for member in split.train}
    tree, cosine, workspace = map(survey.by_measure, ("tree", "cosine", "workspace"))
    is_one_workspace = _same_reach(survey, near) & (workspace > near.workspace)
    is_near = (tree < near.tree) & ((cosine > near.cosine) | is_one_workspace)
    for j, member in enumerate(split.test):
        rivals = [i for i, other in enumerate(split.train) if other.task == member.task]
        shared = [i for i in rivals if split.train[i].robot_hash == member.robot_hash]
        if shared:
            twin = _first_of(split, shared)
            why = f"train robot {twin} has the same body, and learns the same task"
            yield _finding("body-shared", "test", member, why)
        duplicates = sorted(
            (i for i in rivals if is_near[i, j] and i not in shared), key=tree[:, j].item
        )
        if duplicates:
            first = duplicates[0]
            why = (
                f"train robot {_first_of(split, duplicates)} is nearly the same: tree distance "
                f"{tree[first, j]:.2g} (below {near.tree:g}), cosine {cosine[first, j]:.6f} and "
                f"workspace overlap {workspace[first, j]:.4f} (one above {near.cosine:g} or "
                f"{near.workspace:g}, the latter at the same reach)"
            )
            yield _finding("body-near", "test", member, why)
        other = names.get(member.name)
        if other is not None and other.robot_hash != member.robot_hash:
            why = "a train robot of another body has the same name"
            yield _finding("name-shared", "test", member, why)


def _same_reach(survey: SplitSurvey, near: NearThresholds) -> NDArray[np.bool_]:
    """Return which pairs have nearly one reach, shape (n_train, n_test)."""
    train, test = (
        np.array(
            [
                np.nan if isinstance(each, Fault) else each.features.workspace.reach
                for each in robots
            ]
        )
        for robots in (survey.train, survey.test)
    )
    return is_same_reach(train[:, None], test[None, :], near)


def _repeated(split: Split) -> Iterator[Finding]:
    """Yield robots that a side has twice."""
    severity: Severity = "error" if has_hold_out_rules(split) else "warning"
    for side in SIDES:
        first: dict[tuple[object, ...], str] = {}
        for member in split.side(side):
            key = (member.robot_hash, member.task, member.obstacles)
            earlier = first.setdefault(key, member.name)
            if earlier != member.name:
                why = f"{side} robot {earlier} has the same body and task"
                yield replace(_finding("body-repeated", side, member, why), severity=severity)


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
            why = (
                f"its cosine to the nearest train robot is {largest:.3f}, and the split was made "
                f"with {bound}"
            )
            yield _finding("similarity-bound", "test", member, why)


def _neighbours(survey: SplitSurvey) -> Iterator[Neighbour]:
    n = len(survey.split.train)
    for j, member in enumerate(survey.split.test, n):
        for name, train, value in nearest_train(survey.split.train, survey.similarity[:n, j]):
            yield Neighbour(member.name, name, train, value)


def _robots(survey: SplitSurvey) -> Iterator[tuple[Side, Member, SurveyedRobot | Fault]]:
    for (side, member), robot in zip(sided_members(survey.split), survey.robots, strict=True):
        yield side, member, robot


def _first_of(split: Split, indices: Sequence[int]) -> str:
    """Return the name of the first of some train robots, and how many more there are."""
    more = f" (and {len(indices) - 1} more)" if indices[1:] else ""
    return split.train[indices[0]].name + more


def _finding(code: str, side: Side, member: Member, why: str) -> Finding:
    return Finding(code, "error", f"{side} robot {member.name}", why, _FIXES[code])
