"""Meshes and their files."""

import io
import os
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from helpers.collada import DAE
from helpers.faulty_robots import with_shape
from morphgen.checks import check
from morphgen.errors import MeshError
from morphgen.model import mesh_files
from morphgen.model.geometry import Mesh, Shape
from morphgen.model.mesh import convex_hull, load_mesh, mesh_parts
from morphgen.model.mesh_files import MAX_PIXELS, read_mesh_file
from morphgen.model.robot import Link, Robot

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


@pytest.mark.parametrize("suffix", ["stl", "ascii.stl", "STL", "obj", "dae"])
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


def test_a_collada_geometry_whose_material_is_broken_is_read_without_colours(tmp_path):
    path = dae(tmp_path / "m.dae")
    path.write_text(path.read_text().replace('-fx"/>', '-missing"/>'))
    assert counts(path) == [(None, 4)]


CORNERS = [(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
"""A tetrahedron."""


def read(folder, name, content):
    data = content.encode() if isinstance(content, str) else content
    (folder / name).write_bytes(data)
    return read_mesh_file(folder / name)


def count(content):
    return sum(len(part.faces) for part in content.parts)


def volume(content):
    corners = np.concatenate([part.vertices[part.faces] for part in content.parts])
    return float(np.linalg.det(corners).sum() / 6)


def binary_stl(faces=4, stated=None):
    rows = [
        struct.pack("<12fH", 0, 0, 0, *(x for corner in FACES[i % 4] for x in CORNERS[corner]), 0)
        for i in range(faces)
    ]
    return bytes(80) + struct.pack("<I", faces if stated is None else stated) + b"".join(rows)


def ascii_stl(faces, name="a", end=True):
    lines = [f"solid {name}"]
    for i in faces:
        corners = "\n".join("vertex {} {} {}".format(*CORNERS[k]) for k in FACES[i])
        lines.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
    return "\n".join([*lines, f"endsolid {name}" if end else ""]) + "\n"


def picture(size=(2, 2), claimed=None):
    """Return a green PNG, whose header may claim another size."""
    stream = io.BytesIO()
    Image.new("RGB", size, "lime").save(stream, "PNG")
    data = stream.getvalue()
    if claimed is None:
        return data
    header = data[12:16] + struct.pack(">II", *claimed) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def dae_of(**changes: str) -> str:
    text = DAE.format(unit=1, up="Z_UP", shift="0 0 0")
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    return text


def dae_with(primitive):
    first, rest = dae_of().split("<triangles", 1)
    return first + primitive + rest.split("</triangles>")[-1]


INPUT = '<input semantic="VERTEX" source="#v" offset="0"/>'
TRIANGLES = f'<triangles count="4">{INPUT}<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>'


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("two_solids.stl", ascii_stl([0, 1]) + ascii_stl([2, 3], "b", end=False)),
        ("upper.stl", ascii_stl([0, 1, 2, 3]).upper()),
        ("vertex.stl", ascii_stl([0, 1, 2, 3], "vertex of facet")),
        ("concatenated.stl", binary_stl(2) + binary_stl(4)[:80] + struct.pack("<I", 2)
         + binary_stl(4)[-100:]),
        ("indented.obj", "\tv 0 0 0\n v 1 0 0\nv\t0 2 0\nv 0 0 3\n f 1 3 2\nf\t1 2 4\nf 1 4 3 # x\n"
         "f 2 3 4\n"),
        ("negative.obj", "v 0 0 0\nv 1 0 0\nv 0 2 0\nf -3 -1 -2\nv 0 0 3\nf 1 2 -1\nf -4 -1 -2\n"
         "f 2 3 4\n"),
        ("mixed.obj", "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nvt 0 0\nvn 0 0 1\nf 1//1 3//1 2//1\n"
         "f 1/1 2/1 4/1\nf 1 4/1 3//1\nf 2/1/1 3 4\n"),
        ("polylist.dae", dae_with(f'<polylist count="4">{INPUT}<vcount>3 3 3 3</vcount>'
                                  "<p>0 2 1 0 1 3 0 3 2 1 2 3</p></polylist>")),
        ("polygons.dae", dae_with(f'<polygons count="4">{INPUT}<p>0 2 1</p><p>0 1 3</p>'
                                  "<p>0 3 2</p><p>1 2 3</p></polygons>")),
        ("fans.dae", dae_with(f'<trifans count="2">{INPUT}<p>3 0 1 2 0</p><p>0 2 1</p></trifans>')),
        ("strips.dae", dae_with(f'<tristrips count="1">{INPUT}<p>0 2 1 3 0 2</p></tristrips>')),
    ],
)  # fmt: skip
def test_every_form_of_a_tetrahedron_is_read_whole(name, content, tmp_path):
    mesh = read(tmp_path, name, content)
    assert count(mesh) == 4
    assert mesh.left_out == ()
    assert volume(mesh) == pytest.approx(1)


LINES = f'<lines count="1">{INPUT}<p>0 1</p></lines>'
SOLID_OBJ = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
NOTED = {
    "lines.dae": (dae_with(TRIANGLES + LINES), "1 line sets"),
    "linestrips.dae": (dae_with(TRIANGLES + LINES.replace("lines", "linestrips")), "1 line strips"),
    "lost.dae": (
        dae_of(n=("</node>", '</node><node><instance_geometry url="b.dae#x"/></node>')),
        "1 instances of 'b.dae#x', which the file does not define",
    ),
    "skin.dae": (
        dae_of(n=("</node>", '</node><node><instance_controller url="#c"/></node>')),
        "1 skins or morph targets",
    ),
    "texture.dae": (
        dae_of(t=("<color>1 0 0 1</color>", '<texture texture="nosuch" texcoord="UV"/>')),
        "texture 'nosuch', which the file does not define",
    ),
    "tail.stl": (binary_stl() + b"more", "4 bytes after the last triangle"),
    "lines.obj": (
        SOLID_OBJ + "l 1 2\nl 2 3\np 1\n",
        "2 lines",
    ),
    "surface.obj": (
        SOLID_OBJ + "surf 0 1 0 1 1 2\n",
        "1 free-form curves and surfaces",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOTED)
def test_what_is_left_out_is_counted_and_is_a_finding(name, tmp_path):
    content, note = NOTED[name]
    mesh = read(tmp_path, name, content)
    assert count(mesh) == 4
    assert note in mesh.left_out
    found = [f for f in check(with_shape(Mesh(tmp_path / name))) if f.code == "mesh-left-out"]
    without_triangles = ("lines.dae", "linestrips.dae", "texture.dae", "lines.obj")
    assert [f.severity for f in found] == ["info" if name in without_triangles else "warning"]
    assert note in found[0].why


OBJ = (
    "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nvt 0 0\nusemtl a\nf 1/1 3/1 2/1\nusemtl b\nf 1/1 2/1 4/1\n"
)
BLUE_OF_FILE, GREEN = (0.2, 0.4, 0.6, 1.0), (0.0, 1.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("properties", "alpha"),
    [
        ("d 0.5", 128), ("Tr 0.8", 51), ("d -halo 0.25", 64), ("Tr 0.2\nd 0.5", 128), ("", 255),
        ("Tr 1", 255), ("Tr 0", 255), ("d x", 255), ("d 7", 255),
    ],
)  # fmt: skip
def test_the_opacity_of_a_material_is_read(properties, alpha, tmp_path):
    (tmp_path / "m.mtl").write_text(f"newmtl a\nKd 0.2 0.4 0.6\n{properties}\nnewmtl b\nKd 0 1 0\n")
    mesh = read(tmp_path, "e_d_alpha.obj", "mtllib m.mtl\n" + OBJ)
    assert {part.rgba for part in mesh.parts} == {(*BLUE_OF_FILE[:3], alpha / 255), GREEN}


@pytest.mark.parametrize(
    "libraries", ["mtllib a.mtl\nmtllib b c.mtl\n", "mtllib a.mtl x.mtl\nmtllib b c.mtl\n"]
)
def test_all_material_files_are_read(libraries, tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 0.2 0.4 0.6")
    (tmp_path / "b c.mtl").write_text("newmtl b\nKd 0 1 0\n")
    mesh = read(tmp_path, "m.obj", libraries + OBJ)
    assert {part.rgba for part in mesh.parts} == {BLUE_OF_FILE, GREEN}
    expected = ("material file 'x.mtl': no such file",) if "x.mtl" in libraries else ()
    assert mesh.left_out == expected


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("none.png", None, "no such file"),
        ("junk.png", b"junk", "not a picture"),
        ("cut.png", picture((90, 90))[:70], "a broken picture"),
        ("bomb.png", picture(claimed=(8192, 4097)), f"8192 x 4097 pixels; at most {MAX_PIXELS}"),
        ("warned.png", picture(claimed=(13000, 13000)), "13000 x 13000 pixels"),  # by Pillow
        ("../out.png", picture(), "is outside the mesh's folder"),
        ("post.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n",
         "not a picture"),
    ],
)  # fmt: skip
def test_without_its_texture_a_material_has_its_own_colour(name, content, reason, tmp_path):
    (tmp_path / "f").mkdir()
    if content is not None:
        (tmp_path / "f" / name).write_bytes(content)
    (tmp_path / "f" / "m.mtl").write_text(
        f"newmtl a\nKd 0.2 0.4 0.6\nmap_Kd {name}\nnewmtl b\nKd 0 1 0\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = read(tmp_path / "f", "m.obj", "mtllib m.mtl\n" + OBJ)
    assert {part.rgba for part in mesh.parts} == {BLUE_OF_FILE, GREEN}
    assert len(mesh.left_out) == 1
    assert mesh.left_out[0].startswith(f"texture {name!r}: ")
    assert reason in mesh.left_out[0]


def nested_nodes(levels):
    """A COLLADA scene of 2^levels nodes."""
    nodes = "".join(
        f'<node id="n{i}">' + f'<instance_node url="#n{i - 1}"/>' * 2 + "</node>"
        for i in range(1, levels)
    )
    last = f'<visual_scene id="s"><node><instance_node url="#n{levels - 1}"/></node>'
    library = f'<library_nodes><node id="n0"/>{nodes}</library_nodes><library_visual_scenes>'
    return dae_of(n=("<library_visual_scenes>", library), s=('<visual_scene id="s">', last))


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
REFUSED: dict[str, tuple[str | bytes, str]] = {
    # beyond a bound
    "sixteen.dae": (dae_of().encode("utf-16"), "expected UTF-8"),
    "seven.dae": ('<?xml version="1.0" encoding="UTF-7"?>' + dae_of()[38:], "encoding 'utf-7'"),
    "instances.dae": (
        dae_of(n=("</visual_scene>", '<node><instance_geometry url="#g"/></node>' * 20_001
               + "</visual_scene>")),
        "nodes; at most 20000 are read",
    ),
    "nodes.dae": (nested_nodes(40), "nodes; at most 20000 are read"),
    "entity.dae": (dae_of(x=("<COLLADA", '<!DOCTYPE r [<!ENTITY e "a">]><COLLADA')), "DOCTYPE"),
    "deep.dae": (b"<COLLADA>" + b"<a>" * 100_000, "depth"),
    "triangles.dae": (
        dae_with(f'<polylist count="1">{INPUT}<vcount>3000000</vcount><p>0 1 2</p></polylist>'),
        "2999998 triangles; at most 1000000",
    ),
    "elements.dae": (
        dae_of(s=("</library_visual_scenes>", "<a/>" * 500_000 + "</library_visual_scenes>")),
        "more than 500000 elements",
    ),
    "face.obj": ("v 0 0 0\nf" + " 1" * 40_000 + "\n", "a line has more than 65536 characters"),
    "fan.obj": ("v 0 0 0\nf" + " 1" * 1_100_000 + "\n", "a line has more than 65536 characters"),
    "faces.obj": ("v 0 0 0\n" + ("f" + " 1" * 30_000 + "\n") * 40, "1199920 triangles"),
    "index.obj": ("v 0 0 0\nf 1 2 99999999999\n", "is out of bounds"),
    "zero.obj": ("v 0 0 0\nv 0 0 1\nv 0 1 1\nf 0 1 2\n", "index '0' of a face"),
    "materials.obj": (
        OBJ + "".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(5001)), "5003 materials"
    ),
    # the true reason
    "empty.stl": (b"", "the file is empty"),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 2 1 0\nf 1 2 3\n", "a vertex is not finite"),
    "inf.obj": (b"v 1e999 0 0\nv 1 0 0\nv 2 1 0\nf 1 2 3\n", "a vertex is not finite"),
    "a.glb": (b"glTF", "cannot read '.glb' meshes; valid: .dae, .obj, .stl"),
    "pointer.stl": (LFS, "the file is a Git LFS pointer; run 'git lfs pull'"),
    "page.obj": (b"<!DOCTYPE html>\n<html></html>", "the file is a web page"),
    "other.stl": (dae_of().encode(), "the file has the content of a .dae file; rename it"),
    "other.obj": (ascii_stl([0]).encode(), "the file has the content of a .stl file"),
    "cut.stl": (binary_stl()[:200], "4 triangles, which take 284 bytes, and the file has 200"),
    "short.stl": (binary_stl()[:60], "60 bytes; a binary STL file has at least 84"),
    "text.stl": (ascii_stl([0, 1])[:-70].encode(), "truncated or malformed"),
    "none.stl": (b"solid x\nendsolid x\n", "holds no triangle"),
    "solid.stl": (b"solid" + bytes(2**20), "holds no triangle"),
    "none.obj": (b"v 0 0 0\nl 1 1\n", "holds 1 vertices and no triangle"),
    "none.dae": (dae_with(LINES), "its scene holds no triangle"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_refused_file_is_named_with_the_true_reason(name, tmp_path):
    content, reason = REFUSED[name]
    with pytest.raises(MeshError, match=reason) as caught:
        read(tmp_path, name, content)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)
