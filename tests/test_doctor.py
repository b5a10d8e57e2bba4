"""The doctor: finds what is here, and does not overlook what is wrong."""

import re

import pytest
import torch

import torchrl_loco
from torchrl_loco import cli, doctor


def test_healthy(capsys):
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    for subject in ("torch ", "mujoco-warp", "kernel cache", "walker on cpu", "humanoid on cpu"):
        assert subject in out
    assert "NOT RIGHT" not in out


def wrong_physics(env):
    env.sim.model.opt.gravity.fill_(0.0)


def not_finite(env):
    env.sim.model.opt.gravity.fill_(float("nan"))


@pytest.mark.parametrize("spoil", [wrong_physics, not_finite])
def test_ill(capsys, monkeypatch, spoil):
    make = doctor.make

    def spoilt(*args, **kwargs):
        env = make(*args, **kwargs)
        spoil(env)
        return env

    monkeypatch.setattr(doctor, "make", spoilt)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(SystemExit, match="1"):
        cli.main(["doctor"])
    assert capsys.readouterr().out.count("NOT RIGHT") == 2


@pytest.mark.slow
def test_size(capsys):
    """What is advised is enough, and a good deal less leads to losses."""
    assert cli.main(["doctor", "--size", "humanoid_run", "--num_envs", "32", "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    advice = {name: int(re.search(rf"{name} .* (\d+) advised", out)[1]) for name in ("njmax", "naconmax")}
    env = torchrl_loco.make("humanoid_run", 32, "cpu", seed=1, on_overflow="ignore", **advice)
    env.rollout(200)
    assert env.health()["total", "constraint_overflow"] == env.health()["total", "contact_overflow"] == 0
    env = torchrl_loco.make("humanoid_run", 32, "cpu", seed=1, on_overflow="ignore", njmax=advice["njmax"] // 3)
    env.rollout(200)
    assert env.health()["total", "constraint_overflow"] > 0


def test_size_of_what_is_not_there(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["doctor", "--size", "humanoid_rum"])
    assert "did you mean 'humanoid_run'" in capsys.readouterr().err
