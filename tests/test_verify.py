"""Exported policies in C MuJoCo: they are played in their own task, and what does not hold is told."""

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each
from torch import nn

import torchrl_loco
from torchrl_loco import WalkerWalk, cli
from torchrl_loco.conditions import Conditions
from torchrl_loco.export import export_policy
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.source import source_of
from torchrl_loco.verify import Exported, dofs_of_robot, play, verify

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

BLOCK = """
import runpy, sys
class Blocked:
    names = ["torch", "warp", "torchrl_loco"]
    def find_spec(self, name, *others):
        if name in self.names:
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Blocked())
runpy.run_path(sys.argv.pop(1), run_name="__main__")
"""
EXAMPLE = Path(__file__).parents[1] / "examples" / "deploy.py"


def constant(task, size, actions, value=0.0, **info):
    """Returns a policy whose action is always the same."""
    network = nn.Sequential(ObservationNorm(size), nn.Linear(size, actions))
    nn.init.zeros_(network[1].weight)
    nn.init.constant_(network[1].bias, value)
    about = {"task": task, "protocol": "playground", "action_repeat": 1, "control_timestep": 0.02}
    return Policy(network, {**about, **info})


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """An H1 that stands until it is pushed over."""
    path = tmp_path_factory.mktemp("h1") / "h1.onnx"
    export_policy(constant("h1_velocity", 69, 19), path)
    return path


def command(capsys, *arguments):
    """Returns the status of the command and what it prints."""
    try:
        status = cli.main(["verify", *map(str, arguments)])
    except SystemExit as ended:
        status = ended.code
    return status, capsys.readouterr()


def test_a_file_is_deployed_without_this_package(standing):
    done = subprocess.run(
        [sys.executable, "-c", BLOCK, EXAMPLE, standing, "--seconds", "1"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    base, targets = done.stdout.splitlines()
    assert 0.9 < float(base.split()[4]) < 1.0
    assert targets.startswith("left_hip_yaw 0.00, left_hip_roll 0.00, left_hip_pitch -0.27, left_knee 0.80, ")


@pytest.mark.slow
@for_each("pushes", [0, 6])
def test_robots_do_the_same_in_both_engines(standing, capsys, tmp_path, pushes):
    out = tmp_path / f"{pushes}.json"
    options = ("--episodes", 8, "--seconds", 3, "--pushes", pushes, "--device", "cpu", "--out", out)
    status, said = command(capsys, standing, *options)
    figures = json.loads(out.read_text())
    there, here = (figures["outcomes"][name]["all"] for name in ("C MuJoCo", "training simulator"))
    assert (there["falls"] > 0) == (pushes > 0)
    assert there["falls"] == here["falls"]
    assert (status, figures["holds"]) == ((1, False) if pushes else (0, True))
    assert ("DOES NOT HOLD: falls in" in said.out) == (pushes > 0)
    for figure in ("return", "linear_error", "angular_error", "upright"):
        assert there[figure] == pytest.approx(here[figure], rel=0.2 if pushes else 0.02)
    assert figures["outcomes"]["C MuJoCo"].keys() == {
        *("all", "fixed commands", "drawn commands", "delay 0", "delay 1", "delay 2"),
    }


@pytest.mark.slow
def test_a_runner_earns_the_same_in_c_mujoco(capsys, tmp_path):
    """From the same starts, under the model's own solver; what is asked for decides on the status."""
    policy = torchrl_loco.load_policy("walker_walk", "cpu", "dm_control")
    policy.save(tmp_path / "policy.safetensors")
    (tmp_path / "config.json").write_text("{}")  # as in a run folder
    options = ("--episodes", 4, "--seconds", 5, "--device", "cpu")
    status, said = command(capsys, tmp_path / "policy.safetensors", *options)
    assert status == 0, said.err
    outcomes = json.loads((tmp_path / "verify.json").read_text())["outcomes"]
    here, there = (outcomes[name]["all"]["return"] for name in ("training simulator", "C MuJoCo"))
    assert 150 < here < 200
    assert there == pytest.approx(here, rel=0.01)
    status, said = command(capsys, tmp_path / "policy.safetensors", *options, "--seconds", 1, "--min_return", 1.1)
    assert (status, "DOES NOT HOLD: return" in said.out) == (1, True)
    _, said = command(capsys, "humanoid_walk", "--episodes", 4, "--seconds", 0.5, "--device", "cpu")
    assert "1 episode, since all begin alike, of 0.5 s" in said.out


class Late(WalkerWalk):
    """Measures the action that arrives, and observes with noise and memory; a policy must earn 30 of 40."""

    memory = {"steps": ()}
    noise = {"steps": 0.25}
    holds = {"return": 30.0, "falls": 0.5}
    episode_length = 40

    def reward(self, s):
        return {"arrived": s.action[:, 0]}

    def terminated(self, s):
        return (s.env_index == 0) & (s.steps >= 9)

    def metrics(self, s):
        return {"late": torch.where(s.steps < 4, s.action[:, 0] == 0.0, torch.nan)}

    def events(self, s):
        return {"steps": s.steps + 1}

    def observation(self, s):
        return {"observation": {"steps": s.steps}}


def exported(path, **info):
    """Returns the file of a policy for :class:`Late`."""
    export_policy(constant(torchrl_loco.registry.task_name(Late), 1, 6, 1.0, **info), path)
    return path


def test_a_task_of_a_users_own_is_verified_by_its_own_hooks(tmp_path):
    """Actions arrive late, terms and metrics are means over the steps that count, and a fall ends an episode."""
    path = exported(tmp_path / "late.onnx")
    report = verify(path, Conditions(episodes=6, delay=(0, 2)), "cpu")
    for engine in ("C MuJoCo", "training simulator"):
        table = report.figures["outcomes"][engine]
        assert (table["all"]["falls"], table["all"]["episodes"]) == (1, 6)
        assert table["all"]["mean_steps"] == pytest.approx((10 + 5 * 40) / 6)
        for delay in range(3):
            assert table[f"delay {delay}"]["late"] == pytest.approx(delay / 4)
    assert report.holds
    assert "holds: falls in 16.7% of the episodes, 50.0% are allowed; return" in report.lines[-1]
    report = verify(path, Conditions(episodes=6, delay=(15, 15)), "cpu", alone=True)
    assert not report.holds
    assert "DOES NOT HOLD: return 20.8, at least 30.0 is asked for" in report.lines[-1]
    assert list(report.figures["outcomes"]) == ["C MuJoCo"]


class Held(Late):
    """Holds actions back by itself, by one step at most."""

    memory = {**Late.memory, "delay": (), "last": 6}
    holds = {**Late.holds, "delay": (0, 1)}

    def control(self, s, action):
        return torch.where(s.delay.unsqueeze(-1) > 0.0, s.last, action)

    def metrics(self, s):
        return {"late": torch.where(s.steps < 4, s.ctrl[:, 0] == 0.0, torch.nan)}

    def events(self, s):
        return {**super().events(s), "last": s.action}


def test_actions_are_as_late_as_asked_for_where_the_task_holds_them_back_itself(tmp_path):
    path = tmp_path / "held.onnx"
    export_policy(constant(torchrl_loco.registry.task_name(Held), 1, 6, 1.0), path)
    report = verify(path, Conditions(episodes=8, delay=(0, 3)), "cpu", alone=True)
    for delay in range(4):
        assert report.figures["outcomes"]["C MuJoCo"][f"delay {delay}"]["late"] == pytest.approx(delay / 4)


class Waits(Late):
    """Remembers a ``delay`` that is not one of actions, as ``holds`` has none, and cuts episodes off."""

    memory = {**Late.memory, "delay": ()}

    def terminated(self, s):
        return s.steps < 0

    def truncated(self, s):
        return s.steps >= 9

    def metrics(self, s):
        return {"delay": s.delay}

    def begin(self, s):
        return {"delay": 7.0 + s.steps}


def test_an_entry_named_delay_is_the_tasks_own_where_holds_has_none(tmp_path):
    path = tmp_path / "waits.onnx"
    export_policy(constant(torchrl_loco.registry.task_name(Waits), 1, 6, 1.0), path)
    report = verify(path, Conditions(episodes=2), "cpu", alone=True)
    table = report.figures["outcomes"]["C MuJoCo"]["all"]
    assert table["delay"] == 7.0
    assert (table["mean_steps"], table["return"]) == (10.0, 40.0)  # 10 steps of 40, as in evaluations


class Levels(Late):
    """Begins an episode one level above the last, and earns the level."""

    memory = {"steps": (), "level": ()}
    holds = {"return": 0.0}

    def reward(self, s):
        return s.level + 0.0 * s.action[:, 0]

    def terminated(self, s):
        return s.steps < 0

    def begin(self, s):
        return {"level": s.level + 1.0}


def test_both_engines_begin_at_the_stage_of_the_policy_and_have_its_simulation(tmp_path):
    path, about = (
        tmp_path / "levels.onnx",
        {"stage": {"memory": {"level": [7.0]}}, "sim": {"ctrl_dt": 0.05, "sim_dt": None}},
    )
    export_policy(constant(torchrl_loco.registry.task_name(Levels), 1, 6, **about), path)
    report = verify(path, Conditions(episodes=3), "cpu")
    for table in report.figures["outcomes"].values():
        assert table["all"]["return"] == 40 * 8.0
    assert "3 episodes of 2 s" in report.lines[0]


class Kept(Late):
    """Asks for nothing but a share of what the policy had in its training."""

    holds = {}

    def terminated(self, s):
        return s.steps < 0


def test_a_policy_that_had_more_when_its_training_ended_does_not_hold(tmp_path):
    """Also in conditions in which the simulator of the training has as little; not in shorter episodes."""
    path = tmp_path / "kept.onnx"
    export_policy(constant(torchrl_loco.registry.task_name(Kept), 1, 6, 1.0, mean=80.0), path)
    for conditions, words in {
        Conditions(episodes=2): "DOES NOT HOLD: return 40.0, at least 72.0 is asked for, 90% of 80.0",
        Conditions(episodes=2, delay=(2, 2)): "DOES NOT HOLD: return 38.0, at least 72.0 is asked for, 90% of 80.0",
        Conditions(episodes=2, seconds=2.0): "DOES NOT HOLD: return 40.0, at least 72.0 is asked for, 90% of 80.0",
        Conditions(episodes=2, seconds=0.5): "holds: return 20.0, at least 18.0 is asked for, 90% of 20.0 in the",
        Conditions(episodes=2, max_falls=0.0): "DOES NOT HOLD: return 40.0, at least 72.0 is asked for, 90% of 80.0",
    }.items():
        assert verify(path, conditions, "cpu").lines[-1].startswith(words)
    report = verify(path, Conditions(episodes=2, max_falls=0.0), "cpu", alone=True)
    assert report.lines[-1] == "holds: falls in 0.0% of the episodes, 0.0% are allowed; the return is not compared"


def test_a_policy_is_not_held_to_what_it_had_before_its_task_was_edited(tmp_path, caplog):
    task, path = torchrl_loco.registry.task_name(Kept), tmp_path / "kept.onnx"
    for source, words in (
        (source_of(task), "DOES NOT HOLD: return 40.0, at least 72.0"),
        ("other", "holds: return 40"),
    ):
        export_policy(constant(task, 1, 6, 1.0, mean=80.0, source_hash=source), path)
        assert verify(path, Conditions(episodes=2), "cpu").lines[-1].startswith(words)
        path.unlink()
    assert "was edited since the training" in caplog.text


def test_the_return_that_a_task_asks_for_is_that_of_whole_episodes(tmp_path):
    report = verify(exported(tmp_path / "late.onnx"), Conditions(episodes=6, seconds=0.5), "cpu", alone=True)
    assert "holds" in report.lines[-1]
    assert "at least 15.0 is asked for" in report.lines[-1]


def test_noise_is_the_tasks_own(tmp_path):
    played = []
    policy = Exported(exported(tmp_path / "late.onnx"))
    policy.act = lambda seen: played.append(seen.clone()) or torch.zeros(len(seen), 6)
    for scale in (0.0, 2.0):
        env = Late(4, "cpu", 0, play=True, noise_scale=scale, metrics=True)
        play(policy, env, Conditions(noise=scale).of(Late.holds), "test")
    clean, noisy = (torch.cat(played[i : i + 40], dim=1) for i in (0, 40))
    assert torch.equal(clean, torch.arange(40.0).expand(4, 40))
    assert 0.4 < (noisy - clean).abs().max() <= 0.5


def test_robots_are_pushed_alike_in_both_engines(standing):
    """A push is added to the velocity of the base after a step; nothing else is."""
    policy, changes = Exported(standing), []
    policy.act = lambda seen: torch.zeros(len(seen), 19)
    conditions = Conditions(episodes=3, seconds=1.5, pushes=1.0, delay=(0, 0), noise=0.0).of(
        torchrl_loco.H1Velocity.holds
    )
    for engine in ("mujoco", "auto"):
        env = torchrl_loco.make("h1_velocity", 3, "cpu", 0, engine=engine, play=True, metrics=True)
        velocities = []
        step = env.world.step
        env.world.step = lambda action, env=env, step=step, kept=velocities: (
            kept.append(env.sim.qvel.clone()),
            step(action),
        )
        play(policy, env, conditions, "test")
        found = torch.stack(velocities)
        jumps = (found[1:, :, :2] - found[:-1, :, :2]).abs().amax(-1)
        changes.append(jumps > 0.1)
        np.testing.assert_allclose(found[60].numpy()[:, :6], found[60].numpy()[:, :6])
    assert 0 < changes[0].sum() < 10
    assert torch.equal(changes[0], changes[1])


def test_pushes_move_the_robot_and_not_what_it_plays_with():
    free, geom = "<freejoint/>", '<geom size="0.1"/>'
    box, robot = f"<body>{free}{geom}</body>", f'<body>{free}{geom}<body><joint name="hinge"/>{geom}</body></body>'
    model = f"<worldbody>{box}{robot}</worldbody><actuator><motor joint='hinge'/></actuator>"
    assert dofs_of_robot(mujoco.MjModel.from_xml_string(f"<mujoco>{model}</mujoco>")) == 6


def test_what_cannot_be_verified(standing, tmp_path, capsys):
    path = tmp_path / "runner.onnx"
    export_policy(constant("walker_walk", 24, 6), path)
    nameless = tmp_path / "nameless.onnx"
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, nameless)
    cases = {
        (path, "--alone"): "held to its return in the training simulator, and no episode of it falls",
        (path, "--alone", "--max_falls", "0"): "it cannot be played alone",
        (path, "--pushes", "1"): "pushes need a body that floats",
        (path, "--delay", "2", "1"): "delay: the least, 2, must not be greater than the greatest, 1",
        (path, "--task", "cheetah_run"): "the policy has 24 numbers of the observation, cheetah_run has 17",
        (path, "--alone", "--min_return", "0.9"): "min_return is a share of the return in the training simulator",
        (nameless,): "does not say its task",
        (tmp_path / "none.onnx",): "there is no file",
    }
    for arguments, message in cases.items():
        status, said = command(capsys, *arguments, "--episodes", 2, "--device", "cpu")
        assert status == 2
        assert message in " ".join(said.err.split())
