"""Sampling from grammars: draws and sets of robots."""

import itertools
import json
import math
import re
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from helpers.commands import start, tree
from helpers.grammars import CATEGORIES, LIBRARY, benchmark_counts, grammar, shipped, unphysical
from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar import sampling
from morphgen.grammar.analysis import check_grammar, count_structures
from morphgen.grammar.derive import RandomChooser, derive
from morphgen.grammar.grammar_file import grammar_from_text, grammar_text
from morphgen.grammar.sampling import (
    GRAMMAR,
    INDEX,
    JOURNAL,
    SETTINGS,
    RobotMaker,
    Sample,
    SamplingError,
    SetConfig,
    make_set,
    read_index,
    sample_robot,
    sample_robots,
)
from morphgen.grammar.syntax import parse_condition
from morphgen.progress import show_progress


def bodies(name, n, **options):
    return [str(drawn.derivation) for drawn in sample_robots(shipped(name), LIBRARY, n, **options)]


def test_a_robot_does_not_depend_on_the_number_of_samples():
    more = bodies("prims", 7)
    assert bodies("prims", 3) == more[:3]
    alone = sample_robot(shipped("prims"), LIBRARY, 5)
    assert str(alone.derivation) == more[5]
    assert (alone.index, alone.robot.name) == (5, "prims-000005")
    assert len(list(itertools.islice(sample_robots(shipped("cubes"), LIBRARY, 10**9), 2))) == 2


def test_another_seed_gives_other_robots():
    assert not set(bodies("cubes", 5)) & set(bodies("cubes", 5, seed=1))


def test_a_sample_records_its_choices():
    (drawn,) = sample_robots(shipped("cubes"), LIBRARY, 1)
    assert list(drawn.choices) == ["robot/0.cubes.size"]
    assert drawn.choices["robot/0.cubes.size"] == dict(drawn.derivation.parameters)["size"]
    assert drawn.robot.provenance["choices"] == drawn.choices
    assert drawn.robot.provenance["derivation"] == str(drawn.derivation)


def test_conditions_hold_for_every_robot_and_rejected_draws_are_counted():
    condition = parse_condition("dof > 9 and mass < 14")
    drawn = list(sample_robots(shipped("chain"), LIBRARY, 8, where=[condition]))
    assert all(d.robot.dof > 9 and d.properties.mass < 14 for d in drawn)
    rejected = {reason for d in drawn for reason in d.rejected}
    assert rejected == {"where (dof > 9)", "where (mass < 14)"}


def test_a_rejected_draw_does_not_change_other_robots():
    free = bodies("cubes", 12)
    condition = parse_condition("mass < 0.5")
    kept = list(sample_robots(shipped("cubes"), LIBRARY, 12, where=[condition]))
    same = [d.index for d in kept if not d.rejected]
    assert 0 < len(same) < 12
    assert all(str(kept[i].derivation) == free[i] for i in same)


CONDITION = "where dof > 0 and (mass > 900 or links > 3) and reach > 0"


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (["robot -> cubes | cartpole", CONDITION], r"where \(\(mass > 900\) or \(links > 3"),
        (["robot -> pedestal(spread=0.05) left:arm3 right:arm3"], "links overlap at home"),
        (["robot -> pedestal left:arm3 plane"], "check tool-still, [a-z]+ "),
    ],
)
def test_rejected_robots_are_redrawn_and_the_most_frequent_reason_is_named(
    lines, reason, monkeypatch
):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    with pytest.raises(SamplingError, match=f"5 failed at: {reason}"):
        sample_robot(grammar(*lines), LIBRARY, 0)


def test_too_deep_recursions_are_redrawn():
    robot_grammar = grammar(
        "robot -> slides tail", "tail -> @weight(30) bead tail | jaw", "where links < 20"
    )
    drawn = list(sample_robots(robot_grammar, LIBRARY, 3))
    assert sum(d.rejected.get("more than 100 parts", 0) for d in drawn) > 0


NAMES = ("fixed", "post", "pedestal", "slides", "beam", "bead", "arm3", "plane", "claw", "none")
ITEMS = st.builds(
    lambda port, name, value, repetition: (
        f"{port}{name}{value if name == 'beam' else ''}{repetition}"
    ),
    st.sampled_from(["", "", "", "left:", "top:"]),
    st.sampled_from([*NAMES, "a", "b"]),
    st.sampled_from(["", "(length=uniform(0.1, 0.3))", "(length=k, mount_yaw=90deg)"]),
    st.sampled_from(["", "", "{2}", "{1,3}"]),
)
ALTERNATIVES = st.lists(ITEMS, min_size=1, max_size=3).map(" ".join)
PRODUCTIONS = st.lists(ALTERNATIVES, min_size=1, max_size=2).map(" | ".join)
TEXTS = st.builds(
    lambda base, robot, a, b: f"let k = 0.2\nrobot -> {base} {robot}\na -> {a}\nb -> {b}\n",
    st.sampled_from(["fixed", "post", "pedestal", "slides"]),
    PRODUCTIONS,
    PRODUCTIONS,
    PRODUCTIONS,
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(TEXTS)
def test_random_small_grammars_yield_valid_robots_or_an_error(monkeypatch, text):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 2)
    grammar = grammar_from_text(text, "g")
    drawn, why = [], ""
    try:
        drawn = list(sample_robots(grammar, LIBRARY, 2))
    except MorphgenError as error:
        why = str(error)
    assert bool(drawn) != bool(why)
    assert "\n" not in why
    for one in drawn:
        assert unphysical(one.robot) == []
        assert {finding.severity for finding in check(one.robot)} <= {"info"}


# Few random grammars are sound, and how few is chance: that is no fault of the test.
@settings(max_examples=60, suppress_health_check=[HealthCheck.filter_too_much])
@given(TEXTS, st.integers(0, 3))
@example("robot -> left:fixed{3}", 0)  # the third copy finds the port taken
def test_grammars_without_faults_can_be_derived(text, seed):
    grammar = grammar_from_text(text, "g")
    assume(count_structures(grammar) <= 100)
    wrong = [f for f in check_grammar(grammar, LIBRARY) if "cannot be reached" not in f]
    assume(all("never used" in fault for fault in wrong))
    derive(grammar, LIBRARY, RandomChooser(np.random.default_rng(seed)))


def robot_faults(drawn: Sample, category):
    """Return the faults of a robot of a category."""
    robot = drawn.robot
    counts = (len(robot.links), len(robot.movable_joints))
    faults = unphysical(robot)
    if counts != benchmark_counts(category, drawn.derivation):
        faults.append(f"{counts} links and movable joints: {drawn.derivation}")
    faults += [f"{f.code} {f.where}" for f in check(robot) if f.severity != "info"]
    if [frame.name for frame in robot.frames] != ["tool"]:
        faults.append(f"frames {robot.frames}")
    return faults


@pytest.mark.parametrize(
    ("category", "n"),
    [  # the Panda has many meshes to load
        pytest.param(name, n, marks=[pytest.mark.slow] * (n > 1 or name == "panda_variations"))
        for name in CATEGORIES
        for n in (1, 100)
    ],
)
def test_robots_have_the_counts_of_the_benchmark_and_loaders_agree(category, n, tmp_path):
    grammar = shipped(category)
    for index in range(n):
        drawn = sample_robot(grammar, LIBRARY, index, seed=11)
        assert robot_faults(drawn, category) == []
        folder = write_bundle(drawn.robot, tmp_path / "robot", picture=False)
        report = conformance(folder, 20)
        assert report.passed, report
        assert [f.code for f in check(read_bundle(folder)) if f.severity != "info"] == []


def plan(folder, category="cubes", **changes):
    text = grammar_text(shipped(category))
    config = SetConfig(folder, category, text, 0, (), light=True, picture=False, library=())
    return replace(config, **changes)


@pytest.fixture
def whole(tmp_path):
    """A set of eight cubes."""
    config = plan(tmp_path / "whole")
    make_set(config, 8)
    return config.folder


@pytest.mark.parametrize("exists", [False, True])
def test_a_set_that_fails_before_its_first_robot_leaves_nothing(exists, tmp_path, monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    folder = tmp_path / "new" / "set"
    if exists:
        folder.mkdir(parents=True)
    with pytest.raises(SamplingError, match=r"failed at: where .reach > 50"):
        make_set(plan(folder, where=("reach > 50",)), 2)
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "set"] * exists
    assert make_set(plan(folder), 1).made == 1


def stopped(config, n, done, error):
    """Make a set whose drawing raises an error after some robots."""

    def limited(make, indices, jobs):
        yield from map(make, indices[:done])
        raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "parallel_map", limited)
        with pytest.raises(type(error)):
            make_set(config, n)


def test_a_set_that_fails_later_keeps_its_robots(tmp_path):
    stopped(plan(tmp_path / "set"), 2, 1, SamplingError("no more"))
    report = make_set(plan(tmp_path / "set"), 2)
    assert (report.made, report.kept) == (1, 1)


def interrupted(plan, n, done):
    """Make a set that stops like a killed process after some robots."""
    stopped(plan, n, done, SystemExit())


def test_a_light_set_has_one_folder_per_robot_an_index_and_the_grammar(whole):
    names = [f"cubes-{i:06d}" for i in range(8)]
    assert {path.name for path in whole.iterdir()} == {*names, GRAMMAR, INDEX, SETTINGS}
    assert sorted(p.name for p in (whole / names[0]).iterdir()) == ["derivation.txt", "robot.urdf"]
    assert [record["name"] for record in read_index(whole)] == names
    assert (whole / GRAMMAR).read_text() == grammar_text(shipped("cubes"))


def test_the_index_has_one_json_line_per_robot(whole):
    for line in (whole / INDEX).read_text().splitlines():
        record = json.loads(line)
        written = (whole / record["name"] / "derivation.txt").read_text().strip()
        assert record["derivation"] == written
        assert (record["dof"], record["links"], record["movable"]) == (2, 3, 2)
        assert record["mass"] > 0
        assert record["choices"].keys() == {"robot/0.cubes.size"}
    table = pandas.read_json(whole / INDEX, lines=True)
    assert list(table["index"]) == list(range(8))
    assert table["mass"].dtype == float


def test_progress_reaches_the_number_of_robots(tmp_path):
    seen = []
    for n, jobs in ((3, 1), (5, 2)):
        with show_progress(lambda *now: seen.append(now)):
            make_set(plan(tmp_path / "s"), n, jobs)
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3), (3, 5), (4, 5), (5, 5)]


@pytest.mark.parametrize("light", [pytest.param(True, marks=pytest.mark.slow), False])
def test_two_processes_write_the_same_bytes_as_one(tmp_path, light):
    one = plan(tmp_path / "one", "chain", light=light)
    two = replace(one, folder=tmp_path / "two")
    n = 20 if light else 3
    make_set(one, n)
    make_set(two, n, 2)
    assert tree(one.folder) == tree(two.folder)


def test_a_larger_set_contains_the_smaller_one(tmp_path, whole):
    config = plan(tmp_path / "s")
    assert make_set(config, 3).made == 3
    report = make_set(config, 8)
    assert (report.made, report.kept) == (5, 3)
    assert tree(config.folder) == tree(whole)
    assert make_set(config, 2).made == 0
    assert tree(config.folder) == tree(whole)


@pytest.mark.parametrize("done", [0, 1, 7, 8])
def test_robots_written_before_an_interruption_are_kept(tmp_path, whole, done):
    config = plan(tmp_path / "s")
    interrupted(config, 8, done)
    with pytest.raises(FormatError, match=r"is not a finished set: it has no index\.jsonl"):
        read_index(config.folder)
    report = make_set(config, 8)
    assert (report.made, report.kept) == (8 - done, done)
    assert tree(config.folder) == tree(whole)


def test_deleted_robots_are_regenerated(tmp_path, whole):
    before = tree(whole)
    shutil.rmtree(whole / "cubes-000003")
    (whole / "cubes-000005" / "robot.urdf").unlink()
    report = make_set(plan(whole), 8)
    assert (report.made, report.kept) == (2, 6)
    assert tree(whole) == before
    (whole / INDEX).unlink()  # and there is no journal
    assert make_set(plan(whole), 8).made == 8
    assert tree(whole) == before


@pytest.mark.parametrize("cut", [1, 40, -1])
def test_a_truncated_journal_regenerates_one_robot(tmp_path, whole, cut):
    config = plan(tmp_path / "s")
    interrupted(config, 8, 5)
    lines = (config.folder / JOURNAL).read_text().splitlines()
    (config.folder / JOURNAL).write_text("".join(f"{x}\n" for x in lines[:4]) + lines[4][:cut])
    interrupted(config, 8, 2)
    report = make_set(config, 8)
    assert report.made in (2, 3)
    assert tree(config.folder) == tree(whole)


def test_partially_written_robots_are_removed(tmp_path, whole):
    config = plan(tmp_path / "s")
    interrupted(config, 8, 2)
    (config.folder / ".cubes-000002.x1y2").mkdir()
    (config.folder / ".cubes-000002.x1y2" / "robot.urdf").write_text("<robot")
    make_set(config, 8)
    assert tree(config.folder) == tree(whole)


@pytest.mark.parametrize("left", [[], [f".{GRAMMAR}.x1y2"], [GRAMMAR, f".{SETTINGS}.x1y2"]])
def test_a_folder_interrupted_before_the_first_robot_can_be_continued(tmp_path, whole, left):
    config = plan(tmp_path / "s")
    config.folder.mkdir()
    for name in left:
        path = config.folder / name
        path.write_text(config.grammar_text) if name == GRAMMAR else path.mkdir()
    make_set(config, 8)
    assert tree(config.folder) == tree(whole)


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_killed_run_resumes_to_the_same_bytes(tmp_path, jobs):
    words = ("sample", "chain", "-n", 8, "--seed", 3, "--light", "--jobs", jobs)
    process = start(*words, "--out", tmp_path / "killed")
    journal = tmp_path / "killed" / JOURNAL
    for _ in range(1200):
        if journal.exists() and len(journal.read_bytes().splitlines()) > 1:
            break
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)  # ends when no worker holds the pipe any more
    assert not (tmp_path / "killed" / INDEX).exists()
    again = start(*words, "--out", tmp_path / "killed")
    out, err = again.communicate(timeout=60)
    assert (again.returncode, ": 8 robots written" in out) == (0, False), err
    make_set(plan(tmp_path / "whole", "chain", seed=3), 8)
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "holds another set: its seed is 0, not 1; name another folder"),
        ({"light": False}, "its light is True, not False"),
        ({"where": ("mass < 1",)}, "its where is [], not ['mass < 1']"),
        ({"grammar_name": "dice"}, "its grammar is 'cubes', not 'dice'"),
        (
            {"grammar_text": "robot -> cubes\n"},
            "holds a set of another grammar 'cubes', that of its grammar.grammar; name another",
        ),
    ],
)
def test_a_set_is_continued_only_with_the_same_settings(whole, change, message):
    before = tree(whole)
    with pytest.raises(FormatError) as caught:
        make_set(plan(whole, **change), 9)
    assert message in str(caught.value)
    assert tree(whole) == before


@pytest.mark.parametrize("name", ["notes.txt", GRAMMAR, ""])
def test_a_folder_with_other_files_or_a_file_is_an_error(tmp_path, name):
    if name:
        (tmp_path / "s").mkdir()
    (tmp_path / "s" / name).write_text("mine")
    with pytest.raises(FormatError, match=r"and is not a set \(no set\.json\); name another"):
        make_set(plan(tmp_path / "s"), 1)
    assert (tmp_path / "s" / name).read_bytes() == b"mine"


def test_rejected_draws_are_counted_over_the_whole_set(tmp_path):
    config = plan(tmp_path / "s", where=("mass < 0.5 and dof == 2",))
    report = make_set(config, 8)
    counted = sum(sum(record["rejected"].values()) for record in read_index(config.folder))
    assert report.rejected == {"where (mass < 0.5)": counted}
    assert counted > 0
    assert make_set(config, 8).rejected == report.rejected


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_unsatisfiable_condition_stops_the_run(tmp_path, jobs):
    message = "0 of 'cubes': 0 of 500 draws were accepted; 500 failed at: where (mass > 900)"
    with pytest.raises(SamplingError, match=re.escape(message)):
        make_set(plan(tmp_path / "s", where=("mass > 900",)), 4, jobs)


def test_a_light_robot_references_meshes_in_their_packages(tmp_path):
    config = plan(tmp_path / "s", grammar_name="g", grammar_text="robot -> fixed ur5\n")
    make_set(config, 1)
    text = (config.folder / "g-000000" / "robot.urdf").read_text()
    assert 'filename="package://' in text
    assert str(Path.home()) not in text


def test_a_concurrent_run_in_the_same_folder_is_an_error(tmp_path, monkeypatch):
    config, make = plan(tmp_path / "set"), RobotMaker.make

    def make_beside(self, index):
        with pytest.raises(FormatError, match="is being written by another run"):
            make_set(config, 8)
        return make(self, index)

    monkeypatch.setattr(RobotMaker, "make", make_beside)
    make_set(config, 2)
    assert len(read_index(config.folder)) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"name": "../../etc"},
        {"name": ".."},
        {"name": 5},
        {"index": "0"},
        {"choices": {"a": math.nan}},
        {"rejected": [1]},
    ],
)
def test_an_invalid_index_line_is_an_error(whole, change):
    lines = (whole / INDEX).read_text().splitlines()
    lines[1] = json.dumps(json.loads(lines[1]) | change)
    (whole / INDEX).write_text("\n".join(lines))
    with pytest.raises(FormatError, match=r"index.jsonl:2: not a line of an index of morphgen"):
        read_index(whole)


@pytest.mark.parametrize("line", ["[" * 100_000, "[]", "null", "5", "{}"])
def test_an_invalid_journal_is_ignored(whole, line):
    (whole / JOURNAL).write_text(line + "\n")
    assert make_set(plan(whole), 9).made == 1
    assert len(read_index(whole)) == 9
    (whole / INDEX).write_text(line + "\n")
    with pytest.raises(FormatError, match=r"index.jsonl:1: not a line of an index"):
        read_index(whole)


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "{", '{"grammar": 5}', "\0"])
def test_invalid_settings_are_errors(whole, text):
    (whole / SETTINGS).write_text(text)
    reasons = "(invalid JSON|is nested deeper|expected the settings)"
    with pytest.raises(FormatError, match=f"set.json: {reasons}"):
        make_set(plan(whole), 9)
