"""Resolving mesh and include references to files, without leaving the permitted folders."""

import os
from contextlib import nullcontext
from pathlib import Path

import pytest

from morphgen.errors import FormatError
from morphgen.formats.resolve import (
    PackageFinder,
    default_finder,
    distribution_file,
    is_installed,
    require_allowed_text,
    resolve_uri,
)
from morphgen.formats.xacro.evaluator import RefusedError

NOWHERE = PackageFinder()


def touch(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def failure(uri, base, finder=NOWHERE):
    with pytest.raises(FormatError) as caught:
        resolve_uri(uri, base, finder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def urdf(tmp_path):
    return touch(tmp_path / "ws" / "arm_description" / "urdf" / "arm.urdf")


@pytest.mark.parametrize(
    ("file", "uri"),
    [
        ("arm_description/meshes/a.stl", "package://arm_description/meshes/a.stl"),
        ("arm_description/meshes/a.stl", "package:///arm_description/meshes/a.stl"),
        ("arm_description/meshes/a.stl", "model://arm_description/meshes/a.stl"),
        ("arm_description/a.stl", "package://other_name/a.stl"),  # by its package.xml
        ("hand_description/a.stl", "package://hand_description/a.stl"),  # beside
        ("arm_description/a.stl", "package://arm_support/a.stl"),  # a copy without ROS's suffix
        ("root/a.stl", "package://root/a.stl"),
        ("root/one/a.stl", "package://one/a.stl"),
        ("root/repository/src/a.stl", "package://two/a.stl"),  # two levels down
        ("arm_description/urdf/my mesh.stl", "my%20mesh.stl"),
        ("arm_description/urdf/100%20.stl", "100%20.stl"),
        ("arm_description/urdf/my mesh.stl", r"..\urdf\my mesh.stl"),
    ],
)
def test_files_are_found_by_package_and_spelling(file, uri, tmp_path):
    folder = "arm" if "arm_support" in uri else "arm_description"
    urdf = touch(tmp_path / "ws" / folder / "urdf" / "arm.urdf")
    mesh = touch(tmp_path / "ws" / file.replace("arm_description", folder))
    manifests = {"other_name": urdf.parents[1], "two": tmp_path / "ws" / "root/repository/src"}
    for name, path in manifests.items():
        if name in uri:
            text = f"<package format='3'>\n <name> {name} </name></package>"
            touch(path / "package.xml", text)
    assert resolve_uri(uri, urdf, PackageFinder((tmp_path / "ws" / "root",))) == mesh


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("package://lost/a.stl", "package 'lost' not found: looked "),
        *((f"package://{name}/id", "not a package name") for name in (".ssh", "..", "a b", "%2e")),
        ("package://etc/hostname", "not found"),  # the root of the file system is not searched
        *((uri, repr(uri)) for uri in ("", " ", "http://host/a.stl", "package://", "C:/a.stl")),
        ("../urdf", "does not exist"),
        ("base.stl", "did you mean 'Base.STL'?"),
        ("../../secret.stl", "leaves"),
        ("%2e%2e/%2e%2e/secret.stl", "leaves"),
        ("package://arm_description/../secret.stl", "leaves"),
    ],
)
def test_other_references_are_refused(uri, reason, urdf):
    touch(urdf.parents[2] / "secret.stl")
    touch(urdf.parent / "Base.STL")
    message = failure(uri, urdf, PackageFinder((urdf.parents[2] / "root",)))
    assert reason in message
    assert message.startswith(f"{urdf}: ")


def test_a_plain_folder_above_the_description_is_no_package(tmp_path):
    """A stranger's file in a download folder must not read from the user's home."""
    home = tmp_path / "alice"
    urdf = touch(home / "Downloads" / "robot" / "robot.urdf")
    touch(home / "secret" / "part.stl")
    for uri in ("package://alice/secret/part.stl", "package://secret/part.stl"):
        assert "not found" in failure(uri, urdf)
    beside = touch(home / "Downloads" / "hand" / "part.stl")
    assert resolve_uri("package://hand/part.stl", urdf, NOWHERE) == beside
    touch(home / "secret" / "package.xml", "<package><name>other</name></package>")
    assert resolve_uri("package://secret/part.stl", urdf, NOWHERE).is_file()


def test_paths_start_at_the_folder_of_the_description_and_stay_near(urdf, tmp_path, monkeypatch):
    own_file = touch(urdf.parent / "a.stl")
    beside = touch(urdf.parent.parent / "meshes" / "b.stl")
    packaged = touch(tmp_path / "opt" / "hand_description" / "a.stl")
    private = touch(tmp_path / "elsewhere" / "a.stl")
    monkeypatch.chdir(tmp_path / "elsewhere")
    for uri in ("a.stl", "file://a.stl", str(own_file), own_file.as_uri()):
        assert resolve_uri(uri, urdf, NOWHERE) == own_file
    assert resolve_uri("../meshes/b.stl", urdf, NOWHERE) == beside
    assert resolve_uri(packaged.as_uri(), urdf, NOWHERE) == packaged
    assert "leaves" in failure(private.as_uri(), urdf)
    assert resolve_uri(str(private), urdf, PackageFinder((private.parent,))) == private


def test_ros_environment_is_searched_after_the_given_root(tmp_path, urdf, monkeypatch):
    classic = touch(tmp_path / "classic" / "one" / "a.stl")
    ament = touch(tmp_path / "prefix" / "share" / "two" / "a.stl")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "classic"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"))
    assert resolve_uri("package://one/a.stl", urdf, default_finder()) == classic
    assert resolve_uri("package://two/a.stl", urdf, default_finder()) == ament
    mine = touch(tmp_path / "mine" / "one" / "a.stl")
    finder = default_finder(root=tmp_path / "mine")
    assert resolve_uri("package://one/a.stl", urdf, finder) == mine


def test_only_files_that_lie_in_an_installed_package_are_installed(tmp_path):
    file = distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robot.urdf.xacro")
    (tmp_path / "link.xacro").symlink_to(file)
    mine = touch(tmp_path / "mine.xacro")
    through = file.parent / os.path.relpath(mine.resolve(), file.parent.resolve())
    assert through.is_file()
    found = [is_installed(each) for each in (file, tmp_path / "link.xacro", mine, through)]
    assert found == [True, True, False, False]


def test_distribution_files_are_found_and_missing_ones_are_errors(monkeypatch):
    path = distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robot.urdf.xacro")
    assert path.is_absolute()
    assert path.is_file()
    with pytest.raises(FormatError, match=r"did you mean 'ur5_robot.urdf.xacro'"):
        distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robott.urdf.xacro")
    for relative in ("../x", "/etc/hostname", "rtbdata/../../x"):
        with pytest.raises(FormatError, match="not a path below"):
            distribution_file("rtb-data", relative)
    monkeypatch.setattr("sys.path", [])
    with pytest.raises(FormatError, match=r"pip install rtb-data==1\.1\.0"):
        distribution_file("rtb-data", "rtbdata/x.urdf")


def test_a_symbolic_link_cannot_leave_the_tree(tmp_path, urdf):
    private = touch(tmp_path / "private" / "a.stl")
    inside = touch(urdf.parent.parent / "meshes" / "b.stl")
    (urdf.parent / "out.stl").symlink_to(private)
    (urdf.parent / "in.stl").symlink_to(inside)
    (urdf.parent / "folder").symlink_to(private.parent)
    for uri in ("out.stl", "folder/a.stl", "package://arm_description/urdf/out.stl"):
        assert "is a symbolic link that leaves" in failure(uri, urdf)
    assert resolve_uri("in.stl", urdf, NOWHERE) == urdf.parent / "in.stl"
    assert resolve_uri("out.stl", urdf, default_finder(root=private.parent)).name == "out.stl"


def test_links_between_packages_are_followed(tmp_path, urdf):
    """``colcon build --symlink-install`` makes such."""
    source = touch(tmp_path / "src" / "arm" / "meshes" / "a.stl")
    touch(tmp_path / "src" / "arm" / "package.xml", "<package><name>arm</name></package>")
    (urdf.parent / "a.stl").symlink_to(source)
    assert resolve_uri("a.stl", urdf, NOWHERE) == urdf.parent / "a.stl"


def test_a_symlinked_description_may_reference_files_beside_its_target(tmp_path):
    """Download caches store every file as a link into a folder of blobs."""
    store, shown = tmp_path / "store" / "blobs", tmp_path / "shown" / "snapshot"
    shown.mkdir(parents=True)
    for name in ("robot.urdf", "a.stl"):
        touch(store / f"{name}-blob")
        (shown / name).symlink_to(store / f"{name}-blob")
    assert resolve_uri("a.stl", shown / "robot.urdf", NOWHERE) == shown / "a.stl"


def test_a_root_extends_the_permitted_tree(tmp_path):
    urdf = touch(tmp_path / "data" / "robots" / "x" / "x.urdf")
    mesh = touch(tmp_path / "data" / "meshes" / "a.stl")
    packaged = touch(tmp_path / "data" / "hand" / "b.stl")
    touch(tmp_path / "c.stl")
    assert "or name the folder" in failure("../../meshes/a.stl", urdf)
    finder = default_finder(root=tmp_path / "data")
    assert resolve_uri("../../meshes/a.stl", urdf, finder) == mesh
    assert resolve_uri("package://hand/b.stl", urdf, finder) == packaged
    assert "leaves" in failure("../../../c.stl", urdf, finder)
    assert resolve_uri("meshes/a.stl", urdf, finder) == mesh, "a name from the root, too"
    near = touch(urdf.parent / "meshes" / "a.stl")
    assert resolve_uri("meshes/a.stl", urdf, finder) == near, "the own folder comes first"
    with pytest.raises(FormatError, match="no such folder"):
        default_finder(root=tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("file", "finder", "is_allowed"),
    [
        ("downloads/config/a.yaml", {}, True),
        ("ws/arm/a.yaml", {}, True),
        ("secret.yaml", {}, False),
        ("hand_description/a.yaml", {}, False),
        ("secret.yaml", {"root": Path()}, True),
    ],
)
def test_text_files_are_limited_to_own_folder_packages_and_roots(
    file, finder, is_allowed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    touch(tmp_path / "ws" / "arm" / "package.xml", "<package><name>arm</name></package>")
    path, finder = touch(tmp_path / file), default_finder(**finder)
    for place in ("downloads", "downloads/urdf"):
        origin = touch(tmp_path / place / "x.xacro")
        with nullcontext() if is_allowed else pytest.raises(RefusedError):
            require_allowed_text(path, finder, origin, origin)
