"""Reading part manifests, whose errors name file, line and key; their schema; values, units."""

import json
import math
import runpy
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from helpers.grammars import LIBRARY
from helpers.parts import MANIFEST, write_part
from morphgen.errors import PartError
from morphgen.grammar.manifest import (
    MOUNT_YAW_PARAMETER,
    SCHEMA_FILE,
    FrameSpec,
    PackageSource,
    Parameter,
    parse_value,
    read_manifest,
    resolve_values,
)

REAL = {
    "file": None,
    "density": None,
    "parameters": None,
    "source": {"package": "rtb-data", "file": "a/b.urdf", "args": {"hand": True, "n": 3}},
    "citation": "A. Body",
}


def refusal(path):
    with pytest.raises(PartError) as caught:
        read_manifest(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message.removeprefix(str(path))


def test_a_template_manifest_has_a_xacro_file_and_parameters(tmp_path):
    path = write_part(tmp_path)
    manifest = read_manifest(path)
    assert manifest.is_template
    assert manifest.source == tmp_path / "pincer.xacro"
    assert manifest.tool == FrameSpec("palm", (0.0, 0.0, "${length + 0.05}"))
    length = manifest.parameters["length"]
    assert (length.minimum, length.default, length.maximum, length.unit) == (0.1, 0.2, 0.5, "m")
    assert manifest.home == {"left_slide": 0.01, "wheel": 0.5}


def test_a_real_part_manifest_has_a_package_and_xacro_arguments(tmp_path):
    manifest = read_manifest(write_part(tmp_path, **REAL))
    assert not manifest.is_template
    source = manifest.source
    assert isinstance(source, PackageSource)
    assert (source.package, source.file) == ("rtb-data", "a/b.urdf")
    assert source.args == {"hand": "true", "n": "3"}
    assert manifest.citation == "A. Body"


def test_optional_keys_default_to_empty(tmp_path):
    manifest = read_manifest(write_part(tmp_path, mount=None, tool=None, home=None))
    assert (manifest.mount, manifest.tool, manifest.without) == (None, None, ())
    assert not {**manifest.home, **manifest.ports}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(
            ({key: None}, f":1: missing key {key!r}")
            for key in ("kind", "licence", "name", "root", "summary")
        ),
        ({"paramters": {}}, ": unknown key 'paramters'; did you mean 'parameters'? valid: "),
        ({"mass": {}}, "unknown key 'mass'"),
        ({"citation": "x"}, "unknown key 'citation'"),
        (REAL | {"density": MANIFEST["density"]}, "unknown key 'density'"),
        ({"kind": "arn"}, "2: kind: unknown value 'arn'; did you mean 'arm'? valid: arm, base"),
        ({"file": None}, "needs 'source' (a data package) or 'file' (a template)"),
        ({"mount": "palm"}, "6: mount: invalid value 'palm'; expected keys and values"),
        ({"tool": {"link": "palm", "xyz": [0, 1]}}, "tool.xyz: invalid value [0, 1]; expected a"),
        ({"tool": {"link": "palm", "xyz": [0, 0, float("inf")]}}, "tool.xyz[2]: invalid value"),
        ({"ports": {"flange": {"link": "palm", "at": 1}}}, "ports.flange: unknown key 'at'"),
        ({"ports": {5: {"link": "palm"}}}, "ports: key 5 is not text; quote it"),
        ({"density": 0}, "density: invalid value 0; expected a number > 0"),
        (
            {"parameters": {"length": {"default": 0, "min": 0, "mx": 1}}},
            "parameters.length: unknown key 'mx'; did you mean 'max'?",
        ),
        (REAL | {"source": {"package": "rtb-data"}}, "source: missing key 'file'"),
        (REAL | {"scaling": {"palm": 2}}, "scaling.palm: invalid value 2; expected text or keys"),
    ],
)
def test_a_wrong_key_or_value_is_an_error_that_names_file_and_key(tmp_path, changes, message):
    assert message in refusal(write_part(tmp_path, **changes))


def test_the_name_must_equal_the_file_name(tmp_path):
    path = write_part(tmp_path).rename(tmp_path / "tongs.yaml")
    assert refusal(path) == ": name 'pincer' differs from the file's, 'tongs'"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: pincer\nkind: [ee\nroot: palm\n", ":3:5: invalid YAML: "),
        ("name: pincer\nkind: ee\nname: pincer\n", ":3:1: invalid YAML: key 'name' is given twice"),
        ("name: !!python/object/apply:os.getcwd []\n", ":1:7: invalid YAML: "),
        ("name: 2020-13-45\n", ": invalid YAML: "),
        ("- name\n- kind\n", ":1: invalid value ['name', 'kind']; expected keys and values"),
        ("", ":1: missing key 'name'"),
        (b"summary: pr\xe9nom", ": invalid YAML"),
        (None, ": no such file"),
        ("5: 5\n", ":1: key 5 is not text; quote it"),
    ],
)
def test_invalid_yaml_is_an_error_with_line_and_column(tmp_path, text, message):
    path = tmp_path / "pincer.yaml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert refusal(path).startswith(message)


SIZE = Parameter(0.1, 0.05, 0.5, "m")


@pytest.mark.parametrize(
    ("text", "value"), [("0.1", 0.1), ("80mm", 0.08), ("12 cm", 0.12), ("1e-1m", 0.1)]
)
def test_values_are_converted_to_si_units(text, value):
    assert parse_value(text, SIZE, "ee.size") == pytest.approx(value)
    assert parse_value("45deg", MOUNT_YAW_PARAMETER, "ee.mount_yaw") == pytest.approx(math.pi / 4)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["45deg", "1kg", "3 furlongs"], r"ee\.size=.*wrong unit.*units: m/cm/mm"),
        (["big", "", "1.2.3", "nan", "inf", "0x10"], "not a number"),
        (["0.6", "10mm", "-0.1"], r"out of range; expected 0\.05 to 0\.5 m"),
    ],
)
def test_invalid_values_are_errors(texts, message):
    for text in texts:
        with pytest.raises(PartError, match=message):
            parse_value(text, SIZE, "ee.size")


def test_an_unknown_parameter_suggests_the_nearest():
    with pytest.raises(PartError, match="no parameter 'sise'; did you mean 'size'"):
        resolve_values({"sise": 0.1}, {"size": SIZE}, "plane")


def test_a_default_outside_its_range_is_a_manifest_error():
    with pytest.raises(ValueError, match="default 2 is outside"):
        Parameter(2.0, 0.0, 1.0, "m")


VALIDATOR = Draft202012Validator(json.loads(SCHEMA_FILE.read_text(encoding="utf-8")))
MINIMAL = "name: tip\nkind: ee\nsummary: a tip\nroot: tip\nlicence: MIT\n"
SCRIPT = Path(__file__).parents[2] / "docs" / "part_manifest.py"


def test_the_stored_schema_is_that_of_the_records():
    schema = runpy.run_path(str(SCRIPT))["manifest_schema"]()
    assert VALIDATOR.schema == json.loads(json.dumps(schema)), f"run {SCRIPT}"
    for record in schema["$defs"].values():
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
        "file: tip.xacro\nports: {end: {link: tip, xyz: [0, 0]}}",
        "file: tip.xacro\nparameters: {size: {default: 1, min: 0}}",
        "file: tip.xacro\nparameters: {size: {default: 1, min: 0, max: 2, unit: ft}}",
    ],
)
def test_what_the_reader_refuses_is_invalid(lines, tmp_path):
    assert not VALIDATOR.is_valid(yaml.safe_load(MINIMAL + lines))
    (tmp_path / "tip.yaml").write_text(MINIMAL + lines)
    with pytest.raises(PartError):
        read_manifest(tmp_path / "tip.yaml")
