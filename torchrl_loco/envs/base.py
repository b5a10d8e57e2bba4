"""What all locomotion environments share: specs, step, reset, seeding, time limit, state. Knows no task."""

import dataclasses
import secrets
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded

from torchrl_loco import models
from torchrl_loco.checks import check_count, check_device, check_flag, check_new_file, check_seed
from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.envs.autoreset import AsyncReset
from torchrl_loco.envs.bad_world import BadWorldTrap
from torchrl_loco.envs.checks import check_model, check_poses, check_subclass
from torchrl_loco.envs.episode import any_world, apply_action, begin_episode, count_step, quench
from torchrl_loco.envs.health import Health
from torchrl_loco.envs.lifecycle import Closable
from torchrl_loco.envs.state import Resumable, State, write_state
from torchrl_loco.envs.watcher import Watcher
from torchrl_loco.rendering import Renderer
from torchrl_loco.sim import EXCLUSIVE, Simulation
from torchrl_loco.sim.sampling import draw_from_table


class LocoEnv(AsyncReset, Resumable, Closable):
    """Base of the locomotion environments: batched worlds of one body on one device.

    A subclass names its ``body``, ``mjcf`` (path of the model), ``defaults`` (settings under ``playground``),
    ``observation_size`` and ``term_names``, and the kernel that fills the observation, the reward and its terms
    (``_observation_kernel``). Initial poses are drawn from a table (``_initial_poses``) or by a kernel of the
    subclass's own (``_launch_pose``). Everything else is here; docs/guides/extending.md goes through it with a third
    body.

    Args:
        num_envs: number of worlds, the batch size.
        device: where physics and tensors live; ``None`` takes CUDA if there is any, else the CPU.
        seed: integer in [0, 2**32) that, with world and episode, decides every random draw; ``None`` takes a fresh one.
        protocol: ``"playground"`` (the solver cut short, fast) or ``"dm_control"`` (the solver converged).
        reward_terms: whether to return each factor of the reward under ``("next", "reward_terms", name)``.
        stagger: whether a full ``reset()`` starts each world at a random point of its time limit, so that the worlds
            are not truncated together.
        on_overflow: what to do when contacts or constraints find no room and are left out: ``"warn"``, ``"raise"`` or
            ``"ignore"``. It is noticed within some 100 steps, without waiting for the device; see :meth:`health`.
        bad_world_file: a file, not there yet, that is to hold the state and action from which a world first became not
            finite, for ``torchrl-loco replay``. It is written within some 100 steps, or by :meth:`close`.
        config: fields of :class:`torchrl_loco.SimConfig` to override.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
    """

    body: ClassVar[str]
    mjcf: ClassVar[Path]
    defaults: ClassVar[SimConfig]
    observation_size: ClassVar[int]
    term_names: ClassVar[tuple[str, ...]]

    _has_frame_skip = True  # the substeps are our own
    _supports_set_state = True

    def __init__(
        self,
        num_envs: int = 1,
        device: torch.device | str | None = None,
        seed: int | None = None,
        protocol: str = "playground",
        *,
        reward_terms: bool = False,
        stagger: bool = False,
        on_overflow: str = "warn",
        bad_world_file: Path | str | None = None,
        **config: Any,
    ) -> None:
        check_subclass(type(self))
        num_envs = check_count("num_envs", num_envs)
        seed = secrets.randbits(32) if seed is None else check_seed(seed)
        device = check_device(device)
        self.config = sim_config(self.defaults, protocol, num_envs, config)
        self.protocol = protocol
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs, self.seed = num_envs, seed
        self.reward_terms, self.stagger = check_flag("reward_terms", reward_terms), check_flag("stagger", stagger)
        self.on_overflow = on_overflow
        self.bad_world_file = None if bad_world_file is None else check_new_file("bad_world_file", bad_world_file)
        self._open()
        self._make_specs()

    def _build(self) -> None:
        # The device: else torch's views of Warp's arrays would follow the caller's default device.
        with EXCLUSIVE, self.device:
            self.sim = Simulation(check_model(models.from_path(self.mjcf)), self.config, self.num_envs, self.device)
            self._make_buffers()
            self._health = Health(self.sim, self._bad, self.on_overflow)
            self._watchers: list[Watcher] = [self._health]
            if self.bad_world_file is not None:
                inputs = self._action, self._episode, self._elapsed_steps
                self._watchers.append(BadWorldTrap(self.bad_world_file, self.sim, inputs, self._bad, self._describe))
            self._prepare()
            self._make_poses()
            self.sim.compile(self._launch_step, self._launch_reset, self._launch_refresh)
            self._step_graph = self.sim.capture(self._launch_step)
            self._reset_graph = self.sim.capture(self._launch_reset)
            self._refresh_graph = self.sim.capture(self._launch_refresh)
            wp.synchronize_device(self.sim.device)  # made on Warp's stream, used on torch's
            self._set_seed(self.seed)  # and begin anew: recording has drawn episodes
            for watcher in self._watchers:
                watcher.restart()
        self._renderers: dict[tuple[str, int, int], Renderer] = {}

    def __repr__(self) -> str:
        name, device = type(self).__name__, str(self.device)
        return f"{name}(num_envs={self.num_envs}, {device=}, protocol={self.protocol!r}, seed={self.seed})"

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled MuJoCo model, with the options that the simulation uses."""
        return self.sim.mj_model

    # What a body adds.

    def _prepare(self) -> None:
        """Makes what the body's kernels need, once, before they are recorded."""

    def _observation_kernel(self) -> tuple[wp.Kernel, list]:
        """Returns the kernel that observes, and what it reads.

        Its parameters are these, then the mask of the worlds to observe (bool, ``(num_envs,)``; all after a step, those
        that begin anew after a reset), then what it fills there: ``_observation``, ``_reward`` and ``_terms``.
        """
        raise NotImplementedError

    def _initial_poses(self) -> np.ndarray | None:
        """Returns a table of poses, ``(count, nq)``, for each reset to draw one of; ``None`` for the default pose.

        It is asked for when the environment is made, and again when it opens after :meth:`close`: draw from a fixed
        seed.
        """
        return None

    def _launch_pose(self) -> None:
        """Launches the kernel that draws ``qpos`` of the worlds in ``_mask``: by default from the table, if any.

        They are at rest in the default pose, and stay at rest: what is drawn is ``qpos`` alone.
        """
        if self._poses is not None:
            inputs = [self._poses, self._seed, self._episode, self._mask]
            self._launch(draw_from_table, inputs, [self.sim.data.qpos])

    # Setting up.

    def _make_buffers(self) -> None:
        n, device = self.num_envs, self.sim.device
        self._action = wp.zeros((n, self.mj_model.nu), dtype=float, device=device)
        self._observation = wp.zeros((n, self.observation_size), dtype=float, device=device)
        self._reward = wp.zeros(n, dtype=float, device=device)
        self._terms = wp.zeros((n, len(self.term_names)), dtype=float, device=device)
        self._mask = wp.ones(n, dtype=bool, device=device)
        self._everyone = wp.ones(n, dtype=bool, device=device)
        self._any = wp.zeros(1, dtype=int, device=device)
        self._stagger = wp.zeros(1, dtype=bool, device=device)
        self._seed = wp.zeros(1, dtype=wp.uint32, device=device)
        self._episode = wp.zeros(n, dtype=int, device=device)
        self._elapsed_steps = wp.zeros(n, dtype=int, device=device)
        self._bad = wp.zeros(n, dtype=bool, device=device)
        self._done = wp.zeros(n, dtype=bool, device=device)
        self._terminated = wp.zeros(n, dtype=bool, device=device)
        self._truncated = wp.zeros(n, dtype=bool, device=device)
        # Torch's views of the same memory, for the transfers at the border.
        names = ("action", "observation", "reward", "terms", "mask", "stagger", "seed", "episode", "elapsed_steps")
        flags = ("bad", "done", "terminated", "truncated")
        self._views = {name: wp.to_torch(getattr(self, f"_{name}")) for name in names + flags}

    def _make_poses(self) -> None:
        poses = self._initial_poses()
        if poses is not None:
            poses = wp.array(check_poses(poses, self.mj_model.nq), dtype=float, device=self.sim.device)
        self._poses = poses

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device
        as_float: dict[str, Any] = {"device": device, "dtype": torch.float32}
        observation = {"observation": Unbounded((n, self.observation_size), **as_float)}
        if self.reward_terms:
            terms = {name: Unbounded((n, 1), **as_float) for name in self.term_names}
            observation["reward_terms"] = Composite(terms, shape=(n,), device=device)
        flag = Binary(n=1, shape=(n, 1), dtype=torch.bool, device=device)
        self.observation_spec = Composite(observation, shape=(n,), device=device)
        self.action_spec = Bounded(-1.0, 1.0, (n, self.mj_model.nu), **as_float)
        # In [0, 1], but RewardSum takes the bounds over for the sum.
        self.reward_spec = Unbounded((n, 1), **as_float)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(n,), device=device
        )

    # What the graphs record.

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.num_envs, inputs=inputs, outputs=outputs, device=self.sim.device)

    def _launch_step(self) -> None:
        for watcher in self._watchers:
            watcher.launch_before_step()
        self._launch(apply_action, [self._action], [self.sim.data.ctrl, self._bad])
        self.sim.step()
        self._launch_outputs(self._everyone)
        self._launch(
            count_step,
            [self._bad, self.config.episode_length],
            [self._elapsed_steps, self._done, self._terminated, self._truncated],
        )
        for watcher in self._watchers:
            watcher.launch_after_step()

    def _launch_reset(self) -> None:
        self._any.zero_()
        self._launch(any_world, [self._mask], [self._any])
        wp.capture_if(self._any, self._launch_masked_reset)  # costs next to nothing where no world is done

    def _launch_masked_reset(self) -> None:
        self.sim.reset(self._mask)
        self._launch_pose()
        self._launch(
            begin_episode,
            [self._mask, self._stagger, self._seed, self.config.episode_length],
            [self._episode, self._elapsed_steps, self._bad, self._done, self._terminated, self._truncated],
        )
        self.sim.place(self._mask)
        self._launch_outputs(self._mask)

    def _launch_refresh(self) -> None:
        self.sim.forward(self._mask)
        self._launch_outputs(self._mask)

    def _launch_outputs(self, mask: wp.array) -> None:
        data = self.sim.data
        kernel, inputs = self._observation_kernel()
        outputs = [self._observation, self._reward, self._terms]
        self._launch(kernel, [*inputs, mask], outputs)
        self._launch(quench, [mask, data.qpos, data.qvel], [self._bad, *outputs])

    # TorchRL's side.

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse_after_fork()
        action = tensordict.get("action", None)
        if action is None:
            raise KeyError(f"step needs an 'action' of shape {tuple(self._views['action'].shape)} in its TensorDict")
        if action.shape != self._views["action"].shape:
            raise ValueError(f"action must have shape {tuple(self._views['action'].shape)}, got {tuple(action.shape)}")
        self._views["action"].copy_(action.detach())  # else the buffer would hold on to every past policy's graph
        self._step_graph.replay()
        for watcher in self._watchers:
            watcher.after_step()
        result = self._read_outputs()
        result.set("reward", self._views["reward"].clone().unsqueeze(-1))
        return result

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False) -> TensorDictBase:
        self._refuse_after_fork()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if self.is_closed:
            if mask is not None and not mask.all():
                raise ValueError("a closed environment has no worlds to keep: reset all of them")
            self._open()
        if mask is None:
            self._views["mask"].fill_(True)
        else:
            self._views["mask"].copy_(mask.reshape(self.num_envs))
        if set_state:
            self._restore(tensordict)
            self._refresh_graph.replay()
        else:
            self._views["stagger"].fill_(self.stagger and mask is None)
            self._reset_graph.replay()
        result = self._read_outputs()
        if self.reward_terms:
            result.get("reward_terms").zero_()  # nothing was rewarded yet
        return result

    def _read_outputs(self) -> TensorDict:
        """Returns a copy of what the kernels wrote: the buffers themselves change at the next step."""
        views = self._views
        entries: dict[str, Any] = {
            name: views[name].clone().unsqueeze(-1) for name in ("done", "terminated", "truncated")
        }
        entries["observation"] = views["observation"].clone()
        if self.reward_terms:
            columns = views["terms"].clone().split(1, dim=-1)
            entries["reward_terms"] = dict(zip(self.term_names, columns, strict=True))
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Starts the random streams of all worlds anew, at their episode 0."""
        if seed is None:
            seed = secrets.randbits(32)
        seed = check_seed(seed)
        self.seed = seed
        self._views["seed"].fill_(seed)
        self._views["episode"].zero_()

    def health(self) -> TensorDict:
        """Returns what went wrong in the physics since the environment was made.

        ``"worlds"`` (batch ``(num_envs,)``) and ``"total"`` count control steps in which

        - ``constraint_overflow``, ``contact_overflow``: constraints or contacts found no room and were left out.
          Contacts are pooled: if some find no room, that counts in every world.
        - ``iteration_limit``, ``line_search_limit``: the solver or its line search used up its iterations, which is the
          rule under ``protocol="playground"``.
        - ``non_finite``: the world was no longer finite, and terminated.

        ``"peak"`` holds the most ``constraints`` of a world and ``contacts`` of all worlds together that any physics
        step asked for, to choose ``njmax`` and ``naconmax`` by. Nothing waits for the device until you read a number.
        """
        return self._health.report()

    # State.

    def get_state(self) -> State:
        """Returns a copy of the state of all worlds, for ``env.reset(state, set_state=True)``."""
        return State(
            {
                "qpos": self.sim.qpos.clone(),
                "qvel": self.sim.qvel.clone(),
                "qacc_warmstart": self.sim.qacc_warmstart.clone(),
                "elapsed_steps": self._views["elapsed_steps"].clone(),
                "episode": self._views["episode"].clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _describe(self) -> dict[str, Any]:
        """Returns what it takes to make an environment like this one."""
        cls = type(self)
        return {
            **{"env": f"{cls.__module__}.{cls.__qualname__}", "protocol": self.protocol, "seed": self.seed},
            **{"config": dataclasses.asdict(self.config), "device": str(self.device), "num_envs": self.num_envs},
        }

    def _restore(self, state: TensorDictBase | None) -> None:
        """Writes a state into the worlds in the mask."""
        mask, elapsed_steps = self._views["mask"], self._views["elapsed_steps"]
        targets = {name: getattr(self.sim, name) for name in ("qpos", "qvel", "qacc_warmstart")}
        write_state(state, {**targets, "elapsed_steps": elapsed_steps, "episode": self._views["episode"]}, mask)
        for flag in ("bad", "done", "terminated", "truncated"):
            self._views[flag].masked_fill_(mask, False)
        self.sim.time.copy_(torch.where(mask, elapsed_steps * self.config.ctrl_dt, self.sim.time))

    # Pictures, and the way out.

    def render(self, camera: str = "side", width: int = 320, height: int = 240) -> torch.Tensor:
        """Ray-traces every world, on the CPU or CUDA, without OpenGL.

        Args:
            camera: ``"side"``, ``"back"`` or ``"egocentric"``.
            width: pixels in a row.
            height: rows.

        Returns:
            uint8 tensor of shape ``(num_envs, height, width, 3)``.

        Raises:
            ValueError: the model has no such camera, or a size is not positive.
            TypeError: a size is not an integer.
        """
        key = (camera, check_count("width", width), check_count("height", height))
        if key not in self._renderers:
            with self.device:
                self._renderers[key] = Renderer(self.sim, *key)
        return self._renderers[key].render()

    def to(self, device: Any) -> "LocoEnv":
        """Returns the environment itself if it lives on ``device``; physics cannot move, so anything else raises.

        Raises:
            ValueError: ``device`` is another one.
        """
        if check_device(device) != self.device:
            raise ValueError(
                f"the physics lives on {self.device} and cannot move: make a new one with device={device!r}"
            )
        return self
