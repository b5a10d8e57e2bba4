"""The parts of the benchmarks that could be wrong: differences, ratios, and processes that fail."""

import importlib.util
import json
import os
import signal
import sys
import threading

import mujoco
import numpy as np
import pytest
import torch
from hook_tasks import FollowVelocity

from benchmarks import cases, coverage, fidelity, plot, robots, rollouts, scaling, soak, startup, suite, tables, timing
from benchmarks.cases import until_interrupted
from benchmarks.peers import mjlab_policy
from benchmarks.processes import Job, MeasurementError, run_json
from benchmarks.results import save, show
from benchmarks.throughput import phases
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.registry import env_class
from torchrl_loco.tasks.robots import actuated
from torchrl_loco.training.reppo import REPPO


def rows(**ms):
    return [{"body": "walker", "worlds": 8, "case": case, "ms": value} for case, value in ms.items()]


def test_phases_add_up_to_the_collected_step():
    measured = rows(
        bare_default=6.0, bare_compiled=5.0, env_step=5.5, env_step_and_maybe_reset=5.75, rollout_collector=6.5
    )
    (parts,) = phases(measured)
    assert list(parts.values())[2:] == [5.0, 0.5, 0.25, 0.75]
    (parts,) = phases(rows(bare_compiled=5.0, rollout_collector=6.5))  # not all was measured
    assert list(parts.values())[2:] == [5.0, None, None, None]


def test_time_is_the_median_of_blocks_after_the_first(monkeypatch):
    clock, cost = [0.0], iter([100.0] * 2 + [1.0] * 2 + [2.0] * 2 + [30.0] * 2)
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])

    def step():
        clock[0] += next(cost)

    assert timing.milliseconds(step, lambda: None, blocks=3, steps=2) == 2000.0


def test_what_was_measured_before_a_signal_is_kept(monkeypatch):
    monkeypatch.setattr(cases, "INTERRUPTED", threading.Event())
    measured = []
    for run in until_interrupted(range(5), "runs"):
        measured.append(run)
        if run == 1:
            os.kill(os.getpid(), signal.SIGTERM)
    assert measured == [0, 1]
    assert cases.INTERRUPTED.is_set()
    assert list(until_interrupted("abc", "runs")) == ["a", "b", "c"]


def test_a_failed_process_raises_its_error(tmp_path):
    (tmp_path / "good.py").write_text("print('chatter'); print('{\"ms\": 2.5}')")
    (tmp_path / "bad.py").write_text("import there_is_no_such_module")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    assert run_json(["good"], environment) == {"ms": 2.5}
    with pytest.raises(MeasurementError, match="there_is_no_such_module"):
        run_json(["bad"], environment)


WORKER = """
import json, sys, time
from benchmarks.timing import my_turn

began = time.time()
my_turn()
turn = time.time()
time.sleep(0.2)
print(json.dumps({"span": [began, turn, time.time()]}))
"""


def test_jobs_measure_one_after_another_when_all_have_compiled_and_are_not_measured_again(tmp_path, monkeypatch):
    (tmp_path / "worker.py").write_text(WORKER)
    (tmp_path / "broken.py").write_text("import there_is_no_such_module")
    jobs = [Job(name, [module], {"case": name}, tmp_path) for name, module in (("a", "worker"), ("b", "worker"))]
    jobs.append(Job("c", ["broken"], {"case": "c"}, tmp_path))
    monkeypatch.setattr(tables, "PARTS", {"steps": lambda wanted: jobs})
    options = dict.fromkeys(("worlds", "frames", "settings", "path", "mjlab")) | {"device": torch.device("cpu")}
    found = {row["job"]: row for row in tables.tables(tmp_path, ["steps"], **options)}
    assert "there_is_no_such_module" in found["c"]["error"]
    first, second = sorted((found[name]["span"] for name in "ab"), key=lambda span: span[1])
    assert max(first[0], second[0]) < first[1] < first[2] <= second[1]
    (tmp_path / "broken.py").write_text(WORKER)
    again = {row["job"]: row for row in tables.tables(tmp_path, ["steps"], **options)}
    assert "span" in again.pop("c")
    assert again == {name: found[name] for name in "ab"}
    assert len(json.loads((tmp_path / "steps.json").read_text())["rows"]) == 3


def test_results_say_how_they_were_measured(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-m", "throughput", "--out", "/root/out/throughput.json"])
    measured = rows(env_step=5.5)
    save(measured, tmp_path / "new" / "results.json", torch.device("cpu"))
    results = json.loads((tmp_path / "new" / "results.json").read_text())
    assert results["rows"] == measured
    assert results["versions"]["torch"] == torch.__version__
    assert results["command"] == "python -m benchmarks throughput --out throughput.json"
    assert results["device"]
    show(measured, {"case": "", "ms": ".2f", "error": ""})
    assert capsys.readouterr().out.splitlines()[1].split() == ["env_step", "5.50"]


@pytest.mark.slow
def test_fidelity_is_measured_on_real_worlds(tmp_path, monkeypatch):
    """A step of converged walkers agrees to rounding, and a solver cut short differs from a converged one."""
    monkeypatch.setattr(fidelity, "WARMUP", 20)
    monkeypatch.setattr(fidelity, "HORIZONS", (1, 4))
    found = fidelity.fidelity(["walker"], 16, torch.device("cpu"))
    first = {(row["protocol"], row["against"]): row["median"] for row in found if row["steps"] == 1}
    assert first["dm_control", "same settings"] < 1e-5
    assert first["playground", "converged"] > 10 * first["dm_control", "same settings"]
    fidelity.plot_fidelity(found, tmp_path / "fidelity.png")
    assert (tmp_path / "fidelity.png").exists()


@pytest.mark.ci
def test_policies_are_played_here_and_in_dm_control():
    theirs, ours = suite.suite(["walker_walk"], 4, torch.device("cpu"), None)
    assert ours["mean"] > 960
    if importlib.util.find_spec("dm_control"):
        assert theirs["mean"] > 960
    else:
        assert theirs["error"] == "ModuleNotFoundError: No module named 'dm_control'"


@pytest.mark.slow
def test_soak_compares_the_counters_with_what_happened(monkeypatch):
    monkeypatch.setattr(soak, "BLOCK", 40)
    monkeypatch.setattr(soak, "BAD_SHARE", 0.01)
    (row,) = soak.soak(["walker"], 32, 2 * 40 * 32, torch.device("cpu"))
    assert row["terminated"] >= row["bad actions"] > 5
    assert row["million steps"] == 2 * 40 * 32 / 1e6
    monkeypatch.setattr(soak.LocoEnv, "health", lambda env: {"total": {"non_finite": torch.tensor(3)}})
    with pytest.raises(AssertionError):
        soak.soak(["walker"], 32, 40 * 32, torch.device("cpu"))


@pytest.mark.ci
def test_all_seconds_of_a_start_are_in_a_phase(tmp_path, monkeypatch):
    settings = ["num_envs=4", "num_steps=8", "minibatch_size=16", "eval_episodes=2", "episode_length=40"]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setattr(startup, "run_json", lambda arguments, *rest: run_json(["quickly", *arguments], *rest))
    empty, filled = startup.startup(["walker_walk"], torch.device("cpu"), 2, 1, settings)
    for row in empty, filled:
        assert sum(row[phase] for phase in startup.PHASES) == pytest.approx(row["total"], abs=0.01)
        before = ("imports", "worlds", "text", "kernels", "networks", "rollout 1", "update 1")
        assert all(row[phase] > 0.0 for phase in (*before, "iterations", "evaluation", "pictures", "end"))
        assert sum(row[phase] for phase in before) < row["iteration 1"] < row["total"]
    assert filled["kernels"] < 0.5 * empty["kernels"]
    startup.plot_startup([empty, filled], tmp_path / "startup.png")
    assert (tmp_path / "startup.png").exists()


@pytest.mark.slow
def test_rollouts_count_what_lies_and_how_much_it_moves():
    """Of a robot that would have ended its episodes; its kinetic energy is that of C MuJoCo."""
    task = rollouts.lying(FollowVelocity)
    env = task(6, "cpu", 0, episode_length=60)
    env.reset()
    state = env.get_state()
    state["qpos"][:3, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # on their backs
    td = env.reset(state, set_state=True)
    for _ in range(50):
        td = env.step(td.set("action", 4 * torch.randn(env.action_spec.shape)))["next"].exclude("reward")
    m, d = env.mj_model, mujoco.MjData(env.mj_model)
    for world in range(6):
        d.qpos[:], d.qvel[:] = env.sim.qpos[world], env.sim.qvel[world]
        mujoco.mj_forward(m, d)
        mujoco.mj_energyVel(m, d)
        assert td["energy"][world].item() == pytest.approx(d.energy[1], rel=1e-4)
    assert (env.sim.xmat[:3, 1, 2, 2] < 0).all()
    assert not td["done"].any()


@pytest.mark.ci
def test_ranks_are_measured_beside_one_process(tmp_path):
    settings = {"num_envs": 8, "num_steps": 4, "minibatch_size": 16, "epochs": 1, "hidden": [16]}
    found = scaling.scaling(["walker_walk"], [1, 2], torch.device("cpu"), settings=settings)
    assert [(row["algorithm"], row["gpus"]) for row in found] == [("ppo", 1), ("reppo", 1), ("ppo", 2), ("reppo", 2)]
    for row in found:
        assert row["gradient_steps"] == 2
        assert min(row["collection"], row["training"]) > 0
        assert (row["exchange"] > 0) == (row["gpus"] == 2)  # one process exchanges nothing
    save(found, tmp_path / "scaling.json", torch.device("cpu"))
    plot.plot(tmp_path / "scaling.json", tmp_path / "scaling.png")
    assert (tmp_path / "scaling.png").exists()


def test_the_cost_model_adds_the_exchanges_to_an_iteration():
    first = {"gpus": 1, "collection": 10.0, "training": 5.0, "iteration": 30.0}
    row = {"gpus": 4, "collection": 39.0, "training": 15.0, "gradient_steps": 5, "exchange, recorded": 2.0}
    found = scaling.compared(row, first)
    assert found == {"collection, ratio": 3.9, "training, ratio": 3.0, "predicted": 3.0}  # 30 of 30 + 5 * 2 ms


def test_what_is_profiled_of_learning_are_gradient_steps(monkeypatch):
    sizes, gradient_step = [], REPPO.gradient_step

    def noted(self, minibatch):
        sizes.append(len(minibatch))
        return gradient_step(self, minibatch)

    monkeypatch.setattr(REPPO, "gradient_step", noted)
    with torch.no_grad():
        cases.update("walker", 512, torch.device("cpu"))()
    assert sizes == [256, 256]


def test_coverage_tells_what_is_missing(tmp_path):
    box = '<body pos="{} 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    files = {
        "plain.xml": f"<mujoco><worldbody>{box.format(0)}</worldbody></mujoco>",
        "boxes.xml": f'<mujoco><option cone="elliptic"/><worldbody>{box.format(0)}{box.format(1)}</worldbody></mujoco>',
        "fluid.xml": f'<mujoco><option density="1" cone="elliptic"/><worldbody>{box.format(0)}</worldbody></mujoco>',
        "part.xml": "<mujocoinclude/>",
        "still.xml": "<mujoco/>",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    rows, totals = coverage.coverage("own", tmp_path, check=True)
    found = {row["model"]: [row[way] for way in coverage.WAYS] + [row["missing in the last"]] for row in rows}
    assert found == {
        "own/plain.xml": ["yes", "yes", "yes", ""],
        "own/boxes.xml": ["yes", "yes", "yes", ""],
        "own/fluid.xml": ["", "", "", "forces of a fluid"],
    }
    assert totals == {
        "set": "own",
        "models": 3,
        "as is": 2,
        "options": 2,
        "ground": 2,
        "not compiled": 1,
        "checked": 2,
        "wrong": 0,
    }
    errors = {row["model"]: row["p90"] for row in rows}
    assert errors["own/fluid.xml"] is None
    assert 0 < max(errors["own/plain.xml"], errors["own/boxes.xml"]) < 1e-5


def test_a_policy_of_mjlab_moves_the_same_joints_to_the_same_targets(tmp_path):
    """Its actor, computed from sensors at a tilted IMU and with joints in another order, beside ours from its file."""
    rng, order = np.random.default_rng(0), np.random.default_rng(1).permutation(12)
    spec = mujoco.MjSpec.from_file(str(env_class("go1_velocity").model))
    imu = spec.body("trunk").add_site(name="tilted", pos=[0.1, -0.2, 0.05], quat=[0.8, 0.6, 0, 0])
    of_imu = {"objtype": mujoco.mjtObj.mjOBJ_SITE, "objname": imu.name}
    for name, kind in (("linear", mujoco.mjtSensor.mjSENS_VELOCIMETER), ("angular", mujoco.mjtSensor.mjSENS_GYRO)):
        spec.add_sensor(name=name, type=kind, **of_imu)
    m = spec.compile()
    d, joints = mujoco.MjData(m), actuated(m)
    theirs = [joints[k] for k in order]
    home, scale = rng.uniform(-1, 1, 12), rng.uniform(0.1, 1, 12)
    facts = {
        **{"robot": "go1", "base": "trunk", "control_timestep": 0.02, "device": "H100"},
        **{"seed": 42, "frames": 10, "worlds": 1, "seconds": 1.0},
        "terms": ["base_ang_vel", "base_lin_vel", "projected_gravity", "joint_pos", "joint_vel", "actions", "command"],
        **{"sizes": [3, 3, 3, 12, 12, 12, 3], "joints": joints, "home": home.tolist(), "actions": theirs},
        **{"scale": scale.tolist(), "offset": home[order].tolist()},
        **{"imu_position": imu.pos.tolist(), "imu_quaternion": imu.quat.tolist()},
    }
    weights = [rng.normal(0, 0.1, shape) for shape in ((16, 48), (8, 16), (12, 8))]
    biases, mean, std = [rng.normal(size=len(w)) for w in weights], rng.normal(size=48), rng.uniform(0.5, 2, 48)
    layers = {f"mlp.{2 * k}.{what}": a[k] for what, a in (("weight", weights), ("bias", biases)) for k in range(3)}
    norm = {"obs_normalizer._mean": mean[None], "obs_normalizer._std": std[None], "std_epsilon": 0.01}
    np.savez(tmp_path / "go1.npz", facts=json.dumps(facts), **layers, **norm)
    policy = mjlab_policy.convert(tmp_path / "go1.npz")
    own = mjlab_policy.of_ours(m, env_class("go1_velocity"), policy.info)

    d.qpos[:], d.qvel[:] = rng.normal(size=m.nq), rng.normal(size=m.nv)
    d.qpos[3:7] /= np.linalg.norm(d.qpos[3:7])
    mujoco.mj_forward(m, d)
    last, command = rng.normal(size=12), rng.normal(size=3)
    targets = np.array(own["action_offset"]) + own["action_scale"] * last
    last_of_theirs = (targets[order] - home[order]) / scale
    seen = [d.sensor("angular").data, d.sensor("linear").data, -d.body("trunk").xmat.reshape(3, 3)[2]]
    seen += [d.qpos[7:] - home, d.qvel[6:], last_of_theirs, command]
    hidden = (np.concatenate(seen) - mean) / (std + 0.01)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        hidden = weight @ hidden + bias
        hidden = np.where(hidden > 0, hidden, np.expm1(hidden))
    expected = dict(zip(theirs, home[order] + scale * (weights[-1] @ hidden + biases[-1]), strict=True))

    env = env_class("go1_velocity")(1, "cpu", 0, engine="mujoco", play=True)
    env.reset()
    state = env.get_state()
    for entries, name, row in (
        *((state, "qpos", d.qpos), (state, "qvel", d.qvel)),
        *((state["memory"], "last_action", last), (state["memory"], "command", command)),
    ):
        entries[name] = torch.tensor(row, dtype=torch.float32)[None]
    action = policy.module(env.reset(state, set_state=True)["observation"]).numpy()[0]
    ours = np.array(own["action_offset"]) + own["action_scale"] * action
    assert np.allclose(ours, [expected[name] for name in joints], atol=1e-4)
    np.savez(tmp_path / "go1.npz", facts=json.dumps(facts | {"base": "pelvis"}), **layers, **norm)
    with pytest.raises(ValueError, match="is of a robot on pelvis"):
        mjlab_policy.convert(tmp_path / "go1.npz")


def test_a_robots_row_counts_from_its_first_iteration_to_mjlabs_reward(tmp_path):
    network = torch.nn.Sequential(ObservationNorm(48), torch.nn.Linear(48, 12))
    info = {"task": "go1_velocity", "algorithm": "ppo", "trained_on": "H100", "seed": 3, "num_envs": 10}
    Policy(network, info).save(tmp_path / "policy.safetensors")
    curve = [(30.0, 90.0, 0), (31.0, 20.0, 100), (32.0, 64.5, 200), (34.0, 99.0, 300)]  # the first is an estimate
    metrics = [
        dict(zip(robots.KEPT, (i, 240 * i, seconds, earned, 999.0, episodes), strict=True))
        for i, (seconds, earned, episodes) in enumerate(curve, 1)
    ]
    robots.write_metrics(tmp_path, metrics)
    row = robots.row(tmp_path)
    assert (row["first iteration (s)"], row["to mjlab's (s)"], row["seconds"]) == (30.0, 2.0, 4.0)
    assert (row["frames/s"], row["return"]) == (3 * 240 / 4.0, 99.0)
    robots.write_metrics(tmp_path, metrics[:2])
    assert robots.row(tmp_path)["to mjlab's (s)"] is None


@pytest.mark.ci
def test_robots_are_trained_and_verified_once(tmp_path, monkeypatch):
    small = ["total_frames=1536", "num_envs=32", "num_steps=24", "minibatch_size=384", "eval_episodes=2"]
    arguments = tmp_path, ["go1_velocity"], [1], torch.device("cpu"), small
    (row,) = robots.robots(*arguments, 0)
    assert "falls" not in row
    before = row
    (row,) = robots.robots(*arguments, 2)
    assert before.items() <= row.items()  # what a verification tells takes the place of nothing
    assert (row["task"], row["seed"], row["frames"], row["episodes"]) == ("go1_velocity", 1, 1536, 2)
    assert not (tmp_path / "unfinished").exists()
    monkeypatch.setattr(robots.subprocess, "run", None)  # nothing is left to do
    assert robots.robots(tmp_path, ["go1_velocity"], [1], torch.device("cpu"), small, 2) == [row]
