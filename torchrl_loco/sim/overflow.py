"""What an engine dropped or cut short in a control step."""

import enum


class Overflow(enum.IntFlag):
    """Bits of ``overflow``: those of :class:`mujoco_warp.OverflowType` that are counted, and our own at the end."""

    NEFC = 1
    """No room for a row of constraints."""
    NJMAX_NNZ = 2
    """No room for an entry of the constraints' Jacobian."""
    BROADPHASE = 4
    """No room for a pair of geoms that may touch."""
    NARROWPHASE = 8
    """No room for a contact."""
    CCD = 16
    """No room for a pair whose contacts are searched iteratively."""
    ITERATIONS = 512
    """The solver used up its iterations."""
    LS_ITERATIONS = 1024
    """A line search used up its iterations."""
    UNSOLVED = 1 << 16
    """The solver failed, or had too few digits: accelerations may be wrong. MuJoCo-Warp never says so."""
    INDEX = 1 << 17
    """A hook has indexed a table beyond its end."""
    INDEX_OF_INTEGERS = 1 << 18
    """The same, of a table whose numbers have no NaN."""
