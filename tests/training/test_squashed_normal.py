"""Samples and divergences of normals under tanh, against torch's distributions in double precision."""

import math

import torch
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_loco.training.reppo import kl, sample


def normal(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator), torch.rand(shape, generator=generator) + 0.2


def test_samples_and_their_densities():
    (loc, scale), (noise, _) = normal((3, 5, 21)), normal((3, 5, 21), seed=1)
    action, log_prob = sample(loc, scale, noise)
    exact, exact_loc = (loc + scale * noise).double(), loc.double()
    expected = Normal(exact_loc, scale.double()).log_prob(exact) - (1 - exact.tanh().square()).log()
    torch.testing.assert_close(action.double(), exact.tanh(), atol=1e-6, rtol=0)
    torch.testing.assert_close(log_prob.double(), expected.sum(-1), atol=1e-4, rtol=1e-5)


def test_densities_and_slopes_are_exact_where_tanh_saturates():
    """Where the slope of tanh is 4 exp(-2 |u|)."""
    for sign in (-1.0, 1.0):
        loc, scale = torch.full((2000, 1), 30.0 * sign).requires_grad_(), torch.ones(2000, 1)
        noise, _ = normal((2000, 1))
        action, log_prob = sample(loc, scale, noise)
        u = loc + noise
        assert action.eq(sign).all()
        expected = Normal(loc, scale).log_prob(u) - (math.log(4.0) - 2 * u.abs())
        torch.testing.assert_close(log_prob, expected.squeeze(-1), atol=1e-4, rtol=1e-6)
        (slope,) = torch.autograd.grad(log_prob.sum(), loc)
        torch.testing.assert_close(slope, torch.full_like(slope, 2.0 * sign))


def test_divergences():
    old, new = normal((50, 6)), normal((50, 6), seed=1)
    of = [Independent(Normal(loc.double(), scale.double()), 1) for loc, scale in (old, new)]
    torch.testing.assert_close(kl(*old, *new).double(), kl_divergence(*of), atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(kl(*new, *new), torch.zeros(50))
