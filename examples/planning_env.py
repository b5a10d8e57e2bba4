"""Physics for TorchRL's planners, CEMPlanner and MPPIPlanner: all data stays on the device."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner, MPPIPlanner

import torchrl_loco


class PlanningEnv(EnvBase):
    """An environment without a state of its own: it steps TensorDicts of any batch size from the state under "state".

    Args:
        make: makes an environment, given ``num_envs`` and, after ``set_seed``, ``seed``; one is kept for each number of
            worlds that is asked for.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> "PlanningEnv":
        """Returns an environment that takes any batch size, which TorchRL decides here."""
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(self, make: Callable[..., torchrl_loco.LocoEnv]) -> None:
        self.make, self.worlds = make, functools.cache(make)
        one = self.worlds(1)
        super().__init__(device=one.device, batch_size=[])
        state = {key: Unbounded(x.shape, device=x.device, dtype=x.dtype) for key, x in one.get_state()[0].items()}
        self.observation_spec = one.observation_spec[0].set("state", Composite(state, device=one.device))
        self.action_spec, self.reward_spec = one.action_spec[0], one.reward_spec[0]
        self.full_done_spec = one.full_done_spec[0]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        worlds = self.worlds(tensordict.numel())
        td = worlds.reset(tensordict["state"].reshape(-1), set_state=True)
        td["action"] = tensordict["action"].reshape(worlds.action_spec.shape)
        after = worlds.step(td)["next"]
        return after.set("state", worlds.get_state()).reshape(tensordict.batch_size)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        batch_size = self.batch_size if tensordict is None else tensordict.batch_size
        worlds = self.worlds(batch_size.numel())
        return worlds.reset().set("state", worlds.get_state()).reshape(batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.worlds = functools.cache(functools.partial(self.make, seed=seed))


if __name__ == "__main__":
    torch.manual_seed(0)
    make = functools.partial(torchrl_loco.make, "walker_stand", device="cpu", seed=0)
    physics, size = PlanningEnv(make), {"planning_horizon": 8, "optim_steps": 3, "num_candidates": 32, "top_k": 4}
    cem = CEMPlanner(physics, **size)
    # MPPI ranks candidates by the advantage of their first step; without a critic that is the sum of rewards.
    total = TensorDictModule(lambda reward: reward.sum(-2, True).expand_as(reward), [("next", "reward")], ["advantage"])
    mppi = MPPIPlanner(physics, total, temperature=5.0, **size)
    policies = {
        "zero": lambda td: td.set("action", torch.zeros(env.action_spec.shape)),
        "random": lambda td: td.set("action", env.action_spec.rand()),
        "CEM": lambda td: cem(td.set("state", env.get_state())),
        "MPPI": lambda td: mppi(td.set("state", env.get_state())),
    }
    for name, policy in policies.items():
        env = make(4)  # the same four starts for each policy
        print(f"{name:7}", env.rollout(20, policy)["next", "reward"].sum(dim=1).flatten())
