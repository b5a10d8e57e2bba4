"""The documentation: its code runs, its tables and formulas are the package's, the site builds."""

import contextlib
import doctest
import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from cases import BODIES, PROTOCOLS
from for_each import for_each
from generate import benchmarks, bodies, rewards, robots
from generate.tasks import RUNNERS
from oracle import tolerance
from sybil import Example, Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown import CodeBlockParser

import torchrl_loco
from benchmarks.robots import KEPT, write_metrics
from torchrl_loco import registry
from torchrl_loco.registry import env_class

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
HIDDEN = {"_build", "generated"}
PAGES = sorted(path for path in DOCS.rglob("*.md") if not HIDDEN & set(path.relative_to(DOCS).parts))
WITH_CODE = [path for path in [ROOT / "README.md", *PAGES] if "```python" in path.read_text()]
NEEDS = {
    "docs/api/wrappers.md": ("gymnasium", "moviepy", "rsl_rl", "stable_baselines3"),
    "docs/guides/viewer.md": ("mjviser",),
}
"""Pages whose code needs packages that not every installation has."""
FILES = {"docs/guides/your-own-robot.md": ["solo12.urdf"]}
"""Files beside pages that their code reads."""

# The code.

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


def page(path):
    name = str(path.relative_to(ROOT))
    return pytest.param(path, id=name, marks=pytest.mark.slow if name == "README.md" else pytest.mark.ci)


@pytest.mark.filterwarnings("ignore:.*autoreset mode is same-step")  # Gymnasium's, as the page says
@pytest.mark.parametrize("path", [page(path) for path in WITH_CODE])
def test_code_runs_and_prints_what_the_page_says(path, tmp_path, monkeypatch):
    """All blocks of a page, in order, in one namespace and a folder with the files that it offers."""
    for file in FILES.get(str(path.relative_to(ROOT)), ()):
        shutil.copy(path.with_name(file), tmp_path)
    for package in NEEDS.get(str(path.relative_to(ROOT)), ()):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    for example in PARSER.parse(path).examples():
        example.evaluate()


# The tables and formulas.


def scattered(env, actions):
    """Returns the last step of worlds that have tumbled for a while, and the C MuJoCo data of each world."""
    td = env.reset()
    for action in actions(env, 20):
        after = env.step(td.set("action", action))["next"]
        td = after.exclude("reward", "reward_terms")
    worlds = [mujoco.MjData(env.mj_model) for _ in range(env.num_envs)]
    for data, qpos, qvel, ctrl in zip(worlds, env.sim.qpos, env.sim.qvel, action, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(env.mj_model, data)
    return after, worlds


@pytest.mark.slow
@for_each("body_task", BODIES)
def test_every_entry_of_the_observation_tables(body_task, shared, actions):
    for protocol in PROTOCOLS:
        env = shared(body_task, 6, "cpu", 3, protocol=protocol, reward_terms=True)
        after, worlds = scattered(env, actions)
        entries = bodies.observation(env.body, protocol)
        assert len(entries) == env.observation_size
        known = [i for i, entry in enumerate(entries) if entry.value]  # the others are in test_fidelity
        expected = np.array([[entries[i].value(data) for i in known] for data in worlds])
        np.testing.assert_allclose(after["observation"][:, known], expected, rtol=0, atol=2e-4)


@pytest.mark.slow
@for_each("body_task", BODIES)
def test_reward_formulas(body_task, shared, actions):
    """The numbers in the formulas of the pages, put together as the pages do, give the terms of the reward."""
    body = env_class(body_task).body
    for task in RUNNERS:
        if env_class(task).body == body:
            env = shared(task, 6, "cpu", 3, protocol="playground", reward_terms=True)
            check_terms(task, rewards.reward(task).parts, *scattered(env, actions))


def check_terms(task, parts, after, worlds):

    def tol(name, x):
        part = parts[name]
        return float(np.mean(tolerance(x, part.lower, part.upper, part.margin, part.sigmoid, part.value)))

    def walker(d):
        yield (3 * tol("standing", d.body("torso").xpos[2]) + (1 + d.body("torso").xmat[8]) / 2) / 4
        if "fast" in parts:
            yield (1 + 5 * tol("fast", d.sensordata[0])) / 6

    def humanoid(d):
        vx, vy, _ = d.sensordata
        yield tol("standing", d.body("head").xpos[2])
        yield tol("upright", d.body("torso").xmat[8])
        yield (4 + tol("gentle", d.ctrl)) / 5
        moving = "fast" in parts
        yield (1 + 5 * tol("fast", np.hypot(vx, vy))) / 6 if moving else (tol("still_x", vx) + tol("still_y", vy)) / 2

    def cheetah(d):
        yield tol("fast", d.sensordata[0])

    def hopper(d):
        yield tol("standing", d.body("torso").xipos[2] - d.body("foot").xipos[2])
        yield tol("fast", d.sensordata[0]) if "fast" in parts else (4 + tol("gentle", d.ctrl)) / 5

    def quadruped(d):
        yield tol("upright", d.body("torso").xmat[8])
        yield tol("fast", d.sensor("velocimeter").data[0])

    terms_of = {terms.__name__: terms for terms in (walker, humanoid, cheetah, hopper, quadruped)}[env_class(task).body]
    for world, data in enumerate(worlds):
        terms = list(terms_of(data))
        seen = [after["reward_terms", name][world].item() for name in env_class(task).term_names]
        np.testing.assert_allclose(seen, terms, rtol=0, atol=2e-4)


def test_tables_are_those_of_the_results():
    """Or ``make tables`` is due."""
    for path in benchmarks.PAGES:
        assert benchmarks.filled(path.read_text()) == path.read_text(), path


def test_robots_have_the_mean_and_the_worst_of_their_seeds_beside_mjlab(tmp_path):
    seeds = [
        {"task": "go1_velocity", "algorithm": "ppo", "run": f"run{seed}", "frames/s": rate, "to mjlab's (s)": seconds}
        | {
            "device": "NVIDIA H100 80GB HBM3",
            "episodes": 256,
            "falls": falls,
            "error (m/s)": 0.1,
            "falls, on time": 0,
            "falls, training simulator": 1,
        }
        for seed, (rate, seconds, falls) in enumerate([(4.2e6, 8.0, 0), (4.0e6, 9.0, 3), (4.1e6, None, 0)])
    ]
    (tmp_path / "results.json").write_text(json.dumps({"rows": seeds}))
    for seed in range(3):
        (tmp_path / f"run{seed}").mkdir()
        lines = ((1, 100, 30.0, -3.0, 1000, 0), (2, 200, 32.0, 5.0, 100, 10), (3, 300, 42.0, 70.0, 990, 50))
        metrics = [dict(zip(KEPT, line, strict=True)) for line in lines]
        write_metrics(tmp_path / f"run{seed}", metrics)
    made = robots.tables([tmp_path])
    assert "| Go1 | torchrl_loco, PPO | H100 | 3 | 4.1 (4) | 8.5 (9.0), 1 without |" in made["robots-training"]
    assert "| Go1 | torchrl_loco, PPO | H100 | 3 | 1.0 (3.0) | 0.100 | 0.0 | 1.0 |" in made["robots-verified"]


# The site.


@pytest.mark.ci
def test_site_builds_without_warnings():
    """It is left in docs/_build/html, as by ``make docs``."""
    html = DOCS / "_build" / "html"
    anew = ["-E", "-a"]  # all pages: else their warnings are not repeated
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", *anew, "-b", "html", DOCS, html]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert built.returncode == 0, built.stderr
    for task in RUNNERS:
        page = (html / "tasks" / f"{task}.html").read_text()
        assert f"{task}.webp" in page
        assert (html / "_images" / f"{task}.webp").is_file()
        for script in re.findall(r'<script[^>]* src="([^"]+)"', page):  # formulas among others need no network
            assert (html / "tasks" / script.split("?")[0]).resolve().is_file(), script


def test_links_of_pages_that_only_github_shows():
    pages = [*ROOT.glob("*.md"), *(ROOT / "benchmarks").rglob("*.md"), *(ROOT / "notebooks").glob("*.md")]
    for path in pages:
        links = re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text())
        broken = [link for link in links if not (path.parent / link).exists()]
        assert not broken, f"{path.relative_to(ROOT)} links to what is not there: {', '.join(broken)}"


def test_example_of_make():
    result = doctest.testmod(registry, extraglobs={"torchrl_loco": torchrl_loco})
    assert result.attempted > 0
    assert not result.failed
