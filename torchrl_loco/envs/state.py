"""A snapshot of an environment's worlds."""

from typing import Any

from tensordict import TensorDict, TensorDictBase


class State(TensorDict):
    """What ``env.get_state()`` returns and ``env.reset(state, set_state=True)`` restores.

    A TensorDict of batch size ``(num_envs,)`` with

    ==================  ================  =======================================================
    ``qpos``            ``(N, nq)``       positions (m, rad, unit quaternions)
    ``qvel``            ``(N, nv)``       velocities (m/s, rad/s)
    ``qacc_warmstart``  ``(N, nv)``       where the constraint solver starts
    ``elapsed_steps``      ``(N,)``          control steps since the world's reset
    ``episode``         ``(N,)``          episodes drawn so far: the world's random counter
    ==================  ================  =======================================================

    The only difference to a TensorDict: :meth:`select` never drops these entries. ``TransformedEnv`` hands down nothing
    but selected keys, and would otherwise lose the state on its way to the environment. To make one by hand:
    ``State({"qpos": ..., "qvel": ...}, batch_size=[num_envs])``.
    """

    KEYS = ("qpos", "qvel", "qacc_warmstart", "elapsed_steps", "episode")

    def select(self, *keys: Any, inplace: bool = False, strict: bool = True) -> TensorDictBase:
        """Selects ``keys`` and the state."""
        return super().select(*keys, *(key for key in self.KEYS if key in self), inplace=inplace, strict=strict)
