"""Pixels against where the bodies are, and rendering changes nothing but pixels."""

import mujoco
import torch
from for_each import for_each

from torchrl_loco import State

BODIES = ("walker_run", "quadruped_run")
"""One that slides and one that floats, which have all shapes between them."""


def orange(pixels):
    """Pixels of the body's colours, which neither sky nor floor has."""
    red, _, blue = pixels.float().unbind(-1)
    return red > blue + 40


@for_each("task", cpu=BODIES, cuda=BODIES[:1])
def test_every_camera_sees_its_world_and_changes_nothing(shared, task, device):
    env = shared(task, 2, device)
    env.rollout(2)
    before, pictures = env.get_state(), {}
    for camera in ("side", "back", "egocentric"):
        pixels = env.render(camera, width=48, height=36)
        assert pixels.shape == (2, 36, 48, 3)
        assert pixels.dtype == torch.uint8
        assert pixels.device == env.device
        assert len(pixels[0].flatten(0, 1).unique(dim=0)) > 20
        pictures[camera] = pixels, pixels.clone()
        assert torch.equal(env.render(camera, 48, 36, worlds=1), pixels[:1])
    assert orange(pictures["side"][0]).float().mean() > 0.01
    assert len({pixels.cpu().numpy().tobytes() for pixels, _ in pictures.values()}) == 3
    assert (env.get_state() == before).all()
    env.rollout(3)
    for camera, (pixels, kept) in pictures.items():
        assert not torch.equal(env.render(camera, 48, 36), kept)
        assert torch.equal(pixels, kept)  # a later picture does not overwrite an earlier one


@for_each("task", BODIES)
def test_the_floor_reaches_the_horizon_wherever_a_body_goes(shared, task):
    env = shared(task, 2)
    m = env.mj_model
    free = m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    along = 0 if free else int(m.joint("rootx").qposadr[0])
    qpos = torch.tensor(m.qpos0, dtype=torch.float32).repeat(2, 1)
    qpos[1, along] -= 60.0  # behind the end of the floors' size
    env.reset(State({"qpos": qpos, "qvel": torch.zeros(2, m.nv)}, batch_size=[2]), set_state=True)
    start, far = env.render("side", 48, 36)
    lowest = far[-6:].float()
    assert (lowest[..., 2] - lowest[..., 0]).max() < 60  # the sky is bluer than that
    assert (start[-6:].float() - lowest).abs().mean() < 30


def test_pixels_follow_the_state(shared):
    env = shared("walker_run", 2)
    qpos = torch.zeros(2, 9)
    qpos[1, 2] = torch.pi / 2  # upright, and lying on its belly
    env.reset(State({"qpos": qpos, "qvel": torch.zeros(2, 9)}, batch_size=[2]), set_state=True)
    upright, lying = (orange(p) for p in env.render("side", 96, 96))
    assert upright.any(dim=1).sum() > 1.5 * upright.any(dim=0).sum()
    assert lying.any(dim=0).sum() > 1.5 * lying.any(dim=1).sum()
