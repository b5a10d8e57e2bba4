"""Returns as distributions, against values computed by hand or by torch in double precision."""

import math

import pytest
import torch
from torch.nn.functional import cross_entropy

from torchrl_loco.sim import TorchGraph
from torchrl_loco.training.value_bins import ValueBins

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def test_bins_keep_a_return():
    bins = ValueBins(0.0, 150.0, 151)
    returns = torch.tensor([5.0, 17.3, 99.99, 140.0])
    encoded = bins.encode(returns)
    torch.testing.assert_close(encoded.sum(-1), torch.ones(4))
    torch.testing.assert_close(bins.decode(encoded.log()), returns, atol=1e-3, rtol=0)
    spread = (encoded * (bins.centers - returns.unsqueeze(-1)).square()).sum(-1).sqrt()
    torch.testing.assert_close(spread, torch.full((4,), math.sqrt(0.75**2 + 1 / 12)), atol=1e-2, rtol=0)


def test_bins_clip_returns_beyond_them():
    bins = ValueBins(0.0, 10.0, 11)
    torch.testing.assert_close(bins.encode(torch.tensor([-5.0, 99.0])), bins.encode(torch.tensor([0.0, 10.0])))


def test_bins_below_zero_keep_a_return():
    bins = ValueBins(-20.0, 10.0, 61)
    returns = torch.tensor([-20.0, -13.3, -0.2, 0.0, 9.0])
    torch.testing.assert_close(bins.decode(bins.encode(returns).log())[1:], returns[1:], atol=1e-3, rtol=0)
    assert bins.decode(bins.encode(returns).log())[0] < -19.5


def case(device, count=151, rows=37, low=0.0):
    torch.manual_seed(0)
    bins = ValueBins(low, 150.0, count).to(device)
    logits = (10 * torch.randn(rows, count)).to(device).requires_grad_()
    returns = torch.linspace(low - 20.0, 170.0, rows, device=device)  # also beyond the bins
    return bins, logits, returns


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("count", "low"), [(2, 0.0), (31, 0.0), (151, 0.0), (151, -150.0)])
def test_cross_entropy_and_its_gradient(device, count, low):
    bins, logits, returns = case(device, count, low=low)
    loss = bins.cross_entropy(logits, returns)
    (gradient,) = torch.autograd.grad(3 * loss, logits)
    exact = logits.detach().double().requires_grad_()
    expected = cross_entropy(exact, bins.double().encode(returns.double()))
    (other,) = torch.autograd.grad(3 * expected, exact)
    torch.testing.assert_close(loss.double(), expected, atol=0, rtol=1e-4)
    torch.testing.assert_close(gradient.double(), other, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_rows_in_any_order_of_memory(device):
    bins, logits, returns = case(device)
    columns, every_second = logits.detach().T.contiguous().T.requires_grad_(), torch.stack([returns, returns], 1)[:, 0]
    expected = torch.autograd.grad(bins.cross_entropy(logits, returns), logits)
    assert torch.equal(*torch.autograd.grad(bins.cross_entropy(columns, every_second), columns), *expected)


@pytest.mark.gpu
def test_recorded_gradients_are_those_of_a_direct_call():
    bins, logits, returns = case("cuda")
    found = []

    def work():
        found.append(torch.autograd.grad(bins.cross_entropy(logits, returns), logits)[0])

    graph = TorchGraph(work, torch.device("cuda"), warmup=1)
    for _ in range(3):
        graph()
    direct, recorded = found
    assert direct.equal(recorded)
