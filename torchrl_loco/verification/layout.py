"""What a policy observes, from MuJoCo's state and the terms that its file lists, in NumPy.

A term is a dictionary with ``term``, its kind, and ``size``, how many numbers it has:

====================  =============================  ==================================================================
``linear_velocity``   ``body``                       velocity of a floating body in its own frame (m/s)
``angular_velocity``  ``body``                       its angular velocity in its own frame (rad/s)
``gravity``           ``body``                       direction of gravity in the frame of a body
``joint_positions``   ``joints``, ``home``           positions of joints, less those of ``home`` (rad, m)
``joint_velocities``  ``joints``                     velocities of joints (rad/s, m/s)
``last_action``                                      the policy's action of the last control step, first 0
``command``                                          velocity forward, to the left (m/s) and yaw rate (rad/s)
``qpos``, ``qvel``    ``first``                      all positions or velocities from this one on
``activations``                                      activations of the actuators
``height``            ``body``                       height of a body's origin (m)
``positions``         ``bodies``, ``frame``          origins of bodies, seen from another body, in its frame (m)
``axes``              ``bodies``, ``entries``        entries of the orientations of bodies, row by row
``sensors``           ``names``, ``function``        sensors, through ``log1p`` or ``arcsinh`` if that is named
====================  =============================  ==================================================================

``noise`` is the greatest error, either way, that the term had in training, drawn at each step, ``bias`` one that was
drawn for each episode.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"log1p": np.log1p, "arcsinh": np.arcsinh}

Term = Mapping[str, Any]


@dataclasses.dataclass
class State:
    """The state of n worlds, as MuJoCo has it.

    Attributes:
        qpos: positions (m, rad, unit quaternions), ``(n, nq)``.
        qvel: velocities (m/s, rad/s), ``(n, nv)``.
        act: activations, ``(n, na)``.
        xpos: positions of the bodies (m), ``(n, nbody, 3)``.
        xmat: orientations of the bodies, ``(n, nbody, 3, 3)``.
        sensordata: sensors, those of forces of the last physics step, the others of the state, ``(n, nsensordata)``.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    sensordata: np.ndarray

    @classmethod
    def zeros(cls, m: mujoco.MjModel, n: int) -> "State":
        """Returns the state of n worlds of a model, to be written."""
        shapes = [(m.nq,), (m.nv,), (m.na,), (m.nbody, 3), (m.nbody, 3, 3), (m.nsensordata,)]
        return cls(*(np.zeros((n, *shape)) for shape in shapes))

    def write(self, world: int, data: mujoco.MjData) -> None:
        """Copies the state of a world, whose poses and sensors are up to date."""
        for field in ("qpos", "qvel", "act", "xpos", "sensordata"):
            getattr(self, field)[world] = getattr(data, field)
        self.xmat[world] = data.xmat.reshape(-1, 3, 3)


class Layout:
    """Observations by the terms of a file.

    Args:
        terms: the terms.
        m: the model.

    Attributes:
        size: length of an observation.
        noise: greatest error of each number at a step, ``(size,)``.
        bias: greatest error of each number in an episode, ``(size,)``.

    Raises:
        ValueError: a term is unknown, or cannot be had of the model.
        KeyError: the model has no such body, joint or sensor.
    """

    def __init__(self, terms: Sequence[Term], m: mujoco.MjModel) -> None:
        self.size = sum(term["size"] for term in terms)
        self.noise, self.bias = (
            np.concatenate([np.full(term["size"], term.get(name, 0.0)) for term in terms]) for name in ("noise", "bias")
        )
        self._terms = [(term, _reader(term, m)) for term in terms]

    def __call__(self, state: State, last_action: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Returns observations ``(n, size)``.

        Args:
            state: the state of n worlds.
            last_action: the policy's last actions, ``(n, nu)``.
            command: commands, ``(n, 3)``; not read without a term ``command``.

        Raises:
            ValueError: a term has not the size that it says.
        """
        parts = []
        for term, read in self._terms:
            values = read(state, last_action, command).reshape(len(state.qpos), -1)
            if values.shape[1] != term["size"]:
                raise ValueError(f"the term {term['term']} has {values.shape[1]} numbers, its file says {term['size']}")
            parts.append(values)
        return np.concatenate(parts, axis=1)


Read = Callable[[State, np.ndarray, np.ndarray], np.ndarray]


def _reader(term: Term, m: mujoco.MjModel) -> Read:
    """Returns the function of state, last action and command that gives a term, ``(n, ...)``.

    Raises:
        ValueError: the term is unknown.
    """
    kind = term["term"]
    if kind not in _READERS:
        raise ValueError(f"unknown term {kind!r} in the observation: known are {', '.join(_READERS)}")
    return _READERS[kind](term, m)


def _floating(term: Term, m: mujoco.MjModel, angular: bool) -> Read:
    body = m.body(term["body"])
    joint = int(body.jntadr[0])
    if joint < 0 or m.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"the term {term['term']} is of a body with a free joint, and {term['body']} has none")
    dof, index = int(m.jnt_dofadr[joint]), body.id
    if angular:  # that of a free joint is in the body's frame
        return lambda s, action, command: s.qvel[:, dof + 3 : dof + 6]
    return lambda s, action, command: into_frame(s.xmat[:, index], s.qvel[:, dof : dof + 3])


def into_frame(xmat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Returns vectors of the world ``(n, ..., 3)`` in frames with the axes ``xmat`` ``(n, 3, 3)``."""
    return np.einsum("nij,n...i->n...j", xmat, vectors)


def _gravity(term: Term, m: mujoco.MjModel) -> Read:
    body = m.body(term["body"]).id
    return lambda s, action, command: -s.xmat[:, body, 2]


def _joints(term: Term, m: mujoco.MjModel, velocity: bool) -> Read:
    joints = [m.joint(name) for name in term["joints"]]
    where = np.array([int((joint.dofadr if velocity else joint.qposadr)[0]) for joint in joints])
    if velocity:
        return lambda s, action, command: s.qvel[:, where]
    home = np.array(term["home"])
    return lambda s, action, command: s.qpos[:, where] - home


def _positions(term: Term, m: mujoco.MjModel) -> Read:
    bodies, frame = [m.body(name).id for name in term["bodies"]], m.body(term["frame"]).id
    return lambda s, action, command: into_frame(s.xmat[:, frame], s.xpos[:, bodies] - s.xpos[:, None, frame])


def _axes(term: Term, m: mujoco.MjModel) -> Read:
    bodies, entries = [m.body(name).id for name in term["bodies"]], term["entries"]
    return lambda s, action, command: s.xmat[:, bodies].reshape(len(s.xmat), -1, 9)[..., entries]


def _height(term: Term, m: mujoco.MjModel) -> Read:
    body = m.body(term["body"]).id
    return lambda s, action, command: s.xpos[:, body, 2]


def _sensors(term: Term, m: mujoco.MjModel) -> Read:
    sensors = [m.sensor(name) for name in term["names"]]
    where = np.concatenate([np.arange(int(one.adr[0]), int(one.adr[0]) + int(one.dim[0])) for one in sensors])
    function = FUNCTIONS[term["function"]] if "function" in term else np.asarray
    return lambda s, action, command: function(s.sensordata[:, where])


def _from(field: str) -> Callable[[Term, mujoco.MjModel], Read]:
    return lambda term, m: lambda s, action, command: getattr(s, field)[:, term.get("first", 0) :]


_READERS: dict[str, Callable[[Term, mujoco.MjModel], Read]] = {
    "linear_velocity": lambda term, m: _floating(term, m, angular=False),
    "angular_velocity": lambda term, m: _floating(term, m, angular=True),
    "gravity": _gravity,
    "joint_positions": lambda term, m: _joints(term, m, velocity=False),
    "joint_velocities": lambda term, m: _joints(term, m, velocity=True),
    "last_action": lambda term, m: lambda s, action, command: action,
    "command": lambda term, m: lambda s, action, command: command,
    "qpos": _from("qpos"),
    "qvel": _from("qvel"),
    "activations": _from("act"),
    "height": _height,
    "positions": _positions,
    "axes": _axes,
    "sensors": _sensors,
}
