"""Data parallel training: one process a GPU, each with worlds of its own and all with the same parameters.

``torchrun`` starts the processes, the ranks; :func:`joined` connects them, by NCCL on CUDA and by gloo on the CPU. In a
single process nothing is exchanged: functions return what they were given, so that callers need not check.
"""

import contextlib
import datetime
import io
import os
import signal
import socket
import sys
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch.distributed.rendezvous import rendezvous

TIMEOUT = datetime.timedelta(hours=2)
"""For how long a rank waits for another. Rank 0 evaluates and records alone; a rank that dies is noticed at once."""

GRACE = 5.0  # seconds for which a rank that lost another one stays alive, so that torchrun sees first which one died
PATIENCE = 600  # seconds for which ranks that are asked to end may still update, evaluate and write a checkpoint

_joins = 0  # how often this process joined others
_parent = 0  # the process that had started it by then


class RankLostError(ConnectionError):
    """Another rank ended while this one needed it."""


# Who is who.


def rank() -> int:
    """Returns the number of this process among all; 0 if it is the only one."""
    return dist.get_rank() if _connected() else 0


def ranks() -> int:
    """Returns the number of processes; 1 if this is the only one."""
    return dist.get_world_size() if _connected() else 1


def is_first() -> bool:
    """Returns whether this rank writes the run folder, evaluates and talks."""
    return rank() == 0


def _connected() -> bool:
    return dist.is_available() and dist.is_initialized()


def launch_id() -> str | None:
    """Returns a name of the launch by torchrun that stays the same when it restarts its processes, if there is one.

    A script may train several times: each training has a name of its own.
    """
    of = os.environ.get("TORCHELASTIC_RUN_ID")
    if of == "none":  # torchrun's default; the process that starts and restarts this one is unique on its machine
        of = f"{socket.gethostname()} {os.getppid()}"
    return f"{of}, {_joins}" if of and _joins > 1 else of


def is_restart() -> bool:
    """Returns whether torchrun started this process in place of one that failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0


def is_orphan() -> bool:
    """Returns whether the process that started this rank is gone, as by SIGKILL: nobody would end it then."""
    return ranks() > 1 and _parent not in (0, os.getppid())


def own_device(device: str) -> str:
    """Returns the device of this rank: on CUDA, the GPU that has the number of the rank on its machine."""
    if ranks() == 1 or device == "cpu":
        return device
    if device not in ("cuda", "cuda:0"):
        raise ValueError(
            f"device {device!r} is one GPU, but there are {ranks()} ranks, each with a GPU of its own: pass "
            "device='cuda', and choose GPUs by CUDA_VISIBLE_DEVICES"
        )
    return f"cuda:{torch.cuda.current_device()}"


def own_seed(seed: int) -> int:
    """Returns the seed from which this rank draws actions and minibatches; rank 0 draws from ``seed`` itself.

    It has 32 bits: on the CPU, torch ignores further ones.
    """
    return (seed + rank() * 0x9E3779B9) % 2**32


# Start and end.


@contextlib.contextmanager
def joined(device: str) -> Iterator[None]:
    """Connects the ranks that torchrun started, while the block lasts, and gives each its GPU.

    Args:
        device: what the run computes on; its kind chooses NCCL or gloo.

    Yields:
        Nothing.

    Raises:
        ValueError: this machine has no GPU for this rank.
    """
    # torchrun, or a launcher with the same environment variables, may have started this as one of several.
    launched = "RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1
    if not launched or _connected():
        yield
        return
    on_cuda = torch.device(device).type == "cuda"
    own = None
    if on_cuda:
        index, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if index >= count:
            raise ValueError(f"no GPU for local rank {index}, this machine has {count}: start one process a GPU")
        own = torch.device("cuda", index)
        torch.cuda.set_device(own)
    global _joins, _parent
    _joins, _parent = _joins + 1, os.getppid()
    store, number, count = next(rendezvous("env://", timeout=TIMEOUT))
    # torchrun keeps its store when it restarts the ranks, and from one training to the next: they must not find the
    # addresses of those that are gone.
    attempt = dist.PrefixStore(f"attempt {os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}, {_joins}", store)
    backend = "nccl" if on_cuda else "gloo"
    dist.init_process_group(backend, store=attempt, rank=number, world_size=count, timeout=TIMEOUT, device_id=own)
    yield
    # After an error the group is left to the end of the process: closing it could wait for ranks that are gone.
    dist.destroy_process_group()


def launch(count: int, args: Sequence[str]) -> None:
    """Runs ``torchrl-loco`` in several processes of this machine, as ``torchrun --standalone`` does.

    Raises:
        SystemExit: a rank failed; its number is printed.
        KeyboardInterrupt: Ctrl-C or SIGTERM, after which all ranks have ended.
    """
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    os.environ.setdefault("TORCH_ELASTIC_SHUTDOWN_TIMEOUT", str(PATIENCE))  # it kills them after 30 s otherwise
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        run_id=str(uuid.uuid4()),
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
    )
    try:
        with handlers_restored():
            elastic_launch(config, sys.executable)("-m", "torchrl_loco", *args)
    except ChildFailedError as error:
        number, failure = error.get_first_failure()
        if failure.exitcode == 130:
            raise KeyboardInterrupt from None
        how = f"status {failure.exitcode}" if failure.exitcode > 0 else f"signal {failure.signal_name()}"
        print(f"torchrl-loco: rank {number} (process {failure.pid}) ended with {how}", file=sys.stderr)
        raise SystemExit(max(failure.exitcode, 1)) from None
    except SignalException:
        raise KeyboardInterrupt from None


@contextlib.contextmanager
def handlers_restored() -> Iterator[None]:
    """Restores the handlers of the signals that torch's launcher handles, which leaves its own behind."""
    kinds = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
    before = {kind: signal.getsignal(kind) for kind in kinds}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


# What ranks tell each other. All ranks must make the same calls in the same order.


def average(tensors: Sequence[torch.Tensor]) -> None:
    """Replaces tensors of any shapes ``(...)``, such as gradients, by their mean over the ranks, in one message.

    CUDA can record it.
    """
    if ranks() == 1 or not tensors:
        return
    bucket = _reduced(torch.cat([tensor.flatten() for tensor in tensors])) / ranks()
    for tensor, part in zip(tensors, bucket.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def merged_moments(
    count: float | torch.Tensor, mean: torch.Tensor, var: torch.Tensor
) -> tuple[float | torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns number, mean and variance of the samples of all ranks, exactly (Chan's formula).

    Args:
        count: number of samples of this rank.
        mean: their mean, shape ``(n,)``.
        var: their variance, without Bessel's correction, shape ``(n,)``.
    """
    if ranks() == 1:
        return count, mean, var
    own = torch.cat([torch.as_tensor(count, dtype=mean.dtype, device=mean.device).view(1), mean, var])
    rows = own.new_empty(ranks(), len(own))
    with _peers():
        dist.all_gather(list(rows.unbind()), own)
    counts, means, variances = rows.split([1, len(mean), len(var)], dim=1)
    total = counts.sum()
    shares = counts / total
    merged = (shares * means).sum(0)
    return total, merged, (shares * (variances + (means - merged).square())).sum(0)


def mean_of_ranks(values: torch.Tensor) -> torch.Tensor:
    """Returns the mean over the ranks of ``values``, of any shape ``(...)``."""
    return values if ranks() == 1 else _reduced(values.clone()) / ranks()


def add_changes(values: torch.Tensor, before: torch.Tensor) -> None:
    """Writes into ``values`` and ``before``, of any shape and type, what was before plus the changes of all ranks."""
    if ranks() > 1:
        change = _reduced((values - before).double())
        values.copy_(before + change.to(values.dtype))
    before.copy_(values)


def largest_of_ranks(values: torch.Tensor) -> torch.Tensor:
    """Returns the largest over the ranks of each of ``values``, of any shape ``(...)``."""
    return values if ranks() == 1 else _reduced(values.clone(), largest=True)


def any_rank(*flags: bool) -> list[bool]:
    """Returns for each flag whether it is set on some rank."""
    if ranks() == 1:
        return list(flags)
    return largest_of_ranks(torch.tensor(flags, dtype=torch.float32, device=_device())).bool().tolist()


def copy_from_first(tensors: Iterable[torch.Tensor]) -> None:
    """Overwrites ``tensors``, each of any shape ``(...)``, with those of rank 0."""
    if ranks() > 1:
        for tensor in tensors:
            whole = tensor.contiguous()  # rows of weights may have gaps, which are not sent
            with _peers():
                dist.broadcast(whole, src=0)
            tensor.copy_(whole)


def from_first(value: Any) -> Any:
    """Returns the value of rank 0, which pickle must be able to copy."""
    if ranks() == 1:
        return value
    values = [value]
    with _peers():
        dist.broadcast_object_list(values, src=0, device=_device())
    return values[0]


def gathered(state: dict[str, Any]) -> list[dict[str, Any]]:
    """Returns on rank 0 the states of all ranks in their order, with tensors on the CPU; nothing elsewhere."""
    if ranks() == 1:
        return [state]
    buffer = io.BytesIO()  # a pickled tensor of CUDA would be put on its rank's GPU again
    torch.save(state, buffer)
    parts: list[Any] | None = [None] * ranks() if is_first() else None
    with _peers():
        dist.gather_object(buffer.getvalue(), parts)
    return [torch.load(io.BytesIO(part), map_location="cpu", weights_only=True) for part in parts or ()]


def wait_for_all() -> None:
    """Waits until every rank has come here."""
    if ranks() > 1:
        with _peers():
            dist.barrier()


def _reduced(tensor: torch.Tensor, *, largest: bool = False) -> torch.Tensor:
    """Returns a tensor, which now holds the sum over the ranks, or the largest of them."""
    with _peers():
        dist.all_reduce(tensor, dist.ReduceOp.MAX if largest else dist.ReduceOp.SUM)
    return tensor


def _device() -> torch.device:
    """Returns where the messages of this rank lie."""
    return torch.device("cuda", torch.cuda.current_device()) if dist.get_backend() == "nccl" else torch.device("cpu")


@contextlib.contextmanager
def _peers() -> Iterator[None]:
    """Turns a failed exchange into a RankLostError, its usual cause."""
    try:
        yield
    except RuntimeError as error:
        time.sleep(GRACE)
        reason = str(error).splitlines()[0]
        raise RankLostError(f"the other ranks cannot be reached, one of them probably ended: {reason}") from error
