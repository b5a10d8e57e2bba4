"""More than a thousand malformed inputs: each is refused with a message, and nothing is worse for it afterwards."""

import dataclasses
import math
import random

import pytest
import torch
from compare import assert_same
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco import RolloutCollector, SimConfig, replay
from torchrl_loco.policy import SHIPPED, Policy
from torchrl_loco.training import PPOConfig, REPPOConfig, RunFolder, Trainer, preset

REFUSALS = (ValueError, TypeError, IndexError, KeyError, RuntimeError, OSError)
NO_COUNT = [0, -1, -(2**40), 2**31, 1.5, math.nan, math.inf, "3", "many", None, True, [], [4], {}, b"4", object(), 1j]
NO_NAME = [
    "",
    " ",
    "walker",
    "WALKER_WALK",
    "walker-walk",
    "walker_walk ",
    "../walker",
    None,
    3,
    1.5,
    True,
    [],
    {},
    b"x",
]
NO_NUMBER = [0.0, -1.0, math.nan, math.inf, -math.inf, "1.0", None, True, [], {}, 1j, object()]
NO_SEED = [-1, 2**32, 2**70, 1.5, math.nan, "0", True, [], {}, object(), 1j, b"0"]
NO_DEVICE = ["tpu", "cuda:99", "cuda:-1", "gpu", "", "cpu:x", 7, 1.5, [], {}, object()]
NO_FLAG = [0, 1, "yes", None, 1.5, [], math.nan]


def refused(call, *args, **kwargs):
    """Asserts that a call raises one of the errors that a user can read, with a message."""
    with pytest.raises(REFUSALS) as caught:
        call(*args, **kwargs)
    assert str(caught.value).strip(), repr(caught.value)


def make_cases():
    for field, bad in {
        "id": NO_NAME,
        "num_envs": [value for value in NO_COUNT if value != 2**31],
        "device": NO_DEVICE,
        "seed": NO_SEED,
        "protocol": NO_NAME,
        "on_overflow": NO_NAME,
        "reward_terms": [*NO_FLAG, "True"],
        "stagger": [*NO_FLAG, "True"],
        "bad_world_file": [3, 1.5, True, [], {}, object(), "/", "no/such/folder/file"],
    }.items():
        yield from ((field, value) for value in bad)
    for field in dataclasses.fields(SimConfig):
        bad = {int: NO_COUNT, float: NO_NUMBER, bool: NO_FLAG}[field.type]
        yield from ((field.name, value) for value in bad)
    yield from ((name, 1) for name in ("njmx", "iteration", "frame_skip", "batch_size", "_device", "solver"))
    yield from (("ctrl_dt", value) for value in (0.001, 0.0251, 1e-9))


@pytest.mark.parametrize(("field", "value"), list(make_cases()))
def test_make(field, value):
    arguments = {"id": "walker_walk", "num_envs": 2, "device": "cpu", "seed": 0}
    refused(torchrl_loco.make, **{**arguments, field: value})


def config_cases():
    for config in (PPOConfig, REPPOConfig):
        for field in dataclasses.fields(config):
            bad = {int: NO_COUNT, float: [math.nan, -math.inf, "1", None, [], {}, 1j, object()]}.get(field.type)
            elsewhere = [value for value in NO_DEVICE if value != "cuda:99"]  # a run may come from such a machine
            bad = {"seed": NO_SEED, "task": NO_NAME, "protocol": NO_NAME, "device": elsewhere}.get(field.name, bad)
            if field.name == "hidden":
                bad = [(), (0,), (64, -1), (1.5,), ("64",), None, 64, (None,)]
            if field.name == "eval_interval":
                bad = [value for value in NO_COUNT if value != 0]
            if bad is not None:
                yield from ((config, field.name, value) for value in bad if value != 2**31)


@pytest.mark.parametrize(("config", "field", "value"), list(config_cases()))
def test_training_settings(config, field, value):
    refused(config, **{"task": "walker_walk", field: value})


SHAPES = [(), (1,), (3,), (9,), (3, 1), (3, 8), (3, 10), (2, 9), (4, 9), (1, 9), (3, 9, 1), (1, 3, 9), (9, 3), (0, 9)]


@pytest.fixture(scope="module")
def env():
    env = torchrl_loco.make("walker_walk", 3, "cpu", seed=0)
    env.reset()
    return env


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("key", ["qpos", "qvel", "qacc_warmstart"])
def test_states_of_a_wrong_shape(env, key, shape):
    state = {name: value.clone() for name, value in env.get_state().items()}
    before = env.get_state()
    refused(lambda: env.reset(TensorDict({**state, key: torch.zeros(shape)}, batch_size=[]), set_state=True))
    assert (env.get_state() == before).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("key", ["qpos", "qvel", "qacc_warmstart"])
def test_states_that_are_not_finite(env, key, bad):
    for index in range(9):
        state, before = env.get_state(), env.get_state()
        state[key][1, index] = bad
        refused(env.reset, state, set_state=True)
        assert (env.get_state() == before).all()


@pytest.mark.parametrize("missing", ["qpos", "qvel"])
def test_states_that_lack_something(env, missing):
    refused(env.reset, env.get_state().exclude(missing), set_state=True)
    refused(env.reset, None, set_state=True)


@pytest.mark.parametrize("shape", [(), (6,), (3,), (3, 5), (3, 7), (2, 6), (4, 6), (1, 6), (3, 6, 1), (6, 3), (0, 6)])
def test_actions_of_a_wrong_shape(env, shape):
    td = env.reset()
    refused(lambda: env.step(td.exclude("action").set("action", torch.zeros(shape))))
    refused(lambda: env._step(TensorDict({"action": torch.zeros(shape)}, batch_size=[])))
    assert env.rollout(2).shape == (3, 2)


@pytest.mark.parametrize("size", [0, -1, 1.5, "64", None, [64]])
@pytest.mark.parametrize("argument", ["width", "height", "camera"])
def test_pictures(env, argument, size):
    refused(env.render, **{argument: size})


@pytest.mark.parametrize("frames", [0, -3, 1, 2, 4, 100, 1.5, "3", None, [], math.nan])
def test_collector(env, frames):
    refused(RolloutCollector, env, lambda td: td, frames_per_batch=frames)


@pytest.mark.parametrize("task", NO_NAME)
def test_policies_by_name(task):
    refused(torchrl_loco.load_policy, task, "cpu")


@pytest.mark.parametrize("world", [3, -4, 100, "1", None, 1.5])
def test_branches(env, world):
    refused(env.get_state().branch, world)


@pytest.mark.parametrize("num_envs", NO_COUNT[:-1])
def test_branches_into_no_number_of_worlds(env, num_envs):
    if num_envs in (None, 2**31):
        pytest.skip("None stands for as many as there are; 2**31 copies are a matter of memory")
    refused(env.get_state().branch, 0, num_envs)


def damaged(data, chance):
    """Returns the bytes of a file with some of them lost, changed or added."""
    kind = chance.choice(["cut", "flip", "insert", "blank"])
    at = chance.randrange(len(data))
    if kind == "cut":
        return data[:at]
    if kind == "flip":
        return data[:at] + bytes([data[at] ^ (1 << chance.randrange(8))]) + data[at + 1 :]
    if kind == "insert":
        return data[:at] + bytes(chance.randrange(1, 9)) + data[at:]
    length = min(len(data) - at, chance.randrange(1, 4096))
    return data[:at] + bytes(length) + data[at + length :]


def test_damaged_policies(tmp_path):
    whole = (SHIPPED / "walker_walk.safetensors").read_bytes()
    path, chance = tmp_path / "policy.safetensors", random.Random(0)
    for _ in range(200):
        path.write_bytes(data := damaged(whole, chance))
        if data != whole:
            refused(Policy.load, path, "cpu")
    path.write_bytes(whole)
    Policy.load(path, "cpu")


def test_damaged_bad_worlds(tmp_path):
    path, chance = tmp_path / "bad.safetensors", random.Random(0)
    env = torchrl_loco.make("walker_walk", 2, "cpu", 0, bad_world_file=path)
    env.step(TensorDict({"action": torch.full((2, 6), math.nan)}, batch_size=[2]))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    whole = path.read_bytes()
    for _ in range(100):
        path.write_bytes(data := damaged(whole, chance))
        if data != whole:
            refused(replay.load, path)
    path.write_bytes(whole)
    replay.load(path)


def test_damaged_checkpoints(tmp_path):
    small = {"num_envs": 2, "decisions": 4, "minibatch_size": 8, "epochs": 1, "hidden": (8,), "total_frames": 32}
    run = RunFolder.create(preset("walker_stand", "cpu", "ppo", out=tmp_path, video_seconds=0.0, **small))
    Trainer(run).save()
    path, chance = run.path / "checkpoint.pt", random.Random(0)
    whole, original, refusals = path.read_bytes(), run.load_checkpoint("cpu"), 0
    for _ in range(200):
        path.write_bytes(damaged(whole, chance))
        try:
            entries = run.load_checkpoint("cpu")
        except ValueError:
            refusals += 1
        else:  # the format pads: what no reader looks at may change
            assert_same(entries, original)
    assert refusals > 100
    path.write_bytes(whole)
    run.load_checkpoint("cpu")


def test_a_step_without_an_action():
    env = torchrl_loco.make("walker_walk", 2, "cpu", 0)
    with pytest.raises(KeyError, match="step needs an 'action'"):
        env.step(env.reset())


@pytest.mark.parametrize("near", ["num_env", "on_overflw", "njmx"])
def test_a_misspelt_argument_is_suggested(near):
    with pytest.raises(ValueError, match=r"did you mean '(num_envs|on_overflow|njmax)'"):
        torchrl_loco.make("walker_walk", device="cpu", **{near: 3})


def test_a_file_is_no_task():
    with pytest.raises(ValueError, match=r"Policy\.load\('runs/policy\.safetensors'\)"):
        torchrl_loco.load_policy("runs/policy.safetensors")
