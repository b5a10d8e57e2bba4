"""The parts of the contact-free start, each against C MuJoCo."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from cases import MODELS

from torchrl_loco.envs.episode import poser
from torchrl_loco.sim import fill, models
from torchrl_loco.sim.sampling import (
    FreePose,
    Outline,
    depth_below,
    draw_free_pose,
    make_outline,
    make_skeleton,
    segment_distance,
)
from torchrl_loco.sim.world_func import WorldKernels


@wp.kernel
def distances(
    p: wp.array[wp.vec3], u: wp.array[wp.vec3], q: wp.array[wp.vec3], v: wp.array[wp.vec3], out: wp.array[float]
):
    i = wp.tid()
    out[i] = segment_distance(p[i], u[i], q[i], v[i])


def test_segment_distance_agrees_with_mujoco():
    """C MuJoCo's own distance of two capsules, spheres (u or v zero) and parallel ones among them."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    for name in "ab":
        body = spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.01, 0.4, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    n, half = 400, 0.4
    centers, axes = rng.uniform(-0.6, 0.6, (2, n, 3)), rng.normal(size=(2, n, 3))
    axes[1, :50] = axes[0, :50]  # parallel
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    expected = []
    for i in range(n):
        for k in range(2):
            data.mocap_pos[k] = centers[k, i]
            mujoco.mju_quatZ2Vec(data.mocap_quat[k], axes[k, i])
        mujoco.mj_kinematics(model, data)
        expected.append(mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None) + 0.02)
    arrays = [centers[0], half * axes[0], centers[1], half * axes[1]]
    out = wp.full(n, np.nan, dtype=float, device="cpu")
    with wp.ScopedDevice("cpu"):
        wp.launch(distances, n, [*(wp.array(a, dtype=wp.vec3) for a in arrays), out])
        np.testing.assert_allclose(out.numpy(), expected, atol=2e-5)
        arrays[1][:], arrays[3][:] = 0, 0
        wp.launch(distances, n, [*(wp.array(a, dtype=wp.vec3) for a in arrays), out])
        np.testing.assert_allclose(out.numpy(), np.linalg.norm(centers[0] - centers[1], axis=1), atol=1e-6)


@wp.kernel
def depths(outline: Outline, down: wp.array[wp.vec3], out: wp.array[float]):
    out[wp.tid()] = depth_below(outline, down[wp.tid()])


def test_a_body_that_is_raised_by_its_depth_touches_the_floor():
    """In C MuJoCo, with each kind of geom alone and with all of them."""
    geoms = [
        f'<geom type="{kind}" size="{size}" pos="0.1 -0.05 {0.1 * i}" euler="20 {30 * i} 40" margin="0.05"/>'
        for i, (kind, size) in enumerate(
            {"sphere": "0.1", "capsule": "0.05 0.2", "ellipsoid": "0.1 0.2 0.05", "cylinder": "0.1 0.05"}.items()
        )
    ]
    xml = '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>{}</body></worldbody></mujoco>'
    quats = np.random.default_rng(0).normal(size=(30, 4))
    for some in (*geoms, "".join(geoms)):
        model = mujoco.MjModel.from_xml_string(xml.format(some))
        data = mujoco.MjData(model)
        turned = np.zeros((len(quats), 9))
        for row, quat in zip(turned, quats, strict=True):
            mujoco.mju_quat2Mat(row, quat / np.linalg.norm(quat))
        with wp.ScopedDevice("cpu"):
            out = wp.full(len(quats), np.nan, dtype=float)
            down = wp.array(-turned[:, 6:], dtype=wp.vec3)
            wp.launch(depths, len(quats), [make_outline(model, wp.get_device("cpu")), down, out])
        for quat, depth in zip(quats, out.numpy(), strict=True):
            data.qpos[:] = [0, 0, depth, *quat]
            mujoco.mj_fwdPosition(model, data)
            assert abs(data.contact.dist.min()) < 1e-5, some
    box = mujoco.MjModel.from_xml_string(xml.format('<geom type="box" size="1 1 1"/>'))
    with pytest.raises(ValueError, match="an outline consists of"):
        make_outline(box, wp.get_device("cpu"))


def test_poses_near_the_floor_do_not_touch_it():
    """From a root 0.9 m high most poses reach the floor; C MuJoCo finds no contact in those that are kept."""
    model = models.load(MODELS["humanoid"])
    device, n = wp.get_device("cpu"), 500
    with wp.ScopedDevice(device):
        pairs = mjw.put_model(model).nxn_geom_pair_filtered.numpy()
        start = np.tile(model.qpos0, (n, 1))
        start[:, 2] = 0.9
        qpos = wp.array(start, dtype=float)
        skeleton, stream = make_skeleton(model, pairs, device), wp.array(np.arange(n), dtype=wp.uint32)
        xpos, xquat = (wp.zeros((n, model.nbody), dtype=dtype) for dtype in (wp.vec3, wp.quat))
        inputs = fill(FreePose, skeleton=skeleton, qpos=qpos, xpos=xpos, xquat=xquat)
        WorldKernels().launch([poser(draw_free_pose, inputs, stream)], wp.ones(n, dtype=bool))
        drawn = qpos.numpy().astype(np.float64)
    data = mujoco.MjData(model)
    for q in drawn:
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        assert data.ncon == 0


def test_other_models_are_refused():
    pairs = np.zeros((0, 2), dtype=np.int32)
    with pytest.raises(ValueError, match="free joints and hinges"):
        make_skeleton(models.load(MODELS["walker"]), pairs, wp.get_device("cpu"))
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 1])
    with pytest.raises(ValueError, match="capsules and spheres"):
        make_skeleton(spec.compile(), pairs, wp.get_device("cpu"))
