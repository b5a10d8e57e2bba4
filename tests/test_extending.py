"""A body outside the package: the worked example against C MuJoCo, and what is reported about broken plug-ins."""

import dataclasses
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from for_each import for_each
from oracle import tolerance
from torchrl.envs import check_env_specs

import torchrl_loco
from torchrl_loco import WalkerStand, cli, doctor, nan_dump, registry
from torchrl_loco.sim import fill

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "inchworm"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the example as an installer leaves it, but for the time that this takes."""
    path = tmp_path_factory.mktemp("site")
    shutil.copytree(EXAMPLE / "loco_inchworm", path / "loco_inchworm")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    points = project["entry-points"][registry.GROUP]
    distribution(path, project["name"], "\n".join(f"{name} = {value}" for name, value in points.items()))
    return path


def distribution(path, name, entry_points, module=None):
    """Writes a distribution as an installer leaves it: metadata with entry points of our group, and a module."""
    if module is not None:
        (path / f"{name}.py").write_text(module)
    info = path / f"{name}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{entry_points}\n")


@pytest.fixture
def discover(monkeypatch):
    """Adds a folder of installed distributions for the duration of a test, in which nothing else is registered."""
    monkeypatch.setattr(registry, "_added", {})

    def add(path):
        monkeypatch.syspath_prepend(str(path))
        registry.installed.cache_clear()

    yield add
    monkeypatch.undo()
    registry.installed.cache_clear()


@pytest.fixture
def inchworm(site, discover, shared):
    """Makes the environment by its id."""
    discover(site)
    return lambda *args, **kwargs: shared("inchworm_crawl", *args, **kwargs)


# The example.


def test_contract(inchworm, site):
    assert torchrl_loco.list_envs() == [*registry.OURS, "inchworm_crawl"]
    assert registry.summary("inchworm_crawl") == "Crawl at 0.5 m/s or faster."
    env = inchworm(64, reward_terms=True)
    assert Path(sys.modules[type(env).__module__].__file__).is_relative_to(site)
    assert (env.action_spec.shape, env.observation_spec["observation"].shape) == ((64, 2), (64, 9))
    check_env_specs(env)
    td = env.rollout(40)
    reward = td["next", "reward"]
    assert ((reward >= 0) & (reward <= 1)).all()
    assert reward.max() > 0
    assert torch.equal(td["next", "reward_terms", "move"], reward)
    assert env.health()["total", "constraint_overflow"] == env.health()["total", "contact_overflow"] == 0
    assert env.render(width=32, height=24).float().std() > 5


def test_physics_observation_and_reward_agree_with_c_mujoco(inchworm, actions):
    """From states of a rollout, in the air and on the ground, at all speeds, beyond the target too."""
    env = inchworm(64, protocol="dm_control")
    td = env.rollout(60, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    start = env.get_state()
    start["qvel"][:, 0] += torch.linspace(-0.5, 1.0, 64)
    td = env.reset(start, set_state=True)
    (action,) = actions(env, 1)
    td = env.step(td.set("action", action))["next"]
    after, model = env.get_state().numpy(), env.mj_model
    data, rewards, errors = mujoco.MjData(model), [], []
    for world in range(env.num_envs):
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(data, name)[:] = start[name][world]
        data.ctrl[:] = action[world]
        mujoco.mj_step(model, data, env.config.substeps)
        errors.append(np.abs(data.qpos - after["qpos"][world]).max())
        data.qpos[:], data.qvel[:] = after["qpos"][world], after["qvel"][world]
        mujoco.mj_forward(model, data)
        expected = np.concatenate([data.qpos[1:], data.qvel])
        np.testing.assert_allclose(td["observation"][world], expected, rtol=0, atol=1e-6)
        rewards.append(tolerance(data.sensordata[0], 0.5, np.inf, 0.5, "linear", 0))
    assert np.quantile(errors, 0.95) < 1e-4
    np.testing.assert_allclose(td["reward"].squeeze(-1), rewards, rtol=0, atol=1e-5)
    assert min(rewards) == 0
    assert max(rewards) == 1


def test_a_nan_dump_knows_its_class(inchworm, tmp_path):
    file = tmp_path / "dump.safetensors"
    env = registry.env_class("inchworm_crawl")(3, "cpu", seed=0, nan_dump=file)
    action = torch.zeros(3, 2)
    action[1, 1] = torch.nan
    env.step(env.reset().set("action", action))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    assert "world 1 of 3" in next(nan_dump.describe(nan_dump.load(file), "cpu"))


@pytest.mark.slow
def test_doctor(inchworm, monkeypatch):
    _, error, engine = doctor.self_test("inchworm_crawl", "cpu")
    assert error < doctor.TOLERANCE
    assert engine == "compiled"
    tested = []
    monkeypatch.setattr(doctor, "self_test", lambda *args: tested.append(args) or (0.0, 0.0, "compiled"))
    assert "inchworm on cpu" in [finding.subject for finding in doctor.diagnose("all")]
    assert ("inchworm_crawl", "cpu") in tested


@pytest.mark.ci
def test_installed_trained_and_played(tmp_path):
    """In processes of their own, which know the environment from its installation alone."""
    site, options = tmp_path / "site", ["--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    pip = [sys.executable, "-m", "pip", "install", *options, "--target", str(site), str(EXAMPLE)]
    subprocess.run(pip, check=True, timeout=120)

    def command(*args):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}
        done = subprocess.run(
            [sys.executable, "-m", "torchrl_loco", *args],
            **{"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "timeout": 600},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert command("list").splitlines()[-1].split(maxsplit=1) == ["inchworm_crawl", "Crawl at 0.5 m/s or faster."]
    small = {
        **{"num_envs": 4, "num_steps": 8, "action_repeat": 4, "minibatch_size": 16, "epochs": 1, "total_frames": 256},
        **{"hidden": 16, "eval_episodes": 2, "video_seconds": 0.2},
    }
    settings = [text for name, value in small.items() for text in (f"--{name}", str(value))]
    command("train", "inchworm_crawl", "--device", "cpu", *settings)
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "video.mp4").exists()
    policy = str(run / "policy.safetensors")
    command("play", policy, "--seconds", "0.2", "--device", "cpu", "--out", "x.mp4")
    assert (tmp_path / "x.mp4").exists()


# A table of initial states.


@pytest.fixture
def starting(site, discover):
    """Makes an environment of the example's body that has another table."""
    discover(site)

    def make(table, num_envs=1, **options):
        cls = type("Starting", (registry.env_class("inchworm_crawl"),), {"initial_states": lambda self: table})
        return cls(num_envs, "cpu", seed=0, **options)

    return make


@for_each("columns", [5, 10])
def test_each_reset_draws_a_row_uniformly(starting, columns):
    """Of poses at rest, or of poses with velocities."""
    table = np.random.default_rng(0).uniform(0.5, 1.0, (3, columns)).astype(np.float32)
    env, drawn = starting(table, num_envs=300), []
    for _ in range(2):
        td, state = env.reset(), env.get_state()
        start = torch.cat([state["qpos"], state["qvel"]], dim=1).numpy()
        np.testing.assert_array_equal(td["observation"], start[:, 1:])
        assert (start[:, columns:] == 0).all()
        rows, counts = np.unique(start[:, :columns], axis=0, return_counts=True)
        np.testing.assert_array_equal(rows, np.unique(table, axis=0))
        assert counts.min() > 60  # of 100; the deviation is 8
        drawn.append(start)
    assert 150 < (drawn[0] != drawn[1]).any(axis=1).sum() < 250  # 200 of 300, if the draws are independent
    env.set_seed(0)
    env.reset()
    np.testing.assert_array_equal(env.get_state()["qpos"], drawn[0][:, :5])


def test_what_is_observed_at_a_start_in_motion(starting, engine):
    """Sensors belong to the velocities that were drawn."""
    env = starting(np.full((1, 10), 0.3), num_envs=2, engine=engine)
    env.reset()
    data = mujoco.MjData(env.mj_model)
    data.qpos[:], data.qvel[:] = 0.3, 0.3
    mujoco.mj_forward(env.mj_model, data)
    np.testing.assert_allclose(env.sim.data.sensordata.numpy(), np.tile(data.sensordata, (2, 1)), atol=1e-6)


def test_tables_that_are_none(starting):
    """Without a table a world starts in the default pose; one of a wrong shape is refused."""
    env = starting(None, num_envs=2)
    env.reset()
    np.testing.assert_array_equal(env.get_state()["qpos"], np.tile(env.mj_model.qpos0, (2, 1)))
    for shape in ((5,), (4, 6), (0, 5), (2, 2, 5)):
        with pytest.raises(ValueError, match=r"initial_states must return .* shape \(count > 0, 5\) or .* 10\), got"):
            starting(np.zeros(shape))
    with pytest.raises(ValueError, match="initial_states must return finite numbers"):
        starting(np.full((3, 10), np.nan))


# What is observed, of a body that is written here.


@wp.func
def pay() -> float:
    return 0.25


@wp.func
def pay_more() -> float:
    return 0.5


@wp.struct
class PaidInputs:
    bonus: float
    qvel: wp.array2d[float]


@wp.struct
class ForceInputs:
    actuator_force: wp.array2d[float]


@wp.func
def observe_paid(world: int, inputs: PaidInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    observation[0] = inputs.qvel[world, 0]
    terms[0] = inputs.bonus
    return pay() + inputs.bonus


class Paid(WalkerStand):
    observation_size = 1
    term_names = ("bonus",)
    answer = staticmethod(lambda data: (observe_paid, fill(PaidInputs, data, bonus=0.125)))

    def observation_func(self, world):
        return self.answer(world.sim.data)


def test_a_function_that_was_written_anew_is_used(engine, monkeypatch):
    """As in a notebook, where a cell with the reward alone is run again."""
    for func, expected in ((pay, 0.25), (pay_more, 0.5)):
        monkeypatch.setitem(globals(), "pay", func)
        env = Paid(2, "cpu", seed=0, engine=engine)
        td = env.rollout(1)
        assert (td["next", "reward"] == expected + 0.125).all()


def test_wrong_inputs_are_named(monkeypatch):
    for answer, message in [
        (lambda data: observe_paid, "observation_func must return a wp.func and its inputs"),
        (lambda data: (len, fill(PaidInputs, data, bonus=0.0)), "observation_func must return a wp.func"),
        (lambda data: (observe_paid, [data.qvel]), r"inputs of observe_paid must be an instance of a wp\.struct"),
        (lambda data: (pay, fill(PaidInputs, data, bonus=0.0)), "pay must take the index of the world, the inputs"),
        (
            lambda data: (observe_paid, fill(PaidInputs, data)),
            "PaidInputs has the fields bonus, qvel: bonus is missing",
        ),
        (lambda data: (observe_paid, fill(PaidInputs, data, bonus=0.0, bonos=1.0)), "there is no bonos"),
        (lambda data: fill(ForceInputs, data), 'actuator_force is missing, which engine="mujoco_warp" has'),
    ]:
        monkeypatch.setattr(Paid, "answer", staticmethod(answer))
        with pytest.raises(TypeError, match=message):
            Paid(2, "cpu", seed=0)


@wp.func
def observe_two(world: int, inputs: PaidInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    observation[0] = inputs.bonus
    observation[1] = 0.5
    terms[0] = 1.0
    return 1.0


@wp.func
def observe_in_all(world: int, inputs: PaidInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    """Takes the row for the memory of all worlds, and writes before that of the terms."""
    observation[world] = inputs.bonus
    terms[-3] = 1.0
    return 1.0


def test_rows_of_another_length_are_refused(monkeypatch):
    """What is written beyond a row would be another world's reward, or nobody's memory."""
    for func, size, term_names, message in [
        (observe_two, 1, ("bonus",), "observation_size is 1, but observe_two also writes at index 1$"),
        (observe_two, 2, ("a", "b"), "the number of term_names is 2, but observe_two does not write at index 1$"),
        (observe_in_all, 1, ("bonus",), "observation_size is 1, but observe_in_all also writes at index 2$"),
        (observe_in_all, 3, ("bonus",), "does not write at index 0, 1$"),
    ]:
        answer = staticmethod(lambda data, func=func: (func, fill(PaidInputs, data, bonus=0.5)))
        monkeypatch.setattr(Paid, "answer", answer)
        monkeypatch.setattr(Paid, "observation_size", size)
        monkeypatch.setattr(Paid, "term_names", term_names)
        with pytest.raises(ValueError, match=message):
            Paid(3, "cpu", seed=0)


def test_a_table_is_read_again_in_a_subclass_of_a_class_with_one():
    class Lies(WalkerStand):
        pose_func = torchrl_loco.LocoEnv.pose_func

        def initial_states(self):
            return np.zeros((1, 9))

    class Stands(Lies):
        def initial_states(self):
            return np.full((1, 9), 0.125)

    env = Stands(2, "cpu", seed=0)
    env.reset()
    assert (env.get_state()["qpos"] == 0.125).all()


def test_a_name_that_is_almost_a_hook_is_said():
    class Falls(torchrl_loco.WalkerWalk):
        def terminate(self, s):
            return s.xpos("torso")[:, 2] < 0.7

    with pytest.warns(UserWarning, match="Falls defines terminate, which nothing reads: did you mean terminated?"):
        Falls.check_class()
    with pytest.warns(UserWarning, match="Ends defines termination, which nothing reads: did you mean terminated?"):
        type("Ends", (torchrl_loco.WalkerWalk,), {"termination": lambda self, s: s.time > 1.0}).check_class()
    with pytest.warns(UserWarning, match="Heavy defines weigths, which nothing reads: did you mean weights?"):
        type("Heavy", (torchrl_loco.Go1Velocity,), {"weigths": {}}).check_class()
    config = dataclasses.replace(torchrl_loco.Go1Velocity.config, episode_length=200)
    with pytest.warns(UserWarning, match="Brief.config has episode_length=200, but the class Velocity sets 1000"):
        type("Brief", (torchrl_loco.Go1Velocity,), {"config": config}).check_class()


def test_wrong_attributes_are_named(monkeypatch):
    for name, value, message in [
        ("observation_size", 1.0, "observation_size must be an integer"),
        ("config", {"ctrl_dt": 0.02}, "config must be a torchrl_loco.SimConfig"),
        ("term_names", "bonus", "term_names must be a tuple of names"),
        ("initial_states", lambda self: None, "set pose_func = torchrl_loco.LocoEnv.pose_func in Paid"),
    ]:
        with monkeypatch.context() as wrong:
            wrong.setattr(Paid, name, value, raising=False)
            with pytest.raises(TypeError, match=message):
                Paid(2, "cpu", seed=0)


# What plug-ins may get wrong.

INCOMPLETE = "import torchrl_loco\nclass Ant(torchrl_loco.LocoEnv):\n    body, observation_size = 'ant', 3\n"


def test_broken_plug_ins_are_named_and_harm_no_other(tmp_path, discover, capsys, monkeypatch):
    broken = {
        "no_such_module:Env": "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'",
        "broken_loco:Missing": "cannot be loaded: AttributeError: .*Missing",
        "broken_loco:number": "5 is no subclass of torchrl_loco.LocoEnv",
        "failing_loco:Env": "cannot be loaded: ZeroDivisionError: division by zero",
        "broken_loco:Ant": "Ant must set model",
        "broken_loco:Empty": r"Empty.observation_size must lie in \[1, 2\*\*31\)",
    }
    distribution(
        tmp_path,
        "broken_loco",
        "\n".join(f"ant_{i} = {value}" for i, value in enumerate(broken)),
        f"{INCOMPLETE}number = 5\nclass Empty(torchrl_loco.WalkerStand):\n    observation_size = 0\n",
    )
    (tmp_path / "failing_loco.py").write_text("1 / 0")
    discover(tmp_path)
    for i, (value, message) in enumerate(broken.items()):
        with pytest.raises(ImportError, match=rf"'ant_{i}' of broken_loco 1\.2 \({value}\):? {message}"):
            torchrl_loco.make(f"ant_{i}")
    assert registry.env_class("walker_walk") is torchrl_loco.WalkerWalk
    with pytest.raises(ValueError, match="did you mean 'ant_3'"):
        torchrl_loco.make("ant3")

    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(registry.OURS) + len(broken)
    assert all("broken_loco 1.2" in line for line in lines[len(registry.OURS) :])
    with pytest.raises(SystemExit, match="2"):
        cli.main(["train", "ant_0", "--device", "cpu", "--out", str(tmp_path / "runs")])
    assert "'ant_0' of broken_loco 1.2" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()

    monkeypatch.setattr(doctor, "self_test", lambda *args: (0.0, 0.0, "compiled"))
    problems = [finding.subject for finding in doctor.diagnose() if finding.problem]
    assert problems == [f"ant_{i}" for i in range(len(broken))]


def test_ids_that_are_taken_or_malformed_are_ignored_with_a_warning(tmp_path, discover):
    for name, message in [
        ("walker_walk", "torchrl_loco already has this id"),
        ("mjx/walker_walk-v0", "torchrl_loco already has this id"),
        ("ant/run", "an id consists of letters, digits"),
    ]:
        path = tmp_path / name.replace("/", "_")
        path.mkdir()
        distribution(path, "greedy_loco", f"{name} = greedy_loco:Env")
        discover(path)
        with pytest.warns(UserWarning, match=rf"{name}' of greedy_loco 1\.2 .* is ignored: {message}"):
            assert torchrl_loco.list_envs() == list(registry.OURS)
        sys.path.remove(str(path))
    assert registry.env_class("walker_walk") is torchrl_loco.WalkerWalk
    for name in ("one_loco", "two_loco"):
        distribution(tmp_path, name, f"ant_run = {name}:Env")
    discover(tmp_path)
    with pytest.warns(UserWarning, match=r"of (\w+)_loco 1\.2 .* is ignored: (?!\1)\w+_loco 1\.2 already has"):
        assert torchrl_loco.list_envs()[-1] == "ant_run"
