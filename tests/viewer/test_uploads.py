"""Uploads are kept only if they are valid robots that stay inside their folder."""

import html
import io
import stat
import tempfile
import warnings
import zipfile
from dataclasses import replace

import pytest
import trimesh
from PIL import Image

from helpers.pages import URDF, archive
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.model.mesh import mesh_parts
from morphgen.viewer.app import uploads
from morphgen.viewer.app.uploads import UploadError, store_upload
from morphgen.viewer.robot_files import bundle_files, thumbnail_of_picture, zip_files
from morphgen.viewer.robot_uri import UriError, read_robot_uri

MESHED = (
    b'<robot name="r"><link name="a"><visual><geometry><mesh filename="%s"/>'
    b"</geometry></visual></link></robot>"
)
BOX = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")


def test_urdf_upload_is_kept_and_read(access):
    uri = store_upload("some.urdf", URDF, access)
    assert uri.startswith("upload:")
    assert read_robot_uri(uri, access).name == "r"


def test_zipped_bundle_survives_a_round_trip(access, tmp_path):
    write_bundle(arm(), tmp_path / "arm", picture=False)
    files = bundle_files("arm", access)
    assert {"robot.urdf", "robot.xml", "card.json"} <= files.keys()
    sent = zip_files("arm", files)
    assert sent == zip_files("arm", dict(reversed(files.items())))
    assert read_robot_uri(store_upload("arm.zip", sent, access), access).home == arm().home


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.urdf", b"no xml", "a.urdf:1:1"),
        ("a.urdf", b"<sdf/>", "its root is <sdf>; expected <robot> of a URDF, or <mujoco>"),
        ("a.xml", b"<mujocoinclude/>", "holds no .urdf and no MJCF"),
        ("a.xml", b"<mujoco", "a.xml:1:"),
        ("a.xacro", URDF, "expected a .urdf, an MJCF as .xml, or a .zip"),
        ("a.zip", archive({"b.txt": b""}), "holds no .urdf"),
        ("a.zip", archive({"b.xml": b"<mujoco", ".c.xml": b"<"}), "b.xml:1:"),
        ("a.urdf", MESHED % b"../secret.stl", "leads out of its folder"),
        ("a.urdf", MESHED % b"file:///etc/passwd", "only relative paths and package://"),
        ("a.urdf", MESHED % b"/etc/passwd", "leads out of its folder"),
        ("a.urdf", MESHED % b"package://x/../../y.stl", "leads out of its folder"),
        ("a.zip", archive({"deep/a.urdf": MESHED % b"../../x.stl"}), "leads out of its folder"),
        ("a.urdf", b'<!DOCTYPE r [<!ENTITY x "y">]><robot name="r"/>', "DOCTYPE"),
    ],
)
def test_an_invalid_or_unsafe_upload_is_rejected(access, name, content, why):
    with pytest.raises(MorphgenError, match=why):
        store_upload(name, content, access)
    assert list(access.uploads.iterdir()) == []


@pytest.mark.parametrize("how", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_damaged_zip_is_rejected(access, how):
    whole = archive({"a.urdf": 50 * URDF}, how)
    at = whole.index(b"a.urdf") + len(b"a.urdf")
    with pytest.raises(UploadError, match="not a readable zip"):
        store_upload("a.zip", whole[:at] + b"\xff" * 10 + whole[at + 10 :], access)
    assert list(access.uploads.iterdir()) == []


XACRO = b"""<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="a"/>
<xacro:property name="x" value="${python.vars(python.type(xacro.load_yaml))}"/></robot>"""


def linked(name, target):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as made:
        made.writestr("a.urdf", URDF)
        entry = zipfile.ZipInfo(name)
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        made.writestr(entry, target)
    return content.getvalue()


def twice(*names):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as made, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in names:
            made.writestr(name, URDF)
    return content.getvalue()


def patched(whole, old, new):
    assert old in whole
    return whole.replace(old, new)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (twice("x", "x/a.urdf"), "in a folder that is a file"),
        (twice("a.urdf", "a.urdf"), "is there twice"),
        (twice("a.urdf", "./A.URDF"), "is there twice"),
        (archive({"a" * 300 + ".urdf": URDF}), "longer than 100"),
        (archive({"é" * 80 + ".urdf": URDF}), "longer than 100"),
        (archive({"d/" * 30 + "a.urdf": URDF}), "more than 20 folders"),
        (archive({"a\n.urdf": URDF}), "not a valid file name"),
        (archive({"C:/a.urdf": URDF}), "leads out"),
        (archive({"b/../a.urdf": URDF}), "leads out"),
        (archive({"../b.urdf": URDF}), "leads out"),
        (archive({"/b.urdf": URDF}), "leads out"),
        (archive({"c\\..\\..\\b.urdf": URDF}), "leads out"),
        (patched(archive({"aXb.urdf": URDF}), b"aXb", b"a\0b"), "not a valid file|not a readable"),
        (linked("meshes", "/etc"), "is a link"),
        (linked("meshes/x.stl", "../../../etc/passwd"), "is a link"),
        (archive({f"{i}.stl": b"" for i in range(2001)}), "more than 2000 files"),
        (archive({"a.urdf": URDF}, zipfile.ZIP_LZMA), "method other than deflate"),
        (archive({"a.urdf": URDF}, zipfile.ZIP_BZIP2), "method other than deflate"),
        (archive({"a.urdf": URDF})[:-30], "not a readable zip"),
        (b"", "not a readable zip"),
        (archive({"a.urdf.xacro": XACRO}), "no xacro of an upload is expanded"),
        (archive({"a.xacro": XACRO, "b.yaml": b"x: 1"}), "no xacro of an upload is expanded"),
        (archive({"a.urdf": XACRO}), "a.urdf:2: is a xacro; none of an upload is expanded"),
        (archive({"a.urdf": URDF, "robot.xml": b'<mujoco><include file="/etc/passwd"/></mujoco>'}),
         "leads out"),
        (archive({"a.urdf": URDF, "m.xml": b'<mujoco><compiler meshdir="../.."/></mujoco>'}),
         "leads out"),
        (archive({"a.urdf": URDF, "m.xml": b'<mujoco><asset><mesh file="/x"/></asset></mujoco>'}),
         "leads out"),
        (archive({"robot.urdf": URDF, "card.json": b"["}), "card.json: invalid JSON"),
        (archive({"robot.urdf": URDF, "card.json": b"[" * 100_000}), "card.json: is nested deeper"),
        (archive({"robot.urdf": URDF, "card.json": b'{"hashes": {"/etc/passwd": "0"}}'}),
         "leads out"),
        (archive({"robot.urdf": URDF, "card.json": b'{"hashes": {"../x": "0"}}'}), "leads out"),
        (archive({"a.urdf": MESHED % b"x.stl"}), "a.urdf:1: mesh 'x.stl' is not in the upload"),
        (archive({"a.urdf": MESHED % b"..%2f..%2fx.stl"}), "is not in the upload"),
        (archive({"a.urdf": MESHED % b"package://rtb_data/x.stl"}), "is not in the upload"),
        (archive({"a.urdf": MESHED % b""}), "is not in the upload"),
        (archive({"a.urdf": URDF, "b.xml": b"<a>" + b"<a/>" * 2**21 + b"</a>"}),
         "descriptions have more than 8 MB together"),
    ],
    ids=lambda each: each[:40] if isinstance(each, str) else "",
)  # fmt: skip
def test_unsafe_zip_is_rejected_with_a_message(access, content, why):
    with pytest.raises(UploadError, match=why) as refused:
        store_upload("a.zip", content, access)
    assert str(access.uploads) not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert list(access.uploads.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["a" * 300 + ".urdf", "\0.urdf", "a b.urdf", "a\n.urdf", "", "é.urdf"]
)
def test_an_invalid_file_name_is_rejected(access, name):
    with pytest.raises(UploadError, match="invalid file name"):
        store_upload(name, URDF, access)


def test_meshes_are_not_read_from_other_uploads_or_parent_folders(access, elsewhere):
    files = {"p/m.stl": BOX, "a.urdf": MESHED % b"package://p/m.stl"}
    first = store_upload("a.zip", archive(files), access)
    assert read_robot_uri(first, access).links[0].visuals
    token = first.removeprefix("upload:").partition("/")[0]
    for uri in (f"package://{token}/p/m.stl", "package://q/m.stl", f"..%2f{token}/p/m.stl"):
        with pytest.raises(UploadError, match="is not in the upload"):
            store_upload("a.urdf", MESHED % uri.encode(), access)


def test_only_descriptions_meshes_and_cards_are_kept(access):
    files = {"p/urdf/a.urdf": MESHED % b"package://p/meshes/m.STL", "p/meshes/m.STL": BOX}
    files |= {"p/package.xml": b"<package><name>p</name></package>", "p/robot.xml": b"<mujoco/>"}
    files |= {"p/other.xml": b"<x/>", "p/broken.xml": b"<x", "p/load.yaml": b"x: 1"}
    files |= {"p/urdf/a.xacro": XACRO, "p/macros.urdf.xacro": XACRO, "p/run.py": b"print()"}
    files |= {"p/derivation": b"arm=ur5", "p/.git/config": b"", "__MACOSX/p/._a.urdf": b"\0"}
    uri = store_upload("p.zip", archive(files), access)
    assert read_robot_uri(uri, access).name == "r"
    (folder,) = access.uploads.iterdir()
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert kept == {"p/urdf/a.urdf", "p/meshes/m.STL", "p/package.xml", "p/robot.xml"}


def test_xacro_uploads_are_not_read(access):
    folder = access.uploads / "1"
    folder.mkdir()
    (folder / "a.xacro").write_bytes(XACRO)
    with pytest.raises(UriError, match="only a URDF, an MJCF or a bundle is read from an upload"):
        read_robot_uri("upload:1/a.xacro", access)


def test_the_number_of_uploads_is_limited(access, monkeypatch):
    monkeypatch.setattr(uploads, "MAX_UPLOADS", 2)
    store_upload("a.urdf", URDF, access)
    store_upload("a.urdf", URDF, access)
    with pytest.raises(UploadError, match="2 uploads are kept already"):
        store_upload("a.urdf", URDF, access)


def test_full_disk_leaves_no_files(access, monkeypatch):
    def full(self, data):
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(UploadError, match="cannot be kept: No space left on device") as refused:
        store_upload("a.urdf", URDF, access)
    assert str(access.uploads) not in str(refused.value)
    assert list(access.uploads.iterdir()) == []


@pytest.mark.parametrize(("as_zip", "pairs"), [(False, ()), (True, (("upper", "right"),))])
def test_uploaded_bundle_keeps_tool_and_home(access, tmp_path, as_zip, pairs):
    robot = replace(arm(), ignore_pairs=(("upper", "right"),), provenance={"source": "x.urdf"})
    write_bundle(robot, tmp_path / "arm", picture=False)
    files = bundle_files("arm", access)
    name, content = (
        ("arm.zip", zip_files("arm", files)) if as_zip else ("robot.urdf", files["robot.urdf"])
    )
    back = read_robot_uri(store_upload(name, content, access), access)
    assert (back.home, back.ignore_pairs) == (robot.home, pairs)
    assert robot_hash(back) == robot_hash(robot)
    assert bool(back.provenance) == as_zip


def test_uploads_come_through_a_websocket_and_are_read(shared_viewer, tmp_path):
    write_bundle(arm(), tmp_path / "arm", picture=False)
    content = zip_files("arm", {p.name: p.read_bytes() for p in (tmp_path / "arm").iterdir()})
    with PlainClient(shared_viewer.port) as client:
        client.upload("arm.zip", content)
        query = client.sent_to()
    with PlainClient(shared_viewer.port, query) as client:
        client.control("Slider", "shoulder")
        client.until(lambda: "see it" in client.text)


def test_upload_that_differs_from_its_announcement_is_dropped(viewer, quiet):
    on = viewer()
    with PlainClient(on.port) as client:
        client.upload("../../a" + "b" * 10_000 + ".urdf", URDF)
        client.shows("invalid file name")
        client.upload("a.urdf", b" " * 2000, size=1000)
        client.shows("longer than its announced size")
        client.upload("a.urdf", b"", size=200 * 2**20, parts=1)
        client.shows("200 MB; at most 100 MB are accepted")
        client.upload("a.urdf", b"", size=-1, parts=0)
        client.shows("-1 bytes in 0 parts")
        client.upload("a.urdf", b"", size=10, parts=10**9)
        client.shows("10 bytes in 1000000000 parts")
        client.upload("a.urdf", URDF)
        assert client.sent_to().startswith("?robot=upload:")
        assert len(list(on.files.uploads.iterdir())) == 1
        ((_, session),) = on.sessions.items()
        assert session.client.gui._current_file_upload_states == {}


def test_errors_show_no_temporary_path(shared_viewer, capfd):
    broken = URDF.replace(b'<link name="a"/>', b'<link name="a"/><link name="b"/>')
    with PlainClient(shared_viewer.port) as client:
        client.upload("a.urdf", broken)
        query = client.sent_to()
    with PlainClient(shared_viewer.port, query) as client:
        client.shows("upload:")
        client.shows("a.urdf")
        client.shows("tag error")
        assert tempfile.gettempdir() not in client.text


def test_names_in_an_upload_are_escaped_on_the_page(shared_viewer):
    name = "&lt;img src=x onerror=alert()&gt;"
    text = f"""<robot name="{name}"><link name="{name}"><visual name="{name}"><geometry>
    <sphere radius="0.1"/></geometry></visual></link><link name="tool"/><joint name="{name}"
    type="revolute"><parent link="{name}"/><child link="tool"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    with PlainClient(shared_viewer.port) as client:
        client.upload("a.urdf", text.encode())
        query = client.sent_to()
    with PlainClient(shared_viewer.port, query) as client:
        client.change(client.control("Dropdown", "Link"), html.unescape(name))
        client.until(lambda: "inertial-missing" in client.text or "no findings" in client.text
                     or "tag warning" in client.text)  # fmt: skip
        shown = [m["props"]["content"] for m in client.messages if m["type"] == "GuiHtmlMessage"]
        shown += [m["updates"].get("content", "") for m in client.messages if "updates" in m]
        assert name in "".join(shown)
        assert "<img src=x" not in "".join(shown)


def test_a_picture_of_too_many_pixels_is_none(tmp_path):
    Image.new("1", (6000, 6000)).save(tmp_path / "preview.png")
    assert thumbnail_of_picture(tmp_path / "preview.png") == ""
    Image.new("RGB", (400, 300)).save(tmp_path / "preview.png")
    assert thumbnail_of_picture(tmp_path / "preview.png").startswith("data:image/jpeg;base64,")


def test_suffixes_of_files_that_a_mesh_names_have_any_case(access):
    library, texture, mesh = "part.Mtl", "part.Png", "part.Obj"
    picture = io.BytesIO()
    Image.new("RGB", (2, 2), (255, 0, 0)).save(picture, "png")
    obj = (
        f"mtllib {library}\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\n"
        "f 1/1 3/1 2/1\nf 1/1 2/1 4/1\nf 1/1 4/1 3/1\nf 2/1 3/1 4/1\n"
    )
    files = {
        "a.urdf": MESHED % mesh.encode(),
        mesh: obj.encode(),
        library: f"newmtl red\nmap_Kd {texture}\n".encode(),
        texture: picture.getvalue(),
    }
    robot = read_robot_uri(store_upload("a.zip", archive(files), access), access)
    (part,) = mesh_parts(robot.root.visuals[0].geometry.path)
    assert part.rgba == (1, 0, 0, 1)


SPHERE = '<geom size="1"/>'


@pytest.mark.parametrize(
    "text",
    [
        f'<mujoco><worldbody>{SPHERE}<include xmlns="x" file="more.xml"/></worldbody></mujoco>',
        f'<mujoco><worldbody><replicate xmlns="x" count="3000000">{SPHERE}</replicate></worldbody>'
        "</mujoco>",
        '<robot xmlns="x" name="r"><link name="a"/></robot>',
    ],
    ids=["include", "replicate", "urdf"],
)
def test_a_namespace_hides_nothing_in_an_upload(access, text):
    with pytest.raises(MorphgenError, match=r"namespace|x}robot"):
        read_robot_uri(store_upload("a.xml", text.encode(), access), access)
    assert list(access.uploads.iterdir()) == []


BODY = b'<worldbody><body name="%s"><geom type="box" size="1 1 1"/></body></worldbody>'
MJCF = b'<mujoco model="m">%s</mujoco>'
MESH_ASSET = b'<asset><mesh name="x" file="%s"/></asset>'


@pytest.fixture
def elsewhere(access):
    """A package beside the folder of uploads."""
    files = {"package.xml": b"<package><name>q</name></package>", "m.stl": BOX}
    files["m.xml"] = MJCF % BODY % b"secret"
    (access.uploads.parent / "q").mkdir()
    for name, content in files.items():
        (access.uploads.parent / "q" / name).write_bytes(content)


def test_mjcf_upload_is_kept_and_read(access):
    for name, content in (
        ("some.xml", MJCF % BODY % b"a"),
        ("some.urdf", MJCF % BODY % b"a"),  # the root element is the format
        ("some.zip", archive({"p/some.xml": MJCF % BODY % b"a", "p/package.xml": b"<package/>"})),
    ):
        assert read_robot_uri(store_upload(name, content, access), access).root.name == "a"
    assert read_robot_uri(store_upload("some.xml", URDF, access), access).root.name == "a"


def test_a_bundle_whose_urdf_is_an_mjcf_is_refused(access):
    files = {"p/robot.urdf": MJCF % BODY % b"a", "p/card.json": b"{}"}
    with pytest.raises(UploadError, match=r"^p/robot\.urdf: is the robot\.urdf of a bundle, but"):
        store_upload("card.zip", archive(files), access)


def test_mjcf_of_a_zip_is_read_with_its_meshes_and_includes(access):
    worldbody = b"""<worldbody><body name="b"><geom type="mesh" mesh="x"/></body></worldbody>
    <compiler meshdir="../meshes/"/>"""
    files = {
        "arm/mjcf/scene.xml": MJCF % b'<include file="parts/assets.xml"/>',
        "arm/mjcf/parts/assets.xml": b"<mujocoinclude>%s%s</mujocoinclude>"
        % (MESH_ASSET % b"x.stl", worldbody),
        "arm/meshes/x.stl": BOX,
    }
    robot = read_robot_uri(store_upload("a.zip", archive(files), access), access)
    assert robot.root.name == "b"
    assert robot.root.collisions[0].geometry.path.name == "x.stl"


def test_the_mjcf_of_a_zip_is_the_one_with_its_name_or_the_only_one_that_none_includes(access):
    files = {
        "arm/robot.xml": MJCF % (BODY % b"robot" + b'<include file="arm/more.xml"/>'),
        "arm/more.xml": MJCF % b"",
        "hand.xml": MJCF % BODY % b"hand",
        "scene.xml": MJCF % b'<include file="arm/robot.xml"/>',
    }
    uri = store_upload("hand.zip", archive(files), access)
    assert read_robot_uri(uri, access).root.name == "hand"
    with pytest.raises(UploadError, match=r"several MJCFs: 'hand\.xml', 'scene\.xml'; send"):
        store_upload("a.zip", archive(files), access)
    del files["hand.xml"]
    uri = store_upload("a.zip", archive(files), access)
    assert uri.endswith("/scene.xml")
    assert read_robot_uri(uri, access).root.name == "robot"


@pytest.mark.parametrize(
    ("files", "why"),
    [
        ({"a.xml": MESH_ASSET % b"x.stl"}, "a.xml: mesh 'x': not in the upload: send a zip"),
        ({"a.xml": MESH_ASSET % b"../x.stl"}, "leads out of its folder"),
        ({"a.xml": MESH_ASSET % b"package://q/m.stl"}, "names 'm.stl', which is not in the upload"),
        ({"a.xml": MESH_ASSET % b"..%2f..%2fq/m.stl"}, "mesh 'x': not in the upload"),
        ({"a.xml": b'<include file="package://q/m.xml"/>'}, "names 'm.xml', which is not in"),
        ({"a.xml": b'<include file="b.xml"/>'}, "b.xml' does not exist"),
        ({"a.xml": b'<include file="/etc/passwd"/>'}, "leads out of its folder"),
        ({"d/e/a.xml": b'<compiler meshdir="../.."/>' + MESH_ASSET % b"../../q/m.stl"},
         "mesh 'x': not in the upload"),
        ({"a.xml": b'<extension><plugin plugin="p"/></extension>'}, "plugins are code"),
    ],
)  # fmt: skip
def test_mjcf_that_names_files_elsewhere_or_code_is_rejected(access, elsewhere, files, why):
    sent = {path: MJCF % data for path, data in files.items()}
    with pytest.raises(UploadError, match=why) as refused:
        store_upload("a.zip", archive(sent), access)
    assert str(access.uploads) not in str(refused.value)
    assert list(access.uploads.iterdir()) == []


def test_an_included_mjcf_that_is_addressed_reads_no_file_elsewhere(access, elsewhere):
    part = MJCF % (MESH_ASSET % b"package://q/m.stl" + BODY % b"a")
    sent = {"a.xml": MJCF % BODY % b"a", "b.xml": part, "b.urdf": part, "package.xml": part}
    uri = store_upload("a.zip", archive({**sent, "c.urdf": URDF}), access)
    for name in ("b.xml", "b.urdf", "package.xml"):
        with pytest.raises(UriError, match=r"names 'm\.stl', which is not in the upload"):
            read_robot_uri(uri.replace("c.urdf", name), access)
