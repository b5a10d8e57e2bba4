"""The commands on runs: what they print and write, and what they refuse."""

import shutil
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch
from compare import assert_same
from small_runs import SMALL, networks, trained

from torchrl_loco import cli, training
from torchrl_loco.policy import ObservationNorm, Policy, load_policy
from torchrl_loco.training import RunFolder
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.trainer import NothingToLearnError


@pytest.mark.slow
def test_each_seed_is_as_if_it_were_alone(tmp_path, capsys):
    small = [f"--{key}={value}" for key, value in SMALL.items() if key != "hidden"]
    options = [*small, "--hidden=16", "--device=cpu", f"--out={tmp_path / 'seeds'}"]
    assert cli.main(["train", "walker_stand", *options, "--seeds", "3", "1"]) == 0
    said = capsys.readouterr().out.splitlines()
    runs = {run.load_config().seed: run for run in map(RunFolder, (tmp_path / "seeds").iterdir())}
    assert said[-1] == f"all seeds in one picture: torchrl-loco plot {runs[3].path} {runs[1].path}"
    assert_same(networks(runs[1]), networks(trained(tmp_path / "alone", seed=1)))
    assert all(run.is_finished for run in runs.values())
    first, other = (networks(run)["actor.module.0.module.1.0.weight"] for run in runs.values())
    assert (first != other).any()


def test_wrong_seeds(tmp_path, capsys):
    for options, message in {
        "--seeds 1 1": "1 is named twice",
        "--seeds 0 -1": "each of seeds must lie in [0, 2**32)",
        "--seeds 1 x": "Error parsing --seeds",
        "--seed=3 --seeds 0 1": "pass one of them",
        "--seeds": "--seeds must name at least one seed",
    }.items():
        with pytest.raises(SystemExit, match="2"):
            cli.main(["train", "walker_stand", "--device=cpu", f"--out={tmp_path}", *options.split()])
        said = capsys.readouterr()
        assert message in " ".join((said.out + said.err).replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_from_training_to_a_video(tmp_path, capsys, monkeypatch):
    """train, eval, plot, record and play. Without --out, a video replaces no file."""
    small = [f"--{key}={value}" for key, value in SMALL.items() if key != "hidden"]
    assert cli.main(["train", "walker_walk", *small, "--hidden", "16", f"--out={tmp_path}", "--device=cpu"]) == 0
    (path,) = tmp_path.iterdir()
    said = capsys.readouterr().out
    assert f"run folder: {path}\n" in said
    assert said.endswith(f": {path}\n")
    config = RunFolder(path).load_config()
    assert (config.algorithm, config.task, config.num_envs, config.hidden) == ("ppo", "walker_walk", 4, (16,))

    assert cli.main(["eval", str(path), "--episodes", "2"]) == 0
    said = capsys.readouterr()
    assert "over 2 episodes" in said.out
    assert "evaluation" not in said.err  # no progress bar, which would stay in a log

    assert cli.main(["plot", str(path), f"--out={tmp_path / 'curve.png'}"]) == 0
    assert (tmp_path / "curve.png").exists()

    capsys.readouterr()
    video = ["--seconds", "0.05", "--device", "cpu"]
    (path / "video.mp4").write_text("mine")
    assert cli.main(["record", str(path), *video, "--camera", "back"]) == 0
    assert capsys.readouterr().out == f"{path / 'video-2.mp4'}\n"
    assert imageio.imread(path / "video-2.mp4", plugin="pyav").shape[0] == 2
    assert (path / "video.mp4").read_text() == "mine"

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training, "record", lambda policy, env, path, *rest: path.touch(exist_ok=False))
    for what, options, name in (
        ([str(path)], ["--viewer", "video"], "video-3.mp4"),
        (["walker_walk"], ["--viewer", "video"], "walker_walk.mp4"),
        (["walker_walk"], ["--viewer", "video"], "walker_walk-2.mp4"),
        ([str(path / "policy.safetensors")], ["--out", "x.mp4"], "x.mp4"),
    ):
        assert cli.main(["play", *what, *video, *options]) == 0
        head, returns, out = capsys.readouterr().out.splitlines()
        assert (head.split(",")[0], returns.split()[0], Path(out).name) == ("walker_walk", "return", name)
        assert Path(out).exists()
    assert cli.main(["play", "walker_walk", "--viewer", "video", "--protocol", "dm_control", *video]) == 0
    assert "protocol dm_control" in capsys.readouterr().out


@pytest.mark.slow
def test_a_finished_run_is_trained_on(ppo_run, tmp_path, capsys):
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    assert cli.main(["resume", str(run.path), "--total_frames", "512"]) == 0
    assert run.load_config().total_frames == 512
    assert run.read_metrics()["frames"] == [128, 256, 384, 512]
    assert run.is_finished
    with pytest.raises(SystemExit, match="2"):
        cli.main(["resume", str(run.path), "--total_frames", "384"])
    assert "must be at least the 512 frames" in capsys.readouterr().err
    assert run.load_config().total_frames == 512


def test_the_policy_of_the_package_is_evaluated(capsys):
    expected = training.evaluate_policy(load_policy("walker_walk", "cpu", "dm_control"), episodes=2)
    assert expected["mean"] != training.evaluate_policy(load_policy("walker_walk", "cpu"), episodes=2)["mean"]
    assert cli.main(["eval", "walker_walk", "--protocol", "dm_control", "--episodes", "2", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == f"{training.describe(expected)}\n"


@pytest.mark.slow
def test_a_run_is_exported_into_its_folder(ppo_run, tmp_path, capsys):
    path = shutil.copytree(ppo_run.path, tmp_path / "run")
    (path / "policy.pt2").write_text("mine")
    assert cli.main(["export", str(path), "--format", "torch"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(path / "policy-2.pt2")
    assert (path / "policy.pt2").read_text() == "mine"
    action = torch.export.load(path / "policy-2.pt2").module()(torch.ones(3, 24))
    torch.testing.assert_close(action, Policy.load(ppo_run.policy, "cpu")(observation=torch.ones(3, 24)))


def test_errors_of_the_user(ppo_run, tmp_path, capsys):
    (tmp_path / "file.mp4").write_text("")
    broken = shutil.copytree(ppo_run.path, tmp_path / "broken")
    (broken / "config.json").write_text("{}")
    cases = {
        "train walker_wlak": "did you mean 'walker_walk'",
        "train mjx/walker_walk-v0 --gamma 2": "gamma must lie in (0, 1]",
        "train walker_walk --learning_rate=0.1": "unknown setting 'learning_rate': choose one of action_repeat",
        "train walker_walk --device cpu --kl_bound 0.1": "--kl_bound is a setting of --algorithm reppo",
        "train walker_walk --task walker_run": "unknown setting 'task'",
        "train walker_walk --ctrl-dt 0.02": "--ctrl_dt is a field of the simulation: write --sim.ctrl_dt",
        "eval no/such/run": "there is no run folder or policy file 'no/such/run', and unknown environment",
        "eval {run} --policy {swapped}": "{run} is no task: with --policy, the first word is the task to play in",
        "eval {run} --episodes 0": "episodes must lie in [1, 2**31)",
        "resume {run} --task walker_run": "is a run of walker_stand, but task is walker_run",
        "resume {several}": "has no config.json; name one of those in it, such as one, two",
        "resume {broken}": "{broken}/config.json is damaged",
        "record {run} --seconds 0": "seconds must lie in (0, inf)",
        "record {run} --device cpu --out {file}": "already exists",
        "play {swapped} --device cpu": "is a policy for walker_walk, but the run is of walker_stand",
        "resume {renamed} --total_frames 512": "is of a run with task='walker_stand', but its config.json has task",
        "export {run} --out {file}": "out must end in one of .onnx",
        "fly": "train, resume, eval",
    }
    for name in ("one", "two"):
        (tmp_path / "several" / name).mkdir(parents=True)
        (tmp_path / "several" / name / "config.json").write_text("{}")
    swapped, renamed = (shutil.copytree(ppo_run.path, tmp_path / name) for name in ("swapped", "renamed"))
    load_policy("walker_walk", "cpu").save(swapped / "policy.safetensors")
    text = (renamed / "config.json").read_text()
    (renamed / "config.json").write_text(text.replace('"walker_stand"', '"walker_walk"'))
    names = {
        "swapped": swapped,
        "renamed": renamed,
        "run": ppo_run.path,
        "broken": broken,
        "several": tmp_path / "several",
        "file": tmp_path / "file.mp4",
    }
    for arguments, message in cases.items():
        with pytest.raises(SystemExit) as ended:
            cli.main(arguments.format(**names).split())
        captured = capsys.readouterr()
        said = " ".join((captured.out + captured.err).replace("│", " ").split())
        assert (ended.value.code, message.format(**names) in said) == (2, True), f"{arguments}: {said}"


def test_errors_while_training(tmp_path, monkeypatch, capsys):
    """What the machine lacks is said in a line, with how to continue if that is possible; a bug keeps its traceback."""

    def fail(error):
        def update(self, batch, progress):
            raise error

        return update

    command = ["train", "walker_walk", "--device", "cpu", "--out", str(tmp_path)]
    full = OSError("no space left")
    for error, ended in ((full, SystemExit), (NothingToLearnError("none"), SystemExit), (TypeError("bug"), TypeError)):
        monkeypatch.setattr(Algorithm, "update", fail(error))
        with pytest.raises(ended):
            cli.main(command)
        said = capsys.readouterr().err
        assert (f"torchrl-loco: {error}" in said) == (ended is SystemExit)
        assert "to continue" not in said  # there is no checkpoint


def test_a_policy_of_ones_own_is_evaluated(tmp_path, capsys):
    """Of no run; what its file must say is told."""
    network = torch.nn.Sequential(ObservationNorm(24), torch.nn.Linear(24, 6), torch.nn.Tanh())
    info = {"task": "walker_walk", "protocol": "playground", "action_repeat": 1}
    Policy(network, info).save(tmp_path / "own.safetensors")
    Policy(network, {"task": "walker_walk"}).save(tmp_path / "nameless.safetensors")
    (tmp_path / "own.onnx").write_bytes(b"")
    assert cli.main(["eval", str(tmp_path / "own.safetensors"), "--device", "cpu"]) == 0
    assert "over 32 episodes" in capsys.readouterr().out
    for name, message in (("nameless.safetensors", "lacks protocol and action_repeat"), ("own.onnx", "verify plays")):
        with pytest.raises(SystemExit):
            cli.main(["eval", str(tmp_path / name), "--device", "cpu"])
        assert message in " ".join(capsys.readouterr().err.split())
