"""Grammars that tests write as text, and what the benchmark's categories must have."""

import math

from morphgen.grammar.grammar_file import (
    find_grammar,
    grammar_from_text,
    grammar_names,
    load_grammar,
)
from morphgen.grammar.library import default_library

LIBRARY = default_library()
CATEGORIES = grammar_names()


def grammar(*lines, name="g"):
    """Parse a grammar from text lines."""
    return grammar_from_text("\n".join(lines) + "\n", name)


def shipped(name):
    """Return a built-in grammar."""
    return load_grammar(find_grammar(name))


def benchmark_counts(category, derivation):
    """Return the numbers of links and movable joints; those of the benchmark for its categories."""
    nodes = list(derivation.walk())
    parts = [node.part for node in nodes]
    values = {node.part: dict(node.parameters) for node in nodes}
    beams, beads = parts.count("beam"), parts.count("bead")
    match category:
        case "nlink":
            return beams + 2, beams
        case "chain":
            return 3 * beads + 4, 2 * beads + 3
        case "serial":
            tubes = parts.count("tube")
            return 2 * tubes + 2, tubes
        case "planar_arm":
            return (beams + 4, beams + 2) if "jaw" in parts else (beams + 5, beams + 4)
        case "tongs":
            return (12, 9) if values["tongs"]["hinges"] == 2 else (10, 7)
        case "multi_finger":
            hand = values["hand"]
            phalanges = int(hand["fingers"] * hand["phalanges"])
            still = int(hand["fingers"] * (1 - hand["knuckles"]))
            if "arm3" in parts:
                return 6 + phalanges, 4 + phalanges
            return 4 + phalanges, 3 + phalanges - still
        case _:
            return FIXED_COUNTS[category]


FIXED_COUNTS = {
    "arm3": (10, 9),
    "arm5": (23, 8),
    "arm_ed": (19, 8),
    "cartpole": (3, 2),
    "cubes": (3, 2),
    "panda_variations": (11, 9),
    "prims": (7, 5),
    "stick": (5, 3),
}
"""Links and movable joints of categories whose robots all have the same."""


def unphysical(robot):
    """Return one line per link or joint with impossible physical values."""
    faults = []
    for link in robot.links:
        if link.inertial is None:
            continue
        xx, _, _, yy, _, zz = link.inertial.inertia
        moments = sorted((xx, yy, zz))
        if not (link.inertial.mass > 0 and math.isfinite(link.inertial.mass)):
            faults.append(f"{link.name}: mass {link.inertial.mass}")
        if not (moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - 1e-9)):
            faults.append(f"{link.name}: inertia {moments}")
    for joint in robot.joints:
        if joint.limits is not None and not joint.limits[0] < joint.limits[1]:
            faults.append(f"{joint.name}: limits {joint.limits}")
    for k, q in zip(robot.independent_joints, robot.home, strict=True):
        low, high = robot.joints[k].limits or (-math.inf, math.inf)
        if not low <= q <= high:
            faults.append(f"{robot.joints[k].name}: home {q} outside of {low}, {high}")
    return faults
