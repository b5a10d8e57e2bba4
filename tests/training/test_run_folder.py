"""The run folder: what is refused before training, and what happens to files that are damaged or cannot be written."""

import contextlib
import json
import math
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from compare import assert_same
from small_runs import made, networks

from torchrl_loco import registry, storage
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.envs.task import folder_of
from torchrl_loco.sim import models
from torchrl_loco.training import Given, RunFolder, Trainer, preset
from torchrl_loco.training.start import train_to_end


def test_unused_path(tmp_path):
    names = []
    for _ in range(3):
        path = storage.unused_path(tmp_path / "video.mp4")
        path.touch()
        names.append(path.name)
    assert names == ["video.mp4", "video-2.mp4", "video-3.mp4"]


def test_runs_of_the_same_second_have_folders_of_their_own(tmp_path):
    assert len({made(tmp_path).path for _ in range(3)}) == 3


def test_out_must_be_a_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "runs"):
        with pytest.raises(OSError, match=re.escape(f"out must be a folder for runs, but {out}")):
            made(out)


HOLD = """
import sys
from pathlib import Path
from torchrl_loco.training.process import lock

lock(Path(sys.argv[1]))
print("locked", flush=True)
sys.stdin.read()
"""


def test_one_process_at_a_time_trains_a_run(tmp_path):
    """The second is told which one does. The lock of a process that was killed is free."""
    run = made(tmp_path)
    metrics = run.path / "metrics.csv"
    metrics.write_text("frames\n128\n")
    with subprocess.Popen([sys.executable, "-c", HOLD, run.path], stdin=-1, stdout=-1, text=True) as other:
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(BlockingIOError, match=f"process {other.pid} on {socket.gethostname()} is training in"):
            Trainer(run)
        assert metrics.read_text() == "frames\n128\n"
        other.kill()
    metrics.unlink()
    assert (run.path / "lock").exists()
    parts = [f"{name}.{'0123abcd' * 4}.part" for name in ("checkpoint.pt", "checkpoint-128.pt", "config.json")]
    for part in parts:
        (run.path / part).write_text("what a killed process wrote")
    Trainer(run).train()
    assert not {path.name for path in run.path.iterdir()} & {"lock", *parts}


def test_a_damaged_config_is_named(tmp_path):
    run = made(tmp_path)
    path = run.path / "config.json"
    values = json.loads(path.read_text())
    damaged = ['{"task": ', "[]", "{}", json.dumps({**values, "algorithm": "sac"})]
    damaged += [json.dumps({**values, **wrong}) for wrong in ({"decisions": 8}, {"hidden": None}, {"gamma": 2.0})]
    for text in damaged:
        path.write_text(text)
        with pytest.raises(ValueError, match=re.escape(f"{path} is damaged")):
            run.load_config()
    path.write_text(json.dumps(values))
    assert run.load_config(seed=5).seed == 5


def test_a_torn_line_is_left_out_lost_ones_are_said_and_damaged_ones_refused(ppo_run, tmp_path, caplog):
    run = made(tmp_path)
    for frames in (128, 256, 384):
        run.append_metrics({"iteration": frames // 128, "frames": frames, "return": 1.5})
    path = run.path / "metrics.csv"
    path.write_text(path.read_text() + "4,5")
    assert run.read_metrics()["frames"] == [128, 256, 384]
    path.write_text(path.read_text() + "12,1.2")
    assert run.read_metrics()["frames"] == [128, 256, 384]
    run.forget_after(256, 2)
    assert path.read_text() == "iteration,frames,return\n1,128,1.5\n2,256,1.5\n"
    for frames in (256, 384):
        run.append_evaluation({"frames": frames, "mean": 1.5})
    run.forget_after(256, 2)
    assert run.read_evaluations() == [{"frames": 256, "mean": 1.5}]
    (run.path / "evaluations.csv").write_text("")  # the disk was full when its first line was written
    run.forget_after(256, 2)
    run.append_evaluation({"frames": 256, "mean": 3.0})
    assert run.read_evaluations() == [{"frames": 256, "mean": 3.0}]
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    path = run.path / "metrics.csv"
    head, first, _ = path.read_text().splitlines(keepends=True)
    Trainer(run, resume=True, total_frames=384)
    assert "lines up to the checkpoint" not in caplog.text
    path.write_text(head + first)
    Trainer(run, resume=True, total_frames=512)
    assert f"{path} has 1 of the 2 lines up to the checkpoint" in caplog.text
    for text, why in ((head + first.replace(",", ",x", 1), "'x128' is no number"), ("a,b\n", "its head is 'a,b'")):
        path.write_text(text)
        with pytest.raises(ValueError, match=re.escape(f"{path} is damaged, {why}")):
            Trainer(run, resume=True, total_frames=640)


def test_copies_of_checkpoints_stay(tmp_path):
    run = made(tmp_path)
    for name in ("best", "backup"):
        (run.path / f"checkpoint-{name}.pt").write_text("the user's")
    for frames in (64, 512, 128):
        run.save_checkpoint({"frames": frames}, keep=2)
    assert sorted(path.stem[11:] for path in run.path.glob("checkpoint-*.pt")) == ["128", "512", "backup", "best"]


def test_an_extended_run_has_an_end_of_its_own(ppo_run, tmp_path):
    """One that dies after its last frame is not taken for complete because it was so once."""
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    assert run.is_finished
    trainer = Trainer(run, resume=True, total_frames=384)
    trainer._best = math.inf  # no later policy is better
    trainer.iterate()
    trainer.save()
    assert not run.is_finished
    Trainer(run, resume=True).train()
    assert run.is_finished
    with pytest.raises(ValueError, match="is complete: it has all of its 384 frames"):
        Trainer(run, resume=True)
    run.policy.write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"Move it away: the run goes on without"):
        Trainer(run, resume=True, total_frames=512)
    run.policy.unlink()
    Trainer(run, resume=True, total_frames=512)


def test_a_run_needs_an_undamaged_checkpoint_of_this_version(ppo_run, tmp_path):
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    path = run.path / "checkpoint.pt"
    good = path.read_bytes()

    def refused(error, message):
        with pytest.raises(error, match=message):
            Trainer(run, resume=True)

    with zipfile.ZipFile(path) as file:
        largest = max(file.infolist(), key=lambda part: part.file_size)
        middle = largest.header_offset + largest.file_size // 2
    flipped = good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :]
    for bad in (b"no checkpoint at all", good[: len(good) // 2], flipped):
        path.write_bytes(bad)
        refused(ValueError, "checkpoint.pt cannot be read as a checkpoint")
    torch.save({"version": 0}, path)
    refused(ValueError, "has version 0, this release reads 7")
    path.unlink()
    refused(FileNotFoundError, "has no checkpoint")


def test_a_checkpoint_executes_nothing(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    run = made(tmp_path)
    run.save_checkpoint({"frames": 0, "rng": Trap()})
    with pytest.raises(ValueError, match="cannot be read as a checkpoint"):
        Trainer(run, resume=True)
    assert not (tmp_path / "executed").exists()


@contextlib.contextmanager
def full_disk(size):
    """No file may grow beyond ``size`` bytes: what a write to a full disk meets too, an error of the system."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.slow
def test_a_disk_that_fills_up_while_training(tmp_path, capsys):
    """The previous checkpoint is kept, and the command says how to continue from it."""
    run = made(tmp_path, hidden=(128,), checkpoint_seconds=1e-9)
    trainer = Trainer(run)
    trainer.iterate()
    trainer.save()
    before = networks(run)
    with full_disk(2**16), pytest.raises(SystemExit, match="2"):
        train_to_end(trainer, Given(), user_errors)
    problem, way = capsys.readouterr().err.splitlines()[-2:]
    assert problem.startswith("torchrl-loco: ")
    assert problem.endswith(f"the previous file is kept: '{run.path / 'checkpoint.pt'}'")
    assert way == f"to continue: torchrl-loco resume {run.path}"
    assert list(run.path.glob("*.part")) == []
    assert_same(before, networks(run))
    Trainer(run, resume=True).train()
    assert run.is_finished


def test_columns_stay_right_where_a_row_has_others(tmp_path):
    """In another order, or more, or fewer of them, as where the terms of a reward change while a run is stopped."""
    run = made(tmp_path)
    for row in ({"frames": 128, "a": 1, "b": 2}, {"frames": 256, "b": 2, "a": 1}, {"frames": 384, "b": 2, "c": 3}):
        run.append_metrics(row)
    run.forget_after(384, 3)
    path = run.path / "metrics.csv"
    assert path.read_text() == "frames,a,b,c\n128,1,2,\n256,1,2,\n384,,2,3\n"
    metrics = run.read_metrics()
    assert (metrics["frames"], metrics["b"], metrics["c"][2]) == ([128, 256, 384], [2, 2, 2], 3)
    assert [math.isnan(value) for value in metrics["c"]] == [True, True, False]
    path.write_text(path.read_text() + "1,2,3,4,5\n")
    with pytest.raises(ValueError, match="a line of 5 columns, but its head names 4"):
        run.read_metrics()


def test_a_file_is_replaced_on_the_disk_or_not_at_all(tmp_path, monkeypatch):
    path, calls, fsync, replace = tmp_path / "file", [], os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: calls.append("fsync") or fsync(descriptor))
    monkeypatch.setattr(Path, "replace", lambda *paths: calls.append("replace") or replace(*paths))
    storage.replace_file(path, b"before")
    assert calls == ["fsync", "replace", "fsync"]  # of the file, and of its folder
    for error in (OSError(28, "no space left"), KeyboardInterrupt()):

        def fail(*_, error=error):
            raise error

        monkeypatch.setattr(Path, "replace", fail)
        with pytest.raises(type(error)):
            storage.replace_file(path, b"after")
        assert path.read_bytes() == b"before"
        assert list(tmp_path.iterdir()) == [path]


def test_of_two_who_write_a_file_the_last_wins(tmp_path, monkeypatch):
    path, replace = tmp_path / "file", Path.replace

    def meanwhile(part, target):
        monkeypatch.setattr(Path, "replace", replace)
        storage.replace_file(target, b"another's")
        return replace(part, target)

    monkeypatch.setattr(Path, "replace", meanwhile)
    storage.replace_file(path, b"mine")
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


TASK = """
import own_numbers, torchrl_loco

class Own(torchrl_loco.LocoEnv):
    model = "robot/own.xml"
    config = torchrl_loco.SimConfig(ctrl_dt=own_numbers.DT, sim_dt=0.005)

    def reward(self, s):
        return s.time

    def observation(self, s):
        return s.qpos
"""
MODEL = """
<mujoco><compiler meshdir="meshes"/><include file="scene.xml"/><include file="assets.xml"/>
<worldbody><body><freejoint/><geom type="mesh" mesh="box"/></body></worldbody></mujoco>
"""


def test_the_source_of_a_task_is_kept(tmp_path, monkeypatch):
    """With what is beside it: modules, model and meshes. It is what is run where the file is gone."""
    monkeypatch.setattr(sys, "path", sys.path.copy())
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    project = tmp_path / "project"
    (project / "robot" / "meshes").mkdir(parents=True)
    files = {
        "own_task.py": TASK,
        "own_numbers.py": "DT = 0.02",
        "robot/own.xml": MODEL,
        "robot/assets.xml": '<mujoco><asset><mesh name="box" file="box.obj"/></asset></mujoco>',
        "robot/meshes/box.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
    }
    for name, text in {**files, "unrelated.py": "", "robot/unrelated.xml": ""}.items():
        (project / name).write_text(text)
    run = RunFolder.create(preset(f"{project / 'own_task.py'}:Own", "cpu", out=tmp_path))
    kept = run.path / "source"
    assert {str(path.relative_to(kept)) for path in kept.rglob("*") if path.is_file()} == set(files)
    project.rename(tmp_path / "moved")
    for name in [name for name in sys.modules if name.startswith(("own_task_", "own_numbers"))]:
        monkeypatch.delitem(sys.modules, name)
    cls = registry.resolve(run.task)
    assert run.task == f"{kept / 'own_task.py'}:Own"
    assert models.load(cls.model, folder_of(cls)).nmesh == 1
    assert RunFolder(run.path, "walker_walk").task == "walker_walk"
