"""What only CUDA reads of the headers of lanes, on a CPU: the 32 lanes of a warp agree with the one there."""

import ctypes
import pathlib
import re
import shutil
import subprocess

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

import torchrl_loco
from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled import step
from torchrl_loco.sim.compiled.engine import LATER

COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
WORLDS, MOTION = 16, 100
WAITING = r"(INLINE \w+ (?:sync|ballot|any_of_block|read|agreed|sum|sum_below|largest)\()(.*)\) const"
PTX = {
    r'asm\("div\..*': "x = a / b;",
    r'asm\("rcp\..*': "x = 1.0f / a;",
    r'asm\("rsqrt\..*': "y = 1.0f / sqrtf(larger(x, 1e-30f));",
    r'asm\("min\..*': "x = b < a ? b : a;",
    r'asm\("max\..*': "x = a < b ? b : a;",
}

STIFF_LINK = """<body pos="{x} 0 {z}"><joint axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 {to} 0 -{down}" size="0.02" mass="{mass}" condim="1" solimp="0.999 0.999 0.001"/>"""
STIFF = f"""<mujoco><option timestep="0.002" iterations="50"><flag eulerdamp="disable"/></option><worldbody>
<geom type="plane" size="5 5 1" condim="1" solimp="0.999 0.999 0.001"/>
{STIFF_LINK.format(x=0, z=0.55, to=0.175, down=0.175, mass=1)}
{STIFF_LINK.format(x=0.175, z=-0.175, to=-0.175, down=0.175, mass=1)}
{STIFF_LINK.format(x=-0.175, z=-0.175, to=0.14, down=0.14, mass=1)}
{STIFF_LINK.format(x=0.14, z=-0.14, to=-0.077, down=0.077, mass=0.1)}
</body></body></body></body></worldbody></mujoco>"""

SEEN = {
    "go1_velocity": {"qpos": 5.5e-7, "qvel": 2.8e-5, "contact_force": 1.6e-3},
    "g1_velocity": {"qpos": 7.7e-7, "qvel": 2.6e-5, "contact_force": 4.4e-2},
    "humanoid_walk": {"qpos": 3.3e-6, "qvel": 3.2e-4},
}
"""Errors (SI) of the second worst of 16 worlds, the largest of 50 control steps. About one world in 1000 meets a branch
of the limited solver, where rounding decides, and differs more."""
ALIKE = {"xpos": "qpos", "xmat": "qpos", "subtree_com": "qpos", "cvel": "qvel", "sensordata": "qvel"}
MARGIN = 3


class Array(ctypes.Structure):
    _fields_ = (("data", ctypes.c_void_p), ("shape", ctypes.c_int * 2))


def built(text, folder):
    """Returns a library that steps a world with 32 lanes, from the text of a control step."""
    for ptx, same in PTX.items():
        text, count = re.subn(ptx, same, text)
        assert count == 1
    text = re.sub(WAITING, lambda m: f"{m[1]}{m[2]}{', ' if m[2] else ''}int line = __builtin_LINE()) const", text)
    folder.mkdir()  # a library that is loaded is not loaded again from the same file
    (folder / "step.inc").write_text(text)
    source, library = pathlib.Path(__file__).with_name("lanes_on_a_cpu.cpp"), folder / "step.so"
    subprocess.run([COMPILER, "-std=c++17", "-w", "-fPIC", "-shared", f"-I{folder}", "-o", library, source], check=True)
    return ctypes.CDLL(str(library))


def stepped(library, text, before, *, last_first):
    """Returns the arrays after a step of all worlds. The first lane and world begin, or the last ones."""
    arrays = {name: array.copy() for name, array in before.items()}
    for name, array in arrays.items():
        Array.in_dll(library, name).data = array.ctypes.data
        Array.in_dll(library, name).shape[:] = (*array.shape, 1)[:2]
    lines = (ctypes.c_int * 32).in_dll(library, "lines")
    for world in range(WORLDS)[:: -1 if last_first else 1]:
        library.step_world(world, ctypes.c_bool(last_first))
        assert not any(lines), f"lanes part: they wait at {[line and text.splitlines()[line - 1] for line in lines]}"
    return arrays


def with_lanes(sim, folder):
    """Returns the library of a simulation's step, its text, what it begins with, and where the simulation writes."""
    engine, outputs = sim.engine, sim.engine.data.outputs()
    with_cvel, with_com = (outputs[name] is not None for name in LATER)
    asked = step.Asked(with_cvel, with_com, engine._contact_geoms, engine._contact_rows)
    text = step.source(engine._mj_model, engine._substeps, **asked._asdict())
    outputs = {name: array.numpy() for name, array in outputs.items() if array is not None and array.size}
    before = {"ctrl_in": engine.data.ctrl.numpy(), "terrain_in": engine._terrain.numpy()}
    before["numbers_out"] = engine._rows.numpy()
    before |= {f"{name}_out": array.copy() for name, array in outputs.items()}
    return built(text, folder), text, before, outputs


@pytest.mark.ci
@pytest.mark.skipif(COMPILER is None, reason="needs a compiler of C++: c++, g++ or clang++")
@for_each("task", SEEN)
def test_the_lanes_of_a_warp_agree_with_one_lane(task, actions, tmp_path):
    """Nor do they part, or race: in the opposite order they do the same, bit for bit."""
    env = torchrl_loco.make(task, WORLDS, "cpu", seed=0, stagger=True)
    state = env.reset()
    for action in actions(env, MOTION):
        state = env.step_and_maybe_reset(state.set("action", action))[1]
    library, text, before, outputs = with_lanes(env.sim, tmp_path / task)
    env.sim.step()  # into outputs
    after = stepped(library, text, before, last_first=False)
    for name, array in stepped(library, text, before, last_first=True).items():
        np.testing.assert_array_equal(array, after[name], name)
    for name, expected in outputs.items():
        error = np.abs(after[f"{name}_out"].astype(float) - expected).reshape(WORLDS, -1).max(axis=1)
        if name in ("time", "in_contact", "overflow"):
            assert not error.any(), name
        elif name != "qacc_warmstart":
            assert np.sort(error)[-2] < MARGIN * SEEN[task][ALIKE.get(name, name)], name


@pytest.mark.ci
@pytest.mark.skipif(COMPILER is None, reason="needs a compiler of C++: c++, g++ or clang++")
def test_stiff_contacts_of_coupled_hinges(monkeypatch, tmp_path):
    """Four parallel hinges whose links press on each other and the ground, beside C MuJoCo."""
    monkeypatch.setattr(step, "TRACED_DOFS", 0)
    model, generator = mujoco.MjModel.from_xml_string(STIFF), np.random.default_rng(0)
    sim = Simulation(model, SimConfig(ctrl_dt=0.002, sim_dt=0.002, engine="compiled"), WORLDS, torch.device("cpu"))
    expected = []
    for world in range(WORLDS):
        data = mujoco.MjData(model)
        data.qvel[:] = 0.1 * generator.normal(size=model.nv)
        for _ in range(generator.integers(200)):
            mujoco.mj_step(model, data)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(sim, name)[world] = torch.from_numpy(getattr(data, name))
        mujoco.mj_step(model, data)
        expected.append(data.qvel.copy())
    library, text, before, _ = with_lanes(sim, tmp_path / "hinges")
    found = stepped(library, text, before, last_first=False)["qvel_out"]
    assert np.abs(found - expected).max() < 5e-4
