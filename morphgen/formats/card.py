"""The card: everything about a robot that is not geometry, as plain data."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.urdf_text import number
from morphgen.model.dynamics import actuation
from morphgen.model.findings import Finding
from morphgen.model.kinematics import reach
from morphgen.model.robot import Robot

CARD_FORMAT = 1
_PROVENANCE: Mapping[str, tuple[type, ...]] = {
    "derivation": (str,),
    "source": (str,),
    "choices": (dict,),
    "repairs": (list, str),
    "parts": (list, dict),
    "accepted": (dict, dict, str),
    "primitives": (dict,),
}
"""Types of what a card keeps of a robot's provenance, and of what that holds."""


def card_of(
    robot: Robot,
    findings: Iterable[Finding],
    hashes: Mapping[str, str],
    versions: Mapping[str, str],
) -> dict[str, object]:
    """Describe a robot.

    Args:
        robot: The body.
        findings: What the checks say of it.
        hashes: SHA-256 of its files, by name.
        versions: Versions of what made it.

    Returns:
        Data for ``card.json``; it holds no time and no path, so the same robot gives the same
        bytes anywhere.
    """
    has_tool = any(frame.name == "tool" for frame in robot.frames)
    joints = [robot.joints[k] for k in robot.independent_joints]
    return {
        "format": CARD_FORMAT,
        "name": robot.name,
        "links": len(robot.links),
        "movable": len(robot.movable_joints),
        "dof": robot.dof,
        "mass": rounded(robot.mass),
        "reach": rounded(reach(robot)) if has_tool and robot.dof else None,
        "home": {joint.name: rounded(q) for joint, q in zip(joints, robot.home, strict=True)},
        "frames": {
            frame.name: {
                "link": frame.link,
                "position": [rounded(v) for v in frame.T_link_frame.position],
                "quaternion": [rounded(v) for v in frame.T_link_frame.quaternion],
            }
            for frame in robot.frames
        },
        "ignore_pairs": [list(pair) for pair in robot.ignore_pairs],
        "actuation": {
            gains.joint: {
                key: rounded(value) for key, value in asdict(gains).items() if key != "joint"
            }
            for gains in actuation(robot)
        },
        **robot.provenance,
        "findings": [finding.as_dict() for finding in findings],
        "hashes": dict(sorted(hashes.items())),
        "versions": dict(versions),
    }


def card_text(card: Mapping[str, object]) -> str:
    """A card as JSON text."""
    return json.dumps(card, indent=2, ensure_ascii=False) + "\n"


def card_frames(card: object, origin: str) -> tuple[str, ...]:
    """Names of a card's frames.

    Args:
        card: What was read.
        origin: What to call the card in errors, usually its path.

    Raises:
        FormatError: If it is no card, or of another format.
    """
    if not isinstance(card, dict) or "format" not in card:
        raise FormatError(f"{origin}: no card: expected an object with the key 'format'")
    if card["format"] != CARD_FORMAT:
        raise FormatError(
            f"{origin}: card format {card['format']!r}; this version reads {CARD_FORMAT}"
        )
    frames = card.get("frames", {})
    if not isinstance(frames, dict):
        raise FormatError(f"{origin}: frames: expected an object, not {frames!r}")
    return tuple(frames)


def apply_card(robot: Robot, card: Mapping[str, Any], origin: str) -> Robot:
    """Give a robot read from a bundle's URDF what only the card knows.

    Args:
        robot: The robot, with the card's frames.
        card: The card.
        origin: What to call the card in errors, usually its path.

    Raises:
        FormatError: If the card lacks a key, or a value is of the wrong type.
    """
    provenance = {key: card[key] for key in _PROVENANCE if key in card}
    for key, value in provenance.items():
        if not _is_of(_PROVENANCE[key], value):
            raise FormatError(f"{origin}: {key}: not what a card holds there: {_shown(value)}")
    for part in provenance.get("parts", []):
        if not {"label", "part"} <= part.keys():
            raise FormatError(f"{origin}: parts: expected objects with label and part")
    try:
        home = card["home"]
        positions = tuple(float(home[robot.joints[k].name]) for k in robot.independent_joints)
        if not all(map(math.isfinite, positions)):
            raise ValueError("a position at home is not finite")
        return replace(
            robot,
            home=positions,
            ignore_pairs=tuple((str(a), str(b)) for a, b in card["ignore_pairs"]),
            provenance=provenance,
        )
    except KeyError as error:
        raise FormatError(f"{origin}: has no {error}") from error
    except (OverflowError, TypeError, ValueError) as error:
        raise FormatError(f"{origin}: home or ignore_pairs: {error}") from error


def _is_of(kinds: tuple[type, ...], value: object) -> bool:
    """Whether a value is of the first type, what it holds of the second, and so on."""
    if not isinstance(value, kinds[0]):
        return False
    held = value.values() if isinstance(value, dict) else value
    return len(kinds) == 1 or all(_is_of(kinds[1:], each) for each in held)  # type: ignore[attr-defined]


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def rounded(value: float | None) -> float | None:
    """A number as files hold it: 12 significant digits."""
    return None if value is None else float(number(value))
