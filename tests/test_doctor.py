"""The doctor reports what is on the machine, and does not miss what is wrong."""

import pytest
import torch

import torchrl_loco
from torchrl_loco import cli, doctor


def test_healthy(capsys):
    """By default it compiles one body, and says so; another one can be named, by one of its tasks too."""
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    for subject in (
        "torch ",
        "mujoco-warp",
        "kernel cache",
        "of walker: compiles",
        "walker on cpu",
        "verdict: every",
    ):
        assert subject in out
    assert "problems" not in out
    assert "humanoid" not in out
    assert cli.main(["doctor", "walker_run"]) == 0
    assert "walker_run on cpu" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        cli.main(["doctor", "humanoit"])
    assert "unknown body or task 'humanoit', did you mean 'humanoid'" in capsys.readouterr().err


@pytest.mark.slow
def test_wrong_physics(capsys, monkeypatch):
    """Of one body it is wrong, of the other not even finite."""
    make = doctor.make

    def spoilt(*args, **kwargs):
        if kwargs.get("engine") == "mujoco":
            return make(*args, **kwargs)
        env = make(*args, **kwargs, engine="mujoco_warp")  # whose model can be changed
        env.sim.model.opt.gravity.fill_(0.0 if env.body == "walker" else float("nan"))
        return env

    monkeypatch.setattr(doctor, "make", spoilt)
    monkeypatch.setattr(doctor, "list_envs", lambda: ["hopper_hop", "walker_walk"])
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(SystemExit, match="1"):
        cli.main(["doctor", "all"])
    out = capsys.readouterr().out
    assert out.count("WRONG: differs") == 2
    assert "verdict: problems with hopper on cpu, walker on cpu" in out


def test_a_body_that_fails_does_not_hide_the_others(monkeypatch):
    def self_test(task, device):
        if task.startswith("walker"):
            raise RuntimeError("no compiler")
        return 0.0, 0.0, "compiled"

    monkeypatch.setattr(doctor, "self_test", self_test)
    findings = {finding.subject: finding for finding in doctor.diagnose("all")}
    assert findings["walker on cpu"].problem
    assert "no compiler" in findings["walker on cpu"].text
    assert not findings["humanoid on cpu"].problem


def test_episodes_that_begin_in_the_floor_are_told():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0, engine="mujoco")
    assert not doctor.starting_contact(env)
    env.sim.qpos[1, 0] -= 0.5
    assert "mm in each other" in doctor.starting_contact(env)


@pytest.mark.slow
def test_size(capsys):
    """What is advised is enough for the same run, and a good deal less drops constraints."""
    sizes = doctor.size("walker_run", 4, "cpu", steps=20)
    assert all(needed < advised < 2 * needed for needed, advised in sizes.values())
    dropped = []
    for share in (1, 3):
        settings = {name: advised // share for name, (_, advised) in sizes.items()}
        settings |= {"engine": "mujoco_warp", "on_overflow": "ignore"}
        env = torchrl_loco.make("walker_run", 4, "cpu", seed=0, world_offset=0, **settings)
        td = env.reset()
        for action in doctor.random_actions(env, range(20)):
            td = env.step(td.set("action", action))["next"]
        dropped.append(int(env.health()["total", "constraint_overflow"] + env.health()["total", "contact_overflow"]))
    assert dropped[0] == 0 < dropped[1]
    with pytest.raises(SystemExit):
        cli.main(["doctor", "--device", "nosuch"])
    assert "--num_envs and --device are for --size" in capsys.readouterr().err
