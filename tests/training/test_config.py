"""Presets are valid, and wrong settings are named."""

import contextlib
import dataclasses
import inspect

import pytest
import torch

from torchrl_loco.training import PPOConfig, REPPOConfig, TrainingConfig, preset, untuned


@pytest.mark.parametrize("algorithm", [None, "ppo", "reppo"])
def test_a_preset_for_every_task(task, algorithm):
    config = preset(task, "cpu", algorithm)
    assert config.task == task
    assert config.algorithm == (algorithm or "ppo")
    assert config.total_frames >= config.frames_per_batch == config.num_envs * config.decisions * config.action_repeat


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        ({"eval_interval": -1}, ValueError, "eval_interval .* must be an integer of at least 1"),
        ({"final_lr": 1.5}, ValueError, r"final_lr must lie in \[0, 1\]"),
        ({"num_envs": 0}, ValueError, "num_envs must be an integer of at least 1"),
        ({"epochs": 1.5}, TypeError, "epochs must be an integer"),
        ({"gamma": 1.2}, ValueError, r"gamma must lie in \(0, 1\]"),
        ({"gamma": 0.0}, ValueError, r"gamma must lie in \(0, 1\]"),
        ({"lmbda": -0.1}, ValueError, r"lmbda must lie in \[0, 1\]"),
        ({"lr": 0.0}, ValueError, "lr must lie in"),
        ({"lr": float("nan")}, ValueError, "lr must lie in"),
        ({"video_seconds": -1.0}, ValueError, "video_seconds must lie in"),
        ({"hidden": ()}, ValueError, "hidden must name"),
        ({"hidden": (64, 0)}, ValueError, "each width of hidden"),
        ({"minibatch_size": 10_000_000}, ValueError, "minibatch_size .* must not exceed"),
        ({"num_envs": 7}, ValueError, r"num_envs \(7\) .* pass minibatch_size=224 or less, or decisions=74 or more"),
        ({"total_frames": 10}, ValueError, "total_frames .* at least one batch"),
        ({"seed": -1}, ValueError, "seed must lie in"),
        ({"device": "tpu"}, ValueError, "choose one of cpu"),
        ({"task": "walker_stnd"}, ValueError, "did you mean 'walker_stand'"),
        ({"protocol": "brax"}, ValueError, "choose one of playground, dm_control"),
    ],
)
def test_wrong_settings(overrides, error, message):
    with pytest.raises(error, match=message):
        PPOConfig(**{"task": "walker_stand", **overrides})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"kl_bound": 0.0}, r"kl_bound must lie in \(0, inf\]"),
        ({"num_bins": 0}, "num_bins must be an integer of at least 1"),
        ({"num_bins": 1}, "num_bins must be an integer of at least 2"),
        ({"target_entropy": float("nan")}, r"target_entropy must lie in"),
        ({"init_temperature": 1e-5}, "must not be below min_temperature"),
    ],
)
def test_wrong_settings_of_reppo(overrides, message):
    with pytest.raises(ValueError, match=message):
        REPPOConfig("walker_stand", **overrides)


@pytest.mark.parametrize("mended", [{"minibatch_size": 224}, {"decisions": 37}])
def test_few_worlds_need_smaller_minibatches_or_more_decisions(mended):
    """What the error above says to pass is enough, and no more than enough."""
    (name, value), *_ = mended.items()
    assert getattr(preset("walker_stand", "cpu", "ppo", num_envs=7, **mended), name) == value
    beyond = value + (1 if name == "minibatch_size" else -1)
    with pytest.raises(ValueError, match="must not exceed"):
        preset("walker_stand", "cpu", "ppo", num_envs=7, **{name: beyond})


def test_an_alias_is_the_task_itself():
    assert preset("mjx/walker_run-v0", "cpu") == preset("walker_run", "cpu")
    assert PPOConfig("mjx/walker_run-v0").task == "walker_run"


def test_unknown_algorithm():
    with pytest.raises(ValueError, match="did you mean 'reppo'"):
        preset("walker_stand", "cpu", "repo")


@pytest.mark.parametrize("config", [TrainingConfig, PPOConfig, REPPOConfig])
def test_every_setting_is_documented(config):
    lines = inspect.getsource(config).splitlines()
    for name in config.__annotations__:
        if name == "algorithm":
            continue
        at = next(i for i, line in enumerate(lines) if line.startswith(f"    {name}:"))
        assert lines[at + 1].strip().startswith('"""'), name


@pytest.mark.parametrize(
    ("task", "device", "algorithm", "said"),
    [
        ("walker_stand", "cpu", "ppo", False),
        ("walker_stand", "cpu", "reppo", True),
        ("walker_walk", "cpu", "ppo", True),
        ("walker_walk", "cuda", "reppo", False),
        ("humanoid_run", "cuda:1", "reppo", False),
    ],
)
def test_what_the_settings_are_not_tuned_for_is_said(task, device, algorithm, said):
    config = dataclasses.replace(preset(task, "cpu", algorithm), device=device)
    assert ("walker_stand by ppo" in untuned(config)) == said
    assert bool(untuned(config)) == said


@pytest.mark.parametrize(("device", "is_valid"), [(torch.device("cuda", 1), True), ("cpu:1", False), (3, False)])
def test_a_device_may_be_torchs_own(device, is_valid):
    config = preset("walker_stand", "cpu", "ppo")
    with contextlib.nullcontext() if is_valid else pytest.raises(ValueError, match="choose one of cpu, cuda, cuda:0"):
        assert dataclasses.replace(config, device=device).device == device
