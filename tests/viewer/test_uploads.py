"""Uploads are kept only if they are robots that keep to their folder."""

import io
import zipfile

import pytest

from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.grammar.library import default_library
from morphgen.viewer import uploads
from morphgen.viewer.downloads import bundle_files, zipped
from morphgen.viewer.places import Places, read_place
from morphgen.viewer.uploads import UploadError, keep
from robots import arm

URDF = b'<robot name="r"><link name="a"/></robot>'
MESHED = (
    b'<robot name="r"><link name="a"><visual><geometry><mesh filename="%s"/>'
    b"</geometry></visual></link></robot>"
)


@pytest.fixture
def places(tmp_path):
    folder = tmp_path / "uploads"
    folder.mkdir()
    return Places(default_library().folders, (tmp_path.resolve(),), folder.resolve())


def archive(files, how=zipfile.ZIP_STORED):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", how) as made:
        for name, data in files.items():
            made.writestr(name, data)
    return content.getvalue()


def test_a_urdf_is_kept_and_read(places):
    place = keep("some.urdf", URDF, places)
    assert place.startswith("upload:")
    assert read_place(place, places).name == "r"


def test_a_zipped_bundle_comes_back_as_it_left(places, tmp_path):
    write_bundle(arm(), tmp_path / "arm", picture=False)
    files = bundle_files("arm", places)
    assert {"robot.urdf", "robot.xml", "card.json"} <= files.keys()
    sent = zipped("arm", files)
    assert sent == zipped("arm", dict(reversed(files.items())))
    assert read_place(keep("arm.zip", sent, places), places).home == arm().home


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.urdf", b"no xml", "a.urdf:1:1"),
        ("a.urdf", b"<mujoco/>", "its root is <mujoco>"),
        ("a.xacro", URDF, "expected a .urdf, or a .zip"),
        ("a.zip", b"PK nothing", "no readable zip"),
        ("..", URDF, "no file name"),
        ("a.zip", archive({"b.txt": b""}), "holds no .urdf"),
        ("a.zip", archive({"../b.urdf": URDF}), "leads out of its folder"),
        ("a.zip", archive({"/b.urdf": URDF}), "leads out of its folder"),
        ("a.zip", archive({"c\\..\\..\\b.urdf": URDF}), "leads out of its folder"),
        ("a.urdf", MESHED % b"../secret.stl", "leads out of its folder"),
        ("a.urdf", MESHED % b"file:///etc/passwd", "only relative paths and package://"),
        ("a.urdf", MESHED % b"/etc/passwd", "leads out of its folder"),
        ("a.urdf", MESHED % b"package://x/../../y.stl", "leads out of its folder"),
        ("a.zip", archive({"deep/a.urdf": MESHED % b"../../x.stl"}), "leads out of its folder"),
        ("a.urdf", b'<!DOCTYPE r [<!ENTITY x "y">]><robot name="r"/>', "DOCTYPE"),
    ],
)
def test_what_is_no_robot_or_climbs_out_is_refused(places, name, content, why):
    with pytest.raises(MorphgenError, match=why):
        keep(name, content, places)
    assert list(places.uploads.iterdir()) == []


@pytest.mark.parametrize("how", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_damaged_zip_is_refused(places, how):
    whole = archive({"a.urdf": 50 * URDF}, how)
    at = whole.index(b"a.urdf") + len(b"a.urdf")
    with pytest.raises(UploadError, match="no readable zip"):
        keep("a.zip", whole[:at] + b"\xff" * 10 + whole[at + 10 :], places)
    assert list(places.uploads.iterdir()) == []


def test_large_uploads_are_refused(places, monkeypatch):
    monkeypatch.setattr(uploads, "LARGEST", 1000)
    with pytest.raises(UploadError, match="at most"):
        keep("a.urdf", b" " * 1001, places)
    bomb = archive({"a.urdf": URDF, "b.bin": b"0" * 5000})
    with pytest.raises(UploadError, match=r"at most|unpacks to more"):
        keep("a.zip", bomb, places)
