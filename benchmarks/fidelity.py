"""How far the worlds are from C MuJoCo in double precision, after one control step and after many."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
from mujoco import rollout
from tqdm import tqdm

import torchrl_loco
from benchmarks.results import Row
from benchmarks.tasks import TASKS
from torchrl_loco.sim import models

COLUMNS = {
    "body": "",
    "protocol": "",
    "against": "",
    "steps": "d",
    "median": ".1e",
    "p95": ".1e",
    "worst": ".1e",
    "apart": ".1%",
}
HORIZONS = (1, 2, 5, 10, 20, 50, 100)
WARMUP = 50
"""Control steps under random actions before the comparison, from the reset: bodies fall, lie, and touch the ground."""
APART = 0.1
"""Deviation of a position (m, rad) from which two worlds count as apart."""


def fidelity(bodies: Sequence[str], worlds: int, device: torch.device) -> list[Row]:
    """Compares trajectories from the same states under the same random actions.

    Each protocol is compared with C MuJoCo under the same solver settings, and the one that stops the solver early also
    with a converged solver.
    """
    rows = []
    cases = [(b, "playground", against) for b in bodies for against in ("same settings", "converged")]
    cases += [(b, "dm_control", "same settings") for b in bodies]
    for body, protocol, against in tqdm(cases, desc="fidelity"):
        errors = compare(body, protocol, against == "converged", worlds, device)
        for steps in HORIZONS:
            error = errors[:, steps - 1]
            row = {"body": body, "protocol": protocol, "against": against, "steps": steps}
            quantiles = dict(zip(("median", "p95", "worst"), np.quantile(error, (0.5, 0.95, 1.0)), strict=True))
            rows.append({**row, **quantiles, "apart": float((error > APART).mean())})
    return rows


@torch.no_grad()
def compare(body: str, protocol: str, converged: bool, worlds: int, device: torch.device) -> np.ndarray:
    """Returns the largest deviation of qpos (m, rad) of each world after each control step, ``(worlds, steps)``."""
    env = torchrl_loco.make(TASKS[body], worlds, device, seed=0, protocol=protocol)
    generator = torch.Generator().manual_seed(0)
    shape = env.action_spec.shape
    td = env.reset()
    for _ in range(WARMUP):
        td = env.step(td.set("action", draw(shape, generator).to(device)))["next"]
    start = env.get_state().cpu()
    actions = torch.stack([draw(shape, generator) for _ in range(max(HORIZONS))])
    ours = []
    for action in actions:
        td = env.step(td.set("action", action.to(device)))["next"]
        ours.append(env.get_state()["qpos"].cpu().numpy())

    model = env.mj_model
    if converged:
        model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-10
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data = mujoco.MjData(model)
    states = np.zeros((worlds, mujoco.mj_stateSize(model, spec)))
    for world in range(worlds):
        data.qpos[:], data.qvel[:] = start["qpos"][world], start["qvel"][world]
        data.act[:] = start["act"][world] if model.na else 0.0
        mujoco.mj_getState(model, data, states[world], spec)
    control = models.control(model, actions.transpose(0, 1).double().numpy()).repeat(env.config.substeps, axis=1)
    warmstart = start["qacc_warmstart"].double().numpy()
    trajectory, _ = rollout.rollout(model, [data], states, control, initial_warmstart=warmstart)
    theirs = trajectory[:, env.config.substeps - 1 :: env.config.substeps, 1 : 1 + model.nq]  # after the time
    return np.abs(np.stack(ours, axis=1) - theirs).max(axis=-1)


def draw(shape: torch.Size, generator: torch.Generator) -> torch.Tensor:
    """Draws actions uniformly from [-1, 1]."""
    return torch.rand(shape, generator=generator) * 2 - 1


def plot_fidelity(rows: Sequence[Row], picture: Path) -> None:
    """Draws median and 95th percentile of the deviation against steps, a panel for each body."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    bodies = list(dict.fromkeys(row["body"] for row in rows))
    figure, panels = plt.subplots(1, len(bodies), figsize=(5.5 * len(bodies), 4.2), squeeze=False, layout="constrained")
    for axes, body in zip(panels[0], bodies, strict=True):
        of_body = [row for row in rows if row["body"] == body]
        for protocol, against in dict.fromkeys((row["protocol"], row["against"]) for row in of_body):
            line = [row for row in of_body if (row["protocol"], row["against"]) == (protocol, against)]
            steps, label = [row["steps"] for row in line], f"{protocol} against C MuJoCo, {against}"
            (drawn,) = axes.plot(steps, [row["median"] for row in line], "o-", markersize=3, label=label)
            axes.plot(steps, [row["p95"] for row in line], "--", color=drawn.get_color())
        axes.set(title=body, xlabel="control steps", ylabel="deviation of qpos (m, rad)", xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.suptitle("solid: median over worlds, dashed: 95th percentile", fontsize="small")
    figure.savefig(picture, dpi=150)
