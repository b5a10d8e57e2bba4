"""Returns as distributions, against values computed by hand or by torch in double precision."""

import math

import torch
from for_each import for_each

from torchrl_loco.training.reppo import ValueBins


@for_each("low", [0.0, -150.0])
def test_bins_keep_a_return(low):
    bins = ValueBins(low, 150.0, 151)
    returns = torch.tensor([5.0, 17.3, 99.99, 140.0, low + 5.0])
    encoded = bins.encode(returns)
    torch.testing.assert_close(encoded.sum(-1), torch.ones(5))
    torch.testing.assert_close(bins.decode(encoded.log()), returns, atol=1e-3, rtol=0)
    spread = (encoded * (bins.centers - returns.unsqueeze(-1)).square()).sum(-1).sqrt() / bins.width
    torch.testing.assert_close(spread, torch.full((5,), math.sqrt(0.75**2 + 1 / 12)), atol=1e-2, rtol=0)


def test_bins_clip_returns_beyond_them():
    bins = ValueBins(0.0, 10.0, 11)
    torch.testing.assert_close(bins.encode(torch.tensor([-5.0, 99.0])), bins.encode(torch.tensor([0.0, 10.0])))
