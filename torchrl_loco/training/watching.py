"""A run that may still be training, seen from another process: its files are read, and nothing else."""

import dataclasses
from pathlib import Path
from typing import Any

from torchrl_loco.checks import check_device
from torchrl_loco.envs.access import set_stage
from torchrl_loco.policy import Policy, in_task
from torchrl_loco.registry import make, resolve
from torchrl_loco.training.actor import Spaces, deterministic_policy
from torchrl_loco.training.environments import refuse_transforms
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.trainer import ALGORITHMS


class Watched:
    """Worlds of a run's task, and the run's newest policy.

    That is the one of ``checkpoint.pt`` or of ``policy.safetensors``, whichever was written last. A run that was begun
    with objects of one's own (:class:`torchrl_loco.training.Given`) has them in no file, so it is the latter. The
    worlds, ``env``, are without noise and pushes.
    """

    def __init__(self, run: RunFolder, num_envs: int, device: str, seed: int) -> None:
        self._run, self._device, config = run, device, run.load_config(device=device)
        here = in_task({"options": config.options}, config.task, run.task).get("options", {})
        config = dataclasses.replace(config, options=here)
        settings = {**config.of_env, "world_offset": 0, "reward_terms": True, "play": True}
        self.env = make(resolve(run.task), num_envs, device, seed, config.protocol, **settings)
        self._files = [run.policy] if run.given else [run.policy, run.checkpoint]
        self._seen = 0

    def newer(self) -> Policy | None:
        """Returns the newest policy, or ``None`` if there is none that this has not returned before."""
        written = [(file.stat().st_mtime_ns, file) for file in self._files if file.is_file()]
        when, newest = max(written, default=(0, None))
        if newest is None or when <= self._seen:
            return None
        self._seen = when
        if newest == self._run.policy:
            policy = self._run.load_policy(self._device)
            refuse_transforms(policy)
        else:
            policy = last_policy(self._run, self._device)
        set_stage(self.env, self.env.stage_of(policy.info))
        return policy


def last_policy(run: RunFolder, device: str | None = None, path: Path | None = None) -> Policy:
    """Returns the policy of a run's last checkpoint or another, which no evaluation has chosen.

    It computes on CUDA, if there is any, unless ``device`` is given. The run was begun without objects of one's own.
    """
    device = str(check_device(device))
    config, checkpoint = run.load_config(device=device, task=run.task), run.load_checkpoint(device, path)
    stored = checkpoint.get("spaces")  # checkpoints of earlier revisions have none
    spaces = Spaces.of(make(resolve(run.task), 1, device)) if stored is None else Spaces(**stored)
    algorithm = ALGORITHMS[config.algorithm](config, spaces)
    algorithm.load_networks(checkpoint["algorithm"]["networks"])
    names = "frames", "seconds", "stage", "full_length", "transforms"
    counters: dict[str, Any] = {name: checkpoint[name] for name in names if name in checkpoint}
    policy = deterministic_policy(algorithm.actor, config, counters)
    policy.info = in_task(policy.info, run.load_config().task, run.task)
    return policy
