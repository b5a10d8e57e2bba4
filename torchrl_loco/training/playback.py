"""Videos and the viewer."""

import io
import os
import sys
import time
import warnings
from collections.abc import Iterable
from pathlib import Path

import torch

from torchrl_loco.envs import LocoEnv
from torchrl_loco.eyes.scene import to_the_horizon
from torchrl_loco.storage import replace_file
from torchrl_loco.training.algorithm import settings_for_small_networks
from torchrl_loco.training.evaluation import PolicyFunc, play

SIZE = 480, 360
"""Width and height of videos."""


def record(
    policy: PolicyFunc, env: LocoEnv, path: Path, seconds: float, action_repeat: int = 1, camera: str = "side"
) -> None:
    """Records the first world of an environment from its reset on, in real time.

    Args:
        policy: reads ``observation`` and writes ``action``.
        env: where it plays.
        path: the video file, written whole or not at all; its suffix chooses the container, the codec is H.264.
        seconds: length of the video (s).
        action_repeat: frames for which an action is held.
        camera: name of one of the model's cameras.
    """
    frame_rate = round(1 / env.config.ctrl_dt)
    steps = play(policy, env, action_repeat, round(seconds * frame_rate), "video")
    with settings_for_small_networks():
        write_video(path, (env.render(camera, *SIZE, worlds=1)[0] for _ in steps), frame_rate)


def write_video(path: Path, frames: Iterable[torch.Tensor], frame_rate: int) -> None:
    """Writes frames, uint8 ``(height, width, 3)``, as a video file, whole or not at all, as :func:`record` does."""
    import imageio.v3 as imageio  # of the extra "train"

    content = io.BytesIO()
    with imageio.imopen(content, "w", plugin="pyav", extension=path.suffix) as video:
        video.init_video_stream("h264", fps=frame_rate)
        for frame in frames:
            video.write_frame(frame.cpu().numpy())
    replace_file(path, content.getvalue())


def has_display() -> bool:
    """Returns whether MuJoCo's viewer can open a window."""
    if sys.platform == "darwin":  # where the viewer needs MuJoCo's own launcher
        return "mjpython" in Path(sys.argv[0]).name or "MJPYTHON_BIN" in os.environ
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw warns where it fails
        return bool(glfw.init())


def view(policy: PolicyFunc, env: LocoEnv, action_repeat: int = 1) -> None:
    """Shows the first world of an environment in MuJoCo's viewer, in real time, until its window is closed.

    Args:
        policy: reads ``observation`` and writes ``action``.
        env: where it plays.
        action_repeat: frames for which an action is held.
    """
    import mujoco.viewer  # needs a display

    model = to_the_horizon(env.mj_model if env.ghost() is None else env.model_with_ghost)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data) as window:
        with window.lock():  # a free camera would lose a body that runs
            window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        while window.is_running():
            due = time.perf_counter()
            for _ in play(policy, env, action_repeat, env.config.episode_length, "episode"):
                ghost = env.ghost()
                data.qpos[:] = (env.sim.qpos if ghost is None else torch.cat([env.sim.qpos, ghost], dim=-1))[0].cpu()
                for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):  # all that is seen
                    update(model, data)
                window.sync()
                due += env.config.ctrl_dt
                time.sleep(max(0.0, due - time.perf_counter()))
                if not window.is_running():
                    break
