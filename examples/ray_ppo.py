"""PPO with actors in a Ray cluster: TorchRL's RayCollector.

    python examples/ray_ppo.py                               # a cluster of its own, on this machine
    python examples/ray_ppo.py --address auto --actors 8 --device cuda      # on the head of a running cluster

Ray places each actor on a node that has room for it, with a GPU of its own if ``--device cuda``. An actor that dies, or
whose node is gone, ends a batch; then all actors are started anew and get the present weights. The learner keeps its
networks and its optimizer, so at most one batch is lost.
"""

import functools
from collections.abc import Iterator

import ray
import torch
import tyro
from ray.exceptions import RayActorError
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torchrl_loco

FAILURES = 3
"""Lost batches after which training gives up: something else is wrong than a node."""


def make_env(task: str, num_envs: int, device: str, seed: int, k: int) -> torchrl_loco.LocoEnv:
    """Returns the worlds of actor k, in whose process this is called."""
    torch.manual_seed(seed + 1 + k)  # of its actions: torch gives each new process a seed by chance
    return torchrl_loco.make(task, num_envs, device, seed, world_offset=k * num_envs, stagger=True)


def make_networks(env: torchrl_loco.LocoEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    """Returns actor and critic for the observations and actions of an environment."""
    observation_size, action_size = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    widths = {"num_cells": [128, 128], "activation_class": nn.SiLU}
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


def start_actors(policy: ProbabilisticActor, environments: list, frames: int, on_cuda: bool) -> RayCollector:
    """Returns a collector with an actor for each function in ``environments``, all with the weights of ``policy``."""
    device = "cuda" if on_cuda else "cpu"  # Ray shows each actor its own GPU only
    collector = RayCollector(
        environments,
        policy,
        collector_class=Collector,
        frames_per_batch=frames,  # of all actors together
        total_frames=2**62,
        sync=True,  # waits for all actors: PPO is on-policy
        env_device=device,
        policy_device=device,
        storing_device="cpu",  # batches travel through Ray's object store
        collector_kwargs={"track_traj_ids": False, "auto_register_policy_transforms": False},
        remote_configs={"num_cpus": 1, "num_gpus": int(on_cuda)},
    )
    collector.update_policy_weights_()
    return collector


def collect(
    policy: ProbabilisticActor, environments: list, frames: int, batches: int, on_cuda: bool = False
) -> Iterator[TensorDictBase]:
    """Collects by actors that are replaced if one dies.

    Args:
        policy: the policy; whoever takes a batch may change its weights before the next one.
        environments: for each actor, a function that makes its worlds.
        frames: steps in a batch, over all actors.
        batches: number of batches.
        on_cuda: whether each actor gets a GPU.

    Yields:
        Batches of shape ``(actors, num_envs, steps)``.

    Raises:
        RayActorError: too many actors died.
    """
    failures = 0
    while batches > 0:
        collector = start_actors(policy, environments, frames, on_cuda)
        try:
            for batch in collector:
                yield batch
                batches -= 1
                if batches == 0:
                    return
                collector.update_policy_weights_()
        except RayActorError as error:
            failures += 1
            if failures > FAILURES:
                raise
            print(f"an actor died, all are started anew: {str(error).splitlines()[0]}", flush=True)
        finally:
            collector.shutdown()


def main(
    task: str = "walker_stand",
    actors: int = 2,
    device: str = "cpu",
    num_envs: int = 32,
    steps: int = 32,
    batches: int = 20,
    seed: int = 0,
    address: str | None = None,
) -> None:
    """Trains by PPO.

    Args:
        task: id of the environment.
        actors: number of actors.
        device: "cpu", or "cuda" for a GPU an actor.
        num_envs: worlds of each actor.
        steps: steps of each world in a batch.
        batches: number of batches.
        seed: decides every random draw.
        address: of a running cluster; without, one is started on this machine.
    """
    # "local": else Ray would join a cluster that it finds on this machine.
    ray.init(address=address or "local", num_cpus=actors if address is None else None, log_to_driver=False)
    torch.manual_seed(seed)
    # A function for each actor: with one for all of them, they would step the same worlds.
    environments = [functools.partial(make_env, task, num_envs, device, seed, k) for k in range(actors)]
    actor, critic = make_networks(torchrl_loco.make(task, 1, "cpu"))

    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=False)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)
    frames = actors * num_envs * steps
    for number, batch in enumerate(collect(actor, environments, frames, batches, on_cuda=device == "cuda")):
        with torch.no_grad():
            gae(batch)
        data = batch.reshape(-1)
        for _ in range(4):
            for indices in torch.randperm(len(data)).split(256 * actors):
                losses = loss(data[indices])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        reward = batch["next", "reward"].mean().item()
        print(f"batch {number + 1}: {tuple(batch.shape)}, mean reward {reward:.3f}", flush=True)
    ray.shutdown()


if __name__ == "__main__":
    tyro.cli(main)
