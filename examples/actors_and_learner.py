"""Actors on several devices and one learner: TorchRL's MultiSyncCollector and PPO.

    python examples/actors_and_learner.py                              # two actors on the CPU
    python examples/actors_and_learner.py --actors 4 --device cuda     # actor k on cuda:k, the learner on cuda:0

Each actor is a process with an environment of its own. The learner waits for the batches of all actors, updates, and
sends them the new weights, so that all data is on-policy. The physics takes most of the time, and it is what the actors
share. The learner's gradient steps are on one device: ``torchrl-loco train TASK --gpus N`` shares those too.
"""

import functools

import torch
import tyro
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import MultiSyncCollector
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torchrl_loco


def make_env(task: str, num_envs: int, device: str, seed: int, k: int) -> torchrl_loco.LocoEnv:
    """Returns the worlds of actor k, in whose process this is called."""
    torch.manual_seed(seed + 1 + k)  # of its actions: torch gives each new process a seed by chance
    return torchrl_loco.make(task, num_envs, device, seed, world_offset=k * num_envs, stagger=True)


def make_networks(env: torchrl_loco.LocoEnv, device: str) -> tuple[ProbabilisticActor, ValueOperator]:
    """Returns actor and critic for the observations and actions of an environment."""
    observation_size, action_size = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    widths = {"num_cells": [128, 128], "activation_class": nn.SiLU, "device": device}
    mean_and_scale = MLP(in_features=observation_size, out_features=2 * action_size, **widths)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(mean_and_scale, NormalParamExtractor()), in_keys=["observation"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(MLP(in_features=observation_size, out_features=1, **widths), in_keys=["observation"])


def main(
    task: str = "walker_stand",
    actors: int = 2,
    device: str = "cpu",
    num_envs: int = 32,
    steps: int = 32,
    batches: int = 20,
    seed: int = 0,
) -> None:
    """Trains by PPO.

    Args:
        task: id of the environment.
        actors: number of processes that step environments.
        device: "cpu", or "cuda" for a GPU an actor.
        num_envs: worlds of each actor.
        steps: steps of each world in a batch.
        batches: number of batches.
        seed: decides every random draw.
    """
    torch.manual_seed(seed)
    devices = [f"cuda:{k}" for k in range(actors)] if device == "cuda" else ["cpu"] * actors
    learner = devices[0]
    # A function for each actor: with one for all of them, they would step the same worlds.
    environments = [functools.partial(make_env, task, num_envs, devices[k], seed, k) for k in range(actors)]
    env = torchrl_loco.make(task, 1, "cpu")
    actor, critic = make_networks(env, learner)

    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=False)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)

    frames_per_batch = actors * num_envs * steps  # of all actors together
    collector = MultiSyncCollector(
        environments,
        actor,
        frames_per_batch=frames_per_batch,
        total_frames=batches * frames_per_batch,
        env_device=devices,
        policy_device=devices,
        storing_device="cpu",  # where the batches of all actors meet
        cat_results=0,  # along the worlds: (actors * num_envs, steps)
        use_buffers=True,
        auto_register_policy_transforms=False,
    )
    try:
        for number, batch in enumerate(collector):
            batch = batch.to(learner)
            with torch.no_grad():
                gae(batch)
            data = batch.reshape(-1)
            for _ in range(4):
                for indices in torch.randperm(len(data), device=learner).split(256 * actors):
                    losses = loss(data[indices])
                    optimizer.zero_grad()
                    (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                    nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                    optimizer.step()
            collector.update_policy_weights_()
            reward = batch["next", "reward"].mean().item()
            print(f"batch {number + 1}: {tuple(batch.shape)}, mean reward {reward:.3f}", flush=True)
    finally:
        collector.shutdown()


if __name__ == "__main__":  # the actors import this file again
    tyro.cli(main)
