"""Training, also on drawn robots."""

import json
import re
import signal
from collections import Counter
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

import morphgen
from helpers import runs
from helpers.commands import tree
from helpers.grammars import shipped
from helpers.runs import PPO, QUIET, after, small_config, small_source, untimed, weights
from helpers.splits import member, split
from morphgen.cli import main
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import BenchmarkError, FormatError, GrammarError, TaskError
from morphgen.formats.files import locked_folder
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robots
from morphgen.model.robot import TOOL
from morphgen.progress import show_progress
from morphgen.rl.agents import mlp
from morphgen.rl.config import PolicyConfig
from morphgen.rl.runs import robot_source as sources
from morphgen.rl.runs import training
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint, read_config
from morphgen.rl.runs.robot_source import draw, drawn_source, robot_source, specs_of, split_source
from morphgen.rl.runs.training import ExecutionConfig, TrainingBatches, read_metrics, train
from morphgen.splits.split import Member, compose_member, read_split, split_names, write_split
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, load_robot
from morphgen.tasks.scenes.robot_tables import build_robot_tables


@pytest.fixture
def handlers():
    """Handlers of signals, which are those of before after the test."""
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    yield before
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, None])
def test_a_stopped_run_keeps_its_updates(tmp_path, number, handlers):
    """Signals and the end of the minutes let the running update end and write a checkpoint."""

    def interrupt(*_):
        raise KeyboardInterrupt

    config, folder = small_config(), tmp_path / "run"
    for each in handlers:
        signal.signal(each, interrupt)
    if number is None:
        (part,) = train(folder, config, execution=replace(QUIET, minutes=0))
        assert not training.is_done(part)
    else:
        show = after(2, partial(signal.raise_signal, number))
        with pytest.raises(KeyboardInterrupt):
            train(folder, config, execution=QUIET, show=show)
    assert {signal.getsignal(each) for each in handlers} == {interrupt}
    assert read_checkpoint(folder)[1]["update"] == (1 if number is None else 3)
    (part,) = train(folder, config, resume=True, execution=QUIET)
    assert training.is_done(part)
    assert [each["update"] for each in read_metrics(folder)] == list(range(1, 7))


def test_a_second_signal_acts_at_once(tmp_path, handlers):
    # A shell starts processes in the background with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def twice():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise runs.StoppedError

    with pytest.raises(runs.StoppedError):
        train(tmp_path / "run", small_config(), execution=QUIET, show=after(2, twice))


def test_minutes_count_from_the_first_update(tmp_path, monkeypatch):
    now = [0.0]  # seconds
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: now[0]))
    slowly = lambda *args: now.__setitem__(0, 1000.0) or specs_of(*args)  # noqa: E731
    monkeypatch.setattr(training, "specs_of", slowly)
    half_a_minute = lambda report, updates: now.__setitem__(0, now[0] + 30)  # noqa: E731
    execution = replace(QUIET, minutes=1)
    train(tmp_path, small_config(), execution=execution, show=lambda part: half_a_minute)
    assert len(read_metrics(tmp_path)) == 3


def test_a_run_writes_config_checkpoint_and_metrics_and_is_not_trained_again(tmp_path):
    seen, folder, config = [], tmp_path / "a" / "run", small_config()
    show = lambda report, updates: seen.append((report.update, updates))  # noqa: E731
    (part,) = train(folder, config, execution=QUIET, show=lambda part: show)
    assert part.folder == folder
    assert sorted(tree(folder)) == [CHECKPOINT, "config.json", training.METRICS]
    assert read_config(folder) == config
    assert seen == [(i, 6) for i in range(1, 7)]
    metrics = read_metrics(folder)
    assert [each["transitions"] for each in metrics] == [32 * i for i in range(1, 7)]
    run, learner = read_checkpoint(folder)
    assert (run, learner["update"]) == (config, 6)
    before = tree(tmp_path)
    assert train(folder, config, resume=True, execution=QUIET, show=runs.stop_after(1)) == [part]
    with pytest.raises(TaskError, match="pass --resume"):
        train(folder, config, execution=QUIET)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("agent", ["me-mlp", "me-tf", "me-graph"])
def test_all_agents_learn_to_push(tmp_path, agent):
    # Networks of two of them leave out what no pushing robot has, such as the goal.
    config = small_config(robot_source("prims", "push"), agent=agent)
    train(tmp_path / "run", config, execution=QUIET)
    metrics = read_metrics(tmp_path / "run")
    assert len(metrics) == 6
    assert {"success", "distance"} <= set(metrics[0]["terms"])


def run(folder, config, stop=0):
    return train(folder, config, resume=True, execution=QUIET, show=runs.stop_after(stop))


def assert_resumed_equals_whole(folder, config, *stops):
    """Compare a run that stops after some updates with one that does not stop."""
    cut, whole, often = folder / "cut", folder / "whole", training.updates_between(config)
    for stop in stops:
        with pytest.raises(runs.StoppedError):
            run(cut, config, stop)
        saved = stop // often * often
        assert (cut / CHECKPOINT).exists() == (saved > 0)
        assert not saved or read_checkpoint(cut)[1]["update"] == saved
    seen = []
    note = lambda report, updates: seen.append(report.update)  # noqa: E731
    train(cut, config, resume=True, execution=QUIET, show=lambda part: note)
    assert seen == [*range(saved + 1, config.num_updates + 1)]
    run(whole, config)
    assert runs.equal(weights(whole), weights(cut))
    assert untimed(whole) == untimed(cut)
    assert len(untimed(whole)) == config.num_updates


@pytest.mark.parametrize(
    "stops",
    [(8,), *(pytest.param(stops, marks=pytest.mark.slow) for stops in ((1,), (7, 13)))],
    ids=str,
)
def test_a_resumed_run_ends_with_the_same_weights(tmp_path, stops):
    config = small_config(small_source(), total_timesteps=24 * 4 * 8, slow_critic=True)
    assert_resumed_equals_whole(tmp_path, config, *stops)


@pytest.mark.parametrize(
    ("updates", "steps", "expected"),
    [
        (100_000, 128, 24),  # ten episodes
        (150, 128, 15),  # a tenth
        (150, 32, 37),  # a fourth
        (400, 32, 47),  # five episodes
        (3, 8, 1),
    ],
)
def test_checkpoints_are_five_to_ten_episodes_apart_and_four_at_least(updates, steps, expected):
    config = small_config(total_timesteps=4 * steps * updates, num_steps=steps)
    assert config.num_updates == updates
    assert training.updates_between(config) == expected


def test_weights_depend_on_the_seed_and_not_on_the_workers(tmp_path):
    ways = {"a": (0, QUIET), "b": (0, ExecutionConfig(2, tensorboard=False)), "c": (1, QUIET)}
    for name, (seed, execution) in ways.items():
        train(tmp_path / name, small_config(seed=seed, total_timesteps=64), execution=execution)
    a, b, c = (weights(tmp_path / name) for name in ways)
    assert runs.equal(a, b)
    assert not runs.equal(a, c)


def sizes_of(parts):
    return [(part.config.num_envs, part.config.ppo.total_timesteps) for part in parts]


def test_se_trains_a_policy_per_robot_with_a_share_of_the_budget(tmp_path):
    config = small_config(small_source(), agent="se", total_timesteps=128)
    parts = train(tmp_path / "run", config, execution=QUIET)
    names = [part.folder.name for part in parts]
    assert [part.config.source.member for part in parts] == names
    assert len(set(names)) == 2
    assert sizes_of(parts) == [(2, 64)] * 2
    assert len({part.config.seed for part in parts} | {config.seed}) == 3
    files = training.checkpoint_files(tmp_path / "run")
    assert [file.parent.name for file in files] == sorted(names)
    assert not runs.equal(*(weights(part.folder) for part in parts))
    (parts[0].folder / CHECKPOINT).unlink()
    says = f"1 of its 2 robots have no policy yet, such as {parts[0].folder.name}"
    with pytest.raises(TaskError, match=says):
        list(training.checkpoint_files(tmp_path / "run"))
    for one in (small_config(small_source()), small_config(agent="se")):
        assert len(training.subruns_of(tmp_path, one)) == 1
    whole = training.subruns_of(tmp_path, replace(config, full_budget=True))
    assert sizes_of(whole) == [(4, 128)] * 2


def test_a_run_folder_that_is_not_there_is_answered_with_those_beside_it(tmp_path):
    run = tmp_path / "runs" / "mine" / "me-graph+ik" / "seed0"
    run.mkdir(parents=True)
    (run / CHECKPOINT).touch()
    with pytest.raises(TaskError, match=rf"did you mean '{re.escape(str(run))}'"):
        list(training.checkpoint_files(tmp_path / "runs" / "mine" / "me-graph" / "seed0"))


def test_a_run_cannot_resume_with_a_changed_robot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in ("base=planar ee=cube", "base=planar ee=plane"):
        body = replace(morphgen.compose(words), name="own")
        path = morphgen.write(body, "robots", picture=False)
        config = small_config(robot_source(str(path), "reach"), total_timesteps=64)
        if words.endswith("cube"):
            first = config
            train(tmp_path / "run", config, execution=QUIET)
    assert config.source.name == str(path.resolve())
    with pytest.raises(TaskError, match="the robot has changed since the run began"):
        train(tmp_path / "new", first, execution=QUIET)
    with pytest.raises(TaskError, match=r"another run: source\.robot_hash"):
        train(tmp_path / "run", config, resume=True, execution=QUIET)


def test_fine_tuning_starts_from_the_networks_of_a_checkpoint(tmp_path):
    train(tmp_path / "first", small_config(total_timesteps=64), execution=QUIET)
    config = small_config(total_timesteps=32, learning_rate=1e-30, slow_critic=False)
    config = replace(config, initial_checkpoint=str(tmp_path / "first" / CHECKPOINT))
    train(tmp_path / "second", config, execution=QUIET)
    assert runs.equal(weights(tmp_path / "first"), weights(tmp_path / "second"))
    assert read_checkpoint(tmp_path / "second")[1]["update"] == 1
    wider = replace(config, policy=replace(config.policy, network=mlp.Config(4, 16, 1)))
    with pytest.raises(TaskError, match=r"network\.mlp_width 8, here 16$"):
        train(tmp_path / "third", wider, execution=QUIET)
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"num_envs": 0}, "--envs 0: expected 1 or more"),
        ({"sim": "bullet"}, "unknown simulator 'bullet'; did you mean 'pybullet'"),
        ({"seed": -1}, "--seed -1"),
        ({"device": "tpu"}, "unknown device 'tpu'"),
        ({"device": "cudaX"}, "unknown device 'cudaX'"),
        ({"initial_checkpoint": "none.pt"}, "no such checkpoint"),
        ({"source": small_source(), "num_envs": 1}, "--envs 1: fewer than the 2 robots"),
        ({"ppo": replace(PPO, total_timesteps=31)}, "an update takes 32 transitions"),
        ({"ppo": replace(PPO, minibatches=5)}, "equal minibatches"),
        (vars(small_config(small_source(), agent="se", total_timesteps=30)), "the share of "),
    ],
)
def test_a_run_that_cannot_start_writes_nothing(tmp_path, change, says):
    with pytest.raises(TaskError, match=says):
        train(tmp_path / "run", replace(small_config(), **change), execution=QUIET)
    assert tree(tmp_path) == {}


def test_the_number_of_workers_is_at_least_one():
    with pytest.raises(TaskError, match="--workers 0"):
        ExecutionConfig(0)


def test_training_requires_enough_links_for_the_test_robots(tmp_path):
    long = split((member("base=planar ee=cube", task="reach"),), (member("chain beads=7"),))
    config = small_config(split_source(long), total_timesteps=64)
    with pytest.raises(BenchmarkError, match=r"test robot '.*' has 25 links, more than max_links"):
        train(tmp_path / "run", config, execution=QUIET)
    assert tree(tmp_path) == {}
    train(tmp_path / "run", replace(config, max_links=25), execution=QUIET)
    assert read_checkpoint(tmp_path / "run")[1]["layout"]["links"] == 25


def test_a_run_folder_is_locked(tmp_path):
    with locked_folder(tmp_path), pytest.raises(FormatError, match="by another run"):
        train(tmp_path, small_config(), execution=QUIET)


def arm_of_three_joints():
    """An arm3 with a fixed base and a fixed wrist."""
    made = morphgen.compose("arm3")
    moving = [k for k in made.joint_chain(made.frame(TOOL).link) if made.joints[k].is_movable]
    fixed = {made.joints[k].name for k in (moving[0], moving[-1])}
    names = [made.joints[k].name for k in made.independent_joints]
    joints = tuple(
        replace(joint, kind="fixed", limits=None) if joint.name in fixed else joint
        for joint in made.joints
    )
    home = tuple(q for q, name in zip(made.home, names, strict=True) if name not in fixed)
    assert len(moving) - len(fixed) == 3
    return replace(made, joints=joints, home=home)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["se", "me-graph"])
def test_an_arm_of_three_joints_learns_to_reach(agent, tmp_path, capsys):
    arm, run = str(tmp_path / "arm"), str(tmp_path / "run")
    morphgen.write(arm_of_three_joints(), arm)
    options = ("--agent", agent, "--preset", "fast", "--steps", "400000", "--out", run)
    assert main(["train", arm, "task=reach", *options, "--no-tensorboard"]) == 0
    capsys.readouterr()
    chosen = ("--mode", "deterministic", "--episodes", "100", "--json")
    assert main(["eval", run, *chosen]) == 0
    (row,) = json.loads(capsys.readouterr().out)["deterministic"]
    assert row["random_success"] < 0.1
    assert row["success"] >= 0.8


CONFIGS = (ReachConfig(num_goals=3), PushConfig())


pytestmark = pytest.mark.usefixtures("module_cache")


def drawn_config(request="cubes:4,stick:2", *, updates=24, slice_updates=4, **more):
    """Return a run of four environments, on six robots by default."""
    source = drawn_source(request, "reach", **more)
    config = small_config(source, total_timesteps=updates * 4 * 8)
    return replace(config, tasks=CONFIGS, slice_updates=slice_updates)


@pytest.mark.parametrize(("robots", "size"), [(6, 4), (5, 5), (7, 2), (1000, 128)])
def test_slices_use_every_robot_equally_often(robots, size):
    slices = [training.slice_of(robots, size, i, seed=3) for i in range(robots)]
    assert all(len(each) == size for each in slices)
    assert Counter(np.concatenate(slices).tolist()) == dict.fromkeys(range(robots), size)
    first_pass = np.concatenate(slices)[:robots]
    assert sorted(first_pass) == list(range(robots))
    assert slices != [training.slice_of(robots, size, i, seed=4) for i in range(robots)]


def test_a_slice_lasts_two_episodes_or_less_in_a_short_run():
    many = small_config(drawn_source("cubes:9", "reach"), total_timesteps=4 * 8 * 10_000)
    assert training.num_slices(many) == 3
    assert training.default_slice_updates(many) == 75  # of 8 control steps
    assert training.default_slice_updates(replace(many, num_envs=9)) == 0
    short = small_config(drawn_source("cubes:9", "reach"), total_timesteps=4 * 8 * 11)
    assert training.default_slice_updates(short) == 3


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
    slices = [training.slice_of(6, 4, number, config.seed) for number in range(6)]
    assert seen == [[names[i] for i in each] for each in slices]
    assert not batches.changes_at(24)


def test_a_resumed_run_of_slices_ends_with_the_same_weights(tmp_path):
    # A checkpoint is written every six updates: at the end of a slice (12) and within one (6, 18).
    assert_resumed_equals_whole(tmp_path, drawn_config(), 7, 13, 17)
    assert {len(each["scores"]) for each in untimed(tmp_path / "whole")} == {0}


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
    assert_resumed_equals_whole(tmp_path, config, 5)


@pytest.mark.parametrize("task", ["reach", "push"])
def test_actuated_joints_are_counted_as_batches_do(task):
    robots = [load_robot(name) for name in ("planar-cube", "nlink", "arm3", "arm=ur5 ee=rethink")]
    mask = build_robot_tables(robots).action_mask(fingers=TASKS[task].moves_fingers)
    assert [training.num_actuated(robot, task) for robot in robots] == mask.sum(dim=1).tolist()


def test_runs_that_would_leave_robots_out_are_refused(tmp_path):
    own = split((member("base=planar ee=cube"),), (member("base=gantry ee=plane"),))
    write_split(own, tmp_path / "own.yaml")
    held_out = drawn_config(held_out=[tmp_path / "own.yaml"])
    says_se = "--agent se: learns one robot; --robots cubes:4,stick:2 needs an agent of many"
    for config, error in (
        (drawn_config(slice_updates=0), "--envs 4: fewer than the 6 robots"),
        (drawn_config(updates=4), "only 4 of 6 robots would be trained on"),
        (replace(drawn_config(), policy=small_config(agent="se").policy), says_se),
        (replace(drawn_config(), max_links=4), "has 5 links, more than max_links 4"),
        (replace(held_out, max_links=6), "test robot 'gantry-plane' has 7 links"),
    ):
        with pytest.raises((TaskError, BenchmarkError), match=error):
            run(tmp_path / "run", config)
    assert not (tmp_path / "run").exists()


def test_a_run_of_other_robots_is_not_resumed(tmp_path):
    config = drawn_config(updates=8)
    source = replace(config.source, drawn_hash=draw(config.source, GoalConfig(tasks=CONFIGS)).hash)
    run(tmp_path / "run", replace(config, source=source))
    for other in (drawn_config(updates=8, seed=1), drawn_config("cubes:5,stick:2", updates=8)):
        with pytest.raises(TaskError, match="has another run: source"):
            run(tmp_path / "run", other)


def test_goal_sets_are_reported_robot_by_robot():
    source = split_source(read_split("extrapolation/primitives/reach"), side="test")
    config = replace(small_config(), source=source)
    for work in (lambda: specs_of(source, GoalConfig()), lambda: TrainingBatches(config)):
        reports = []
        with show_progress(lambda *now: reports.append(now)):  # noqa: B023
            work()
        assert reports == [(0, 2), (1, 2), (2, 2)]


LIBRARY = default_library()
FEW = GoalConfig(tasks=(ReachConfig(num_goals=3),))


@pytest.fixture(autouse=True)
def _nothing_drawn(monkeypatch):
    monkeypatch.setattr(sources, "_drawn", {})


@pytest.fixture
def grammar_file(tmp_path):
    def write(text):
        path = tmp_path / "mine.grammar"
        path.write_text(f"{text}\n")
        return path

    return write


def hashes(robots):
    return [each.robot_hash for each in robots.members]


def test_robots_are_those_of_sample_with_their_goals():
    source = drawn_source("cubes:3, stick:2", "reach", seed=4)
    assert (source.name, sources.num_drawn(source)) == ("cubes:3,stick:2", 5)
    assert sources.tasks_of(source) == ("reach",)
    robots = draw(source, FEW)
    sampled = []
    for name, count in source.grammars:
        sampled += [each.robot for each in sample_robots(shipped(name), LIBRARY, count, seed=4)]
    assert [each.name for each in robots.members] == [each.name for each in sampled]
    assert hashes(robots) == [robot_hash(each) for each in sampled]
    assert [each.category for each in robots.members] == ["cubes"] * 3 + ["stick"] * 2
    assert robots.most_links == 5
    assert robots.skipped == {}
    for each, spec in zip(robots.members, robots.specs, strict=True):
        assert robot_hash(compose_member(each, LIBRARY)) == each.robot_hash
        assert (spec.robot.name, spec.task, len(spec.goals.q)) == (each.name, "reach", 3)


def test_robots_depend_on_the_seed_and_not_on_their_number():
    source = drawn_source("cubes:3", "reach")
    robots = draw(source, FEW)
    assert draw(source, FEW) is robots  # once per process
    others = draw(drawn_source("cubes:3", "reach", seed=1), FEW)
    assert not set(hashes(others)) & set(hashes(robots))
    assert hashes(draw(drawn_source("cubes:2", "reach"), FEW)) == hashes(robots)[:2]


@pytest.mark.slow
def test_robots_do_not_depend_on_the_processes(monkeypatch):
    source = drawn_source("cubes:3", "reach")
    robots = draw(source, FEW)
    monkeypatch.setattr(sources, "_drawn", {})
    monkeypatch.setattr(sources, "ROBOTS_PER_JOB", 2)
    progress = []
    with show_progress(lambda *now: progress.append(now)):
        again = draw(source, FEW, jobs=2)
    assert (hashes(again), again.hash) == (hashes(robots), robots.hash)
    assert progress == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_test_robots_of_splits_are_never_drawn(tmp_path):
    free = draw(drawn_source("cubes:3", "reach"), FEW)
    test = Member("other-name", "cubes", free.members[1].derivation, "push", True, hashes(free)[1])
    write_split(split((member("base=planar ee=cube"),), (test,)), tmp_path / "own.yaml")
    source = drawn_source("cubes:3", "reach", held_out=[tmp_path / "own.yaml"])
    assert source.held_out == (str(tmp_path / "own.yaml"),)
    robots = draw(source, FEW)
    assert [each.name[-1] for each in robots.members] == ["0", "2", "3"]
    assert hashes(robots)[:2] == [hashes(free)[0], hashes(free)[2]]
    assert robots.skipped == {"held out": 1}
    assert test.robot_hash in robots.held_out
    assert test.robot_hash not in free.held_out
    shipped = {each.robot_hash for name in split_names() for each in read_split(name).test}
    assert shipped
    assert shipped < set(robots.held_out)


def test_equal_robots_are_drawn_once(grammar_file):
    path = grammar_file("robot -> cubes(size=0.1) | cubes(size=0.2)")
    robots = draw(drawn_source(f"{path}:2", "reach"), FEW)
    assert len(set(hashes(robots))) == 2
    ((name, count),) = robots.skipped.items()
    assert (name, count > 0) == ("drawn before", True)
    says = "2 of 20 robots of mine can be used, expected 3; mine-0000"
    with pytest.raises(TaskError, match=says):
        draw(drawn_source(f"{path}:3", "reach"), FEW)


def test_robots_that_cannot_do_the_task_are_skipped(grammar_file):
    cartpole = "cartpole(length=uniform(0.5, 1.5), mass=1)"
    path = grammar_file(f"robot -> cubes(size=uniform(0.1, 0.2)) | {cartpole}")
    robots = draw(drawn_source(f"{path}:3", "push"), GoalConfig())
    assert {spec.robot.dof for spec in robots.specs} == {2}
    assert robots.skipped.keys() == {"without goals"}
    with pytest.raises(TaskError, match=r"0 of 21 robots of cartpole .*tool does not move along y"):
        draw(drawn_source("cartpole:3", "push"), GoalConfig())


def test_grammar_files_are_named_by_their_absolute_path(grammar_file, monkeypatch):
    path = grammar_file("robot -> cubes(size=uniform(0.1, 0.2))")
    monkeypatch.chdir(path.parent)
    source = drawn_source("mine.grammar:2", "reach")
    assert source.grammars == ((str(path), 2),)
    assert source.name == "mine:2"
    robots = draw(source, FEW)
    grammar_file("robot -> cubes(size=uniform(0.1, 0.19))")
    sources._drawn.clear()
    with pytest.raises(TaskError, match="mine:2 with seed 0 have changed since the run began"):
        draw(replace(source, drawn_hash=robots.hash), FEW)


@pytest.mark.parametrize(
    ("request_text", "error"),
    [
        ("cubes", "'cubes' is not a grammar and a number of robots"),
        ("cubes:0", "'cubes:0' is not a grammar"),
        ("cubes:2,", "'' is not a grammar"),
        ("cubes:2,cubes:3", "names the grammar 'cubes' 2 times"),
        ("cubs:2", "unknown grammar 'cubs'"),
    ],
)
def test_malformed_requests_are_refused(request_text, error):
    with pytest.raises((TaskError, GrammarError), match=error):
        drawn_source(request_text, "reach")


def test_drawn_robots_have_no_test_side():
    source = drawn_source("cubes:2", "reach")
    assert sources.other_side(source, "train") is source
    for refused in (lambda: sources.other_side(source, "test"), lambda: specs_of(source, FEW)):
        with pytest.raises(TaskError, match="no test side: name other robots with --split"):
            refused()


def test_the_list_of_robots_builds_them_again(tmp_path):
    source = drawn_source("cubes:2,stick:1", "reach")
    robots = draw(source, FEW)
    sources.write_drawn(tmp_path, source, robots)
    content = (tmp_path / sources.FILE).read_bytes()
    data = json.loads(content)
    assert (data["robots"], data["seed"], data["hash"]) == (source.name, 0, robots.hash)
    assert data["held_out"] == split_names()
    assert data["held_out_bodies"] == list(robots.held_out)
    assert sources.read_drawn(tmp_path) == robots.members
    sources.write_drawn(tmp_path, source, robots)
    assert (tmp_path / sources.FILE).read_bytes() == content


def test_robots_that_were_trained_on_are_named(tmp_path):
    source = drawn_source("cubes:2", "reach")
    robots = draw(source, FEW)
    sources.write_drawn(tmp_path, source, robots)
    drawn, new = replace(robots.members[0], name="a"), member("base=gantry ee=plane", name="b")
    test_side = split_source(split((new,), (drawn, new)), side="test")
    assert sources.trained_on(tmp_path, test_side) == ["a"]
    assert sources.trained_on(tmp_path, replace(test_side, side="train")) == []
    one = robot_source("planar-cube", "reach")
    assert sources.trained_on(tmp_path, one) == []
    same = replace(one, robot_hash=drawn.robot_hash)
    assert sources.trained_on(tmp_path, same) == ["planar-cube"]


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (None, "no list of drawn robots"),
        ("{", "no list of drawn robots"),
        ("[]", "expected the key 'drawn'"),
        ('{"drawn": [7]}', r"drawn: \[0\]: invalid value 7"),
        ('{"drawn": [{"name": "a"}]}', r"drawn: \[0\]: missing key 'category'"),
        ('{"drawn": [{"name": "a", "body": 7}]}', r"drawn: \[0\]\.body: invalid value 7"),
    ],
)
def test_malformed_lists_are_refused(tmp_path, content, error):
    if content is not None:
        (tmp_path / sources.FILE).write_text(content)
    with pytest.raises(TaskError, match=error):
        sources.read_drawn(tmp_path)
