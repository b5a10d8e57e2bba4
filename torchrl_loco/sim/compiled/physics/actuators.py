"""The force of an actuator: traced with the numbers of a model, and by lanes as a function that reads tables."""

import dataclasses
import math
from typing import Any

import mujoco

from torchrl_loco.sim.compiled.ir.symbols import Scalar, cpp_function, maximum, minimum, name

AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
BIASES = int(mujoco.mjtBias.mjBIAS_NONE), AFFINE  # kinds of bias that an actuator may have


@dataclasses.dataclass(frozen=True)
class Actuator:
    """A motor or servo at a hinge, slide or fixed tendon. Numbers, or scalars that read tables.

    Attributes:
        gear: length of the actuator per position of the joint or length of the tendon, and force of that per force of
            the actuator.
        gain: force per input: per control, or activation.
        bias: what is added: a constant, per length and per velocity; ``None`` for a motor.
        control_range: range of the control, or ``None``.
        force_range: range of the force, or ``None``.
    """

    gear: Any
    gain: Any
    bias: Any
    control_range: Any
    force_range: Any

    @classmethod
    def of(cls, m: mujoco.MjModel, i: int) -> "Actuator":
        """Returns an actuator of a model."""
        return cls(
            m.actuator_gear[i, 0],
            m.actuator_gainprm[i, 0],
            m.actuator_biasprm[i, :3] if m.actuator_biastype[i] == AFFINE else None,
            m.actuator_ctrlrange[i] if m.actuator_ctrllimited[i] else None,
            m.actuator_forcerange[i] if m.actuator_forcelimited[i] else None,
        )

    def force(self, given: Scalar, position: Scalar, velocity: Scalar) -> Scalar:
        """Returns its force (N or N m), for its input, and position and velocity of its joint or tendon."""
        force = self.gain * _within(given, self.control_range)
        if self.bias is not None:
            constant, per_length, per_velocity = self.bias
            force = force + constant + self.gear * (per_length * position + per_velocity * velocity)
        return _within(force, self.force_range)

    def as_cpp(self) -> str:
        """Returns :meth:`force` as a member function of the actuator's number ``a``, which its numbers may read."""
        arguments = "given", "position", "velocity"
        parameters = ", ".join(f"float {argument}" for argument in arguments)
        head = f"INLINE float actuator_force(int a, {parameters}) const"
        return cpp_function(head, self.force(*map(name, arguments)))


FILTERS = tuple(int(getattr(mujoco.mjtDyn, f"mjDYN_{kind}")) for kind in ("INTEGRATOR", "FILTER", "FILTEREXACT"))
"""Kinds of activation that an actuator may have."""


def activation_flow(m: mujoco.MjModel, i: int) -> tuple[float, float]:
    """Returns by how much of its control an activation grows in a substep, and of itself shrinks."""
    integrator, euler, _ = FILTERS
    if m.actuator_dyntype[i] == integrator:
        return float(m.opt.timestep), 0.0
    time = m.opt.timestep / max(m.actuator_dynprm[i, 0], mujoco.mjMINVAL)
    share = time if m.actuator_dyntype[i] == euler else -math.expm1(-time)
    return float(share), float(share)


def acting(m: mujoco.MjModel) -> list[int]:
    """Returns the actuators whose group the options do not disable."""
    return [
        i
        for i in range(m.nu)
        if not (0 <= m.actuator_group[i] < 31 and m.opt.disableactuator >> m.actuator_group[i] & 1)
    ]


def _within(x: Scalar, limits: Any) -> Scalar:
    return x if limits is None else minimum(maximum(x, limits[0]), limits[1])
