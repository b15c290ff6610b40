"""Output and files of the basic commands; their options are those of the functions."""

import inspect
import json
import os
import re
import sys
from dataclasses import replace
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest

import morphgen
from helpers.commands import start, tree
from helpers.faulty_robots import valid_robot, with_joint
from helpers.mjcf import TWO_JOINTS, write
from helpers.parts import PINCER
from helpers.robots import arm
from morphgen.api import export
from morphgen.checks.readers import LOADERS
from morphgen.checks.srdf import read_srdf, robot_srdf_text
from morphgen.cli import main
from morphgen.cli.command import read_commands
from morphgen.encoding.robot_hash import robot_hash
from morphgen.formats.bundle import EXPORTS, file_findings, read_bundle, write_bundle
from morphgen.formats.files import MANIFEST
from morphgen.formats.fits import FITS
from morphgen.formats.urdf.write import urdf_text
from morphgen.rl.config import SWITCHES
from morphgen.tasks.registry import Registry
from morphgen.tasks.scenes.env_specs import load_robot


def test_compose_writes_a_bundle_and_prints_its_summary(ok, tmp_path):
    out = ok("compose", "base=gantry", "ee=plane", "--out", "robots")
    first, *files = out.splitlines()
    assert first.startswith("robots/gantry-plane: 7 links, 5 DoF, ")
    names = ["card.json", "preview.png", "robot.urdf", "robot.xml"]
    assert [name.strip() for name in files] == names
    assert [path.name for path in (tmp_path / "robots").iterdir()] == ["gantry-plane"]
    data = json.loads(ok("compose", "base=gantry", "ee=plane", "--no-picture", "--json"))
    assert data["folder"] == "robots/gantry-plane"
    assert data["card"] == json.loads(Path("robots/gantry-plane/card.json").read_text())


def test_list_prints_one_row_per_part(ok):
    out = ok("list", "bases")
    rows = [line.split() for line in out.splitlines()[2:]]
    assert {"fixed", "gantry", "pedestal", "planar"} <= {row[0] for row in rows}
    assert {row[1] for row in rows} == {"base"}
    out = ok("list", "bases", "--json")
    assert {row["name"]: row["dof"] for row in json.loads(out)}["gantry"] == 5


@pytest.mark.parametrize(
    "words",
    [
        ["list", "arms"],
        ["split", "list"],
        ["grammar", "list"],
        ["conform", "gantry-plane", "--samples", "2"],
    ],
)
def test_tables_fit_the_terminal(words, ok, monkeypatch):
    piped = ok(*words)
    assert max(map(len, piped.splitlines())) > 80
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    shown = ok(*words)
    assert max(map(len, shown.splitlines())) <= 80
    assert len(shown.splitlines()) >= len(piped.splitlines())
    if words[0] != "conform":  # its numbers are measured anew
        assert ok(*words, "--wide") == piped


def test_show_prints_the_tree(ok, robot_urdf):
    out = ok("show", robot_urdf(arm()))
    assert out.splitlines()[0].startswith("arm: 6 links, 4 DoF, ")
    assert "\n  upper  shoulder: revolute (0 1 0) [-114.6, 114.6] deg  " in out
    assert "extend: prismatic (0 0 1) [0, 0.04] m" in out
    assert "right: prismatic (0 1 0) [-0.04, 0] m = -1 * left + 0" in out


def test_show_prints_the_frames_of_a_bundle_as_json(ok, tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm", picture=False)
    out = ok("show", folder, "--json")
    data = json.loads(out)
    assert [link["name"] for link in data["links"]][:2] == ["base", "upper"]
    assert data["frames"]["tool"]["link"] == "slider"
    assert {joint["name"]: joint["mimic"] for joint in data["joints"]}["right"] == "left"


def test_check_reports_no_findings_for_a_valid_bundle(run, tmp_path):
    folder = write_bundle(valid_robot(), tmp_path / "sound", picture=False)
    assert run("check", folder, "--strict") == (0, f"{folder}: 0 error, 0 warning, 0 info\n", "")


@pytest.mark.parametrize(
    ("change", "codes"),
    [
        ({"limits": (1.0, -1.0)}, (1, 1)),
        ({"limits": (-180.0, 180.0)}, (0, 1)),
        ({"damping": 0.1}, (0, 0)),
    ],
)
def test_check_exits_1_for_errors_and_with_strict_for_warnings(run, robot_urdf, change, codes):
    path = robot_urdf(with_joint(valid_robot(), "elbow", **change))
    assert (run("check", path)[0], run("check", path, "--strict")[0]) == codes


def test_check_prints_code_location_and_fix_of_a_finding(run, robot_urdf):
    path = robot_urdf(with_joint(valid_robot(), "elbow", limits=(1.0, -1.0)))
    _, out, _ = run("check", path)
    _, finding, remedy = out.splitlines()
    assert finding.startswith("  error limits-inverted at joint elbow: ")
    assert remedy.startswith("    fix: ")
    _, out, _ = run("check", path, "--json")
    (data,) = json.loads(out)[str(path)]["findings"]
    parts = (data["code"], data["where"], data["severity"])
    assert parts == ("limits-inverted", "joint elbow", "error")


def test_check_reports_a_broken_structure_as_findings(run, urdf):
    path = urdf('<robot name="r"><link name="a"/><link name="b"/></robot>')
    code, out, err = run("check", path, "--json")
    assert (code, err) == (1, "")
    assert [finding["severity"] for finding in json.loads(out)[str(path)]["findings"]] == ["error"]


def test_check_fix_writes_a_bundle_without_the_faults(run, urdf, tmp_path):
    text = urdf_text(replace(valid_robot(), frames=()), str)
    path = urdf(text.replace('xyz="1 0 0"', 'xyz="3 0 0"'))
    code, out, err = run("check", path, "--fix", "mended")
    assert (code, err) == (0, "written: mended/arm\n")
    assert "repaired axis-not-unit at joint elbow" in out
    assert read_bundle(tmp_path / "mended" / "arm").joints[1].axis == (1, 0, 0)
    code, out, err = run("check", path, "--fix", "mended", "--json")
    assert [f["code"] for f in json.loads(out)[str(path)]["repaired"]] == ["axis-not-unit"]
    assert "axis-not-unit" in run("check", path)[1]


@pytest.mark.parametrize("command", ["check", "conform"])
def test_a_robot_that_cannot_be_read_does_not_stop_others(run, command):
    Path("broken.urdf").write_text("<robot\n")
    words = (command, "broken.urdf", "gantry-plane", "gantri-plane")
    code, out, err = run(*words)
    assert (code, "gantry-plane" in out) == (2, True)
    first, second = err.splitlines()
    assert first.startswith("morphgen: broken.urdf:2:1: ")
    assert second.startswith("morphgen: robot 'gantri-plane': ")
    code, out, again = run(*words, "--json")
    assert (code, again) == (2, err)
    data = json.loads(out)
    rows = data if command == "conform" else [{"robot": k, **row} for k, row in data.items()]
    assert [row["robot"] for row in rows] == ["gantry-plane", "broken.urdf", "gantri-plane"]
    assert [row.get("error") for row in rows] == [None, "FormatError", "CompositionError"]
    assert f"morphgen: {rows[1]['message']}" == first


def test_a_missing_folder_does_not_stop_other_exports(run):
    refusal = "morphgen: gone/: gone: no such file or folder\n"
    assert run("export", "gone/", "prims", "--format", "urdf") == (2, "prims-urdf\n", refusal)


def test_places_that_cannot_be_written_are_refused_before_the_work(refused, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    error = refused("similarity", "plane", "--map", "a.png")
    assert "--map a.png: folder . cannot be written" in error
    assert "cannot write to out: " in refused("fit", "plane", "--out", "out/made")


def test_files_and_folders_beside_a_part_do_not_hide_it(ok, refused):
    Path("plane").mkdir()
    Path("arms").mkdir()
    Path("arms/my_arm.urdf").touch()
    ok("check", "plane")  # the part
    ok("fit", "plane")
    assert refused("check", "arms").endswith("; did you mean arms/my_arm.urdf?\n")


def test_robots_of_one_name_are_not_written_over_each_other(run, tmp_path):
    for name in ("a.urdf", "b.urdf"):
        (tmp_path / name).write_text(urdf_text(replace(valid_robot(), frames=()), str))
    code, _, err = run("check", "a.urdf", "b.urdf", "--fix", "mended")
    assert code == 2
    assert "b.urdf: mended/arm is that of a.urdf, which has the same name" in err


def test_import_converts_a_urdf_to_a_bundle(ok, robot_urdf, tmp_path):
    path = robot_urdf(arm())
    out = ok("import", path, "--root-link", "upper", "--tool", "slider", "--out", "robots")
    assert out.startswith("robots/arm: 5 links, 3 DoF, ")
    assert read_bundle(tmp_path / "robots" / "arm").frame("tool").link == "slider"
    data = json.loads(ok("import", path, "--name", "limb", "--no-picture", "--json"))
    assert (data["folder"], data["card"]["source"]) == ("robots/limb", "some_robot.urdf")


def test_import_ignores_the_pairs_that_an_srdf_disables(run, robot_urdf, tmp_path):
    path, srdf = robot_urdf(arm()), tmp_path / "arm.srdf"
    words = ("import", path, "--no-picture", "--out", "robots", "--srdf", srdf)
    pair = '<disable_collisions link1="slider" link2="base" reason="Never"/>'
    srdf.write_text(f'<robot name="arm">{pair}</robot>')
    assert run(*words)[0] == 0
    assert ("base", "slider") in read_bundle(tmp_path / "robots" / "arm").ignore_pairs


def test_import_passes_arguments_to_xacro_and_prints_repairs(run, ok, tmp_path):
    path = tmp_path / "pincer.xacro"
    path.write_text(PINCER.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 2 0"/>'))
    words = ("import", path, "--arg", "length=0.4", "--no-picture", "--out", "o")
    out = ok(*words)
    assert "  repaired joint left_slide: the axis (0.0, 2.0, 0.0) was scaled to unit length" in out
    palm = read_bundle(tmp_path / "o" / "pincer").link("palm")
    assert palm.collisions[0].geometry.size == pytest.approx((0.02, 0.02, 0.4))
    code, out, _ = run(*words, "--as-is", "--name", "as_is")
    assert code == 1
    assert "  error axis-not-unit at joint left_slide: its axis (0.0, 2.0, 0.0) is 2 long" in out
    assert "repaired" not in out
    assert (tmp_path / "o" / "as_is" / "card.json").is_file()


def test_conform_fails_for_a_bundle_whose_files_disagree(run, tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm", picture=False)
    other = write_bundle(valid_robot(), tmp_path / "other", picture=False) / "robot.xml"
    (folder / "robot.xml").write_bytes(other.read_bytes().replace(b"elbow", b"knee"))
    code, out, _ = run("conform", folder, "--samples", "2")
    assert code == 1
    assert "lacks joints elbow" in out


def test_the_help_of_a_first_use_is_short(capsys):
    shown = []
    for flag in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            main(["train", flag])
        shown.append(capsys.readouterr().out)
    assert all("--agent" in text and "--resume" in text for text in shown)
    assert ["--robots" in text and "--symlog" in text for text in shown] == [False, True]
    for name in ("learning_rate=0.0003", "the networks of me-tf: ", "graph_hidden=64"):
        assert [name in " ".join(text.split()) for text in shown] == [False, True]


def test_definitions_name_functions_and_options_that_exist():
    for command in read_commands():
        module, _, function = command.function.rpartition(".")
        assert not function or hasattr(import_module(f"morphgen.cli.{module}"), function)
        named = [name for flags, _, other, _ in command.rules for name in (*flags, other)]
        assert {*named} <= {*command.options}, command.path


def test_without_a_command_usage_is_printed_and_exit_code_is_2(run):
    code, out, _ = run()
    assert code == 2
    assert out.startswith("usage: morphgen")


def test_version(run):
    assert run("--version") == (0, f"morphgen {version('morphgen')}\n", "")


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(tmp_path):
    words = ("compose", "arm=lwr", "ee=robotiq_2f85", "ee.mount_yaw=45deg", "--out")
    processes = [start(*words, tmp_path / seed, PYTHONHASHSEED=seed) for seed in ("1", "2")]
    for process in processes:
        _, err = process.communicate()
        assert (process.returncode, err) == (0, "")
    first, second = tree(tmp_path / "1"), tree(tmp_path / "2")
    assert first == second
    (folder,) = (tmp_path / "1").iterdir()
    names = "robot.urdf card.json robot.xml preview.png primitives.json meshes"
    assert {path.name for path in folder.iterdir()} == {*names.split()}


def test_closed_stdout_causes_no_error_message():
    process = start("--version", PYTHONUNBUFFERED="")
    process.stdout.close()
    assert process.wait() == 1
    assert process.stderr.read() == ""


def test_internal_errors_keep_their_traceback(monkeypatch):
    """User errors print one line; internal errors keep their traceback."""

    def fail(*_):
        raise ZeroDivisionError

    monkeypatch.setattr("morphgen.cli.lists.catalogue", fail)
    with pytest.raises(ZeroDivisionError):
        main(["list"])


@pytest.mark.parametrize("columns", [0, -1, 1, 2, 3, 12, 10**6, "abc", ""])
@pytest.mark.parametrize("words", [["--help"], ["export", "--help"], ["split", "new", "--help"]])
def test_the_help_fits_every_terminal(words, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit) as exit_:
        main(words)
    assert exit_.value.code == 0
    assert "--help" in "".join(capsys.readouterr().out.split())


def test_demo_composes_checks_and_loads_a_robot(ok):
    out = ok("demo")
    commands = [line for line in out.splitlines() if line.startswith("$ ")]
    assert commands == [
        "$ morphgen compose arm=ur5 ee=plane --out robots",
        "$ morphgen check robots/ur5-plane --strict",
        "$ morphgen conform robots/ur5-plane",
    ]
    assert "robots/ur5-plane: 0 error, 0 warning, 0 info\n" in out
    assert all(f"ur5-plane  bundle  {loader.name} " in out for loader in LOADERS)
    *_, last = out.splitlines()
    assert last == "The robot is in robots/ur5-plane; its picture is robots/ur5-plane/preview.png"
    assert Path("robots/ur5-plane/preview.png").is_file()


def test_demo_prints_one_line_if_it_cannot_write(run):
    Path("file").write_text("")
    code, out, err = run("demo", "--out", "file")
    assert (code, out) == (2, "$ morphgen compose arm=ur5 ee=plane --out file\n")
    assert err.startswith("morphgen: ")
    assert err.count("\n") == 1


def test_check_and_show_read_an_mjcf_of_any_suffix(ok, tmp_path):
    path = write(tmp_path, TWO_JOINTS, "robot.mjcf")
    found = {f["code"] for f in json.loads(ok("check", path, "--json"))[str(path)]["findings"]}
    assert found == {"effort-missing", "velocity-missing", "self-collision"}
    assert ok("show", "robot.mjcf").splitlines()[0] == "test: 3 links, 2 DoF, 12.57 kg"


ROBOT = {"words": "robot"}
ROBOTS = {"words": "robots"}
OPERATIONS = {
    "conform": ("conform", ROBOT, {"root", "json", "wide"}),
    "eval": ("evaluate", ROBOTS | {"checkpoint": "policy"}, {"out", "json", "wide"}),
    "export": ("export", ROBOT, {"root", "json"}),
    "goals": ("goals", ROBOTS, {"json", "wide"}),
    "play": ("play", ROBOT, set()),
    "clone": ("clone", {"words": "demonstrations"}, set()),
    "record": ("record", ROBOTS, {"json"}),
    "train": ("train", ROBOTS, {*SWITCHES, "observe"}),
    "verify": ("verify", {}, {"json", "wide"}),
}
"""For each command the function, the names of its parameters where they differ, and the options
that are no parameters: they print or write the result, or are switches within ``agent``."""
ONLY_IN_PYTHON = {"max_successes", "show"}
"""Parameters that are no options."""


def options_of(path):
    """Return the settings of a command's options by the names of their attributes."""
    (command,) = (each for each in read_commands() if each.path == path)
    return {
        settings.get("dest") or name.lstrip("-").replace("-", "_"): settings
        for name, settings in command.options.items()
    }


def documented(function):
    """Return the text of each parameter in the docstring."""
    text = re.search(r"\n    Args:\n(.*?)\n    (?=\w)", function.__doc__, re.DOTALL)[1]
    entries = re.split(r"^        \**(\w+): ", text, flags=re.MULTILINE)[1:]
    return dict(zip(entries[::2], entries[1::2], strict=True))


@pytest.mark.parametrize("path", OPERATIONS)
def test_options_and_parameters_are_the_same(path):
    name, renamed, others = OPERATIONS[path]
    function = getattr(morphgen, name)
    parameters = inspect.signature(function).parameters
    texts = documented(function)
    assert list(texts) == list(parameters)
    others = {each.replace("-", "_") for each in others}
    options = {renamed.get(k, k): v for k, v in options_of(path).items() if k not in others}
    assert set(options) == set(parameters) - ONLY_IN_PYTHON
    for key, settings in options.items():
        default, expected = settings.get("default"), parameters[key].default
        valid = (None, ()) if default == [] else (default,)
        assert expected is inspect.Parameter.empty or expected in valid, key
        choices = settings.get("choices", ())
        if not isinstance(choices, Registry):
            assert [each for each in choices if f"``{each}``" not in texts[key]] == [], key


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
    out = ok("export", "base=planar", "ee=cube", "--out", tmp_path)
    (path,) = tmp_path.iterdir()
    assert out.strip() == str(path)
    assert path.suffix == ".html"
    assert b"__VISER_EMBED_DATA__" in path.read_bytes()


def files(folder):
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in paths if path.suffix != ".stl"}


ROS2 = {"package.xml", "CMakeLists.txt", "launch/display.launch.py", "urdf/arm.urdf"}
ROS2 |= {"config/arm.srdf", "config/display.rviz"}


@pytest.mark.parametrize(
    ("name", "folder", "expected"),
    [
        ("urdf", "arm-urdf", {"robot.urdf"}),
        ("mjcf", "arm-mjcf", {"robot.xml"}),
        ("sdf", "arm-sdf", {"model.sdf", "model.config"}),
        ("ros2", "arm_description", ROS2),
    ],
)
def test_folders_are_written_into_the_output_folder_and_again(
    run, refused, tmp_path, name, folder, expected
):
    bundle = write_bundle(arm(), tmp_path / "bundle", picture=False)
    words = ["export", bundle, "--format", name, "--out", tmp_path]
    for _ in range(2):
        code, out, _ = run(*words)
        assert (code, out.strip()) == (0, str(tmp_path / folder))
    assert files(tmp_path / folder) == {*expected, MANIFEST}
    (tmp_path / folder / "mine").write_text("")
    assert "mine is not of the export" in refused(*words)


def test_an_exported_urdf_has_the_fits_and_so_the_goals_of_the_robot(run, tmp_path, refused):
    words = ("arm=xarm6", "ee=none")
    assert run("export", *words, "--format", "urdf", "--out", tmp_path)[0] == 0
    (urdf,) = tmp_path.glob("*/robot.urdf")
    assert (urdf.parent / FITS).is_file()
    composed, exported = load_robot(" ".join(words)), load_robot(urdf)
    assert run("import", urdf, "--name", "mine", "--no-picture")[0] == 0
    robots = (composed, exported, load_robot("robots/mine"))
    assert len({robot_hash(robot, visuals=False) for robot in robots}) == 1
    (urdf.parent / FITS).write_text("[]")
    assert FITS in refused("check", urdf)


def test_files_of_a_bundle_are_written_into_it(run, tmp_path):
    bundle = write_bundle(arm(), tmp_path / "a", picture=False)
    for name in ("srdf", "glb"):
        code, out, _ = run("export", bundle, "--format", name)
        assert (code, out.strip()) == (0, str(bundle / f"robot.{name}"))
    assert (bundle / "robot.srdf").read_text() == robot_srdf_text(arm())
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
    for name in ("srdf", "ros2", "curobo"):
        refused("export", toolless, "--format", name, "--out", "new/folder")
    err = refused("export", bundle, "--out", bundle / "robot.urdf")
    assert "cannot write to" in err


def test_exports_of_robots_of_one_name_are_not_written_over_each_other(run, tmp_path):
    folders = [write_bundle(arm(), tmp_path / name, picture=False) for name in ("a", "b")]
    code, _, err = run("export", *folders, "--format", "sdf", "--out", tmp_path)
    assert code == 2
    assert f"b: {tmp_path / 'arm-sdf'} is of another robot of this command already" in err


def test_the_help_has_the_formats():
    (command,) = [each for each in read_commands() if each.path == "export"]
    assert command.options["--format"]["choices"] == [*export.FILES, *export.FOLDERS]
