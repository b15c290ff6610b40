"""Records in YAML and JSON, and archives."""

import io
import math
import zipfile
from typing import Annotated, Literal

import pytest
import yaml
from msgspec import Meta, field

from morphgen.errors import FormatError, PartError
from morphgen.formats import zip_files
from morphgen.formats.records import FiniteNumber, PositiveNumber, Record, read_record
from morphgen.formats.zip_files import ZipLimits, unpack_zip, write_entries, write_zip


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


LIMITS = ZipLimits(max_bytes=10_000, max_files=5)


def archive(path, entries):
    """Write an archive of (name, content), in this order."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for entry, content in entries:
            target.writestr(entry, content)
    return path


def test_the_same_files_give_the_same_bytes(tmp_path):
    (tmp_path / "b.txt").write_bytes(b"from a file")
    contents = []
    for names in (("a/b", "a.txt"), ("a.txt", "a/b")):
        files = {name: tmp_path / "b.txt" for name in names} | {"c": b"bytes"}
        write_zip(tmp_path / "one.zip", files)
        target = io.BytesIO()
        write_entries(target, files)
        contents += [(tmp_path / "one.zip").read_bytes(), target.getvalue()]
    assert len(set(contents)) == 1
    unpack_zip(tmp_path / "one.zip", tmp_path / "out", LIMITS)
    found = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*")}
    assert found == {"a", "a/b", "a.txt", "c"}


@pytest.mark.parametrize(
    ("entries", "why"),
    [
        ([("../evil", b"x")], "'../evil' leads out of its folder"),
        ([("a", bytes(20_000))], "unpacks to more than 0 MB"),
        ([(f"{i}", b"") for i in range(6)], "holds more than 5 files"),
    ],
)
def test_unsafe_archives_are_refused_before_anything_is_written(tmp_path, entries, why):
    path = archive(tmp_path / "evil.zip", entries)
    (tmp_path / "out").mkdir()
    with pytest.raises(FormatError, match=r"evil\.zip: ") as caught:
        unpack_zip(path, tmp_path / "out", LIMITS)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evil.zip", "out"]
    assert list((tmp_path / "out").iterdir()) == []


def test_broken_archives_are_refused(tmp_path):
    (tmp_path / "out").mkdir()
    whole = archive(tmp_path / "cut.zip", [("a", bytes(range(200)))]).read_bytes()
    for content in (whole[:60], b"", b"no zip at all"):
        (tmp_path / "cut.zip").write_bytes(content)
        with pytest.raises(FormatError, match=r"cut\.zip: not a readable zip"):
            unpack_zip(tmp_path / "cut.zip", tmp_path / "out", LIMITS)
    with pytest.raises(FormatError, match="no such file"):
        unpack_zip(tmp_path / "none.zip", tmp_path / "out", LIMITS)
    with pytest.raises(FormatError, match="out: is not a regular file"):
        unpack_zip(tmp_path / "out", tmp_path / "out", LIMITS)


def test_an_entry_that_is_larger_than_it_says_is_refused(tmp_path):
    path = archive(tmp_path / "liar.zip", [("a", bytes(5000))])
    content = bytearray(path.read_bytes())
    start = content.index(b"PK\x01\x02")
    content[start + 24 : start + 28] = (10).to_bytes(4, "little")  # size of the unpacked file
    path.write_bytes(content)
    (tmp_path / "out").mkdir()
    with pytest.raises(FormatError, match=r"liar.zip: (not a readable zip|.*larger)"):
        unpack_zip(path, tmp_path / "out", LIMITS)


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(FormatError, match="cannot write"):
        write_zip(tmp_path / "a.zip", {"x": tmp_path / "missing"})
    assert list(tmp_path.iterdir()) == []


def test_a_table_of_too_many_entries_is_not_read(tmp_path, monkeypatch):
    path = archive(tmp_path / "many.zip", [(f"folder{i}/", b"") for i in range(11)])
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(zipfile, "ZipFile", None)
    for chunk in (2**20, 7):  # signatures at the ends of chunks count once
        monkeypatch.setattr(zip_files, "_CHUNK", chunk)
        with pytest.raises(FormatError, match=r"many\.zip: holds more than 5 files"):
            unpack_zip(path, tmp_path / "out", LIMITS)
    with path.open("rb") as file:
        zip_files.require_few_entries(file, ZipLimits(max_bytes=10_000, max_files=6))
