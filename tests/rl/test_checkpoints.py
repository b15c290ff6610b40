"""Checkpoints of a learner: what goes on from one equals what never stopped, or is refused."""

import copy

import pytest

from learners import equal, learner, stored, untimed, weights
from morphgen.errors import TaskError
from on_a_line import OnALine


@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
@pytest.mark.parametrize("discrete", [True, False], ids=["discrete", "continuous"])
def test_a_run_that_is_taken_up_again_equals_one_that_went_on(agent, discrete):
    options = {
        "agent": agent,
        "discrete": discrete,
        "task_reweighting": True,
        "learning_rate": 3e-3,
        "target_kl": 1e-3,
    }
    went_on = learner(**options)
    went_on.iterate(), went_on.iterate()
    checkpoint = stored(went_on.checkpoint())
    went_on.restart_episodes()
    reports = [went_on.iterate(), went_on.iterate()]

    kind = "discrete" if discrete else "continuous"
    again = learner(OnALine(8, kind=kind, seed=99), seed=77, **options)
    again.iterate()
    again.resume(checkpoint)
    assert not again.done
    same = [again.iterate(), again.iterate()]
    assert again.done
    assert equal(weights(went_on), weights(again))
    for one, other in zip(reports, same, strict=True):
        assert untimed(one) == untimed(other)
    assert went_on.batch.state_dict() == again.batch.state_dict()


@pytest.mark.parametrize("part", ["optimiser", "generators", "batch", "slow", "update", "share"])
def test_a_run_that_forgets_a_part_does_not_equal_one_that_went_on(part):
    options = {"task_reweighting": True, "learning_rate": 3e-3, "target_kl": 1e-3}
    went_on = learner(**options)
    went_on.iterate(), went_on.iterate()
    checkpoint = stored(went_on.checkpoint())
    went_on.restart_episodes()
    went_on.iterate()
    again = learner(OnALine(8, seed=99), seed=77, **options)
    again.iterate()
    again.resume({**checkpoint, part: again.checkpoint()[part]})
    again.iterate()
    assert not equal(weights(went_on), weights(again))


def test_a_checkpoint_does_not_change_with_the_learner():
    made = learner()
    made.iterate()
    checkpoint = made.checkpoint()
    before = copy.deepcopy(checkpoint)
    made.iterate()
    again = learner()
    again.resume(checkpoint)
    assert all(checkpoint["actor"][k].equal(before["actor"][k]) for k in before["actor"])
    steps = [each["step"] for each in checkpoint["optimiser"]["state"].values()]
    assert steps == [each["step"] for each in before["optimiser"]["state"].values()]


def test_a_learner_does_not_change_with_a_checkpoint():
    looked_at, alone = learner(), learner()
    for each in (looked_at, alone):
        each.iterate()
    looked_at.checkpoint()
    assert untimed(looked_at.iterate()) == untimed(alone.iterate())
    assert equal(weights(looked_at), weights(alone))


def test_the_same_seed_gives_the_same_run():
    runs = [learner(seed=seed) for seed in (1, 1, 2)]
    for each in runs:
        each.iterate()
    assert equal(weights(runs[0]), weights(runs[1]))
    assert not equal(weights(runs[0]), weights(runs[2]))


def test_checkpoints_of_other_runs_are_refused_and_nothing_is_changed():
    made = learner()
    before = weights(made)
    with pytest.raises(TaskError, match=r"another run: gamma 0\.9, here 0\.99$"):
        made.resume(learner(gamma=0.9).checkpoint())
    with pytest.raises(TaskError, match="another run: agent me-tf, here me-mlp"):
        made.resume(learner(agent="me-tf").checkpoint())
    wider = learner().checkpoint()
    wider["layout"]["links"] = 30
    for take in (made.resume, made.adopt):
        with pytest.raises(TaskError, match="the checkpoint is for other observations: links 30, "):
            take(wider)
    assert equal(before, weights(made))


def test_checkpoints_from_before_a_constant_have_its_default():
    made, again = learner(seed=1), learner()
    checkpoint = stored(made.checkpoint())
    del checkpoint["policy"]["logit_scale"], checkpoint["config"]["target_kl"]
    again.resume(checkpoint)
    assert equal(weights(made), weights(again))


def test_fine_tuning_begins_with_the_networks_and_nothing_else():
    pre = learner()
    pre.iterate()
    fine = learner(OnALine(16), gamma=0.9)
    fine.adopt(stored(pre.checkpoint()))
    assert equal(weights(pre), weights(fine))
    assert fine.update == 0
    assert not fine.optimiser.state
    fine.iterate()
    assert not equal(weights(pre), weights(fine))
