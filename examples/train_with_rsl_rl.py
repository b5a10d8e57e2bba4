"""RSL-RL's PPO on worlds of torchrl_loco; all data stays on the device. It needs the extra ``wrappers``.

python examples/train_with_rsl_rl.py                       # walker_stand on a CPU
python examples/train_with_rsl_rl.py --task walker_walk --num-envs 4096 --device cuda --iterations 300
"""

import tempfile

import torch
import tyro
from rsl_rl.algorithms import PPO
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from torchrl_loco.wrappers import RslRlVecEnv


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
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {**NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
    "critic": NETWORK,
    "algorithm": {"class_name": FinalValuePPO, "learning_rate": 1e-3, "entropy_coef": 1e-3, "desired_kl": 0.01},
}


def main(
    task: str = "walker_stand",
    num_envs: int = 16,
    device: str = "cpu",
    seed: int = 0,
    iterations: int = 3,
    episode_length: int = 100,
) -> None:
    """Trains, and keeps the policy in a new folder.

    Args:
        task: id of the task.
        num_envs: number of worlds.
        device: where they are.
        seed: decides all draws.
        iterations: rollouts of 32 steps, each with its update.
        episode_length: time limit, in control steps.
    """
    torch.manual_seed(seed)
    env = RslRlVecEnv(task, num_envs, device=device, seed=seed, episode_length=episode_length)
    runner = OnPolicyRunner(env, CONFIG, log_dir=tempfile.mkdtemp(), device=str(env.device))
    runner.learn(iterations, init_at_random_ep_len=True)


if __name__ == "__main__":
    tyro.cli(main)
