"""Shapes of an MJCF without a mesh file have the shape and the mass that MuJoCo gives them."""

import mujoco
import numpy as np
import pytest
import trimesh

from helpers.mjcf import inertia_in_mujoco, read, write
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.mjcf.read import read_mjcf
from morphgen.model.geometry import Mesh, Sphere
from morphgen.model.mesh import convex_hull, load_mesh

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
    (tmp_path / "meshes").mkdir()
    box.export(tmp_path / "meshes" / "box.stl")
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
