"""Comparisons of checkpoints and rollouts."""

import torch


def assert_same(a, b):
    """Asserts that two nestings of dicts, lists and tensors are equal, bit for bit."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list):
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b)
    else:
        assert a == b


def played(env, moves):
    """Returns the observations of a rollout of ``moves`` across episodes."""
    td, observations = env.reset(), []
    for action in moves:
        current, td = env.step_and_maybe_reset(td.set("action", action))
        observations.append(current["next", "observation"])
    return torch.stack(observations)


def assert_repeats(first, second, engine="compiled"):
    """Equal bit for bit; with MuJoCo-Warp on CUDA, where the order of sums varies, as long as rounding stays small."""
    exact = engine == "compiled" or first.device.type == "cpu"
    torch.testing.assert_close(first, second, rtol=0 if exact else 2e-2, atol=0 if exact else 2e-2)
