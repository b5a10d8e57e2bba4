"""What is released, wheel and sdist: what is in them and that it works; and the files that describe the package."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import torch
import yaml
from cases import MODELS
from generate import address

import torchrl_loco
from hatch_build import absolute, urls
from torchrl_loco.config import SCENE

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAME = f"torchrl_loco-{torchrl_loco.__version__}"
UNRELEASED = {".ci/run"}  # for our own CI alone

TRY = """
import sys
from pathlib import Path

import torchrl_loco

assert Path(torchrl_loco.__file__).is_relative_to(sys.argv[1]), torchrl_loco.__file__
env = torchrl_loco.make("walker_walk", num_envs=2, device="cpu", seed=0)
policy = torchrl_loco.load_policy("walker_walk", device="cpu")
random, trained = (env.rollout(50, by)["next", "reward"].mean() for by in (None, policy))
assert trained > 2 * random, (trained, random)
print(torchrl_loco.__version__)
"""


def run(*command, cwd, path=None):
    """Runs a command in a folder, with one folder on Python's path at most, and returns what it prints."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment |= {} if path is None else {"PYTHONPATH": str(path)}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with wheel and sdist, made by the build backend."""
    path = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "--directory", str(path), cwd=ROOT)
    return path


def files_below(path):
    return {file.relative_to(ROOT).as_posix() for file in path.rglob("*") if file.is_file() and file.suffix != ".pyc"}


@pytest.mark.ci
def test_wheel_holds_the_package_and_nothing_else(built):
    with zipfile.ZipFile(built / f"{NAME}-py3-none-any.whl") as wheel:
        names, info = set(wheel.namelist()), f"{NAME}.dist-info"
        metadata = wheel.read(f"{info}/METADATA").decode()
        entry_points = wheel.read(f"{info}/entry_points.txt").decode()
    inside = {name for name in names if not name.startswith(info)}
    assert inside == files_below(ROOT / "torchrl_loco")
    assert {path.relative_to(ROOT).as_posix() for path in [*MODELS.values(), SCENE]} < inside
    assert {f"torchrl_loco/policies/playground/walker_{goal}.safetensors" for goal in ("stand", "walk", "run")} < inside
    assert "torchrl_loco/py.typed" in inside
    assert {f"{info}/licenses/LICENSE", f"{info}/licenses/NOTICE"} < names
    assert f"\nVersion: {torchrl_loco.__version__}\n" in metadata
    assert "# torchrl_loco" in metadata  # the README
    assert "torchrl-loco = torchrl_loco.cli:main" in entry_points
    assert f"\nAuthor: {PROJECT['authors'][0]['name']}\n" in metadata
    checked = run(sys.executable, "-m", "twine", "check", "--strict", *map(str, built.iterdir()), cwd=built)
    assert checked.count("PASSED") == 2, checked


def test_what_follows_from_an_address():
    """Links of the README that work on the package index, its pages, badges, and notebooks in Colab."""
    public = "https://github.com/Someone/loco"
    text = absolute((ROOT / "README.md").read_text(), public, "v1.2.3")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert all(link.startswith("https://") for link in links), links
    assert f"({public}/raw/v1.2.3/docs/_static/runners.webp)" in text
    assert f"({public}/blob/v1.2.3/docs/benchmarks.md)" in text
    assert urls(public)["Documentation"] == "https://someone.github.io/loco/"
    assert f"{public}/actions/workflows/test.yml/badge.svg" in address.badges(public)
    assert "colab.research.google.com/github/Someone/loco/blob/main/notebooks/planning.ipynb" in address.colab(public)
    assert (urls(""), address.badges(""), address.colab("")) == ({}, "", "")


@pytest.mark.ci
def test_sdist_holds_the_repository(built, tmp_path):
    with tarfile.open(built / f"{NAME}.tar.gz") as sdist:
        names = {name.removeprefix(f"{NAME}/") for name in sdist.getnames()}
        sdist.extractall(tmp_path, filter="data")
    unpacked = tmp_path / NAME
    assert (unpacked / "PKG-INFO").is_file()
    for folder in ("torchrl_loco", "tests", "benchmarks", "docs", "examples"):
        assert (unpacked / folder).is_dir(), folder
    if (ROOT / ".git").exists():  # the tests may run from an sdist themselves
        tracked = set(run("git", "ls-files", cwd=ROOT).splitlines())
        missing = {name for name in tracked if (ROOT / name).exists()} - names
        assert {
            name for name in missing if not name.endswith(".webp")
        } <= UNRELEASED  # nothing but the site reads those

    # Tests find in it what they need: the package, its files, the example.
    chosen = ["tests/test_package.py", "tests/test_packaging.py", "tests/test_benchmarks.py", "tests/test_extending.py"]
    out = run(sys.executable, "-m", "pytest", "-q", "-m", "not slow and not ci", *chosen, cwd=unpacked)
    assert re.search(r"\d{2,} passed", out), out


@pytest.mark.ci
def test_wheel_works_on_its_own(built, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    options = ["--quiet", "--no-index", "--no-deps", "--target", str(site)]
    run(sys.executable, "-m", "pip", "install", *options, str(built / f"{NAME}-py3-none-any.whl"), cwd=elsewhere)
    assert run(sys.executable, "-c", TRY, str(site), cwd=elsewhere, path=site).strip() == torchrl_loco.__version__
    for command in (["-m", "torchrl_loco"], [str(site / "bin" / "torchrl-loco")]):
        listed = run(sys.executable, *command, "list", cwd=elsewhere, path=site).splitlines()
        assert [line.split()[0] for line in listed[:6]] == torchrl_loco.list_envs()[:6]


def test_citation_agrees_with_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == torchrl_loco.__version__
    assert citation["license"] == PROJECT["license"]
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation.get("repository-code", "") == address.ADDRESS
    assert all(citation[key] for key in ("message", "title", "authors"))


@pytest.mark.ci
def test_extras_combine():
    """All of them at once, and so any two, as pip resolves them; torch is that of here."""
    extras = ",".join(PROJECT["optional-dependencies"])
    torch_here = f"torch=={torch.__version__.partition('+')[0]}"
    command = sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet"
    run(*command, torch_here, f"{ROOT}[{extras}]", cwd=ROOT)
