"""A collector that never waits for the device, and records whole rollouts as CUDA graphs."""

import contextlib
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import EnvBase, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeProbabilisticModule

from torchrl_loco.checks import ANY, Interval, check_int
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.state import State
from torchrl_loco.envs.transforms import PLAIN_TRANSFORMS, load_transforms, state_of_transforms, unwrap
from torchrl_loco.sim import TorchGraph


class RolloutCollector:
    """Collects batches of consecutive steps, across episodes; iterable like TorchRL's ``Collector``.

    A batch has the layout of TorchRL's: shape ``(num_envs, steps)``, with observation and action at the root and the
    result of the step under ``"next"``. Each batch continues where the last one ended. Environment and policy run
    without gradients, and without synchronisation with the device unless the policy itself synchronises.

    On CUDA the third batch is recorded as one CUDA graph, policy and resets included, and every further batch is a
    replay of it: the host has nothing to do but to start it. The data is the same, to the bit. That needs the engine
    ``compiled`` and a policy that is an ``nn.Module`` without synchronisation or state on the host, whose weights are
    updated in place; :attr:`step_by_step` tells why something else is not recorded.

    Args:
        env: an environment of this package, or one in :class:`torchrl_loco.TransformedEnv`.
        policy: reads the observation ``(num_envs, n)`` from a TensorDict and writes the action ``(num_envs, nu)``.
        frames_per_batch: steps in a batch, over all worlds; a multiple of the number of worlds.
        total_frames: steps over all batches, rounded up to whole batches; -1 never ends.
        exploration_type: how a stochastic policy chooses actions.

    Attributes:
        step_by_step: why batches are collected step by step; ``None`` if they are recorded, or will be.

    Raises:
        ValueError: ``frames_per_batch`` is not a positive multiple of the number of worlds, or ``total_frames`` is
            below -1.
        TypeError: one of them is no integer, or the policy cannot be called.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Callable[[TensorDictBase], TensorDictBase],
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
    ) -> None:
        worlds = env.batch_size.numel()
        if not callable(policy):
            raise TypeError(f"policy must be a function or module from TensorDict to TensorDict, got {policy!r}")
        check_int("total_frames", total_frames, Interval(-1, math.inf))
        if check_int("frames_per_batch", frames_per_batch, ANY) < 1 or frames_per_batch % worlds:
            raise ValueError(
                f"frames_per_batch must be a positive multiple of the {worlds} worlds, got {frames_per_batch}"
            )
        self._env = env
        self._base, _ = unwrap(env)
        self._policy = policy
        self._steps = frames_per_batch // worlds
        self._frames_per_batch = frames_per_batch
        self._total_frames = total_frames
        self._exploration_type = exploration_type
        self._carried: TensorDictBase | None = None
        self._recording: Recording | None = None
        self._warm = False
        self._rewritten = rewritten_by(policy)  # need not be zeroed where a world is reset
        self.step_by_step = what_forbids_recording(env, self._base, policy)

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields batches until ``total_frames`` are collected."""
        frames = 0
        while self._total_frames < 0 or frames < self._total_frames:
            yield self.rollout()
            frames += self._frames_per_batch

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Returns the next batch, of shape ``(num_envs, steps)``, in memory of its own."""
        if self._base.is_closed:
            self._carried, self._recording, self._warm = None, None, False
        if self._carried is None:
            self._carried = self._env.reset()
        with set_exploration_type(self._exploration_type):
            steps = self._recorded_steps() if self._can_replay() else self._direct_steps()
        return stack(steps).refine_names(..., "time")

    @property
    def replays(self) -> bool:
        """Whether batches are collected by a recording, without the host."""
        return self._recording is not None and self._recording.works

    def _take_steps(
        self, td: TensorDictBase, interruptible: bool = False
    ) -> tuple[list[TensorDictBase], TensorDictBase]:
        """Returns the steps of a batch that begins with ``td``, and what the next one begins with.

        Where it can be interrupted, the next batch goes on from the last whole step, or from a reset if there is half
        of one.

        Raises:
            TypeError: the policy returns no TensorDict.
        """
        steps = []
        for _ in range(self._steps):
            current = self._policy(td)
            if not isinstance(current, TensorDictBase):
                raise TypeError(f"policy must return the TensorDict with an action, got {type(current).__name__}")
            if current is not td:  # perhaps with the action alone
                current = td.update(current)
            if interruptible:
                self._carried = None
            if steps_as_ours(self._env):
                current, td = self._base._step_and_maybe_reset(current, self._rewritten)
            else:
                current, td = self._env.step_and_maybe_reset(current)
            if interruptible:
                self._carried = td
            steps.append(current)
        return steps, td

    def _direct_steps(self) -> list[TensorDictBase]:
        """Returns steps that are taken one by one; the second time, if nothing waits for the device, it records."""
        watch = self.step_by_step is None and self._warm
        watching: contextlib.AbstractContextManager[list[str]] = (
            noted_synchronisation() if watch else contextlib.nullcontext([])
        )
        with watching as waits:
            steps, self._carried = self._take_steps(self._carried, interruptible=True)
        if waits:
            self._go_step_by_step(f"something waits for the device ({waits[0]})")
        elif watch:
            self._recording = Recording(self._take_steps, self._carried, self._policy, self._base)
        self._warm = True  # what is only done once, and may wait, is done
        return steps

    def _can_replay(self) -> bool:
        """Returns whether there is a recording that belongs to the present worlds and weights."""
        if self._recording is None:
            return False
        if self._recording.world is not self._base.world:
            self._recording, self._warm = None, False  # the environment was closed and opened again
        elif self._carried is not self._recording.carried and self._lacks_entries():
            self._recording, self._warm = None, False  # a policy's memory begins anew, as the policy says
        elif self._recording.has_other_weights():
            self._go_step_by_step(
                "the policy's weights were replaced, or it changed between training and evaluation mode; update "
                "weights in place to keep the recording"
            )
        return self._recording is not None

    def _lacks_entries(self) -> bool:
        """Returns whether a batch is to begin without an entry that the recording begins with."""
        assert self._recording is not None
        assert self._carried is not None
        return bool({*self._recording.carried.keys(True, True)} - {*self._carried.keys(True, True)})

    def _recorded_steps(self) -> list[TensorDictBase]:
        assert self._recording is not None
        if self._carried is not self._recording.carried:
            self._recording.carried.update_(self._carried)
        try:
            steps = self._recording.replay()
        except RuntimeError as error:
            if self._recording.works:
                raise
            self._go_step_by_step(f"the policy cannot be recorded as a CUDA graph: {error}")
            return self._direct_steps()
        self._carried = self._recording.carried
        self._base.world.poll(self._steps)
        return steps

    def _go_step_by_step(self, why: str) -> None:
        self.step_by_step, self._recording = why, None
        logging.getLogger("torchrl_loco").warning("batches are collected step by step: %s", why)

    def state_dict(self) -> dict[str, Any]:
        """Returns a copy of the state of worlds and transforms, and of the data that the next batch begins with.

        Of transforms it is what their ``state_dict`` holds, such as what ``VecNormV2`` has learned.

        Raises:
            TypeError: it collects in an environment of TorchRL's, such as ``SerialEnv``.
        """
        if not isinstance(self._base, LocoEnv):
            raise TypeError(f"the state of {type(self._base).__name__} is not known: collect in one environment")
        state: dict[str, Any] = {"transforms": state_of_transforms(self._env)}
        if self._carried is not None:
            worlds = self._base.get_state()
            again = ["pixels"] if "pictures" in worlds.keys() else []  # noqa: SIM118, the state holds them
            state |= {"carried": self._carried.exclude(*again).clone().to_dict(), "env": worlds.to_dict()}
            of_env = {*self._env.observation_spec, *self._env.done_spec, *self._env.state_spec}
            state["remembered"] = [key for key in self._carried.keys() if key not in of_env]  # noqa: SIM118, no dict
            state |= {"seed": self._base.seed, "first_world": self._base.world_offset or 0}
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a ``state`` that :meth:`state_dict` returned, in an environment of the same settings.

        The environment takes its seed from there.

        Without the entries of worlds they begin anew, with a reset of all; without that of transforms, those go on as
        they are. If the environment returns other entries by now, such as other terms of the reward, it is those that
        the next batch begins with.

        Raises:
            ValueError: the state is of other worlds.
        """
        self._carried = None
        if "carried" in state:
            own = [self._base.num_envs, self._base.world_offset or 0]
            worlds = [len(state["env"]["elapsed_steps"]), state.get("first_world", own[1])]
            if worlds != own:
                raise ValueError(f"the state is of {worlds[0]} worlds from {worlds[1]} on, not {own[0]} from {own[1]}")
            size, device = self._env.batch_size, self._env.device
            returned = self._env.reset(State(state["env"], batch_size=size, device=device), set_state=True)
            of_env = {*self._env.observation_spec.keys(), *self._env.state_spec.keys()}
            stale = set(State.KEYS) - of_env  # which TorchRL's TransformedEnv returns, and collectors once kept
            begin = TensorDict({k: v for k, v in returned.items() if k not in stale}, batch_size=size, device=device)
            carried = TensorDict(state["carried"], batch_size=size, device=device)
            dropped = stale if "qpos" in carried else set()
            remembered = [name for name in state.get("remembered", ()) if name not in dropped]
            kept = carried.select(*begin.keys(True, True), *remembered, strict=False)
            self._carried = begin.update(kept)
            if "seed" in state:  # on which later episodes depend
                self._base._continue_with(state["seed"])
        if "transforms" in state:  # after the reset, from which some learn
            load_transforms(self._env, state["transforms"])

    def shutdown(self) -> None:
        """Does nothing: TorchRL's ``Collector`` has this method."""


FORWARDS = {
    *(TensorDictModule.forward, TensorDictSequential.forward),
    *(ProbabilisticTensorDictModule.forward, ProbabilisticTensorDictSequential.forward),
    SafeProbabilisticModule.forward,
}
"""Of modules that read nothing but their ``in_keys``."""


def rewritten_by(policy: Any) -> frozenset[NestedKey]:
    """Returns the entries that a policy writes anew at each step, if no part of it reads others than ``in_keys``.

    Others may remember something there, such as noise that is correlated in time.
    """
    if not isinstance(policy, TensorDictModuleBase):
        return frozenset()
    for part in policy.modules():
        plain = type(part).forward in FORWARDS or getattr(part, "reads_in_keys_alone", False)
        if isinstance(part, TensorDictModuleBase) and not plain:
            return frozenset()
    return frozenset(policy.out_keys) - set(policy.in_keys)


def steps_as_ours(env: EnvBase) -> bool:
    """Returns whether an environment's ``step_and_maybe_reset`` is this package's, neither overridden nor compiled."""
    names = "step_and_maybe_reset", "_step_and_maybe_reset"
    own = all(getattr(type(env), name) is getattr(LocoEnv, name) for name in names)
    return own and "_compiled_step_and_maybe_reset" not in vars(env)


def stack(steps: Sequence[TensorDictBase]) -> TensorDictBase:
    """Returns consecutive steps, each of batch ``(*batch,)``, as one TensorDict of batch ``(*batch, steps)``."""
    first = steps[0]
    apart = [key for key, entry in first.items(True, True) if stacks_slowly(entry, first.ndim)]
    batch = TensorDict.stack([step.exclude(*apart) for step in steps] if apart else steps, dim=-1)
    for key in apart:
        batch.set(key, torch.stack([step[key] for step in steps]).movedim(0, first.ndim).contiguous())
    return batch


def stacks_slowly(entry: Any, dim: int) -> bool:
    """Returns whether torch stacks such tensors faster along dimension 0, and moves that to ``dim``, than at ``dim``.

    On CUDA it does if the entry of one world takes between 16 and 128 bytes and no multiple of 16 (131072 actions of 6
    numbers, 20 steps, H200: 0.08 instead of 0.29 ms).
    """
    if not isinstance(entry, torch.Tensor) or not entry.is_cuda:
        return False
    size = entry.shape[dim:].numel() * entry.element_size()
    return 16 < size < 128 and size % 16 != 0


class Recording:
    """The steps of a batch as one CUDA graph.

    ``take_steps`` takes the steps of a batch that begins with a TensorDict, such as ``carried``; it returns them, and
    what the next begins with. The environment is without transforms.
    """

    def __init__(
        self,
        take_steps: Callable[[TensorDictBase], tuple[list[TensorDictBase], TensorDictBase]],
        carried: TensorDictBase,
        policy: Any,
        env: LocoEnv,
    ) -> None:
        self.carried = carried.clone()  # what the next batch begins with, at an address that stays
        self.world, self.works = env.world, False  # whether it was replayed at least once
        self._policy, self._addresses = policy, addresses(policy)
        self._take_steps, self._taken = take_steps, [carried]
        self._graph = TorchGraph(self._work, env.device)

    def has_other_weights(self) -> bool:
        """Returns whether the policy computes with other tensors than those that were recorded."""
        return self._addresses != addresses(self._policy)

    def _work(self) -> None:
        self._taken, carried = self._take_steps(self.carried.clone())
        self.carried.update_(carried)

    def replay(self) -> list[TensorDictBase]:
        """Returns the steps; the next call overwrites them."""
        self._graph()
        self.works = True
        return self._taken


def what_forbids_recording(env: EnvBase, base: LocoEnv, policy: Any) -> str | None:
    """Returns why the rollouts of a policy in an environment are not recorded, or ``None`` if they can be."""
    if base.device is None or base.device.type != "cuda":
        return "only CUDA has graphs of torch's work"
    if base.engine != "compiled":
        return f"engine {base.engine!r} launches too many kernels to gain from it"
    if not base.compile_hooks:
        return "compile_hooks=False runs hooks at every step"
    if not isinstance(policy, nn.Module):
        return "the policy is no nn.Module, so it would not be noticed if its weights were replaced"
    for transform in (part for each in unwrap(env)[1] for part in each.modules()):
        if isinstance(transform, Transform) and type(transform) not in PLAIN_TRANSFORMS:
            return f"{type(transform).__name__} may keep something on the host from step to step"
    return None


def addresses(module: nn.Module) -> list[int | bool]:
    """Returns what a recording of a module depends on: where its tensors are, and whether its parts train."""
    tensors = [*module.parameters(), *module.buffers()]
    return [*(tensor.data_ptr() for tensor in tensors), *(part.training for part in module.modules())]


@contextlib.contextmanager
def noted_synchronisation() -> Iterator[list[str]]:
    """Yields a list that holds, afterwards, where the host waited for CUDA."""
    found: list[str] = []
    before = torch.cuda.get_sync_debug_mode()
    if before != 0:  # somebody else watches, who will say so
        yield found
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield found
        finally:
            torch.cuda.set_sync_debug_mode(before)
    for warning in caught:
        text = str(warning.message)
        if "called a synchronizing CUDA operation" in text:
            found.append(f"{warning.filename}:{warning.lineno}")
        elif "Synchronization debug mode is a prototype" not in text:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
