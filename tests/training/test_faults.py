"""A rank that dies: what is said, and how the run goes on."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchrl_loco.training import Given, RunFolder, distributed
from torchrl_loco.training.start import run_to_end

SMALL = {
    "num_envs": 8,
    "num_steps": 8,
    "minibatch_size": 64,
    "epochs": 1,
    "hidden": 16,
    "action_repeat": 2,
    "eval_episodes": 2,
    "video_seconds": 0,
    "checkpoint_seconds": 0.1,
    "logger": "csv",
}


def started(launcher, out, *options, **settings):
    """Starts a training run as a process of its own."""
    words = [f"--{name}={value}" for name, value in {**SMALL, **settings}.items()]
    command = [*launcher, "-m", "torchrl_loco", "train", "walker_stand", "--device=cpu", f"--out={out}", *words]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def processes_of_ranks(parent):
    """Returns the processes that a launcher has started, by rank."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    environments = {int(child): Path(f"/proc/{child}/environ").read_text().split("\0") for child in children}
    found = {
        int(entry.removeprefix("RANK=")): child
        for child, environment in environments.items()
        for entry in environment
        if entry.startswith("RANK=")
    }
    return found


def until(what, process, seconds=120):
    """Waits until ``what()`` returns something true, which it returns, while a process runs."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def kill_rank_1(process, out):
    """Kills rank 1 of a run when there is a checkpoint; returns its process id."""
    until(lambda: list(out.glob("*/checkpoint.pt")), process)
    pid = processes_of_ranks(process.pid)[1]
    os.kill(pid, signal.SIGKILL)
    return pid


@pytest.mark.ci
def test_a_rank_that_dies_is_named(tmp_path):
    """The other ranks end too, and the run can be continued."""
    process = started([sys.executable], tmp_path, "--gpus=2", total_frames=10_000_000)
    pid = kill_rank_1(process, tmp_path)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 1, said
    assert f"torchrl-loco: rank 1 (process {pid}) ended with signal SIGKILL" in said
    assert re.search(r"to continue: torchrl-loco resume \S+ --gpus 2", said)
    (path,) = tmp_path.iterdir()
    run = RunFolder(path)
    assert len(run.load_checkpoint("cpu")["further_ranks"]) == 1
    # Whoever starts them may be killed too: they end, with a checkpoint.
    command = [sys.executable, "-m", "torchrl_loco", "resume", str(path), "--gpus=2"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rows = len(run.read_metrics()["frames"])
    until(lambda: len(run.read_metrics()["frames"]) > rows, process)
    left = processes_of_ranks(process.pid).values()
    process.kill()
    process.wait()
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in left):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert run.load_checkpoint("cpu")["frames"] == run.read_metrics()["frames"][-1]


@pytest.mark.ci
def test_torchrun_restarts_a_run_from_its_checkpoint(tmp_path):
    """In the same folder, without a frame lost or counted twice."""
    own_port = ["--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0"]  # tests may run side by side
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--max-restarts=1", *own_port]
    frames = 256 * 60
    process = started(torchrun, tmp_path, total_frames=frames)
    kill_rank_1(process, tmp_path)
    said, _ = process.communicate(timeout=240)
    assert process.returncode == 0, said
    (path,) = tmp_path.iterdir()
    assert f"run folder: {path}, which torchrun continues after a failure" in said
    run = RunFolder(path)
    assert run.read_metrics()["frames"] == list(range(256, frames + 1, 256))
    assert run.is_finished


def test_the_run_of_a_launch(tmp_path, monkeypatch):
    """It is found by the id of the launch, or by the process that launched where torchrun gives none."""
    from small_runs import made

    made(tmp_path)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    own = made(tmp_path)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "job 7")
    config = own.load_config()
    assert not distributed.is_restart()
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert distributed.is_restart()
    assert RunFolder.of_launch(config) is None
    made(tmp_path)
    second = made(tmp_path)
    os.utime(second.path / "launch.txt", (time.time() + 10,) * 2)
    assert RunFolder.of_launch(config).path == second.path
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    assert RunFolder.of_launch(config).path == own.path
    assert RunFolder.of_launch(dataclasses.replace(config, seed=config.seed + 1)) is None  # of a script with several
    monkeypatch.setattr(RunFolder, "is_finished", True)
    assert run_to_end(config, Given()).path == own.path  # which is not trained again
    monkeypatch.setattr(distributed, "ranks", lambda: 2)
    for parent, is_orphan in ((os.getppid(), False), (os.getppid() + 1, True), (0, False)):  # 0: a user's own group
        monkeypatch.setattr(distributed, "_parent", parent)
        assert distributed.is_orphan() == is_orphan
