"""Models for pictures, and poses that no simulation is at: of a motion, or with a ghost beside the body."""

from typing import Any

import mujoco
import torch
import warp as wp

from torchrl_loco.eyes.tracer import Eye
from torchrl_loco.motion import poses
from torchrl_loco.sim import EXCLUSIVE, current_stream

LOOKS_WELL: dict[str, Any] = {"shadows": True, "samples": 2}
"""Settings of an :class:`~torchrl_loco.eyes.tracer.Eye` for pictures that people look at."""

GHOST, OPACITY = "ghost/", 0.4  # what the names of a ghost's bodies begin with, and how much of it is seen
GHOST_COLOR = (0.2, 0.75, 0.35)  # of a ghost: red, green, blue


def with_ghost(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Returns a model with its first body once more, which touches nothing: its positions follow those of the model."""
    seen, other = spec.copy(), spec.copy()
    for geom in other.geoms:
        geom.contype = geom.conaffinity = 0
        geom.material, geom.rgba = "", [*GHOST_COLOR, OPACITY]
    for kind in (other.actuators, other.sensors, other.cameras, other.lights, other.keys, other.pairs, other.excludes):
        for part in list(kind):
            other.delete(part)
    seen.worldbody.add_frame().attach_body(other.worldbody.bodies[0], GHOST, "")
    return seen.compile()


class Poses:
    """Renders poses of a model through one camera. Arguments are those of :class:`Eye`: a world is a pose."""

    def __init__(self, m: mujoco.MjModel, device: wp.Device, *picture: Any) -> None:
        self._model, self._device, self._eye = m, device, Eye(m, device, *picture, **LOOKS_WELL)

    def render(self, qpos: torch.Tensor) -> torch.Tensor:
        """Returns poses ``(worlds, nq)`` as pixels, uint8 ``(worlds, height, width, 3)``, until the next call."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            pos, mat = poses(self._model, qpos.numpy(force=True))
            self._bodies = wp.array(pos, wp.vec3), wp.array(mat, wp.mat33)  # kept until they are drawn
            self._eye.launch(*self._bodies)
        return self._eye.rgb
