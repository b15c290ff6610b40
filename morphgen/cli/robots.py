"""``morphgen compose``, ``show`` and ``import``: make robots and print their facts."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from morphgen.checks import check
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, status
from morphgen.errors import FormatError
from morphgen.formats.bundle import CARD, URDF, bundle_folder, find_description, write_bundle
from morphgen.formats.data_files import read_json
from morphgen.grammar.compose import compose as compose_parts
from morphgen.grammar.part import part_manifest, write_part
from morphgen.grammar.request import parse_words
from morphgen.model.robot import Joint, Robot

RECORDING = "recording.json"
"""File that every folder of demonstrations has, see ``morphgen.rl.demonstrations``."""
_PARTS = Path("parts")  # folder of the manifests that `morphgen import --part` writes by default


def compose(args: argparse.Namespace) -> int:
    """Compose a robot, check it and write its bundle."""
    library = opt.library_of(args)
    with status(args, "composing"):
        derivation, name = parse_words(args.words, library)
        robot = compose_parts(derivation, library, name if args.name is None else args.name)
    if args.geometry != "mesh":
        from morphgen.fitting.replace_collision import with_geometry

        with bar(args, "replacing collision meshes", "shape"):
            robot = with_geometry(robot, args.geometry, library.folders)
    data, text, code = write_checked(robot, args)
    opt.print_result(args, data, lambda: text)
    return code


Written: TypeAlias = tuple[dict[str, object], str, int]
"""Summary of a bundle that was written, as JSON and as text, and the exit code."""


def write_checked(robot: Robot, args: argparse.Namespace) -> Written:
    """Check a robot, write ``args.out / robot.name``, and return text and code of ``check``."""
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
    lines += [f"  {opt.finding_line(each)}" for each in findings if each.severity != "info"]
    files = sorted(folder.iterdir())
    lines += [f"  {path.name}{'/' if path.is_dir() else ''}" for path in files]
    data = {"folder": str(folder), "card": read_json(folder / CARD)}
    return data, "\n".join(lines), int(any(each.severity == "error" for each in findings))


def show(args: argparse.Namespace) -> None:
    """Print the link tree of one robot, or what a data set of demonstrations has."""
    if len(args.words) == 1 and (Path(args.words[0]) / RECORDING).is_file():
        from morphgen.api.demonstrations import demos
        from morphgen.cli.evaluate import print_summary

        print_summary(args, demos(args.words[0]))
        return
    _, robot = opt.read_one_robot(args)
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


def import_robot(args: argparse.Namespace) -> int:
    """Import a description, check it, and write its bundle and, if asked for, its manifest."""
    from morphgen.grammar import robot_source

    if args.name is not None:
        bundle_folder(args.out, args.name)  # refuses an invalid name before the work
    if args.root is not None and not args.root.is_dir():
        raise FormatError(
            f"--root {args.root}: no such folder; the link where the robot begins is named by "
            "--root-link"
        )
    if args.part and not args.licence:
        raise FormatError("--part: name the robot's licence by --licence, such as MIT")
    path, own_args = find_description(args.file)
    with status(args, f"importing {path}"):
        robot = robot_source.import_robot(
            path,
            {**own_args, **_xacro_args(args.arg)},
            root=args.root,
            root_link=args.root_link,
            tool=args.tool,
            srdf=args.srdf,
            name=args.name,
            repair=not args.as_is,
            skip_missing_meshes=args.skip_missing_meshes,
        )
    folder = bundle_folder(args.out, robot.name)
    if path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(
            f"{path}: its bundle would replace {folder}, the folder that it is in; "
            "choose another --name or --out"
        )
    part = None
    if args.part:  # refuses before the bundle is replaced
        part = part_manifest(robot, folder / URDF, args.part, args.parts or _PARTS, args.licence)
    data, text, code = write_checked(robot, args)
    if part is not None:
        write_part(*part)
        manifest = str(part[0])
        data, text = {**data, "part": manifest}, f"{text}\n{manifest}"
    opt.print_result(args, data, lambda: text)
    return code


def _xacro_args(words: Sequence[str]) -> dict[str, str]:
    """Return the values of ``--arg NAME=VALUE`` by name."""
    pairs = [word.partition("=") for word in words]
    for key, equals, value in pairs:
        if not key or not equals:
            raise FormatError(f"--arg {key}{equals}{value}: expected NAME=VALUE")
    return {key: value for key, _, value in pairs}
