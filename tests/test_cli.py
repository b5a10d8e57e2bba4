"""The command line answers at once where it can, and refuses before it says or makes anything."""

import subprocess
import sys

import pytest

from torchrl_loco import cli

HELP = """
import sys
from torchrl_loco.cli import main
for args in (["--help"], ["fly"], ["play"], ["play", "--help"], ["eval", "run", "--episode", "many"]):
    try:
        main(args)
    except SystemExit as end:
        print("exit", end.code)
print("imported", {"torch", "mujoco", "warp"} & set(sys.modules))
"""


def test_help_and_wrong_options_wait_for_nothing():
    """Importing torch, TorchRL and MuJoCo-Warp takes seconds."""
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, timeout=60)
    told = [line for line in done.stdout.splitlines() if line.startswith(("exit", "imported"))]
    assert told == ["exit 0", "exit 2", "exit 2", "exit 0", "exit 2", "imported set()"], done.stderr
    assert "Train a policy" in done.stdout


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
