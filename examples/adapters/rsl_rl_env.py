"""Worlds for RSL-RL (``pip install rsl-rl-lib``): all data stays on the device."""

import tempfile

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import torchrl_loco


class RslRlEnv(VecEnv):
    """An environment of torchrl_loco as RSL-RL's ``VecEnv``.

    Observations are those after the reset of worlds that are done. The true last ones are in
    ``extras["final_observations"]``, and ``extras["time_outs"]`` marks the worlds that were truncated.
    """

    def __init__(self, env: torchrl_loco.LocoEnv) -> None:
        self.env, self.cfg, self.device = env, env.config, env.device
        self.num_envs, self.num_actions = env.action_spec.shape
        self.max_episode_length = env.config.episode_length
        self.td = env.reset()

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps since the reset of each world; the runner sets them for ``init_at_random_ep_len``."""
        return self.env.get_state()["elapsed_steps"]

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.td = self.env.reset(self.env.get_state().set("elapsed_steps", steps), set_state=True)

    def get_observations(self) -> TensorDict:
        """Returns the current observations, batch ``(num_envs,)``."""
        return self.td.select("observation")

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Returns the step of all worlds. RSL-RL's Gaussian has no bounds, so the actions are clamped to [-1, 1]."""
        step, self.td = self.env.step_and_maybe_reset(self.td.set("action", actions.clamp(-1, 1)))
        after = step["next"]
        time_outs = after["truncated"] & ~after["terminated"]
        extras = {"time_outs": time_outs.squeeze(-1), "final_observations": after.select("observation")}
        return self.get_observations(), after["reward"].squeeze(-1), after["done"].squeeze(-1), extras


class FinalValuePPO(PPO):
    """RSL-RL's PPO, bootstrapping a truncated episode from its last observation instead of the one before it.

    Not for recurrent critics, whose memory the additional call would advance.
    """

    def process_env_step(self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict) -> None:
        """Adds the discounted value of the last observation to the last reward, then records the step."""
        values = self.critic(extras["final_observations"]).squeeze(-1)
        super().process_env_step(obs, rewards + self.gamma * values * extras["time_outs"], dones, {})


NETWORK = {"class_name": "MLPModel", "hidden_dims": [128, 128], "activation": "elu", "obs_normalization": True}
CONFIG = {
    "num_steps_per_env": 32,
    "save_interval": 100,
    "check_for_nan": False,  # a world that is not finite ends with zeros; the check would wait for the device
    "obs_groups": {"actor": ["observation"], "critic": ["observation"]},
    "actor": {**NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
    "critic": NETWORK,
    "algorithm": {"class_name": FinalValuePPO, "learning_rate": 1e-3, "entropy_coef": 1e-3, "desired_kl": 0.01},
}

if __name__ == "__main__":
    torch.manual_seed(0)
    env = RslRlEnv(torchrl_loco.make("walker_stand", num_envs=16, device="cpu", seed=0, episode_length=100))
    runner = OnPolicyRunner(env, CONFIG, log_dir=tempfile.mkdtemp(), device=str(env.device))
    runner.learn(num_learning_iterations=3, init_at_random_ep_len=True)
