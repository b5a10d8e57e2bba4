"""Ranks for tests: processes connected by gloo, and what they do."""

import itertools
import os
import signal
import time
import uuid

import torch
from small_runs import SMALL, made, small_walker
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from torchrl_loco.tasks.walker import Walker
from torchrl_loco.training import RunFolder, Trainer, distributed, preset, train
from torchrl_loco.training.algorithm import Algorithm

BATCH = SMALL["num_envs"] * SMALL["num_steps"] * SMALL["action_repeat"]
"""Frames in a batch of one rank."""


def in_ranks(function, *args, count=2, connected=True):
    """Runs a function of this module in several ranks; returns what each has returned, in their order."""
    config = LaunchConfig(
        *(1, 1, count),
        run_id=str(uuid.uuid4()),
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        start_method="spawn" if torch.cuda.is_available() else "fork",  # a new interpreter takes seconds to import all
    )
    with distributed.handlers_restored():
        results = elastic_launch(config, _connected if connected else _alone)(function, *args)
    return [results[rank] for rank in range(count)]


def _alone(function, *args):
    torch.set_num_threads(1)
    return function(*args)


def _connected(function, *args):
    torch.set_num_threads(1)
    with distributed.joined("cpu"):
        return function(*args)


def messages():
    """Returns what the functions of the module give this rank."""
    rank = distributed.rank()
    samples = torch.randn(10, 3, generator=torch.Generator().manual_seed(rank)) * 3 + 100 * rank
    var, mean = torch.var_mean(samples, dim=0, correction=0)
    parameters = [torch.nn.Parameter(torch.zeros(shape)) for shape in ((2, 3), (), (4,))]
    parameters[0].grad, parameters[1].grad = torch.full((2, 3), 1.0 + rank), torch.tensor(4.0 * rank)
    distributed.average([p.grad for p in parameters if p.grad is not None])
    copied = torch.full((2,), float(rank))
    distributed.copy_from_first([copied])
    return {
        "gradients": [parameter.grad for parameter in parameters],
        "samples": samples,
        "moments": distributed.merged_moments(len(samples), mean, var),
        "mean": distributed.mean_of_ranks(torch.tensor([rank, 3.0])),
        "any": distributed.any_rank(rank == 1, False),
        "copied": copied,
        "from_first": distributed.from_first(f"of {rank}"),
        "gathered": [state["rank"] for state in distributed.gathered({"rank": rank})],
    }


class Counts(Walker):
    """Counts control steps of all worlds, over the ranks and of this one."""

    shared = {"all_steps": torch.int64, "own_steps": torch.int64}
    summed_over_ranks = ("all_steps",)

    def adapt(self, s):
        return {name: getattr(s, name) + s.num_envs for name in ("all_steps", "own_steps")}

    def metrics(self, s):
        return {"of_three": torch.where(s.env_index < 3, 1.0 + s.env_index, torch.nan)}  # of worlds of rank 0


def counted(out):
    """Returns what worlds share after two batches, the mean of a metric, and the run, which has a checkpoint."""
    settings = {**SMALL, "total_frames": 8 * BATCH}
    path = RunFolder.create(preset(Counts, "cpu", out=out, **settings)).path if distributed.is_first() else None
    trainer = Trainer(RunFolder(distributed.from_first(path)))
    for _ in range(2):
        row = trainer.iterate()
    trainer.save()
    shared = {name: int(values) for name, values in trainer._base.world.shared.items()}
    return {"shared": shared, "of_three": row["metric/of_three"], "run": trainer.run.path}


def seen(out):
    """Returns the mean picture after a batch, the number of pictures, and the first ones of this rank."""
    settings = {**SMALL, "from_pixels": True, "size": (20, 20), "hidden": (8,), "total_frames": 4 * BATCH}
    path = RunFolder.create(preset("walker_walk", "cpu", "reppo", out=out, **settings)).path
    trainer = Trainer(RunFolder(distributed.from_first(path if distributed.is_first() else None)))
    batch = trainer.collector.rollout()
    trainer.algorithm.update(batch, progress=0.0)
    encoder = trainer.algorithm.distribution[0]
    return {"mean": encoder.mean, "count": encoder.count.item(), "pictures": batch["pixels"][:, 0].clone()}


def whole_and_resumed(out, algorithm):
    """Trains a run at once, and another that rank 1 is asked to end in its second update, after which it is resumed.

    Returns the folders of both, and of each update of the first one the batch, and the parameters afterwards.
    """
    settings = {"total_frames": 4 * 2 * BATCH, "episode_length": 23, "logger": ("csv",)}
    if algorithm == "reppo":
        settings |= {"trials": 2, "trial_fraction": 0.3}
    update, updates = Algorithm.update, []

    def noted(self, batch, progress):
        metrics = update(self, batch, progress)
        updates.append((batch.clone().to_dict(), [tensor.clone() for tensor in self.networks.state_dict().values()]))
        return metrics

    def new_run(name):
        return RunFolder(distributed.from_first(made(out / name, algorithm, **settings).path if is_first else None))

    is_first = distributed.is_first()
    try:
        Algorithm.update = noted
        whole = new_run("whole")
        Trainer(whole).train()

        calls = itertools.count(1)

        def asked_to_end(self, batch, progress):
            if next(calls) == 2 and not is_first:
                signal.raise_signal(signal.SIGTERM)
            return update(self, batch, progress)

        Algorithm.update = asked_to_end
        stopped = new_run("stopped")
        try:
            Trainer(stopped).train()
        except KeyboardInterrupt:
            iteration = stopped.load_checkpoint("cpu")["iteration"]
    finally:
        Algorithm.update = update
    distributed.wait_for_all()
    Trainer(stopped, resume=True).train()
    return {"whole": whole.path, "stopped": stopped.path, "stopped_at": iteration, "updates": updates}


def of_ranks(out):
    """Returns all of the above."""
    with small_walker():
        runs = {algorithm: whole_and_resumed(out / algorithm, algorithm) for algorithm in ("ppo", "reppo")}
        return {"messages": messages(), "counted": counted(out / "counts"), "seen": seen(out / "seen"), **runs}


def resumed_by_train(path, frames):
    """Resumes a run by ``train``, which connects the ranks itself; returns the frames of its last row."""
    with small_walker():
        found = train("walker_stand", resume=path, total_frames=frames).read_metrics()["frames"][-1]
    if os.environ["RANK"] == "1":  # the other one must wait, and not look for it where it was
        time.sleep(1.0)
    with distributed.joined("cpu"):
        return distributed.from_first(found)
