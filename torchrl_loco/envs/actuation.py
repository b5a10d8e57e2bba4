"""The force of actuators, from controls, positions and velocities."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

if TYPE_CHECKING:
    from torchrl_loco.envs.view import View

AFFINE = mujoco.mjtBias.mjBIAS_AFFINE


def force(s: "View") -> torch.Tensor:
    """Returns the forces of all actuators, ``(num_envs, nu)``: see :attr:`torchrl_loco.View.actuator_force`."""
    m, catalog = s._catalog.mj_model, s._catalog
    _check(m)
    joints = m.actuator_trnid[:, 0]
    gear, gain = s.model("actuator_gear")[..., 0], s.model("actuator_gainprm")[..., 0]
    position, velocity = (
        gear * catalog.pick(values, address[joints].tolist(), False)
        for values, address in ((s.qpos, m.jnt_qposadr), (s.qvel, m.jnt_dofadr))
    )
    constant, stiffness, damping = s.model("actuator_biasprm")[..., :3].unbind(-1)
    bias = constant + stiffness * position + damping * velocity
    is_servo = catalog.derived("is_servo", lambda: m.actuator_biastype == AFFINE)
    return _limited(s, "force", gain * _limited(s, "ctrl", s.ctrl) + is_servo * bias)


def _limited(s: "View", name: str, values: torch.Tensor) -> torch.Tensor:
    """Returns controls or forces within their ranges, where they have one."""
    limited = getattr(s._catalog.mj_model, f"actuator_{name}limited").astype(bool)
    if not limited.any():
        return values
    low, high = s.model(f"actuator_{name}range").unbind(-1)
    is_limited = s._catalog.derived(f"{name}limited", lambda: limited) > 0
    return torch.where(is_limited, torch.minimum(torch.maximum(values, low), high), values)


def _check(m: mujoco.MjModel) -> None:
    """Checks that the forces are functions of the state's positions and velocities, and of controls."""
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    at_joint = (m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & np.isin(m.jnt_type[m.actuator_trnid[:, 0]], single)
    plain = (
        at_joint
        & (m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & np.isin(m.actuator_biastype, (mujoco.mjtBias.mjBIAS_NONE, AFFINE))
    )
    if m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION):
        raise ValueError("s.actuator_force needs actuators that work: the model has <flag actuation='disable'/>")
    if not plain.all():
        names = ", ".join(m.actuator(int(i)).name or str(i) for i in np.flatnonzero(~plain)[:3])
        raise ValueError(
            f"s.actuator_force is of motors and servos at hinges and slides, without activation: not {names}"
        )
