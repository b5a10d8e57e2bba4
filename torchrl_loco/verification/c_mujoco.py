"""Many worlds of C MuJoCo, on all cores."""

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from torchrl_loco.verification.exported import Exported
from torchrl_loco.verification.layout import State

WARNINGS = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC")]
"""After these MuJoCo starts a world again."""
NO_ACTUATION = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)


class CMujoco:
    """Worlds of C MuJoCo, in float64, which threads step side by side.

    Args:
        exported: the policy that is played, with the robot's model.
        n: number of worlds.
        friction: sliding friction of each world, of all geoms and pairs, ``(n,)``; ``None`` is that of the model.

    Attributes:
        state: the present state of all worlds.
        failed: whether a world became unstable, ``(n,)``; it is not stepped further.
    """

    def __init__(self, exported: Exported, n: int, friction: np.ndarray | None = None) -> None:
        m, self._exported, self._substeps = exported.model, exported, exported.substeps
        self._models = [m] * n if friction is None else [copy.copy(m) for _ in range(n)]
        for model, value in zip(self._models, () if friction is None else friction, strict=False):
            model.geom_friction[:, 0], model.pair_friction[:, :2] = value, value
        self._data = [mujoco.MjData(m) for _ in range(n)]
        self.state, self.failed = State.zeros(m, n), np.zeros(n, dtype=bool)
        threads = os.cpu_count() or 1
        self._pool, self._chunk = ThreadPoolExecutor(threads), -(-n // (4 * threads))

    def begin(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Puts all worlds into states ``(n, nq)`` and ``(n, nv)``; sensors of forces are those without actuation."""

        def begin(i: int) -> None:
            mujoco.mj_resetData(self._models[i], self._data[i])
            self._data[i].qpos[:], self._data[i].qvel[:] = qpos[i], qvel[i]
            mujoco.mj_forward(self._models[i], self._data[i])

        for model in self._models:
            model.opt.disableflags |= NO_ACTUATION
        self._each(begin, np.arange(len(self._data)))
        for model in self._models:
            model.opt.disableflags &= ~NO_ACTUATION

    def act(self, action: np.ndarray, worlds: np.ndarray) -> None:
        """Steps the worlds of a mask ``(n,)`` by a control step under the policy's actions ``(n, nu)``."""
        control = self._exported.control(action)

        def step(i: int) -> None:
            model, data = self._models[i], self._data[i]
            data.ctrl[:] = control[i]
            mujoco.mj_step(model, data, self._substeps)
            mujoco.mj_step1(model, data)  # poses and sensors of the state; sensors of forces stay those of the step
            self.failed[i] = any(data.warning[warning].number for warning in WARNINGS)

        self._each(step, np.flatnonzero(worlds & ~self.failed))

    def push(self, change: np.ndarray) -> None:
        """Adds changes ``(n, 6)`` to the velocities of the free joint (m/s, rad/s), where they are not zero."""

        def push(i: int) -> None:
            self._data[i].qvel[:6] += change[i]
            mujoco.mj_step1(self._models[i], self._data[i])

        self._each(push, np.flatnonzero(change.any(1) & ~self.failed))

    def _each(self, work: Callable[[int], None], worlds: np.ndarray) -> None:
        """Does something in worlds, on all cores, and reads their state."""

        def some(part: np.ndarray) -> None:
            for i in part:
                work(i)
                self.state.write(i, self._data[i])

        parts = [worlds[first : first + self._chunk] for first in range(0, len(worlds), self._chunk)]
        list(self._pool.map(some, parts))
