"""Splits: list, show, new, audit, build, verify and stats."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member
from morphgen.splits.split import read_split, split_id, split_names, split_text
from morphgen.tasks.split_goals import read_goals

INTERPOLATION = ("split", "new", "interpolation", "--grammar", "cubes", "--train", "3")
COMPOSITION = ("split", "new", "composition", "--from", "base=gantry ee={plane,cube}")
COMPOSITION += ("--from", "arm=lwr ee={plane,cube}", "--train", "3")
EXTRAPOLATION = ("split", "new", "extrapolation", "--train-category", "stick,nlink,prims")
EXTRAPOLATION += ("--test-category", "chain", "--train", "6")
HOLD_OUT = ("split", "new", "--hold-out", "ee=plane", "--train", "2")
HOLD_OUT += ("--from", "arm={lwr,arm3} ee={plane,cube,stick}")


def test_list_has_one_row_per_split(run, ok):
    out = ok("split", "list")
    header, _, *rows = out.splitlines()
    columns = ["name", "regime", "task", "train", "test", "categories", "summary"]
    assert header.split() == columns
    assert [row.split()[0] for row in rows] == split_names()
    row = next(row for row in rows if row.startswith("interpolation/arm3/push-obstacles "))
    assert row.split()[1:9] == [*"interpolation push (obstacles) 10 1 arm3 -> arm3".split()]  # noqa: SIM905
    data = json.loads(run("split", "list", "--json")[1])
    facts = next(each for each in data if each["name"] == "composition/ee-task")
    assert facts["tasks"] == ["push", "reach"]
    assert facts["train_categories"] == {"prims": 3, "composed": 1}
    assert (facts["train"], facts["test"], facts["regime"]) == (4, 1, "composition")


def test_show_prints_one_row_per_robot(ok):
    out = ok("split", "show", "composition/ee-arm/reach")
    split = read_split("composition/ee-arm/reach")
    assert f"  id: {split_id(split)}\n" in out
    assert "table 1: Composition, EE Arm" in out
    assert "accepted part-unseen: the paper's own" in out
    assert "\ntrain, 10: 7 prims, 3 composed\n" in out
    assert "\ntest, 1: 1 composed\n" in out
    for each in (*split.train, *split.test):
        (row,) = [line for line in out.splitlines() if line.startswith(f"{each.name} ")]
        assert row.split()[1:4] == ["reach", each.category, each.robot_hash[:8]]
    assert "base=fixed(spread=0.6)[top: arm=ur5[flange: ee=plane(size..." in out


def test_new_prints_a_summary_and_the_next_command(run, ok, tmp_path):
    name = "interpolation-cubes-reach-seed4"
    assert ok(*INTERPOLATION, "--seed", 4).splitlines() == [
        f"{name}.yaml: 3 robots of cubes; test: 1 more",
        "  test: cubes-test-000000",
        f"next: morphgen split audit {name}.yaml",
    ]
    assert list(tree(tmp_path)) == [f"{name}.yaml"]
    split = read_split(f"{name}.yaml")
    assert (split.name, split.regime, len(split.train)) == (name, "interpolation", 3)
    assert run("split", "show", f"{name}.yaml")[0] == 0


@pytest.mark.parametrize(
    ("argv", "options", "name", "counts"),
    [
        (INTERPOLATION, "", "interpolation-cubes-reach-seed0", (3, 1)),
        (
            *(INTERPOLATION, "--hull inside --task push --obstacles"),
            *("interpolation-cubes-inside-push-obstacles-seed0", (3, 1)),
        ),
        (COMPOSITION, "", "composition-ee-reach-seed0", (3, 1)),
        (HOLD_OUT, "", "hold-out-ee-plane-reach-seed0", (2, 1)),
        (
            *(HOLD_OUT, "--hold-out arm=arm3 --test 2 --task push"),
            *("hold-out-ee-plane-arm-arm3-push-seed0", (2, 2)),
        ),
        (
            *(EXTRAPOLATION, "--test 2 --task reach,push"),
            *("extrapolation-chain-reach-push-seed0", (12, 4)),
        ),
    ],
)
def test_every_regime_can_be_created(run, argv, options, name, counts):
    data = json.loads(run(*argv, *options.split(), "--json")[1])
    split = read_split(f"{name}.yaml")
    written = {"file": f"{name}.yaml", "name": name, "id": split_id(split)}
    assert data == [written | dict(zip(("train", "test"), counts, strict=True))]
    assert (len(split.train), len(split.test)) == counts


def test_a_hold_out_split_passes_its_audit(ok):
    words = ("split", "new", "--hold-out", "arm=kinova*", "--name", "my/no-kinova")
    words += ("--from", "arm={mico,kinova_gen3} ee={plane,stick}", "--train", "2")
    out = ok(*words)
    lines = out.splitlines()
    assert lines[0] == "my/no-kinova.yaml: 2 robots without arm=kinova*; test: 1 with it"
    assert lines[1] in ("  test: kinova_gen3+plane", "  test: kinova_gen3+stick")
    assert lines[-1] == "next: morphgen split audit my/no-kinova.yaml"
    out = ok("split", "audit", "my/no-kinova.yaml", "--strict")
    assert out.endswith("my/no-kinova: passed: 0 error, 0 warning, 0 accepted\n")


def test_robots_that_were_left_out_are_counted_with_their_reason(ok):
    pattern = "arm={lwr,panda,kinova_gen3,ur5,arm3} ee={plane,stick}"
    options = ("--from", pattern, "--test", "2", "--max-links", "10", "--seed", "2")
    line = "  robots that were left out: 2 with more than 10 links"
    assert line in ok(*HOLD_OUT[:-2], *options).splitlines()


def test_several_train_sizes_write_one_file_each(run, ok):
    out = ok(*INTERPOLATION[:-1], "1,2,4", "--name", "my/cubes", "--out", "splits")
    paths = [Path(f"splits/my/cubes-train{n}.yaml") for n in (1, 2, 4)]
    assert [line.partition(":")[0] for line in out.splitlines()[::2]] == [*map(str, paths), "next"]
    splits = [read_split(path) for path in paths]
    assert [split.name for split in splits] == [f"my/cubes-train{n}" for n in (1, 2, 4)]
    assert splits[0].train == splits[2].train[:1]
    assert run(*INTERPOLATION[:-1], "1,2", "--out", "a.yaml")[0] == 0
    assert Path("a-train1.yaml").is_file()
    assert Path("a-train2.yaml").is_file()


def test_existing_split_file_is_never_replaced(run, refused):
    assert run(*INTERPOLATION, "--out", "a.yaml")[0] == 0
    message = refused(*INTERPOLATION, "--out", "a.yaml", "--seed", 1)
    assert "a.yaml exists with another content; choose another name or path" in message
    Path("b-train2.yaml").write_text("thesis")
    assert "b-train2.yaml exists" in refused(*INTERPOLATION[:-1], "1,2", "--out", "b.yaml")


def test_split_file_of_another_version_is_kept(run):
    assert run(*INTERPOLATION, "--out", "a.yaml")[0] == 0
    path = Path("a.yaml")
    text = re.sub(r"(?m)^morphgen: .*$", 'morphgen: "0.0.1"', path.read_text())
    path.write_text(text)
    assert run(*INTERPOLATION, "--out", "a.yaml")[0] == 0
    assert path.read_text() == text


@pytest.fixture
def write(tmp_path):
    """Write a split's file; return its name."""

    def written(definition, name="some.yaml"):
        (tmp_path / name).write_text(split_text(definition))
        return name

    return written


def leaky():
    """A split in which every test robot leaks from the train side."""
    twin = member(TRAIN[0], "twin")
    near = member(f"{TRAIN[1]} ee.size=100.1mm", "near")
    return combined(test=[*TEST, twin, near, "base=planar ee=sphere"])


def test_valid_split_passes_the_audit(ok, write):
    out = ok("split", "audit", write(combined()))
    header, _, row, verdict = out.splitlines()
    assert header.split("  ")[0] == "test robot"
    assert [row.count(name) for name in ("planar-plane", "planar-cube")] == [1, 3]
    assert verdict == "mine/some: passed: 0 error, 0 warning, 0 accepted"


def test_leaky_split_fails_the_audit_with_reasons(run, write):
    code, out, err = run("split", "audit", write(leaky()))
    assert (code, err) == (1, "")
    lines = out.splitlines()
    i = lines.index("error body-shared (1)")
    assert lines[i + 1 : i + 3] == [
        "  test robot twin: train robot gantry-plane has the same body, and learns the same task",
        "    fix: leave it out of one side",
    ]
    for line in ("error body-near (1)", "error combination-seen (2)", "error part-unseen (1)"):
        assert line in lines
    assert lines[-1] == "mine/some: FAILED: 5 error, 0 warning, 0 accepted"
    code, out, err = run("split", "audit", "some.yaml", "--json")
    data = json.loads(out)
    assert (code, err, data["split"], data["passed"]) == (1, "", "mine/some", False)
    codes = {"body-shared", "body-near", "combination-seen", "part-unseen"}
    assert {each["code"] for each in data["findings"]} == codes
    assert data["nearest"]["twin"]["tree"] == {"train": "gantry-plane", "value": 0.0}


def test_strict_option_makes_warnings_fail(run, write):
    path = write(combined(accepted={"hull": "nobody knows"}))
    code, out, _ = run("split", "audit", path)
    assert (code, "warning accepted-unused (1)" in out) == (0, True)
    assert run("split", "audit", path, "--strict")[0] == 1


def test_long_lists_of_findings_are_shortened(run, write):
    many = [replace(member(TRAIN[0], f"robot-{i}"), robot_hash=f"{i:032d}") for i in range(14)]
    _, out, _ = run("split", "audit", write(combined(train=[*TRAIN, *many])))
    lines = out.splitlines()
    i = lines.index("error body-changed (14)")
    assert lines[i + 11] == "  and 4 more (--json lists all)"


def test_build_prints_its_folder_and_passes_verify(ok, write):
    path = write(combined())
    out = ok("split", "build", path)
    assert out.splitlines() == [
        "data/mine/some: 4 robots written, 0 already existed",
        "verify it anywhere: morphgen split verify data/mine/some",
    ]
    first = tree(Path("data"))
    out = ok("split", "build", path, "--json")
    assert json.loads(out) == {"folder": "data/mine/some", "made": 0, "kept": 4}
    assert tree(Path("data")) == first
    for what in (path, "data/mine/some"):
        out = ok("split", "verify", what)
        assert out == f"mine/some, id {split_id(combined())}: all 4 robots are the same\n"


def test_verify_prints_differences_per_robot(run, write):
    run("split", "build", write(combined()), "--out", "out")
    folder = Path("out/mine/some/robots/planar-cube")
    (folder / "robot.xml").write_text("<mujoco/>")
    code, out, err = run("split", "verify", "out/mine/some")
    assert (code, err) == (1, "")
    assert out.splitlines() == [
        f"mine/some, id {split_id(combined())}: 1 difference",
        "  planar-cube: file robot.xml is not what SHA256SUMS was written for",
    ]
    code, out, _ = run("split", "verify", "out/mine/some", "--json")
    data = json.loads(out)
    assert (code, data["passed"]) == (1, False)
    assert [each["where"] for each in data["differences"]] == ["planar-cube"]


def test_stats_has_a_row_per_set_of_robots(ok):
    out = ok("split", "stats", "composition/ee-task", "extrapolation/primitives/reach")
    _, _, task, primitives, _, _ = out.splitlines()
    cells = [cell.strip() for cell in task.split("  ") if cell]
    assert cells[:6] == ["composition/ee-task", "4", "1", "7.75", "5.25", "5.25"]
    assert "0.44" in primitives


def test_stats_merges_splits_with_the_same_robots(run, write):
    path = write(combined(name="mine/some/push"))
    other = write(reaching(name="mine/some/reach"), "other.yaml")
    code, out, _ = run("split", "stats", path, other, "--json")
    (row,) = json.loads(out)["rows"]
    assert code == 0
    assert (row["robots"], row["splits"]) == ("mine/some", ["mine/some/push", "mine/some/reach"])
    assert row["statistics"]["train"]["robots"] == 3


@pytest.mark.slow
def test_all_scenarios_have_a_row_and_pass_their_audit(run):
    _, out, _ = run("split", "stats", "--json")
    rows = json.loads(out)["rows"]
    assert sum(len(row["splits"]) for row in rows) == len(split_names()) == 36
    for name in split_names():
        assert run("split", "audit", name, "--strict")[0] == 0, name


def reaching(**more):
    """A valid split of reach robots."""
    train, test = ([member(words, task="reach") for words in side] for side in (TRAIN, TEST))
    return combined(train=train, test=test, **more)


@pytest.mark.usefixtures("goal_cache")
def test_goal_seed_is_printed_and_stored(ok, write):
    out = ok("split", "build", write(reaching()), "--goals", "--goal-seed", "7")
    assert out.splitlines()[1] == "4 goal sets, seed 7"
    assert {one.seed for one in read_goals("data/mine/some", "train").values()} == {7}
