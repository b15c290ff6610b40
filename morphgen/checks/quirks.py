"""Deviations of loaders: how they read the URDFs of others otherwise, and what they refuse.

Each deviation has a change of the file with which it can be tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    """How loaders read a URDF otherwise than morphgen, or what they refuse in it."""

    words: str  # description of the deviation
    change: Change
    """Changes a URDF so that morphgen reads it as the loaders do, or so that they read it."""
    loaders: tuple[str, ...] = ()  # names of the loaders that read so
    refusal: str = ""  # regular expression of the message with which a loader refuses the file


QUIRKS: list[Quirk] = []
"""All deviations of loaders from the URDF specification, in the order in which they are applied."""


def _quirk(words: str, *loaders: str, refusal: str = "") -> Callable[[Change], Change]:
    """Make a change of a URDF the test of a quirk."""

    def register(change: Change) -> Change:
        QUIRKS.append(Quirk(words, change, loaders, refusal))
        return change

    return register


@_quirk("reads no quat_xyzw", "yourdfpy", "pybullet", "mujoco (urdf)", "usd")
def _drop_quaternions(root: etree._Element, urdf: Path) -> None:
    for origin in root.iter("origin"):
        origin.attrib.pop("quat_xyzw", "")


@_quirk("counts the inertia of links without mass", "pybullet", "pinocchio")
def _count_massless(root: etree._Element, urdf: Path) -> None:
    for mass in root.iterfind("link/inertial/mass"):
        if float(mass.get("value") or 0) == 0:
            mass.set("value", repr(BOUND_MASS))


@_quirk("gives links without inertia 1 kg and 1 kg m^2", "pybullet")
def _add_inertia(root: etree._Element, urdf: Path) -> None:
    for link in root.iterfind("link"):
        if link.find("inertial") is None and link.get("name") != "world":
            _set_inertial(link, 1.0, np.eye(3))


@_quirk("gives links without inertia that of their shapes, of 1000 kg/m^3", "mujoco (urdf)")
def _add_solids(root: etree._Element, urdf: Path) -> None:
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


@_quirk("joins the base to the world, without its mass", "mujoco (urdf)")
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


def _set_inertias(
    root: etree._Element, is_wrong: Callable[[float, float, float], bool], moment: str
) -> None:
    """Set the moments of inertia that are wrong; they are tested in ascending order."""
    for inertia in root.iterfind("link/inertial/inertia"):
        xx, xy, xz, yy, yz, zz = (float(inertia.get(name) or 0) for name in _INERTIA)
        a, b, c = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
        if is_wrong(a, b, c):
            for name in _INERTIA:
                # The names of the diagonal are ixx, iyy and izz.
                inertia.set(name, moment if name[1] == name[2] else "0")


@_quirk("sets inertia that no body has to zero", "pybullet")
def _zero_impossible(root: etree._Element, urdf: Path) -> None:
    _set_inertias(root, lambda a, b, c: a < 0 or c > a + b, "0")


@_quirk("limits continuous joints that name a range", "pybullet")
def _limit_continuous(root: etree._Element, urdf: Path) -> None:
    for joint in root.iterfind("joint[@type='continuous']"):
        limit = joint.find("limit")
        if limit is not None and {"lower", "upper"} & set(limit.attrib):
            joint.set("type", "revolute")


def _open_ranges(root: etree._Element, is_open: Callable[[float, float], bool]) -> None:
    for limit in root.iterfind("joint/limit"):
        if is_open(*(float(limit.get(name) or 0) for name in ("lower", "upper"))):
            for name in ("lower", "upper"):
                limit.attrib.pop(name, "")


@_quirk("reads a range in the wrong order as none", "pybullet", "mujoco (urdf)")
def _open_inverted(root: etree._Element, urdf: Path) -> None:
    _open_ranges(root, lambda lower, upper: lower > upper)


@_quirk("reads a range of 0 to 0 as none", "mujoco (urdf)")
def _open_empty(root: etree._Element, urdf: Path) -> None:
    _open_ranges(root, lambda lower, upper: lower == upper == 0)


@_quirk("reads a range that is missing as 0 to 0", "pinocchio", "usd")
def _zero_ranges(root: etree._Element, urdf: Path) -> None:
    for limit in root.iterfind("joint/limit"):
        if not {"lower", "upper"} & set(limit.attrib):
            limit.set("lower", "0")
            limit.set("upper", "0")


@_quirk("holds joints that mimic a missing one", "yourdfpy")
def _hold_lost_followers(root: etree._Element, urdf: Path) -> None:
    """Let joints that mimic a missing one follow a fixed one, and so stay."""
    joints = {joint.get("name"): joint.get("type") for joint in root.iterfind("joint")}
    fixed = next((name for name, kind in joints.items() if kind == "fixed"), None)
    for mimic in root.iterfind("joint/mimic"):
        if mimic.get("joint") not in joints and fixed is not None:
            mimic.set("joint", fixed)


MIN_VALUE = 1e-14
"""Largest mass and moment of inertia that MuJoCo 4.0 takes for zero [kg or kg m^2]."""


@_quirk("refuses moving links without mass or inertia", refusal="mass and inertia of moving bodies")
def _add_mass(root: etree._Element, urdf: Path) -> None:
    for link in root.iterfind("link"):
        mass = link.find("inertial/mass")
        if mass is None or float(mass.get("value") or 0) <= MIN_VALUE:
            _set_inertial(link, 1.0, np.eye(3))
    _set_inertias(root, lambda a, b, c: c <= MIN_VALUE, "1")


@_quirk("refuses inertia that no body has", refusal=r"A \+ B >= C")
def _correct_impossible(root: etree._Element, urdf: Path) -> None:
    # Rounding may have passed a + b = c already.
    _set_inertias(root, lambda a, b, c: a + b <= c * (1 + 1e-9), "1")


@_quirk("refuses inertia that is not positive", refusal="must have positive eigenvalues")
def _correct_negative(root: etree._Element, urdf: Path) -> None:
    _set_inertias(root, lambda a, b, c: a <= MIN_VALUE, "1")


@_quirk(
    "refuses <inertial> without <inertia>",
    refusal="missing element: 'inertia'|Cannot load URDF file",
)
def _add_missing_inertia(root: etree._Element, urdf: Path) -> None:
    for inertial in root.iterfind("link/inertial"):
        if inertial.find("inertia") is None:
            etree.SubElement(inertial, "inertia", dict(zip(_INERTIA, "100101", strict=True)))


@_quirk("refuses a repeated element", refusal="repeated element")
def _take_first(root: etree._Element, urdf: Path) -> None:
    """Remove elements that follow one of the same name where there may be one."""
    for parent in (*root.iterfind("joint"), *root.iterfind("link/*")):
        for name in {str(child.tag) for child in parent}:
            for surplus in parent.findall(name)[1:]:
                parent.remove(surplus)


@_quirk(
    "refuses a mesh scale of more than three numbers",
    refusal="'scale' has too much data|mesh: scale: .* but 3 expected",
)
def _shorten_scales(root: etree._Element, urdf: Path) -> None:
    for mesh in root.iter("mesh"):
        mesh.set("scale", " ".join(mesh.get("scale", "1 1 1").split()[:3]))


@_quirk("refuses shapes without a size", refusal=r"size \d must be positive")
def _thicken(root: etree._Element, urdf: Path) -> None:
    """Give every dimension of zero a millimetre."""
    for shape in root.iterfind("link/*/geometry/*"):
        for name in {"size", "radius", "length"} & set(shape.attrib):
            sizes = [size if float(size) else "0.001" for size in shape.get(name, "").split()]
            shape.set(name, " ".join(sizes))


@_quirk(
    f"fails on robots with more than {PYBULLET_LINKS} links",
    refusal="Cannot load URDF file|getLinkState failed",
)
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


@_quirk("refuses a joint that mimics a missing one", refusal="Mimic joint '.*' not found")
def _drop_lost_mimics(root: etree._Element, urdf: Path) -> None:
    joints = {joint.get("name") for joint in root.iterfind("joint")}
    for joint in root.iterfind("joint"):
        for mimic in joint.findall("mimic"):
            if mimic.get("joint") not in joints:
                joint.remove(mimic)


REFUSALS = [quirk for quirk in QUIRKS if quirk.refusal]
"""Causes of refusals; each is one only if the loader reads the file without it."""
