"""Robot bundles: atomic and reproducible writing, reading, and detection of changed files."""

import json
import stat

import numpy as np
import pytest
import trimesh
from PIL import Image

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.bundle import file_findings, read_bundle, write_bundle
from morphgen.model.geometry import Mesh, Shape
from morphgen.model.robot import Link, Robot


def files(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def test_a_bundle_has_urdf_mjcf_card_and_a_picture_that_is_not_blank(tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm")
    assert set(files(folder)) == {"robot.urdf", "robot.xml", "card.json", "preview.png"}
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
