"""``morphgen train``, ``eval``, ``finetune``, ``study`` and ``play`` with a trained policy."""

import json
import re
import signal
import subprocess
from pathlib import Path

import pytest

from helpers.commands import start, tree
from helpers.runs import NETWORK, ROLLOUT, RUN, SMALL
from morphgen.benchmark.scores.submission import read_table
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint, read_config
from morphgen.rl.runs.robot_source import specs_of
from morphgen.rl.runs.training import METRICS, _StopRequest, read_metrics
from morphgen.tasks.goals.split_goals import read_goals
from morphgen.tasks.scenes.env_specs import GoalConfig

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

    code, out, _ = run("eval", folder, "--episodes", "2", "--out", "scores.csv")
    assert code == 0
    assert [line.split()[3] for line in out.splitlines()[2:4]] == ["deterministic", "stochastic"]
    assert "deterministic: MT reach " in out
    assert len((tmp_path / "scores.csv").read_text().splitlines()) == 3
    code, out, _ = run(
        "eval", folder / CHECKPOINT, "--steps", "600", "--mode", "stochastic", "--json"
    )
    (score,) = json.loads(out)["stochastic"]
    assert (score["robot"], score["episodes"], score["steps"]) == ("planar-cube", 2, 600)
    assert score["score"] == pytest.approx(score["raw"] - score["random"])

    code, out, _ = run("play", "reach", "planar-cube", "--policy", folder, "--sim", "mujoco")
    assert code == 0
    assert out.startswith("episode 1: ")


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
        assert run(*command, "--resume")[0] == 0
        assert [each["update"] for each in read_metrics(folder)] == [1, 2, 3]
        assert "num_envs 4, not 8" in run(*command, "--resume", "--envs", "8")[2]


@pytest.mark.slow
def test_max_links_defaults_to_the_size_of_the_robot(run, ok, tmp_path):
    words = ("train", "chain", "beads=7", "task=reach", "--agent", "me-mlp", *SMALL)
    words += ("--steps", "32")
    code, out, err = run(*words, "--out", "run", "--max-links", "23")
    assert (code, out, tree(tmp_path)) == (2, "", {})
    assert "has 25 links, more than max_links 23; make max_links 25 or more" in err

    for options, links in (((), 25), (("--max-links", "26"), 26)):
        assert run(*words, "--out", f"run{links}", *options)[0] == 0
        assert read_checkpoint(Path(f"run{links}"))[1]["layout"]["links"] == links
    code, out, _ = run("eval", "run26", "--episodes", "1", "--mode", "deterministic")
    assert code == 0
    assert "chain" in out
    for policy in ("run26", "zero"):
        out = ok("play", "reach", "chain", "beads=7", "--policy", policy)
        assert out.startswith("episode 1: ")


@pytest.mark.slow
def test_policy_with_tool_position_is_evaluated_and_played(run):
    words = (*RUN, "--steps", "32", "--no-tensorboard", "--out", "run")
    assert run(*words, "--tool-position")[0] == 0
    assert read_checkpoint(Path("run"))[1]["layout"]["tool"]
    code, _, err = run(*words, "--resume")
    assert (code, "tool_position" in err) == (2, True)
    code, out, _ = run("eval", "run", "--episodes", "1", "--mode", "deterministic")
    assert (code, "planar-cube" in out) == (0, True)
    code, out, _ = run("play", "reach", "planar-cube", "--policy", "run", "--sim", "mujoco")
    assert (code, out[:11]) == (0, "episode 1: ")


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
    code, _, _ = run(
        "train", split_yaml, "--agent", "me-mlp", *SMALL, "--steps", "64", "--out", "a"
    )
    assert code == 0
    code, out, _ = run("eval", "a", "--episodes", "1", "--mode", "deterministic")
    assert [line.split()[1] for line in out.splitlines()[2:5]] == ["train", "train", "test"]
    assert re.search(r"deterministic: MT reach .*; ZS reach ", out)
    code, out, _ = run("eval", "a", "--on", "test", "--episodes", "1", "--json")
    assert {each["side"] for mode_scores in json.loads(out).values() for each in mode_scores} == {
        "test"
    }

    few = ("--steps", "32", "--envs", "4", "--set", "num_steps=8", "--no-tensorboard")
    code, out, _ = run("finetune", "a", *few)
    assert (code, out) == (0, f"a/finetuned/test-seed0/{CHECKPOINT}\n")
    tuned = read_config(Path("a/finetuned/test-seed0"))
    assert (tuned.source.side, tuned.ppo.total_timesteps, tuned.ppo.num_steps) == ("test", 32, 8)
    assert tuned.initial_checkpoint.endswith(f"a/{CHECKPOINT}")
    assert read_config(Path("a")).ppo.curriculum
    assert (tuned.ppo.curriculum, tuned.ppo.desired_kl) == (False, 0.01)
    first = json.loads(Path("a/finetuned/test-seed0/metrics.jsonl").read_text().splitlines()[0])
    assert first["learning_rate"] == pytest.approx(tuned.ppo.learning_rate * 0.1)
    assert run("finetune", "a", *few, "--out", "b", "--curriculum", "--bf16")[0] == 0
    other = read_config(Path("b")).ppo
    assert (other.curriculum, other.bf16, other.compile) == (True, True, False)
    code, _, err = run("finetune", "a", *few)
    assert code == 2
    assert "pass --resume" in err


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
    """Evaluation goals do not depend on the number of training goals."""
    goal_counts = []
    for name, more in (("a", ()), ("b", ("--train-goals", "150"))):
        assert run(*RUN, "--steps", "32", "--no-tensorboard", "--out", name, *more)[0] == 0
        config = read_config(Path(name))
        (setting,) = specs_of(config.source, GoalConfig(tasks=config.tasks))
        goal_counts.append(len(setting.goals.q))
        assert {task.num_goals for task in config.tasks} == {goal_counts[-1]}
    assert goal_counts == [100, 150]
    _, out, _ = run("eval", "b", "--episodes", "1", "--json")
    _, chance, _ = run("eval", "a", "--episodes", "1", "--json")
    randoms = [
        {each["random"] for mode_scores in json.loads(one).values() for each in mode_scores}
        for one in (out, chance)
    ]
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
    assert (policy.discrete, policy.proprioceptive_only, policy.network.mlp_width) == (
        False,
        True,
        8,
    )
    assert policy.fixed_std
    assert policy.tool_position


def test_default_actions_are_discrete_only_for_reach(run, tmp_path):
    run("train", "prims", "task=push", "--agent", "me-mlp", *SMALL, "--steps", "32", "--out", "p")
    assert not read_config(tmp_path / "p").policy.discrete


def test_baselines_can_be_evaluated(run, split_yaml):
    code, out, _ = run("eval", "ik", "--split", split_yaml, "--sim", "mujoco", "--episodes", "1")
    assert code == 0
    assert "ik: MT reach " in out
    assert len(re.findall(r"(?<!to )100%", out)) == 5  # three robots, two means


@pytest.mark.slow
def test_interrupted_training_can_be_resumed(run, tmp_path, cache):
    words = (*RUN, "--steps", 32 * 300, "--no-tensorboard")
    process = start(*words, "--out", "cut", XDG_CACHE_HOME=str(cache))
    try:
        while not (tmp_path / "cut" / CHECKPOINT).is_file():
            assert process.poll() is None
            try:
                process.wait(timeout=0.05)
            except subprocess.TimeoutExpired:
                continue
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
    words += ("--steps", "32", "--eval-steps", "300", "--no-tensorboard")
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
    words += ("--steps", "32", "--eval-steps", "300", "--no-tensorboard")
    code, out, _ = run(*words, "--report")
    assert code == 0
    assert out.count("- missing: mine/small ") == 8
    assert not list((tmp_path / "study").glob("**/episodes.csv.gz"))
    code, out, err = run(*words)
    assert code == 0
    assert "missing" not in out
    assert "8 of 8: " in err
    policies = ("me-mlp", "me-mlp (stochastic)")
    assert [line.split("|")[1].strip() for line in out.splitlines()[4:12]] == [
        *("random", "zero", "jacobian", "ik", *policies),
        *("me-mlp-discrete", "me-mlp-discrete (stochastic)"),
    ]
    before = tree(tmp_path / "study" / "mine")
    code, again, _ = run(*words)
    assert (code, again) == (0, out)
    assert tree(tmp_path / "study" / "mine") == before
    code, _, err = run(*words, "--set", "gamma=0.5")
    assert code == 2
    assert "another run: ppo.gamma 0.99, not 0.5" in err
    code, _, err = run(*words, "--eval-steps", "600", "--report")
    assert code == 2
    assert "of another evaluation" in err


def test_failed_study_cell_is_reported_with_exit_code_1(run, split_yaml, tmp_path):
    words = ("study", split_yaml, "--agents", "me-mlp", "--seeds", "0..1", *SMALL)
    words += ("--steps", "32", "--eval-steps", "300", "--no-tensorboard")
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
    assert "not a checkpoint" in refused(
        "play", "reach", "planar-cube", "--policy", "mine/letter.txt"
    )
    run(*RUN, "--steps", "32", "--out", "run", "--no-tensorboard")
    assert "pass --resume" in refused(*RUN, "--steps", "32", "--out", "run")
    assert "total_timesteps 32, not 64" in refused(
        *RUN, "--steps", "64", "--out", "run", "--resume"
    )
    layout = ("eval", "run", "--split", "planar-cube", "task=reach", "--obstacles")
    assert "for other observations: obstacles 0, here 3" in refused(*layout, "--episodes", "1")
    assert "table.txt" in refused("eval", "run", "--out", "table.txt")
