"""Networks of linear layers and SiLU in Triton's kernels, beside torch in double precision."""

import itertools

import pytest
import torch
from for_each import for_each
from torch import nn

pytestmark = pytest.mark.gpu


@for_each("sizes", [(48, 512, 256, 128, 12), (300, 512, 256, 128, 1), (45, 50, 100, 29), (16, 3)])
def test_outputs_and_slopes_are_those_of_torch(sizes):
    """Of rows that lie apart, of any number of them and of any widths; bit for bit the same again."""
    from torchrl_loco.training import mlp

    torch.manual_seed(0)
    place, weights = 16, []
    vector = torch.randn(10**6, device="cuda").bfloat16()
    for inputs, outputs in itertools.pairwise(sizes):
        wide = inputs + -inputs % 16  # behind each row of a matrix zeros may follow
        weight = vector[place : place + outputs * wide].view(outputs, wide)[:, :inputs]
        weights += [weight.div_(inputs**0.5), vector[place + outputs * wide :][:outputs]]
        place += outputs * wide + outputs + -outputs % 16
    rows = torch.randn(1000, 320, device="cuda").bfloat16()[:, : sizes[0]]
    slope = torch.randn(1000, sizes[-1], device="cuda").bfloat16()

    expected, exact = rows.double(), [weight.double().requires_grad_() for weight in weights]
    for index in range(0, len(exact), 2):
        expected = nn.functional.linear(nn.functional.silu(expected) if index else expected, *exact[index : index + 2])
    expected.backward(slope.double())

    found = []
    for _ in range(2):
        parts = torch.zeros(mlp.PARTS, len(vector), device="cuda", requires_grad=True)
        given = mlp.SiluNetwork.apply(rows, parts, *weights)
        given.backward(slope)
        found.append((given.detach(), parts.detach().sum(0)))
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
    assert torch.equal(mlp.SiluNetwork.apply(rows, None, *weights), given)
    slopes = [found[0][1].as_strided(w.shape, w.stride(), w.storage_offset()) for w in weights]
    pairs = [(given, expected.detach()), *((ours, theirs.grad) for ours, theirs in zip(slopes, exact, strict=True))]
    for ours, theirs in pairs:
        assert (ours - theirs).norm() < 0.01 * theirs.norm()
