"""What all algorithms have in common; also what CUDA graphs and an asynchronous host need, checked on the CPU."""

import dataclasses
import traceback

import pytest
import torch
from small_runs import made
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_loco.training import Trainer
from torchrl_loco.training.actor import SquashedNormal
from torchrl_loco.training.algorithm import Packed, compiled

HOST = ("_local_scalar_dense", "lift_fresh", "nonzero", "aten.equal")
"""Operations that read a tensor's value, or make a tensor from a value of Python's."""


class HostTraffic(TorchDispatchMode):
    """Notes which operations go between host and device."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        # On the CPU, Adam keeps its count there; on CUDA it does not.
        if any(name in str(func) for name in HOST) and not any(
            "/optim/" in f.filename for f in traceback.extract_stack()
        ):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


@pytest.fixture(params=["ppo", "reppo"])
def trainer(request, tmp_path):
    trainer = Trainer(made(tmp_path, request.param))
    trainer.algorithm.update(trainer.collector.rollout(), 0.0)
    return trainer


def test_training_waits_for_nothing(trainer):
    """Neither collecting nor what is computed of a batch nor a gradient step, which a CUDA graph can so record."""
    algorithm = trainer.algorithm
    if algorithm.config.algorithm == "ppo":
        algorithm.config = dataclasses.replace(algorithm.config, target_kl=0.01)
    with HostTraffic() as traffic, torch.no_grad():
        after = trainer.collector.rollout()["next"]
        trainer.episodes.add(*(after[name].squeeze(-1) for name in ("reward", "done", "terminated")))
        algorithm.batch_metrics(algorithm._data.steps)
    assert traffic.found == []
    with HostTraffic() as traffic:
        algorithm._gradient_steps()
    assert traffic.found == []
    with HostTraffic() as traffic:  # it would have been noticed
        torch.tensor(1.0)
        bool(torch.ones(()) > 0)
    assert len(traffic.found) >= 2


def test_actor_and_critic_see_the_same_normalised_observations(trainer):
    algorithm, batch = trainer.algorithm, trainer.collector.rollout()
    values = "returns" if algorithm.config.algorithm == "reppo" else "value_target"

    @torch.no_grad()
    def now():
        torch.manual_seed(0)
        return algorithm.prepare(batch)[values], algorithm.actor[0].module(batch["observation"])[0]

    before = now()
    algorithm.norms["observation"].update(torch.randn(100, 24) * 5 + 3)
    assert all((new != old).any() for new, old in zip(now(), before, strict=True))


def test_gradient_steps_see_what_the_actor_sees(trainer):
    """Whether they normalise observations themselves, or get them normalised."""
    algorithm, batch = trainer.algorithm, trainer.collector.rollout()
    algorithm.norms["observation"].update(torch.randn(100, 24) * 5 + 3)
    with torch.no_grad():
        data = algorithm.prepare(batch)["observation"]
        if algorithm.config.algorithm == "reppo":
            own = algorithm.distribution(data)[0]
        else:
            own = algorithm._mean(data, algorithm.optimizer.wide(torch.float32))
        torch.testing.assert_close(own, algorithm.actor[0].module(batch["observation"])[0])


def test_gradients_of_one_minibatch_do_not_reach_the_next(trainer):
    algorithm, norms = trainer.algorithm, []
    for optimizer in algorithm.optimizers.values():
        optimizer.param_groups[0]["lr"].fill_(1e-12)
    for _ in range(2):
        torch.manual_seed(0)
        metrics = dict(zip(algorithm.metric_names, algorithm.gradient_step(algorithm._data.steps), strict=True))
        norms.append([value.item() for name, value in metrics.items() if name.startswith("grad_norm")])
    assert norms[1] == pytest.approx(norms[0], rel=1e-2)


def test_learning_rate_falls_while_a_run_goes_on(tmp_path):
    trainer = Trainer(made(tmp_path, lr=1e-3, final_lr_fraction=0.2))
    for lr in (1e-3, 6e-4):  # two batches in all
        trainer.iterate()
        torch.testing.assert_close(trainer.algorithm.optimizer.param_groups[0]["lr"], torch.tensor(lr))


def test_squashed_normal_is_a_normal_under_tanh():
    loc, scale = torch.randn(1000, 3).double(), torch.rand(1000, 3).double() + 0.1
    squashed = SquashedNormal(loc, scale)
    u = torch.randn(1000, 3).double()
    density = torch.distributions.Normal(loc, scale).log_prob(u) - (1 - u.tanh().square()).log()
    torch.testing.assert_close(squashed.log_prob(u.tanh()), density.sum(-1))
    torch.testing.assert_close(squashed.deterministic_sample, loc.tanh())
    drawn = squashed.rsample((500,)).clamp(-1 + 1e-12, 1 - 1e-12).atanh()
    torch.testing.assert_close(drawn.mean(), loc.mean(), atol=0.01, rtol=0)
    torch.testing.assert_close(drawn.std(0).mean(), scale.mean(), atol=0.01, rtol=0)


def test_a_process_may_compile_more_often_than_torch_lets_one_function():
    """It keeps eight versions of one. The error of what it cannot trace names the way out."""
    sizes = range(1, 11)
    doubled = [compiled(lambda x: 2 * x, "it", backend="eager")(torch.ones(size)) for size in sizes]
    assert [len(x) for x in doubled] == list(sizes)
    with pytest.raises(TypeError, match="cannot trace what is asked; train with compile=False"):
        compiled(lambda x: 2 * x if x.sum() > 0 else x, "what is asked", backend="eager")(torch.ones(2))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_shuffled_steps_are_the_same_steps(device):
    """Of entries of any type and length, NaN too."""
    kinds = torch.float32, torch.bfloat16, torch.bool, torch.int64, torch.uint8
    entries = {f"{kind}": torch.randn(50, 3).mul(9.0).to(kind) for kind in kinds}
    entries |= {"row": torch.randn(50), "picture": torch.randn(50, 7, 5).to(torch.float16)}
    steps = TensorDict(entries, [50]).to(device)
    steps["row"][::3] = torch.nan
    order = torch.randperm(50, device=device)[:33]
    chosen = Packed(steps)[order]
    for key, entry in steps.items():
        torch.testing.assert_close(chosen[key], entry[order], rtol=0, atol=0, equal_nan=True)
