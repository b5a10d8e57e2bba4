"""Rotations of many worlds in torch; quaternions are (w, x, y, z)."""

import mujoco
import torch


def product(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Returns the products of quaternions, ``(n, 4)``."""
    aw, ax, ay, az = one.unbind(-1)
    bw, bx, by, bz = other.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def matrix(quaternion: torch.Tensor) -> torch.Tensor:
    """Returns the orientations of unit quaternions, ``(n, 3, 3)``."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def small_turn(angles: torch.Tensor) -> torch.Tensor:
    """Returns quaternions that turn by ``angles`` (rad), ``(n, 3)``, where these are small."""
    half = 0.5 * angles
    return torch.cat([(1.0 - half.square().sum(-1, keepdim=True)).clamp(min=0.01).sqrt(), half], dim=-1)


def unit_quaternions(m: mujoco.MjModel, qpos: torch.Tensor) -> torch.Tensor:
    """Returns poses ``(num_envs, nq)`` with the quaternions of free and ball joints normalised; 0 is no turn."""
    for q in _quaternions(m).values():
        none = ~qpos[:, q : q + 4].any(dim=-1, keepdim=True)
        unit = torch.nn.functional.normalize(torch.cat([qpos[:, q : q + 1] + none, qpos[:, q + 1 : q + 4]], -1), dim=-1)
        qpos = torch.cat([qpos[:, :q], unit, qpos[:, q + 4 :]], dim=-1)
    return qpos


def check_quaternions(m: mujoco.MjModel, qpos: torch.Tensor) -> None:
    """Raises ValueError for poses ``(n, nq)`` in which a free or ball joint has a quaternion of zeros."""
    for joint, q in _quaternions(m).items():
        if not qpos[:, q : q + 4].any(dim=-1).all():
            raise ValueError(
                f"the quaternion of joint {m.joint(joint).name or joint}, qpos[:, {q}:{q + 4}], must not be zeros: "
                "(1, 0, 0, 0) is no turn"
            )


def _quaternions(m: mujoco.MjModel) -> dict[int, int]:
    """Returns where quaternions begin in qpos, by joint."""
    return {j: int(m.jnt_qposadr[j]) + 3 * (m.jnt_type[j] == 0) for j in range(m.njnt) if m.jnt_type[j] in (0, 1)}
