"""Invalid input is rejected with a one-line message, and no partial files are left."""

import argparse
import json
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

import morphgen
from helpers.commands import start, tree
from helpers.parts import write_part
from helpers.robots import arm
from morphgen import cli
from morphgen.cli.command import whole_number
from morphgen.cli.export import FORMATS, FileFormat
from morphgen.errors import MorphgenError
from morphgen.formats import bundle
from morphgen.formats.bundle import write_bundle
from morphgen.grammar import library

LINK = '<link name="a">{}</link>'
SHAPE = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
BOMB = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "lol"}">' for i in range(12))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("arm=ur55 ee=plane", "unknown arm 'ur55'; did you mean 'ur5'?"),
        ("arm=ur5 ee=plnae", "unknown ee 'plnae'; did you mean 'plane'?"),
        ("base=gantri arm=ur5", "unknown base 'gantri'; did you mean 'gantry'?"),
        (
            "base=gantry ee=plane ee.sise=1",
            "'plane' has no parameter 'sise'; did you mean 'size'? valid: mount_yaw, size,",
        ),
        (
            "base=gantry ee=plane ee.size=5m",
            "ee.size=5: out of range; expected 0.02 to 1 m (units: m/cm/mm)",
        ),
        (
            "base=gantry ee=plane ee.size=5kg",
            "ee.size=5kg: wrong unit 'kg'; expected 0.02 to 1 m (units: m/cm/mm)",
        ),
        ("base=gantry ee=plane ee.size=big", "ee.size=big: not a number; expected"),
        ("base=gantry ee=plane ee.mount_yaw=1m", "wrong unit 'm'; expected"),
        ("base=gantry up.ee=plane", "'gantry' has no port 'up'"),
        ("base=gantry", "nothing to compose"),
        ("ur5 x", "'ur5' is not of the form key=value, such as arm=ur5"),
        ("base=gantry ee=plane --library nowhere", "nowhere does not exist"),
    ],
)
def test_invalid_arguments_are_rejected(refused, words, message):
    assert message in refused("compose", *words.split(), "--out", "out")


def test_names_are_printed_in_any_encoding(tmp_path):
    (tmp_path / "ü.urdf").write_text('<robot name="r"><link name="ä"/></robot>', encoding="utf-8")
    process = start("show", tmp_path / "ü.urdf", PYTHONIOENCODING="ascii")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert r"\xe4" in out


@pytest.mark.parametrize("name", ["../x", "", "a/b", ".", "..", ".hidden", "-x", "a b", "n" * 300])
def test_names_that_are_not_plain_folder_names_are_rejected(refused, robot_urdf, name):
    naming = ("--no-picture", "--out", "out", f"--name={name}")
    assert f"name {name!r}: use letters" in refused("compose", "base=gantry", "ee=plane", *naming)
    assert f"name {name!r}: use letters" in refused("import", robot_urdf(arm()), *naming)


def test_robot_name_in_a_file_cannot_leave_the_output_folder(refused, robot_urdf):
    path = robot_urdf(replace(arm(), name=".."))
    assert "name '..': use letters" in refused("import", path, "--out", "out", "--as-is")


@pytest.mark.parametrize("name", ["..", "../../x", "/x"])
def test_a_repaired_name_stays_in_the_output_folder(run, robot_urdf, tmp_path, name):
    path = robot_urdf(replace(arm(), name=name))
    work = tmp_path / "work"
    work.mkdir()
    assert run("check", path, "--fix", work / "out")[0] == 0
    (repaired,) = (work / "out").iterdir()
    assert repaired.is_dir()
    assert {entry.name for entry in tmp_path.iterdir()} >= {"work", path.name}
    assert [entry.name for entry in work.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        ('<robot name="r">\n<link name="a">\n</robot>', "broken.urdf:3:"),
        ("", "broken.urdf:1:"),
        (f'<!DOCTYPE r [{BOMB}]><robot name="r">&e11;</robot>', "broken.urdf"),
        ('<!DOCTYPE r SYSTEM "x.dtd"><robot name="r"/>', "DOCTYPE"),
        (
            f'<robot name="r">\n{LINK.format(SHAPE.format("../../etc/hand.stl"))}</robot>',
            "'../../etc/hand.stl' leaves ",
        ),
        (
            f'<robot name="r">\n{LINK.format(SHAPE.format("/etc/passwd"))}</robot>',
            "'/etc/passwd' leaves ",
        ),
        (
            f'<robot name="r">\n{LINK.format(SHAPE.format("hand.stl"))}</robot>',
            "broken.urdf:2: ",
        ),
        (
            f'<robot name="r">{LINK.format(SHAPE.format("package://nowhere/hand.stl"))}</robot>',
            "package 'nowhere' not found",
        ),
        ("<sdf/>", "<sdf>"),
    ],
    ids=["broken", "empty", "bomb", "dtd", "climbing", "absolute", "mesh", "package", "sdf"],
)
def test_broken_urdf_is_rejected(refused, urdf, xml, message):
    started = time.process_time()  # CPU time of this process, independent of other load
    path = urdf(xml)
    assert message in refused("import", path, "--out", "out")
    assert message in refused("show", path)
    assert time.process_time() - started < 5


@pytest.mark.parametrize("xml", ["<robot", f'<!DOCTYPE r [{BOMB}]><robot name="r">&e11;</robot>'])
def test_check_rejects_files_that_are_not_xml(refused, urdf, xml):
    assert "broken.urdf" in refused("check", urdf(xml))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("show nowhere.urdf", "nowhere.urdf: no such file"),
        ("check nowhere", "'nowhere' is not a part"),
        ("check nowhere/", "nowhere: no such file"),
        ("import nowhere.xacro", "nowhere.xacro: no such file"),
        ("conform ./", ". holds no robot; expected a bundle"),
        ("show ./", ". holds no robot; expected a bundle"),
        (f"show {'n' * 300}", "File name too long"),
        ("import x.xacro --arg length", "--arg length: expected NAME=VALUE"),
        ("import x.xacro --arg =1", "--arg =1: expected NAME=VALUE"),
        ("conform . --samples 0", "argument --samples: 0: expected a whole number, 1 to 100000"),
    ],
)
def test_missing_files_are_named(refused, argv, message):
    assert message in refused(*argv.split())


def test_unknown_link_names_suggest_the_nearest(refused, robot_urdf):
    path = robot_urdf(arm())
    assert "did you mean 'slider'" in refused("import", path, "--tool", "slidr")
    assert "did you mean 'base'" in refused("import", path, "--root-link", "bas")
    assert "named by --root-link" in refused("import", path, "--root", "base")


@pytest.mark.parametrize(
    "card",
    [
        "{",
        "[]",
        "{}",
        '{"format": 99}',
        '{"format": 1}',
        '{"format": 1, "frames": 5}',
        '{"format": 1, "home": 5, "ignore_pairs": []}',
        '{"format": 1, "home": {"j": "x"}, "ignore_pairs": []}',
    ],
)
def test_bundle_with_a_broken_card_is_rejected(refused, tmp_path, card):
    folder = write_bundle(replace(arm(), frames=()), tmp_path / "arm", picture=False)
    (folder / "card.json").write_text(card)
    assert "card" in refused("show", folder)


def test_errors_are_printed_as_json_with_the_json_option(run):
    code, out, err = run("compose", "arm=ur55", "--json")
    assert code == 2
    data = json.loads(out)
    assert data["error"] == "PartError"
    assert err == f"morphgen: {data['message']}\n"


def test_missing_data_package_error_says_how_to_install_it(refused, tmp_path):
    source = {"package": "no-such-data", "file": "x.urdf"}
    write_part(tmp_path, source=source, file=None, density=None, parameters=None)
    message = refused("compose", "base=gantry", "ee=pincer", "--library", ".")
    assert "'x.urdf' is part of 'no-such-data', not installed: pip install no-such-data" in message


def test_broken_manifest_error_has_line_and_column(refused, tmp_path):
    (tmp_path / "stump.yaml").write_text("name: stump\nkind: [\n")
    assert "stump.yaml:3:1: invalid YAML" in refused("compose", "ee=stump", "--library", ".")


def test_unwritable_output_folder_is_named(refused, tmp_path):
    (tmp_path / "file").write_text("a plain file")
    words = ("compose", "base=gantry", "ee=plane", "--no-picture")
    assert "cannot write to file/deep" in refused(*words, "--out", "file/deep")
    assert "cannot write to file" in refused(*words, "--out", "file")


def test_folder_that_is_not_a_bundle_is_never_replaced(refused, tmp_path):
    (tmp_path / "out" / "gantry-plane").mkdir(parents=True)
    (tmp_path / "out" / "gantry-plane" / "thesis.txt").write_text("years of work")
    words = ("compose", "base=gantry", "ee=plane", "--no-picture", "--out", "out")
    assert "out/gantry-plane exists and is not a bundle" in refused(*words)


@pytest.mark.parametrize(
    ("file", "why"),
    [
        ("robot.urdf", "robot.urdf was changed since"),
        ("robot.xml", "robot.xml was changed since"),
        ("notes.md", "notes.md is not of the bundle"),
        ("meshes/own.stl", "meshes/own.stl is not of the bundle"),
    ],
)
def test_a_bundle_that_was_edited_is_never_replaced(refused, run, file, why):
    words = ("compose", "base=gantry", "ee=plane", "--no-picture", "--out", "out")
    assert run(*words)[0] == 0
    edited = Path("out/gantry-plane") / file
    edited.parent.mkdir(exist_ok=True)
    with edited.open("a") as stream:
        stream.write("<!-- years of work -->")
    assert f"out/gantry-plane is not replaced: {why}; move the folder away" in refused(*words)
    assert "years of work" in edited.read_text()
    fitted = ("fit", "base=gantry", "ee=plane", "--no-picture", "--out", "out/gantry-plane")
    assert f"out/gantry-plane is not replaced: {why}" in refused(*fitted)


def test_a_bundle_with_exported_files_is_replaced(run):
    words = ("compose", "base=gantry", "ee=plane", "--no-picture", "--out", "out")
    assert run(*words)[0] == 0
    for name, row in FORMATS.items():
        if isinstance(row, FileFormat):
            (Path("out/gantry-plane") / f"robot.{name}").touch()
    (Path("out/gantry-plane/.DS_Store")).touch()  # of a file manager
    (Path("out/gantry-plane/robot.urdf")).unlink()  # a damaged bundle is mended
    assert run(*words)[0] == 0
    assert {path.name for path in Path("out/gantry-plane").iterdir()} == {
        "robot.urdf",
        "robot.xml",
        "card.json",
    }


def test_a_robot_is_never_imported_over_itself(refused, run):
    words = ("compose", "base=gantry", "ee=plane", "--no-picture")
    assert run(*words)[0] == 0
    card = Path("robots/gantry-plane/card.json")
    before = card.read_bytes()
    for name in ("robot.urdf", "robot.xml"):
        refusal = refused("import", card.with_name(name), "--name", "gantry-plane", "--no-picture")
        assert f"robots/gantry-plane/{name}: its bundle would replace robots/gantry" in refusal
    assert card.read_bytes() == before


def interrupt(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", ["urdf_text", "mjcf_text", "card_text", "render"])
def test_interrupted_run_leaves_no_partial_bundle(run, tmp_path, monkeypatch, step):
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(bundle, step, interrupt)
    code, out, err = run("compose", "base=gantry", "ee=plane", "--out", "out")
    assert (code, out) == (130, "")
    assert err == "morphgen: interrupted; nothing half-written is left\n"
    assert tree(tmp_path / "out") == {}


def test_ctrl_c_during_imports_prints_one_line(run, monkeypatch):
    monkeypatch.setattr(cli, "build_parser", interrupt)
    assert run("list") == (130, "", "morphgen: interrupted; nothing half-written is left\n")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("trian", "argument COMMAND: invalid choice: 'trian'; did you mean 'train'?"),
        ("split shw", "argument COMMAND: invalid choice: 'shw'; did you mean 'show'?"),
        ("split new interpolatoin", "'interpolatoin'; did you mean 'interpolation'? valid: "),
        ("similarity a b --measure cosin", "argument --measure: invalid choice: 'cosin'; did you"),
        ("check a --strct", "unknown option '--strct'; did you mean '--strict'?"),
        ("check a --strct", "; see morphgen check --help"),
        ("list arms legs", "unknown arguments: legs; see morphgen list --help"),
        ("train --envs x", "argument --envs: x: expected a whole number, 1 or more; see morphgen"),
        ("sample chain -n 2.5", "argument -n: 2.5: expected a whole number, 1 or more"),
        ("compose foo=bar", "foo=bar: unknown key 'foo'; expected base, arm, ee, a limb such as"),
    ],
)
def test_misspelt_words_suggest_the_nearest_valid_one(refused, argv, message):
    assert message in refused(*argv.split())


@pytest.mark.parametrize(
    ("text", "value"), [("2e6", 2_000_000), ("7", 7), (str(2**60 + 1), 2**60 + 1)]
)
def test_whole_numbers_are_read_exactly(text, value):
    assert whole_number(0)(text) == value


@pytest.mark.parametrize("text", ["1.5", "nan", "inf", "1e999", "x", "", "-1"])
def test_invalid_whole_numbers_are_rejected(text):
    with pytest.raises(argparse.ArgumentTypeError, match="expected a whole number, 0 or more"):
        whole_number(0)(text)


def test_ctrl_c_converted_by_a_package_is_treated_as_ctrl_c(run, monkeypatch):
    def swallow(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        except BaseException:
            raise TypeError("unsupported operand")  # noqa: B904

    monkeypatch.setattr(library, "default_library", swallow)
    # Background processes of a shell ignore Ctrl-C, and this process would inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    code, out, err = run("list")
    assert (code, out) == (130, "")
    assert err == "morphgen: interrupted; nothing half-written is left\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("move", [1, 2])
def test_interrupted_replacement_keeps_the_old_bundle(run, tmp_path, monkeypatch, move):
    words = ("compose", "--no-picture", "--out", "out", "--name", "g", "base=gantry", "ee=plane")
    assert run(*words)[0] == 0
    before = tree(tmp_path / "out")
    rename, moves = Path.rename, []

    def interrupted(path, target):
        moves.append(path)
        if len(moves) == move:
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    assert run(*words, "ee.size=0.2")[0] == 130
    assert tree(tmp_path / "out") == before


@pytest.mark.slow
def test_interrupted_process_leaves_no_partial_bundle_or_temporary_folder(tmp_path):
    out = tmp_path / "out"
    process = start("compose", "arm=kinova_gen3", "ee=robotiq_2f85", "--out", out)
    deadline = time.monotonic() + 60
    while not list(out.glob(".*/meshes/*")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    printed, err = process.communicate()
    assert (process.returncode, printed) == (130, "")
    assert err == "morphgen: interrupted; nothing half-written is left\n"
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("where", [0, 1, 2])
@pytest.mark.parametrize("missing", ["no/such.urdf", "gone/", "./empty"])
@pytest.mark.parametrize(
    "command", [["check"], ["conform", "--samples", 1], ["export", "--format", "urdf"]]
)
def test_a_missing_robot_does_not_stop_the_others(command, missing, where, run):
    Path("empty").mkdir()
    robots = ["prims", "arm3-stick"] if command[0] != "conform" else ["prims"]
    words = [*robots]
    words.insert(where, missing)
    code, out, err = run(*command, *words)
    assert code == 2
    assert all(name in out for name in robots)
    assert err.startswith("morphgen: ")
    assert str(Path(missing)) in err
    assert err.index("\n") == len(err) - 1


UNSOUND = {
    "unknown part": "robot -> base arm\nbase -> fixed\narm -> nosuch\n",
    "unused value": "let unused = uniform(1, 2)\nrobot -> base arm3\nbase -> fixed\n",
    "unreachable": "robot -> base arm3\nbase -> fixed\nother -> stick\n",
    "never ending": "robot -> base loop\nbase -> fixed\nloop -> arm3 loop\n",
}


@pytest.mark.parametrize("text", UNSOUND.values(), ids=UNSOUND)
def test_commands_refuse_the_grammars_that_check_refuses(text, run, refused):
    Path("mine.grammar").write_text(text)
    code, out, _ = run("grammar", "check", "mine.grammar")
    assert code == 1
    fault = out.splitlines()[0]
    for command in (
        ["grammar", "count", "mine.grammar"],
        ["grammar", "enumerate", "mine.grammar"],
        ["sample", "mine.grammar", "-n", 1, "--out", "out"],
        ["compose", "mine.grammar"],
        ["derive", "mine.grammar"],
        ["split", "new", "interpolation", "--grammar", "mine.grammar", "--out", "s.yaml"],
    ):
        assert fault in refused(*command)
    with pytest.raises(MorphgenError) as caught:
        list(morphgen.sample("mine.grammar", 1))
    assert fault in str(caught.value)


def actions_of(parser):
    """Return the actions of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from actions_of(child)


def accepts(convert, text):
    try:
        convert(text)
    except argparse.ArgumentTypeError:
        return False
    return True


def test_numbers_are_checked_before_the_work():
    numbers = [each for each in actions_of(cli.build_parser()) if each.metavar == "N"]
    unchecked = {each.dest for each in numbers if each.type and accepts(each.type, "-1")}
    assert (len(numbers) > 60, unchecked) == (True, {"gpus", "test"})
