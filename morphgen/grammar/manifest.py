"""Manifests: the YAML files that describe templates and real parts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

from msgspec import field
from msgspec.structs import fields, replace

from morphgen.errors import FormatError, PartError, nearest
from morphgen.formats.data_files import parse_yaml, read_bytes
from morphgen.formats.records import FiniteNumber, PositiveNumber, Record, read_record, value_line

SCHEMA_FILE = Path(__file__).with_name("manifest.schema.json")
"""The JSON schema of a manifest, for editors; ``docs/part_manifest.py`` writes it."""

Unit = Literal["m", "rad", "kg", "N", "N s/m", ""]
_SCALES: dict[Unit, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "kg": {"kg": 1.0, "g": 0.001},
    "N": {"N": 1.0},
    "N s/m": {},
    "": {},
}
UNITS: Mapping[str, tuple[str, float]] = {
    name: (unit, scale) for unit, scales in _SCALES.items() for name, scale in scales.items()
}
"""SI unit and factor of every unit that can be written."""
_VALUE = re.compile(
    r"(?P<number>[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*(?P<unit>[a-zA-Z]*)"
)


class Parameter(Record, frozen=True):
    """A number that shapes a part, in SI units."""

    default: FiniteNumber
    """Value of a part that does not name the parameter [its `unit`]."""
    minimum: FiniteNumber = field(name="min")
    """Smallest valid value [its `unit`]."""
    maximum: FiniteNumber = field(name="max")
    """Largest valid value [its `unit`]."""
    unit: Unit = ""
    """SI unit; empty for a pure number."""
    summary: str = ""
    """Description in a few words, for the viewer."""
    integer: bool = False
    """Whether only integers are valid, such as for a count."""

    def __post_init__(self) -> None:
        if not self.minimum <= self.default <= self.maximum:
            raise ValueError(
                f"default {self.default:g} is outside [{self.minimum:g}, {self.maximum:g}]"
            )


MOUNT_YAW = "mount_yaw"
"""Name of the parameter that every attached part has."""
MOUNT_YAW_PARAMETER = Parameter(
    0.0, -2 * math.pi, 2 * math.pi, "rad", "rotation about the axis of the port"
)


def parse_value(text: str, parameter: Parameter, where: str) -> float:
    """Return a number with an optional unit, such as ``45deg`` or ``80mm``, in SI units."""
    match = _VALUE.fullmatch(text.strip())
    if match is None:
        raise PartError(f"{where}={text}: not a number{_expected(parameter)}")
    from morphgen.formats.rounding import format_number  # loads numpy: lists need no values

    value, unit = float(match["number"]), match["unit"]
    if unit:
        scales = _SCALES[parameter.unit]
        if unit not in scales:
            raise PartError(f"{where}={text}: wrong unit {unit!r}{_expected(parameter)}")
        value *= scales[unit]
    return require_range(float(format_number(value)), parameter, where)


def require_range(value: float, parameter: Parameter, where: str) -> float:
    """Return the value if it is in the parameter's range, to 12 digits."""
    from morphgen.formats.rounding import format_number

    low = min(parameter.minimum, float(format_number(parameter.minimum)))  # 2 pi rounds up
    high = max(parameter.maximum, float(format_number(parameter.maximum)))
    if not low <= value <= high:
        raise PartError(f"{where}={value:g}: out of range{_expected(parameter)}")
    if parameter.integer and value != int(value):
        raise PartError(f"{where}={value:g}: not a whole number{_expected(parameter)}")
    return value


def resolve_values(
    values: Mapping[str, float], parameters: Mapping[str, Parameter], where: str
) -> dict[str, float]:
    """Complete values with defaults, in the order of the parameters."""
    for name in values:
        if name not in parameters:
            raise PartError(f"{where} has no parameter {name!r}{nearest(name, parameters)}")
    return {
        name: require_range(values[name], parameter, f"{where}.{name}")
        if name in values
        else parameter.default
        for name, parameter in parameters.items()
    }


def _expected(parameter: Parameter) -> str:
    low, high = f"{parameter.minimum:.4g}", f"{parameter.maximum:.4g}"
    units = "/".join(_SCALES[parameter.unit])
    expected = f"; expected {low} to {high} {parameter.unit}".rstrip()
    return expected + (f" (units: {units})" if units else "")


PartKind = Literal["base", "arm", "ee", "segment", "body", "object"]
PART_KINDS: tuple[PartKind, ...] = ("base", "arm", "ee", "segment", "body", "object")
"""A segment is a piece that grammars chain; a body is a complete robot; an object stands before a
robot and has one joint, without a motor."""
Number = FiniteNumber | str
"""A number, or an expression over the part's parameters such as ``${size / 2}``."""

REAL_ONLY = {"source", "citation", "mass", "drop", "collision_from_visual", "scaling"}
"""Keys of parts whose source is a data package."""
TEMPLATE_ONLY = {"file", "density", "reference"}
"""Keys of parts whose source is a file; ``reference`` is their ``citation``."""


class FrameSpec(Record, frozen=True):
    """A frame on one of the part's links."""

    link: str
    """Link that carries the frame."""
    xyz: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    """Position in the link frame [m]."""
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    """Orientation in the link frame as roll, pitch, yaw [rad]."""


class Scaling(Record, frozen=True):
    """How a link of a real part is scaled."""

    parameter: str | None = field(default=None, name="by")
    """Name of the parameter that holds the scale factor; without it the link keeps its size."""
    face: tuple[FiniteNumber, FiniteNumber, FiniteNumber] = (0.0, 0.0, 0.0)
    """Point where the link meets its parent, in the link frame at factor 1 [m]."""


class PackageSource(Record, frozen=True):
    """A URDF, xacro or MJCF file of an installed data package."""

    package: str
    """Name of the pip package."""
    file: str
    """URDF, xacro or MJCF, relative to the folder in which pip installed the package."""
    raw_args: Mapping[str, str | bool | int | float] = field(default_factory=dict, name="args")
    """Arguments of the xacro, by name."""

    @property
    def args(self) -> dict[str, str]:
        """Arguments as xacro spells them: booleans are ``true`` and ``false``."""
        return {
            name: str(value).lower() if isinstance(value, bool) else str(value)
            for name, value in self.raw_args.items()
        }


class Manifest(Record, frozen=True, kw_only=True, dict=True):
    """Description of a part: its source file, frames, parameters and corrections of the source."""

    name: str
    """Name of the part, the same as that of the YAML file."""
    kind: PartKind
    """Kind of the part. Only grammars use a ``segment``, which they chain, and a ``body``, which is
    a complete robot. An ``object`` stands before a robot; it has one joint, without a motor."""
    summary: str
    """Description in one line, for ``morphgen list``."""
    root: str
    """Link whose subtree is the part."""
    licence: str
    """Licence of the source; every card repeats it."""
    manufacturer: str = ""
    """Manufacturer of the real product, such as ``Kinova``; empty for a part that is none."""
    path: Path = field(default_factory=Path)
    """The YAML file."""
    package_source: PackageSource | None = field(default=None, name="source")
    """File of an installed data package."""
    file: str = ""
    """URDF, xacro or MJCF, relative to the YAML file."""
    without: tuple[str, ...] = ()
    """Links that are left out, with everything below them."""
    mount: FrameSpec | None = None
    """Frame that is attached to the parent's port; by default the root's frame."""
    ports: Mapping[str, FrameSpec] = {}
    """Frames that other parts can be attached to, by name."""
    tool: FrameSpec | None = None
    """Frame at the working point, for example between the fingertips; its z axis points away from
    the mount."""
    home: Mapping[str, Number] = {}
    """Home position by joint [rad or m]."""
    effort: Mapping[str, FiniteNumber] = {}
    """Effort limits that replace the source's, by joint [N m or N]."""
    velocity: Mapping[str, FiniteNumber] = {}
    """Velocity limits that replace the source's, by joint [rad/s or m/s]."""
    mass: Mapping[str, FiniteNumber] = {}
    """Masses that replace the source's, by link [kg]; the inertia then follows from the geometry.
    A mass of 0 removes the inertial."""
    drop: Mapping[str, tuple[str, ...]] = {}
    """File names of meshes whose shapes are left out, by link."""
    collision_from_visual: tuple[str, ...] = ()
    """Links whose visual shapes replace their collision shapes."""
    accepted: Mapping[str, Mapping[str, str]] = {}
    """Reasons why findings of ``check`` are no faults, by link or joint and finding code."""
    link_scaling: Mapping[str, str | Scaling] = field(default_factory=dict, name="scaling")
    """Scaling by link, or only the name of its parameter."""
    density: PositiveNumber | None = None
    """Density of links without inertial [kg/m^3]."""
    parameters: Mapping[str, Parameter] = {}
    """Numbers that shape the part, by name. A xacro gets them as its arguments."""
    citation: str = ""
    """Publication or repository of the part's model, as one cites it."""
    notes: str = ""
    """Reasons for the corrections of the source."""

    @property
    def is_template(self) -> bool:
        """Whether the part is procedural."""
        return self.package_source is None

    @cached_property
    def source(self) -> PackageSource | Path:
        """A file of a data package, or the template's own xacro."""
        return self.package_source or self.path.parent / self.file

    @cached_property
    def scaling(self) -> dict[str, Scaling]:
        """Scaling by link; everything attached to a link moves with it."""
        return {
            link: Scaling(entry) if isinstance(entry, str) else entry
            for link, entry in self.link_scaling.items()
        }

    @cached_property
    def attached_parameters(self) -> dict[str, Parameter]:
        """The part's parameters, and that of how it is attached."""
        return {**self.parameters, MOUNT_YAW: MOUNT_YAW_PARAMETER}


@cache
def _keys() -> frozenset[str]:
    """Return the keys of all manifests."""
    return frozenset({entry.encode_name for entry in fields(Manifest)} - {"path"} | {"reference"})


def read_manifest(path: Path) -> Manifest:
    """Read a part's YAML. A key without a value is the same as no key."""
    try:
        text = read_bytes(path)
        data = parse_yaml(text, str(path)) or {}
    except FormatError as error:
        raise PartError(str(error)) from error
    if isinstance(data, dict):
        data = {key: value for key, value in data.items() if value is not None}
        allowed = _keys() - (TEMPLATE_ONLY if "source" in data else REAL_ONLY)
        for key in data:
            if isinstance(key, str) and key not in allowed:
                line = value_line(text, (key,))
                raise PartError(f"{path}:{line}: unknown key {key!r}{nearest(key, allowed)}")
        if "reference" in data:
            data["citation"] = data.pop("reference")
    manifest = read_record(data, Manifest, str(path), PartError, yaml_text=text)
    if manifest.package_source is None and not manifest.file:
        raise PartError(f"{path}: needs 'source' (a data package) or 'file' (a template)")
    if manifest.name != path.stem:
        raise PartError(f"{path}: name {manifest.name!r} differs from the file's, {path.stem!r}")
    return replace(
        manifest, path=path, citation=manifest.citation.strip(), notes=manifest.notes.strip()
    )
