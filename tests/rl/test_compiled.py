"""Compiled learners learn like uncompiled ones, also on a GPU."""

import functools

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException

from helpers.learners import learner
from helpers.line_batch import OnALine
from morphgen.errors import TaskError
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.ppo import Learner, prepared

CPU = torch.device("cpu")


@pytest.mark.parametrize(("bf16", "kind"), [(True, torch.bfloat16), (False, torch.float32)])
def test_matrix_products_have_the_requested_precision(bf16, kind):
    call = prepared(lambda x: x @ x, CPU, bf16=bf16, compiled=False)
    found = call(torch.eye(3) / 3)
    assert found.dtype == kind
    torch.testing.assert_close(found.float(), torch.eye(3) / 9, rtol=1e-2, atol=0)


def test_a_failed_compilation_is_a_one_line_error(monkeypatch):
    def without(function, **options):
        def call(*args):
            raise TorchDynamoException("no compiler\nand a long story")

        return call

    monkeypatch.setattr(torch, "compile", without)
    call = prepared(torch.exp, CPU, bf16=False, compiled=True)
    with pytest.raises(TaskError, match=r"^--compile: torch cannot compile here: no compiler$"):
        call(torch.zeros(1))


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
def test_compilation_gives_nearly_the_same_update(agent):
    plain = learner(agent=agent, epochs=1).iterate()
    compiled = learner(agent=agent, epochs=1, compile=True).iterate()
    torch.compiler.reset()
    assert compiled.value_loss == pytest.approx(plain.value_loss, rel=1e-3)
    assert compiled.actor_gradient == pytest.approx(plain.actor_gradient, rel=1e-2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
def test_cuda_graphs_of_two_learners_in_turn_learn_the_same(agent):
    for seed in (0, 1):
        plain, graphs = (
            learner(agent=agent, seed=seed, device="cuda", compile=compiled)
            for compiled in (False, True)
        )
        for _ in range(3):
            wanted, found = plain.iterate(), graphs.iterate()
            assert found.value_loss == pytest.approx(wanted.value_loss, rel=1e-2)
            assert found.actor_gradient == pytest.approx(wanted.actor_gradient, rel=5e-2)
            assert found.entropy == pytest.approx(wanted.entropy, rel=1e-2)
            assert found.reward == pytest.approx(wanted.reward, rel=1e-2)


@pytest.mark.slow
def test_one_process_compiles_many_learners(monkeypatch):
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))
    for agent in ("se", "me-mlp", "me-tf"):
        for envs in (2, 4, 6):
            config = PPOConfig(
                total_timesteps=envs * 8, num_steps=8, minibatches=2, epochs=1, compile=True
            )
            Learner(OnALine(envs), PolicyConfig(agent), config).iterate()
    torch.compiler.reset()
