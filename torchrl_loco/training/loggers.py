"""Where the metrics of a run go besides its CSV files: TorchRL's loggers."""

import contextlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from torchrl.record.loggers import Logger, MLFlowLogger, TensorboardLogger, WandbLogger

from torchrl_loco.training.run_folder import RunFolder

PROJECT = "torchrl_loco"
"""Project of W&B and experiment of MLflow, unless WANDB_PROJECT or MLFLOW_EXPERIMENT_NAME names another."""


class Loggers:
    """The loggers of a run, open in a ``with`` block; a resumed run continues what it has logged before.

    A logger that fails later is reported and left out: a run does not end because a server is away. What loggers store
    on this machine lies in the run's folder.
    """

    def __init__(self, run: RunFolder, frames: int) -> None:
        self._run = run
        self._frames = frames
        self._open: dict[str, Logger] = {}

    def __enter__(self) -> "Loggers":
        """Returns itself, with all of them open."""
        config = self._run.load_config()
        ids = self._run.read_logger_ids()
        for name in config.logger:
            if name == "csv":
                continue
            try:
                self._open[name] = OPENERS[name](self._run.path, self._frames, ids.get(name))
                if (id := _begin(self._open[name], config.to_json())) is not None:
                    ids[name] = id
            except Exception as error:  # each has errors of its own
                self.__exit__(type(error), error, None)
                raise OSError(f"the logger {name} cannot be opened: {error}") from error
        self._run.write_logger_ids(ids)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Closes all of them; W&B and MLflow show whether the run came to its end."""
        for name in list(self._open):
            try:
                _close(self._open.pop(name), kind)
            except Exception as problem:
                _report(name, problem)

    def log(self, row: dict[str, float], frames: int) -> None:
        """Logs a row of metrics at a number of frames."""
        for name, logger in list(self._open.items()):
            try:
                logger.log_metrics(row, step=frames)
            except Exception as error:
                _report(name, error)
                with contextlib.suppress(Exception):  # open, it would get what the next run of this process logs
                    _close(self._open.pop(name), type(error))


def _report(name: str, error: Exception) -> None:
    warnings.warn(
        f"the logger {name} failed and is left out from here on; the CSV files have every row: {error}",
        RuntimeWarning,
        stacklevel=3,
    )


class _Tensorboard(TensorboardLogger):
    """As TorchRL's, but what a resumed run writes again replaces what was there."""

    def __init__(self, folder: Path, frames: int) -> None:
        self._first = frames + 1
        super().__init__("tensorboard", str(folder))

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter  # of the extra "train", without which folders can be read

        return SummaryWriter(os.path.join(self.log_dir, self.exp_name), purge_step=self._first)

    def log_metrics(self, metrics: Any, step: int | None = None, *, keys_sep: str = "/") -> dict[str, Any]:
        """Returns the metrics, which become one event: TorchRL makes one of each, which takes a millisecond."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = [Summary.Value(tag=name, simple_value=value) for name, value in metrics.items()]
        self.experiment.file_writer.add_summary(Summary(value=values), step)
        return metrics


class MLflow(MLFlowLogger):
    """As TorchRL's, but the run has the name of its folder and can be continued."""

    def __init__(self, folder: Path, id: str | None) -> None:
        import mlflow

        self.mlflow, self._name, self._id, self._begun = mlflow, folder.name, id, False
        self.tracking_before = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else None
        local = f"sqlite:///{folder.absolute() / 'mlflow.db'}"
        artifacts = None if self.tracking_before else (folder.absolute() / "mlflow").as_uri()
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        try:
            super().__init__(name, self.tracking_before or local, artifact_location=artifacts)
        except Exception:
            self.end("FAILED")
            raise

    def end(self, status: str) -> None:
        """Ends the run, if it has begun, and gives the process back the server that it had before."""
        try:
            if self._begun:  # else the active run, if there is one, is not ours
                self.mlflow.end_run(status)
        finally:
            self.mlflow.set_tracking_uri(self.tracking_before)  # which TorchRL has set for the whole process

    def _create_experiment(self) -> Any:
        run = super()._create_experiment() if self._id is None else self.mlflow.start_run(run_id=self._id)
        self._begun = True
        if self._id is None:
            self.mlflow.set_tag("mlflow.runName", self._name)
        else:
            self.id = run.info.experiment_id
        return run


OPENERS: dict[str, Callable[[Path, int, str | None], Logger]] = {
    "tensorboard": lambda folder, frames, _: _Tensorboard(folder, frames),
    "wandb": lambda folder, _, id: WandbLogger(
        folder.name, save_dir=str(folder), project=os.environ.get("WANDB_PROJECT", PROJECT), id=id
    ),
    "mlflow": lambda folder, _, id: MLflow(folder, id),
}
"""Functions of the run's folder, its frames so far, and the id by which the logger knows a run that it continues."""


def _begin(logger: Logger, settings: dict[str, Any]) -> str | None:
    """Logs the settings; returns the id by which the logger finds the run again, if it has one."""
    if isinstance(logger, WandbLogger):
        logger.log_hparams(settings)
        return logger.experiment.id
    if isinstance(logger, MLflow):
        logger.mlflow.log_params(settings)  # TorchRL's log_hparams needs omegaconf
        return logger.experiment.info.run_id
    return None


def _close(logger: Logger, kind: type[BaseException] | None) -> None:
    try:
        if isinstance(logger, WandbLogger) and kind is not None:
            logger.experiment.finish(exit_code=1)
        logger.close()
    finally:
        if isinstance(logger, MLflow):
            stopped = "KILLED" if kind is KeyboardInterrupt else "FAILED"
            logger.end("FINISHED" if kind is None else stopped)
