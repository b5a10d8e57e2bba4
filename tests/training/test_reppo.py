"""REPPO's parts against values computed by hand."""

import math

import pytest
import torch
from for_each import for_each
from small_runs import WALKER, collected
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_loco.training import Spaces, preset
from torchrl_loco.training.actor import deterministic_policy
from torchrl_loco.training.reppo import REPPO, kl, sample


def observed(reppo, batch):
    return reppo.norms["observation"](batch["observation"])


def distribution(reppo, batch):
    return reppo.distribution(observed(reppo, batch))


def made(spaces=WALKER, **overrides):
    settings = {"num_envs": 1, "num_steps": 4, "minibatch_size": 4, "total_frames": 10_000, "epochs": 1, **overrides}
    torch.manual_seed(0)
    return REPPO(preset("walker_stand", "cpu", "reppo", hidden=(32,), **settings), spaces)


def test_critic_begins_at_zero():
    reppo = made()
    value, _ = reppo.critic.value_and_features(torch.randn(50, 24), torch.rand(50, 6))
    assert value.max() < 1.0


def test_soft_returns_by_hand():
    """Four steps of one world: an ordinary one, a truncated one, a terminated one, an ordinary one."""
    gamma, lmbda, temperature = 0.9, 0.8, 0.5
    reppo = made(gamma=gamma, lmbda=lmbda, reward_scale=2.0, init_temperature=temperature)
    log_prob = torch.tensor([[-1.0, -2.0, -3.0, -4.0]])
    reppo._nets.sample = lambda loc, scale, noise: (torch.zeros(1, 4, 6), log_prob)
    reppo._nets.value_and_features = lambda observation, action: (observation[..., 0], torch.zeros(1, 4, 32))
    reward, next_value = torch.tensor([0.5, 0.25, 1.0, 0.75]), torch.tensor([2.0, 5.0, 7.0, 6.0])
    truncated = torch.tensor([False, True, False, False])
    terminated = torch.tensor([False, False, True, False])
    after = torch.zeros(1, 4, 24)
    after[0, :, 0] = next_value
    zeros = {name: torch.zeros(1, 4, 6) for name in ("action", "loc", "scale")}
    td = TensorDict(
        {
            "observation": torch.zeros(1, 4, 24),
            **zeros,
            "next": {
                "observation": after,
                "reward": reward.view(1, 4, 1),
                "done": (truncated | terminated).view(1, 4, 1),
                "terminated": terminated.view(1, 4, 1),
            },
        },
        batch_size=[1, 4],
    )
    with torch.no_grad():
        data = reppo.prepare(td)
    g3 = 2 * 0.75 + gamma * (6.0 + temperature * 4.0)
    g2 = 2 * 1.0  # nothing follows a termination, no entropy either
    g1 = 2 * 0.25 + gamma * (5.0 + temperature * 2.0)  # at the time limit, the terminal observation's value follows
    g0 = 2 * 0.5 + gamma * (temperature * 1.0 + (1 - lmbda) * 2.0 + lmbda * g1)
    torch.testing.assert_close(data["returns"], torch.tensor([[g0, g1, g2, g3]]))
    assert data["alive"].tolist() == [[1.0, 1.0, 0.0, 1.0]]


def test_negative_returns_are_learned_with_bins_below_zero():
    """With bins from zero on, the critic's value of what earns -1 at each step stays at zero."""
    found = []
    for low in (0.0, -20.0):
        reppo = made(num_envs=8, num_steps=8, minibatch_size=64, lr=1e-2, min_value=low, max_value=20.0, gamma=0.5)
        batch = collected(reppo, 8)
        batch["next", "reward"].fill_(-10.0)
        for _ in range(60):
            reppo.update(batch, progress=0.0)
        with torch.no_grad():
            found.append(reppo.critic.value_and_features(observed(reppo, batch), batch["action"])[0].mean())
    assert found[0] > -1.0
    assert -11.5 < found[1] < -8.5


def test_returns_beyond_the_bins_are_counted_and_said():
    """Of four returns two are beyond: a third one is within a bin of the end."""
    reppo = made(min_value=-10.0, max_value=10.0, num_bins=21)
    data = TensorDict({"returns": torch.tensor([-14.0, 3.0, 10.5, 12.0])}, batch_size=[4])
    metrics = dict(zip(reppo.batch_metric_names, reppo.batch_metrics(data).tolist(), strict=True))
    assert metrics == {"return_min": -14.0, "return_max": 12.0, "return_clipped": 0.5}
    note = reppo.note({name: [value, 0.0] for name, value in metrics.items()})
    assert "Returns from -14 to 12 occurred" in note
    assert "from -10 to 10 and cut off up to 50.00% of a batch: pass --min_value -21 --max_value 18" in note
    assert reppo.note({"return_min": [-10.9], "return_max": [10.9], "return_clipped": [0.0]}) == ""
    wide = made(min_value=-20.0, max_value=20.0, num_bins=21)
    assert wide.batch_metrics(data)[2] == 0.0


@pytest.mark.slow
def test_updates_raise_what_is_rewarded():
    """Rewarded for the first joint alone, the actor moves that joint."""
    reppo = made(num_envs=64, num_steps=8, minibatch_size=128, epochs=8, lr=1e-3, gamma=0.5, reward_scale=10.0)
    for _ in range(16):
        batch = collected(reppo, 64)
        batch["next", "reward"] = batch["action"][..., :1] + 1.0
        reppo.update(batch, progress=0.0)
    mean = torch.tanh(batch["loc"]).mean(dim=(0, 1))
    assert mean[0] > 0.5
    assert mean[1:].mean().abs() < mean[0] / 2


def test_nothing_is_predicted_beyond_a_termination():
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128)
    with torch.no_grad():
        data = reppo.prepare(collected(reppo, 16)).reshape(-1)
    data["features"][::2] = 1e3
    assert reppo.critic_step(data)[1] > 1e5
    data["alive"][::2] = 0.0
    assert reppo.critic_step(data)[1] < 10.0


def test_the_actor_returns_where_the_kl_bound_is_exceeded():
    """With a bound that is always exceeded, the critic's gradient counts for nothing."""
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128, kl_bound=1e-12, init_kl_weight=1.0, lr=1e-3)
    batch = collected(reppo, 16)
    batch["loc"] += 0.3  # as if the policy that collected had been another
    before = kl(batch["loc"], batch["scale"], *distribution(reppo, batch)).mean()
    data = reppo.prepare(batch).detach().reshape(-1)
    reppo._nets.value_and_features = lambda observation, action: (1e6 * action.sum(-1), None)
    for _ in range(20):
        reppo.actor_step(data)
    after = kl(batch["loc"], batch["scale"], *distribution(reppo, batch)).mean()
    assert after < before / 2


@for_each(("slope", "temperature"), [(1.0, 1e-6), (0.0, 1.0)])
def test_the_actor_ascends_value_and_entropy(slope, temperature):
    """Within the bound: towards larger actions if the critic prefers them; if it prefers none, towards any action."""
    settings = {"kl_bound": 1e6, "init_temperature": temperature, "min_temperature": 1e-9}
    reppo = made(num_envs=8, num_steps=8, minibatch_size=64, lr=1e-2, **settings)
    batch = collected(reppo, 8)
    with torch.no_grad():
        data = reppo.prepare(batch).reshape(-1)
    reppo._nets.value_and_features = lambda observation, action: (slope * action.sum(-1), None)

    def now():
        torch.manual_seed(1)
        loc, scale = distribution(reppo, batch)
        return loc.mean().item() if slope else -sample(loc, scale, torch.randn_like(loc))[1].mean().item()

    before = now()
    for _ in range(10):
        reppo.actor_step(data)
    assert now() > before + 0.1


def test_the_critic_learns_to_predict_features_as_much_as_asked():
    fallen = []
    for coeff in (0.0, 100.0):
        reppo = made(num_envs=8, num_steps=8, minibatch_size=64, lr=1e-3, aux_coeff=coeff)
        with torch.no_grad():
            data = reppo.prepare(collected(reppo, 8)).reshape(-1)
        losses = [reppo.critic_step(data)[1].item() for _ in range(20)]
        fallen.append(losses[-1] / losses[0])
    assert fallen[1] < 0.7 * fallen[0]


def test_dual_variables_rise_while_their_constraint_is_violated():
    """Too little entropy raises the temperature, too much divergence the weight of the divergence, and the reverse."""
    for target_entropy, kl_bound, rises in ((5.0, 1e-12, True), (-50.0, 100.0, False)):
        reppo = made(num_envs=16, num_steps=8, minibatch_size=128, target_entropy=target_entropy, kl_bound=kl_bound)
        batch = collected(reppo, 16)
        batch["loc"] += 0.3  # as if the policy that collected had been another
        reppo.update(batch, progress=0.0)
        assert (reppo.dual.temperature > reppo.config.init_temperature) == rises
        assert (reppo.dual.kl_weight > reppo.config.init_kl_weight) == rises


def test_target_entropy_is_that_of_each_entry_of_an_action():
    """Six entries, so that a third of the entropy for each is twice the entropy, too much or, if negative, enough."""
    batch = collected(made(num_envs=16, num_steps=8, minibatch_size=128), 16)
    entropy = -sample(batch["loc"], batch["scale"], torch.randn(16, 8, 6))[1].mean().item()
    assert abs(entropy) > 0.3
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128, target_entropy=entropy / 3)
    reppo.update(batch, progress=0.0)
    assert (reppo.dual.temperature > reppo.config.init_temperature) == (entropy > 0)


def test_the_actors_step_leaves_the_critic_alone():
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128)
    batch = collected(reppo, 16)
    with torch.no_grad():
        data = reppo.prepare(batch).reshape(-1)
    before = {name: value.clone() for name, value in reppo.critic.state_dict().items()}
    reppo.actor_step(data)
    assert all(torch.equal(value, before[name]) for name, value in reppo.critic.state_dict().items())
    assert all(parameter.grad is None for parameter in reppo.critic.parameters())


def test_a_temperature_that_has_fallen_rises_again():
    """With too little entropy its logarithm grows by the learning rate at every step, however small it is."""
    low = {"init_temperature": 1e-8, "min_temperature": 1e-9}
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128, target_entropy=50.0, lr=1e-2, **low)
    batch = collected(reppo, 16)
    with torch.no_grad():
        data = reppo.prepare(batch).reshape(-1)
    for _ in range(100):
        reppo.actor_step(data)
    assert reppo.dual.temperature > 1e-8 * math.exp(0.8 * 100 * 1e-2)


def test_weights_do_not_fall_below_their_minima():
    """Both would: there is more entropy than the target, and less divergence than the bound."""
    floors = {"init_temperature": 0.02, "min_temperature": 0.02, "init_kl_weight": 0.03, "min_kl_weight": 0.03}
    reppo = made(num_envs=16, num_steps=8, minibatch_size=128, target_entropy=-50.0, kl_bound=50.0, **floors)
    reppo.update(collected(reppo, 16), progress=0.0)
    weights = torch.stack([reppo.dual.temperature, reppo.dual.kl_weight]).detach()
    torch.testing.assert_close(weights, torch.tensor([0.02, 0.03]), rtol=1e-6, atol=0)


def test_unbounded_actions_are_bounded_by_a_setting():
    """The critic sees them in [-1, 1]; a saved policy gives what the actor does, which is checked as it is made."""
    reppo = made(Spaces(24, 6, bounded=False), action_bound=3.0)
    batch = TensorDict({"observation": 10.0 * torch.randn(200, 24)}, [200])
    with set_exploration_type(ExplorationType.RANDOM):
        batch = reppo.actor(batch).detach()
    assert 2.9 < batch["action"].abs().max() <= 3.0
    batch["next"] = TensorDict({"observation": batch["observation"], "reward": torch.zeros(200, 1)}, [200])
    batch["next", "done"] = batch["next", "terminated"] = torch.zeros(200, 1, dtype=torch.bool)
    torch.testing.assert_close(3.0 * reppo.prepare(batch.unsqueeze(-1))["action"].squeeze(-2), batch["action"])
    assert 1.0 < deterministic_policy(reppo.actor, reppo.config, {}).module(batch["observation"]).abs().max() <= 3.0
