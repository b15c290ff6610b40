"""``morphgen import``: bundles and parts from the files of other tools."""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option, path_option, repeated
from morphgen.cli.progress import status, track
from morphgen.cli.robots import WrittenBundle, write_checked
from morphgen.errors import FormatError, MorphgenError

if TYPE_CHECKING:
    from morphgen.formats.named_descriptions import NamedDescription

PART_KINDS = ("arm", "ee", "body")
"""Keys of ``morphgen.grammar.imported_part.PART_KINDS``."""
_PARTS = Path("parts")


@command(
    "import",
    "turn a URDF, xacro or MJCF into a bundle, or several",
    option(
        "files",
        nargs="+",
        metavar="FILE",
        help="a URDF, an MJCF, or a xacro if its suffix is .xacro; or menagerie:NAME or "
        "robot_descriptions:NAME, a robot of one of these pip packages",
    ),
    option(
        "--root-link",
        metavar="LINK",
        help="link where the robot begins (default: the root of the file)",
    ),
    option("--tool", metavar="LINK", help="link whose frame is the tool"),
    path_option("--srdf", "FILE", "an SRDF; the pairs of links that it disables are ignored, too"),
    repeated("--arg", "a xacro argument", metavar="NAME=VALUE"),
    flag(
        "--as-is",
        "do not make the safe repairs (see morphgen check), without which some loaders refuse the "
        "robot",
    ),
    flag(
        "--skip-missing-meshes",
        "leave out the shapes of a URDF whose mesh is missing; the findings and the card name them",
    ),
    option("--part", choices=PART_KINDS, help="also write a manifest: the robot becomes a part"),
    path_option("--parts", "DIR", f"with --part: folder of the manifests (default: {_PARTS})"),
    option(
        "--licence", metavar="TEXT", help="with --part: licence, if the robot's source has none"
    ),
    opt.ROOT,
    *opt.BUNDLE_OUT,
    opt.JSON,
    details="Meshes are converted to metres and z up. The exit code is 1 if an error remains that "
    "no safe repair removes (see morphgen check); the bundle is written all the same. Robots of "
    "several files are named after their files; those that are refused are named with the reason, "
    "and the exit code is 2. With --json, several files give one array with an object per file.",
    examples=(
        "import my_arm.urdf --tool flange",
        "import my_arm.xacro --arg length=0.4",
        "import scene.xml --root-link base",
        "import my_arm.urdf --tool flange --srdf my_arm.srdf",
        "import menagerie:universal_robots_ur5e --part arm --licence BSD-3-Clause",
        "import bodies/*.xml --tool torso --part arm --licence MIT --out imported",
    ),
)
def import_robots(args: argparse.Namespace) -> int:
    """Import descriptions, check them and write their bundles."""
    from morphgen.formats.bundle import bundle_folder
    from morphgen.formats.named_descriptions import find_description

    if args.part is None:
        given = {"--parts": args.parts is not None, "--licence": args.licence is not None}
        opt.reject_idle(given, "only with --part")
    sources = list(dict.fromkeys(args.files))
    if len(sources) > 1:
        if args.name is not None:
            raise FormatError(f"--name {args.name}: {len(sources)} robots cannot have one name")
        if args.srdf is not None:
            raise FormatError(
                f"--srdf {args.srdf}: is of one robot, and {len(sources)} are named; import its "
                "robot alone"
            )
    elif args.name is not None:
        bundle_folder(args.out, args.name)  # refuses an invalid name before the work
    if args.root is not None and not args.root.is_dir():
        raise FormatError(
            f"--root {args.root}: no such folder; the link where the robot begins is named by "
            "--root-link"
        )
    xacro_args = _xacro_args(args.arg)
    if len(sources) > 1:
        return _import_several(sources, args, xacro_args)
    robot = _import(find_description(sources[0]), args.name, xacro_args, args)
    opt.print_result(args, robot.data, lambda: robot.text)
    return robot.code


def _xacro_args(words: Sequence[str]) -> dict[str, str]:
    """Return the values of ``--arg NAME=VALUE`` by name."""
    pairs = [word.partition("=") for word in words]
    for key, equals, value in pairs:
        if not key or not equals:
            raise FormatError(f"--arg {key}{equals}{value}: expected NAME=VALUE")
    return {key: value for key, _, value in pairs}


def _import_several(
    sources: Sequence[str], args: argparse.Namespace, xacro_args: Mapping[str, str]
) -> int:
    """Import every file that can be, and print what became of each; return the exit code."""
    from morphgen.formats.named_descriptions import find_description

    found: dict[str, NamedDescription | MorphgenError] = {}
    for file in sources:
        try:
            found[file] = find_description(file)
        except MorphgenError as error:
            found[file] = error
    names = _bundle_names(found)
    code = 0
    objects: list[dict[str, object]] = []
    for file, description in track(list(found.items()), args, "importing", "robot", len(found)):
        try:
            if isinstance(description, MorphgenError):
                raise description
            robot = _import(description, names[file], xacro_args, args)
        except MorphgenError as error:
            objects.append({"file": file, **opt.refusal(error, file, Path(file).name)})
            code = 2
            continue
        objects.append({"file": file, **robot.data})
        code = max(code, robot.code)
        if not args.json:
            print(robot.text)
    if args.json:
        print(json.dumps(objects, default=str))
    return code


def _bundle_names(found: Mapping[str, NamedDescription | MorphgenError]) -> dict[str, str]:
    """Return the names of the bundles: those of the descriptions, without their suffixes.

    Raises:
        FormatError: If several descriptions would have one name, or one has no valid name.
    """
    from morphgen.formats.bundle import bundle_folder

    names = {
        file: re.sub(r"\W", "_", description.path.stem.removesuffix(".urdf"), flags=re.ASCII)
        for file, description in found.items()
        if not isinstance(description, MorphgenError)
    }
    names = {file: name.lstrip("_") or name for file, name in names.items()}
    for file, name in names.items():
        try:
            bundle_folder(Path(), name)
        except FormatError as error:
            raise FormatError(f"{file}: {error}; import it alone, with --name") from error
    for name, count in Counter(names.values()).items():
        if count > 1:
            files = [file for file, own in names.items() if own == name]
            raise FormatError(
                f"{', '.join(files)}: these would all be named {name!r}; import one at a time, "
                "with --name"
            )
    return names


def _import(
    description: NamedDescription,
    name: str | None,
    xacro_args: Mapping[str, str],
    args: argparse.Namespace,
) -> WrittenBundle:
    """Import a robot, and write its bundle and, if asked for, its manifest."""
    from morphgen.formats.bundle import URDF, bundle_folder
    from morphgen.grammar.imported_part import part_manifest, write_part
    from morphgen.grammar.robot_source import import_robot

    licence = args.licence or description.licence
    if args.part and not licence:
        raise FormatError("--part: name the robot's licence by --licence, such as MIT")
    with status(args, f"importing {description.path}"):
        robot = import_robot(
            description.path,
            {**description.args, **xacro_args},
            root=args.root,
            root_link=args.root_link,
            tool=args.tool,
            srdf=args.srdf,
            name=name,
            repair=not args.as_is,
            skip_missing_meshes=args.skip_missing_meshes,
        )
    folder = bundle_folder(args.out, robot.name)
    if description.path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(
            f"{description.path}: its bundle would replace {folder}, the folder that it is in; "
            "choose another --name or --out"
        )
    part = None
    if args.part:  # refuses before the bundle is replaced
        part = part_manifest(robot, folder / URDF, args.part, args.parts or _PARTS, licence)
    written = write_checked(robot, args)
    if part is None:
        return written
    write_part(*part)
    path = str(part[0])
    return replace(written, data={**written.data, "part": path}, text=f"{written.text}\n{path}")
