"""Motions: read from files, refused where something is wrong, resampled, and what is found of them."""

import copy

import mujoco
import numpy as np
import pytest
from for_each import for_each

from torchrl_loco import Motion, cli
from torchrl_loco import motion as motions
from torchrl_loco.envs.task import folder_of
from torchrl_loco.sim import models
from torchrl_loco.tasks.tracking import OWN_RATE, G1Tracking

PUNCHES = G1Tracking.motion_folder / "punches.csv"


@pytest.fixture(scope="module")
def g1():
    return models.load(G1Tracking.model, folder_of(G1Tracking))


@pytest.fixture(scope="module")
def rows():
    return np.loadtxt(PUNCHES, delimiter=",")


def written(folder, table, name="clip.csv", header=""):
    np.savetxt(folder / name, table, delimiter=",", header=header, comments="")
    return folder / name


def tables_of(path):
    with np.load(path) as file:
        return dict(file)


def as_npz(folder, m, rows, **changes):
    """Returns an npz of a motion's rows, with some arrays changed."""
    path = folder / "clip.npz"
    motions.save(path, rows[:, [0, 1, 2, 6, 3, 4, 5, *range(7, 36)]], 50.0, m)
    tables = tables_of(path)
    np.savez(path, **{**{key: value for key, value in tables.items() if key not in changes}, **changes})
    return path


def test_a_csv_becomes_poses_of_the_model(tmp_path, g1, rows):
    motion = Motion(PUNCHES, fps=OWN_RATE)
    q, said = motion.on(g1)
    assert np.allclose(q[:, :3], rows[:, :3])
    assert np.allclose(q[:, 3:7], rows[:, [6, 3, 4, 5]], atol=1e-3)
    assert np.allclose(q[:, 7:], rows[:, 7:])
    assert np.allclose(np.linalg.norm(q[:, 3:7], axis=1), 1.0, atol=1e-12)
    assert said == []
    assert motion.seconds == pytest.approx((len(rows) - 1) / OWN_RATE)
    # The joints in another order, with their names.
    order = np.random.default_rng(0).permutation(29)
    names = [g1.joint(1 + j).name for j in order]
    header = ",".join(["x", "y", "z", "qx", "qy", "qz", "qw", *names])
    mixed = written(tmp_path, np.concatenate([rows[:, :7], rows[:, 7:][:, order]], axis=1), header=header)
    assert np.allclose(Motion(mixed, fps=OWN_RATE).on(g1)[0], q)


def test_an_npz_of_mjlabs_kind_is_read_back(tmp_path, g1):
    q, _ = Motion(PUNCHES, fps=OWN_RATE).on(g1)
    motions.save(tmp_path / "clip.npz", q, OWN_RATE, g1)
    again = Motion(tmp_path / "clip.npz")
    assert again.fps == OWN_RATE
    assert np.abs(again.on(g1)[0] - q).max() < 1e-6


def test_what_is_no_motion_is_refused(tmp_path, g1, rows):
    def changed(frame, column, value):
        table = rows.copy()
        table[frame, column] = value
        return written(tmp_path, table)

    joints = [g1.joint(i).name for i in range(1, g1.njnt)]
    for file, words in (
        (lambda: changed(7, 12, np.nan), "frame 7 .* not finite"),
        (lambda: changed(9, slice(3, 7), 0.1), "frame 9 must be a unit quaternion"),
        (lambda: changed(11, 0, 3.0), "moves at .* m/s after frame 1[01]"),
        (lambda: changed(3, 20, 90.0), "joints must be in radians"),
        (lambda: written(tmp_path, rows, header="x,y,z,qw,qx,qy,qz"), "in the order .* x, y, z, w"),
        (lambda: written(tmp_path, rows, header="x,y,z,w_quat,x_quat,y_quat,z_quat"), "in the order .* x, y, z, w"),
        (lambda: written(tmp_path, rows, header="x,y,z,qz,qy,qx,qw"), "in the order .* x, y, z, w"),
        (lambda: written(tmp_path, rows, header="pos.z,pos.x,pos.y,qx,qy,qz,qw"), "in the order x, y, z"),
        (lambda: written(tmp_path, np.vstack([np.arange(36), rows])), "numbers of its columns in line 1"),
        (
            lambda: written(tmp_path, np.column_stack([rows[:, 0], rows])),
            "of 37 columns the 4th to the 7th",
        ),
        (lambda: written(tmp_path, rows[:1]), "1 frames"),
        (lambda: written(tmp_path, rows[:0]), "none"),
        (lambda: written(tmp_path, rows[:, :6]), "rows of 6"),
        (lambda: written(tmp_path, rows[:, :20]), "13 joints, the robot has 29"),
        (lambda: written(tmp_path, rows, header=",".join(["x"] * 7 + ["knee"] * 29)), "no joint 'knee'"),
        (lambda: written(tmp_path, rows, header=",".join(["x"] * 7 + joints + joints[-1:])), "name each joint once"),
    ):
        with pytest.raises(ValueError, match=words):
            Motion(file(), fps=50.0).on(g1)
    (tmp_path / "ragged.csv").write_text("1,2,3,0,0,0,1,4\n1,2,3,0,0,0,1\n")
    with pytest.raises(ValueError, match="rows of 7 to 8 numbers"):
        Motion(tmp_path / "ragged.csv", fps=50.0)
    (tmp_path / "spaces.csv").write_text("1 2 3 0 0 0 1 4\n" * 2)
    with pytest.raises(ValueError, match="column 1, without a comma"):
        Motion(tmp_path / "spaces.csv", fps=50.0)
    for row in ("1,2,3,0,0,0,1,what", "#1,2,3,0,0,0,1,4"):
        (tmp_path / "words.csv").write_text(f"1,2,3,0,0,0,1,4\n{row}\n1,2,3,0,0,0,1,4\n")
        with pytest.raises(ValueError, match=r"in line 2, column [18]"):
            Motion(tmp_path / "words.csv", fps=50.0)
    (tmp_path / "gap.csv").write_text("1,2,3,0,0,0,1,,4\n1,2,3,0,0,0,1,4,4\n")  # is no header
    with pytest.raises(ValueError, match="'' in line 1, column 8"):
        Motion(tmp_path / "gap.csv", fps=50.0)
    with pytest.raises(ValueError, match="pass fps"):
        Motion(PUNCHES)
    with pytest.raises(TypeError, match="ground must be True or False"):
        Motion(PUNCHES, fps=50.0, ground="false")
    for wrong in ({"fps": 50.0}, {"path": PUNCHES, "clips": True}):
        with pytest.raises(ValueError, match="must have a path, and of fps, clip, ground, weight"):
            motions.read(wrong)
    (tmp_path / "clip.pkl").write_bytes(b"")
    with pytest.raises(ValueError, match="a pickle can run code"):
        Motion(tmp_path / "clip.pkl")
    with pytest.raises(FileNotFoundError):
        Motion(tmp_path / "none.csv", fps=50.0)
    motion = copy.deepcopy(Motion(PUNCHES, fps=OWN_RATE))
    with pytest.raises(AttributeError):  # it is read from its file again
        motion.qpos = np.zeros((5, 36))
    with pytest.raises(ValueError, match="read-only"):
        motion.qpos[0] = 0.0


def test_an_npz_that_does_not_fit_is_refused(tmp_path, g1, rows):
    with pytest.raises(ValueError, match="has 50 frames per second, not 60"):
        Motion(as_npz(tmp_path, g1, rows), fps=60.0)
    joints = rows[:, 7:][:, ::-1]
    names = np.array([])
    path = as_npz(tmp_path, g1, rows, joint_pos=joints, joint_names=names)
    with pytest.raises(ValueError, match=r"lies .* m from where the joints put it .* another order"):
        Motion(path).on(g1)
    fewer = {key: value[:, :20] for key, value in tables_of(path).items() if key.startswith("body_") and value.ndim > 2}
    few = np.array([g1.body(i).name for i in range(1, 21)])
    mixed = Motion(as_npz(tmp_path, g1, rows, joint_pos=joints, joint_names=names, body_names=few, **fewer))
    with pytest.raises(ValueError, match=r"lies .* another order"):  # by the names of its bodies
        mixed.on(g1)
    in_bytes = as_npz(tmp_path, g1, rows, joint_pos=joints, joint_names=names, body_names=few.astype("S"), **fewer)
    with pytest.raises(ValueError, match=r"lies .* another order"):  # as some writers have them
        Motion(in_bytes).on(g1)
    order, named = [1, 0, *range(2, 30)], tables_of(as_npz(tmp_path, g1, rows))
    turned = {key: named[key][:, order] for key in fewer}
    bodies = np.array([g1.body(1 + i).name for i in order])
    with pytest.raises(ValueError, match="the first body must be the base, 'pelvis'"):
        Motion(as_npz(tmp_path, g1, rows, body_names=bodies, **turned)).on(g1)
    unnamed = as_npz(tmp_path, g1, rows, joint_names=names, body_names=names, **fewer)
    assert any("could not be checked" in note for note in Motion(unnamed).on(g1)[1])
    torn = bytearray(path.read_bytes())
    torn[400:600] = bytes(200)
    for content in (b"", b"no archive", path.read_bytes()[:500], torn):
        (tmp_path / "broken.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.npz cannot be read"):
            Motion(tmp_path / "broken.npz")
    with pytest.raises(ValueError, match=r"body_quat_w \(frames, bodies, 4\)"):
        Motion(as_npz(tmp_path, g1, rows, body_quat_w=np.zeros((len(rows), 30, 3))))
    tables = {key: value for key, value in tables_of(path).items() if key != "body_quat_w"}
    np.savez(path, **tables)
    with pytest.raises(ValueError, match="lacks body_quat_w"):
        Motion(path)


def test_limits_and_the_ground_are_said_or_mended(tmp_path, g1, rows):
    knee = 7 + [g1.joint(1 + j).name for j in range(29)].index("left_knee_joint")
    most = g1.joint("left_knee_joint").range[1]
    table = rows.copy()
    table[:, 2] += 0.2
    table[20:30, knee] = most + 0.3
    path = written(tmp_path, table)
    _, said = Motion(path, fps=OWN_RATE).on(g1)
    assert any("left_knee_joint is 0.30 rad beyond its limit in frame 2" in note for note in said)
    assert any("floats" in note for note in said)
    q, said = Motion(path, fps=OWN_RATE, clip=True, ground=True).on(g1)
    assert not any("limit" in note or "floats" in note for note in said)
    assert q[:, knee].max() == pytest.approx(most)
    # What touches the ground now is what C MuJoCo finds there.
    data, deepest = mujoco.MjData(g1), 0.0
    for row in q:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(g1, data)
        floor = [contact.dist for contact in data.contact if 0 in g1.geom_bodyid[contact.geom]]
        deepest = min([deepest, *floor])
    assert deepest == pytest.approx(-motions.PENETRATES, abs=1e-6)
    table[:, 2] -= 0.3
    _, said = Motion(written(tmp_path, table), fps=OWN_RATE).on(g1)
    assert any("below the ground" in note for note in said)


def test_frames_are_those_of_the_control_step_and_their_velocities_mujocos(g1):
    bodies = [g1.body(i).name for i in range(1, g1.nbody)]
    frames = motions.Frames.of([Motion(PUNCHES, fps=OWN_RATE)] * 2, g1, bodies, 0.02)
    q, _ = Motion(PUNCHES, fps=OWN_RATE).on(g1)
    assert frames.last.tolist() == [348, 697]
    assert frames.first.tolist() == [0, 349]
    assert np.abs(frames.qpos[:349:2] - q).max() < 1e-6
    assert np.abs(frames.qpos[349:] - frames.qpos[:349]).max() == 0.0
    between = frames.qpos[1:348:2, 7:]
    assert np.abs(between - 0.5 * (q[1:, 7:] + q[:-1, 7:])).max() < 1e-6
    data, velocity = mujoco.MjData(g1), np.zeros(6)
    for k in range(1, 348, 13):
        wanted = np.zeros(g1.nv)
        mujoco.mj_differentiatePos(g1, wanted, 0.04, frames.qpos[k - 1].astype(float), frames.qpos[k + 1].astype(float))
        assert np.abs(frames.qvel[k] - wanted).max() < 2e-3  # of float32 positions
        data.qpos[:], data.qvel[:] = frames.qpos[k], frames.qvel[k]
        mujoco.mj_forward(g1, data)
        for body in (1, 16, 23):
            mujoco.mj_objectVelocity(g1, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            assert np.abs(frames.ang[k, body - 1] - velocity[:3]).max() < 0.5  # of a chord and of a tangent
            assert np.abs(frames.lin[k, body - 1] - velocity[3:]).max() < 0.1


def test_files_folders_globs_and_motions(tmp_path, g1, rows):
    written(tmp_path, rows, "a.csv")
    (tmp_path / "deep").mkdir()
    written(tmp_path / "deep", rows, "b.csv")
    as_npz(tmp_path / "deep", g1, rows).rename(tmp_path / "deep" / "b.npz")
    (tmp_path / "deep" / "c.pkl").write_bytes(b"")
    written(tmp_path / "deep", rows, "a.csv")
    found = motions.read(tmp_path, 25.0)
    assert [(motion.name, motion.fps) for motion in found] == [
        ("a", 25.0),
        ("a", 25.0),
        ("b", 50.0),
    ]  # an npz says its rate
    assert [motion.name for motion in motions.read(f"{tmp_path}/**/*.csv", 25.0)] == ["a", "a", "b"]
    assert motions.expand(f"{tmp_path}*") == motions.expand(tmp_path)  # a glob finds folders, too
    assert motions.read([found[0], tmp_path / "a.csv"], 25.0)[0] is found[0]
    for nothing in (tmp_path / "none", f"{tmp_path}/*.txt"):
        with pytest.raises(FileNotFoundError, match="there is no motion"):
            motions.read(nothing, 25.0)
    with pytest.raises(TypeError, match="must be a path"):
        motions.read(3)


@pytest.mark.slow
def test_the_command_prints_films_and_mends(tmp_path, capsys, rows):
    table = rows[:4].copy()
    table[:, 2] += 0.2
    path = written(tmp_path, table)
    cli.main(["motion", str(path), "--fps", "25"])
    printed = capsys.readouterr().out
    assert "clip" in printed
    assert "the robot floats" in printed
    cli.main(["motion", str(path), "--fps", "25", "--ground", "--out", str(tmp_path / "mended.npz")])
    cli.main(["motion", str(tmp_path / "mended.npz")])
    assert "floats" not in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(
            ["motion", str(path), str(tmp_path / "mended.npz"), "--fps", "25", "--out", str(tmp_path / "both.npz")]
        )
    assert "a copy is of one motion, and there are 2" in capsys.readouterr().err
    cli.main(["motion", str(path), "--fps", "25", "--out", str(tmp_path / "clip.mp4")])
    import imageio.v3 as imageio

    assert len(imageio.imread(tmp_path / "clip.mp4", plugin="pyav")) == 4
    with pytest.raises(SystemExit):
        cli.main(["motion", str(path)])
    assert "WRONG" in (printed := capsys.readouterr()).out
    assert "pass fps" in printed.out
    assert "1 of 1 files hold no motion" in printed.err


@for_each("shape", ["box", "cylinder", "capsule", "ellipsoid", "sphere", "mesh"])
def test_the_lowest_point_is_as_far_from_a_floor_as_c_mujoco_says(shape):
    of = 'mesh="wedge"' if shape == "mesh" else 'size="0.1 0.2 0.3"'
    m = mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <asset><mesh name="wedge" vertex="0 0 0  .3 0 0  0 .4 0  .1 .1 .5"/></asset>
      <worldbody>
        <geom type="plane" size="0 0 1" pos="0 0 -5"/>
        <body><freejoint/><geom type="{shape}" {of} pos="0.1 0 0.2" euler="10 20 30"/></body>
        <body pos="0 0 -1"><freejoint/><geom type="sphere" size="0.1"/></body>
      </worldbody>
    </mujoco>""")
    data, rng = mujoco.MjData(m), np.random.default_rng(0)
    data.qpos[:7] = rng.normal(size=7)
    mujoco.mj_normalizeQuat(m, data.qpos)
    mujoco.mj_kinematics(m, data)
    poses = data.xpos[None], data.xmat.reshape(1, -1, 3, 3)
    distance = mujoco.mj_geomDistance(m, data, 1, 0, 50.0, None)
    assert motions.lowest_points(m, *poses, [1])[0] == pytest.approx(distance - 5.0)
    assert motions.lowest_points(m, *poses)[0] == pytest.approx(min(distance - 5.0, data.xpos[2, 2] - 0.1))
