"""What a split gives away, or promises and does not keep; and how far test is from train."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morphgen.benchmark.extrapolation import parse_bound
from morphgen.benchmark.regimes import regime_findings
from morphgen.benchmark.similarity import MEASURES
from morphgen.benchmark.split import SIDES, Member, Side, Split
from morphgen.benchmark.survey import Fault, SplitSurvey, SurveyedRobot, survey_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding
from morphgen.processes import Progress, no_progress


@dataclass(frozen=True)
class NearThresholds:
    """Two bodies are near each other if their trees and their tokens are."""

    tree: float
    """Tree distances below it are near."""
    cosine: float
    """Cosines above it are near."""


NEAR_THRESHOLDS = NearThresholds(0.001, 0.99999)
"""Sizes that differ by about one per cent, which is within what a builder calls the same.

Sizes of robots of the shipped grammars, each changed by 1 %, give tree distances of 0.0002 to
0.0011 and cosines above 0.999997; by 3 %, 0.0007 to 0.0033 and down to 0.99997. Neither is enough
alone: the tree does not tell where along a link the next one sits, and the cosine is mostly flags
and unit quaternions, so it hardly tells sizes.
"""

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
    """The train robot that a test robot is most like."""

    test: str
    measure: str
    """A name in ``MEASURES``."""
    train: str
    value: float


@dataclass(frozen=True)
class Audit:
    """What was found of a split."""

    split: str
    findings: tuple[Finding, ...]
    accepted: tuple[tuple[Finding, str], ...]
    """Findings that the split's author knows of, each with the reason."""
    neighbours: tuple[Neighbour, ...]
    """By test robot, then measure; robots that cannot be composed have none."""

    def passed(self, *, strict: bool = False) -> bool:
        """Whether no error is left that was not accepted; ``strict``: nor a warning."""
        failing = ("error", "warning") if strict else ("error",)
        return not any(finding.severity in failing for finding in self.findings)

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        accepted = [{**each.as_dict(), "reason": reason} for each, reason in self.accepted]
        nearest: dict[str, dict[str, object]] = defaultdict(dict)
        for one in self.neighbours:
            nearest[one.test][one.measure] = {"train": one.train, "value": one.value}
        return {
            "split": self.split,
            "findings": [finding.as_dict() for finding in self.findings],
            "accepted": accepted,
            "nearest": dict(nearest),
        }


def audit(
    split: Split,
    library: Library,
    *,
    near: NearThresholds = NEAR_THRESHOLDS,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> Audit:
    """Look for leaks between train and test, and for rules of the regime that are broken.

    Errors: ``part-missing`` and ``body-broken`` (a robot cannot be composed), ``links-many`` (it
    has more links than the split's ``max_links``), ``body-changed`` (it is not the one that the
    split names), ``body-shared`` (a test robot is trained at its task),
    ``body-near`` (nearly so, see ``Near``), ``name-shared`` (by different bodies),
    ``similarity-bound`` (made with one that does not hold), and those of ``regime_findings``.
    Warnings: ``body-repeated`` (on one side, at one task),
    ``accepted-unused`` (the split accepts what is not found).

    Args:
        split: The split.
        library: Where its parts are.
        near: When bodies are near each other.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Raises:
        BenchmarkError: If ``jobs`` is below 1, or what the split says of its making is malformed.
    """
    return audit_survey(survey_split(split, library, jobs=jobs, progress=progress), library, near)


def audit_survey(
    found: SplitSurvey, library: Library, near: NearThresholds = NEAR_THRESHOLDS
) -> Audit:
    """The audit of a split that was surveyed; see ``audit``."""
    split = found.split
    findings = [
        *_robot_findings(found),
        *_leaks(found, near),
        *_repeated(split),
        *_regime_findings(found, library),
        *_bound_findings(found),
    ]
    left = tuple(each for each in findings if each.code not in split.accepted)
    known = tuple(
        (each, split.accepted[each.code]) for each in findings if each.code in split.accepted
    )
    codes = {finding.code for finding in findings}
    unused = tuple(_unused(code) for code in split.accepted if code not in codes)
    return Audit(split.name, (*left, *unused), known, tuple(_neighbours(found)))


def _robot_findings(found: SplitSurvey) -> Iterator[Finding]:
    """Robots that are not to be had, or not as they were."""
    for side, member, robot in _robots(found):
        if isinstance(robot, Fault):
            yield _finding(robot.code, side, member, robot.why)
        elif robot.robot_hash != member.robot_hash:
            why = (
                f"the split names body {member.robot_hash}, its derivation gives {robot.robot_hash}"
            )
            yield _finding("body-changed", side, member, why)


def _leaks(found: SplitSurvey, near: NearThresholds) -> Iterator[Finding]:
    """Test robots that are in train, or nearly."""
    split = found.split
    names = {member.name: member for member in split.train}
    tree, cosine = found.by_measure("tree"), found.by_measure("cosine")
    for j, member in enumerate(split.test):
        rivals = [i for i, other in enumerate(split.train) if other.task == member.task]
        shared = [i for i in rivals if split.train[i].robot_hash == member.robot_hash]
        if shared:
            why = (
                f"train robot {_others(split, shared)} has the same body, and learns the same task"
            )
            yield _finding("body-shared", "test", member, why)
        close = (tree[:, j] < near.tree) & (cosine[:, j] > near.cosine)
        beside = sorted((i for i in rivals if close[i] and i not in shared), key=tree[:, j].item)
        if beside:
            first = beside[0]
            why = (
                f"train robot {_others(split, beside)} is nearly the same: tree distance "
                f"{tree[first, j]:.2g} (below {near.tree:g}), cosine {cosine[first, j]:.6f} "
                f"(above {near.cosine:g})"
            )
            yield _finding("body-near", "test", member, why)
        other = names.get(member.name)
        if other is not None and other.robot_hash != member.robot_hash:
            why = "a train robot of another body has the same name"
            yield _finding("name-shared", "test", member, why)


def _repeated(split: Split) -> Iterator[Finding]:
    """Robots that a side has twice."""
    for side in SIDES:
        first: dict[tuple[object, ...], str] = {}
        for member in split.side(side):
            key = (member.robot_hash, member.task, member.obstacles)
            earlier = first.setdefault(key, member.name)
            if earlier != member.name:
                why = f"{side} robot {earlier} has the same body and task"
                yield replace(_finding("body-repeated", side, member, why), severity="warning")


def _regime_findings(found: SplitSurvey, library: Library) -> tuple[Finding, ...]:
    """What is against the regime, of the robots that can be composed."""
    sound: dict[Side, list[Member]] = {"train": [], "test": []}
    for side, member, robot in _robots(found):
        if isinstance(robot, SurveyedRobot):
            sound[side].append(member)
    if not sound["train"]:
        return ()
    split = replace(found.split, train=tuple(sound["train"]), test=tuple(sound["test"]))
    return regime_findings(split, library)


def _bound_findings(found: SplitSurvey) -> Iterator[Finding]:
    """Test robots that are not as alike to train as the split was made to be."""
    text = found.split.provenance.get("similarity")
    if text is None:
        return
    try:
        bound = parse_bound(str(text))
    except BenchmarkError as error:
        raise BenchmarkError(f"split {found.split.name!r}: made: {error}") from error
    for member, cosines in zip(found.split.test, found.by_measure("cosine").T, strict=True):
        largest = max(cosines[~np.isnan(cosines)].tolist(), default=None)
        if largest is not None and not bound.holds(largest):
            why = (
                f"its cosine to the nearest train robot is {largest:.3f}, and the split was made "
                f"with {bound}"
            )
            yield _finding("similarity-bound", "test", member, why)


def _neighbours(found: SplitSurvey) -> Iterator[Neighbour]:
    train, test = found.split.train, found.split.test
    for j, member in enumerate(test):
        for name, measure in MEASURES.items():
            values = found.by_measure(name)[:, j]
            if np.isnan(values).all():
                continue
            best = np.nanargmax(values) if measure.larger_is_more_alike else np.nanargmin(values)
            yield Neighbour(member.name, name, train[best].name, float(values[best]))


def _robots(found: SplitSurvey) -> Iterator[tuple[Side, Member, SurveyedRobot | Fault]]:
    robots: Mapping[Side, Sequence[SurveyedRobot | Fault]] = {
        "train": found.train,
        "test": found.test,
    }
    for side in SIDES:
        for member, robot in zip(found.split.side(side), robots[side], strict=True):
            yield side, member, robot


def _others(split: Split, indices: Sequence[int]) -> str:
    more = f" (and {len(indices) - 1} more)" if indices[1:] else ""
    return split.train[indices[0]].name + more


def _finding(code: str, side: Side, member: Member, why: str) -> Finding:
    return Finding(code, "error", f"{side} robot {member.name}", why, _FIXES[code])


def _unused(code: str) -> Finding:
    why = "the split accepts it, but nothing of that code is found"
    return Finding("accepted-unused", "warning", f"accepted {code}", why, "delete the entry")
