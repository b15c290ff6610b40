"""Bundles: their files, fits, pictures and cards; folders of exports."""

import json
import math
import os
import random
import re
import shutil
import stat
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from PIL import Image

import morphgen
from helpers.commands import run_python, tree
from helpers.robots import arm
from morphgen.errors import FormatError, MissingDependencyError
from morphgen.fitting import token_shapes as module
from morphgen.fitting.replace_collision import as_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats import picture
from morphgen.formats.bundle import file_findings, read_bundle, write_bundle
from morphgen.formats.files import MANIFEST, writing_export
from morphgen.formats.fits import (
    FITS,
    FITTER_VERSION,
    SUFFIX,
    StoredFit,
    fits_text,
    read_stored_fits,
    shape_to_data,
    shapes_key,
    stored_fit,
)
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, scale_shape
from morphgen.model.robot import Link, Robot


def test_a_bundle_has_urdf_mjcf_card_and_a_picture_that_is_not_blank(tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm")
    assert set(tree(folder)) == {"robot.urdf", "robot.xml", "card.json", "preview.png"}
    assert (tmp_path / "arm").stat().st_mode & stat.S_IROTH
    picture = Image.open(folder / "preview.png")
    pixels = np.asarray(picture.convert("L"))
    assert picture.size == (640, 480)
    assert 0.01 < (np.abs(pixels.astype(int) - int(pixels[0, 0])) > 10).mean() < 0.6


def test_meshes_are_written_once_and_in_metres(tmp_path):
    source = tmp_path / "cube.stl"
    trimesh.creation.box(extents=(100, 100, 100)).export(source)
    mesh = Mesh(source, (0.001, 0.001, 0.001))
    link = Link("a", visuals=(Shape(mesh),), collisions=(Shape(mesh),))
    folder = write_bundle(Robot("r", (link,)), tmp_path / "r", picture=False)
    (written,) = (folder / "meshes").iterdir()
    assert trimesh.load_mesh(written).extents == pytest.approx([0.1, 0.1, 0.1])
    again = write_bundle(read_bundle(folder), tmp_path / "r2", picture=False)
    assert [p.name for p in (again / "meshes").iterdir()] == [written.name]


@pytest.fixture
def folder(tmp_path):
    return write_bundle(arm(), tmp_path / "arm", picture=False)


@pytest.fixture
def change(folder):
    """Change keys of the card of a bundle."""

    def change(changes):
        card = json.loads((folder / "card.json").read_text())
        (folder / "card.json").write_text(json.dumps({**card, **changes}))

    return change


@pytest.mark.parametrize(("content", "message"), [("{", "invalid JSON"), ('{"format": 99}', "99")])
def test_a_broken_card_is_an_error(folder, content, message):
    (folder / "card.json").write_text(content)
    with pytest.raises(FormatError, match=message):
        read_bundle(folder)


def test_changed_and_missing_files_are_reported(folder):
    assert file_findings(folder) == ()
    (folder / "robot.urdf").write_text((folder / "robot.urdf").read_text() + "<!-- mine -->")
    (folder / "robot.xml").unlink()
    location_by_code = {finding.code: finding.where for finding in file_findings(folder)}
    assert location_by_code == {"file-changed": "file robot.urdf", "file-missing": "file robot.xml"}


@pytest.mark.parametrize("name", ["/etc/passwd", "../other", "meshes/../../x"])
def test_a_card_that_references_a_file_outside_the_bundle_is_an_error(folder, change, name):
    change({"hashes": {name: "0"}})
    with pytest.raises(FormatError, match=f"hashes: '{name}' leads out of the folder"):
        file_findings(folder)


@pytest.mark.parametrize("name", ["a\0b", "a" * 300])
def test_an_invalid_file_name_in_a_card_is_reported_as_missing(folder, change, name):
    change({"hashes": {name: "0"}})
    assert [finding.code for finding in file_findings(folder)] == ["file-missing"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"parts": [{"label": "a"}]},
        {"accepted": {"a": 3}},
        {"repairs": 5},
        {"ignore_pairs": [10**400]},
        {"home": {"shoulder": 0}},
        {"home": {"shoulder": 0, "elbow": float("nan"), "extend": 0, "left": 0}},
        {"ignore_pairs": [["a"]]},
        {"frames": {"nowhere": {}}},
    ],
    ids=str,
)
def test_a_card_of_the_wrong_type_is_an_error(folder, change, wrong):
    change(wrong)
    with pytest.raises(FormatError):
        read_bundle(folder)


WORDS = "arm=ur5 ee=plane"
ROBOT = morphgen.compose(WORDS)


@pytest.fixture(autouse=True)
def no_search(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "user_cache_path", lambda name: tmp_path / "cache" / name)
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched"))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the folder of a bundle of the UR5."""
    return write_bundle(ROBOT, tmp_path_factory.mktemp("r") / "ur5", picture=False)


@pytest.fixture
def bundle_folder(written, tmp_path):
    return shutil.copytree(written, tmp_path / "ur5")


def test_a_bundle_contains_the_fits_of_its_parts(bundle_folder):
    back = read_bundle(bundle_folder)
    assert token_shapes(back) == token_shapes(ROBOT)
    robots = [as_primitives(each, ()) for each in (ROBOT, back)]
    ours, theirs = ([link.collisions for link in robot.links] for robot in robots)
    assert ours == theirs


def test_token_shapes_do_not_depend_on_the_collision_geometry(tmp_path):
    primitive_robot = morphgen.compose(WORDS, geometry="primitive")
    back = read_bundle(write_bundle(primitive_robot, tmp_path / "prims", picture=False))
    assert token_shapes(primitive_robot) == token_shapes(back) == token_shapes(ROBOT)
    upper_arm = token_shapes(ROBOT)["arm_upper_arm_link"].geometry
    assert upper_arm.radius == pytest.approx(0.0545, abs=1e-4)


def test_fits_are_kept_when_a_bundle_is_rewritten(bundle_folder, tmp_path):
    again = write_bundle(read_bundle(bundle_folder), tmp_path / "again", picture=False)
    assert (again / FITS).read_bytes() == (bundle_folder / FITS).read_bytes()


def test_a_robot_without_meshes_has_no_fits_file(tmp_path):
    bundle_folder = write_bundle(morphgen.compose("prims"), tmp_path / "prims", picture=False)
    assert not (bundle_folder / FITS).exists()


def test_an_edited_mesh_does_not_use_the_fit_of_the_original(bundle_folder):
    link = read_bundle(bundle_folder).link("arm_forearm_link")
    path = link.collisions[0].geometry.path
    trimesh.creation.box((0.1, 0.2, 0.3)).export(path)
    with pytest.raises(pytest.fail.Exception, match="searched"):
        token_shapes(read_bundle(bundle_folder))


def test_fits_of_another_fitter_version_are_ignored(bundle_folder):
    data = json.loads((bundle_folder / FITS).read_text())
    (bundle_folder / FITS).write_text(json.dumps(data | {"fitter": 1}))
    assert read_bundle(bundle_folder).fits == {}


def test_links_to_fits_outside_the_bundle_are_not_followed(bundle_folder, tmp_path):
    (bundle_folder / FITS).rename(tmp_path / "elsewhere.json")
    (bundle_folder / FITS).symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(FormatError, match="leaves its folder"):
        read_bundle(bundle_folder)


TILTED = Pose.from_xyz_rpy((0.1, -0.25, 1 / 3), (0.3, -0.5, 2.0))
CAN = Shape(Cylinder(0.05, 0.3), TILTED)
ARM = StoredFit(
    "arm",
    CAN,
    (Shape(Box((0.1, 0.2, 1 / 7)), TILTED), CAN, Shape(Sphere(0.123456), Pose((0, 0, 1)))),
    0.8125,
    0.9375,
)
HAND = StoredFit(
    "a hand \N{GREEK SMALL LETTER ALPHA}", CAN, (Shape(Capsule(0.02, 0.1), TILTED),), 0.5, 0.5
)


def write(folder, text, name="robot"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}{SUFFIX}"
    path.write_text(text, encoding="utf-8")
    return path


def changed(**changes):
    """Return the fits file of the arm with changed keys of its link; None removes a key."""
    data = json.loads(fits_text({"key": ARM}))
    link = {k: v for k, v in (data["links"][0] | changes).items() if v is not None}
    return json.dumps(data | {"links": [link]})


def shape(**changes):
    """Return plain data of the can with changed keys; None removes a key."""
    return {k: v for k, v in (shape_to_data(CAN) | changes).items() if v is not None}


def test_all_fit_files_of_all_folders_are_read_and_other_files_ignored(tmp_path):
    write(tmp_path / "a", fits_text({"one": ARM}))
    write(tmp_path / "b" / "deep" / "deeper", fits_text({"two": HAND}))
    (tmp_path / "a" / "robot.json").write_text("{")
    (tmp_path / "a" / "robot.yaml").write_text("name: robot")
    assert read_stored_fits([tmp_path / "a", tmp_path / "b"]) == {"one": ARM, "two": HAND}
    assert read_stored_fits([tmp_path / "b"]) == {"two": HAND}
    assert read_stored_fits([tmp_path / "nowhere"]) == {}
    assert read_stored_fits([]) == {}


MALFORMED = {
    "empty": "",
    "list": "[]",
    "deep": "[" * 100_000,
    "no links": json.dumps({"fitter": FITTER_VERSION}),
    "link empty": json.dumps({"fitter": FITTER_VERSION, "links": [{}]}),
    "no kind": changed(token=shape(cylinder=None)),
    "two kinds": changed(token=shape(sphere=[0.1])),
    "cone": changed(token=shape(cylinder=None, cone=[1, 2])),
    "cylinder of three": changed(token=shape(cylinder=[1, 2, 3])),
    "nan": changed(token=shape(cylinder=[0.1, math.nan])),
    "negative": changed(token=shape(cylinder=[0.1, -1.0])),
    "too large": changed(token=shape(cylinder=[0.1, 10**400])),
    "quaternion zero": changed(token=shape(quaternion=[0, 0, 0, 0])),
    "long": changed(token=dict.fromkeys(map(str, range(10_000)), 0)),
    "no primitives": changed(collision=[]),
    "many primitives": changed(collision=[shape()] * 33),
    "overlap above one": changed(token_iou=1.5),
    "overlap nan": changed(collision_iou=math.nan),
}


@pytest.mark.parametrize("fault", list(MALFORMED))
def test_a_malformed_file_is_a_one_line_error(tmp_path, fault):
    path = write(tmp_path, MALFORMED[fault])
    with pytest.raises(FormatError) as caught:
        read_stored_fits([tmp_path])
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def test_a_changed_file_is_reloaded(tmp_path):
    path = write(tmp_path, fits_text({"one": ARM}))
    read_stored_fits([tmp_path]).clear()  # changes no cache
    assert read_stored_fits([tmp_path]) == {"one": ARM}
    path.write_text(fits_text({"one": HAND}), encoding="utf-8")
    os.utime(path, ns=(1, 1))
    assert read_stored_fits([tmp_path]) == {"one": HAND}


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.1, 0.2, 0.3)).export(path)
    return Mesh(path)


def test_the_same_content_under_another_name_has_the_same_key(mesh, tmp_path):
    (tmp_path / "deep").mkdir()
    copy = Mesh(tmp_path / "deep" / "other.stl")
    shutil.copy(mesh.path, copy.path)
    os.utime(copy.path, ns=(1, 1))
    assert shapes_key([Shape(copy, TILTED)]) == shapes_key([Shape(mesh, TILTED)])


def test_changes_of_the_solid_change_the_key(mesh):
    geometries = [
        mesh,
        *(replace(mesh, scale=scale) for scale in ((1.0, 1.0, -1.0), (0.001, 0.001, 0.002))),
        *(replace(mesh, part=part) for part in (0, 1)),
        *(Box(size) for size in ((0.1, 0.2, 0.3), (0.2, 0.1, 0.3))),
        *(Sphere(0.1), Sphere(0.2), Cylinder(0.1, 0.2), Capsule(0.1, 0.2), Capsule(0.2, 0.1)),
    ]
    shapes = [*map(Shape, geometries), Shape(mesh, Pose((0, 0, 1e-6))), Shape(mesh, TILTED)]
    keys = [shapes_key([each]) for each in shapes]
    keys += [shapes_key([]), shapes_key(shapes[:2]), shapes_key(shapes[:1] * 2)]
    assert len(set(keys)) == len(keys)


def test_uniformly_scaled_shapes_share_a_key_and_their_fit_scales(mesh):
    shapes = [Shape(mesh, TILTED), Shape(Box((0.1, 0.2, 0.3)), Pose((0.1, 0.0, 0.2)))]
    larger = [scale_shape(shape, 1.3) for shape in shapes]
    assert shapes_key(larger) == shapes_key(shapes)
    assert shapes_key([larger[0], shapes[1]]) != shapes_key(shapes)
    stored = {shapes_key(shapes): ARM}
    assert stored_fit(shapes, stored) == ARM
    fit = stored_fit(larger, stored)
    assert fit.token == scale_shape(ARM.token, 1.3)
    assert fit.collision == tuple(scale_shape(shape, 1.3) for shape in ARM.collision)
    assert stored_fit([Shape(Sphere(0.1))], stored) is None


def test_neither_colour_nor_order_nor_the_sign_of_zero_changes_the_key(mesh):
    shapes = [Shape(mesh), Shape(mesh, TILTED), Shape(Box((0.1, 0.2, 0.3))), Shape(Sphere(0.1))]
    key = shapes_key(shapes)
    rng = random.Random(0)
    for _ in range(5):
        assert shapes_key(rng.sample(shapes, len(shapes))) == key
    assert shapes_key([replace(each, rgba=(1.0, 0.0, 0.0, 1.0)) for each in shapes]) == key
    assert shapes_key([Shape(mesh, Pose((-0.0, 0.0, 0.0)))]) == shapes_key([Shape(mesh)])


def test_a_missing_mesh_has_no_key(tmp_path):
    with pytest.raises(FormatError, match=r"lost\.stl: cannot be read") as caught:
        shapes_key([Shape(Sphere(0.1)), Shape(Mesh(tmp_path / "lost.stl"))])
    assert "\n" not in str(caught.value)


def export(folder, text="a"):
    with writing_export(folder, "urdf", "arm") as partial:
        (partial / "meshes").mkdir()
        (partial / "meshes" / "a.stl").write_text(text)
    return folder


def test_unchanged_export_is_replaced(tmp_path):
    folder = export(tmp_path / "arm-urdf")
    manifest = json.loads((folder / MANIFEST).read_text())
    assert (manifest["format"], manifest["robot"]) == ("urdf", "arm")
    assert list(manifest["files"]) == ["meshes/a.stl"]
    (folder / "meshes" / ".DS_Store").touch()  # of a file manager
    export(folder, "b")
    assert (folder / "meshes" / "a.stl").read_text() == "b"
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("notes.txt", "notes.txt is not of the export"),
        ("meshes/a.stl", "meshes/a.stl was changed since"),
        (MANIFEST, "files: expected an object"),
    ],
)
def test_edited_export_is_not_replaced(tmp_path, file, message):
    folder = export(tmp_path / "arm-urdf")
    (folder / file).write_text("[1]")
    before = tree(tmp_path)
    with pytest.raises(FormatError, match=re.escape(message)):
        export(folder, "b")
    assert tree(tmp_path) == before


def test_export_of_another_robot_is_not_replaced(tmp_path):
    folder = export(tmp_path / "x")
    message = r"x is an export of robot 'arm', not of 'leg'"
    with pytest.raises(FormatError, match=message), writing_export(folder, "urdf", "leg"):
        pass


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_other_things_are_not_replaced(tmp_path, kind):
    path = tmp_path / "arm-urdf"
    make = {"folder": path.mkdir, "file": path.touch, "link": lambda: path.symlink_to(other)}
    other = export(tmp_path / "other")
    make[kind]()
    with pytest.raises(FormatError, match=r"arm-urdf exists and is not an export"):
        export(path)


@pytest.mark.parametrize("name", ["arm-urdf", "new/folder/arm-urdf"])
def test_failed_export_leaves_what_was_there(tmp_path, name):
    export(tmp_path / "arm-urdf")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(TypeError):
        export(tmp_path / name, 1)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "arm-urdf/meshes/a.stl").read_text() == "a"


def test_triton_is_imported_before_an_opengl_library(monkeypatch):
    imported = []

    def import_module(name):
        imported.append(name)
        raise ImportError(f"no {name}")

    monkeypatch.setattr(picture, "import_module", import_module)
    monkeypatch.setattr(picture, "find_spec", lambda name: name == "triton")
    with pytest.raises(MissingDependencyError, match=r"egl: no mujoco\.egl; osmesa: no mujoco\."):
        picture.gl_context(8, 8)
    assert imported == ["triton", "mujoco.egl", "mujoco.osmesa"]


@pytest.mark.skipif(find_spec("triton") is None, reason="this PyTorch has no triton")
def test_a_process_can_draw_and_then_import_triton():
    code = "from morphgen.formats.picture import gl_context; gl_context(8, 8).free(); import triton"
    assert run_python(code).stderr == ""
