"""The package as a whole: imports go one way, and what takes seconds to import waits until it is asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_loco

ROOT = Path(torchrl_loco.__file__).parent
LAYERS = [  # a module imports from its own layer or from those before it
    {"checks", "conditions", "config", "garbage", "known_files", "lazy_compiler", "motion", "rewards", "storage"},
    {"terrain"},
    {"sim"},
    {"eyes"},
    {"envs", "viewer"},
    {"tasks"},
    {"registry", "collector"},
    {"encoder", "policy", "nan_dump", "doctor", "source", "wrappers"},
    {"export", "verify"},
    {"training"},
    {"cli", "__main__"},
]


def layer(module):
    return next(i for i, names in enumerate(LAYERS) if module in names)


def imports(path):
    """Yields what a file imports from the package, in functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        assert not (isinstance(node, ast.ImportFrom) and node.level), "relative imports would escape this check"
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "torchrl_loco":
            parts = node.module.split(".")[1:]
            yield from parts[:1] or [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("torchrl_loco."))


def test_imports_go_one_way():
    for path in sorted(ROOT.rglob("*.py")):
        own = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if own != "__init__":
            later = [module for module in imports(path) if layer(module) > layer(own)]
            assert not later, f"{path} imports {later}"


@pytest.mark.ci
def test_in_a_fresh_interpreter_without_the_extras(tmp_path):
    """A worker that unpickles imports the module that it needs before the rest."""
    code = """
import sys
for name in ("matplotlib", "tensorboard", "imageio", "av", "gymnasium", "rsl_rl", "stable_baselines3"):
    sys.modules[name] = None
import torchrl_loco
assert "walker_walk" in torchrl_loco.list_envs()
assert not hasattr(torchrl_loco, "mke")
assert not {"torch", "warp", "mujoco"} & set(sys.modules)
import pickle, torchrl_loco.registry as registry
assert pickle.loads(pickle.dumps(registry.make)) is torchrl_loco.make
assert torchrl_loco.envs.LocoEnv is torchrl_loco.LocoEnv
from torchrl_loco import *
import quickly
env = make("walker_walk", 1, "cpu")
assert RolloutCollector and training.PPOConfig("walker_walk")
assert torchrl_loco.wrappers.LIBRARIES
assert env.rollout(2, load_policy("walker_walk", "cpu")).shape == (1, 2)
assert "mujoco_warp" not in sys.modules
assert env.sim.model.opt.timestep.numpy() == env.config.sim_dt and "mujoco_warp" in sys.modules
for name in ("tensorboard", "imageio", "av"):
    del sys.modules[name]
try:
    training.Trainer
except ImportError as error:
    assert "matplotlib" in str(error) and "[train]" in str(error)
else:
    raise AssertionError("a trainer without matplotlib would fail at the end of its run")
from torchrl_loco.cli import main
main(["train", "walker_stand", "--device=cpu", "--out", sys.argv[1]])
"""
    command = [sys.executable, "-c", code, tmp_path / "runs"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parent)
    assert ended.returncode == 2, ended.stderr
    assert "pip install 'torchrl-loco[train]'" in ended.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.ci
def test_torchs_compiler_is_imported_when_somebody_compiles(tmp_path):
    """Not by a training or by hooks; what tensordict and TorchRL asked of it at their import is done then.

    Nor is sympy, of which its symbolic shapes are made: they are asked about plain numbers, which is answered alike.
    """
    code = """
import sys
import hook_tasks
import quickly
from torchrl_loco import training
sizes = {"num_envs": 4, "num_steps": 8, "minibatch_size": 16, "epochs": 1, "hidden": (8,), "total_frames": 256}
settings = {**sizes, "eval_episodes": 2, "video_seconds": 0.0, "logger": ("csv",)}
for algorithm in "ppo", "reppo":
    training.train("walker_stand", device="cpu", out=sys.argv[1], algorithm=algorithm, episode_length=40, **settings)
hook_tasks.FollowVelocity(4, "cpu", 0)
assert not {"torch._dynamo", "sympy"} & sys.modules.keys()
import torch, tensordict.base
from torch.fx.experimental import symbolic_shapes as stand_in
questions = {
    **dict.fromkeys(("expect_true", "guard_bool", "guard_or_false", "guard_size_oblivious"), [(True,), (False,)]),
    **dict.fromkeys(("guard_int", "guarding_hint_or_throw", "has_guarding_hint", "is_nested_int"), [(0,), (7,)]),
    **dict.fromkeys(("sym_and", "sym_or"), [(False, True), (True, True), (False,)]),
    "sym_eq": [((2, 3), torch.Size([2, 3])), ([2], [2, 3]), (4, 5)],
}
of_torch = {"__name__": "torch.functions"}
exec("def get(name): return getattr(module, name)", of_torch | {"module": stand_in}, of_torch)
answers = {(name, i): of_torch["get"](name)(*args) for name in questions for i, args in enumerate(questions[name])}
sym_eq, is_nested_int = map(of_torch["get"], ("sym_eq", "is_nested_int"))
assert "sympy" not in sys.modules
from torch.fx.experimental.symbolic_shapes import guard_or_false
real = sys.modules["torch.fx.experimental.symbolic_shapes"]
assert real is torch.fx.experimental.symbolic_shapes is not stand_in and stand_in.ShapeEnv is real.ShapeEnv
# Whoever keeps a function may compile it: functions of others and torch's modules at their import get the real one.
assert guard_or_false is real.guard_or_false and (lambda: stand_in.guard_or_true)() is real.guard_or_true
exec("kept = module.sym_and", at_import := {"__name__": "torch.module", "module": stand_in})
assert at_import["kept"] is real.sym_and
for (name, i), answer in answers.items():
    assert getattr(real, name)(*questions[name][i]) is answer, name
symbol = real.ShapeEnv().create_unbacked_symint()
assert isinstance(sym_eq((symbol, 2), (3, 2)), torch.SymBool) and is_nested_int(symbol) is False
from torchrl.modules.distributions import utils
before = torch.compiler.allow_in_graph, torch.compiler.disable
assert torch.compiler.disable(lambda x: x + 1.0)(torch.ones(())) == 2.0
assert torch.compiler.disable.__module__ == torch.compiler.allow_in_graph.__module__ == "torch.compiler"
from torch._dynamo import trace_rules
later = lambda x: x
assert before[0](later) is later and id(later) in trace_rules._allowed_callable_ids
assert before[1](fn=abs)(-2) == 2
assert id(tensordict.base._foreach_copy_) in trace_rules._allowed_callable_ids
assert any(getattr(value, "_dynamo_marked_constant", False) for value in vars(utils).values())
doubled = torch.compile(lambda x: 2 * x, backend="aot_eager", dynamic=True)
assert doubled(torch.ones(2)).sum() == 4.0 and doubled(torch.ones(3)).sum() == 6.0
"""
    command = [sys.executable, "-c", code, tmp_path]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parent)
    assert ended.returncode == 0, ended.stderr
