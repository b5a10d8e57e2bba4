"""A snapshot of an environment's worlds."""

from typing import Any

from tensordict import TensorDict, TensorDictBase

from torchrl_loco.envs.checks import check_count


class State(TensorDict):
    """What ``env.get_state()`` returns and ``env.reset(state, set_state=True)`` restores.

    A TensorDict of batch size ``(num_envs,)`` with

    ==================  ===========  =====================================================
    ``qpos``            ``(N, nq)``  positions (m, rad, unit quaternions)
    ``qvel``            ``(N, nv)``  velocities (m/s, rad/s)
    ``qacc_warmstart``  ``(N, nv)``  where the constraint solver starts
    ``elapsed_steps``   ``(N,)``     control steps since the world's reset
    ``episode``         ``(N,)``     episodes drawn so far: the world's random counter
    ==================  ===========  =====================================================

    The only difference to a TensorDict: a :meth:`select` of ``"_reset"`` keeps these entries too. ``TransformedEnv``
    hands down nothing else, and would lose the state on its way to the environment. It also returns the very TensorDict
    that it was given, state and all: exclude ``State.KEYS`` before you pass that on as a state again.

    To make a state by hand: ``State({"qpos": ..., "qvel": ...}, batch_size=[num_envs])``.
    """

    KEYS = ("qpos", "qvel", "qacc_warmstart", "elapsed_steps", "episode")

    def branch(self, world: int, num_envs: int | None = None) -> "State":
        """Returns a state in which every world is a copy of one, to try different futures from the same moment.

        Args:
            world: index of the world to copy.
            num_envs: number of copies; ``None`` takes as many worlds as there are.

        Raises:
            IndexError: there is no such world.
        """
        count = self.batch_size[0] if num_envs is None else check_count("num_envs", num_envs)
        copies = {key: value[world].expand(count, *value.shape[1:]).clone() for key, value in self.items()}
        return State(copies, batch_size=[count], device=self.device)

    def select(self, *keys: Any, inplace: bool = False, strict: bool = True) -> TensorDictBase:
        """Selects ``keys``, and the state if ``"_reset"`` is among them."""
        state = [key for key in self.KEYS if key in self] if "_reset" in keys else []
        return super().select(*keys, *state, inplace=inplace, strict=strict)
