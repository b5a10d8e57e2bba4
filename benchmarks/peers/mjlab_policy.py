"""A policy of mjlab's as one of ours, from the file of :mod:`benchmarks.peers.mjlab_ppo`.

    python -m benchmarks.peers.mjlab_policy go1.npz FOLDER/mjlab-go1
    torchrl-loco verify FOLDER/mjlab-go1/policy.safetensors

mjlab measures velocities at the robot's IMU, and orders joints in its own way. Both are linear in our observation, so
they go into the first layer, and the order and scale of its actions into the last; all else is the network that it
trained. In mjlab servos follow the encoders with their bias; in our training and in every evaluation, the joints.
"""

import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import nn

from benchmarks.robots import KEPT, write_metrics
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.registry import env_class
from torchrl_loco.sim import models
from torchrl_loco.tasks.robots import actuated

TERMS = {
    "base_lin_vel": "linear_velocity",
    "base_ang_vel": "angular_velocity",
    "projected_gravity": "gravity",
    "joint_pos": "joint_positions",
    "joint_vel": "joint_velocities",
    "actions": "last_action",
    "command": "command",
}
"""Our name of each term of mjlab's observation."""
UNBOUNDED = 1e9
"""Bound of normalised observations, where mjlab has none."""
Affine = tuple[np.ndarray, np.ndarray]
"""Matrix and shift."""


def convert(path: Path) -> Policy:
    """Returns the policy of a file.

    Raises:
        ValueError: its robot is not ours: another base, control step or term of the observation.
        KeyError: it has other joints.
    """
    file = np.load(path)
    facts: dict[str, Any] = json.loads(str(file["facts"]))
    task = f"{facts['robot']}_velocity"
    cls: Any = env_class(task)
    if (facts["base"], round(facts["control_timestep"], 6)) != (cls.base, cls.config.ctrl_dt):
        raise ValueError(f"{path} is of a robot on {facts['base']} with control steps of {facts['control_timestep']} s")
    info = {
        **{"task": task, "protocol": "playground", "action_repeat": 1, "control_timestep": cls.config.ctrl_dt},
        **{"algorithm": "mjlab 1.6.0's ppo", "trained_on": facts["device"], "seed": facts["seed"]},
        **{"frames": facts["frames"], "num_envs": facts["worlds"], "seconds": round(facts["seconds"], 3)},
        "eval_episodes": 128,
    }
    own = of_ours(models.load(cls.model), cls, info)
    weights = [file[name].astype(float) for name in sorted(file, key=_layer) if name.endswith(".weight")]
    biases = [file[name].astype(float) for name in sorted(file, key=_layer) if name.endswith(".bias")]
    matrix, shift = observation(facts, own)
    spread = file["obs_normalizer._std"][0].astype(float) + float(file["std_epsilon"])
    biases[0] = biases[0] + (weights[0] / spread) @ (shift - file["obs_normalizer._mean"][0])
    weights[0] = (weights[0] / spread) @ matrix
    matrix, shift = action(facts, own)
    weights[-1], biases[-1] = matrix @ weights[-1], matrix @ biases[-1] + shift

    norm = ObservationNorm(weights[0].shape[1], UNBOUNDED)
    norm.var -= 1e-6  # which it adds
    layers: list[nn.Module] = [norm]
    for weight, bias in zip(weights, biases, strict=True):
        layer = nn.Linear(*reversed(weight.shape))
        layer.load_state_dict({"weight": torch.from_numpy(weight), "bias": torch.from_numpy(bias)})
        layers += [layer, nn.ELU()]
    return Policy(nn.Sequential(*layers[:-1]).requires_grad_(False), info)


def of_ours(m: mujoco.MjModel, cls: Any, info: dict[str, Any]) -> dict[str, Any]:
    """Returns what our task observes, ``sizes`` of its terms by name, and controls: ``joints``, offsets and scales."""
    joints = actuated(m)
    sizes = {"linear_velocity": 3, "angular_velocity": 3, "gravity": 3, "joint_positions": len(joints)}
    sizes |= {"joint_velocities": len(joints), "last_action": len(joints), "command": 3}
    return {"sizes": sizes, "joints": joints, **cls.facts(m, info)}


def _layer(name: str) -> tuple[bool, int]:
    """Returns where an array stands among those of the network: ``mlp.4.weight`` is the third layer's."""
    first, _, rest = name.partition(".")
    return first != "mlp", int(rest.partition(".")[0]) if first == "mlp" else 0


def observation(facts: dict[str, Any], own: dict[str, Any]) -> Affine:
    """Returns how mjlab's observation follows from ours.

    Args:
        facts: those of mjlab's file.
        own: :func:`of_ours`.

    Raises:
        ValueError: a term is unknown, or of another size.
        KeyError: a joint is not ours.
    """
    starts, first = {}, 0
    for term, size in own["sizes"].items():
        starts[term], first = first, first + size
    joints = own["joints"]
    matrix, shift, row = np.zeros((sum(facts["sizes"]), first)), np.zeros(sum(facts["sizes"])), 0
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, np.array(facts["imu_quaternion"]))
    into_imu, (x, y, z) = turned.reshape(3, 3).T, facts["imu_position"]
    rotation = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # the velocity at the IMU by that of the rotation

    for name, size in zip(facts["terms"], facts["sizes"], strict=True):
        if name not in TERMS:
            raise ValueError(f"unknown term {name!r}: known are {', '.join(TERMS)}")
        rows, start = slice(row, row + size), starts[TERMS[name]]
        if name in ("base_lin_vel", "base_ang_vel"):
            matrix[rows, start : start + 3] = into_imu
            if name == "base_lin_vel":
                turns = starts["angular_velocity"]
                matrix[rows, turns : turns + 3] = into_imu @ rotation
        elif name in ("joint_pos", "joint_vel", "actions"):
            order = _order(facts["actions"] if name == "actions" else facts["joints"], joints)
            scale = np.ones(len(order))
            if name == "joint_pos":
                shift[rows] = np.array(own["action_offset"])[order] - facts["home"]
            if name == "actions":
                scale = np.array(own["action_scale"])[order] / facts["scale"]
                shift[rows] = (np.array(own["action_offset"])[order] - facts["offset"]) / facts["scale"]
            matrix[np.arange(row, row + size), start + order] = scale
        else:
            matrix[rows, start : start + size] = np.eye(size)
        row += size
    return matrix, shift


def action(facts: dict[str, Any], own: dict[str, Any]) -> Affine:
    """Returns how our action follows from mjlab's, so that the targets of the joints are the same."""
    joints = own["joints"]
    order = _order(joints, facts["actions"])
    scale, offset = np.array(own["action_scale"]), np.array(own["action_offset"])
    matrix = np.zeros((len(joints), len(order)))
    matrix[np.arange(len(joints)), order] = np.array(facts["scale"])[order] / scale
    return matrix, (np.array(facts["offset"])[order] - offset) / scale


def _order(wanted: list[str], joints: list[str]) -> np.ndarray:
    """Returns where joints stand in a list of as many.

    Raises:
        KeyError: it has others.
    """
    if sorted(wanted) != sorted(joints):
        raise KeyError(f"joints differ: {', '.join(sorted({*wanted} ^ {*joints}))}")
    return np.array([joints.index(name) for name in wanted])


def metrics(path: Path) -> list[dict[str, float]]:
    """Returns the curve of a file, as the metrics of a run; mjlab's means are over 100 episodes."""
    file = np.load(path)
    curve, frames = file["curve"], json.loads(str(file["facts"]))["frames"]
    return [
        dict(zip(KEPT, (i, frames * i / len(curve), *of_iteration, 100), strict=True))
        for i, of_iteration in enumerate(curve.tolist(), 1)
    ]


if __name__ == "__main__":
    source, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True)
    write_metrics(folder, metrics(source))
    convert(source).save(folder / "policy.safetensors")
