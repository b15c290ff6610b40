"""Fitting robots: replacing meshes by primitives, shared and stored fits."""

import numpy as np
import pytest
import trimesh

import morphgen
from helpers.robots import chain
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.cli import main
from morphgen.errors import FitError, FormatError
from morphgen.fitting import robot_fit
from morphgen.fitting import token_shapes as token_shapes_module
from morphgen.fitting.link_fit import FitOptions, fit_shapes, quality
from morphgen.fitting.replace_collision import (
    as_primitives,
    with_fits,
    with_primitives,
)
from morphgen.fitting.robot_fit import (
    COLLISION_OPTIONS,
    TOKEN_OPTIONS,
    fit_links,
    parts_without_fits,
)
from morphgen.fitting.solid import solid_of
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.fits import SUFFIX, read_stored_fits, shapes_key
from morphgen.formats.rounding import as_written
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import IDENTITY, Box, Capsule, Mesh, Pose, Shape, Sphere, StoredFit
from morphgen.model.robot import Link

LIBRARY = default_library()


def mesh_shape(folder, mesh, name="part.stl", pose=IDENTITY, scale=(1.0, 1.0, 1.0)):
    mesh.export(folder / name)
    return Shape(Mesh(folder / name, scale), pose)


def arm(*links):
    """Return a chain of links with the given collision shapes and revolute joints."""
    named = (Link(f"l{i}", None, (), tuple(shapes)) for i, shapes in enumerate(links))
    return chain(*named, step=(0.0, 0.0, 0.5), axis=(0, 0, 1))


@pytest.fixture
def wedge():
    """Return a mesh without any symmetry."""
    points = [(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.1), (0.3, 0.05, 0.02), (0.1, 0.2, 0.1)]
    return trimesh.convex.convex_hull(np.array(points))


def test_links_of_the_same_shapes_share_a_fit(tmp_path, wedge):
    shape = mesh_shape(tmp_path, wedge, "a.stl")
    robot = arm([shape], [shape], [mesh_shape(tmp_path, wedge, "b.stl", scale=(2.0, 2.0, 2.0))])
    first, second, third = fit_links(robot, FitOptions()).links
    assert (first.same_as, second.same_as, third.same_as) == (None, "l0", None)
    assert second.fit == first.fit
    assert third.fit.quality.iou == pytest.approx(first.fit.quality.iou, abs=0.02)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes(tmp_path, wedge):
    ball = trimesh.creation.icosphere(3, 0.1)
    robot = arm([mesh_shape(tmp_path, wedge, "a.stl")], [mesh_shape(tmp_path, ball, "b.stl")])
    for options in (FitOptions(), FitOptions(max_primitives=2, iou=1.0)):
        one, two = (fit_links(robot, options, jobs=jobs).links for jobs in (1, 2))
        assert [row.fit.primitives for row in one] == [row.fit.primitives for row in two]


@pytest.mark.slow
def test_existing_primitives_are_unchanged():
    shapes = (Shape(Box((0.1, 0.2, 0.3)), Pose((0.0, 0.1, 0.0))), Shape(Sphere(0.1)))
    kept = fit_shapes(shapes, FitOptions(max_primitives=2))
    assert kept.primitives == shapes
    assert kept.solid == "primitives"
    assert kept.quality.iou > 0.99
    assert len(fit_shapes(shapes, FitOptions(max_primitives=1)).primitives) == 1


def with_bar(mesh, size, at):
    """Return a mesh with a box beside it."""
    bar = trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))
    return trimesh.util.concatenate([mesh, bar])


@pytest.mark.slow
def test_primitives_are_added_until_the_fit_is_good_enough(tmp_path):
    bent = with_bar(trimesh.creation.cylinder(0.05, 0.4), (0.3, 0.08, 0.08), (0.15, 0, 0.2))
    shape = mesh_shape(tmp_path, bent)
    fits = [fit_shapes([shape], FitOptions(max_primitives=k)) for k in (1, 2, 8)]
    scores = [fit.quality.iou for fit in fits]
    assert scores[0] < 0.75
    assert scores[1] > 0.9
    assert len(fits[2].primitives) == 2


def test_replacing_collisions_preserves_masses_and_joints():
    meshes = morphgen.compose("arm=ur5 ee=plane")
    primitive_robot = morphgen.compose("arm=ur5 ee=plane", geometry="primitive")
    written = as_written(meshes)
    assert primitive_robot.joints == written.joints
    kept = [(link.inertial, link.visuals) for link in primitive_robot.links]
    inertials = [link.inertial for link in written.links]
    assert kept == [*zip(inertials, (link.visuals for link in meshes.links), strict=True)]
    collisions = [s for link in primitive_robot.links for s in link.collisions]
    assert not any(isinstance(shape.geometry, Mesh) for shape in collisions)
    assert list(SelfCollisionChecker(primitive_robot).penetrations([primitive_robot.home])) == [{}]
    assert morphgen.check(primitive_robot) == morphgen.check(meshes)


def test_fitted_capsules_survive_a_bundle(tmp_path, wedge):
    pose = Pose.from_xyz_rpy((0.1, 0.1, 0.05), (0.3, -0.5, 2.0))
    fitted, token = Shape(Capsule(0.03, 0.123457), pose), Shape(Box((0.3, 0.2, 0.1)))
    robot = with_primitives(arm([mesh_shape(tmp_path, wedge)]), {"l0": [fitted]})
    robot = with_fits(robot, {"l0": StoredFit("l0", token, (fitted,), 0.5, 0.6)})
    read = read_bundle(write_bundle(robot, tmp_path / "made", picture=False))
    assert as_written(read).link("l0").collisions == robot.link("l0").collisions
    assert token_shapes(read) == {"l0": token}


def test_links_without_stored_fits_are_fitted_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shape = mesh_shape(tmp_path, trimesh.creation.box((0.1, 0.2, 0.3)), scale=(3.0, 3.0, 3.0))
    robot = arm([shape])
    primitive_robot = as_primitives(robot, LIBRARY.folders)
    worth = quality(solid_of(robot.links[0].collisions), primitive_robot.links[0].collisions)
    assert worth.iou > 0.95
    assert [record.args[:2] for record in caplog.records] == [(1, robot.name)]
    monkeypatch.setattr(robot_fit, "fit_links", lambda *given: pytest.fail("fitted again"))
    assert as_primitives(robot, ()).links == primitive_robot.links
    (kept,) = (tmp_path / "cache").rglob("*.json")
    kept.write_text("{}")
    with pytest.raises(FormatError, match=f"{kept}.*; delete the file"):
        as_primitives(robot, ())


def test_a_link_that_cannot_be_fitted_is_an_error(tmp_path):
    flat = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)])
    with pytest.raises(FitError, match="link l0"):
        as_primitives(arm([mesh_shape(tmp_path, flat)]), LIBRARY.folders)


@pytest.mark.slow
def test_every_real_part_has_stored_fits():
    assert [m.name for m in parts_without_fits(LIBRARY)] == []


TEMPLATE = """\
name: my_wedge
kind: ee
summary: A wedge on a link, of one's own mesh.
file: my_wedge.xacro
root: wedge
licence: CC0-1.0
tool: {link: wedge, xyz: [0, 0, 0.1]}
"""
MESH = '<geometry><mesh filename="my_wedge.stl"/></geometry>'
XACRO = f"""\
<robot name="my_wedge">
  <link name="wedge"><visual>{MESH}</visual><collision>{MESH}</collision>
    <inertial><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
</robot>
"""


@pytest.fixture
def own_parts(tmp_path, monkeypatch):
    """Return a folder with a user part, a template with a mesh, and no cache of fits."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "my_wedge.yaml").write_text(TEMPLATE)
    (folder / "my_wedge.xacro").write_text(XACRO)
    mesh = trimesh.creation.box((0.04, 0.06, 0.1))
    mesh.apply_translation((0.0, 0.0, 0.05))
    mesh.export(folder / "my_wedge.stl")
    monkeypatch.setattr(token_shapes_module, "user_cache_path", lambda name: tmp_path / "cache")
    return folder


@pytest.mark.slow
def test_a_template_with_a_mesh_is_fitted_stored_and_used(own_parts, monkeypatch, capsys):
    assert main(["fit", "--all", "--library", str(own_parts)]) == 0
    stored = own_parts / f"my_wedge{SUFFIX}"
    assert [path.name for path in own_parts.glob(f"*{SUFFIX}")] == [stored.name]
    monkeypatch.setattr(token_shapes_module, "fit_primitive", lambda shapes: pytest.fail("search"))
    robot = morphgen.compose("base=fixed ee=my_wedge", library=[own_parts])
    (token,) = token_shapes(robot).values()
    assert token.geometry.size == pytest.approx((0.04, 0.06, 0.1), abs=2e-3)
    assert as_primitives(robot, ()).link("ee_wedge").collisions
    before = stored.stat().st_mtime_ns
    assert main(["fit", "--all", "--library", str(own_parts)]) == 0
    assert stored.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("name", "options", "only"),
    [
        ("panda_hand", COLLISION_OPTIONS, ["panda_leftfinger", "panda_rightfinger"]),
        pytest.param("panda_hand", COLLISION_OPTIONS, None, marks=pytest.mark.slow),
        pytest.param("ur5", TOKEN_OPTIONS, None, marks=pytest.mark.slow),
        pytest.param("ur5", COLLISION_OPTIONS, None, marks=pytest.mark.slow),
        pytest.param("xarm7", COLLISION_OPTIONS, None, marks=pytest.mark.slow),
    ],
)
def test_new_fits_reach_stored_ones_or_their_target_with_as_few_primitives(name, options, only):
    """The tolerance is 0.01: processors round sums differently, and the search amplifies that.

    Stored collision fits are of an earlier search, which needed more primitives for some links.
    """
    body = load_part(LIBRARY.manifest(name)).fragment
    stored = read_stored_fits(LIBRARY.folders)
    for row in fit_links(body, options, only=only).links:
        shapes = body.link(row.link).solid_shapes
        fit, new = stored[shapes_key(shapes)], row.fit.quality.iou
        kept = (fit.token,) if options == TOKEN_OPTIONS else fit.collision
        iou = quality(solid_of(shapes), kept).iou
        assert new == pytest.approx(iou, abs=0.01) or new >= options.iou
        assert len(row.fit.primitives) <= len(kept)
