"""Write the folder of one robot in a split folder, and compare it with the robot."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path

from morphgen.checks import check
from morphgen.errors import FormatError
from morphgen.formats.bundle import (
    CARD,
    PICTURE,
    URDF,
    file_findings,
    split_colours,
    write_bundle,
)
from morphgen.formats.card import card_text, robot_card
from morphgen.formats.data_files import read_json
from morphgen.formats.files import replacing_folder
from morphgen.formats.urdf_text import urdf_text
from morphgen.grammar.robot_set import DERIVATION, light_urdf
from morphgen.model.robot import Robot

_MESH = re.compile(r'(<mesh filename=")[^"]*"')
_IGNORED_KEYS = {"findings", "versions"}
"""Keys of a card that are not compared."""
_REL_TOL, _ABS_TOL = 1e-6, 1e-9
"""Tolerances of the numbers of two cards, which may be rounded on different machines."""


def write_robot(robot: Robot, folder: Path, *, light: bool, picture: bool) -> None:
    """Write a robot's bundle over an existing folder; ``light``: only URDF and derivation.

    Raises:
        FormatError: If the folder cannot be written.
    """
    if light:
        with replacing_folder(folder) as partial:
            for name, text in _light_files(robot).items():
                (partial / name).write_text(text, encoding="utf-8")
        return
    write_bundle(robot, folder, check(robot), picture=picture, edits_kept=False)


def differences(folder: Path, robot: Robot, *, light: bool) -> list[str]:
    """Return the differences between a robot's folder and the robot, one line each.

    The URDF (without the names of meshes) and the card (without findings and versions) are compared
    with the robot, all other files with the hashes on the card.
    """
    if not folder.is_dir():
        return ["its folder is missing"]
    return list(_light_differences(folder, robot) if light else _differences(folder, robot))


def is_current(folder: Path, *, light: bool, picture: bool) -> bool:
    """Test if this version of morphgen would write a folder without differences in the same way."""
    if light:
        return True
    card = read_json(folder / CARD)
    has_picture = (folder / PICTURE).is_file()
    return card["versions"] == {"morphgen": version("morphgen")} and has_picture == picture


def _light_files(robot: Robot) -> dict[str, str]:
    return {URDF: light_urdf(robot), DERIVATION: f"{robot.provenance['derivation']}\n"}


def _light_differences(folder: Path, robot: Robot) -> Iterator[str]:
    files = _light_files(robot)
    for name, text in files.items():
        path = folder / name
        if not path.is_file():
            yield f"file {name} is missing"
        elif path.read_bytes() != text.encode():
            yield f"file {name} is not the robot's"
    yield from _extra(folder, files)


def _differences(folder: Path, robot: Robot) -> Iterator[str]:
    try:
        findings = file_findings(folder)
    except FormatError as error:
        yield str(error)
        return
    yield from (f"{finding.where}: {finding.why}" for finding in findings)
    card = read_json(folder / CARD)
    if (folder / URDF).is_file():
        stored_urdf = (folder / URDF).read_text("utf-8", "replace")
        # Compared without the names of meshes, which depend on where the meshes are stored.
        if _MESH.sub(r'\1"', stored_urdf) != urdf_text(split_colours(robot), lambda mesh: ""):
            yield f"file {URDF} is not the robot's"
    expected = json.loads(card_text(robot_card(robot, (), card["hashes"], {})))
    for key in sorted(expected.keys() - _IGNORED_KEYS):
        if not same(card.get(key), expected[key]):
            yield f"file {CARD}: its {key!r} is not the robot's"
    yield from _extra(folder, (*card["hashes"], CARD, PICTURE))


def _extra(folder: Path, known: Iterable[str]) -> Iterator[str]:
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    yield from (f"file {name} does not belong to it" for name in sorted(names - set(known)))


def same(a: object, b: object) -> bool:
    """Test if two values read from JSON are equal up to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=_REL_TOL, abs_tol=_ABS_TOL)
    return a == b
