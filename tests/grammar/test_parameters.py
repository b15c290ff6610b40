"""Part parameters: units, ranges and error messages."""

import math

import pytest

from morphgen.errors import PartError
from morphgen.grammar.manifest import (
    MOUNT_YAW_PARAMETER,
    Parameter,
    parse_value,
    resolve_values,
)

SIZE = Parameter(0.1, 0.05, 0.5, "m")


@pytest.mark.parametrize(
    ("text", "value"), [("0.1", 0.1), ("80mm", 0.08), ("12 cm", 0.12), ("1e-1m", 0.1)]
)
def test_lengths(text, value):
    assert parse_value(text, SIZE, "ee.size") == pytest.approx(value)


def test_degrees_become_radians():
    assert parse_value("45deg", MOUNT_YAW_PARAMETER, "ee.mount_yaw") == pytest.approx(math.pi / 4)


@pytest.mark.parametrize("text", ["45deg", "1kg", "3 furlongs"])
def test_a_wrong_unit_is_an_error_that_lists_the_valid_ones(text):
    with pytest.raises(PartError, match=r"ee\.size=.*wrong unit.*units: m/cm/mm"):
        parse_value(text, SIZE, "ee.size")


@pytest.mark.parametrize("text", ["big", "", "1.2.3", "nan", "inf", "0x10"])
def test_values_that_are_not_numbers_are_errors(text):
    with pytest.raises(PartError, match="not a number"):
        parse_value(text, SIZE, "ee.size")


@pytest.mark.parametrize("text", ["0.6", "10mm", "-0.1"])
def test_a_value_out_of_range_is_an_error_that_names_the_range(text):
    with pytest.raises(PartError, match=r"out of range; expected 0\.05 to 0\.5 m"):
        parse_value(text, SIZE, "ee.size")


def test_an_unknown_parameter_suggests_the_nearest():
    with pytest.raises(PartError, match="no parameter 'sise'; did you mean 'size'"):
        resolve_values({"sise": 0.1}, {"size": SIZE}, "plane")


def test_a_default_outside_its_range_is_a_manifest_error():
    with pytest.raises(ValueError, match="default 2 is outside"):
        Parameter(2.0, 0.0, 1.0, "m")
