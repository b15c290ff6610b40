"""``morphgen train --robots``: training on robots that are drawn from grammars."""

import json
import re
from pathlib import Path

import pytest

from helpers.runs import SMALL, small_split
from helpers.splits import member, split
from morphgen.grammar.library import default_library
from morphgen.rl.runs.checkpoint import read_checkpoint, read_config
from morphgen.rl.runs.robot_source import FILE, fresh_source, members, read_drawn
from morphgen.rl.runs.training import read_metrics
from morphgen.splits.split import Member
from morphgen.splits.split_file import write_split
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.viewer.robot_uri import DERIVATION, FileAccess
from morphgen.viewer.simulation import training_robots

FEW = ("--agent", "me-mlp", "--train-goals", "3", "--no-tensorboard", *SMALL)
RUN = ("train", "task=reach", *FEW, "--robots")
pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.slow
def test_drawn_robots_are_trained_on_and_others_evaluated_and_played(run, ok, tmp_path):
    code, out, err = run(*RUN, "cubes:3,stick:2", "--steps", "192")
    folder = Path("runs/cubes-3-stick-2-reach/me-mlp/seed0")
    assert (code, out) == (0, f"{folder}/checkpoint.pt\n")
    assert "cubes:3,stick:2: update 6 of 6, 192 steps, score -" in err
    config = read_config(folder)
    assert (config.source.grammars, config.source.draw_seed) == ((("cubes", 3), ("stick", 2)), 0)
    assert (config.slice_updates, config.max_links) == (3, 23)
    assert {config.tasks[0].num_goals, config.tasks[1].num_goals} == {3}
    robots = read_drawn(folder)
    assert [each.name for each in robots] == [
        *("cubes-000000", "cubes-000001", "cubes-000002"),
        *("stick-000000", "stick-000001"),
    ]
    assert config.source.drawn_hash == json.loads((folder / FILE).read_text())["hash"]
    assert [len(each["scores"]) for each in read_metrics(folder)] == [2] * 6
    assert run(*RUN, "cubes:3,stick:2", "--steps", "192", "--resume")[0] == 0
    code, _, err = run(*RUN, "cubes:3,stick:2", "--steps", "192", "--resume", "--robot-seed", "1")
    assert (code, "has another run" in err) == (2, True)

    write_split(small_split(), tmp_path / "own.yaml")
    evaluation = ("--episodes", "1", "--mode", "deterministic")
    out = ok("eval", folder, "--split", "own.yaml", "--on", "test", *evaluation)
    assert "gantry-plane" in out
    known = Member("known", "cubes", robots[1].derivation, "reach", False, robots[1].robot_hash)
    write_split(split((member("base=planar ee=cube"),), (known,)), tmp_path / "known.yaml")
    code, _, err = run("eval", folder, "--split", "known.yaml", "--on", "test", *evaluation)
    assert (code, err) == (0, "morphgen: the policy was trained on known\n")
    code, out, _ = run("play", "reach", "planar-cube", "--policy", folder, "--sim", "mujoco")
    assert (code, out[:10]) == (0, "episode 1:")

    files = FileAccess(default_library().folders, (tmp_path,), tmp_path / "none")
    listed = [(each.name, f"{DERIVATION}{each.derivation}") for each in robots]
    assert training_robots(str(folder), files) == ("reach", False, listed)
    (folder / FILE).unlink()
    assert training_robots(f"{folder}/checkpoint.pt", files) == ("reach", False, [])
    code, _, err = run("eval", folder, "--split", "own.yaml", "--on", "test", *evaluation)
    assert code == 0
    assert f"{folder} has no robots.json: it is unknown whether" in err


@pytest.mark.parametrize(
    "drawn",
    [
        "cubes:1,stick:2",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("cubes:2", "stick:1")),
    ],
)
def test_without_a_split_fresh_robots_are_evaluated(run, drawn):
    run(*RUN, drawn, "--steps", "96", "--out", "run")
    trained = {each.robot_hash for each in read_drawn(Path("run"))}
    words = ("eval", "run", "--episodes", "1", "--mode", "deterministic")
    found = []
    for seed in (0, 0, 1):
        code, out, err = run(*words, "--seed", str(seed), "--json")
        assert code == 0
        request, draw_seed, robots_hash = re.search(
            r"fresh robots (\S+), drawn with seed (\d+), hash (\w+)", err
        ).groups()
        assert request == drawn
        scores = json.loads(out)["deterministic"]
        assert len(scores) == len(trained)
        assert {score["side"] for score in scores} == {"test"}
        found.append((draw_seed, robots_hash, out))
    assert found[0] == found[1] != found[2]
    source = read_config(Path("run")).source
    fresh, _ = fresh_source(Path("run"), source, GoalConfig(), 0)
    assert trained.isdisjoint(each.robot_hash for each in members(fresh))
    code, _, err = run(*words, "--on", "train")
    assert (code, "its policy is scored on fresh robots" in err) == (2, True)
    (Path("run") / FILE).unlink()
    code, _, err = run(*words)
    assert (code, "no list of drawn robots" in err) == (2, True)


def test_held_out_robots_are_skipped_and_fit_the_observations(run, tmp_path):
    run(*RUN, "cubes:2", "--steps", "32", "--out", "free")
    code, _, err = run("finetune", "free")
    assert code == 2
    assert "robots cubes:2 are drawn from grammars and have no test side" in err
    assert "with --split" in err
    (_, second) = read_drawn(Path("free"))
    test = Member("known", "cubes", second.derivation, "reach", False, second.robot_hash)
    large = split((member("base=planar ee=cube"),), (test,), provenance={"max_links": 25})
    write_split(large, tmp_path / "own.yaml")
    options = ("--held-out", "own.yaml", "--steps", "32", "--out", "run")
    code, _, err = run(*RUN, "cubes:2", *options)
    assert code == 0
    assert "morphgen: robots that were skipped: 1 held out\n" in err
    assert [each.name for each in read_drawn(Path("run"))] == ["cubes-000000", "cubes-000002"]
    config = read_config(Path("run"))
    assert config.source.held_out == (str(tmp_path / "own.yaml"),)
    assert (config.slice_updates, config.max_links) == (0, 25)
    assert read_checkpoint(Path("run"))[1]["layout"]["links"] == 25


def test_workers_draw_for_a_simulator_that_has_none(run):
    words = [*RUN, "cubes:2", "--steps", "32", "--workers", "2"]
    words[words.index("mujoco")] = "kinematic"
    assert run(*words)[0] == 0
    assert len(read_drawn(Path("runs/cubes-2-reach/me-mlp/seed0"))) == 2
