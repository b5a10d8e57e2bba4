"""Policies on disk: small, exact enough, and safe to load."""

import errno
import importlib.util
import os

import pytest
import torch
from cases import PROTOCOLS
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn

import torchrl_loco
from torchrl_loco import storage
from torchrl_loco.collector import rewritten_by
from torchrl_loco.policy import ObservationNorm, Policy, in_task, shipped_policies
from torchrl_loco.sim import models
from torchrl_loco.training import evaluate_policy

INFO = {"task": "walker_stand", "protocol": "playground", "action_repeat": 2, "mean": 12.5}


@pytest.fixture(scope="module")
def policy():
    generator = torch.Generator().manual_seed(0)
    norm = ObservationNorm(24)
    norm.update(torch.randn(1000, 24, generator=generator) * 100 + 7)
    network = nn.Sequential(norm, nn.Linear(24, 32), nn.LayerNorm(32), nn.SiLU(), nn.Linear(32, 6), nn.Tanh())
    return Policy(network, INFO)


def test_observations_are_normalised_by_all_that_were_seen():
    batches = [torch.randn(n, 3, 2) * scale + 5 for n, scale in ((1, 1.0), (50, 3.0), (20, 0.1))]
    norm = ObservationNorm(2, limit=2.0)
    norm.update(batches[0][:0])
    for batch in batches:
        norm.update(batch)
    seen = torch.cat(batches).flatten(0, 1)
    norm.update(one := torch.tensor([7.0, -3.0]))
    seen = torch.cat([seen, one[None]])
    torch.testing.assert_close(norm.mean, seen.mean(0))
    torch.testing.assert_close(norm.var, seen.var(0, correction=0))
    assert norm.count == len(seen)
    expected = ((seen - norm.mean) / norm.var.sqrt()).clamp(-2, 2)
    torch.testing.assert_close(norm(seen), expected, rtol=1e-4, atol=1e-4)
    assert norm(seen).max() == 2.0


ACTIVATIONS = [
    *(nn.SiLU(), nn.ELU(), nn.ELU(0.5), nn.ReLU(), nn.LeakyReLU(), nn.LeakyReLU(0.3), nn.Tanh(), nn.GELU()),
    *(nn.GELU("tanh"), nn.Softplus(), nn.Softplus(2.0, 5.0), nn.Mish(), nn.Identity(), nn.ReLU(inplace=True)),
    *(nn.LayerNorm(7), nn.LayerNorm(7, eps=0.5), nn.Sequential(nn.Linear(7, 7, bias=False), nn.ELU())),
]


def test_a_file_holds_what_a_policy_computes(tmp_path):
    """To the bit."""
    for layer in ACTIVATIONS:
        torch.manual_seed(0)
        norm = ObservationNorm(5, limit=2.0)
        norm.update(torch.randn(100, 5) * 3 + 1)
        body = nn.Sequential(nn.Linear(5, 7), layer)
        policy = Policy(nn.Sequential(norm, body, nn.Linear(7, 2)), {"task": "walker_stand"})
        policy.save(tmp_path / "policy.safetensors")
        again, seen = Policy.load(tmp_path / "policy.safetensors", "cpu"), torch.randn(50, 5) * 9
        assert torch.equal(again(observation=seen), policy(observation=seen)), layer
        assert not again.is_bounded


def test_layers_that_a_file_cannot_hold(tmp_path):
    for layer, message in ((nn.Dropout(), "cannot hold Dropout"), (nn.LayerNorm((2, 3)), "over 2 dimensions")):
        policy = Policy(nn.Sequential(ObservationNorm(3), layer), {})
        with pytest.raises(TypeError, match=message):
            policy.save(tmp_path / "policy.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_it_is_called_as_modules_of_tensordict_are(policy, monkeypatch):
    """Which look for pandas at each call; it does not."""
    observation, elsewhere = torch.randn(3, 24), TensorDict(batch_size=3)
    td = TensorDict({"observation": observation}, batch_size=3)
    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", None)
        assert policy(td, tensordict_out=elsewhere) is elsewhere
        assert policy(td) is td
    for action in (td["action"], elsewhere["action"], policy(observation), policy(observation=observation)):
        assert torch.equal(action, policy.module(observation))
    with pytest.raises(KeyError, match="observation"):
        policy(TensorDict())
    assert rewritten_by(policy) == {"action"}


def test_round_trip(policy, shared, tmp_path):
    policy.save(tmp_path / "policy.safetensors", small=True)
    whole = tmp_path / "whole.safetensors"
    policy.save(whole)
    assert whole.stat().st_size > 1.5 * (tmp_path / "policy.safetensors").stat().st_size
    for stored, layer in zip(Policy.load(tmp_path / "policy.safetensors", "cpu").module, policy.module, strict=True):
        if isinstance(layer, nn.Linear):
            error = (stored.weight - layer.weight).abs() / layer.weight.abs().amax(dim=1, keepdim=True)
            assert 0 < error.max() <= 0.5001 / 127
    again = Policy.load(tmp_path / "policy.safetensors", "cpu")
    assert again.info == INFO
    assert not any(parameter.requires_grad for parameter in again.parameters())
    env = shared("walker_run", 16)
    td = env.reset()
    torch.testing.assert_close(again(td.clone())["action"], policy(td.clone())["action"], atol=2e-2, rtol=0)
    assert env.rollout(3, again)["action"].abs().max() <= 1


def test_large_observations_survive_a_file(tmp_path):
    """A variance may be larger than a small file's weights can be exact to."""
    norm, center = ObservationNorm(2), torch.tensor([1e5, 3000.0])
    norm.update(torch.randn(1000, 2) * 1000 + center)
    policy = Policy(nn.Sequential(norm, nn.Linear(2, 1), nn.Tanh()), {})
    policy.save(tmp_path / "policy.safetensors", small=True)
    seen = torch.randn(50, 2) * 1000 + center
    again = Policy.load(tmp_path / "policy.safetensors", "cpu")
    torch.testing.assert_close(again(observation=seen), policy(observation=seen), atol=2e-3, rtol=0)


def test_a_saved_file_has_the_permissions_of_any_file(policy, tmp_path):
    (tmp_path / "any").touch()
    policy.save(tmp_path / "policy.safetensors")  # safetensors' own writer would keep it private
    assert (tmp_path / "policy.safetensors").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_an_interrupted_write_leaves_the_file_as_it_was(policy, tmp_path, monkeypatch):
    def disk_full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "policy.safetensors"
    policy.save(path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(OSError, match=r"No space left.*previous file is kept"):
        policy.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_are_no_policy(policy, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no policy"):
        Policy.load(tmp_path / "none.safetensors", "cpu")
    path = tmp_path / "policy.safetensors"
    path.write_bytes(b"no tensors at all")
    with pytest.raises(ValueError, match="cannot be read as a policy"):
        Policy.load(path, "cpu")
    save_file({"0.mean": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match="its format is None"):
        Policy.load(path, "cpu")
    for layers, tensors, message in [
        (["os.system"], {"0.weight": torch.zeros(3)}, "unknown layer 'os.system'"),
        (["linear"], {}, "'linear' has no tensors"),
        (["layer_norm"], {"0.weight": torch.zeros(3)}, "cannot be read as a policy.*bias"),
        ([["elu", {"beta": 1.0}]], {}, "layer 'elu' has no setting 'beta'"),
    ]:
        storage.save(path, "policy", tensors, {"layers": layers, "info": {}})
        with pytest.raises(ValueError, match=f"(?s){message}"):
            Policy.load(path, "cpu")
    policy.save(path)
    good = path.read_bytes()
    path.write_bytes(good[:-3] + bytes([good[-3] ^ 1]) + good[-2:])
    with pytest.raises(ValueError, match="it is damaged, as its checksum says"):
        Policy.load(path, "cpu")


SHIPPED = [(name, protocol) for protocol in PROTOCOLS for name in shipped_policies(protocol)]


def test_shipped_policies_belong_to_their_task_and_protocol():
    assert {protocol for _, protocol in SHIPPED} == set(PROTOCOLS)
    for name, protocol in SHIPPED:
        policy = torchrl_loco.load_policy(name, "cpu", protocol)
        assert (policy.info["task"], policy.info["protocol"]) == (name, protocol)
        env_class = torchrl_loco.registry.env_class(name)
        nu = models.load(env_class.model).nu
        zeros = torch.zeros(2, len(policy.module[0].mean))
        assert policy(observation=zeros).shape == (2, nu)


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore:contacts were dropped")  # a G1's feet on bumps have more than there is room for
def test_shipped_policies_reach_the_return_that_they_state():
    for name, protocol in SHIPPED:
        policy = torchrl_loco.load_policy(name, "cpu", protocol)
        found = evaluate_policy(policy, 4, seed=1)
        assert found["mean"] > policy.info["mean"] - 3 * policy.info["std"] - 20, (name, protocol)


def test_a_policy_that_was_not_shipped(monkeypatch, tmp_path):
    (tmp_path / "dm_control").mkdir()
    (tmp_path / "dm_control/walker_run.safetensors").touch()
    monkeypatch.setattr("torchrl_loco.policy.SHIPPED", tmp_path)
    with pytest.raises(ValueError, match=r"no policy for 'walker_walk' under .* choose one of walker_run, or train"):
        torchrl_loco.load_policy("walker_walk", "cpu", protocol="dm_control")
    with pytest.raises(ValueError, match="choose one of playground, dm_control"):
        torchrl_loco.load_policy("walker_walk", "cpu", protocol="mjx")


def test_another_bodys_observations_are_refused(policy, shared):
    env = shared("humanoid_run", 2)
    with pytest.raises(Exception, match="takes observations of size 24, got size 67"):
        env.rollout(1, policy)


def test_what_a_policy_earned_is_of_its_task():
    """In another task neither that holds, nor options that it does not have, nor whether it was edited."""
    info = {
        "source_hash": "of the other",
        "protocol": "playground",
        "mean": 12.5,
        "selected_by": 13.0,
        "options": {"future": (1, 2), "speed": 2.0},
    }
    assert in_task(info, "walker_stand", "walker_stand") == {**info, "task": "walker_stand"}
    assert in_task(info, "a.py:Walk", "b.py:Walk~2")["mean"] == in_task(info, "m:WalkerWalk", "walker_walk")["mean"]
    assert in_task(info, "walker_stand", "walker_walk") == {"protocol": "playground", "task": "walker_walk"}
    assert in_task(info, "walker_stand", "g1_tracking")["options"] == {"future": (1, 2)}
