"""MJCF: what is written and read, meshes, what is refused, and where an MJCF can be named."""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

import morphgen
from helpers.mjcf import TWO_JOINTS, inertia_in_mujoco, read, refusal, write
from helpers.parts import write_part
from helpers.robots import arm, composed, rod
from morphgen.errors import FormatError
from morphgen.formats.bundle import is_mjcf, read_bundle, read_description, read_robot, write_bundle
from morphgen.formats.mjcf.read import read_mjcf
from morphgen.formats.mjcf.write import FLAT_THICKNESS, mjcf_text, to_spec
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import UnsoundError
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.robot_source import import_robot
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import forward_kinematics, movable_positions, random_configurations
from morphgen.model.mesh import convex_hull, load_mesh
from morphgen.model.robot import Inertial, Joint, Link, Robot


def no_file(mesh):
    raise AssertionError(f"{mesh} was written")


def text(robot):
    return mjcf_text(robot, no_file)


def compiled(robot):
    return mujoco.MjModel.from_xml_string(text(robot))


def single(shape, **kwargs):
    return Robot("one", (Link("body", Inertial(1.0, inertia=(1, 0, 0, 1, 0, 1)), **kwargs),))


def hinged(link, joint=None):
    """Return a link with a revolute joint on a massless root."""
    joint = joint or Joint("hinge", "revolute", "root", link.name, limits=(-1.0, 1.0))
    return Robot("hinged", (Link("root"), link), (joint,), home=(0.0,))


def test_inertias_keep_their_digits():
    matrix = np.array([[3.123456789e-8, 4e-9, -5e-9], [4e-9, 2.9e-8, 6e-9], [-5e-9, 6e-9, 3e-8]])
    link = Link("bead", Inertial.from_matrix(0.0123456789, (0.1, 0.2, 1 / 3), matrix))
    model = compiled(hinged(link))
    body = model.body("bead")
    assert body.mass[0] == pytest.approx(0.0123456789, rel=1e-9)
    assert body.ipos == pytest.approx((0.1, 0.2, 1 / 3), abs=1e-9)
    assert inertia_in_mujoco(model, "bead") == pytest.approx(matrix, abs=1e-6 * 3e-8)


def test_the_spec_equals_the_text():
    robot = arm()
    assert to_spec(robot).to_xml() == mujoco.MjSpec.from_string(text(robot)).to_xml()


def test_primitives_have_their_sizes_and_groups():
    shapes = (
        Shape(Box((0.1, 0.2, 0.3)), Pose((1.0, 2.0, 3.0))),
        Shape(Sphere(0.1)),
        Shape(Cylinder(0.1, 0.4)),
        Shape(Capsule(0.1, 0.4), rgba=(0.1, 0.2, 0.3, 0.5)),
    )
    model = compiled(single("body", visuals=shapes, collisions=shapes))
    kinds = [mujoco.mjtGeom(kind).name[7:].lower() for kind in model.geom_type]
    assert kinds == ["box", "sphere", "cylinder", "capsule"] * 2
    sizes = [[0.05, 0.1, 0.15], [0.1, 0, 0], [0.1, 0.2, 0], [0.1, 0.2, 0]]
    assert model.geom_size.tolist() == sizes * 2
    assert model.geom_pos[0].tolist() == [1.0, 2.0, 3.0]
    assert model.geom_rgba[3] == pytest.approx((0.1, 0.2, 0.3, 0.5))
    assert model.geom_group.tolist() == [2] * 4 + [3] * 4
    assert model.geom_contype.tolist() == [0] * 4 + [1] * 4
    assert model.geom_conaffinity.tolist() == [0] * 4 + [1] * 4


def test_continuous_and_unlimited_joints_have_no_range():
    for kind, limits in (("continuous", (-1.0, 1.0)), ("revolute", None)):
        joint = Joint("free", kind, "root", "rod", limits=limits)
        model = compiled(hinged(rod("rod"), joint))
        assert model.jnt_limited.tolist() == [0]
        assert model.actuator_ctrllimited.tolist() == [0]
        assert model.actuator_forcelimited.tolist() == [0]


def test_a_root_named_world_is_the_world_body():
    robot = hinged(rod("rod"))
    joint = replace(robot.joints[0], parent="world")
    robot = replace(robot, links=(Link("world"), robot.links[1]), joints=(joint,))
    assert compiled(robot).nbody == 2
    heavy = Link("world", Inertial(1.0))
    with pytest.raises(FormatError, match="rename"):
        text(replace(robot, links=(heavy, robot.links[1])))


@pytest.mark.parametrize("limits", [(0.0, 0.0), (1.0, -1.0)])
def test_limits_without_a_range_are_errors(limits):
    with pytest.raises(FormatError, match=r"'hinge'.*fixed"):
        text(hinged(rod("rod"), Joint("hinge", "revolute", "root", "rod", limits=limits)))


def meshed(path, *, collision, scale=(1.0, 1.0, 1.0)):
    shape = (Shape(Mesh(path, scale)),)
    shapes = {"collisions": shape} if collision else {"visuals": shape}
    return single("body", **shapes)


def export(mesh, path):
    path.parent.mkdir(exist_ok=True)
    mesh.export(path)
    return path


@pytest.fixture
def flat(tmp_path):
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    return export(square, tmp_path / "flat.stl")


@pytest.mark.parametrize("collision", [True, False])
def test_meshes_without_files_are_in_the_model(tmp_path, collision):
    path = export(trimesh.creation.box((1, 2, 3)), tmp_path / "cube.stl")
    model = to_spec(meshed(path, collision=collision, scale=(0.1, 0.1, -0.1))).compile()
    extents = sorted(np.ptp(model.mesh_vert, axis=0))
    assert extents == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)


def test_each_mesh_file_is_declared_once(tmp_path):
    path = export(trimesh.creation.box(), tmp_path / "cube.stl")
    shape = Shape(Mesh(path))
    robot = single("body", visuals=(shape, shape), collisions=(shape,))
    written = mjcf_text(robot, lambda mesh: f"meshes/{Path(mesh.path).name}")
    assert re.findall(r'<mesh [^>]*file="([^"]*)"', written) == ["meshes/cube.stl"]
    assert written.count('mesh="cube"') == 3


def test_meshes_with_the_same_file_stem_have_unique_names(tmp_path):
    cubes = [trimesh.creation.box((k, k, k)) for k in (1, 2)]
    paths = [export(cube, tmp_path / f"{k}" / "cube.stl") for k, cube in enumerate(cubes)]
    shapes = tuple(Shape(Mesh(path)) for path in paths)
    assert to_spec(single("body", visuals=shapes)).compile().nmesh == 2


def test_flat_visual_meshes_compile(flat, tmp_path):
    assert to_spec(meshed(flat, collision=False)).compile().nmeshface == 2
    written = mjcf_text(meshed(flat, collision=False), lambda mesh: str(mesh.path))
    assert mujoco.MjModel.from_xml_string(written).nmeshface == 2
    triangle = export(trimesh.Trimesh(np.eye(3), [[0, 1, 2]]), tmp_path / "triangle.stl")
    assert to_spec(meshed(triangle, collision=False)).compile().nmesh == 1


def test_flat_collision_meshes_get_a_thickness(flat):
    robot = meshed(flat, collision=True)
    written = mujoco.MjModel.from_xml_string(mjcf_text(robot, no_file))
    for model in (written, to_spec(robot).compile()):
        assert min(np.ptp(model.mesh_vert, axis=0)) == pytest.approx(FLAT_THICKNESS, rel=1e-3)


@pytest.mark.slow
def test_a_mesh_with_more_faces_than_mujoco_reads_from_stl(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=7)
    assert len(sphere.faces) > 200_000
    path = export(sphere, tmp_path / "sphere.stl")
    assert to_spec(meshed(path, collision=False)).compile().nmeshface == len(sphere.faces)


TETRAHEDRON = "0 0 0  1 0 0  0 1 0  0 0 1"
FACES = "0 2 1  0 1 3  0 3 2  1 2 3"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def directions():
    vectors = np.random.default_rng(0).normal(size=(200, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def shape_support(shape):
    """Return the support function of a mesh shape, in the frame of its link."""
    T = shape.T_link_shape.matrix
    points = np.asarray(load_mesh(shape.geometry).vertices) @ T[:3, :3].T + T[:3, 3]
    return (points @ directions().T).max(axis=0)


def mujoco_support(model, geom):
    """Return the support function of a mesh geom, in the frame of the world's only body."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mesh = model.mesh(model.geom_dataid[geom])
    points = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
    points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    return (points @ directions().T).max(axis=0)


def assert_mass_as_in_mujoco(robot, model):
    inertial = robot.root.inertial
    assert inertial.mass == pytest.approx(model.body_mass[1])
    np.testing.assert_allclose(inertial.com, model.body_ipos[1], atol=1e-9)
    expected = inertia_in_mujoco(model, 1)
    np.testing.assert_allclose(inertial.matrix, expected, atol=1e-6 * model.body_inertia[1].max())


def assert_as_in_mujoco(robot, path):
    """Compare mass, inertia and the support function of all meshes of a robot of one link."""
    model = mujoco.MjModel.from_xml_path(str(path))
    assert_mass_as_in_mujoco(robot, model)
    meshes = [s for s in robot.root.collisions if isinstance(s.geometry, Mesh)]
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    geoms = np.flatnonzero(is_mesh & (model.geom_contype > 0))
    assert len(meshes) == len(geoms) > 0
    for shape, geom in zip(meshes, geoms, strict=True):
        np.testing.assert_allclose(shape_support(shape), mujoco_support(model, geom), atol=1e-6)


def test_vertices_in_the_document_become_files_of_the_bundle(tmp_path):
    points = " ".join(f"{x:.4f}" for x in np.random.default_rng(1).normal(size=60))
    path = write(
        tmp_path,
        f"""<asset>
          <mesh name="cloud/1" vertex="{points}" scale="1 2 -1" refpos="0.1 0.2 0.3"/>
          <mesh name="faces" vertex="{TETRAHEDRON}" face="{FACES}" refquat="1 1 0 0"/>
        </asset><worldbody><body name="base">
          <geom type="mesh" mesh="cloud/1" pos="0.1 0.2 0.3" euler="10 20 30"/>
          <geom type="mesh" mesh="faces" pos="0 0 1"/>
        </body></worldbody>""",
    )
    robot = read_mjcf(path)
    assert_as_in_mujoco(robot, path)
    cloud, faces = (shape.geometry for shape in robot.root.collisions)
    assert load_mesh(cloud).is_watertight
    assert load_mesh(cloud).volume > 0
    assert load_mesh(faces).volume == pytest.approx(1 / 6)
    bundle = write_bundle(robot, tmp_path / "test", picture=False)
    names = {file.name.rpartition("-")[0] for file in (bundle / "meshes").iterdir()}
    assert names == {"cloud_1", "faces"}
    assert_as_in_mujoco(read_bundle(bundle), bundle / "robot.xml")


def test_mesh_files_lie_where_mujoco_has_them(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    box.apply_translation((0.5, -0.2, 0.1))
    export(box, tmp_path / "meshes" / "box.stl")
    path = write(
        tmp_path,
        """<compiler meshdir="meshes"/><asset>
          <mesh file="box.stl" scale="1 2 -1" refpos="0.1 0.2 0.3"/>
          <mesh name="turned" file="box.stl" scale="2 2 2" refpos="0 1 0" refquat="1 1 0 0"/>
        </asset><worldbody><body name="base">
          <geom type="mesh" mesh="box" pos="0.1 0.2 0.3" euler="10 20 30"/>
          <geom type="mesh" mesh="turned" pos="0 0 1" euler="0 0 30"/>
        </body></worldbody>""",
    )
    robot = read_mjcf(path)
    assert_as_in_mujoco(robot, path)
    assert robot.root.collisions[0].geometry.scale == (1.0, 2.0, -1.0)


def test_the_same_vertices_have_the_same_file(tmp_path, cache):
    content = f"""<asset><mesh name="m" vertex="{TETRAHEDRON}"/></asset><worldbody>
    <body name="a"><geom type="mesh" mesh="m"/></body></worldbody>"""
    first, second = (read(tmp_path / folder, content) for folder in "ab")
    assert first.root == second.root
    assert len([*cache.rglob("*.stl")]) == 1


def test_an_ellipsoid_is_a_convex_mesh_of_its_volume_and_keeps_its_mass(tmp_path):
    path = write(
        tmp_path,
        """<worldbody><body name="a"><geom name="egg" type="ellipsoid" size="0.1 0.2 0.3"
        pos="0.1 0.2 0.3" euler="10 20 30" density="500"/>
        <geom type="ellipsoid" size="0.1 0.1 0.1"/></body></worldbody>""",
    )
    robot = read_mjcf(path)
    egg, ball = robot.root.collisions
    assert robot.root.visuals[0].geometry == egg.geometry
    assert ball.geometry == Sphere(0.1)
    radii = np.array((0.1, 0.2, 0.3))
    volume = 4 / 3 * np.pi * radii.prod()
    assert load_mesh(egg.geometry).volume == pytest.approx(volume, rel=1e-6)
    assert convex_hull(egg.geometry).volume == pytest.approx(volume, rel=1e-6)
    T = egg.T_link_shape.matrix
    exact = np.linalg.norm(directions() @ T[:3, :3] * radii, axis=1) + directions() @ T[:3, 3]
    assert np.abs(shape_support(egg) - exact).max() < 0.012 * radii.max()
    # The mass and the inertia are those of the solids, not of the meshes.
    assert_mass_as_in_mujoco(robot, mujoco.MjModel.from_xml_path(str(path)))
    (finding,) = robot.source_findings
    assert (finding.code, finding.where) == ("ellipsoid-mesh", "robot.xml: geom 'egg'")


def positions(robot, q):
    """Return the position of every movable joint by name."""
    names = (robot.joints[k].name for k in robot.movable_joints)
    return dict(zip(names, movable_positions(robot, q).tolist(), strict=True))


def assert_poses_agree(robot, path):
    """Compare links and sites with MuJoCo at random configurations."""
    data = mujoco_data(path)
    for q in random_configurations(robot, 10, np.random.default_rng(0)):
        for name, value in positions(robot, q).items():
            data.joint(name).qpos[0] = value
        assert_pose_agrees(robot, q, data)


def mujoco_data(path):
    return mujoco.MjData(mujoco.MjModel.from_xml_path(str(path)))


def assert_pose_agrees(robot, q, data):
    """Compare mass properties of links, and sites, with those of MuJoCo in its state."""
    mujoco.mj_kinematics(data.model, data)
    T_root_link = forward_kinematics(robot, q)
    for T, link in zip(T_root_link, robot.links, strict=True):
        if link.inertial is None:
            continue
        com = T @ [*link.inertial.com, 1]
        np.testing.assert_allclose(com[:3], data.body(link.name).xipos, atol=1e-9)
        R, R_com = T[:3, :3], data.body(link.name).ximat.reshape(3, 3)
        principal = np.diag(data.model.body(link.name).inertia)
        inertia = R @ link.inertial.matrix @ R.T
        np.testing.assert_allclose(inertia, R_com @ principal @ R_com.T, atol=1e-9)
    for frame in robot.frames:
        if frame.name != "tool":
            T = T_root_link[robot.link_index[frame.link]] @ frame.T_link_frame.matrix
            np.testing.assert_allclose(T[:3, 3], data.site(frame.name).xpos, atol=1e-9)
            np.testing.assert_allclose(T[:3, :3].ravel(), data.site(frame.name).xmat, atol=1e-9)


def assert_same(robot, other):
    """Compare what an MJCF holds of a robot."""
    assert other.name == robot.name
    assert set(other.link_index) == set(robot.link_index)
    for link in robot.links:
        inertial = other.link(link.name).inertial
        if link.inertial is None or link.inertial.mass == 0:
            assert inertial is None
            continue
        assert inertial.mass == pytest.approx(link.inertial.mass, rel=1e-9)
        np.testing.assert_allclose(inertial.com, link.inertial.com, atol=1e-9)
        np.testing.assert_allclose(inertial.matrix, link.inertial.matrix, rtol=1e-6, atol=1e-11)
        for kind in ("visuals", "collisions"):
            shapes, read_shapes = getattr(link, kind), getattr(other.link(link.name), kind)
            assert [type(s.geometry) for s in shapes] == [type(s.geometry) for s in read_shapes]
            for shape, read_shape in zip(shapes, read_shapes, strict=True):
                T, T_read = shape.T_link_shape.matrix, read_shape.T_link_shape.matrix
                np.testing.assert_allclose(T, T_read, atol=1e-6)
    for joint in (robot.joints[k] for k in robot.movable_joints):
        read_joint = other.joints[other.joint_index[joint.name]]
        assert (read_joint.is_independent, read_joint.is_continuous) == (
            joint.is_independent,
            joint.is_continuous,
        )
        if joint.limits is not None and not joint.is_continuous:
            assert read_joint.limits == pytest.approx(joint.limits, abs=1e-9)
        if joint.is_independent and joint.effort:
            assert read_joint.effort == pytest.approx(joint.effort)
    assert positions(other, other.home) == pytest.approx(positions(robot, robot.home), abs=1e-9)
    assert other.ignore_pairs == robot.ignore_pairs
    assert {frame.name for frame in other.frames} == {frame.name for frame in robot.frames}
    assert_same_poses(robot, other)


def assert_same_poses(robot, other):
    """Compare links, mimic joints and frames of two robots at random configurations."""
    order = {robot.joints[k].name: i for i, k in enumerate(robot.independent_joints)}
    columns = [order[other.joints[k].name] for k in other.independent_joints]
    for q in random_configurations(robot, 5, np.random.default_rng(1)):
        T, T_read = forward_kinematics(robot, q), forward_kinematics(other, q[columns])
        assert positions(other, q[columns]) == pytest.approx(positions(robot, q), abs=1e-9)
        for name, i in robot.link_index.items():
            np.testing.assert_allclose(T_read[other.link_index[name]], T[i], atol=1e-9)
        for frame in robot.frames:
            other_frame = other.frame(frame.name)
            np.testing.assert_allclose(
                T_read[other.link_index[other_frame.link]] @ other_frame.T_link_frame.matrix,
                T[robot.link_index[frame.link]] @ frame.T_link_frame.matrix,
                atol=1e-9,
            )


def branching():
    """A tree whose joints are in another order than MuJoCo's, which is depth first."""
    places = {"left": ("root", -0.2), "right": ("root", 0.2), "left_tip": ("left", 0.0)}
    links = tuple(rod(name) for name in ("root", *places, "right_tip"))
    joints = tuple(
        Joint(child, "revolute", parent, child, Pose((x, 0, 0.3)), (0, 1, 0), (-2.0, 2.0))
        for child, (parent, x) in {**places, "right_tip": ("right", 0.0)}.items()
    )
    return Robot("tree", links, joints, home=(0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize("make", [arm, branching])
def test_written_robots_read_the_same(make, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf_text(make(), lambda mesh: ""), encoding="utf-8")
    assert_same(make(), read_mjcf(path))


@pytest.mark.parametrize(
    "words", ["arm=ur5 ee=plane", "arm=arm3 ee=panda_hand", "base=gantry arm=arm3 ee=plane"]
)
def test_mjcf_of_composed_bundles_reads_the_same(words, tmp_path):
    folder = write_bundle(composed(words), tmp_path / "arm", picture=False)
    robot = read_bundle(folder)
    assert_same(robot, read_mjcf(folder / "robot.xml"))


def test_defaults_degrees_and_several_joints_of_a_body_agree_with_mujoco(tmp_path):
    path = write(
        tmp_path,
        """
        <compiler angle="degree" eulerseq="zyx"/>
        <default>
          <joint damping="0.5" frictionloss="0.1"/>
          <default class="arm"><joint axis="0 1 0" range="-90 45"/>
            <geom type="capsule" size="0.02 0.1" rgba="1 0 0 1"/></default>
        </default>
        <worldbody>
          <geom type="plane" size="1 1 1"/>
          <body name="base" pos="0.1 0 0.2" euler="10 20 30">
            <geom type="box" size="0.1 0.2 0.3"/>
            <body name="upper" pos="0 0 0.3" childclass="arm">
              <joint name="pan" axis="0 0 1"/>
              <joint name="lift" pos="0.05 0 0.02"/>
              <joint name="reach" type="slide" axis="1 0 1" range="0 0.2"/>
              <geom name="u" pos="0 0 0.1"/>
              <site name="elbow" pos="0 0.1 0.2" euler="0 45 0"/>
              <body name="lower" pos="0 0 0.25" euler="0 0 90">
                <joint name="bend" pos="0 0.03 -0.02" ref="15" range="-30 60"/>
                <joint name="turn" axis="1 1 0" limited="false"/>
                <geom fromto="0 0 0 0.1 0.2 0.3"/>
                <body name="tip" pos="0 0 0.2">
                  <joint name="last" pos="0.1 0 0" axis="0 0 1" range="-20 20"/>
                  <geom type="cylinder"/><geom type="sphere" pos="0.1 0 0" mass="2"/>
                  <site name="grip_site" pos="0 0 0.1"/>
                </body>
              </body>
            </body>
          </body>
        </worldbody>""",
    )
    robot = read_mjcf(path)
    assert_poses_agree(robot, path)
    assert [link.name for link in robot.links] == [
        *("world", "base", "upper_pan", "upper_lift", "upper"),
        *("lower_bend", "lower", "tip"),
    ]
    joints = {joint.name: joint for joint in robot.joints}
    kinds = {name: joint.kind for name, joint in joints.items() if joint.kind != "revolute"}
    assert kinds == {"base_joint": "fixed", "reach": "prismatic", "turn": "continuous"}
    assert list(joints) == ["base_joint", "pan", "lift", "reach", "bend", "turn", "last"]
    assert joints["lift"].limits == pytest.approx((-np.pi / 2, np.pi / 4))
    assert (joints["pan"].damping, joints["pan"].friction) == (0.5, 0.1)
    upper = robot.link("upper")
    assert upper.visuals[0].rgba == (1.0, 0.0, 0.0, 1.0)
    assert upper.collisions[0].geometry == Capsule(0.02, 0.2)
    assert robot.link("world").collisions == ()
    assert isinstance(robot.link("base").collisions[0].geometry, Box)
    tip = [type(shape.geometry) for shape in robot.link("tip").collisions]
    assert tip == [Cylinder, Sphere]
    tool = robot.frame("tool")
    assert (tool.link, tool.T_link_frame) == ("tip", robot.frame("grip_site").T_link_frame)


def test_visual_and_collision_geoms_are_told_apart(tmp_path):
    robot = read(
        tmp_path,
        """
        <asset><material name="blue" rgba="0 0 1 1"/></asset>
        <worldbody><body name="a">
          <geom size="0.1" contype="0" conaffinity="0" material="blue"/>
          <geom size="0.2"/><geom size="0.3" group="3"/>
          <geom size="0.4" group="4" contype="0" conaffinity="0"/>
          <body name="b"><geom size="0.5" rgba="0 1 0 0.5"/><geom size="0.6" group="3"/></body>
        </body></worldbody>""",
    )

    def radii(shapes):
        return [shape.geometry.radius for shape in shapes]

    a, b = robot.links
    assert (radii(a.visuals), radii(a.collisions)) == ([0.1], [0.2, 0.3])
    assert (radii(b.visuals), radii(b.collisions)) == ([0.5], [0.5, 0.6])
    assert a.visuals[0].rgba == (0, 0, 1, 1)
    assert b.visuals[0].rgba == (0, 1, 0, 0.5)
    assert b.collisions[0].rgba is None


def test_joint_equalities_become_mimic_joints(tmp_path):
    path = write(
        tmp_path,
        """
        <compiler angle="radian"/>
        <worldbody><body name="base"><geom size="0.1"/>
          <body name="left"><joint name="a" ref="0.2" range="-1 1"/><geom size="0.1"/></body>
          <body name="right"><joint name="b" ref="0.1" range="-3 3"/><geom size="0.1"/></body>
        </body></worldbody>
        <equality><joint joint1="b" joint2="a" polycoef="0.5 -2 0 0 0"/></equality>
        <tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed>
        </tendon>
        <actuator><position tendon="both" kp="1"/>
          <motor joint="a" gear="3" ctrlrange="-2 2"/></actuator>
        <contact><exclude body1="right" body2="left"/></contact>
        <keyframe><key qpos="0.9 0"/><key name="home" qpos="0.5 0"/></keyframe>""",
    )
    robot = read_mjcf(path)
    _, b = robot.joints
    assert (b.mimic.joint, b.mimic.multiplier) == ("a", -2.0)
    assert b.mimic.offset == pytest.approx(0.1 + 0.5 + 2 * 0.2)
    assert robot.home == (0.5,)
    assert robot.ignore_pairs == (("left", "right"),)
    assert robot.joints[0].effort == 6.0
    follower = 0.1 + 0.5 - 2 * (0.5 - 0.2)  # from its reference, as the leader
    data = mujoco_data(path)
    data.qpos[:] = (0.5, follower)
    assert_pose_agrees(robot, robot.home, data)


def test_free_base_becomes_the_root(tmp_path):
    robot = read(
        tmp_path,
        """<worldbody><geom type="box" size="1 1 1"/><body name="trunk" pos="0 0 1"><freejoint/>
        <geom size="0.1"/><body name="leg"><joint name="hip"/><geom size="0.1"/></body></body>
        </worldbody><keyframe><key qpos="0 0 1 1 0 0 0 0.5"/></keyframe>""",
    )
    assert (robot.root.name, robot.dof, robot.home) == ("trunk", 1, (0.5,))
    assert [finding.code for finding in robot.source_findings] == ["world-shapes"]


def test_keyframe_outside_the_limits_is_left_out(tmp_path):
    robot = read(
        tmp_path,
        """<compiler angle="radian"/>
        <worldbody><body name="base"><geom size="0.1"/><body name="tip">
        <joint name="a" range="1 2"/><geom size="0.1"/></body></body></worldbody>
        <keyframe><key name="rest" qpos="3"/></keyframe>""",
    )
    assert robot.home == (1.5,)
    (finding,) = robot.source_findings
    assert (finding.code, finding.where) == ("keyframe-outside-limits", "robot.xml: key 'rest'")


def test_root_body_cuts_the_robot_out_of_a_scene(tmp_path):
    scene = """<worldbody><body name="table"><geom size="0.1"/></body>
        <body name="handle" mocap="true"/>
        <body name="arm"><geom size="0.1"/><body name="tip"><joint name="a"/><geom size="0.1"/>
        </body></body><body name="ball"><freejoint name="fly"/><geom size="0.1"/></body></worldbody>
        <equality><weld name="drag" body1="handle" body2="tip"/></equality>"""
    assert refusal(tmp_path, scene) == (
        "the world holds the bodies 'table', 'handle', 'arm', 'ball', of which 'table' has no "
        "joints; name the robot's by --root-link BODY of morphgen import"
    )
    robot = read(tmp_path, scene, root_body="arm")
    assert [link.name for link in robot.links] == ["arm", "tip"]
    assert [finding.code for finding in robot.source_findings] == ["mocap-constraint"]
    assert refusal(tmp_path, scene, root_body="amr") == (
        "no body 'amr' for root link; did you mean 'arm'? valid: arm, ball, handle, table, tip, "
        "world"
    )


def test_names_are_unique_and_sites_do_not_take_those_of_links(tmp_path):
    robot = read(
        tmp_path,
        """<worldbody><body name="a"><geom size="0.1"/><site name="a"/>
        <body name="b"><joint/><joint name="b_joint" axis="1 0 0"/><geom size="0.1"/></body>
        <body><joint/><geom size="0.1"/></body></body></worldbody>""",
    )
    assert [link.name for link in robot.links] == ["a", "b_b_joint_2", "b", "body_3"]
    assert [joint.name for joint in robot.joints] == ["b_joint_2", "b_joint", "body_3_joint"]
    assert [frame.name for frame in robot.frames] == ["a_site"]


def test_what_a_robot_has_no_place_for_is_counted(tmp_path):
    body = """<option timestep="0.001"><flag gravity="disable"/></option>
        <default><geom condim="4"/></default>
        <worldbody><light/><body name="base"><geom size="0.1" friction="1 1 1" solref="1 1"/>
        <body name="tip" gravcomp="1"><joint name="a" stiffness="3"/><geom size="0.1" friction="1"/>
        </body></body></worldbody>
        <actuator><position joint="a" kp="9" ctrlrange="-1 1"/></actuator>
        <sensor><jointpos joint="a"/><jointvel joint="a"/></sensor>"""
    findings = read(tmp_path, body).source_findings
    assert {finding.severity for finding in findings} == {"info"}
    assert [finding.repair for finding in findings] == [
        "left out: 1 <option> of <mujoco> with 1 elements inside",
        "left out: 1 <sensor> of <mujoco> with 2 elements inside",
        "left out: 1 <light> of <worldbody>",
        "left out: 1 condim=..., 2 friction=..., 1 solref=... of <geom>",
        "left out: 1 gravcomp=... of <body>",
        "left out: 1 stiffness=... of <joint>",
        "left out: 1 kp=... of <position>",
    ]


WORLD = '<worldbody><body name="a">{}</body></worldbody>'
INERTIAL = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
COUPLING = """<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed>
</tendon>"""
BODY = '<body name="{}"><geom size="0.1"/>{}</body>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<worldbody/>", "it has no bodies; expected at least one in <worldbody>"),
        (
            WORLD.format('<body><joint name="j" type="ball"/><geom size="1"/></body>'),
            "joint 'j': type ball; expected hinge or slide, such as three hinges at one place",
        ),
        (
            TWO_JOINTS + COUPLING,
            "tendon 't' couples the joints 'a', 'b', which has no counterpart; couple them by "
            "<equality><joint>, or remove the tendon and what uses it",
        ),
        (
            '<worldbody><site name="s"/><body name="a"><geom size="0.1"/><site name="e"/></body>'
            '</worldbody><tendon><spatial name="rope"><site site="s"/><site site="e"/></spatial>'
            "</tendon>",
            "tendon 'rope' is spatial, which has no counterpart; remove it and what uses it",
        ),
        (
            f'{TWO_JOINTS}<equality><connect name="loop" body1="left" body2="right" '
            'anchor="0 0 0"/></equality>',
            "equality 'loop': a connect constraint has no counterpart; expected joint constraints "
            "of degree 1",
        ),
        (
            f'{TWO_JOINTS}<equality><joint joint1="a" joint2="b" polycoef="0 1 0 2 0"/></equality>',
            "equality 'a - b': its polycoef has degree 3; expected degree 1, as of a mimic joint",
        ),
        (
            f'{TWO_JOINTS}<equality><joint joint1="a" joint2="b"/>'
            '<joint name="e" joint1="a" joint2="b"/></equality>',
            "equality 'e': another one couples joint 'a', too; expected one",
        ),
        (
            f'{TWO_JOINTS}<equality><joint name="e" joint1="a"/></equality>',
            "equality 'e' holds a joint in place; expected joint2, or no joint",
        ),
        (
            f'{TWO_JOINTS}{COUPLING}<equality><tendon name="e" tendon1="t"/></equality>',
            "equality 'e': a tendon constraint has no counterpart; expected joint constraints of "
            "degree 1",
        ),
        (
            WORLD.format('<geom name="table" type="plane" size="1 2 3"/><geom size="1"/>'),
            "geom 'table': type plane; expected box, sphere, cylinder, capsule, ellipsoid or mesh",
        ),
        (
            '<extension><plugin plugin="mujoco.pid"/></extension><worldbody/>',
            "<extension> is refused: plugins are code",
        ),
        (
            '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1e10"/></asset>'
            + WORLD.format(f'{INERTIAL}<geom type="mesh" mesh="m"/>'),
            "mesh 'm': a vertex is beyond 1e+09 m",
        ),
        (
            '<worldbody><replicate count="2"><body><geom size="1"/></body></replicate></worldbody>',
            "<replicate> is refused: write its copies",
        ),
        (
            f"{TWO_JOINTS}<keyframe>{'<key/>' * 1001}</keyframe>",
            "it has 1001 keyframes; at most 1000 are read",
        ),
        (
            f"<worldbody>{'<body/>' * 1001}</worldbody>",
            "has 1001 <body> elements; at most 1000 are read",
        ),
        (
            '<worldbody><body name="a" pos="0 0 nan"><geom size="0.1"/></body></worldbody>',
            "body_pos of the compiled model has the value nan; expected numbers up to 1e+20",
        ),
        (
            WORLD.format('<geom size="0.1" colour="red"/>'),
            "not MJCF that MuJoCo reads: XML Error: Schema violation: unrecognized attribute: "
            "'colour' Element 'geom'",
        ),
    ],
)
def test_content_without_a_counterpart_is_refused(content, message, tmp_path):
    assert refusal(tmp_path, content) == message


def test_couplings_with_the_rest_of_a_scene_are_refused(tmp_path):
    coupling = '<equality><joint joint1="a" joint2="b"/></equality>'
    scene = TWO_JOINTS.replace(
        '<body name="left">', '<body name="arm"><geom size="1"/><body name="left">'
    ).replace('<body name="right">', '</body><body name="right">')
    assert refusal(tmp_path, scene + coupling, root_body="arm") == (
        "equality 'a - b': joint 'b' is not of the robot"
    )


def test_includes_stay_in_the_folder(tmp_path):
    path = tmp_path / "arm" / "robot.xml"
    write(tmp_path, "<worldbody/>", "secret.xml")
    write(tmp_path / "arm", f"<worldbody>{BODY.format('tip', '')}</worldbody>", "a.xml")
    write(tmp_path / "arm", '<include file="a.xml"/>')
    assert read_mjcf(path).root.name == "tip"
    (tmp_path / "arm" / "link.xml").symlink_to(tmp_path / "secret.xml")
    elsewhere = f"is not in {tmp_path / 'arm'}, the folder"
    reasons = {"/etc/passwd": "leaves", "link.xml": elsewhere, "../secret.xml": elsewhere}
    for file, reason in reasons.items():
        write(tmp_path / "arm", f'<include file="{file}"/>')
        with pytest.raises(FormatError, match=re.escape(reason)):
            read_mjcf(path)
    with pytest.raises(FormatError, match="no bodies"):
        read_mjcf(path, default_finder(root=tmp_path))


def test_entities_are_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text('<!DOCTYPE x [<!ENTITY e "lol">]><mujoco model="&e;"/>', encoding="utf-8")
    with pytest.raises(FormatError, match="has a DOCTYPE; a robot description needs none"):
        read_mjcf(path)


def test_user_data_is_left_out(tmp_path):
    body = f'<body name="a" user="{"1 " * 100_000}">{"<body/>" * 900}</body>'
    assert len(read(tmp_path, f"<worldbody>{body}</worldbody>").links) == 901


def test_includes_end(tmp_path):
    write(tmp_path, '<include file="robot.xml"/>')
    with pytest.raises(FormatError, match=r"robot\.xml: is included twice"):
        read_mjcf(tmp_path / "robot.xml")
    for k in range(50):
        write(tmp_path, f'<include file="f{k + 1}.xml"/>', f"f{k}.xml")
    with pytest.raises(FormatError, match="includes are nested deeper than 40 levels"):
        read_mjcf(tmp_path / "f0.xml")


def test_nested_includes_are_relative_to_the_main_file_or_their_own(tmp_path):
    write(tmp_path, '<include file="sub/a.xml"/>')
    write(tmp_path, '<include file="b.xml"/>', "sub/a.xml")
    write(tmp_path, f"<worldbody>{BODY.format('deep', '')}</worldbody>", "sub/b.xml")
    assert read_mjcf(tmp_path / "robot.xml").root.name == "deep"


def test_all_missing_meshes_are_listed(tmp_path):
    with pytest.raises(UnsoundError) as error:
        read(
            tmp_path,
            '<compiler meshdir="meshes"/><asset><mesh file="a.stl"/><mesh name="b" '
            'file="../../b.stl"/></asset><worldbody/>',
        )
    first, second = error.value.findings
    assert first.where == f"{tmp_path / 'robot.xml'}: mesh 'a'"
    assert "'meshes/a.stl' does not exist" in first.why
    assert f"leaves {tmp_path.parent}" in second.why or "does not exist" in second.why


def test_files_of_textures_and_height_fields_are_not_read(tmp_path):
    robot = read(
        tmp_path,
        """<asset><texture name="t" type="2d" file="missing.png"/><material name="m" texture="t"/>
        <hfield name="h" file="missing.png" size="1 1 1 1"/></asset>
        <worldbody><geom type="hfield" hfield="h"/>
        <body name="a"><geom size="1" material="m"/></body></worldbody>""",
    )
    assert robot.root.visuals[0].rgba == (1, 1, 1, 1)


SITE = TWO_JOINTS.replace(
    '<joint name="b"', '<site name="attachment_site" pos="0 0 1"/><joint name="b"'
)


def test_root_element_decides_between_urdf_and_mjcf(tmp_path):
    urdf = tmp_path / "arm.xml"
    urdf.write_text("<!-- an arm -->" + urdf_text(arm(), str), encoding="utf-8")
    assert not is_mjcf(urdf)
    assert read_description(urdf).name == "arm"
    mjcf = write(tmp_path, TWO_JOINTS, "two.urdf")
    assert is_mjcf(mjcf)
    assert read_description(mjcf).dof == 2


@pytest.mark.parametrize("text", ["", "<", "no XML", "<sdf/>", "<!-- only a comment -->"])
def test_other_files_are_refused_by_the_urdf_reader(text, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(text, encoding="utf-8")
    assert not is_mjcf(path)
    with pytest.raises(FormatError, match=r"robot\.xml"):
        read_robot(path)


def test_imports_accept_mjcf(tmp_path):
    path = write(tmp_path, SITE)
    assert import_robot(path).frame("tool").link == "right"
    right = import_robot(path, root_link="right", tool="right", name="half")
    assert (right.name, right.dof, right.frame("tool").link) == ("half", 0, "right")
    assert right.provenance["source"] == "robot.xml"


def test_mjcf_of_a_bundle_stands_for_the_bundle(tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm", picture=False)
    robot, bundle = read_robot(folder / "robot.xml"), read_bundle(folder)
    assert (robot.name, robot.home, robot.links) == (bundle.name, bundle.home, bundle.links)


def test_part_from_an_mjcf(tmp_path):
    write(tmp_path / "library", SITE)
    write_part(
        tmp_path / "library",
        file="robot.xml",
        root="base",
        tool={"link": "right"},
        **dict.fromkeys(("parameters", "mount", "home", "accepted")),
    )
    robot = morphgen.compose("base=gantry ee=pincer", library=[tmp_path / "library"])
    assert {"ee_left", "ee_right"} <= set(robot.link_index)
