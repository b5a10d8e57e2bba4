"""Where the metrics of a run go besides its CSV files: TorchRL's loggers."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from torchrl.record.loggers import Logger, MLFlowLogger, TensorboardLogger, WandbLogger

from torchrl_loco.checks import is_run_group
from torchrl_loco.training.run_folder import RunFolder

PROJECT = "torchrl_loco"
"""Project of W&B and experiment of MLflow, unless WANDB_PROJECT or MLFLOW_EXPERIMENT_NAME names another."""


class Loggers:
    """The loggers of a run, open in a ``with`` block; a resumed run continues what it has logged before.

    A logger that fails later is reported and left out: a run does not end because a server is away.

    Args:
        run: the run; what loggers store on this machine lies in its folder.
        frames: frames of the run so far.

    Raises:
        OSError: one cannot be opened, for example because it needs a login.
    """

    def __init__(self, run: RunFolder, frames: int) -> None:
        self._run = run
        self._frames = frames
        self._open: dict[str, Logger] = {}

    def __enter__(self) -> "Loggers":
        """Returns itself, with all of them open.

        Raises:
            OSError: one cannot be opened.
        """
        config = self._run.load_config()
        settings = config.to_json()
        ids: dict[str, str | None] = {**self._run.read_logger_ids()}
        for name in config.logger:
            if name == "csv":
                continue
            try:
                self._open[name], ids[name] = _OPEN[name](self._run.path, self._frames, ids.get(name), settings)
            except Exception as error:  # each has errors of its own
                self.__exit__(type(error), error, None)
                raise OSError(f"the logger {name} cannot be opened: {error}") from error
        self._run.write_logger_ids({name: of for name, of in ids.items() if of is not None})
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Closes all of them; W&B and MLflow show whether the run came to its end."""
        for name, logger in self._open.items():
            try:
                _close(logger, kind)
            except Exception as problem:
                _report(name, problem)
        self._open.clear()

    def log(self, row: dict[str, float], frames: int) -> None:
        """Logs a row of metrics at a number of frames."""
        for name, logger in list(self._open.items()):
            try:
                with _closed_at_errors(logger):
                    logger.log_metrics(row, step=frames)
            except Exception as error:
                _report(name, error)
                del self._open[name]


def _report(name: str, error: Exception) -> None:
    warnings.warn(
        f"the logger {name} failed and is left out from here on; the CSV files have every row: {error}",
        RuntimeWarning,
        stacklevel=3,
    )


Opened = tuple[Logger, str | None]
"""A logger, and the id by which it finds the run again."""


class _Tensorboard(TensorboardLogger):
    """As TorchRL's, but what a resumed run writes again replaces what was there."""

    def __init__(self, folder: Path, frames: int) -> None:
        self._first = frames + 1
        super().__init__("tensorboard", str(folder))

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter  # of the extra "train", without which folders can be read

        return SummaryWriter(os.path.join(self.log_dir, self.exp_name), purge_step=self._first)


def _open_tensorboard(folder: Path, frames: int, _: str | None, settings: dict[str, Any]) -> Opened:
    return _Tensorboard(folder, frames), None


def _open_wandb(folder: Path, _: int, of: str | None, settings: dict[str, Any]) -> Opened:
    project = os.environ.get("WANDB_PROJECT", PROJECT)
    group = folder.absolute().parent.name if is_run_group(folder.parent) else None
    logger = WandbLogger(folder.name, save_dir=str(folder), project=project, id=of, group=group)
    with _closed_at_errors(logger):
        logger.log_hparams(settings)
        return logger, logger.experiment.id


class _MLflow(MLFlowLogger):
    """As TorchRL's, but the run has the name of its folder and can be continued."""

    def __init__(self, folder: Path, of: str | None) -> None:
        import mlflow

        self._name, self._of, self._begun = folder.name, of, False
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
        import mlflow

        try:
            if self._begun:  # else the active run, if there is one, is not ours
                mlflow.end_run(status)
        finally:
            mlflow.set_tracking_uri(self.tracking_before)  # which TorchRL has set for the whole process

    def _create_experiment(self) -> Any:
        import mlflow

        run = super()._create_experiment() if self._of is None else mlflow.start_run(run_id=self._of)
        self._begun = True
        if self._of is None:
            mlflow.set_tag("mlflow.runName", self._name)
        else:
            self.id = run.info.experiment_id
        return run


def _open_mlflow(folder: Path, _: int, of: str | None, settings: dict[str, Any]) -> Opened:
    import mlflow

    logger = _MLflow(folder, of)
    with _closed_at_errors(logger):
        mlflow.log_params(settings)  # TorchRL's log_hparams needs omegaconf
        return logger, logger.experiment.info.run_id


_OPEN = {"tensorboard": _open_tensorboard, "wandb": _open_wandb, "mlflow": _open_mlflow}


@contextlib.contextmanager
def _closed_at_errors(logger: Logger) -> Iterator[None]:
    """Closes a logger if a call of it fails: else the next run of this process would be written into this one."""
    try:
        yield
    except Exception as error:
        with contextlib.suppress(Exception):
            _close(logger, type(error))
        raise


def _close(logger: Logger, kind: type[BaseException] | None) -> None:
    try:
        if isinstance(logger, WandbLogger) and kind is not None:
            logger.experiment.finish(exit_code=1)
        logger.close()
    finally:
        if isinstance(logger, _MLflow):
            stopped = "KILLED" if kind is KeyboardInterrupt else "FAILED"
            logger.end("FINISHED" if kind is None else stopped)
