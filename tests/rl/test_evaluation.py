"""Scores of policies and baselines by robot."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.runs import EVAL, QUIET, small_config, small_source
from helpers.splits import member, split
from morphgen.errors import TaskError
from morphgen.progress import show_progress
from morphgen.rl import evaluation
from morphgen.rl.baselines import ZERO
from morphgen.rl.evaluation import (
    EvalConfig,
    episodes_alone,
    evaluate_baseline,
    evaluate_checkpoints,
    evaluate_run,
)
from morphgen.rl.inference import Policy, PolicyController
from morphgen.rl.runs.checkpoint import CHECKPOINT, Interface, read_checkpoint, write_checkpoint
from morphgen.rl.runs.robot_source import other_side, robot_source, split_source
from morphgen.rl.runs.training import checkpoint_files, subruns_of, train
from morphgen.rl.scores import Evaluation, scores_to_json
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.make import batch_from_specs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two updates on the robots of a split."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    train(folder, small_config(small_source(), total_timesteps=64), execution=QUIET)
    return folder


def test_the_score_of_the_random_policy_is_zero():
    scores = evaluate_baseline("random", small_source(), EVAL)
    assert [each.side for each in scores] == ["train", "train"]
    for each in scores:
        assert (each.score, math.isnan(each.low), math.isnan(each.high)) == (0, True, True)
        assert each.raw == each.random < 0
        assert each.success == each.random_success
        assert (each.episodes, each.steps) == (2, 600)
        assert each.relative_distance > 0.03


def test_inverse_kinematics_scores_far_above_the_random_policy():
    for side in ("train", "test"):
        for each in evaluate_baseline("ik", other_side(small_source(), side), EVAL):
            assert each.side == side
            assert each.success == 1
            assert each.distance < ReachConfig().near
            assert each.score == pytest.approx(each.raw - each.random)
            assert each.raw > 100 > 0 > each.random
            assert each.low <= each.score <= each.high


def test_the_seed_determines_the_episodes():
    source = small_source()
    scores = [evaluate_baseline("zero", source, replace(EVAL, seed=seed)) for seed in (0, 0, 1)]
    assert scores_to_json(scores[0]) == scores_to_json(scores[1])
    assert scores[0][0].distance != scores[2][0].distance


def test_evaluations_are_repeatable_in_both_modes_by_any_workers(run):
    modes = ("deterministic", "deterministic", "stochastic", "stochastic")
    configs = (EVAL, replace(EVAL, workers=2)) * 2
    found = [evaluate_run(run, "train", *each) for each in zip(configs, modes, strict=True)]
    data = [scores_to_json(scores) for scores in found]
    assert data[0] == data[1] != data[2] == data[3]
    assert found[0][0].random == found[2][0].random


def at_most(count, monkeypatch):
    """Limit the number of parallel environments of MuJoCo."""
    fewer = replace(SIMULATORS["mujoco"], max_envs=count)
    monkeypatch.setitem(SIMULATORS._loaded, "mujoco", fewer)


def test_evaluation_in_several_batches_has_the_same_episodes(run, monkeypatch):
    config = replace(EVAL, episodes=5)
    source = other_side(small_source(), "train")
    whole = evaluate_run(run, "train", config, "deterministic")
    still = evaluate_baseline("zero", source, config)
    made = []

    def noted(settings, num_envs, **options):
        made.append((options["first"], num_envs))
        return batch_from_specs(settings, num_envs, **options)

    monkeypatch.setattr(evaluation, "batch_from_specs", noted)
    at_most(4, monkeypatch)
    evaluation._random_episodes.cache_clear()
    parts = evaluate_run(run, "train", config, "deterministic")
    assert made[:3] == [(0, 4), (4, 4), (8, 2)]
    assert [each.raw for each in parts] == pytest.approx([each.raw for each in whole])
    assert [each.distance for each in parts] == pytest.approx([each.distance for each in whole])
    again = evaluate_baseline("zero", source, config)
    assert [each.raw for each in again] == pytest.approx([each.raw for each in still])


def test_single_episodes_are_those_of_the_evaluation_of_baseline_and_policy(run, monkeypatch):
    monkeypatch.setattr(evaluation, "MAX_ENVS_PER_ROBOT", 2)  # two episodes one after another
    config, source = replace(EVAL, episodes=3), other_side(small_source(), "train")
    policies = evaluate_checkpoints([run / CHECKPOINT], source, config, "deterministic")
    whole = evaluate_baseline("zero", source, config), policies
    trained, learner = read_checkpoint(run / CHECKPOINT)
    policy = PolicyController(Policy(learner, "deterministic", 0))
    controllers = (ZERO.make(0), Interface()), (policy, trained.interface)
    for scores, controller in zip(whole, controllers, strict=True):
        outcomes = {each.robot: each.outcomes.distance for each in scores}
        chosen = [(robot, number) for robot in reversed(outcomes) for number in (3, 0, 1)]
        found = episodes_alone(*controller, source, config, chosen)
        expected = [outcomes[robot][number] for robot, number in chosen]
        assert [each.distance for each in found] == pytest.approx(expected, abs=1e-4)
        assert len({round(each, 4) for each in expected}) == len(expected)


def test_push_scores_are_success_rates_and_baselines_reject_other_tasks():
    mixed = robot_source("prims", "push")
    config = EvalConfig(episodes=3, sim="mujoco")
    (zero,) = evaluate_baseline("zero", mixed, config)
    assert (zero.task, zero.score, zero.success) == ("push", 0, 0)
    assert math.isnan(zero.relative_distance)
    (scripted,) = evaluate_baseline("scripted", mixed, config)
    assert scripted.score == scripted.raw == scripted.success > 0
    assert scripted.steps < 3 * 300
    with pytest.raises(TaskError, match="no robot is there to reach"):
        evaluate_baseline("ik", mixed, config)
    with pytest.raises(TaskError, match="did you mean 'scripted'"):
        evaluate_baseline("script", mixed, config)


def test_se_policies_are_scored_on_their_own_robot_and_together_on_others(tmp_path):
    config = small_config(small_source(), agent="se", total_timesteps=64)
    train(tmp_path, config, execution=QUIET)
    own = evaluate_run(tmp_path, "train", EVAL, "deterministic")
    names = [part.config.source.member for part in subruns_of(tmp_path, config)]
    assert sorted(each.robot for each in own) == sorted(names)
    assert [each.episodes for each in own] == [2, 2]
    seen = []
    with show_progress(lambda *now: seen.append(now)):
        (test,) = evaluate_run(tmp_path, "test", EVAL, "deterministic")
    assert (test.side, test.episodes) == ("test", 4)
    assert (len(seen), seen[300], seen[-1]) == (600, (pytest.approx(2 + 1 / 150), 4), (4, 4))
    files = list(checkpoint_files(tmp_path))
    again = evaluate_checkpoints(files, small_source(), EVAL, "deterministic")
    assert scores_to_json(again) == scores_to_json(own)
    others = replace(small_source(), goal_seed=1)
    again = evaluate_checkpoints(files, others, EVAL, "deterministic")
    assert [(each.robot, each.episodes) for each in again] == [(e.robot, 2) for e in own]
    assert [each.score for each in again] != [each.score for each in own]
    source = other_side(small_source(), "test")
    alone = [evaluate_checkpoints([file], source, EVAL, "deterministic")[0] for file in files]
    assert test.score == pytest.approx(np.mean([each.score for each in alone]))


@pytest.mark.parametrize(("in_rounds", "whole"), [(True, 8), (False, 6)])
def test_progress_counts_finished_and_partial_episodes(monkeypatch, in_rounds, whole):
    if in_rounds:
        monkeypatch.setattr(evaluation, "MAX_ENVS_PER_ROBOT", 2)
    else:  # in batches
        at_most(4, monkeypatch)
    seen = []
    config = replace(EVAL, episodes=3)
    with show_progress(lambda *now: seen.append(now)):
        evaluate_baseline("zero", small_source(), config)
    parts = [done for done, _ in seen]
    assert {total for _, total in seen} == {whole}
    assert len(parts) == 600
    assert 0 < parts[0] < 0.05
    assert parts == sorted(set(parts))
    assert parts[-1] == whole


def test_a_checkpoint_of_another_layout_is_rejected_with_the_difference(run, tmp_path):
    config, learner = read_checkpoint(run)
    learner["layout"]["obstacles"] = 0
    boxes = robot_source("planar-cube", "reach", obstacles=True)
    with pytest.raises(TaskError, match="the checkpoint is for other observations: obstacles 0, h"):
        evaluate_checkpoints([run], boxes, EVAL, "deterministic")
    write_checkpoint(tmp_path, config, learner)
    evaluate_run(tmp_path, "test", EVAL, "deterministic")


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"max_links": 30}, "max_links 30, not 23"),
        ({"discrete": False}, "kind continuous, not discrete"),
        ({"tool_position": True}, "tool True, not False"),
    ],
)
def test_policies_of_different_interfaces_are_not_scored_together(
    run, tmp_path, change, difference
):
    config, learner = read_checkpoint(run)
    policy = {} if "max_links" in change else {"policy": replace(config.policy, **change)}
    write_checkpoint(tmp_path, replace(config, **(policy or change)), learner)
    other = tmp_path / "checkpoint.pt"
    message = rf"^{other}: its policy .* than that of {run}: {difference}; evaluate it on"
    with pytest.raises(TaskError, match=message):
        evaluate_checkpoints([run, other], small_source(), EVAL, "deterministic")


@pytest.mark.parametrize("agent", ["me-mlp", "se"])
def test_obstacles_may_surround_only_some_robots(agent, tmp_path):
    def made(words, obstacles):
        return member(words, task="reach", obstacles=obstacles)

    sides = {"one": (False, True, False), "test": (False, False, True)}
    for place, (cube, other, test) in sides.items():
        own = made("base=planar ee=cube", cube), made("base=gantry ee=cube", other)
        source = split_source(split(own, (made("base=gantry ee=plane", test),)))
        config, folder = small_config(source, agent=agent, total_timesteps=64), tmp_path / place
        train(folder, config, execution=QUIET)
        for part in subruns_of(folder, config):
            assert read_checkpoint(part.folder)[1]["layout"]["obstacles"] == 3
        for side, count in (("train", 2), ("test", 1)):
            assert len(evaluate_run(folder, side, EVAL, "deterministic")) == count


def test_one_robot_has_no_other_side_and_is_evaluated_with_contacts(tmp_path):
    run_config = replace(small_config(total_timesteps=32), sim="kinematic")
    train(tmp_path, run_config, execution=QUIET)
    config = evaluation.eval_config_of(run_config, 35)
    assert config.sim == "mujoco"
    (score,) = evaluate_run(tmp_path, "train", config, "deterministic")
    assert (score.episodes, score.steps) == (36, 36 * 300)  # in rounds: there are 34 environments
    with pytest.raises(TaskError, match="has no test robots"):
        evaluate_run(tmp_path, "test", config, "deterministic")


def test_eval_config_has_the_simulator_and_tasks_of_the_run(run):
    config, _ = read_checkpoint(run)
    assert evaluation.eval_config_of(config, 3) == EvalConfig(3, "mujoco")
    with pytest.raises(TaskError, match="0 episodes"):
        EvalConfig(episodes=0)
    with pytest.raises(TaskError, match="a seed from 0 to"):
        EvalConfig(seed=2**63)


def test_score_tables_have_every_robot_and_mode(run, tmp_path):
    modes = ("deterministic", "stochastic")
    found = {mode: evaluate_run(run, "train", EVAL, mode) for mode in modes}
    lines = Evaluation(found).table().splitlines()
    assert len(lines) == 2 + 4
    assert "MT reach" in Evaluation(found).summary()
    mean = np.mean([each.score for each in found["deterministic"]])
    assert f"{mean:.2f}" in Evaluation(found).summary().splitlines()[0]
    assert "unstable" not in Evaluation(found).summary()
    lost = [replace(found["deterministic"][0], unstable=2), *found["deterministic"][1:]]
    last = "episodes that ended because their simulation became unstable: 2"
    assert Evaluation({"deterministic": lost}).summary().endswith(last)
    for suffix in (".csv", ".json", ".md"):
        Evaluation(found).write(tmp_path / f"table{suffix}")
    stored = json.loads((tmp_path / "table.json").read_text())
    assert stored["stochastic"] == scores_to_json(found["stochastic"])
    rows = (tmp_path / "table.csv").read_text().splitlines()
    assert rows[0].startswith("mode,robot,side,task,episodes,steps,score,")
    assert len(rows) == 1 + 4
    assert (tmp_path / "table.md").read_text().startswith("| robot")
    with pytest.raises(TaskError, match=r"table\.txt"):
        Evaluation(found).write(tmp_path / "table.txt")
