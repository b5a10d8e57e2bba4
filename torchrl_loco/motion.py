"""Motions of a robot: read from what people have, checked against its model, and as tables for a task."""

import dataclasses
import glob
import inspect
import io
import logging
import math
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.checks import check_bool, check_float, number_of, several, suggestion
from torchrl_loco.storage import replace_file

SUFFIXES = (".csv", ".npz")  # of files that motions are read from
BASE = "xyzxyzw"  # the base's columns of a CSV file: its position, then its quaternion
AXES = {**{axis: axis for axis in "xyzw"}, "i": "x", "j": "y", "k": "z", "r": "w"}  # of columns, by their names
COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")  # of the base in a pose
TILTED, UPRIGHT = 0.9, 0.97  # mean z of the base's upright axis, read as it is, and as if w came first
MAX_SPEED, MAX_TURN = 12.0, 40.0
"""Speed (m/s) and rate of turn (rad/s) of the base between two frames that no robot has: the motion jumps there."""
QUICK = 40.0  # rate of a joint (rad/s) between two frames that is said
SUNK, FLOATS, PENETRATES = 0.02, 0.03, 0.005
"""How far the lowest frame may lie below and above the ground (m) before it is said; where a shift puts it, below."""
BODY_ERROR = 0.05  # how far bodies in a file may lie from where the model puts them (m)
MAX_BEYOND = 7.0  # how far a joint may be beyond its limit (rad): more are degrees
LOOKED_AT = 20.0  # frames per second whose bodies are compared with the ground and with the file
FAR_BEYOND = 0.8  # from where on it may be another joint (rad)
NORM_ERROR = 0.05  # how far the length of a quaternion may be from 1


class Motion:
    """A motion of a robot: a pose at each frame.

    A CSV file has a row for each frame: position of the base (m), its orientation as a quaternion x, y, z, w, and the
    joints in the order of the model (rad), which a first line may name. It does not say its rate. An npz file is that
    of mjlab, with ``fps``, ``joint_pos``, ``body_pos_w`` and ``body_quat_w`` (w, x, y, z); the first body is the base.

    Args:
        path: the file.
        fps: frames per second; needed for CSV. An npz file says it, and another number is refused.
        clip: whether joints beyond the limits of the model are put at them.
        ground: whether the motion is shifted so that its lowest point lies 5 mm in the ground, as where a robot stands.
        weight: how often it is practised, by the time it takes, relative to others.

    Attributes:
        name: the file's, without its suffix.
        fps: frames per second.
        qpos: the poses as MuJoCo has them, float64 ``(frames, 7 + joints)``: the quaternion is w, x, y, z.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no motion; the message says what is wrong, and in which frame.
    """

    def __init__(
        self,
        path: Path | str,
        fps: float | None = None,
        *,
        clip: bool = False,
        ground: bool = False,
        weight: float = 1.0,
    ) -> None:
        self.path = Path(path).expanduser()
        self.clip, self.ground = check_bool("clip", clip), check_bool("ground", ground)
        self.weight = check_float("weight", weight)
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no file {self.path}")
        fps = None if not fps else check_float("fps", fps)
        self._joints: list[str] = []
        self._notes: list[str] = []
        self._bodies: tuple[np.ndarray, list[str]] | None = None
        suffix = self.path.suffix.lower()
        if suffix not in SUFFIXES:
            hint = ": a pickle can run code, so it is not read" if suffix in (".pkl", ".pt", ".npy") else ""
            raise ValueError(f"{self.path} must be one of {', '.join(SUFFIXES)}{hint}")
        if suffix == ".csv" and fps is None:
            raise ValueError(f"{self.path}: a CSV file does not say its rate: pass fps (--fps), as 30, 50, 60 or 120")
        self.fps, self._qpos = (fps or 0.0, self._from_csv()) if suffix == ".csv" else self._from_npz(fps)
        self._check()

    def __repr__(self) -> str:
        return f"Motion({str(self.path)!r}, fps={self.fps:g})"

    @property
    def name(self) -> str:
        """Name of the file, without its suffix."""
        return self.path.stem

    @property
    def qpos(self) -> np.ndarray:
        """The poses, read-only: a training reads the file again. :func:`torchrl_loco.motion.save` writes a new one."""
        poses = self._qpos.view()
        poses.setflags(write=False)
        return poses

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last (s)."""
        return (len(self.qpos) - 1) / self.fps

    def as_json(self) -> dict[str, Any]:
        """Returns the arguments from which an equal motion is read, as JSON can hold them."""
        path = str(self.path.absolute())
        return {"path": path, "fps": self.fps, "clip": self.clip, "ground": self.ground, "weight": self.weight}

    def _from_csv(self) -> np.ndarray:
        try:
            text = self.path.read_text(encoding="utf-8-sig").splitlines()
            numbered = [(number, line) for number, line in enumerate(text, start=1) if line.strip()]
        except UnicodeDecodeError as error:
            raise ValueError(f"{self.path} is no text: {error}") from None
        head = numbered[0][1].split(",") if numbered else []
        if numbered and sum(number_of(word) is None for word in head) * 2 >= len(head):
            names = [name.strip().strip('"') for name in numbered.pop(0)[1].split(",")]
            self._joints = names[7:]
            axes = [_axis(name) for name in names[:7]]
            if sorted(axes) == sorted(BASE) and "".join(axes) != BASE:
                raise ValueError(
                    f"{self.path} has {', '.join(names[:7])}: the base must be in the order x, y, z and, of its "
                    "quaternion, x, y, z, w"
                )
            if "".join(axes) != BASE:
                self._notes.append(f"{', '.join(names[:7])} are taken for x, y, z and the quaternion x, y, z, w")
        lines = [line for _, line in numbered]
        try:
            table = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None) if lines else np.empty((0, 0))
        except ValueError:
            widths = sorted({line.count(",") + 1 for line in lines})
            wrong = [
                f"{word[:40]!r} in line {number}, column {column}{'' if ',' in line else ', without a comma'}"
                for number, line in numbered
                for column, word in enumerate(line.split(","), start=1)
                if number_of(word) is None
            ]
            what = wrong[0] if wrong else f"rows of {widths[0]} to {widths[-1]} numbers"
            raise ValueError(f"{self.path} must have rows of as many numbers, it has {what}") from None
        if table.shape[1] < 8:
            raise ValueError(
                f"{self.path} must have rows of 7 numbers of the base and one of each joint, 36 for a G1; it has "
                f"{f'rows of {table.shape[1]}' if lines else 'none'}"
            )
        if np.array_equal(table[0], np.arange(table.shape[1])):
            raise ValueError(f"{self.path} has the numbers of its columns in line {numbered[0][0]}: remove that line")
        return table[:, [0, 1, 2, 6, 3, 4, 5, *range(7, table.shape[1])]]

    def _from_npz(self, fps: float | None) -> tuple[float, np.ndarray]:
        try:
            with self.path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                tables = dict(file)
        except (OSError, EOFError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{self.path} cannot be read as an npz file of numbers: {error}") from None
        if missing := [key for key in ("fps", "joint_pos", "body_pos_w", "body_quat_w") if key not in tables]:
            raise ValueError(f"{self.path} lacks {', '.join(missing)}: it has {', '.join(tables) or 'nothing'}")
        rate, joints, pos, quat = (tables[key] for key in ("fps", "joint_pos", "body_pos_w", "body_quat_w"))
        frames, bodies = len(joints) if joints.ndim else 0, pos.shape[1] if pos.ndim == 3 else 0
        fits = rate.size == 1 and joints.ndim == 2 and bodies > 0
        fits = fits and pos.shape == (frames, bodies, 3) and quat.shape == (frames, bodies, 4)
        if not fits or any(each.dtype.kind not in "fiu" for each in (rate, joints, pos, quat)):
            raise ValueError(
                f"{self.path} must have fps, a number; joint_pos (frames, joints), body_pos_w (frames, bodies, 3) and "
                f"body_quat_w (frames, bodies, 4), they are {rate.shape}, {joints.shape}, {pos.shape}, {quat.shape}"
            )
        stated = check_float(f"fps of {self.path}", float(rate.ravel()[0]))
        if fps is not None and not math.isclose(fps, stated, rel_tol=1e-3):
            raise ValueError(f"{self.path} has {stated:g} frames per second, not {fps:g}")
        self._joints = _words(tables.get("joint_names", ()))
        self._bodies = pos, _words(tables.get("body_names", ()))
        return stated, np.concatenate([pos[:, 0], quat[:, 0], joints], axis=1).astype(float)

    def _check(self) -> None:
        """Checks all that needs no model."""
        q = self._qpos
        if len(q) < 2:
            raise ValueError(f"{self.path} has {len(q)} frames: a motion has at least 2")
        if (bad := np.argwhere(~np.isfinite(q))).size:
            frame, column = (int(k) for k in bad[0])
            which = COLUMNS[column] if column < 7 else f"joint {column - 7}"
            raise ValueError(f"{self.path}: frame {frame} has a number that is not finite, in {which}")
        lengths = np.linalg.norm(q[:, 3:7], axis=1)
        if (wrong := np.flatnonzero(np.abs(lengths - 1.0) > NORM_ERROR)).size:
            where = f", of {q.shape[1]} columns the 4th to the 7th," if self.path.suffix.lower() == ".csv" else ""
            raise ValueError(
                f"{self.path}: the base's orientation{where} in frame {wrong[0]} must be a unit quaternion, its length "
                f"is {lengths[wrong[0]]:.3g}"
            )
        q[:, 3:7] /= lengths[:, None]
        speed = np.linalg.norm(np.diff(q[:, :3], axis=0), axis=1) * self.fps
        turn = np.linalg.norm(_rotation(q[:-1, 3:7], q[1:, 3:7]), axis=1) * self.fps
        for what, values, most, unit in (("moves", speed, MAX_SPEED, "m/s"), ("turns", turn, MAX_TURN, "rad/s")):
            if values.max() > most:
                frame = int(values.argmax())
                raise ValueError(
                    f"{self.path}: the base {what} at {values[frame]:.0f} {unit} after frame {frame}, more than "
                    f"{most:g}: the motion jumps there, or fps ({self.fps:g}) is not its rate"
                )

    def in_steps(self, q: np.ndarray, dt: float) -> np.ndarray:
        """Returns its poses at every control step of ``dt`` (s).

        Raises:
            ValueError: it is shorter than two of them.
        """
        q = resampled(q, self.fps, dt)
        if len(q) < 3:
            raise ValueError(f"{self.path} takes {self.seconds:g} s, less than two control steps of {dt:g} s")
        return q

    def on(self, m: mujoco.MjModel) -> tuple[np.ndarray, list[str]]:
        """Returns the poses ``(frames, nq)`` for a model, and what is to be said of them.

        Raises:
            ValueError: it is a motion of another robot, or its joints are in another order.
        """
        q, joints = self.qpos.copy(), _joints_of(m)
        if m.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE or m.nq != 7 + len(joints):
            raise ValueError("motions need a robot whose base floats, and whose joints are hinges")
        if q.shape[1] != m.nq:
            raise ValueError(f"{self.path} has {q.shape[1] - 7} joints, the robot has {m.nq - 7}: {', '.join(joints)}")
        if self._joints:
            for name in self._joints:
                if name not in joints:
                    raise ValueError(f"{self.path}: the robot has no joint {name!r}{suggestion(name, joints)}")
            if sorted(self._joints) != sorted(joints):
                raise ValueError(f"{self.path} must name each joint once, it names {', '.join(sorted(self._joints))}")
            q[:, 7:] = q[:, 7:][:, [self._joints.index(name) for name in joints]]
        said = [*self._notes, *self._compare_bodies(m, q)]
        low, high = np.where(m.jnt_limited[1:, None].astype(bool), m.jnt_range[1:], (-np.inf, np.inf)).T
        beyond = np.maximum(low - q[:, 7:], q[:, 7:] - high)
        frame, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        if beyond.max() > MAX_BEYOND:
            raise ValueError(
                f"{self.path}: {joints[joint]} is {beyond.max():.0f} rad beyond its limit in frame {frame}: joints "
                "must be in radians"
            )
        if beyond.max() > 1e-3 and self.clip:
            q[:, 7:] = q[:, 7:].clip(low, high)
        elif beyond.max() > 1e-3:
            order = ", as if the joints were in another order" if beyond.max() > FAR_BEYOND else ""
            said.append(f"{joints[joint]} is {beyond.max():.2f} rad beyond its limit in frame {frame}{order}")
        up, as_if = (1.0 - 2.0 * (q[:, [a, b]] ** 2).sum(1).mean() for a, b in ((4, 5), (5, 6)))
        if up < 0.0 or up < TILTED < UPRIGHT < as_if:
            tilt = math.degrees(math.acos(up))
            said.append(f"the base is tilted by {tilt:.0f} degrees, as if its quaternion were not x, y, z, w")
        rates = np.abs(np.diff(q[:, 7:], axis=0)) * self.fps
        if rates.max() > QUICK:
            frame, joint = np.unravel_index(rates.argmax(), rates.shape)
            said.append(f"{joints[joint]} turns at {rates.max():.0f} rad/s after frame {frame}")
        every = 1 if self.ground else self._stride
        lowest = lowest_points(m, *poses(m, q[::every]))
        frame, least = every * int(lowest.argmin()), float(lowest.min())
        if not np.isfinite(least):
            said.append("nothing of the robot can touch the ground")
        elif self.ground:
            q[:, 2] -= least + PENETRATES
        elif least < -SUNK:
            said.append(f"the robot is {-least:.2f} m below the ground in frame {frame}")
        elif least > FLOATS:
            said.append(f"the robot floats: its lowest point is {least:.2f} m above the ground, in frame {frame}")
        return q, said

    def _compare_bodies(self, m: mujoco.MjModel, q: np.ndarray) -> list[str]:
        """Returns what is to be said of the bodies of a file, which must lie where the joints put them."""
        if self._bodies is None:
            return []
        there, names = self._bodies
        bodies, base = _bodies_of(m), m.body(m.jnt_bodyid[0]).name
        if names and names[0] != base and names[0] in bodies:
            raise ValueError(f"{self.path}: the first body must be the base, {base!r}, it is {names[0]!r}")
        names = names or (bodies if there.shape[1] == len(bodies) else [])
        both = [name for name in names if name in bodies]
        if not both or len(names) != there.shape[1]:
            return [f"its {there.shape[1]} bodies have no names, so the order of the joints could not be checked"]
        every = self._stride
        here = poses(m, q[::every])[0][:, [m.body(name).id for name in both]]
        apart = np.linalg.norm(here - there[::every, [names.index(name) for name in both]], axis=2)
        if apart.max() > BODY_ERROR:
            frame, body = np.unravel_index(apart.argmax(), apart.shape)
            raise ValueError(
                f"{self.path}: {both[body]} lies {apart.max():.2f} m from where the joints put it in frame "
                f"{every * frame}: joints or bodies are in another order than the robot's, {', '.join(_joints_of(m))}"
            )
        return []

    @property
    def _stride(self) -> int:
        """Of every how many frames one is looked at, where not all must be."""
        return max(1, int(self.fps / LOOKED_AT))


def _joints_of(m: mujoco.MjModel) -> list[str]:
    return [m.joint(j).name for j in range(1, m.njnt)]


def _bodies_of(m: mujoco.MjModel) -> list[str]:
    return [m.body(i).name for i in range(1, m.nbody)]


def _axis(column: str) -> str:
    """Returns the axis that a column is named after, as that of ``"root_qx [m]"`` or ``"w_quat"``; "" if none."""
    words = re.findall(r"[a-z]+", re.sub(r"[\[(].*", "", column.lower()))
    named = [word.removeprefix("q") for word in words if word.removeprefix("q") in AXES]
    return AXES[named[-1]] if named else AXES.get("".join(words)[-1:], "")


def read(motion: Any, fps: float = 0.0) -> list[Motion]:
    """Returns the motions that are named.

    Args:
        motion: a file, a folder with all that is below it, a glob, a :class:`Motion`, or several of these. Of files
            of a folder with the same name, the npz is read, which says its rate.
        fps: frames per second of CSV files.

    Raises:
        FileNotFoundError: there is no such file, or no motion in a folder.
        ValueError: a file is no motion.
        TypeError: it is something else.
    """
    return [one if isinstance(one, Motion) else Motion(**one) for one in named(motion, fps)]


def named(motion: Any, fps: float = 0.0) -> list[Motion | dict[str, Any]]:
    """Returns the motions that are named, as :func:`read` takes them; of files, the arguments of :class:`Motion`."""
    found = list[Motion | dict[str, Any]]()
    for one in several(motion):
        if isinstance(one, Motion):
            found.append(one)
        elif isinstance(one, Mapping):
            known = list(inspect.signature(Motion).parameters)
            if "path" not in one or not {*known} >= one.keys():
                raise ValueError(f"a motion must have a path, and of {', '.join(known[1:])} what differs; got {one}")
            found.append(dict(one))
        elif isinstance(one, str | Path):
            found += [{"path": file, "fps": fps if file.suffix.lower() == ".csv" else 0.0} for file in expand(one)]
        else:
            raise TypeError(f"motion must be a path, a Motion, or a list of these, got {one!r}")
    if not found:
        raise ValueError("motion must name at least one motion")
    return found


def _words(names: Any) -> list[str]:
    """Returns names of an array as text: some writers have bytes."""
    return [name.decode() if isinstance(name, bytes) else str(name) for name in np.ravel(names)]


def expand(place: Path | str) -> list[Path]:
    """Returns the files of a path, a folder, or a glob of both, in the order of their names."""
    path = Path(place).expanduser()
    if path.is_file():
        return [path]
    places = [path] if path.is_dir() else list(map(Path, glob.glob(str(path), recursive=True)))
    folders = [each for each in places if each.is_dir()]
    found = {*places}.union(*(folder.rglob("*") for folder in folders))
    files = sorted(file for file in found if file.suffix.lower() in SUFFIXES)
    if folders:
        files = list({file.with_suffix(""): file for file in files}.values())  # of one name, the npz comes last
    if not files:
        raise FileNotFoundError(
            f"there is no motion {place}: name a .csv or .npz, a folder, or a glob; of a run or a policy, --motion and "
            "--fps tell where its motions are now"
        )
    return files


@dataclasses.dataclass(frozen=True)
class Frames:
    """Motions as tables, one after the other, a frame for each control step; velocities are in the world's frame."""

    names: tuple[str, ...]  # of the clips
    first: np.ndarray  # frame of each clip, (clips,)
    last: np.ndarray
    weights: np.ndarray
    qpos: np.ndarray  # poses and velocities as MuJoCo has them, (frames, nq) and (frames, nv)
    qvel: np.ndarray
    pos: np.ndarray  # of bodies (m), (frames, bodies, 3)
    mat: np.ndarray  # their orientations, (frames, bodies, 3, 3)
    lin: np.ndarray  # their velocities (m/s), (frames, bodies, 3)
    ang: np.ndarray  # their angular velocities (rad/s), (frames, bodies, 3)
    said: Mapping[str, list[str]]  # what is to be said of the motions, by name

    @classmethod
    def of(cls, motions: Sequence[Motion], m: mujoco.MjModel, bodies: Sequence[str], dt: float) -> "Frames":
        """Returns motions on a model, with the bodies that are named, at the rate of control steps of ``dt`` (s).

        Raises:
            ValueError: one is of another robot, or shorter than two control steps.
        """
        ids, parts, said = [m.body(name).id for name in bodies], [], {}
        for motion in motions:
            q, notes = motion.on(m)
            if notes:
                said[motion.name] = notes
            q = motion.in_steps(q, dt)
            pos, mat = poses(m, q)
            base = mat[:, m.jnt_bodyid[0]]
            pos, mat = pos[:, ids], mat[:, ids]
            lin, ang = np.gradient(pos, dt, axis=0), _turn_rate(mat, dt)
            of_base = np.einsum("fji,fj->fi", base, _turn_rate(base[:, None], dt)[:, 0])
            rates = np.gradient(q, dt, axis=0)
            qvel = np.concatenate([rates[:, :3], of_base, rates[:, 7:]], axis=1)
            parts.append((q, qvel, pos, mat, lin, ang))
        lengths = np.array([len(part[0]) for part in parts])
        last = lengths.cumsum() - 1
        joined = (np.ascontiguousarray(np.concatenate(each), np.float32) for each in zip(*parts, strict=True))
        tables: Any = dict(zip(("qpos", "qvel", "pos", "mat", "lin", "ang"), joined, strict=True))
        names, weights = tuple(motion.name for motion in motions), np.array([motion.weight for motion in motions])
        if said:
            name, notes = next(iter(said.items()))
            more = f", and more of {len(said) - 1} others" if len(said) > 1 else ""
            words = f"{name}: {'; '.join(notes)}{more}"
            logging.getLogger("torchrl_loco").warning("motion %s: see torchrl-loco motion", words)
        return cls(names, last - lengths + 1, last, weights, **tables, said=said)


def save(path: Path, qpos: np.ndarray, fps: float, m: mujoco.MjModel) -> None:
    """Writes poses ``(frames, nq)`` as an npz as mjlab's, with the names of joints and bodies."""
    pos, mat = (table[:, 1:] for table in poses(m, qpos))
    joints, dt = qpos[:, 7:], 1.0 / fps
    rates = np.gradient(joints, dt, axis=0)
    tables: Any = mjlabs_tables(joints, rates, pos, mat, np.gradient(pos, dt, axis=0), _turn_rate(mat, dt))
    tables |= {"joint_names": _joints_of(m), "body_names": _bodies_of(m)}
    content = io.BytesIO()
    np.savez_compressed(content, fps=np.array([fps]), **tables)
    replace_file(path, content.getvalue())


def mjlabs_tables(
    joints: np.ndarray, rates: np.ndarray, pos: np.ndarray, mat: np.ndarray, lin: np.ndarray, ang: np.ndarray
) -> dict[str, np.ndarray]:
    """Returns joints, and positions, orientations and velocities of bodies, by mjlab's names, float32."""
    quat = quat_of(mat.reshape(-1, 3, 3)).reshape(*mat.shape[:2], 4)
    tables = {"joint_pos": joints, "joint_vel": rates, "body_pos_w": pos, "body_quat_w": quat}
    tables |= {"body_lin_vel_w": lin, "body_ang_vel_w": ang}
    return {name: table.astype(np.float32) for name, table in tables.items()}


def poses(m: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions (m) ``(frames, nbody, 3)`` and orientations ``(frames, nbody, 3, 3)`` of all bodies."""
    data = mujoco.MjData(m)
    pos, mat = np.empty((len(qpos), m.nbody, 3)), np.empty((len(qpos), m.nbody, 9))
    for k, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(m, data)
        pos[k], mat[k] = data.xpos, data.xmat
    return pos, mat.reshape(len(qpos), m.nbody, 3, 3)


def lowest_points(
    m: mujoco.MjModel, pos: np.ndarray, mat: np.ndarray, geoms: Iterable[int] | None = None
) -> np.ndarray:
    """Returns the height of the lowest point of what can touch the ground, in each frame (m); infinity if nothing can.

    Positions (m) and orientations of bodies are those of :func:`poses`; ``geoms`` count, all of them for ``None``.
    """
    lowest, kinds = np.full(len(pos), np.inf), mujoco.mjtGeom
    for geom in range(m.ngeom) if geoms is None else geoms:
        body, kind, size = m.geom_bodyid[geom], kinds(int(m.geom_type[geom])), m.geom_size[geom]
        if not body or not (m.geom_contype[geom] or m.geom_conaffinity[geom]):
            continue
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, m.geom_quat[geom])
        axes = mat[:, body, 2] @ turn.reshape(3, 3)  # heights of the geom's axes, (frames, 3)
        half: Any
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE):
            half = size[0] + (np.abs(axes[:, 2]) * size[1] if kind == kinds.mjGEOM_CAPSULE else 0.0)
        elif kind == kinds.mjGEOM_BOX:
            half = np.abs(axes) @ size
        elif kind == kinds.mjGEOM_CYLINDER:
            half = np.hypot(axes[:, 0], axes[:, 1]) * size[0] + np.abs(axes[:, 2]) * size[1]
        elif kind == kinds.mjGEOM_ELLIPSOID:
            half = np.linalg.norm(axes * size, axis=1)
        elif kind == kinds.mjGEOM_MESH:
            mesh = m.mesh(int(m.geom_dataid[geom]))
            first = int(mesh.vertadr[0])
            half = -(axes @ m.mesh_vert[first : first + int(mesh.vertnum[0])].T).min(axis=1)
        else:
            continue
        lowest = np.minimum(lowest, pos[:, body, 2] + mat[:, body, 2] @ m.geom_pos[geom] - half)
    return lowest


def resampled(qpos: np.ndarray, fps: float, dt: float) -> np.ndarray:
    """Returns poses at multiples of ``dt`` (s), between frames along the shortest turn of the base."""
    last = (len(qpos) - 1) / fps
    frames = np.arange(math.floor(last / dt + 1e-6) + 1) * dt * fps
    before = np.minimum(frames.astype(int), len(qpos) - 2)
    share = (frames - before)[:, None]
    one, other = qpos[before], qpos[before + 1]
    found = (1.0 - share) * one + share * other
    found[:, 3:7] = one[:, 3:7]
    for row, turn in zip(found, share * _rotation(one[:, 3:7], other[:, 3:7]), strict=True):
        mujoco.mju_quatIntegrate(row[3:7], turn, 1.0)
    return found


def quat_of(mat: np.ndarray) -> np.ndarray:
    """Returns unit quaternions (w, x, y, z) ``(n, 4)`` of rotation matrices ``(n, 3, 3)``."""
    found = np.empty((len(mat), 4))
    for row, one in zip(found, mat.reshape(-1, 9).astype(float), strict=True):
        mujoco.mju_mat2Quat(row, one)
    return found


def _rotation(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns rotation vectors (rad) ``(n, 3)``, in the frames of unit quaternions, that turn these to others."""
    found = np.empty((len(one), 3))
    for row, begin, end in zip(found, one, other, strict=True):
        mujoco.mju_subQuat(row, end, begin)
    return found


def _turn_rate(mat: np.ndarray, dt: float) -> np.ndarray:
    """Returns angular velocities (rad/s) ``(frames, n, 3)``, world frame, by central differences on SO(3)."""
    before, after = np.maximum(np.arange(len(mat)) - 1, 0), np.minimum(np.arange(len(mat)) + 1, len(mat) - 1)
    turn = mat[after] @ mat[before].swapaxes(-1, -2)
    axis = np.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    sine, cosine = 0.5 * np.linalg.norm(axis, axis=-1), 0.5 * (np.trace(turn, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > 1e-9, angle / np.maximum(2.0 * sine, 1e-12), 0.5)
    return axis * (scale / ((after - before) * dt)[:, None])[..., None]
