"""The dynamics behind the compiled step, evaluated in float64, against C MuJoCo: as good as exact."""

import hypothesis
import mujoco
import numpy as np
import pytest
from cases import COMPILED, MODELS
from evaluate import evaluate
from for_each import for_each
from random_models import models

import torchrl_loco.sim.models
from torchrl_loco.sim.compiled import unsupported
from torchrl_loco.sim.compiled.ir.symbols import names
from torchrl_loco.sim.compiled.physics.dynamics import ArticulatedFactor, Dynamics

SETTINGS = {"deadline": None, "derandomize": True, "database": None, "phases": [hypothesis.Phase.generate]}
EXACT = {"rtol": 1e-9, "atol": 1e-9}


def assert_agrees(model, rng):
    symbols = {
        title: names(title, size) for title, size in (("qpos", model.nq), ("qvel", model.nv), ("ctrl", model.nu))
    }
    x = names("x", model.nv)
    tree = Dynamics(model, *symbols.values())
    factor = ArticulatedFactor(tree, [np.zeros((6, 6)) for _ in range(model.nbody)], [0.0] * model.nv)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:], data.ctrl[:] = rng.normal(size=model.nv), rng.uniform(-2, 2, model.nu)
    mujoco.mj_forward(model, data)
    values = {
        str(node.args[0]): value
        for title in symbols
        for node, value in zip(symbols[title], getattr(data, title), strict=True)
    }
    vector = rng.normal(size=model.nv)
    values |= {str(node.args[0]): value for node, value in zip(x, vector, strict=True)}

    def value(expression):
        return evaluate(expression, values)

    np.testing.assert_allclose(value(tree.poses.xpos), data.xpos, **EXACT)
    np.testing.assert_allclose(value(tree.poses.xmat).reshape(-1, 9), data.xmat, **EXACT)
    np.testing.assert_allclose(value(tree.cdof), data.cdof, **EXACT)
    np.testing.assert_allclose(value(tree.cvel), data.cvel, **EXACT)
    np.testing.assert_allclose(value(tree.force), data.qfrc_smooth, **EXACT)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    np.testing.assert_allclose(value(tree.mass_times(x)), mass @ vector, **EXACT)
    np.testing.assert_allclose(mass @ value(factor.solve(x)), vector, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@hypothesis.settings(max_examples=20, suppress_health_check=list(hypothesis.HealthCheck), **SETTINGS)
@hypothesis.given(models(max_bodies=5))
def test_random_models(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    hypothesis.assume(not unsupported(model))
    assert_agrees(model, np.random.default_rng(0))


@for_each("body", [task.split("_")[0] for task in COMPILED])
def test_our_bodies(body):
    assert_agrees(torchrl_loco.sim.models.load(MODELS[body]), np.random.default_rng(0))
