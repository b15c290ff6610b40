"""Poses of primitives that look alike, and congruence of meshes under motions and reflections."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from morphgen.fitting.canonical import canonical
from morphgen.fitting.quality import signed_distance
from morphgen.fitting.robot_fit import congruence, moved, representatives
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, dimensions
from morphgen.model.mesh import load_mesh

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
KINDS = [Box((0.3, 0.2, 0.4)), Cylinder(0.15, 0.3), Sphere(0.2), Capsule(0.1, 0.25)]


def links(robot: str) -> dict[str, trimesh.Trimesh]:
    body = load_part(default_library(()).manifest(robot)).fragment
    return {
        link.name: load_mesh(link.collisions[0].geometry)
        for link in body.links
        if link.collisions and isinstance(link.collisions[0].geometry, Mesh)
    }


@pytest.fixture(scope="module")
def base() -> trimesh.Trimesh:
    return links("ur5")["base_link"]


def motion(seed: int, mirrored: bool = False) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-1, 1, 3)
    return T @ MIRROR if mirrored else T


def shuffled(mesh: trimesh.Trimesh, T: np.ndarray, seed: int = 0) -> trimesh.Trimesh:
    """Return the moved mesh with shuffled vertices and faces, rounded as in a file."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    vertices = trimesh.transform_points(mesh.vertices, T)[order].astype(np.float32)
    faces = rng.permutation(np.argsort(order)[mesh.faces])
    return trimesh.Trimesh(vertices.astype(float), faces, process=False)


def farthest(a: trimesh.Trimesh, b: trimesh.Trimesh, T: np.ndarray) -> float:
    return float(b.kdtree.query(trimesh.transform_points(a.vertices, T))[0].max())


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_motions_and_reflections_of_a_link_are_recovered(base, seed, mirrored):
    T = motion(seed, mirrored)
    np.testing.assert_allclose(congruence(base, shuffled(base, T)), T, atol=1e-6)


def test_equal_meshes_give_the_identity_and_shifted_meshes_a_translation(base):
    assert np.array_equal(congruence(base, base.copy()), np.eye(4))
    shift = trimesh.transformations.translation_matrix([0.1, 0.2, 0.3])
    transform = congruence(base, shuffled(base, shift))
    assert np.array_equal(transform[:3, :3], np.eye(3))
    np.testing.assert_allclose(transform, shift, atol=1e-7)


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.cylinder(0.1, 0.3, sections=48),
        trimesh.creation.box((0.1, 0.2, 0.3)),
        trimesh.creation.box((0.2, 0.2, 0.2)),
        trimesh.creation.icosahedron(),
        trimesh.creation.annulus(0.1, 0.2, 0.1),
    ],
    ids=["cylinder", "box", "cube", "icosahedron", "annulus"],
)
@pytest.mark.parametrize("mirrored", [False, True])
def test_symmetric_meshes_are_matched_by_a_rotation(mesh, mirrored):
    other = shuffled(mesh, motion(5, mirrored))
    transform = congruence(mesh, other)
    assert farthest(mesh, other, transform) < 1e-6
    assert np.linalg.det(transform[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("moved_by", [0.01, -0.01])
def test_one_moved_vertex_makes_meshes_incongruent(base, moved_by):
    other = base.copy()
    size = np.linalg.norm(base.extents)
    vertices = np.array(base.vertices)
    vertices[100] += moved_by * size * base.vertex_normals[100]
    other.vertices = vertices
    assert congruence(base, other) is None
    assert congruence(base, shuffled(other, motion(1))) is None
    vertices[100] += (1e-5 - moved_by) * size * base.vertex_normals[100]
    other.vertices = vertices
    assert congruence(base, other) is not None


def test_different_counts_sizes_or_proportions_are_incongruent(base):
    assert congruence(base, links("ur5")["shoulder_link"]) is None
    scaled = base.copy().apply_scale(1.001)
    assert congruence(base, scaled) is None
    sheared = base.copy()
    sheared.vertices = base.vertices * (1, 1, 1.01)
    assert congruence(base, sheared) is None
    boxes = [trimesh.creation.box((0.1, 0.2, height)) for height in (0.3, 0.2997)]
    assert congruence(*boxes) is None


def test_vertices_at_equal_distances_in_other_directions_are_incongruent(base):
    other = base.copy()
    vertices = np.array(base.vertices) - base.vertices.mean(axis=0)
    far = np.argsort(-np.linalg.norm(vertices, axis=1))[:2]
    turn = Rotation.from_rotvec([0.0, 0.0, 0.3]).as_matrix()
    vertices[far] = [turn @ vertices[far[0]], turn.T @ vertices[far[1]]]
    other.vertices = vertices
    assert congruence(base, other, tolerance=5e-3) is None


def test_the_same_vertices_with_another_surface_are_incongruent():
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0.5], [0, 3, 0], [0.7, 1.2, 4]], dtype=float)
    sides = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    one = trimesh.Trimesh(corners, [*sides, [0, 2, 1], [0, 3, 2]], process=False)
    other = trimesh.Trimesh(corners, [*sides, [0, 3, 1], [1, 3, 2]], process=False)
    assert congruence(one, other) is None
    assert congruence(one, trimesh.Trimesh(corners, one.faces[::-1], process=False)) is not None


def test_a_vertex_without_a_counterpart_makes_meshes_incongruent():
    ends = np.concatenate([np.eye(3), -np.eye(3)])
    sides = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    doubled = [[0, 0, 1], [0, 0, -1]]
    apart = np.array([[1, 1, 1], [-1, -1, -1]]) / np.sqrt(3)
    one, other = (
        trimesh.Trimesh(np.concatenate([ends, more]), sides, process=False)
        for more in (doubled, apart)
    )
    assert congruence(one, other) is None
    assert congruence(other, one) is None
    assert congruence(one, shuffled(one, motion(3))) is not None


@pytest.mark.parametrize("geometry", KINDS)
@pytest.mark.parametrize("mirrored", [False, True])
def test_moving_a_primitive_and_points_preserves_distances(geometry, mirrored):
    shape = Shape(geometry, Pose.from_xyz_rpy((0.1, 0.2, -0.3), (0.5, 0.6, 0.7)), (1, 0, 0, 1))
    points = np.random.default_rng(0).normal((0.1, 0.2, -0.3), 0.2, (500, 3))
    before = signed_distance([shape], points)
    assert (before < 0).sum() > 5
    for seed in range(5):
        T = motion(seed, mirrored)
        there = moved(shape, T)
        after = signed_distance([there], trimesh.transform_points(points, T))
        np.testing.assert_allclose(after, before, atol=1e-12)
        assert sorted(dimensions(there.geometry)) == sorted(dimensions(geometry))
        assert there.rgba == shape.rgba
        assert there.T_link_shape.quaternion[0] >= 0
        assert np.linalg.norm(there.T_link_shape.quaternion) == pytest.approx(1)
    with pytest.raises(ValueError, match="neither a rotation nor a mirroring"):
        moved(shape, np.diag([2.0, 2.0, 2.0, 1.0]))


def test_representatives_are_the_first_of_each_congruence_class(base):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    moves = [motion(1), motion(2, mirrored=True)]
    meshes = [base, box, *(shuffled(base, T) for T in moves), shuffled(box, moves[0])]
    indices = representatives(meshes)
    assert [first for first, _ in indices] == [0, 1, 0, 0, 1]
    for mesh, (first, T) in zip(meshes, indices, strict=True):
        assert farthest(meshes[first], mesh, T) < 1e-6
    np.testing.assert_allclose(indices[3][1], moves[1], atol=1e-6)
    assert representatives([]) == []


def test_the_arms_of_yumi_have_congruent_links():
    left, right = links("yumi_left"), links("yumi_right")
    indices = representatives([*left.values(), *right.values()])
    assert [first for first, _ in indices] == 2 * list(range(8))
    assert all(np.array_equal(T, np.eye(4)) for _, T in indices)


POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))


def turned(geometry, rotation, position=(0.1, -0.05, 0.02)):
    w, x, y, z = rotation.as_quat(scalar_first=True, canonical=True).tolist()
    return Shape(geometry, Pose(position, (w, x, y, z)))


@pytest.mark.parametrize("geometry", KINDS, ids=lambda g: type(g).__name__)
def test_canonicalization_preserves_the_solid_and_is_idempotent(geometry):
    for rotation in Rotation.random(20, random_state=1):
        shape = turned(geometry, rotation)
        first = canonical(shape)
        again = canonical(first)
        before, after = (signed_distance([each], POINTS) for each in (shape, first))
        assert after == pytest.approx(before, abs=1e-9)
        assert again.geometry == first.geometry
        assert again.T_link_shape.matrix == pytest.approx(first.T_link_shape.matrix, abs=1e-9)


def test_equivalent_boxes_have_one_canonical_form():
    R = Rotation.from_rotvec((0.2, 0.1, -0.3))
    shapes = []
    for quarter in Rotation.create_group("O"):
        edges = np.abs(quarter.inv().as_matrix()) @ (0.1, 0.2, 0.4)
        shapes.append(canonical(turned(Box(tuple(edges.round(9).tolist())), R * quarter)))
    for shape in shapes:
        assert shape.geometry == Box((0.1, 0.2, 0.4))
        assert shape.T_link_shape.matrix == pytest.approx(shapes[0].T_link_shape.matrix, abs=1e-9)


def test_equivalent_cylinders_have_one_canonical_form():
    R = Rotation.from_rotvec((0.4, -0.2, 0.3))
    flip = Rotation.from_rotvec((np.pi, 0, 0))
    poses = [
        canonical(turned(Cylinder(0.1, 0.3), R * about * over)).T_link_shape
        for about in Rotation.from_rotvec([(0, 0, a) for a in (0, 1, 2, 3)])
        for over in (Rotation.identity(), flip)
    ]
    for pose in poses:
        assert pose.matrix == pytest.approx(poses[0].matrix, abs=1e-8)
    assert poses[0].quaternion[3] == 0


def test_spheres_have_no_rotation_and_meshes_are_no_primitives(tmp_path):
    R = Rotation.from_rotvec((1.0, 2.0, 0.5))
    assert canonical(turned(Sphere(0.1), R)).T_link_shape == Pose((0.1, -0.05, 0.02))
    mesh = turned(Mesh(tmp_path / "m.stl"), R)
    assert canonical(mesh) is mesh
    with pytest.raises(ValueError, match="primitive"):
        moved(mesh, np.eye(4))
