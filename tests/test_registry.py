"""make() and everything that can be wrong with what it is given."""

import dataclasses

import pytest
import torch

import torchrl_loco
from torchrl_loco import SimConfig, ids, list_envs, make, registry
from torchrl_loco.config import DEFAULTS, sim_config

EXPECTED = {
    "walker": {"nu": 6, "obs": 24, "ctrl_dt": 0.025, "sim_dt": 0.0025, "naconmax": 50_000, "njmax": 100},
    "humanoid": {"nu": 21, "obs": 67, "ctrl_dt": 0.025, "sim_dt": 0.005, "naconmax": 200_000, "njmax": 250},
}


def test_six_environments():
    assert list_envs()[:6] == [f"{body}_{goal}" for body in ("walker", "humanoid") for goal in ("stand", "walk", "run")]


def test_ids_are_those_of_the_classes_and_say_what_they_ask_for():
    """Two tables, because an id and what it asks for are told without the seconds that its class takes to import."""
    assert {name: cls.__doc__.split("\n")[0] for name, cls in registry.ENVS.items()} == ids.OURS


def test_classes_aliases_and_sizes(task):
    env = make(f"mjx/{task}-v0", 2, "cpu")
    name = "".join(part.capitalize() for part in task.split("_"))
    assert type(env) is getattr(torchrl_loco, name)
    expected = EXPECTED[env.body]
    assert env.action_spec.shape == (2, expected["nu"])
    assert env.observation_spec["observation"].shape == (2, expected["obs"])
    assert env.mj_model.nu == expected["nu"]
    assert env.batch_size == (2,)
    assert env.batch_locked


@pytest.mark.parametrize("body", EXPECTED)
def test_defaults(body):
    for protocol in ("playground", "dm_control"):
        config = sim_config(DEFAULTS[body], protocol, 2048, {})
        for field in ("ctrl_dt", "sim_dt", "naconmax", "njmax"):
            assert getattr(config, field) == EXPECTED[body][field]
        assert config.episode_length == 1000
    cut = {"walker": (2, 5), "humanoid": (4, 8)}[body]
    playground, dm_control = (sim_config(DEFAULTS[body], name, 2048, {}) for name in ("playground", "dm_control"))
    assert (playground.iterations, playground.ls_iterations, playground.euler_damping) == (*cut, False)
    assert (dm_control.iterations, dm_control.ls_iterations, dm_control.euler_damping) == (100, 50, True)


def test_every_field_can_be_overridden():
    changed = {
        "ctrl_dt": 0.05,
        "sim_dt": 0.005,
        "naconmax": 777,
        "njmax": 60,
        "iterations": 3,
        "ls_iterations": 4,
        "euler_damping": True,
        "episode_length": 11,
        "deterministic": True,
    }
    assert set(changed) == {field.name for field in dataclasses.fields(SimConfig)}
    env = make("walker_walk", 2, "cpu", **changed)
    assert dataclasses.asdict(env.config) == changed
    assert env.sim.data.naconmax == 777
    assert env.sim.data.njmax == 60
    assert env.sim.substeps == 10
    assert env.rollout(20).shape == (2, 11)


def test_naconmax_grows_with_the_worlds():
    small, large = (make("walker_stand", n, "cpu").sim.data.naconmax for n in (2048, 4096))
    assert (small, large) == (50_000, 100_000)
    assert make("walker_stand", 1, "cpu").config.naconmax == 1024


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"id": "walker_wlak"}, ValueError, "did you mean 'walker_walk'.*humanoid_run"),
        ({"id": "cheetah"}, ValueError, "choose one of walker_stand"),
        ({"id": None}, ValueError, "choose one of walker_stand"),
        ({"num_envs": 0}, ValueError, "num_envs must be an integer of at least 1, got 0"),
        ({"num_envs": -3}, ValueError, "at least 1"),
        ({"num_envs": 2.5}, TypeError, "num_envs must be an integer, got 2.5"),
        ({"num_envs": "8"}, TypeError, "num_envs must be an integer"),
        ({"num_envs": True}, ValueError, "num_envs must be an integer of at least 1"),
        ({"device": "cuda:77"}, ValueError, "no device 'cuda:77' here: choose one of cpu"),
        ({"device": "gpu"}, ValueError, "no device 'gpu' here: choose one of cpu"),
        ({"device": 5}, ValueError, "choose one of cpu"),
        ({"seed": -1}, ValueError, r"seed must lie in \[0, 2\*\*32\), got -1"),
        ({"seed": 2**32}, ValueError, "seed must lie in"),
        ({"seed": 0.5}, TypeError, "seed must be an integer"),
        ({"protocol": "brax"}, ValueError, "choose one of playground, dm_control"),
        ({"ctrl_td": 0.1}, ValueError, "unknown setting 'ctrl_td', did you mean 'ctrl_dt'.*episode_length"),
        ({"ctrl_dt": 0.003}, ValueError, "ctrl_dt .* must be a whole multiple of sim_dt"),
        ({"ctrl_dt": 0.001}, ValueError, "whole multiple"),
        ({"ctrl_dt": float("nan")}, ValueError, "ctrl_dt must be positive and finite"),
        ({"sim_dt": 0.0}, ValueError, "sim_dt must be positive and finite"),
        ({"sim_dt": "fast"}, TypeError, "sim_dt must be of type float"),
        ({"njmax": 0}, ValueError, "njmax must be positive"),
        ({"naconmax": 1.5}, TypeError, "naconmax must be of type int"),
        ({"iterations": True}, TypeError, "iterations must be of type int"),
        ({"ls_iterations": -1}, ValueError, "ls_iterations must be positive"),
        ({"euler_damping": 1}, TypeError, "euler_damping must be True or False"),
        ({"episode_length": 0}, ValueError, "episode_length must be positive"),
        ({"episode_length": 2**31}, ValueError, r"episode_length must be less than 2\*\*31"),
    ],
)
def test_wrong_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        make(**{"id": "walker_walk", "device": "cpu", **arguments})


def test_wrong_shapes_and_cameras():
    env = make("walker_walk", 2, "cpu")
    td = env.reset()
    with pytest.raises(ValueError, match=r"action must have shape \(2, 6\), got \(2, 1\)"):
        env.step(td.set("action", torch.zeros(2, 1)))
    with pytest.raises(ValueError, match="choose one of side, back, egocentric"):
        env.render("front")
    with pytest.raises(ValueError, match="width must be an integer of at least 1"):
        env.render(width=0)


def test_moving_to_another_device_is_refused(monkeypatch):
    env = make("walker_walk", 2, "cpu")
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match=r"choose one of cpu|cannot move"):
        env.to("cuda:5")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)  # also where there is one
    with pytest.raises(ValueError, match="lives on cpu and cannot move"):
        env.to("cuda:0")
