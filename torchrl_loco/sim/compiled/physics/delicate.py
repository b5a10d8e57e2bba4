"""Models for whose solver the digits of single precision may not be enough: these pay for a look at each pivot.

The solver factors H = M + J' D J. A pivot is what elimination leaves of an entry of its diagonal. Where that is a
millionth, a tenth of it is rounding, as in chains of light links with heavy ends, or beside constraints that are much
stiffer than the body is heavy. Such a step is flagged, however right it is.
"""

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.physics.constraints import MAXIMP

LEAST_PIVOT = 256 * 2.0**-23  # share of its entry of the diagonal that a pivot must keep

SAFE = 3e-4
"""Share above which the estimate of :func:`is_delicate` lets a model go; poses differ by a factor of 10."""

POSES = 8


def is_delicate(m: mujoco.MjModel) -> bool:
    """Returns whether pivots may be too small, by those of M in a few poses and by the stiffest constraint."""
    impedances = [
        m.geom_solimp[(m.geom_contype | m.geom_conaffinity) != 0],
        m.pair_solimp,
        m.jnt_solimp[m.jnt_limited != 0],
        m.dof_solimp[m.dof_frictionloss > 0],
        m.eq_solimp[m.eq_active0 != 0],
    ]
    stiffest = min(max((rows[:, :2].max() for rows in impedances if len(rows)), default=0.0), MAXIMP)
    return _least_pivot_of_mass(m) * (1 - stiffest) < SAFE


def _least_pivot_of_mass(m: mujoco.MjModel) -> float:
    """Returns the least pivot of M, as a share of its entry of the diagonal, in the default pose and random ones."""
    data, rng, least = mujoco.MjData(m), np.random.default_rng(0), 1.0
    for _ in range(POSES):
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_makeM(m, data)
        mujoco.mj_factorM(m, data)
        matrix = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, matrix)
        least = min(least, (1 / (data.qLDiagInv * np.maximum(np.diag(matrix), mujoco.mjMINVAL))).min())
        mujoco.mj_integratePos(m, data.qpos, rng.normal(size=m.nv), 1.0)
    return least
