"""Presets are valid, and wrong settings are named."""

import dataclasses
import inspect

import pytest

from torchrl_loco.training import PPOConfig, preset


def test_a_preset_for_every_task(task):
    config = preset(task, "cpu")
    assert config.task == task
    assert config.total_frames >= config.frames_per_batch == config.num_envs * config.decisions * config.action_repeat


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
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


def test_every_setting_is_documented():
    lines = inspect.getsource(PPOConfig).splitlines()
    for field in dataclasses.fields(PPOConfig):
        at = next(i for i, line in enumerate(lines) if line.startswith(f"    {field.name}:"))
        assert lines[at + 1].strip().startswith('"""'), field.name
