"""Presets are valid, and wrong settings are named."""

import dataclasses
import re

import pytest
import torch

import torchrl_loco
from torchrl_loco.registry import OURS
from torchrl_loco.training import PPOConfig, REPPOConfig, preset, tuning_note


def test_a_preset_for_every_task():
    for task in OURS:
        for algorithm in (None, "ppo", "reppo"):
            config = preset(task, "cpu", algorithm)
            assert (config.task, config.algorithm) == (task, algorithm or "ppo")
            assert config.frames_per_batch == config.num_envs * config.num_steps
            assert (
                config.total_frames >= config.control_steps_per_batch == config.frames_per_batch * config.action_repeat
            )


def test_wrong_settings():
    cases = [
        ({"eval_interval": -1}, ValueError, "eval_interval must lie in [0, 2**31)"),
        ({"final_lr_fraction": 1.5}, ValueError, "final_lr_fraction must lie in [0, 1]"),
        ({"num_envs": 0}, ValueError, "num_envs must lie in [1, 2**31)"),
        ({"epochs": 1.5}, TypeError, "epochs must be an integer"),
        ({"gamma": 0.0}, ValueError, "gamma must lie in (0, 1]"),
        ({"lmbda": -0.1}, ValueError, "lmbda must lie in [0, 1]"),
        ({"lr": float("nan")}, ValueError, "lr must lie in (0, inf)"),
        ({"video_seconds": -1.0}, ValueError, "video_seconds must lie in [0, inf)"),
        ({"checkpoint_seconds": -1.0}, ValueError, "checkpoint_seconds must lie in [0, inf)"),
        ({"clip_epsilon": 1.5}, ValueError, "clip_epsilon must lie in (0, 1]"),
        ({"entropy_coeff": -1.0}, ValueError, "entropy_coeff must lie in [0, inf)"),
        ({"hidden": ()}, ValueError, "hidden must name"),
        ({"hidden": (64, 0)}, ValueError, "each width of hidden"),
        ({"minibatch_size": 10_000_000}, ValueError, "minibatch_size (10000000) must not exceed"),
        ({"total_frames": 10}, ValueError, "total_frames (10) must be at least one batch"),
        ({"trials": 0}, ValueError, "trials must lie in [1, 2**31)"),
        ({"trial_fraction": 1.0}, ValueError, "trial_fraction must lie in (0, 1)"),
        (
            {"trials": 2, "total_frames": 20_000, "num_envs": 4, "minibatch_size": 128, "trial_fraction": 0.02},
            ValueError,
            "(400) must be at least one batch of num_envs * num_steps * action_repeat (512), or trials must be 1",
        ),
        ({"trials": 5}, ValueError, "trials (5) * trial_fraction (0.2) must be less than 1"),
        ({"random_shift": 4}, ValueError, "random_shift needs from_pixels=True"),
        ({"size": (64, 64)}, ValueError, "size needs from_pixels=True"),
        ({"from_pixels": True, "size": (64, 20), "random_shift": 20}, ValueError, "less than width and height of size"),
        ({"from_pixels": True, "size": 64}, ValueError, "size must be the width and height"),
        ({"seed": -1}, ValueError, "seed must lie in [0, 2**32)"),
        ({"device": "tpu"}, ValueError, "choose one of cpu"),
        ({"task": "walker_stnd"}, ValueError, "did you mean 'walker_stand'"),
        ({"protocol": "brax"}, ValueError, "choose one of playground, dm_control"),
        (
            {"logger": ("csv", "wanb")},
            ValueError,
            "did you mean 'wandb'?: choose one of csv, tensorboard, wandb, mlflow",
        ),
    ]
    for overrides, error, message in cases:
        with pytest.raises(error, match=re.escape(message)):
            PPOConfig(**{"task": "walker_stand", **overrides})
    cases_of_reppo = [
        ({"kl_bound": 0.0}, "kl_bound must lie in (0, inf)"),
        ({"num_bins": 1}, "num_bins must lie in [2, 2**31)"),
        ({"target_entropy": float("nan")}, "target_entropy must lie in"),
        ({"min_value": 150.0}, "min_value (150) must be below max_value (150)"),
        ({"min_value": float("-inf")}, "min_value must lie in (-inf, inf)"),
        ({"aux_coeff": -1.0}, "aux_coeff must lie in [0, inf)"),
        ({"init_temperature": 1e-5}, "must not be below min_temperature"),
        ({"min_kl_weight": 0.02}, "init_kl_weight (0.01) must not be below min_kl_weight (0.02)"),
    ]
    for overrides, message in cases_of_reppo:
        with pytest.raises(ValueError, match=re.escape(message)):
            REPPOConfig("walker_stand", **overrides)


def test_few_worlds_need_smaller_minibatches_or_more_steps():
    """What the error says to pass is enough, and no more than enough."""
    with pytest.raises(
        ValueError, match=r"num_envs \(7\) .* pass minibatch_size=224 or less, or num_steps=147 or more"
    ):
        preset("walker_stand", "cpu", "ppo", num_envs=7)
    for name, enough, too_much in (("minibatch_size", 224, 225), ("num_steps", 147, 146)):
        assert getattr(preset("walker_stand", "cpu", "ppo", num_envs=7, **{name: enough}), name) == enough
        with pytest.raises(ValueError, match="must not exceed"):
            preset("walker_stand", "cpu", "ppo", num_envs=7, **{name: too_much})


def test_names():
    assert preset("mjx/walker_run-v0", "cpu") == preset("walker_run", "cpu")
    assert PPOConfig("mjx/walker_run-v0").task == "walker_run"
    with pytest.raises(ValueError, match="did you mean 'reppo'"):
        preset("walker_stand", "cpu", "repo")


def test_a_name_for_files():
    for task, label in (("walker_run", "walker_run"), ("/some/where/file.py:Outer.Task", "Outer.Task")):
        assert PPOConfig(task).label == label
    assert PPOConfig("module:make.<locals>.Task").label == "make.-locals-.Task"


def test_what_was_not_tuned_is_said():
    cases = [
        ("walker_stand", "cpu", "ppo", False),
        ("walker_stand", "cpu", "reppo", True),
        ("walker_walk", "cpu", "ppo", False),
        ("walker_run", "cpu", "ppo", True),
        ("cheetah_run", "cpu", "ppo", True),
        ("cheetah_run", "cuda", "ppo", False),
    ]
    for task, device, algorithm, said in cases:
        note = tuning_note(dataclasses.replace(preset(task, "cpu", algorithm), device=device))
        assert ("walker_stand and walker_walk by ppo" in note) == said


def test_presets_of_a_task(monkeypatch):
    """Its own on CUDA, where the critic of a task that is not of this package has bins for returns of either sign."""
    monkeypatch.setattr("torchrl_loco.training.config.check_device", torch.device)
    own = {"reppo": {"lr": 3e-3, "max_value": 20.0}}
    cls = type("Own", (torchrl_loco.WalkerWalk,), {"presets": own, "__doc__": "Walk."})
    config = preset(cls, "cuda:0", "reppo", gamma=0.9)
    assert (config.lr, config.gamma, config.num_envs, config.episode_length) == (3e-3, 0.9, 8192, 0)
    assert (config.min_value, config.max_value, config.num_bins) == (-20.0, 20.0, 301)
    assert preset(cls, "cuda:0", "ppo").lr == PPOConfig.presets["cuda"]["lr"]
    assert preset(cls, "cpu", "reppo").lr == REPPOConfig.presets["cpu"]["lr"]
    first = type("First", (torchrl_loco.WalkerWalk,), {"presets": {"ppo": {}, **own}, "__doc__": "Walk."})
    assert [preset(task, "cuda:0").algorithm for task in (cls, first)] == ["reppo", "ppo"]
    assert preset("walker_walk", "cuda:0", from_pixels=True).bf16
    walker = preset("walker_walk", "cuda:0")
    assert (walker.algorithm, walker.max_value, walker.min_value, walker.num_bins) == ("reppo", 75.0, 0.0, 151)


def test_misspelt_presets_of_a_task():
    cases = [
        ({"repo": {}}, "unknown algorithm in the presets of Own 'repo', did you mean 'reppo'"),
        ({"reppo": {"learning_rat": 1}}, "unknown setting of reppo in the presets of Own 'learning_rat'"),
        ({"ppo": {"max_value": 1}}, "choose one of protocol, device"),
    ]
    for wrong, message in cases:
        cls = type("Own", (torchrl_loco.WalkerWalk,), {"presets": wrong, "__doc__": "Walk."})
        for device in ("cpu", None):
            with pytest.raises(ValueError, match=message):
                preset(cls, device)


def test_a_device_may_be_torchs_own():
    config, device = preset("walker_stand", "cpu", "ppo"), torch.device("cuda", 1)
    assert dataclasses.replace(config, device=device).device == "cuda:1"
    for wrong in ("cpu:1", 3):
        with pytest.raises(ValueError, match="choose one of cpu, cuda, cuda:0"):
            dataclasses.replace(config, device=wrong)


def test_equal_settings_have_equal_hashes():
    """Settings are keys, also those with options of the task."""
    configs = {preset("g1_tracking", "cpu", motion=["a.csv"], seed=seed) for seed in (0, 1, 0)}
    assert {config.seed for config in configs} == {0, 1}
    assert len(configs) == 2
