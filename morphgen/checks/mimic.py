"""Mimic joints: followers that cannot follow."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from morphgen.checks.joints import reachable
from morphgen.model.findings import Finding
from morphgen.model.robot import Joint, Mimic, Robot

RANGE_TOLERANCE = 0.01
"""How far a follower may be sent past its limits, as a fraction of their span."""


def check_mimic(robot: Robot) -> Iterator[Finding]:
    """Find mimic joints whose leader does not move, or moves them nowhere."""
    for joint in robot.joints:
        if joint.mimic is not None:
            yield from _follower_findings(robot, joint, joint.mimic)


def check_mimic_range(robot: Robot) -> Iterator[Finding]:
    """Find followers that their leaders' ranges send past their own limits."""
    matrix, offset = robot.mimic_map
    for row, k in enumerate(robot.movable_joints):
        follower = robot.joints[k]
        lower, upper = reachable(follower)
        leaders = np.flatnonzero(matrix[row]).tolist()
        if follower.mimic is None or not leaders or not math.isfinite(upper - lower):
            continue
        leader = robot.joints[robot.independent_joints[leaders[0]]]
        gain = float(matrix[row, leaders[0]])
        low, high = sorted(gain * q + float(offset[row]) for q in reachable(leader))
        slack = RANGE_TOLERANCE * (upper - lower)
        if low < lower - slack or high > upper + slack:
            yield Finding(
                "mimic-range",
                "warning",
                f"joint {follower.name}",
                f"joint {leader.name} sends it from {low:.4g} to {high:.4g}; its limits are "
                f"{lower:.4g} to {upper:.4g}",
                "widen its limits, or narrow its leader's",
            )


def _follower_findings(robot: Robot, joint: Joint, mimic: Mimic) -> Iterator[Finding]:
    where = f"joint {joint.name}"
    if not joint.is_movable:
        yield Finding(
            "mimic-on-fixed",
            "warning",
            where,
            f"it is fixed but mimics {mimic.joint}",
            "remove <mimic>, or give the joint a movable type",
        )
        return
    if not robot.joints[robot.joint_index[mimic.joint]].is_movable:
        yield Finding(
            "mimic-leader-fixed",
            "error",
            where,
            f"it mimics {mimic.joint}, which is fixed: loaders disagree whether it moves",
            "make it fixed, let it move by itself or name another leader",
        )
    if not (math.isfinite(mimic.multiplier) and math.isfinite(mimic.offset)):
        yield Finding(
            "mimic-invalid",
            "error",
            where,
            f"it follows as {mimic.multiplier} q + {mimic.offset}",
            "write a finite multiplier and offset",
        )
    elif mimic.multiplier == 0:
        yield Finding(
            "mimic-still",
            "warning",
            where,
            f"its multiplier is 0: it never moves with {mimic.joint}",
            "write the multiplier, or make the joint fixed",
        )
