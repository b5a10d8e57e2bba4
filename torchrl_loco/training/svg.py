"""Stochastic value gradients through a learned model (Heess et al., 2015; Amos et al., 2021).

A network learns one control step of the robot from what happened last. From there, actor and critic learn in steps that
are imagined: the model predicts states, and the task's own hooks say what is observed and earned there and what ends.
So the actor ascends the gradient of the imagined return, as in SuperMimic (arXiv 2610.28480), which follows motions.
"""

import contextlib
import copy
import logging
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn
from torchrl.modules import MLP, ProbabilisticActor

from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.imagined import FOUND, Imagined
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, Spaces, make_actor, network_of, normed_layers
from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import SVGConfig
from torchrl_loco.training.dynamics import Dynamics
from torchrl_loco.training.muon import Muon
from torchrl_loco.training.replay import Replay


class SVG(Algorithm):
    """After each batch, some rounds: the model is fitted to windows of what is remembered, actor and critic imagine.

    The policy that is evaluated and kept is a moving average of the one that learns. The one that collects is a copy of
    that, from before the update, on all devices: on CUDA the next batch is collected meanwhile.
    """

    config_type = SVGConfig
    metric_names = (
        *("loss_model", "error_first", "error_last", "grad_norm_model", "lost_of_model"),
        *("imagined_return", "imagined_length", "value", "loss_critic"),
        *("grad_norm_actor", "lost_of_actor", "grad_norm_critic", "lost_of_critic"),
    )
    config: SVGConfig

    def __init__(self, config: SVGConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)
        if spaces.pixels:
            raise ValueError("svg imagines no pixels: train with algorithm='ppo' or 'reppo' from pixels")
        if network is None:
            self._mean: nn.Module = MLP(
                spaces.observation, spaces.action, num_cells=config.hidden, activation_class=nn.SiLU
            )
            nn.init.orthogonal_(self._mean[-1].weight, gain=0.01)  # the first actions are near zero
        else:
            self._mean = network_of(network, spaces.observation, spaces.action)
        self._average = copy.deepcopy(self._mean).requires_grad_(False)
        scale = AddStateIndependentNormalScale(spaces.action, init_value=math.log(config.init_std))
        scale.requires_grad_(False)
        self._shown = copy.deepcopy(self._mean).requires_grad_(False)
        self._collector, self._learner, self.actor = (
            make_actor(spaces, self.device, nn.Sequential(self.norms["observation"], mean, scale), log_prob=False)
            for mean in (self._shown, self._mean, self._average)
        )
        *_, last = config.critic_hidden
        value = nn.Sequential(*normed_layers(spaces.critic, config.critic_hidden), nn.Linear(last, 1))
        self.critic = nn.Sequential(self.norms[spaces.critic_key], value.to(self.device))
        self._target = copy.deepcopy(self.critic[1]).requires_grad_(False)
        actors = {"actor": self.actor, "learner": self._learner, "collector": self._collector}
        parts = {**actors, "critic": self.critic, "target": self._target}
        self.networks, self._rounds = nn.ModuleDict(parts), 0
        self._actor_optimizers = self._optimizers_of("actor", self._mean)
        self._critic_optimizers = [self.make_optimizer("critic", value.parameters())]

    def attach(self, env: LocoEnv) -> None:
        """Makes the model of the robot of an environment, and what imagines its task."""
        config, on_cuda = self.config, self.device.type == "cuda"
        if FOUND not in env.hooks.catalog.memory:
            raise ValueError("svg needs a task that shows its states: train with the task's id or class, not in an env")

        def fused(function: Callable[..., Any], what: str = "") -> Callable[..., Any]:
            bf16 = config.bf16 and bool(what)  # hooks are none of networks
            return self.fused(function, what or "a hook", bf16, combo_kernels=True)

        self._imagined = Imagined(env, config.minibatch_size, config.horizon, fused)
        if (unknown := self._imagined.unknown) and distributed.is_first():
            logging.getLogger("torchrl_loco").warning(
                "svg imagines neither contacts nor sensors of forces: hooks read zeros there for %s", ", ".join(unknown)
            )
        m, sim = env.mj_model, env.config
        self.model = Dynamics(m, sim.ctrl_dt, sim.substeps, config.model_hidden).to(self.device)
        self.networks.add_module("model", self.model)
        self._known = copy.deepcopy(self.model).requires_grad_(False)
        for layer in self._known.net if config.bf16 and on_cuda else ():
            if isinstance(layer, nn.Linear):  # as autocast has them, but once a round
                layer.bfloat16()
        self._model_optimizers = self._optimizers_of("model", self.model.net)
        steps = torch.zeros(config.horizon, config.minibatch_size, 1, device=self.device)
        self._noise, self._units = (steps.repeat(1, 1, count) for count in (self.spaces.action, self._imagined.drawn))
        sizes = {"state": self._imagined.size, "observation": self.spaces.observation}
        self._replay = Replay(config, m, sizes, self.generator)
        self._move, self._dream = fused(self._moved, "the model"), fused(self._dreamt, "the actor")
        self._value, self._target_value = fused(self.critic, "the critic"), fused(self._valued, "the critic")
        self._returns = fused(self._returned)

    def acting(self) -> nn.Module:
        """Returns the actor that learns, as it was before the last update, as a policy for collectors."""
        return self._collector

    @property
    def actors(self) -> list[ProbabilisticActor]:
        """The actor that is kept, the one that learns and the one that collects."""
        return [self.actor, self._learner, self._collector]

    def prepare(self, batch: TensorDictBase) -> NoReturn:
        """Refuses: it remembers batches instead."""
        raise NotImplementedError("svg learns from windows of several batches")

    def gradient_step(self, minibatch: TensorDictBase) -> NoReturn:
        """Refuses, likewise."""
        raise NotImplementedError("svg learns from windows of several batches")

    def update(self, batch: TensorDictBase, progress: float) -> Tensor:
        """Returns the means of the metrics over all rounds of an update, zeros until a window is remembered."""
        self.adopt()
        self.schedule(progress)
        steps = self._replay.keep(batch)
        self.learn_moments(batch)
        self.model.learn_moments(*steps)
        self._imagined.refresh()
        with torch.no_grad():
            torch._foreach_copy_(list(self._shown.state_dict().values()), list(self._mean.state_dict().values()))
        self.began = torch.cuda.current_stream(self.device).record_event() if self.device.type == "cuda" else None
        self._totals.zero_()
        rounds = self.config.epochs if self._replay.has_window else 0
        for _ in range(rounds):
            self._replay.draw_window()
            self._replay.draw_starts()
            self._noise.normal_(generator=self.generator)  # graphs that run at once share the state of torch's own
            self._units.uniform_(generator=self.generator)
            self._learn()
        self._rounds += rounds
        return self._totals / max(rounds, 1)

    def _gradient_steps(self) -> None:
        """Makes a round: fits the model, and then the critic, while the actor imagines and learns by what they were."""
        with torch.no_grad():
            torch._foreach_copy_(list(self._known.state_dict().values()), list(self.model.state_dict().values()))
        alone = distributed.ranks() == 1  # several meet in one order
        with self.beside() if alone else contextlib.nullcontext():
            lesson = self.improve()
        self.fit()
        self.value(*lesson)
        if alone:
            self.join()
        self.follow()

    def schedule(self, progress: float) -> None:
        """Sets the learning rates, as all do; that of the model is its own, and that of the actor 0 at the start."""
        super().schedule(progress)
        for optimizers, factor in (
            (self._model_optimizers, self.config.model_lr / self.config.lr),
            (self._actor_optimizers, float(self._rounds >= self.config.warmup)),
        ):
            for group in (group for optimizer in optimizers for group in optimizer.param_groups):
                group["lr"].mul_(factor)

    # The model.

    def fit(self) -> None:
        """Makes a gradient step of the model: it predicts a window of steps from the first state alone."""
        first, controls, afters, events, valid = self._replay.window
        qpos, qvel, _ = self._imagined.unpacked(first)
        qpos, qvel = qpos.requires_grad_(), qvel.requires_grad_()  # as those of later steps, so that one kernel does
        errors = []
        for ctrl, after, event in zip(controls, afters, events, strict=True):
            qpos, qvel, error = self._move(qpos, qvel, ctrl, after, event)
            errors.append(error)
        by_step = (torch.stack(errors) * valid).sum(1) / valid.sum(1).clamp(min=1.0)
        loss = by_step.mean()
        self._add("loss_model", loss, by_step[0], by_step[-1], *self._descend(self._model_optimizers, loss))

    def _moved(
        self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, after: Tensor, event: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns predicted positions and velocities with what events changed, and the error without."""
        qpos, qvel = self.model(qpos, qvel, ctrl)
        return qpos, qvel + event, self.model.errors(qpos, qvel, after)

    # Actor and critic.

    def improve(self) -> tuple[Tensor, Tensor, Tensor, torch.cuda.Event | None]:
        """Makes a gradient step of the actor, in steps that are imagined from remembered states on.

        Returns:
            What the critic reads of steps, what returns it had, how much each counts, and when these exist.
        """
        rewards, ended, cut, seen = self._imagine()
        values = self._target_value(seen.flatten(0, 1)).view_as(rewards)
        returns, alive = self._returns(rewards, values, ended, cut)
        lesson = seen[:-1].detach().flatten(0, 1), returns[1:].detach(), alive[1:]
        exists = torch.cuda.current_stream(self.device).record_event() if self.device.type == "cuda" else None
        gain = returns[0].mean()
        of_actor = self._descend(self._actor_optimizers, -gain)
        self._add("imagined_return", gain, alive.sum(0).mean(), values.mean())
        self._add("grad_norm_actor", *of_actor)
        return *lesson, exists

    def value(self, seen: Tensor, aims: Tensor, weight: Tensor, exist: torch.cuda.Event | None) -> None:
        """Makes a gradient step of the critic; the arguments are what :meth:`improve` returns."""
        if exist is not None:
            torch.cuda.current_stream(self.device).wait_event(exist)
        loss = ((self._value(seen).float().view_as(aims) - aims).square() * weight).sum() / weight.sum().clamp(min=1.0)
        self._add("loss_critic", loss)
        self._add("grad_norm_critic", *self._descend(self._critic_optimizers, loss))

    @torch.no_grad()
    def follow(self) -> None:
        """Moves the critic that returns are made with, and the policy that is kept, towards those that learn."""
        for mine, new, rate in (
            (self._target, self.critic[1], self.config.target_rate),
            (self._average, self._mean, self.config.average_rate),
        ):
            torch._foreach_lerp_(list(mine.parameters()), list(new.parameters()), rate)

    def _returned(self, rewards: Tensor, values: Tensor, ended: Tensor, cut: Tensor) -> tuple[Tensor, Tensor]:
        """Returns lambda-returns from each step on, and whether the episode goes on before it."""
        over = (ended | cut)[:-1].float()
        alive = torch.cat([torch.ones_like(rewards[:1]), (1.0 - over).cumprod(0)])
        return lambda_returns(rewards, values, ended, cut, self.config.gamma, self.config.lmbda), alive

    def _imagine(self) -> tuple[Tensor, ...]:
        """Returns rewards, whether episodes terminated and were cut off, and what the critic reads after each step.

        Each is ``(horizon, n, ...)``; what comes after an end does not count.
        """
        config, imagined = self.config, self._imagined
        rows, observation = self._replay.starts
        qpos, qvel, rest = imagined.unpacked(rows)
        observation = observation.clone()
        for start in (qpos, qvel, observation, *rest):
            start.requires_grad_(start.is_floating_point())  # as in later steps, so that one kernel does
        judged, over = [], torch.zeros_like(rows[:, 0], dtype=torch.bool)
        for noise, units in zip(self._noise, self._units, strict=True):
            action, qpos, qvel = self._dream(observation, qpos, qvel, noise, *rest)
            said = imagined.judge(qpos, qvel, action, rest, rows, over, units)
            qpos, qvel, rest, over, observation = said.qpos, said.qvel, said.rest, said.over, said.observation
            judged.append(said)
        earned, cut = imagined.earned(judged), torch.stack([said.truncated for said in judged])
        if self.spaces.critic_key in earned.observations:
            seen = earned.observations[self.spaces.critic_key]
        else:
            seen = torch.stack([said.observation for said in judged])
        return config.reward_scale * earned.reward, earned.terminated, cut, seen

    def _dreamt(
        self, observation: Tensor, qpos: Tensor, qvel: Tensor, noise: Tensor, *rest: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the actions that standard normal noise makes, and the positions and velocities they lead to."""
        action = self._mean(self.norms["observation"](observation)).float() + self.config.init_std * noise
        action = action.tanh() if self.spaces.bounded else action
        with torch.autocast(self.device.type, enabled=False):  # a hook
            ctrl = self._imagined.control(qpos, qvel, action, rest)
        return action, *self._known(qpos, qvel, ctrl)

    def _valued(self, rows: Tensor) -> Tensor:
        """Returns the values that returns are made with, ``(n, 1)``."""
        return self._target(self.critic[0](rows)).float()

    # Optimizers.

    def _optimizers_of(self, name: str, network: nn.Module) -> list[Any]:
        """Returns those of a network: Muon for its matrices but the last, Adam for the rest."""
        weights: list[Any] = [part.weight for part in network.modules() if isinstance(part, nn.Linear)]
        matrices = list({id(each): each for each in weights if each is not weights[-1]}.values())  # some may be shared
        taken = set(map(id, matrices))
        rest = self.make_optimizer(name, (each for each in network.parameters() if id(each) not in taken))
        if not matrices:
            return [rest]
        self.optimizers[f"{name} matrices"] = Muon(matrices, torch.tensor(self.config.lr, device=self.device))
        return [rest, self.optimizers[f"{name} matrices"]]

    def _descend(self, optimizers: Iterable[Any], loss: Tensor) -> tuple[Tensor, Tensor]:
        """Makes a step of each optimizer, of zeros if a number of the gradient is not finite.

        Returns:
            The norm of all gradients before, 0 if it is not finite, and whether it is not.
        """
        for optimizer in optimizers:
            optimizer.zero_grad()
        with torch.autograd.set_multithreading_enabled(False):  # Warp belongs to the thread that records
            loss.backward()
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        slopes = [part.grad for group in groups for part in group["params"] if part.grad is not None]
        norm = torch.stack(torch._foreach_norm(slopes)).norm()
        is_lost = ~norm.isfinite()
        for slope in slopes:
            slope.masked_fill_(is_lost, 0.0)
        for optimizer in optimizers:
            clip_and_step(optimizer, self.config.max_grad_norm)
        return norm.nan_to_num(0.0, 0.0, 0.0), is_lost

    def _add(self, first: str, *values: Tensor) -> None:
        """Adds metrics to their totals, from the one that is named on."""
        at = self.metric_names.index(first)
        self._totals[at : at + len(values)] += torch.stack([value.detach().float() for value in values])

    def note(self, metrics: Mapping[str, Sequence[float]]) -> str:
        """Returns that gradients were lost, and why they may be, if some were."""
        lost = {part: max(metrics[f"lost_of_{part}"]) for part in ("model", "actor", "critic")}
        if not any(lost.values()):
            return ""
        shares = ", ".join(f"{share:.0%} of the {part}'s" for part, share in lost.items() if share)
        why = "a hook gives NaN, or has no slope where it is called, as sqrt at 0"
        return f"gradients that were not finite were left out, {shares}: {why}"

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a continuation needs, but for the steps that are remembered."""
        return {**super().state_dict(), "rounds": self._rounds}

    def load_state_dict(self, state: dict[str, Any], draws: bool = True) -> None:
        """Continues from a state, but for the steps that were remembered, which are as large as the worlds' memory."""
        super().load_state_dict(state, draws)
        self._rounds = state["rounds"]
        if distributed.is_first():
            print("svg remembers steps anew: the run differs from one that was not stopped", file=sys.stderr)


def lambda_returns(rewards: Tensor, values: Tensor, ended: Tensor, cut: Tensor, gamma: float, lmbda: float) -> Tensor:
    """Returns lambda-returns from each step on, ``(steps, n)`` as all arguments, through which gradients flow.

    Values are of the states after steps. Nothing follows where an episode ended; where it was cut off, the value does.
    """
    follows, returns = values[-1], []
    for t in range(len(rewards) - 1, -1, -1):
        follows = torch.where(cut[t], values[t], follows)
        returns.append(rewards[t] + torch.where(ended[t], 0.0, gamma * follows))
        follows = torch.lerp(values[t - 1], returns[-1], lmbda)  # of the step before
    return torch.stack(returns[::-1])
