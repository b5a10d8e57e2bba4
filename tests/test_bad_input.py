"""Malformed input is refused with a message, before anything is allocated, and nothing is worse for it afterwards."""

import contextlib
import math
import random

import pytest
import torch
from compare import assert_same
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco import nan_dump, storage
from torchrl_loco.envs import access
from torchrl_loco.envs.monitors import NAN_DUMP
from torchrl_loco.known_files import UnnamedFileError
from torchrl_loco.policy import Policy, shipped_policies

BAD = {
    "num_envs": (2.5, TypeError),
    "device": ("tpu", ValueError),
    "seed": (2**32, ValueError),
    "protocol": ("brax", ValueError),
    "world_offset": (-1, ValueError),
    "reward_terms": ("yes", TypeError),
    "stagger": (1, TypeError),
    "randomize": (3, TypeError),
    "compile_hooks": (1, TypeError),
    "play": ("yes", TypeError),
    "metrics": (1, TypeError),
    "observation_terms": ("all", TypeError),
    "noise_scale": (-1.0, ValueError),
    "on_overflow": ("shout", ValueError),
    "nan_dump": ("no/such/folder/file", ValueError),
    "from_pixels": (1, TypeError),
    "pixels_only": (True, ValueError),
    "camera": ("side", ValueError),
    "size": ((84, 84), ValueError),
    "depth": (-1.0, ValueError),
    "ctrl_dt": (0.003, ValueError),
    "sim_dt": (0.0, ValueError),
    "naconmax": (1.5, TypeError),
    "njmax": (0, ValueError),
    "iterations": (True, TypeError),
    "ls_iterations": (-1, ValueError),
    "euler_damping": (1, TypeError),
    "episode_length": (2**31, ValueError),
    "deterministic": (None, TypeError),
    "engine": ("compield", ValueError),
    "integrator": ("eular", ValueError),
    "contacts": ("floor", ValueError),
    "solids_on_terrain": ("cubes", ValueError),
}


def test_every_argument_is_checked(monkeypatch):
    monkeypatch.setattr(access, "World", None)  # nothing is made before
    for name, (value, error) in BAD.items():
        with pytest.raises(error, match=name):
            torchrl_loco.make("walker_walk", **{"num_envs": 2, "device": "cpu", name: value})


def test_unknown_arguments_and_ids():
    for wrong, meant in [("num_env", "num_envs"), ("njmx", "njmax"), ("world_ofset", "world_offset")]:
        with pytest.raises(ValueError, match=f"unknown argument '{wrong}', did you mean '{meant}'"):
            torchrl_loco.make("walker_walk", device="cpu", **{wrong: 3})
    for wrong in ("walker_wlak", "mjx/walker_wlak-v0"):
        with pytest.raises(ValueError, match=r"did you mean '(mjx/)?walker_walk.*humanoid_run"):
            torchrl_loco.make(wrong)
        with pytest.raises(ValueError, match=r"did you mean '(mjx/)?walker_walk"):
            torchrl_loco.load_policy(wrong)
    for wrong in ("", "walker", "../walker_walk"):
        with pytest.raises(ValueError, match="choose one of cheetah_run"):
            torchrl_loco.make(wrong)
    with pytest.raises(ValueError, match=r"Policy\.load\('runs/policy\.safetensors'\)"):
        torchrl_loco.load_policy("runs/policy.safetensors")


@pytest.fixture
def env(shared):
    return shared("walker_run", 3)


def test_actions(env):
    td = env.reset()
    with pytest.raises(KeyError, match="step needs an 'action'"):
        env.step(td)
    for shape in ((3, 1), (3, 5), (3, 6, 1)):
        with pytest.raises(ValueError, match=r"action must have shape \(3, 6\), got"):
            env.step(td.clone().set("action", torch.zeros(shape)))
    for shape in ((), (6,), (1, 6), (6, 3)):
        with pytest.raises(ValueError, match=r"action must have shape \(3, 6\), got"):
            env._step(TensorDict({"action": torch.zeros(shape)}, batch_size=[]))
    assert env.rollout(2).shape == (3, 2)


def test_masks(env):
    td = env.reset()
    part = td.clone().set("action", torch.zeros(3, 6))
    with pytest.raises(TypeError, match=r"'_step' must be .* bool, got torch\.float32"):
        env._step(part.set("_step", torch.ones(3, 1)))
    with pytest.raises(ValueError, match=r"'_step' must have shape \(3, 1\), got \(2,\)"):
        env._step(TensorDict({"action": torch.zeros(3, 6), "_step": torch.ones(2, dtype=torch.bool)}))
    before = env.get_state()
    with pytest.raises(TypeError, match=r"'_reset' must be .* bool, got torch\.float32"):
        env.reset(td.set("_reset", torch.ones(3, 1)))
    assert (env.get_state() == before).all()


def test_pictures(env):
    for argument, value, error in [
        ("camera", "front", ValueError),
        ("width", 0, ValueError),
        ("height", 1.5, TypeError),
        ("worlds", env.num_envs + 1, ValueError),
    ]:
        with pytest.raises(error, match="choose one of side, back, egocentric" if argument == "camera" else argument):
            env.render(**{argument: value})


def test_moving_and_casting(env, monkeypatch):
    assert env.to("cpu") is env.to(torch.device("cpu")) is env
    with pytest.raises(ValueError, match="choose one of cpu"):
        env.to("cuda:5")
    with pytest.raises(TypeError, match=r"float32.*DTypeCastTransform"):
        env.to(torch.float64)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)  # as on a machine with CUDA
    with pytest.raises(ValueError, match="lives on cpu and cannot move"):
        env.to("cuda:0")


def damaged(data, chance):
    """Returns the bytes of a file of which some are missing, changed or added."""
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


def assert_damage_is_noticed(path, load, kind, times=100):
    """A file of another length is refused by what it should have been; no damage raises another error.

    A damaged name may be that of a file, which then is not run.
    """
    whole, chance = path.read_bytes(), random.Random(0)
    for _ in range(times):
        path.write_bytes(data := damaged(whole, chance))
        noticed = pytest.raises(ValueError, match=f"cannot be read as a {kind}")
        with noticed if len(data) != len(whole) else contextlib.suppress(ValueError, UnnamedFileError):
            load()
    path.write_bytes(whole)
    return load()


def test_damaged_policies(tmp_path):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(shipped_policies("playground")["walker_walk"].read_bytes())
    assert_damage_is_noticed(path, lambda: Policy.load(path, "cpu"), "policy")


def test_damaged_nan_dumps(tmp_path):
    path = tmp_path / "dump.safetensors"
    env = torchrl_loco.make("walker_walk", 2, "cpu", 0, nan_dump=path)
    env.step(TensorDict({"action": torch.full((2, 6), math.nan)}, batch_size=[2]))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    assert_damage_is_noticed(path, lambda: nan_dump.load(path), "NaN dump")
    tensors, settings = storage.load(path, NAN_DUMP)
    del settings["env"]
    storage.save(path, NAN_DUMP, tensors, settings)
    with pytest.raises(ValueError, match="settings lack env"):
        nan_dump.load(path)


def test_damaged_checkpoints(tmp_path):
    from torchrl_loco.training import RunFolder, Trainer, preset

    small = {"num_envs": 2, "num_steps": 4, "minibatch_size": 8, "epochs": 1, "hidden": (8,), "total_frames": 32}
    run = RunFolder.create(preset("walker_stand", "cpu", "ppo", out=tmp_path, video_seconds=0.0, **small))
    Trainer(run).save()
    path, chance = run.path / "checkpoint.pt", random.Random(0)
    whole, refusals, expected = path.read_bytes(), 0, run.load_checkpoint("cpu")
    for _ in range(100):
        path.write_bytes(damaged(whole, chance))
        try:
            found = run.load_checkpoint("cpu")
        except ValueError:
            refusals += 1
        else:
            assert_same(found, expected)  # what fills gaps was damaged
    assert refusals > 90
    path.write_bytes(whole)
    run.load_checkpoint("cpu")
