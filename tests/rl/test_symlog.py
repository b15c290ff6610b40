"""Symlog and its inverse; the matching loss learns the mean of returns."""

import pytest
import torch

from morphgen.rl.ppo import half_square, matching_loss, symexp, symlog


def test_symexp_is_the_inverse_of_symlog_which_is_odd_and_logarithmic():
    x = torch.tensor([-5e4, -3.0, -1e-6, 0.0, 1e-6, 0.5, 7.0, 1e5])
    torch.testing.assert_close(symexp(symlog(x)), x, rtol=1e-5, atol=0)
    assert symlog(-x).equal(-symlog(x))
    torch.testing.assert_close(symlog(torch.tensor(torch.e - 1)), torch.tensor(1.0))


def test_the_matching_loss_is_zero_at_the_target_and_its_gradient_the_error():
    x = torch.linspace(-4, 4, 33).requires_grad_()
    y = torch.linspace(30, -30, 33)
    matching_loss(x, y).sum().backward()
    torch.testing.assert_close(x.grad, symexp(x.detach()) - y)
    torch.testing.assert_close(matching_loss(symlog(y), y), torch.zeros(33), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("loss", "read"), [(matching_loss, symexp), (half_square, lambda x: x)], ids=["symlog", "plain"]
)
def test_the_minimum_of_the_loss_is_the_mean(loss, read):
    returns = torch.tensor([-3.0, 0.0, 1.0, 20.0])
    x = torch.zeros((), requires_grad=True)
    optimiser = torch.optim.LBFGS([x], max_iter=50)

    def closure():
        optimiser.zero_grad()
        lost = loss(x.expand(4), returns).mean()
        lost.backward()
        return lost

    optimiser.step(closure)
    assert read(x.detach()).item() == pytest.approx(returns.mean().item(), rel=1e-4)
