"""Training, also on drawn robots, playback, demonstrations, evaluation and studies."""

import json
import re
import signal
import time
from pathlib import Path

import imageio.v2 as imageio
import pytest

from helpers.commands import start, tree
from helpers.runs import NETWORK, ROLLOUT, RUN, SMALL, small_split
from helpers.splits import member, split
from morphgen.benchmark.scores.submission import read_table
from morphgen.cli import progress
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint, read_config
from morphgen.rl.runs.robot_source import FILE, fresh_source, members, read_drawn, specs_of
from morphgen.rl.runs.training import METRICS, _StopRequest, read_metrics
from morphgen.rl.shipped_policies import POLICIES, ShippedPolicy, policies_for
from morphgen.splits.split import Member, write_split
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.split_goals import read_goals

pytestmark = pytest.mark.usefixtures("own_cache")


def test_single_robot_is_trained_resumed_evaluated_and_played(run, tmp_path):
    code, out, err = run(*RUN, "--steps", "128", "--seed", "3")
    folder = tmp_path / "runs" / "planar-cube-reach" / "me-mlp" / "seed3"
    assert (code, out) == (0, f"{folder.relative_to(tmp_path) / CHECKPOINT}\n")
    assert "update 4 of 4, 128 steps, score -" in err
    assert re.search(r"success (\d+%|unknown), ", err)
    assert re.search(r"[\d,]+ steps/s, 0\.0 min left", err)
    config = read_config(folder)
    assert (config.seed, config.policy.discrete, config.policy.agent) == (3, True, "me-mlp")
    assert [each["update"] for each in read_metrics(folder)] == [1, 2, 3, 4]
    assert list(folder.glob("events/events.out.tfevents.*"))

    before = tree(folder)
    code, _, err = run(*RUN, "--steps", "128", "--seed", "3", "--resume")
    assert (code, "update" in err) == (0, False)
    command = f"morphgen finetune {folder.relative_to(tmp_path)} --on train --steps"
    assert f"is finished, with all 128 steps; to train longer: {command} N\n" in err
    assert tree(folder) == before
    few = ("--envs", "4", *ROLLOUT, "--no-tensorboard")
    assert run(*command.split()[1:], "32", *few)[0] == 0

    _, out, _ = run("eval", folder, "--episodes", "2", "--out", "scores.csv")
    assert [line.split()[3] for line in out.splitlines()[2:4]] == ["deterministic", "stochastic"]
    assert "deterministic: MT reach " in out
    assert len((tmp_path / "scores.csv").read_text().splitlines()) == 3
    words = ("eval", folder / CHECKPOINT, "--episodes", "2", "--mode", "stochastic", "--json")
    (score,) = json.loads(run(*words)[1])["stochastic"]
    assert (score["robot"], score["episodes"], score["steps"]) == ("planar-cube", 2, 600)
    assert score["score"] == pytest.approx(score["raw"] - score["random"])

    words = ("play", "reach", "planar-cube", "--policy", folder, "--sim", "mujoco")
    assert run(*words)[1].startswith("episode 1: ")


def test_resume_continues_to_the_steps_of_the_run(run, monkeypatch):
    quick = (*ROLLOUT, "--no-tensorboard", "--out")
    words = ("planar-cube", "task=reach", "--agent", "me-mlp", *NETWORK)
    train = ("train", *words, *quick, "run")
    finetune = ("finetune", "run", "--on", "train", *quick, "tuned")
    for command, sim in ((train, "kinematic"), (finetune, "mujoco")):
        with monkeypatch.context() as patch:
            patch.setattr(_StopRequest, "is_requested", True)
            run(*command, "--steps", "96", "--envs", "4", "--sim", sim)
        folder = Path(command[-1])
        assert [each["update"] for each in read_metrics(folder)] == [1]
        _, _, err = run("play", "reach", "planar-cube", "--policy", folder, "--sim", sim)
        assert err == f"morphgen: {folder} is not finished: update 1 of 3\n"
        assert run(*command, "--resume")[0] == 0
        assert [each["update"] for each in read_metrics(folder)] == [1, 2, 3]
        assert "num_envs 4, not 8" in run(*command, "--resume", "--envs", "8")[2]


@pytest.mark.slow
def test_max_links_defaults_to_the_size_of_the_robot(run, ok):
    words = ("train", "chain", "beads=7", "task=reach", "--agent", "me-mlp", *SMALL)
    words += ("--steps", "32")
    for options, links in (((), 25), (("--max-links", "26"), 26)):
        assert run(*words, "--out", f"run{links}", *options)[0] == 0
        assert read_checkpoint(Path(f"run{links}"))[1]["layout"]["links"] == links
    assert "chain" in run("eval", "run26", "--episodes", "1", "--mode", "deterministic")[1]
    for policy in ("run26", "zero"):
        assert ok("play", "reach", "chain", "beads=7", "--policy", policy).startswith("episode 1: ")


@pytest.mark.slow
def test_the_goal_of_the_training_is_that_of_all_commands_on_its_policy(run, tmp_path):
    quick = ("--steps", "32", "--no-tensorboard")
    assert run(*RUN, *quick, "--goal", "pose")[0] == 0
    folder = tmp_path / "runs" / "planar-cube-reach-pose" / "me-mlp" / "seed0"
    (reach,) = [each for each in read_config(folder).tasks if each.task == "reach"]
    assert reach.goal == "pose"
    _, _, err = run(*RUN, *quick, "--resume", "--out", folder)
    assert "has another run: reach.goal pose, not position" in err

    words = ("eval", folder, "--episodes", "1", "--mode", "deterministic", "--json")
    angles = [
        json.loads(run(*words, *options)[1])["deterministic"][0]["angle"]
        for options in ((), ("--goal", "pose"), ("--goal", "position"))
    ]
    assert angles[0] == angles[1] > 0
    assert angles[2] is None

    words = ("play", "reach", "planar-cube", "--policy", folder, "--sim", "mujoco")
    assert re.search(r"\d m and \d+\.\d degrees from the goal", run(*words)[1])
    assert "degrees" not in run(*words, "--goal", "position")[1]

    words = ("finetune", folder, "--on", "train", "--envs", "4", *ROLLOUT, *quick)
    assert run(*words, "--out", "tuned")[0] == 0
    assert [c for c in read_config(tmp_path / "tuned").tasks if c.task == "reach"] == [reach]


def test_split_is_trained_fine_tuned_and_evaluated_on_both_sides(run, split_yaml):
    words = ("train", split_yaml, "--agent", "me-mlp", *SMALL, "--steps", "64", "--out", "a")
    assert run(*words)[0] == 0
    _, out, _ = run("eval", "a", "--episodes", "1", "--mode", "deterministic")
    assert [line.split()[1] for line in out.splitlines()[2:5]] == ["train", "train", "test"]
    assert re.search(r"deterministic: MT reach .*; ZS reach ", out)
    modes = json.loads(run("eval", "a", "--on", "test", "--episodes", "1", "--json")[1])
    assert {each["side"] for scores in modes.values() for each in scores} == {"test"}

    few = ("--steps", "32", "--envs", "4", "--set", "num_steps=8", "--no-tensorboard")
    code, out, _ = run("finetune", "a", *few)
    assert (code, out) == (0, f"a/finetuned/test-seed0/{CHECKPOINT}\n")
    tuned = read_config(Path("a/finetuned/test-seed0"))
    assert (tuned.source.side, tuned.ppo.total_timesteps, tuned.ppo.num_steps) == ("test", 32, 8)
    assert tuned.initial_checkpoint == f"../../{CHECKPOINT}"
    assert read_config(Path("a")).ppo.curriculum
    assert (tuned.ppo.curriculum, tuned.ppo.desired_kl) == (False, 0.01)
    first = json.loads(Path("a/finetuned/test-seed0/metrics.jsonl").read_text().splitlines()[0])
    assert first["learning_rate"] == pytest.approx(tuned.ppo.learning_rate * 0.1)
    assert run("finetune", "a", *few, "--out", "b", "--curriculum", "--bf16")[0] == 0
    other = read_config(Path("b")).ppo
    assert (other.curriculum, other.bf16, other.compile) == (True, True, False)


def test_training_uses_the_goals_stored_with_a_split(run, split_yaml):
    build = ("split", "build", split_yaml, "--out", "built", "--goals", "--goal-seed", "5")
    assert run(*build)[0] == 0
    (index,) = Path("built").rglob("goals/index.json")
    home = index.parents[1]
    words = ("train", home, "--agent", "me-mlp", *SMALL, "--steps", "32", "--no-tensorboard")
    assert run(*words, "--out", "a")[0] == 0
    source = read_config(Path("a")).source
    assert (source.goal_seed, source.goal_dir) == (5, str(home.resolve()))
    shipped = read_goals(home, "train")
    for setting in specs_of(source, GoalConfig(5)):
        assert (setting.goals.q == shipped[setting.robot.name].q).all()

    code, _, err = run(*words, "--out", "b", "--goal-seed", "4")
    assert (code, "the goals in " in err, "are of seed 5" in err) == (2, True, True)
    code, _, err = run(*words, "--out", "b", "--train-goals", "300")
    assert (code, "--train-goals 300" in err, str(home.resolve()) in err) == (2, True, True)
    assert not Path("b").exists()


@pytest.mark.slow
def test_train_goals_option_does_not_change_evaluation_goals(run):
    randoms = []
    for name, more, count in (("a", (), 100), ("b", ("--train-goals", "150"), 150)):
        assert run(*RUN, "--steps", "32", "--no-tensorboard", "--out", name, *more)[0] == 0
        config = read_config(Path(name))
        (setting,) = specs_of(config.source, GoalConfig(tasks=config.tasks))
        assert [len(setting.goals.q)] == [*{task.num_goals for task in config.tasks}] == [count]
        modes = json.loads(run("eval", name, "--episodes", "1", "--json")[1])
        randoms.append({each["random"] for scores in modes.values() for each in scores})
    assert randoms[0] == randoms[1]


def test_every_training_switch_has_an_option(run, tmp_path):
    off = ("--no-symlog", "--no-slow-critic", "--no-discrete", "--no-curriculum")
    on = ("--task-reweighting", "--fixed-deviation", "--mask-morphology", "--tool-position")
    flags = (*off, *on, "--no-tensorboard")
    code, out, _ = run(*RUN, "--steps", "32", *flags)
    label = "me-mlp-symlog-slow-critic+task-reweighting-curriculum-discrete"
    label += "+fixed-deviation+mask-morphology+tool-position"
    assert (code, out) == (0, f"runs/planar-cube-reach/{label}/seed0/{CHECKPOINT}\n")
    config = read_config(tmp_path / out.strip().removesuffix(f"/{CHECKPOINT}"))
    ppo, policy = config.ppo, config.policy
    assert (ppo.symlog, ppo.slow_critic, ppo.task_reweighting, ppo.curriculum) == (0, 0, 1, 0)
    assert (policy.discrete, policy.proprioceptive_only, policy.fixed_std) == (False, True, True)
    assert (policy.tool_position, policy.network.mlp_width) == (True, 8)


def test_default_actions_are_discrete_only_for_reach(run, tmp_path):
    run("train", "prims", "task=push", "--agent", "me-mlp", *SMALL, "--steps", "32", "--out", "p")
    assert not read_config(tmp_path / "p").policy.discrete


def test_baselines_can_be_evaluated(ok, split_yaml):
    out = ok("eval", "ik", "--split", split_yaml, "--sim", "mujoco", "--episodes", "1")
    assert "ik: MT reach " in out
    assert len(re.findall(r"(?<!to )100%", out)) == 5  # three robots, two means


@pytest.mark.slow
def test_interrupted_training_can_be_resumed(run, tmp_path, cache):
    words = (*RUN, "--steps", 32 * 300, "--no-tensorboard")
    process = start(*words, "--out", "cut", XDG_CACHE_HOME=str(cache))
    try:
        while not (tmp_path / "cut" / CHECKPOINT).is_file():
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate()
    finally:
        process.kill()
    assert process.returncode == 130
    assert "continues from its last checkpoint, if there is one, with --resume" in err
    assert "Traceback" not in err
    assert sorted(tree(tmp_path / "cut")) == [CHECKPOINT, "config.json", METRICS]


@pytest.mark.slow
def test_policies_of_a_gpu_are_scored_without_one(run, split_yaml, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    words = ("study", split_yaml, "--agents", "me-mlp", "--seeds", "0", *SMALL)
    words += ("--steps", "32", "--episodes", "1", "--no-tensorboard")
    assert run(*words)[0] == 0
    folder = tmp_path / "study" / "mine" / "small" / "me-mlp" / "seed0"
    table = tmp_path / "study" / "episodes.csv.gz"
    scores = read_table(table)
    table.unlink()
    config = (folder / "config.json").read_text()
    assert '"device": "cpu"' in config
    (folder / "config.json").write_text(config.replace('"device": "cpu"', '"device": "cuda"'))
    assert run(*words, "--device", "cuda")[0] == 0
    again = read_table(table)
    assert [run.robots for run in again] == [run.robots for run in scores]
    (folder / CHECKPOINT).unlink()
    code, _, err = run(*words, "--device", "cuda")
    assert code == 2
    assert "device 'cuda': this machine has no CUDA device" in err


@pytest.mark.slow
def test_study_prints_a_table(run, split_yaml, tmp_path):
    words = ("study", split_yaml, "--agents", "me-mlp,me-mlp-discrete", "--seeds", "0..1", *SMALL)
    words += ("--steps", "32", "--episodes", "1", "--no-tensorboard")
    assert run(*words, "--report")[1].count("- missing: mine/small ") == 8
    assert not list((tmp_path / "study").glob("**/episodes.csv.gz"))
    code, out, err = run(*words)
    assert (code, "missing" in out, "8 of 8: " in err) == (0, False, True)
    policies = ("me-mlp", "me-mlp (stochastic)")
    assert [line.split("|")[1].strip() for line in out.splitlines()[4:12]] == [
        *("random", "zero", "jacobian", "ik", *policies),
        *("me-mlp-discrete", "me-mlp-discrete (stochastic)"),
    ]
    assert run(*words)[:2] == (0, out)
    assert "of another evaluation" in run(*words, "--episodes", "2", "--report")[2]


def test_failed_study_cell_is_reported_with_exit_code_1(run, split_yaml, tmp_path):
    words = ("study", split_yaml, "--agents", "me-mlp", "--seeds", "0..1", *SMALL)
    words += ("--steps", "32", "--episodes", "1", "--no-tensorboard")
    code, out, _ = run(*words, "--device", "cuda", "--report")  # which needs no GPU
    assert (code, "missing" in out) == (0, True)
    broken = tmp_path / "study" / "mine" / "small" / "me-mlp" / "seed0" / CHECKPOINT
    broken.parent.mkdir(parents=True)
    assert run(*words, "--seeds", "1")[0] == 0
    config = (broken.parents[1] / "seed1" / "config.json").read_text()
    (broken.parent / "config.json").write_text(config.replace('"seed": 1', '"seed": 0'))
    broken.write_text("broken")
    code, out, err = run(*words)
    assert code == 1
    assert f"{broken.relative_to(tmp_path)} is not a checkpoint" in err
    assert "- missing: mine/small me-mlp seed 0\n" in out


def test_foreign_folders_and_checkpoints_are_rejected(run, refused, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    assert "not the folder of a run" in refused(*RUN, "--steps", "32", "--out", "mine")
    assert "not a checkpoint" in refused("eval", "mine/letter.txt")
    play = ("play", "reach", "planar-cube", "--policy")
    assert "not a checkpoint" in refused(*play, "mine/letter.txt")
    run(*RUN, "--steps", "32", "--out", "run", "--no-tensorboard")
    assert "pass --resume" in refused(*RUN, "--steps", "32", "--out", "run")
    longer = (*RUN, "--steps", "64", "--out", "run", "--resume")
    assert "total_timesteps 32, not 64" in refused(*longer)
    layout = ("eval", "run", "--split", "planar-cube", "task=reach", "--obstacles")
    assert "for other observations: obstacles 0, here 3" in refused(*layout, "--episodes", "1")
    assert "table.txt" in refused("eval", "run", "--out", "table.txt")


FEW = ("--agent", "me-mlp", "--train-goals", "3", "--no-tensorboard", *SMALL)
RUN_DRAWN = ("train", "task=reach", *FEW, "--robots")


@pytest.mark.slow
def test_drawn_robots_are_trained_on_and_others_evaluated_and_played(run, ok, tmp_path):
    code, out, err = run(*RUN_DRAWN, "cubes:3,stick:2", "--steps", "192")
    folder = Path("runs/cubes-3-stick-2-reach/me-mlp/seed0")
    assert (code, out) == (0, f"{folder}/checkpoint.pt\n")
    assert "cubes:3,stick:2: update 6 of 6, 192 steps, score -" in err
    config, robots = read_config(folder), read_drawn(folder)
    assert (config.source.grammars, config.source.draw_seed) == ((("cubes", 3), ("stick", 2)), 0)
    assert (config.slice_updates, config.max_links) == (3, 23)
    assert {config.tasks[0].num_goals, config.tasks[1].num_goals} == {3}
    assert [each.name[:-6] for each in robots] == ["cubes-"] * 3 + ["stick-"] * 2
    assert config.source.drawn_hash == json.loads((folder / FILE).read_text())["hash"]
    assert [len(each["scores"]) for each in read_metrics(folder)] == [0] * 6
    again = (*RUN_DRAWN, "cubes:3,stick:2", "--steps", "192", "--resume")
    assert run(*again)[0] == 0
    assert "has another run" in run(*again, "--robot-seed", "1")[2]

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

    (folder / FILE).unlink()
    code, _, err = run("eval", folder, "--split", "own.yaml", "--on", "test", *evaluation)
    assert (code, f"{folder} has no robots.json: it is unknown whether" in err) == (0, True)


@pytest.mark.parametrize(
    "drawn",
    [
        "cubes:1,stick:2",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("cubes:2", "stick:1")),
    ],
)
def test_without_a_split_fresh_robots_are_evaluated(run, drawn, refused):
    run(*RUN_DRAWN, drawn, "--steps", "96", "--out", "run")
    trained = {each.robot_hash for each in read_drawn(Path("run"))}
    words = ("eval", "run", "--episodes", "1", "--mode", "deterministic")
    found = []
    for seed in (0, 0, 1):
        code, out, err = run(*words, "--seed", str(seed), "--json")
        assert code == 0
        facts = re.search(r"fresh robots (\S+), drawn with seed (\d+), hash (\w+)", err).groups()
        scores = json.loads(out)["deterministic"]
        assert (facts[0], len(scores)) == (drawn, len(trained))
        assert {score["side"] for score in scores} == {"test"}
        found.append((facts, out))
    assert found[0] == found[1] != found[2]
    source = read_config(Path("run")).source
    fresh, _ = fresh_source(Path("run"), source, GoalConfig(), 0)
    assert trained.isdisjoint(each.robot_hash for each in members(fresh))
    assert "its policy is scored on fresh robots" in refused(*words, "--on", "train")
    (Path("run") / FILE).unlink()
    assert "no list of drawn robots" in refused(*words)


def test_held_out_robots_are_skipped_and_fit_the_observations(run, refused, tmp_path):
    run(*RUN_DRAWN, "cubes:2", "--steps", "32", "--out", "free")
    err = refused("finetune", "free")
    assert "robots cubes:2 are drawn from grammars and have no test side" in err
    (_, second) = read_drawn(Path("free"))
    test = Member("known", "cubes", second.derivation, "reach", False, second.robot_hash)
    large = split((member("base=planar ee=cube"),), (test,), provenance={"max_links": 25})
    write_split(large, tmp_path / "own.yaml")
    options = ("--held-out", "own.yaml", "--steps", "32", "--out", "run")
    code, _, err = run(*RUN_DRAWN, "cubes:2", *options)
    assert (code, "morphgen: robots that were skipped: 1 held out\n" in err) == (0, True)
    assert [each.name for each in read_drawn(Path("run"))] == ["cubes-000000", "cubes-000002"]
    config = read_config(Path("run"))
    assert config.source.held_out == (str(tmp_path / "own.yaml"),)
    assert (config.slice_updates, config.max_links) == (0, 25)
    assert read_checkpoint(Path("run"))[1]["layout"]["links"] == 25


def test_workers_draw_for_a_simulator_that_has_none(run):
    words = [*RUN_DRAWN, "cubes:2", "--steps", "32", "--workers", "2"]
    words[words.index("mujoco")] = "kinematic"
    assert run(*words)[0] == 0
    assert len(read_drawn(Path("runs/cubes-2-reach/me-mlp/seed0"))) == 2


LINE = re.compile(
    r"episode (\d+): (success|failure), (\d+\.\d{3}) m from the (goal|line), "
    r"score (-?\d+\.\d\d), (\d+\.\d\d) s"
)


def parse_episodes(out):
    """Parse the printed line of every episode."""
    return [LINE.fullmatch(line).groups() for line in out.splitlines() if "episode" in line]


def test_ik_policy_reaches_the_goal(ok, tmp_path):
    out = ok("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco")
    ((number, result, distance, place, score, seconds),) = parse_episodes(out)
    assert (number, result, place, seconds) == ("1", "success", "goal", "6.00")
    assert float(distance) < 0.03
    assert float(score) > 0
    assert tree(tmp_path) == {}


@pytest.mark.slow
def test_scripted_policy_pushes_before_the_time_limit_and_is_recorded(ok, tmp_path):
    words = ("play", "push", "prims", "--policy", "scripted", "--sim", "mujoco")
    out = ok(*words, "--out", "push.mp4")
    ((_, *result, seconds),) = parse_episodes(out)
    assert result == ["success", "0.000", "line", "1.00"]
    assert float(seconds) < 6
    assert out.splitlines()[-1] == "push.mp4"
    assert list(tree(tmp_path)) == ["push.mp4"]
    with imageio.get_reader("push.mp4") as film:
        frames, fps = film.count_frames(), film.get_meta_data()["fps"]
    assert fps == 25
    assert 0 <= frames / fps - float(seconds) <= 0.08


def test_baselines_play_with_goals_that_are_poses(ok):
    words = ("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco", "--goal", "pose")
    out = ok(*words)
    result, angle = re.match(r"episode 1: (\w+), .* m and (.*) degrees from the goal", out).groups()
    assert result == "success"
    assert float(angle) < 10


def test_episodes_differ_and_are_reproducible(run):
    words = ("play", "reach", "arm3-stick", "--sim", "mujoco", "--episodes", "2", "--obstacles")
    outs = [run(*words, "--seed", seed)[1] for seed in (1, 1, 2)]
    assert outs[0] == outs[1] != outs[2]
    first, second = parse_episodes(outs[0])
    assert first[2:] != second[2:]


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_shipped_policies_are_small_and_act_on_any_robot(name):
    policy = POLICIES[name]
    run_config, _ = read_checkpoint(policy.file)
    assert policy.file.stat().st_size < 2e6
    assert run_config.interface.max_links is None
    assert run_config.source.grammars, "it was trained on drawn robots alone"
    for task in ("reach", "push"):
        assert (name in policies_for(task)) == (task in policy.tasks)
        assert (task in policy.tasks) == (task == run_config.source.task)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "controllers"),
    [
        ("--obstacles", ["zero-shot-obstacles", "ik", "jacobian", "random"]),
        ("--goal pose", ["zero-shot-pose", "ik", "jacobian", "random"]),
        ("--goal pose --obstacles", ["zero-shot-pose-obstacles", "ik", "jacobian", "random"]),
        ("--task push", ["zero-shot-push", "scripted", "path", "random"]),
        ("--task door", ["zero-shot-door", "scripted", "path", "random"]),
    ],
)
def test_each_variant_has_a_policy_and_controllers_to_compare(options, controllers, ok):
    out = ok("zeroshot", "ur5-stick", *options.split(), "--episodes", "1")
    head, _, *rows = out.splitlines()
    assert [row.split()[0] for row in rows] == controllers
    assert ("angle" in head) == ("pose" in options)
    assert ("score" in head) == ("--task" not in options)  # others count successes alone


def test_a_table_follows_the_episodes_of_each_controller(run, monkeypatch):
    for name in ("FIRST_LINE", "LINE_INTERVAL"):
        monkeypatch.setattr(progress, name, -1.0)
    code, out, err = run("zeroshot", "arm3-stick", "--episodes", "1")
    controllers = ["zero-shot", "ik", "jacobian", "random"]
    head, _, *rows = out.splitlines()
    assert (code, head.split()) == (0, ["controller", "success", "distance", "[m]", "score"])
    assert [row.split()[0] for row in rows] == controllers
    assert float(rows[1].split()[-2]) < 0.03 < float(rows[-1].split()[-2])  # ik, random [m]
    assert float(rows[-1].split()[-1]) == 0  # scores are relative to it
    ended = re.findall(r"(?m)^(\S+): all 1 episodes, finishing, \d+ s$", err)
    assert list(dict.fromkeys(ended)) == controllers


def test_a_shipped_policy_is_named_like_a_checkpoint(ok, run, tmp_path):
    words = ["zero-shot", "--split", "interpolation/arm3/reach", "--on", "test", "--sim", "mujoco"]
    out = ok("eval", *words, "--episodes", "1", "--mode", "deterministic", "--json")
    (score,) = json.loads(out)["deterministic"]
    assert score["episodes"] == 1
    few = ["--steps", "64", "--envs", "2", "--set", "num_steps=8", "--set", "minibatches=2"]
    assert run("finetune", *words, *few, "--no-tensorboard", "--out", tmp_path)[0] == 0
    tuned, _ = read_checkpoint(tmp_path / "checkpoint.pt")
    path = tmp_path / tuned.initial_checkpoint
    assert not Path(tuned.initial_checkpoint).is_absolute()
    assert path.resolve() == POLICIES["zero-shot"].file.resolve()


def test_other_packages_register_policies(monkeypatch, ok):
    monkeypatch.setattr(POLICIES, "_loaded", {})
    POLICIES.register(ShippedPolicy("mine", POLICIES["zero-shot"].file, ("reach",)))
    poses = ("zero-shot-pose", "zero-shot-pose-obstacles")
    assert policies_for("reach")[-5:] == ("zero-shot", "zero-shot-obstacles", *poses, "mine")
    words = ["arm=arm3", "ee=stick", "--policy", "mine", "--sim", "mujoco"]
    assert "episode 1" in ok("play", "reach", *words)


@pytest.mark.slow
def test_the_shipped_policy_reaches_with_real_arms(ok):
    policy, ik, _, random = json.loads(ok("zeroshot", "ur5-stick", "--episodes", "40", "--json"))
    assert policy["success"]["low"] > 0.5 > random["success"]["high"]
    assert ik["success"]["value"] == 1


def test_record_show_and_verify(run, ok, tmp_path, refused):
    pytest.importorskip("pyarrow")
    words = ("record", "prims", "--tasks", "reach", "--episodes", "1", "--out", "demos")
    first, _, _, row, *_ = ok(*words).splitlines()
    assert first.startswith("demos: 1 episode of 1 robot, ")
    assert row.split()[:4] == ["reach", "ik", "1", "1"]
    assert ok(*words).splitlines()[0] == first  # finished: nothing is recorded again
    assert ok("show", "demos").splitlines()[0] == first
    facts = json.loads(ok("show", "demos", "--json"))
    assert (facts["episodes"], facts["tasks"][0]["success"]["value"]) == (1, 1.0)
    assert ok("verify", "demos").splitlines()[-1] == "1 of 1 episodes agree within 0.001 rad or m"
    (tmp_path / "demos" / "mine.txt").write_text("mine")
    code, out, _ = run("verify", "demos")
    assert code == 1
    assert "changed: mine.txt" in out
    assert "holds another data set: its seed is " in refused(*words, "--seed", "1")
    err = refused("record", "stick", *words[2:])
    assert "its robots[0].name is 'prims', not 'stick'; name another folder" in err
