"""``morphgen fit`` of a mesh file: output and rejected meshes."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.commands import tree

pytestmark = pytest.mark.usefixtures("nothing_is_stored")
FIGURES = {
    "iou",
    "coverage",
    "volume_ratio",
    "protrusion_share",
    "protrusion_mean",
    "protrusion_p95",
    "gap_mean",
    "gap_p95",
    "hausdorff",
}


@pytest.fixture
def angle(tmp_path):
    """``angle.stl``, an L of two boxes that touch."""
    tall, wide = trimesh.creation.box((0.1, 0.1, 0.4)), trimesh.creation.box((0.2, 0.1, 0.1))
    tall.apply_translation((0.05, 0.05, 0.2))
    wide.apply_translation((0.2, 0.05, 0.05))
    trimesh.boolean.union([tall, wide]).export(tmp_path / "angle.stl")
    return Path("angle.stl")


def test_mesh_fit_prints_a_table_and_the_primitive(run, box, tmp_path):
    before = tree(tmp_path)
    code, out, err = run("fit", box)
    assert (code, err) == (0, "")
    header, rule, row, shape = out.splitlines()
    for word in ("link", "primitives", "solid", "IoU", "Hausdorff mm"):
        assert word in header
    assert set(rule) == {"-", " "}
    assert row.split()[:3] == ["link.stl", "box", "watertight"]
    assert float(row.split()[3]) > 0.97
    assert shape.startswith("Box(size=(")
    assert tree(tmp_path) == before


@pytest.mark.slow
def test_mesh_fit_as_json_is_in_metres(run, box):
    code, out, err = run("fit", box, "--json", "--seed", "3")
    assert (code, err) == (0, "")
    data = json.loads(out)
    assert out.count("\n") == 1
    assert (data["mesh"], data["solid"], data["decimated_from"]) == ("link.stl", "watertight", None)
    (primitive,) = data["primitives"]
    np.testing.assert_allclose(sorted(primitive["box"]), (0.1, 0.2, 0.3), rtol=0.02)
    np.testing.assert_allclose(primitive["xyz"], (1.0, 2.0, 3.0), atol=2e-3)
    assert np.linalg.norm(primitive["quaternion"]) == pytest.approx(1.0)
    assert set(data["quality"]) == FIGURES
    assert data["quality"]["iou"] > 0.97
    again = json.loads(run("fit", box, "--json", "--seed", "3")[1])
    assert {**again, "seconds": 0} == {**data, "seconds": 0}


@pytest.mark.slow
def test_more_primitives_are_fitted_until_the_iou_is_reached(run, angle):
    code, out, err = run("fit", angle, "--max-primitives", "3", "--iou", "0.95", "--json")
    assert (code, err) == (0, "")
    data = json.loads(out)
    assert [set(each) & {"box", "cylinder", "sphere"} for each in data["primitives"]] == [
        {"box"}
    ] * 2
    assert data["quality"]["iou"] > 0.95
    code, out, err = run("fit", angle, "--max-primitives", "3", "--iou", "0.3", "--json")
    assert len(json.loads(out)["primitives"]) == 1


def test_enclosing_primitives_cover_the_whole_mesh(run, angle):
    code, out, err = run("fit", angle, "--enclose", "--json")
    assert (code, err) == (0, "")
    data = json.loads(out)
    assert data["quality"]["coverage"] == 1.0
    assert data["quality"]["gap_p95"] < 1e-8
    assert data["quality"]["iou"] < 0.8


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "STL"])
def test_every_mesh_format_is_read(run, tmp_path, suffix):
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / f"link.{suffix}")
    code, out, err = run("fit", f"link.{suffix}", "--json", "--enclose")
    assert (code, err) == (0, "")
    (primitive,) = json.loads(out)["primitives"]
    np.testing.assert_allclose(sorted(primitive["box"]), (0.1, 0.2, 0.3), atol=1e-5)


MESHES = {
    "empty.stl": b"",
    "text.stl": b"Dear diary,\nthis is no mesh.\n",
    "noise.stl": b"\x00\xff" * 300,
    "none.obj": b"v 0 0 0\n",
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n",
    "inf.obj": b"v 1e999 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n",
    "flat.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n",
    "point.obj": b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n",
}


@pytest.mark.parametrize("name", list(MESHES))
def test_invalid_mesh_is_rejected_with_its_file_name(refused, tmp_path, name):
    (tmp_path / name).write_bytes(MESHES[name])
    assert name in refused("fit", name)


def test_binary_stl_with_nan_is_rejected_with_its_file_name(refused, tmp_path):
    mesh = trimesh.creation.box((1, 1, 1))
    data = bytearray(mesh.export(file_type="stl"))
    data[84 + 12 : 84 + 16] = np.float32(np.nan).tobytes()
    (tmp_path / "nan.stl").write_bytes(data)
    assert "nan.stl" in refused("fit", "nan.stl")


def test_mesh_fit_does_not_accept_out(refused, box):
    message = refused("fit", box, "--out", "made")
    assert "link.stl is a mesh" in message
    assert "--out" in message
