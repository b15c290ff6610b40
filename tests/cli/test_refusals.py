"""Invalid input is rejected with a one-line message, and no partial files are left."""

import argparse
import json
import shlex
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import morphgen
from helpers.commands import start, tree
from helpers.mjcf import TWO_JOINTS
from helpers.mjcf import write as write_mjcf
from helpers.robots import arm
from helpers.runs import RUN, SMALL, small_split
from helpers.splits import TRAIN, combined, member
from morphgen import cli
from morphgen.api.export import FILES
from morphgen.cli.command import whole_number
from morphgen.errors import MorphgenError
from morphgen.splits.split import split_text
from morphgen.tasks.registry import TASKS

ABBREVIATIONS = {
    "CUBES": "split new interpolation --grammar cubes --train 3",
    "EXTRAPOLATION": "split new extrapolation --train 6 --train-category",
    "HOLD_OUT": "split new --hold-out ee=plane --from 'arm={lwr,arm3} ee={plane,cube}' --train 2",
    "RELEASE": "split release --no-goals",
    "RUN": " ".join(RUN),
    "DRAWN": f"train task=reach --agent me-mlp --train-goals 3 {' '.join(SMALL)} --robots",
    "STUDY": "study interpolation/arm3/reach",
    "SUBMIT": "eval zero --split small.yaml --submission",
}
"""Words that several of the lines below begin with."""
REFUSALS = """
compose arm=ur55 ee=plane => ; your own parts need --library DIR
compose arm=ur5 ee=stik => 'stick'? your own parts need --library DIR
compose base=gantry ee=plane --library nowhere => nowhere does not exist
compose chian beads=5 => 'chian' is neither a grammar nor of the form key=value; did you mean
show nowhere.urdf => nowhere.urdf: no such file
show folder => folder holds no robot; expected a bundle
show broken.urdf => : not well-formed XML: 
show climbing.urdf => '../../etc/hand.stl' leaves
compose base=gantry ee=plane --no-picture --out file/deep => cannot write to file/deep
compose ee=stump --library stumps => stump.yaml:3:1: invalid YAML
check nowhere => 'nowhere' is not a part
conform folder => folder holds no robot; expected a bundle
conform . --samples 0 => argument --samples: 0: expected a whole number, 1 to 100000
import x.xacro --arg length => --arg length: expected NAME=VALUE
import a.xml --part arm => --part: name the robot's licence by --licence, such as MIT
import a.xml --licence MIT => --licence: only with --part
import a.xml --parts parts => --parts: only with --part
import a.xml --part arm --licence MIT --name 1st => digits and underscores, no digit first; import
import a.xml --part ee --licence MIT => no frame 'tool', which is the flange or the tool of a
import a.xml --part arm --licence MIT --tool left --name z1 => morphgen has a part of this name;
export arm3-stick --format curobo => (morphgen fit ROBOT --spheres N --out DIR), and export DIR
export prims --out /dev/null => cannot write to /dev/null: /dev/null is a file
check flat.obj => flat.obj: a mesh; expected a bundle, URDF, xacro or MJCF; `morphgen fit`
fit => name a part, a robot or a mesh file, or say --all alone
fit plane --all => name a part, a robot or a mesh file, or say --all alone
--json list => --json stands before the command
fit lost.stl => lost.stl: no such file
fit flat.obj => robot 'flat': link flat: no primitive can stand for its shapes
fit bare.urdf => robot 'r': no link has a shape
fit plane --iou 0.9 => --iou: only with --max-primitives
fit plane --cover 0.9 => --cover: only with --spheres
fit plane --spheres 4 --max-primitives 2 => --max-primitives: only without --spheres
fit --all --max-primitives 2 --seed 3 => --max-primitives --seed: only without --all
fit plane --out .. => name
fit plane --out file/made => cannot write to file: file is a file
tokens plane --out x.txt => --out x.txt: expected a name that ends in .npz
tokens plane --out no/x.npz => --out no/x.npz: there is no folder no
similarity folder plane => folder holds no robot; expected a bundle, a URDF, a set
similarity begun plane => begun is not a finished set: it has no index.jsonl
similarity prims => prims is one robot; name others
similarity prims stick --map a.jpg => --map a.jpg: expected a name that ends in .png
similarity a b --measure cosin => argument --measure: invalid choice: 'cosin'; did you
sample cubse => unknown grammar 'cubse'; did you mean 'cubes'? valid: arm3, arm5
sample cubes --seed -1 => argument --seed: -1: expected
sample cubes --where mas<3 => --where:1:1: unknown property 'mas'; did you mean 'mass'
trian => argument COMMAND: invalid choice: 'trian'; did you mean 'train'?
split shw => argument COMMAND: invalid choice: 'shw'; did you mean 'show'?
split new --hold-out arm=ur5 --grammar arm3 => neither a command nor the value of an option: 'arm3'
fit a --max-primitives 1e30 => 1e30: expected a whole number, 1 to 32
split new interpolatoin => 'interpolatoin'; did you mean 'interpolation'? valid: 
check a --strct => unknown option '--strct'; did you mean '--strict'?
check a --strct => ; see morphgen check --help
list arms legs => unknown arguments: legs; see morphgen list --help
split => the following arguments are required
split new => --hold-out 'arm=kinova*', or a regime: interpolation, composition, extrapolation; see
split new interpolation => the following arguments are required
EXTRAPOLATION stick, --test-category chain => unknown grammar ''
CUBES --train 3,x => argument --train: x: expected a whole number, 1 or more
CUBES --train '' => --train and --test start at 1
CUBES --out file/x.yaml => cannot write file/x.yaml: 
HOLD_OUT --name ../x => name '../x': use letters, digits
HOLD_OUT composition --from ee=plane => --hold-out before composition: options stand after it
split new --seed 5 composition => --seed before composition: options stand after it
split show interpolation/arm3 => no split of this name; did you mean
split audit broken.yaml => broken.yaml:
split build some.yaml --out file => cannot write to file/mine/some: Not a directory
split build some.yaml --goal-seed 1 => --goal-seed: only with --goals
split stats wrong.yaml => robot 'planar-cube': the library has no part 'cubw'
RELEASE interpolation/arm3/reach --out file => cannot write to file: file is a f
goals nowhere.yaml => nowhere.yaml: no such file
goals interpolation/arm3/reach --task reach => is for a robot; interpolation/arm3/reach is a split
goals some.yaml --obstacles => --obstacles: only with --task
train --envs x => argument --envs: x: expected a whole number, 1 or more; see morphgen
train interpolation/arm3/reech => did you mean 'interpolation/arm3/reach'?
train planar-cube => a robot needs task=reach or task=push
train base=planar ee=cube => a robot needs its task
train begun => begun is a set of robots; expected a split, such as one that morphgen split new
train planar-cube task=dance => unknown task 'dance'; valid: TASKS
train interpolation/arm3/reach --obstacles => --obstacles is for one robot
train interpolation/arm3/reach --envs 9 => fewer than the 10 robots
RUN --steps 1e99 => argument --steps: 1e99: expected at most 2^63 - 1
RUN --steps 31 => an update takes 32 transitions
RUN --device tpu => unknown device 'tpu'
RUN --agent se+magic => after se come switches
RUN --set gamma=much => expected a number
RUN --on test => is one robot and not a split: it has no test robots
RUN --whole => --whole is for --agent se, not for me-mlp
RUN --set logit_scale=8 => --set logit_scale: me-mlp has none; valid for me-tf
RUN --train-goals 1 => argument --train-goals: 1: expected a whole number, 2 or more
RUN --fixed-deviation => fixed-deviation: discrete actions have no
train planar-cube task=reach --agent me-tf --no-discrete --set logit_scale=8 => have no logits; it
train planar-cube task=reach --held-out own.yaml => only with --robots
train planar-cube task=reach --robots cubes:2 => name the task and nothing else
train interpolation/arm3/reach --robots cubes:2 => name the task and nothing
train task=reach --robots chain:3000 --steps 1000 => an update takes
DRAWN cubes:900 --sim warp => simulator 'warp' on device 'cpu'
DRAWN cubes:2 --on test => --on test: drawn robots have no sides
DRAWN chain:4 --max-links 6 => links, more than max_links 6
eval nothing => no checkpoint, and no folder of a run
eval ik => name its robots with --split
eval ik --split interpolation/arm3/reach --out folder.csv => folder.csv: it is a folder
eval ik --split planar-cube task=reach --mode stochastic => --mode is for policies
eval random --split prims task=push --goal pose => is for task reach; the tasks of the robots: push
eval scripted --split planar-cube task=reach => no robot is there to push
eval zero-shot --split interpolation/arm3/push => policy zero-shot was trained on reach, not on push
eval zero --split some.yaml --method a => --method: only with --submission
eval nothing --goal-seed 1 => --goal-seed: only with --split
finetune nothing --obstacles => --obstacles: only with --split
SUBMIT a.json --on train => leave --on train out
SUBMIT none/a.json => there is no folder none
SUBMIT a.json --episodes 2 => expected 34 or more
SUBMIT a.json --seed 3 => evaluation.seed: 3; expected 0
SUBMIT a.json --sim pybullet => expected 'mujoco'
eval zero --split prims task=reach --submission a.json => prims is no split
finetune nothing => no checkpoint
study nothing => nothing: no such file, and no split of this name
STUDY --seeds 0,9223372036854775808 => with at most 18 digits
STUDY --agents se,se => is there twice
STUDY --agents me-tf@test => only se
STUDY --steps 10 => an update takes
STUDY --finetune 1000 => --steps 1000 with --envs 64: an update takes 2,048 transitions
STUDY --episodes 13334 => 13334 episodes
study small.yaml again.yaml => again.yaml: split 'mine/small' is also in small.yaml; expected sp
split score some.yaml => some.yaml: a split, no submission; name it by --split
split score a.json --split some.yaml => a.json: no submission
play dance prims => see morphgen play --help
play push => see morphgen play --help
play push prims --policy magic => 'magic' is neither a checkpoint nor a policy; valid:
play push prims --out film.avi => the name of a video ends in .mp4 or .gif
play reach arm3-stick --policy scripted => valid: ik, jacobian, zero, random
zeroshot ur5-stick --task push --obstacles => no policy for push among obstacles comes with
zeroshot ur5-stick --task push --goal pose => --goal pose is for task reach
zeroshot ur5-stick --policy zero-shot-pose --goal position --episodes 1 => for other observations
view some.pt => is not a checkpoint
view --host 8.8.8.8 => cannot serve at '8.8.8.8'
view --host nosuch.invalid => cannot serve at
view --port 0 => argument --port: 0: expected a whole number, 1 to 65535
view --allow-origin null => --allow-origin 'null': expected a site
view --allow-origin http://box/page => without a path
"""
"""Command lines that are refused, and part of the reason; TASKS stands for the names of tasks."""


@cache
def texts_of_splits():
    wrong = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
    small = split_text(small_split())
    return {
        "some.yaml": split_text(combined()),
        "wrong.yaml": split_text(combined(train=[wrong])),
        "small.yaml": small,
        "again.yaml": small,
    }


@pytest.fixture
def _inputs():
    """The files and folders that the refused command lines name."""
    for name in ("folder", "folder.csv", "begun", "stumps"):
        Path(name).mkdir()
    urdf = '<robot name="r"><link name="a">{}</link></robot>'
    mesh = '<visual><geometry><mesh filename="../../etc/hand.stl"/></geometry></visual>'
    texts = {"file": "a plain file", "broken.yaml": "format: [1\n", "begun/set.json": "{}"}
    texts |= {"bare.urdf": urdf.format("")}
    texts |= {"climbing.urdf": urdf.format(mesh), "broken.urdf": "<robot>\n<link>\n</robot>"}
    texts |= {"flat.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n"}
    texts |= {"stumps/stump.yaml": "name: stump\nkind: [\n"}
    texts |= {"some.pt": "something else", "a.json": "{}"}
    for name, text in (texts | texts_of_splits()).items():
        Path(name).write_text(text, encoding="utf-8")
    write_mjcf(Path(), TWO_JOINTS, "a.xml")


@pytest.mark.usefixtures("_inputs", "own_cache", "nothing_is_stored")
@pytest.mark.parametrize("refusal", REFUSALS.strip().splitlines())
def test_invalid_arguments_are_refused_in_one_line(refused, refusal):
    line, _, reason = refusal.replace("TASKS", ", ".join(sorted(TASKS))).partition(" => ")
    first, *words = shlex.split(line)
    assert reason in refused(*shlex.split(ABBREVIATIONS.get(first, first)), *words)


COMPOSE = ("compose", "base=gantry", "ee=plane", "--no-picture", "--out", "out")


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


def test_unknown_link_names_suggest_the_nearest(refused, robot_urdf):
    path = robot_urdf(arm())
    assert "did you mean 'slider'" in refused("import", path, "--tool", "slidr")
    assert "named by --root-link" in refused("import", path, "--root", "base")


def test_errors_are_printed_as_json_with_the_json_option(run):
    code, out, err = run("compose", "arm=ur55", "--json")
    assert code == 2
    data = json.loads(out)
    assert data["error"] == "PartError"
    assert err == f"morphgen: {data['message']}\n"


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
    assert run(*COMPOSE)[0] == 0
    edited = Path("out/gantry-plane") / file
    edited.parent.mkdir(exist_ok=True)
    with edited.open("a") as stream:
        stream.write("<!-- years of work -->")
    assert f"out/gantry-plane is not replaced: {why}; move the folder away" in refused(*COMPOSE)
    assert "years of work" in edited.read_text()
    fitted = ("fit", "base=gantry", "ee=plane", "--no-picture", "--out", "out/gantry-plane")
    assert f"out/gantry-plane is not replaced: {why}" in refused(*fitted)


def test_a_bundle_with_exported_files_is_replaced(run):
    assert run(*COMPOSE)[0] == 0
    for name in FILES:
        (Path("out/gantry-plane") / f"robot.{name}").touch()
    (Path("out/gantry-plane/.DS_Store")).touch()  # of a file manager
    (Path("out/gantry-plane/robot.urdf")).unlink()  # a damaged bundle is mended
    assert run(*COMPOSE)[0] == 0
    names = {path.name for path in Path("out/gantry-plane").iterdir()}
    assert names == {"robot.urdf", "robot.xml", "card.json"}


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


def test_ctrl_c_during_imports_prints_one_line(run, monkeypatch):
    monkeypatch.setattr(cli, "build_parser", interrupt)
    assert run("list") == (130, "", "morphgen: interrupted; nothing half-written is left\n")


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

    monkeypatch.setattr("morphgen.cli.options.default_library", swallow)
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


UNSOUND = {
    "unused value": "let unused = uniform(1, 2)\nrobot -> base arm3\nbase -> fixed\n",
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
        ["sample", "mine.grammar", "-n", 1, "--out", "out"],
        ["compose", "mine.grammar"],
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
    assert (len(numbers) > 60, unchecked) == (True, set())
