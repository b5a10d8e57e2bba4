"""Off-policy learning: TorchRL's SACLoss, with a replay buffer on the device of the worlds.

    python examples/sac.py                              # walker_stand on a CPU
    python examples/sac.py --task walker_walk --seed 1

Thousands of gradient steps are made on few frames: the opposite of the package's own algorithms, which take many frames
and learn from each batch once.
"""

import torch
import tyro
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from tqdm import tqdm

import torchrl_loco
from torchrl_loco.training.actor import SquashedNormal

ACTION_REPEAT = 2
"""Control steps for which an action is held."""
STEPS = 2
"""Steps of each world between two rounds of gradient steps."""
WARMUP = 2048
"""Transitions that are collected before the first gradient step."""
TRANSITION = ["observation", "action", *(("next", key) for key in ("observation", "reward", "done", "terminated"))]
"""What the loss reads."""


def layers(inputs: int, outputs: int, width: int = 256) -> MLP:
    """Returns two hidden layers with layer norm, which keeps a critic that learns from old data stable."""
    norm = {"norm_class": nn.LayerNorm, "norm_kwargs": {"normalized_shape": width}}
    return MLP(inputs, outputs, num_cells=[width, width], activation_class=nn.SiLU, **norm)


def make_env(task: str, num_envs: int, device: str, seed: int, **options: int | bool) -> torchrl_loco.TransformedEnv:
    """Returns worlds in which an action is held for ``ACTION_REPEAT`` control steps."""
    env = torchrl_loco.make(task, num_envs, device, seed, **options)
    return torchrl_loco.TransformedEnv(env, torchrl_loco.ActionRepeat(ACTION_REPEAT))


def make_loss(env: torchrl_loco.TransformedEnv, gamma: float) -> tuple[ProbabilisticActor, SACLoss]:
    """Returns the actor, and the loss with two critics, their targets and the temperature."""
    observations, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    network = nn.Sequential(layers(observations, 2 * actions), NormalParamExtractor(scale_lb=0.01))
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=SquashedNormal,
    ).to(env.device)
    critic = ValueOperator(layers(observations + actions, 1), in_keys=["observation", "action"]).to(env.device)
    loss = SACLoss(actor, critic, alpha_init=0.1, target_entropy=-float(actions), loss_function="l2")
    loss.make_value_estimator(gamma=gamma)  # bootstraps at time limits, where `terminated` is not set
    return actor, loss.to(env.device)


def main(
    task: str = "walker_stand",
    device: str = "cpu",
    num_envs: int = 64,
    total_frames: int = 600_000,
    episode_length: int = 400,
    gradient_steps: int = 4,
    minibatch_size: int = 256,
    buffer_size: int = 1_000_000,
    gamma: float = 0.98,
    lr: float = 1e-3,
    tau: float = 0.01,
    seed: int = 0,
) -> None:
    """Trains by soft actor-critic, then plays 32 full episodes without noise.

    Args:
        task: id of the environment.
        device: where worlds, replay buffer and networks live.
        num_envs: worlds stepped together.
        total_frames: control steps to collect, over all worlds.
        episode_length: control steps after which an episode is truncated in training.
        gradient_steps: gradient steps after each batch.
        minibatch_size: transitions in a gradient step.
        buffer_size: transitions that are kept.
        gamma: discount of a step of the policy.
        lr: learning rate of actor, critics and temperature.
        tau: how far the targets of the critics move in a gradient step.
        seed: decides every random draw.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)  # threads mostly wait for each other in networks as small as these
    env = make_env(task, num_envs, device, seed, episode_length=episode_length, stagger=True)
    actor, loss = make_loss(env, gamma)
    targets = SoftUpdate(loss, tau=tau)
    optimizer = torch.optim.Adam([weight for weight in loss.parameters() if weight.requires_grad], lr=lr, fused=True)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(buffer_size, device=env.device), batch_size=minibatch_size
    )
    frames_per_batch = num_envs * STEPS * ACTION_REPEAT
    collector = torchrl_loco.RolloutCollector(
        env, actor, frames_per_batch=num_envs * STEPS, total_frames=total_frames // ACTION_REPEAT
    )
    with tqdm(total=total_frames, unit="frame", unit_scale=True, desc=task) as bar:
        for batch in collector:
            buffer.extend(batch.select(*TRANSITION).reshape(-1))
            if len(buffer) >= WARMUP:
                for _ in range(gradient_steps):
                    losses = loss(buffer.sample())
                    optimizer.zero_grad()
                    (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
                    optimizer.step()
                    targets.step()
            bar.update(frames_per_batch)
    env.close()

    test = make_env(task, 32, device, seed + 1)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        returns = test.rollout(1000 // ACTION_REPEAT, actor)["next", "reward"].sum(dim=1)
    print(f"{task}, seed {seed}: return {returns.mean():.1f} +- {returns.std():.1f} over {len(returns)} episodes")


if __name__ == "__main__":
    tyro.cli(main)
