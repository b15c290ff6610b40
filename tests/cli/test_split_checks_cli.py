"""``morphgen split audit``, ``build``, ``verify`` and ``stats``: output and rejected input."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member, split
from morphgen.benchmark.split_folder import load_split_folder
from morphgen.benchmark.survey import paper_rows
from morphgen.splits.split import split_id
from morphgen.splits.split_file import split_names, split_text
from morphgen.tasks.goals.split_goals import read_goals


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


def test_near_option_sets_the_audit_thresholds(run, write):
    path = write(split([*TRAIN, member(f"{TEST[0]} ee.size=0.2", "large")], TEST))
    assert "body-near" not in run("split", "audit", path)[1]
    assert "error body-near (1)" in run("split", "audit", path, "--near", "0.05,0.99")[1]


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


def test_audit_json_option_prints_only_json(run, write):
    code, out, err = run("split", "audit", write(leaky()), "--json")
    assert (code, err) == (1, "")
    data = json.loads(out)
    assert (data["split"], data["passed"]) == ("mine/some", False)
    assert {each["code"] for each in data["findings"]} == {
        "body-shared",
        "body-near",
        "combination-seen",
        "part-unseen",
    }
    assert data["nearest"]["twin"]["tree"] == {"train": "gantry-plane", "value": 0.0}


def test_build_prints_its_folder_and_passes_verify(ok, write):
    path = write(combined())
    out = ok("split", "build", path, "--light")
    assert out.splitlines() == [
        "data/mine/some: 4 robots written, 0 already existed",
        "verify it anywhere: morphgen split verify data/mine/some",
    ]
    first = tree(Path("data"))
    out = ok("split", "build", path, "--light", "--json")
    assert json.loads(out) == {"folder": "data/mine/some", "made": 0, "kept": 4}
    assert tree(Path("data")) == first
    assert len(load_split_folder("data/mine/some").train) == 3
    for what in (path, "data/mine/some"):
        out = ok("split", "verify", what)
        assert out == f"mine/some, id {split_id(combined())}: all 4 robots are the same\n"


def test_a_part_that_the_library_lacks_is_named(run, write):
    wrong = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
    code, _, err = run("split", "build", write(combined(train=[wrong])), "--out", "out")
    assert (code, err.count("\n")) == (2, 1)
    assert "unknown part 'cubw'; did you mean 'cube'?" in err


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


def test_stats_shows_the_figures_of_the_paper(ok):
    out = ok("split", "stats", "composition/ee-task", "extrapolation/primitives/reach")
    _, _, task, primitives, _, _, source = out.splitlines()
    assert [cell.strip() for cell in task.split("  ") if cell][:6] == [
        "composition/ee-task",
        "4",
        "1",
        "7.75 (7.75)",
        "5.25 (5.25)",
        "5.25 (-)",
    ]
    assert "6.6 (6.6)" in primitives
    assert "(0.45)" in primitives
    assert "arXiv 2505.14986" in source


def test_stats_merges_splits_with_the_same_robots(run, write):
    path = write(combined(name="mine/some/push"))
    reach = combined(name="mine/some/reach")
    sides = [tuple(replace(m, task="reach") for m in side) for side in (reach.train, reach.test)]
    other = write(replace(reach, train=sides[0], test=sides[1]), "other.yaml")
    code, out, _ = run("split", "stats", path, other, "--json")
    (row,) = json.loads(out)["rows"]
    assert code == 0
    assert (row["robots"], row["splits"]) == ("mine/some", ["mine/some/push", "mine/some/reach"])
    assert (row["ours"]["train"]["robots"], row["paper"]) == (3, None)


def test_stats_can_be_markdown(run, write):
    _, out, _ = run("split", "stats", write(combined()), "--markdown")
    header, rule, row = out.splitlines()[:3]
    assert header.startswith("| robots")
    assert set(rule) <= set("|-:")
    assert row.startswith("| mine/some")


@pytest.mark.slow
def test_all_scenarios_have_a_row_and_pass_their_audit(run):
    _, out, _ = run("split", "stats", "--json")
    rows = json.loads(out)["rows"]
    assert {row["robots"] for row in rows} >= set(paper_rows())
    assert sum(len(row["splits"]) for row in rows) == len(split_names()) == 36
    for name in split_names():
        assert run("split", "audit", name, "--strict")[0] == 0, name


def reaching(**more):
    """A valid split of reach robots."""
    train, test = ([member(words, task="reach") for words in side] for side in (TRAIN, TEST))
    return combined(train=train, test=test, **more)


def known(**more):
    """A split with one robot on both sides."""
    twin = member(TRAIN[0], "twin", task="reach")
    return replace(reaching(**more), test=(*reaching().test, twin))


@pytest.mark.usefixtures("goal_cache")
def test_goal_seed_is_printed_stored_and_audited(run, ok, write):
    out = ok("split", "build", write(reaching()), "--light", "--goals", "--goal-seed", "7")
    assert out.splitlines()[1] == "4 goal sets, seed 7"
    assert {one.seed for one in read_goals("data/mine/some", "train").values()} == {7}
    assert run("split", "audit", "data/mine/some")[0] == 0
    code, out, _ = run("split", "audit", "data/mine/some", "--goal-seed", "0")
    assert code == 1
    i = out.splitlines().index("error goals-seed (4)")
    assert out.splitlines()[i + 1].endswith("its set was made with seed 7, the split's with 0")


@pytest.mark.usefixtures("goal_cache")
def test_goals_are_audited_only_if_stored_or_requested(run, write):
    accepted = {"body-shared": "new goals", "combination-seen": "it is known"}
    path = write(known(accepted=accepted))
    assert run("split", "audit", path)[0] == 0
    run("split", "build", path, "--light")
    assert run("split", "audit", "data/mine/some")[0] == 0
    for words in ((path, "--goals"), ("data/mine/some", "--goals")):
        code, out, _ = run("split", "audit", *words)
        assert code == 1
        i = out.splitlines().index("error goals-shared (1)")
        assert out.splitlines()[i + 1] == (
            "  test robot twin: train robot gantry-plane has 100 of its 100 goals"
        )
        assert "5 goal sets were audited, seed 0" in out


@pytest.mark.usefixtures("goal_cache")
def test_accepted_findings_do_not_fail(ok, write):
    accepted = {"body-shared": "one", "combination-seen": "two", "goals-shared": "three"}
    out = ok("split", "audit", write(known(accepted=accepted)), "--goals", "--strict")
    assert "accepted goals-shared (1): three" in out.splitlines()
    assert out.splitlines()[-1] == "mine/some: passed: 0 error, 0 warning, 3 accepted"
