"""The card of a bundle: everything about a robot except its geometry, as plain data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

from msgspec import field

from morphgen.errors import FormatError
from morphgen.formats.records import FiniteNumber, Record, read_record
from morphgen.formats.rounding import round_number
from morphgen.formats.urdf.read import with_frames
from morphgen.model.dynamics import actuation
from morphgen.model.findings import Finding
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot

CARD_FORMAT = 1

_PROVENANCE = (
    "derivation",
    "source",
    "choices",
    "repairs",
    "parts",
    "accepted",
    "primitives",
    "convex",
    "packages",
)
"""Keys of a card that become the robot's ``provenance``."""


class _CardRecord(Record, frozen=True):
    """The keys of a card that a robot is read from; the others only describe the robot."""

    home: dict[str, FiniteNumber]
    ignore_pairs: tuple[tuple[str, str], ...]
    frames: dict[str, Any] = field(default_factory=dict)
    derivation: str = ""
    source: str = ""
    choices: dict[str, Any] = field(default_factory=dict)
    repairs: list[str] = field(default_factory=list)
    parts: list[dict[str, Any]] = field(default_factory=list)
    accepted: dict[str, dict[str, str]] = field(default_factory=dict)
    primitives: dict[str, Any] = field(default_factory=dict)
    convex: dict[str, Any] = field(default_factory=dict)
    packages: list[dict[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if any(not {"label", "part"} <= part.keys() for part in self.parts):
            raise ValueError("parts: expected objects with the keys 'label' and 'part'")


def robot_card(
    robot: Robot,
    findings: Iterable[Finding],
    hashes: Mapping[str, str],
    versions: Mapping[str, str],
) -> dict[str, object]:
    """Return the data of a robot's ``card.json``.

    It contains no time and no path, so that the same robot gives the same bytes on any machine.
    """
    has_tool = any(frame.name == "tool" for frame in robot.frames)
    joints = [robot.joints[k] for k in robot.independent_joints]
    return {
        "format": CARD_FORMAT,
        "name": robot.name,
        "links": len(robot.links),
        "movable": len(robot.movable_joints),
        "dof": robot.dof,
        "mass": round_number(robot.mass),
        "reach": round_number(arm_reach(robot)) if has_tool and robot.dof else None,
        "home": {joint.name: round_number(q) for joint, q in zip(joints, robot.home, strict=True)},
        "frames": {
            frame.name: {
                "link": frame.link,
                "position": [round_number(v) for v in frame.T_link_frame.position],
                "quaternion": [round_number(v) for v in frame.T_link_frame.quaternion],
            }
            for frame in robot.frames
        },
        "ignore_pairs": [list(pair) for pair in robot.ignore_pairs],
        "actuation": {
            gains.joint: {
                key: None if value is None else round_number(value)
                for key, value in asdict(gains).items()
                if key != "joint"
            }
            for gains in actuation(robot)
        },
        **robot.provenance,
        "findings": [finding.as_dict() for finding in findings],
        "hashes": dict(sorted(hashes.items())),
        "versions": dict(versions),
    }


def card_text(card: Mapping[str, object]) -> str:
    """Return a card as JSON text."""
    return json.dumps(card, indent=2, ensure_ascii=False) + "\n"


def apply_card(robot: Robot, card: Mapping[str, Any], origin: str) -> Robot:
    """Complete a robot that was read from a bundle's URDF by what only its card holds."""
    if "format" not in card:
        raise FormatError(f"{origin}: not a card: missing key 'format'")
    if card["format"] != CARD_FORMAT:
        raise FormatError(
            f"{origin}: card format {card['format']!r}; this version reads {CARD_FORMAT}"
        )
    known = {key: card[key] for key in _CardRecord.__struct_fields__ if key in card}
    record = read_record(known, _CardRecord, origin)
    robot = with_frames(robot, tuple(record.frames))
    try:
        home = tuple(record.home[robot.joints[k].name] for k in robot.independent_joints)
    except KeyError as error:
        raise FormatError(f"{origin}: home: missing joint {error}") from error
    provenance = {key: card[key] for key in _PROVENANCE if key in card}
    return replace(robot, home=home, ignore_pairs=record.ignore_pairs, provenance=provenance)
