"""An exported policy: its network, and what its file says of task and robot."""

import contextlib
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.verification.layout import Layout

ITERATIONS, LS_ITERATIONS, TOLERANCE = 100, 50, 1e-8
"""Least limits of the solver, and the greatest tolerance: MuJoCo's defaults."""


class Exported:
    """A policy from an ONNX file that :func:`torchrl_loco.export_policy` wrote.

    It needs MuJoCo and onnxruntime alone, unless the model needs further files.

    Args:
        path: the file.
        task: the name of its task, as the user says; ``None`` for what the file says.

    Attributes:
        facts: what the file says, by name: see :mod:`torchrl_loco.deployment`.
        model: the robot's model at full accuracy: its own options (cone, integrator, time step), and a solver that
            converges.
        layout: what the policy observes.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no exported policy, or does not say what the policy observes; or it has no model, and its task
            is not at hand.
        UnnamedFileError: its task is in a file that the user has not named.
    """

    def __init__(self, path: Path, task: str | None = None) -> None:
        import onnxruntime

        if not Path(path).is_file():
            raise FileNotFoundError(f"there is no file {path}")
        try:
            self._session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's have no base of their own
            raise ValueError(f"{path} cannot be read as an ONNX file: {error}") from error
        self.facts: dict[str, Any] = {}
        for name, word in self._session.get_modelmeta().custom_metadata_map.items():
            self.facts[name] = word
            with contextlib.suppress(json.JSONDecodeError):  # words are not quoted
                self.facts[name] = json.loads(word)
        if task is not None:
            self.facts["task"] = task
        if "observation" not in self.facts:
            raise ValueError(
                f"{path} does not say what the policy observes: export it again with its task at hand, which needs a "
                "layout(), see help(torchrl_loco.LocoEnv)"
            )
        self.model = self._model()
        option = self.model.opt
        option.iterations = max(option.iterations, ITERATIONS)
        option.ls_iterations = max(option.ls_iterations, LS_ITERATIONS)
        option.tolerance = min(option.tolerance, TOLERANCE)
        self.layout = Layout(self.facts["observation"], self.model)
        self._offset, self._scale = (np.array(self.facts[f"action_{name}"]) for name in ("offset", "scale"))

    def _model(self) -> mujoco.MjModel:
        """Returns the model in the file, or the task's if it needs further files, such as meshes."""
        if "mjcf" in self.facts:
            return mujoco.MjModel.from_xml_string(self.facts["mjcf"])
        from torchrl_loco.deployment import specification

        return specification(self.facts["task"]).compile()

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.facts["task"]

    @property
    def substeps(self) -> int:
        """Physics steps of the model in a control step.

        Raises:
            ValueError: the model's time step does not divide it.
        """
        steps = self.facts["control_timestep"] / self.model.opt.timestep
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"the model's time step {self.model.opt.timestep} s does not divide a control step")
        return round(steps)

    @property
    def hold(self) -> int:
        """Control steps for which an action is held."""
        return int(self.facts["action_repeat"])

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns the actions ``(n, nu)`` for observations ``(n, size)``."""
        (action,) = self._session.run(["action"], {"observation": observation.astype(np.float32)})
        return action.astype(float)

    def control(self, action: np.ndarray) -> np.ndarray:
        """Returns the controls of actions, each ``(n, nu)``."""
        if self.facts["action_low"] is not None:
            action = action.clip(self.facts["action_low"], self.facts["action_high"])
        return self._offset + self._scale * action
