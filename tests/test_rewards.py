"""tolerance, for Warp and for torch, against a NumPy version, over a grid that contains the edges."""

import itertools

import numpy as np
import pytest
import torch
import warp as wp
from oracle import tolerance as expected_tolerance

import torchrl_loco
from torchrl_loco.rewards import Sigmoid, tolerance

REACH_ZERO = (Sigmoid.LINEAR, Sigmoid.COSINE, Sigmoid.QUADRATIC)
BOUNDS = [(0.0, 0.0), (-1.0, 2.0), (1.5, np.inf), (-np.inf, -0.5)]
MARGINS = [0.0, 0.25, 1.0, 7.5]


@wp.kernel
def evaluate(
    x: wp.array[float],
    lower: float,
    upper: float,
    margin: float,
    kind: int,
    value: float,
    out: wp.array[float],
):
    i = wp.tid()
    out[i] = tolerance(x[i], lower, upper, margin, kind, value)


def run(x, lower, upper, margin, kind, value, device):
    out = wp.full(len(x), np.nan, dtype=float, device=device)
    wp.launch(evaluate, len(x), [wp.array(x, dtype=float, device=device), lower, upper, margin, int(kind), value, out])
    return out.numpy()


def grid(lower, upper, margin):
    edges = [b for b in (lower, upper) if np.isfinite(b)]
    edges += [lower - margin, upper + margin]
    edges = np.array([e for e in edges if np.isfinite(e)], dtype=np.float32)
    beside = np.concatenate([np.nextafter(edges, np.float32(side)) for side in (-1e9, 1e9)])
    return np.concatenate([np.linspace(-20, 20, 401, dtype=np.float32), edges, beside])


def test_agrees_with_numpy(device):
    with wp.ScopedDevice(device):
        for kind, (lower, upper), margin in itertools.product(Sigmoid, BOUNDS, MARGINS):
            for value in [0.1, 0.5, 0.95, *([0.0] if kind in REACH_ZERO else [])]:
                x = grid(lower, upper, margin)
                ours = run(x, lower, upper, margin, kind, value, device)
                theirs = expected_tolerance(x, lower, upper, margin, kind.name.lower(), value)
                message = f"{kind.name} {lower} {upper} {margin} {value}"
                np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-6, err_msg=message)
                seen = torch.tensor(x, dtype=torch.double)
                in_torch = torchrl_loco.tolerance(seen, (lower, upper), margin, kind.name.lower(), value)
                np.testing.assert_allclose(in_torch, theirs, rtol=0, atol=1e-9, err_msg=message)


def test_edges():
    for kind in Sigmoid:
        value = 0.0 if kind in REACH_ZERO else 0.2
        x = [-1.0, 2.0, 5.0, -4.0, 1e6]
        on_lower, on_upper, *at_margin, far = run(x, -1.0, 2.0, 3.0, kind, value, "cpu")
        assert on_lower == on_upper == 1.0, kind
        np.testing.assert_allclose(at_margin, value, atol=1e-6, err_msg=kind.name)
        assert 0.0 <= far < 1e-3, kind
        assert run([-1.0, 2.0, 2.0001], -1.0, 2.0, 0.0, kind, value, "cpu").tolist() == [1.0, 1.0, 0.0], kind


def test_in_torch_what_is_not_valid_is_refused():
    for arguments, message in [
        ({"bounds": (1, 0)}, "bounds must be"),
        ({"margin": -1}, "margin must be 0 or more"),
        ({"sigmoid": "lineer"}, "did you mean 'linear'"),
        ({"value_at_margin": 0.0, "margin": 1}, "value_at_margin must"),
    ]:
        with pytest.raises(ValueError, match=message):
            torchrl_loco.tolerance(torch.zeros(2), **arguments)
