"""Loggers: what they are given, what a resumed run continues, and what their failures leave as it was."""

import contextlib
import os
import signal
import sys
import time

import pytest
from for_each import for_each
from small_runs import made, trained
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import CSVLogger

from torchrl_loco import cli
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.training import Given, Trainer, config, loggers
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.start import train_to_end


def files(run):
    return {path.name for path in run.path.iterdir()}


def stopped_after_a_batch(run, monkeypatch):
    """Trains the first batch of a run, which is as a crash leaves it if it is followed by another."""
    update = Algorithm.update
    with monkeypatch.context() as patch:
        press = lambda *args, **more: signal.raise_signal(signal.SIGINT) or update(*args, **more)  # noqa: E731
        patch.setattr(Algorithm, "update", press)
        with pytest.raises(KeyboardInterrupt):
            Trainer(run).train()
    assert run.load_checkpoint("cpu")["iteration"] == 1


def test_csv_alone(tmp_path):
    run = trained(tmp_path, logger="csv")
    assert run.load_config().logger == ("csv",)
    assert len(run.read_metrics()["frames"]) == 2
    assert not {"tensorboard", "wandb", "mlflow.db", "loggers.json"} & files(run)


def in_the_next_second(monkeypatch):
    """Sets the clock: files of one second are read in the order of their names, a process's tenth before its ninth."""
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + 1.0)


def test_tensorboard_shows_what_was_kept(tmp_path, monkeypatch):
    """What a run has logged after its last checkpoint is replaced when it is resumed."""
    run = made(tmp_path)
    stopped_after_a_batch(run, monkeypatch)
    in_the_next_second(monkeypatch)
    with loggers.Loggers(run, 128) as lost:
        lost.log({"return": 999.0}, 256)
    in_the_next_second(monkeypatch)
    Trainer(run, resume=True).train()
    board = EventAccumulator(str(run.path / "tensorboard")).Reload()
    seen = {name: [(event.step, event.value) for event in board.Scalars(name)] for name in ("return", "evaluation")}
    metrics = run.read_metrics()
    expected = zip(metrics["frames"], map(pytest.approx, metrics["return"]), strict=True)
    assert seen["return"] == list(expected)
    assert seen["evaluation"] == [(256, pytest.approx(run.read_evaluations()[0]["mean"]))]


def test_a_missing_package_is_named_before_anything_is_made(tmp_path, monkeypatch, capsys):
    run = made(tmp_path / "elsewhere", logger=())  # trained on a machine that has the package
    text = (run.path / "config.json").read_text()
    (run.path / "config.json").write_text(text.replace('"logger": []', '"logger": ["wandb"]'))
    monkeypatch.setattr("torchrl_loco.training.environments.Environments.training", None)
    for name, extra in {"wandb": "wandb", "mlflow": "mlflow", "tensorboard": "train"}.items():
        monkeypatch.setitem(sys.modules, name, None)
        command = ["train", "walker_stand", "--device=cpu", f"--out={tmp_path / 'runs'}", "--logger", "csv", name]
        with pytest.raises(SystemExit, match="2"):
            cli.main(command)
        said = f"the logger {name} needs {name}: pip install 'torchrl-loco[{extra}]'"
        assert said in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SystemExit, match="2"):
        cli.main(["train", "walker_stand", "--device=cpu", f"--out={tmp_path / 'runs'}", "--logger", "csv"])
    assert "a video (none with video_seconds=0) needs av: pip install" in capsys.readouterr().err
    monkeypatch.delitem(sys.modules, "av")
    assert not (tmp_path / "runs").exists()
    with pytest.raises(ImportError, match="the logger wandb needs wandb"):
        Trainer(run)
    assert run.load_config().logger == ("wandb",)  # it can be evaluated and plotted without


@pytest.mark.slow
def test_a_logger_that_fails_does_not_end_the_run(tmp_path, monkeypatch):
    """Neither while it logs nor when it is closed; the others go on."""

    failures = []

    class Fails(CSVLogger):
        def log_metrics(self, metrics, step):
            if step > 128:
                failures.append(step)
                raise ConnectionError("the server is away")
            super().log_metrics(metrics, step)

        def close(self):
            failures.append("closed")

    class FailsToClose(CSVLogger):
        def close(self):
            raise ConnectionError("no answer")

    opened = {"wandb": Fails, "mlflow": FailsToClose}
    openers = {name: lambda folder, *_, of=of: of(of.__name__, str(folder)) for name, of in opened.items()}
    monkeypatch.setattr(loggers, "OPENERS", openers)
    monkeypatch.setattr(config, "check_packages", lambda *_: None)
    with (
        pytest.warns(RuntimeWarning, match="wandb failed and is left out .*: the server is away"),
        pytest.warns(RuntimeWarning, match="mlflow failed .*: no answer"),
    ):
        run = trained(tmp_path, logger=("wandb", "mlflow"))
    assert run.is_finished
    assert failures == [256, "closed"]
    logged = {
        name: (run.path / name / "scalars" / "return.csv").read_text().splitlines()
        for name in files(run)
        if name.startswith("Fails")
    }
    assert {name: len(lines) for name, lines in logged.items()} == {"Fails": 1, "FailsToClose": 2}


def test_a_logger_that_cannot_be_opened_is_said_in_a_line(tmp_path, monkeypatch, capsys):
    closed = []

    class Closes(CSVLogger):
        def close(self):
            closed.append(self.exp_name)

    def no_login(*_):
        raise RuntimeError("no login")

    openers = {"wandb": lambda folder, *_: Closes("first", str(folder)), "mlflow": no_login}
    monkeypatch.setattr(loggers, "OPENERS", openers)
    monkeypatch.setattr(config, "check_packages", lambda *_: None)
    with pytest.raises(SystemExit, match="2"):
        train_to_end(Trainer(made(tmp_path, logger=("wandb", "mlflow"))), Given(), user_errors)
    assert capsys.readouterr().err == "torchrl-loco: the logger mlflow cannot be opened: no login\n"
    assert closed == ["first"]


def test_seeds_share_a_group_in_wandb(tmp_path, monkeypatch):
    given = []

    class Fake(CSVLogger):
        def __init__(self, name, save_dir, **options):
            given.append((name, options))
            super().__init__(name, save_dir)
            self.experiment.id = f"id{len(given)}"

    monkeypatch.setattr(loggers, "WandbLogger", Fake)
    monkeypatch.setattr(config, "check_packages", lambda *_: None)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    runs = [made(tmp_path, logger="wandb", seed=seed) for seed in (0, 1)]
    for run in [*runs, runs[0]]:
        with loggers.Loggers(run, 0):
            pass
    assert [options["id"] for _, options in given] == [None, None, "id1"]
    assert {options["project"] for _, options in given} == {"torchrl_loco"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@for_each("fails", ["log_metrics", "log_hparams"])
@for_each("name", ["wandb", "mlflow"])
def test_a_failure_of_one_run_leaves_the_next_alone(tmp_path, monkeypatch, name, fails):
    """The process must not keep the failed run open: the next one would be written into it, or be refused."""
    module = pytest.importorskip(name)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    owner, method = {"wandb": loggers.WandbLogger, "mlflow": loggers.MLflow}[name], fails
    if (name, fails) == ("mlflow", "log_hparams"):
        owner, method = module, "log_params"
    works, calls = getattr(owner, method), []

    def once(*arguments, **options):
        calls.append(method)
        if len(calls) == 1:
            raise ConnectionError("away for a moment")
        return works(*arguments, **options)

    monkeypatch.setattr(owner, method, once)
    runs, refused = [made(tmp_path, logger=name, seed=seed) for seed in (0, 1)], fails == "log_hparams"
    with pytest.raises(OSError, match="away for a moment") if refused else contextlib.nullcontext():
        Trainer(runs[0]).train()
    Trainer(runs[1]).train()
    ids = [run.read_logger_ids().get(name) for run in runs]
    assert len(set(ids)) == 2
    assert ids[1] is not None


@pytest.mark.slow
def test_wandb(tmp_path, monkeypatch):
    """Without a network; a resumed run has the same id."""
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    run = made(tmp_path, logger="wandb")
    stopped_after_a_batch(run, monkeypatch)
    ids = run.read_logger_ids()
    Trainer(run, resume=True).train()
    assert run.read_logger_ids() == ids
    parts = [path.name for path in (run.path / "wandb").iterdir() if path.is_dir() and not path.is_symlink()]
    assert len(parts) == 2
    assert all(ids["wandb"] in part for part in parts)
    assert "tensorboard" not in files(run)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of what MLflow itself uses
def test_mlflow(tmp_path, monkeypatch):
    """Into the run folder, unless a server is named; a resumed run is the same run."""
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    run = made(tmp_path / "one", logger="mlflow")
    stopped_after_a_batch(run, monkeypatch)
    client = mlflow.MlflowClient(f"sqlite:///{run.path / 'mlflow.db'}")
    of = run.read_logger_ids()["mlflow"]
    assert client.get_run(of).info.status == "KILLED"
    Trainer(run, resume=True).train()
    assert run.read_logger_ids() == {"mlflow": of}
    found = client.get_run(of)
    assert (found.info.run_name, found.info.status) == (run.path.name, "FINISHED")
    assert found.data.params["task"] == "walker_stand"
    history = [(point.step, point.value) for point in client.get_metric_history(of, "return")]
    metrics = run.read_metrics()
    assert history == list(zip(metrics["frames"], metrics["return"], strict=True))
    assert "MLFLOW_TRACKING_URI" not in os.environ

    server = f"sqlite:///{tmp_path / 'server.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server)
    other = trained(tmp_path / "two", logger="mlflow")
    assert not (other.path / "mlflow.db").exists()
    assert mlflow.MlflowClient(server).get_run(other.read_logger_ids()["mlflow"]).info.run_name == other.path.name
