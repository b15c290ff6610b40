"""``import morphgen`` gives the public API and loads packages only when used."""

import ast
import doctest
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import trimesh

import morphgen
from morphgen.api.splits import LoadedSplit
from morphgen.cli import main
from morphgen.errors import MorphgenError

FUNCTIONS = (
    *("check", "clone", "compose", "conform", "demos", "evaluate", "export", "fit", "goals"),
    *("make_env", "play", "read", "record", "sample", "similarity", "split", "tokens", "train"),
    *("verify", "write"),
)


@pytest.mark.parametrize(
    ("request_text", "words"),
    [
        ("arm=lwr ee=plane ee.size=80mm", {"arm": "lwr", "ee": "plane", "ee.size": 0.08}),
        ("lwr-plane", {"arm": "lwr", "ee": "plane"}),
    ],
)
def test_parts_may_be_keywords_or_joined_by_dashes(request_text, words):
    robot, same = morphgen.compose(request_text), morphgen.compose(**words)
    assert (robot.name, robot.links, robot.joints) == (same.name, same.links, same.joints)


def test_dir_lists_the_public_functions():
    assert set(morphgen.__all__) == {*FUNCTIONS, "__version__", "MorphgenError", "Robot", "fix"}
    assert dir(morphgen) == sorted(morphgen.__all__)
    assert all(getattr(morphgen, name) is not None for name in morphgen.__all__)
    assert morphgen.MorphgenError is MorphgenError
    assert morphgen.tasks.make_batch
    with pytest.raises(AttributeError, match="no attribute 'composed'"):
        _ = morphgen.composed


def test_type_checkers_see_every_public_name():
    tree = ast.parse(Path(morphgen.__file__).read_text(encoding="utf-8"))
    conditions = [node for node in tree.body if isinstance(node, ast.If)]
    (block,) = (each for each in conditions if ast.unparse(each.test) == "TYPE_CHECKING")
    imported = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    modules = {alias.name: node.module for node in imported for alias in node.names}
    assert modules.pop("tasks") == "morphgen"
    assert modules == morphgen._MODULES
    assert set(morphgen.__all__) == {*modules, "__version__"}


def test_a_robot_prints_as_one_line():
    robot = morphgen.compose("lwr-plane")
    facts = f"{len(robot.links)} links, 7 independent joints, 16.11 kg"
    assert repr(robot) == f"Robot('lwr-plane': {facts})"


EXAMPLES = {name: getattr(morphgen, name) for name in FUNCTIONS}
EXAMPLES |= {f"split.{name}": getattr(LoadedSplit, name) for name in ("write", "build", "verify")}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "fit")) for name in EXAMPLES]
)
def test_documentation_examples_work(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder().find(EXAMPLES[name], name, globs={})
    assert example.examples
    example.globs["morphgen"] = morphgen
    assert doctest.DocTestRunner().run(example).failed == 0


def test_robots_may_be_named(tmp_path):
    robot = morphgen.compose("arm3-stick")
    folder = morphgen.write(robot, tmp_path, picture=False)
    tables = [morphgen.tokens(each) for each in (robot, "arm3-stick", folder, str(folder))]
    assert all(np.array_equal(table, tables[0]) for table in tables)
    assert morphgen.check(robot) == morphgen.check("arm3-stick") == morphgen.check(folder)
    (folder / "robot.urdf").write_text("<robot/>")
    assert "error" in {finding.severity for finding in morphgen.check(folder)}
    reports = [morphgen.conform(each, samples=2) for each in ("arm3-stick", robot)]
    assert reports[0] == reports[1]


def test_a_name_that_is_a_path_leaves_the_folder_alone(tmp_path):
    robot = replace(morphgen.compose("prims"), name="../x")
    with pytest.raises(MorphgenError, match=r"name '\.\./x': use letters"):
        morphgen.write(robot, tmp_path / "out", picture=False)
    assert list(tmp_path.iterdir()) == []


def test_repairs_take_a_robot_by_its_name():
    robot, repaired = morphgen.fix("prims")
    assert (robot.name, repaired) == ("prims", ())


def test_fit_returns_robot_and_report(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.export(tmp_path / "box.stl")
    fitted = morphgen.fit(tmp_path / "box.stl")
    ((shape,),) = (link.collisions for link in fitted.robot.links)
    assert sorted(shape.geometry.size) == pytest.approx([0.1, 0.2, 0.3], abs=2e-3)
    assert fitted.report.mean.iou > 0.95
    assert fitted.source.name == fitted.robot.name == "box"


def test_library_may_be_one_folder(tmp_path):
    (tmp_path / "two.grammar").write_text("robot -> base arm3\nbase -> fixed\n")
    (robot,) = morphgen.sample("two", 1, library=str(tmp_path))
    assert robot.name == "two-000000"


def test_split_has_robots_statistics_and_audit():
    scenario = morphgen.split("interpolation/arm3/reach")
    assert scenario.name == "interpolation/arm3/reach"
    assert [robot.name for robot in scenario.train] == [m.name for m in scenario.definition.train]
    assert scenario.train is scenario.train
    assert scenario.statistics() == scenario.definition.statistics
    assert scenario.audit().split == scenario.name


def test_a_split_is_chosen_written_built_audited_and_verified(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rules = {"hold_out": ["ee=cube"], "robots": "arm={arm3,arm5} ee={cube,stick}"}
    split = morphgen.split("my/cubes", train=2, test=2, task=["reach"], **rules)
    assert [len(side) for side in (split.train, split.test)] == [2, 2]
    file = split.write()
    assert (str(file), split.write("own.yaml").name) == ("my/cubes.yaml", "own.yaml")
    assert split.write() == file
    with pytest.raises(MorphgenError, match=r"own\.yaml exists with another content; choose"):
        morphgen.split("interpolation/arm3/reach").write("own.yaml")
    assert morphgen.split(file).definition == split.definition
    folder = split.build("data", goals=True, goal_seed=1)
    built = morphgen.split(folder)
    assert (built.verify(), split.verify()) == ((), ())
    assert built.audit().passed()
    with pytest.raises(MorphgenError, match="was built with goals: ask for goals"):
        split.build("data")
    (folder / "robots" / split.test[0].name / "robot.urdf").write_text("<robot/>")
    assert [each.where for each in built.verify()] == [split.test[0].name]


@pytest.mark.slow
def test_splits_of_every_regime_are_those_of_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pattern = "arm={lwr,z1,ur5} ee={stick,plane}"
    for words, arguments in (
        (["--hold-out", "ee=plane", "--from", pattern, "--train", "2"],
         {"hold_out": "ee=plane", "robots": pattern, "train": 2}),
        (["interpolation", "--grammar", "arm3", "--hull", "inside", "--seed", "3"],
         {"regime": "interpolation", "grammar": "arm3", "hull": "inside", "seed": 3}),
        (["composition", "--from", pattern, "--task", "push", "--obstacles", "--train", "5"],
         {"regime": "composition", "robots": pattern, "task": "push", "obstacles": True,
          "train": 5}),
        (["extrapolation", "--train-category", "stick,nlink", "--test-category", "chain",
          "--train", "2,4", "--max-links", "25"],
         {"regime": "extrapolation", "train_category": ["stick", "nlink"], "train": [2, 4],
          "test_category": "chain", "max_links": 25}),
    ):  # fmt: skip
        assert main(["split", "new", *words, "--out", "cli"]) == 0
        splits = morphgen.split(**arguments)
        for split in splits if isinstance(splits, tuple) else [splits]:
            file = split.write("api")
            assert file.read_bytes() == (Path("cli") / file.relative_to("api")).read_bytes()


def test_vector_environments_of_one_keep_their_axis():
    env = morphgen.make_env("reach", "arm3-stick", sim="kinematic")
    (vector,) = (morphgen.make_env("reach", "arm3-stick", num_envs=1, sim="kinematic"),)
    assert isinstance(env, gymnasium.Env)
    assert isinstance(vector, gymnasium.vector.VectorEnv)
    assert vector.action_space.shape == (1, 5)
    env.close()
    vector.close()


def held_out(**arguments):
    return morphgen.split(hold_out="arm=lwr", **arguments)


def prims_env(**options):
    return morphgen.make_env("reach", "prims", **options)


REFUSALS = """
compose("arm=lwrr") => did you mean 'lwr'
compose("prims", geometry="meshes") => did you mean 'mesh'
sample("arm3", 1, seed=-1) => sample: seed -1: expected a whole number
sample("arm3", 1.5) => sample: n 1.5: expected a whole number, 0 or mor
held_out(train="3") => train '3': expected a whole num
held_out(max_links=None) => max_links None: expected
check(3) => 3 is no robot; expected a Robot, a path, or a name
conform("no/such/folder") => no/such/folder: no such file or folder
conform("prims", samples=0) => samples 0: expected a whole number, 1
conform("prims", seed=None) => seed None: expected a whole number, 0
compose(Path("ur5")) => expected words, such as ur5-plane
compose("prims", library=None) => library None: expected a folder, or
compose("chain beads=5.5") => valid: a whole number of repetitions, bead
split(hold_out=None) => hold_out None: expected a text, or several
held_out(robots=[3]) => split: robots [3]: expected a
held_out(task=None) => split: task None: expected a text
sample(".", 1) => unknown grammar '.'
similarity(["prims", "prims"], []) => no measure is named; valid: cos
similarity(["prims", "prims"], "cosin") => 'cosin'; did you mean 'cosine'? valid: cos
tokens("arm3-stick", max_links=23.5) => max_links 23.5: expected a whole
held_out(seed=True) => split: seed True: expected a whole number
held_out(obstacles="no") => split: obstacles 'no': expected True or False
prims_env(obstacles="no") => obstacles 'no': expected True or False
prims_env(goal_seed=1.5) => goal seed 1.5: expected a whole number, 0
prims_env(size=64) => size 64: expected width and height
prims_env(size=(0, 9)) => size 0: expected a whole number, 1 or more
prims_env(size=(10**9, 9)) => expected at most 4,096 pixels each
prims_env(observe="ik") => observe 'ik': expected an Observation
prims_env(num_envs="2") => number of environments '2': expected a
prims_env(num_envs=1, seed="x") => seed 'x': expected a whole numb
prims_env(num_envs=1, configs=3) => configs 3: expected a list
prims_env(num_envs=1, configs=[3]) => config int: its task None is unknown
similarity("arm3-stick") => 1 robots to compare; expected a list
similarity(["prims", "z1"], ["tee"]) => did you mean 'tree'
split() => no split is named; expected a name, or hold_out or regime
split("a", test=2) => hold-out: hold_out is missing; valid: hold_out, ro
split(hold_out="arm=lwrr") => no arm matches 'lwrr'; did you mean 'lwr'
held_out(hull="any") => hold-out: no effect of hull; va
split(regime="extrapolate") => unknown regime 'extrapolate'; did you mean 'extra
split(regime="interpolation", grammar=["arm3", "arm5"]) => 2 grammars
held_out(task="reech") => unknown task 'reech'; did yo
split("../a", hold_out="arm=lwr") => name '../a': use letters, digits
split(holdout="arm=lwr") => argument 'holdout'; did you mean 'hold_out'
make_env("reech") => did you mean 'reach'
make_env("reach", workers=2) => unknown option 'workers'
make_env("reach", ["prims"]) => name several with num_envs
make_env("reach", [], num_envs=2) => expected at least one robot
make_env("reach", num_envs=2, config=3) => int is not the config of reach
make_env("reach", num_envs=2, autoreset_mode="NextStep") => unknown option 'autoreset_mode'
prims_env(num_envs=0) => 0 environments
prims_env(num_envs=10**30) => at most 1,048,576 environments
prims_env(num_envs=2, max_links=10**12) => expected 2 to 10000
export("prims", "gltf") => unknown format 'gltf'; did you mean 'glb'
export("prims", "stl") => unknown format 'stl'; valid: curobo, gif
train("prims") => prims: no such file, and no split of this name
train("prims task=reach", steps="9") => steps '9': expected a whole number, 1
train("prims task=reach", sim="mujco") => did you mean 'mujoco'
train("prims task=reach", sim=3) => sim 3: expected a text
train("prims task=reach", robot_seed=1) => only with drawn
evaluate("ik", "prims task=reach", mode="best") => unknown mode 'best'; valid: deter
evaluate("ik", "prims task=reach", episodes=None) => episodes None: expected a whole num
evaluate("zero-shot", goal_seed=1) => goal_seed and library: only with robots
evaluate("zero-shot", method="mine") => method: only with submission
evaluate("zero-shot", "prims task=reach", on="tests") => unknown side 'tests'
play("reach", "prims", episodes=0) => episodes 0: expected a whole number, 1
play("push", "prims", policy="ik") => valid: scripted, path, zero, random
goals("arm=ur5 ee=stick") => name one split, or say --task for a robot
goals("interpolation/arm3/reach", obstacles=True) => obstacles: only with task
fit("ur5", iou=None) => iou None: expected a number
fit("ur5", max_primitives=None) => max_primitives None: expected a whole number
compose(arm=None) => arm None: expected a text or a number
write("prims", 5) => folder 5: expected a path
"""
"""Calls of public functions that are refused, and part of the reason."""


@pytest.mark.parametrize("refusal", REFUSALS.strip().splitlines())
def test_invalid_arguments_give_one_clear_error(refusal):
    call, _, reason = refusal.partition(" => ")
    names = {name: getattr(morphgen, name) for name in FUNCTIONS}
    with pytest.raises(MorphgenError) as caught:
        eval(call, {**names, "Path": Path, "held_out": held_out, "prims_env": prims_env})
    assert reason in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


NOT_TEXTS = (5, None, [3], {}, 1.5, b"x", object())


@pytest.mark.parametrize(
    "call",
    [
        lambda value: morphgen.compose(arm=value if value not in (5, 1.5) else None),
        lambda value: morphgen.compose("prims", geometry=value),
        lambda value: morphgen.read(value),
        lambda value: morphgen.write("prims", value),
        lambda value: morphgen.sample(value, 1),
        lambda value: morphgen.split(value),
        lambda value: morphgen.make_env(value),
        lambda value: morphgen.make_env("reach", "prims", kind=value),
        lambda value: morphgen.similarity(value),
        lambda value: morphgen.similarity(["prims", "z1-plane"], [value]),
        lambda value: morphgen.check(value),
        lambda value: morphgen.train(value),
        lambda value: morphgen.train("prims task=reach", agent=5 if value is None else value),
        lambda value: morphgen.evaluate(value),
        lambda value: morphgen.play(value, "prims"),
        lambda value: morphgen.goals(value),
        lambda value: morphgen.export("prims", value),
    ],
)
def test_values_that_are_no_texts_give_one_clear_error(call):
    for value in NOT_TEXTS:
        with pytest.raises(MorphgenError) as caught:
            call(value)
        assert len(str(caught.value).splitlines()) == 1
