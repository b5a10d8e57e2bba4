"""Our MJCF files against the figures of dm_control's compiled models, and what a model must keep to."""

import mujoco
import numpy as np
import pytest
from oracle import reference_model

import torchrl_loco
from torchrl_loco import models

SECTIONS = ("names", "sizes", "option", "source")
SENSORS = {
    **{body: ["torso_velocity"] for body in ("walker", "humanoid", "cheetah")},
    "hopper": ["torso_velocity", "touch_toe", "touch_heel"],
}
"""A sensor that nobody reads costs time."""


def assert_figures_are_dm_controls(model, body):
    reference = reference_model(body)
    for field in reference:
        if field not in SECTIONS:
            ours, theirs = np.asarray(getattr(model, field), dtype=float), np.ravel(reference[field])
            np.testing.assert_allclose(ours.ravel(), theirs, rtol=0, atol=1e-6, err_msg=field)
    assert {size: getattr(model, size) for size in reference["sizes"]} == reference["sizes"]
    for option, value in reference["option"].items():
        np.testing.assert_allclose(getattr(model.opt, option), value, err_msg=option)


@pytest.mark.parametrize("body", models.PATHS)
def test_figures_names_and_scene(body):
    model = models.load(models.PATHS[body])
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
    assert models.check(model) is model


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
        ({"actuator": MOTOR.replace("-1 1", "-2 2")}, "every actuator needs ctrlrange -1 1"),
        ({"actuator": '<motor name="a" joint="leg"/>'}, "every actuator needs ctrlrange -1 1"),
        ({"actuator": MOTOR.replace("/>", ' ctrllimited="false"/>')}, "must be clipped"),
        ({"option": clampctrl}, "must be clipped"),
        ({"actuator": MOTOR.replace("/>", ' delay="0.1" nsample="4"/>')}, "delays"),
        ({"actuator": '<intvelocity joint="leg" ctrlrange="-1 1" actrange="-1 1"/>'}, "activations"),
        ({"sensor": from_camera}, "sensor 'seen' is not evaluated"),
        ({"sensor": '<framepos name="place" objtype="body" objname="ant"/>'}, "sensor 'place' is not evaluated"),
        ({"sensor": '<actuatorfrc name="force" actuator="a"/>'}, "sensor 'force' is not evaluated"),
    ]:
        with pytest.raises(ValueError, match=message):
            models.check(ant(**options))
    models.check(ant())


def test_load(tmp_path):
    """A scene of its own comes before ours; a missing or broken file is named."""
    path = tmp_path / "ant.xml"
    with pytest.raises(ValueError, match=r"ant\.xml"):
        models.load(path)
    path.write_text('<mujoco><include file="scene.xml"/></mujoco>')
    assert models.load(path).nmat == 3
    (tmp_path / "scene.xml").write_text('<mujoco><asset><material name="sand"/></asset></mujoco>')
    assert models.load(path).nmat == 1


def test_an_environment_refuses_such_a_model(tmp_path):
    unclipped = models.PATHS["walker"].read_text().replace('ctrlrange="-1 1"', 'ctrlrange="-2 2"')
    path = tmp_path / "walker.xml"
    path.write_text(unclipped)
    body = type("Strong", (torchrl_loco.WalkerWalk,), {"mjcf": path})
    with pytest.raises(ValueError, match="every actuator needs ctrlrange -1 1"):
        body(2, "cpu", seed=0)
