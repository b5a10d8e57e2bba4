"""Robots that follow motions: the task by formula in C MuJoCo, starts and ends of episodes, what its files hold."""

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import torchrl_loco as loco
from torchrl_loco import Motion, cli, motion
from torchrl_loco.sim import models
from torchrl_loco.tasks import tracking
from torchrl_loco.tasks.tracking import FOLLOWED, PENALTIES, PIECES, G1Tracking, H1Tracking

PUNCHES = H1Tracking.motion_folder / "punches.csv"
PLAIN = {"engine": "mujoco", "compile_hooks": False}
"""What makes worlds that are hardly stepped: nothing is compiled."""
MANY = 500
"""Worlds of which shares are counted."""
EXAMPLE = Path(__file__).parents[1] / "examples" / "follow_motion.py"


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Two motions of 10 and 15 frames of 25 Hz, in which the H1 stands almost still."""
    folder, rows = tmp_path_factory.mktemp("short"), np.loadtxt(PUNCHES, delimiter=",")
    for name, count in (("a", 10), ("b", 15)):
        np.savetxt(folder / f"{name}.csv", rows[:count], delimiter=",")
    return folder


@pytest.fixture(scope="module")
def h1(short):
    options = {"play": True, "motion": short, "fps": 25, "metrics": True, "reward_terms": True}
    return loco.make("h1_tracking", 6, "cpu", 0, **options, **PLAIN)


def rotation(mat):
    """The angle of a rotation matrix (rad)."""
    return np.arccos(np.clip((np.trace(mat) - 1.0) / 2.0, -1.0, 1.0))


def by_formula(env, qpos, qvel, frame, action, last_action):
    """The terms of the reward of one world, in float64, from C MuJoCo."""
    m, f = env.mj_model, env.frames
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = qpos, qvel
    mujoco.mj_forward(m, d)
    names, anchor = list(env.bodies), list(env.bodies).index(env.anchor)
    ids = [m.body(name).id for name in names]
    pos, mat = d.xpos[ids], d.xmat[ids].reshape(-1, 3, 3)
    velocity = np.zeros((len(ids), 6))
    for row, i in zip(velocity, ids, strict=True):
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, i, row, 0)
    wanted, frames = f.pos[frame].astype(float), f.mat[frame].astype(float)
    turn = mat[anchor] @ frames[anchor].T
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    about = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    moved = np.array([*pos[anchor, :2], wanted[anchor, 2]]) + (wanted - wanted[anchor]) @ about.T
    squared = {
        "anchor_position": ((wanted - pos)[anchor] ** 2).sum(),
        "anchor_orientation": rotation(mat[anchor].T @ frames[anchor]) ** 2,
        "body_positions": ((moved - pos) ** 2).sum(1).mean(),
        "body_orientations": np.mean([rotation(a.T @ about @ b) ** 2 for a, b in zip(mat, frames, strict=True)]),
        "body_velocities": ((f.lin[frame] - velocity[:, 3:]) ** 2).sum(1).mean(),
        "body_turn_rates": ((f.ang[frame] - velocity[:, :3]) ** 2).sum(1).mean(),
    }
    terms = {name: weight * np.exp(-squared[name] / sigma**2) for name, (weight, sigma) in FOLLOWED.items()}
    low, high = m.jnt_range[1:].T
    beyond = np.abs(qpos[7:] - 0.5 * (low + high)) - 0.45 * (high - low)
    terms["action_rate"] = PENALTIES["action_rate"] * ((action - last_action) ** 2).sum()
    terms["joint_limits"] = PENALTIES["joint_limits"] * beyond.clip(min=0.0).sum()
    return {name: 0.02 * value for name, value in terms.items()}


def test_terms_are_those_of_the_formula(device):
    env = loco.make("h1_tracking", 8, device, 3, reward_terms=True, metrics=True, randomize=[])
    td = env.reset()
    last = torch.zeros(8, 19, device=device)
    for _ in range(12):
        frame = env.world.memory["frame"].cpu()
        action = 0.5 * torch.randn(8, 19, device=device)
        state = env.step(td.set("action", action))["next"]
        pushed = env.world.memory["until_push"] > 0.98  # velocities of the observation are those after a push
        for k in np.flatnonzero(~pushed.cpu().numpy())[:3]:
            rows = (env.sim.qpos, env.sim.qvel, action, last)
            qpos, qvel, now, before = (row[k].cpu().numpy().astype(float) for row in rows)
            wanted = by_formula(env, qpos, qvel, int(frame[k]), now, before)
            for name, value in wanted.items():
                assert state["reward_terms", name][k].item() == pytest.approx(value, abs=2e-5), name
        assert torch.allclose(state["reward"], sum(state["reward_terms"].values()), atol=1e-5)
        last, td = action, state.exclude("reward")


def test_worlds_to_play_with_begin_with_their_own_clip_and_end_with_it(h1, short):
    td = h1.reset()
    assert h1.cases() == {"a": 18, "b": 28}
    first = torch.tensor([0, 19] * 3)
    assert torch.equal(h1.world.memory["frame"].long(), first)
    assert torch.allclose(h1.sim.qpos, torch.tensor(h1.frames.qpos)[first], atol=1e-6)
    assert torch.allclose(h1.sim.qvel, torch.tensor(h1.frames.qvel)[first], atol=1e-6)
    seen = td["observation"]
    sizes = h1.observation_layout["observation"]
    terms = dict(zip(sizes, seen.split(list(sizes.values()), dim=-1), strict=True))
    assert terms["anchor_position"].abs().max() < 1e-6
    assert torch.allclose(terms["anchor_orientation"], torch.eye(3)[:, :2].flatten().expand(6, 6), atol=1e-5)
    assert torch.allclose(terms["reference_joints"], h1.sim.qpos[:, 7:], atol=1e-6)
    ended = torch.zeros(6, dtype=torch.long)
    for step in range(1, 30):
        td = h1.step(td.set("action", torch.zeros(6, 19)))["next"].exclude("reward")
        assert not td["terminated"].any()
        ended = torch.where((ended == 0) & td["truncated"].squeeze(-1), step, ended)
    assert ended.tolist() == [18, 28] * 3


def test_clip_and_phase_can_be_set(h1):
    td = h1.reset()
    h1.set_command(1.0, "clip")  # of world 0, and on from there
    h1.set_command(0.5, "phase")
    for _ in range(2):  # it is set in the first step, and begins in the second
        td = h1.step(td.set("action", torch.zeros(6, 19)))["next"].exclude("reward")
    assert h1.world.memory["frame"].tolist() == [19 + 14, 9] * 3
    assert torch.allclose(h1.sim.qpos, torch.tensor(h1.frames.qpos)[[33, 9] * 3], atol=1e-6)
    td = h1.reset()
    assert h1.world.memory["frame"].tolist() == [33, 9] * 3
    h1.set_command(None, "clip")
    h1.set_command(None, "phase")
    h1.step(td.set("action", torch.zeros(6, 19)))
    h1.reset()
    assert h1.world.memory["frame"].tolist() == [0, 19] * 3


def test_the_reference_is_shown_beside_the_robot(h1):
    h1.reset()
    frame = h1.world.memory["frame"].long()
    assert torch.allclose(h1.ghost(), torch.tensor(h1.frames.qpos)[frame])
    model = h1.model_with_ghost
    assert model.nq == 2 * h1.mj_model.nq
    assert model.nu == h1.mj_model.nu
    shown = h1.render(worlds=2, width=64, height=48)
    td = h1.reset()
    for _ in range(10):
        td = h1.step(td.set("action", torch.ones(6, 19)))["next"].exclude("reward")
    apart = h1.render(worlds=2, width=64, height=48)
    green = (apart[..., 1].int() - apart[..., 0].int() > 25).sum()
    assert green > (shown[..., 1].int() - shown[..., 0].int() > 25).sum()


def test_starts_follow_failures(device):
    env = loco.make("h1_tracking", MANY, device, 1, randomize=[], sim_dt=0.02)
    tables, pieces = env.hooks.catalog.constants, env.pieces
    share, piece_of, ends = tables["piece_share"], tables["piece_of"].long(), tables["clip_last"]

    def drawn():
        env.reset()
        frame = env.world.memory["frame"].long()
        assert (frame < ends[torch.searchsorted(ends, frame)]).all()
        return torch.bincount(piece_of[frame], minlength=PIECES) / MANY

    assert (drawn() - share).abs().max() < 0.04  # nothing is known: anywhere
    shared = env.world.shared
    shared["recent"][0, :pieces], shared["recent"][1, 5] = 1e6, 1e5
    env.step(env.rand_action())
    found = drawn()
    assert found[5].item() == pytest.approx((1.0 - tracking.UNIFORM) / (1.0 + tracking.BEFORE), abs=0.1)
    assert found[4].item() == pytest.approx(
        tracking.BEFORE * (1.0 - tracking.UNIFORM) / (1.0 + tracking.BEFORE), abs=0.1
    )
    for entry in ("visits", "failures", "counted", "recent"):
        shared[entry].zero_()
    before = env.world.memory["frame"].long()
    td = env.step(env.rand_action())["next"]
    lost = td["terminated"].squeeze(-1)
    visits = torch.bincount(piece_of[before], minlength=PIECES)
    failures = torch.bincount(piece_of[before][lost], minlength=PIECES)
    assert torch.equal(shared["visits"], visits)
    assert torch.equal(shared["failures"], failures)
    # What other ranks have counted comes in once, and fades as the own.
    shared["visits"] += 3 * visits
    env.step(env.rand_action())
    own = shared["visits"] - 4 * visits
    assert torch.allclose(shared["recent"][0], tracking.MEMORY * visits + 3.0 * visits + own, atol=1e-3)


def test_what_is_seen():
    whole = loco.make("g1_tracking", 2, "cpu", 0, play=True, future=(1, 400), **PLAIN)
    without = loco.make("g1_tracking_no_estimation", 2, "cpu", 0, play=True, **PLAIN)
    sizes = whole.observation_layout["observation"]
    own = without.observation_layout["observation"]
    assert sizes.keys() - own.keys() == {"anchor_position", "linear_velocity", "ahead"}
    assert {"anchor_position", "linear_velocity"} < without.observation_layout["privileged"].keys()
    td = whole.reset()
    terms = dict(zip(sizes, td["observation"].split(list(sizes.values()), dim=-1), strict=True))
    f = whole.frames
    frames = np.minimum(f.first[:2, None] + np.array([1, 400]), f.last[:2, None])
    ahead = terms["ahead"].view(2, 2, 29 + 29 + 10)
    assert torch.allclose(ahead[..., :29], torch.tensor(f.qpos[frames, 7:]), atol=1e-6)
    assert torch.allclose(ahead[..., 29:58], torch.tensor(f.qvel[frames, 6:]), atol=1e-5)
    assert torch.allclose(ahead[..., 58], torch.tensor(f.qpos[frames, 2]), atol=1e-6)
    upright = torch.tensor(f.mat[frames, whole.bodies.index("pelvis")])[..., 2, :]
    assert torch.allclose(ahead[..., 59:62], -upright, atol=1e-6)


def test_actions_come_a_step_late_in_every_other_episode_if_asked_for():
    env = loco.make("h1_tracking", 100, "cpu", 0, max_delay=1, **PLAIN)
    td = env.reset()
    is_late = env.world.memory["delay"] == 1.0
    assert 30 < is_late.sum() < 70
    assert ((env.world.memory["delay"] == 0.0) | is_late).all()
    first, second = 0.1 * torch.randn(2, 100, 19)
    td = env.step(td.set("action", first))["next"]
    goes_on = ~td["done"].squeeze(-1)
    env.step(td.exclude("reward").set("action", second))
    arrived = torch.where(is_late.unsqueeze(-1), first, second)
    torch.testing.assert_close(env.sim.ctrl[goes_on], targets_of(env, arrived)[goes_on])
    assert not loco.make("h1_tracking", 9, "cpu", 0, play=True, max_delay=1, **PLAIN).world.memory["delay"].any()
    with pytest.raises(ValueError, match="max_delay must lie in"):
        loco.make("h1_tracking", 1, "cpu", 0, max_delay=2)
    with pytest.raises(ValueError, match="the delay that holds names of Later must lie in"):
        type("Later", (H1Tracking,), {"holds": {**H1Tracking.holds, "delay": (0, 2)}})(1, "cpu")


def targets_of(env, action):
    """Returns the targets of the joints that actions mean (rad)."""
    facts = env.facts(env.mj_model, {})
    return torch.tensor(facts["action_offset"]) + torch.tensor(facts["action_scale"]) * action


def test_a_robot_that_does_not_fit_is_refused(short):
    spec = models.specification(H1Tracking.model)
    spec.delete(spec.actuators[0])
    unfit = [
        ({"anchor": "left_knee"}, "must hold base, anchor and ends, but not left_knee"),
        ({"bodies": (*H1Tracking.bodies, "pelvis")}, "bodies of Other has 'pelvis' twice"),
        ({"bodies": (*H1Tracking.bodies, "left_ankl")}, "it has no body 'left_ankl', did you mean"),
        ({"bodies": H1Tracking.bodies[::-1]}, "the first of bodies of Other must be the base"),
        ({"model": spec, "memory": tracking.memory(18)}, "an actuator for each joint, in their order: left_hip_yaw"),
        ({"memory": tracking.memory(18)}, "memory is that of 18 joints, but it has 19 actuators"),
    ]
    for given, message in unfit:
        with pytest.raises(ValueError, match=message):
            type("Other", (H1Tracking,), given)(1, "cpu", **PLAIN)
    with pytest.raises(TypeError, match="Bare must set base, anchor, bodies, ends: see help"):
        type("Bare", (tracking.Tracking,), {"model": H1Tracking.model})(1, "cpu", **PLAIN)
    table = {name: vars(H1Tracking)[name] for name in ("model", "config", "memory", "base", "anchor", "bodies", "ends")}
    still = type("Still", (tracking.Tracking,), {**table, "action_scale": 0.25})
    with pytest.raises(ValueError, match="Still has no motions of its own: pass motion, or set motion_folder"):
        still(1, "cpu", **PLAIN)
    assert still(1, "cpu", motion=short, fps=25, **PLAIN).frames.names == ("a", "b")


def test_motions_are_given_as_files_and_objects_and_wrong_ones_are_refused(tmp_path, short):
    given = Motion(short / "a.csv", fps=25, ground=True, weight=2.0)
    one = loco.make("h1_tracking", 1, "cpu", 0, motion=given, **PLAIN)
    assert list(one.cases()) == ["a"]
    again = loco.make("h1_tracking", 1, "cpu", 0, **PLAIN, **json.loads(json.dumps(one.options_given)))
    assert np.array_equal(again.frames.qpos, one.frames.qpos)
    assert again.frames.weights.tolist() == [2.0]
    other = loco.make("h1_tracking", 1, "cpu", 0, motion=short, fps=25, **PLAIN)
    with pytest.raises(ValueError, match="cases"):  # its memory points into other tables
        other.load_state_dict(one.state_dict())
    with pytest.raises(FileNotFoundError, match="there is no motion"):
        loco.make("h1_tracking", 1, "cpu", 0, motion=tmp_path / "none")
    with pytest.raises(ValueError, match="the robot has 29"):
        loco.make("g1_tracking", 1, "cpu", 0, motion=short, fps=25)
    with pytest.raises(ValueError, match="pass fps"):
        loco.make("h1_tracking", 1, "cpu", 0, motion=short)
    with pytest.raises(ValueError, match="unknown argument 'motions', did you mean 'motion'"):
        loco.make("h1_tracking", 1, "cpu", 0, motions=short)
    assert loco.make("h1_tracking", 1, "cpu", 0, future=3, **PLAIN).future == (3,)
    assert loco.make("h1_tracking", 1, "cpu", 0, future=range(1, 3), **PLAIN).future == (1, 2)
    other = {**H1Tracking.options, "motion": (str(short), "Short ones."), "fps": (25.0, "Theirs.")}
    assert list(type("Others", (H1Tracking,), {"options": other})(1, "cpu", 0, **PLAIN).cases()) == ["a", "b"]
    ahead = type("Ahead", (H1Tracking,), {"options": {**H1Tracking.options, "future": ((1, 2), "Frames.")}})
    env = ahead(1, "cpu", 0, **PLAIN)
    assert (list(env.future), ahead.facts(env.mj_model, {})["tracking"]["future"]) == ([1, 2], [1, 2])
    sees = type("Sees", (loco.H1Tracking,), {"future": (1, 2)})  # as a class's attribute
    assert (sees(1, "cpu", 0, **PLAIN).future, sees(1, "cpu", 0, future=(), **PLAIN).future) == ((1, 2), ())
    for future in ((-1,), (0,), ("a",), 1.5):
        with pytest.raises(ValueError, match="future must be whole numbers"):
            loco.make("h1_tracking", 1, "cpu", 0, future=future)
    with pytest.raises(ValueError, match="twice"):
        loco.make("h1_tracking", 1, "cpu", 0, future=(1, 1))
    with pytest.raises(ValueError, match="names none"):
        loco.make("h1_tracking", 1, "cpu", 0, motion=[])
    with pytest.raises(ValueError, match="motion: options are those of the environment"):
        loco.training.train(one, motion=short, total_frames=1)
    with pytest.raises(ValueError, match="has no options"):
        loco.WalkerStand.checked_options({"motion": 1})


@pytest.mark.ci
def test_from_a_clip_to_a_file_that_plays_without_torch(tmp_path, short, capsys):
    settings = {"num_envs": 16, "num_steps": 8, "total_frames": 256, "minibatch_size": 64, "eval_episodes": 2}
    arguments = [f"--{name}={value}" for name, value in {**settings, "video_seconds": 0}.items()]
    options = ["--motion", str(short), "--fps", "25", "--future", "1", "3"]
    cli.main(["train", "h1_tracking", *options, *arguments, "--out", str(tmp_path)])
    (run,) = tmp_path.iterdir()
    config = json.loads((run / "config.json").read_text())
    assert config["options"] == {"motion": [str(short)], "fps": 25.0, "future": [1, 3]}
    info = loco.Policy.load(run / "policy.safetensors", "cpu").info
    assert info["options"] == config["options"]
    assert "stage" not in info
    (short / "a.csv").rename(tmp_path / "a.csv")  # the clip of the run is elsewhere now
    (short / "b.csv").rename(tmp_path / "b.csv")
    tracking._tables.clear()  # of this process
    with pytest.raises(SystemExit):
        cli.main(["eval", str(run), "--episodes", "2"])
    with pytest.raises(SystemExit):  # its worlds are in the midst of other tables
        cli.main(["resume", str(run), "--total_frames", "512", "--motion", str(tmp_path / "a.csv"), "--fps", "25"])
    assert "is a run of 2 case(s), a (" in capsys.readouterr().err
    (tmp_path / "b.csv").rename(tmp_path / "renamed.csv")
    there = ["--motion", str(tmp_path / "a.csv"), str(tmp_path / "renamed.csv"), "--fps", "25"]
    cli.main(["resume", str(run), "--total_frames", "512", *there])
    header, *_ = (run / "metrics.csv").read_text().splitlines()
    assert "metric/body_error" in header
    cli.main(["verify", str(run), "--episodes", "1"])  # so short a motion is survived without having learned
    printed = capsys.readouterr().out
    assert "2 in all" in printed
    figures = json.loads((run / "verify.json").read_text())["cases"]
    for name in ("a", "renamed"):
        ours, theirs = (figures[engine][name]["return"] for engine in ("training simulator", "C MuJoCo"))
        assert ours == pytest.approx(theirs, abs=0.02)
    cli.main(["export", str(run), "--out", str(tmp_path / "h1.onnx")])
    done = subprocess.run(
        [sys.executable, EXAMPLE, tmp_path / "h1.onnx", "--clip", "renamed"], capture_output=True, text=True, check=True
    )
    assert "renamed: bodies were 0." in done.stdout


def test_tables_of_the_package_are_those_of_its_models():
    for cls in (G1Tracking, H1Tracking):
        env = loco.make(cls, 1, "cpu", 0, **PLAIN)
        assert env.bodies[0] == env.base
        assert len(env.cases()) == 3
        assert not env.frames.said
        assert set(env.reference()) >= {"joint_pos", "body_quat_w"}
        pos, mat = motion.poses(env.mj_model, env.frames.qpos.astype(float))
        assert motion.lowest_points(env.mj_model, pos, mat).min() > -motion.SUNK
