"""What the page of a task says in numbers, and its picture."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torchrl.envs.utils import step_mdp

import torchrl_loco
from generate.markdown import table
from torchrl_loco.config import NACONMAX_FLOOR, NACONMAX_WORLDS, PROTOCOLS, sim_config
from torchrl_loco.policy import shipped_policies
from torchrl_loco.registry import ALIASES, OURS, env_class
from torchrl_loco.sim import models
from torchrl_loco.tasks.tracking import FOLLOWED, PENALTIES
from torchrl_loco.training.config import is_runner

RUNNERS = [name for name in OURS if is_runner(name)]  # the others have pages of their own
CLASSES = {env_class(name).body: env_class(name) for name in RUNNERS}
"""A class of each body."""

COMMAND = (0.8, 0.0, 0.15)
"""Velocity forward and to the left (m/s) and yaw rate (rad/s) of robots in moving pictures."""
RATE, QUALITY = 20, 60
"""Frames a second of moving pictures, and their quality in percent."""


def _aliases(name: str) -> str:
    return ", ".join(f"`{alias}`" for alias, target in ALIASES.items() if target == name)


def properties(name: str, more: Sequence[tuple[str, str]]) -> str:
    """Returns the head of a task's page: its picture and a table, which ends with more lines."""
    cls = env_class(name)
    config = cls.config
    nu = models.load(cls.model).nu
    length = config.episode_length
    rows = [
        ("id", f"`{name}`"),
        ("alias", _aliases(name)),
        ("class", f"[`torchrl_loco.{cls.__name__}`](../api/environments.md)"),
        ("action", f"`(num_envs, {nu})`, float32, in [-1, 1]"),
        ("observation", f"`(num_envs, {cls.observation_size})`, float32"),
        ("reward", "`(num_envs, 1)`, float32, in [0, 1]"),
        ("target speed", f"{cls.target_speed:g} m/s" if cls.target_speed else "0 m/s"),
        ("control step", f"{config.ctrl_dt:g} s"),
        ("physics step", f"{config.sim_dt:g} s, {config.substeps} in a control step"),
        ("episode", f"{length} control steps, {length * config.ctrl_dt:g} s"),
        ("protocols", ", ".join(f"`{protocol}`" for protocol in PROTOCOLS)),
        *more,
    ]
    shown = f"![{name}: the shipped policy after a reset](../_static/tasks/{name}.webp)"
    return f"{shown}\n\n{table(('property', 'value'), rows)}"


def overview() -> str:
    """Returns the table of all tasks."""
    rows = []
    for name in RUNNERS:
        cls = env_class(name)
        speed = f"{cls.target_speed:g}" if cls.target_speed else "0"
        policy = _info(name)
        best = f"{policy['mean']:.0f} ± {policy['std']:.0f}" if policy else "none yet"
        link = f"[{name}]({name}.md)"
        rows.append((link, _aliases(name), models.load(cls.model).nu, cls.observation_size, speed, best))
    return table(("id", "alias", "action", "observation", "target speed (m/s)", "return of the policy"), rows)


def protocols(body: str) -> str:
    """Returns the settings of a body's simulation under each protocol."""
    settings = {p: dataclasses.asdict(sim_config(CLASSES[body].config, p, NACONMAX_WORLDS, {})) for p in PROTOCOLS}
    rows = [(f"`{field}`", *(f"`{settings[p][field]}`" for p in PROTOCOLS)) for field in settings[PROTOCOLS[0]]]
    note = (
        f"\n`naconmax` is for {NACONMAX_WORLDS} worlds and is scaled with `num_envs`, with a minimum of "
        f"{NACONMAX_FLOOR}. [`SimConfig`](../api/simulation.md) says what each setting is.\n"
    )
    return table(("setting", *(f"`{protocol}`" for protocol in PROTOCOLS)), rows) + note


def _info(name: str, protocol: str = "playground") -> dict[str, Any] | None:
    """Returns the info of the shipped policy, None if there is none."""
    if name not in shipped_policies(protocol):
        return None
    return torchrl_loco.load_policy(name, "cpu", protocol).info


def shipped_policy(name: str) -> str:
    """Returns how well the shipped policies of a task do, if there are any."""
    found = {protocol: info for protocol in PROTOCOLS if (info := _info(name, protocol))}
    if not found:
        return "No policy is shipped for this task. The [benchmarks](../benchmarks.md) list its training runs.\n"
    return "\n".join(_about_policy(name, protocol, info) for protocol, info in found.items())


def _about_policy(name: str, protocol: str, info: dict[str, Any]) -> str:
    chosen = "" if protocol == "playground" else f', protocol="{protocol}"'
    episodes = f"{info['episodes']} episodes of {env_class(name).config.episode_length} steps"
    if info["std"] < 1e-3:
        earned = f"**{info['mean']:.1f}** under protocol `{protocol}`, where all episodes begin and so end alike"
    else:
        earned = (
            f"**{info['mean']:.1f} ± {info['std']:.1f}** under protocol `{protocol}` (mean and standard deviation over "
            f"{episodes} that were not used to select it; worst {info['min']:.1f}, best {info['max']:.1f})"
        )
    return (
        f'`torchrl_loco.load_policy("{name}"{chosen})` returns {earned}. It was trained by '
        f"{info['algorithm'].upper()} for {info['frames'] / 1e6:.0f} million frames on one {info['trained_on']}, with "
        f"{info['num_envs']} worlds and seed {info['seed']}.\n"
    )


@torch.no_grad()
def frames(
    name: str, width: int, height: int, seconds: float, protocol: str = "playground", seed: int = 2
) -> list[torch.Tensor]:
    """Returns what the shipped policy of a task does after a reset, ``RATE`` times a second.

    Each frame is ``(height, width, 3)``, in [0, 255], and the mean of four pixels each, which smooths the edges. Robots
    look to the right and follow ``COMMAND``.

    Raises:
        ValueError: the task has no policy under the protocol.
    """
    policy, commanded = torchrl_loco.load_policy(name, device="cpu", protocol=protocol), name.endswith("_velocity")
    env = torchrl_loco.make(name, num_envs=1, device="cpu", seed=seed, protocol=protocol, play=not is_runner(name))
    dt, repeat = env.config.ctrl_dt, policy.info.get("action_repeat", 1)
    wanted = [round(i / RATE / dt) for i in range(round(seconds * RATE))]
    td, found = env.reset(), []
    if commanded:
        env.set_command(COMMAND)
        state = env.get_state()
        state["qpos"][:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        td = env.reset(state, set_state=True)
    for step in range(wanted[-1] + 1):
        if step == wanted[len(found)]:
            pixels = env.render("side", 2 * width, 2 * height)[0].float()
            found.append(pixels.view(height, 2, width, 2, 3).mean(dim=(1, 3)))
        if step % repeat == 0:
            action = policy(td)["action"]
        td = step_mdp(env.step(td.set("action", action)))
    return found


def save_moving(path: Path, pictures: Sequence[torch.Tensor], rate: int = RATE) -> None:
    """Writes pictures of shape ``(height, width, 3)``, so many a second, as a WebP file that repeats without end."""
    first, *others = (Image.fromarray(picture.round().to(torch.uint8).numpy()) for picture in pictures)
    options = {"quality": QUALITY, "method": 5, "duration": round(1000 / rate), "loop": 0}
    first.save(path, save_all=True, append_images=others, **options)


def joined(pieces: list[torch.Tensor], dim: int, gap: int) -> torch.Tensor:
    """Returns pictures of shape ``(height, width, 3)`` side by side (dim 1) or one above the other (dim 0), in uint8.

    Between two of them lies a white gap of as many pixels.
    """
    size = list(pieces[0].shape)
    size[dim] = gap
    white = torch.full(size, 255.0)
    all_pieces = [part for piece in pieces for part in (white, piece.float())][1:]
    return torch.cat(all_pieces, dim=dim).round().to(torch.uint8)


MEANINGS = {
    "linear_velocity": "velocity of the base in its frame (m/s)",
    "angular_velocity": "angular velocity of the base in its frame (rad/s)",
    "gravity": "direction of gravity in the base's frame",
    "joint_positions": "relative to the home pose (rad), in the order of the actuators",
    "joint_velocities": "rad/s",
    "last_action": "the last action that was sent",
    "command": "velocity forward, to the left (m/s), yaw rate (rad/s)",
    "foot_heights": "m",
    "air_time": "of each foot (s)",
    "foot_contacts": "whether each touches something, 0 or 1",
    "foot_forces": "`sign(f) log(1 + abs(f))` of the components of each contact force (N)",
    "delay": "of actions (control steps)",
    "reference_joints": "joints of the reference (rad)",
    "reference_rates": "their rates (rad/s)",
    "anchor_position": "of the reference's anchor, in the frame of the robot's (m)",
    "anchor_orientation": "the same, two columns of a matrix",
    "bodies": "positions of the bodies in the anchor's frame (m)",
    "orientations": "theirs, two columns of a matrix each",
}
"""What the terms of a robot's observation are."""


ERRORS = {
    "anchor_position": "the anchor in the world (m)",
    "anchor_orientation": "the same (rad)",
    "body_positions": "bodies, moved to the anchor (m)",
    "body_orientations": "the same (rad)",
    "body_velocities": "bodies in the world (m/s)",
    "body_turn_rates": "the same (rad/s)",
    "action_rate": "squared change of the action",
    "joint_limits": "how far joints are beyond 0.9 of their ranges (rad)",
    "self_collision": "physics steps with a contact with itself of more than 10 N",
}
"""Of what the terms of the reward for following are."""


def observation(names: Sequence[str]) -> str:
    """Returns the terms of the observations of tasks: sizes, a column a task, noise, and who sees them."""
    envs = [torchrl_loco.make(name, 1, "cpu", 0, engine="mujoco", compile_hooks=False) for name in names]
    seen, rows = envs[0].observation_layout["observation"], []
    for name in envs[0].observation_layout["privileged"]:
        sizes = [env.observation_layout["privileged"][name] for env in envs]
        noise = envs[0].noise.get(name, 0.0)
        most = f"{noise[0]:g}, and `{noise[1]}`" if isinstance(noise, tuple) else f"{noise:g}" if noise else ""
        rows.append((f"`{name}`", MEANINGS[name], *sizes, most, "" if name in seen else "critic"))
    return table(("term", "", *(f"`{name}`" for name in names), "noise, either way", "seen by"), rows)


def tracking_reward() -> str:
    """Returns the table of the terms of the reward of those that follow motions."""
    rows = [(f"`{name}`", f"{weight:g}", f"{error:g}", ERRORS[name]) for name, (weight, error) in FOLLOWED.items()]
    rows += [(f"`{name}`", f"{weight:g}", "", ERRORS[name]) for name, weight in PENALTIES.items()]
    return table(("term", "weight", "`s`", "of"), rows)


def velocity_weights() -> str:
    """Returns the table of the weights of the reward of those that follow a velocity, a column a robot."""
    followers = {name: env_class(name).weights for name in OURS if name.endswith("_velocity")}
    terms = list(dict.fromkeys(term for weights in followers.values() for term in weights))
    rows = [(f"`{term}`", *(f"{w[term]:g}" if term in w else "" for w in followers.values())) for term in terms]
    return table(("term", *(f"`{name}`" for name in followers)), rows)
