"""Read and write bundles, robots as folders that every loader can read, and read descriptions."""

from __future__ import annotations

import hashlib
import json
import pkgutil
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from msgspec import field

from morphgen.errors import FormatError, nearest, one_line
from morphgen.files import file_sha256
from morphgen.formats import resolve
from morphgen.formats.data_files import kept_reading, read_json
from morphgen.formats.files import (
    folder_hashes,
    replacing_folder,
    require_unedited,
    require_writable_folder,
)
from morphgen.formats.fits import FITS, fits_of_copies, fits_text, read_fits
from morphgen.formats.mjcf.write import mjcf_text
from morphgen.formats.records import FiniteNumber, Record, read_record
from morphgen.formats.rounding import round_number
from morphgen.formats.urdf.read import (
    read_urdf,
    require_description_file,
    require_no_arguments,
    with_frames,
)
from morphgen.formats.urdf.write import urdf_text
from morphgen.formats.xml import found, root_tag
from morphgen.model.dynamics import actuation
from morphgen.model.findings import Finding
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, StoredFits
from morphgen.model.kinematics import reach
from morphgen.model.mesh import (
    MAX_STL_FACES,
    kept_of_mesh,
    load_mesh,
    mesh_parts,
    require_bounded_meshes,
)
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot

URDF = "robot.urdf"
MJCF = "robot.xml"
CARD = "card.json"
PICTURE = "preview.png"
MESHES = "meshes"
XACRO = ".xacro"

EXPORTS = ("srdf", "glb", "html", "mp4", "gif")
"""Formats of ``morphgen export`` whose file is written into the bundle, as ``robot.<format>``."""
_REPLACED = {CARD, PICTURE, *(f"robot.{name}" for name in EXPORTS)}
"""Files that a new bundle replaces although no hash shows whether they were edited."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}")


def bundle_folder(parent: Path, name: str) -> Path:
    """Return the folder of a robot's bundle below ``parent``."""
    if not _NAME.fullmatch(name):
        raise FormatError(
            f"name {name!r}: use letters, digits, '-', '_', '+' and '.', a letter or digit first, "
            "at most 200"
        )
    return parent / name


def require_replaceable(folder: Path) -> None:
    """Require that a folder does not exist or is a bundle of which only generated files differ."""
    if folder.is_symlink():
        raise FormatError(f"{folder} is a link; choose another name or folder")
    if not folder.exists():
        require_writable_folder(folder.parent)
        return
    if not (folder / CARD).is_file():
        raise FormatError(f"{folder} exists and is not a bundle (no {CARD}); choose another name")
    require_unedited(folder, _card_hashes(folder), _REPLACED, "bundle", "name or folder")


def write_bundle(
    robot: Robot,
    folder: Path,
    findings: Iterable[Finding] = (),
    *,
    picture: bool = True,
    edits_kept: bool = True,
) -> Path:
    """Write a robot's bundle atomically; return ``folder``."""
    if edits_kept:
        require_replaceable(folder)
    robot = split_colours(robot)
    with replacing_folder(folder) as partial:
        files = write_meshes(robot, partial / MESHES)
        (partial / URDF).write_text(urdf_text(robot, lambda mesh: files[mesh]), encoding="utf-8")
        (partial / MJCF).write_text(mjcf_text(robot, lambda mesh: files[mesh]), encoding="utf-8")
        write_fits(robot, partial)
        hashes = folder_hashes(partial)
        card = robot_card(robot, findings, hashes, {"morphgen": version("morphgen")})
        (partial / CARD).write_text(card_text(card), encoding="utf-8")
        if picture:
            from morphgen.formats.picture import render

            render(robot, partial / MJCF).save(partial / PICTURE)
    return folder


def read_bundle(folder: Path, *, root: Path | None = None) -> Robot:
    """Read a robot from its bundle."""
    card = read_card(folder)
    robot = read_urdf(folder / URDF, finder=resolve.default_finder(root=root), keep_order=True)
    return replace(apply_card(robot, card, str(folder / CARD)), fits=fits_in(folder))


def fits_in(folder: Path) -> StoredFits:
    """Return the fits that a folder has beside a robot's description; none without the file."""
    path = folder / FITS
    if not path.exists():
        return {}
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{path}: is a link that leaves its folder; replace it by the file")
    return read_fits(path)


def read_card(folder: Path) -> dict[str, Any]:
    """Return the content of a bundle's card."""
    card_path = folder / CARD
    if not card_path.is_file():
        is_light = (folder / URDF).is_file()
        hint = f"; name its {URDF}, or sample it again without --light" if is_light else ""
        raise FormatError(f"{folder} is not a bundle: it has no {CARD}{hint}")
    card = read_json(card_path)
    if not isinstance(card, dict):
        raise FormatError(f"{card_path}: expected an object, not {type(card).__name__}")
    return card


def _card_hashes(folder: Path) -> dict[str, object]:
    """Return the SHA-256 of every file of a bundle but the card and the picture, by its path."""
    hashes = read_card(folder).get("hashes")
    if not isinstance(hashes, dict):
        raise FormatError(f"{folder / CARD}: hashes: expected an object, not {hashes!r}")
    return hashes


def file_findings(folder: Path) -> tuple[Finding, ...]:
    """Return findings about files of a bundle that are missing or differ from the card's hashes."""
    findings = []
    for name, expected in _card_hashes(folder).items():
        path = folder / name
        try:
            is_inside = path.resolve().is_relative_to(folder.resolve())
            exists = is_inside and path.is_file()
        except (OSError, ValueError):  # not a valid file name
            is_inside, exists = True, False
        if not is_inside:
            raise FormatError(f"{folder / CARD}: hashes: {name!r} leads out of the folder")
        if not exists:
            findings.append(found("file-missing", f"file {name}"))
        elif file_sha256(path) != expected:
            findings.append(found("file-changed", f"file {name}"))
    return tuple(findings)


def read_robot(path: Path, *, root: Path | None = None, skip_missing_meshes: bool = False) -> Robot:
    """Read a bundle's folder, a URDF, a xacro or an MJCF.

    The URDF or MJCF of a bundle stands for the bundle. Another description gets the fits of a
    ``primitives.json`` beside it, such as that of an exported URDF.
    """
    if path.is_dir():
        return read_bundle(path, root=root)
    if path.name in (URDF, MJCF) and (path.parent / CARD).is_file():
        return read_bundle(path.parent, root=root)
    is_xacro = path.suffix == XACRO
    finder = resolve.default_finder(root=root, skip_missing=skip_missing_meshes)
    robot = read_description(path, finder=finder, written_frames=not is_xacro)
    return replace(robot, fits=fits_in(path.parent))


def split_colours(robot: Robot) -> Robot:
    """Split every visual mesh of several colours into one visual shape per colour.

    A part of a single triangle is dropped, because MuJoCo refuses meshes of three vertices.
    """
    require_bounded_meshes(robot)
    links = [
        replace(link, visuals=tuple(part for shape in link.visuals for part in _split_shape(shape)))
        for link in robot.links
    ]
    return replace(robot, links=tuple(links))


def _split_shape(shape: Shape) -> tuple[Shape, ...]:
    mesh = shape.geometry
    if not isinstance(mesh, Mesh) or mesh.part is not None:
        return (shape,)
    parts = mesh_parts(mesh.path)
    if len(parts) < 2:
        rgba = shape.rgba or (parts[0].rgba if parts else None)
        return (replace(shape, rgba=rgba),)
    return tuple(
        replace(shape, geometry=replace(mesh, part=i), rgba=part.rgba or shape.rgba)
        for i, part in enumerate(parts)
        if len(part.faces) > 1  # MuJoCo refuses three vertices
    )


def write_meshes(robot: Robot, folder: Path) -> dict[Mesh, str]:
    """Write every mesh of a robot once, in metres, as STL or, if it is large, as OBJ.

    Return their files, such as ``meshes/hand-1a2b3c4d.stl``: relative to the parent of ``folder``.
    """
    files = {}
    for mesh in robot.meshes:
        folder.mkdir(exist_ok=True)
        name, data = mesh_file(mesh)
        (folder / name).write_bytes(data)
        files[mesh] = f"{MESHES}/{name}"
    return files


def mesh_file(mesh: Mesh) -> tuple[str, bytes]:
    """Return the name and content of the file that every loader can read for a mesh."""
    data, suffix = kept_of_mesh("file", mesh, lambda: _exported(mesh))
    digest = hashlib.sha256(data).hexdigest()[:8]
    # The name of a mesh that another bundle wrote already ends with a digest.
    base, dash, last_word = mesh.path.stem.rpartition("-")
    stem = base if dash and len(last_word) == 8 else mesh.path.stem
    safe_stem = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in stem)
    return f"{safe_stem}-{digest}.{suffix}", data


def _exported(mesh: Mesh) -> tuple[bytes, str]:
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.stl import export_stl

    triangles = load_mesh(mesh)
    if len(triangles.faces) <= MAX_STL_FACES:
        return export_stl(triangles), "stl"
    # Too large for MuJoCo's STL reader.
    return export_obj(triangles, include_normals=False, header=None).encode(), "obj"


def write_fits(robot: Robot, folder: Path) -> None:
    """Write the fits of the collision shapes under the keys of the rewritten meshes.

    The bundle's meshes have other content than the robot's, and with it other keys.
    """
    if not robot.fits:
        return
    fits = fits_of_copies(robot, read_urdf(folder / URDF, keep_order=True), {})
    if fits:
        (folder / FITS).write_text(fits_text(fits), encoding="utf-8")


CARD_FORMAT = 1


class _CardRecord(Record, frozen=True):
    """The keys of a card that a robot is read from; the others only describe the robot."""

    home: dict[str, FiniteNumber]
    ignore_pairs: tuple[tuple[str, str], ...]
    frames: dict[str, Any] = field(default_factory=dict)
    derivation: str = ""
    source: str = ""
    choices: dict[str, Any] = field(default_factory=dict)
    repairs: list[str] = field(default_factory=list)
    parts: list[dict[str, Any]] = field(default_factory=list)
    accepted: dict[str, dict[str, str]] = field(default_factory=dict)
    primitives: dict[str, Any] = field(default_factory=dict)
    convex: dict[str, Any] = field(default_factory=dict)
    packages: list[dict[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if any(not {"label", "part"} <= part.keys() for part in self.parts):
            raise ValueError("parts: expected objects with the keys 'label' and 'part'")


_KEYS = _CardRecord.__struct_fields__
_PROVENANCE = _KEYS[_KEYS.index("derivation") :]  # keys that become the robot's provenance


def robot_card(
    robot: Robot,
    findings: Iterable[Finding],
    hashes: Mapping[str, str],
    versions: Mapping[str, str],
) -> dict[str, object]:
    """Return the data of a robot's ``card.json``.

    It contains no time and no path, so that the same robot gives the same bytes on any machine.
    """
    joints = [robot.joints[k] for k in robot.independent_joints]
    return {
        "format": CARD_FORMAT,
        "name": robot.name,
        "links": len(robot.links),
        "movable": len(robot.movable_joints),
        "dof": robot.dof,
        "mass": round_number(robot.mass),
        "reach": round_number(reach(robot)) if robot.tool and robot.dof else None,
        "home": {joint.name: round_number(q) for joint, q in zip(joints, robot.home, strict=True)},
        "frames": {
            frame.name: {
                "link": frame.link,
                "position": [round_number(v) for v in frame.T_link_frame.position],
                "quaternion": [round_number(v) for v in frame.T_link_frame.quaternion],
            }
            for frame in robot.frames
        },
        "ignore_pairs": [list(pair) for pair in robot.ignore_pairs],
        "actuation": {
            gains.joint: {
                key: None if value is None else round_number(value)
                for key, value in asdict(gains).items()
                if key != "joint"
            }
            for gains in actuation(robot)
        },
        **robot.provenance,
        "findings": [finding.as_dict() for finding in findings],
        "hashes": dict(sorted(hashes.items())),
        "versions": dict(versions),
    }


def card_text(card: Mapping[str, object]) -> str:
    """Return a card as JSON text."""
    return json.dumps(card, indent=2, ensure_ascii=False) + "\n"


def part_licences(card: Mapping[str, object]) -> tuple[str, ...]:
    """Return the licences of a robot's parts by its provenance or card; none without parts."""
    parts = card.get("parts")
    rows = parts if isinstance(parts, list) else []
    names = [
        one_line(str(part["licence"]))
        for part in rows
        if isinstance(part, Mapping) and "licence" in part
    ]
    return tuple(dict.fromkeys(names))


def apply_card(robot: Robot, card: Mapping[str, Any], origin: str) -> Robot:
    """Complete a robot that was read from a bundle's URDF by what only its card holds."""
    if "format" not in card:
        raise FormatError(f"{origin}: not a card: missing key 'format'")
    if card["format"] != CARD_FORMAT:
        raise FormatError(
            f"{origin}: card format {card['format']!r}; this version reads {CARD_FORMAT}"
        )
    known = {key: card[key] for key in _KEYS if key in card}
    record = read_record(known, _CardRecord, origin)
    robot = with_frames(robot, tuple(record.frames))
    try:
        home = tuple(record.home[robot.joints[k].name] for k in robot.independent_joints)
    except KeyError as error:
        raise FormatError(f"{origin}: home: missing joint {error}") from error
    provenance = {key: card[key] for key in _PROVENANCE if key in card}
    return replace(robot, home=home, ignore_pairs=record.ignore_pairs, provenance=provenance)


_KEPT = (
    *(Robot, Link, Joint, Frame, Inertial, Mimic, Shape, Pose, Finding),
    *(Box, Capsule, Cylinder, Mesh, Sphere),
)
"""Types of what is kept of a robot."""
SUFFIXES = (".urdf", ".xacro", ".xml")  # file name suffixes of robot descriptions
_MAX_HEAD = 2**20  # number of bytes within which the root element of an MJCF begins


def read_description(
    path: Path,
    args: Mapping[str, str] | None = None,
    finder: resolve.PackageFinder | None = None,
    *,
    root_link: str | None = None,
    written_frames: bool = False,
) -> Robot:
    """Read a xacro (by its suffix), an MJCF (by its root element ``<mujoco>``), or a URDF."""
    require_description_file(path)
    if is_mjcf(path):
        from morphgen.formats.mjcf.read import read_mjcf  # takes a second to load

        require_no_arguments(path, args)
        return read_mjcf(path, finder, root_body=root_link)
    return read_urdf(path, args, finder, written_frames=written_frames)


def read_installed(package: str, file: str, args: Mapping[str, str]) -> Robot:
    """Read a description of an installed data package, kept in the user's cache."""
    path, finder = resolve.distribution_file(package, file), resolve.default_finder()
    read = partial(read_description, path, args, finder)
    if not (resolve.is_installed(path) and resolve.finds_installed_only(finder)):
        return read()
    key = (path, finder.roots, dict(args))
    robot = kept_reading("robot", key, read, _KEPT)
    return robot if all(mesh.path.is_file() for mesh in robot.meshes) else read()


def is_mjcf(path: Path) -> bool:
    """Return whether a file is an MJCF: its root element is ``<mujoco>``.

    A file with the suffix ``.xacro`` is none; it is not opened.
    """
    if path.suffix == ".xacro" or not path.is_file():
        return False
    with path.open("rb") as file:
        return root_tag(file.read(_MAX_HEAD)) == "mujoco"


DESCRIPTIONS = "robot_descriptions"  # module of the pip package, and prefix of its robots
_PATHS = ("MJCF_PATH", "URDF_PATH", "XACRO_PATH")
"""Names of the paths in a module of ``robot_descriptions``; the first one that exists is taken."""


def find_description(text: str) -> tuple[Path, dict[str, str]]:
    """Return the file that a path or ``robot_descriptions:NAME`` names, and its xacro arguments."""
    collection, colon, name = text.partition(":")
    if not colon or collection != DESCRIPTIONS:
        return Path(text), {}
    spec = find_spec(DESCRIPTIONS)
    if spec is None:
        raise FormatError(f"{text}: pip install {DESCRIPTIONS}, which has its robots")
    modules = pkgutil.iter_modules(spec.submodule_search_locations)
    names = [module.name for module in modules if module.name.endswith("_description")]
    if name not in names:
        raise FormatError(f"{text}: no such robot{nearest(name, names)}")
    try:
        module = import_module(f"{DESCRIPTIONS}.{name}")
    except Exception as error:  # whatever the package's download raises, such as GitCommandError
        raise FormatError(f"{text}: cannot be loaded: {error}") from error
    for key in _PATHS:
        if path := getattr(module, key, None):
            args = getattr(module, "XACRO_ARGS", {}) if key == "XACRO_PATH" else {}
            return Path(path), {name: str(args[name]) for name in args}
    raise FormatError(f"{text}: the module has none of {', '.join(_PATHS)}")
