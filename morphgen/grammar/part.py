"""Parts: fragments of a kinematic tree with a root, a mount and named ports."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from weakref import WeakSet

from morphgen.checks.names import safe_names
from morphgen.errors import FormatError, MorphgenError, PartError, RobotError, nearest
from morphgen.formats.resolve import PackageFinder, distribution_file, file_stamp
from morphgen.formats.rounding import format_number
from morphgen.formats.urdf import read_urdf, robot_from_xml
from morphgen.formats.xacro import evaluate, expand
from morphgen.formats.xacro_compile import CompiledXacro, compile_xacro
from morphgen.grammar.manifest import FrameSpec, Manifest, Number, PackageSource
from morphgen.grammar.parameters import resolve_values
from morphgen.model.geometry import IDENTITY, Mesh, Pose, Shape
from morphgen.model.inertia import inertial_from_mass, with_inertia
from morphgen.model.robot import Frame, Link, Robot
from morphgen.model.tree import rename, scale_links, subtree

_examined: WeakSet[CompiledXacro] = WeakSet()
_EXPRESSION = re.compile(r"\$\{(.*)\}")


@dataclass(frozen=True, eq=False)
class Part:
    """A part with its parameters filled in."""

    manifest: Manifest
    values: Mapping[str, float]
    fragment: Robot
    """Its links and joints, rooted at the manifest's root; names as in the source, but for
    characters that loaders dislike."""
    T_root_mount: Pose
    """The frame that is put onto the parent's port."""
    ports: Mapping[str, Frame]
    tool: Frame | None


def load_part(manifest: Manifest, values: Mapping[str, float] | None = None) -> Part:
    """Build a part; the same manifest and values give the same object.

    Args:
        manifest: What the part is.
        values: Its parameters, SI units; defaults fill the rest.

    Raises:
        PartError: If a parameter is unknown or out of range, or the manifest names a link or
            joint that its source does not have.
        FormatError: If the source cannot be read.
    """
    complete = resolve_values(values or {}, manifest.parameters, manifest.name)
    return _load(_Frozen(manifest, complete))


class _Frozen:
    """A manifest and values as a key of the cache."""

    def __init__(self, manifest: Manifest, values: Mapping[str, float]) -> None:
        self.manifest, self.values = manifest, values
        xacro = manifest.source if isinstance(manifest.source, Path) else manifest.path
        stamps = (file_stamp(manifest.path), file_stamp(xacro))
        self.key = (manifest.path, stamps, tuple(values.items()))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frozen) and self.key == other.key


@lru_cache(maxsize=256)
def _load(frozen: _Frozen) -> Part:
    manifest, values = frozen.manifest, frozen.values
    try:
        body = subtree(_read_source(manifest, values), manifest.root, manifest.without)
    except RobotError as error:
        raise PartError(f"{manifest.path}: {error}") from error
    body = _with_bodies(_with_motion(body, manifest, values), manifest)
    T_root_mount = _mount(body, manifest, values)
    body = _with_frames(body, manifest, values)
    body = _with_scaling(body, manifest, values)
    links = safe_names(link.name for link in body.links)
    body = rename(body, links, safe_names(joint.name for joint in body.joints))
    has_tool = manifest.tool is not None
    return Part(
        manifest,
        values,
        replace(body, frames=()),
        T_root_mount,
        {frame.name: frame for frame in body.frames if frame.name in manifest.ports},
        body.frames[0] if has_tool else None,
    )


def _with_frames(body: Robot, manifest: Manifest, values: Mapping[str, float]) -> Robot:
    """The body with the tool, if there is one, and the ports as its frames."""
    placements = {"tool": manifest.tool} if manifest.tool is not None else {}
    frames = [
        Frame(name, placement.link, _pose(placement, body, manifest, values))
        for name, placement in (*placements.items(), *manifest.ports.items())
    ]
    return replace(body, frames=tuple(frames))


def _with_scaling(body: Robot, manifest: Manifest, values: Mapping[str, float]) -> Robot:
    """The body with every link that the manifest lets grow at its size."""
    factors: dict[str, float] = {}
    for link, scaling in manifest.scaling.items():
        if link not in body.link_index:
            raise PartError(
                f"{manifest.path}: scaling: no link {link!r}{nearest(link, body.link_index)}"
            )
        if scaling.parameter is None:
            continue
        if scaling.parameter not in values:
            raise PartError(
                f"{manifest.path}: scaling: no parameter {scaling.parameter!r}"
                f"{nearest(scaling.parameter, values)}"
            )
        factors[link] = values[scaling.parameter]
    return scale_links(body, factors, {link: each.face for link, each in manifest.scaling.items()})


def _read_source(manifest: Manifest, values: Mapping[str, float]) -> Robot:
    try:
        if isinstance(manifest.source, PackageSource):
            file = distribution_file(manifest.source.package, manifest.source.file)
            return read_urdf(file, manifest.source.args)
        return _read_template(manifest.source, manifest, values)
    except FormatError as error:
        raise PartError(f"part {manifest.name!r}: {error}") from error


def _read_template(path: Path, manifest: Manifest, values: Mapping[str, float]) -> Robot:
    """A template's body; its structure is examined once for all values of its numbers."""
    constants: dict[str, str] = {}
    numbers: dict[str, str] = {}
    for name, value in values.items():
        kind = constants if manifest.parameters[name].integer else numbers
        kind[name] = format_number(value)
    finder = PackageFinder()
    compiled = compile_xacro(path, constants, numbers, finder)
    if compiled is None:
        data = expand(path, {**constants, **numbers}, finder)
        return robot_from_xml(data, path, finder)
    body = robot_from_xml(compiled.fill(numbers), path, finder, trusted=compiled in _examined)
    _examined.add(compiled)
    return body


def _with_motion(body: Robot, manifest: Manifest, values: Mapping[str, float]) -> Robot:
    """The body with the manifest's home, efforts and velocities; continuous joints unlimited."""
    for key, entries in (
        ("home", manifest.home),
        ("effort", manifest.effort),
        ("velocity", manifest.velocity),
    ):
        for name in entries:
            if name not in body.joint_index:
                raise PartError(
                    f"{manifest.path}: {key}: no joint {name!r}{nearest(name, body.joint_index)}"
                )
    independent = [body.joints[k].name for k in body.independent_joints]
    for name in manifest.home:
        if name not in independent:
            raise PartError(f"{manifest.path}: home: {name!r} does not move by itself")
    home = {name: _evaluated(entry, manifest, values) for name, entry in manifest.home.items()}
    return replace(
        body,
        joints=tuple(
            replace(
                joint,
                effort=manifest.effort.get(joint.name, joint.effort),
                velocity=manifest.velocity.get(joint.name, joint.velocity),
                limits=None if joint.kind == "continuous" else joint.limits,
            )
            for joint in body.joints
        ),
        home=tuple(home.get(name, rest) for name, rest in zip(independent, body.home, strict=True)),
    )


def _with_bodies(body: Robot, manifest: Manifest) -> Robot:
    """The body with the manifest's shapes and masses."""
    for key, names in (
        ("mass", manifest.mass),
        ("drop", manifest.drop),
        ("collision_from_visual", manifest.collision_from_visual),
    ):
        for name in names:
            if name not in body.link_index:
                raise PartError(
                    f"{manifest.path}: {key}: no link {name!r}{nearest(name, body.link_index)}"
                )
    return replace(body, links=tuple(_with_body(link, manifest) for link in body.links))


def _with_body(link: Link, manifest: Manifest) -> Link:
    if link.name in manifest.drop:
        dropped = manifest.drop[link.name]
        link = replace(
            link, visuals=_kept(link.visuals, dropped), collisions=_kept(link.collisions, dropped)
        )
    if link.name in manifest.collision_from_visual:
        link = replace(link, collisions=tuple(replace(shape, rgba=None) for shape in link.visuals))
    if link.name in manifest.mass:
        mass = manifest.mass[link.name]
        return replace(link, inertial=inertial_from_mass(link, mass) if mass else None)
    if manifest.density is not None and link.inertial is None:
        return with_inertia(link, manifest.density)
    return link


def _kept(shapes: tuple[Shape, ...], dropped: tuple[str, ...]) -> tuple[Shape, ...]:
    return tuple(
        shape
        for shape in shapes
        if not (isinstance(shape.geometry, Mesh) and shape.geometry.path.name in dropped)
    )


def _mount(body: Robot, manifest: Manifest, values: Mapping[str, float]) -> Pose:
    if manifest.mount is None:
        return IDENTITY
    T_link_mount = _pose(manifest.mount, body, manifest, values)
    T_root_link = IDENTITY
    link = manifest.mount.link
    while link != manifest.root:
        joint = body.joints[body.link_index[link] - 1]
        if joint.is_movable:
            raise PartError(
                f"{manifest.path}: mount is on {manifest.mount.link!r}, which moves "
                f"({joint.name!r}) against the root {manifest.root!r}"
            )
        T_root_link = joint.T_parent_joint @ T_root_link
        link = joint.parent
    return T_root_link @ T_link_mount


def _pose(
    placement: FrameSpec, body: Robot, manifest: Manifest, values: Mapping[str, float]
) -> Pose:
    if placement.link not in body.link_index:
        raise PartError(
            f"{manifest.path}: no link {placement.link!r} in the part"
            + nearest(placement.link, body.link_index)
        )
    x, y, z = (_evaluated(entry, manifest, values) for entry in placement.xyz)
    roll, pitch, yaw = (_evaluated(entry, manifest, values) for entry in placement.rpy)
    return Pose.from_xyz_rpy((x, y, z), (roll, pitch, yaw))


def _evaluated(entry: Number, manifest: Manifest, values: Mapping[str, float]) -> float:
    if not isinstance(entry, str):
        return entry
    match = _EXPRESSION.fullmatch(entry.strip())
    if match is None:
        raise PartError(f"{manifest.path}: {entry!r} is neither a number nor ${{...}}")
    try:
        return evaluate(entry, values)
    except MorphgenError as error:
        raise PartError(f"{manifest.path}: {entry}: {error}") from error
