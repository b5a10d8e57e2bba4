"""Exported policies in C MuJoCo: they are played as their files say, and what does not hold is told."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from torch import nn

import torchrl_loco
from torchrl_loco import cli
from torchrl_loco.deployment import why_not
from torchrl_loco.export import export_policy
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.verification import velocity
from torchrl_loco.verification.conditions import Conditions
from torchrl_loco.verification.exported import Exported
from torchrl_loco.verification.layout import State
from torchrl_loco.verification.training_simulator import check_layout, make

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

BLOCK = """
import runpy, sys
class Blocked:
    names = ["torch", "warp"]
    def find_spec(self, name, *others):
        if name in self.names:
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Blocked())
"""
EXAMPLE = Path(__file__).parents[1] / "examples" / "deploy.py"


def at_home(task, size, joints):
    """Returns a policy that always asks for the home pose."""
    network = nn.Sequential(ObservationNorm(size), nn.Linear(size, joints))
    nn.init.zeros_(network[1].weight)
    nn.init.zeros_(network[1].bias)
    return Policy(network, {"task": task, "protocol": "playground", "action_repeat": 1, "control_timestep": 0.02})


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """An H1 that stands until it is pushed over."""
    path = tmp_path_factory.mktemp("h1") / "h1.onnx"
    export_policy(at_home("h1_velocity", 69, 19), path)
    return path


def changed(path, **facts):
    """Returns an exported policy whose file tells something else."""
    model = onnx.load(path)
    for entry in model.metadata_props:
        if entry.key in facts:
            entry.value = json.dumps(facts[entry.key])
    onnx.save(model, path.with_name("changed.onnx"))
    return Exported(path.with_name("changed.onnx"))


def verify(capsys, *arguments):
    """Returns the status of the command and what it prints."""
    try:
        status = cli.main(["verify", *map(str, arguments)])
    except SystemExit as ended:
        status = ended.code
    return status, capsys.readouterr().out


def in_fresh_process(code, *arguments):
    """Runs code where neither torch nor Warp can be imported."""
    code = f"{BLOCK}\n{code}"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(("pushes", "falls"), [(0, range(1)), (20, range(8, 9))])
def test_a_file_is_verified_alone(standing, tmp_path, pushes, falls):
    """A robot that stands falls when it is pushed hard, and the command says so by its status."""
    out = tmp_path / "out.json"
    options = ("--episodes", 8, "--seconds", 5, "--noise", 0, "--pushes", pushes, "--out", out)
    command = "from torchrl_loco.cli import main\nsys.exit(main(sys.argv[1:]))"
    done = in_fresh_process(command, "verify", standing, *options)
    holds = 0 in falls
    assert done.returncode == (0 if holds else 1), done.stderr
    assert "not beside the training simulator: " in done.stdout
    figures = json.loads(out.read_text())
    everything = figures["outcomes"]["C MuJoCo"]["all"]
    assert figures["holds"] == holds
    assert everything["falls"] in falls
    assert (everything["mean_steps"] == 250) == holds


def test_a_file_is_deployed_alone(standing):
    example = "Blocked.names.append('torchrl_loco')\nrunpy.run_path(sys.argv.pop(1), run_name='__main__')"
    done = in_fresh_process(example, EXAMPLE, standing, "--seconds", 1)
    assert done.returncode == 0, done.stderr
    base, targets = done.stdout.splitlines()
    assert 0.9 < float(base.split()[4]) < 1.0
    assert targets.startswith("left_hip_yaw 0.00, left_hip_roll 0.00, left_hip_pitch -0.27, left_knee 0.80, ")


def test_a_layout_that_is_wrong_is_refused(standing):
    exported = Exported(standing)
    env = make(exported, 2, 0, "cpu")
    check_layout(exported, env, seed=0)
    terms = exported.facts["observation"]
    assert terms[3]["term"] == "joint_positions"
    terms[3]["joints"].reverse()
    with pytest.raises(ValueError, match="not what h1_velocity observes: joint_positions differs by"):
        check_layout(changed(standing, observation=terms), env, seed=0)
    with pytest.raises(ValueError, match="not how h1_velocity controls: controls differ by"):
        check_layout(changed(standing, action_scale=[0.3] * 19), env, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["humanoid_walk", "cheetah_run", "hopper_hop", "quadruped_walk", "go1_velocity"])
def test_layouts_of_the_other_bodies(task, tmp_path):
    policy = at_home(task, 48, 12) if task == "go1_velocity" else torchrl_loco.load_policy(task, "cpu")
    export_policy(policy, tmp_path / "policy.onnx")
    exported = Exported(tmp_path / "policy.onnx")
    check_layout(exported, make(exported, 8, 0, "cpu"), seed=0)


@pytest.mark.slow
def test_a_runner_earns_the_same_in_c_mujoco(capsys, tmp_path):
    """From the same starts, under the model's own solver; what is asked for decides on the status."""
    policy = torchrl_loco.load_policy("walker_walk", "cpu", "dm_control")
    policy.save(tmp_path / "policy.safetensors")
    (tmp_path / "config.json").write_text("{}")  # as in a run folder
    options = ("--episodes", 4, "--seconds", 5, "--device", "cpu")
    status, said = verify(capsys, tmp_path / "policy.safetensors", *options)
    assert status == 0, said
    returns = json.loads((tmp_path / "verify.json").read_text())["returns"]
    here, there = (returns[name]["mean"] for name in ("training simulator", "C MuJoCo"))
    assert 150 < here < 200
    assert there == pytest.approx(here, rel=0.01)
    status, said = verify(capsys, tmp_path / "policy.safetensors", *options, "--seconds", 1, "--min_return", 1.1)
    assert (status, "DOES NOT HOLD: return" in said) == (1, True)
    _, said = verify(capsys, "humanoid_walk", "--episodes", 4, "--seconds", 0.5, "--device", "cpu")
    assert "1 episode, since all begin alike, of 20 control steps" in said


@pytest.mark.slow
def test_robots_do_the_same_in_both_simulators(standing, capsys, tmp_path):
    options = ("--episodes", 8, "--seconds", 3, "--pushes", 6, "--device", "cpu", "--out", tmp_path / "out.json")
    assert verify(capsys, standing, *options)[0] == 1
    outcomes = json.loads((tmp_path / "out.json").read_text())["outcomes"]
    there, here = outcomes["C MuJoCo"]["all"], outcomes["training simulator"]["all"]
    assert there["falls"] == here["falls"] > 0
    for error in ("linear_error", "angular_error"):
        assert there[error] == pytest.approx(here[error], rel=0.1)


class Perfect:
    """A simulator whose robot has the velocity of the command, but for the actions, which shift it."""

    def __init__(self, exported, episodes):
        n = len(episodes.delay)
        self.state, self.failed = State.zeros(exported.model, n), np.zeros(n, dtype=bool)
        self.state.xmat[:] = np.eye(3)
        self.episodes, self.step, self.acted = episodes, 0, []

    def begin(self, qpos, qvel):
        self.state.qpos[:] = qpos

    def act(self, action, worlds):
        self.acted.append(action[:, 0].copy())
        self.state.qvel[:, :2] = self.episodes.command[self.step, :, :2] + [0.3, 0.4]
        self.state.qvel[:, 5] = self.episodes.command[self.step, :, 2] - 0.1
        self.failed[0] = self.step >= 100
        self.step += 1

    def push(self, change):
        pass


def test_errors_delays_and_failures_are_counted(standing):
    """In a simulator that is always wrong by 0.5 m/s and 0.1 rad/s; the policy counts its steps."""
    exported = Exported(standing)
    episodes = velocity.draw(exported, Conditions(episodes=6, seed=3), seconds=4.0)
    assert sorted(episodes.delay) == [0, 0, 1, 1, 2, 2]
    assert [len(np.unique(episodes.command[:, i], axis=0)) for i in range(3)] == [1, 1, 1]
    simulator = Perfect(exported, episodes)
    exported.act = lambda seen: np.full((6, 19), simulator.step + 1.0)
    outcome = velocity.play(exported, simulator, episodes, "test")
    assert list(outcome.fell) == [True] + [False] * 5
    assert list(outcome.steps) == [100] + [200] * 5
    assert outcome.of(np.ones(6, dtype=bool))["linear_error"] == pytest.approx(0.5)
    assert outcome.of(np.ones(6, dtype=bool))["angular_error"] == pytest.approx(0.1)
    assert outcome.counted[0] == 100 - 75  # it settles for 1.5 s
    acted = np.array(simulator.acted)
    for i, delay in enumerate(episodes.delay):
        np.testing.assert_array_equal(acted[:, i], np.maximum(np.arange(200) + 1.0 - delay, 0.0))


class OtherObservation(torchrl_loco.WalkerWalk):
    """A task that inherits a layout and observes something else."""

    def observation(self, s):
        return s.qpos


def test_what_cannot_be_verified(tmp_path, capsys):
    policy = torchrl_loco.load_policy("walker_walk", "cpu")
    policy.info["task"] = torchrl_loco.registry.task_name(OtherObservation)
    assert "OtherObservation has no layout() of its own observation and control" in why_not(policy)
    policy.save(tmp_path / "policy.safetensors")
    export_policy(policy, tmp_path / "policy.onnx")
    export_policy(torchrl_loco.load_policy("walker_walk", "cpu"), tmp_path / "runner.onnx")
    for name, message in {
        "policy.safetensors": "OtherObservation has no layout()",
        "policy.onnx": "does not say what the policy observes",
        "none.onnx": "there is no file",
        "runner.onnx": "only robots with a velocity command can be played alone",
    }.items():
        with pytest.raises(SystemExit, match="2"):
            cli.main(["verify", str(tmp_path / name), "--alone"])
        assert message in " ".join(capsys.readouterr().err.split())
