"""Our MJCF files against the figures of dm_control's compiled models."""

import mujoco
import numpy as np
import pytest
from oracle import reference_model

from torchrl_loco import models

BODIES = ("walker", "humanoid")
SECTIONS = ("names", "sizes", "option", "source")


def compiled_fields():
    return [(body, field) for body in BODIES for field in reference_model(body) if field not in SECTIONS]


@pytest.mark.parametrize(("body", "field"), compiled_fields())
def test_field_agrees_with_dm_control(body, field):
    ours = np.asarray(getattr(models.load(body), field), dtype=float)
    theirs = np.asarray(reference_model(body)[field], dtype=float)
    assert ours.shape == theirs.shape or ours.size == theirs.size == 0
    np.testing.assert_allclose(ours.ravel(), theirs.ravel(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("body", BODIES)
def test_names_sizes_and_options_agree(body):
    model, reference = models.load(body), reference_model(body)
    for kind, names in reference["names"].items():
        assert [getattr(model, kind)(i).name for i in range(len(names))] == names
    for size, value in reference["sizes"].items():
        assert getattr(model, size) == value, size
    for option, value in reference["option"].items():
        np.testing.assert_allclose(getattr(model.opt, option), value, err_msg=option)


@pytest.mark.parametrize("body", BODIES)
def test_scene_is_shared(body):
    model = models.load(body)
    assert {model.camera(i).name for i in range(model.ncam)} == {"side", "back", "egocentric"}
    assert model.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert model.nlight == 1
    assert {model.material(i).name for i in range(model.nmat)} == {"floor", "skin", "skin_left"}


@pytest.mark.parametrize("body", BODIES)
def test_only_the_sensor_that_is_read(body):
    model = models.load(body)
    assert model.nsensor == 1
    assert model.sensor_type[0] == mujoco.mjtSensor.mjSENS_SUBTREELINVEL
    assert model.sensor_objid[0] == model.body("torso").id


def test_unknown_model():
    with pytest.raises(ValueError, match="walker, humanoid"):
        models.load("ant")
