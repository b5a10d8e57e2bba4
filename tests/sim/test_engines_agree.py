"""One control step of each body under both engines, and against C MuJoCo in float64, from states of rollouts."""

import mujoco
import numpy as np
import pytest
import torch
from cases import COMPILED, ENGINES, MODELS, PROTOCOLS

import torchrl_loco
from torchrl_loco import State
from torchrl_loco.sim import models
from torchrl_loco.sim.simulation import set_options

pytestmark = pytest.mark.slow

WORLDS, AGES = 80, (10, 30, 50, 80)


@pytest.fixture(scope="module", params=COMPILED)
def states(request):
    """A task of each body, and states of worlds that begin, fall and lie, with an action for each."""
    env = torchrl_loco.make(request.param, WORLDS, "cpu", seed=0, protocol="dm_control", stagger=True)
    generator, td, found = torch.Generator().manual_seed(0), env.reset(), []
    for step in range(1, AGES[-1] + 1):
        td = td.set("action", torch.rand(env.action_spec.shape, generator=generator) * 2 - 1)
        td = env.step(td)["next"].exclude("reward")
        if step in AGES:
            found.append(env.get_state())
    action = torch.rand(len(AGES) * WORLDS, env.action_spec.shape[-1], generator=generator) * 2 - 1
    return request.param, torch.cat(found), action


def after(env, state, action):
    """Returns the positions after one control step, ``(num_envs, nq)``."""
    td = env.reset(State(dict(state.items()), batch_size=len(state)), set_state=True)
    env.step(td.set("action", action))
    return env.get_state()["qpos"].double().numpy()


def of_c_mujoco(env, state, action):
    """Returns the same from C MuJoCo, and the share of worlds that touch something."""
    model = models.load(MODELS[env.body])
    set_options(model, env.config)
    data, rows, touching = mujoco.MjData(model), [], 0
    for world in range(len(state)):
        mujoco.mj_resetData(model, data)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(data, name)[:] = state[name][world]
        data.ctrl[:] = action[world]
        for _ in range(env.config.substeps):
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
        touching += data.ncon > 0
    return np.array(rows), touching / len(state)


def assert_agree(ours, theirs):
    """Positions differ by rounding, except where rounding takes a solver to another branch: in one world at most."""
    error = np.abs(ours - theirs)
    assert np.quantile(error, 0.95) < 1e-6
    assert (error.max(axis=1) > 1e-4).sum() <= 1


@pytest.mark.parametrize("states", ["walker_run", "humanoid_run"], indirect=True)
def test_both_engines_agree(shared, states):
    few = slice(None, None, 4 if states[0] == "walker_run" else 8)
    task, state, action = states[0], states[1][few], states[2][few]
    for protocol in PROTOCOLS:
        envs = {engine: shared(task, len(state), protocol=protocol, engine=engine) for engine in ENGINES}
        found = {engine: after(env, state, action) for engine, env in envs.items()}
        if task == "walker_run":
            assert_agree(*found.values())
            continue
        if protocol == "dm_control":  # but for frames of steep capsules, which MuJoCo-Warp does not align
            error = np.abs(found["compiled"] - found["mujoco_warp"]).max(axis=1)
            assert np.median(error) < 1e-6
            assert np.quantile(error, 0.95) > 1e-5
            continue
        # Four iterations rarely converge. By lanes, the first one guesses the active rows, and what is left is less.
        many = {"iterations": 50, "ls_iterations": 50}
        converged = after(shared(task, len(state), protocol=protocol, engine="compiled", **many), state, action)
        ours, theirs = (np.abs(found[engine] - converged).max(axis=1) for engine in ENGINES)
        assert ours.mean() < 0.5 * theirs.mean()
        assert np.quantile(ours, 0.95) < 0.75 * np.quantile(theirs, 0.95)


def test_converged_steps_agree_with_c_mujoco(shared, states):
    task, state, action = states
    env = shared(task, len(state), protocol="dm_control")
    expected, touching = of_c_mujoco(env, state, action)
    assert touching > 0.5
    assert_agree(after(env, state, action), expected)
