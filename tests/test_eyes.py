"""What cameras see, against rays of C MuJoCo; pixels and depth as entries of environments and in hooks."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from for_each import for_each
from tensordict import TensorDict
from torchrl.envs import CatFrames, Compose, ToTensorImage
from torchrl.envs.utils import check_env_specs

import torchrl_loco as loco
from torchrl_loco.envs.pixels import checked_camera
from torchrl_loco.eyes.placing import bytes_placed
from torchrl_loco.eyes.rays import Rays
from torchrl_loco.eyes.tracer import Eye
from torchrl_loco.sim import simulation
from torchrl_loco.sim.models import load

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
WIDTH, HEIGHT = 42, 30  # no multiples of a tile of threads
BALLS = "".join(f'<geom type="sphere" size="0.07" pos="{0.1 * k - 1.5} 0.2 {1.1 + 0.2 * (k % 2)}"/>' for k in range(30))
"""More shapes than a warp has threads, with the others."""
SHAPES = f"""
<mujoco>
  <asset>
    <hfield name="field" nrow="9" ncol="12" size="2 1.5 0.4 0.1"/>
    <hfield name="small" nrow="4" ncol="5" size="0.5 0.4 0.5 0.1"/>
    <mesh name="wedge" vertex="0 0 0  0.4 0 0  0 0.4 0  0 0 0.5"/>
    <material name="opaque"/>
    <material name="clear" rgba="1 1 1 0"/>
  </asset>
  <worldbody>
    <geom type="plane" size="0 0 1" pos="0 0 -0.2"/>
    <geom type="plane" size="0.3 0.4 1" pos="-0.9 -0.3 0.6" euler="30 20 0" contype="0" conaffinity="0"/>
    <geom type="hfield" hfield="field" pos="0.4 0.3 -0.1" euler="0 0 10"/>
    <geom type="box" size="0.3 0.2 0.1" pos="-0.6 0.5 0.3" euler="10 20 30"/>
    <body pos="0 0 0.6">
      <freejoint/>
      <geom type="sphere" size="0.12"/>
      <geom type="capsule" size="0.06 0.3" pos="0.3 0.2 0.1" euler="30 40 0"/>
      <geom type="cylinder" size="0.1 0.2" pos="-0.4 0.1 0.1" euler="60 10 0"/>
      <geom type="ellipsoid" size="0.1 0.2 0.05" pos="0 -0.4 0.2" euler="10 40 20"/>
      <geom type="box" size="0.1 0.15 0.05" pos="0.1 0.4 0.3" euler="50 10 0"/>
      <geom type="mesh" mesh="wedge" pos="-0.3 -0.5 0.1"/>
      <geom type="sphere" size="0.3" group="3"/>
      <geom type="sphere" size="0.3" rgba="1 1 1 0"/>
      <site name="eye" pos="0.1 -0.9 0.4" quat="0.8 0.6 0 0"/>
      <camera name="track" mode="track" pos="0 -2 0.5" xyaxes="1 0 0 0 0.3 1"/>
      <camera name="trackcom" mode="trackcom" pos="1.5 0.4 1" xyaxes="-0.2 1 0 -0.4 0 1"/>
      <camera name="held" pos="0.1 -1.2 0.4" xyaxes="1 0.1 0 0 0.5 1" fovy="70"/>
    </body>
    <body pos="-1.3 -0.9 0.2" euler="0 0 20"><geom type="hfield" hfield="small"/></body>
    <body name="target" pos="0.2 0.1 0.7"><geom type="sphere" size="0.01"/></body>
    {BALLS}
    <camera name="fixed" pos="2 2 1.5" xyaxes="-1 1 0 -0.4 -0.4 1"/>
    <camera name="at_body" pos="-1.5 -1 1.2" mode="targetbody" target="target"/>
    <camera name="at_com" pos="-1.5 1.5 0.9" mode="targetbodycom" target="target"/>
  </worldbody>
</mujoco>"""


def shapes():
    m = mujoco.MjModel.from_xml_string(SHAPES)
    m.hfield_data[:] = np.random.default_rng(0).random(m.hfield_data.size)
    return m


def seen_by_rays(m, data, camera):
    """Returns depths along rays through the pixels, infinite where nothing is, and the geoms that they meet."""
    half = np.tan(np.deg2rad(m.cam_fovy[camera] / 2))
    x = half * WIDTH / HEIGHT * (2 * (np.arange(WIDTH) + 0.5) / WIDTH - 1)
    y = half * (1 - 2 * (np.arange(HEIGHT) + 0.5) / HEIGHT)
    rays = np.stack([*np.meshgrid(x, y), np.full((HEIGHT, WIDTH), -1.0)], -1)
    lengths = np.linalg.norm(rays, axis=-1)
    rays = rays / lengths[..., None] @ data.cam_xmat[camera].reshape(3, 3).T
    distances, geoms, geom = np.full((HEIGHT, WIDTH), np.inf), np.full((HEIGHT, WIDTH), -1), np.zeros(1, np.int32)
    groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
    for at in np.ndindex(HEIGHT, WIDTH):
        distance = mujoco.mj_ray(m, data, data.cam_xpos[camera], rays[at], groups, 1, -1, geom)
        if distance >= 0:
            distances[at], geoms[at] = distance / lengths[at], geom[0]
    return distances, geoms


@pytest.mark.parametrize("device", DEVICES)
@for_each("camera", ["track", "trackcom", "held", "fixed", "at_body", "at_com"])
def test_depth_and_geoms_are_those_of_rays_of_c_mujoco(camera, device):
    """Of all shapes and all kinds of cameras; what is transparent or in a hidden group is not seen."""
    m, device = shapes(), wp.get_device(device)
    eye = Eye(m, device, camera, WIDTH, HEIGHT, 2, ("rgb", "depth", "geoms"), far=1e3)
    eye.depth.fill_(torch.nan)
    assert 2 * bytes_placed(m) == sum(each.capacity for each in (eye.placed.sight.poses, eye.placed.sight.bounds))
    data, rng = mujoco.MjData(m), np.random.default_rng(1)
    poses = []
    for _ in range(2):
        data.qpos[:3] = 0.2 * rng.standard_normal(3) + [0, 0, 0.6]
        data.qpos[3:7] = [1, *0.3 * rng.standard_normal(3)]
        mujoco.mj_normalizeQuat(m, data.qpos)
        mujoco.mj_forward(m, data)
        poses.append((data.xpos.copy(), data.xmat.copy(), *seen_by_rays(m, data, m.camera(camera).id)))
    xpos = wp.array(np.stack([pose[0] for pose in poses]), dtype=wp.vec3, device=device)
    xmat = wp.array(np.stack([pose[1] for pose in poses]).reshape(2, -1, 3, 3), dtype=wp.mat33, device=device)
    eye.look(xpos, xmat)
    for world, (_, _, distance, geom) in enumerate(poses):
        same = eye.geoms[world].cpu().numpy() == geom
        assert same.mean() > 0.995  # but at silhouettes
        assert len(np.unique(geom)) > 5
        found, there = eye.depth[world].cpu().numpy(), same & (geom >= 0)
        assert (np.abs(found[there] / distance[there] - 1) < 1e-4).mean() > 0.998
        assert (found[same & (geom < 0)] == 1e3).all()
    assert not torch.equal(eye.rgb[0], eye.rgb[1])


def test_light_falls_off_and_casts_shadows():
    """A lit floor, the shadow of a ball on it, and colors of materials; a spot's ambient light is in its cone."""
    xml = """
    <mujoco>
      <visual><headlight active="0"/></visual>
      <worldbody>
        <light directional="true" pos="0 0 3" dir="0 0 -1" diffuse="0.8 0.8 0.8"
               ambient="0.1 0.1 0.1" specular="0 0 0"/>
        <light pos="0 0 3" dir="0 0 1" cutoff="30" ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/>
        <geom type="plane" size="0 0 1" rgba="0 1 0 1"/>
        <geom type="sphere" size="0.2" pos="0 0 1" rgba="1 0 0 1"/>
        <camera name="above" pos="1 0 3" xyaxes="0 1 0 -1 0 0.5"/>
      </worldbody>
    </mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    nobody = {"dtype": wp.vec3, "device": "cpu"}
    pixels = {}
    for shadows in (False, True):
        eye = Eye(m, wp.get_device("cpu"), "above", 60, 60, 1, shadows=shadows)
        eye.look(wp.zeros((1, 1), **nobody), wp.array(np.eye(3)[None, None], dtype=wp.mat33, device="cpu"))
        pixels[shadows] = eye.rgb[0].clone()
    red, green, _ = pixels[False].int().unbind(-1)
    assert ((red > 100) & (green == 0)).any()
    floor = (green > 0) & (red == 0)
    assert (green[floor] == round(0.9 * 255)).all()
    dark = (pixels[True][..., 1] == round(0.1 * 255)) & floor
    assert 0.005 < dark.float().mean() < 0.2
    assert torch.equal(pixels[True][~dark], pixels[False][~dark])


CHECKED = """<mujoco><asset>
  <texture name="check" type="2d" builtin="checker" rgb1="1 1 1" rgb2="0 0 0" width="64" height="64"/>
  <material name="check" texture="check" texrepeat="2 3" {uniform}/>
  <hfield name="flat" nrow="2" ncol="2" size="2 3 1 1"/></asset>
  <worldbody><geom {ground} material="check"/><camera name="above" pos="0 0 5" fovy="20"/>
  <body pos="0 0 9"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
SQUARES = {"": (2.0, 3.0, 1.0, 1.0), 'texuniform="true"': (2.0, 3.0, 0.5, 1 / 3)}
"""Distances of a corner of the ground, and sides of a square, along x and y (m)."""


def test_the_texture_of_ground_is_as_large_as_in_mujoco_and_begins_in_its_corner():
    for ground in (
        'type="plane" size="2 3 1"',
        'type="box" size="2 3 .5" pos="0 0 -.5"',
        'type="hfield" hfield="flat"',
    ):
        for uniform, (*corner, width, height) in SQUARES.items():
            m = mujoco.MjModel.from_xml_string(CHECKED.format(ground=ground, uniform=uniform))
            data, eye = mujoco.MjData(m), Eye(m, wp.get_device("cpu"), "above", 120, 120, 1)
            mujoco.mj_kinematics(m, data)
            rows = wp.array(data.xpos[None], wp.vec3), wp.array(data.xmat.reshape(1, -1, 3, 3), wp.mat33)
            eye.look(*rows)
            light = eye.rgb[0, :, :, 0].numpy() > 100
            at = (np.arange(120) - 59.5) / 60 * 5 * np.tan(np.radians(10))
            x, y = (at + corner[0]) / width, (-at + corner[1]) / height
            inside = [((each - 0.1) % 1 < 0.8) for each in (x, y)]  # edges are soft
            even = (np.floor(x)[None] + np.floor(y)[:, None]) % 2 == 0
            kept = inside[1][:, None] & inside[0][None]
            assert len({*(light == even)[kept].tolist()}) == 1, (ground, uniform)


def test_a_camera_shows_what_is_there_now():
    """The same as the entries of steps; geoms are seen where something is near."""
    env = loco.make("walker_walk", 2, "cpu", 0, from_pixels=True, depth=50.0, size=(24, 16), camera="back")
    td = env.rollout(3)[:, -1]["next"]
    seen = env.camera("back", 24, 16, ("rgb", "depth", "geoms"))
    assert torch.equal(seen["rgb"], td["pixels"])
    assert torch.equal(seen["depth"].clamp(max=50.0), td["depth"])
    assert ((seen["geoms"] >= 0) == (seen["depth"] < 1e9)).all()
    floor = env.mj_model.geom("floor").id
    assert (seen["geoms"] == floor).any()
    assert ((seen["geoms"] >= 0) & (seen["geoms"] != floor)).any()
    kept = seen["rgb"].clone()
    env.rollout(2)
    env.camera("back", 24, 16)
    assert torch.equal(seen["rgb"], kept)
    assert "observation" not in td
    assert {"observation", "depth"} <= set(loco.make("walker_walk", 2, "cpu", 0, depth=5.0, size=(8, 6)).reset().keys())
    single = loco.make("walker_walk", None, "cpu", 0)
    single.reset()
    assert single.camera(width=8, height=6)["rgb"].shape == (6, 8, 3)
    with pytest.raises(ValueError, match="'color': choose one of rgb, depth, geoms"):
        env.camera(kinds=["color"])
    with pytest.raises(ValueError, match="at least one of rgb, depth, geoms"):
        env.camera(kinds=())
    with pytest.raises(ValueError, match="choose one of side, back, egocentric"):
        env.camera("top")


@pytest.mark.parametrize("device", DEVICES)
def test_the_last_pictures_of_an_episode_are_stacked(device):
    """A state holds them; one without begins with what is seen then."""
    options = {"from_pixels": True, "pixels_only": False, "size": (24, 16), "episode_length": 4, "frame_stack": 3}
    env = loco.make("walker_walk", 3, device, 0, **options)
    check_env_specs(env)
    env.set_seed(0)
    td, generator = env.reset(), torch.Generator().manual_seed(0)
    actions = (torch.rand(4, 3, 6, generator=generator) * 2 - 1).to(env.device)
    assert torch.equal(td["pixels"][..., :3], td["pixels"][..., 6:])
    pictures = [td["pixels"][..., 6:]] * 3
    for action in actions[:3]:
        before, td = env.step_and_maybe_reset(td.set("action", action))
        pictures = [*pictures[1:], before["next", "pixels"][..., 6:]]
        assert torch.equal(before["next", "pixels"], torch.cat(pictures, dim=-1))
    state = env.get_state()
    last, begun = env.step_and_maybe_reset(td.clone().set("action", actions[3]))
    assert last["next", "done"].all()
    assert torch.equal(begun["pixels"][..., :3], begun["pixels"][..., 6:])
    restored = env.reset(state.clone(), set_state=True)
    assert torch.equal(restored["pixels"], td["pixels"])
    moved = state.clone()
    moved["qpos"][:, 0] += 0.5
    changed = env.reset(moved, set_state=True)["pixels"]
    assert torch.equal(changed[..., :6], td["pixels"][..., :6])
    assert not torch.equal(changed[..., 6:], td["pixels"][..., 6:])
    restored = env.reset(state.clone(), set_state=True)
    again, _ = env.step_and_maybe_reset(restored.set("action", actions[3]))
    assert torch.equal(again["next", "pixels"], last["next", "pixels"])
    bare = env.reset(loco.State(state.exclude("pictures").to_dict(), batch_size=[3]), set_state=True)
    assert torch.equal(bare["pixels"], td["pixels"][..., 6:].repeat(1, 1, 1, 3))


@pytest.mark.parametrize("device", DEVICES)
def test_pixels_are_entries_that_hold_what_they_held(device):
    """With the true last frame of an episode; they are the same alone and among others."""
    options = {"from_pixels": True, "depth": 8.0, "size": (24, 16), "camera": "side", "episode_length": 3}
    env = loco.make("walker_walk", 3, device, 0, pixels_only=False, **options)
    check_env_specs(env)
    env.set_seed(0)
    td = env.reset()
    assert td["pixels"].shape == (3, 16, 24, 3)
    assert td["depth"].shape == (3, 16, 24)
    first, kept = td["pixels"], td["pixels"].clone()
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        action = torch.rand(env.action_spec.shape, generator=generator).to(env.device) * 2 - 1
        before, td = env.step_and_maybe_reset(td.set("action", action))
    assert torch.equal(first, kept)
    ended = before["next"]
    assert ended["truncated"].all()
    assert not torch.equal(ended["pixels"], td["pixels"])
    restored = env.reset(env.get_state(), set_state=True)
    assert torch.equal(restored["pixels"], td["pixels"])
    alone = loco.make("walker_walk", 1, device, 0, reward_terms=True, **options)
    other = alone.reset()
    assert set(other.keys()) == {"pixels", "depth", "reward_terms", "done", "terminated", "truncated"}
    check_env_specs(alone)
    assert torch.equal(other["pixels"][0], kept[0])
    assert other["depth"].max() == 8.0


@pytest.mark.parametrize("device", DEVICES)
@for_each("stack", [1, 2])
def test_what_is_written_into_pixels_is_seen_nowhere_else(device, stack):
    """Into those of a step, of what the next begins with, of resets and states; masked worlds are drawn onto others."""
    options = {"from_pixels": True, "depth": 8.0, "size": (24, 16), "episode_length": 3, "frame_stack": stack}
    env, plain = (loco.make("walker_walk", 3, device, 0, **options) for _ in range(2))
    generator = torch.Generator().manual_seed(0)

    def alike(ours, expected):
        for key in {"pixels", "depth", "pictures"} & set(ours.keys()):
            assert torch.equal(ours[key], expected[key])
            ours[key].fill_(7)

    rows = torch.tensor([[True], [False], [True]], device=env.device)
    reset = TensorDict({"_reset": rows}, batch_size=[3])
    td, other = env.reset(), plain.reset()
    for i in range(8):
        alike(td, other)
        action = (torch.rand(3, 6, generator=generator) * 2 - 1).to(env.device)
        if i % 4 == 2:
            ours, theirs = (each.step(now.set("action", action)) for each, now in ((env, td), (plain, other)))
            alike(ours["next"], theirs["next"])
            td, other = env._reset(reset.clone()), plain._reset(reset.clone())
        else:
            ours, td = env.step_and_maybe_reset(td.set("action", action))
            theirs, other = plain.step_and_maybe_reset(other.set("action", action))
            alike(ours["next"], theirs["next"])
        alike(env.get_state(), plain.get_state())
    alike(env.reset(env.get_state(), set_state=True), other)


def test_transforms_of_torchrl_stack_and_turn_them():
    env = loco.TransformedEnv(
        loco.make("walker_walk", 2, "cpu", 0, from_pixels=True, size=(20, 20)),
        Compose(ToTensorImage(), CatFrames(N=3, dim=-3, in_keys=["pixels"])),
    )
    batch = env.rollout(4)
    assert batch["pixels"].shape == (2, 4, 9, 20, 20)
    assert torch.equal(batch["pixels"][:, 2, 3:], batch["pixels"][:, 3, :6])


@for_each(
    ("options", "match"),
    [
        ({"pixels_only": True}, "pixels_only needs from_pixels=True"),
        ({"camera": "side"}, "camera needs from_pixels=True"),
        ({"from_pixels": True, "observation_terms": True}, "observation_terms .* pixels_only=False"),
        ({"from_pixels": True, "camera": "left"}, "unknown camera .left.: choose one of side"),
        ({"from_pixels": True, "camera": 7}, "camera"),
        ({"from_pixels": True, "size": 84}, "size must be the width and height"),
        ({"from_pixels": True, "size": (0, 84)}, "width"),
        ({"depth": -1.0}, r"depth, the greatest that is seen \(m\) or 0 for none, must lie in"),
    ],
)
def test_what_cannot_be_seen_is_refused(options, match):
    with pytest.raises(ValueError, match=match):
        loco.make("walker_walk", 2, "cpu", 0, **options)


def test_a_camera_without_a_name_has_a_number():
    m = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera/><camera name='b'/></worldbody></mujoco>")
    assert checked_camera(m, None) == 0
    with pytest.raises(ValueError, match=r"unknown camera '': choose one of b$"):
        checked_camera(m, "")
    cart = """<mujoco><worldbody><body><joint/><geom size="0.1"/>
      <body><camera name="eye"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    m = load(cart)  # with a camera that MuJoCo numbers first
    assert [m.camera(i).name for i in range(m.ncam)] == ["side", "eye"]
    assert [m.camera(checked_camera(m, number)).name for number in (None, 0, 1)] == ["eye", "eye", "side"]


def test_pixels_that_do_not_fit_are_refused():
    with pytest.raises(MemoryError, match="GiB"):
        loco.make("walker_walk", 2**16, "cpu", 0, from_pixels=True, size=(8192, 8192))


class Sees(loco.Go1Velocity):
    """Go1 that sees the ground ahead."""

    def observation(self, s):
        return {**super().observation(s), "eye": s.depth("egocentric", 8, 6, far=4.0)}


def test_hooks_see_depth():
    """As kernels and as plain torch, after steps and resets, what the environment's own camera sees."""
    options = {"depth": 4.0, "camera": "egocentric", "size": (8, 6), "pixels_only": False}
    env, plain = (Sees(3, "cpu", seed=0, compile_hooks=compiled, **options) for compiled in (True, False))
    assert env.world.kinds["observation"] == "kernel"
    td, ours = env.reset(), plain.reset()
    for _ in range(3):
        assert td["eye"].shape == (3, 6, 8)
        assert torch.equal(td["eye"], td["depth"])
        torch.testing.assert_close(ours["eye"], td["eye"], atol=1e-4, rtol=1e-4)
        state, action = env.get_state(), torch.zeros(env.action_spec.shape)
        td = env.step(env.reset(state, set_state=True).set("action", action))["next"]
        ours = plain.step(plain.reset(state, set_state=True).set("action", action))["next"]
    assert td["eye"].max() == 4.0
    assert td["eye"].min() < 1.0


def test_a_group_must_not_have_the_name_of_pixels():
    class Named(Sees):
        def observation(self, s):
            return {**super().observation(s), "depth": s.depth("egocentric", 8, 6)}

    with pytest.raises(ValueError, match="'depth' is what a camera sees"):
        Named(2, "cpu", seed=0, depth=4.0, pixels_only=False)


@pytest.mark.parametrize("device", DEVICES)
def test_rays_from_a_body_meet_what_those_of_c_mujoco_meet(device):
    m, device, rng = shapes(), wp.get_device(device), np.random.default_rng(2)
    for kind, material in ((mujoco.mjtGeom.mjGEOM_CAPSULE, "clear"), (mujoco.mjtGeom.mjGEOM_SPHERE, "opaque")):
        of_kind = (m.geom_type == kind) & ((m.geom_rgba[:, 3] == 0.0) == (material == "opaque"))
        m.geom_matid[of_kind] = m.material(material).id  # whose opacity counts, not the geom's
        m.geom_rgba[of_kind, :3] = 0.9
    directions, site = rng.standard_normal((200, 3)), m.site("eye")
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    data, geom = mujoco.MjData(m), np.zeros(1, np.int32)
    data.qpos[3:7] = [0.9, 0.2, -0.3, 0.1]
    mujoco.mj_normalizeQuat(m, data.qpos)
    mujoco.mj_forward(m, data)
    rays = Rays(m, device, site.id, directions, 1, far=50.0)
    start, axes = data.site("eye").xpos, data.site("eye").xmat.reshape(3, 3)
    rays.launch(
        wp.array(data.xpos[None], dtype=wp.vec3, device=device),
        wp.array(data.xmat.reshape(1, -1, 3, 3), dtype=wp.mat33, device=device),
    )
    found, hidden = rays.distance[0].cpu().numpy(), 0
    for direction, distance in zip(directions @ axes.T, found, strict=True):
        met = mujoco.mj_ray(m, data, start, direction, None, 1, -1, geom)
        assert distance == pytest.approx(50.0 if met < 0 else min(met, 50.0), rel=1e-4)
        hidden += met > 0 and m.geom_group[geom[0]] >= 3
    assert hidden > 0  # geoms that pictures do not show
    assert (found < 50.0).mean() > 0.3


@for_each(
    "seen",
    [
        lambda s: s.depth("egocentric", 60, 60).flatten(1),
        lambda s: torch.cat([s.ray(foot, [[0, 0, 1]]) for foot in ("FR", "FL", "RR", "RL")], dim=1),
    ],
)
def test_what_hooks_see_must_fit(seen, monkeypatch):
    """Also a few rays, before each of whose sites all shapes are placed."""

    class Blind(loco.Go1Velocity):
        noise = {}

        def observation(self, s):
            return seen(s)

    monkeypatch.setattr(simulation, "free_memory", lambda device: 2 * 12_000)
    loco.Go1Velocity(2, "cpu", seed=0)
    with pytest.raises(MemoryError, match=r"num_envs=2 needs about .* GiB .* worlds fit"):
        Blind(2, "cpu", seed=0)


def test_rays_meet_the_underside_of_a_field():
    model = """
    <mujoco><asset><hfield name="raised" nrow="3" ncol="4" size="1 0.8 0.4 0.3"/></asset><worldbody>
    <geom type="hfield" hfield="raised" pos="0 0 1" euler="0 0 30"/><site name="eye" pos="0.1 0.2 0.1"/>
    </worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(model)
    data, geom = mujoco.MjData(m), np.zeros(1, np.int32)
    mujoco.mj_forward(m, data)
    directions = np.random.default_rng(3).normal([0.0, 0.0, 2.0], 1.0, (100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = Rays(m, wp.get_device("cpu"), 0, directions, 1, far=50.0)
    rays.launch(wp.array(data.xpos[None], dtype=wp.vec3), wp.array(data.xmat.reshape(1, -1, 3, 3), dtype=wp.mat33))
    met = np.array([mujoco.mj_ray(m, data, data.site("eye").xpos, way, None, 1, -1, geom) for way in directions])
    assert 20 < (met > 0).sum() < 100
    np.testing.assert_allclose(rays.distance[0], np.where(met < 0, 50.0, met), rtol=1e-4)


def test_hooks_cast_rays():
    """From a site that turns with its body: the floor is as far below a foot as the foot is high."""

    class Feels(loco.Go1Velocity):
        noise = {}

        def observation(self, s):
            return s.ray("FR", [[0, 0, -3.0], [0, 0, 1.0]], far=3.0)

    env, plain = (Feels(2, "cpu", seed=0, compile_hooks=compiled) for compiled in (True, False))
    env.reset()
    state = env.get_state()
    state["qpos"][1, 2:7] = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0])  # high, and on its back
    found = env.reset(state, set_state=True)["observation"]
    assert torch.equal(plain.reset(state, set_state=True)["observation"], found)
    assert found[0, 0] < 0.2
    assert found[1, 0] == 3.0  # it points into the sky


@for_each(
    "seen, error, match",
    [
        (lambda s: s.depth("left", 8, 6), KeyError, "no camera 'left'.*egocentric"),
        (lambda s: s.ray("paw", [[0, 0, 1]]), KeyError, "no site 'paw'.*FR"),
        (lambda s: s.depth(".*e.*", 8, 6), ValueError, "name one camera: .* matches 2"),
        (lambda s: s.ray("[FR][RL]", [[0, 0, 1]]), ValueError, "name one site: .* matches 4"),
        (lambda s: s.ray("FR", [0, 0, 1]), ValueError, "directions must be rows of 3"),
    ],
)
def test_what_hooks_ask_for_must_be_there(seen, error, match):
    class Blind(Sees):
        def observation(self, s):
            return seen(s).flatten(1)

    with pytest.raises(error, match=match):
        Blind(2, "cpu", seed=0)


HELD = """
<mujoco>
  <asset>
    <mesh name="head" vertex="-.1 -.1 -.1 .1 -.1 -.1 .1 .1 -.1 -.1 .1 -.1 -.1 -.1 .1 .1 -.1 .1 .1 .1 .1 -.1 .1 .1"/>
  </asset>
  <worldbody>
    <geom type="box" pos="0 3 .5" size=".5 .5 .5"/>
    <geom type="box" pos="0 6 1" size="5 .1 5"/>
    <camera name="in crate" pos="0 3 .5" xyaxes="1 0 0 0 0 1"/>
    <camera name="above" pos="0 0 3" mode="targetbody" target="b"/>
    <body name="b" pos="0 0 1.2">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom type="mesh" mesh="head" contype="0" conaffinity="0"/>
      <camera name="in head" xyaxes="1 0 0 0 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("device", DEVICES)
@for_each(("camera", "expected"), [("in head", 5.9), ("in crate", 2.9)])
def test_cameras_see_through_meshes_and_boxes_that_they_are_in(camera, expected, device):
    m, device = mujoco.MjModel.from_xml_string(HELD), wp.get_device(device)
    eye, data = Eye(m, device, camera, 3, 3, 1, ("depth",)), mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    eye.look(wp.array([data.xpos], dtype=wp.vec3, device=device), wp.array([data.xmat], dtype=wp.mat33, device=device))
    assert eye.depth[0, 1, 1].item() == pytest.approx(expected, abs=1e-3)


def test_a_camera_above_what_it_looks_at_has_the_axes_of_c_mujoco():
    m, device = mujoco.MjModel.from_xml_string(HELD), wp.get_device("cpu")
    eye, data = Eye(m, device, "above", 3, 3, 1, ("depth",)), mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    eye.look(wp.array([data.xpos], dtype=wp.vec3, device=device), wp.array([data.xmat], dtype=wp.mat33, device=device))
    expected = data.cam("above").xmat.reshape(3, 3)
    np.testing.assert_allclose(eye.placed.sight.camera_mat.numpy()[0], expected, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_cameras_follow_the_center_of_mass_that_a_world_has(device):
    vary = [
        loco.Vary("body_mass", 0.0, 10.0, of="torso", how="add"),
        loco.Vary("body_ipos", -0.2, 0.2, of="torso", how="add"),
    ]
    env = loco.make("walker_walk", 2, device, 0, randomize=vary, from_pixels=True, size=(4, 4))
    env.reset()
    seen = env.world.seen.eye.placed.sight.camera_pos.numpy()
    for world, pos in enumerate(seen):
        m = env.mujoco_model(world)
        data = mujoco.MjData(m)
        data.qpos[:] = env.sim.qpos[world].numpy(force=True)
        mujoco.mj_forward(m, data)
        np.testing.assert_allclose(pos, data.cam_xpos[0], atol=1e-5)
    assert abs(seen[0] - seen[1]).max() > 1e-2


def test_pictures_that_do_not_fit_are_refused_with_the_figures():
    env = loco.make("walker_walk", 1, "cpu", 0)
    with pytest.raises(MemoryError, match="GiB"):
        env.camera(width=200_000, height=200_000)
