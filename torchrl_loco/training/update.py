"""One PPO update: advantages, then minibatch epochs over the clipped loss."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_loco.training.presets import PPOConfig


class PPOUpdate:
    """Improves actor and critic on one batch after another.

    Args:
        config: the run's settings.
        actor: the policy, updated in place.
        critic: the value function, updated in place.
    """

    def __init__(self, config: PPOConfig, actor: ProbabilisticActor, critic: ValueOperator) -> None:
        self._config = config
        # At a time limit the value of the true terminal observation is bootstrapped; termination ends the return.
        self._gae = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=critic, average_gae=False)
        self._loss = ClipPPOLoss(
            actor,
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=0.5,
            loss_critic_type="smooth_l1",
            normalize_advantage=True,
        )
        self.optimizer = torch.optim.Adam(self._loss.parameters(), lr=config.lr, eps=1e-5)
        self._generator = torch.Generator(config.device).manual_seed(config.seed)

    def __call__(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Updates on one batch.

        Args:
            batch: experience of shape ``(num_envs, decisions)``.
            progress: share of the run that is done, in [0, 1], which sets the learning rate.

        Returns:
            The mean of the losses and statistics over all gradient steps.
        """
        config = self._config
        for group in self.optimizer.param_groups:
            group["lr"] = config.lr * (1.0 - progress)
        with torch.no_grad():
            self._gae(batch.set(("next", "reward"), batch["next", "reward"] * config.reward_scale))
        data = batch.select(*self._loss.in_keys, "advantage", "value_target", "state_value", strict=False).reshape(-1)
        # A rest smaller than a minibatch is left out: it would weigh as much as a full one.
        minibatches = len(data) // config.minibatch_size
        history = []
        for _ in range(config.epochs):
            order = torch.randperm(len(data), generator=self._generator, device=config.device)
            chunks = order[: minibatches * config.minibatch_size].split(config.minibatch_size)
            history += [self._step(data[indices]) for indices in chunks]
        return {key: float(value) for key, value in TensorDict.stack(history).mean(dim=0).items()}

    def _step(self, minibatch: TensorDictBase) -> TensorDict:
        losses = self._loss(minibatch)
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        self.optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self._loss.parameters(), self._config.max_grad_norm)
        self.optimizer.step()
        return losses.select("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction").detach()
