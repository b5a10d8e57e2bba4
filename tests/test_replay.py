"""The first bad world is caught, kept in a file, and can be stepped again."""

import numpy as np
import pytest
import torch

import torchrl_loco
from torchrl_loco import NonFiniteWarning, cli, replay, storage
from torchrl_loco.envs.watcher import INTERVAL

WORLDS, BAD = 6, 4


@pytest.fixture
def file(tmp_path):
    return tmp_path / "bad.safetensors"


def made(file, device="cpu", **options):
    return torchrl_loco.make("walker_walk", WORLDS, device, 7, bad_world_file=file, **options)


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


@pytest.mark.parametrize("spoil", [bad_action, too_fast])
def test_the_file_holds_what_the_step_began_with(device, file, actions, spoil):
    env = made(file, device, njmax=90)
    state, action, _ = drive(env, actions, spoil)
    with pytest.warns(NonFiniteWarning, match=rf"world {BAD} was no longer finite at step 4 of its episode.*bad\.safe"):
        env.close()
    world = replay.load(file)
    for name in ("qpos", "qvel", "qacc_warmstart"):
        assert torch.equal(world.tensors[name], state[name][BAD].cpu()), name
    torch.testing.assert_close(world.tensors["action"], action[BAD].cpu(), rtol=0, atol=0, equal_nan=True)
    settings = world.settings
    assert (settings["world"], settings["episode"], settings["elapsed_steps"], settings["seed"]) == (BAD, 1, 3, 7)
    assert (settings["env"], settings["protocol"], settings["config"]["njmax"]) == (
        "torchrl_loco.envs.walker.WalkerWalk",
        "playground",
        90,
    )


def test_only_the_first_is_kept(file, actions):
    env = made(file)
    state, _, td = drive(env, actions, too_fast)
    for world in (0, BAD):
        action = env.action_spec.zero()
        action[world] = float("inf")
        td = stepped(env, td, action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    assert torch.equal(replay.load(file).tensors["qvel"], state["qvel"][BAD])


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
    for _ in range(INTERVAL - 5):  # the resets are no steps: 4 are done
        td = stepped(env, td, zero)
    assert not file.exists()
    if device == "cuda":
        td = stepped(env, td, zero)  # starts the look, which has arrived after
        torch.cuda.synchronize()
    with pytest.warns(NonFiniteWarning):
        stepped(env, td, zero)
    assert file.exists()


def test_nothing_is_written_where_nothing_happens(file):
    env = made(file)
    env.rollout(INTERVAL + 1)
    env.close()
    assert not file.exists()


def test_nothing_is_overwritten(file, tmp_path, actions):
    env = made(file)
    drive(env, actions, bad_action)
    file.write_text("evidence")
    with pytest.warns(NonFiniteWarning, match="already there and was left as it is"):
        env.close()
    assert file.read_text() == "evidence"
    with pytest.raises(ValueError, match="is already there: move it away"):
        made(file)
    with pytest.raises(ValueError, match="there is no folder"):
        made(tmp_path / "no" / "file")
    with pytest.raises(TypeError):
        made(3)


def test_catching_changes_no_rollout(file, actions):
    env, plain = made(file), torchrl_loco.make("walker_walk", WORLDS, "cpu", 7)
    td, expected = env.reset(), plain.reset()
    for action in actions(env, 10):
        td, expected = stepped(env, td, action), stepped(plain, expected, action)
    assert torch.equal(td["observation"], expected["observation"])


@pytest.mark.parametrize("substeps", [10, 5])
def test_warp_replays_what_happened_and_c_goes_its_own_way(file, actions, substeps):
    """A state that is bad after the last substep was good before it; slow ones agree in both."""
    env = made(file, protocol="dm_control", sim_dt=0.025 / substeps)
    drive(env, actions, bad_action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    world = replay.load(file)
    world.tensors["action"][2] = 0.0  # mended, the step is an ordinary one
    warp, c = replay.warp_trace(world, "cpu"), replay.c_trace(world)
    assert warp.shape == c.shape == (substeps + 1, 18)
    np.testing.assert_allclose(warp, c, atol=1e-3)
    assert np.abs(warp[-1] - warp[0]).max() > 1e-3


def test_the_replay_goes_on_from_the_solvers_warm_start(file, actions):
    """From a wrong one, the few iterations of ``playground`` do not lead all the way back."""

    def astray(state, action):
        state["qacc_warmstart"][BAD] = 1e4
        bad_action(state, action)

    env = made(file)
    state, action, _ = drive(env, actions, astray)
    action[BAD, 2] = 0.0
    stepped(env, env.reset(state, set_state=True), action)
    expected = env.get_state()["qvel"][BAD].numpy()
    with pytest.warns(NonFiniteWarning):
        env.close()
    world = replay.load(file)
    world.tensors["action"][2] = 0.0
    np.testing.assert_array_equal(replay.warp_trace(world, "cpu")[-1, 9:], expected)
    world.tensors["qacc_warmstart"].zero_()
    assert (replay.warp_trace(world, "cpu")[-1, 9:] != expected).any()


@pytest.mark.parametrize(("spoil", "told"), [(bad_action, "entry 2 is nan"), (too_fast, "C MuJoCo: not finite after")])
def test_command(file, actions, capsys, spoil, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = made(file)
    drive(env, actions, spoil)
    with pytest.warns(NonFiniteWarning):
        env.close()
    with pytest.raises(SystemExit):
        cli.main(["replay", str(file), "--device", "cuda:9"])
    assert capsys.readouterr().out == ""  # refused before the first line
    assert cli.main(["replay", str(file), "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert f"world {BAD} of {WORLDS} on cpu, episode 1, after 3 steps" in out
    assert told in out
    assert [path.name for path in tmp_path.iterdir()] == [file.name]  # C MuJoCo would leave a log


def test_a_state_written_from_outside_is_told(file):
    env = made(file)
    td = env.reset()
    env.sim.qvel[BAD, 3] = float("nan")
    stepped(env, td, env.action_spec.zero())
    with pytest.warns(NonFiniteWarning):
        env.close()
    assert list(replay.describe(replay.load(file)))[-1].startswith("it was written into the simulation from outside")


def test_files_that_are_something_else(file, tmp_path, capsys):
    for text in ("", "nothing"):
        file.write_text(text)
        with pytest.raises(ValueError, match="cannot be read as a bad world"):
            replay.load(file)
    storage.save(file, "policy", {"x": torch.zeros(1)}, {})
    with pytest.raises(SystemExit):
        cli.main(["replay", str(file)])
    assert "its format is 'torchrl_loco policy 1'" in capsys.readouterr().err
    storage.save(file, "bad world", {}, {"env": "Cheetah"})
    with pytest.raises(ValueError, match=r"is of 'Cheetah', there are torchrl_loco\.envs\.walker\.WalkerStand"):
        replay.load(file)
    with pytest.raises(FileNotFoundError, match="there is no bad world"):
        replay.load(tmp_path / "none")


def test_a_huge_action_is_named(file):
    env = made(file)
    action = env.action_spec.zero()
    action[BAD, 1] = 1e30
    stepped(env, env.reset(), action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    lines = list(replay.describe(replay.load(file), "cpu"))
    assert any("action is not finite before the step: entry 1 is" in line for line in lines), lines


def test_an_overflow_that_raises_does_not_keep_the_file_from_being_written(file):
    env = torchrl_loco.make("humanoid_stand", 2, "cpu", 0, njmax=5, on_overflow="raise", bad_world_file=file)
    td = env.reset()
    for _ in range(60):
        td = stepped(env, td, env.action_spec.zero())
    stepped(env, td, torch.full_like(env.action_spec.zero(), float("nan")))
    with pytest.warns(NonFiniteWarning), pytest.raises(torchrl_loco.PhysicsOverflowError):
        env.close()
    assert replay.load(file).settings["elapsed_steps"] == 60
    assert env.is_closed
    with pytest.raises(RuntimeError, match="is closed"):
        env.get_state()


def test_the_path_is_that_of_the_moment(tmp_path, monkeypatch, actions):
    monkeypatch.chdir(tmp_path)
    env = made("bad.safetensors")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    drive(env, actions, bad_action)
    with pytest.warns(NonFiniteWarning):
        env.close()
    assert (tmp_path / "bad.safetensors").exists()


def test_a_failed_write_leaves_no_empty_file(file, actions, monkeypatch):
    env = made(file)
    drive(env, actions, bad_action)
    monkeypatch.setattr(storage, "save", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.close()
    assert not file.exists()
