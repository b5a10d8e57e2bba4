"""The documentation: its code runs, its figures are the package's, the site builds, docstrings are complete."""

import contextlib
import doctest
import inspect
import io
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from generate import benchmarks, bodies, rewards
from oracle import tolerance
from sphinx.pycode import ModuleAnalyzer
from sybil import Example, Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown import CodeBlockParser

import torchrl_loco
from torchrl_loco import models, registry, training
from torchrl_loco.envs import LocoEnv

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
HIDDEN = {"_build", "generated"}
PAGES = sorted(path for path in DOCS.rglob("*.md") if not HIDDEN & set(path.relative_to(DOCS).parts))
WITH_CODE = [path for path in [ROOT / "README.md", *PAGES] if "```python" in path.read_text()]

# What code in the documentation runs.

run_python = PythonEvaluator()


def run_block(example: Example):
    """Runs a block of Python and keeps what it prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        run_python(example)
    example.namespace["_printed"] = printed.getvalue()


def compare_output(example: Example):
    """Compares a block of text with what the block of Python before it has printed."""
    printed = example.namespace.pop("_printed", None)
    if printed is None:  # no Python before it
        return
    expected, printed = str(example.parsed).strip(), printed.strip()
    if expected != printed:
        raise AssertionError(f"{example.path}, line {example.line}: expected\n{expected}\nbut it printed\n{printed}")


PARSER = Sybil([CodeBlockParser("python", run_block), CodeBlockParser("text", compare_output)])


@pytest.mark.slow
@pytest.mark.parametrize("path", WITH_CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_code_runs_and_prints_what_the_page_says(path, tmp_path, monkeypatch):
    """All blocks of a page, in order, in one namespace and an empty folder."""
    monkeypatch.chdir(tmp_path)
    for example in PARSER.parse(path).examples():
        example.evaluate()


# What tables and formulas say.


def scattered(task, protocol):
    """An environment that has tumbled for a while, and the C MuJoCo data of each of its worlds."""
    env = torchrl_loco.make(task, 6, "cpu", seed=3, protocol=protocol, reward_terms=True)
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    for _ in range(20):
        action = torch.rand(env.action_spec.shape, generator=generator) * 2 - 1
        after = env.step(td.set("action", action))["next"]
        td = after.exclude("reward", "reward_terms")
    model = models.load(env.body)
    worlds = [mujoco.MjData(model) for _ in range(env.num_envs)]
    for data, qpos, qvel, ctrl in zip(worlds, env.sim.qpos, env.sim.qvel, action, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, data)
    return after, worlds


@pytest.mark.parametrize("body", ["walker", "humanoid"])
def test_every_entry_of_the_observation_tables(body, protocol):
    after, worlds = scattered(f"{body}_walk", protocol)
    entries = bodies.observation(body, protocol)
    expected = np.array([[entry.value(data) for entry in entries] for data in worlds])
    np.testing.assert_allclose(after["observation"], expected, rtol=0, atol=2e-4)


def test_reward_formulas(task):
    """The numbers in the formulas of the pages, put together as the pages do, give the terms of the reward."""
    after, worlds = scattered(task, "playground")
    parts = rewards.tolerances(task)

    def tol(name, x):
        part = parts[name]
        return float(np.mean(tolerance(x, part.lower, part.upper, part.margin, part.sigmoid, part.value)))

    for world, data in enumerate(worlds):
        vx, vy, _ = data.sensordata
        u = data.body("torso").xmat[8]
        if "fast" in parts:
            speed = vx if task.startswith("walker") else np.hypot(vx, vy)
            move = (1 + 5 * tol("fast", speed)) / 6
        if task.startswith("walker"):
            terms = [(3 * tol("standing", data.body("torso").xpos[2]) + (1 + u) / 2) / 4]
            terms += [move] if "fast" in parts else []
        else:
            if "fast" not in parts:
                move = (tol("still_x", vx) + tol("still_y", vy)) / 2
            control = (4 + tol("gentle", data.ctrl)) / 5
            terms = [tol("standing", data.body("head").xpos[2]), tol("upright", u), control, move]
        seen = [after["reward_terms", name][world].item() for name in registry.ENVS[task].term_names]
        np.testing.assert_allclose(seen, terms, rtol=0, atol=2e-4)


def test_new_results_appear_by_themselves(tmp_path):
    folder = tmp_path / "benchmarks" / "results" / "2027-01-02-toaster"
    folder.mkdir(parents=True)
    (folder / "new.csv").write_text("task,mean\nwalker_walk,12.5\n")
    text = benchmarks.all_results(folder.parent)
    assert "## toaster, 2027-01-02" in text
    assert "| walker_walk | 12.5 |" in text


# The site.


@pytest.mark.slow
def test_site_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", DOCS, tmp_path / "html"]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert built.returncode == 0, built.stderr
    for task in torchrl_loco.list_envs():
        page = (tmp_path / "html" / "tasks" / f"{task}.html").read_text()
        assert f"mjx/{task}-v0" in page
        assert f"{task}.png" in page


# Docstrings: ruff's rules (pyproject.toml) ask for their existence, results and errors, tests/test_docstrings.py for
# shapes and units; arguments are asked for here.


def public():
    """The public names, and the public methods of public classes that are the package's own."""
    for module in (torchrl_loco, training):
        names = getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")])
        for name in names:
            thing = getattr(module, name)
            if not getattr(thing, "__module__", "").startswith("torchrl_loco"):
                continue
            yield f"{module.__name__}.{name}", thing
    yield "torchrl_loco.envs.LocoEnv", LocoEnv


def documented():
    for name, thing in dict(public()).items():
        yield pytest.param(thing, id=name)
        if inspect.isclass(thing):
            for key, method in vars(thing).items():
                if not key.startswith("_") and inspect.isfunction(inspect.unwrap(getattr(method, "__func__", method))):
                    yield pytest.param(getattr(thing, key), id=f"{name}.{key}")


def test_example_of_make():
    result = doctest.testmod(registry, extraglobs={"torchrl_loco": torchrl_loco})
    assert result.attempted > 0
    assert not result.failed


@pytest.mark.parametrize("thing", list(documented()))
def test_docstring_names_every_argument(thing):
    """Under Args, or in ``quotes`` where a sentence says all."""
    doc = vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__
    assert doc, "no docstring"
    told = set()  # what has a docstring of its own: fields of a dataclass
    if inspect.isclass(thing):
        for cls in thing.__mro__:
            if cls.__module__.startswith("torchrl_loco"):
                told |= {name for _, name in ModuleAnalyzer.for_module(cls.__module__).find_attr_docs()}
        thing = vars(thing).get("__init__")
    if thing is None:  # made like its base
        return
    doc = inspect.cleandoc(doc)
    for name in inspect.signature(thing).parameters:
        if name not in {"self", "cls", "args", "kwargs"} | told:
            assert f"\n    {name}: " in doc or f"``{name}``" in doc, f"{name} is not explained"
