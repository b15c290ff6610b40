"""Loading parts: the source file with the corrections of the manifest; scaled links."""

import importlib.metadata
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.parts import PINCER, write_part
from morphgen.checks import rules
from morphgen.checks.rules import check_links_apart
from morphgen.errors import PartError
from morphgen.formats import description
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.xacro.expand import Expansion
from morphgen.grammar.library import default_library
from morphgen.grammar.manifest import read_manifest
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, scale_shape

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
        monkeypatch.setattr(description, "distribution_file", lambda package, file: tmp_path / file)
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
    arm = load_part(default_library().manifest("jaco2"))
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


SCALES = [f"scale{i}" for i in range(1, 8)]
SLIT = 1.6e-3
"""The slits of 1 mm between the Panda's own meshes, at a factor of 1.5, metres."""
FACTOR = st.sampled_from([0.5, 1.5]) | st.floats(0.5, 1.5)


def variation(*factors):
    return load_part(
        default_library().manifest("panda_scaled"), dict(zip(SCALES, factors, strict=True))
    ).fragment


@pytest.mark.slow
@settings(max_examples=12, derandomize=True)
@given(st.tuples(*[FACTOR] * 7))
def test_neighbouring_links_stay_in_contact_for_all_scale_factors(factors):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rules, "MAX_GAP", SLIT)
        assert list(check_links_apart(variation(*factors))) == []


def test_unit_scale_factors_give_the_original_panda():
    panda, same = load_part(default_library().manifest("panda")).fragment, variation(*[1] * 7)
    assert panda.links[8].name == "panda_link8"  # a bare frame; the scaled part has a port there
    assert (same.links, same.joints, same.home) == (panda.links[:8], panda.joints[:7], panda.home)


def test_lengths_masses_and_inertias_scale_at_constant_density():
    plain, other = variation(*[1] * 7), variation(1.2, 0.5, 1.5, 0.8, 1.1, 0.9, 1.3)
    for i, f in enumerate((1.2, 0.5, 1.5, 0.8, 1.1, 0.9, 1.3, 1.0)):
        a, b = plain.links[i].inertial, other.links[i].inertial
        assert b.mass == pytest.approx(f**3 * a.mass)
        assert b.inertia == pytest.approx([f**5 * value for value in a.inertia])
        assert {shape.geometry.scale for shape in other.links[i].visuals} == {(f, f, f)}
