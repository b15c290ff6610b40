"""``morphgen show``: what a robot is made of."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    Subparsers,
    add_json,
    add_library,
    add_robot,
    add_root,
    robot_named,
)

if TYPE_CHECKING:
    from morphgen.model.robot import Joint, Robot


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "show",
        help="print a robot's link tree with joints, limits, masses and frames",
        description="Print a robot's link tree with joints, limits, masses and frames.",
    )
    add_robot(parser)
    add_root(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the tree."""
    robot = robot_named(args)
    print(json.dumps(_data(robot), indent=2) if args.json else _text(robot))
    return 0


def _text(robot: Robot) -> str:
    lines = [f"{robot.name}: {len(robot.links)} links, {robot.dof} DoF, {robot.mass:.4g} kg"]
    depth = [0] * len(robot.links)
    frames = {
        link.name: [f.name for f in robot.frames if f.link == link.name] for link in robot.links
    }
    for i, link in enumerate(robot.links):
        words = [link.name]
        if i:
            joint = robot.joints[i - 1]
            depth[i] = depth[robot.parents[i]] + 1
            words.append(_joint_words(joint))
        if link.inertial is not None and link.inertial.mass:
            words.append(f"{link.inertial.mass:.4g} kg")
        words += [f"<{name}>" for name in frames[link.name]]
        lines.append("  " * depth[i] + "  ".join(words))
    return "\n".join(lines)


def _joint_words(joint: Joint) -> str:
    if joint.kind == "fixed":
        return "fixed"
    axis = " ".join(f"{value:g}" for value in joint.axis)
    words = f"{joint.name}: {joint.kind} ({axis})"
    if joint.limits is not None:
        low, high = joint.limits
        words += (
            f" [{low:.4g}, {high:.4g}] m"
            if joint.kind == "prismatic"
            else f" [{math.degrees(low):.4g}, {math.degrees(high):.4g}] deg"
        )
    if joint.mimic is not None:
        words += f" = {joint.mimic.multiplier:g} * {joint.mimic.joint} + {joint.mimic.offset:g}"
    return words


def _data(robot: Robot) -> dict[str, object]:
    parents = ["", *(joint.parent for joint in robot.joints)]
    return {
        "name": robot.name,
        "mass": robot.mass,
        "dof": robot.dof,
        "links": [
            {
                "name": link.name,
                "parent": parent,
                "mass": link.inertial.mass if link.inertial else 0.0,
            }
            for link, parent in zip(robot.links, parents, strict=True)
        ],
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind,
                "parent": joint.parent,
                "child": joint.child,
                "axis": joint.axis,
                "limits": joint.limits,
                "effort": joint.effort,
                "velocity": joint.velocity,
                "mimic": joint.mimic.joint if joint.mimic else None,
            }
            for joint in robot.joints
        ],
        "frames": {
            frame.name: {
                "link": frame.link,
                "position": frame.T_link_frame.position,
                "quaternion": frame.T_link_frame.quaternion,
            }
            for frame in robot.frames
        },
    }
