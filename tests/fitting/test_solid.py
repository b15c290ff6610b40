"""Solids of defective meshes: open, nested, inverted, duplicated, flat, hollow and very large."""

import math

import igl
import numpy as np
import pytest
import trimesh

from morphgen.errors import FitError, MeshError
from morphgen.fitting import solid as module
from morphgen.fitting.solid import Solid, _Columns, solid_of, solid_of_mesh
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, volume

SIZE = (0.2, 0.3, 0.4)
BOX_VOLUME = 0.024
HALF = 0.25
"""Half the edge of the cube in which volumes are counted."""
TILTED = Pose.from_xyz_rpy((0.05, -0.02, 0.03), (0.3, 0.5, -0.4))


AXIS = (np.arange(50) + 0.5) / 100 - HALF
GRID = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 3)
"""Middles of cells of a centimetre; boxes of whole cells are counted exactly."""


def counted(solid):
    """Return the volume by counting grid points."""
    return solid.contains(GRID).mean() * (2 * HALF) ** 3


def box(size=SIZE, at=(0.0, 0.0, 0.0), inverted=False):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    if inverted:
        mesh.invert()
    return mesh


def without(mesh, dropped):
    """Return the mesh without the masked triangles."""
    kept = mesh.copy()
    kept.update_faces(~dropped)
    kept.remove_unreferenced_vertices()
    return kept


def soup(corners):
    """Triangles, shape (n, 3, 3), that share no vertices."""
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)


def angle():
    """An L-shaped prism of 0.014 cubic metres, so that its hull, of 0.023, is another solid."""
    outline = np.array([(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)]) / 10 - 0.2
    vertices = np.concatenate([np.insert(outline, 2, z, axis=1) for z in (-0.1, 0.1)])
    cap = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = [(i, j, j + 6, i + 6) for i, j in zip(range(6), (1, 2, 3, 4, 5, 0), strict=True)]
    walls = [three for a, b, c, d in sides for three in ((a, b, c), (a, c, d))]
    return trimesh.Trimesh(vertices, [*cap[:, ::-1], *(cap + 6), *walls])


def test_a_closed_box_is_its_own_solid():
    solid = solid_of_mesh(box())
    assert (solid.method, solid.decimated_from) == ("watertight", None)
    assert counted(solid) == pytest.approx(BOX_VOLUME, rel=1e-9)
    assert solid.size == pytest.approx(math.hypot(*SIZE))
    assert solid.hull.volume == pytest.approx(BOX_VOLUME)
    assert not solid.contains(np.array([(0.1001, 0, 0), (5, 5, 5)])).any()


def test_crossings_of_closed_triangles_give_their_winding_numbers():
    """The peer sums the solid angles of triangles; the parts overlap, nest and touch."""
    tilted = box((0.3, 0.1, 0.2)).apply_transform(TILTED.matrix)
    parts = [angle(), tilted, trimesh.creation.icosphere(3, 0.12), box((0.1,) * 3)]
    mesh = trimesh.util.concatenate([*parts, box((0.1,) * 3, (0.1, 0, 0), inverted=True)])
    solid = Solid(mesh, "watertight")
    points = np.random.default_rng(0).uniform(*mesh.bounds, (20_000, 3))
    expected = igl.fast_winding_number(mesh.vertices, mesh.faces, points)
    counted = _Columns(mesh).winding(points)
    assert {-1, 0, 1, 2, 3} <= {*counted}
    np.testing.assert_array_equal(counted, expected.round())
    np.testing.assert_array_equal(solid.contains(points), expected > 0.5)


@pytest.mark.parametrize("flipped", [1, 4, 7, 10, 12])
def test_inverted_triangles_are_repaired(flipped):
    mesh = box()
    faces = mesh.faces.copy()
    faces[:flipped] = faces[:flipped, ::-1]
    solid = solid_of_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert solid.method == "repaired"
    assert counted(solid) == pytest.approx(BOX_VOLUME, rel=1e-9)


@pytest.mark.parametrize("outer", [False, True])
@pytest.mark.parametrize("inner", [False, True])
def test_a_cavity_is_filled_for_any_triangle_orientation(inner, outer):
    nested = [box(inverted=outer), box((0.1, 0.1, 0.1), inverted=inner)]
    solid = solid_of_mesh(trimesh.util.concatenate(nested))
    assert solid.method == ("repaired" if inner or outer else "watertight")
    assert counted(solid) == pytest.approx(BOX_VOLUME, rel=1e-9)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
def test_a_duplicated_mesh_is_counted_once(merged, inverted):
    again = angle()
    if inverted:
        again.invert()
    twice = trimesh.util.concatenate([angle(), again])
    if merged:
        twice.merge_vertices()
    assert counted(solid_of_mesh(twice)) == pytest.approx(0.014, rel=1e-9)


def test_boxes_that_share_the_vertices_of_a_face_are_one_solid():
    stacked = trimesh.util.concatenate([box((0.2,) * 3, (0, 0, z)) for z in (-0.1, 0.1)])
    stacked.merge_vertices()
    solid = solid_of_mesh(stacked)
    assert counted(solid) == pytest.approx(0.016, rel=1e-9)
    assert solid.contains(np.array([(0, 0, -0.01), (0, 0, 0.01)])).all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_box_with_a_missing_face_is_closed(axis, side):
    whole = box()
    mesh = without(whole, whole.face_normals[:, axis] * side > 0.5)
    assert len(mesh.faces) == 10
    solid = solid_of_mesh(mesh)
    assert solid.method in ("repaired", "winding")
    assert solid.contains(np.zeros((1, 3))).all()
    assert counted(solid) == pytest.approx(BOX_VOLUME, rel=0.1)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_unmerged_vertices_are_welded_and_oriented_outwards(size):
    rng = np.random.default_rng(0)
    corners = size * box().triangles
    corners[::3] = corners[::3, ::-1]
    mesh = soup(corners + rng.uniform(-1e-7, 1e-7, corners.shape) * size)
    solid = solid_of_mesh(mesh)
    assert solid.method == "repaired"
    assert solid.mesh.is_watertight
    assert solid.mesh.volume == pytest.approx(BOX_VOLUME * size**3, rel=1e-5)


@pytest.mark.parametrize("gap", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("whole", [box(), angle()], ids=["box", "angle"])
def test_faces_with_gaps_enclose_a_solid(whole, gap):
    mesh = soup(whole.triangles + gap * whole.face_normals[:, None])
    mesh.merge_vertices()
    solid = solid_of_mesh(mesh)
    assert solid.method in ("repaired", "winding")
    assert counted(solid) == pytest.approx(whole.volume, rel=0.05)


@pytest.mark.parametrize("inverted", [False, True])
def test_a_sphere_with_many_holes_is_solid_by_winding_number(inverted):
    ball = trimesh.creation.icosphere(3, 0.2)
    if inverted:
        ball.invert()
    solid = solid_of_mesh(without(ball, np.random.default_rng(0).random(len(ball.faces)) < 0.2))
    assert solid.method == "winding"
    assert not solid.mesh.is_watertight
    assert solid.contains(np.zeros((1, 3))).all()
    assert counted(solid) == pytest.approx(volume(Sphere(0.2)), rel=0.05)


def test_a_sheet_that_encloses_almost_nothing_becomes_its_convex_hull():
    axis = np.linspace(-0.2, 0.2, 20)
    x, y = (each.ravel() for each in np.meshgrid(axis, axis, indexing="ij"))
    corner = np.arange(400).reshape(20, 20)
    a, b = corner[:-1, :-1].ravel(), corner[1:, :-1].ravel()
    c, d = corner[1:, 1:].ravel(), corner[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    saddle = trimesh.Trimesh(np.stack([x, y, 5 * x * y], axis=1), faces)
    solid = solid_of_mesh(saddle)
    assert solid.method == "hull"
    assert solid.mesh.is_watertight
    assert counted(solid) == pytest.approx(saddle.convex_hull.volume, rel=0.02)


def write(mesh, path):
    mesh.export(path)
    return Shape(Mesh(path))


@pytest.mark.parametrize(
    "pose", [Pose(), Pose((3.0, -2.0, 1.0)), TILTED], ids=["here", "off", "tilted"]
)
def test_flat_meshes_are_errors(tmp_path, pose):
    square = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], [(0, 1, 2), (1, 3, 2)])
    shape = Shape(write(square, tmp_path / "square.stl").geometry, pose)
    with pytest.raises(FitError, match="flat"):
        solid_of([shape])
    with pytest.raises(FitError, match="flat"):
        solid_of([shape, shape])
    assert counted(solid_of([shape, Shape(Box(SIZE))])) == pytest.approx(BOX_VOLUME, rel=1e-9)


def test_an_unreadable_mesh_is_an_error(tmp_path):
    with pytest.raises(MeshError, match=r"lost\.stl"):
        solid_of([Shape(Box(SIZE)), Shape(Mesh(tmp_path / "lost.stl"))])


@pytest.mark.parametrize("pose", [Pose(), TILTED], ids=["here", "tilted"])
@pytest.mark.parametrize(
    "geometry",
    [Box((0.14, 0.2, 0.24)), Cylinder(0.12, 0.3), Sphere(0.2), Capsule(0.1, 0.2)],
    ids=lambda geometry: type(geometry).__name__,
)
def test_a_primitive_is_its_own_solid(geometry, pose):
    solid = solid_of([Shape(geometry, pose)])
    assert solid.method == "watertight"
    assert counted(solid) == pytest.approx(volume(geometry), rel=0.02)
    inside = GRID[solid.contains(GRID)]
    np.testing.assert_allclose(inside.mean(axis=0), pose.position, atol=1e-3)


def test_shapes_of_all_kinds_form_one_solid_with_the_least_reliable_method(tmp_path):
    crate = box()
    ball = trimesh.creation.icosphere(3, 0.1)
    holes = np.random.default_rng(0).random(len(ball.faces)) < 0.2
    closed = (
        Shape(Box((0.1, 0.1, 0.1)), Pose((-0.2, 0, 0))),
        Shape(Cylinder(0.05, 0.2), Pose.from_xyz_rpy((0, 0.2, 0), (0, math.pi / 2, 0))),
        Shape(Sphere(0.05), Pose((0, -0.2, 0))),
        Shape(Capsule(0.04, 0.1), Pose((0, 0, 0.15))),
    )
    opened = write(without(crate, crate.face_normals[:, 2] > 0.5), tmp_path / "box.stl")
    ragged = write(without(ball, holes), tmp_path / "ball.stl")
    assert solid_of(closed).method == "watertight"
    total = sum(volume(shape.geometry) for shape in closed)
    assert counted(solid_of(closed)) == pytest.approx(total, rel=0.03)
    ends = np.array([(-0.2, 0, 0), (0.09, 0.2, 0), (-0.09, 0.2, 0), (0, -0.2, 0), (0, 0, 0.23)])
    assert solid_of(closed).contains(ends).all()
    assert not solid_of(closed).contains(ends + np.array((0, 0, 0.1))).any()
    assert solid_of([*closed, opened]).method == "repaired"
    assert solid_of([opened, ragged, *closed]).method == "winding"


def test_a_very_large_mesh_is_decimated_and_records_its_face_count(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_FACES", 10_000)
    monkeypatch.setattr(module, "DECIMATED_FACES", 5_000)
    ball = trimesh.creation.icosphere(5, 0.2)
    solid = solid_of_mesh(ball)
    assert solid.method == "watertight"
    assert solid.decimated_from == len(ball.faces)
    assert len(solid.mesh.faces) <= 1.01 * 5_000
    assert solid.mesh.volume == pytest.approx(ball.volume, rel=0.01)
    assert counted(solid) == pytest.approx(volume(Sphere(0.2)), rel=0.01)
    several = solid_of([write(ball, tmp_path / "ball.stl"), Shape(Box(SIZE))])
    assert several.decimated_from == len(ball.faces) + 12


@pytest.mark.parametrize("inverted", [False, True])
def test_the_surface_excludes_enclosed_faces(inverted):
    nested = [box(), box((0.15, 0.25, 0.35), inverted=inverted)]
    solid = solid_of_mesh(trimesh.util.concatenate(nested))
    points = solid.surface(4000, np.random.default_rng(0))
    outer, inner = (mesh.area for mesh in nested)
    assert len(points) == pytest.approx(4000 * outer / (outer + inner), rel=0.1)
    beyond = np.abs(points) - np.array(SIZE) / 2
    np.testing.assert_allclose(beyond.max(axis=1), 0, atol=1e-9)


def test_the_given_meshes_are_not_modified():
    for mesh in (box(inverted=True), without(box(), np.arange(12) < 2)):
        before = mesh.vertices.copy(), mesh.faces.copy()
        solid_of_mesh(mesh)
        np.testing.assert_array_equal(mesh.vertices, before[0])
        np.testing.assert_array_equal(mesh.faces, before[1])


def tube(wall=0.01, radius=0.1, length=0.6, closed=False):
    mesh = trimesh.creation.annulus(radius - wall, radius, length)
    if not closed:
        return mesh
    lid = trimesh.creation.cylinder(radius, wall)
    lid.apply_translation((0, 0, -length / 2))
    return trimesh.util.concatenate([mesh, lid])


def solid_from(mesh, tmp_path):
    return solid_of([write(mesh, tmp_path / "mesh.stl")])


@pytest.mark.parametrize("closed", [False, True])
def test_a_tube_is_filled_except_near_its_opening(tmp_path, closed):
    solid = solid_from(tube(closed=closed), tmp_path)
    assert solid.method == "filled"
    deep, mouth, beside = (0.02, 0.03, -0.1), (0.0, 0.0, 0.299), (0.11, 0.0, 0.0)
    assert solid.contains(np.array([deep, mouth, beside])).tolist() == [True, False, False]


PRONGS = [box((0.02, 0.1, 0.3), (x, 0, 0)) for x in (0.0, 0.15)]


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.annulus(0.4, 0.5, 0.1),
        trimesh.util.concatenate([*PRONGS, box((0.17, 0.1, 0.02), (0.075, 0, -0.16))]),
        box((0.3, 0.2, 0.1)),
    ],
    ids=["ring", "fork", "box"],
)
def test_rings_forks_and_boxes_are_not_filled(tmp_path, mesh):
    assert solid_from(mesh, tmp_path).method != "filled"


def test_the_surface_of_a_filled_tube_is_its_outer_surface(tmp_path):
    solid = solid_from(tube(), tmp_path)
    points = solid.surface(2000, np.random.default_rng(0))
    middle = points[np.abs(points[:, 2]) < 0.15]
    assert len(middle) > 200
    assert np.linalg.norm(middle[:, :2], axis=1).min() > 0.095
