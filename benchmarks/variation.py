"""What training with numbers that vary buys: returns over a grid of friction, masses and gears."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torchrl.envs import step_mdp
from tqdm.auto import trange

import torchrl_loco as loco
from benchmarks.results import Row
from torchrl_loco.policy import Policy, load_policy
from torchrl_loco.training.algorithm import settings_for_small_networks

COLUMNS = {"policy": "", "mean": ".1f", "worst": ".1f", "nominal": ".1f", "inside": ".1f", "worst inside": ".1f"}
FRICTION, MASS, GEAR = (0.4, 1.4), (0.8, 1.2), (0.8, 1.2)
"""What the policy was trained on: sliding friction, and factors of all masses and of all gears."""
FACTORS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)
GRID = ((0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6), FACTORS, FACTORS)
EPISODES = 16
"""Episodes of a cell of the grid, which differ by a small velocity at their start."""


class HumanoidWalkVaried(loco.HumanoidWalk):
    """Walk with a friction, masses and gears that nobody has told it."""

    randomize: ClassVar = [
        loco.Vary("geom_friction", *FRICTION, how="set"),
        loco.Vary("body_mass", *MASS),
        loco.Vary("actuator_gear", *GEAR),
    ]


def variation(policies: Sequence[Path], device: torch.device) -> tuple[list[Row], dict[str, list]]:
    """Plays the shipped policy of humanoid_walk, and others, on the grid.

    Returns:
        A row for each policy: its mean and its worst cell, that of the model itself, and mean and worst of the cells
        within what was trained on; and the mean return of each cell by policy, in the nested order of the grid.
    """
    rows, returns = [], {}
    players = {"shipped": load_policy("humanoid_walk", device)}
    players |= {path.parent.name: Policy.load(path, device) for path in policies}
    grid = list(itertools.product(*GRID))
    trained = (FRICTION, MASS, GEAR)
    inside = [all(low <= x <= high for x, (low, high) in zip(cell, trained, strict=True)) for cell in grid]
    for name, policy in players.items():
        means = play(policy, torch.tensor(grid, device=device)).reshape(len(grid), EPISODES).mean(1).cpu().numpy()
        rows.append(
            {
                "policy": name,
                "mean": float(means.mean()),
                "worst": float(means.min()),
                "nominal": float(means[grid.index((1.0, 1.0, 1.0))]),
                "inside": float(means[inside].mean()),
                "worst inside": float(means[inside].min()),
            }
        )
        returns[name] = means.astype(float).round(1).reshape([len(axis) for axis in GRID]).tolist()
    return rows, returns


@torch.no_grad()
def play(policy: Policy, grid: torch.Tensor) -> torch.Tensor:
    """Returns the returns of full episodes, ``EPISODES`` for each row of a grid of friction, mass and gear."""
    friction, mass, gear = grid.repeat_interleave(EPISODES, 0).unsqueeze(-1).unbind(1)
    nominal = [  # which are written into the state below
        loco.Vary("geom_friction", 1.0, 1.0, how="set", once=True),
        loco.Vary("body_mass", 1.0, 1.0, once=True),
        loco.Vary("actuator_gear", 1.0, 1.0, once=True),
    ]
    env = loco.make("humanoid_walk", num_envs=len(friction), device=grid.device, seed=0, randomize=nominal)
    env.reset()
    state = env.get_state()
    state["qvel"] += 0.1 * torch.randn(state["qvel"].shape, generator=torch.Generator().manual_seed(0)).to(grid.device)
    for field, factor in (("geom_friction", friction), ("body_mass", mass), ("actuator_gear", gear)):
        state["model", field] *= factor
    td = env.reset(state, set_state=True)
    total = torch.zeros(env.num_envs, 1, device=grid.device)
    alive = torch.ones_like(total, dtype=torch.bool)
    with settings_for_small_networks():
        for _ in trange(env.config.episode_length, leave=False, disable=None):
            after = env.step(policy(td))
            total += after["next", "reward"] * alive
            alive &= ~after["next", "done"]
            td = step_mdp(after)
    return total.squeeze(-1)


def plot_variation(returns: Mapping[str, list], picture: Path) -> None:
    """Draws returns against friction and mass, a row of panels for each policy and a column for each of three gears."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    frictions, masses, gears = GRID
    shown = [gears.index(gear) for gear in (GEAR[0], 1.0, GEAR[1])]
    size = (3.2 * len(shown) + 1.2, 2.4 * len(returns))
    figure, panels = plt.subplots(len(returns), len(shown), figsize=size, squeeze=False, layout="constrained")
    for of_policy, (name, values) in zip(panels, returns.items(), strict=True):
        for axes, gear in zip(of_policy, shown, strict=True):
            image = axes.imshow(np.array(values)[..., gear].T, origin="lower", vmin=0, vmax=1000, aspect="auto")
            axes.set(title=f"{name}, gears x {gears[gear]:g}", xlabel="friction", ylabel="masses x")
            axes.set_xticks(range(len(frictions)), [f"{x:g}" for x in frictions])
            axes.set_yticks(range(len(masses)), [f"{x:g}" for x in masses])
    figure.colorbar(image, ax=panels, label="return")
    figure.savefig(picture, dpi=110)
