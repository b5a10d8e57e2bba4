"""world_offset: worlds keep their place in a larger whole, whichever process steps them."""

import functools
import multiprocessing
import warnings

import pytest
import torch
from cases import COARSE, KINDS, STAGGERED, coarse
from for_each import for_each
from torchrl.envs import EnvCreator, ParallelEnv

import torchrl_loco

WHOLE, OFFSET, PART = 4, 1, 2


# Under MuJoCo-Warp on CUDA the order of sums depends on the number of worlds.
@for_each("task, protocol, engine", cpu=[kind for kind in KINDS if kind[2] == "compiled"], cuda=KINDS[:1])
def test_an_offset_draws_what_these_worlds_of_a_larger_environment_draw(
    shared, actions, task, protocol, engine, device
):
    """To the bit, across several episodes that do not end together."""
    options = {"protocol": protocol, "engine": engine, **STAGGERED, **coarse(task)}
    whole = shared(task, WHOLE, device, 5, **options)
    part = shared(task, PART, device, 5, world_offset=OFFSET, **options)
    rows = slice(OFFSET, OFFSET + PART)
    moves, td, part_td = actions(whole, 20), whole.reset(), part.reset()
    assert torch.equal(part_td["observation"], td["observation"][rows])
    for action in moves:
        current, td = whole.step_and_maybe_reset(td.set("action", action))
        part_current, part_td = part.step_and_maybe_reset(part_td.set("action", action[rows]))
        assert (part_current == current[rows]).all()
    assert (part.get_state() == whole.get_state()[rows]).all()


def test_a_state_of_other_worlds_is_refused(shared):
    state = shared("walker_run", 1, **COARSE).state_dict()
    shared("walker_run", 1, world_offset=0, **COARSE).load_state_dict(state)  # None means 0
    with pytest.raises(ValueError, match="world_offset=0, this environment has 4"):
        shared("walker_run", 1, world_offset=4, **COARSE).load_state_dict(state)


def test_a_seed_without_an_offset_is_warned_of_in_one_of_several_ranks(monkeypatch):
    make = functools.partial(torchrl_loco.make, "walker_run", 1, "cpu", **COARSE)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 1)
    make(0)  # silent: warnings are errors here
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    with pytest.warns(UserWarning, match="world_offset=k"):
        make(0)
    make(0, world_offset=0)
    make()


def test_a_seed_without_an_offset_is_logged_in_a_worker(monkeypatch, caplog):
    """TorchRL's workers silence warnings."""
    make = functools.partial(torchrl_loco.make, "walker_run", 1, "cpu", **COARSE)
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: object())
    with pytest.warns(UserWarning, match="world_offset=k"):
        make(0)
    assert not caplog.records
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make(0, world_offset=0)
        make()
        assert not caplog.records
        make(0)
    assert "world_offset=k" in caplog.text


@pytest.mark.slow
def test_parallel_env():
    """Two workers with offsets collect what one environment of all worlds collects."""
    make = functools.partial(torchrl_loco.make, "walker_walk", 3, "cpu", 0, episode_length=6, **COARSE)
    workers = [EnvCreator(functools.partial(make, world_offset=0)), EnvCreator(functools.partial(make, world_offset=3))]
    env = ParallelEnv(2, workers, mp_start_method="fork")
    try:
        td = env.rollout(4)
    finally:
        env.close()
    assert td.shape == (2, 3, 4)
    whole = torchrl_loco.make("walker_walk", 6, "cpu", 0, episode_length=6, **COARSE)
    steps = iter(td["action"].reshape(6, 4, 6).unbind(1))
    expected = whole.rollout(4, lambda td: td.set("action", next(steps)))
    assert torch.equal(td["next", "observation"].reshape(6, 4, 24), expected["next", "observation"])
    assert not torch.equal(td["observation"][0], td["observation"][1])
