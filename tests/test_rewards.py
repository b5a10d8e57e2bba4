"""tolerance against a NumPy version, over a grid that contains the edges."""

import numpy as np
import pytest
import warp as wp
from oracle import tolerance as expected_tolerance

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


@pytest.mark.parametrize("kind", Sigmoid)
def test_agrees_with_numpy(kind, device):
    with wp.ScopedDevice(device):
        for lower, upper in BOUNDS:
            for margin in MARGINS:
                for value in [0.1, 0.5, 0.95, *([0.0] if kind in REACH_ZERO else [])]:
                    x = grid(lower, upper, margin)
                    ours = run(x, lower, upper, margin, kind, value, device)
                    theirs = expected_tolerance(x, lower, upper, margin, kind.name.lower(), value)
                    np.testing.assert_allclose(
                        ours, theirs, rtol=0, atol=2e-6, err_msg=f"{lower} {upper} {margin} {value}"
                    )


@pytest.mark.parametrize("kind", Sigmoid)
def test_edges(kind):
    with wp.ScopedDevice("cpu"):
        value = 0.0 if kind in REACH_ZERO else 0.2
        x = [-1.0, 2.0, 5.0, -4.0, 1e6]
        on_lower, on_upper, *at_margin, far = run(x, -1.0, 2.0, 3.0, kind, value, "cpu")
        assert on_lower == on_upper == 1.0
        np.testing.assert_allclose(at_margin, value, atol=1e-6)
        assert 0.0 <= far < 1e-3
        assert run([-1.0, 2.0, 2.0001], -1.0, 2.0, 0.0, kind, value, "cpu").tolist() == [1.0, 1.0, 0.0]
