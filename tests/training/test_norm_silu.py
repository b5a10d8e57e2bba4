"""Layer norm and SiLU in one kernel, against torch's own in double precision."""

import pytest
import torch
from torch import nn
from torch.nn.functional import layer_norm, silu

from torchrl_loco.sim import TorchGraph
from torchrl_loco.training.norm_silu import BLOCKS, WIDEST, Layers, norm_silu

SHAPES = [(5, 32), (8 * BLOCKS + 9, 64), (8 * BLOCKS + 9, 128), (2, 3, 512), (9, WIDEST), (0, 32)]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def reference(x, weight, bias):
    return silu(layer_norm(x, (x.shape[-1],), weight, bias, 1e-5))


def inputs(shape, device):
    torch.manual_seed(0)
    x = 3 * torch.randn(shape) + 1
    return [value.to(device).requires_grad_() for value in (x, torch.randn(shape[-1]), torch.randn(shape[-1]))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_gradients_are_those_of_torch(device, shape):
    given = inputs(shape, device)
    y = norm_silu(*given, 1e-5)
    grad_y = torch.randn(shape, device=device)
    gradients = torch.autograd.grad(y, given, grad_y)
    exact = [value.detach().double().requires_grad_() for value in given]
    expected = reference(*exact)
    torch.testing.assert_close(y.double(), expected, atol=1e-5, rtol=1e-5)
    for gradient, other in zip(gradients, torch.autograd.grad(expected, exact, grad_y.double()), strict=True):
        torch.testing.assert_close(gradient.double(), other, atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_rows_in_any_order_of_memory(device):
    x, weight, bias = inputs((32, 6), device)
    rows = x.T
    weight, bias = torch.ones(32, device=device), torch.zeros(32, device=device)
    grad_y = torch.randn(32, 6, device=device).T
    (gradient,) = torch.autograd.grad(norm_silu(rows, weight, bias, 1e-5), x, grad_y)
    (expected,) = torch.autograd.grad(reference(rows, weight, bias), x, grad_y)
    torch.testing.assert_close(gradient, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_tensors_with_gaps_and_at_any_address(device):
    x, weight, bias = inputs((4, 128), device)
    moved, moved_weight = (torch.cat([one.new_zeros(1), one.view(-1)])[1:].view(one.shape) for one in (x, weight))
    assert moved.data_ptr() % 16
    assert moved_weight.data_ptr() % 16
    every_second = torch.stack([bias, weight], dim=1)[:, 0]
    expected = reference(x, weight, bias)
    torch.testing.assert_close(norm_silu(moved, moved_weight, every_second, 1e-5), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.gpu
def test_recorded_gradients_are_those_of_a_direct_call():
    given = inputs((33, 128), "cuda")
    grad_y, found = torch.randn(33, 128, device="cuda"), []

    def work():
        found.append(torch.autograd.grad(norm_silu(*given, 1e-5), given, grad_y))

    graph = TorchGraph(work, torch.device("cuda"), warmup=1)
    for _ in range(3):
        graph()
    assert len(found) == 2  # one direct call, one recording
    for direct, recorded in zip(*found, strict=True):
        assert direct.equal(recorded)


def test_frozen_weights_get_no_gradient():
    x, weight, bias = inputs((4, 32), "cpu")
    norm_silu(x, weight.detach(), bias.detach(), 1e-5).sum().backward()
    expected = torch.autograd.grad(reference(x, weight, bias).sum(), x)[0]
    torch.testing.assert_close(x.grad, expected, atol=1e-5, rtol=1e-5)
    assert weight.grad is None


@pytest.mark.gpu
@pytest.mark.parametrize("width", [40, 64, WIDEST, WIDEST + 32])
def test_layers_are_the_same_on_both_devices(width):
    torch.manual_seed(0)
    norms = [nn.LayerNorm(width) for _ in range(3)]
    layers, x = Layers(norms[0], nn.SiLU(), norms[1], norms[2], nn.SiLU()), torch.randn(7, width)
    for norm in norms:
        nn.init.normal_(norm.weight)
    expected = layers(x)
    torch.testing.assert_close(layers.to("cuda")(x.to("cuda")).cpu(), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.gpu
def test_layers_launch_the_kernel_where_it_computes_them(monkeypatch):
    launched = []
    monkeypatch.setattr("torchrl_loco.training.norm_silu.norm_silu", lambda x, *_: launched.append(x.shape) or x)
    for width in (64, 40):
        x = torch.randn(7, width, device="cuda")
        Layers(nn.LayerNorm(width), nn.SiLU(), nn.LayerNorm(width)).to("cuda")(x)
    assert launched == [(7, 64)]
