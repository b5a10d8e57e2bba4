"""What the tables of speeds in README and docs are made of, measured by one command: ours and others, on one card.

Each part has a file in the folder, which is written anew as soon as a job is done. What it has is not measured again.
"""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks.processes import Job, in_turn
from benchmarks.results import Row, device_name, save
from benchmarks.tasks import MJLAB, RUNNERS, TASKS
from torchrl_loco import motion
from torchrl_loco.registry import env_class
from torchrl_loco.sim import models
from torchrl_loco.tasks.tracking import OWN_RATE

COLUMNS = {"job": "", "worlds": "d", "case": "", "ms": ".3f", "frames/s": ",.0f", "error": ""}
LIMIT = 300.0
"""Seconds in which a process must have compiled, and in which it must have measured."""
CASES = ("bare_default", "bare_compiled", "env_step", "env_step_and_maybe_reset", "rollout_collector")
"""Of all bodies."""
OF_RUNNERS, OF_TWO = ("env_step_dm_control",), ("torchrl_collector",)
"""Of those of dm_control, and of walker and humanoid."""
MORE_WORLDS, OF_MORE = (0.25, 4, 16), ("bare_default", "env_step", "rollout_collector")
"""Further numbers of worlds that walker and humanoid are measured in, as multiples, and the cases."""
PEERS = {"cuda": ("playground", "playground_torchrl"), "cpu": ("c_mujoco",)}


class Wanted(NamedTuple):
    """Where to measure, worlds of all bodies, frames and further settings (``name=value``) of our trainings.

    ``path`` is a folder with the packages of peers, ``mjlab`` one with mjlab's, ``work`` one for files in passing.
    """

    device: torch.device
    worlds: int
    frames: int
    settings: list[str]
    path: Path | None
    mjlab: Path | None
    work: Path


def steps(wanted: Wanted) -> list[Job]:
    """Returns a job for each body: :mod:`benchmarks.throughput`."""
    jobs = []
    for body in TASKS:
        runs: list[tuple[str, int, str]] = [(body, wanted.worlds, case) for case in CASES]
        if body in RUNNERS:
            runs += [(body, wanted.worlds, case) for case in OF_RUNNERS]
        if body in RUNNERS[:2]:
            runs += [(body, wanted.worlds, case) for case in OF_TWO]
            runs += [(body, int(wanted.worlds * times), case) for times in MORE_WORLDS for case in OF_MORE]
        jobs.append(Job(body, ["benchmarks.throughput", wanted.device, json.dumps(runs)]))
    return jobs


def peers(wanted: Wanted) -> list[Job]:
    """Returns a job for each peer of the device and each runner that it has."""
    return [
        Job(
            f"{body}, {peer}",
            [f"benchmarks.peers.{peer}", body, wanted.worlds],
            {"body": body, "worlds": wanted.worlds, "case": peer},
            wanted.path if peer in PEERS["cuda"] else None,
        )
        for peer in PEERS[wanted.device.type]
        for body in RUNNERS
        if body != "quadruped" or not peer.startswith("playground")
    ]


def mjlab(wanted: Wanted) -> list[Job]:
    """Returns a job for each task of mjlab: its step and its training; of our motions it follows one."""
    cls, clip = env_class("g1_tracking"), wanted.work / "motion.npz"
    m = models.load(cls.model)
    poses, _ = motion.Motion(str(min(cls.motion_folder.glob("*.csv"))), fps=OWN_RATE).on(m)
    motion.save(clip, motion.resampled(poses, OWN_RATE, 0.02), 50.0, m)  # a frame for each of its control steps
    return [
        Job(
            task,
            [
                "benchmarks.peers.mjlab_speed",
                task,
                wanted.worlds,
                wanted.device,
                *([clip] if "tracking" in task else []),
            ],
            {"task": task, "worlds": wanted.worlds, "case": "mjlab"},
            wanted.mjlab,
        )
        for task in MJLAB
    ]


def training(wanted: Wanted) -> list[Job]:
    """Returns a job for each task that mjlab has too: our training."""
    settings = [f"num_envs={wanted.worlds}", *wanted.settings]
    return [
        Job(
            task, ["benchmarks.learning", task, wanted.device, wanted.frames, *settings], {"task": task, "case": "ours"}
        )
        for task in MJLAB
    ]


PARTS = {part.__name__: part for part in (steps, peers, mjlab, training)}


def tables(folder: Path, parts: Sequence[str], **options: Any) -> list[Row]:
    """Measures what the files of a folder lack, and returns all of their rows; a job that failed has an error there.

    Args:
        folder: has a file for each part.
        parts: which of :data:`PARTS`.
        options: fields of :class:`Wanted`, but for ``work``.
    """
    rows, name = list[Row](), device_name(options["device"])  # a folder may be filled on several cards
    with tempfile.TemporaryDirectory() as work:
        wanted = Wanted(**options, work=Path(work))
        for part in parts:
            file = folder / f"{part}.json"
            kept = json.loads(file.read_text())["rows"] if file.exists() else []
            found = [row for row in kept if "error" not in row]
            missing = [job for job in PARTS[part](wanted) if job.name not in {row["job"] for row in found}]

            def done(job: Job, result: Row, found: list[Row] = found, file: Path = file) -> None:
                found += [{"job": job.name, **job.about, **row, "device": name} for row in result.get("rows", [result])]
                save(found, file, wanted.device)
                print(f"{file.name}: {job.name} {result.get('error', 'measured')}", flush=True)

            in_turn(missing, LIMIT, done)
            rows += found
    return rows
