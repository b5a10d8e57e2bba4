"""Terms of the observation by name: joined, noisy, with their past, and apart."""

import pytest
import torch
from for_each import for_each
from hook_tasks import Still

from torchrl_loco import Go1Velocity, State, WalkerWalk


class Named(WalkerWalk):
    """Observes heights and velocities by name, in three frames; the critic sees them without noise."""

    memory = {"offset": 2}
    noise = {"pose": (0.1, "offset"), "velocity": 0.5}
    history = {"observation": 3}

    def observation(self, s):
        seen = {"pose": s.qpos[:, :2], "time": s.time, "velocity": s.qvel[:, :4].unflatten(-1, (2, 2))}
        return {"observation": seen, "privileged": seen, "sum": s.qpos.sum(-1, keepdim=True)}

    def begin(self, s):
        return {**super().begin(s), "offset": s.uniform(3.0, 4.0, 2)}

    def terminated(self, s):
        return s.time > 0.25


def steps(env, count, td=None):
    """Returns the observations of a reset and of steps without action, ``(num_envs, count + 1)``, over resets."""
    td = env.reset() if td is None else td
    found = [td.clone()]
    for _ in range(count):
        td = env.maybe_reset(env.step(Still(env)(td))["next"].exclude("reward"))
        found.append(td.clone())
    return torch.stack(found, 1)


@for_each("kernels", [True, False])
def test_terms_are_joined_with_noise_and_history(kernels):
    env = Named(4, "cpu", 0, observation_terms=True, compile_hooks=kernels)
    assert env.observation_layout == {
        "observation": {"pose": 2, "time": 1, "velocity": 4},
        "privileged": {"pose": 2, "time": 1, "velocity": 4},
        "sum": {},
    }
    assert env.observation_spec["observation"].shape == (4, 21)
    found = steps(env, 20)
    assert env.observation_spec.is_in(found[:, 3].select(*env.observation_spec.keys()))
    past, clean = found["observation"].unflatten(-1, (3, 7)), found["privileged"]
    noise = past[:, :, 2] - clean
    offset = noise[..., :2] - (noise[..., :2] - 3.5).clamp(-0.6, 0.6)
    torch.testing.assert_close(offset, torch.full_like(offset, 3.5))
    assert (noise[..., 2] == 0.0).all()
    assert 0.4 < noise[..., 3:].abs().max() <= 0.5
    assert noise[..., 3:].mean().abs() < 0.05
    began = found["privileged"][..., 2] == 0.0
    assert began.sum(1).tolist() == [2, 2, 2, 2]
    for t in range(1, 21):
        fresh, before = began[:, t].view(4, 1, 1), torch.cat([past[:, t - 1, 1:], past[:, t, 2:]], dim=1)
        assert torch.equal(past[:, t], torch.where(fresh, past[:, t, 2:].expand(-1, 3, -1), before))
    apart = found["observation_terms"]
    assert torch.equal(apart["observation", "velocity"], past[:, :, 2, 3:])
    assert torch.equal(apart["privileged", "pose"], clean[..., :2])
    assert set(apart.keys()) == {"observation", "privileged"}


def test_a_state_holds_the_history():
    env = Named(4, "cpu", 0)
    last = steps(env, 7)[:, -1]
    state = env.get_state()
    ahead = steps(env, 20, env.reset(state.clone(), set_state=True))
    assert torch.equal(ahead["observation"][:, 0], last["observation"])
    assert torch.equal(ahead["observation"], steps(env, 20, env.reset(state, set_state=True))["observation"])
    by_hand = State({"qpos": state["qpos"], "qvel": state["qvel"]}, batch_size=[4])
    past = env.reset(by_hand, set_state=True)["observation"].unflatten(-1, (3, 7))
    assert torch.equal(past, past[:, 2:].expand(-1, 3, -1))
    part = torch.tensor([True, False, True, False]).unsqueeze(-1)
    before = steps(env, 5)[:, -1]
    td = Still(env)(before.clone()).set("_step", part)
    after = env.step(td)["next", "observation"]
    assert torch.equal(after[1], before["observation"][1])
    assert not torch.equal(after[0], before["observation"][0])


def test_there_is_no_noise_in_play():
    env = Named(4, "cpu", 0, play=True)
    found = steps(env, 3)
    assert torch.equal(found["observation"][..., -7:], found["privileged"])


def test_robots_name_what_they_see():
    env = Go1Velocity(2, "cpu", 0, observation_terms=True, engine="mujoco", compile_hooks=False)  # nothing is compiled
    seen = env.observation_layout["observation"]
    assert seen["gravity"] == 3
    assert sum(seen.values()) == env.observation_spec["observation"].shape[-1]
    td = env.rollout(3, Still(env))["next"]
    noise = td["observation_terms", "observation", "gravity"] - td["observation_terms", "privileged", "gravity"]
    assert 0.0 < noise.abs().max() <= 0.05


@for_each(
    ("entries", "error", "message"),
    [
        ({"noise": {"poes": 0.1}}, ValueError, "unknown Wrong.noise 'poes', did you mean 'pose'"),
        ({"noise": {"sum": (0.1, "bias")}}, ValueError, "choose one of offset"),
        ({"noise": {"pose": -0.1}}, ValueError, r"noise\['pose'\] must lie in \[0"),
        ({"history": {"observations": 3}}, ValueError, "unknown Wrong.history 'observations'"),
        ({"history": {"observation": 0}}, ValueError, r"history\['observation'\] must lie in \[1"),
        (
            {"memory": {"offset": ()}, "begin": lambda self, s: {}},
            ValueError,
            r"noise\['pose'\]: 'offset' must have the term's shape \(2,\), not \(\)",
        ),
        (
            {"observation": lambda self, s: {"observation": {"pose": s.qpos > 0}}},
            TypeError,
            r"observation\['observation.pose'\] must be of floats",
        ),
        (
            {"observation": lambda self, s: {"observation": {"pose": s.qpos[:2]}}},
            ValueError,
            r"observation\['observation.pose'\] must return shape \(4, 9\)",
        ),
    ],
)
def test_what_is_wrong_is_said(entries, error, message):
    with pytest.raises(error, match=message):
        type("Wrong", (Named,), entries)(4, "cpu", 0)
