"""The house: import layers, size of files, versions, typing marker."""

import ast
import importlib
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import torchrl_loco
from torchrl_loco import _versions

ROOT = Path(torchrl_loco.__file__).parent
LAYERS = [  # a module imports from its own layer or from those before it
    {"config", "checks", "ids", "rewards", "models", "storage", "_lazy", "_versions"},
    {"sim"},
    {"rendering"},
    {"envs"},
    {"collector"},
    {"registry"},
    {"doctor", "policy", "replay"},
    {"training"},
    {"cli", "__main__"},
]


def layer(module):
    return next(i for i, names in enumerate(LAYERS) if module in names)


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        assert not (isinstance(node, ast.ImportFrom) and node.level), "relative imports would escape this check"
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "torchrl_loco":
            parts = node.module.split(".")[1:]
            yield from parts[:1] or [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("torchrl_loco."))


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_keep_to_their_layer_and_stay_small(path):
    own = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if own not in ("__init__", "_api"):
        assert all(layer(module) <= layer(own) for module in imports(path)), list(imports(path))
    assert len(path.read_text().splitlines()) <= 400


@pytest.mark.parametrize("body", ["walker", "humanoid"])
def test_a_body_is_one_file_under_250_lines(body):
    assert len((ROOT / "envs" / f"{body}.py").read_text().splitlines()) < 250


def test_typing_marker():
    assert (ROOT / "py.typed").exists()


def test_public_names_are_imported_when_they_are_asked_for():
    """In an interpreter of its own, where nothing was asked for before."""
    code = (
        "import sys, torchrl_loco\n"
        "assert 'torch' not in sys.modules\n"
        "assert set(torchrl_loco.__all__) <= set(dir(torchrl_loco))\n"
        "assert not hasattr(torchrl_loco, 'mke')\n"
        "assert torchrl_loco.envs.LocoEnv is torchrl_loco.LocoEnv\n"
        "from torchrl_loco import *\n"
        "assert make('walker_walk', 1, 'cpu').num_envs == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_module_may_be_imported_before_the_rest():
    """As unpickling does in a worker: what makes an environment is looked for in its module."""
    code = "import pickle, torchrl_loco.registry as r; assert pickle.loads(pickle.dumps(r.make)) is r.make"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize("package", [torchrl_loco, torchrl_loco.training], ids=lambda package: package.__name__)
def test_public_names_are_those_that_are_imported(package):
    own = {name for name in vars(package._api) if not name.startswith("_")}
    assert own == {*package.__all__} - {"__version__"} <= set(dir(package))


def test_public_names_have_docstrings():
    for name in torchrl_loco.__all__:
        if name != "__version__":
            assert getattr(torchrl_loco, name).__doc__, name


def test_untested_versions_are_named(monkeypatch):
    real = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "9.9.1" if name == "mujoco-warp" else real(name))
    with pytest.warns(UserWarning, match=r"tested with mujoco-warp 4\.0, not with the installed 9\.9\.1"):
        importlib.reload(torchrl_loco)
    monkeypatch.undo()
    _versions.warn_if_untested()  # silent: a warning is an error here


@pytest.mark.slow
def test_importing_needs_no_extra():
    """The environments work without what only training needs."""
    code = (
        "import sys\n"
        "for name in ('matplotlib', 'imageio', 'tyro'): sys.modules[name] = None\n"
        "import torchrl_loco\n"
        "torchrl_loco.list_envs()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
