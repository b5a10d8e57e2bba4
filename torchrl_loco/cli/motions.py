"""Motions at the command line: which are followed, and the command on what is in files."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

import torchrl_loco
from torchrl_loco.checks import check_choice, check_output_file
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.registry import resolve
from torchrl_loco.training.config import check_video


@dataclasses.dataclass(frozen=True)
class Motions:
    """Which motions are followed."""

    motion: tuple[str, ...] = ()
    """Motions for a task that follows some, instead of those of the training: files, folders or globs."""
    fps: float = 0.0
    """Frames per second of those in CSV files."""

    def given(self, task: str) -> dict[str, object]:
        """Returns the options of a task that are given."""
        if not (self.motion or self.fps):
            return {}
        given = {"motion": list(self.motion), "fps": self.fps} if self.motion else {"fps": self.fps}
        return resolve(task).checked_options(given)  # the rate is not that of the training


THOSE_OF_TRAINING = Motions()

FRAME_RATE = 25  # frames per second of videos


def motion(
    files: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FILE...")],
    /,
    fps: float | None = None,
    task: str = "g1_tracking",
    clip: bool = False,
    ground: bool = False,
    out: Annotated[
        Path | None,
        tyro.conf.arg(help="a new file: .mp4 for a video of the first motion, .npz for a copy of one, as mjlab's."),
    ] = None,
    camera: str = "side",
) -> None:
    """Print what is in files of motions, and what is wrong with it, for a robot.

    Args:
        files: CSV or npz files, folders or globs.
        fps: frames per second of CSV files.
        task: a task that follows motions, whose robot it is.
        clip: put joints that are beyond their limits at them.
        ground: shift motions so that their lowest points lie 5 mm in the ground, as those of a robot that stands.
        out: a video of the first, or a copy of the only one, also with joints clipped and shifted.
        camera: name of one of the model's cameras, for the video.
    """
    with user_errors():
        if out is not None:
            check_output_file("out", out, (".mp4", ".npz"))
            if out.suffix == ".mp4":
                check_video()
        if not files:
            raise ValueError("name a CSV or npz file, a folder or a glob")
        from torchrl_loco.envs.task import folder_of
        from torchrl_loco.sim import models

        motions, cls = torchrl_loco.motion, resolve(task, by_user=True)
        m = models.load(cls.model, folder_of(cls))
        check_choice("camera", camera, [m.camera(i).name for i in range(m.ncam)])
        named = motions.named(list(files), fps or 0.0)
        width = max(len(Path(one["path"]).stem) for one in named if isinstance(one, dict))
        print(f"{'motion':<{width}}  frames     Hz  seconds  lowest (m)  speed (m/s)  joints (rad/s)")
        found, first, wrong = [], None, 0
        for one in named:
            assert isinstance(one, dict)  # none is a Motion
            try:
                each = motions.Motion(**one, clip=clip, ground=ground)
                q, said = each.on(m)
                each.in_steps(q, cls.config.ctrl_dt)
            except ValueError as error:
                print(f"{Path(one['path']).stem:<{width}}  WRONG: {error}")
                wrong += 1
                continue
            found.append(each)
            first = q if first is None else first
            print(f"{each.name:<{width}}  {_row(each, q, m)}  {'; '.join(said)}".rstrip())
        seconds = sum(each.seconds for each in found)
        print(f"{len(found)} motions of {seconds:.1f} s in all, for {task}")
        if wrong:
            raise ValueError(f"{wrong} of {len(named)} files hold no motion for {task}")
        if out is not None and out.suffix == ".npz" and len(found) > 1:
            raise ValueError(f"out: a copy is of one motion, and there are {len(found)}: name one file")
        if out is not None and first is not None:
            q = first
            if out.suffix == ".npz":
                motions.save(out, q, found[0].fps, m)
            else:
                _film(m, motions.resampled(q, found[0].fps, 1.0 / FRAME_RATE), out, camera)
            print(out)


def _row(motion: "torchrl_loco.Motion", q: np.ndarray, m: Any) -> str:
    """Returns figures of a motion on a model."""
    lowest = torchrl_loco.motion.lowest_points(m, *torchrl_loco.motion.poses(m, q)).min()
    speed = np.linalg.norm(np.diff(q[:, :3], axis=0), axis=1).max() * motion.fps
    rate = np.abs(np.diff(q[:, 7:], axis=0)).max() * motion.fps
    return f"{len(q):6d} {motion.fps:6g} {motion.seconds:8.2f} {lowest:11.3f} {speed:12.2f} {rate:15.1f}"


def _film(m: Any, q: np.ndarray, out: Path, camera: str) -> None:
    """Renders poses as a video, at its frame rate."""
    import torch
    import warp as wp
    from tqdm.auto import tqdm

    from torchrl_loco.eyes.pictures import Poses
    from torchrl_loco.sim.warp_init import init_warp
    from torchrl_loco.training.evaluation import SIZE, write_video

    init_warp()
    print(f"rendering {len(q)} frames; on a CPU this takes a while", file=sys.stderr)
    renderer = Poses(m, wp.get_device("cuda" if torch.cuda.is_available() else "cpu"), camera, *SIZE, 1)
    shown = tqdm(torch.from_numpy(q), desc="video", leave=False, disable=None)
    write_video(out, (renderer.render(row[None])[0] for row in shown), FRAME_RATE)
