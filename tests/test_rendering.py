"""Pixels against where the bodies are, and nothing but pixels changed."""

import pytest
import torch

import torchrl_loco
from torchrl_loco import State


@pytest.fixture(params=["walker_walk", "humanoid_walk"])
def body_task(request):
    return request.param


def orange(pixels):
    """Pixels of the body's colours, which neither sky nor floor has."""
    red, _, blue = pixels.float().unbind(-1)
    return red > blue + 40


def test_every_camera_sees_its_world(body_task, device):
    env = torchrl_loco.make(body_task, 2, device, seed=0)
    env.reset()
    for camera in ("side", "back", "egocentric"):
        pixels = env.render(camera, width=64, height=48)
        assert pixels.shape == (2, 48, 64, 3)
        assert pixels.dtype == torch.uint8
        assert pixels.device == env.device
        assert len(pixels[0].flatten(0, 1).unique(dim=0)) > 20
    assert orange(env.render("side", 64, 48)).float().mean() > 0.01


def test_pixels_follow_the_state():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    qpos = torch.zeros(2, 9)
    qpos[1, 2] = torch.pi / 2  # upright, and lying on its belly
    env.reset(State({"qpos": qpos, "qvel": torch.zeros(2, 9)}, batch_size=[2]), set_state=True)
    upright, lying = (orange(p) for p in env.render("side", 96, 96))
    assert upright.any(dim=1).sum() > 1.5 * upright.any(dim=0).sum()
    assert lying.any(dim=0).sum() > 1.5 * lying.any(dim=1).sum()


def test_rendering_leaves_the_simulation_alone(body_task):
    env = torchrl_loco.make(body_task, 2, "cpu", seed=0)
    env.rollout(2)
    before, first = env.get_state(), env.render("side", 48, 48)
    kept = first.clone()
    after = env.get_state()
    assert all(torch.equal(before[key], after[key]) for key in State.KEYS)
    env.rollout(3)
    env.render("side", 48, 48)
    assert torch.equal(first, kept)  # a later picture does not overwrite an earlier one
