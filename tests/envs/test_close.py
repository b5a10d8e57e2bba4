"""Closing an environment frees its memory; a reset opens it again."""

import gc
import weakref

import pytest
import torch
from cases import COARSE
from compare import assert_repeats, played
from for_each import for_each

import torchrl_loco

WORLDS = 4


def made(device="cpu", seed=0, **options):
    return torchrl_loco.make("walker_walk", WORLDS, device, seed, episode_length=6, **COARSE, **options)


def test_closed_means_closed():
    env = made()
    td = env.reset()
    env.close()
    env.close()
    assert env.is_closed
    for use in (
        lambda: env.step(td.set("action", torch.zeros(WORLDS, 6))),
        lambda: env.world,
        lambda: env.sim,
        env.health,
        env.get_state,
        env.render,
        env.state_dict,
    ):
        with pytest.raises(RuntimeError, match=r"this WalkerWalk is closed: reset\(\) opens it again"):
            use()
    mask = torch.tensor([[True], [False], [False], [False]])
    with pytest.raises(ValueError, match="reset all worlds"):
        env.reset(td.set("_reset", mask))
    assert env.mj_model.nu == 6
    env.set_seed(7)
    assert torch.equal(env.reset()["observation"], made(seed=7).reset()["observation"])


def test_reset_opens_it_again(device, tmp_path, actions):
    """As it was when it was made, but its random streams go on."""
    options = {"reward_terms": True, "nan_dump": tmp_path / "dump"}
    env, never_closed = made(device, **options), made(device)
    moves = actions(env, 8)
    for other in (env, never_closed):
        played(other, moves)
    env.close()
    assert_repeats(played(env, moves), played(never_closed, moves))
    assert env.health()["total", "non_finite"] == 0
    assert not env.is_closed
    env.step(env.reset().set("action", torch.full_like(moves[0], float("nan"))))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    env.reset()  # although the file exists now


def test_a_failed_opening_leaves_nothing_behind(actions, monkeypatch):
    env, never_closed = made(), made()
    moves = actions(env, 8)
    for other in (env, never_closed):
        played(other, moves)
    env.close()
    with monkeypatch.context() as broken:
        broken.setattr(type(env), "pose_func", lambda self, world: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.reset()
    env.close()
    assert env.is_closed
    assert_repeats(played(env, moves), played(never_closed, moves))


@pytest.mark.slow
def test_nothing_holds_on_to_a_closed_environment(engine):
    for way in ("close", "del"):
        env = made(engine=engine)
        env.rollout(3)
        env.render(width=16, height=12)
        held = [weakref.ref(thing) for thing in (env.world, env.sim, env.sim.data, env.world.outputs)]
        if way == "close":
            env = torchrl_loco.TransformedEnv(env)
            env.close()
        else:
            del env
        gc.collect()
        assert [ref() for ref in held] == [None] * len(held), way


def test_an_environment_that_is_dropped_reports_as_if_closed(tmp_path):
    held = [made(nan_dump=tmp_path / "dump")]
    held[0].step(held[0].reset().set("action", torch.full((WORLDS, 6), torch.nan)))

    def drop():
        held.clear()
        gc.collect()

    with pytest.warns(torchrl_loco.NonFiniteWarning):
        drop()
    assert (tmp_path / "dump").exists()


@pytest.mark.gpu
@for_each(("engine", "num_envs"), [("compiled", 2**18), ("mujoco_warp", 4096)])
def test_close_frees_device_memory(engine, num_envs, cuda_memory):
    def live():
        env = torchrl_loco.make("humanoid_walk", num_envs, "cuda", 0, engine=engine)
        env.rollout(3)
        return env

    live().close()  # loads what stays loaded
    before = cuda_memory()
    left = []
    for _ in range(3):
        env = live()
        taken = cuda_memory() - before
        env.close()
        left.append(cuda_memory() - before)
    assert taken > 200 * 2**20
    assert left[0] < taken / 2  # the bounds of the specs are kept
    assert left[2] <= left[0]
