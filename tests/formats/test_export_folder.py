"""Exported folders: what replaces them, and what never does."""

import json
import re

import pytest

from helpers.commands import tree
from morphgen.errors import FormatError
from morphgen.formats.files import MANIFEST, writing_export


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
    if kind == "folder":
        path.mkdir()
    elif kind == "file":
        path.write_text("")
    else:
        path.symlink_to(export(tmp_path / "other"))
    with pytest.raises(FormatError, match=r"arm-urdf exists and is not an export"):
        export(path)


def test_failed_export_leaves_the_old_one(tmp_path):
    folder = export(tmp_path / "arm-urdf")
    before = tree(tmp_path)
    with pytest.raises(TypeError):
        export(folder, 1)
    assert tree(tmp_path) == before
