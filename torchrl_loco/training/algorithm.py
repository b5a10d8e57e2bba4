"""What all algorithms share: warm starts, and gradient steps over minibatches, recorded as a graph on CUDA."""

import contextlib
import dataclasses
import importlib
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import ProbabilisticActor

from torchrl_loco.encoder import PixelEncoder, shifted
from torchrl_loco.envs import LocoEnv
from torchrl_loco.policy import ObservationNorm, Policy, check_terms, layers_of, moments
from torchrl_loco.sim import TorchGraph
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, Spaces, layers_of_actor
from torchrl_loco.training.adam import LARGE, FlatAdam, launch
from torchrl_loco.training.config import TrainingConfig
from torchrl_loco.training.run_folder import RunFolder

WARMUP = 1  # calls before one is recorded: cuBLAS allocates at its first product, and torch.compile compiles
RECORDED = 4  # gradient steps of a recording, at most: to record a step takes as long as to make it
ROW_ALIGNED = 16  # bytes at a multiple of which each entry of a row of steps begins; rows at one of twice that


class Algorithm(ABC):
    """Improves an actor on one batch after another.

    A subclass sets ``config_type`` and ``metric_names``, and in ``__init__`` ``actor`` and ``networks``, which are
    saved: of ``norms``, which follow the observations, those belong there that the actor does not hold. It turns a
    batch into what gradient steps need (:meth:`prepare`) and makes one gradient step (:meth:`gradient_step`).

    Args:
        config: the run's settings, of type ``config_type``.
        spaces: what networks read and write.
        network: makes networks of so many inputs and outputs; ``None`` leaves that to the algorithm.
    """

    config_type: ClassVar[type[TrainingConfig]]
    metric_names: ClassVar[tuple[str, ...]]
    """Names of what :meth:`gradient_step` returns."""
    batch_metric_names: ClassVar[tuple[str, ...]] = ()
    """Names of what :meth:`batch_metrics` returns."""

    actor: ProbabilisticActor
    norms: dict[str, ObservationNorm]
    """The norms of what networks read, by entry; ``observation`` is the actor's."""
    networks: nn.Module
    began: torch.cuda.Event | None = None
    """Event of an update after which it reads neither the batch nor the environment: on one rank, the next batch is
    collected from there on. ``None``: after the update."""

    def __init__(self, config: TrainingConfig, spaces: Spaces, network: Network | None = None) -> None:
        self.config, self.spaces, self.network = config, spaces, network
        self.device = torch.device(config.device)
        self.norms = {key: ObservationNorm(size).to(self.device) for key, size in spaces.rows.items()}
        self.optimizers: dict[str, FlatAdam | torch.optim.Optimizer] = {}
        self.generator = torch.Generator(config.device).manual_seed(distributed.own_seed(config.seed))
        self._order = torch.zeros(0, dtype=torch.long, device=config.device)
        self._totals = torch.zeros(len(self.metric_names), device=config.device)
        self._data: Packed | None = None
        on_cuda = self.device.type == "cuda"
        # The longer of two branches goes there (svg's actor), and its kernels first.
        self._stream = torch.cuda.Stream(self.device, priority=-1) if on_cuda else None
        self._learn = TorchGraph(self._gradient_steps, self.device, warmup=WARMUP) if on_cuda else self._gradient_steps

    @abstractmethod
    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what gradient steps need of a ``batch`` of shape ``(num_envs, num_steps)``, in the same shape."""

    @abstractmethod
    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Makes a gradient step without transfers between host and device, so that CUDA can record it.

        Args:
            minibatch: steps that :meth:`minibatches` returned, batch ``(minibatch_size,)``.

        Returns:
            The metrics, a scalar each, in the order of ``metric_names``.
        """

    def minibatches(self, steps: TensorDictBase) -> Iterable[TensorDictBase]:
        """Returns the minibatches of shuffled ``steps`` of an epoch, a copy, which it may change."""
        return steps.split(self.config.minibatch_size)

    def batch_metrics(self, data: TensorDictBase) -> torch.Tensor:
        """Returns metrics of what :meth:`prepare` made of a batch, shape ``(len(batch_metric_names),)``, on all ranks.

        They are computed once for a batch, also without transfers between host and device.
        """
        return torch.zeros(0, device=self.device)

    def note(self, metrics: Mapping[str, Sequence[float]]) -> str:
        """Returns what a user should know of ``metrics``, by name from one batch or several, or an empty string."""
        return ""

    @classmethod
    def start_compilers(cls, config: TrainingConfig) -> None:
        """Starts the compilers of its kernels on CUDA, which take seconds to be ready: torch.compile if it is set."""
        if getattr(config, "compile", False):
            start_compiler()

    def acting(self) -> nn.Module:
        """Returns the actor as a policy for collectors."""
        return self.actor

    @property
    def actors(self) -> list[ProbabilisticActor]:
        """All actors, which begin alike: by itself, one."""
        return [self.actor]

    def attach(self, env: LocoEnv) -> None:
        """Takes what it needs of the environment in which it will train beyond its spaces: nothing, by itself."""
        del env

    def make_optimizer(self, name: str, parameters: Iterable[Any]) -> FlatAdam:
        """Returns ``optimizers[name]``, which it makes of ``parameters`` or groups; recorded steps follow its rate."""
        lr = torch.tensor(self.config.lr, device=self.device)
        self.optimizers[name] = optimizer = FlatAdam(parameters, lr=lr, eps=1e-5)
        return optimizer

    def update(self, batch: TensorDictBase, progress: float) -> torch.Tensor:
        """Updates on one batch, without synchronising with the device.

        Args:
            batch: experience of shape ``(num_envs, num_steps)``; each rank passes its own.
            progress: fraction of the policy's training that is done, in [0, 1], which sets the learning rate.

        Returns:
            The mean of the metrics over all gradient steps, then those of the batch, of shape ``(len(metric_names) +
            len(batch_metric_names),)``.
        """
        config = self.config
        self.adopt()
        self.schedule(progress)
        with self.beside():
            frames = batch.numel()
            orders = [
                torch.randperm(frames, generator=self.generator, device=self.device) for _ in range(config.epochs)
            ]
        with torch.no_grad():
            data = self.prepare(batch).reshape(-1)
            of_batch = self.batch_metrics(data)
            # A remainder smaller than a minibatch is left out: it would weigh as much as a full one.
            steps = frames // config.minibatch_size
            if self._data is None:
                self._data = Packed(data)
                # One recording serves the whole epoch, so its length divides that of the epoch.
                self._order = self._order.new_zeros(math.gcd(steps, RECORDED) * config.minibatch_size)
            else:
                self._data.steps.update_(data)
            del data  # of which that is a copy
        self._totals.zero_()
        self.join()
        for order in orders:
            for part in order[: steps * config.minibatch_size].split(len(self._order)):
                self._order.copy_(part)
                self._learn()
        self.learn_moments(batch)  # after the update: the losses need the normalisation used while collecting
        return torch.cat([self._totals / (config.epochs * steps), of_batch])

    def fused(self, function: Callable[..., Any], what: str, bf16: bool = False, **options: bool) -> Callable[..., Any]:
        """Returns a function of tensors as kernels of torch.compile on CUDA, if the settings ask for that.

        Between the matrix products of small networks, torch spends most of a step reading and writing activations.

        Args:
            function: takes and returns tensors.
            what: what it is, for the error that says that torch.compile cannot trace it.
            bf16: whether it computes in bfloat16 on CUDA, compiled or not.
            options: further ones of torch.compile.
        """

        def in_bf16(*args: Any) -> Any:
            with torch.autocast("cuda", torch.bfloat16):
                return function(*args)

        if self.device.type != "cuda":
            return function
        chosen = in_bf16 if bf16 else function
        if not getattr(self.config, "compile", False):
            return chosen
        # Rows whose length is no multiple of 8 are slow to multiply: those that a Go1's critic reads have 73 numbers.
        return compiled(chosen, what, options={"force_shape_pad": True, **options})

    @contextlib.contextmanager
    def beside(self) -> Iterator[None]:
        """Lets CUDA work on another stream, until :meth:`join`: small networks leave most of it idle."""
        if self._stream is None:
            yield
        else:
            self._stream.wait_stream(torch.cuda.current_stream(self.device))
            with torch.cuda.stream(self._stream):
                yield

    def join(self) -> None:
        """Waits for what was put on the other stream, without the host."""
        if self._stream is not None:
            torch.cuda.current_stream(self.device).wait_stream(self._stream)

    def adopt(self) -> None:
        """Takes parameters back that were moved out of the vectors of their optimizers."""
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, FlatAdam):
                optimizer.adopt()

    def learn_moments(self, batch: TensorDictBase) -> None:
        """Updates the normalisation of what networks read with a batch, and the mean picture with its first step."""
        for key, norm in self.norms.items():
            count, mean, var = distributed.merged_moments(*moments(batch[key]))
            norm.merge(count, mean, var + self.config.norm_eps**2)
        if self.spaces.pixels:
            first = batch["pixels"][:, 0]
            mean = distributed.mean_of_ranks(first.float().mean(0))
            for encoder in (part for part in self.networks.modules() if isinstance(part, PixelEncoder)):
                encoder.merge(len(first) * distributed.ranks(), mean)

    def observed(self, minibatch: TensorDictBase) -> torch.Tensor:
        """Returns what the actor reads of steps; pictures are moved at random if the settings ask for that."""
        observation, most = minibatch[self.spaces.actor_key], self.config.random_shift
        return shifted(observation, most) if self.spaces.pixels and most else observation

    def schedule(self, progress: float) -> None:
        """Sets the learning rate for a batch after ``progress`` of the policy's training, in [0, 1]."""
        lr = self.config.lr * (1.0 - (1.0 - self.config.final_lr_fraction) * progress)
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"].fill_(lr)

    def _gradient_steps(self) -> None:
        """Makes the gradient steps that CUDA records: by default, those on the steps that ``_order`` numbers."""
        assert self._data is not None
        for minibatch in self.minibatches(self._data[self._order]):
            self._totals += torch.stack([metric.detach() for metric in self.gradient_step(minibatch)])

    def release(self) -> None:
        """Forgets the recorded gradient steps: NCCL's communicators wait at their end for graphs that contain them."""
        if isinstance(self._learn, TorchGraph):
            self._learn.release()

    def begin_anew(self) -> None:
        """Draws parameters as at the start of a run, in place, so that what was recorded stays valid."""
        self.restore(type(self)(self.config, self.spaces, self.network).state_dict())

    @torch.no_grad()
    def restore(self, state: dict[str, Any]) -> None:
        """Goes back to the networks and moments of a copy of an earlier :meth:`state_dict`, in place as well.

        The generator goes on.
        """
        self.load_networks(state["networks"])
        for name, optimizer in self.optimizers.items():
            kept = state["optimizers"][name]
            if isinstance(optimizer, FlatAdam):
                optimizer.load_state_dict(kept)
                continue
            for group, before in zip(optimizer.param_groups, kept["param_groups"], strict=True):
                group["lr"].copy_(torch.as_tensor(before["lr"]))
            for index, of_one in optimizer.state_dict()["state"].items():  # one of torch's, of a user's algorithm
                for key, value in of_one.items():
                    value.copy_(kept["state"][index][key]) if index in kept["state"] else value.zero_()

    def load_networks(self, state: Mapping[str, torch.Tensor]) -> None:
        """Copies the parameters of networks, also of runs whose networks in bfloat16 were one level deeper."""
        if state.keys() != self.networks.state_dict().keys():
            state = {re.sub(r"(module\.1)\.0\.(?=\d+\.)", r"\1.", name): value for name, value in state.items()}
        self.networks.load_state_dict(state)

    def state_dict(self) -> dict[str, Any]:
        """Returns all that an exact continuation needs, as it is: not as a copy."""
        return {
            "networks": self.networks.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any], draws: bool = True) -> None:
        """Continues from a ``state`` that :meth:`state_dict` returned.

        Args:
            state: the state.
            draws: whether minibatches are drawn as they would have been: a generator is of one kind of device.
        """
        self.load_networks(state["networks"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        if draws:
            self.generator.set_state(state["generator"].cpu())


class Acting(TensorDictModuleBase):
    """An actor that is called through a faster function, which may write other entries."""

    reads_in_keys_alone = True

    def __init__(
        self,
        actor: ProbabilisticActor,
        act: Callable[[TensorDictBase], TensorDictBase],
        written: Sequence[str] | None = None,
    ) -> None:
        super().__init__()
        self.actor, self._act = actor, act
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys if written is None else list(written)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns ``tensordict`` with the actor's entries."""
        return self._act(tensordict)


def clip_and_step(optimizer: FlatAdam | torch.optim.Optimizer, max_norm: float) -> torch.Tensor:
    """Averages an optimizer's gradients over the ranks, clips them and makes its step; returns their norm before."""
    if isinstance(optimizer, FlatAdam):
        return optimizer.clipped_step(max_norm)
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    distributed.average([parameter.grad for parameter in parameters if parameter.grad is not None])
    norm = nn.utils.clip_grad_norm_(parameters, max_norm)
    optimizer.step()
    return norm


@contextlib.contextmanager
def settings_for_small_networks() -> Iterator[None]:
    """Lets torch compute in one thread on the CPU, and matrix products in TF32 on CUDA; restores the settings after.

    With small networks threads mostly wait for each other, the more so on busy cores. TF32 is three times as fast.
    """
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)


class Packed:
    """A copy of steps whose entries lie one after the other in rows of bytes.

    One kernel shuffles them: a row costs it the same however long. Entries are of any type, batch ``(n,)``.
    """

    def __init__(self, steps: TensorDictBase) -> None:
        self._entries, end = [], 0
        for key, entry in steps.items(True, True):
            size = entry[0].numel() * entry.element_size()
            self._entries.append((key, slice(end, end + size), entry.dtype, entry.shape[1:]))
            end += -(-size // ROW_ALIGNED) * ROW_ALIGNED
        end += -end % (2 * ROW_ALIGNED)
        self._rows = entry.new_zeros(len(steps), end, dtype=torch.uint8)
        self.steps = self._views(self._rows).update_(steps)

    def __getitem__(self, order: torch.Tensor) -> TensorDictBase:
        """Returns the steps with the numbers ``order``, as views of one new matrix."""
        if not self._rows.is_cuda:
            return self._views(self._rows[order])
        words = self._rows.view(torch.int64)
        chosen = words.new_empty(len(order), words.shape[1])
        launch(choose, tuple(chosen.shape), [words, order], [chosen], LARGE)
        return self._views(chosen.view(torch.uint8))

    def _views(self, rows: torch.Tensor) -> TensorDictBase:
        entries = {
            key: rows[:, columns].view(dtype).unflatten(-1, shape) if shape else rows[:, columns].view(dtype)[:, 0]
            for key, columns, dtype, shape in self._entries
        }
        return TensorDict(entries, batch_size=len(rows), device=rows.device)


@wp.kernel(enable_backward=False, grid_stride=False)
def choose(rows: wp.array2d[wp.int64], order: wp.array[wp.int64], out: wp.array2d[wp.int64]):
    i, j = wp.tid()
    out[i, j] = rows[order[i], j]


def begin_from(algorithm: Algorithm, source: Path, device: str, observed: Mapping[str, Mapping[str, int]]) -> None:
    """Gives networks the weights of a run's checkpoint, actor and critic, or the actor those of a policy file.

    ``observed`` has by group of the observation the sizes of its terms by name, in the order in which they come.

    Raises:
        ValueError: they do not fit.
    """
    # A run without a checkpoint has a policy. A checkpoint may be named by its file.
    is_checkpoint = source.is_file() and source.suffix == ".pt"
    folder = source.parent if is_checkpoint else source
    if folder.is_dir() and (is_checkpoint or RunFolder(folder).has_checkpoint):
        run = RunFolder(folder)
        settings = run.load_config(), algorithm.config
        if all(each.from_pixels for each in settings):
            _check_strides(source, *(each.strides for each in settings))
        checkpoint = run.load_checkpoint(device, source if is_checkpoint else None)
        check_order(checkpoint.get("observed", {}), observed, "this run")
        networks = checkpoint["algorithm"]["networks"]
        if "network" in run.given and run.policy.is_file():  # weights do not tell what lies between them
            theirs = layers_of(Policy.load(run.policy, device).module)
            for mine in map(layers_of_actor, algorithm.actors):
                _check_kinds(source, mine, theirs)
        of_settings = {k: v.clone() for k, v in algorithm.networks.state_dict().items() if k.startswith("dual.")}
        try:
            algorithm.load_networks(networks)
        except (RuntimeError, KeyError) as error:
            names = "algorithm", *algorithm.config.widths
            pairs = {name: [getattr(each, name, None) for each in settings] for name in names}
            spaces = dataclasses.asdict(algorithm.spaces)
            pairs |= {name: [size, spaces.get(name)] for name, size in checkpoint.get("spaces", {}).items()}
            differing = [f"{name} {old}, here {new}" for name, (old, new) in pairs.items() if old != new]
            why = ", ".join(differing) or str(error).splitlines()[-1].strip()
            raise ValueError(f"init: the networks of {source} do not fit this run: {why}") from error
        algorithm.networks.load_state_dict(of_settings, strict=False)
        return
    policy = RunFolder(source).load_policy(device) if source.is_dir() else Policy.load(source, device)
    check_order({policy.in_keys[0]: policy.info.get("terms", ())}, observed, "this run")
    for mine in map(layers_of_actor, algorithm.actors):
        theirs = layers_of(policy.module)
        _check_kinds(source, mine, theirs)
        for own, other in zip(mine, theirs, strict=False):
            _copy(own, other, source, last=own is mine[-1])


def check_order(trained: Mapping[str, Iterable[Any]], now: Mapping[str, Mapping[str, int]], task: str) -> None:
    """Checks that each group of the observation comes in the order in which networks were trained on its terms."""
    for group, terms in trained.items():
        check_terms(terms, now.get(group, {}), task)


def _check_kinds(source: Path, mine: list[nn.Module], theirs: list[nn.Module]) -> None:
    """Checks that layers are of the same kinds; behind an actor's last a policy may have a tanh and its bound."""
    kinds = [", ".join(type(layer).__name__ for layer in layers) for layers in (theirs[: len(mine)], mine)]
    if kinds[0] != kinds[1]:
        raise ValueError(f"init: the policy of {source} has layers {kinds[0]}, this run {kinds[1]}")


def _check_strides(source: Path, theirs: tuple[int, ...], own: tuple[int, ...]) -> None:
    """Checks that convolutions step alike: their weights do not tell."""
    if theirs != own:
        raise ValueError(f"init: the networks of {source} do not fit this run: strides {theirs}, here {own}")


def _copy(own: nn.Module, other: nn.Module, source: Path, *, last: bool) -> None:
    """Copies the weights of a layer; the last of an actor also gives what a policy does not have: its deviations."""
    if isinstance(own, PixelEncoder) and isinstance(other, PixelEncoder):
        _check_strides(source, other.strides, own.strides)
    mine, theirs = own.state_dict(), other.state_dict()
    for name, values in theirs.items():
        if name not in mine and isinstance(own, nn.LayerNorm) and (values == float(name == "weight")).all():
            continue  # which a file has for a norm without
        fits = name in mine and mine[name].shape[1:] == values.shape[1:]
        rows = len(values) if values.ndim else 1
        if not fits or (values.ndim and len(mine[name]) not in (rows, 2 * rows * last)):
            shapes = [tuple(each[name].shape) if name in each else None for each in (theirs, mine)]
            raise ValueError(f"init: the policy of {source} has {name} of shape {shapes[0]}, this run {shapes[1]}")
        if values.ndim:
            mine[name][:rows] = values
        else:
            mine[name] = values
    own.load_state_dict(mine)


def start_compiler() -> None:
    """Imports the compiler, and with it starts the processes that compile kernels: they take seconds to be ready."""
    importlib.import_module("torch._inductor.compile_fx")
    importlib.import_module("torch._inductor.async_compile").maybe_warm_pool()


def compiled(function: Callable[..., Any], what: str, **settings: Any) -> Callable[..., Any]:
    """Returns what torch.compile makes of a function of tensors, as a whole and for one shape, at the first call.

    It raises a ``TypeError`` that names ``what`` if torch.compile cannot trace it.
    """

    def call(*args: Any) -> Any:
        return function(*args)

    # torch.compile limits a code object to 8 versions, which further trainings of a process would exceed.
    call.__code__ = call.__code__.replace()
    kernels = torch.compile(call, fullgraph=True, dynamic=False, **settings)

    def run(*args: Any) -> Any:
        try:
            return kernels(*args)
        except torch._dynamo.exc.Unsupported as error:
            raise TypeError(f"torch.compile cannot trace {what}; train with compile=False: {error}") from error

    return run
