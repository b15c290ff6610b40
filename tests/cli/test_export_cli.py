"""``morphgen export``."""

from dataclasses import replace
from pathlib import Path

import pytest

from helpers.robots import arm
from morphgen.api import export
from morphgen.checks.robot_srdf import MATRIX_SAMPLES, robot_srdf_text
from morphgen.cli.command import read_commands
from morphgen.encoding.robot_hash import robot_hash
from morphgen.formats.bundle import EXPORTS, file_findings, write_bundle
from morphgen.formats.files import MANIFEST
from morphgen.formats.fits import FITS
from morphgen.formats.srdf import read_srdf
from morphgen.tasks.scenes.env_specs import load_robot


def test_a_bundle_knows_the_files_that_may_be_written_into_it():
    assert set(EXPORTS) == set(export.FILES)


def test_bundles_get_their_web_page_and_stay_valid(ok, tmp_path):
    folders = [write_bundle(arm(), tmp_path / name, picture=False) for name in ("a", "b")]
    out = ok("export", *folders)
    assert out.split() == [str(folder / "robot.html") for folder in folders]
    for folder in folders:
        assert b"__VISER_EMBED_DATA__" in (folder / "robot.html").read_bytes()
        assert file_findings(folder) == ()


def test_other_robots_are_written_into_the_output_folder(ok, tmp_path):
    out = ok("export", "base=planar", "ee=cube", "--out", tmp_path, "--dark")
    (path,) = tmp_path.iterdir()
    assert out.strip() == str(path)
    assert path.suffix == ".html"
    assert b"darkMode:true" in path.read_bytes()


def files(folder):
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in paths if path.suffix != ".stl"}


@pytest.mark.parametrize(
    ("name", "folder", "expected"),
    [
        ("urdf", "arm-urdf", {"robot.urdf"}),
        ("mjcf", "arm-mjcf", {"robot.xml"}),
        ("sdf", "arm-sdf", {"model.sdf", "model.config"}),
        (
            "ros2",
            "arm_description",
            {
                "package.xml",
                "CMakeLists.txt",
                "urdf/arm.urdf",
                "config/arm.srdf",
                "config/display.rviz",
                "launch/display.launch.py",
            },
        ),
    ],
)
def test_folders_are_written_into_the_output_folder_and_again(
    run, tmp_path, name, folder, expected
):
    bundle = write_bundle(arm(), tmp_path / "bundle", picture=False)
    options = ("--samples", "20") if name == "ros2" else ()
    for _ in range(2):
        code, out, _ = run("export", bundle, "--format", name, "--out", tmp_path, *options)
        assert (code, out.strip()) == (0, str(tmp_path / folder))
    assert files(tmp_path / folder) == {*expected, MANIFEST}
    (tmp_path / folder / "mine").write_text("")
    code, _, err = run("export", bundle, "--format", name, "--out", tmp_path, *options)
    assert code == 2
    assert "mine is not of the export" in err
    assert {path.name for path in tmp_path.iterdir()} == {"bundle", folder}


def test_an_exported_urdf_has_the_fits_and_so_the_goals_of_the_robot(run, tmp_path):
    words = ("arm=xarm6", "ee=none")
    assert run("export", *words, "--format", "urdf", "--out", tmp_path)[0] == 0
    (urdf,) = tmp_path.glob("*/robot.urdf")
    assert (urdf.parent / FITS).is_file()
    composed, exported = load_robot(" ".join(words)), load_robot(urdf)
    assert robot_hash(exported, visuals=False) == robot_hash(composed, visuals=False)
    assert run("import", urdf, "--name", "mine", "--no-picture")[0] == 0
    assert robot_hash(load_robot("robots/mine"), visuals=False) == robot_hash(
        composed, visuals=False
    )
    (urdf.parent / FITS).write_text("[]")
    code, _, err = run("check", urdf)
    assert (code, FITS in err) == (2, True)


def test_files_of_a_bundle_are_written_into_it(run, tmp_path):
    bundle = write_bundle(arm(), tmp_path / "a", picture=False)
    for name, options in (("srdf", ("--samples", "30", "--seed", "2")), ("glb", ())):
        code, out, _ = run("export", bundle, "--format", name, *options)
        assert (code, out.strip()) == (0, str(bundle / f"robot.{name}"))
    assert (bundle / "robot.srdf").read_text() == robot_srdf_text(arm(), samples=30, seed=2)
    assert read_srdf(bundle / "robot.srdf").find("group").get("name") == "arm"
    assert (bundle / "robot.glb").read_bytes()[:4] == b"glTF"
    assert file_findings(bundle) == ()


def test_folders_go_beside_the_bundle_and_into_an_output_folder_that_is_made(ok, refused, tmp_path):
    bundle = write_bundle(arm(), tmp_path / "robots" / "arm", picture=False)
    words = ("--format", "urdf")
    beside = str(bundle.parent / "arm-urdf")
    assert ok("export", bundle, *words).strip() == beside
    assert ok("export", bundle / "robot.urdf", *words).strip() == beside
    assert ok("export", "base=planar", "ee=cube", *words).strip() == "planar-cube-urdf"
    assert ok("export", bundle, *words, "--out", "new/folder").strip() == "new/folder/arm-urdf"
    assert ok("export", bundle, "--format", "glb", "--out", "other").strip() == "other/arm.glb"
    toolless = write_bundle(replace(arm(), frames=()), tmp_path / "robots" / "b", picture=False)
    for name in ("srdf", "ros2"):
        refused("export", toolless, "--format", name, "--out", "none/of/it")
    assert not Path("none").exists()
    err = refused("export", bundle, "--out", bundle / "robot.urdf")
    assert "cannot write to" in err


def test_robots_of_one_name_are_not_written_over_each_other(run, tmp_path):
    folders = [write_bundle(arm(), tmp_path / name, picture=False) for name in ("a", "b")]
    code, _, err = run("export", *folders, "--format", "sdf", "--out", tmp_path)
    assert code == 2
    assert f"b: {tmp_path / 'arm-sdf'} is of another robot of this command already" in err


def test_the_help_has_the_formats_and_the_default_number_of_samples():
    (command,) = [each for each in read_commands() if each.path == "export"]
    assert command.options["--format"]["choices"] == [*export.FILES, *export.FOLDERS]
    assert f"default: {MATRIX_SAMPLES:,}" in command.options["--samples"]["help"]


@pytest.mark.parametrize("name", ["srdf", "ros2", "curobo"])
def test_export_without_a_tool_is_refused_before_the_fit(run, tmp_path, monkeypatch, name):
    monkeypatch.setattr(export, "as_spheres", lambda *given, **_: pytest.fail("fitted"))
    bundle = write_bundle(replace(arm(), frames=()), tmp_path / "a", picture=False)
    words = ("--format", name, "--spheres", "2", "--out", tmp_path)
    code, _, err = run("export", bundle, *words)
    assert code == 2
    assert "robot 'arm' has no frame 'tool'" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
