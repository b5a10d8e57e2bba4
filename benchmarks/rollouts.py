"""Random actions for whole episodes in which nothing ends a fall: what is lost, and how fast the bodies become."""

import math
import time
from collections.abc import Sequence
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.results import Row
from torchrl_loco import registry
from torchrl_loco.envs import LocoEnv

COLUMNS = {
    **{"task": "", "engine": "", "worlds": "d", "million steps": ".2f", "million steps/s": ".3f"},
    **{"not finite": "d", "lost contacts": "d", "those of small actions": "d", "lost constraints": "d"},
    **{"at iteration limit": ".4f", "base (m/s)": ".1f", "joint (rad/s)": ".0f", "energy (J)": ".0f"},
    "lying": ".2f",
}
"""Of a row: steps in which a world was not finite or lost something, also of the seventh of worlds whose actions spread
by 1 or less; the share at the limit of iterations; the largest speeds and kinetic energy; the share of worlds whose
base is in the lower half of its height at the end."""


def lying(cls: type[LocoEnv]) -> type[LocoEnv]:
    """Returns a task of which no fall ends an episode, and which also observes the kinetic energy."""

    def terminated(self: Any, s: Any) -> torch.Tensor:
        return torch.zeros_like(s.time, dtype=torch.bool)

    def observation(self: Any, s: Any) -> dict[str, torch.Tensor]:
        return {**cls.observation(self, s), "energy": kinetic_energy(s).unsqueeze(-1)}

    return type(cls.__name__, (cls,), {"terminated": terminated, "observation": observation})


def kinetic_energy(s: Any) -> torch.Tensor:
    """Returns the kinetic energy of each world, with that of armatures (J), ``(num_envs,)``."""
    xmat, rotation = s.xmat(".*"), s.angvel(".*")
    lever = (xmat * s.model("body_ipos").unsqueeze(-2)).sum(-1)
    velocity = s.linvel(".*") + torch.linalg.cross(rotation, lever)
    own = (xmat * rotation.unsqueeze(-1)).sum(-2)  # in the frame of the body
    w, axis = s.model("body_iquat").split((1, 3), dim=-1)
    twice = 2.0 * torch.linalg.cross(own, axis)
    principal = own + w * twice + torch.linalg.cross(twice, axis)  # turned backwards, into the axes of inertia
    bodies = s.model("body_mass") * velocity.square().sum(-1) + (s.model("body_inertia") * principal.square()).sum(-1)
    return 0.5 * (bodies.sum(-1) + (s.model("dof_armature") * s.qvel.square()).sum(-1))


@torch.no_grad()
def rollouts(tasks: Sequence[str], worlds: int, frames: int, device: torch.device) -> list[Row]:
    """Steps each task at least ``frames`` times, over all worlds, in whole episodes of random actions.

    Those of a world are normally distributed, with a spread between 0.5 and 4, and are kept for five steps on average,
    so that joints get where they are told to.
    """
    rows = []
    for task in tasks:
        env = lying(registry.env_class(task))(worlds, device, 0, on_overflow="ignore")
        td, generator = env.reset(), torch.Generator(device).manual_seed(0)
        most = torch.zeros(3, device=device)
        shape, home = env.action_spec.shape, env.hooks.catalog.home[2]
        spread, action = torch.linspace(0.5, 4.0, worlds, device=device).unsqueeze(-1), env.action_spec.zero()
        steps, start = env.episode_length * math.ceil(frames / worlds / env.episode_length), time.perf_counter()
        down = torch.zeros((), device=device)
        for step in tqdm(range(steps), desc=f"{task}, {worlds} worlds", unit="step"):
            drawn = spread * torch.empty(shape, device=device).normal_(generator=generator)
            anew = torch.rand(worlds, 1, device=device, generator=generator) < 0.2
            action = torch.where(anew, drawn, action)
            current, td = env.step_and_maybe_reset(td.set("action", action))
            qvel, energy = env.sim.qvel, current["next", "energy"]
            found = [qvel[:, :3].norm(dim=-1).max(), qvel[:, 6:].abs().max(), energy.max()]
            most = torch.maximum(most, torch.stack(found))
            if step % env.episode_length == env.episode_length - 2:
                down = (env.sim.qpos[:, 2] < 0.5 * home).float().mean()
        health = env.health()
        total, done = health["total"], steps * worlds
        rows.append(
            {
                **{"task": task, "engine": env.engine, "worlds": worlds, "million steps": done / 1e6},
                "million steps/s": done / (time.perf_counter() - start) / 1e6,
                "not finite": int(total["non_finite"]),
                "lost contacts": int(total["contact_overflow"]),
                "those of small actions": int(health["worlds", "contact_overflow"][spread.squeeze(-1) <= 1.0].sum()),
                "lost constraints": int(total["constraint_overflow"]),
                "at iteration limit": int(total["iteration_limit"]) / done,
                **dict(zip(("base (m/s)", "joint (rad/s)", "energy (J)"), most.tolist(), strict=True)),
                "lying": down.item(),
            }
        )
        env.close()
    return rows
