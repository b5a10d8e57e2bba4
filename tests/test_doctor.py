"""The doctor: finds what is here, and does not overlook what is wrong."""

import pytest
import torch

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
