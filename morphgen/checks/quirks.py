"""Deviations of loaders: how they read the URDFs of others otherwise, and what they refuse.

Each deviation has a change of the file with which it can be tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from lxml import etree

from morphgen.checks.rules import PYBULLET_LINKS
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS
from morphgen.model.geometry import Pose
from morphgen.typing import Array

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
Change = Callable[[etree._Element, Path], None]
"""Function of the root of a URDF, which it changes to what a loader reads, and of the file."""


@dataclass(frozen=True)
class Quirk:
    """How a loader reads a URDF otherwise than morphgen."""

    words: str  # description of the deviation
    change: Change  # changes a URDF so that morphgen reads it as the loader does


@dataclass(frozen=True)
class Refusal(Quirk):
    """A reason why a loader refuses a URDF; ``change`` takes it out of the file."""

    pattern: str  # regular expression of the loader's message


def _add_inertia(root: etree._Element, urdf: Path) -> None:
    for link in root.iterfind("link"):
        if link.find("inertial") is None and link.get("name") != "world":
            _set_inertial(link, 1.0, np.eye(3))


def _add_solids(root: etree._Element, urdf: Path) -> None:
    """Give links without inertia the one that MuJoCo makes of their shapes."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(urdf))
    spec.compiler.fusestatic = False
    spec.compiler.boundmass, spec.compiler.boundinertia = BOUND_MASS, BOUND_INERTIA
    model = spec.compile()
    for link in root.iterfind("link"):
        if link.find("inertial") is None and link.find("collision") is not None:
            body = model.body(link.get("name", ""))
            w, x, y, z = body.iquat.tolist()
            R = Pose(quaternion=(w, x, y, z)).matrix[:3, :3]
            inertia = R @ np.diag(body.inertia) @ R.T
            _set_inertial(link, float(body.mass[0]), inertia, body.ipos.tolist())


def _set_inertial(
    link: etree._Element, mass: float, inertia: Array, com: Sequence[float] = (0, 0, 0)
) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    element = etree.SubElement(link, "inertial")
    etree.SubElement(element, "origin", xyz=" ".join(map(repr, com)))
    etree.SubElement(element, "mass", value=repr(mass))
    values = inertia[np.triu_indices(3)].tolist()
    etree.SubElement(element, "inertia", dict(zip(_INERTIA, map(repr, values), strict=True)))


def _drop_quaternions(root: etree._Element, urdf: Path) -> None:
    for origin in root.iter("origin"):
        origin.attrib.pop("quat_xyzw", "")


def _empty_base(root: etree._Element, urdf: Path) -> None:
    """Remove the inertia of the root and of the links that are fixed to it."""
    parents = {}
    for joint in root.iterfind("joint"):
        parent, child = (joint.find(end) for end in ("parent", "child"))
        if joint.get("type") == "fixed" and parent is not None and child is not None:
            parents[child.get("link")] = parent.get("link")
        elif child is not None:
            parents[child.get("link")] = None
    for link in root.iterfind("link"):
        name = link.get("name")
        while name is not None and name in parents:
            name = parents[name]
        if name is not None:
            for inertial in link.findall("inertial"):
                link.remove(inertial)


def _count_massless(root: etree._Element, urdf: Path) -> None:
    for mass in root.iterfind("link/inertial/mass"):
        if float(mass.get("value") or 0) == 0:
            mass.set("value", repr(BOUND_MASS))


def _set_inertias(
    root: etree._Element, urdf: Path, is_wrong: Callable[[float, float, float], bool], moment: str
) -> None:
    """Set the moments of inertia that are wrong; they are tested in ascending order."""
    for inertia in root.iterfind("link/inertial/inertia"):
        xx, xy, xz, yy, yz, zz = (float(inertia.get(name) or 0) for name in _INERTIA)
        a, b, c = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
        if is_wrong(a, b, c):
            for name in _INERTIA:
                # The names of the diagonal are ixx, iyy and izz.
                inertia.set(name, moment if name[1] == name[2] else "0")


def _limit_continuous(root: etree._Element, urdf: Path) -> None:
    for joint in root.iterfind("joint[@type='continuous']"):
        limit = joint.find("limit")
        if limit is not None and {"lower", "upper"} & set(limit.attrib):
            joint.set("type", "revolute")


def _zero_ranges(root: etree._Element, urdf: Path) -> None:
    for limit in root.iterfind("joint/limit"):
        if not {"lower", "upper"} & set(limit.attrib):
            limit.set("lower", "0")
            limit.set("upper", "0")


def _open_ranges(root: etree._Element, urdf: Path, is_open: Callable[[float, float], bool]) -> None:
    for limit in root.iterfind("joint/limit"):
        if is_open(*(float(limit.get(name) or 0) for name in ("lower", "upper"))):
            for name in ("lower", "upper"):
                limit.attrib.pop(name, "")


def _hold_lost_followers(root: etree._Element, urdf: Path) -> None:
    """Let joints that mimic a missing one follow a fixed one, and so stay."""
    joints = {joint.get("name"): joint.get("type") for joint in root.iterfind("joint")}
    fixed = next((name for name, kind in joints.items() if kind == "fixed"), None)
    for mimic in root.iterfind("joint/mimic"):
        if mimic.get("joint") not in joints and fixed is not None:
            mimic.set("joint", fixed)


def _add_mass(root: etree._Element, urdf: Path) -> None:
    """Give mass and inertia to links that have none."""
    for link in root.iterfind("link"):
        mass = link.find("inertial/mass")
        if mass is None or float(mass.get("value") or 0) <= MIN_VALUE:
            _set_inertial(link, 1.0, np.eye(3))
    _set_inertias(root, urdf, lambda a, b, c: c <= MIN_VALUE, "1")


def _add_missing_inertia(root: etree._Element, urdf: Path) -> None:
    for inertial in root.iterfind("link/inertial"):
        if inertial.find("inertia") is None:
            etree.SubElement(
                inertial, "inertia", ixx="1", ixy="0", ixz="0", iyy="1", iyz="0", izz="1"
            )


def _take_first(root: etree._Element, urdf: Path) -> None:
    """Remove elements that follow one of the same name where there may be one."""
    for parent in (*root.iterfind("joint"), *root.iterfind("link/*")):
        for name in {str(child.tag) for child in parent}:
            for surplus in parent.findall(name)[1:]:
                parent.remove(surplus)


def _shorten_scales(root: etree._Element, urdf: Path) -> None:
    for mesh in root.iter("mesh"):
        mesh.set("scale", " ".join(mesh.get("scale", "1 1 1").split()[:3]))


def _thicken(root: etree._Element, urdf: Path) -> None:
    """Give every dimension of zero a millimetre."""
    for shape in root.iterfind("link/*/geometry/*"):
        for name in {"size", "radius", "length"} & set(shape.attrib):
            sizes = [size if float(size) else "0.001" for size in shape.get(name, "").split()]
            shape.set(name, " ".join(sizes))


def _drop_links(root: etree._Element, urdf: Path) -> None:
    """Remove links that are fixed to others and carry none, until 127 are left below the root."""
    links = {link.get("name"): link for link in root.iterfind("link")}
    for joint in reversed(root.findall("joint[@type='fixed']")):
        parents = {parent.get("link") for parent in root.iterfind("joint/parent")}
        child = joint.find("child")
        name = None if child is None else child.get("link")
        if len(root.findall("link")) > PYBULLET_LINKS + 1 and name not in parents and name in links:
            root.remove(joint)
            root.remove(links[name])


def _drop_lost_mimics(root: etree._Element, urdf: Path) -> None:
    joints = {joint.get("name") for joint in root.iterfind("joint")}
    for joint in root.iterfind("joint"):
        for mimic in joint.findall("mimic"):
            if mimic.get("joint") not in joints:
                joint.remove(mimic)


_ZERO_IMPOSSIBLE = partial(_set_inertias, is_wrong=lambda a, b, c: a < 0 or c > a + b, moment="0")
NO_QUATERNIONS = Quirk("reads no quat_xyzw", _drop_quaternions)
COUNT_MASSLESS = Quirk("counts the inertia of links without mass", _count_massless)
NO_WRONG_RANGES = Quirk(
    "reads a range in the wrong order as none",
    partial(_open_ranges, is_open=lambda lower, upper: lower > upper),
)
ZERO_RANGES = Quirk("reads a range that is missing as 0 to 0", _zero_ranges)
YOURDFPY_QUIRKS = (
    NO_QUATERNIONS,
    Quirk("holds joints that mimic a missing one", _hold_lost_followers),
)
PYBULLET_QUIRKS = (
    NO_QUATERNIONS,
    COUNT_MASSLESS,
    Quirk("gives links without inertia 1 kg and 1 kg m^2", _add_inertia),
    Quirk("sets inertia that no body has to zero", _ZERO_IMPOSSIBLE),
    Quirk("limits continuous joints that name a range", _limit_continuous),
    NO_WRONG_RANGES,
)
MUJOCO_QUIRKS = (
    NO_QUATERNIONS,
    Quirk("gives links without inertia that of their shapes, of 1000 kg/m^3", _add_solids),
    Quirk("joins the base to the world, without its mass", _empty_base),
    NO_WRONG_RANGES,
    Quirk(
        "reads a range of 0 to 0 as none",
        partial(_open_ranges, is_open=lambda lower, upper: lower == upper == 0),
    ),
)
PINOCCHIO_QUIRKS = (COUNT_MASSLESS, ZERO_RANGES)
USD_QUIRKS = (NO_QUATERNIONS, ZERO_RANGES)

MIN_VALUE = 1e-14
"""Largest mass and moment of inertia that MuJoCo 4.0 takes for zero [kg or kg m^2]."""
REFUSALS = (
    Refusal(
        "refuses moving links without mass or inertia",
        _add_mass,
        "mass and inertia of moving bodies",
    ),
    Refusal(
        "refuses inertia that no body has",
        # Rounding may have passed a + b = c already.
        partial(_set_inertias, is_wrong=lambda a, b, c: a + b <= c * (1 + 1e-9), moment="1"),
        r"A \+ B >= C",
    ),
    Refusal(
        "refuses inertia that is not positive",
        partial(_set_inertias, is_wrong=lambda a, b, c: a <= MIN_VALUE, moment="1"),
        "must have positive eigenvalues",
    ),
    Refusal(
        "refuses <inertial> without <inertia>",
        _add_missing_inertia,
        "missing element: 'inertia'|Cannot load URDF file",
    ),
    Refusal("refuses a repeated element", _take_first, "repeated element"),
    Refusal(
        "refuses a mesh scale of more than three numbers",
        _shorten_scales,
        "'scale' has too much data|mesh: scale: .* but 3 expected",
    ),
    Refusal("refuses shapes without a size", _thicken, r"size \d must be positive"),
    Refusal(
        f"fails on robots with more than {PYBULLET_LINKS} links",
        _drop_links,
        "Cannot load URDF file|getLinkState failed",
    ),
    Refusal(
        "refuses a joint that mimics a missing one",
        _drop_lost_mimics,
        "Mimic joint '.*' not found",
    ),
)
"""Causes of refusals; each is one only if the loader reads the file without it."""
