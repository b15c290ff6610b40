"""Stored fits: the file format and the keys that identify the shapes of a link."""

import json
import math
import os
import random
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from morphgen.errors import FormatError
from morphgen.formats.fits import (
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


def test_stored_fits_round_trip(tmp_path):
    fits = {"one": ARM, "two": HAND}
    write(tmp_path, fits_text(fits))
    assert read_stored_fits([tmp_path]) == fits


def test_a_mesh_is_not_stored():
    with pytest.raises(ValueError, match=r"mesh m\.stl is not a primitive"):
        shape_to_data(Shape(Mesh(Path("m.stl"))))


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


def test_a_key_follows_the_working_directory(tmp_path, monkeypatch):
    keys = set()
    for name, size in (("a", 1.0), ("b", 2.0)):
        (tmp_path / name).mkdir()
        trimesh.creation.box((size,) * 3).export(tmp_path / name / "m.stl")
        os.utime(tmp_path / name / "m.stl", ns=(1, 1))
        monkeypatch.chdir(tmp_path / name)
        keys.add(shapes_key([Shape(Mesh(Path("m.stl")))]))
    assert len(keys) == 2


def test_changes_of_the_solid_change_the_key(mesh):
    shapes = [
        Shape(mesh),
        Shape(replace(mesh, scale=(1.0, 1.0, -1.0))),
        Shape(replace(mesh, scale=(0.001, 0.001, 0.002))),
        Shape(replace(mesh, part=0)),
        Shape(replace(mesh, part=1)),
        Shape(mesh, Pose((0, 0, 1e-6))),
        Shape(mesh, TILTED),
        Shape(Box((0.1, 0.2, 0.3))),
        Shape(Box((0.2, 0.1, 0.3))),
        Shape(Sphere(0.1)),
        Shape(Sphere(0.2)),
        Shape(Cylinder(0.1, 0.2)),
        Shape(Capsule(0.1, 0.2)),
        Shape(Capsule(0.2, 0.1)),
    ]
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
