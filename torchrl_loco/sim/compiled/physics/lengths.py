"""Lengths along which actuators pull and equalities hold: of hinges and slides, and of fixed tendons, their sums."""

import dataclasses

import mujoco

OF_JOINT, OF_TENDON = (int(getattr(mujoco.mjtTrn, f"mjTRN_{kind}")) for kind in ("JOINT", "TENDON"))
"""Transmissions of an actuator."""


@dataclasses.dataclass(frozen=True)
class Length:
    """A sum of positions of hinges and slides, each times a coefficient.

    Attributes:
        shares: degrees of freedom, and their coefficients.
        at_home: the sum in the model's reference pose.
        weight: approximate inverse inertia along it.
    """

    shares: tuple[tuple[int, float], ...]
    at_home: float
    weight: float

    @classmethod
    def of_joint(cls, m: mujoco.MjModel, joint: int) -> "Length":
        """Returns the position of a hinge or slide."""
        dof = int(m.jnt_dofadr[joint])
        return cls(((dof, 1.0),), float(m.qpos0[m.jnt_qposadr[joint]]), float(m.dof_invweight0[dof]))

    @classmethod
    def of_tendon(cls, m: mujoco.MjModel, tendon: int) -> "Length":
        """Returns the length of a fixed tendon."""
        wraps = range(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        shares = tuple((int(m.jnt_dofadr[m.wrap_objid[k]]), float(m.wrap_prm[k])) for k in wraps)
        return cls(shares, float(m.tendon_length0[tendon]), float(m.tendon_invweight0[tendon]))
