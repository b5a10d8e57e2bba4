"""Pixels as entries of an environment: which camera, how large, and what they are in TorchRL's specs."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import torch
import warp as wp
from tensordict import TensorDictBase
from torchrl.data import Bounded

from torchrl_loco.checks import Interval, check_bool, check_choice, check_float, check_int, checked_size
from torchrl_loco.eyes.placing import bytes_placed
from torchrl_loco.eyes.shapes import MISS
from torchrl_loco.eyes.tracer import Color, Eye
from torchrl_loco.sim import EXCLUSIVE, Simulation, current_stream
from torchrl_loco.sim.models import cameras
from torchrl_loco.sim.simulation import check_memory

SIZE = (84, 84)  # width and height of pixels, those of dm_control's benchmarks from pixels
KEYS = {"rgb": "pixels", "depth": "depth"}  # keys of what is drawn
COPIES_IN_STEP = 3
"""How often pixels lie in memory: in what a step begins with, in what it returns, and in what the next begins with."""
DEPTHS = Interval(0, float(MISS))  # what is not met is farther
Pictures = dict[str, torch.Tensor]  # what is seen in all worlds by key, (worlds, height, width, ...)


@dataclasses.dataclass(frozen=True)
class Pixels:
    """What an environment returns of a camera."""

    camera: int  # its id in MuJoCo
    number: int  # as an argument
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
        if given["frame_stack"] is not None and not with_rgb:
            raise ValueError("frame_stack needs from_pixels=True: depth is not stacked")
        if not with_rgb and not far:
            if extra := [name for name in ("pixels_only", "camera", "size", "frame_stack") if given[name] is not None]:
                raise ValueError(f"{extra[0]} needs from_pixels=True, or the greatest depth to be seen (m) as depth")
            return None
        camera = checked_camera(m, given["camera"])
        width, height = checked_size(SIZE if given["size"] is None else given["size"])
        kinds = tuple(kind for kind, wanted in (("rgb", with_rgb), ("depth", far > 0)) if wanted)
        only = with_rgb if given["pixels_only"] is None else check_bool("pixels_only", given["pixels_only"])
        stack = 1 if given["frame_stack"] is None else check_int("frame_stack", given["frame_stack"])
        of_pixel = COPIES_IN_STEP * sum({"rgb": 3 * stack, "depth": 4}[kind] for kind in kinds)
        of_pixel += 3 * stack * (stack > 1)  # Seen.stack
        check_memory(num_envs * (width * height * of_pixel + bytes_placed(m)), num_envs, device)
        return cls(camera, cameras(m).index(camera), width, height, kinds, far, stack, only)

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments that ask for them."""
        rgb, size = "rgb" in self.kinds, (self.width, self.height)
        seen = {"from_pixels": rgb, "depth": self.far, "camera": self.number, "size": size, "pixels_only": self.only}
        return {**seen, "frame_stack": self.stack if rgb else None}

    def settings(self, m: mujoco.MjModel) -> dict[str, Any]:
        """Returns the settings of a training in which the same is seen."""
        if not (name := m.camera(self.camera).name) and self.number:
            raise ValueError(f"camera {self.number} needs a name to train with")
        seen = {"camera": name, "size": (self.width, self.height), "frame_stack": self.stack}
        return {**seen, **({"critic_from_pixels": True} if self.only else {})}

    def seen(self, sim: Simulation, mask: torch.Tensor) -> "Seen":
        """Returns what draws them; ``mask`` tells in which worlds episodes begin."""
        n, picture = sim.num_envs, (self.camera, self.width, self.height)
        eye = Eye(
            sim.mj_model, sim.device, *picture, n, self.kinds, far=self.far, keeps=False, varied=sim.varied_numbers
        )
        specs = dataclasses.replace(self, stack=1).specs(torch.Size([n]), sim.qpos.device)
        return Seen(sim, mask, eye, specs, self.stack)

    def specs(self, batch: torch.Size, device: torch.device) -> dict[str, Bounded]:
        """Returns the specs of the entries by key."""
        size = self.height, self.width
        rgb = Bounded(0, 255, (*batch, *size, 3 * self.stack), dtype=torch.uint8, device=device)
        depth = Bounded(0.0, self.far, (*batch, *size), dtype=torch.float32, device=device)
        return {KEYS[kind]: {"rgb": rgb, "depth": depth}[kind] for kind in self.kinds}


def checked_camera(m: mujoco.MjModel, camera: str | int | None) -> int:
    """Returns the id of a camera by its name or number, of the first for ``None``."""
    if not (ids := cameras(m)):
        raise ValueError("pixels need a camera: the model has none")
    if isinstance(camera, str):
        check_choice("camera", camera, [name for i in range(m.ncam) if (name := m.camera(i).name)])
        return m.camera(camera).id
    return ids[0 if camera is None else check_int("camera", camera, Interval(0, m.ncam))]


class Seen:
    """What ``eye`` sees in all worlds: entries of an environment by key, drawn into new memory at each call.

    ``specs`` are those of one picture. ``stack`` keeps the last ``count`` of them, if they are several: uint8
    ``(worlds, height, width, 3 * count)``, the newest last; after a reset all are the first one.
    """

    def __init__(self, sim: Simulation, mask: torch.Tensor, eye: Eye, specs: Mapping[str, Bounded], count: int) -> None:
        self._sim, self._mask, self.eye, self._specs, self._count = sim, mask, eye, specs, count
        self.stack = specs["pixels"].zero().repeat(1, 1, 1, count) if count > 1 else None

    def launch(self, mask: wp.array | None = None) -> None:
        """Launches what comes before drawing in the worlds of a mask, in all of them for ``None``."""
        self.eye.placed.launch(self._sim.data.xpos, self._sim.data.xmat, mask)

    def step(self) -> Pictures:
        """Returns what is seen after a step."""
        new = {key: torch.empty(one.shape, dtype=one.dtype, device=one.device) for key, one in self._specs.items()}
        self._draw(new)
        if self.stack is not None:
            new["pixels"] = torch.cat([self.stack[..., 3:], new["pixels"]], dim=-1)
            self.stack.copy_(new["pixels"])
        return new

    def begin(self, last: Pictures | TensorDictBase | None, *, restored: bool = False) -> Pictures:
        """Returns what is seen after a reset of the worlds of the mask.

        The others are as in ``last``, what the step before it returned; without that all are drawn, and where it is
        empty nobody reads them. ``restored`` leaves earlier pictures, if there are any, but the newest: the state may
        have been changed.
        """
        onto = {} if last is None else {**last}
        if self.stack is not None:
            onto.pop("pixels", None)
        new = {
            key: onto[key].view(one.shape).clone() if key in onto else one.zero() for key, one in self._specs.items()
        }
        self._draw(new, None if last is None else self._mask)
        if self.stack is not None:
            new["pixels"] = self._begun(self.stack, new["pixels"], restored)
            self.stack.copy_(new["pixels"])
        return new

    def _begun(self, stack: torch.Tensor, newest: torch.Tensor, restored: bool) -> torch.Tensor:
        """Returns a stack of pictures in which those of the worlds of the mask are ``newest``."""
        places, begun = stack.unflatten(-1, (self._count, 3)), self._mask.view(-1, 1, 1, 1, 1)
        if restored:
            last = torch.arange(self._count, device=stack.device) == self._count - 1
            begun = begun & (last.unsqueeze(-1) | (places == 0).flatten(1).all(dim=1).view_as(begun))
        return torch.where(begun, newest.unsqueeze(-2), places).flatten(-2)

    def _draw(self, new: Pictures, mask: torch.Tensor | None = None) -> None:
        """Draws the worlds of a mask, all of them for ``None``."""
        tensors = (new.get("pixels"), Color), (new.get("depth"), wp.float32), (mask, wp.bool)
        *out, where = (None if one is None else wp.from_torch(one, kind, return_ctype=True) for one, kind in tensors)
        with EXCLUSIVE:  # the kernel is loaded and allocates nothing: torch may be recording
            self.eye.draw([*out, None], where, current_stream(self._sim.device))
