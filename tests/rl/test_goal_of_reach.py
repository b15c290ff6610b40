"""The goal of reach in stored runs and scores."""

import json
from dataclasses import replace
from math import isnan

import pytest

from helpers.runs import EVAL, small_config, small_source
from morphgen.errors import TaskError
from morphgen.rl.evaluation import eval_config_of, evaluate_baseline
from morphgen.rl.runs.checkpoint import config_from
from morphgen.rl.runs.robot_source import other_side
from morphgen.rl.scores import score_table, scores_to_json
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig

NEW = ("goal", "near_angle", "rotation_weight")
POSE = (ReachConfig(num_goals=7, goal="pose", near_angle=0.2), PushConfig())


def test_a_run_keeps_its_goal_and_missing_constants_have_defaults():
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


def test_scores_of_poses_have_the_angle():
    config = replace(EVAL, tasks=(replace(EVAL.tasks[0], goal="pose"), *EVAL.tasks[1:]))
    source = other_side(small_source(), "test")
    (score,) = evaluate_baseline("ik", source, config)
    assert 0 < score.angle < config.tasks[0].near_angle
    (stored,) = scores_to_json([score])
    assert stored["angle"] == score.angle
    assert f"{score.angle * 57.29578:.1f} deg" in score_table({"ik": [score]})
    (by_position,) = evaluate_baseline("ik", source, EVAL)
    assert isnan(by_position.angle)
    assert "deg" not in score_table({"ik": [by_position]})
    assert scores_to_json([by_position])[0]["angle"] is None
