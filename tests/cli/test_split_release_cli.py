"""``morphgen split release`` and ``score``, and ``eval --submission``."""

import json
import re
import shutil
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest

from helpers.commands import tree
from helpers.splits import TRAIN, combined, member
from helpers.submissions import data
from morphgen.benchmark.scores import study
from morphgen.benchmark.scores.submission import EvalProtocol, expected_robots
from morphgen.grammar.library import default_library
from morphgen.splits.split import read_split, split_text

RELEASE = ("split", "release", "--no-goals")


def test_release_prints_archive_and_hashes_and_passes_verify(run, ok, small):
    out = ok(*RELEASE, small, "--version", "2.0.0")
    *notes, first, sha256, content, last = out.splitlines()
    archive = "releases/mine-small-2.0.0.zip"
    assert first.startswith(f"{archive}: ")
    assert last == f"verify it anywhere: morphgen split verify {archive}"
    out = ok(*RELEASE, small, "--version", "2.0.0", "--json")
    data = json.loads(out)
    assert (f"  sha256: {data['sha256']}", f"  content: {data['content']}") == (sha256, content)
    kept, *others = data["notes"]
    assert kept == f"{archive} exists: it stays, unless the content is the same"
    assert [f"note: {note}" for note in others] == notes
    lacks = ["no reference scores", "no --date", "no --creator"]
    assert [note.partition(":")[0] for note in others] == lacks
    cited = ("--date", "2027-01-31", "--creator", "us", "--out", "dated")
    assert run(*RELEASE, small, *cited)[1].count("note: ") == 1
    out = ok("split", "verify", archive)
    assert out.splitlines()[1] == content
    assert [path.name for path in Path("releases").iterdir()] == ["mine-small-2.0.0.zip"]


def test_a_dry_run_says_what_is_missing_and_writes_nothing(ok, run, small, tmp_path):
    before = tree(tmp_path)
    *notes, last = ok("split", "release", small, "--dry-run", "--date", "2027-01-31").splitlines()
    lacks = ["no reference scores", "no --creator"]
    assert [note.partition(":")[2].strip().split(":")[0] for note in notes] == lacks
    archive = "releases/mine-small-1.0.0.zip"
    assert last == f"{archive} would be written: names, licences and audit are in order"
    data = json.loads(ok("split", "release", small, "--dry-run", "--json"))
    assert (data["archive"], len(data["notes"])) == (archive, 3)
    assert tree(tmp_path) == before
    code, _, err = run("split", "release", "composition/ee-arm/reach", "--dry-run")
    assert code == 2
    assert "sake_ez" in err


def test_a_tampered_archive_fails_verify_and_ranks_nothing(run, refused, small):
    run(*RELEASE, small)
    shutil.unpack_archive("releases/mine-small-1.0.0.zip", "unpacked")
    path = Path("unpacked/mine-small-1.0.0/robots.jsonl")
    path.write_text(path.read_text().replace("train", "test", 1))
    shutil.make_archive("changed", "zip", "unpacked", "mine-small-1.0.0")
    why = "robots.jsonl is not what SHA256SUMS was written for"
    code, out, err = run("split", "verify", "changed.zip")
    assert (code, err, why in out) == (1, "", True)
    Path("a.json").write_text(json.dumps(data()))
    err = refused("split", "score", "a.json", "--split", "changed.zip")
    assert f"changed.zip: robots.jsonl: file {why}" in err
    err = refused("eval", "zero", "--split", "changed.zip")
    assert err.endswith("unpack it, and name the folder\n")


def test_a_restricted_licence_is_released_when_it_is_allowed(ok):
    words = ("composition/ee-arm/reach", "--licence-allow", "CC-BY-NC-ND-4.0,MIT")
    ok(*RELEASE, *words)
    shutil.unpack_archive("releases/composition-ee-arm-reach-1.0.0.zip", ".")
    card = Path("composition-ee-arm-reach-1.0.0/README.md").read_text()
    assert "- cc-by-nc-nd-4.0\n" in card
    limits = "(CC-BY-NC-ND-4.0: non-commercial, no derivatives)"
    assert f"Restricted: sake_ez {limits} in robots ur5-ez." in card


def test_show_names_restricted_parts(run):
    line = "sake_ez (CC-BY-NC-ND-4.0: non-commercial, no derivatives) in robots ur5-ez"
    out = run("split", "show", "composition/ee-arm/reach")[1]
    assert f"  restricted: {line}\n" in out
    data = json.loads(run("split", "show", "composition/ee-arm/reach", "--json")[1])
    assert [each["part"] for each in data["licences"] if each["restrictions"]] == ["sake_ez"]
    assert "restricted" not in run("split", "show", "composition/ee-task")[1]


def test_show_works_without_the_library_of_the_parts(ok):
    other = member(TRAIN[0])
    other = replace(other, name="other", derivation=other.derivation.replace("plane", "planf"))
    Path("other.yaml").write_text(split_text(combined([*TRAIN, other])))
    out = ok("split", "show", "other.yaml")
    (line,) = [line for line in out.splitlines() if line.startswith("  licences: ")]
    assert "'planf'" in line
    assert line.endswith("; see --library")


def test_score_refuses_other_files(refused, small):
    values = data()
    Path("c.json").write_text(json.dumps(values))
    assert "c.json: split.name: mine/small is not" in refused("split", "score", "c.json")
    Path("c.json").write_text(json.dumps(values | {"split": values["split"] | {"name": small}}))
    assert "c.json: split.name: small.yaml is not" in refused("split", "score", "c.json")


def test_edited_random_scores_do_not_pass_unnoticed(run, ok, refused, small):
    split, protocol = read_split(small), EvalProtocol()
    expected = expected_robots(split, protocol, default_library())
    values = data(split=split, expected=expected, protocol=protocol, episodes=protocol.episodes)
    values["morphgen"] = version("morphgen")
    Path("a.json").write_text(json.dumps(values))
    baseline = {"method": "random", "mode": "", "training_seed": None}
    Path("random.json").write_text(json.dumps(values | baseline))
    values["robots"][-1]["random_score"] = [-200.0] * protocol.episodes
    Path("b.json").write_text(json.dumps(values))
    score = ("split", "score", "--split", small)
    for file in ("a.json", "b.json"):
        out = ok(*score, file)
        (warning,) = json.loads(run(*score, file, "--json")[1])["warnings"]
        assert out.splitlines()[-1] == f"warning: {warning}"
        assert warning.startswith("random_score was not checked: there is no reference submission")
    assert "b.json: test robot planar-plane: random_score: " in refused(*score, "a.json", "b.json")
    out = run(*RELEASE, small, "--scores", "a.json")[1]
    assert "note: no submission of random among --scores: " in out
    out = run(*RELEASE, small, "--scores", "random.json", "--version", "1.1.0")[1]
    assert "no submission of random" not in out
    assert "no reference scores" not in out
    words = ("split", "score", "b.json", "--split", "releases/mine-small-1.1.0.zip", "--json")
    ranking = json.loads(run(*words)[1])
    assert (ranking["random"], ranking["warnings"]) == ("release", [])


@pytest.mark.slow
def test_submissions_are_recorded_scored_and_ranked(run, ok, small):
    few = ("--episodes", "2")
    run(*RELEASE, small, *few)
    shutil.unpack_archive("releases/mine-small-1.0.0.zip", ".")
    folder = "mine-small-1.0.0"
    for name in ("random", "ik"):
        words = ("eval", name, "--split", folder, *few, "--submission", f"{name}.json")
        scores = json.loads(ok(*words, "--json"))[name]
        rows = json.loads(run("split", "score", f"{name}.json", "--split", folder, "--json")[1])
        (row,) = rows["rows"]
        assert (row["method"], row["source"], row["mode"]) == (name, "submission", "")
        test, (expected,) = row["sides"]["test"], [x for x in scores if x["side"] == "test"]
        found = {
            **test["score"],
            "value": test["success"]["value"],
            "score": test["score"]["value"],
        }
        for key, name in (("score",) * 2, ("value", "success"), ("low",) * 2, ("high",) * 2):
            assert found[key] == pytest.approx(expected[name]), name
    words = ("--scores", "random.json", "ik.json", "--version", "1.1.0")
    ok(*RELEASE, small, *few, *words)
    archive = "releases/mine-small-1.1.0.zip"
    out = ok("split", "score", "ik.json", "--split", archive)
    names = [line.partition("  ")[0] for line in out.splitlines()[4:7]]
    assert names == ["ik", "ik (reference)", "random (reference)"]
    assert "by the episodes of the release" in out
    brief = ("--steps", "64", "--envs", "4", "--set", "num_steps=16", "--set", "minibatches=4")
    words = ("--agent", "me-mlp+tool-position", "--observe", "lag,joint", *brief)
    words += ("--sim", "mujoco", "--out", "r")
    assert run("train", folder, *words)[0] == 0
    words = ("--mode", "deterministic", *few, "--submission", "policy.json")
    assert run("eval", "r", "--split", folder, *words)[0] == 0
    policy = json.loads(Path("policy.json").read_text())
    assert policy["method"] == "me-mlp+tool-position+lag+joint"
    assert policy["training"] == {"simulator": "mujoco", "transitions": 64, "finetuned": 0}


def test_episodes_of_a_submission_are_run_again(run, refused, small, monkeypatch):
    few = ("--episodes", "2")
    run(*RELEASE, small, *few, "--no-goals")
    archive = "releases/mine-small-1.0.0.zip"
    shutil.unpack_archive(archive, ".")
    run("eval", "zero", "--split", "mine-small-1.0.0", *few, "--submission", "a.json")
    score = ("split", "score", "a.json", "--split", archive, "--replay", "2")
    with monkeypatch.context() as patch:
        # What agrees alone needs no whole evaluation.
        patch.setattr(study, "evaluate_baseline", pytest.fail)
        code, out, _ = run(*score)
    assert (code, out.count(": agrees\n")) == (0, 2)
    values = json.loads(Path("a.json").read_text())
    del values["sha256"]
    for robot in values["robots"]:
        robot["distance"] = [each + 0.01 for each in robot["distance"]]
    Path("a.json").write_text(json.dumps(values))
    code, out, err = run(*score, "--seed", "3")
    assert (code, "; running the whole evaluation\n" in err) == (1, True)
    assert len(re.findall(r"a\.json: \w+ robot \S+, episode [01]: .*: DIFFERS: again ", out)) == 2
    errors = {"mine": "expected one with --checkpoint RUN", "scripted": " for reach"}
    for method, error in errors.items():
        Path("a.json").write_text(json.dumps(values | {"method": method}))
        assert error in refused(*score)


@pytest.mark.slow
def test_the_submission_of_policies_of_single_robots_is_of_their_run(run, small):
    words = ("--agent", "se", "--seed", "3", "--steps", "256", "--envs", "8", "--no-tensorboard")
    words += ("--set", "num_steps=16", "--set", "minibatches=2", "--sim", "mujoco")
    assert run("train", small, *words, "--out", "run")[0] == 0
    words = ("--split", small, "--mode", "deterministic", "--submission", "a.json")
    assert run("eval", "run", *words)[0] == 0
    submission = json.loads(Path("a.json").read_text())
    assert submission["training_seed"] == 3
    assert submission["training"]["transitions"] == 256
