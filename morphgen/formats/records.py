"""Typed reading of YAML and JSON: plain data to frozen records, with errors that locate the fault.

Declare a file's content as a ``Record``: its fields are the keys, its annotations the checks.

    class Range(Record, frozen=True):
        low: PositiveNumber
        high: Annotated[float, Meta(lt=100)]
        unit: Literal["m", "rad"] = "m"

    class Part(Record, frozen=True):
        name: str
        robot_hash: str = field(name="body")  # msgspec.field; "body" is the key in the file
        parameters: dict[str, Range] = field(default_factory=dict)

    part = read_record(data, Part, "arm.yaml", PartError)

Errors read ``arm.yaml: parameters.size.low: invalid value -1; expected a number > 0`` or
``arm.yaml: parameters.size: unknown key 'hihg'; did you mean 'high'? valid: high, low, unit``.
With the file's YAML text as ``yaml_text`` they begin ``arm.yaml:7:``, the line of the value.

The conversion is msgspec's. It changes no types except whole numbers to floats and lists to
tuples; the text ``"3"`` is not a number. A ``ValueError`` of ``__post_init__`` is an error, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
import yaml
from msgspec import Meta

from morphgen.errors import FormatError, MorphgenError, nearest, shortened

T = TypeVar("T")
KeyPath = tuple[str | int, ...]  # keys and list indices from the top of the data to a value

_LARGEST = 1e12  # largest size of a number: more than a robot can hold in SI units
FiniteNumber = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
"""A number that is neither NaN nor infinite, nor beyond what a robot can hold in SI units."""
PositiveNumber = Annotated[float, Meta(gt=0, le=_LARGEST)]

_WORDS = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "an integer",
    "null": "null",
    "object": "keys and values",
    "str": "text",
}
"""Words for the type names in msgspec's messages."""
_BOUNDS = {
    f"`float` >= {-_LARGEST}": "a finite number from -1e12 to 1e12",
    f"`float` <= {_LARGEST}": "a finite number up to 1e12",
}
"""Words for the bounds of ``FiniteNumber`` and ``PositiveNumber`` in msgspec's messages."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the types that describe the content of a file."""


def read_record(
    data: object,
    kind: type[T],
    where: str,
    error: type[MorphgenError] = FormatError,
    *,
    yaml_text: str | bytes | None = None,
) -> T:
    """Convert plain data to a declared type."""
    try:
        return msgspec.convert(data, kind, strict=True)
    except msgspec.ValidationError as invalid:
        path, reason = _fault(data, kind, ())
        line = "" if yaml_text is None else f":{value_line(yaml_text, path)}"
        steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
        location = f"{''.join(steps).removeprefix('.')}: " if path else ""
        raise error(f"{where}{line}: {location}{reason}") from invalid


def _fault(data: object, hint: Any, path: KeyPath) -> tuple[KeyPath, str]:  # noqa: ANN401
    """Return the path of the innermost invalid value, and what is wrong with it."""
    for step, value, value_hint in _entries(data, hint):
        if _error(value, value_hint):
            return _fault(value, value_hint, (*path, step))
    if isinstance(data, dict) and (reason := _key_fault(data, _member(data, hint))):
        return path, reason
    if get_origin(hint) is Literal:
        return (
            path,
            f"unknown value {shortened(repr(data))}{nearest(str(data), map(str, get_args(hint)))}",
        )
    reason = _error(data, hint)
    if reason.startswith("expected"):
        reason = f"invalid value {shortened(repr(data))}; {reason}"
    return path, reason


def _key_fault(data: dict[Any, Any], hint: Any) -> str:  # noqa: ANN401
    """Return what is wrong with the keys of an object, if anything."""
    for key in data:
        if not isinstance(key, str):
            return f"key {shortened(repr(key))} is not text; quote it"
    if _is_record(hint):
        keys = [field.encode_name for field in msgspec.structs.fields(hint)]
        for key in data:
            if key not in keys:
                return f"unknown key {shortened(repr(key))}{nearest(key, keys)}"
    return ""


def _error(data: object, hint: Any) -> str:  # noqa: ANN401
    """Return msgspec's message for data of another type in the words of users, else nothing."""
    try:
        msgspec.convert(data, hint, strict=True)
    except msgspec.ValidationError as error:
        reason = re.sub(r", got `\w+`$", "", str(error).partition(" - at ")[0])
        reason = re.sub("^Object missing required field", "missing key", reason)
        reason = re.sub("^Number out of range", "expected a smaller number", reason)
        for bound, words in _BOUNDS.items():
            reason = reason.replace(bound, words)
        return re.sub(
            r"`([^`]*)`",
            lambda match: " or ".join(_WORDS.get(w, repr(w)) for w in match[1].split(" | ")),
            re.sub("^Expected", "expected", reason),
        )
    return ""


def _entries(data: object, hint: Any) -> Iterator[tuple[str | int, object, Any]]:  # noqa: ANN401
    """Yield key or index, value and declared type of all that an object or list contains."""
    hint = _member(data, hint)
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    arguments = get_args(hint)
    if isinstance(data, dict) and _is_record(hint):
        for field in msgspec.structs.fields(hint):
            if field.encode_name in data:
                yield field.encode_name, data[field.encode_name], field.type
    elif isinstance(data, dict) and arguments and _shape(hint) is dict:
        yield from ((key, value, arguments[1]) for key, value in data.items())
    elif isinstance(data, list) and arguments and _shape(hint) is list:
        fixed = get_origin(hint) is tuple and arguments[-1] is not ...
        for i, value in enumerate(data[: len(arguments)] if fixed else data):
            yield i, value, arguments[i if fixed else 0]


def _member(data: object, hint: Any) -> Any:  # noqa: ANN401
    """Return the member of a union that is read from an object or a list, if data is one."""
    shape = dict if isinstance(data, dict) else list if isinstance(data, list) else None
    if shape is None or get_origin(hint) not in (Union, UnionType):
        return hint
    return next((member for member in get_args(hint) if _shape(member) is shape), hint)


def _shape(hint: Any) -> type | None:  # noqa: ANN401
    origin = get_origin(hint) or hint
    if origin is Annotated:
        return _shape(get_args(hint)[0])
    if origin in (list, tuple, Sequence):
        return list
    return dict if origin in (dict, Mapping) or _is_record(hint) else None


def _is_record(hint: object) -> bool:
    return isinstance(hint, type) and issubclass(hint, msgspec.Struct)


def value_line(text: str | bytes, path: KeyPath) -> int:
    """Return the line of a value in YAML text."""
    node = yaml.compose(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    line = 1
    for step in path:
        if isinstance(node, yaml.MappingNode):
            node = next((value for key, value in node.value if key.value == step), None)
        elif isinstance(node, yaml.SequenceNode) and isinstance(step, int):
            node = node.value[step]
        if node is not None:
            line = node.start_mark.line + 1
    return line


def dotted_values(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values in nested dictionaries, and in lists of them, by their dotted names."""
    values: dict[str, Any] = {}
    for name, value in data.items():
        if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
            entries = {f"{name}[{i}]": each for i, each in enumerate(value)}
            values |= dotted_values(entries, prefix)
        elif isinstance(value, dict) and value:
            values |= dotted_values(value, f"{prefix}{name}.")
        else:
            values[prefix + name] = value
    return values
