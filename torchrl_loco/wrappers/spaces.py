"""TorchRL's specs as Gymnasium's spaces."""

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from torchrl_loco.wrappers.common import groups_of


def observation_space(env: EnvBase) -> Box | Dict:
    """Returns the space of an observation of one world, or a dictionary of those of its groups."""
    groups = groups_of(env)
    boxes = {key: box(env.observation_spec[key]) for key in groups}
    return boxes["observation"] if groups == ["observation"] else Dict(boxes)


def box(spec: TensorSpec) -> Box:
    """Returns the space of one world."""
    shape, dtype = tuple(spec.shape[1:]), torch.empty(0, dtype=spec.dtype).numpy().dtype
    if dtype.kind == "b":
        return Box(False, True, shape, np.bool_)
    if dtype.kind == "f" and not isinstance(spec, Bounded):  # TorchRL says the largest float
        return Box(-np.inf, np.inf, shape, dtype.type)
    low, high = (bound[0].numpy(force=True) for bound in (spec.space.low, spec.space.high))
    return Box(low, high, shape, dtype.type)
