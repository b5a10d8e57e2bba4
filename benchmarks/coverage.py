"""Which models the compiled step can do: those of installed packages, and those of folders that the user names."""

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
from tqdm import tqdm

from benchmarks.results import Row
from torchrl_loco.sim import models
from torchrl_loco.sim.compiled import unsupported
from torchrl_loco.sim.compiled.support import IGNORED_FLAGS

PACKAGES = ("dm_control", "gymnasium", "mujoco_playground")
"""Packages that bring models. They are not imported."""
WAYS = ("as is", "options", "ground")
"""Ways to step a model: as it is; with other options and without sensors; without contacts of moving bodies too."""
COLUMNS = {"model": "", "nq": "d", "nv": "d", "nu": "d", **dict.fromkeys(WAYS, ""), "missing in the last": ""}
TOTALS = {"set": "", "models": "d", **dict.fromkeys(WAYS, "d"), "not compiled": "d"}


def folders(named: Sequence[Path]) -> dict[str, Path]:
    """Returns where models are looked for, by title."""
    specs = {package: importlib.util.find_spec(package) for package in PACKAGES}
    installed = {package: Path(spec.origin).parent for package, spec in specs.items() if spec and spec.origin}
    return {**installed, **{path.resolve().name: path for path in named}}


def coverage(title: str, folder: Path) -> tuple[list[Row], Row]:
    """Returns a row for each model in a folder, and their totals.

    Files that MuJoCo does not compile, such as parts of models and those whose meshes are elsewhere, are counted.
    """
    rows: list[Row] = []
    lost = 0
    for path in tqdm(sorted(folder.rglob("*.xml")), desc=title):
        try:
            *first, (m, missing) = [(m, unsupported(m)) for m in _variants(path)]
        except ValueError:
            lost += 1
            continue
        if m.nv == 0:
            continue
        row: Row = {"model": f"{title}/{path.relative_to(folder)}", "nq": m.nq, "nv": m.nv, "nu": m.nu}
        lines = [*(found for _, found in first), missing]
        row |= {way: "" if found else "yes" for way, found in zip(WAYS, lines, strict=True)}
        rows.append({**row, "missing in the last": "; ".join(map(_short, missing))})
    done = {way: sum(row[way] == "yes" for row in rows) for way in WAYS}
    return rows, {"set": title, "models": len(rows), **done, "not compiled": lost}


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
