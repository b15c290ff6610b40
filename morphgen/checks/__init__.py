"""Checks of a robot: findings with a code, a severity and a remedy, and the safe repairs.

An ``error`` means that a simulator rejects the robot or simulates something other than the file
describes; a ``warning``, that something is suspicious; an ``info``, something to know:
a limitation of a loader that a bundle works around, or a finding that a part accepts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

from morphgen.checks.rules import CHECKS, check_self_collision, check_tool, repaired
from morphgen.model.findings import Finding
from morphgen.model.mesh import require_bounded_meshes
from morphgen.model.robot import Robot

_SEVERITY_RANK = {"error": 0, "warning": 1, "info": 2}


def check(
    robot: Robot, *, tool_required: bool = True, home_tested: bool = False
) -> tuple[Finding, ...]:
    """Run every check on a robot.

    Args:
        robot: The robot.
        tool_required: Whether a missing or immobile tool is a finding; False for parts.
        home_tested: Whether ``survey_collisions`` has already tested the home configuration, so
            that the self-collision check can be skipped.

    Returns:
        Findings, sorted by severity, code and place.

    Raises:
        MeshError: If the meshes have too many triangles in all.
    """
    require_bounded_meshes(robot)
    checks = (*CHECKS, check_tool) if tool_required else CHECKS
    if home_tested:
        checks = tuple(run for run in checks if run is not check_self_collision)
    findings = {_apply_accepted(finding, robot) for run in checks for finding in run(robot)}
    findings.update(robot.source_findings)
    return tuple(
        sorted(findings, key=lambda f: (_SEVERITY_RANK[f.severity], f.code, f.where, f.why))
    )


def _apply_accepted(finding: Finding, robot: Robot) -> Finding:
    """Lower a finding to ``info`` if a part's manifest accepts it and gives a reason.

    A finding about two links is accepted if either of them accepts it.
    """
    accepted = cast(Mapping[str, Mapping[str, str]], robot.provenance.get("accepted", {}))
    for name in finding.where.partition(" ")[2].split(", "):  # kind, then names
        reason = accepted.get(name, {}).get(finding.code)
        if reason is not None:
            return replace(finding, severity="info", why=f"{finding.why}; accepted: {reason}")
    return finding


def fix(robot: Robot) -> tuple[Robot, tuple[Finding, ...]]:
    """Apply all safe repairs to a robot.

    Args:
        robot: The robot.

    Returns:
        The repaired robot, whose provenance lists the repairs, and the repaired findings.
    """
    fixable = tuple(f for f in check(robot, tool_required=False) if f.fixable)
    return (record_repairs(repaired(robot, fixable), fixable) if fixable else robot), fixable


def record_repairs(robot: Robot, findings: tuple[Finding, ...]) -> Robot:
    """Return a robot whose provenance, and therefore its card, lists further repairs.

    The findings of its source file are cleared, because the repaired robot does not have them.
    """
    earlier = cast(list[str], robot.provenance.get("repairs", []))
    repairs = [*earlier, *(f"{finding.where}: {finding.repair}" for finding in findings)]
    return replace(robot, provenance={**robot.provenance, "repairs": repairs}, source_findings=())
