"""The command line answers at once where it can, and refuses wrong options before it prints or makes anything."""

import contextlib
import os
import subprocess
import sys

import pytest
import tyro

from torchrl_loco import __version__, cli, garbage
from torchrl_loco.cli.errors import tolerate_broken_streams
from torchrl_loco.cli.options import VALUES, _of_task
from torchrl_loco.registry import resolve

FRESH = """
import sys
from torchrl_loco.cli import main

for name in ("matplotlib", "tensorboard", "imageio", "av", "viser", "mjviser"):  # as if they were not installed
    sys.modules[name] = None
for line in sys.argv[1:]:
    try:
        print("exit", main(line.split()))
    except SystemExit as end:
        print("exit", end.code)
    print("imported", sorted({"torch", "torchrl", "mujoco", "warp"} & set(sys.modules)))
"""


def in_fresh_process(*lines):
    """Returns what a fresh interpreter prints for command lines, how it exits, and what it has imported after each."""
    done = subprocess.run([sys.executable, "-c", FRESH, *lines], capture_output=True, text=True, timeout=60)
    said = done.stdout.splitlines()
    exits, imported = ([line for line in said if line.startswith(word)] for word in ("exit", "imported"))
    return " ".join((done.stdout + done.stderr).replace("│", " ").split()), exits, imported


def test_help_and_wrong_options_wait_for_nothing():
    """Importing torch, TorchRL and MuJoCo-Warp takes seconds, and the extra need not be installed."""
    helpful = ["--help", "list", "train --help", "play --help"]
    wrong = ["fly", "train", "train walker_wlak", "train --seed 1", "play", "play walker_wlak", "eval x --episode many"]
    wrong += [f"{command} no/such/run" for command in ("eval", "resume", "record", "plot", "export")]
    wrong += ["play walker_walk --viewer video", "play walker_walk --viewer browser"]  # right, but for the extras
    said, exits, imported = in_fresh_process(*helpful, *wrong)
    assert exits == ["exit 0"] * len(helpful) + ["exit 2"] * len(wrong), said
    assert imported[-1] == "imported []"
    assert said.count("pip install 'torchrl-loco[train]'") == 2, said  # of play and plot
    assert said.count("pip install 'torchrl-loco[viewer]'") == 1
    assert "Train a policy" in said
    assert said.count("Walk at 1 m/s or faster, in any direction.") == 2  # in the list and among what can be trained


@pytest.mark.ci
def test_settings_of_a_task_wait_for_torch_alone(tmp_path):
    """It knows whether there is CUDA, which decides on the preset."""
    (tmp_path / "config.json").write_text("{}")
    lines = ["train walker_walk --help", "train walker_walk --num_env 8", f"plot {tmp_path}"]
    said, exits, imported = in_fresh_process(*lines)
    assert exits == ["exit 0", "exit 2", "exit 2"], said
    assert imported[1] == "imported ['torch']"
    assert "--algorithm, ppo or reppo or svg (here ppo)" in said
    assert "--task" not in said  # the preset is for no other
    assert "did you mean 'num_envs'?" in said
    assert not {"walker_run", "doctor"} & set(said.split())  # other tasks and commands have such an option too
    assert "pip install 'torchrl-loco[train]'" in said


def test_the_version_and_an_unknown_command(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"
    with pytest.raises(SystemExit, match="2"):
        cli.main(["tain"])
    assert "did you mean 'train'?" in capsys.readouterr().err


def test_ctrl_c_while_a_command_starts(monkeypatch, capsys):
    def interrupted(task, *rest):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_loco.cli.options.preset", interrupted)  # importing torch takes the longest in it
    assert cli.main(["train", "walker_walk"]) == 130
    assert capsys.readouterr().err == "torchrl-loco: interrupted\n"


def test_a_training_outlives_who_reads_what_it_says(monkeypatch):
    reads, writes = os.pipe()
    os.close(reads)
    pipe = os.fdopen(writes, "w", buffering=1)
    monkeypatch.setattr(sys, "stdout", pipe)
    monkeypatch.setattr(sys, "stderr", None)  # as where it is closed
    tolerate_broken_streams()
    for stream in (sys.stdout, sys.stderr):
        print("a line", file=stream, flush=True)
    assert sys.stdout.fileno() == writes
    with contextlib.suppress(OSError):
        pipe.close()
    sys.stderr.close()


def test_integers(capsys):
    for word, number in (("100_000", 100_000), ("1e5", 100_000), ("12", 12)):
        assert tyro.cli(tuple[int, ...], args=[word, "8"], registry=VALUES) == (number, 8)
        assert type(tyro.cli(int | None, args=[word], registry=VALUES)) is int
    for word in ("100k", "1.5", "inf", "nan", ""):
        for option in (["doctor", f"--num_envs={word}"], ["eval", "x", f"--episodes={word}"]):
            with pytest.raises(SystemExit, match="2"):
                cli.main(option)
            said = capsys.readouterr()
            plain = " ".join((said.out + said.err).replace("│", " ").split())
            assert "is not an integer: write it as 100000, 100_000 or 1e5" in plain
            assert "NoneType" not in plain


def test_options_of_a_video_are_checked_first(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.mp4").touch()
    cases = {
        "--seconds=nan": "seconds must lie in (0, inf)",
        "--seed=-1": "seed must lie in [0, 2**32)",
        "--device=cuda:9": "choose one of cpu",
        "--out=no/such/folder/x.mp4": "no/such/folder does not exist",
        "--out=x.txt": "out must end in one of .mp4",
        "--out=taken.mp4": "already exists",
    }
    for command in (["play", "walker_walk"], ["record", "no/such/run"]):
        for option, message in cases.items():
            with pytest.raises(SystemExit, match="2"):
                cli.main([*command, option])
            said = capsys.readouterr()
            assert said.out == ""
            assert message in said.err
    assert [path.name for path in tmp_path.iterdir()] == ["taken.mp4"]


def test_a_window_needs_a_display(monkeypatch, capsys):
    monkeypatch.setattr("torchrl_loco.training.has_display", lambda: False)
    with pytest.raises(SystemExit, match="2"):
        cli.main(["play", "walker_walk", "--viewer=window"])
    assert "no display for a window: pass --viewer browser" in capsys.readouterr().err


@pytest.mark.ci
def test_kernels_are_compiled_ahead_and_no_run_is_left(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["warm", "walker_walk", "--device", "cpu"]) == 0
    assert capsys.readouterr().out.startswith("walker_walk: its kernels are in the caches after ")
    assert not list(tmp_path.iterdir())
    with pytest.raises(SystemExit):
        cli.main(["warm"])
    assert "name the tasks" in capsys.readouterr().err


def test_what_the_command_imports_is_left_out_of_collections(monkeypatch):
    """In its own process, and where something was imported: else garbage of a training would stay."""
    frozen = []
    monkeypatch.setattr(garbage.gc, "freeze", lambda: frozen.append(len(sys.modules)))
    for own_process, module in ((False, "first"), (True, "second"), (True, "second")):
        monkeypatch.setattr(garbage.OWN_PROCESS, "is_set", lambda own=own_process: own)
        with garbage.importing():
            monkeypatch.setitem(sys.modules, module, sys)
    assert len(frozen) == 1


TASK = """
import torch
from torchrl_loco import WalkerStand

class Calm(WalkerStand):
    options = {"wind": (False, "Whether it blows.")}

    def reward(self, s):
        return s.qpos[:, 0] + "1"

class Windy(Calm):
    wind = True

class Named(WalkerStand):
    options = {"speed": (0.5, "m/s"), "names": ((), "Files.")}

class Whole(Named):
    speed, names = 1, ["a.csv", "b.csv"]

class Pair(WalkerStand):
    options = {"pair": ((0.5, 1.0), "Two.")}

class Ints(Pair):
    pair = range(2, 4)
"""


def test_an_option_has_the_value_of_the_class_and_errors_in_a_hook_have_a_place(tmp_path, capsys):
    """A flag that a subclass sets can be taken back; a slip in a task's file is found without a traceback."""
    file = tmp_path / "task.py"
    file.write_text(TASK)
    for name, blows in (("Calm", False), ("Windy", True)):
        resolve(f"{file}:{name}", by_user=True)
        assert _of_task(f"{file}:{name}")["wind"][:2] == (False, blows)
    resolve(f"{file}:Whole", by_user=True)
    assert [entry[1] for entry in _of_task(f"{file}:Whole").values()] == [1.0, ("a.csv", "b.csv")]
    resolve(f"{file}:Ints", by_user=True)
    assert _of_task(f"{file}:Ints")["pair"][1] == (2.0, 3.0)
    with pytest.raises(SystemExit):
        cli.main(["train", f"{file}:Windy", "--device", "cpu", "--no_wind", "--out", str(tmp_path)])
    assert f"({file}, line 9, in reward)" in capsys.readouterr().err
