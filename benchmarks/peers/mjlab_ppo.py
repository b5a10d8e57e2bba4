"""mjlab's flat velocity tasks, trained by its own runner: the actor, its curve, and what tells how to play it.

It runs in a process of its own, in which mjlab and the MuJoCo that it pins come first:

    PYTHONPATH=FOLDER python benchmarks/peers/mjlab_ppo.py go1 150 go1.npz

A second call goes on from ``go1.pt`` until the seconds are reached: a long training may take several. Then
:mod:`benchmarks.peers.mjlab_policy` makes a policy of the file.
"""

import argparse
import importlib.abc
import importlib.machinery
import json
import signal
import sys
import time
import types
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

FOR_SHOW = ("viser", "mjviser", "wandb", "torchrunx", "mediapy", "trimesh", "git", "imageio_ffmpeg")
"""Packages that mjlab imports for viewers and loggers, which a training without either never calls."""
TASKS = {"go1": "Mjlab-Velocity-Flat-Unitree-Go1", "g1": "Mjlab-Velocity-Flat-Unitree-G1"}


class Absent(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds empty modules where a package of :data:`FOR_SHOW` is not installed."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Returns the spec of an empty module, ``None`` for all other names."""
        shown = name.partition(".")[0] in FOR_SHOW
        return importlib.machinery.ModuleSpec(name, self, is_package=True) if shown else None

    def create_module(self, spec: Any) -> types.ModuleType:
        """Returns a module that has an empty class under every name."""
        module = types.ModuleType(spec.name)
        module.__getattr__ = _empty_class
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Has nothing to run."""


def _empty_class(name: str) -> type:
    if name.startswith("__"):
        raise AttributeError(name)
    takes_all = {"__init__": lambda self, *args, **kwargs: None, "__class_getitem__": classmethod(lambda cls, key: cls)}
    return type(name, (), takes_all)


sys.meta_path.append(Absent())  # last: what is installed comes first

import mujoco  # noqa: E402

if not hasattr(mujoco, "Renderer"):  # where no window can be opened; mjlab names it in a signature
    setattr(mujoco, "Renderer", object)  # noqa: B010

import mjlab.tasks  # noqa: E402, F401  it registers the tasks
import torch  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper  # noqa: E402
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls  # noqa: E402
from mjlab.utils.torch import configure_torch_backends  # noqa: E402


class Curve:
    """Stands in for the runner's log: notes each iteration, and ends the training when its time is over.

    Attributes:
        rows: seconds of training, mean reward and mean length of the last 100 episodes, by iteration.
    """

    def __init__(self, runner: MjlabOnPolicyRunner, seconds: float, rows: list[list[float]]) -> None:
        self._logger, self._until, self.rows = runner.logger, seconds, rows
        runner.logger.writer, runner.logger.log_dir = object(), ""  # without, it keeps no returns of episodes
        runner.logger.init_logging_writer, runner.logger.log = lambda: None, self.note
        runner.save = lambda *args: None
        self._start = time.perf_counter() - (rows[-1][0] if rows else 0.0)

    def rate(self, frames: int) -> float | None:
        """Returns frames per second without the first iterations, of which each has so many frames."""
        times = [seconds for seconds, *_ in self.rows[5:]]
        return frames * (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None

    def note(self, **of_iteration: Any) -> None:
        """Notes an iteration.

        Raises:
            KeyboardInterrupt: it was the last one.
        """
        logger, seconds = self._logger, time.perf_counter() - self._start
        ended = max(len(logger.rewbuffer), 1)
        self.rows.append([seconds, sum(logger.rewbuffer) / ended, sum(logger.lenbuffer) / ended])
        logger.ep_extras.clear()
        if len(self.rows) % 50 == 1 or seconds >= self._until:
            print(len(self.rows), *(f"{value:.2f}" for value in self.rows[-1]), flush=True)
        if seconds >= self._until:
            raise KeyboardInterrupt


def made(task: str, worlds: int, device: str, motion: Path | None = None) -> tuple[MjlabOnPolicyRunner, Any]:
    """Returns the runner of a task of mjlab, with its environment, and its settings of the training.

    Raises:
        ValueError: actions are clipped, which nothing here expects.
    """
    configure_torch_backends()
    cfg, rl = load_env_cfg(task), load_rl_cfg(task)
    cfg.scene.num_envs, rl.upload_model = worlds, False
    cfg.seed = rl.seed
    if motion is not None:
        cfg.commands["motion"].motion_file = str(motion)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg=cfg, device=device), clip_actions=rl.clip_actions)
    if rl.clip_actions is not None:
        raise ValueError("actions are clipped, which the file cannot tell")
    return (load_runner_cls(task) or MjlabOnPolicyRunner)(env, asdict(rl), None, device), rl


def layout(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Returns the facts by which the actor's numbers can be found on a robot elsewhere.

    ``terms`` and ``sizes`` of the observation; ``joints`` of the observation and their ``home`` (rad); ``actions``, the
    joints of the action, with ``scale`` and ``offset`` (rad); ``base``, and ``imu_position`` (m) and ``imu_quaternion``
    in its frame, where velocities are measured; ``control_timestep`` (s).
    """
    robot, action = env.scene["robot"], env.action_manager.get_term("joint_pos")
    m, manager = env.sim.mj_model, env.observation_manager
    sites = {int(m.sensor(f"robot/imu_{kind}_vel").objid[0]) for kind in ("lin", "ang")}
    (site,) = sites
    base = m.body(int(m.site_bodyid[site])).name
    if m.body_parentid[m.body(base).id] != 0:
        raise ValueError(f"velocities are measured on {base}, which does not float")
    scale, offset = (torch.as_tensor(value).expand(env.num_envs, -1)[0] for value in (action.scale, action.offset))
    return {
        "terms": manager.active_terms["actor"],
        "sizes": [size for (size,) in manager.group_obs_term_dim["actor"]],
        "joints": list(robot.joint_names),
        "home": robot.data.default_joint_pos[0].tolist(),
        "actions": list(action.target_names),
        "scale": scale.tolist(),
        "offset": offset.tolist(),
        "base": base.removeprefix("robot/"),
        "imu_position": m.site_pos[site].tolist(),
        "imu_quaternion": m.site_quat[site].tolist(),
        "control_timestep": env.step_dt,
    }


def train(robot: str, seconds: float, out: Path, worlds: int, device: str) -> None:
    """Trains a robot, or goes on, until so many seconds of training; writes the actor to ``out``."""
    began = time.perf_counter()
    runner, rl = made(TASKS[robot], worlds, device)
    facts = layout(runner.env.unwrapped)
    checkpoint, rows = out.with_suffix(".pt"), []
    if checkpoint.exists():
        rows = runner.load(str(checkpoint))["rows"]
    print(f"worlds made in {time.perf_counter() - began:.0f} s, {len(rows)} iterations so far", flush=True)

    save, curve = runner.save, Curve(runner, seconds, rows)
    if not rows or rows[-1][0] < seconds:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a time limit loses nothing
        try:
            runner.learn(rl.max_iterations - len(rows), init_at_random_ep_len=True)
        except KeyboardInterrupt:
            save(str(checkpoint), {"rows": curve.rows})

    frames = worlds * rl.num_steps_per_env
    facts |= {
        "robot": robot,
        "worlds": worlds,
        "seed": rl.seed,
        "frames": frames * len(curve.rows),
        "seconds": curve.rows[-1][0],
        "frames_per_second": curve.rate(frames),
        "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU",
        "mujoco": mujoco.__version__,
    }
    actor = runner.alg.get_policy()
    arrays = {name: tensor.cpu().numpy() for name, tensor in actor.state_dict().items()}
    arrays["std_epsilon"] = np.array(actor.obs_normalizer.eps)
    np.savez(out, facts=json.dumps(facts), curve=np.array(curve.rows), **arrays)
    print(json.dumps({name: facts[name] for name in ("robot", "frames", "seconds", "frames_per_second")}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("robot", choices=list(TASKS))
    parser.add_argument("seconds", type=float, help="of training; making the worlds does not count")
    parser.add_argument("out", type=Path, help="the file, .npz")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--device", default="cuda:0")
    args = parser.parse_args()
    train(args.robot, args.seconds, args.out, args.worlds, args.device)
