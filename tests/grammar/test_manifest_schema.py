"""The JSON schema of part manifests accepts and refuses what the reader does."""

import json

import pytest
import yaml
from jsonschema import Draft202012Validator

from helpers.grammars import LIBRARY
from morphgen.errors import PartError
from morphgen.grammar.manifest import read_manifest
from morphgen.grammar.manifest_schema import SCHEMA_FILE, manifest_schema

VALIDATOR = Draft202012Validator(json.loads(SCHEMA_FILE.read_text(encoding="utf-8")))
MINIMAL = "name: tip\nkind: ee\nsummary: a tip\nroot: tip\nlicence: MIT\n"
REGENERATE = "python -m morphgen.grammar.manifest_schema"


def test_the_stored_schema_is_that_of_the_records():
    stored = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(manifest_schema())), f"run {REGENERATE}"


def test_every_key_has_a_description():
    for record in manifest_schema()["$defs"].values():
        assert all(entry["description"] for entry in record["properties"].values())


@pytest.mark.parametrize("path", LIBRARY.paths.values(), ids=lambda path: path.stem)
def test_shipped_manifests_are_valid(path):
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert [error.message for error in VALIDATOR.iter_errors(data)] == []


def test_the_smallest_manifest_is_valid(tmp_path):
    assert VALIDATOR.is_valid(yaml.safe_load(MINIMAL + "file: tip.xacro\n"))
    (tmp_path / "tip.yaml").write_text(MINIMAL + "file: tip.xacro\n")
    assert read_manifest(tmp_path / "tip.yaml").name == "tip"


@pytest.mark.parametrize(
    "lines",
    [
        "",
        "file: tip.xacro\nmas: {}",
        "file: tip.xacro\nmass: {tip: 1}",
        "source: {package: p, file: f}\ndensity: 1000",
        "source: {package: p, file: f}\nfile: tip.xacro",
        "file: tip.xacro\ndensity: 0",
        "file: tip.xacro\nports: {end: {link: tip, xyz: [0, 0]}}",
        "file: tip.xacro\nparameters: {size: {default: 1, min: 0}}",
        "file: tip.xacro\nparameters: {size: {default: 1, min: 0, max: 2, unit: ft}}",
        "file: tip.xacro\nhome: 0",
    ],
)
def test_what_the_reader_refuses_is_invalid(lines, tmp_path):
    assert not VALIDATOR.is_valid(yaml.safe_load(MINIMAL + lines))
    (tmp_path / "tip.yaml").write_text(MINIMAL + lines)
    with pytest.raises(PartError):
        read_manifest(tmp_path / "tip.yaml")
