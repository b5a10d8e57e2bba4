"""What networks read and write, taken from an environment."""

import dataclasses

import torch
from torchrl.envs import EnvBase


@dataclasses.dataclass(frozen=True)
class Spaces:
    """The sizes of what actor and critic read, and of an action.

    The actor reads ``observation``. The critic reads ``privileged`` where an environment has it, else the same as the
    actor.
    """

    observation: int
    """Length of an observation."""
    action: int
    """Length of an action."""
    privileged: int | None = None
    """Length of what the critic alone reads; ``None`` where it reads the observation."""
    bounded: bool = True
    """Whether actions are bounded by [-1, 1]; else they are any numbers."""

    @property
    def critic_key(self) -> str:
        """The entry that the critic reads."""
        return "observation" if self.privileged is None else "privileged"

    @property
    def critic(self) -> int:
        """Length of what the critic reads."""
        return self.observation if self.privileged is None else self.privileged

    @classmethod
    def of(cls, env: EnvBase) -> "Spaces":
        """Returns those of an environment, of any batch size.

        Raises:
            ValueError: it has no flat observation, or its actions are neither bounded by [-1, 1] nor unbounded.
        """
        spec = env.observation_spec
        sizes = {}
        for key in ("observation", "privileged"):
            if key not in spec.keys():  # noqa: SIM118
                continue
            shape = spec[key].shape[len(env.batch_size) :]
            if len(shape) != 1:
                raise ValueError(
                    f"{key!r} must be a row of numbers for each world to train on, but has shape {tuple(shape)}: "
                    "flatten it, for example with torchrl.envs.FlattenObservation"
                )
            sizes[key] = shape[0]
        if "observation" not in sizes:
            raise ValueError(f"the environment must have an 'observation' to train on, it has {', '.join(spec.keys())}")
        low, high = env.action_spec.space.low, env.action_spec.space.high
        largest = torch.finfo(low.dtype).max  # which TorchRL has for infinity
        bounded = not ((low <= -largest).all() and (high >= largest).all())
        if bounded and not ((low == -1.0).all() and (high == 1.0).all()):
            raise ValueError("actions must be bounded by [-1, 1], or by nothing: set action_range in the class")
        return cls(sizes["observation"], env.action_spec.shape[-1], sizes.get("privileged"), bounded)
