"""Split files: lookup, reading, writing, tamper detection and errors with line numbers."""

import string
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from helpers.commands import tree
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.splits.split import (
    Member,
    Split,
    find_split,
    parse_split,
    read_split,
    read_split_file,
    split_id,
    split_text,
    write_split,
)

DERIVATION = "base=fixed(spread=0.6)[top: arm=ur5[flange: ee=plane(size=0.1, thickness=0.01)]]"


def robot(name="ur5-plane", **changes):
    return replace(Member(name, "composed", DERIVATION, "reach", False, "0a" * 16), **changes)


SPLIT = Split(
    "mine/first",
    "composition",
    "A UR5: with a plane, or not",
    (robot(), robot("arm3-000001", category="arm3", robot_hash="1e5" + "0" * 29)),
    (robot("ur5-stick", task="push", obstacles=True),),
    {"seed": 3, "train": 2, "from": ["arm={ur5}"], "seeds": {"arm3": 17}},
    {"part-unseen": "the paper's own: so it is"},
    "a paper, table 1",
    {"train": {"links": 10.5}},
)


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "mine.yaml"
    write_split(SPLIT, path)
    return path


def test_split_files_round_trip(written):
    assert read_split(written) == SPLIT
    assert read_split(str(written)) == SPLIT
    read = read_split_file(written)
    assert read.id == split_id(SPLIT)
    assert read.split.version == version("morphgen")
    assert written.read_bytes() == split_text(SPLIT).encode() == split_text(read.split).encode()


def test_a_split_keeps_the_version_that_made_it(written):
    """Runs and built splits contain this text, and compare it, also after an update of morphgen."""
    text = written.read_text().replace(f'morphgen: "{version("morphgen")}"', 'morphgen: "0.0.1"')
    written.write_text(text)
    assert split_text(read_split(written)) == text
    assert read_split(written).as_dict()["morphgen"] == "0.0.1"
    assert (read_split(written), split_id(read_split(written))) == (SPLIT, split_id(SPLIT))


def test_other_yaml_parsers_read_the_same_data():
    data = yaml.safe_load(split_text(SPLIT))
    assert data["id"] == split_id(SPLIT)
    assert data["train"][1]["body"] == SPLIT.train[1].robot_hash
    assert data["test"][0]["obstacles"] is True
    assert data["made"] == SPLIT.provenance


def test_empty_fields_are_omitted():
    bare = Split("s", "interpolation", "x", SPLIT.train, SPLIT.test)
    text = split_text(bare)
    assert not any(f"{key}:" in text for key in ("made", "accepted", "statistics", "reference"))
    assert parse_split(text, Path("s.yaml")).split == bare


NAMES = st.text(string.ascii_letters + string.digits, min_size=1, max_size=6)
TEXTS = st.text(string.printable[:95] + "äß漢😀", min_size=1)


@given(NAMES, NAMES | st.sampled_from(["no", "null", "y", "1e5", "0x1F", "12:30", "~"]), TEXTS)
def test_arbitrary_text_round_trips(name, category, text):
    odd = replace(
        SPLIT,
        name=name,
        summary=text,
        train=(robot(name, category=category, derivation=text),),
        provenance={"from": [text], category: text},
        accepted={"hull": text},
    )
    assert parse_split(split_text(odd), Path("s.yaml")).split == odd


def test_a_changed_file_is_an_error_unless_allowed(written):
    text = written.read_text()
    written.write_text(text.replace("size=0.1,", "size=0.2,", 1))
    with pytest.raises(BenchmarkError) as caught:
        read_split(written)
    stored = read_split_file(written)
    assert stored.id != split_id(stored.split)
    prefix = f"{written}: id: {split_id(SPLIT)} is not that of its robots, which is "
    assert str(caught.value).startswith(prefix + split_id(stored.split))
    written.write_text(text.replace("A UR5", "My UR5"))
    assert read_split(written).summary.startswith("My UR5")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("regime: composition", "regime: compostion", "7: regime: unknown value 'compostion'; did"),
        ("format: 1", "format: 2", "3: format: unknown value 2; valid: 1"),
        ("summary: ", "name: x\nsummary: ", "8:1: invalid YAML: key 'name' is given twice"),
        ("summary: ", "summary: # ", "8: summary: invalid value None; expected text"),
        ("test:\n- ", "test: []\n# ", "22: test: invalid value []; expected a list of length >= 1"),
        ("task: push", "task: Push!", "23: test[0]: task: 'Push!': expected a name of lower-case"),
        ("name: ur5-stick, ", "", "23: test[0]: missing key 'name'"),
        ("name: mine/first", "name: ../first", "1: name: '../first': use letters, digits"),
        ("name: ur5-stick", "name: ../x", "23: test[0]: name: '../x': use letters, digits"),
        ("name: arm3-000001", "name: ur5-plane", "1: train: 2 robots are named 'ur5-plane'"),
        ('body: "1e5', 'body: "1g5', "21: train[1]: body: '1g500"),
        ("seed: 3", "seed: 2024-13-45", " invalid YAML: month must be in 1..12"),
        ("seed: 3", "seed: &a [*a]", "11: invalid YAML: found unconstructable recursive node"),
    ],
)
def test_errors_name_the_line(written, old, new, message):
    text = written.read_text()
    assert old in text
    written.write_text(text.replace(old, new, 1))
    with pytest.raises(MorphgenError) as caught:
        read_split(written)
    assert str(caught.value).startswith(f"{written}:{message}")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", ": no split: expected 'format: 1'"),
        (b"- a\n", ": no split: expected 'format: 1'"),
        (b"a: \xff\xfe", ": cannot be read: not UTF-8 text"),
        (b"a: 1\n---\nb: 2\n", ":2:1: invalid YAML: "),
        (b"format: 1\n? [a]\n: b\n", ":2:3: invalid YAML: found unhashable key"),
    ],
)
def test_invalid_files_are_errors(tmp_path, content, message):
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    with pytest.raises(MorphgenError) as caught:
        read_split(path)
    assert str(caught.value).startswith(f"{path}{message}")


def test_splits_are_found_by_name_or_path(written, tmp_path, monkeypatch):
    assert find_split("interpolation/arm3/reach").name == "reach.yaml"
    monkeypatch.chdir(tmp_path)
    assert find_split("mine.yaml") == Path("mine.yaml")
    (tmp_path / "plain").write_text(split_text(SPLIT))
    assert find_split("plain") == Path("plain")
    assert read_split("plain") == SPLIT


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("interpolation/arm3/reech", "did you mean 'interpolation/arm3/reach'?"),
        ("nowhere.yaml", "nowhere.yaml: no such file"),
        ("../../split", "../../split: no such file, and no split of this name"),
        ("", ": no such file, and no split of this name"),
    ],
)
def test_an_unknown_split_suggests_the_nearest(name, message):
    with pytest.raises(BenchmarkError, match=message.replace("?", r"\?")):
        find_split(name)


@pytest.mark.parametrize("name", ["", "/x", "x/", "../x", "a b", ".x", "x//y", "x/../y"])
def test_names_that_cannot_be_those_of_files_are_errors(name):
    with pytest.raises(BenchmarkError, match="use letters, digits"):
        split_text(replace(SPLIT, name=name))
    for robot_name in (name, "n" * 201):
        with pytest.raises(BenchmarkError, match="robot name"):
            split_text(replace(SPLIT, test=(robot(robot_name),)))


def test_a_failed_write_is_an_error_and_leaves_no_file(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    before = tree(tmp_path)
    with pytest.raises(BenchmarkError, match=r"cannot write .*file/x\.yaml: "):
        write_split(SPLIT, tmp_path / "file" / "x.yaml")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_split(SPLIT, tmp_path / "x.yaml")
    assert tree(tmp_path) == before


@pytest.mark.parametrize("max_links", [1, 10**9, 2.5])
def test_an_invalid_number_of_links_is_an_error(max_links):
    split = replace(SPLIT, provenance={"max_links": max_links})
    with pytest.raises(BenchmarkError, match="expected a whole number from 2 to 10000"):
        _ = split.max_links
