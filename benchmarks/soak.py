"""Millions of steps under actions and states that no trained policy would choose: nothing may break, leak or be lost.

Three things are done to the worlds: bang-bang actions beside uniform ones, a NaN, infinity or huge number in the action
of some, and now and then states far outside what a body can be in. After every block, what the rollout showed is
compared with the counters of ``env.health()``.
"""

import time
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

import torchrl_loco
from benchmarks.results import Row
from benchmarks.tasks import TASKS
from torchrl_loco import State
from torchrl_loco.envs import LocoEnv

COLUMNS = {
    **{"body": "", "worlds": "d", "million steps": ".1f", "million steps/s": ".2f"},
    **{"bad actions": "d", "extreme states": "d", "terminated": "d", "truncated": "d"},
    **{"lost contacts": "d", "lost constraints": "d", "memory growth (MiB)": ".1f"},
}
BLOCK = 500
"""Control steps between two comparisons."""
BAD_SHARE = 1e-4
"""Share of worlds that get one of these values in their action at a step."""
BAD_VALUES = (float("nan"), float("inf"), -float("inf"), 1e30)
EXTREME = 64
"""Worlds that are put into an extreme state before each block."""


@torch.no_grad()
def soak(bodies: Sequence[str], worlds: int, frames: int, device: torch.device) -> list[Row]:
    """Steps each body ``frames`` times, over all worlds.

    Raises:
        AssertionError: an observation or reward was not finite or out of range, or the counters do not add up.
    """
    rows = []
    for body in bodies:
        env = torchrl_loco.make(TASKS[body], worlds, device, seed=0, stagger=True, on_overflow="ignore")
        generator = torch.Generator(device).manual_seed(0)
        td, memory, start = env.reset(), None, time.perf_counter()
        totals = dict.fromkeys(("bad actions", "extreme states", "terminated", "truncated"), 0)
        blocks = max(1, round(frames / worlds / BLOCK))
        for block in tqdm(range(blocks), desc=f"{body}, {worlds} worlds", unit="block"):
            td = upset(env, td, generator)
            totals["extreme states"] += min(EXTREME, worlds)
            td, counts = play(env, td, generator)
            for name, count in counts.items():
                totals[name] += count
            found = env.health()["total"]
            assert int(found["non_finite"]) == totals["terminated"], (int(found["non_finite"]), totals)
            assert totals["terminated"] >= totals["bad actions"], totals
            if block == 0:
                memory = used(device)
        rows.append(
            {
                **{"body": body, "worlds": worlds, "million steps": blocks * BLOCK * worlds / 1e6, **totals},
                "million steps/s": blocks * BLOCK * worlds / (time.perf_counter() - start) / 1e6,
                "lost contacts": int(found["contact_overflow"]),
                "lost constraints": int(found["constraint_overflow"]),
                "memory growth (MiB)": None if memory is None else (used(device) - memory) / 2**20,
            }
        )
        env.close()
    return rows


def upset(env: LocoEnv, td: TensorDictBase, generator: torch.Generator) -> TensorDictBase:
    """Puts some worlds into states with speeds up to 1e6 and positions far off."""
    state, count = env.get_state(), min(EXTREME, env.num_envs)
    scale = 10.0 ** torch.empty(count, 1, device=env.device).uniform_(0.0, 6.0, generator=generator)
    for key in ("qpos", "qvel"):
        noise = torch.empty_like(state[key][:count]).normal_(generator=generator)
        state[key][:count] += noise * (scale if key == "qvel" else scale.log10())
    mask = torch.arange(env.num_envs, device=env.device).unsqueeze(-1) < count
    flags = td.select("done", "terminated", "truncated")
    fresh = env.reset(State({**state, **flags, "_reset": mask}, state.batch_size, device=env.device), set_state=True)
    return fresh.exclude(*State.KEYS)


def play(env: LocoEnv, td: TensorDictBase, generator: torch.Generator) -> tuple[TensorDictBase, dict[str, int]]:
    """Plays a block; returns where it ends, and counts of bad actions and of ends of episodes."""
    shape, device = env.action_spec.shape, env.device
    values = torch.tensor(BAD_VALUES, device=device)
    sums = torch.zeros(3, dtype=torch.long, device=device)
    well = torch.ones((), dtype=torch.bool, device=device)
    for _ in range(BLOCK):
        action = torch.empty(shape, device=device).uniform_(-1.5, 1.5, generator=generator)
        draw = torch.rand(shape[0], 2, device=device, generator=generator)
        action = torch.where(draw[:, :1] < 0.5, action.sign(), action)
        which = (draw[:, 0] * len(values)).long()
        action[:, 0] = torch.where(draw[:, 1] < BAD_SHARE, values[which], action[:, 0])
        bad = ~action.isfinite().all(dim=1)  # a huge number is clipped
        current, td = env.step_and_maybe_reset(td.set("action", action))
        after = current["next"]
        reward = after["reward"]
        well &= after["observation"].isfinite().all() & td["observation"].isfinite().all()
        well &= (reward >= 0).all() & (reward <= 1 + 1e-5).all() & (reward * after["terminated"] == 0).all()
        sums += torch.stack([bad.sum(), after["terminated"].sum(), after["truncated"].sum()])
    assert well, "an observation or reward was not finite, or not in [0, 1]"
    return td, dict(zip(("bad actions", "terminated", "truncated"), sums.tolist(), strict=True))


def used(device: torch.device) -> int | None:
    """Returns the bytes in use on a CUDA device."""
    if device.type != "cuda":
        return None
    torch.cuda.synchronize(device)
    free, total = torch.cuda.mem_get_info(device)
    return total - free
