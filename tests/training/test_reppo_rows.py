"""REPPO's kernels of Triton beside torch in double precision, and its updates beside those of its modules."""

import pytest
import torch
from for_each import for_each
from small_runs import WALKER
from tensordict import TensorDict
from torch import nn

from torchrl_loco.training import Spaces, preset
from torchrl_loco.training import reppo as of_reppo
from torchrl_loco.training.adam import FlatAdam
from torchrl_loco.training.reppo_rows import ReppoRows
from torchrl_loco.training.rows import Rows

pytestmark = pytest.mark.gpu
UNBOUNDED = Spaces(24, 6, privileged=31, bounded=False)
ROUNDING = {torch.float32: 1e-5, torch.bfloat16: 1e-2}
on_both = for_each("dtype", list(ROUNDING))


def drawn(*shape, dtype=torch.float32):
    return torch.randn(shape, device="cuda").to(dtype)


def check(ours, theirs, dtype):
    for one, other in zip(ours, theirs, strict=True):
        assert (one.double() - other).norm() <= ROUNDING[dtype] * other.norm()


@on_both
@for_each(("n", "width"), [(1000, 512), (3, 48), (4099, 300)])
def test_normed_rows(dtype, n, width):
    from torchrl_loco.training.normed import NormedSilu

    torch.manual_seed(0)
    inputs = drawn(n, width + 16, dtype=dtype)[:, :width], *(drawn(width, dtype=dtype) for _ in range(3))
    exact = [each.double().requires_grad_() for each in inputs]
    ours, slope = [each.detach().requires_grad_() for each in inputs], drawn(n, width, dtype=dtype)
    given = NormedSilu.apply(*ours, 1e-5)
    expected = nn.functional.silu(nn.functional.layer_norm(exact[0] + exact[1], (width,), *exact[2:], 1e-5))
    given.backward(slope)
    expected.backward(slope.double())
    check([given, *(each.grad for each in ours)], [expected, *(each.grad for each in exact)], dtype)


@on_both
def test_distributions_and_errors(dtype):
    from torchrl_loco.training import reppo_kernels as kernels

    torch.manual_seed(0)
    bins = of_reppo.ValueBins(-5.0, 20.0, 151).cuda()
    logits, returns = drawn(500, 151, dtype=dtype).requires_grad_(), 10.0 * drawn(500, 2)[:, 0]
    exact, slope = logits.detach().double().requires_grad_(), drawn(500)
    loss = kernels.MeanLoss.apply(logits, *kernels.entropy(logits.detach(), returns, bins))
    value = kernels.BinMean.apply(logits, bins.centers)
    slopes = [torch.autograd.grad(loss, logits)[0], torch.autograd.grad(value, logits, slope)[0]]
    wanted = nn.functional.cross_entropy(exact, bins.double().encode(returns.double()))
    mean = (exact.softmax(-1) * bins.centers).sum(-1)
    of_exact = [torch.autograd.grad(wanted, exact)[0], torch.autograd.grad(mean, exact, slope.double())[0]]
    check([loss, value, *slopes], [wanted, mean, *of_exact], dtype)

    found, features = (drawn(500, 64, dtype=dtype)[:, :48].requires_grad_() for _ in range(2))
    alive = (drawn(500, 3) > 0).float()[:, 0]
    exact = found.detach().double().requires_grad_()
    error = kernels.MeanLoss.apply(found, *kernels.squared_error(found.detach(), features, alive))
    wanted = ((exact - features.double()).square().mean(-1) * alive).mean()
    check([error, *torch.autograd.grad(error, found)], [wanted, *torch.autograd.grad(wanted, exact)], dtype)


@for_each(
    ("spaces", "hidden", "kl_bound"),
    [
        (WALKER, (64, 48), 100.0),
        (WALKER, (40, 40), 2.0),
        (Spaces(24, 6, privileged=31, bounded=False), (48, 64), 100.0),
    ],
)
def test_updates_are_those_of_the_modules(spaces, hidden, kl_bound, monkeypatch):
    """Within the bound of the divergence, so that the critic's slope by actions counts, and in part beyond it."""

    def trained(quick):
        monkeypatch.setattr(of_reppo, "triton_works", lambda device: quick)
        settings = {"num_envs": 32, "num_steps": 8, "minibatch_size": 64, "hidden": hidden, "epochs": 2}
        torch.manual_seed(0)
        config = preset("walker_stand", "cuda", "reppo", kl_bound=kl_bound, compile=False, bf16=False, **settings)
        reppo = of_reppo.REPPO(config, spaces)
        assert isinstance(reppo._nets, ReppoRows) == quick
        sizes = {"observation": 24, **({"privileged": 31} if spaces.privileged else {})}
        for number in range(3):
            torch.manual_seed(number)
            batch = TensorDict({name: drawn(32, 8, size) for name, size in sizes.items()}, (32, 8))
            of_policy = {"loc": 0.3 * drawn(32, 8, 6), "scale": drawn(32, 8, 6).exp(), "action": drawn(32, 8, 6).tanh()}
            after = {name: drawn(32, 8, size) for name, size in sizes.items()} | {"reward": drawn(32, 8, 1)}
            after |= {"terminated": drawn(32, 8, 1) > 1.5, "done": drawn(32, 8, 1) > 1.0}
            metrics = reppo.update(batch.update(of_policy).update({"next": after}), progress=0.0)
        return metrics, torch.cat([part.flatten() for part in reppo.networks.parameters()]).detach()

    (metrics, weights), (wanted, of_modules) = trained(quick=True), trained(quick=False)
    torch.testing.assert_close(metrics, wanted, rtol=1e-3, atol=1e-4)
    assert (weights - of_modules).abs().max() < 1e-3


def test_an_actor_of_linear_layers_learns_in_bfloat16():
    settings = {"num_envs": 32, "num_steps": 8, "minibatch_size": 64, "epochs": 1, "hidden": (64, 48)}
    config = preset("walker_stand", "cuda", "reppo", bf16=True, **settings)
    reppo = of_reppo.REPPO(config, WALKER, lambda i, o: nn.Sequential(nn.Linear(i, 32), nn.SiLU(), nn.Linear(32, o)))
    begin = [part.clone() for part in reppo.actor.parameters()]
    batch = TensorDict({"observation": drawn(32, 8, 24)}, (32, 8))
    with torch.no_grad():
        batch = reppo.acting()(batch)
    after = {"observation": drawn(32, 8, 24), "reward": drawn(32, 8, 1)}
    after |= dict.fromkeys(("terminated", "done"), torch.zeros(32, 8, 1, dtype=torch.bool, device="cuda"))
    reppo.update(batch.update({"next": after}), progress=0.0)
    assert all((old != new).any() for old, new in zip(begin, reppo.actor.parameters(), strict=True))


def test_norms_anywhere_in_a_network():
    """Behind linear layers, with and without a bias, behind activations, at the beginning, and without SiLU."""
    layers: list[nn.Module] = [nn.LayerNorm(24), nn.SiLU(), nn.Linear(24, 48), nn.SiLU(), nn.LayerNorm(48), nn.SiLU()]
    layers += [
        nn.Linear(48, 40, bias=False),
        nn.LayerNorm(40),
        nn.SiLU(),
        nn.Linear(40, 32),
        nn.LayerNorm(32),
        nn.SiLU(),
    ]
    layers += [
        nn.LayerNorm(32, bias=False),
        nn.SiLU(),
        nn.Linear(32, 20),
        nn.LayerNorm(20),
        nn.Tanh(),
        nn.Linear(20, 7),
    ]
    torch.manual_seed(0)
    network = nn.Sequential(*layers).cuda()
    with torch.no_grad():
        for part in network.parameters():
            part += 0.3 * torch.randn_like(part)
    optimizer = FlatAdam(network.parameters(), lr=torch.tensor(1e-3, device="cuda"))
    rows, slope = drawn(500, 24), drawn(500, 7)
    expected = network(rows)
    expected.backward(slope)
    wanted = [part.grad.clone() for part in network.parameters()]
    optimizer.zero_grad()
    found = Rows(network, 24, torch.float32)(nn.functional.pad(rows, (0, 8)), optimizer.wide(torch.float32))
    found.backward(slope)
    found_slopes = optimizer._vectors[0]._views(optimizer._vectors[0].gradient())
    for ours, theirs in zip([found, *found_slopes], [expected, *wanted], strict=True):
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm()
