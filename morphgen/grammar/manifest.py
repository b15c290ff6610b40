"""Manifests: the YAML that describes a template or a real part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from morphgen.errors import FormatError, PartError, nearest
from morphgen.formats.data_files import read_bytes, require_plain_yaml
from morphgen.grammar.parameters import Parameter

PartKind = Literal["base", "arm", "ee", "segment", "body"]
PART_KINDS: tuple[PartKind, ...] = ("base", "arm", "ee", "segment", "body")
"""A segment is a piece that grammars chain; a body is a whole robot by itself."""
Number = float | str
"""A number, or an expression over the part's parameters such as ``${size / 2}``."""

_REQUIRED = {"name", "kind", "summary", "root", "licence"}
_COMMON = _REQUIRED | {
    "accepted",
    "effort",
    "home",
    "mount",
    "notes",
    "ports",
    "tool",
    "velocity",
    "without",
}
_REAL = _COMMON | {
    "source",
    "citation",
    "mass",
    "drop",
    "collision_from_visual",
    "parameters",
    "scaling",
}
_TEMPLATE = _COMMON | {"file", "density", "parameters", "reference"}


@dataclass(frozen=True)
class FrameSpec:
    """A frame on one of the part's links."""

    link: str
    xyz: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scaling:
    """How one of the part's links grows."""

    parameter: str | None = None
    """Name of the parameter that holds its factor; without one the link keeps its size."""
    face: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where it meets its parent at factor 1, in its own frame, metres; see ``model.scaling``."""


@dataclass(frozen=True)
class PackageSource:
    """A file of an installed data package."""

    package: str
    file: str
    args: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Manifest:
    """What a part is and where it is described."""

    name: str
    kind: PartKind
    summary: str
    path: Path
    """The YAML file."""
    source: PackageSource | Path
    """A file of a data package, or the template's own xacro."""
    root: str
    licence: str
    without: tuple[str, ...] = ()
    mount: FrameSpec | None = None
    ports: Mapping[str, FrameSpec] = field(default_factory=dict)
    tool: FrameSpec | None = None
    home: Mapping[str, Number] = field(default_factory=dict)
    effort: Mapping[str, float] = field(default_factory=dict)
    velocity: Mapping[str, float] = field(default_factory=dict)
    mass: Mapping[str, float] = field(default_factory=dict)
    """Masses that replace the source's; inertia then follows from geometry. 0: no inertial."""
    drop: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of mesh files, by link, whose shapes are left out."""
    collision_from_visual: tuple[str, ...] = ()
    """Links whose visual shapes replace their collision shapes."""
    accepted: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Findings that are as they should be: by link or joint and code, why."""
    scaling: Mapping[str, Scaling] = field(default_factory=dict)
    """How links grow with all that is on them, by link."""
    density: float | None = None
    """Of links without inertial, kg/m^3."""
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    citation: str = ""
    notes: str = ""

    @property
    def is_template(self) -> bool:
        """Whether the part is procedural."""
        return isinstance(self.source, Path)


def read_manifest(path: Path) -> Manifest:
    """Read a part's YAML.

    Raises:
        PartError: If it is no YAML, lacks a key, has an unknown or a repeated one, or a value of
            wrong type; the message names the file and the key.
    """
    data = _mapping(load_yaml(path), str(path))
    allowed = _REAL if "source" in data else _TEMPLATE
    for key in data:
        if key not in allowed:
            raise PartError(f"{path}: unknown key {key!r}{nearest(str(key), allowed)}")
    for key in sorted(_REQUIRED - set(data)):
        raise PartError(f"{path}: key {key!r} is missing")
    if data["kind"] not in PART_KINDS:
        raise PartError(f"{path}: kind {data['kind']!r}{nearest(str(data['kind']), PART_KINDS)}")
    if data["name"] != path.stem:
        raise PartError(f"{path}: name {data['name']!r} differs from the file's, {path.stem!r}")
    ports = _mapping(data.get("ports", {}), f"{path}: ports")
    parameters = _mapping(data.get("parameters", {}), f"{path}: parameters")
    return Manifest(
        name=data["name"],
        kind=data["kind"],
        summary=str(data["summary"]),
        path=path,
        source=_source(data, path),
        root=str(data["root"]),
        licence=str(data["licence"]),
        without=_names(data.get("without"), f"{path}: without"),
        mount=_placement(data["mount"], f"{path}: mount") if "mount" in data else None,
        ports={name: _placement(port, f"{path}: ports.{name}") for name, port in ports.items()},
        tool=_placement(data["tool"], f"{path}: tool") if "tool" in data else None,
        home=_home(data, path),
        effort=_numbers(data, "effort", path),
        velocity=_numbers(data, "velocity", path),
        mass=_numbers(data, "mass", path),
        drop={
            link: _names(names, f"{path}: drop.{link}")
            for link, names in _mapping(data.get("drop"), f"{path}: drop").items()
        },
        scaling={
            link: _scaling(entry, f"{path}: scaling.{link}")
            for link, entry in _mapping(data.get("scaling"), f"{path}: scaling").items()
        },
        collision_from_visual=_names(
            data.get("collision_from_visual"), f"{path}: collision_from_visual"
        ),
        accepted={
            name: {
                code: str(why) for code, why in _mapping(whys, f"{path}: accepted.{name}").items()
            }
            for name, whys in _mapping(data.get("accepted"), f"{path}: accepted").items()
        },
        density=_positive(data["density"], f"{path}: density") if "density" in data else None,
        parameters={name: _parameter(name, entry, path) for name, entry in parameters.items()},
        citation=str(data.get("citation", data.get("reference", ""))).strip(),
        notes=str(data.get("notes", "")).strip(),
    )


def load_yaml(path: Path) -> object:
    """The content of a YAML file.

    Raises:
        PartError: If it cannot be read; a syntax error is named by line and column.
    """
    try:
        data = read_bytes(path)
        require_plain_yaml(data, str(path))
        return yaml.load(data, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        location = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        raise PartError(f"{path}{location}: no valid YAML: {error.problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise PartError(f"{path}: no valid YAML: {' '.join(str(error).split())}") from error
    except FormatError as error:
        raise PartError(str(error)) from error
    except OSError as error:
        raise PartError(f"{path}: cannot be read: {error.strerror}") from error


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Safe, and a key may be given once only."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is given twice", key.start_mark
                )
            seen.add(key.value)
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        return found


def _source(data: Mapping[str, Any], path: Path) -> PackageSource | Path:
    if "source" not in data:
        if "file" not in data:
            raise PartError(f"{path}: needs 'source' (a data package) or 'file' (a template)")
        return path.parent / str(data["file"])
    source = _mapping(data["source"], f"{path}: source")
    for key in ("package", "file"):
        if key not in source:
            raise PartError(f"{path}: source.{key} is missing")
    args = _mapping(source.get("args", {}), f"{path}: source.args")
    return PackageSource(
        str(source["package"]), str(source["file"]), {k: _arg(v) for k, v in args.items()}
    )


def _arg(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _placement(data: object, where: str) -> FrameSpec:
    entries = _mapping(data, where)
    for key in entries:
        if key not in ("link", "xyz", "rpy"):
            raise PartError(f"{where}: unknown key {key!r}{nearest(key, ('link', 'xyz', 'rpy'))}")
    if "link" not in entries:
        raise PartError(f"{where}: key 'link' is missing")
    return FrameSpec(
        str(entries["link"]),
        _triple(entries.get("xyz", (0, 0, 0)), f"{where}.xyz"),
        _triple(entries.get("rpy", (0, 0, 0)), f"{where}.rpy"),
    )


def _triple(data: object, where: str) -> tuple[Number, Number, Number]:
    if not isinstance(data, list | tuple) or len(data) != 3:
        raise PartError(f"{where}: {data!r} is not three numbers")
    x, y, z = (value if isinstance(value, str) else _float(value, where) for value in data)
    return (x, y, z)


def _parameter(name: str, data: object, path: Path) -> Parameter:
    where = f"{path}: parameters.{name}"
    entries = _mapping(data, where)
    allowed = ("default", "min", "max", "unit", "integer", "summary")
    for key in entries:
        if key not in allowed:
            raise PartError(f"{where}: unknown key {key!r}{nearest(key, allowed)}")
    for key in ("default", "min", "max"):
        if key not in entries:
            raise PartError(f"{where}: key {key!r} is missing")
    low, high = _float(entries["min"], where), _float(entries["max"], where)
    return Parameter(
        name,
        _float(entries["default"], where),
        low,
        high,
        str(entries.get("unit", "")),
        str(entries.get("summary", "")),
        bool(entries.get("integer", False)),
    )


def _numbers(data: Mapping[str, Any], key: str, path: Path) -> dict[str, float]:
    entries = _mapping(data.get(key, {}), f"{path}: {key}")
    return {name: _float(value, f"{path}: {key}.{name}") for name, value in entries.items()}


def _home(data: Mapping[str, Any], path: Path) -> dict[str, Number]:
    entries = _mapping(data.get("home", {}), f"{path}: home")
    return {
        name: value if isinstance(value, str) else _float(value, f"{path}: home.{name}")
        for name, value in entries.items()
    }


def _scaling(data: object, where: str) -> Scaling:
    if isinstance(data, str):
        return Scaling(data)
    if not isinstance(data, dict):
        raise PartError(f"{where}: expected a parameter, or keys 'by' and 'face', not {data!r}")
    entries = _mapping(data, where)
    for key in entries:
        if key not in ("by", "face"):
            raise PartError(f"{where}: unknown key {key!r}{nearest(key, ('by', 'face'))}")
    parameter = entries.get("by")
    if not isinstance(parameter, str | None):
        raise PartError(f"{where}.by: {parameter!r} is not the name of a parameter")
    x, y, z = _triple(entries.get("face", (0, 0, 0)), f"{where}.face")
    location = f"{where}.face"
    return Scaling(parameter, (_float(x, location), _float(y, location), _float(z, location)))


def _float(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PartError(f"{where}: {value!r} is not a number")
    if abs(value) > 1e12 or math.isnan(value):
        raise PartError(f"{where}: {value:.6} is no number of a robot")
    return float(value)


def _positive(value: object, where: str) -> float:
    number = _float(value, where)
    if number <= 0:
        raise PartError(f"{where}: {number:g} is not positive")
    return number


def _names(data: object, where: str) -> tuple[str, ...]:
    if data is None:
        return ()
    if not isinstance(data, list) or not all(isinstance(name, str) for name in data):
        raise PartError(f"{where}: expected a list of names, not {data!r}")
    return tuple(data)


def _mapping(data: object, where: str) -> Mapping[str, Any]:
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise PartError(f"{where}: expected keys and values, not {data!r}")
    for key in data:
        if not isinstance(key, str):
            raise PartError(f"{where}: key {key!r} is not text; quote it")
    return data
