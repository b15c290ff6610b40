"""``morphgen split list``, ``show`` and ``new``: output, written files and rejected input."""

import json
import re
from pathlib import Path

import pytest
import yaml

from helpers.commands import tree
from morphgen.grammar.library import LIBRARY_VARIABLE
from morphgen.splits.split import split_id
from morphgen.splits.split_file import read_split, split_names

INTERPOLATION = ("split", "new", "interpolation", "--grammar", "cubes", "--train", "3")
COMPOSITION = ("split", "new", "composition", "--from", "base=gantry ee={plane,cube}")
COMPOSITION += ("--from", "arm=lwr ee={plane,cube}")
EXTRAPOLATION = ("split", "new", "extrapolation", "--train-category", "stick,nlink,prims")
EXTRAPOLATION += ("--test-category", "chain", "--train", "6")
HOLD_OUT = ("split", "new", "--hold-out", "ee=plane", "--train", "2")
HOLD_OUT += ("--from", "arm={lwr,arm3} ee={plane,cube,stick}")


def test_list_has_one_row_per_split(run, ok):
    out = ok("split", "list")
    header, _, *rows = out.splitlines()
    assert header.split() == [
        "name", "regime", "task", "train", "test", "categories", "summary",
    ]  # fmt: skip
    assert [row.split()[0] for row in rows] == split_names()
    row = next(row for row in rows if row.startswith("interpolation/arm3/push-obstacles "))
    assert row.split()[1:9] == [*"interpolation push (obstacles) 10 1 arm3 -> arm3".split()]  # noqa: SIM905
    data = json.loads(run("split", "list", "--json")[1])
    facts = next(each for each in data if each["name"] == "composition/ee-task")
    assert facts["tasks"] == ["push", "reach"]
    assert facts["train_categories"] == {"prims": 3, "composed": 1}
    assert (facts["train"], facts["test"], facts["regime"]) == (4, 1, "composition")


def test_show_prints_one_row_per_robot(run):
    code, out, err = run("split", "show", "composition/ee-arm/reach")
    split = read_split("composition/ee-arm/reach")
    assert (code, err) == (0, "")
    assert f"  id: {split_id(split)}\n" in out
    assert "table 1: Composition, EE Arm" in out
    assert "accepted part-unseen: the paper's own" in out
    assert "\ntrain, 10: 7 prims, 3 composed\n" in out
    assert "\ntest, 1: 1 composed\n" in out
    for member in (*split.train, *split.test):
        (row,) = [line for line in out.splitlines() if line.startswith(f"{member.name} ")]
        assert row.split()[1:4] == ["reach", member.category, member.robot_hash[:8]]
    assert "base=fixed(spread=0.6)[top: arm=ur5[flange: ee=plane(size..." in out
    full = run("split", "show", "composition/ee-arm/reach", "--full")[1]
    assert all(member.derivation in full for member in split.train)
    assert "{robots: 3, grammar: prims, pinned: prim=plane, seed: " in full


def test_show_prints_json(run):
    data = json.loads(run("split", "show", "extrapolation/arms/push", "--json")[1])
    split = read_split("extrapolation/arms/push")
    assert data["id"] == split_id(split)
    assert data["train"][0]["derivation"] == split.train[0].derivation
    assert data["statistics"] == split.statistics


def test_new_prints_a_summary_and_the_next_command(run, tmp_path):
    code, out, err = run(*INTERPOLATION, "--seed", 4)
    name = "interpolation-cubes-reach-seed4"
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"{name}.yaml: 3 robots of cubes; test: 1 besides",
        "  test: cubes-test-000000",
        f"next: morphgen split audit {name}.yaml",
    ]
    assert list(tree(tmp_path)) == [f"{name}.yaml"]
    split = read_split(f"{name}.yaml")
    assert (split.name, split.regime, len(split.train)) == (name, "interpolation", 3)
    assert run("split", "show", f"{name}.yaml")[0] == 0


@pytest.mark.parametrize(
    ("argv", "name", "counts"),
    [
        (INTERPOLATION, "interpolation-cubes-reach-seed0", (3, 1)),
        (
            (*INTERPOLATION, "--hull", "inside", "--task", "push", "--obstacles"),
            "interpolation-cubes-inside-push-obstacles-seed0",
            (3, 1),
        ),
        (COMPOSITION, "composition-ee-reach-seed0", (3, 1)),
        (HOLD_OUT, "hold-out-ee-plane-reach-seed0", (2, 1)),
        (
            (*HOLD_OUT, "--hold-out", "arm3.length=0.3..0.4", "--test", "2", "--task", "push"),
            "hold-out-ee-plane-arm3.length-0.3..0.4-push-seed0",
            (2, 2),
        ),
        (
            (*EXTRAPOLATION, "--similarity", "<0.6", "--test", "2", "--task", "reach,push"),
            "extrapolation-chain-reach-push-seed0",
            (12, 4),
        ),
    ],
)
def test_every_regime_can_be_created(run, argv, name, counts):
    data = json.loads(run(*argv, "--json")[1])
    split = read_split(f"{name}.yaml")
    assert data == [
        {
            "file": f"{name}.yaml",
            "name": name,
            "id": split_id(split),
            "train": counts[0],
            "test": counts[1],
            "restricted": [],
        }
    ]
    assert (len(split.train), len(split.test)) == counts


def test_a_hold_out_split_says_what_it_lacks_and_passes_its_audit(run, ok):
    words = ("split", "new", "--hold-out", "arm=kinova*", "--name", "my/no-kinova")
    words += ("--from", "arm={mico,kinova_gen3} ee={plane,stick}", "--train", "2")
    out = ok(*words)
    lines = out.splitlines()
    assert lines[0] == "my/no-kinova.yaml: 2 robots without arm=kinova*; test: 1 with it"
    assert lines[1] in ("  test: kinova_gen3+plane", "  test: kinova_gen3+stick")
    assert (
        "  note: train robots have mico; --hold-out arm.manufacturer=Kinova excludes parts of that "
        "manufacturer"
    ) in lines
    assert lines[-1] == "next: morphgen split audit my/no-kinova.yaml"
    before = Path("my/no-kinova.yaml").read_bytes()
    assert run(*words, "--out", "again.yaml")[0] == 0
    assert Path("again.yaml").read_bytes() == before
    code, out, _ = run("split", "audit", "my/no-kinova.yaml", "--strict")
    assert (code, out.splitlines()[-1]) == (
        0,
        "my/no-kinova: passed: 0 error, 0 warning, 0 accepted",
    )
    assert run("split", "verify", "my/no-kinova.yaml")[0] == 0


def test_a_new_split_names_what_a_release_of_it_must_allow(run, ok):
    words = ("split", "new", "--hold-out", "ee=sake_ez", "--name", "my/sake", "--train", "2")
    words += ("--from", "arm={ur5,fetch_arm} ee={sake_ez,plane}")
    out = ok(*words)
    (line,) = [line.strip() for line in out.splitlines() if "restricted" in line]
    assert "fetch_arm (CC-BY-NC-SA-4.0: non-commercial, share-alike) in robots fetch_arm+" in line
    assert line.endswith("; split release needs --licence-allow CC-BY-NC-ND-4.0,CC-BY-NC-SA-4.0")
    assert line in run("split", "audit", "my/sake.yaml")[1].splitlines()
    audited = json.loads(run("split", "audit", "my/sake.yaml", "--json")[1])
    assert [part["part"] for part in audited["restricted"]] == ["sake_ez", "fetch_arm"]
    (made,) = json.loads(run(*words, "--out", "again.yaml", "--json")[1])
    assert made["restricted"] == audited["restricted"]
    allowed = line.rpartition(" ")[2]
    release = ("split", "release", "my/sake.yaml", "--light", "--no-goals")
    assert run(*release)[0] == 2
    assert run(*release, "--licence-allow", allowed)[0] == 0


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


def test_statistics_option_adds_statistics(run):
    run(*INTERPOLATION, "--out", "a.yaml", "--statistics")
    run(*INTERPOLATION, "--out", "b.yaml")
    a, b = read_split("a.yaml"), read_split("b.yaml")
    assert a.statistics["train"]["links"] == 3
    assert (b.statistics, split_id(b)) == ({}, split_id(a))


def test_duplicate_train_robots_are_reported(run):
    Path("two.grammar").write_text(
        "robot -> gantry ee\nee -> @weight(30) plane(size=0.1) | plane(size=0.2)\n"
    )
    _, out, _ = run("split", "new", "interpolation", "--grammar", "two.grammar", "--train", 5)
    split = read_split("interpolation-two-reach-seed0.yaml")
    repeated = 5 - len({member.robot_hash for member in split.train})
    assert repeated > 2
    assert f"  {repeated} train robots have the body and task of an earlier one\n" in out


def test_parts_and_grammars_are_read_from_the_user_library(run, monkeypatch):
    Path("lib").mkdir()
    Path("lib/mine.grammar").write_text("robot -> gantry plane(size=uniform(0.1, 0.3))\n")
    words = ("split", "new", "interpolation", "--grammar", "mine", "--train", 2)
    assert run(*words, "--library", "lib", "--out", "a.yaml")[0] == 0
    monkeypatch.setenv(LIBRARY_VARIABLE, str(Path("lib").absolute()))
    assert run(*words, "--out", "b.yaml")[0] == 0
    assert Path("a.yaml").read_bytes() == Path("b.yaml").read_bytes()
    data = yaml.safe_load(Path("a.yaml").read_text())
    assert list(data["made"]["grammar"]) == ["mine"]


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
