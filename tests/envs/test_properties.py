"""What holds for every state, action and mask."""

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from cases import BODIES, MODELS, TASKS
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_loco import State

pytestmark = pytest.mark.slow

WORLDS = 5
SETTINGS = hypothesis.settings(
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],  # the environment is shared anyway
)

seeds = st.integers(0, 2**32 - 1)
masks = st.lists(st.booleans(), min_size=WORLDS, max_size=WORLDS).map(torch.tensor)
tasks = st.sampled_from([task for task in TASKS if task != "cheetah_run"])  # whose poses take seconds to settle
bodies = st.sampled_from([task for task in BODIES if task != "cheetah_run"])


@pytest.fixture
def made(shared):
    return lambda task: shared(task, WORLDS, reward_terms=True, on_overflow="ignore")


def states(env, seed, spread):
    """Draws states: the root anywhere near the ground in any orientation, hinges and velocities about ``spread``."""
    rng = np.random.default_rng(seed)
    qpos = rng.uniform(-1, 1, (WORLDS, env.mj_model.nq)) * np.minimum(spread, 3.0)
    if env.body in ("humanoid", "quadruped"):
        quat = rng.normal(size=(WORLDS, 4))
        qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        qpos[:, 2] = rng.uniform(0.1, 2.0, WORLDS)
    qvel = rng.normal(size=(WORLDS, env.mj_model.nv)) * spread
    values = {"qpos": torch.tensor(qpos, dtype=torch.float32), "qvel": torch.tensor(qvel, dtype=torch.float32)}
    return State(values, batch_size=[WORLDS])


@SETTINGS
@hypothesis.given(task=tasks, seed=seeds, spread=st.floats(0, 20), loudness=st.floats(0, 100))
def test_rewards_and_terms(made, task, seed, spread, loudness):
    """Rewards and terms lie in [0, 1] and the terms multiply to the reward, from any state and for any action."""
    env = made(task)
    td = env.reset(states(env, seed, spread), set_state=True)
    action = torch.randn(env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) * loudness
    after = env.step(td.set("action", action))["next"]
    reward, terms = after["reward"], torch.stack(list(after["reward_terms"].values()))
    assert reward.isfinite().all()
    assert after["observation"].isfinite().all()
    assert ((reward >= 0) & (reward <= 1)).all()
    assert ((terms >= 0) & (terms <= 1)).all()
    torch.testing.assert_close(terms.prod(dim=0), reward, atol=1e-6, rtol=1e-5)


@SETTINGS
@hypothesis.given(task=bodies, seed=seeds, spread=st.floats(0, 3))
def test_observation_and_state_are_what_was_set(made, task, seed, spread):
    """get_state after set_state is the identity, and the observation is C MuJoCo's of that state."""
    env = made(task)
    state = states(env, seed, spread)
    td = env.reset(state, set_state=True)
    now = env.get_state()
    assert torch.equal(now["qpos"], state["qpos"])
    assert torch.equal(now["qvel"], state["qvel"])
    reference = oracle.Oracle(task, MODELS[env.body])
    for world in range(WORLDS):
        row = {key: now[key][world].double().numpy() for key in ("qpos", "qvel", "act") if key in now}
        expected = reference.observation(env.protocol, **row)
        rows = (oracle.without_forces(env.body, row) for row in (td["observation"][world], expected))
        np.testing.assert_allclose(*rows, atol=2e-5, rtol=2e-5)


@SETTINGS
@hypothesis.given(task=bodies, seed=seeds, mask=masks, spread=st.floats(0, 3))
def test_masked_reset_touches_only_its_worlds(made, task, seed, mask, spread):
    hypothesis.assume(mask.any())
    env = made(task)
    td = env.reset(states(env, seed, spread), set_state=True)
    td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
    before = env.get_state()
    fresh = env.reset(td.clone().set("_reset", mask.unsqueeze(-1)))
    after = env.get_state()
    for key, value in before.items():
        assert torch.equal(after[key][~mask], value[~mask]), key
    assert torch.equal(fresh["observation"][~mask], td["observation"][~mask])
    assert (after["elapsed_steps"][mask] == 0).all()
    assert (after["episode"][mask] == before["episode"][mask] + 1).all()
    assert (after["qvel"][mask] == 0).all()


@SETTINGS
@hypothesis.given(
    task=bodies, seed=seeds, mask=masks, bad=st.sampled_from([float("nan"), float("inf"), -float("inf"), 1e30])
)
def test_bad_actions_stay_in_their_worlds(made, task, seed, mask, bad):
    """Beside any set of bad worlds, the others do bitwise what they do beside none; 1e30 is clipped."""
    env = made(task)
    state = states(env, seed, 1.0)
    good = torch.rand(env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    spoilt = good.clone()
    spoilt[mask, seed % good.shape[1]] = bad
    results = []
    for action in (good, spoilt):
        env.reset(state, set_state=True)
        td = TensorDict({"action": action}, batch_size=[WORLDS])
        results.append(env.step(td)["next"])
    well, beside = results
    assert (well[~mask] == beside[~mask]).all()
    ends = bad != 1e30
    assert (beside["terminated"].squeeze(-1)[mask] == ends).all()
    assert ((beside["observation"][mask] == 0).all(dim=-1) == ends).all()
    if ends:
        assert (beside["reward"][mask] == 0).all()
