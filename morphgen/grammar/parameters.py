"""Parameters of parts: units, defaults and ranges, and parsing their values."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Literal

from msgspec import field

from morphgen.errors import PartError, nearest
from morphgen.formats.records import FiniteNumber, Record
from morphgen.formats.rounding import format_number

Unit = Literal["m", "rad", "kg", ""]
_SCALES: dict[Unit, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "kg": {"kg": 1.0, "g": 0.001},
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
    """Parse a number with an optional unit, such as ``45deg`` or ``80mm``.

    Args:
        text: The user's text; a number without a unit is in SI units.
        parameter: The parameter that the value is for.
        where: The parameter's name as the user wrote it, for messages.

    Returns:
        The value in SI units.

    Raises:
        PartError: If the text is not a number, has the wrong unit, or is out of range.
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
    """Return the value if it is in the parameter's range, to 12 digits.

    Raises:
        PartError: If it is not.
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
    low, high = f"{parameter.minimum:.4g}", f"{parameter.maximum:.4g}"
    units = "/".join(_SCALES[parameter.unit])
    expected = f"; expected {low} to {high} {parameter.unit}".rstrip()
    return expected + (f" (units: {units})" if units else "")
