"""The simulator in which a policy was trained, beside C MuJoCo: layout, velocity episodes and returns."""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import torch
from tqdm.auto import trange

import torchrl_loco
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.vary import Vary
from torchrl_loco.registry import resolve
from torchrl_loco.verification.c_mujoco import CMujoco
from torchrl_loco.verification.exported import Exported
from torchrl_loco.verification.layout import State

RANDOM_STATES = 16
"""States in which the layout is compared with the environment, at most: one in a world."""
AGREEMENT = 1e-2
"""Greatest difference of an entry, as a share of the entry or absolute: accelerations in single precision."""


def make(exported: Exported, n: int, seed: int, device: str | None, **settings: Any) -> LocoEnv:
    """Returns worlds of a policy's task under the protocol of its training, without noise and pushes."""
    cls, facts = resolve(exported.task), exported.facts
    return torchrl_loco.make(cls, n, device, seed, facts["protocol"], world_offset=0, play=True, **settings)


def check_layout(exported: Exported, env: LocoEnv, seed: int) -> None:
    """Checks that a file's layout says what the environment observes and controls.

    They are compared in random states above the ground, where nothing depends on how far a solver goes.

    Raises:
        ValueError: it does not; the message names the term.
    """
    n, m, generator = min(env.num_envs, RANDOM_STATES), env.mj_model, np.random.default_rng(seed)
    home, worlds = np.array(exported.facts["home"]), env.num_envs
    qvel, action = generator.uniform(-1, 1, (worlds, m.nv)), generator.uniform(-1, 1, (worlds, m.nu))
    qpos, command = np.empty((worlds, m.nq)), generator.uniform(-1, 1, (worlds, 3))
    for row in qpos:
        row[:] = home
        mujoco.mj_integratePos(m, row, generator.uniform(-0.3, 0.3, m.nv), 1.0)
        if m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            row[2] += 2.0

    env.reset()
    state = env.get_state()
    for part, name, rows in (
        *((state, "qpos", qpos), (state, "qvel", qvel)),
        *((state.get("memory", {}), "last_action", action), (state.get("memory", {}), "command", command)),
    ):
        if name in part:
            part[name] = torch.as_tensor(rows, dtype=torch.float32).to(env.device)
    seen = env.reset(state, set_state=True)["observation"].cpu().numpy()[:n]
    worlds_in_c = CMujoco(exported, n)
    worlds_in_c.begin(qpos[:n], qvel[:n])
    expected = exported.layout(worlds_in_c.state, action[:n], command[:n])
    if seen.shape != expected.shape:
        raise ValueError(f"the layout has {expected.shape[1]} numbers, {exported.task} observes {seen.shape[1]}")
    wrong = ~(np.abs(seen - expected) <= AGREEMENT * np.maximum(1.0, np.abs(expected)))  # true for NaN too
    first = 0
    for term in exported.facts["observation"]:
        entries, first = slice(first, first + term["size"]), first + term["size"]
        if wrong[:, entries].any():
            error = np.abs(seen - expected)[:, entries].max()
            raise ValueError(f"the layout is not what {exported.task} observes: {term['term']} differs by {error:.2g}")

    td = env.reset(state, set_state=True)
    env.step(td.set("action", torch.as_tensor(action, dtype=torch.float32).to(env.device)))
    error = np.abs(env.sim.ctrl.cpu().numpy() - exported.control(action)).max()
    if not error <= AGREEMENT:
        raise ValueError(f"the layout is not how {exported.task} controls: controls differ by {error:.2g}")


class TrainingSimulator:
    """Worlds of the environment in which a robot was trained, for :func:`torchrl_loco.verification.velocity.play`.

    Args:
        exported: the policy.
        friction: sliding friction of each world, of all geoms, ``(n,)``.
        seed: of the environment.
        device: where it computes; ``None`` takes CUDA if there is any.

    Attributes:
        env: the environment.
        state: the present state of all worlds.
        failed: whether a world is no longer finite, ``(n,)``.
    """

    def __init__(self, exported: Exported, friction: np.ndarray, seed: int, device: str | None) -> None:
        vary = Vary("geom_friction", float(friction.min()), float(friction.max()), how="set", once=True)
        self.env = make(exported, len(friction), seed, device, randomize=[vary])
        self._friction = torch.as_tensor(friction, dtype=torch.float32).to(self.env.device)
        self.state = State.zeros(self.env.mj_model, len(friction))
        self.failed = np.zeros(len(friction), dtype=bool)

    def begin(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Puts all worlds into states ``(n, nq)`` and ``(n, nv)``."""
        self._td = self.env.reset()
        state = self.env.get_state()
        state["model", "geom_friction"] = self._friction[:, None].expand_as(state["model", "geom_friction"])
        state["qpos"], state["qvel"] = self._tensor(qpos), self._tensor(qvel)
        self.env.reset(state, set_state=True)
        self._read()

    def act(self, action: np.ndarray, worlds: np.ndarray) -> None:
        """Steps all worlds by a control step under the policy's actions ``(n, nu)``."""
        self.env.step(self._td.set("action", self._tensor(action)))
        self._read()

    def push(self, change: np.ndarray) -> None:
        """Adds changes ``(n, 6)`` to the velocities of the free joint (m/s, rad/s)."""
        self.env.sim.qvel[:, :6] += self._tensor(change)  # poses stay, and the next step begins from it
        self.state.qvel[:] = self.env.sim.qvel.cpu().numpy()

    def _tensor(self, rows: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(rows, dtype=torch.float32).to(self.env.device)

    def _read(self) -> None:
        for field in ("qpos", "qvel", "act", "xpos", "xmat"):
            getattr(self.state, field)[:] = getattr(self.env.sim, field).cpu().numpy()
        self.failed |= ~np.isfinite(self.state.qpos).all(1)


def begin_alike(env: LocoEnv) -> bool:
    """Returns whether the next episodes of all worlds begin in the same state."""
    env.reset()
    return all(bool((view == view[:1]).all()) for view in (env.sim.qpos, env.sim.qvel))


@dataclasses.dataclass(frozen=True)
class Returns:
    """Returns of the same episodes, by their starts, each ``(n,)``.

    Attributes:
        there: in C MuJoCo.
        here: in the simulator of the training.
    """

    there: np.ndarray
    here: np.ndarray


def compare_returns(exported: Exported, env: LocoEnv, steps: int) -> Returns:
    """Plays episodes in the environment, and from the same starts in C MuJoCo; the task's own code rewards both.

    Args:
        exported: the policy.
        env: a world for each episode.
        steps: control steps of an episode.

    Returns:
        What they earn in both.

    Raises:
        ValueError: the reward or the end depends on what the task remembers.
    """
    if env.memory:
        raise ValueError(
            f"{exported.task} remembers {', '.join(env.memory)}, which only its own simulator can keep: what can be "
            "verified are robots that follow a velocity (a layout with velocity), and tasks without memory"
        )
    td, n = env.reset(), env.num_envs
    start = env.get_state()
    here, alive = np.zeros(n), np.ones(n, dtype=bool)
    for t in trange(steps, desc="training simulator", leave=False, disable=None):
        if t % exported.hold == 0:
            action = torch.as_tensor(exported.act(td["observation"].cpu().numpy())).float().to(env.device)
        td = env.step(td.set("action", action))["next"]
        here += td["reward"].squeeze(-1).cpu().numpy() * alive
        alive &= ~td["done"].squeeze(-1).cpu().numpy()

    worlds, there, alive = CMujoco(exported, n), np.zeros(n), np.ones(n, dtype=bool)
    worlds.begin(*(start[name].cpu().numpy().astype(float) for name in ("qpos", "qvel")))
    state, none = env.get_state(), np.zeros((n, 0))
    for t in trange(steps, desc="C MuJoCo", leave=False, disable=None):
        if t % exported.hold == 0:
            played = exported.act(exported.layout(worlds.state, none, none))
            alive &= np.isfinite(played).all(1)
        worlds.act(played, alive)
        alive &= ~worlds.failed
        for name in ("qpos", "qvel", "act"):
            if name in state:
                state[name] = torch.as_tensor(getattr(worlds.state, name), dtype=torch.float32).to(env.device)
        state["elapsed_steps"].fill_(t)
        reward, ended = judge(env, state, played, exported.control(played))
        there += reward * alive
        alive &= ~ended
        if not alive.any():
            break
    return Returns(there, here)


def judge(env: LocoEnv, state: Any, action: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns reward and end of states, each ``(n,)``, by the task's own code, for actions and controls ``(n, nu)``."""
    env.sim.ctrl.copy_(torch.as_tensor(control, dtype=torch.float32))
    env.reset(state, set_state=True)
    reward, ended = env.world.judge(torch.as_tensor(action, dtype=torch.float32).to(env.device))
    return reward.cpu().numpy(), ended.cpu().numpy()
