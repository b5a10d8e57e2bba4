"""What the physics drops is counted and reported, and the setting that the message advises mends it.

The engine ``compiled`` has no settings for room; what it drops is in ``tests/sim/test_compiled.py``.
"""

import gc
import re
import warnings

import pytest
import torch
from cases import COARSE, COMPILED, PROTOCOLS
from for_each import for_each
from mujoco_warp import OverflowType
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco import PhysicsOverflowError, PhysicsOverflowWarning
from torchrl_loco.envs import monitors
from torchrl_loco.sim import Overflow

WORLDS, INTERVAL = 2, 40


@pytest.fixture(autouse=True)
def reported_soon(monkeypatch):
    monkeypatch.setattr(monitors, "INTERVAL", INTERVAL)


def made(device, engine="mujoco_warp", **options):
    """Makes worlds, under MuJoCo-Warp with two physics steps in a control step: recording each takes long."""
    coarse = COARSE if engine == "mujoco_warp" else {}
    return torchrl_loco.make("humanoid_stand", WORLDS, device, seed=0, engine=engine, **{**coarse, **options})


def fall(env, steps=35):
    """Lets the first world fall from its start, and keeps the other in the air."""
    td = env.reset()
    state = env.get_state()
    state["qpos"][1:, 2] = 50.0
    td = env.reset(state, set_state=True)
    for _ in range(steps):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape, device=env.device)))["next"]
    return env.health()


def test_dropped_constraints_are_counted_in_their_world_and_contacts_in_all():
    found = fall(made("cpu", njmax=5, on_overflow="ignore", sim_dt=0.005))
    counts = found["worlds", "constraint_overflow"].tolist()
    assert counts[0] > 20
    assert counts[1:] == [0]
    assert found["total", "constraint_overflow"] == counts[0]
    assert found["total", "contact_overflow"] == 0
    assert found["peak", "constraints"] > 5
    assert found["worlds"].batch_size == torch.Size([WORLDS])

    found = fall(made("cpu", naconmax=2, on_overflow="ignore"))
    assert found["total", "contact_overflow"] > 20
    assert found["peak", "contacts"] > 2


BITS = {
    OverflowType.NEFC: "constraint_overflow",
    OverflowType.NJMAX_NNZ: "constraint_overflow",
    OverflowType.BROADPHASE: "contact_overflow",
    OverflowType.NARROWPHASE: "contact_overflow",
    OverflowType.CCD: "contact_overflow",
    OverflowType.ITERATIONS: "iteration_limit",
    OverflowType.LS_ITERATIONS: "line_search_limit",
    Overflow.UNSOLVED: "solver_failure",
}


def test_each_bit_counts_once_and_in_its_world(engine):
    """In the air, where nothing is dropped: a bit that a physics step sets counts in this control step alone."""
    env = made("cpu", engine, protocol="dm_control", on_overflow="ignore")
    env.reset()
    state = env.get_state()
    state["qpos"][:, 2] = 50.0
    td = env.reset(state, set_state=True)
    before = env.health()["worlds"]
    for bits, counter in BITS.items():
        env.sim.overflow[1] = int(bits)
        for _ in range(2):
            td = env.step(td.set("action", env.action_spec.zero()))["next"]
        now = env.health()["worlds"]
        counts = {name: count.tolist() for name, count in (now - before).items() if count.any()}
        assert counts == {counter: [0, 1]}
        before = now


def test_peaks_hold_for_all_steps():
    """A lying capsule has two contacts in one pair, limbs that pass each other have none: both need room."""
    env = made("cpu", sim_dt=0.005)
    td, contacts, pairs, rows = env.reset(), [0], [0], [0]
    for _ in range(60):
        td = env.step(td.set("action", env.action_spec.zero()))["next"]
        contacts.append(int(env.sim.data.nacon.numpy()[0]))
        pairs.append(int(env.sim.data.ncollision.numpy()[0]))
        rows.append(int(env.sim.data.nefc.numpy().max()))
        peak = env.health()["peak"]
        assert peak["contacts"] >= max(contacts + pairs)
        assert peak["constraints"] >= max(rows)
    assert any(some > max(pairs[: i + 1]) for i, some in enumerate(contacts))
    assert max(rows) > rows[-1]


@pytest.mark.slow
@for_each("field", ["njmax", "naconmax"])
def test_the_advice_is_enough(field):
    env = made("cpu", **{field: 2})
    fall(env)
    with pytest.warns(PhysicsOverflowWarning, match=rf"pass {field}=\d+") as caught:
        env.world.health.check()
    (advice,) = {int(re.search(rf"{field}=(\d+)", str(warning.message))[1]) for warning in caught}
    env = made("cpu", **{field: advice}, on_overflow="raise")
    assert fall(env)["total", "constraint_overflow"] == 0
    env.world.health.check()


def test_an_overflow_is_noticed_while_stepping_or_ignored(device):
    env = made(device, njmax=5, on_overflow="raise")
    fall(env, INTERVAL - 1)
    if env.device.type == "cuda":
        torch.cuda.synchronize()
    with pytest.raises(PhysicsOverflowError, match="njmax="):
        env.rollout(INTERVAL + 1)
    env = made(device, njmax=5, on_overflow="ignore")
    assert fall(env, INTERVAL + 1)["total", "constraint_overflow"] > 0
    env.world.health.check()


def test_overflows_are_reported_again_once_there_are_ten_times_as_many():
    def dropped():
        return int(env.health()["total", "constraint_overflow"])

    env = made("cpu", njmax=5)
    td = env.reset()
    while not (first := dropped()):
        td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
    with pytest.warns(PhysicsOverflowWarning):
        env.world.health.check()
    while dropped() < 10 * first:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.world.health.check()
        td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
    with pytest.warns(PhysicsOverflowWarning):
        env.world.health.check()


def test_nothing_is_reported_if_nothing_was_dropped(shared, engine):
    for protocol in PROTOCOLS:
        env = shared("humanoid_stand", WORLDS, protocol=protocol, engine=engine, on_overflow="raise")
        env.rollout(INTERVAL + 1)
        env.world.health.check()
        found = env.health()
        assert found["total", "constraint_overflow"] == found["total", "contact_overflow"] == 0
        if engine == "mujoco_warp":
            assert 0 < found["peak", "constraints"] <= env.config.njmax
        if protocol == "playground":
            assert found["total", "iteration_limit"] > 0


@pytest.mark.slow
def test_bodies_that_lie_on_the_floor_lose_hardly_a_contact():
    """Under ``compiled``, whose places are fixed: flat on their backs or faces, bodies touch the floor everywhere."""
    for task in COMPILED:
        env = torchrl_loco.make(task, 16, "cpu", seed=0, protocol="dm_control", on_overflow="ignore")
        td = env.reset()
        for _ in range(120):
            td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
        share = 1e-3 if task == "humanoid_run" else 0.0
        assert env.health()["total", "contact_overflow"] <= share * 16 * 120, task


def test_worlds_that_are_not_finite_are_counted(engine):
    env = made("cpu", engine)
    action = env.action_spec.zero()
    action[1, 0] = float("nan")
    for _ in range(3):
        env.step(TensorDict({"action": action}, batch_size=[WORLDS], device=env.device))
    assert env.health()["worlds", "non_finite"].tolist() == [0, 3]


def test_an_error_that_nobody_can_catch_becomes_a_warning():
    """In the garbage collector nothing can be raised, but the strictest setting must not be silent."""

    def leave():
        fall(made("cpu", njmax=5, on_overflow="raise"), 20)
        gc.collect()

    with pytest.warns(RuntimeWarning, match="njmax="):
        leave()
