"""Values that are kept in the user's cache: what comes back, what does not, how much is kept."""

import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from helpers.collada import DAE
from morphgen import files
from morphgen.checks import check
from morphgen.errors import MeshError
from morphgen.files import KEPT, keep, read_kept
from morphgen.formats.bundle import mesh_file
from morphgen.formats.data_files import kept_reading, read_bytes
from morphgen.formats.resolve import default_finder
from morphgen.formats.xacro import compile as xacro_compile
from morphgen.grammar import compose as composing
from morphgen.grammar import part as part_module
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request
from morphgen.model import inertia, mesh_files
from morphgen.model import mesh as mesh_module
from morphgen.model.geometry import Box, Mesh, MeshContent, MeshPart, Pose, Shape
from morphgen.model.mesh import convex_hull, hull_triangles, load_mesh, mesh_parts, mesh_triangles
from morphgen.model.robot import Link, Robot

TYPES = (Robot, Link, Shape, Pose, Box, Mesh, MeshContent, MeshPart)
MEMORIES = (
    *(composing._ignored_in_part, part_module._load, xacro_compile._compiled),
    *(inertia._bounding_box, inertia._union_moments, inertia._unit_solid),
    mesh_module._content_or_fault,
    *(read.__wrapped__ for read in (convex_hull, hull_triangles, load_mesh, mesh_triangles)),
)
"""Caches in memory of what is kept in files, too."""


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Use an empty cache; return its folder of kept values."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(files, "_room", 0)
    files._warn_of.cache_clear()
    forget()
    yield tmp_path / "cache" / "morphgen" / KEPT
    forget()


def forget():
    """Forget what this process has computed, as a new process does."""
    for memory in MEMORIES:
        memory.cache_clear()


def kinds_of(kept):
    return {path.name.partition("-")[0] for path in kept.glob("*")}


@pytest.fixture
def box(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.2, 0.4, 0.6)).export(path)
    return path


@pytest.fixture
def reads(monkeypatch):
    """Count the mesh files that are parsed."""
    read, counted = mesh_files.read_mesh_file, []
    monkeypatch.setattr(
        mesh_files, "read_mesh_file", lambda path: counted.append(path) or read(path)
    )
    return counted


def test_a_value_comes_back_as_it_was(kept):
    shape = Shape(Box((0.1, 1 / 3, 1e-300)), Pose((0.0, -0.0, 5.0)), (1.0, 0.0, 0.0, 1.0))
    other = Shape(Mesh(Path("/a/b.stl"), (1.0, 1.0, -1.0), 2))
    link = Link("a", visuals=(shape, other), collisions=())
    robot = Robot("r", (link,), provenance={"note": ("x", 1, None, True)})
    content = MeshContent((MeshPart(None, np.eye(3), np.array([[0, 1, 2]])),), ("note",), 7, True)
    assert read_kept("test", (1, "a"), TYPES) is None
    keep("test", (1, "a"), (robot, content))
    again, meshes = read_kept("test", (1, "a"), TYPES)
    assert (again.name, again.links, again.provenance) == ("r", robot.links, robot.provenance)
    assert (meshes.left_out, meshes.pixels, meshes.self_contained) == (("note",), 7, True)
    part = meshes.parts[0]
    assert isinstance(part, MeshPart)
    assert (part.vertices.dtype, part.faces.dtype) == (np.float64, np.int64)
    np.testing.assert_array_equal(part.vertices, np.eye(3))
    for other_key in ((1, "b"), (1,), (1.5, "a")):
        assert read_kept("test", other_key, TYPES) is None
    assert read_kept("other", (1, "a"), TYPES) is None
    assert read_kept("test", (1, "a")) is None  # these types are not expected here


@pytest.mark.parametrize("size", [0, 3, 4, 5, 40, -1])
def test_a_cut_entry_is_ignored_and_replaced(kept, size):
    keep("test", (1,), list(range(100)))
    (path,) = kept.iterdir()
    path.write_bytes(path.read_bytes()[:size])
    assert read_kept("test", (1,)) is None
    keep("test", (1,), (2,))
    assert read_kept("test", (1,)) == (2,)


def test_every_changed_byte_is_noticed(kept):
    keep("test", (1,), {"a": 1.5, "b": "text"})
    (path,) = kept.iterdir()
    data = path.read_bytes()
    for i in range(len(data)):
        path.write_bytes(data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :])
        assert read_kept("test", (1,)) is None


def entry(name, value):
    body = msgspec.msgpack.encode([name, value])
    return files.zlib.crc32(body).to_bytes(4, "big") + body


@pytest.mark.parametrize(
    "value",
    [
        {"": "Popen", "args": "true"},
        {"": "Box"},
        {"": "Box", "size": [1, 1, 1], "other": 1},
        {"": ["Box"]},
        {"": "ndarray", "dtype": "|O", "shape": [1], "data": b"12345678"},
        {"": "ndarray", "dtype": "<f8", "shape": [2], "data": b"12345678"},
        {"": "ndarray", "dtype": "no", "shape": [2], "data": b""},
        {"": "Path", "path": 3},
    ],
)
def test_what_another_program_wrote_is_ignored(kept, value):
    keep("test", (1,), 0)
    (path,) = kept.iterdir()
    path.write_bytes(entry(path.name, value))
    assert read_kept("test", (1,), (Box,)) is None


def test_an_entry_under_another_name_is_ignored(kept):
    keep("test", (1,), "one")
    (path,) = kept.iterdir()
    keep("test", (2,), "two")
    (other,) = {*kept.iterdir()} - {path}
    shutil.copy(path, other)
    assert (read_kept("test", (1,)), read_kept("test", (2,))) == ("one", None)


def test_entries_of_another_version_are_ignored(kept, monkeypatch):
    keep("test", (1,), "one")
    monkeypatch.setattr(files, "_versions", lambda: ("0.0.1",))
    assert read_kept("test", (1,)) is None


def test_a_cache_that_cannot_be_written_is_reported_once(kept, box, caplog):
    kept.parent.parent.mkdir()
    kept.parent.write_text("a file, so that no folder can be made here")
    with caplog.at_level(logging.WARNING):
        assert load_mesh(Mesh(box)).volume == pytest.approx(0.048)
        assert convex_hull(Mesh(box)).volume == pytest.approx(0.048)
    (message,) = {record.getMessage() for record in caplog.records}
    assert message.startswith(f"cannot keep compiled parts and meshes in {kept}: ")


def test_what_was_not_used_for_longest_is_removed(kept, monkeypatch):
    for i in range(8):
        keep("test", (i,), bytes(1000))
        os.utime(max(kept.iterdir(), key=lambda path: path.stat().st_mtime), (i, i))
    assert read_kept("test", (0,)) is not None  # which makes it the last one used
    (kept / ".partial").mkdir()  # of another process
    monkeypatch.setattr(files, "MAX_KEPT", 6000)
    monkeypatch.setattr(files, "_room", 0)
    keep("test", (8,), bytes(1000))
    left = [i for i in range(9) if read_kept("test", (i,)) is not None]
    assert left == [0, 8]
    assert sum(path.stat().st_size for path in kept.iterdir() if path.is_file()) <= 6000


def test_a_mesh_is_parsed_once_for_all_processes(kept, box, reads):
    def results():
        triangles, hull = mesh_triangles(Mesh(box)), convex_hull(Mesh(box))
        forget()
        return [*map(np.ndarray.tolist, (triangles.vertices, triangles.faces, hull.vertices))]

    first, file = results(), mesh_file(Mesh(box))
    forget()
    assert (results(), mesh_file(Mesh(box))) == (first, file)
    assert len(reads) == 1


def test_an_edited_mesh_is_parsed_again(kept, box, reads):
    load_mesh(Mesh(box))
    trimesh.creation.box((1, 1, 1)).export(box)
    forget()
    np.testing.assert_allclose(load_mesh(Mesh(box)).extents, (1, 1, 1))
    assert len(reads) == 2


def test_a_mesh_with_a_drawn_scale_is_not_kept(kept, box):
    mesh_triangles(Mesh(box, (1.1, 1.1, 1.1)))
    assert kinds_of(kept) == {"content"}
    mesh_triangles(Mesh(box, (0.001, 0.001, -0.001)))
    assert kinds_of(kept) == {"content", "triangles"}


def test_a_mesh_that_names_another_file_is_not_kept(kept, tmp_path):
    (tmp_path / "colours.mtl").write_text("newmtl paint\nKd 1 0 0\n")
    path = tmp_path / "box.obj"
    text = trimesh.creation.box((1, 1, 1)).export(file_type="obj", include_normals=False)
    path.write_text(f"mtllib colours.mtl\nusemtl paint\n{text}")
    assert [part.rgba for part in mesh_parts(path)] == [(1.0, 0.0, 0.0, 1.0)]
    mesh_file(Mesh(path))
    (tmp_path / "colours.mtl").write_text("newmtl paint\nKd 0 0 1\n")
    forget()
    assert [part.rgba for part in mesh_parts(path)] == [(0.0, 0.0, 1.0, 1.0)]
    assert not kept.exists()


def test_a_refused_mesh_is_refused_again(kept, tmp_path):
    path = tmp_path / "broken.dae"
    path.write_text(DAE.format(unit="1", up="Z_UP", shift="0 0 0")[:-40])
    messages = []
    for _ in range(2):
        with pytest.raises(MeshError) as error:
            load_mesh(Mesh(path))
        messages.append(str(error.value))
        forget()
    assert messages[0] == messages[1]
    assert not kept.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_not_hashed(kept, tmp_path):
    os.mkfifo(tmp_path / "endless.stl")
    with pytest.raises(MeshError, match="not a regular file"):
        load_mesh(Mesh(tmp_path / "endless.stl"))


def test_files_are_read_again_when_one_of_them_changes(kept, tmp_path):
    names = [tmp_path / "a", tmp_path / "b"]
    runs = []

    def read():
        runs.append(1)
        return b"".join(map(read_bytes, names))

    def kept_text():
        return kept_reading("test", ("key",), read)

    for name in names:
        name.write_bytes(name.name.encode())
    assert (kept_text(), kept_text(), len(runs)) == (b"ab", b"ab", 1)
    names[1].write_bytes(b"changed")
    assert (kept_text(), kept_text(), len(runs)) == (b"achanged", b"achanged", 2)
    names.pop().unlink()
    assert (kept_text(), len(runs)) == (b"a", 3)


def test_a_robot_is_the_same_from_the_cache(kept, monkeypatch):
    library = default_library()
    derivation = parse_request(["arm=px100", "ee=stick"], library)
    first = compose(derivation, library, "robot")
    findings = check(first)
    every_kind = "content hull moments pairs robot solid template triangles"
    assert kinds_of(kept) == {*every_kind.split()}
    forget()
    monkeypatch.setattr(
        mesh_files, "read_mesh_file", lambda path: pytest.fail(f"{path} was parsed")
    )
    monkeypatch.setattr(xacro_compile, "trace", lambda path, *_, **__: pytest.fail(f"{path}"))
    again = compose(derivation, library, "robot")
    for name in ("links", "joints", "frames", "home", "ignore_pairs", "provenance", "fits"):
        assert getattr(again, name) == getattr(first, name)
    assert check(again) == findings


def test_parts_are_not_kept_where_ros_finds_packages(kept, tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    assert tmp_path in default_finder().roots
    part_module.load_part(default_library().manifest("px100"))
    assert "robot" not in kinds_of(kept)


def test_a_part_whose_mesh_is_gone_is_read_again(kept, monkeypatch):
    from morphgen.formats import bundle

    manifest = default_library().manifest("px100")
    part_module.load_part(manifest)
    forget()
    kept_robot = bundle.kept_reading

    def moved(*arguments):
        robot = kept_robot(*arguments)
        shape = Shape(Mesh(Path("/gone.stl")))
        return replace(robot, links=tuple(replace(x, visuals=(shape,)) for x in robot.links))

    monkeypatch.setattr(bundle, "kept_reading", moved)
    part = part_module.load_part(manifest)
    shapes = [shape.geometry for link in part.fragment.links for shape in link.visuals]
    paths = {shape.path for shape in shapes if isinstance(shape, Mesh)}
    assert paths
    assert all(path.is_file() for path in paths)
