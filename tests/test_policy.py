"""Policies on disk: small, exact enough, and safe to load."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

import torchrl_loco
from torchrl_loco import storage
from torchrl_loco.policy import SHIPPED, ObservationNorm, Policy

INFO = {"task": "walker_stand", "protocol": "playground", "action_repeat": 2, "mean": 12.5}


@pytest.fixture
def policy():
    torch.manual_seed(0)
    norm = ObservationNorm(24)
    norm.update(torch.randn(1000, 24) * 100 + 7)
    network = nn.Sequential(norm, nn.Linear(24, 32), nn.LayerNorm(32), nn.SiLU(), nn.Linear(32, 6), nn.Tanh())
    return Policy(network, INFO)


def test_round_trip(policy, tmp_path):
    policy.save(tmp_path / "policy.safetensors")
    again = Policy.load(tmp_path / "policy.safetensors", "cpu")
    assert again.info == INFO
    env = torchrl_loco.make("walker_stand", 16, "cpu", seed=0)
    td = env.reset()
    torch.testing.assert_close(again(td.clone())["action"], policy(td.clone())["action"], atol=1e-3, rtol=0)
    assert env.rollout(3, again)["action"].abs().max() <= 1


def test_others_may_read_what_they_may_read_of_any_file(policy, tmp_path):
    (tmp_path / "any").touch()
    policy.save(tmp_path / "policy.safetensors")  # safetensors' own writer would keep it private
    assert (tmp_path / "policy.safetensors").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_a_write_that_breaks_off_leaves_what_was_there(policy, tmp_path, monkeypatch):
    def disk_full(path, data):
        with path.open("wb") as file:
            file.write(data[:100])
        raise OSError("no space left")

    path = tmp_path / "policy.safetensors"
    policy.save(path)
    before = path.read_bytes()
    monkeypatch.setattr(Path, "write_bytes", disk_full)
    with pytest.raises(OSError, match="no space left"):
        policy.save(path)
    assert path.read_bytes() == before


def test_what_cannot_be_read_is_told(policy, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no policy"):
        Policy.load(tmp_path / "none.safetensors", "cpu")
    path = tmp_path / "policy.safetensors"
    path.write_bytes(b"no tensors at all")
    with pytest.raises(ValueError, match="cannot be read as a policy"):
        Policy.load(path, "cpu")
    policy.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="cannot be read as a policy"):
        Policy.load(path, "cpu")
    save_file({"0.mean": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match="its format is None"):
        Policy.load(path, "cpu")
    storage.save(path, "policy", {"0.weight": torch.zeros(3)}, {"layers": ["os.system"], "info": {}})
    with pytest.raises(ValueError, match=r"unknown layer 'os.system'"):
        Policy.load(path, "cpu")


def test_unknown_task():
    with pytest.raises(ValueError, match="did you mean 'walker_walk'"):
        torchrl_loco.load_policy("walker_wlak")


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.safetensors")), ids=lambda path: path.stem)
def test_shipped_policies(path):
    """Each is small, belongs to its task, and earns what it is said to earn."""
    assert path.stat().st_size < 1e6
    policy = torchrl_loco.load_policy(path.stem, "cpu")
    assert policy.info["task"] == path.stem
    env = torchrl_loco.make(path.stem, 4, "cpu", seed=1, protocol=policy.info["protocol"])
    returns = env.rollout(1000, policy)["next", "reward"].sum(dim=1)
    assert returns.mean() > policy.info["mean"] - 3 * policy.info["std"] - 20


def test_another_bodys_observations_are_refused(policy):
    env = torchrl_loco.make("humanoid_walk", 2, "cpu", seed=0)
    with pytest.raises(Exception, match="takes observations of 24 numbers, got 67"):
        env.rollout(1, policy)
