"""``morphgen compose``, ``list`` and ``show``: make robots and print their facts."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, option
from morphgen.cli.progress import bar, status
from morphgen.errors import CompositionError

if TYPE_CHECKING:
    from morphgen.model.robot import Joint, Robot

PART_KINDS = {"bases": "base", "arms": "arm", "ees": "ee", "segments": "segment", "bodies": "body"}


@command(
    "compose",
    "join a base, arms and end-effectors into a robot",
    option(
        "words",
        nargs="+",
        metavar="[GRAMMAR] KEY=VALUE",
        help="arm=ur5, ee=plane, ee.size=0.1, left.arm=panda, ee.mount_yaw=45deg ...",
    ),
    option(
        "--geometry",
        choices=["mesh", "primitive", "convex", "sphere"],
        default="mesh",
        help="collision shapes: meshes of real parts; in their place fitted boxes, cylinders and "
        "spheres, or convex pieces by CoACD, which takes minutes once for each part; or 8 spheres "
        "for each link",
    ),
    *opt.BUNDLE_OUT,
    *opt.LIBRARY_JSON,
    details="The bundle is a folder with the robot as URDF and MJCF. If the first word is a "
    "grammar (see: morphgen grammar list), the robot follows its first alternatives and typical "
    "values, except for those that KEY=VALUE sets.",
    examples=("compose arm=ur5 ee=plane ee.size=80mm --out robots/", "compose chain beads=5"),
)
def compose(args: argparse.Namespace) -> int:
    """Compose a robot, check it and write its bundle."""
    from morphgen.grammar.compose import compose
    from morphgen.grammar.request import parse_words

    library = opt.library_of(args)
    with status(args, "composing"):
        derivation, name = parse_words(args.words, library)
        robot = compose(derivation, library, name if args.name is None else args.name)
    if args.geometry != "mesh":
        from morphgen.fitting.collision_geometry import with_geometry

        with bar(args, "replacing collision meshes", "shape") as shown:
            robot = with_geometry(robot, args.geometry, library.folders, progress=shown)
    return write_and_report(robot, args)


def write_and_report(robot: Robot, args: argparse.Namespace) -> int:
    """Write ``args.out / robot.name`` and print a summary.

    Returns:
        1 if the checks find an error in the robot, as ``morphgen check`` does, else 0.
    """
    written = write_checked(robot, args)
    opt.print_result(args, written.data, lambda: written.text)
    return written.code


@dataclass(frozen=True)
class WrittenBundle:
    """Summary of a bundle that was written, as JSON and as text, with the exit code."""

    data: dict[str, object]
    """Folder and card of the bundle, printed with ``--json``."""
    text: str
    """Folder, sizes, repairs, findings and files of the bundle, in lines."""
    code: int
    """1 if the checks find an error in the robot, as ``morphgen check`` does, else 0."""


def write_checked(robot: Robot, args: argparse.Namespace) -> WrittenBundle:
    """Check a robot, write ``args.out / robot.name``, and return what to print."""
    from morphgen.checks import check
    from morphgen.formats.bundle import CARD, bundle_folder, write_bundle
    from morphgen.formats.data_files import read_json

    folder = bundle_folder(args.out, robot.name)
    with status(args, f"checking and writing {folder}"):
        findings = check(robot)
        write_bundle(robot, folder, findings, picture=not args.no_picture)

    lines = [
        f"{folder}: {len(robot.links)} links, {robot.dof} DoF, {robot.mass:.3g} kg, "
        f"{len(robot.ignore_pairs)} pairs ignored for self-collision"
    ]
    repairs = robot.provenance.get("repairs", ())
    lines += [f"  repaired {repair}" for repair in repairs]  # type: ignore[attr-defined]
    lines += [
        f"  {finding.severity} {finding.code} at {finding.where}: {finding.why}"
        for finding in findings
        if finding.severity != "info"
    ]
    files = sorted(folder.iterdir())
    lines += [f"  {path.name}{'/' if path.is_dir() else ''}" for path in files]
    return WrittenBundle(
        {"folder": str(folder), "card": read_json(folder / CARD)},
        "\n".join(lines),
        int(any(finding.severity == "error" for finding in findings)),
    )


@command(
    "list",
    "list the parts that morphgen compose joins",
    option("kind", nargs="?", choices=list(PART_KINDS), help="list only this kind"),
    *opt.LIBRARY_JSON,
    details="The columns are degrees of freedom, reach (m), mass (kg), source, licence "
    "and manufacturer of the real product.",
    examples=("list arms",),
)
def list_parts(args: argparse.Namespace) -> None:
    """Print a table with a row per part."""
    from tabulate import tabulate

    from morphgen.grammar.catalogue import catalogue

    with status(args, "reading the parts"):
        rows = catalogue(opt.library_of(args), PART_KINDS.get(args.kind))
    opt.print_result(args, rows, lambda: tabulate(rows, headers="keys", floatfmt=".3g"))


@command(
    "show",
    "print the link tree of a robot with joints, limits, masses and frames",
    opt.ROBOT,
    *opt.ROOT_LIBRARY_JSON,
    examples=("show ur5-plane", "show my_arm.urdf"),
)
def show(args: argparse.Namespace) -> None:
    """Print the link tree of one robot."""
    from morphgen.grammar.robot_source import read_source

    sources = opt.sources_of(args)
    if len(sources) > 1:
        raise CompositionError(
            f"{' '.join(args.words)}: {len(sources)} robots; name one, such as {sources[0].label}"
        )
    with status(args, f"reading {sources[0].label}"):
        robot = read_source(sources[0], opt.library_of(args), args.root)
    opt.print_result(args, _facts(robot), lambda: _tree(robot))


def _tree(robot: Robot) -> str:
    lines = [f"{robot.name}: {len(robot.links)} links, {robot.dof} DoF, {robot.mass:.4g} kg"]
    depth = [0] * len(robot.links)
    for i, link in enumerate(robot.links):
        words = [link.name]
        if i:
            depth[i] = depth[robot.parents[i]] + 1
            words.append(_joint_text(robot.joints[i - 1]))
        if link.inertial is not None and link.inertial.mass:
            words.append(f"{link.inertial.mass:.4g} kg")
        words += [f"<{frame.name}>" for frame in robot.frames if frame.link == link.name]
        lines.append("  " * depth[i] + "  ".join(words))
    return "\n".join(lines)


def _joint_text(joint: Joint) -> str:
    if joint.kind == "fixed":
        return "fixed"
    axis = " ".join(f"{value:g}" for value in joint.axis)
    text = f"{joint.name}: {joint.kind} ({axis})"
    if joint.limits is not None:
        unit, factor = ("m", 1.0) if joint.kind == "prismatic" else ("deg", math.degrees(1))
        low, high = (factor * limit for limit in joint.limits)
        text += f" [{low:.4g}, {high:.4g}] {unit}"
    if joint.mimic is not None:
        text += f" = {joint.mimic.multiplier:g} * {joint.mimic.joint} + {joint.mimic.offset:g}"
    return text


def _facts(robot: Robot) -> dict[str, object]:
    parents = ["", *(joint.parent for joint in robot.joints)]
    columns = ("name", "kind", "parent", "child", "axis", "limits", "effort", "velocity")
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
            {name: getattr(joint, name) for name in columns}
            | {"mimic": joint.mimic.joint if joint.mimic else None}
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
