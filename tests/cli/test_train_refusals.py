"""Arguments, folders and checkpoints that ``morphgen train`` and its relatives refuse."""

import pytest

from helpers.runs import RUN, small_split
from morphgen.benchmark.split_file import write_split

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train", "interpolation/arm3/reech"), "did you mean 'interpolation/arm3/reach'?"),
        (("train", "planar-cube"), "a robot needs task=reach or task=push"),
        (("train", "base=planar", "ee=cube"), "a robot needs its task"),
        (("train", "planar-cube", "task=lift"), "unknown task 'lift'; valid: push, reach"),
        (("train", "interpolation/arm3/reach", "--obstacles"), "--obstacles is for one robot"),
        ((*RUN, "--agent", "me-tff"), "did you mean 'me-tf'?"),
        ((*RUN, "--agent", "se+magic"), "after se come switches"),
        ((*RUN, "--steps", "31"), "an update takes 32 transitions"),
        ((*RUN, "--device", "tpu"), "unknown device 'tpu'"),
        ((*RUN, "--set", "gama=1"), "did you mean 'gamma'?"),
        ((*RUN, "--set", "gamma=much"), "expected a number"),
        ((*RUN, "--set", "gamma=2"), "gamma 2: expected 0 to 1"),
        (("eval", "nothing"), "no checkpoint, and no folder of a run"),
        ((*RUN, "--on", "test"), "is one robot and not a split: it has no test robots"),
        ((*RUN, "--whole"), "--whole is for --agent se, not for me-mlp"),
        (
            (*RUN[:3], "--agent", "me-tf", "--no-discrete", "--set", "logit_scale=8"),
            "--set logit_scale: continuous actions have no logits; it is for --discrete",
        ),
        ((*RUN, "--set", "logit_scale=8"), "--set logit_scale: me-mlp has none; valid for me-tf"),
        ((*RUN, "--set", "features=8"), "--set features: me-mlp has none; valid for me-tf"),
        ((*RUN, "--set", "mlp_layers=0"), "mlp_layers 0: expected 1 or more"),
        (("train", "interpolation/arm3/reach", "--envs", "9"), "fewer than the 10 robots"),
        (("eval", "ik"), "name its robots with --split"),
        (
            ("eval", "random", "--split", "prims", "task=push", "--goal", "pose"),
            "--goal pose is for task reach; the tasks of the robots: push",
        ),
        ((*RUN, "--goal", "poses"), "invalid choice: 'poses'"),
        (
            ("eval", "ik", "--split", "planar-cube", "task=reach", "--mode", "stochastic"),
            "--mode is for policies",
        ),
        (
            ("eval", "ik", "--split", "planar-cube", "task=reach", "--on", "test"),
            "is one robot and not a split: it has no test robots",
        ),
        (("eval", "ik", "--out", "none/scores.csv"), "there is no folder none"),
        (
            ("eval", "zero-shot", "--split", "interpolation/arm3/push"),
            "policy zero-shot was trained on reach, not on push",
        ),
        (("eval", "nothing", "--goal-seed", "1"), "--goal-seed: only with --split"),
        (("finetune", "nothing", "--obstacles"), "--obstacles: only with --split"),
        (("eval", "scripted", "--split", "planar-cube", "task=reach"), "no robot is there to push"),
        (("finetune", "nothing"), "no checkpoint"),
        (("study", "nothing"), "nothing: no such file, and no split of this name"),
        (("study", "interpolation/arm3/reach", "--gpus", "1"), "--gpus: only with --ray"),
        (("eval", "random", "--seed", str(2**63), "--split", "nothing"), "no split of this name"),
        (("study", "interpolation/arm3/reach", "--seeds", "2..x"), "--seeds 2..x"),
        (("study", "interpolation/arm3/reach", "--agents", "se,se"), "is there twice"),
        (("study", "interpolation/arm3/reach", "--agents", "me-tf@test"), "only se"),
        (("study", "interpolation/arm3/reach", "--steps", "10"), "an update takes"),
        (
            ("study", "interpolation/arm3/reach", "--finetune", "1000"),
            "--finetune 1000: --steps 1000 with --envs 64: an update takes 2,048 transitions",
        ),
        (
            ("study", "interpolation/arm3/reach", "--eval-steps", "4000000"),
            "13334 episodes",
        ),
        (
            ("train", "task=reach", "--robots", "chain:3000", "--steps", "1000"),
            "an update takes",
        ),
        (
            ("train", "task=reach", "--robots", "chain:3000", "--agent", "se"),
            "--agent se: learns one robot",
        ),
    ],
)
def test_invalid_arguments_are_rejected_in_one_line(refused, words, message):
    assert message in refused(*words)


def test_splits_of_one_name_are_refused_in_a_study(refused, tmp_path):
    for name in ("a", "b"):
        write_split(small_split(), tmp_path / f"{name}.yaml")
    message = "b.yaml: split 'mine/small' is also in a.yaml; expected splits of different names"
    assert message in refused("study", "a.yaml", "b.yaml")


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


@pytest.mark.parametrize("words", [("--steps", "1.5"), ("--steps", "inf"), ("--steps", "many")])
def test_steps_option_must_be_a_whole_number(words, refused):
    assert "argument --steps" in refused(*RUN, *words)
