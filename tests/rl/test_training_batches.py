"""Training on more drawn robots than environments, slice by slice."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from helpers.commands import tree
from helpers.learners import learner
from helpers.line_batch import OnALine
from helpers.runs import (
    QUIET,
    StoppedError,
    equal,
    small_config,
    stop_after,
    untimed,
    weights,
)
from helpers.splits import member, split
from morphgen.errors import BenchmarkError, TaskError
from morphgen.progress import show_progress
from morphgen.rl.config import PolicyConfig
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint, read_config
from morphgen.rl.runs.robot_source import FILE, draw, drawn_source, specs_of, split_source
from morphgen.rl.runs.training import (
    TrainingBatches,
    default_slice_updates,
    num_actuated,
    num_slices,
    slice_of,
    train,
    use_batch,
)
from morphgen.splits.split_file import read_split, write_split
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, load_robot
from morphgen.tasks.scenes.robot_tables import build_robot_tables

CONFIGS = (ReachConfig(num_goals=3), PushConfig())


pytestmark = pytest.mark.usefixtures("module_cache")


def drawn_config(request="cubes:4,stick:2", *, updates=24, slice_updates=4, **more):
    """Return a run of four environments, on six robots by default."""
    source = drawn_source(request, "reach", **more)
    config = small_config(source, total_timesteps=updates * 4 * 8)
    return replace(config, tasks=CONFIGS, slice_updates=slice_updates)


def run(folder, config, stop=0):
    return train(folder, config, resume=True, execution=QUIET, show=stop_after(stop))


@pytest.mark.parametrize(("robots", "size"), [(6, 4), (5, 5), (7, 2), (1000, 128)])
def test_slices_use_every_robot_equally_often(robots, size):
    slices = [slice_of(robots, size, i, seed=3) for i in range(robots)]
    assert all(len(each) == size for each in slices)
    assert Counter(np.concatenate(slices).tolist()) == dict.fromkeys(range(robots), size)
    first_pass = np.concatenate(slices)[:robots]
    assert sorted(first_pass) == list(range(robots))
    assert slices != [slice_of(robots, size, i, seed=4) for i in range(robots)]


def test_a_slice_lasts_two_episodes_or_less_in_a_short_run():
    many = small_config(drawn_source("cubes:9", "reach"), total_timesteps=4 * 8 * 10_000)
    assert num_slices(many) == 3
    assert default_slice_updates(many) == 75  # of 8 control steps
    assert default_slice_updates(replace(many, num_envs=9)) == 0
    short = small_config(drawn_source("cubes:9", "reach"), total_timesteps=4 * 8 * 11)
    assert default_slice_updates(short) == 3


def test_batches_have_the_robots_of_their_slice():
    config = drawn_config()
    robots = draw(config.source, GoalConfig(tasks=CONFIGS))
    batches = TrainingBatches(config)
    assert batches.most_links == 5
    seen = []
    for update in range(24):
        if batches.changes_at(update) or not update:
            batch = batches.make(update)
            seen.append([spec.robot.name for spec in batch.specs])
            assert batch.env_robot_index.tolist() == [0, 1, 2, 3]
    batches.close()
    assert len(seen) == 6
    names = [each.name for each in robots.members]
    assert seen == [[names[i] for i in slice_of(6, 4, number, config.seed)] for number in range(6)]
    assert not batches.changes_at(24)


def test_recorded_scores_are_means_of_grammars():
    config = drawn_config()
    batches, grammars = TrainingBatches(config), ["cubes"] * 4 + ["stick"] * 2
    for update in (1, 4, 5):
        robots = slice_of(6, 4, (update - 1) // 4, config.seed)
        of = {name: [i for i in robots if grammars[i] == name] for name in ("cubes", "stick")}
        means = batches.recorded_scores([float(i) for i in robots], update)
        assert means == pytest.approx([np.mean(of["cubes"]), np.mean(of["stick"])])


@pytest.mark.parametrize(
    "stops", [pytest.param((8,), marks=pytest.mark.slow), (7, 13, 17)], ids=str
)
def test_a_resumed_run_ends_with_the_same_weights(tmp_path, stops):
    # A checkpoint is written every six updates: at the end of a slice (12) and within one (6, 18).
    config = drawn_config()
    for stop in stops:
        with pytest.raises(StoppedError):
            run(tmp_path / "cut", config, stop)
        assert read_checkpoint(tmp_path / "cut")[1]["update"] == stop // 6 * 6
    run(tmp_path / "cut", config)
    run(tmp_path / "whole", config)
    assert equal(weights(tmp_path / "whole"), weights(tmp_path / "cut"))
    assert untimed(tmp_path / "whole") == untimed(tmp_path / "cut")
    assert len(untimed(tmp_path / "whole")) == 24
    assert {len(each["scores"]) for each in untimed(tmp_path / "whole")} == {2}


def test_slices_may_differ_in_their_largest_robot(tmp_path):
    # Two of them at a time: a slice has the stick, with one joint more, or it has not.
    config = drawn_config("cubes:4,stick:1", updates=8, slice_updates=2)
    policy = PolicyConfig("me-graph", observe=("joint", "jacobian"), normalize=True)
    config = replace(config, policy=policy, num_envs=2)
    config = replace(config, ppo=replace(config.ppo, total_timesteps=8 * 2 * 8))
    batches = TrainingBatches(config)
    observations = [batches.make(update).observe() for update in (0, 2, 4)]
    batches.close()
    assert len({len(observation["links"].any(0).nonzero()) for observation in observations}) == 2
    assert {observation["joints"].shape for observation in observations} == {(2, 3)}
    with pytest.raises(StoppedError):
        run(tmp_path / "cut", config, 5)
    run(tmp_path / "cut", config)
    run(tmp_path / "whole", config)
    assert equal(weights(tmp_path / "whole"), weights(tmp_path / "cut"))


@pytest.mark.parametrize("task", ["reach", "push"])
def test_actuated_joints_are_counted_as_batches_do(task):
    robots = [load_robot(name) for name in ("planar-cube", "nlink", "arm3", "arm=ur5 ee=rethink")]
    mask = build_robot_tables(robots).action_mask(fingers=TASKS[task].moves_fingers)
    assert [num_actuated(robot, task) for robot in robots] == mask.sum(dim=1).tolist()


def test_a_run_with_an_environment_for_every_robot_has_one_batch(tmp_path):
    config = drawn_config("cubes:2,stick:1", updates=6, slice_updates=0)
    run(tmp_path / "run", config)
    assert sorted(tree(tmp_path / "run")) == [CHECKPOINT, "config.json", "metrics.jsonl", FILE]
    assert read_config(tmp_path / "run") == config
    assert not TrainingBatches(config).changes_at(3)


def test_runs_that_would_leave_robots_out_are_refused(tmp_path):
    cases = [
        (drawn_config(slice_updates=0), "--envs 4: fewer than the 6 robots"),
        (drawn_config(updates=4), "only 4 of 6 robots would be trained on"),
        (
            replace(drawn_config(), policy=small_config(agent="se").policy),
            "--agent se: learns one robot; --robots cubes:4,stick:2 needs an agent of many",
        ),
    ]
    for config, error in cases:
        with pytest.raises(TaskError, match=error):
            run(tmp_path / "run", config)
    with pytest.raises(BenchmarkError, match="has 5 links, more than max_links 4"):
        run(tmp_path / "run", replace(drawn_config(), max_links=4))
    own = split((member("base=planar ee=cube"),), (member("base=gantry ee=plane"),))
    write_split(own, tmp_path / "own.yaml")
    held_out = drawn_config(held_out=[tmp_path / "own.yaml"])
    with pytest.raises(BenchmarkError, match="test robot 'gantry-plane' has 7 links"):
        run(tmp_path / "run", replace(held_out, max_links=6))
    assert not (tmp_path / "run").exists()


def test_a_run_of_other_robots_is_not_resumed(tmp_path):
    config = drawn_config(updates=8)
    source = replace(config.source, drawn_hash=draw(config.source, GoalConfig(tasks=CONFIGS)).hash)
    run(tmp_path / "run", replace(config, source=source))
    for other in (drawn_config(updates=8, seed=1), drawn_config("cubes:5,stick:2", updates=8)):
        with pytest.raises(TaskError, match="has another run: source"):
            run(tmp_path / "run", other)


def test_a_learner_continues_in_another_batch():
    agent = learner()
    agent.iterate()
    other = OnALine(8, seed=1)
    use_batch(agent, other)
    assert agent.batch is other
    before = other.state_dict()
    assert before == OnALine(8, seed=1).state_dict()  # nothing was drawn yet
    agent.iterate()
    assert other.spread
    assert other.progress == [1 / 4]


def test_a_batch_that_does_not_fit_is_refused():
    agent = learner()
    with pytest.raises(TaskError, match="6 environments with discrete actions; expected 8"):
        use_batch(agent, OnALine(6))
    with pytest.raises(TaskError, match="8 environments with continuous actions; expected 8 with"):
        use_batch(agent, OnALine(8, kind="continuous"))
    agent = learner(agent="me-tf")
    larger = OnALine(8)
    observe = larger.observe
    larger.observe = lambda: {**observe(), "links": observe()["links"] | True}
    with pytest.raises(TaskError, match="a robot has 4 links; the learner has room for 3"):
        use_batch(agent, larger)


def test_goal_sets_are_reported_robot_by_robot():
    source = split_source(read_split("extrapolation/primitives/reach"), side="test")
    config = replace(small_config(), source=source)
    for work in (lambda: specs_of(source, GoalConfig()), lambda: TrainingBatches(config)):
        reports = []
        with show_progress(lambda *now: reports.append(now)):  # noqa: B023
            work()
        assert reports == [(0, 2), (1, 2), (2, 2)]
