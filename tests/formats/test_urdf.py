"""URDF: what is written and read, what is left out, and rounding."""

import json
import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from morphgen import read
from morphgen.cli import main
from morphgen.errors import FormatError
from morphgen.formats.bundle import read_bundle, read_robot, write_bundle
from morphgen.formats.rounding import as_written, format_number, rounded_pose
from morphgen.formats.urdf.read import UnsoundError, read_urdf
from morphgen.formats.urdf.schema import structure_findings
from morphgen.formats.urdf.write import urdf_text
from morphgen.formats.xml import parse_xml
from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.robot import Frame, Inertial, Joint, Link, Robot
from morphgen.model.rotation import to_matrix


def no_mesh(mesh):
    raise AssertionError(f"no mesh expected: {mesh}")


def written(robot, folder):
    path = folder / "robot.urdf"
    path.write_text(urdf_text(robot, no_mesh))
    return path


def test_links_are_sorted_from_the_root_and_missing_limits_are_not_zero(tmp_path):
    robot = reading(
        '<robot name="r"><link name="c"/><link name="a"/><link name="b"/>'
        '<joint name="j2" type="fixed"><parent link="b"/><child link="c"/></joint>'
        '<joint name="j1" type="revolute"><parent link="a"/><child link="b"/></joint></robot>',
        tmp_path,
    )
    assert [link.name for link in robot.links] == ["a", "b", "c"]
    assert (robot.joints[0].limits, robot.joints[0].effort) == (None, None)


def test_home_is_in_the_middle_of_a_range_without_zero(tmp_path):
    joint = Joint("j", "prismatic", "a", "b", limits=(0.2, 0.8), effort=1.0, velocity=1.0)
    robot = Robot("r", (Link("a"), Link("b")), (joint,), home=(0.3,))
    path = written(robot, tmp_path)
    assert read_urdf(path).home == (0.3,)
    path.write_text(path.read_text().replace("morphgen>", "others>"))
    assert read_urdf(path).home == (0.5,)


def test_a_urdf_without_its_bundle_keeps_tool_and_home(tmp_path):
    path = written(arm(), tmp_path)
    alone = read_robot(path)
    assert alone.home == arm().home
    (tool,), (expected,) = alone.frames, arm().frames
    assert (tool.name, tool.link) == (expected.name, expected.link)
    assert tool.T_link_frame.matrix == pytest.approx(expected.T_link_frame.matrix, rel=0, abs=1e-9)
    assert [link.name for link in alone.links] == [link.name for link in arm().links]


@pytest.mark.parametrize("position", ["nan", "inf", "1e999", "left", ""])
def test_a_home_that_is_not_a_number_is_an_error(tmp_path, position):
    path = written(arm(), tmp_path)
    path.write_text(path.read_text().replace('position="0.4"', f'position="{position}"'))
    with pytest.raises(FormatError, match=rf"robot.urdf:\d+: home position '{position}'"):
        read_robot(path)


def test_a_capsule_is_written_as_cylinder_and_spheres_and_read_back(tmp_path):
    T = Pose.from_xyz_rpy((0.1, 0, 0), (1.0, 0, 0))
    others = (Shape(Sphere(0.05)), Shape(Cylinder(0.05, 0.1)))
    link = Link("a", collisions=(*others, Shape(Capsule(0.05, 0.2), T), *others))
    path = written(Robot("r", (link,)), tmp_path)
    kinds = [Sphere, Cylinder, Capsule, Sphere, Cylinder]
    assert [type(shape.geometry) for shape in read_urdf(path).root.collisions] == kinds
    assert read_urdf(path).root.collisions[2].geometry == Capsule(0.05, 0.2)
    path.write_text(path.read_text().replace('length="0.2"', 'length="0.3"'))
    shapes = read_urdf(path).root.collisions[2:5]
    assert [type(shape.geometry) for shape in shapes] == [Cylinder, Sphere, Sphere]
    ends = [np.array(shape.T_link_shape.position) for shape in shapes[1:]]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(0.2)
    np.testing.assert_allclose((ends[0] + ends[1]) / 2, T.position, atol=1e-12)


def test_a_missing_mesh_is_an_error(tmp_path):
    with pytest.raises(UnsoundError, match=r"gone\.stl") as caught:
        reading(urdf(base=MESH.format("gone.stl")), tmp_path)
    assert caught.value.findings[0].code == "mesh-unresolved"
    assert str(caught.value).count("gone.stl") == 2  # as written, and where it was looked for
    sent = pickle.loads(pickle.dumps(caught.value))  # as a worker process sends it
    assert (str(sent), sent.findings) == (str(caught.value), caught.value.findings)


def test_numbers_have_twelve_digits_and_no_negative_zero():
    values = (0.1 + 0.2, -0.0, 1e-13, 1.0, -1.5707963267948966)
    texts = ["0.3", "0", "0", "1", "-1.57079632679"]
    assert [format_number(value) for value in values] == texts


INERTIAL = (
    '<inertial>{}<mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>'
)
BALL = '<geometry><sphere radius="0.05"/></geometry>'
S = 0.7071067811865476
TRIANGLE = b"vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
STL = b"solid\nfacet\nouter loop\n" + TRIANGLE + b"endloop\nendfacet\nendsolid\n"


def urdf(base="", tip="", more="", origin="", com=""):
    return (
        f'<robot name="r" version="1.2"><link name="base">{INERTIAL.format("")}{base}</link>\n'
        f'<link name="tip">{INERTIAL.format(com)}{tip}</link>\n'
        f'<joint name="j" type="revolute">{origin}<parent link="base"/><child link="tip"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="5" velocity="1"/></joint>\n'
        f"{more}</robot>"
    )


def reading(text, folder, **options):
    path = folder / "r.urdf"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return read(path, **options)


def codes(robot):
    return [finding.code for finding in robot.source_findings]


@pytest.mark.parametrize(
    ("rotation", "R"),
    [
        (f'quat_xyzw="0 0 {S} {S}"', [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ('quat_xyzw="0 0 -3 -3"', [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        (f'quat_xyzw="0 {S} 0 {S}"', [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
        ('quat_xyzw="0.5 0.5 0.5 0.5"', [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        ('rpy="0 0 1.5707963267948966"', [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    ],
)
def test_rotations_of_joints_shapes_and_inertias_are_read(tmp_path, rotation, R):
    origin = f'<origin xyz="0.1 0 0" {rotation}/>'
    tip = f"<visual>{origin}{BALL}</visual><collision>{origin}{BALL}</collision>"
    robot = reading(urdf(tip=tip, origin=origin, com=origin), tmp_path)
    link = robot.links[1]
    poses = [robot.joints[0].T_parent_joint, link.visuals[0].T_link_shape]
    for T in (*poses, link.collisions[0].T_link_shape):
        np.testing.assert_allclose(T.matrix[:3, :3], R, atol=1e-12)
        assert T.position == (0.1, 0, 0)
    expected = np.array(R) @ np.diag([0.01, 0.01, 0.002]) @ np.array(R).T
    np.testing.assert_allclose(link.inertial.matrix, expected, atol=1e-12)
    assert robot.source_findings == ()


RED, BLUE = '<material name="m"><color rgba="1 0 0 1"/></material>', "0 0 1 1"
NAMED = '<material name="m"/>'


@pytest.mark.parametrize(
    ("base", "tip", "more", "colours"),
    [
        (RED, NAMED, "", ["red", "red"]),
        (NAMED, RED, "", ["red", "red"]),
        (NAMED, NAMED, RED, ["red", "red"]),
        (RED, NAMED, RED.replace("1 0 0 1", BLUE), ["red", "blue"]),
        (RED, RED.replace("1 0 0 1", BLUE), "", ["red", "blue"]),
        (RED, '<material name="n"/>', "", ["red", None]),
        (RED, "", "", ["red", None]),
    ],
)
def test_a_material_of_one_link_is_known_in_all(tmp_path, base, tip, more, colours):
    visuals = [f"<visual>{BALL}{material}</visual>" for material in (base, tip)]
    robot = reading(urdf(*visuals, more=more), tmp_path)
    rgba = {"red": (1, 0, 0, 1), "blue": (0, 0, 1, 1), None: None}
    assert [link.visuals[0].rgba for link in robot.links] == [rgba[colour] for colour in colours]
    unknown = tip not in ("", NAMED) and tip != RED and None in colours
    assert codes(robot) == (["material-unknown"] if unknown else [])


@pytest.mark.parametrize(
    ("change", "guess"),
    [
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><origin xzy="0 0 1"/>'), "xyz"),
        (('upper="1"', 'upper="1" uper="2"'), "upper"),
        (('<mass value="1"/>', '<mass value="1" valeu="2"/>'), "value"),
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><limits/>'), "limit"),
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><dynamic damping="1"/>'), "dynamics"),
        (("</robot>", '<jiont name="k"/></robot>'), "joint"),
        (('<link name="tip">', '<link name="tip"><visuals/>'), "visual"),
        (('<mass value="1"/>', '<mass value="1"><inertai/></mass>'), None),
        (("</joint>", "<p:axis/></joint>"), None),
    ],
)
def test_a_slip_is_a_finding_with_the_nearest_name(tmp_path, change, guess):
    text = urdf().replace('name="r"', 'name="r" xmlns:p="p"')
    assert change[0] in text
    robot = reading(text.replace(*change, 1), tmp_path)
    (finding,) = robot.source_findings
    assert finding.code in ("attribute-unread", "element-unread")
    assert finding.severity == ("info" if "p:axis" in change[1] else "warning")
    assert guess is None or f"did you mean '{guess}'?" in finding.why
    assert guess is None or f"did you mean '{guess}'?" in finding.repair
    assert finding.where.startswith("r.urdf:")


def test_extensions_are_counted_by_kind_without_a_line_for_each():
    more = '<gazebo reference="tip"><a><b/></a></gazebo>' * 200 + "<transmission/>" * 3 + "hello"
    text = urdf(more=more, tip=f"<collision>{BALL}<contact/></collision>" * 4)
    found = structure_findings(parse_xml(text.encode(), "r.urdf"), "r.urdf")
    assert [(f.code, f.severity, f.repair) for f in found] == [
        ("text-unread", "warning", "left out: 1 text of <robot>, not of URDF"),
        ("element-unread", "info", "left out: 200 <gazebo> of <robot> with 400 elements inside"),
        ("element-unread", "info", "left out: 3 <transmission> of <robot>"),
        ("element-unread", "info", "left out: 4 <contact> of <collision>"),
    ]


MESH = '<visual><geometry><mesh filename="{}"/></geometry></visual>'


def mesh_file(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(STL)
    return path


@pytest.mark.parametrize(
    ("uri", "folder", "root"),
    [
        ("package://some_export/meshes/a.stl", "meshes", None),
        ("model://other/meshes/deep/a.stl", "../meshes/deep", None),
        ("package://2 bad.name/meshes/a.stl", "meshes", None),
        ("package://some_export/meshes/a.stl", "../elsewhere/meshes", "../elsewhere"),
        ("package://some_export/meshes/a.stl", "../elsewhere/meshes", "../elsewhere/meshes"),
    ],
)
def test_meshes_of_an_unknown_package_are_found_around_the_file(tmp_path, uri, folder, root):
    home = tmp_path / "a" / "b"
    mesh = mesh_file(home / folder / "a.stl")
    root = None if root is None else home / root
    robot = reading(urdf(base=MESH.format(uri)), home, root=root)
    assert robot.links[0].visuals[0].geometry.path.samefile(mesh)
    assert codes(robot) == ["mesh-beside"]


@pytest.mark.parametrize(
    ("uri", "folder"),
    [
        ("package://unknown/../secret/a.stl", None),
        ("package://unknown/../../secret/a.stl", None),
        ("package://unknown/%2e%2e/secret/a.stl", None),
        ("package://unknown/link/a.stl", None),
        ("a.stl", "{secret}"),
        ("a.stl", "../../secret"),
        ("a.stl", "link"),
    ],
)
def test_meshes_do_not_leave_the_files_folders(tmp_path, uri, folder):
    """By the path in an unknown package, or by MuJoCo's folder of meshes."""
    secret = mesh_file(tmp_path / "secret" / "a.stl").parent
    home = tmp_path / "a" / "b"
    home.mkdir(parents=True)
    (home / "link").symlink_to(secret)
    compiler = f'<mujoco><compiler meshdir="{folder}"/></mujoco>'.format(secret=secret)
    with pytest.raises(FormatError):
        reading(urdf(base=MESH.format(uri), more=compiler if folder else ""), home)


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", None])
def test_a_mesh_of_an_installed_package_is_a_finding_and_on_the_card(
    tmp_path, monkeypatch, variable
):
    package, rest, source, licence = "far_description", "meshes/a.stl", "far_description", "MIT"
    if variable is None:
        pytest.importorskip("rtbdata")
        package, rest, source = "ur_description", "meshes/ur5/visual/base.dae", "rtb-data 1.1.0"
    else:
        share = tmp_path / "site" / ("share" if variable.startswith("AMENT") else "")
        mesh_file(share / package / rest)
        manifest = f"<package><name>{package}</name><license>MIT</license></package>"
        (share / package / "package.xml").write_text(manifest)
        monkeypatch.setenv(variable, str(tmp_path / "site"))
    home = tmp_path / "mine"
    path = home / "r.urdf"
    robot = reading(urdf(base=MESH.format(f"package://{package}/{rest}")), home)
    assert codes(robot) == ["mesh-from-package"]
    assert str(robot.links[0].visuals[0].geometry.path) in robot.source_findings[0].why
    assert main(["import", str(path), "--out", str(tmp_path / "out"), "--no-picture"]) in (0, 1)
    card = json.loads((tmp_path / "out" / "r" / "card.json").read_text())
    assert card["packages"] == [{"package": package, "source": source, "licence": licence}]
    assert read(tmp_path / "out" / "r").provenance["packages"] == card["packages"]
    beside = mesh_file(home / rest)  # its own file comes first
    if beside.suffix == ".stl":
        robot = read(path)
        assert robot.links[0].visuals[0].geometry.path == beside
        assert codes(robot) == ["mesh-beside"]


@pytest.mark.parametrize(
    "uri", ["package://no/a.stl", "no/a.stl", "file:///no/a.stl", "../../a.stl"]
)
def test_missing_meshes_are_left_out_on_request(tmp_path, uri):
    path = mesh_file(tmp_path / "a" / "b" / "here.stl").with_name("r.urdf")
    base = MESH.format(uri) * 2 + MESH.format("here.stl")
    text = urdf(base=base, tip=MESH.format("gone.stl").replace("visual", "collision"))
    with pytest.raises(FormatError):
        reading(text, path.parent)
    robot = read(path, skip_missing_meshes=True)
    assert [len(link.visuals) for link in robot.links] == [1, 0]
    assert robot.links[1].collisions == ()
    (finding,) = robot.source_findings
    assert (finding.code, finding.severity) == ("mesh-skipped", "warning")
    assert "3 shapes were left out, because 2 meshes are missing" in finding.repair
    out = tmp_path / "out"
    words = ["import", str(path), "--out", str(out), "--no-picture", "--skip-missing-meshes"]
    assert main(words) in (0, 1)
    repairs = json.loads((out / "r" / "card.json").read_text())["repairs"]
    assert any("3 shapes were left out" in repair for repair in repairs)


@pytest.mark.parametrize(
    ("compiler", "uri", "place"),
    [
        ('meshdir="assets"', "a.stl", "assets/a.stl"),
        ('meshdir="assets/"', "package://p/any/a.stl", "assets/a.stl"),
        ('meshdir="assets" strippath="false"', "sub/a.stl", "assets/sub/a.stl"),
        ("", "package://p/any/a.stl", "a.stl"),
        ('meshdir="../meshes"', "a.stl", "../meshes/a.stl"),
    ],
)
def test_the_mesh_folder_of_mujoco_applies_to_a_urdf(tmp_path, compiler, uri, place):
    home = tmp_path / "a" / "b"
    mesh = mesh_file(home / place)
    more = f"<mujoco><compiler {compiler}/></mujoco>"
    robot = reading(urdf(base=MESH.format(uri), more=more), home)
    assert robot.links[0].visuals[0].geometry.path.samefile(mesh)
    assert codes(robot) in ([], ["mesh-beside"])


def free(kind, parent, child):
    return (
        f'<joint name="{parent}_{child}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="0 0 1"/></joint>'
    )


@pytest.mark.parametrize(
    ("more", "num_links"),
    [
        ('<link name="world"/>' + free("floating", "world", "base"), 1),
        ('<link name="world"/>' + free("planar", "world", "base"), 1),
        (
            f'<link name="world"><visual>{BALL}</visual></link><link name="table"/>'
            f"{free('fixed', 'world', 'table')}{free('floating', 'world', 'base')}",
            2,
        ),
        (
            '<link name="odom"/><link name="foot"/>'
            f"{free('planar', 'odom', 'foot')}{free('fixed', 'foot', 'base')}",
            1,
        ),
        (
            '<link name="map"/><link name="odom"/>'
            f"{free('planar', 'map', 'odom')}{free('floating', 'odom', 'base')}",
            2,
        ),
    ],
)
def test_a_free_base_is_left_out_with_a_finding(tmp_path, more, num_links):
    robot = reading(urdf(more=more), tmp_path)
    assert {link.name for link in robot.links} - {"foot"} == {"base", "tip"}
    assert {joint.name for joint in robot.joints} - {"foot_base"} == {"j"}
    found = [finding for finding in robot.source_findings if finding.code == "base-free"]
    assert len(found) == more.count("planar") + more.count("floating")
    assert f"{num_links} links above it" in found[0].repair


@pytest.mark.parametrize(
    "more",
    [
        '<link name="box"/>' + free("floating", "tip", "box"),
        '<link name="w"/><link name="box"/>'
        f"{free('floating', 'w', 'base')}{free('floating', 'w', 'box')}",
    ],
)
def test_a_free_joint_elsewhere_is_an_error(tmp_path, more):
    with pytest.raises(FormatError, match="not supported"):
        reading(urdf(more=more), tmp_path)


@pytest.mark.parametrize(
    ("start", "why"),
    [
        ('<r:robot xmlns:r="x" ', "<r:robot>, not <robot>; remove the prefix 'r'"),
        ("<r:robot ", "<r:robot>, not <robot>; remove the prefix 'r'"),
        ('<robot xmlns="x" ', "namespace 'x'; remove xmlns"),
        ('<m:mujoco xmlns:m="y" ', "<m:mujoco>, not <robot>; remove the prefix 'm'"),
    ],
)
def test_a_root_with_a_namespace_is_refused_with_a_true_message(tmp_path, start, why):
    tag = start[1:].split()[0]
    text = urdf().replace("<robot ", start).replace("</robot", f"</{tag}")
    with pytest.raises(FormatError, match=re.escape(why)):
        reading(text, tmp_path)


def test_a_capsule_without_a_length_is_an_error(tmp_path):
    shape = '<geometry><capsule radius="0.1" diameter="1"/></geometry>'
    with pytest.raises(FormatError, match="has no length, but diameter"):
        reading(urdf(tip=f"<collision>{shape}</collision>"), tmp_path)


def test_the_findings_of_a_bundle_do_not_name_what_morphgen_wrote(tmp_path):
    robot = reading(urdf(tip=f"<visual>{BALL}</visual>"), tmp_path)
    folder = write_bundle(robot, tmp_path / "bundle", picture=False)
    assert read_urdf(folder / "robot.urdf").source_findings == ()


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("&lt;x&gt;", "x_"),
        ("_arm", "arm"),
        ("../../up", "up"),
        ("a" * 300, "a" * 200),
        ("\u673a\u5668", "robot"),
        ("my arm", "my_arm"),
    ],
)
def test_the_name_of_an_imported_robot_is_one_that_a_bundle_can_have(tmp_path, name, written):
    file = tmp_path / "<x>.urdf"
    file.write_text(urdf().replace('name="r"', f'name="{name}"'))
    out = tmp_path / "out"
    assert main(["import", str(file), "--out", str(out), "--no-picture"]) in (0, 1)
    assert read(out / written).name == written


RNG = np.random.default_rng(0)
NEAR_GIMBAL = [
    (a, s * (math.pi / 2 - off), b)
    for a in (0.0, 1.1)
    for b in (-2.3, 0.4)
    for s in (1, -1)
    for off in (0.0, 1e-13, 1e-10, 1e-8, 3.7e-6, 1e-4, 1e-2)
]
HALF_TURNS = [(math.pi, 0.0, 0.3), (0.7, math.pi, 0.0), (math.pi, 0.2, math.pi)]
TINY = [(1e-5, 3e-9, -2e-11), (4e-12, 1.0, 7e-13)]
RANDOM = RNG.uniform(-math.pi, math.pi, (200, 3)).tolist()


def from_file(pose):
    """Return the pose after writing it to a URDF and reading it."""
    triples = (pose.position, pose.rpy)
    xyz, rpy = ([float(format_number(value)) for value in triple] for triple in triples)
    return Pose.from_xyz_rpy(xyz, rpy)


@pytest.mark.parametrize("rpy", [*NEAR_GIMBAL, *HALF_TURNS, *TINY, *RANDOM])
def test_rounded_poses_round_trip_through_a_file(rpy):
    pose = Pose.from_xyz_rpy(tuple(RNG.normal(size=3)), rpy)
    rounded = rounded_pose(pose)
    assert rounded_pose(rounded) == rounded
    assert rounded_pose(from_file(rounded)) == rounded
    turned = np.array(to_matrix(rounded.quaternion)) - to_matrix(pose.quaternion)
    assert np.abs(turned).max() < 1e-9


def tilted(rng):
    return Pose.from_xyz_rpy(tuple(rng.normal(size=3)), tuple(rng.uniform(-3, 3, 3)))


def odd_robot(seed):
    """Return a tree with everything that a file changes: joint defaults, capsules, long numbers."""
    rng = np.random.default_rng(seed)
    limits = tuple(sorted(rng.normal(size=2)))
    can = Shape(Capsule(0.1 / 3, 0.7 / 3), tilted(rng))
    body = Inertial(1 / 3, tuple(rng.normal(size=3)), (1e-5 / 3, 1e-9 / 3, 0.0, 2e-5 / 3, 0, 2e-5))
    links = (
        Link("root"),
        Link("a", body, collisions=(can, Shape(Box((0.1 / 3, 0.1, 0.1)), tilted(rng)))),
        Link("b", Inertial(0.0), collisions=(Shape(Cylinder(1 / 7, 1 / 9), tilted(rng)),)),
        Link("c"),
    )
    axis = tuple(rng.normal(size=3))
    joints = (
        Joint("j0", "revolute", "root", "a", tilted(rng), axis, velocity=2 / 3),
        Joint("j1", "prismatic", "root", "b", tilted(rng), axis, limits, effort=10 / 3),
        Joint("j2", "fixed", "a", "c", tilted(rng), limits=(0.0, 1.0), damping=1.0),
    )
    tool = Frame("tool", "c", tilted(rng))
    return Robot("odd", links, joints, (tool,), home=(1 / 3, 2 / 3))


@pytest.mark.parametrize("robot", [arm(), *map(odd_robot, range(10))])
def test_rounded_robots_round_trip_through_a_file(tmp_path, robot):
    rounded = as_written(robot)
    there = as_written(read_bundle(write_bundle(robot, tmp_path / "r", picture=False)))
    assert as_written(rounded).joints == rounded.joints
    for name in ("joints", "frames", "home"):
        assert getattr(there, name) == getattr(rounded, name)
    for link, other in zip(rounded.links, there.links, strict=True):
        bare = replace(other, visuals=link.visuals)
        assert bare == replace(link, collisions=bare.collisions)
        shapes = [[replace(s, rgba=None) for s in each.collisions] for each in (link, other)]
        assert shapes[0] == shapes[1]
