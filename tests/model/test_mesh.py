"""Loading meshes: formats, units, colours, caching, convex hulls and errors."""

import importlib.metadata
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.collada import DAE
from morphgen.checks import check
from morphgen.errors import MeshError
from morphgen.model import mesh_files
from morphgen.model.geometry import Mesh, Shape
from morphgen.model.mesh import convex_hull, load_mesh, mesh_parts
from morphgen.model.robot import Link, Robot

DATA = Path(str(importlib.metadata.distribution("rtb-data").locate_file("rtbdata/xacro")))
RED, BLUE = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)


def dae(path, unit="1", up="Z_UP", shift="0 0 0"):
    path.write_text(DAE.format(unit=unit, up=up, shift=shift))
    return path


def counts(path):
    """Return the colours of a file and their numbers of triangles."""
    return [(part.rgba, len(part.faces)) for part in mesh_parts(path)]


@pytest.fixture
def box(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.2, 0.4, 0.6)).export(path)
    return path


@pytest.mark.parametrize("suffix", ["stl", "ascii.stl", "STL", "obj", "ply", "glb", "dae"])
def test_a_box_is_equal_in_every_format(suffix, tmp_path):
    path = tmp_path / f"box.{suffix}"
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    path.write_bytes(_exported(box, suffix))
    mesh = load_mesh(Mesh(path))
    np.testing.assert_allclose(mesh.extents, (0.2, 0.4, 0.6), atol=1e-7)
    assert len(mesh.faces) == 12
    assert len(mesh.vertices) == 8
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.048)


def _exported(mesh, suffix):
    kind = "stl_ascii" if suffix == "ascii.stl" else suffix.lower()
    data = mesh.export(file_type=kind)
    return data.encode() if isinstance(data, str) else bytes(data)


def test_the_scale_is_applied_and_a_mirror_keeps_the_volume_positive(box):
    mesh = load_mesh(Mesh(box, (2.0, 1.0, -1.0)))
    np.testing.assert_allclose(mesh.extents, (0.4, 0.4, 0.6), atol=1e-7)
    assert mesh.volume == pytest.approx(0.096)


def test_a_mesh_is_read_once_until_its_file_changes(box):
    first = load_mesh(Mesh(box))
    assert load_mesh(Mesh(box)) is first
    trimesh.creation.box((1, 1, 1)).export(box)
    os.utime(box, ns=(1, 1))
    np.testing.assert_allclose(load_mesh(Mesh(box)).extents, (1, 1, 1))


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_a_broken_mesh_is_read_once(suffix, tmp_path, monkeypatch):
    path, reads = tmp_path / f"broken.{suffix}", []
    path.write_text("v 0 0 nan\nf 1 1 1\n")
    read = mesh_files.read_mesh_file
    monkeypatch.setattr(mesh_files, "read_mesh_file", lambda file: reads.append(file) or read(file))
    shape = Shape(Mesh(path))
    robot = Robot("r", (Link("a", visuals=(shape,), collisions=(shape,)),))
    assert "mesh-unreadable" in {finding.code for finding in check(robot)}
    assert len(reads) == 1


def test_relative_paths_follow_the_working_directory(tmp_path, monkeypatch):
    for name, size in (("a", 1.0), ("b", 2.0)):
        (tmp_path / name).mkdir()
        trimesh.creation.box((size,) * 3).export(tmp_path / name / "m.stl")
        os.utime(tmp_path / name / "m.stl", ns=(1, 1))
        monkeypatch.chdir(tmp_path / name)
        assert load_mesh(Mesh(Path("m.stl"))).extents[0] == pytest.approx(size)


@pytest.mark.parametrize(
    ("asset", "bounds"),
    [
        ({"unit": "0.001"}, [[0, 0, 0], [0.001, 0.002, 0.003]]),
        ({"unit": "0.1", "shift": "10 0 0"}, [[1, 0, 0], [1.1, 0.2, 0.3]]),
        *(({"up": up}, [[0, 0, 0], [1, 2, 3]]) for up in ("X_UP", "Y_UP", "Z_UP")),
    ],
)
def test_units_of_collada_are_applied_once_also_to_its_scene_and_its_up_axis_is_not(
    asset, bounds, tmp_path
):
    mesh = load_mesh(Mesh(dae(tmp_path / "m.dae", **asset)))
    np.testing.assert_allclose(mesh.bounds, bounds, atol=1e-12)


def test_a_file_has_one_part_per_colour(tmp_path):
    path = dae(tmp_path / "m.dae")
    assert counts(path) == [(RED, 1), (BLUE, 3)]
    red, blue, whole = (load_mesh(Mesh(path, part=part)) for part in (0, 1, None))
    assert (len(red.faces), len(blue.faces), len(whole.faces)) == (1, 3, 4)
    assert whole.is_watertight
    assert red.area + blue.area == pytest.approx(whole.area)


def test_obj_materials_are_parts_and_a_file_without_colour_has_none(tmp_path, box):
    (tmp_path / "m.mtl").write_text("newmtl r\nKd 1 0 0\nnewmtl b\nKd 0 0 1\nnewmtl r2\nKd 1 0 0\n")
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
        "usemtl r\nf 1 3 2\nusemtl b\nf 1 2 4\nf 2 3 4\nusemtl r2\nf 1 4 3\n"
    )
    assert counts(tmp_path / "m.obj") == [(RED, 2), (BLUE, 2)]
    assert counts(box) == [(None, 12)]


def test_an_unknown_part_is_an_error(box):
    with pytest.raises(MeshError, match="no part 1; valid: 0 to 0"):
        load_mesh(Mesh(box, part=1))


def test_triangles_without_area_are_dropped(tmp_path):
    path = tmp_path / "m.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    assert load_mesh(Mesh(path)).faces.shape == (1, 3)
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    for read in (lambda: load_mesh(Mesh(flat)), lambda: mesh_parts(flat)):
        with pytest.raises(MeshError, match=rf"{flat}: none of its 1 triangles has an area"):
            read()


@pytest.mark.parametrize("scale", [(0.0, 1.0, 1.0), (np.nan, 1.0, 1.0), (np.inf, 1.0, 1.0)])
def test_a_degenerate_scale_is_an_error(scale, box):
    with pytest.raises(MeshError, match="scale"):
        load_mesh(Mesh(box, scale))


def test_a_hull_encloses_its_mesh_and_is_computed_once(tmp_path):
    path = tmp_path / "ring.stl"
    trimesh.creation.annulus(0.1, 0.2, 0.3).export(path)
    shape = convex_hull(Mesh(path))
    assert convex_hull(Mesh(path)) is shape
    assert shape.is_convex
    assert shape.is_watertight
    np.testing.assert_allclose(shape.bounds, load_mesh(Mesh(path)).bounds)
    assert shape.volume > load_mesh(Mesh(path)).volume


def test_a_flat_mesh_has_no_hull(tmp_path):
    path = tmp_path / "flat.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    with pytest.raises(MeshError, match="flat"):
        convex_hull(Mesh(path))


@pytest.mark.parametrize("part", ["arm_mico", "hand_2finger", "wrist_spherical_2"])
def test_y_up_visuals_of_the_kinova_match_its_stls(part):
    path = DATA / "kinova_description" / "meshes" / f"{part}.dae"
    assert "Y_UP" in path.read_text()
    visual, collision = load_mesh(Mesh(path)), load_mesh(Mesh(path.with_suffix(".STL")))
    np.testing.assert_allclose(visual.bounds, collision.bounds, atol=1e-3)


def test_the_kr210_visual_in_inches_has_the_size_of_its_collision():
    meshes = DATA / "kuka_description" / "kuka_kr210" / "meshes" / "kr210l150"
    visual = load_mesh(Mesh(meshes / "visual" / "link_2.dae"))
    collision = load_mesh(Mesh(meshes / "collision" / "link_2.stl"))
    np.testing.assert_allclose(sorted(visual.extents), sorted(collision.extents), atol=1e-3)


def test_a_collada_geometry_whose_material_is_broken_is_read_without_colours(tmp_path):
    path = dae(tmp_path / "m.dae")
    path.write_text(path.read_text().replace('-fx"/>', '-missing"/>'))
    assert counts(path) == [(None, 4)]
