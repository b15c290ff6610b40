"""Load parts: fragments of a kinematic tree with a root, a mount and named ports."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from weakref import WeakSet

import yaml

from morphgen.checks.rules import safe_names
from morphgen.errors import (
    CompositionError,
    FormatError,
    MorphgenError,
    PartError,
    RobotError,
    nearest,
)
from morphgen.files import file_stamp, write_atomic
from morphgen.formats.bundle import is_mjcf, read_description, read_installed
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.rounding import format_number
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.formats.xacro.compile import CompiledXacro, compile_xacro
from morphgen.formats.xacro.evaluator import evaluate_number
from morphgen.grammar.library import Library, shipped_folders
from morphgen.grammar.manifest import (
    FrameSpec,
    Manifest,
    Number,
    PackageSource,
    read_manifest,
    resolve_values,
)
from morphgen.model.geometry import IDENTITY, Mesh, Pose, Shape
from morphgen.model.inertia import inertial_from_mass, with_inertia
from morphgen.model.robot import TOOL, Frame, Link, Robot
from morphgen.model.tree import rename, scale_links, subtree

_trusted: WeakSet[CompiledXacro] = WeakSet()
"""Compiled templates whose structure has passed all checks of a URDF once."""
_EXPRESSION = re.compile(r"\$\{(.*)\}")


@dataclass(frozen=True, eq=False)
class Part:
    """A part with given parameters."""

    manifest: Manifest
    values: Mapping[str, float]  # values of all parameters, SI units
    fragment: Robot
    """Links and joints of the part. Names are those of the source, without characters that some
    loaders refuse."""
    T_root_mount: Pose  # pose of the mount, the frame that is attached to the parent's port
    ports: Mapping[str, Frame]  # frames that other parts can be attached to, by name
    tool: Frame | None  # frame at the working point; None for a part without one


def load_part(manifest: Manifest, values: Mapping[str, float] | None = None) -> Part:
    """Load a part; the same manifest and values give the same object.

    A part is read again when its manifest or source changes. Files that the source includes, and
    meshes, are not looked at.
    """
    complete = resolve_values(values or {}, manifest.parameters, manifest.name)
    source = manifest.path if isinstance(manifest.source, PackageSource) else manifest.source
    stamps = (file_stamp(manifest.path), file_stamp(source))
    return _load(_Loader((manifest.path, stamps, tuple(complete.items())), manifest, complete))


@dataclass(frozen=True)
class _Loader:
    """Reads a part's source and applies the manifest's corrections, frames and scaling."""

    key: tuple[object, ...]  # path, states of the manifest and the source, values of parameters
    _manifest: Manifest = field(compare=False)
    _values: Mapping[str, float] = field(compare=False)

    def load(self) -> Part:
        manifest = self._manifest
        try:
            fragment = subtree(self._read_source(), manifest.root, manifest.without)
        except RobotError as error:
            raise PartError(f"{manifest.path}: {error}") from error
        fragment = self._correct_links(self._correct_joints(fragment))
        T_root_mount = self._mount(fragment)
        # Frames are attached before links are scaled and renamed, so that they follow both.
        specs = {**({"tool": manifest.tool} if manifest.tool else {}), **manifest.ports}
        frames = (
            Frame(name, spec.link, self._pose(spec, fragment)) for name, spec in specs.items()
        )
        fragment = self._scale(replace(fragment, frames=tuple(frames)))
        links = safe_names(link.name for link in fragment.links)
        joints = safe_names(joint.name for joint in fragment.joints)
        fragment = rename(fragment, links, joints)
        ports = {frame.name: frame for frame in fragment.frames if frame.name in manifest.ports}
        tool = fragment.frames[0] if manifest.tool else None
        return Part(manifest, self._values, replace(fragment, frames=()), T_root_mount, ports, tool)

    def _read_source(self) -> Robot:
        source = self._manifest.source
        try:
            if isinstance(source, PackageSource):
                return read_installed(source.package, source.file, source.args)
            if is_mjcf(source):
                return read_description(source)
            return self._read_template(source)
        except FormatError as error:
            raise PartError(f"part {self._manifest.name!r}: {error}") from error

    def _read_template(self, path: Path) -> Robot:
        """Expand a template; its structure is checked once for all values of its numbers."""
        constants: dict[str, str] = {}
        """Parameters that may change the structure, such as the number of fingers."""
        numbers: dict[str, str] = {}
        for name, value in self._values.items():
            is_integer = self._manifest.parameters[name].integer
            (constants if is_integer else numbers)[name] = format_number(value)
        finder = PackageFinder()
        # Sampling expands the same template thousands of times.
        compiled = compile_xacro(path, constants, numbers, finder)
        if compiled is None:
            from morphgen.formats.xacro.expand import expand

            return robot_from_xml(expand(path, {**constants, **numbers}, finder), path, finder)
        text = compiled.fill(numbers)
        robot = robot_from_xml(text, path, finder, trusted=compiled in _trusted)
        _trusted.add(compiled)
        return robot

    def _correct_joints(self, fragment: Robot) -> Robot:
        """Apply the manifest's home, efforts and velocities; continuous joints have no limits."""
        manifest = self._manifest
        self._require_known(("home", "effort", "velocity"), "joint", fragment.joint_index)
        independent = [fragment.joints[k].name for k in fragment.independent_joints]
        for name in manifest.home:
            if name not in independent:
                raise self._error(f"home: {name!r} does not move by itself")
        home = {name: self._evaluate(entry) for name, entry in manifest.home.items()}
        return replace(
            fragment,
            joints=tuple(
                replace(
                    joint,
                    effort=manifest.effort.get(joint.name, joint.effort),
                    velocity=manifest.velocity.get(joint.name, joint.velocity),
                    limits=None if joint.kind == "continuous" else joint.limits,
                )
                for joint in fragment.joints
            ),
            home=tuple(
                home.get(name, position)
                for name, position in zip(independent, fragment.home, strict=True)
            ),
        )

    def _correct_links(self, fragment: Robot) -> Robot:
        """Apply the manifest's shapes, masses and density."""
        keys = ("mass", "drop", "collision_from_visual", "scaling")
        self._require_known(keys, "link", fragment.link_index)
        return replace(fragment, links=tuple(map(self._correct_link, fragment.links)))

    def _correct_link(self, link: Link) -> Link:
        manifest = self._manifest
        if link.name in manifest.drop:
            dropped = manifest.drop[link.name]
            link = replace(
                link,
                visuals=_without_meshes(link.visuals, dropped),
                collisions=_without_meshes(link.collisions, dropped),
            )
        if link.name in manifest.collision_from_visual:
            collisions = tuple(replace(shape, rgba=None) for shape in link.visuals)
            link = replace(link, collisions=collisions)
        if link.name in manifest.mass:
            mass = manifest.mass[link.name]
            return replace(link, inertial=inertial_from_mass(link, mass) if mass else None)
        if manifest.density is not None and link.inertial is None:
            return with_inertia(link, manifest.density)
        return link

    def _scale(self, fragment: Robot) -> Robot:
        scaling, factors = self._manifest.scaling, {}
        for link, entry in scaling.items():
            if (name := entry.parameter) and name not in self._values:
                raise self._error(f"scaling: no parameter {name!r}{nearest(name, self._values)}")
            if name:
                factors[link] = self._values[name]
        return scale_links(fragment, factors, {link: e.face for link, e in scaling.items()})

    def _mount(self, fragment: Robot) -> Pose:
        """Return the pose of the mount in the root's frame."""
        spec, root = self._manifest.mount, self._manifest.root
        if spec is None:
            return IDENTITY
        T_link_mount = self._pose(spec, fragment)
        T_root_link = IDENTITY
        for joint in [fragment.joints[k] for k in reversed(fragment.joint_chain(spec.link))]:
            if joint.is_movable:
                raise self._error(
                    f"mount is on {spec.link!r}, which moves ({joint.name!r}) against the root "
                    f"{root!r}"
                )
            T_root_link = joint.T_parent_joint @ T_root_link
        return T_root_link @ T_link_mount

    def _pose(self, spec: FrameSpec, fragment: Robot) -> Pose:
        if spec.link not in fragment.link_index:
            raise self._error(
                f"no link {spec.link!r} in the part{nearest(spec.link, fragment.link_index)}"
            )
        x, y, z, roll, pitch, yaw = map(self._evaluate, (*spec.xyz, *spec.rpy))
        return Pose.from_xyz_rpy((x, y, z), (roll, pitch, yaw))

    def _evaluate(self, entry: Number) -> float:
        if not isinstance(entry, str):
            return entry
        match = _EXPRESSION.fullmatch(entry.strip())
        if match is None:
            raise self._error(f"{entry!r} is neither a number nor ${{...}}")
        try:
            return evaluate_number(match[1], self._values)
        except MorphgenError as error:
            raise self._error(f"{entry}: {error}") from error

    def _require_known(self, keys: Iterable[str], what: str, valid: Collection[str]) -> None:
        """Require that the names under some keys of the manifest exist in the part."""
        for key in keys:
            for name in getattr(self._manifest, key):
                if name not in valid:
                    raise self._error(f"{key}: no {what} {name!r}{nearest(name, valid)}")

    def _error(self, text: str) -> PartError:
        return PartError(f"{self._manifest.path}: {text}")


@lru_cache(maxsize=256)
def _load(loader: _Loader) -> Part:
    return loader.load()


def _without_meshes(shapes: tuple[Shape, ...], names: Collection[str]) -> tuple[Shape, ...]:
    return tuple(
        shape
        for shape in shapes
        if not (isinstance(shape.geometry, Mesh) and shape.geometry.path.name in names)
    )


_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")  # names that derivations and grammars can hold


def part_manifest(
    robot: Robot, description: Path, kind: str, folder: Path, licence: str
) -> tuple[Path, str]:
    """Return the path of a part's manifest and its text, before anything is written.

    The frame ``tool`` of the robot becomes the port ``flange`` of an arm, and the tool of an
    end-effector or a body. The part has the robot's home.
    """
    if not _NAME.fullmatch(robot.name):
        raise FormatError(
            f"name {robot.name!r} of a part: expected letters, digits and underscores, no digit "
            "first; import its file alone, and choose a name by --name"
        )
    if robot.name in Library(shipped_folders()).paths:
        raise FormatError(
            f"name {robot.name!r} of a part: morphgen has a part of this name; import its file "
            "alone, and choose another by --name"
        )
    tool = robot.tool
    if tool is None:
        raise CompositionError(
            f"robot {robot.name!r} has no frame {TOOL!r}, which is the flange or the tool of a "
            "part; name its link by --tool"
        )
    pose = tool.T_link_frame
    # Adding zero turns -0.0 into 0.0.
    xyz, rpy = ([value + 0.0 for value in values] for values in (pose.position, pose.rpy))
    frame = {"link": tool.link, "xyz": xyz, "rpy": rpy}
    frames = {"ports": {"flange": frame}} if kind == "arm" else {"tool": frame}
    joints = [robot.joints[k].name for k in robot.independent_joints]
    content = {
        "name": robot.name,
        "kind": kind,
        "summary": f"{robot.name}, imported, {robot.dof} DoF",
        "file": Path(os.path.relpath(description, folder)).as_posix(),
        "root": robot.root.name,
        "without": [frame.name for frame in robot.frames],  # links of the URDF, not of the robot
        **frames,
        "home": dict(zip(joints, robot.home, strict=True)),
        "licence": licence,
    }
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    path = folder / f"{robot.name}.yaml"
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"{folder} is not a folder; choose another --parts")
    if path.exists() and path.read_bytes() != text.encode():
        raise FormatError(f"{path} exists; move it away, or choose another folder by --parts")
    return path, text


def write_part(path: Path, text: str) -> None:
    """Write the manifest of a part whose bundle is written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text)
    try:
        load_part(read_manifest(path))
    except MorphgenError:
        path.unlink()
        raise
