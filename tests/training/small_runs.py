"""Runs small enough for tests."""

import contextlib
import dataclasses
import functools

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torchrl_loco
from torchrl_loco.tasks.walker import Walker
from torchrl_loco.training import RunFolder, Spaces, Trainer, evaluation, preset

EPISODE = 40
"""Control steps of an episode of the small walker."""
WALKER = Spaces(observation=24, action=6)
SMALL = {
    "num_envs": 4,
    "num_steps": 8,
    "action_repeat": 4,
    "minibatch_size": 16,
    "epochs": 2,
    "total_frames": 256,
    "hidden": (16,),
    "eval_episodes": 3,
    "video_seconds": 0.0,
}
"""Two batches, each of 128 frames."""


@contextlib.contextmanager
def small_walker():
    """Makes the walker's tasks cheap: short episodes, which evaluations play in full, coarse physics, small videos."""
    with pytest.MonkeyPatch.context() as patch:
        small = dataclasses.replace(Walker.config, episode_length=EPISODE, sim_dt=0.0125)
        patch.setattr(Walker, "config", small)
        patch.setattr(evaluation, "SIZE", (64, 48))
        yield


def made(out, algorithm="ppo", **overrides):
    """Returns a new run folder, in which nothing was trained yet."""
    settings = {"task": "walker_stand", **SMALL, **overrides}
    return RunFolder.create(preset(settings.pop("task"), "cpu", algorithm, out=out, **settings))


def trained(out, algorithm="ppo", **overrides):
    run = made(out, algorithm, **overrides)
    Trainer(run).train()
    return run


def networks(run):
    return run.load_checkpoint("cpu")["algorithm"]["networks"]


make_once = functools.cache(torchrl_loco.make)


def collected(algorithm, num_envs):
    """Returns a batch that an algorithm's actor has collected, always from the same start."""
    env = make_once("walker_stand", num_envs, "cpu")
    env.set_seed(0)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return env.rollout(algorithm.config.num_steps, algorithm.acting())
