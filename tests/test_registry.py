"""From an id to an environment with the documented settings. Plug-ins are in test_extending.py."""

import dataclasses
import functools
import importlib
import itertools
import json
import runpy
import sys

import pytest
import torch
from cases import CONFIGS

import torchrl_loco
from torchrl_loco import list_envs, make, registry
from torchrl_loco.config import sim_config

GOALS = {
    "walker": ("stand", "walk", "run"),
    "humanoid": ("stand", "walk", "run"),
    "cheetah": ("run",),
    "hopper": ("stand", "hop"),
    "quadruped": ("walk", "run"),
}


def test_our_environments():
    tasks = [f"{body}_{goal}" for body, goals in sorted(GOALS.items()) for goal in goals]
    robots = [f"{robot}_{what}" for robot in ("go1", "go2", "g1", "h1") for what in ("velocity", "rough")]
    robots += ["g1_tracking", "g1_tracking_no_estimation", "h1_tracking"]
    assert list_envs()[: len(registry.OURS)] == list(registry.OURS)
    assert set(registry.OURS) == {*tasks, *robots}
    for task in tasks:
        cls = registry.env_class(task)
        assert cls is registry.env_class(f"mjx/{task}-v0") is getattr(torchrl_loco, task.title().replace("_", ""))
        assert cls is registry.resolve(task) is registry.resolve(cls)
        assert task == registry.task_name(task) == registry.task_name(cls) == registry.task_name(f"mjx/{task}-v0")
        assert registry.summary(task) == cls.__doc__.split("\n")[0]


def test_every_field_can_be_overridden():
    changed = {
        "ctrl_dt": 0.05,
        "sim_dt": 0.005,
        "naconmax": 777,
        "njmax": 60,
        "iterations": 3,
        "ls_iterations": 4,
        "euler_damping": True,
        "integrator": "euler",
        "contacts": "ground",
        "solids_on_terrain": "spheres",
        "episode_length": 11,
        "deterministic": True,
        "engine": "mujoco_warp",
    }
    env = make("walker_walk", 2, "cpu", **changed)
    assert dataclasses.asdict(env.config) == changed
    assert env.sim.data.naconmax == 777
    assert env.sim.data.njmax == 60
    assert env.config.substeps == 10
    assert env.rollout(20).shape == (2, 11)


def test_what_torchrl_would_take_from_the_arguments_is_refused():
    """Its ``auto_reset`` is for environments that reset themselves within a step."""
    with pytest.raises(ValueError, match="auto_reset is no argument: step_and_maybe_reset"):
        make("walker_walk", 2, "cpu", auto_reset=True)


def test_arguments_of_other_libraries_get_a_hint():
    walker_walk = functools.partial(make, "walker_walk")
    for of, (name, instead) in itertools.product(
        [walker_walk, registry.resolve("walker_walk")],
        [("frame_skip", "ctrl_dt"), ("render_mode", "wrappers")],
    ):
        with pytest.raises(ValueError, match=f"{name} is no argument: .*{instead}"):
            of(num_envs=2, device="cpu", **{name: 2})


def test_a_class_may_take_an_argument_of_another_library():
    class Framed(torchrl_loco.WalkerWalk):
        def __init__(self, *args, frame_skip, **settings):
            super().__init__(*args, ctrl_dt=frame_skip * self.config.ctrl_dt, **settings)

    assert make(Framed, 1, "cpu", frame_skip=2).config.ctrl_dt == 2 * Framed.config.ctrl_dt


# Classes of users.


@pytest.fixture
def nothing_added(monkeypatch):
    """What is registered or named in a test is forgotten."""
    monkeypatch.setattr(registry, "_added", {})
    monkeypatch.setattr(registry, "_named", {})
    monkeypatch.setattr(registry, "_folders", set())


def walk_slowly(name="WalkSlowly"):
    class WalkSlowly(torchrl_loco.WalkerWalk):
        """Walk slowly.

        No faster.
        """

        target_speed = 0.5

    WalkSlowly.__qualname__ = name
    return WalkSlowly


def test_register(nothing_added):
    cls = walk_slowly()
    assert torchrl_loco.register("walk_slowly", cls) is None
    assert list_envs() == [*registry.installed(), "walk_slowly"]
    assert registry.env_class("walk_slowly") is registry.resolve("walk_slowly") is cls
    assert registry.summary("walk_slowly") == "Walk slowly."
    assert type(make("walk_slowly", 2, "cpu")) is cls is type(make(cls, 2, "cpu"))
    again = walk_slowly()  # as when a cell of a notebook runs again
    torchrl_loco.register("walk_slowly", again)
    torchrl_loco.register("walk_slowly", again)
    assert registry.env_class("walk_slowly") is again
    torchrl_loco.register("walker_walk", torchrl_loco.WalkerWalk)  # changes nothing
    assert list_envs() == [*registry.installed(), "walk_slowly"]


def test_what_register_refuses(nothing_added):
    torchrl_loco.register("walk_slowly", walk_slowly())
    for id in ("walk slowly", "mjx/walker_walk-v0", "walk.py:Slowly", "", 3):
        with pytest.raises(ValueError, match="an id consists of letters, digits"):
            torchrl_loco.register(id, walk_slowly())
    for id, owner in (("walker_walk", "tasks.walker:WalkerWalk"), ("walk_slowly", ":WalkSlowly")):
        with pytest.raises(ValueError, match=f"{id!r} is taken by .*{owner}: choose another than cheetah_run"):
            torchrl_loco.register(id, walk_slowly("Other"))
    for thing in (dict, "walker_walk", torch.nn.Module, None):
        with pytest.raises(TypeError, match=r"no subclass of torchrl_loco\.LocoEnv"):
            torchrl_loco.register("thing", thing)
    with pytest.raises(TypeError, match="must set"):
        torchrl_loco.register("empty", type("Empty", (torchrl_loco.LocoEnv,), {}))
    assert list_envs() == [*registry.installed(), "walk_slowly"]


SLOWLY = """
import numbers_beside
from torchrl_loco import WalkerWalk

class Base(WalkerWalk):
    pass

class Slowly(Base):
    target_speed = numbers_beside.SPEED

count = globals().get("count", 0) + 1
"""


@pytest.fixture
def file(tmp_path, nothing_added, monkeypatch):
    with torch.device("cpu"):  # torch imports a module for it that must stay
        pass
    monkeypatch.setattr(sys, "path", sys.path.copy())
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    (tmp_path / "numbers_beside.py").write_text("SPEED = 0.25")
    path = tmp_path / "walk-slowly.py"
    path.write_text(SLOWLY)
    return path


def test_a_class_in_a_file(file, monkeypatch):
    """The file runs once, by whatever name; its neighbours can be imported."""
    cls = registry.resolve(f"{file}:Slowly", by_user=True)
    assert cls.target_speed == 0.25
    assert issubclass(cls, torchrl_loco.WalkerWalk)
    monkeypatch.chdir(file.parent)
    assert registry.resolve("walk-slowly.py:Slowly") is registry.resolve(f"./{file.name}:Slowly") is cls
    assert registry.task_name("walk-slowly.py:Slowly") == registry.task_name(cls) == f"{file}:Slowly"
    assert registry.summary("walker_walk") == "Walk at 1 m/s or faster."
    torchrl_loco.register("slowly", cls)  # other processes do not know this id
    assert registry.task_name("slowly") == f"{file}:Slowly"
    assert make("walk-slowly.py:Slowly", 2, "cpu").target_speed == 0.25


def test_a_class_in_a_module(nothing_added, monkeypatch):
    assert registry.resolve("torchrl_loco:WalkerWalk") is torchrl_loco.WalkerWalk
    assert registry.task_name("torchrl_loco:WalkerWalk") == "walker_walk"
    cls = walk_slowly()
    assert registry.task_name(cls) == f"{__name__}:WalkSlowly"
    with pytest.raises(ValueError, match=f"{__name__} has no class 'Walk': it defines no subclass"):
        registry.resolve(f"{__name__}:Walk")
    assert registry.resolve(registry.task_name(cls)) is cls  # in this process
    monkeypatch.setattr(registry, "_named", {})  # as in another one
    with pytest.raises(ValueError, match=f"{__name__} has no class 'WalkSlowly'"):
        registry.resolve(f"{__name__}:WalkSlowly")
    for name in ("__main__:Walk", f"{__name__}:f.<locals>.Walk"):
        with pytest.raises(ValueError, match="move the class into a file"):
            registry.resolve(name)


@pytest.mark.slow
def test_a_class_in_a_script(file, capsys, monkeypatch):
    """A script is its own module, here and where its file is looked up; so is a file beside it, under its name."""
    script = file.with_name("script.py")
    script.write_text(
        "import json, pathlib\n"
        "from torchrl_loco.registry import resolve, task_name\n"
        "from neighbour import Slowly\n"
        "class Own(Slowly): pass\n"
        "if __name__ == '__main__':\n"
        "    names = [task_name(Own), task_name(Slowly)]\n"
        "    assert [resolve(name) for name in names] == [Own, Slowly]\n"
        "    print(json.dumps(names))\n"
    )
    file.rename(file.with_name("neighbour.py"))
    with monkeypatch.context() as patch:
        patch.syspath_prepend(script.parent)
        runpy.run_path(str(script), run_name="__main__")
    del sys.modules["neighbour"]  # as in another process
    names = json.loads(capsys.readouterr().out)
    assert names == [f"{script}:Own", f"{script.with_name('neighbour.py')}:Slowly"]
    assert [registry.resolve(name, by_user=True).target_speed for name in names] == [0.25, 0.25]
    assert [registry.task_name(name) for name in names] == names


def test_what_is_wrong_with_the_name_of_a_class(file):
    others = file.with_name("others.py")
    others.write_text(
        "import torchrl_loco\n"
        "def made():\n"
        "    class Task(torchrl_loco.WalkerStand): pass\n"
        "    return Task\n"
        "Slow = Other = made()\n"
    )
    for task, kind, message in [
        (
            "walker_wolk",
            ValueError,
            r"did you mean 'walker_walk'.*a class of your own as path/to/file\.py:Class",
        ),
        ("no_such.py:Slowly", FileNotFoundError, r"there is no file .*no_such\.py$"),
        (f"{file}:Slow", ValueError, "has no class 'Slow', did you mean 'Slowly'.*: choose one of Base, Slowly"),
        (str(file), ValueError, "names no class: choose one of Base, Slowly"),
        (f"{others}:Fly", ValueError, "choose one of Other, Slow$"),
        ("torchrl_loco:WalkerWolk", ValueError, "did you mean 'WalkerWalk'"),
        (f"{file.with_name('numbers_beside.py')}:A", ValueError, "has no class 'A': it defines no subclass of"),
        (f"{file}:numbers_beside", TypeError, r"walk-slowly\.py:numbers_beside: .* is no subclass of"),
        ("no_such_module:Slowly", ImportError, r"'no_such_module' cannot be loaded: .*path/to/file\.py:Class"),
        (dict, TypeError, "is no subclass of torchrl_loco"),
        (None, TypeError, "None is no subclass of torchrl_loco"),
        (3, TypeError, "3 is no subclass of torchrl_loco"),
    ]:
        with pytest.raises(kind, match=message):
            registry.resolve(task, by_user=True)
        with pytest.raises(kind, match=message):
            registry.task_name(task, by_user=True)
    for text, message in (("1 / 0", "ZeroDivisionError: division"), ("exit(3)", "SystemExit"), ("a =", "SyntaxError")):
        file.write_text(text)
        for _ in range(2):  # what has failed is tried again
            with pytest.raises(ImportError, match=f"broken.py cannot be loaded: {message}"):
                registry.resolve(f"{file.rename(file.with_name('broken.py'))}:Slowly", by_user=True)
            file.with_name("broken.py").rename(file)


def test_limits_without_effect_are_said():
    with pytest.warns(UserWarning, match="njmax and naconmax have no effect: the compiled step"):
        make("walker_walk", 2, "cpu", njmax=50, naconmax=100)


def test_naconmax_grows_with_the_worlds():
    for num_envs, expected in ((1, 1024), (2048, 50_000), (4096, 100_000)):
        assert sim_config(CONFIGS["walker"], "playground", num_envs, {}).naconmax == expected
    assert make("walker_stand", 100, "cpu", engine="mujoco_warp").sim.data.naconmax == 2442


def test_modules_beside_a_file_are_its_own(tmp_path, monkeypatch):
    """Whatever another task or the working directory has of that name."""
    body = "import common\nimport torchrl_loco\nclass Own{0}(torchrl_loco.WalkerStand):\n    k = common.K\n"
    for folder, number in (("here", 0), ("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "common.py").write_text(f"K = {number}\n")
        (tmp_path / folder / f"task_{folder}.py").write_text(body.format(folder))
    monkeypatch.syspath_prepend(tmp_path / "here")
    assert importlib.import_module("common").K == 0
    found = [registry.resolve(f"{tmp_path}/{of}/task_{of}.py:Own{of}", by_user=True).k for of in ("a", "b")]
    assert found == [1, 2]
    assert importlib.import_module("common").K == 0
    for name in ("common", *(name for name in sys.modules if name.startswith(("task_a_", "task_b_")))):
        monkeypatch.delitem(sys.modules, name)


def test_classes_of_one_name_stay_apart():
    """Of a loop, or of a cell that is run again: the name that a class is given leads to it."""
    made = [type("Same", (torchrl_loco.WalkerStand,), {"gain": gain}) for gain in (1, 2)]
    for one in made:
        one.__qualname__ = "test_classes_of_one_name_stay_apart.<locals>.Same"
    names = [registry.task_name(one) for one in made]
    assert names[1] == f"{names[0]}~2"
    assert [registry.resolve(name) for name in names] == made == [registry.resolve(registry.task_name(x)) for x in made]
