"""A learner resumed from a checkpoint equals an uninterrupted one; others are rejected."""

import copy

import pytest
import torch

from helpers.line_batch import OnALine, equal, learner, stored, untimed, weights
from morphgen.errors import TaskError
from morphgen.rl.runs.checkpoint import packed
from morphgen.rl.runs.training import load_networks, resume_learner, state_of


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
@pytest.mark.parametrize("discrete", [True, False], ids=["discrete", "continuous"])
def test_a_resumed_run_equals_an_uninterrupted_one(agent, discrete):
    options = {"agent": agent, "discrete": discrete, "task_reweighting": True}
    options |= {"learning_rate": 3e-3, "desired_kl": 1e-3}
    went_on = learner(**options)
    went_on.iterate(), went_on.iterate()
    checkpoint = stored(state_of(went_on))
    went_on.restart_episodes()
    reports = [went_on.iterate(), went_on.iterate()]

    kind = "discrete" if discrete else "continuous"
    again = learner(OnALine(8, kind=kind, seed=99), seed=77, **options)
    again.iterate()
    resume_learner(again, checkpoint)
    assert not again.done
    same = [again.iterate(), again.iterate()]
    assert again.done
    assert equal(weights(went_on), weights(again))
    for one, other in zip(reports, same, strict=True):
        assert untimed(one) == untimed(other)
    assert went_on.batch.state_dict() == again.batch.state_dict()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_run_on_a_gpu_is_written_and_resumed():
    options = {"device": "cuda", "learning_rate": 3e-3}
    went_on = learner(**options)
    went_on.iterate(), went_on.iterate()
    packed(state_of(went_on), "checkpoint.pt")  # refuses tensors outside main memory
    checkpoint = stored(state_of(went_on))
    went_on.restart_episodes()
    report = went_on.iterate()

    again = learner(OnALine(8, seed=99), seed=77, **options)
    resume_learner(again, checkpoint)
    assert again.iterate().value_loss == pytest.approx(report.value_loss, rel=1e-4)


def test_later_updates_do_not_change_a_saved_state():
    made = learner()
    made.iterate()
    checkpoint = state_of(made)
    before = copy.deepcopy(checkpoint)
    made.iterate()
    again = learner()
    resume_learner(again, checkpoint)
    assert all(checkpoint["actor"][k].equal(before["actor"][k]) for k in before["actor"])
    steps = [each["step"] for each in checkpoint["optimiser"]["state"].values()]
    assert steps == [each["step"] for each in before["optimiser"]["state"].values()]


def test_resume_rejects_checkpoints_of_other_runs_and_changes_nothing():
    made = learner()
    before = weights(made)
    with pytest.raises(TaskError, match=r"another run: gamma 0\.9, here 0\.99$"):
        resume_learner(made, state_of(learner(gamma=0.9)))
    with pytest.raises(TaskError, match="another run: agent me-tf, here me-mlp"):
        resume_learner(made, state_of(learner(agent="me-tf")))
    wider = state_of(learner())
    wider["layout"]["links"] = 30
    for take in (resume_learner, load_networks):
        with pytest.raises(TaskError, match="the checkpoint is for other observations: links 30, "):
            take(made, wider)
    assert equal(before, weights(made))


def test_a_constant_missing_in_an_old_checkpoint_has_its_default():
    made, again = learner(seed=1), learner()
    checkpoint = stored(state_of(made))
    del checkpoint["policy"]["network"]["mlp_width"], checkpoint["config"]["desired_kl"]
    resume_learner(again, checkpoint)
    assert equal(weights(made), weights(again))


def test_load_networks_loads_only_the_networks():
    pre = learner()
    pre.iterate()
    fine = learner(OnALine(16), gamma=0.9)
    load_networks(fine, stored(state_of(pre)))
    assert equal(weights(pre), weights(fine))
    assert fine.update == 0
    assert not fine.optimiser.state
    fine.iterate()
    assert not equal(weights(pre), weights(fine))
