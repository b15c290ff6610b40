"""Symlog and its inverse; the matching loss learns the mean of returns."""

import pytest
import torch

from morphgen.rl.ppo import half_square, matching_loss, symexp, symlog


def test_symexp_is_the_inverse_of_symlog():
    x = torch.tensor([-5e4, -3.0, -1e-6, 0.0, 1e-6, 0.5, 7.0, 1e5])
    torch.testing.assert_close(symexp(symlog(x)), x, rtol=1e-5, atol=0)


def test_symlog_is_odd_and_linear_near_zero_and_logarithmic_beyond():
    torch.testing.assert_close(symlog(torch.tensor(torch.e - 1)), torch.tensor(1.0))
    x = torch.linspace(0, 9, 10)
    assert symlog(-x).equal(-symlog(x))
    small = torch.tensor([1e-4])
    torch.testing.assert_close(symlog(small), small, rtol=1e-3, atol=0)


def test_symlog_has_slope_one_at_zero_on_both_sides():
    x = torch.tensor([-1e-9, 1e-9], requires_grad=True)
    symlog(x).sum().backward()
    torch.testing.assert_close(x.grad, torch.ones(2))


def test_the_gradient_of_the_matching_loss_is_the_error():
    x = torch.linspace(-4, 4, 33).requires_grad_()
    y = torch.linspace(30, -30, 33)
    matching_loss(x, y).sum().backward()
    torch.testing.assert_close(x.grad, symexp(x.detach()) - y)


def test_the_matching_loss_is_zero_only_at_the_target():
    y = torch.tensor([-20.0, -0.1, 0.0, 3.0, 50.0])
    at = symlog(y)
    torch.testing.assert_close(matching_loss(at, y), torch.zeros(5), atol=1e-5, rtol=0)
    for off in (-1.0, -0.1, 0.1, 1.0):
        assert (matching_loss(at + off, y) > 0).all()


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
