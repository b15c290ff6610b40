"""Parameters of parts: their units, defaults and ranges, and reading their values."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from morphgen.errors import PartError, nearest
from morphgen.formats.rounding import format_number

_SCALES: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "kg": {"kg": 1.0, "g": 0.001},
    "": {},
}
UNITS: Mapping[str, tuple[str, float]] = {
    name: (unit, scale) for unit, scales in _SCALES.items() for name, scale in scales.items()
}
"""Every unit that can be written: the SI unit it stands for, and its factor."""
_VALUE = re.compile(
    r"(?P<number>[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*(?P<unit>[a-zA-Z]*)"
)


@dataclass(frozen=True)
class Parameter:
    """A number that shapes a part."""

    name: str
    default: float
    minimum: float
    maximum: float
    unit: str = ""
    """``m``, ``rad``, ``kg``, or empty for a pure number."""
    summary: str = ""
    integer: bool = False
    """Whether only whole numbers make sense, such as a count."""

    def __post_init__(self) -> None:
        if self.unit not in _SCALES:
            raise PartError(f"parameter {self.name}: unknown unit {self.unit!r}{_units()}")
        if not self.minimum <= self.default <= self.maximum:
            raise PartError(
                f"parameter {self.name}: default {self.default:g} is outside "
                f"[{self.minimum:g}, {self.maximum:g}]"
            )


MOUNT_YAW = Parameter(
    "mount_yaw", 0.0, -2 * math.pi, 2 * math.pi, "rad", "turn about the axis of the port"
)
"""Every attached part has it."""


def parse_value(text: str, parameter: Parameter, where: str) -> float:
    """Read a number with an optional unit, such as ``45deg`` or ``80mm``.

    Args:
        text: What the user wrote; without a unit it is in SI.
        parameter: What it is for.
        where: Its name as the user wrote it, for messages.

    Returns:
        The value in SI units.

    Raises:
        PartError: If it is no number, its unit is of another kind, or it is out of range.
    """
    match = _VALUE.fullmatch(text.strip())
    if match is None:
        raise PartError(f"{where}={text}: not a number{_expected(parameter)}")
    value, unit = float(match["number"]), match["unit"]
    if unit:
        scales = _SCALES[parameter.unit]
        if unit not in scales:
            raise PartError(f"{where}={text}: wrong unit {unit!r}{_expected(parameter)}")
        value *= scales[unit]
    return require_range(float(format_number(value)), parameter, where)


def require_range(value: float, parameter: Parameter, where: str) -> float:
    """Return the value if it lies in the parameter's range, to 12 digits.

    Raises:
        PartError: If it does not.
    """
    low = min(parameter.minimum, float(format_number(parameter.minimum)))
    high = max(parameter.maximum, float(format_number(parameter.maximum)))
    if not low <= value <= high:
        raise PartError(f"{where}={value:g}: out of range{_expected(parameter)}")
    if parameter.integer and value != int(value):
        raise PartError(f"{where}={value:g}: not a whole number{_expected(parameter)}")
    return value


def resolve_values(
    values: Mapping[str, float], parameters: Mapping[str, Parameter], where: str
) -> dict[str, float]:
    """Complete values with defaults, in the order of the parameters.

    Raises:
        PartError: If a name is unknown or a value is out of range.
    """
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
    units = "/".join(_SCALES[parameter.unit])
    unit = f" {units}" if units else ""
    low, high = f"{parameter.minimum:.4g}", f"{parameter.maximum:.4g}"
    return f"; expected {low} to {high} {parameter.unit}".rstrip() + (
        f" (units:{unit})" if unit else ""
    )


def _units() -> str:
    return nearest("", (unit or "(none)" for unit in _SCALES))
