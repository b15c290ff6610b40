"""MJCF uploads are read with the files of their own upload only."""

import pytest
import trimesh

from helpers.uploads import URDF, archive
from morphgen.viewer.app.uploads import UploadError, store_upload
from morphgen.viewer.robot_uri import UriError, read_robot_uri

BODY = b'<worldbody><body name="%s"><geom type="box" size="1 1 1"/></body></worldbody>'
MJCF = b'<mujoco model="m">%s</mujoco>'
MESH_ASSET = b'<asset><mesh name="x" file="%s"/></asset>'


def box_stl():
    return trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")


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
        "arm/meshes/x.stl": box_stl(),
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
    assert read_robot_uri(store_upload("hand.zip", archive(files), access), access).root.name == (
        "hand"
    )
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
def test_mjcf_that_names_files_elsewhere_or_code_is_rejected(access, files, why):
    (access.uploads.parent / "q").mkdir()
    (access.uploads.parent / "q" / "package.xml").write_bytes(b"<package/>")
    (access.uploads.parent / "q" / "m.stl").write_bytes(box_stl())
    (access.uploads.parent / "q" / "m.xml").write_bytes(MJCF % BODY % b"secret")
    sent = {path: MJCF % data for path, data in files.items()}
    with pytest.raises(UploadError, match=why) as refused:
        store_upload("a.zip", archive(sent), access)
    assert str(access.uploads) not in str(refused.value)
    assert list(access.uploads.iterdir()) == []


def test_an_included_mjcf_that_is_addressed_reads_no_file_elsewhere(access):
    (access.uploads.parent / "q").mkdir()
    (access.uploads.parent / "q" / "m.stl").write_bytes(box_stl())
    (access.uploads.parent / "q" / "package.xml").write_text("<package><name>q</name></package>")
    part = MJCF % (MESH_ASSET % b"package://q/m.stl" + BODY % b"a")
    sent = {"a.xml": MJCF % BODY % b"a", "b.xml": part, "b.urdf": part, "package.xml": part}
    uri = store_upload("a.zip", archive({**sent, "c.urdf": URDF}), access)
    for name in ("b.xml", "b.urdf", "package.xml"):
        with pytest.raises(UriError, match=r"names 'm\.stl', which is not in the upload"):
            read_robot_uri(uri.replace("c.urdf", name), access)
