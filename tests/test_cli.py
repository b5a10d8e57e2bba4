"""The command line answers at once where it can, and refuses before it says or makes anything."""

import subprocess
import sys

import pytest
import tyro

from torchrl_loco import cli

HELP = """
import sys
from torchrl_loco.cli import main
for line in sys.argv[1:]:
    try:
        print("exit", main(line.split()))
    except SystemExit as end:
        print("exit", end.code)
print("imported", sorted({"torch", "torchrl", "mujoco", "warp"} & set(sys.modules)))
"""


def told(*lines):
    """Returns what a fresh interpreter prints for command lines, how it exits, and what it imports for them."""
    done = subprocess.run([sys.executable, "-c", HELP, *lines], capture_output=True, text=True, timeout=60)
    said = done.stdout.splitlines()
    *exits, imported = (line for line in said if line.startswith(("exit", "imported")))
    return " ".join((done.stdout + done.stderr).replace("│", " ").split()), exits, imported


def test_help_and_wrong_options_wait_for_nothing():
    """Importing torch, TorchRL and MuJoCo-Warp takes seconds."""
    helpful = ["--help", "list", "train --help", "play --help"]
    wrong = ["fly", "train", "train walker_wlak", "train --seed 1", "play", "play walker_wlak", "eval x --episode many"]
    wrong += [f"{command} no/such/run" for command in ("eval", "resume", "record", "plot")]
    said, exits, imported = told(*helpful, *wrong)
    assert exits == ["exit 0"] * len(helpful) + ["exit 2"] * len(wrong), said
    assert imported == "imported []"
    assert "Train a policy" in said
    assert said.count("Walk at 1 m/s or faster, in any direction.") == 2  # in the list and among what can be trained


def test_an_unknown_command_names_the_one_that_is_meant(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["tain"])
    assert "did you mean 'train'?" in capsys.readouterr().err


def test_ctrl_c_while_a_command_starts_is_told_in_a_line(monkeypatch, capsys):
    def interrupted(task, *rest):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_loco.training.presets.preset", interrupted)  # importing torch takes the longest in it
    assert cli.main(["train", "walker_walk"]) == 130
    assert capsys.readouterr().err == "torchrl-loco: interrupted\n"


def test_settings_of_a_task_wait_for_torch_alone():
    """It knows whether there is CUDA, which decides on the preset."""
    said, exits, imported = told("train walker_walk --help", "train walker_walk --num_env 8")
    assert exits == ["exit 0", "exit 2"], said
    assert imported == "imported ['torch']"
    assert "--algorithm, ppo or reppo (here ppo)" in said
    assert "--task" not in said  # the preset is for no other
    assert "Perhaps you meant: --num_envs" in said
    assert not {"walker_run", "doctor"} & set(said.split())  # other tasks and commands have such an option too


@pytest.mark.parametrize(("word", "number"), [("100_000", 100_000), ("1e5", 100_000), ("12", 12)])
def test_ways_to_write_a_whole_number(word, number):
    assert tyro.cli(tuple[int, ...], args=[word, "8"], registry=cli.VALUES) == (number, 8)
    assert type(tyro.cli(int | None, args=[word], registry=cli.VALUES)) is int


@pytest.mark.parametrize("word", ["100k", "1.5", "inf", "nan", ""])
@pytest.mark.parametrize("command", [["doctor", "--num_envs"], ["eval", "x", "--episodes"]], ids=lambda words: words[0])
def test_what_is_no_whole_number(command, word, capsys):
    *words, option = command
    with pytest.raises(SystemExit, match="2"):
        cli.main([*words, f"{option}={word}"])
    said = capsys.readouterr()
    plain = " ".join((said.out + said.err).replace("│", " ").split())
    assert "is no whole number: write it as 100000, 100_000 or 1e5" in plain
    assert "NoneType" not in plain


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seconds", "0"], "seconds must be positive"),
        (["--seconds", "nan"], "seconds must be positive"),
        (["--seed", "-1"], "seed must lie in"),
        (["--device", "cuda:9"], "choose one of cpu"),
        (["--out", "no/such/folder/x.mp4"], "there is no folder"),
        (["--out", "x.txt"], "out must end in one of .mp4"),
    ],
)
@pytest.mark.parametrize("command", [["play", "walker_walk"], ["record", "no/such/run"]], ids=lambda words: words[0])
def test_options_of_a_video_are_looked_at_first(command, options, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        cli.main([*command, *options])
    said = capsys.readouterr()
    assert (said.out, list(tmp_path.iterdir())) == ("", [])
    assert message in said.err
