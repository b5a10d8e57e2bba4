"""From an id to an environment with the documented settings. Plug-ins are in test_extending.py."""

import dataclasses

import pytest

import torchrl_loco
from torchrl_loco import SimConfig, list_envs, make, registry
from torchrl_loco.config import DEFAULTS, sim_config

EXPECTED = {
    "walker": {"nu": 6, "obs": 24, "ctrl_dt": 0.025, "sim_dt": 0.0025, "naconmax": 50_000, "njmax": 100},
    "humanoid": {"nu": 21, "obs": 67, "ctrl_dt": 0.025, "sim_dt": 0.005, "naconmax": 200_000, "njmax": 250},
    "hopper": {"nu": 4, "obs": 15, "ctrl_dt": 0.02, "sim_dt": 0.005, "naconmax": 50_000, "njmax": 50},
    "quadruped": {"nu": 12, "obs": 78, "ctrl_dt": 0.02, "sim_dt": 0.005, "naconmax": 50_000, "njmax": 100},
    "cheetah": {"nu": 6, "obs": 17, "ctrl_dt": 0.01, "sim_dt": 0.01, "naconmax": 100_000, "njmax": 100},
}
GOALS = {
    "walker": ("stand", "walk", "run"),
    "humanoid": ("stand", "walk", "run"),
    "cheetah": ("run",),
    "hopper": ("stand", "hop"),
    "quadruped": ("walk", "run"),
}


def test_our_environments():
    tasks = [f"{body}_{goal}" for body, goals in GOALS.items() for goal in goals]
    assert list_envs()[: len(tasks)] == tasks == list(registry.OURS)
    for task in tasks:
        cls = registry.env_class(task)
        assert cls is registry.env_class(f"mjx/{task}-v0") is getattr(torchrl_loco, task.title().replace("_", ""))
        # The table has summaries of its own, so that they can be shown without importing the classes.
        assert registry.summary(task) == cls.__doc__.split("\n")[0]
        assert cls.observation_size == EXPECTED[cls.body]["obs"]


@pytest.mark.parametrize("body", EXPECTED)
def test_an_alias_and_sizes(body):
    env = make(f"mjx/{body}_{GOALS[body][-1]}-v0", 2, "cpu")
    assert env.action_spec.shape == (2, EXPECTED[body]["nu"])
    assert env.observation_spec["observation"].shape == (2, EXPECTED[body]["obs"])
    assert env.batch_size == (2,)
    assert env.batch_locked


@pytest.mark.parametrize("body", EXPECTED)
def test_defaults(body):
    for protocol in ("playground", "dm_control"):
        config = sim_config(DEFAULTS[body], protocol, 2048, {})
        for field in ("ctrl_dt", "sim_dt", "naconmax", "njmax"):
            assert getattr(config, field) == EXPECTED[body][field]
        assert config.episode_length == 1000
    cut = {"walker": (2, 5), "humanoid": (4, 8), "cheetah": (4, 8), "hopper": (4, 10), "quadruped": (4, 10)}[body]
    playground, dm_control = (sim_config(DEFAULTS[body], name, 2048, {}) for name in ("playground", "dm_control"))
    damped = body == "quadruped"
    assert (playground.iterations, playground.ls_iterations, playground.euler_damping) == (*cut, damped)
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
        "engine": "mujoco_warp",
    }
    assert set(changed) == {field.name for field in dataclasses.fields(SimConfig)}
    env = make("walker_walk", 2, "cpu", **changed)
    assert dataclasses.asdict(env.config) == changed
    assert env.sim.data.naconmax == 777
    assert env.sim.data.njmax == 60
    assert env.config.substeps == 10
    assert env.rollout(20).shape == (2, 11)


def test_what_torchrl_would_take_from_the_arguments_is_refused():
    """Its ``auto_reset`` is for environments that reset themselves within a step."""
    with pytest.raises(ValueError, match="auto_reset is no argument: step_and_maybe_reset"):
        make("walker_walk", 2, "cpu", auto_reset=True)


def test_limits_without_effect_are_said():
    with pytest.warns(UserWarning, match="njmax and naconmax have no effect: the compiled step"):
        make("walker_walk", 2, "cpu", njmax=50, naconmax=100)


def test_naconmax_grows_with_the_worlds():
    for num_envs, expected in ((1, 1024), (2048, 50_000), (4096, 100_000)):
        assert sim_config(DEFAULTS["walker"], "playground", num_envs, {}).naconmax == expected
    assert make("walker_stand", 100, "cpu", engine="mujoco_warp").sim.data.naconmax == 2442
