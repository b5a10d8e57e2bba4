"""Samples and divergences of normals under tanh, against torch's distributions in double precision."""

import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_loco.training.squashed_normal import _Sample, kl, sample

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def normal(shape, device, seed=0):
    """Returns means and standard deviations side by side, as the last layer of an actor gives them."""
    generator = torch.Generator().manual_seed(seed)
    loc, scale = torch.randn(shape, generator=generator), torch.rand(shape, generator=generator) + 0.2
    return torch.cat([loc, scale], dim=-1).to(device).requires_grad_()


def reference(both, noise):
    loc, scale = both.chunk(2, dim=-1)
    u = loc + scale * noise
    return u.tanh(), (Normal(loc, scale).log_prob(u) - (1 - u.tanh().square()).log()).sum(-1)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(100, 6), (3, 5, 21), (0, 6)])
def test_samples_and_their_gradients(device, shape):
    both = normal(shape, device)
    torch.manual_seed(1)
    noise = torch.randn(shape, device=device)
    torch.manual_seed(1)
    action, log_prob = sample(*both.chunk(2, dim=-1))
    exact = both.detach().double().requires_grad_()
    expected_action, expected_log_prob = reference(exact, noise.double())
    torch.testing.assert_close(action.double(), expected_action, atol=1e-6, rtol=0)
    torch.testing.assert_close(log_prob.double(), expected_log_prob, atol=1e-5, rtol=1e-5)
    weight = torch.randn(shape, device=device)
    (gradient,) = torch.autograd.grad((action * weight).sum() + log_prob.sum(), both)
    (expected,) = torch.autograd.grad((expected_action * weight).sum() + expected_log_prob.sum(), exact)
    torch.testing.assert_close(gradient.double(), expected, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_rows_in_any_order_of_memory(device):
    """The time first or the world first, which for torch are the same memory."""
    found = []
    for turned in (False, True):
        loc, scale = (x.detach() for x in normal((5, 3, 6), device).chunk(2, dim=-1))
        if turned:
            loc, scale = (x.transpose(0, 1).contiguous().transpose(0, 1) for x in (loc, scale))
        loc, scale = loc.requires_grad_(), scale.requires_grad_()
        torch.manual_seed(0)
        noise = torch.randn(5, 3, 6).to(device)
        action, log_prob = _Sample.apply(loc, scale, noise)
        divergence = kl(scale.detach(), scale.detach(), loc, scale)
        found.append(
            [action, log_prob, *torch.autograd.grad((action.sum() + log_prob + divergence).sum(), [loc, scale])]
        )
    for straight, other in zip(*found, strict=True):
        assert torch.equal(straight, other)


@pytest.mark.parametrize("device", DEVICES)
def test_log_probability_is_exact_where_tanh_saturates(device):
    """Where the slope of tanh is 4 exp(-2 u)."""
    loc, scale = torch.full((2000, 1), 30.0, device=device), torch.ones(2000, 1, device=device)
    torch.manual_seed(0)
    u = loc + torch.randn_like(loc)
    torch.manual_seed(0)
    action, log_prob = sample(loc, scale)
    assert action.eq(1).all()
    expected = Normal(loc, scale).log_prob(u) - (math.log(4.0) - 2 * u)
    torch.testing.assert_close(log_prob, expected.squeeze(-1), atol=1e-4, rtol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_divergences_and_their_gradients(device):
    old, new = normal((50, 6), device), normal((50, 6), device, seed=1)
    exact_old, exact = (x.detach().double().requires_grad_() for x in (old, new))
    divergence = kl(*old.detach().chunk(2, dim=-1), *new.chunk(2, dim=-1))
    normals = [Independent(Normal(*x.chunk(2, dim=-1)), 1) for x in (exact_old, exact)]
    expected = kl_divergence(*normals)
    torch.testing.assert_close(divergence.double(), expected, atol=1e-4, rtol=1e-5)
    weight = torch.randn(50, device=device)
    (gradient,) = torch.autograd.grad((divergence * weight).sum(), new)
    (other,) = torch.autograd.grad((expected * weight).sum(), exact)
    torch.testing.assert_close(gradient.double(), other, atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(kl(*new.chunk(2, -1), *new.chunk(2, -1)), torch.zeros(50, device=device))
