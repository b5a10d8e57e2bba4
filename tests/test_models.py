"""Our MJCF files against the figures of dm_control's compiled models, and what a model must keep to."""

import mujoco
import numpy as np
import pytest
import torch
from cases import MODELS
from for_each import for_each
from oracle import reference_model

import torchrl_loco
from torchrl_loco.sim import models
from torchrl_loco.sim.mujoco_warp import stepped_wrongly

SECTIONS = {"names", "sizes", "option", "source"}
INDICES = {"sensor_objid"}
"""Fields that count what our models leave out, such as sites that no sensor uses."""
LEGS = ("front_left", "front_right", "back_right", "back_left")
SENSORS = {
    **{body: ["torso_velocity"] for body in ("walker", "humanoid", "cheetah")},
    "hopper": ["torso_velocity", "touch_toe", "touch_heel"],
    "quadruped": [
        *("imu_accel", "imu_gyro", "velocimeter"),
        *(f"force_toe_{leg}" for leg in LEGS),
        *(f"torque_toe_{leg}" for leg in LEGS),
    ],
}
"""A sensor that nobody reads costs time."""


def assert_figures_are_dm_controls(model, body):
    reference = reference_model(body)
    for field in set(reference) - SECTIONS - INDICES:
        ours, theirs = np.asarray(getattr(model, field), dtype=float), np.asarray(reference[field], dtype=float)
        kind = field.split("_")[0]
        if kind == "site":  # those that our sensors use
            theirs = theirs[[reference["names"]["site"].index(model.site(i).name) for i in range(model.nsite)]]
        elif kind == "sensor":  # our sensors come first
            theirs = theirs[: model.nsensor]
        elif field == "geom_size":  # the size of the floor is that of its picture
            ours, theirs = ours[1:], theirs[1:]
        np.testing.assert_allclose(ours, theirs.reshape(ours.shape), rtol=0, atol=1e-6, err_msg=field)
    sizes = reference["sizes"].keys() - {"nsite", "nsensor"}
    assert {size: getattr(model, size) for size in sizes} == {size: reference["sizes"][size] for size in sizes}
    for option, value in reference["option"].items():
        np.testing.assert_allclose(getattr(model.opt, option), value, err_msg=option)


@for_each("body", MODELS)
def test_figures_names_and_scene(body):
    model = models.load(MODELS[body])
    assert_figures_are_dm_controls(model, body)
    names = reference_model(body)["names"]
    for kind in ("body", "joint", "actuator"):
        assert [getattr(model, kind)(i).name for i in range(len(names[kind]))] == names[kind]
    assert [model.geom(i).name for i in range(1, model.ngeom)] == names["geom"][1:]  # the floor has one name here
    assert {model.camera(i).name for i in range(model.ncam)} == {"side", "back", "egocentric"}
    assert model.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert model.nlight == 1
    assert {model.material(i).name for i in range(model.nmat)} == {"floor", "skin", "skin_left"}
    assert [model.sensor(i).name for i in range(model.nsensor)] == SENSORS[body]
    if "torso_velocity" in SENSORS[body]:
        assert model.sensor("torso_velocity").type[0] == mujoco.mjtSensor.mjSENS_SUBTREELINVEL
        assert model.sensor("torso_velocity").objid[0] == model.body("torso").id
    for i in range(model.nsensor):
        if model.sensor_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
            name = model.site(model.sensor_objid[i]).name
            assert model.sensor(i).name.endswith(name) or name == "torso"
    assert models.check(model) is model


def test_a_viewer_opens_on_the_body():
    """MuJoCo's own camera has the whole body in its picture, and the body fills a third of the picture or more."""
    for body, path in MODELS.items():
        model = models.load(path)
        data, scene, camera = mujoco.MjData(model), mujoco.MjvScene(model, 1000), mujoco.MjvCamera()
        mujoco.mj_forward(model, data)
        mujoco.mjv_defaultFreeCamera(model, camera)
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        eye = scene.camera[0]
        to_body = data.geom_xpos[model.geom_bodyid > 0] - eye.pos
        ahead = to_body @ eye.forward
        assert (ahead > eye.frustum_near).all()
        assert (ahead < eye.frustum_far).all()
        half = eye.frustum_top / eye.frustum_near  # of the picture's height, as a tangent
        up, aside = to_body @ eye.up / ahead / half, to_body @ np.cross(eye.forward, eye.up) / ahead / half
        assert np.abs([up, aside]).max() < 0.9, body
        assert max(np.ptp(up), np.ptp(aside)) > 2 / 3, body


ANT = """
<mujoco>
  <worldbody><body name="ant"><joint name="leg"/><geom name="leg" size="0.1"/><camera name="eye"/></body></worldbody>
  <actuator>{actuator}</actuator>
  <sensor>{sensor}</sensor>
</mujoco>
"""
MOTOR = '<motor name="a" joint="leg" ctrlrange="-1 1"/>'
VELOCITY = '<subtreelinvel name="speed" body="ant"/>'


def ant(actuator=MOTOR, sensor=VELOCITY, option=""):
    xml = ANT.format(actuator=actuator, sensor=sensor).replace("<mujoco>", f"<mujoco>{option}")
    return mujoco.MjModel.from_xml_string(xml)


def test_a_model_that_would_go_wrong_in_silence_is_refused():
    from_camera = '<framelinvel name="seen" objtype="body" objname="ant" reftype="camera" refname="eye"/>'
    clampctrl = '<option><flag clampctrl="disable"/></option>'
    for options, message in [
        ({"actuator": '<motor name="a" joint="leg"/>'}, "every actuator needs a ctrlrange"),
        ({"actuator": MOTOR.replace("/>", ' ctrllimited="false"/>')}, "must be clipped"),
        ({"option": clampctrl}, "must be clipped"),
        ({"option": '<option actuatorgroupdisable="3"/>', "actuator": MOTOR.replace("/>", ' group="3"/>')}, "disabled"),
        ({"actuator": MOTOR.replace("/>", ' delay="0.1" nsample="4"/>')}, "delays of actuators"),
        ({"sensor": VELOCITY.replace("/>", ' delay="0.1" nsample="4"/>')}, "delays and intervals of sensors"),
        ({"sensor": VELOCITY.replace("/>", ' interval="0.1"/>')}, "delays and intervals of sensors"),
        ({"option": '<default><joint frictionloss="-1"/></default>'}, "frictionloss must not be negative"),
        ({"sensor": from_camera}, "sensor 'seen' is not evaluated"),
        ({"sensor": '<framepos name="place" objtype="body" objname="ant"/>'}, "sensor 'place' is not evaluated"),
        ({"sensor": '<actuatorfrc name="force" actuator="a"/>'}, "sensor 'force' is not evaluated"),
    ]:
        with pytest.raises(ValueError, match=message):
            models.check(ant(**options))
    for actuator in (MOTOR.replace("-1 1", "-2 2"), '<intvelocity joint="leg" ctrlrange="-1 1" actrange="-1 1"/>'):
        models.check(ant(actuator))


def test_load(tmp_path):
    """A scene of its own comes before ours; a missing or broken file is named."""
    path = tmp_path / "ant.xml"
    with pytest.raises(FileNotFoundError, match=r"ant\.xml"):
        models.load(path)
    path.write_text('<mujoco><include file="scene.xml"/></mujoco>')
    assert models.load(path).nmat == 3
    (tmp_path / "scene.xml").write_text('<mujoco><asset><material name="sand"/></asset></mujoco>')
    assert models.load(path).nmat == 1


def test_an_environment_refuses_such_a_model(tmp_path):
    unclipped = MODELS["walker"].read_text().replace('ctrlrange="-1 1" ctrllimited="true"', "")
    path = tmp_path / "walker.xml"
    path.write_text(unclipped)
    body = type("Strong", (torchrl_loco.WalkerWalk,), {"model": path})
    with pytest.raises(ValueError, match="every actuator needs a ctrlrange"):
        body(2, "cpu", seed=0)


def test_actions_are_scaled_to_the_range_of_the_controls(shared):
    env = shared("quadruped_run", 3)
    action = torch.tensor([[-1.0], [0.5], [7.0]]).expand(3, 12)
    env.step(env.reset().set("action", action))
    low, high = env.mj_model.actuator_ctrlrange.T
    expected = np.stack([low, low + 0.75 * (high - low), high])
    np.testing.assert_allclose(env.sim.ctrl, expected, atol=1e-6)
    np.testing.assert_allclose(models.control(env.mj_model, action.numpy()), expected, atol=1e-6)


def test_what_mujoco_warp_would_step_wrongly_from_reset_to_reset():
    joint = '<joint name="hinge" axis="0 1 0" stiffness="1" springyield="0.05"/>'
    body = f'<worldbody><body>{joint}<geom size="0.1" pos="0 0 0.2"/><site name="here"/></body></worldbody>'
    motor = '<actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>'
    sensor = '<sensor><gyro site="here" interval="0.05"/></sensor>'
    for option, more, words in (
        ('<flag sleep="enable"/>', "", "bodies that sleep"),
        ("", sensor, "sensors with a delay or an interval"),
    ):
        m = mujoco.MjModel.from_xml_string(f"<mujoco><option>{option}</option>{body}{motor}{more}</mujoco>")
        assert [what.startswith(words) for what in stepped_wrongly(m)] == [True]
        with pytest.raises(ValueError, match="plastic joints are not supported"):
            models.check(m)
