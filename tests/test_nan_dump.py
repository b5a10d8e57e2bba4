"""The first world that is not finite is written to a file, from which its step can be repeated."""

import numpy as np
import pytest
import torch
from cases import COARSE
from for_each import for_each

import torchrl_loco
from torchrl_loco import NonFiniteWarning, cli, nan_dump, storage
from torchrl_loco.envs.monitors import INTERVAL, NAN_DUMP

WORLDS, BAD = 6, 4


@pytest.fixture
def file(tmp_path):
    return tmp_path / "dump.safetensors"


def made(file, device="cpu", **options):
    return torchrl_loco.make("walker_walk", WORLDS, device, 7, nan_dump=file, **{**COARSE, **options})


def stepped(env, td, action):
    return env.step(td.set("action", action))["next"].exclude("reward")


def drive(env, actions, spoil):
    """Plays 3 good steps, then one that ``spoil`` makes bad; returns the state and action that it began with."""
    td, (*good, last) = env.reset(), actions(env, 4)
    for action in good:
        td = stepped(env, td, action)
    state = env.get_state()
    spoil(state, last)
    td = env.reset(state, set_state=True)
    td = stepped(env, td, last)
    assert td["terminated"].flatten().tolist() == [i == BAD for i in range(WORLDS)]
    return state, last, td


def bad_action(state, action):
    action[BAD, 2] = float("nan")


def too_fast(state, action):
    state["qvel"][BAD, 4] = 3e9


def test_the_file_holds_what_the_step_began_with(device, engine, file, actions):
    for spoil in (bad_action, too_fast):
        env = made(file, device, engine=engine, iterations=3)
        state, action, _ = drive(env, actions, spoil)
        with pytest.warns(NonFiniteWarning, match=rf"world {BAD} became non-finite in step 4 .*dump\.safe.*inspect"):
            env.close()
        dump = nan_dump.load(file)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            assert torch.equal(dump.tensors[name], state[name][BAD].cpu()), name
        torch.testing.assert_close(dump.tensors["action"], action[BAD].cpu(), rtol=0, atol=0, equal_nan=True)
        found = dump.settings
        assert (found["world"], found["episode"], found["elapsed_steps"], found["seed"]) == (BAD, 1, 3, 7)
        assert (found["env"], found["protocol"]) == ("torchrl_loco.tasks.walker.WalkerWalk", "playground")
        assert (found["config"]["iterations"], found["config"]["engine"]) == (3, engine)
        file.unlink()


def test_only_the_first_is_kept(file, actions):
    env = made(file)
    state, _, td = drive(env, actions, too_fast)
    for world in (0, BAD):
        action = env.action_spec.zero()
        action[world] = float("inf")
        td = stepped(env, td, action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    assert torch.equal(nan_dump.load(file).tensors["qvel"], state["qvel"][BAD])


@pytest.mark.slow
def test_of_a_body_with_activations(file, actions):
    """They are kept, and both simulators step with them and with scaled actions."""
    env = torchrl_loco.make("quadruped_run", 3, "cpu", 0, protocol="dm_control", nan_dump=file)
    td = env.reset()
    for action in actions(env, 5):
        td = stepped(env, td, action)
    state = env.get_state()
    action[1, 2] = float("nan")
    stepped(env, td, action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    dump = nan_dump.load(file)
    assert torch.equal(dump.tensors["act"], state["act"][1])
    assert dump.tensors["act"].abs().max() > 0.1
    dump.tensors["action"][2] = 0.5
    warp, c = nan_dump.warp_trace(dump, "cpu"), nan_dump.mujoco_trace(dump)
    np.testing.assert_allclose(warp, c, atol=1e-3)
    last = [line for line in nan_dump.describe(dump, "cpu") if line.split()[0].isdigit()][-1].split()
    assert float(last[3]) == pytest.approx(np.abs(warp[-1] - c[-1]).max(), rel=0.01, abs=1e-9)


def test_of_two_in_one_step_the_lower_is_kept(file):
    env = made(file)
    action = env.action_spec.zero()
    action[1:4:2] = float("nan")
    stepped(env, env.reset(), action)
    with pytest.warns(NonFiniteWarning, match="world 1 "):
        env.close()


def test_it_is_written_while_stepping(device, file, actions):
    env = made(file, device)
    *_, td = drive(env, actions, bad_action)
    zero = env.action_spec.zero()
    for _ in range(INTERVAL - 5):  # 4 steps are done
        td = stepped(env, td, zero)
    assert not file.exists()

    def steps():
        next_td = stepped(env, td, zero)  # requests the numbers
        if device == "cuda":
            torch.cuda.synchronize()  # now they have arrived
            stepped(env, next_td, zero)

    with pytest.warns(NonFiniteWarning):
        steps()
    assert file.exists()


def test_nothing_is_written_or_changed_if_all_is_finite(shared, file, actions):
    env, plain = made(file), shared("walker_walk", WORLDS, seed=7, **COARSE)
    td, expected = env.reset(), plain.reset()
    for action in actions(env, 10):
        td, expected = stepped(env, td, action), stepped(plain, expected, action)
    assert torch.equal(td["observation"], expected["observation"])
    for _ in range(INTERVAL):
        td = stepped(env, td, action)
    env.close()
    assert not file.exists()


def test_nothing_is_overwritten(file, actions):
    env = made(file)
    drive(env, actions, bad_action)
    file.write_text("evidence")
    with pytest.warns(NonFiniteWarning, match="already exists"):
        env.close()
    assert file.read_text() == "evidence"
    with pytest.raises(ValueError, match="already exists: move it away"):
        made(file)


@pytest.mark.slow
def test_warp_repeats_what_happened_and_c_mujoco_agrees_on_an_ordinary_step(file, engine, actions):
    """With the action repaired. From another warm start, few iterations of the solver end elsewhere."""

    def far_warm_start(state, action):
        state["qacc_warmstart"][BAD] = 1e4
        bad_action(state, action)

    env = made(file, engine=engine)
    state, action, _ = drive(env, actions, far_warm_start)
    action[BAD, 2] = 0.0
    stepped(env, env.reset(state, set_state=True), action)
    expected = env.get_state()["qvel"][BAD].numpy()
    with pytest.warns(NonFiniteWarning):
        env.close()
    dump = nan_dump.load(file)
    dump.tensors["action"][2] = 0.0
    np.testing.assert_array_equal(nan_dump.warp_trace(dump, "cpu")[-1, 9:], expected)
    dump.tensors["qacc_warmstart"].zero_()
    assert (nan_dump.warp_trace(dump, "cpu")[-1, 9:] != expected).any()

    file.unlink()
    env = made(file, engine=engine, protocol="dm_control", sim_dt=0.005)
    drive(env, actions, bad_action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    dump = nan_dump.load(file)
    dump.tensors["action"][2] = 0.0
    warp, c = nan_dump.warp_trace(dump, "cpu"), nan_dump.mujoco_trace(dump)
    assert warp.shape == c.shape == (6, 18)
    np.testing.assert_allclose(warp, c, atol=1e-3)
    assert np.abs(warp[-1] - warp[0]).max() > 1e-3


@for_each(("spoil", "said"), [(bad_action, "entry 2 is nan"), (too_fast, "C MuJoCo: not finite after")])
def test_command(file, actions, capsys, spoil, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = made(file)
    drive(env, actions, spoil)
    with pytest.warns(NonFiniteWarning):
        env.close()
    capsys.readouterr()
    with pytest.raises(SystemExit):
        cli.main(["inspect", str(file), "--device", "cuda:9"])
    assert capsys.readouterr().out == ""  # refused before the first line
    file.rename(file.with_name("nan_dump.safetensors"))  # as in the folder of a run
    assert cli.main(["inspect", str(file.parent), "--device", "cpu"]) == 0
    file.with_name("nan_dump.safetensors").rename(file)
    out = capsys.readouterr().out
    assert f"world {BAD} of {WORLDS} on cpu, episode 1, after 3 steps" in out
    assert said in out
    assert [path.name for path in tmp_path.iterdir()] == [file.name]  # C MuJoCo would leave a log
    file.unlink()


class Hooked(torchrl_loco.WalkerWalk):
    """Its third reward is not finite in one world."""

    def reward(self, s):
        return torch.where((s.env_index == BAD) & (s.time > 0.06), torch.nan, 1.0)


def test_a_hook_that_gives_what_is_not_finite_is_told_from_the_physics(file, actions):
    env = Hooked(WORLDS, "cpu", 7, nan_dump=file, engine="mujoco", compile_hooks=False)
    td = env.reset()
    for action in actions(env, 4):
        td = stepped(env, td, action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    *_, said = nan_dump.describe(nan_dump.load(file))
    assert said == "state, action and physics are finite: reward gave what is not"


class Remembers(torchrl_loco.WalkerWalk):
    """What is not finite is of the time that it remembers."""

    memory = {"since": ()}

    def update(self, s):
        return {"since": s.since + s.dt}

    def reward(self, s):
        return {"period": s.dt / s.since, "left": (0.06 - s.since).sqrt()}


def test_memory_is_not_in_the_file_which_is_said(file, actions):
    env = Remembers(WORLDS, "cpu", 7, nan_dump=file)
    td = env.reset()
    for action in actions(env, 4):
        td = stepped(env, td, action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    said = list(nan_dump.describe(nan_dump.load(file)))
    assert said[1].startswith("memory, and what worlds share, are not in the file: hooks see zeros")
    assert said[-1].endswith(
        "a hook (control, reward, observation, memory) gave what is not; with zeros as memory: none"
    )


class Deep(torchrl_loco.WalkerWalk):
    """One of two terms is the root of what is negative where a world has turned."""

    def reward(self, s):
        return {"alive": torch.ones_like(s.time), "depth": (0.5 - s.qpos[:, 2].abs()).sqrt()}


def test_a_term_that_is_not_finite_is_named(file, actions):
    env = Deep(WORLDS, "cpu", 7, nan_dump=file)
    td = env.reset()
    state = env.get_state()
    state["qpos"][:, 2] = 0.0
    state["qpos"][BAD, 2] = 1.0
    td = env.reset(state, set_state=True)
    stepped(env, td, actions(env, 1)[0])
    with pytest.warns(NonFiniteWarning):
        env.close()
    *_, said = nan_dump.describe(nan_dump.load(file))
    assert said == "state, action and physics are finite: reward['depth'] gave what is not"


def test_a_state_written_from_outside_is_recognised(file):
    env = made(file)
    td = env.reset()
    env.sim.qvel[BAD, 3] = float("nan")
    stepped(env, td, env.action_spec.zero())
    with pytest.warns(NonFiniteWarning):
        env.close()
    *_, entry, end = nan_dump.describe(nan_dump.load(file))
    assert "qvel is not finite before the step: entry 3 is nan" in entry
    assert "already non-finite" in end


def test_files_that_are_no_nan_dump(file, tmp_path, capsys):
    file.write_text("nothing")
    with pytest.raises(ValueError, match="cannot be read as a NaN dump"):
        nan_dump.load(file)
    storage.save(file, "policy", {"x": torch.zeros(1)}, {})
    with pytest.raises(SystemExit):
        cli.main(["inspect", str(file)])
    assert "its format is 'torchrl_loco policy 1'" in capsys.readouterr().err
    storage.save(file, NAN_DUMP, {}, {"env": "Ant", "config": {}, "seed": 0, "protocol": "playground"})
    with pytest.raises(
        ValueError, match=r"is of 'Ant', which is not there; installed are torchrl_loco\.tasks\.cheetah\.CheetahRun"
    ):
        nan_dump.load(file)
    with pytest.raises(FileNotFoundError, match="there is no NaN dump"):
        nan_dump.load(tmp_path / "none")


def test_an_overflow_that_raises_does_not_keep_the_file_from_being_written(file):
    options = {"engine": "mujoco_warp", "njmax": 5, "on_overflow": "raise", "nan_dump": file, **COARSE}
    env = torchrl_loco.make("humanoid_stand", 2, "cpu", 0, **options)
    td = env.reset()
    for _ in range(60):
        td = stepped(env, td, env.action_spec.zero())
    stepped(env, td, torch.full_like(env.action_spec.zero(), float("nan")))
    with pytest.warns(NonFiniteWarning), pytest.raises(torchrl_loco.PhysicsOverflowError):
        env.close()
    assert nan_dump.load(file).settings["elapsed_steps"] == 60
    assert env.is_closed
    with pytest.raises(RuntimeError, match="is closed"):
        env.get_state()


def test_the_path_does_not_follow_the_working_directory(tmp_path, monkeypatch, actions):
    monkeypatch.chdir(tmp_path)
    env = made("dump.safetensors")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    drive(env, actions, bad_action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    assert (tmp_path / "dump.safetensors").exists()


def test_a_failed_write_leaves_no_empty_file(file, actions, monkeypatch):
    env = made(file)
    drive(env, actions, bad_action)
    monkeypatch.setattr(storage, "save", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.close()
    assert not file.exists()
