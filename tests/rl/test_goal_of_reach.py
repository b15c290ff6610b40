"""The goal of reach in stored runs and scores, also in those from before there was a choice."""

import json
from dataclasses import asdict, replace
from math import isnan, nan

import pytest

from helpers.runs import EVAL, small_config, small_source
from morphgen.errors import TaskError
from morphgen.rl.evaluation import eval_config_of, evaluate_baseline
from morphgen.rl.runs.checkpoint import config_from
from morphgen.rl.runs.robot_source import other_side
from morphgen.rl.scores.scores import score_from_json, score_table, scores_to_json
from morphgen.rl.scores.study import SCORES, baseline_cells, read_scores
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig

NEW = ("goal", "near_angle", "rotation_weight")
POSE = (ReachConfig(num_goals=7, goal="pose", near_angle=0.2), PushConfig())


def test_a_run_keeps_its_goal_and_old_runs_have_positions():
    config = replace(small_config(small_source()), tasks=POSE)
    data = json.loads(json.dumps(config.as_data()))
    assert config_from(data).tasks == POSE
    assert eval_config_of(config, 3).tasks[0] == replace(POSE[0], num_goals=100)
    for name in NEW:
        del data["reach"][name]
    assert config_from(data).tasks[0] == ReachConfig(num_goals=7)


@pytest.mark.parametrize(
    ("goal", "message"), [("poses", "unknown goal of reach 'poses'"), (3, "goal: invalid value 3")]
)
def test_an_invalid_goal_in_a_file_is_named(goal, message):
    data = json.loads(json.dumps(small_config(small_source()).as_data()))
    data["reach"]["goal"] = goal
    with pytest.raises(TaskError, match=message):
        config_from(data)


def test_scores_from_before_there_was_a_choice_are_those_of_positions(tmp_path):
    cell = baseline_cells(tmp_path, small_source(), EVAL)[0]
    evaluation = json.loads(json.dumps(cell.eval_config.as_data()))
    for name in NEW:
        del evaluation["reach"][name]
    cell.folder.mkdir(parents=True)
    data = {"eval": evaluation, "source": asdict(cell.source), "scores": {cell.agent: []}}
    (cell.folder / SCORES).write_text(json.dumps(data))
    assert read_scores(cell) == {cell.agent: []}
    of_poses = replace(cell, eval_config=replace(EVAL, tasks=POSE))
    with pytest.raises(TaskError, match="of another evaluation"):
        read_scores(of_poses)


def test_scores_of_poses_have_the_angle():
    config = replace(EVAL, tasks=(replace(EVAL.tasks[0], goal="pose"), *EVAL.tasks[1:]))
    source = other_side(small_source(), "test")
    (score,) = evaluate_baseline("ik", source, config)
    assert 0 < score.angle < config.tasks[0].near_angle
    (stored,) = scores_to_json([score])
    assert score_from_json(stored) == score
    assert f"{score.angle * 57.29578:.1f} deg" in score_table({"ik": [score]})
    (by_position,) = evaluate_baseline("ik", source, EVAL)
    assert isnan(by_position.angle)
    assert "deg" not in score_table({"ik": [by_position]})
    old = {name: value for name, value in stored.items() if name != "angle"}
    assert repr(score_from_json(old)) == repr(replace(score, angle=nan))
