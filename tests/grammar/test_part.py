"""Manifests and parts, and imported robots as parts."""

import importlib.metadata
import json
import math
import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from helpers.grammars import LIBRARY
from helpers.parts import MANIFEST, PINCER, write_part
from helpers.robots import arm
from morphgen.checks import check, rules
from morphgen.checks.rules import check_links_apart
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import FormatError, PartError
from morphgen.formats import resolve
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.xacro.expand import Expansion
from morphgen.grammar.library import default_library
from morphgen.grammar.manifest import (
    MOUNT_YAW_PARAMETER,
    SCHEMA_FILE,
    FrameSpec,
    PackageSource,
    Parameter,
    parse_value,
    read_manifest,
)
from morphgen.grammar.part import load_part
from morphgen.grammar.robot_source import import_robot, resolve_robot
from morphgen.model.geometry import IDENTITY, Box, scale_shape
from morphgen.model.kinematics import frame_pose
from morphgen.model.tree import rename

BAR = 0.02 * 0.02 * 1000  # kg a metre
GONE = {"file": None, "density": None, "parameters": None}
"""Keys of templates, which a real part has not."""
SIZE = {"size": {"default": 1, "min": 0.5, "max": 2}}


def template(folder, values=None, **changes):
    return load_part(read_manifest(write_part(folder, **changes)), values)


@pytest.fixture
def real(tmp_path, monkeypatch):
    """Make a real part: the pincer's URDF stands for a file of a data package."""

    def make(**changes):
        urdf = tmp_path / "pincer.urdf"
        urdf.write_bytes(Expansion({}, urdf, PackageFinder()).run(PINCER.encode()))
        monkeypatch.setattr(resolve, "distribution_file", lambda package, file: tmp_path / file)
        source = {"source": {"package": "rtb-data", "file": "pincer.urdf"}}
        tool = {"link": "palm", "xyz": [0, 0, 0.25]}
        manifest = write_part(tmp_path, **GONE | source | {"tool": tool} | changes)
        return load_part(read_manifest(manifest))

    return make


def test_the_fragment_starts_at_the_root_link_of_the_manifest(tmp_path):
    body = template(tmp_path).fragment
    assert [link.name for link in body.links] == ["palm", "left", "right", "disc"]
    assert [joint.name for joint in body.joints] == ["left_slide", "right_slide", "wheel"]


def test_excluded_links_are_removed_with_their_joints(tmp_path):
    body = template(tmp_path, without=["disc"], home={"left_slide": 0.01}).fragment
    assert [link.name for link in body.links] == ["palm", "left", "right"]
    assert body.home == (0.01,)


def test_parameters_change_links_and_frames(tmp_path):
    part = template(tmp_path, {"length": 0.4})
    assert part.fragment.link("palm").collisions[0].geometry == Box((0.02, 0.02, 0.4))
    assert part.tool.T_link_frame.position == pytest.approx((0, 0, 0.45))
    assert part.values == {"length": 0.4}
    assert template(tmp_path).values == {"length": 0.2}
    part = template(tmp_path, {"length": 0.3}, home={"left_slide": "${length / 10}"})
    assert part.fragment.home == pytest.approx((0.03, 0.0))


def test_the_density_sets_missing_masses(tmp_path):
    part = template(tmp_path)
    palm = part.fragment.link("palm").inertial
    assert palm.mass == pytest.approx(BAR * 0.2)
    assert palm.com == pytest.approx((0, 0, 0.1))
    assert palm.inertia[0] == pytest.approx(palm.mass * (0.02**2 + 0.2**2) / 12)


def test_loaded_parts_are_cached(tmp_path):
    manifest = read_manifest(write_part(tmp_path))
    assert load_part(manifest, {"length": 0.3}) is load_part(manifest, {"length": 0.3})
    assert load_part(manifest, {"length": 0.2}) is load_part(manifest)
    assert load_part(manifest, {"length": 0.3}) is not load_part(manifest)


def test_home_effort_and_velocity_of_the_manifest_take_precedence(tmp_path):
    body = template(tmp_path, effort={"wheel": 7}, velocity={"left_slide": 0.3}).fragment
    left, right, wheel = body.joints
    assert body.home == (0.01, 0.5)
    assert (left.effort, left.velocity) == (10, 0.3)
    assert (wheel.effort, wheel.velocity, wheel.limits) == (7, 2, None)  # it is continuous
    assert (right.effort, right.limits, right.mimic.joint) == (10, (-0.04, 0), "left_slide")


def test_unsafe_names_are_replaced_in_every_reference(tmp_path):
    xacro = PINCER.replace('"palm"', '"the palm"').replace('name="wheel"', 'name="big/wheel"')
    link = {"link": "the palm"}
    part = template(
        tmp_path, xacro=xacro, root="the palm", mount=link, tool=link, home={"big/wheel": 1}
    )
    assert part.fragment.root.name == part.tool.link == "the_palm"
    assert part.fragment.joints[2].name == "big_wheel"


def test_a_mount_may_be_on_a_link_behind_a_fixed_joint(tmp_path):
    mount = {"link": "palm", "xyz": [0, 0, 0.01], "rpy": [0, 0, math.pi / 2]}
    part = template(tmp_path, root="plinth", mount=mount)
    assert part.T_root_mount.position == pytest.approx((0, 0, 1.01))
    x_axis = part.T_root_mount.matrix[:3, 0]
    assert x_axis == pytest.approx([0, 1, 0])


def test_a_mass_in_the_manifest_sets_the_inertia_from_the_geometry(real):
    body = real(mass={"palm": 2}).fragment
    palm = body.link("palm").inertial
    assert palm.mass == 2
    assert palm.com == pytest.approx((0, 0, 0.1))
    assert palm.inertia[5] == pytest.approx(2 * (0.02**2 + 0.02**2) / 12)
    assert body.link("disc").inertial is None
    assert real(mass={"palm": 0, "left": 1}).fragment.link("palm").inertial is None


def test_visual_shapes_can_replace_collision_shapes(real):
    palm = real(collision_from_visual=["palm"]).fragment.link("palm")
    assert [shape.geometry for shape in palm.collisions] == [Box((0.02, 0.02, 0.2))]
    assert palm.collisions[0].rgba is None
    assert palm.visuals[0].rgba == (1, 0, 0, 1)


def test_a_dropped_mesh_is_removed_from_visuals_and_collisions():
    """The palm belongs to Jaco's hand, not to the last link of its arm."""
    arm = load_part(LIBRARY.manifest("jaco2"))
    shapes = [s for link in arm.fragment.links for s in (*link.visuals, *link.collisions)]
    meshes = {shape.geometry.path.name for shape in shapes}
    assert "hand_3finger.dae" not in meshes
    assert "ring_small.dae" in meshes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"root": "pallm"}, "no link 'pallm'; did you mean 'palm'"),
        ({"without": ["left"]}, "joint 'right_slide' mimics 'left_slide'"),
        ({"home": {"weel": 0}}, "home: no joint 'weel'; did you mean 'wheel'"),
        ({"home": {"right_slide": 0}}, "home: 'right_slide' does not move by itself"),
        ({"mount": {"link": "plinth"}}, "no link 'plinth' in the part"),
        ({"mount": {"link": "disc"}}, "mount is on 'disc', which moves ('wheel')"),
        ({"tool": {"link": "palm", "xyz": [0, 0, "length"]}}, "'length' is neither a number nor"),
        ({"tool": {"link": "palm", "xyz": [0, 0, "${lenth}"]}}, "did you mean 'length'"),
        ({"home": {"wheel": "${1 / 0}"}}, "${1 / 0}: "),
        ({"file": "tongs.xacro"}, "tongs.xacro: no such file"),
        ({"xacro": PINCER.replace("</robot>", "")}, "pincer.xacro:"),
        ({"xacro": PINCER.replace('parent link="palm"', 'parent link="pam"')}, "'pam'"),
        ({"xacro": PINCER.replace("length", "size")}, "no argument 'length'"),
        ({"values": {"lenth": 0.2}}, "pincer has no parameter 'lenth'; did you mean 'length'"),
        ({"values": {"length": 2.0}}, "pincer.length=2: out of range; expected 0.1 to 0.5 m"),
    ],
)
@pytest.mark.usefixtures("xacro_here")
def test_a_manifest_that_contradicts_its_source_is_an_error(tmp_path, changes, message):
    with pytest.raises(PartError, match=r"^[^\n]*$") as caught:
        template(tmp_path, **changes)
    assert message in str(caught.value)
    assert "pincer" in str(caught.value)


@pytest.mark.parametrize(
    ("package", "install"),
    [
        ("rtb-data", "pip install rtb-data==1.1.0"),
        ("example-robot-data", "pip install example-robot-data"),
    ],
)
def test_missing_data_packages_and_files_are_errors(tmp_path, monkeypatch, package, install):
    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", absent)
    source = {"package": package, "file": "robots/x.urdf"}
    manifest = read_manifest(write_part(tmp_path, source=source, **GONE))
    with pytest.raises(PartError, match="not installed: " + install):
        load_part(manifest)
    monkeypatch.undo()
    source["file"] = "nowhere.urdf"
    with pytest.raises(PartError, match=rf"{package} [0-9.]+ has no file .*nowhere\.urdf"):
        load_part(read_manifest(write_part(tmp_path, source=source, **GONE)))


def test_an_edited_part_is_reloaded(tmp_path):
    manifest = write_part(tmp_path, density=1000)
    library = default_library([tmp_path])
    name = manifest.stem
    light = load_part(library.manifest(name)).fragment.mass
    write_part(tmp_path, density=3000)
    assert load_part(library.manifest(name)).fragment.mass == pytest.approx(3 * light)


def test_a_link_scaled_by_a_parameter_stays_in_contact_with_its_parent(real):
    plain = real(parameters=SIZE, scaling={"disc": "size"})
    assert plain.fragment.joints == real().fragment.joints
    for scaling in ({"disc": "size"}, {"disc": {"by": "size"}}):
        manifest = real(parameters=SIZE, scaling=scaling).manifest
        larger = load_part(manifest, {"size": 2}).fragment
        shapes = plain.fragment.link("disc").collisions
        assert larger.link("disc").collisions == tuple(scale_shape(s, 2) for s in shapes)
        assert larger.joints == plain.fragment.joints
    face = {"disc": {"by": "size", "face": [0, 0, -0.01]}}
    held = load_part(real(parameters=SIZE, scaling=face).manifest, {"size": 2}).fragment
    moved = held.joints[-1].T_parent_joint.inverse() @ plain.fragment.joints[-1].T_parent_joint
    assert moved.position == pytest.approx((0, 0, -0.01))


def test_an_unscaled_link_may_follow_the_face_of_its_parent(real):
    scaling = {"palm": {"by": "size"}, "disc": {"face": [0, 0, 0.01]}}
    part = real(parameters=SIZE, scaling=scaling)
    larger = load_part(part.manifest, {"size": 2}).fragment
    assert larger.link("disc") == part.fragment.link("disc")
    face_before, face_after = (
        body.joints[-1].T_parent_joint.apply((0, 0, 0.01)) for body in (part.fragment, larger)
    )
    assert face_after == pytest.approx([2 * value for value in face_before])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": {"pam": 1}}, "mass: no link 'pam'; did you mean 'palm'"),
        ({"drop": {"pam": ["x.dae"]}}, "drop: no link 'pam'"),
        ({"scaling": {"disk": {"by": "size"}}}, "scaling: no link 'disk'; did you mean 'disc'"),
        ({"scaling": {"disc": {"by": "sise"}}}, "scaling: no parameter 'sise'; did you mean"),
    ],
)
def test_unknown_links_or_parameters_of_real_parts_are_errors(real, changes, message):
    with pytest.raises(PartError, match=message):
        real(parameters=SIZE, **changes)


SLIT = 1.6e-3
"""The slits of 1 mm between the Panda's own meshes, at a factor of 1.5, metres."""
FACTOR = st.sampled_from([0.5, 1.5]) | st.floats(0.5, 1.5)


def variation(*factors):
    scales = {f"scale{i}": factor for i, factor in enumerate(factors, start=1)}
    return load_part(LIBRARY.manifest("panda_scaled"), scales).fragment


@pytest.mark.slow
@settings(max_examples=12, derandomize=True)
@given(st.tuples(*[FACTOR] * 7))
def test_neighbouring_links_stay_in_contact_for_all_scale_factors(factors):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rules, "MAX_GAP", SLIT)
        assert list(check_links_apart(variation(*factors))) == []


def test_unit_scale_factors_give_the_original_panda():
    panda, same = load_part(LIBRARY.manifest("panda")).fragment, variation(*[1] * 7)
    assert panda.links[8].name == "panda_link8"  # a bare frame; the scaled part has a port there
    assert (same.links, same.joints, same.home) == (panda.links[:8], panda.joints[:7], panda.home)


def test_lengths_masses_and_inertias_scale_at_constant_density():
    factors = (1.2, 0.5, 1.5, 0.8, 1.1, 0.9, 1.3)
    plain, other = variation(*[1] * 7), variation(*factors)
    for i, f in enumerate((*factors, 1.0)):
        a, b = plain.links[i].inertial, other.links[i].inertial
        assert b.mass == pytest.approx(f**3 * a.mass)
        assert b.inertia == pytest.approx([f**5 * value for value in a.inertia])
        assert {shape.geometry.scale for shape in other.links[i].visuals} == {(f, f, f)}


SOURCE = {"package": "rtb-data", "file": "a/b.urdf", "args": {"hand": True, "n": 3}}
REAL = GONE | {"source": SOURCE, "citation": "A. Body"}


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
    assert (manifest.is_template, manifest.citation) == (False, "A. Body")
    assert manifest.source == PackageSource(*SOURCE.values())
    assert manifest.source.args == {"hand": "true", "n": "3"}


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
        ({"tool": {"link": "palm", "xyz": [0, 0, float("inf")]}}, "tool.xyz[2]: invalid value"),
        ({"ports": {"flange": {"link": "palm", "at": 1}}}, "ports.flange: unknown key 'at'"),
        ({"density": 0}, "density: invalid value 0; expected a number > 0"),
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
    ],
)
def test_invalid_yaml_is_an_error_with_line_and_column(tmp_path, text, message):
    path = tmp_path / "pincer.yaml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert refusal(path).startswith(message)


SIZE_IN_MANIFEST = Parameter(0.1, 0.05, 0.5, "m")


@pytest.mark.parametrize(
    ("text", "value"), [("0.1", 0.1), ("80mm", 0.08), ("12 cm", 0.12), ("1e-1m", 0.1)]
)
def test_values_are_converted_to_si_units(text, value):
    assert parse_value(text, SIZE_IN_MANIFEST, "ee.size") == pytest.approx(value)
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
            parse_value(text, SIZE_IN_MANIFEST, "ee.size")


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
    manifest = read_manifest(tmp_path / "tip.yaml")
    assert (manifest.mount, manifest.tool, manifest.without) == (None, None, ())
    assert not {**manifest.home, **manifest.ports}


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


def test_the_tool_frame_is_at_the_given_link_if_there_is_one(robot_urdf):
    robot = import_robot(robot_urdf(arm()), tool="left")
    frame = robot.frame("tool")
    assert (frame.link, frame.T_link_frame) == ("left", IDENTITY)
    assert robot.provenance["source"] == "some_robot.urdf"
    robot = import_robot(robot_urdf(arm()))
    assert robot.frames == ()
    assert "tool-missing" in {finding.code for finding in check(robot)}


def test_home_has_no_self_collision(robot_urdf):
    robot = import_robot(robot_urdf(arm()))
    assert list(SelfCollisionChecker(robot).penetrations([robot.home])) == [{}]
    assert ("left", "slider") in robot.ignore_pairs


def test_a_link_named_tool_is_renamed_in_favour_of_the_frame(robot_urdf):
    path = robot_urdf(rename(arm(), {"slider": "tool"}, {"extend": "tool_joint"}))
    robot = import_robot(path, tool="tool")
    assert robot.frame("tool").link == "tool_link"
    assert import_robot(path).frames == robot.frames
    assert resolve_robot(path, default_library()).frame("tool").link == "tool_link"
    assert {"tool", "tool_joint"}.isdisjoint({*robot.link_index, *robot.joint_index})
    assert "frame-name-taken" not in {finding.code for finding in check(robot)}
    np.testing.assert_allclose(
        frame_pose(robot, robot.home),
        frame_pose(import_robot(robot_urdf(arm()), tool="slider"), robot.home),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"root_link": "bass"}, "no link 'bass' for root link; did you mean 'base'? valid: base,"),
        ({"tool": "slidr"}, "no link 'slidr' for tool; did you mean 'slider'?"),
        ({"root_link": "slider", "tool": "base"}, "tool 'base' is not below the root link"),
        ({"args": {"length": "1"}}, "xacro arguments length for a file that is not a xacro"),
    ],
)
def test_unknown_links_are_errors(robot_urdf, options, message):
    path = robot_urdf(arm())
    with pytest.raises(FormatError) as caught:
        import_robot(path, **options)
    assert str(caught.value).startswith(f"{path}: {message}")
