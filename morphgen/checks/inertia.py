"""Checks of mass properties: missing, impossible, or inconsistent with the geometry."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from morphgen.checks.loaders import unit_density_inertial
from morphgen.model.findings import Finding, Severity
from morphgen.model.inertia import bounding_box
from morphgen.model.robot import Inertial, Link, Robot
from morphgen.model.tree import RigidGroup, rigid_groups
from morphgen.typing import Array

DEFAULT_DENSITY = 1000.0  # density of a link whose source gives no mass [kg/m^3]; that of water
GYRATION_FACTOR = 5.0
"""Largest plausible ratio between radii of gyration and those of the solid geometry."""
COM_MARGIN = 0.5
"""Distance of the centre of mass from the bounding box that is still plausible, as a fraction of
half the size of the box."""
DENSITY_RANGE = (20.0, 25_000.0)
"""Plausible mean densities, from foam to more than tungsten [kg/m^3]."""
TRIANGLE_MARGIN = 1e-12
"""Relative margin of the triangle inequality, because MuJoCo refuses values at the limit after
rounding."""


def check_masses(robot: Robot) -> Iterator[Finding]:
    """Find moving links without mass, and links whose mass is invalid."""
    for group in rigid_groups(robot):
        if not group.is_root:
            yield from _group_findings(group)
    for link in robot.links:
        where = f"link {link.name}"
        if link.inertial is not None and not is_mass_valid(link.inertial):
            why = f"mass {link.inertial.mass:g} kg with its centre at {link.inertial.com}"
            solid = f"the solid geometry's at {DEFAULT_DENSITY:g} kg/m^3"
            fix = f"write a finite mass of at least 0; the repair takes {solid}"
            yield Finding("mass-invalid", "error", where, why, fix, _solid_repair(link))
        if is_inertia_without_mass(link):
            why = "it has a rotational inertia but no mass"
            fix = "give it a mass, or set its inertia to zero as the repair does"
            repair = "its inertia was set to zero: it has no mass"
            yield Finding("inertia-without-mass", "warning", where, why, fix, repair)


def check_inertia(robot: Robot) -> Iterator[Finding]:
    """Compare the mass properties of every link with physics and with its geometry."""
    for link in robot.links:
        inertial = link.inertial
        if inertial is None or not is_mass_valid(inertial) or inertial.mass == 0:
            continue
        solid = unit_density_inertial(link)
        fault = inertia_fault(inertial)
        if fault is not None:
            fix = (
                "correct the inertia; the repair takes, at the same mass, the solid geometry's or, "
                f"without any, that of a ball of {DEFAULT_DENSITY:g} kg/m^3"
            )
            body = "a ball" if solid is None else "its solid geometry"
            repair = f"its inertia was set to that of {body} at the same mass, {inertial.mass:g} kg"
            why = f"{fault}; MuJoCo refuses it, PyBullet takes zero"
            where = f"link {link.name}"
            yield Finding("inertia-not-physical", "error", where, why, fix, repair)
        if solid is not None:
            if fault is None:
                yield from _gyration_findings(link, inertial, solid)
            yield from _placement_findings(link, inertial, solid)


def is_mass_valid(inertial: Inertial) -> bool:
    """Return whether mass and centre of mass are finite, and the mass is not negative."""
    return (
        math.isfinite(inertial.mass)
        and inertial.mass >= 0
        and all(map(math.isfinite, inertial.com))
    )


def _solid_repair(link: Link) -> str:
    """Return the repair of a link that gets the mass of its shapes; none without a volume."""
    of_solid = f"those of its solid geometry at {DEFAULT_DENSITY:g} kg/m^3"
    is_possible = unit_density_inertial(link) is not None
    return f"its mass and inertia were set to {of_solid}" if is_possible else ""


def is_inertia_without_mass(link: Link) -> bool:
    """Return whether a link without mass and shapes has an inertia."""
    return link.is_empty and link.inertial is not None and any(link.inertial.inertia)


def lacks_mass(link: Link) -> bool:
    """Return whether a link has shapes but no mass."""
    return not link.is_empty and (link.inertial is None or link.inertial.mass == 0)


def inertia_fault(inertial: Inertial) -> str | None:
    """Return why no rigid body with positive mass can have this inertia; None if it is possible.

    The principal moments must be positive and each smaller than the sum of the other two, which it
    equals only for bodies without thickness.
    """
    if not np.isfinite(inertial.matrix).all():
        return f"inertia {inertial.inertia} is not finite"
    low, middle, high = np.linalg.eigvalsh(inertial.matrix).tolist()
    moments = f"principal moments {low:.4g}, {middle:.4g}, {high:.4g} kg m^2"
    if low <= 0:
        return f"{moments} are not all positive"
    if low + middle <= high * (1 + TRIANGLE_MARGIN):
        return f"{moments}: the largest is no less than the sum of the others"
    return None


def _group_findings(group: RigidGroup) -> Iterator[Finding]:
    missing = [link for link in group.links if lacks_mass(link)]
    for link in missing:
        if group.mass > 0:
            why = (
                "it has geometry but no mass, on a body that has (PyBullet takes 1 kg where "
                "<inertial> is missing; a bundle writes zero)"
            )
        else:
            why = (
                "it moves, has geometry and no mass: MuJoCo refuses that, PyBullet takes 1 kg "
                "where <inertial> is missing and cannot move it where the mass is zero"
            )
        severity: Severity = "info" if group.mass > 0 else "error"
        of_solid = f"those of its solid geometry at {DEFAULT_DENSITY:g} kg/m^3"
        fix = f"give it mass and inertia; the repair takes {of_solid}"
        where = f"link {link.name}"
        yield Finding("inertia-missing", severity, where, why, fix, _solid_repair(link))
    if group.mass > 0 or any(not link.is_empty for link in group.links):
        return
    where = f"link {group.links[0].name}"
    if group.mass_beyond > 0:
        why = "it moves and has no mass: MuJoCo refuses that without boundmass, which a bundle sets"
        yield Finding("massless-between", "info", where, why, "give it a small mass")
    else:
        why = "it moves, and neither it nor anything beyond it has mass: simulators cannot move it"
        fix = "give it geometry and mass, or make its joint fixed"
        yield Finding("massless-body", "error", where, why, fix)


def _gyration_findings(link: Link, inertial: Inertial, solid: Inertial) -> Iterator[Finding]:
    radii, expected = _gyration_radii(inertial), _gyration_radii(solid)
    ratio = radii / expected
    if ratio.max() <= GYRATION_FACTOR and ratio.min() >= 1 / GYRATION_FACTOR:
        return
    own, of_solid = (", ".join(f"{1000 * r:.3g}" for r in each) for each in (radii, expected))
    why = f"radii of gyration {own} mm; its solid geometry has {of_solid} mm"
    fix = "compute the inertia from the geometry, or check its unit"
    yield Finding("inertia-implausible", "warning", f"link {link.name}", why, fix)


def _placement_findings(link: Link, inertial: Inertial, solid: Inertial) -> Iterator[Finding]:
    where = f"link {link.name}"
    low, high = bounding_box(link.collisions or link.visuals)
    margin = COM_MARGIN * (high - low) / 2
    if np.any(inertial.com < low - margin) or np.any(inertial.com > high + margin):
        x, y, z = inertial.com
        corners = " to ".join(f"({', '.join(f'{v:.3g}' for v in each)})" for each in (low, high))
        why = (
            f"its centre of mass ({x:.4g}, {y:.4g}, {z:.4g}) m lies outside its geometry "
            f"({corners} m)"
        )
        yield Finding("com-outside", "warning", where, why, "check the origin of <inertial>")
    density = inertial.mass / solid.mass
    if not DENSITY_RANGE[0] <= density <= DENSITY_RANGE[1]:
        why = f"{inertial.mass:.4g} kg in {solid.mass * 1e6:.4g} cm^3 are {density:.4g} kg/m^3"
        lowest, highest = DENSITY_RANGE
        fix = f"check mass and geometry; {lowest:g} to {highest:g} is plausible"
        yield Finding("density-implausible", "warning", where, why, fix)


def _gyration_radii(inertial: Inertial) -> Array:
    """Return the principal radii of gyration about the centre of mass, ascending, (3,) [m]."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(inertial.matrix) / inertial.mass))


CHECKS = (check_masses, check_inertia)
