"""A run's folder: config, checkpoint, metrics and events."""

import json
import math
import re
import sys
import time
from contextlib import nullcontext
from dataclasses import asdict, fields, replace

import pytest
import torch

from helpers.commands import tree
from helpers.runs import EVAL, PPO, small_config, small_source
from morphgen.errors import FormatError, MissingDependencyError, TaskError
from morphgen.rl.evaluation import eval_config_of, evaluate_baseline
from morphgen.rl.ppo import UpdateMetrics
from morphgen.rl.runs import checkpoint
from morphgen.rl.runs.checkpoint import CHECKPOINT, CONFIG, config_from, open_run, read_checkpoint
from morphgen.rl.runs.robot_source import drawn_source, other_side, robot_source, source_from
from morphgen.rl.runs.training import METRICS, ROBOTS, read_metrics, recording
from morphgen.rl.scores import Evaluation, scores_to_json
from morphgen.tasks.configs import PushConfig, ReachConfig


def report(update, success=0.5):
    numbers = {each.name: 0.25 for each in fields(UpdateMetrics) if each.type == "float"}
    numbers |= {"update": update, "transitions": 32 * update, "episodes": 3, "unstable": 0}
    terms, scores = {"distance": -0.5}, (1.0, math.nan)
    return UpdateMetrics(**{**numbers, "success": success}, terms=terms, scores=scores)


def test_every_field_of_a_config_is_saved(tmp_path):
    other = {"device": "cuda", "initial_checkpoint": "a.pt", "full_budget": True}
    config = replace(small_config(small_source(), agent="se", gamma=0.9), **other)
    open_run(tmp_path / "run", config, resume=False)
    assert checkpoint.read_config(tmp_path / "run") == config
    stored = json.loads((tmp_path / "run" / CONFIG).read_text())
    assert stored["ppo"]["gamma"] == 0.9
    assert stored["reach"]["near"] == 0.03
    assert "planar" in stored["source"]["split"]
    assert config_from(stored) == config


NEWER = replace(
    small_source(), split=re.sub("(?m)^morphgen: .*$", 'morphgen: "0.2.99"', small_source().split)
)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({}, None),
        ({"device": "cuda:1"}, None),  # the same kind of device
        ({"source": NEWER}, None),  # the same robots of another version of morphgen
        ({"device": "cpu"}, "another run: device cuda, not cpu"),
        (
            {"seed": 3, "ppo": replace(PPO, gamma=0.5)},
            r"run: .*gamma 0\.99, not 0\.5; .*seed 0, not 3",
        ),
        ({"source": small_source(task="push")}, r"another run: source\.split [0-9a-f]{32}, not"),
        ({"source": small_config().source}, r"source\.name mine/small, not planar-cube"),
    ],
)
def test_a_run_continues_only_with_resume_and_the_same_config(tmp_path, change, says):
    folder, config = tmp_path / "runs" / "one", replace(small_config(small_source()), device="cuda")
    open_run(folder, config, resume=True)
    checkpoint.write_checkpoint(folder, config, {"update": 1})
    before = tree(tmp_path)
    with pytest.raises(TaskError, match="has a run: pass --resume"):
        open_run(folder, config, resume=False)
    with nullcontext() if says is None else pytest.raises(TaskError, match=says):
        open_run(folder, replace(config, **change), resume=True)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("resume", [True, False])
def test_a_run_without_a_checkpoint_may_be_replaced(tmp_path, resume):
    first, other = small_config(), small_config(small_source(), agent="se")
    open_run(tmp_path, first, resume=False)
    open_run(tmp_path / ROBOTS / "a", first, resume=False)
    open_run(tmp_path, other, resume=resume)
    assert checkpoint.read_config(tmp_path) == other
    checkpoint.write_checkpoint(tmp_path / ROBOTS / "a", first, {"update": 1})
    with pytest.raises(TaskError, match="has a run: pass --resume"):
        open_run(tmp_path, first, resume=False)


def test_files_of_others_are_not_changed(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    (tmp_path / CONFIG).write_text('{"model": "mine"}')
    before = tree(tmp_path)
    for folder, says in (
        (tmp_path, "is not the config of a run"),
        (tmp_path / "mine", "not the folder of a run"),
        (tmp_path / "mine" / "letter.txt", "is a file"),
    ):
        for resume in (True, False):
            with pytest.raises(TaskError, match=says):
                open_run(folder, small_config(), resume=resume)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("text", ["{}", "[]", "so", '{"format": 3}', '{"source": {"name": "a"}}'])
def test_an_invalid_config_is_rejected(tmp_path, text):
    (tmp_path / CONFIG).write_text(text)
    with pytest.raises(TaskError, match="is not the config of a run"):
        checkpoint.read_config(tmp_path)


def test_other_format_versions_are_rejected(tmp_path):
    open_run(tmp_path, small_config(), resume=False)
    checkpoint.write_checkpoint(tmp_path, small_config(), {"update": 3})
    config = tmp_path / CONFIG
    config.write_text(config.read_text().replace('"format": 3', '"format": 1'))
    with pytest.raises(TaskError, match=r"config.json has format 1; expected 3: it"):
        checkpoint.read_config(tmp_path)
    data = checkpoint.unpacked(tmp_path / CHECKPOINT) | {"format": 1}
    (tmp_path / CHECKPOINT).write_bytes(checkpoint.packed(data, CHECKPOINT))
    with pytest.raises(TaskError, match=r"checkpoint.pt has format 1"):
        read_checkpoint(tmp_path)


def test_files_that_are_not_checkpoints_are_rejected(tmp_path):
    checkpoint.write_checkpoint(tmp_path, small_config(), {"update": 1})
    whole = (tmp_path / CHECKPOINT).read_bytes()
    torch.save({"weights": torch.ones(1)}, tmp_path / "other.pt")
    contents = {"empty.pt": b"", "text.pt": b"hello", "half.pt": whole[: len(whole) // 2]}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    for name in (*contents, "other.pt"):
        with pytest.raises(TaskError, match=f"{name} is not a checkpoint"):
            read_checkpoint(tmp_path / name)
    with pytest.raises(TaskError, match="no such checkpoint"):
        read_checkpoint(tmp_path / "none.pt")


def record(folder, *reports, after=0, tensorboard=False):
    """Record metrics of a run that continues after an update."""
    with recording(folder, after, tensorboard=tensorboard) as recorder:
        for each in reports:
            recorder(each)


def test_resumed_metrics_drop_lines_after_the_checkpoint(tmp_path):
    record(tmp_path, report(1, success=math.nan), report(2), report(3))
    with (tmp_path / METRICS).open("a") as file:
        file.write('{"update": 4, "tran')
    assert [each["update"] for each in read_metrics(tmp_path)] == [1, 2, 3]
    record(tmp_path, report(3, success=0.75), after=2)
    found = read_metrics(tmp_path)
    assert [each["update"] for each in found] == [1, 2, 3]
    assert [each["success"] for each in found] == [None, 0.5, 0.75]
    assert found[0]["scores"] == [1.0, None]
    assert found[1] == json.loads(json.dumps(asdict(report(2)) | {"scores": [1.0, None]}))


def test_an_invalid_metrics_line_is_named(tmp_path):
    record(tmp_path, report(1))
    first = (tmp_path / METRICS).read_text()
    for broken in ("\0\0\0", "[]", "{}"):
        (tmp_path / METRICS).write_text(f"{first}{broken}\n")
        with pytest.raises(FormatError, match=r"metrics\.jsonl, line 2: not the report"):
            read_metrics(tmp_path)


def test_tensorboard_reads_the_events(tmp_path):
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    first, second, third = report(1, success=math.nan), report(2, success=0.0), report(3)
    record(tmp_path, first, second, third, tensorboard=True)
    # Files are read by the second in their names, then by a counter as text: 10 before 9.
    time.sleep(1)
    record(tmp_path, report(3, success=0.2), after=2, tensorboard=True)
    shown = accumulators.EventAccumulator(str(tmp_path / "events")).Reload()
    points = [(each.step, each.value) for each in shown.Scalars("success")]
    assert points == [(2, 0.0), (3, pytest.approx(0.2))]
    assert [each.value for each in shown.Scalars("terms/distance")] == [-0.5] * 3


def test_a_missing_tensorboard_names_its_package_and_option(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingDependencyError, match="--no-tensorboard"):
        record(tmp_path, tensorboard=True)


def test_a_source_needs_a_split_or_a_robot_with_a_task():
    config = small_config().as_data()
    config["source"]["task"] = None
    with pytest.raises(TaskError, match="run: source: missing key 'split'"):
        config_from(json.loads(json.dumps(config)))


OLD = {"split": "", "task": None, "obstacles": False, "side": "train", "robot_hash": ""}
OLD |= {"member": None, "goal_dir": "", "grammars": [], "draw_seed": 0, "held_out": []}
OLD |= {"drawn_hash": ""}
"""Fields that sources of all kinds had until version 0.3, but for those that they share."""


@pytest.mark.parametrize(
    "source",
    [
        replace(small_source(), member="planar-cube"),
        robot_source("planar-cube", "push", obstacles=True, goal_seed=3),
        drawn_source("cubes:3", "reach", seed=4),
    ],
)
def test_a_source_of_an_older_run_is_read(source):
    stored = json.loads(json.dumps(asdict(source)))
    assert source_from(stored, "source") == source_from(OLD | stored, "source") == source
    with pytest.raises(TaskError, match="source: unknown key 'speed'"):
        source_from({**stored, "speed": 1}, "source")


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


def test_scores_of_poses_have_the_angle():
    config = replace(EVAL, tasks=(replace(EVAL.tasks[0], goal="pose"), *EVAL.tasks[1:]))
    source = other_side(small_source(), "test")
    (score,) = evaluate_baseline("ik", source, config)
    assert 0 < score.angle < config.tasks[0].near_angle
    (stored,) = scores_to_json([score])
    assert stored["angle"] == score.angle
    assert f"{score.angle * 57.29578:.1f} deg" in Evaluation({"ik": [score]}).table()
    (by_position,) = evaluate_baseline("ik", source, EVAL)
    assert math.isnan(by_position.angle)
    assert "deg" not in Evaluation({"ik": [by_position]}).table()
    assert scores_to_json([by_position])[0]["angle"] is None
