"""A manifest is read as it is written, or refused with the file and the key."""

import pytest

from helpers.parts import MANIFEST, write_part
from morphgen.errors import PartError
from morphgen.grammar.manifest import FrameSpec, PackageSource, read_manifest

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


def text_refusal(tmp_path, text):
    path = tmp_path / "pincer.yaml"
    path.write_bytes(text.encode())
    return refusal(path)


def test_a_template_has_a_xacro_beside_it_and_parameters(tmp_path):
    path = write_part(tmp_path)
    manifest = read_manifest(path)
    assert manifest.is_template
    assert manifest.source == tmp_path / "pincer.xacro"
    assert manifest.tool == FrameSpec("palm", (0.0, 0.0, "${length + 0.05}"))
    length = manifest.parameters["length"]
    assert (length.minimum, length.default, length.maximum, length.unit) == (0.1, 0.2, 0.5, "m")
    assert manifest.home == {"left_slide": 0.01, "wheel": 0.5}


def test_a_real_part_names_a_package_and_xacro_arguments_as_xacro_spells_them(tmp_path):
    manifest = read_manifest(write_part(tmp_path, **REAL))
    assert not manifest.is_template
    assert manifest.source == PackageSource("rtb-data", "a/b.urdf", {"hand": "true", "n": "3"})
    assert manifest.citation == "A. Body"


def test_what_may_be_left_out_is_empty(tmp_path):
    manifest = read_manifest(write_part(tmp_path, mount=None, tool=None, home=None))
    assert manifest.mount is None
    assert manifest.tool is None
    assert not manifest.home
    assert not manifest.ports
    assert manifest.without == ()


def test_an_unknown_key_names_the_nearest(tmp_path):
    message = refusal(write_part(tmp_path, paramters={}))
    assert message.startswith(": unknown key 'paramters'; did you mean 'parameters'? valid: ")


@pytest.mark.parametrize(("key", "of"), [("mass", {}), ("drop", {}), ("citation", "x")])
def test_keys_of_real_parts_are_none_of_templates(tmp_path, key, of):
    assert f"unknown key {key!r}" in refusal(write_part(tmp_path, **{key: of}))


@pytest.mark.parametrize("key", ["density"])
def test_keys_of_templates_are_none_of_real_parts(tmp_path, key):
    changes = REAL | {key: MANIFEST[key]}
    assert f"unknown key {key!r}" in refusal(write_part(tmp_path, **changes))


@pytest.mark.parametrize("key", ["kind", "licence", "name", "root", "summary"])
def test_a_missing_key_is_named(tmp_path, key):
    assert refusal(write_part(tmp_path, **{key: None})) == f": key {key!r} is missing"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "arn"}, "kind 'arn'; did you mean 'arm'? valid: arm, base"),
        ({"kind": ["ee"]}, "kind ['ee']"),
        ({"file": None}, "needs 'source' (a data package) or 'file' (a template)"),
        ({"mount": "palm"}, "mount: expected keys and values, not 'palm'"),
        ({"mount": {"xyz": [0, 0, 0]}}, "mount: key 'link' is missing"),
        ({"mount": {"link": "palm", "xzy": [0, 0, 0]}}, "mount: unknown key 'xzy'; did you mean"),
        ({"tool": {"link": "palm", "xyz": [0, 1]}}, "tool.xyz: [0, 1] is not three numbers"),
        ({"tool": {"link": "palm", "rpy": [0, 0, True]}}, "tool.rpy: True is not a number"),
        (
            {"tool": {"link": "palm", "xyz": [0, 0, float("inf")]}},
            "tool.xyz: inf is no number of a robot",
        ),
        ({"ports": ["flange"]}, "ports: expected keys and values, not ['flange']"),
        ({"ports": {"flange": {"link": "palm", "at": 1}}}, "ports.flange: unknown key 'at'"),
        ({"ports": {5: {"link": "palm"}}}, "ports: key 5 is not text; quote it"),
        ({"home": {"wheel": None}}, "home.wheel: None is not a number"),
        ({"home": {"wheel": float("nan")}}, "home.wheel: nan is no number of a robot"),
        ({"effort": {"wheel": "strong"}}, "effort.wheel: 'strong' is not a number"),
        ({"velocity": [1]}, "velocity: expected keys and values, not [1]"),
        ({"density": "water"}, "density: 'water' is not a number"),
        ({"density": 0}, "density: 0 is not positive"),
        ({"without": "disc"}, "without: expected a list of names, not 'disc'"),
        ({"without": [1]}, "without: expected a list of names, not [1]"),
        ({"accepted": {"palm": "as is"}}, "accepted.palm: expected keys and values, not 'as is'"),
        ({"parameters": {"length": 0.2}}, "parameters.length: expected keys and values, not 0.2"),
        ({"parameters": {"length": {"min": 0, "max": 1}}}, "length: key 'default' is missing"),
        (
            {"parameters": {"length": {"default": 0, "min": 0, "mx": 1}}},
            "parameters.length: unknown key 'mx'; did you mean 'max'?",
        ),
        (
            {"parameters": {"length": {"default": "wide", "min": 0, "max": 1}}},
            "parameters.length: 'wide' is not a number",
        ),
        (REAL | {"source": {"package": "rtb-data"}}, "source.file is missing"),
        (REAL | {"source": "rtb-data"}, "source: expected keys and values, not 'rtb-data'"),
        (REAL | {"mass": {"palm": "heavy"}}, "mass.palm: 'heavy' is not a number"),
        (REAL | {"drop": {"palm": "hand.dae"}}, "drop.palm: expected a list of names"),
        (REAL | {"scaling": {"palm": 2}}, "scaling.palm: expected a parameter, or keys 'by' and"),
        (REAL | {"scaling": {"palm": {"bye": "s"}}}, "scaling.palm: unknown key 'bye'; did you"),
        (REAL | {"scaling": {"palm": {"by": 2}}}, "scaling.palm.by: 2 is not the name of a"),
        (REAL | {"scaling": {"palm": {"face": [0]}}}, "scaling.palm.face: [0] is not three"),
        (REAL | {"scaling": {"palm": {"face": [0, 0, "z"]}}}, "palm.face: 'z' is not a number"),
        (REAL | {"collision_from_visual": "palm"}, "collision_from_visual: expected a list"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_by_file_and_key(tmp_path, changes, message):
    assert message in refusal(write_part(tmp_path, **changes))


def test_the_name_is_the_files(tmp_path):
    path = write_part(tmp_path).rename(tmp_path / "tongs.yaml")
    assert refusal(path) == ": name 'pincer' differs from the file's, 'tongs'"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: pincer\nkind: [ee\nroot: palm\n", ":3:5: no valid YAML: "),
        ("name: pincer\n\tkind: ee\n", ":2:1: no valid YAML: "),
        (
            "name: pincer\nkind: ee\nname: pincer\n",
            ":3:1: no valid YAML: key 'name' is given twice",
        ),
        (
            "name: pincer\nhome:\n  a: 1\n  a: 2\n",
            ":4:3: no valid YAML: key 'a' is given twice",
        ),
        ("name: pincer\n? [a]\n: 5\n", ":2:3: no valid YAML: "),
        ("name: !!python/object/apply:os.getcwd []\n", ":1:7: no valid YAML: "),
        ("name: pin\x00cer\n", ": no valid YAML: "),
        ("name: 2020-13-45\n", ": no valid YAML: "),
        ("- name\n- kind\n", ": expected keys and values, not ['name', 'kind']"),
        ("", ": key 'kind' is missing"),
        ("5: 5\n", ": key 5 is not text; quote it"),
    ],
)
def test_what_is_no_manifest_is_refused_at_its_line_and_column(tmp_path, text, message):
    assert text_refusal(tmp_path, text).startswith(message)


def test_a_manifest_in_another_encoding_is_refused(tmp_path):
    path = tmp_path / "pincer.yaml"
    path.write_bytes("summary: prénom".encode("latin-1"))
    assert "no valid YAML" in refusal(path)


def test_a_missing_file_is_refused(tmp_path):
    assert refusal(tmp_path / "pincer.yaml") == ": cannot be read: No such file or directory"
