"""Converting plain data to dataclasses; errors name file, line, key and valid values."""

import math
from typing import Annotated, Literal

import pytest
import yaml
from msgspec import Meta, field

from morphgen.errors import FormatError, PartError
from morphgen.formats.records import FiniteNumber, PositiveNumber, Record, read_record


class Range(Record, frozen=True):
    low: PositiveNumber
    high: FiniteNumber | str
    unit: Literal["m", "rad"] = "m"

    def __post_init__(self):
        if isinstance(self.high, float) and self.low > self.high:
            raise ValueError(f"low {self.low:g} is above high {self.high:g}")


class Part(Record, frozen=True):
    name: str
    robot_hash: str = field(default="", name="body")
    parameters: dict[str, Range] = field(default_factory=dict)
    home: tuple[float, float] | None = None
    links: Annotated[tuple[str, ...], Meta(max_length=3)] = ()
    scaling: str | Range | None = None
    extra: object = None


WHOLE = """\
name: arm
body: 00ff
parameters:
  size: {low: 1, high: 2.5, unit: rad}
  count:
    low: 3
    high: ${size}
home: [0, -1.5]
links: [a, b]
scaling: {low: 1, high: 1}
extra: {anything: [1, null]}
"""


def test_nested_data_becomes_dataclasses():
    part = read_record(yaml.safe_load(WHOLE), Part, "arm.yaml")
    assert type(part.parameters["size"].low) is float  # from a whole number
    assert part == Part(
        "arm",
        "00ff",
        {"size": Range(1.0, 2.5, "rad"), "count": Range(3.0, "${size}")},
        (0.0, -1.5),
        ("a", "b"),
        Range(1.0, 1.0),
        {"anything": [1, None]},
    )


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("low", math.nan, "a number > 0.0"),
        ("low", math.inf, "a finite number up to 1e12"),
        ("high", math.nan, "a finite number from -1e12 to 1e12"),
        ("high", -math.inf, "a finite number from -1e12 to 1e12"),
        ("high", 1e13, "a finite number up to 1e12"),
    ],
)
def test_numbers_that_are_not_finite_are_called_so(key, value, expected):
    class Numbers(Record, frozen=True):
        low: PositiveNumber = 1.0
        high: FiniteNumber = 1.0

    with pytest.raises(FormatError) as caught:
        read_record({key: value}, Numbers, "x")
    assert str(caught.value) == f"x: {key}: invalid value {value}; expected {expected}"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name: arm\n", "", "1: missing key 'name'"),
        ("name: arm", "name: 3", "1: name: invalid value 3; expected text"),
        ("body: 00ff", "bodi: 00ff", "1: unknown key 'bodi'; did you mean 'body'? valid: body, "),
        ("body: 00ff", "robot_hash: 00ff", "1: unknown key 'robot_hash'; "),
        ("low: 3", "low: 0", "6: parameters.count.low: invalid value 0; expected a number > 0"),
        ("low: 3", "low: true", "6: parameters.count.low: invalid value True; expected a number"),
        ("low: 3", "low: '3'", "6: parameters.count.low: invalid value '3'; expected a number"),
        ("low: 3", "lwo: 3", "6: parameters.count: unknown key 'lwo'; did you mean 'low'? valid: "),
        ("low: 3\n", "\n", "7: parameters.count: missing key 'low'"),
        ("high: 2.5", "high: .nan", "4: parameters.size.high: invalid value nan; expected"),
        ("high: 2.5", "high: [1]", "4: parameters.size.high: invalid value [1]; expected"),
        ("high: 2.5", "high: 0.5", "4: parameters.size: low 1 is above high 0.5"),
        ("rad", "rat", "4: parameters.size.unit: unknown value 'rat'; did you mean 'rad'? valid: "),
        ("size:", "7:", "4: parameters: key 7 is not text; quote it"),
        ("-1.5]", "-1.5, 2]", "8: home: invalid value [0, -1.5, 2]; expected a list of length 2"),
        ("-1.5]", "x]", "8: home[1]: invalid value 'x'; expected a number"),
        ("[0, -1.5]", "0", "8: home: invalid value 0; expected a list or null"),
        ("[a, b]", "[a, b, c, d]", "9: links: invalid value ['a', 'b', 'c', 'd']; expected a list"),
        ("[a, b]", "{a: b}", "9: links: invalid value {'a': 'b'}; expected a list"),
        ("scaling: {low: 1, high: 1}", "scaling: 3", "10: scaling: invalid value 3; expected "),
    ],
)
def test_an_error_names_line_key_value_and_what_is_valid(old, new, message):
    text = WHOLE.replace(old, new, 1)
    assert text != WHOLE
    with pytest.raises(PartError) as error:
        read_record(yaml.safe_load(text), Part, "arm.yaml", PartError, yaml_text=text)
    assert str(error.value).startswith(f"arm.yaml:{message}")


@pytest.mark.parametrize("data", [None, 3, "text", [], [["name", "arm"]]])
def test_data_that_is_not_an_object_is_an_error(data):
    with pytest.raises(FormatError, match=r"^x\.json: invalid value .*; expected keys and values$"):
        read_record(data, Part, "x.json")


def test_errors_without_source_text_have_no_line_number():
    with pytest.raises(FormatError) as error:
        read_record({"name": "a", "home": [0, math.inf, "x" * 200]}, Part, "x.json")
    assert str(error.value).startswith("x.json: home: invalid value [0, inf, 'xxxx")
    assert len(str(error.value)) < 160


def test_errors_in_lists_name_the_index():
    rows = [{"low": 1, "high": 2}, {"low": -1, "high": 2}]
    with pytest.raises(FormatError, match=r"^x: \[1\]\.low: invalid value -1; expected a number"):
        read_record(rows, list[Range], "x")
