"""Which models the compiled step can do: those of installed packages, and those of folders that the user names.

A model that it accepts can be checked: a physics step from states of random motion, beside C MuJoCo.
"""

import copy
import importlib.util
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
import warp as wp
from tqdm import tqdm

from benchmarks.results import Row
from torchrl_loco.config import INTEGRATORS, SimConfig
from torchrl_loco.sim import Simulation, models
from torchrl_loco.sim.compiled import unsupported
from torchrl_loco.sim.compiled.support import IGNORED_FLAGS

PACKAGES = ("dm_control", "gymnasium", "mujoco_playground")
"""Packages that bring models. They are not imported."""
WAYS = ("as is", "options", "ground")
"""Ways to step a model: as it is; with other options and without sensors; without contacts of moving bodies too."""
ERRORS = ("contacts", "median", "p90")
"""Of the steps that are checked: mean number of contacts, and errors of the change of velocity, as a share of it."""
COLUMNS = {
    **{"model": "", "nq": "d", "nv": "d", "nu": "d", **dict.fromkeys(WAYS, "")},
    **{"contacts": ".1f", "median": ".0e", "p90": ".0e", "missing in the last": ""},
}
TOTALS = {"set": "", "models": "d", **dict.fromkeys(WAYS, "d"), "not compiled": "d", "checked": "d", "wrong": "d"}
STATES, BETWEEN = 24, 20
"""States of a model that is checked, and the most physics steps between two."""
SUSPECT, WORSE = 1e-3, 2.0
"""Median error from which a step is compared with that of MuJoCo-Warp, which is of single precision too, and the ratio
of their errors from which it is wrong."""
CLOSE = 1e-6
"""Distance to the margin (m) within which rounding decides whether there is a contact; such states do not count."""


def folders(named: Sequence[Path]) -> dict[str, Path]:
    """Returns where models are looked for, by title."""
    specs = {package: importlib.util.find_spec(package) for package in PACKAGES}
    installed = {package: Path(spec.origin).parent for package, spec in specs.items() if spec and spec.origin}
    return {**installed, **{path.resolve().name: path for path in named}}


def coverage(title: str, folder: Path, *, check: bool = False) -> tuple[list[Row], Row]:
    """Returns a row for each model in a folder, and their totals.

    Files that MuJoCo does not compile, such as parts of models and those whose meshes are elsewhere, are counted.

    Args:
        title: name of the folder.
        folder: the folder.
        check: whether models that are accepted are stepped beside C MuJoCo, in the first of the ways; their kernels are
            compiled for that.
    """
    rows: list[Row] = []
    lost = 0
    for path in tqdm(sorted(folder.rglob("*.xml")), desc=title):
        try:
            tried = [(copy.copy(m), unsupported(m)) for m in _variants(path)]
        except ValueError:
            lost += 1
            continue
        m, missing = tried[-1]
        if m.nv == 0:
            continue
        row: Row = {"model": f"{title}/{path.relative_to(folder)}", "nq": m.nq, "nv": m.nv, "nu": m.nu}
        row |= {way: "" if found else "yes" for way, (_, found) in zip(WAYS, tried, strict=True)}
        row |= dict.fromkeys((*ERRORS, "wrong"))
        accepted = next((found for found, lines in tried if not lines), None)
        if check and accepted is not None:
            row |= dict(zip(ERRORS, compared(accepted, "compiled"), strict=True))
        if row["median"] is not None:  # some states tell
            suspect = row["median"] > SUSPECT
            row["wrong"] = suspect and row["median"] > WORSE * (compared(accepted, "mujoco_warp")[1] or 0.0)
        rows.append({**row, "missing in the last": "; ".join(map(_short, missing))})
    done = {way: sum(row[way] == "yes" for row in rows) for way in WAYS}
    wrong = [row["wrong"] for row in rows if row["wrong"] is not None]
    total = {"set": title, "models": len(rows), **done, "not compiled": lost, "checked": len(wrong)}
    return rows, {**total, "wrong": sum(wrong)}


def compared(m: mujoco.MjModel, engine: str) -> tuple[float, float | None, float | None]:
    """Returns the mean number of contacts, and median and 90 % of the errors of a physics step's change of velocity.

    From states of C MuJoCo under random controls, with a solver that converges in both.
    """
    wp.config.optimization_level = 0  # compiles sooner, and computes the same
    names = {int(getattr(mujoco.mjtIntegrator, f"mjINT_{name.upper()}")): name for name in INTEGRATORS}
    damped = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    settings = {"iterations": 100, "ls_iterations": 50, "euler_damping": damped, "engine": engine}
    m, step = copy.copy(m), m.opt.timestep
    config = SimConfig(ctrl_dt=step, sim_dt=step, integrator=names[int(m.opt.integrator)], **settings)
    sim = Simulation(m, config, STATES, torch.device("cpu"))
    data, rng, contacts = mujoco.MjData(m), np.random.default_rng(0), 0
    begin(m, data, rng)
    after = []
    for world in range(STATES):
        for _ in range(rng.integers(1, BETWEEN)):
            mujoco.mj_step(m, data)
        if not np.isfinite(data.qvel).all() or data.warning.number.any():
            begin(m, data, rng)
        low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, (-1.0, 1.0)).T
        data.ctrl[:] = rng.uniform(low, high)
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            row = torch.from_numpy(getattr(data, name)).float()
            getattr(sim, name)[world] = row
            getattr(data, name)[:] = row  # what single precision holds
        before = data.qvel.copy()
        mujoco.mj_step(m, data)
        contacts += data.ncon
        clear = all(abs(contact.dist - contact.includemargin) > CLOSE for contact in data.contact)
        after.append((before, data.qvel.copy(), clear))
    sim.step()
    errors = []
    for (before, expected, clear), found in zip(after, sim.qvel.numpy(), strict=True):
        if clear:
            error = np.abs(found - expected).max() / (np.abs(expected - before).max() + math.ulp(1.0))
            errors.append(error if np.isfinite(error) else math.inf)
    if not errors:
        return contacts / STATES, None, None
    return contacts / STATES, float(np.median(errors)), float(np.quantile(errors, 0.9))


def begin(m: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Puts a model into its home pose, moved a little and moving."""
    mujoco.mj_resetData(m, data)
    data.qpos[:] = models.home_pose(m)
    mujoco.mj_integratePos(m, data.qpos, rng.normal(0.0, 0.1, m.nv), 1.0)
    data.qvel[:] = rng.normal(0.0, 0.3, m.nv)


def _variants(path: Path) -> Iterator[mujoco.MjModel]:
    """Yields a model in each of the ways."""
    spec = _without_looks(models.specification(path))
    yield models.load(spec)
    m = models.load(spec, sensors=())
    m.opt.integrator, m.opt.solver = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtSolver.mjSOL_NEWTON
    m.opt.cone, m.opt.noslip_iterations, m.opt.enableflags = mujoco.mjtCone.mjCONE_PYRAMIDAL, 0, 0
    m.opt.disableflags &= sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0)) for flag in IGNORED_FLAGS)
    yield m
    models.touch_ground_only(m)
    yield m


def _without_looks(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a model without meshes that touch nothing: robots often come without their files."""
    for geom in list(spec.geoms):
        if geom.meshname and not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    return spec


def _short(line: str) -> str:
    """Returns what is missing without the names of the elements and without what there is instead."""
    first, _, rest = line.partition(": ")
    return rest if "'" in first and rest else first
