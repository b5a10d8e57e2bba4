"""What the physics drops is counted, told, and mended by the setting that the message names."""

import gc
import re
import warnings

import pytest
import torch
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco import PhysicsOverflowError, PhysicsOverflowWarning
from torchrl_loco.envs.watcher import INTERVAL

WORLDS = 4


def made(device, **options):
    return torchrl_loco.make("humanoid_stand", WORLDS, device, seed=0, **options)


def fall(env, steps=60):
    """Lets the first world fall down from its start, and keeps the others in the air."""
    td = env.reset()
    state = env.get_state()
    state["qpos"][1:, 2] = 50.0
    td = env.reset(state, set_state=True)
    for _ in range(steps):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape, device=env.device)))["next"]
    return env.health()


def test_constraints_without_room_are_counted_in_their_world(device):
    found = fall(made(device, njmax=5, on_overflow="ignore"))
    counts = found["worlds", "constraint_overflow"].tolist()
    assert counts[0] > 20
    assert counts[1:] == [0, 0, 0]
    assert found["total", "constraint_overflow"] == counts[0]
    assert found["total", "contact_overflow"] == 0
    assert found["peak", "constraints"] > 5
    assert found["worlds"].batch_size == torch.Size([WORLDS])


def test_contacts_without_room_are_counted(device):
    found = fall(made(device, naconmax=2, on_overflow="ignore"))
    assert found["total", "contact_overflow"] > 20
    assert found["peak", "contacts"] > 2


@pytest.mark.parametrize("field", ["njmax", "naconmax"])
def test_the_advice_is_enough(device, field):
    env = made(device, **{field: 2})
    fall(env, 60)
    with pytest.warns(PhysicsOverflowWarning, match=rf"pass {field}=\d+ ") as caught:
        env._health.check()
    (advice,) = {int(re.search(rf"{field}=(\d+)", str(warning.message))[1]) for warning in caught}
    env = made(device, **{field: advice}, on_overflow="raise")
    assert fall(env, 60)["total", "constraint_overflow"] == 0
    env._health.check()


def test_overflow_is_noticed_while_stepping(device):
    env = made(device, njmax=5, on_overflow="raise")
    fall(env, INTERVAL - 1)
    if env.device.type == "cuda":
        torch.cuda.synchronize()
    with pytest.raises(PhysicsOverflowError, match="njmax="):
        env.rollout(INTERVAL + 1)


def test_a_loss_is_told_once(device):
    env = made(device, njmax=5)
    fall(env, 60)
    with pytest.warns(PhysicsOverflowWarning):
        env._health.check()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env._health.check()
    fall(env, INTERVAL - 61)
    with pytest.warns(PhysicsOverflowWarning):
        env._health.check()


def test_no_loss_no_word(device, protocol):
    env = made(device, protocol=protocol, on_overflow="raise")
    env.rollout(2 * INTERVAL + 1)
    env._health.check()
    found = env.health()
    assert found["total", "constraint_overflow"] == found["total", "contact_overflow"] == 0
    assert 0 < found["peak", "constraints"] <= env.config.njmax
    if protocol == "playground":
        assert found["total", "iteration_limit"] > 0


def test_worlds_that_are_not_finite_are_counted(device):
    env = made(device)
    action = env.action_spec.zero()
    action[2, 0] = float("nan")
    for _ in range(3):
        env.step(TensorDict({"action": action}, batch_size=[WORLDS], device=env.device))
    assert env.health()["worlds", "non_finite"].tolist() == [0, 0, 3, 0]


def test_unknown_policy():
    with pytest.raises(ValueError, match="choose one of warn, raise, ignore"):
        made("cpu", on_overflow="shout")


def test_an_error_that_nobody_can_catch_is_a_warning():
    """Left to the garbage collector, the strictest setting is not the most silent one."""

    def leave():
        fall(made("cpu", njmax=5, on_overflow="raise"), 60)
        gc.collect()

    with pytest.warns(RuntimeWarning, match="njmax="):
        leave()
