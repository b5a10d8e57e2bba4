"""Several seeds in one folder: each as if it were alone, none lost if another fails, and one picture of all."""

import json
import re
import signal

import pytest
from compare import assert_same
from small_runs import SMALL, networks, trained

from torchrl_loco import cli
from torchrl_loco.training import RunFolder, RunGroup, preset
from torchrl_loco.training.algorithm import Algorithm


def group_of(out, *seeds, **settings):
    return RunGroup.create(preset("walker_stand", "cpu", out=out, **{**SMALL, **settings}), seeds)


def content(run):
    return {path.name: path.read_bytes() for path in run.path.iterdir() if path.is_file()}


def at_update(monkeypatch, seed, number, act):
    """From now on, an update of a seed acts before it updates: the first one has the number 1."""
    update, calls = Algorithm.update, []

    def other(self, *args, **more):
        if self.config.seed == seed:
            calls.append(1)
            if len(calls) == number:
                act()
        return update(self, *args, **more)

    monkeypatch.setattr(Algorithm, "update", other)


def bug():
    raise ArithmeticError("a bug")


@pytest.mark.slow
def test_each_seed_is_as_if_it_were_alone(tmp_path, capsys):
    group = group_of(tmp_path / "group", 3, 1)
    assert group.train() == {}
    runs = RunGroup(group.path).runs
    assert {seed: run.load_config().seed for seed, run in runs.items()} == {3: 3, 1: 1}
    folders = {run.path.name for run in runs.values()}
    assert {path.name for path in group.path.iterdir()} == {"group.json", "learning_curve.png"} | folders
    alone = trained(tmp_path / "alone", seed=1)
    assert_same(networks(runs[1]), networks(alone))
    other = networks(runs[3])
    assert any((value != other[name]).any() for name, value in networks(alone).items() if "weight" in name)
    second, mean = capsys.readouterr().out.split("seed 3: return ")[1].splitlines()[1:3]
    assert re.match(r"seed 1: return \d", second)
    assert re.match(r"mean of 2 seeds: \d+\.\d, from \d+\.\d to \d+\.\d$", mean)
    with pytest.raises(ValueError, match="is complete: all of its 2 seeds"):
        group.train()


@pytest.mark.slow
def test_a_seed_that_fails_loses_no_other(tmp_path, monkeypatch, capsys):
    """Its traceback is kept; resuming trains it alone, and touches nothing of the others."""
    small = [f"--{key}={value}" for key, value in SMALL.items() if key != "hidden"]
    with monkeypatch.context() as patch:
        at_update(patch, 1, 1, bug)
        with pytest.raises(SystemExit, match="1"):
            cli.main(
                [
                    "train",
                    "walker_stand",
                    *small,
                    f"--out={tmp_path}",
                    *["--device=cpu", "--hidden=16", "--seeds", "0", "1", "2"],
                ]
            )
    (path,) = tmp_path.iterdir()
    said = capsys.readouterr()
    assert "seed 1 failed: ArithmeticError: a bug" in said.out
    assert "mean of 2 of 3 seeds" in said.out
    assert said.err.splitlines()[-1] == f"to continue: torchrl-loco resume {path}"
    runs = RunGroup(path).runs
    assert {seed: run.is_finished for seed, run in runs.items()} == {0: True, 1: False, 2: True}
    assert "in bug" in (runs[1].path / "error.txt").read_text()
    picture = (path / "learning_curve.png").read_bytes()
    before = {seed: content(run) for seed, run in runs.items()}

    with pytest.raises(SystemExit, match="2"):
        cli.main(["eval", str(path)])
    assert "holds the runs of several seeds: name the folder of one" in capsys.readouterr().err
    assert cli.main(["plot", str(path), f"--out={tmp_path / 'all.png'}"]) == 0

    assert cli.main(["resume", str(path)]) == 0
    said = capsys.readouterr().out
    assert said.count("best policy, in new episodes") == 1
    assert "mean of 3 seeds" in said
    assert said.endswith(f"policies, curves, videos and logs: {path}\n")
    after = RunGroup(path).runs
    assert all(run.is_finished for run in after.values())
    assert {seed: content(after[seed]) for seed in (0, 2)} == {seed: before[seed] for seed in (0, 2)}
    assert content(runs[1]) == before[1]  # there was no checkpoint: it begins anew, beside what was there
    assert after[1].path != runs[1].path
    assert (path / "learning_curve.png").read_bytes() != picture
    with pytest.raises(SystemExit, match="2"):
        cli.main(["resume", str(path)])
    assert "is complete" in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_stops_all_seeds_and_resume_continues_them(tmp_path, monkeypatch, capsys):
    """The seed that was stopped continues from its checkpoint, in its own folder."""
    group = group_of(tmp_path, 0, 1, 2)
    with monkeypatch.context() as patch:
        at_update(patch, 1, 2, lambda: signal.raise_signal(signal.SIGINT))
        assert cli.main(["resume", str(group.path)]) == 130
    assert f"to continue: torchrl-loco resume {group.path}" in capsys.readouterr().err
    stopped = group.runs
    assert set(stopped) == {0, 1}
    assert not stopped[1].is_finished
    first = content(stopped[0])
    assert cli.main(["resume", str(group.path)]) == 0
    runs = group.runs
    assert runs[1].path == stopped[1].path
    assert all(run.read_metrics()["frames"] == [128, 256] for run in runs.values())
    assert content(runs[0]) == first


def test_wrong_seeds(tmp_path, capsys):
    cases = {
        (): "seeds must name at least one",
        (0, 1, 0): "seeds must differ, but 0 is named twice",
        (0, -1): "each of seeds must lie in [0, 2**32)",
    }
    for seeds, message in cases.items():
        with pytest.raises(ValueError, match=re.escape(message)):
            group_of(tmp_path, *seeds)
    with pytest.raises(TypeError, match="each of seeds must be an integer"):
        group_of(tmp_path, 0, 1.5)
    for options, message in {
        "--seeds 1 1": "1 is named twice",
        "--seeds 1 x": "Error parsing --seeds",
        "--seed=3 --seeds 0 1": "pass one of them",
    }.items():
        with pytest.raises(SystemExit, match="2"):
            cli.main(["train", "walker_stand", "--device=cpu", f"--out={tmp_path}", *options.split()])
        said = capsys.readouterr()
        assert message in " ".join((said.out + said.err).replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_group_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no group\.json"):
        RunGroup(tmp_path)
    group = group_of(tmp_path, 0, 1)
    file = group.path / "group.json"
    values = json.loads(file.read_text())
    assert (RunGroup(group.path).seeds, RunGroup(group.path).config) == ((0, 1), group.config)
    for text in ("{", "[]", "{}", json.dumps({**values, "seeds": [0, 0]}), json.dumps({**values, "config": {}})):
        file.write_text(text)
        with pytest.raises(ValueError, match=re.escape(f"{file} is damaged")):
            RunGroup(group.path)


def test_a_group_of_another_device_is_refused_before_anything_is_made(tmp_path):
    group = group_of(tmp_path, 0, 1)
    file = group.path / "group.json"
    file.write_text(file.read_text().replace('"cpu"', '"cuda:7"'))
    with pytest.raises(ValueError, match="choose one of cpu"):
        RunGroup(group.path).train()
    assert [path.name for path in group.path.iterdir()] == ["group.json"]
    with pytest.raises(FileNotFoundError, match="is not a run folder"):
        RunFolder(group.path.parent)
