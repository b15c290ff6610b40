"""Checks of joints: axes, limits, effort, velocity, home positions and mimic joints."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from morphgen.model.findings import Finding, Severity
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Joint, Robot

AXIS_TOLERANCE = 1e-3  # deviation of an axis from unit length that counts as rounding in a file
REVOLUTE_SPAN = 4 * 2 * math.pi
"""Widest plausible range of a revolute joint [rad]; wider limits are likely degrees."""
PRISMATIC_SPAN = 10.0
"""Widest plausible range of a prismatic joint [m]; wider limits are likely millimetres."""
MIMIC_RANGE_TOLERANCE = 0.01
"""Overshoot of a mimic joint's limits that is not reported, as a fraction of their span."""


_Fault = tuple[str, Severity, str, str, str]
"""Code, severity, reason, remedy and repair of a finding about a joint; no repair is empty."""


def check_joints(robot: Robot) -> Iterator[Finding]:
    """Find faults of single joints: of axis, limits, effort, velocity, home and ``<mimic>``."""
    home = dict(zip(robot.independent_joints, robot.home, strict=True))
    for k, joint in enumerate(robot.joints):
        faults = [*_mimic_faults(robot, joint)]
        if joint.is_movable:
            faults += (*_axis_faults(joint), *_limit_faults(robot, joint))
            faults += _drive_faults(robot, joint)
        if k in home:
            faults += _home_faults(joint, home[k])
        for code, severity, *texts in faults:
            yield Finding(code, severity, f"joint {joint.name}", *texts)


def _axis_faults(joint: Joint) -> Iterator[_Fault]:
    """Find an axis that is zero or not of unit length."""
    axis = f"its axis {joint.axis}"
    if not is_axis_valid(joint):
        yield "axis-invalid", "error", f"{axis} has no direction", "write a unit vector", ""
    elif not is_axis_unit(joint):
        severity: Severity = "error" if joint.kind == "prismatic" else "warning"
        effect = "; PyBullet moves it that many times as far" if severity == "error" else ""
        why = f"{axis} is {math.hypot(*joint.axis):.4g} long{effect}"
        fix = "scale the axis to unit length, as the repair does"
        repair = f"the axis {joint.axis} was scaled to unit length"
        yield "axis-not-unit", severity, why, fix, repair


def _limit_faults(robot: Robot, joint: Joint) -> Iterator[_Fault]:
    """Find limits that are missing, contradictory or implausible."""
    limits = joint.limits
    if joint.kind == "continuous":
        if limits is not None:
            effect = "which PyBullet reports and MuJoCo drops"
            why = f"it is continuous but has limits {limits}, {effect}"
            fix = "make it revolute if the limits are real; the repair drops them"
            repair = f"its limits {limits} were dropped: it is continuous"
            yield "limits-on-continuous", "warning", why, fix, repair
        return
    if limits is None or not all(map(math.isfinite, limits)):
        given = "without limits" if limits is None else f"with limits {limits}"
        effect = "PyBullet refuses the file, MuJoCo lets it move without end"
        fix = "write limits" + (", or make it continuous" if joint.kind == "revolute" else "")
        yield "limits-missing", "error", f"it is {joint.kind} {given}: {effect}", fix, ""
        return
    lower, upper = sorted(limits)
    span, unit = upper - lower, "m" if joint.kind == "prismatic" else "rad"
    widest = PRISMATIC_SPAN if joint.kind == "prismatic" else REVOLUTE_SPAN
    if has_inverted_limits(joint):
        why = f"lower {upper:g} is above upper {lower:g}: MuJoCo drops or refuses such limits"
        fix = "swap the limits, as the repair does"
        repair = f"its limits were swapped to {lower:g} to {upper:g}"
        yield "limits-inverted", "error", why, fix, repair
    if span == 0:
        why = f"both limits are {lower:g}: MuJoCo drops or refuses that, PyBullet locks it"
        fix = "write the real limits, or make the joint fixed, as the repair does at zero"
        repair = "it was made fixed: both limits are 0" if is_locked(robot, joint) else ""
        yield "limits-empty", "error", why, fix, repair
    if span > widest:
        why = f"its limits span {span:g} {unit}, more than {widest:.4g} {unit}"
        yield "limits-wide", "warning", why, f"check the unit of the limits ({unit})", ""


def _drive_faults(robot: Robot, joint: Joint) -> Iterator[_Fault]:
    """Find effort or velocity that is missing, and negative damping or friction."""
    units = ("N", "m/s") if joint.kind == "prismatic" else ("N m", "rad/s")
    consequence = ": PyBullet has no force to move it, MuJoCo no limit"
    is_driven = joint.is_independent and not is_locked(robot, joint)
    for name, value, default, unit, effect in (
        ("effort", joint.effort, DEFAULT_EFFORT, units[0], consequence),
        ("velocity", joint.velocity, DEFAULT_VELOCITY, units[1], ""),
    ):
        if is_driven and not is_positive(value):
            why = (f"it has no {name}" if value is None else f"its {name} is {value:g}") + effect
            fix = f"write its largest {name}; the repair takes {default:g} {unit}"
            repair = f"its {name} was set to {default:g} {unit}"
            yield f"{name}-missing", "warning", why, fix, repair
    for name, value in (("damping", joint.damping), ("friction", joint.friction)):
        if not value >= 0 or math.isinf(value):
            fix = "write a finite number of at least 0"
            yield f"{name}-invalid", "warning", f"its {name} is {value}", fix, ""


def _home_faults(joint: Joint, position: float) -> Iterator[_Fault]:
    """Find a home position outside the limits."""
    lower, upper = position_range(joint)
    if not (math.isfinite(position) and lower <= position <= upper):
        why = f"home is {position:g}, its limits are {lower:g} to {upper:g}"
        fix = "move home between the limits, as the repair does"
        repair = f"its home was moved from {position:g} to the nearest limit"
        yield "home-outside-limits", "error", why, fix, repair


def _mimic_faults(robot: Robot, joint: Joint) -> Iterator[_Fault]:
    """Find a mimic joint that cannot move, or whose leader is fixed."""
    mimic = joint.mimic
    if mimic is None:
        return
    if not joint.is_movable:
        fix = "remove <mimic>, or give the joint a movable type"
        yield "mimic-on-fixed", "warning", f"it is fixed but mimics {mimic.joint}", fix, ""
        return
    if not robot.joints[robot.joint_index[mimic.joint]].is_movable:
        why = f"it mimics {mimic.joint}, which is fixed: loaders disagree whether it moves"
        fix = "make it fixed, let it move by itself or name another leader"
        yield "mimic-leader-fixed", "error", why, fix, ""
    if not (math.isfinite(mimic.multiplier) and math.isfinite(mimic.offset)):
        why = f"its position is {mimic.multiplier} q + {mimic.offset}, which is not finite"
        yield "mimic-invalid", "error", why, "write a finite multiplier and offset", ""
    elif mimic.multiplier == 0:
        why = f"its multiplier is 0: it never moves with {mimic.joint}"
        yield "mimic-still", "warning", why, "write the multiplier, or make the joint fixed", ""


def check_mimic_range(robot: Robot) -> Iterator[Finding]:
    """Find mimic joints that their leaders drive beyond their own limits."""
    matrix, offset = robot.mimic_map
    for row, k in enumerate(robot.movable_joints):
        follower = robot.joints[k]
        lower, upper = position_range(follower)
        leaders = np.flatnonzero(matrix[row]).tolist()
        if follower.mimic is None or not leaders or not math.isfinite(upper - lower):
            continue
        leader = robot.joints[robot.independent_joints[leaders[0]]]
        gain = float(matrix[row, leaders[0]])
        low, high = sorted(gain * q + float(offset[row]) for q in position_range(leader))
        slack = MIMIC_RANGE_TOLERANCE * (upper - lower)
        if low < lower - slack or high > upper + slack:
            driven = f"joint {leader.name} drives it from {low:.4g} to {high:.4g}"
            why = f"{driven}; its limits are {lower:.4g} to {upper:.4g}"
            fix = "widen its limits, or narrow its leader's"
            yield Finding("mimic-range", "warning", f"joint {follower.name}", why, fix)


def is_axis_valid(joint: Joint) -> bool:
    """Return whether the axis is finite and not zero."""
    length = math.hypot(*joint.axis)
    return math.isfinite(length) and length >= 1e-9


def is_axis_unit(joint: Joint) -> bool:
    """Return whether the axis has unit length, up to rounding in a file."""
    return abs(math.hypot(*joint.axis) - 1) <= AXIS_TOLERANCE


def has_inverted_limits(joint: Joint) -> bool:
    """Return whether the lower limit is above the upper one."""
    return (
        joint.kind in ("revolute", "prismatic")
        and joint.limits is not None
        and all(map(math.isfinite, joint.limits))
        and joint.limits[0] > joint.limits[1]
    )


def is_locked(robot: Robot, joint: Joint) -> bool:
    """Return whether limits of zero make the joint equivalent to a fixed one."""
    mimics = (other.mimic for other in robot.joints if other.mimic is not None)
    return (
        joint.kind in ("revolute", "prismatic")
        and joint.limits == (0.0, 0.0)
        and joint.mimic is None
        and all(mimic.joint != joint.name for mimic in mimics)
    )


def position_range(joint: Joint) -> tuple[float, float]:
    """Return the lowest and highest position within the limits, even if these are inverted."""
    if joint.limits is None or joint.kind == "continuous" or any(map(math.isnan, joint.limits)):
        return (-math.inf, math.inf)
    return (min(joint.limits), max(joint.limits))


def is_positive(value: float | None) -> bool:
    """Return whether a value is given, finite and above zero."""
    return value is not None and math.isfinite(value) and value > 0


CHECKS = (check_joints, check_mimic_range)
