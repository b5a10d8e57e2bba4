"""Advantages and normalisation against values computed by hand, and what an update does."""

import copy
import dataclasses
import functools
import itertools
import math

import pytest
import torch
from for_each import for_each
from small_runs import WALKER, collected
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from torchrl_loco.training import Spaces, preset
from torchrl_loco.training.actor import deterministic_policy
from torchrl_loco.training.adam import FlatAdam
from torchrl_loco.training.algorithm import clip_and_step
from torchrl_loco.training.ppo import PPO, clipped_loss, standardise
from torchrl_loco.training.rows import are_linear_and_silu


def made(spaces=WALKER, **overrides):
    settings = {"num_envs": 1, "num_steps": 4, "minibatch_size": 4, "total_frames": 10_000, "epochs": 1, **overrides}
    torch.manual_seed(0)
    return PPO(preset("walker_stand", "cpu", "ppo", **settings), spaces)


def test_truncation_bootstraps_and_termination_does_not():
    """Four steps of one world: an ordinary one, a truncated one, a terminated one, an ordinary one."""
    gamma, lmbda = 0.9, 0.8
    ppo = made(gamma=gamma, lmbda=lmbda, reward_scale=2.0)
    ppo._value = lambda rows, weights: rows[..., :1]  # the value is the observation's first entry

    value, next_value = torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([2.0, 5.0, 7.0, 6.0])
    reward = torch.tensor([0.5, 0.25, 1.0, 0.75])
    truncated = torch.tensor([False, True, False, False])
    terminated = torch.tensor([False, False, True, False])
    observation, after = torch.zeros(1, 4, 24), torch.zeros(1, 4, 24)
    observation[0, :, 0], after[0, :, 0] = value, next_value
    td = TensorDict(
        {
            "observation": observation,
            "action": torch.zeros(1, 4, 6),
            "before_tanh": torch.zeros(1, 4, 6),
            "action_log_prob": torch.zeros(1, 4),
            "next": {
                "observation": after,
                "reward": reward.view(1, 4, 1) / 2,
                "done": (truncated | terminated).view(1, 4, 1),
                "terminated": terminated.view(1, 4, 1),
                "truncated": truncated.view(1, 4, 1),
            },
        },
        batch_size=[1, 4],
    )
    with torch.no_grad():
        data = ppo.prepare(td)
    d3 = 0.75 + gamma * 6.0 - 4.0
    d2 = 1.0 - 3.0  # nothing follows a termination
    d1 = 0.25 + gamma * 5.0 - 2.0  # at the time limit, the value of the terminal observation follows
    d0 = 0.5 + gamma * 2.0 - 1.0
    expected = torch.tensor([d0 + gamma * lmbda * d1, d1, d2, d3])
    torch.testing.assert_close(data["advantage"].flatten(), expected)
    torch.testing.assert_close(data["value_target"].flatten(), expected + value)


def test_an_end_that_is_both_counts_as_termination():
    """A world that falls at its time limit earns nothing more."""
    gamma, ppo = 0.9, made(gamma=0.9, num_steps=1, minibatch_size=1, reward_scale=1.0)
    ppo._value = lambda rows, weights: rows[..., :1] * 0 + 3.0
    yes = torch.ones(1, 1, 1, dtype=torch.bool)
    for terminated, expected in ((True, 1.0 - 3.0), (False, 1.0 + gamma * 3.0 - 3.0)):
        ends = {"done": yes, "truncated": yes, "terminated": yes & terminated}
        td = TensorDict(
            {
                "observation": torch.zeros(1, 1, 24),
                "action": torch.zeros(1, 1, 6),
                "before_tanh": torch.zeros(1, 1, 6),
                "action_log_prob": torch.zeros(1, 1),
                "next": {"observation": torch.zeros(1, 1, 24), "reward": torch.ones(1, 1, 1), **ends},
            },
            batch_size=[1, 1],
        )
        with torch.no_grad():
            torch.testing.assert_close(ppo.prepare(td)["advantage"], torch.full((1, 1, 1), expected))


def test_the_critic_reads_what_is_privileged():
    """With a norm of its own; the actor does not see it."""
    spaces, settings = Spaces(24, 6, privileged=5), {"num_envs": 1, "num_steps": 4, "minibatch_size": 4}
    ppo = PPO(preset("walker_stand", "cpu", "ppo", total_frames=10_000, **settings), spaces)
    seen = 100.0 + 7.0 * torch.randn(1, 4, 5)
    td = TensorDict({"observation": torch.randn(1, 4, 24), "privileged": seen}, batch_size=[1, 4])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        td = ppo.acting()(td)
    value = ppo.critic(td.clone())["state_value"]
    flags = {name: torch.zeros(1, 4, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    after = {name: td[name].clone() for name in ("observation", "privileged")}
    td["next"] = TensorDict({**after, "reward": torch.ones(1, 4, 1), **flags}, batch_size=[1, 4])
    ppo.update(td, progress=0.0)
    assert not torch.equal(ppo.critic(td.clone())["state_value"], value)
    torch.testing.assert_close(ppo.norms["privileged"].mean, seen.mean((0, 1)))
    torch.testing.assert_close(ppo.norms["observation"].mean, td["observation"].mean((0, 1)))
    assert ppo.norms["privileged"] in list(ppo.networks.modules())
    changed = td.clone().set("privileged", seen + 50.0)
    assert torch.equal(*(ppo.actor.get_dist(one).deterministic_sample for one in (changed, td)))
    assert not torch.equal(ppo.critic(changed)["state_value"], ppo.critic(td.clone())["state_value"])


@for_each("bounded", [True, False])
def test_what_acts_is_the_actor(bounded):
    """Its densities are those of the actor's distribution; without bounds, actions are normal, and so is the policy."""
    spaces = Spaces(21, 6, bounded=bounded)  # rows that are no multiple of 8
    settings = {
        "num_envs": 1,
        "num_steps": 4,
        "minibatch_size": 4,
        "hidden": (12,),
        "init_std": 0.5 if bounded else 2.0,
    }
    config = preset("walker_stand", "cpu", "ppo", **settings)
    ppo = PPO(config, spaces)
    ppo.norms["observation"].update(3.0 + 2.0 * torch.randn(100, 21))
    ppo.actor[0].module[1][-1].bias.data.fill_(0.5 if bounded else 3.0)
    td = TensorDict({"observation": 3.0 + torch.randn(500, 21)}, batch_size=[500])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        td = ppo.acting()(td)
        distribution = ppo.actor.get_dist(td.clone())
    torch.testing.assert_close(td["action_log_prob"], distribution.log_prob(td["action"]), rtol=1e-4, atol=2e-3)
    assert td["action"].abs().max() <= 1.0 if bounded else td["action"].abs().max() > 5.0
    action = ppo.acting()(td.clone())["action"]  # the mode where no type of exploration is set, as TorchRL's actors
    policy = deterministic_policy(ppo.actor, config, {})
    assert policy.is_bounded == bounded
    torch.testing.assert_close(policy(observation=td["observation"]), action)


@for_each("bounded", [True, False])
def test_gradients_are_those_of_clip_ppo_loss(bounded):
    """Of TorchRL's loss, through networks that torch differentiates; rows of odd lengths are padded."""
    torch.manual_seed(0)
    spaces = Spaces(21, 6, privileged=13, bounded=bounded)
    settings = {"num_envs": 16, "num_steps": 8, "minibatch_size": 128, "hidden": (20, 12), "entropy_coeff": 0.03}
    ppo = PPO(preset("walker_stand", "cpu", "ppo", total_frames=10_000, **settings), spaces)
    theirs = ClipPPOLoss(
        *(ppo.actor, ppo.critic),
        clip_epsilon=ppo.config.clip_epsilon,
        entropy_coeff=0.03,
        critic_coeff=0.5,
        loss_critic_type="smooth_l1",
        normalize_advantage=True,
        functional=False,
        samples_mc_entropy=1,
    )
    td = TensorDict({"observation": torch.randn(128, 21), "privileged": torch.randn(128, 13)}, batch_size=[128])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        td = ppo.acting()(td)
    targets = {"advantage": torch.randn(128, 1), "value_target": 2.0 * torch.randn(128, 1)}
    td.update(targets)
    with torch.no_grad():  # the policy has moved on, so that ratios are clipped
        for parameter in ppo.networks.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    log_prob, action = td["action_log_prob"], td["action"]
    if bounded:
        action = td["before_tanh"]
        log_prob = log_prob + (1.0 - action.tanh().square()).log().sum(-1)
    rows = {key: ppo._read(td, key) for key in ppo.norms}
    data = TensorDict({**rows, **targets, "action": action, "log_prob": log_prob}, batch_size=[128])
    ppo.optimizer.clipped_step = lambda norm: torch.zeros(())
    torch.manual_seed(1)
    metrics = metrics_of(ppo, data)
    (vectors,) = ppo.optimizer._vectors
    ours = vectors.gradient().clone()
    ppo.optimizer.zero_grad()
    torch.manual_seed(1)
    losses = theirs(td)
    sum(losses[name] for name in ("loss_objective", "loss_critic", "loss_entropy")).backward()
    expected = vectors.gradient()
    assert 0.1 < metrics["clip_fraction"] < 0.9
    for name in ppo.metric_names[:-1]:
        torch.testing.assert_close(metrics[name], losses[name].detach(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-4 * expected.abs().max().item())


def test_updates_raise_what_is_rewarded():
    """Rewarded for the first joint alone, the actor moves that joint and leaves the others."""
    ppo, means = made(num_envs=64, num_steps=8, minibatch_size=128, epochs=4, lr=1e-3), []
    for _ in range(6):
        batch = collected(ppo, 64)
        batch["next", "reward"] = batch["action"][..., :1].clone()
        ppo.update(batch, progress=0.0)
        means.append(ppo.actor.get_dist(batch).deterministic_sample.mean(dim=(0, 1)))
    assert means[-1][0] > 0.2
    assert means[-1][1:].abs().max() < means[-1][0] / 2


def metrics_of(ppo, data):
    """Returns what a gradient step says before it is made."""
    (minibatch,) = ppo.minibatches(data.clone())
    return dict(zip(ppo.metric_names, ppo.gradient_step(minibatch), strict=True))


def test_advantages_are_normalised():
    """What is added to all of a minibatch, or multiplies all, changes nothing."""
    ppo = made(num_envs=8, num_steps=8, minibatch_size=64, lr=1e-12)
    with torch.no_grad():
        data = ppo.prepare(collected(ppo, 8)).reshape(-1)
    data["log_prob"] += torch.linspace(-0.1, 0.1, 64)  # as if the policy had moved on
    loss = metrics_of(ppo, data)["loss_objective"]
    data["advantage"] = 1e3 * data["advantage"] + 5e2
    assert loss.abs() > 1e-3
    torch.testing.assert_close(metrics_of(ppo, data)["loss_objective"], loss, rtol=1e-3, atol=0)


def check_standardised(device):
    """Rows of any length, beside other numbers; a row of one has no deviation."""
    for size in (1, 7, 10_000):
        whole = 3.0 + torch.randn(3 * size, 5, device=device)
        numbers, others = whole[:, 1].view(3, size), whole[:, 2:].clone()
        expected = numbers.double() - numbers.double().mean(1, keepdim=True)
        if size > 1:
            expected /= expected.std(1, keepdim=True)
        standardise(numbers)
        torch.testing.assert_close(numbers, expected.float(), rtol=1e-5, atol=1e-5)
        assert torch.equal(whole[:, 2:], others)


def test_rows_are_standardised():
    check_standardised("cpu")


@pytest.mark.gpu
def test_rows_are_standardised_on_cuda():
    check_standardised("cuda")


def test_entropy_is_rewarded():
    """With nothing else to gain, actions spread."""
    settings = {"num_envs": 8, "num_steps": 8, "minibatch_size": 64, "entropy_coeff": 1.0, "init_std": 0.3, "lr": 1e-2}
    for bounded in (True, False):
        ppo = made(dataclasses.replace(WALKER, bounded=bounded), **settings)
        batch = collected(ppo, 8)
        batch["next", "reward"].zero_()
        before = ppo._std().mean().item()
        metrics = dict(zip(ppo.metric_names, ppo.update(batch, progress=0.0), strict=True))
        if not bounded:
            expected = torch.distributions.Normal(0.0, torch.full((6,), 0.3)).entropy().sum()
            torch.testing.assert_close(metrics["entropy"], expected)
        for _ in range(4):
            ppo.update(batch, progress=0.0)
        assert ppo.actor.get_dist(batch).base_dist.stddev.mean() > 1.02 * before


def test_the_critic_learns_the_returns():
    ppo = made(num_envs=8, num_steps=8, minibatch_size=64, lr=3e-3)
    with torch.no_grad():
        data = ppo.prepare(collected(ppo, 8)).reshape(-1)
    losses = [metrics_of(ppo, data)["loss_critic"].item() for _ in range(31)]
    assert losses[-1] < losses[0] / 2


def test_the_ratio_is_clipped_where_the_settings_say():
    objectives = []
    for epsilon in (0.05, 0.2):
        ppo = made(num_envs=8, num_steps=8, minibatch_size=64, clip_epsilon=epsilon)
        with torch.no_grad():
            data = ppo.prepare(collected(ppo, 8)).reshape(-1)
        data["log_prob"] -= 1.0  # as if every action had become e times as likely
        objectives.append(metrics_of(ppo, data)["loss_objective"].item())
    assert objectives[0] != objectives[1]


def test_the_learning_rate_follows_the_divergence():
    """By a half up below half of the target, by a third down beyond twice of it, and not by time."""
    for target, factor in ((1.0, 1.0), (1e3, 1.5), (1e-9, 1 / 1.5)):
        ppo = made(num_envs=8, num_steps=8, minibatch_size=64, target_kl=target, lr=1e-3)
        with torch.no_grad():
            data = ppo.prepare(collected(ppo, 8)).reshape(-1)
        data["log_prob"] += 1.0  # the divergence
        ppo.gradient_step(data)
        ppo.schedule(progress=1.0)
        assert ppo.optimizer.param_groups[0]["lr"].item() == pytest.approx(1e-3 * factor)


def test_an_untrained_actor_hardly_looks_at_the_observation():
    assert made().actor[0].module(torch.randn(200, 24))[0].std(dim=0).mean() < 0.02


def test_metrics_are_means_over_all_gradient_steps():
    ppo = made(num_envs=8, num_steps=8, minibatch_size=16, epochs=3)
    ppo.gradient_step = lambda minibatch: [torch.tensor(2.5)] * len(ppo.metric_names)
    torch.testing.assert_close(ppo.update(collected(ppo, 8), 0.0), torch.full((6,), 2.5))


def test_a_remainder_smaller_than_a_minibatch_is_left_out():
    """Of nine steps, minibatches of four take eight, other ones in each epoch, and none twice in one."""
    ppo, seen = made(num_envs=3, num_steps=3, epochs=2, minibatch_size=4), []
    ppo.gradient_step = lambda minibatch: seen.append(minibatch["observation"]) or [torch.zeros(())] * 6
    ppo.update(collected(ppo, 3), progress=0.0)
    assert [len(minibatch) for minibatch in seen] == [4] * 4
    for epoch in (seen[:2], seen[2:]):
        assert len(torch.cat(epoch).unique(dim=0)) == 8


@for_each("minibatches", [1, 4, 5, 6, 8])
def test_an_epoch_of_several_recordings_takes_each_step_once(minibatches):
    ppo, seen = made(num_envs=3, num_steps=minibatches, epochs=2, minibatch_size=3), []
    ppo.gradient_step = lambda minibatch: seen.append(minibatch["observation"]) or [torch.tensor(2.5)] * 6
    metrics = ppo.update(collected(ppo, 3), progress=0.0)
    for epoch in (seen[:minibatches], seen[minibatches:]):
        assert len(torch.cat(epoch).unique(dim=0)) == 3 * minibatches
    torch.testing.assert_close(metrics, torch.full((6,), 2.5))


def test_the_norm_is_updated_after_the_gradient_steps():
    """Else probabilities would be compared with those that were computed with another norm."""
    ppo, seen = made(num_envs=2, num_steps=4), []
    ppo.gradient_step = lambda minibatch: seen.append(ppo.norms["observation"].count.item()) or [torch.zeros(())] * 6
    ppo.update(collected(ppo, 2), progress=0.0)
    assert (seen, ppo.norms["observation"].count) == ([0.0, 0.0], 8.0)


def test_entries_that_hardly_vary_are_not_blown_up():
    """By a standard deviation that all entries have besides their own."""
    ppo = made(num_envs=2, num_steps=4, norm_eps=0.5)
    td = collected(ppo, 2)
    ppo.update(td, progress=0.0)
    seen = td["observation"].flatten(0, 1)
    torch.testing.assert_close(ppo.norms["observation"].var, seen.var(0, correction=0) + 0.25)


def test_steps_of_vectors_are_those_of_adam():
    """Of several groups, with rows that are padded and parameters that have a gradient of their own."""
    torch.manual_seed(0)
    ours, theirs = ([torch.nn.Parameter(torch.ones(shape)) for shape in ((3, 10), (3,), ())] for _ in range(2))
    optimizers = []
    for kind, parameters in ((FlatAdam, ours), (functools.partial(torch.optim.Adam, fused=True), theirs)):
        groups = [{"params": parameters[:2]}, {"params": parameters[2:], "eps": 1e-2}]
        optimizers.append(kind(groups, lr=torch.tensor(0.1), eps=1e-5))
    for scale in (1.0, 10.0, 0.01, 1.0):  # clipped, and not
        for own, other in zip(ours, theirs, strict=True):
            own.grad = scale * torch.randn(own.shape)
            other.grad = own.grad.clone()
        torch.testing.assert_close(*(clip_and_step(optimizer, 0.5) for optimizer in optimizers))
        optimizers[0].load_state_dict(optimizers[0].state_dict())
    torch.testing.assert_close(ours, theirs)


def test_gradients_are_clipped_to_a_norm():
    parameter = torch.nn.Parameter(torch.zeros(4))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    for length, step in ((6.0, 1.5), (1.0, 1.0)):
        parameter.data.zero_()
        parameter.grad = torch.full((4,), length / 2)
        torch.testing.assert_close(clip_and_step(optimizer, 1.5), torch.tensor(length))
        torch.testing.assert_close(parameter.norm(), torch.tensor(step), rtol=1e-4, atol=0)


def one_update(ppo, **changes):
    """Returns by how much each parameter of the networks moves."""
    before = {name: parameter.detach().clone() for name, parameter in ppo.networks.named_parameters()}
    batch = collected(ppo, 8)
    batch["next"].update(changes)
    ppo.update(batch, progress=0.0)
    return {name: (p.detach() - before[name]).abs().max() for name, p in ppo.networks.named_parameters()}


EIGHT = {"num_envs": 8, "num_steps": 8, "minibatch_size": 64}


def test_what_is_frozen_stays():
    """As the first layers of a network that was trained before."""

    def network(inputs, outputs):
        layers = nn.Sequential(nn.Linear(inputs, 12), nn.ELU(inplace=True), nn.Linear(12, outputs))
        layers[0].requires_grad_(False)
        return layers

    torch.manual_seed(0)
    config = preset("walker_stand", "cpu", "ppo", total_frames=10_000, **EIGHT)
    moved = one_update(PPO(config, WALKER, network))
    for name, by in moved.items():
        assert (by == 0.0) == (".0.weight" in name or ".0.bias" in name), name


@for_each("frozen", [6, 1])
def test_a_frozen_actor_or_critic_stays(frozen):
    """As a critic that learns first, beside an actor that was trained before."""

    def network(inputs, outputs):
        return nn.Sequential(nn.Linear(inputs, 12), nn.Tanh(), nn.Linear(12, outputs)).requires_grad_(outputs != frozen)

    ppo = PPO(preset("walker_stand", "cpu", "ppo", total_frames=10_000, **EIGHT), WALKER, network)
    stays = {6: "actor.module.0.module.1.", 1: "critic."}[frozen]
    moved = one_update(ppo)
    assert any(name.startswith(stays) for name in moved)
    for name, by in moved.items():
        assert (by == 0.0) == name.startswith(stays), name


def test_what_actor_and_critic_share_learns_of_both():
    trunk = nn.Linear(24, 12)

    def network(inputs, outputs):
        return nn.Sequential(trunk, nn.Tanh(), nn.Linear(12, outputs))

    ppo = PPO(preset("walker_stand", "cpu", "ppo", total_frames=10_000, lr=0.01, **EIGHT), WALKER, network)
    sums = []
    for _ in range(4):
        ppo.optimizer.zero_grad()
        ppo.optimizer.wide(torch.float32)[trunk.weight].sum().backward()
        ppo.optimizer.clipped_step(1.0)
        sums.append(trunk.weight.sum().item())
    assert all(after < before for before, after in itertools.pairwise(sums))
    assert all(by > 0.0 for by in one_update(ppo).values())


def test_activations_may_write_in_place():
    def network(inputs, outputs):
        return nn.Sequential(nn.Linear(inputs, 12), nn.ELU(inplace=True), nn.Linear(12, outputs))

    config = preset("walker_stand", "cpu", "ppo", total_frames=10_000, **EIGHT)
    assert all(by > 0.0 for by in one_update(PPO(config, WALKER, network)).values())


def test_parameters_that_were_moved_still_learn():
    ppo = made(**EIGHT)
    ppo.actor.double().float()
    assert all(by > 0.0 for by in one_update(ppo).values())
    assert all(by > 0.0 for by in one_update(copy.deepcopy(ppo)).values())
    shared = nn.Sequential(nn.Linear(24, 6))
    again = PPO(ppo.config, WALKER, lambda inputs, outputs: shared if outputs == 6 else nn.Linear(inputs, outputs))
    again.begin_anew()
    assert all(by > 0.0 for by in one_update(again).values())


class Skipping(nn.Sequential):
    def forward(self, x):
        return super().forward(x) + x[..., :1]


def test_a_critic_may_be_any_module():
    """Also a Sequential that does more than its layers."""
    torch.manual_seed(0)
    config = preset("walker_stand", "cpu", "ppo", total_frames=10_000, **EIGHT)

    def network(inputs, outputs):
        return nn.Linear(inputs, outputs) if outputs == 6 else Skipping(nn.Linear(inputs, 9), nn.Linear(9, 1))

    ppo = PPO(config, WALKER, network)
    seen = torch.randn(20, 24)
    rows = ppo._read(TensorDict({"observation": seen}, [20]), "observation")
    value = ppo._value(rows, ppo.optimizer.wide(torch.float32))
    torch.testing.assert_close(value, ppo.critic.module(seen))
    assert all(by > 0.0 for by in one_update(ppo).values())


def test_a_critic_sees_rows_one_after_the_other():
    """Whose layers may look at the dimensions; advantages and gradient steps are of the same values."""

    def network(inputs, outputs):
        if outputs == 6:
            return nn.Linear(inputs, outputs)
        return nn.Sequential(nn.Linear(inputs, 9), nn.Softmax(dim=1), nn.Linear(9, 1))

    ppo = PPO(preset("walker_stand", "cpu", "ppo", total_frames=10_000, **EIGHT), WALKER, network)
    seen, weights = torch.randn(8, 5, 24), ppo.optimizer.wide(torch.float32)
    torch.testing.assert_close(ppo._values(seen, weights).view(-1, 1), ppo._value(seen.view(-1, 24), weights))


def test_what_is_not_a_number_is_seen():
    """In parameters too, not only in the loss; and it leaves the learning rate alone."""
    ppo = made(**EIGHT, target_kl=0.01)
    lr = ppo.optimizer.param_groups[0]["lr"].item()
    moved = one_update(ppo, reward=torch.full((8, 8, 1), math.nan))
    assert all(by.isnan() for by in moved.values())
    assert ppo.optimizer.param_groups[0]["lr"].item() == pytest.approx(lr)


def test_settings_and_sizes_that_do_not_fit():
    with pytest.raises(ValueError, match="no setting 'weight_decay': choose of lr, eps, betas"):
        made().make_optimizer("other", [{"params": [torch.nn.Parameter(torch.ones(2))], "weight_decay": 0.1}])
    with pytest.raises(TypeError, match=r"torch.float32, not torch.float64"):
        made().make_optimizer("other", [torch.nn.Parameter(torch.ones(2).double())])
    with pytest.raises(ValueError, match="observations of size 24, got size 23"):
        made().acting()(TensorDict({"observation": torch.zeros(3, 23)}, [3]))
    assert made().acting()(TensorDict({"observation": torch.zeros(24)}, []))["action"].shape == (6,)


def test_networks_of_earlier_runs_in_bfloat16_are_read():
    """Those were one level deeper."""
    ppo = made(**EIGHT)
    state = {name.replace("module.1.", "module.1.0."): value + 1.0 for name, value in ppo.networks.state_dict().items()}
    assert state.keys() != ppo.networks.state_dict().keys()
    ppo.load_networks(state)
    for name, value in ppo.networks.state_dict().items():
        torch.testing.assert_close(value, state[name.replace("module.1.", "module.1.0.")])


@pytest.mark.gpu
def test_what_is_computed_beside_is_the_same():
    """On another stream and recorded, to the bit; and in bfloat16 it is nearly what it is in single precision."""
    parameters = {}
    for bf16, beside in ((True, True), (True, False), (False, False)):
        settings = {"num_envs": 256, "num_steps": 8, "minibatch_size": 512, "epochs": 2, "hidden": (64, 32)}
        torch.manual_seed(0)
        ppo = PPO(preset("walker_stand", "cuda", "ppo", bf16=bf16, **settings), Spaces(21, 6, privileged=13))
        ppo._stream = ppo._stream if beside else None
        for iteration in range(5):
            torch.manual_seed(iteration)
            seen = {"observation": torch.randn(256, 8, 21).cuda(), "privileged": torch.randn(256, 8, 13).cuda()}
            td = TensorDict(seen, batch_size=[256, 8]).cuda()
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                td = ppo.acting()(td)
            ends = {name: torch.zeros(256, 8, 1, dtype=torch.bool).cuda() for name in ("done", "terminated")}
            td["next"] = TensorDict({**seen, "reward": td["action"][..., :1].clone(), **ends}, batch_size=[256, 8])
            ppo.update(td, progress=0.0)
        parameters[bf16, beside] = [parameter.clone() for parameter in ppo.networks.parameters()]
    assert all(torch.equal(*pair) for pair in zip(parameters[True, True], parameters[True, False], strict=True))
    for ours, exact in zip(parameters[True, True], parameters[False, False], strict=True):
        torch.testing.assert_close(ours, exact, rtol=0.1, atol=0.01)


@pytest.mark.gpu
@for_each("steps", [7, 100])
def test_the_loss_of_a_warp_is_that_of_its_steps(steps):
    """Threads of a warp add up their numbers, also of a warp that is not full."""
    torch.manual_seed(0)
    rows = {name: torch.randn(steps, size, device="cuda") for name, size in (("mean", 6), ("value", 1), ("action", 6))}
    rows |= {name: torch.randn(steps, 1, device="cuda") for name in ("advantage", "value_target")}
    rows["log_prob"] = torch.full((steps,), -9.0, device="cuda")
    std, config = 0.5 + torch.rand(6, device="cuda"), preset("walker_stand", "cuda", "ppo")

    def loss(which):
        data = {name: values[which] for name, values in rows.items()}
        return clipped_loss(data["mean"], std, data["value"], data, config, bounded=False)

    of_mean, of_std, of_value, metrics = loss(slice(None))
    each = [torch.stack(parts) for parts in zip(*(loss(slice(k, k + 1)) for k in range(steps)), strict=True)]
    for ours, theirs in zip((of_mean, of_value), (each[0], each[2]), strict=True):
        torch.testing.assert_close(ours, theirs[:, 0] / steps, rtol=1e-4, atol=1e-6)
    for ours, theirs in zip((of_std, metrics), (each[1], each[3]), strict=True):
        torch.testing.assert_close(ours, theirs.mean(0), rtol=1e-4, atol=1e-5)


def test_which_networks_triton_computes():
    """Linear layers with SiLU between them, each with a weight and a bias of its own, which get slopes of their own."""
    one, other, silu = nn.Linear(8, 8), nn.Linear(8, 8), nn.SiLU()
    tied = nn.Linear(8, 8)
    tied.weight, tied.bias = one.weight, one.bias
    expected = {
        (one, silu, other): True,
        (one, silu, other, silu, nn.Linear(8, 1)): True,
        (one,): True,
        (one, nn.ReLU(), other): False,
        (one, silu): False,
        (nn.Linear(8, 8, bias=False), silu, other): False,
        (one, silu, tied): False,
        (one, silu, one): False,
        (one, silu, nn.LayerNorm(8), other): False,
    }
    for layers, fits in expected.items():
        parameters = list(nn.Sequential(*layers).parameters())
        assert are_linear_and_silu(layers, parameters) == fits, layers


def test_gradients_in_parts_are_summed_and_forgotten():
    """A step adds them to what autograd gives; none goes into a second step."""
    weight = nn.Parameter(torch.ones(3))
    optimizer = FlatAdam([weight], lr=torch.tensor(0.1))
    ((whole, length),) = [(vectors.whole, len(vectors.whole)) for vectors in optimizer._vectors]
    parts = optimizer.parts(4)
    assert parts.shape == (4, length)
    with torch.no_grad():
        parts[1, :3], parts[3, :3] = 1.0, 2.0
    (weight * torch.tensor([1.0, 0.0, -3.0])).sum().backward()
    torch.testing.assert_close(optimizer.clipped_step(math.inf), torch.tensor([4.0, 3.0, 0.0]).norm())
    torch.testing.assert_close(weight.detach(), torch.tensor([0.9, 0.9, 1.0]), rtol=0, atol=1e-4)
    optimizer.zero_grad()
    assert optimizer.clipped_step(math.inf) == 0.0
    assert optimizer.parts(4) is parts
    assert optimizer.clipped_step(math.inf) > 0.0
    assert whole.grad is None
