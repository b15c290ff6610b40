"""``morphgen export``: robots as files and folders of other tools, web pages and videos.

A format is one function, a row of ``FILES`` or ``FOLDERS``, and a few words in ``commands.txt``.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from morphgen.api.checks import bundle_of
from morphgen.checks.robot_srdf import (
    MATRIX_SAMPLES,
    collision_matrix,
    matrix_evidence,
    robot_srdf_text,
)
from morphgen.cli import options as opt
from morphgen.errors import FormatError
from morphgen.fitting.replace_collision import SPHERES, as_spheres, link_spheres
from morphgen.formats.bundle import (
    MESHES,
    MJCF,
    URDF,
    bundle_folder,
    split_colours,
    write_fits,
    write_meshes,
)
from morphgen.formats.files import require_writable_folder, write_atomic, writing_export
from morphgen.formats.glb import glb_bytes
from morphgen.formats.mjcf.write import mjcf_text
from morphgen.formats.ros_package import ros_package_name, write_ros_package
from morphgen.formats.sdf import MODEL_CONFIG, MODEL_SDF, model_config_text, sdf_text
from morphgen.formats.srdf import CUROBO_CONFIG, curobo_text, require_tool
from morphgen.formats.urdf.write import MeshUri, urdf_text
from morphgen.formats.usd import convert_urdf
from morphgen.grammar.library import Library
from morphgen.grammar.robot_source import RobotReference, read_source
from morphgen.model.robot import Robot


def export(args: argparse.Namespace) -> int:
    """Write a file or a folder for each robot."""
    made: list[Path] = []
    if args.out is not None:
        require_writable_folder(args.out)
        made = [folder for folder in (args.out, *args.out.parents) if not folder.exists()]
    paths: list[Path] = []

    def write(source: RobotReference, library: Library) -> None:
        robot = read_source(source, library, args.root)
        path = _target(source, robot, args)
        if path in paths:
            raise FormatError(f"{source.label}: {path} is of another robot of this command already")
        if args.format in FILES:
            content = FILES[args.format](robot, args)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, content)
        else:
            with writing_export(path, args.format, robot.name) as partial_folder:
                FOLDERS[args.format](robot, partial_folder, args)
        paths.append(path)

    try:
        _, refused = opt.for_each_robot(args, "exporting", write)
    finally:
        for folder in made if not paths else ():  # the inner ones come first
            with suppress(OSError):
                folder.rmdir()
    refusals = [{"robot": label, **error} for label, error in refused.items()]
    data = [*map(str, paths), *refusals]
    opt.print_result(args, data, lambda: "\n".join(map(str, paths)))
    return 2 if refused else 0


def _target(source: RobotReference, robot: Robot, args: argparse.Namespace) -> Path:
    """Return the path of a robot's file or folder."""
    bundle = bundle_of(source) if args.out is None else None
    if bundle is not None and args.format in FILES:
        return bundle / f"robot.{args.format}"
    beside = Path() if bundle is None else Path(os.path.normpath(bundle / ".."))
    path = bundle_folder(args.out or beside, robot.name)
    if args.format == "ros2":
        return path.with_name(ros_package_name(robot.name))
    if args.format in FOLDERS:
        return path.with_name(f"{robot.name}-{args.format}")
    return path.with_name(f"{path.name}.{args.format}")


def _html(robot: Robot, args: argparse.Namespace) -> bytes:
    from morphgen.viewer.app.web_page import robot_page  # of an extra, and seconds to import

    return robot_page(robot, dark=args.dark)


def _video(robot: Robot, args: argparse.Namespace) -> bytes:
    from morphgen.viewer.film import turntable  # of an extra, and seconds to import

    return turntable(robot, f".{args.format}")


def _glb(robot: Robot, args: argparse.Namespace) -> bytes:
    return glb_bytes(split_colours(robot))


def _srdf(robot: Robot, args: argparse.Namespace) -> bytes:
    require_tool(robot)  # before spheres are fitted
    # The pairs are those of the robot's own shapes, which planners may test, too.
    return _srdf_text(robot, _with_spheres(robot, args), args).encode()


def _srdf_text(robot: Robot, sphered: Robot, args: argparse.Namespace) -> str:
    spheres = link_spheres(sphered)
    return robot_srdf_text(robot, samples=_samples(args), seed=args.seed or 0, spheres=spheres)


def _samples(args: argparse.Namespace) -> int:
    return args.samples or MATRIX_SAMPLES


def _with_spheres(robot: Robot, args: argparse.Namespace, default: int | None = None) -> Robot:
    """Return the robot with the spheres of ``--spheres`` as its collision shapes, if any."""
    number = args.spheres or default
    if number is None:
        return robot
    folders = opt.library_of(args).folders  # with the parts' stored fits
    return as_spheres(robot, folders, spheres=number, cover=args.cover)


def _with_meshes(
    robot: Robot, folder: Path, texts: Callable[[Robot, MeshUri], Mapping[str, str]]
) -> None:
    """Write meshes and the texts that name them by relative paths."""
    robot = split_colours(robot)
    files = write_meshes(robot, folder / MESHES)
    for name, text in texts(robot, files.__getitem__).items():
        (folder / name).write_text(text, encoding="utf-8")
    if (folder / URDF).is_file():
        write_fits(robot, folder)


def _meshed(
    robot: Robot,
    folder: Path,
    args: argparse.Namespace,
    *,
    texts: Callable[[Robot, MeshUri], Mapping[str, str]],
) -> None:
    _with_meshes(_with_spheres(robot, args), folder, texts)


def _urdf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    return {URDF: urdf_text(robot, mesh_uri)}


def _mjcf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    return {MJCF: mjcf_text(robot, mesh_uri)}


def _sdf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    return {MODEL_SDF: sdf_text(robot, mesh_uri), MODEL_CONFIG: model_config_text(robot)}


def _curobo(robot: Robot, folder: Path, args: argparse.Namespace) -> None:
    require_tool(robot)
    robot = _with_spheres(robot, args, SPHERES)
    matrix = collision_matrix(robot, samples=_samples(args), seed=args.seed or 0)
    evidence = matrix_evidence(robot, matrix)
    text = curobo_text(robot, link_spheres(robot), matrix.reasons, URDF, evidence)
    _with_meshes(robot, folder, _urdf)
    (folder / CUROBO_CONFIG).write_text(text, encoding="utf-8")


def _usd(robot: Robot, folder: Path, args: argparse.Namespace) -> None:
    with TemporaryDirectory() as scratch:
        _with_meshes(_with_spheres(robot, args), Path(scratch), _urdf)
        convert_urdf(Path(scratch) / URDF, folder)


def _ros2(robot: Robot, folder: Path, args: argparse.Namespace) -> None:
    require_tool(robot)
    robot = _with_spheres(robot, args)
    write_ros_package(robot, folder, _srdf_text(robot, robot, args))


FILES: Mapping[str, Callable[[Robot, argparse.Namespace], bytes]] = {
    "html": _html,
    "mp4": _video,
    "gif": _video,
    "glb": _glb,
    "srdf": _srdf,
}
"""Functions that return the content of a robot's file, by the format's name, which is its suffix.
"""
FOLDERS: Mapping[str, Callable[[Robot, Path, argparse.Namespace], None]] = {
    "urdf": partial(_meshed, texts=_urdf),
    "mjcf": partial(_meshed, texts=_mjcf),
    "sdf": partial(_meshed, texts=_sdf),
    "curobo": _curobo,
    "usd": _usd,
    "ros2": _ros2,
}
"""Functions that write a robot's files into an empty folder, by the format's name."""
