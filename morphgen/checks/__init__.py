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
    """Run every check on a robot; findings are sorted by severity, code and place.

    Without ``tool_required`` a missing or immobile tool is none, as for parts. With ``home_tested``
    ``survey_collisions`` has tested the home configuration already.
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
    """Lower a finding to ``info`` if the part of one of its links accepts it with a reason."""
    accepted = cast(Mapping[str, Mapping[str, str]], robot.provenance.get("accepted", {}))
    for name in finding.where.partition(" ")[2].split(", "):  # kind, then names
        reason = accepted.get(name, {}).get(finding.code)
        if reason is not None:
            return replace(finding, severity="info", why=f"{finding.why}; accepted: {reason}")
    return finding


def fix(robot: Robot) -> tuple[Robot, tuple[Finding, ...]]:
    """Return a robot with all safe repairs, listed in its provenance, and repaired findings."""
    fixable = tuple(f for f in check(robot, tool_required=False) if f.fixable)
    return (record_repairs(repaired(robot, fixable), fixable) if fixable else robot), fixable


def record_repairs(robot: Robot, findings: tuple[Finding, ...]) -> Robot:
    """Return a robot whose card lists further repairs, without the findings of its source file."""
    earlier = cast(list[str], robot.provenance.get("repairs", []))
    repairs = [*earlier, *(f"{finding.where}: {finding.repair}" for finding in findings)]
    return replace(robot, provenance={**robot.provenance, "repairs": repairs}, source_findings=())
