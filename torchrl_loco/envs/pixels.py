"""Pixels as entries of an environment: which camera, how large, and what they are in TorchRL's specs."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import torch
import warp as wp
from torchrl.data import Bounded

from torchrl_loco.checks import Interval, check_bool, check_choice, check_float, check_int, checked_size
from torchrl_loco.eyes.placing import bytes_placed
from torchrl_loco.eyes.tracer import Eye
from torchrl_loco.sim import Buffer, Simulation
from torchrl_loco.sim.simulation import check_memory

SIZE = (84, 84)  # width and height of pixels, those of dm_control's benchmarks from pixels
KEYS = {"rgb": "pixels", "depth": "depth"}  # keys of what is drawn
COPIES_IN_STEP = 3
"""How often pixels lie in memory: where they are drawn, in what a step returns, and in what the next begins with."""
DEPTHS = Interval(0, float("inf"))


@dataclasses.dataclass(frozen=True)
class Pixels:
    """What an environment returns of a camera."""

    camera: int  # its number
    width: int
    height: int
    kinds: tuple[str, ...]  # what is drawn, of torchrl_loco.eyes.tracer.KINDS
    far: float  # greatest depth (m)
    stack: int  # how many of the last pictures in colour an entry holds, the newest last
    only: bool  # whether the groups of the observation are left out

    @classmethod
    def checked(
        cls, m: mujoco.MjModel, given: Mapping[str, Any], num_envs: int, device: torch.device
    ) -> "Pixels | None":
        """Returns what arguments of :class:`torchrl_loco.LocoEnv` ask for, ``None`` if that is no pixels."""
        with_rgb = check_bool("from_pixels", given["from_pixels"])
        far = check_float("depth, the greatest that is seen (m) or 0 for none,", given["depth"], DEPTHS)
        if not with_rgb and not far:
            if extra := [name for name in ("pixels_only", "camera", "size", "frame_stack") if given[name] is not None]:
                raise ValueError(f"{extra[0]} needs from_pixels=True, or the greatest depth to be seen (m) as depth")
            return None
        camera = checked_camera(m, given["camera"])
        width, height = checked_size(SIZE if given["size"] is None else given["size"])
        kinds = tuple(kind for kind, wanted in (("rgb", with_rgb), ("depth", far > 0)) if wanted)
        only = True if given["pixels_only"] is None else check_bool("pixels_only", given["pixels_only"])
        if given["frame_stack"] is not None and not with_rgb:
            raise ValueError("frame_stack needs from_pixels=True: depth is not stacked")
        stack = 1 if given["frame_stack"] is None else check_int("frame_stack", given["frame_stack"])
        of_pixel = sum({"rgb": 3 * stack, "depth": 4}[kind] for kind in kinds)
        check_memory(num_envs * (COPIES_IN_STEP * width * height * of_pixel + bytes_placed(m)), num_envs, device)
        return cls(camera, width, height, kinds, far, stack, only)

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments that ask for them."""
        rgb, size = "rgb" in self.kinds, (self.width, self.height)
        seen = {"from_pixels": rgb, "depth": self.far, "camera": self.camera, "size": size, "pixels_only": self.only}
        return {**seen, "frame_stack": self.stack if rgb else None}

    def settings(self, m: mujoco.MjModel) -> dict[str, Any]:
        """Returns the settings of a training in which the same is seen."""
        if not (name := m.camera(self.camera).name) and self.camera:
            raise ValueError(f"camera {self.camera} needs a name to train with")
        seen = {"camera": name, "size": (self.width, self.height), "frame_stack": self.stack}
        return {**seen, **({"critic_from_pixels": True} if self.only else {})}

    def seen(self, sim: Simulation, mask: Buffer) -> "Seen":
        """Returns what draws them, and keeps them; ``mask`` tells in which worlds episodes begin."""
        size = self.width, self.height, sim.num_envs, self.kinds
        return Seen(sim, mask, Eye(sim.mj_model, sim.device, self.camera, *size, far=self.far), self.stack)

    def specs(self, batch: torch.Size, device: torch.device) -> dict[str, Bounded]:
        """Returns the specs of the entries by key."""
        size = self.height, self.width
        rgb = Bounded(0, 255, (*batch, *size, 3 * self.stack), dtype=torch.uint8, device=device)
        depth = Bounded(0.0, self.far, (*batch, *size), dtype=torch.float32, device=device)
        return {KEYS[kind]: {"rgb": rgb, "depth": depth}[kind] for kind in self.kinds}

    def entries(self, seen: "Seen | None", batch: torch.Size) -> dict[str, torch.Tensor]:
        """Returns copies of what is drawn, by key."""
        assert seen is not None
        return {
            KEYS[kind]: image.clone().view(*batch, *image.shape[1:])
            for kind, image in (("rgb", seen.stack), ("depth", seen.eye.depth))
            if kind in self.kinds
        }


def checked_camera(m: mujoco.MjModel, camera: str | int | None) -> int:
    """Returns the number of a camera; of the first for ``None``."""
    if not m.ncam:
        raise ValueError("pixels need a camera: the model has none")
    if isinstance(camera, str):
        check_choice("camera", camera, [name for i in range(m.ncam) if (name := m.camera(i).name)])
        return m.camera(camera).id
    return 0 if camera is None else check_int("camera", camera, Interval(0, m.ncam))


class Seen:
    """What ``eye`` draws in all worlds: ``stack`` has the last ``count`` pictures, the newest last.

    It is uint8 ``(worlds, height, width, 3 * count)``; after a reset all are the first one.
    """

    def __init__(self, sim: Simulation, mask: Buffer, eye: Eye, count: int) -> None:
        self._sim, self._mask, self.eye, self.count = sim, mask, eye, count
        self.stack = eye.rgb if count == 1 else eye.rgb.repeat(1, 1, 1, count)

    def launch(self, mask: wp.array | None = None) -> None:
        """Launches what draws the worlds of a mask, all of them for ``None``."""
        self.eye.launch(self._sim.data.xpos, self._sim.data.xmat, mask)

    def append(self) -> None:
        """Adds what was drawn of all worlds."""
        if self.count > 1:
            self.stack.copy_(torch.cat([self.stack[..., 3:], self.eye.rgb], dim=-1))

    def begin(self, kept: bool = False) -> None:
        """Begins anew in the worlds of the mask with what was drawn; ``kept`` leaves earlier pictures, if any."""
        if self.count > 1:
            masked, begun = self._mask.torch.view(-1, 1, 1, 1), self.eye.rgb.repeat(1, 1, 1, self.count)
            if kept:  # but the newest, as the state may have been changed
                has = (self.stack != 0).flatten(1).any(dim=1).view(-1, 1, 1, 1)
                begun = torch.where(has, torch.cat([self.stack[..., :-3], self.eye.rgb], dim=-1), begun)
            self.stack.copy_(torch.where(masked, begun, self.stack))
