"""Environments for other libraries: Gymnasium, RSL-RL and Stable-Baselines3.

Each wrapper is a subclass of its library's own class, and the library is imported when the wrapper is first asked for.
The extra ``wrappers`` installs them all.

All wrappers but the one of a single world end an episode in the same way. A world that is done is reset in the same
step, so the observation that it returns is the first one of its next episode; the true last observation of the old
episode is returned beside it.
"""

import importlib
from typing import TYPE_CHECKING, Any

from torchrl_loco.checks import check_packages

if TYPE_CHECKING:
    from torchrl_loco.wrappers.gymnasium import GymnasiumEnv as GymnasiumEnv
    from torchrl_loco.wrappers.gymnasium import GymnasiumVectorEnv as GymnasiumVectorEnv
    from torchrl_loco.wrappers.rsl_rl import RslRlVecEnv as RslRlVecEnv
    from torchrl_loco.wrappers.stable_baselines3 import StableBaselines3VecEnv as StableBaselines3VecEnv

LIBRARIES = {
    "GymnasiumEnv": "gymnasium",
    "GymnasiumVectorEnv": "gymnasium",
    "RslRlVecEnv": "rsl_rl",
    "StableBaselines3VecEnv": "stable_baselines3",
}
"""Each wrapper, and its library, after which its module is named."""


def __getattr__(name: str) -> Any:
    if name not in LIBRARIES:
        raise AttributeError(f"torchrl_loco.wrappers has no {name}: it has {', '.join(LIBRARIES)}")
    check_packages(name, [LIBRARIES[name]], "wrappers")
    return getattr(importlib.import_module(f"{__name__}.{LIBRARIES[name]}"), name)
