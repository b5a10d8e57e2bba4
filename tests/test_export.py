"""Exported policies do what the policies do, without this package, and say what they are."""

import json
import sys

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each
from torch import nn

import torchrl_loco
from torchrl_loco import cli, export
from torchrl_loco.config import arguments_of
from torchrl_loco.export import TOLERANCE, export_policy, of_robot
from torchrl_loco.policy import ObservationNorm, Policy, check_terms

INFO = {"task": "walker_stand", "protocol": "dm_control", "action_repeat": 2, "mean": 12.5}


def policy(bias=0.0):
    """Returns a policy with a normalisation that matters: without it, the layers would saturate."""
    norm = ObservationNorm(24)
    norm.update(torch.randn(1000, 24, generator=torch.Generator().manual_seed(0)) * 100 + 700)
    network = nn.Sequential(norm, nn.Linear(24, 32), nn.LayerNorm(32), nn.SiLU(), nn.Linear(32, 6), nn.Tanh())
    nn.init.constant_(network[1].bias, bias)
    return Policy(network, INFO)


def read_onnx(path):
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    text = {"task", "protocol", "torchrl_loco", "mjcf"}
    words = {name: fact if name in text else json.loads(fact) for name, fact in facts.items()}
    return lambda seen: session.run(["action"], {"observation": seen.numpy()})[0], words


def read_program(path):
    files = {"metadata.json": ""}
    program = torch.export.load(path, extra_files=files).module()
    return lambda seen: program(seen).numpy(), json.loads(files["metadata.json"])


OF_ROBOT = {
    *("observation", "history", "action_offset", "actuators", "joints", "stiffness", "damping", "force_limit"),
    *("home", "physics_timestep", "mjcf"),
}

FORMATS = [("policy.onnx", read_onnx), ("policy.pt2", read_program)]


@for_each(("name", "read"), FORMATS)
def test_exported_policies_do_the_same(name, read, tmp_path):
    """For any batch; with observations that are clipped; and they say what a robot's program has to know."""
    if name.endswith("onnx"):
        pytest.importorskip("onnxscript")
    original = policy().train()
    error = export_policy(original, tmp_path / name)
    assert original.module.training
    assert all(parameter.requires_grad for parameter in original.parameters())
    assert 0 <= error <= TOLERANCE
    play, facts = read(tmp_path / name)
    for batch in (1, 3, 50):
        seen = torch.randn(batch, 24) * 500 + 700
        expected = original(observation=seen)
        assert expected.std() > 1e-2
        np.testing.assert_allclose(play(seen), expected.detach().numpy(), rtol=0, atol=TOLERANCE)
    assert facts.pop("info") == INFO
    assert facts.pop("action_scale") == [1.0] * 6  # what else is told of the robot, test_verify.py plays
    assert {name: facts[name] for name in facts if name not in OF_ROBOT} == {
        **{"task": "walker_stand", "protocol": "dm_control", "torchrl_loco": torchrl_loco.__version__},
        **{"observation_size": 24, "action_size": 6, "action_low": -1.0, "action_high": 1.0},
        **{"control_timestep": 0.025, "action_repeat": 2},
    }


class Pair(torchrl_loco.LocoEnv):
    """Two bodies that would touch each other."""

    model = """<mujoco><compiler autolimits="true"/><option timestep="0.004" integrator="implicitfast"/><worldbody>
      <geom type="plane" size="0 0 1"/>
      <body pos="0 0 0.5"><joint name="x" type="slide" axis="1 0 0" damping="1" actuatorfrcrange="-6 9"/>
      <geom size="0.1"/></body>
      <body pos="0.15 0 0.5"><joint name="y" type="slide" axis="1 0 0" damping="1"/><geom size="0.1"/></body>
    </worldbody><actuator>
      <motor joint="x" gear="3" ctrlrange="-1 1"/><position joint="y" kp="20" ctrlrange="-1 2" forcerange="-3 8"/>
    </actuator></mujoco>"""
    config = torchrl_loco.SimConfig(ctrl_dt=0.02, sim_dt=0.002, contacts="ground")

    def observation(self, s):
        return torch.cat([s.qpos, s.qvel], -1)

    def reward(self, s):
        return s.qpos[:, 0]


class OtherWay(torchrl_loco.Go1Velocity):
    """Its controls are not those of its facts, which are a class's above."""

    def control(self, s, action):
        return self.home(s) + 0.1 * action


def test_facts_are_those_of_what_is_stepped(tmp_path):
    """The time between control steps is that of the training, so the class of a task need not be there."""
    info = {**INFO, "task": torchrl_loco.registry.task_name(Pair), "protocol": "playground"}
    facts, _ = of_robot(Policy(nn.Sequential(ObservationNorm(4), nn.Linear(4, 2)), info))
    assert (facts["force_limit"], facts["stiffness"]) == ([2.0, 3.0], [0.0, 20.0])
    m = mujoco.MjModel.from_xml_string(facts["mjcf"])
    data, env = mujoco.MjData(m), Pair(1, "cpu", seed=0, engine="mujoco")
    td = env.reset()
    data.qpos[:] = td["observation"][0, :2]
    for _ in range(5):
        td = env.step(td.set("action", torch.tensor([[1.0, -1.0]])))["next"]
        data.ctrl[:] = facts["action_offset"] + np.array(facts["action_scale"]) * [1.0, -1.0]
        mujoco.mj_step(m, data, 10)
    np.testing.assert_allclose(data.qpos, td["observation"][0, :2], atol=1e-5)
    size = sum(torchrl_loco.Go1Velocity(1, "cpu", seed=0).observation_layout["observation"].values())
    info["task"] = torchrl_loco.registry.task_name(OtherWay)
    facts, _ = of_robot(Policy(nn.Sequential(ObservationNorm(size), nn.Linear(size, 12)), info))
    assert not {"action_offset", "action_scale"} & facts.keys()
    network = nn.Sequential(ObservationNorm(24), nn.Linear(24, 8), nn.ELU(0.5), nn.Linear(8, 6))
    with torch.no_grad():
        network[-1].bias.fill_(5.0)
    info = {**INFO, "task": "/no/such/file.py:Task", "control_timestep": 0.02}
    original = Policy(network, info)
    export_policy(original, tmp_path / "policy.pt2")
    play, facts = read_program(tmp_path / "policy.pt2")
    seen = torch.randn(3, 24)
    np.testing.assert_allclose(play(seen), original(observation=seen).detach().numpy(), rtol=0, atol=TOLERANCE)
    assert play(seen).max() > 1.0
    assert (facts["action_low"], facts["action_high"], facts["control_timestep"]) == (None, None, 0.02)


def test_what_differs_is_not_written(tmp_path, monkeypatch):
    """Here because what is read back is a policy with another bias."""
    load, wrong = torch.export.load, tmp_path / "wrong.pt2"
    export_policy(policy(bias=0.5), wrong)
    monkeypatch.setattr("torch.export.load", lambda file: load(wrong))
    with pytest.raises(
        RuntimeError, match=r"differs by .* own rounding in float32 is \d.\de-0[78]; .* nothing was written"
    ):
        export_policy(policy(), tmp_path / "policy.pt2")
    assert list(tmp_path.iterdir()) == [wrong]


def test_what_cannot_be_exported(tmp_path, monkeypatch):
    (tmp_path / "taken.pt2").touch()
    for name, message in {"x.tflite": "must end in one of .onnx, .pt2", "taken.pt2": "already exists"}.items():
        with pytest.raises(ValueError, match=message):
            export_policy(policy(), tmp_path / name)
    narrow = Policy(nn.Sequential(ObservationNorm(23), nn.Linear(23, 6)), INFO)
    with pytest.raises(
        ValueError, match=r"observations of shape \(23,\) and 6 actions, walker_stand has \(24,\) and 6"
    ):
        export_policy(narrow, tmp_path / "x.pt2")
    with pytest.raises(TypeError, match="must begin with an ObservationNorm"):
        export_policy(Policy(nn.Sequential(nn.Linear(24, 6)), INFO), tmp_path / "x.pt2")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"needs onnx: pip install 'torchrl-loco\[onnx\]'"):
        export_policy(policy(), tmp_path / "x.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.pt2"]


def test_the_command(tmp_path, monkeypatch, capsys):
    """From a shipped policy or a file; nothing is overwritten."""
    monkeypatch.chdir(tmp_path)
    policy().save(tmp_path / "mine.safetensors")
    commands = {
        "export mjx/walker_walk-v0 --format torch": "walker_walk.pt2",
        "export walker_walk --format torch": "walker_walk-2.pt2",
        "export mine.safetensors --format torch": "mine.pt2",
        "export mine.safetensors --format torch --out other.pt2": "other.pt2",
    }
    for command, name in commands.items():
        assert cli.main(command.split()) == 0
        said, written = capsys.readouterr().out.splitlines()
        assert said.startswith("largest difference from the policy, on random observations: ")
        assert written == name
        assert read_program(name)[1]["task"] == ("walker_walk" if "walk" in command else "walker_stand")
    with pytest.raises(SystemExit, match="2"):
        cli.main(["export", "walker_walk", "--format", "torch", "--out", "other.pt2"])
    assert "already exists" in capsys.readouterr().err


def test_terms_in_another_order_are_refused(caplog):
    trained = [["pose", 4], ["velocities", 4]]
    check_terms(trained, {"pose": 4, "velocities": 4}, "task")
    check_terms((), {"pose": 4}, "task")
    assert not caplog.records
    check_terms(trained, {"pose": 4, "speeds": 4}, "task")
    assert "trained on pose, velocities, task observes pose, speeds" in caplog.text
    with pytest.raises(ValueError, match="task observes velocities, pose: another order"):
        check_terms(trained, {"velocities": 4, "pose": 4}, "task")


def test_settings_of_a_training_that_a_file_tells():
    """Also of a checkpoint, which does not say the rate, and of a training without variation."""
    info = {"task": "walker_walk", "protocol": "playground", "sim": {"ctrl_dt": 0.05, "sim_dt": None}}
    assert export._control_timestep(info) == 0.05
    assert arguments_of({**info, "randomize": False}) == {"ctrl_dt": 0.05, "randomize": ()}
