"""Findings about a robot, each with a code, a severity and the fix; and the safe repairs.

``error`` means that a simulator refuses the robot or simulates something else than it says,
``warning`` that something is suspicious, ``info`` names a trap that a bundle already avoids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import cast

from morphgen.checks.frames import check_tool
from morphgen.checks.gaps import check_links_apart
from morphgen.checks.home import check_self_collision
from morphgen.checks.inertia import check_inertia, check_masses
from morphgen.checks.joints import check_axes, check_drive, check_home, check_limits
from morphgen.checks.loaders import (
    check_capsules,
    check_link_count,
    check_mesh_scales,
    check_mimic_loaders,
    check_root,
)
from morphgen.checks.mimic import check_mimic, check_mimic_range
from morphgen.checks.names import check_frame_names, check_names, check_reserved
from morphgen.checks.repairs import repaired
from morphgen.checks.shapes import check_shapes, check_units
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot

Check = Callable[[Robot], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    check_masses,
    check_inertia,
    check_axes,
    check_limits,
    check_drive,
    check_home,
    check_mimic,
    check_mimic_range,
    check_shapes,
    check_units,
    check_links_apart,
    check_names,
    check_reserved,
    check_frame_names,
    check_self_collision,
    check_mimic_loaders,
    check_capsules,
    check_mesh_scales,
    check_link_count,
    check_root,
)

_RANK = {"error": 0, "warning": 1, "info": 2}

__all__ = ["CHECKS", "Check", "check", "fix", "record_repairs"]


def check(
    robot: Robot, *, tool_required: bool = True, home_tested: bool = False
) -> tuple[Finding, ...]:
    """Run every check.

    Args:
        robot: The body.
        tool_required: Whether a missing or motionless tool is a finding; not so for a part.
        home_tested: Whether it is known that nothing collides at home, as after ``survey_split``.

    Returns:
        Findings by severity, code and place; the same robot gives the same ones.
    """
    checks = (*CHECKS, check_tool) if tool_required else CHECKS
    if home_tested:
        checks = tuple(run for run in checks if run is not check_self_collision)
    findings = {_judged(finding, robot) for run in checks for finding in run(robot)}
    findings.update(robot.source_findings)
    return tuple(sorted(findings, key=lambda f: (_RANK[f.severity], f.code, f.where, f.why)))


def _judged(finding: Finding, robot: Robot) -> Finding:
    """The finding, turned to information where a part says why it is as it should be.

    One of the two links of a pair may say so for both.
    """
    accepted = cast(Mapping[str, Mapping[str, str]], robot.provenance.get("accepted", {}))
    for name in finding.where.partition(" ")[2].split(", "):
        reason = accepted.get(name, {}).get(finding.code)
        if reason is not None:
            return replace(finding, severity="info", why=f"{finding.why}; accepted: {reason}")
    return finding


def fix(robot: Robot) -> tuple[Robot, tuple[Finding, ...]]:
    """Repair what can be repaired safely.

    Args:
        robot: The body.

    Returns:
        The repaired body, whose provenance names the repairs, and the findings that are gone.
    """
    gone = tuple(f for f in check(robot, tool_required=False) if f.fixable)
    return (record_repairs(repaired(robot), gone) if gone else robot), gone


def record_repairs(robot: Robot, findings: tuple[Finding, ...]) -> Robot:
    """A copy whose provenance, and with it its card, names repairs after those that it names.

    What was repaired in its file is no finding any more: nothing written of the robot has it.
    """
    made = cast(list[str], robot.provenance.get("repairs", []))
    new = [f"{finding.where}: {finding.repair}" for finding in findings]
    provenance = {**robot.provenance, "repairs": [*made, *new]}
    return replace(robot, provenance=provenance, source_findings=())
