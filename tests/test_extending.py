"""The body that lives outside the package, installed as its users would; and what is told of those that are broken."""

import operator
import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from oracle import DATA, reference_model, tolerance
from torchrl.envs import check_env_specs

import torchrl_loco
from torchrl_loco import State, cli, doctor, ids, models, registry
from torchrl_loco.envs.checks import check_model

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "cheetah"
MJCF = EXAMPLE / "loco_cheetah" / "cheetah.xml"
FIGURES = [field for field in reference_model("cheetah") if field not in ("names", "sizes", "option", "source")]
SMALL = {
    **{"num_envs": 4, "decisions": 8, "action_repeat": 4, "minibatch_size": 16, "epochs": 1, "total_frames": 256},
    **{"hidden": 16, "eval_episodes": 2, "video_seconds": 0.2},
}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder that pip has installed the example into, as a wheel."""
    path = tmp_path_factory.mktemp("site")
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target", str(path)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(EXAMPLE)], check=True, timeout=120)
    return path


@pytest.fixture
def discover(monkeypatch):
    """Makes a folder of installed distributions part of this environment for the duration of a test."""

    def add(path):
        monkeypatch.syspath_prepend(str(path))
        ids.plugins.cache_clear()

    yield add
    monkeypatch.undo()
    ids.plugins.cache_clear()


@pytest.fixture
def cheetah(site, discover):
    """Makes the environment by its id."""
    discover(site)
    return lambda *args, **kwargs: torchrl_loco.make("cheetah_run", *args, **kwargs)


def recorded(kind):
    return dict(np.load(DATA / f"cheetah_{kind}_dm_control.npz"))


def state(qpos, qvel, **more):
    entries = {"qpos": qpos, "qvel": qvel, **more}
    values = {key: torch.as_tensor(value, dtype=torch.float32) for key, value in entries.items()}
    return State(values, batch_size=[len(qpos)])


# The example.


def lines_of_the_example():
    files = [file for file in EXAMPLE.rglob("*") if file.suffix in {".py", ".xml", ".toml"}]
    assert {file.name for file in files} == {"__init__.py", "cheetah.xml", "pyproject.toml"}
    return sum(len(file.read_text().splitlines()) for file in files)


def test_a_body_takes_under_150_lines_in_all():
    assert lines_of_the_example() < 150


@pytest.mark.parametrize("field", FIGURES)
def test_model_has_the_figures_of_dm_control(field):
    ours = np.asarray(getattr(models.from_path(MJCF), field), dtype=float)
    np.testing.assert_allclose(ours.ravel(), np.ravel(reference_model("cheetah")[field]), rtol=0, atol=1e-6)


def test_model_has_the_sizes_and_options_of_dm_control():
    model, reference = models.from_path(MJCF), reference_model("cheetah")
    assert {size: getattr(model, size) for size in reference["sizes"]} == reference["sizes"]
    for option, value in reference["option"].items():
        np.testing.assert_allclose(getattr(model.opt, option), value, err_msg=option)


def test_found_by_its_entry_point(cheetah, site, protocol):
    assert torchrl_loco.list_envs() == [*registry.ENVS, "cheetah_run"]
    env = cheetah(5, "cpu", seed=0, protocol=protocol, reward_terms=True)
    assert Path(sys.modules[type(env).__module__].__file__).is_relative_to(site)
    assert (env.action_spec.shape, env.observation_spec["observation"].shape) == ((5, 6), (5, 17))
    check_env_specs(env)
    td = env.rollout(100)
    reward = td["next", "reward"]
    assert ((reward >= 0) & (reward <= 1)).all()
    assert reward.max() > 0
    assert torch.equal(td["next", "reward_terms", "move"], reward)
    assert env.health()["total", "constraint_overflow"] == env.health()["total", "contact_overflow"] == 0
    assert env.render(width=32, height=24).float().std() > 5


def test_observation_and_physics_agree_with_dm_control(cheetah):
    record = recorded("run")
    env = cheetah(len(record["qpos"]), "cpu", seed=0, protocol="dm_control")
    td = env.reset(state(record["next_qpos"], record["next_qvel"]), set_state=True)
    np.testing.assert_allclose(td["observation"], record["obs"], rtol=0, atol=1e-5)
    before = state(record["qpos"], record["qvel"], qacc_warmstart=record["warmstart"])
    td = env.reset(before, set_state=True)
    td = env.step(td.set("action", torch.as_tensor(record["action"], dtype=torch.float32)))["next"]
    error = np.abs(env.get_state()["qpos"].numpy() - record["next_qpos"]).max(axis=1)
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.95) < 1e-4
    speed_error = np.abs(td["reward"].squeeze(-1).numpy() - record["reward"])
    assert np.median(speed_error) < 1e-5


def test_observation_and_reward_agree_with_c_mujoco(cheetah, protocol):
    """At all speeds, beyond the target too: reward and observation of C MuJoCo in float64 at the state that follows."""
    record, rng = recorded("run"), np.random.default_rng(0)
    qvel = record["qvel"].copy()
    qvel[:, 0] += rng.uniform(-2, 13, len(qvel))
    env = cheetah(len(qvel), "cpu", seed=0, protocol=protocol)
    td = env.reset(state(record["qpos"], qvel), set_state=True)
    td = env.step(td.set("action", torch.as_tensor(record["action"], dtype=torch.float32)))["next"]
    after, model = env.get_state().numpy(), mujoco.MjModel.from_xml_string(*expanded())
    data, rewards = mujoco.MjData(model), []
    for world in range(env.num_envs):
        data.qpos[:], data.qvel[:] = after["qpos"][world], after["qvel"][world]
        mujoco.mj_forward(model, data)
        expected = np.concatenate([data.qpos[1:], data.qvel])
        np.testing.assert_allclose(td["observation"][world], expected, rtol=0, atol=1e-6)
        rewards.append(tolerance(data.sensordata[0], 10, np.inf, 10, "linear", 0))
    np.testing.assert_allclose(td["reward"].squeeze(-1), rewards, rtol=0, atol=1e-5)
    assert min(rewards) == 0
    assert max(rewards) == 1


def expanded():
    """The model's text and what it includes, for MuJoCo alone."""
    return MJCF.read_text(), {"scene.xml": (Path(models.__file__).parent / "scene.xml").read_bytes()}


def test_starts_are_distributed_as_dm_control_s(cheetah):
    ours, theirs = cheetah(1, "cpu", protocol="dm_control")._initial_poses(), recorded("resets")["qpos"]
    critical = np.sqrt(-0.5 * np.log(1e-6 / 2) * (1 / len(ours) + 1 / len(theirs)))  # Kolmogorov and Smirnov's
    for a, b in zip(ours.T, theirs.T, strict=True):
        both = np.concatenate([a, b])
        share = [np.searchsorted(np.sort(x), both, side="right") / len(x) for x in (a, b)]
        assert np.abs(share[0] - share[1]).max() < critical


def test_starts_stand_at_rest_on_the_floor(cheetah, protocol):
    env = cheetah(64, "cpu", seed=0, protocol=protocol)
    td = env.reset()
    first, data = env.get_state()["qpos"], mujoco.MjData(env.mj_model)
    assert len(first.unique(dim=0)) > 32
    for qpos in first.numpy():
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(env.mj_model, data)
        assert data.ncon >= 2
        assert data.contact.dist.min() > -0.02
    for _ in range(20):
        td = env.step(td.set("action", torch.zeros(64, 6)))["next"].exclude("reward")
    assert (env.get_state()["qpos"] - first).abs().max() < 0.05  # random hinges swing through more than 1 rad


def test_a_masked_reset_draws_anew_and_leaves_the_others(cheetah):
    env = cheetah(8, "cpu", seed=3)
    td = env.rollout(5)[:, -1]["next"].exclude("reward")
    before, mask = env.get_state(), torch.arange(8) % 2 == 0
    td = env.reset(td.set("_reset", mask.unsqueeze(-1)))
    after = env.get_state()
    assert torch.equal(after["qpos"][~mask], before["qpos"][~mask])
    starts = torch.as_tensor(env._initial_poses(), dtype=torch.float32)
    assert (after["qpos"][mask].unsqueeze(1) == starts).all(dim=-1).any(dim=-1).all()
    assert torch.equal(td["observation"][mask, :8], after["qpos"][mask, 1:])
    assert (after["qvel"][mask] == 0).all()


def test_a_bad_world_is_caught_and_replayed(cheetah, tmp_path, capsys):
    file = tmp_path / "bad.safetensors"
    env = cheetah(3, "cpu", seed=0, bad_world_file=file)
    action = torch.zeros(3, 6)
    action[1, 2] = torch.nan
    env.step(env.reset().set("action", action))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    assert cli.main(["replay", str(file), "--device", "cpu"]) == 0
    assert "world 1 of 3" in capsys.readouterr().out


# A table of initial poses.


@pytest.fixture
def posed(cheetah):
    """Makes an environment of the example's body that has another table."""

    def make(table, num_envs=1):
        cls = type("Posed", (registry.env_class("cheetah_run"),), {"_initial_poses": lambda self: table})
        return cls(num_envs, "cpu", seed=0)

    return make


def test_each_reset_draws_a_row_uniformly(posed):
    table = np.random.default_rng(0).uniform(0.5, 1.0, (3, 9)).astype(np.float32)
    env, drawn = posed(table, num_envs=300), []
    for _ in range(2):
        td = env.reset()
        qpos = env.get_state()["qpos"].numpy()
        np.testing.assert_array_equal(td["observation"][:, :8], qpos[:, 1:])
        rows, counts = np.unique(qpos, axis=0, return_counts=True)
        np.testing.assert_array_equal(rows, np.unique(table, axis=0))
        assert counts.min() > 60  # of 100; the deviation is 8
        drawn.append(qpos)
    assert 150 < (drawn[0] != drawn[1]).any(axis=1).sum() < 250  # 200 of 300, if the draws are independent
    env.set_seed(0)
    env.reset()
    np.testing.assert_array_equal(env.get_state()["qpos"], drawn[0])


def test_without_a_table_a_world_starts_in_the_default_pose(posed):
    env = posed(None, num_envs=2)
    env.reset()
    np.testing.assert_array_equal(env.get_state()["qpos"], np.tile(env.mj_model.qpos0, (2, 1)))


@pytest.mark.parametrize("shape", [(9,), (4, 8), (0, 9), (2, 2, 9)])
def test_a_table_of_another_shape_is_refused(posed, shape):
    told = f"_initial_poses must return an array of shape (count, 9), count > 0; got {shape}"
    with pytest.raises(ValueError, match=re.escape(told)):
        posed(np.zeros(shape))


# The command.


def test_list_and_doctor(cheetah, capsys, monkeypatch):
    assert cli.main(["list"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "cheetah_run      Run at 10 m/s or faster."
    self_test, tested = doctor.self_test, []
    monkeypatch.setattr(doctor, "self_test", lambda *args: tested.append(args) or (0.0, 0.0))
    assert cli.main(["doctor"]) == 0
    assert ("cheetah_run", "cpu") in tested
    assert "cheetah on cpu" in capsys.readouterr().out
    _, error = self_test("cheetah_run", "cpu")
    assert error < doctor.TOLERANCE


@pytest.mark.slow
def test_train_and_play(site, tmp_path):
    """In processes of their own, which know the environment from its installation alone."""

    def command(*args):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}
        done = subprocess.run(
            [sys.executable, "-m", "torchrl_loco", *args],
            **{"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "timeout": 600},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    settings = [text for name, value in SMALL.items() for text in (f"--{name}", str(value))]
    out = command("train", "cheetah_run", "--device", "cpu", *settings)
    assert "No settings were tuned for cheetah_run" in out
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "video.mp4").stat().st_size > 0
    assert len((run / "metrics.csv").read_text().splitlines()) == 3  # a head and two iterations
    (evaluation,) = torchrl_loco.training.RunFolder(run).read_evaluations()
    assert 0 <= evaluation["mean"] <= 1000
    arguments = ["--policy", str(run / "policy.safetensors"), "--seconds", "0.2", "--device", "cpu", "--out", "x.mp4"]
    assert command("play", "cheetah_run", *arguments).splitlines()[-1] == "x.mp4"
    assert (tmp_path / "x.mp4").stat().st_size > 0
    with pytest.raises(SystemExit, match="2"):
        cli.main(["play", "walker_walk", *arguments])


def test_play_without_a_policy(cheetah, capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["play", "cheetah_run"])
    assert "no policy for 'cheetah_run' comes with this release" in capsys.readouterr().err


# What others may get wrong.


def distribution(path, name, entry_points, module=""):
    """Leaves a distribution as an installer would: a module, and metadata with entry points of our group."""
    (path / f"{name}.py").write_text(module)
    info = path / f"{name}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{ids.GROUP}]\n{entry_points}\n")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("no_such_module:Env", "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'"),
        ("broken_loco:Missing", "cannot be loaded: AttributeError: .*Missing"),
        ("broken_loco:number", "is no subclass of torchrl_loco.LocoEnv"),
        ("failing_loco:Env", "cannot be loaded: ZeroDivisionError: division by zero"),
    ],
)
def test_broken(tmp_path, discover, capsys, value, message):
    distribution(tmp_path, "broken_loco", f"ant_run = {value}", "number = 5")
    (tmp_path / "failing_loco.py").write_text("1 / 0")
    discover(tmp_path)
    with pytest.raises(ImportError, match=rf"'ant_run' of broken_loco 1\.2 \({value}\) {message}"):
        torchrl_loco.make("ant_run")
    assert torchrl_loco.make("walker_walk", 1, "cpu").body == "walker"
    with pytest.raises(ValueError, match="did you mean 'ant_run'"):
        torchrl_loco.make("ant_rum")

    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7
    assert lines[-1].startswith("ant_run          NOT USABLE: environment 'ant_run' of broken_loco 1.2")
    with pytest.raises(SystemExit, match="2"):
        cli.main(["train", "ant_run", "--device", "cpu", "--out", str(tmp_path / "runs")])
    assert "'ant_run' of broken_loco 1.2" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_broken_is_told_by_the_doctor(tmp_path, discover, capsys, monkeypatch):
    distribution(tmp_path, "broken_loco", "ant_run = no_such_module:Env")
    discover(tmp_path)
    monkeypatch.setattr(doctor, "self_test", lambda *args: (0.0, 0.0))
    with pytest.raises(SystemExit, match="1"):
        cli.main(["doctor"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "NOT RIGHT" in line)
    assert line.startswith("ant_run")


@pytest.mark.parametrize("name", ["walker_walk", "mjx/walker_walk-v0"])
def test_an_id_of_ours_is_not_given_away(tmp_path, discover, name):
    distribution(tmp_path, "greedy_loco", f"{name} = greedy_loco:Env")
    discover(tmp_path)
    with pytest.warns(UserWarning, match=rf"{name}' of greedy_loco 1\.2 .* is refused: torchrl_loco itself has it"):
        assert registry.env_class(name) is torchrl_loco.WalkerWalk
    assert torchrl_loco.list_envs() == list(registry.ENVS)


def test_of_two_with_one_id_the_second_is_refused(tmp_path, discover):
    for name in ("one_loco", "two_loco"):
        distribution(tmp_path, name, f"ant_run = {name}:Env")
    discover(tmp_path)
    with pytest.warns(UserWarning, match=r"of (\w+)_loco 1\.2 .* is refused: (?!\1)\w+_loco 1\.2 .* has it"):
        assert torchrl_loco.list_envs()[-1] == "ant_run"


def test_an_incomplete_class_is_told_what_it_lacks():
    class Ant(torchrl_loco.LocoEnv):
        body = "ant"
        observation_size = 3

    with pytest.raises(TypeError, match="Ant must set mjcf, defaults, term_names"):
        Ant(1, "cpu")


ANT = """
<mujoco>
  <worldbody><body name="ant"><joint name="leg"/><geom name="leg" size="0.1"/><camera name="eye"/></body></worldbody>
  <actuator>{actuator}</actuator>
  <sensor>{sensor}</sensor>
</mujoco>
"""
MOTOR = '<motor joint="leg" ctrlrange="-1 1"/>'
VELOCITY = '<subtreelinvel name="speed" body="ant"/>'


@pytest.mark.parametrize(
    ("actuator", "sensor", "message"),
    [
        ('<motor joint="leg" ctrlrange="-2 2"/>', VELOCITY, "every actuator needs ctrlrange -1 1"),
        ('<motor joint="leg"/>', VELOCITY, "every actuator needs ctrlrange -1 1"),
        ('<intvelocity joint="leg" ctrlrange="-1 1" actrange="-1 1"/>', VELOCITY, "activations are not supported"),
        ('<motor joint="leg" ctrlrange="-1 1" ctrllimited="false"/>', VELOCITY, "must be clipped"),
        ('<motor joint="leg" ctrlrange="-1 1" delay="0.1" nsample="4"/>', VELOCITY, "delays of actuators"),
        (
            MOTOR,
            '<framelinvel name="seen" objtype="body" objname="ant" reftype="camera" refname="eye"/>',
            "sensor 'seen' is not evaluated",
        ),
        (MOTOR, '<framepos name="place" objtype="body" objname="ant"/>', "sensor 'place' is not evaluated"),
        (MOTOR, '<actuatorfrc name="force" actuator="a"/>', "sensor 'force' is not evaluated"),
    ],
)
def test_a_model_that_would_be_wrong_in_silence_is_refused(actuator, sensor, message):
    actuator = actuator.replace("<motor", '<motor name="a"')
    with pytest.raises(ValueError, match=message):
        check_model(mujoco.MjModel.from_xml_string(ANT.format(actuator=actuator, sensor=sensor)))
    check_model(mujoco.MjModel.from_xml_string(ANT.format(actuator=MOTOR, sensor=VELOCITY)))


def test_a_scene_of_its_own_comes_first(tmp_path):
    (tmp_path / "ant.xml").write_text('<mujoco><include file="scene.xml"/></mujoco>')
    assert models.from_path(tmp_path / "ant.xml").nmat == 3
    (tmp_path / "scene.xml").write_text('<mujoco><asset><material name="sand"/></asset></mujoco>')
    assert models.from_path(tmp_path / "ant.xml").nmat == 1


def test_the_guide_names_what_there_is(cheetah):
    guide, env = (ROOT / "docs" / "guides" / "extending.md").read_text(), cheetah(1, "cpu")
    named = re.findall(r"^\| `(?:self\.)?([\w.]+)` \|", guide, flags=re.MULTILINE)
    assert len(named) == 17
    for name in named:
        assert operator.attrgetter(name)(env) is not None
    for field in re.findall(r"`(\w+)`", next(line for line in guide.splitlines() if "`self.sim.data`" in line)):
        assert hasattr(env.sim.data, field), field
    for file in re.findall(r"{literalinclude} (\S+)", guide):
        assert (ROOT / "docs" / "guides" / file).is_file()
    assert f"{lines_of_the_example()} lines in all" in " ".join(guide.split())
