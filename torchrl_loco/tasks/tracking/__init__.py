"""Tracking: robots that follow reference motions. One recipe, and a table for each robot."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
import torch

from torchrl_loco import motion as motions
from torchrl_loco.checks import Interval, check_int, several, suggestion
from torchrl_loco.conditions import PUSH_EVERY
from torchrl_loco.envs.rotations import product, small_turn
from torchrl_loco.envs.task import options_of_class
from torchrl_loco.tasks.robots import Robot, actuated, either, hard_contacts, pushed, squares
from torchrl_loco.tasks.velocity import G1Velocity, H1Velocity

if TYPE_CHECKING:
    from torchrl_loco.envs.view import View

FOLDER = Path(__file__).parent

AHEAD = Interval(1, 10_000)  # control steps that a policy may look ahead
PIECES = 2048  # room for pieces of the motions, whose failures are counted apart
PIECE = 0.5  # length of a piece (s), more where there is no room for so many
MEMORY = 0.998  # share of what is known of failures that a control step keeps
BEFORE = 0.6  # share of a failure that counts in the piece before
UNIFORM = 0.1  # share of the starts that are drawn without regard to failures
BIAS = 0.01  # greatest error of a joint's encoder in an episode (rad)
PUSH = (0.5, 0.5, 0.2, 0.52, 0.52, 0.78)
"""Greatest change of the base's velocity by a push, and at the start (m/s, rad/s)."""
NEAR, TILT, BEND = (0.05, 0.05, 0.01), (0.1, 0.1, 0.2), 0.1
"""Greatest distance of a start from the reference: place (m), rotation (rad), joints (rad)."""
MAX_HEIGHT, MAX_TILT = 0.25, 0.8
"""Differences from the reference at which it is lost: of heights (m), of the height of an axis."""
OWN_RATE = 25.0  # frames per second of the motions of the package

FOLLOWED = {
    "anchor_position": (0.5, 0.3),  # m
    "anchor_orientation": (0.5, 0.4),  # rad
    "body_positions": (1.0, 0.3),  # m
    "body_orientations": (1.0, 0.4),  # rad
    "body_velocities": (1.0, 1.0),  # m/s
    "body_turn_rates": (1.0, 3.14),  # rad/s
}
"""Terms of the reward for following: weight, and the error that earns exp(-1) of it."""
NOISE: dict[str, Any] = {
    **{"anchor_position": 0.25, "linear_velocity": 0.5},  # m, m/s
    **{"anchor_orientation": 0.05, "angular_velocity": 0.2},  # entries of a matrix; rad/s
    **{"joint_positions": (0.01, "bias"), "joint_velocities": 0.5},  # rad, rad/s
}
"""Noise of what the policy sees."""
ESTIMATED = ("anchor_position", "linear_velocity")  # what a robot does not measure
PENALTIES = {"action_rate": -0.1, "joint_limits": -10.0, "self_collision": -10.0}  # weights of the other terms


def memory(joints: int) -> dict[str, Any]:
    """Returns what a robot with so many joints remembers."""
    return {
        "frame": torch.int32,  # of the reference that the robot is at
        **{"last_action": joints, "delay": ()},  # of actions (control steps)
        **{"bias": joints, "until_push": ()},  # rad; s
        **{"clip": (), "phase": ()},  # of play: the clip, counted from the world's own, and where in it to begin
        **{"began_clip": (), "began_phase": ()},  # what they were then
    }


class Tracking(Robot):
    """What robots that follow motions share; a robot sets the attributes without a value.

    The motions are ``motion``, as :func:`torchrl_loco.motion.read` takes them, in the time of control steps.
    Episodes begin somewhere in them, more often where the reference was lost, and end with the clip. In worlds to play
    with, world k begins with the first frame of clip k.

    Observation:
        ``observation``: joints of the reference and their rates, position (3) and orientation (6) of the reference's
        anchor in the frame of the robot's, linear and angular velocity of the base in its frame (6), joint positions
        relative to home, joint velocities, last action, and of each frame ahead (``future``) the reference's
        joints, their rates, and its base's height, gravity and velocities in its own frame (10); with noise.
        ``privileged``: the same without noise, and position and orientation of all bodies in the frame of the anchor.

    Action:
        Changes of the joints' targets from home, scaled, without bounds. With ``max_delay`` of 1 they come a control
        step late in every other episode.

    Reward:
        ``FOLLOWED``: of the anchor in the world, and of all bodies, whose reference is moved and turned about the
        vertical to the robot's anchor; and ``PENALTIES``, both times the control step. Without :attr:`own_geoms` there
        is no ``self_collision``. A step is compared with the frame that the policy has seen.

    Start:
        The pose and velocities of a frame of the reference, up to ``NEAR``, ``TILT``, ``BEND`` and a push
        away from it; in worlds to play with, exactly.

    Termination:
        When the height of the anchor or of a hand or foot is off by 0.25 m, or the height of the anchor's upright axis
        by 0.8; in worlds to play with, when that of the base is. Truncation at the end of the clip, and after 10 s in
        training.

    Source:
        BeyondMimic (Liao et al., 2025) as mjlab 1.6.0 has it; there a clip starts again where it ends.
    """

    options = {
        "motion": ((), "Motions to follow: CSV or npz files, folders or globs; without any, those of the package."),
        "fps": (0.0, "Frames per second of motions in CSV files, which do not say it."),
        "future": ((), "Frames ahead that the policy sees of the reference too, such as 1 2 3."),
        "max_delay": (0, "Greatest delay of an action in training (control steps), 0 or 1; verify plays both."),
    }
    config = G1Velocity.config
    episode_length = 500
    perfect = {name: weight for name, (weight, _) in FOLLOWED.items()}
    shared = {
        **{"visits": (PIECES, torch.int64), "failures": (PIECES, torch.int64)},  # of all time, and of all ranks
        **{"counted": ((2, PIECES), torch.int64), "recent": (2, PIECES), "chance": PIECES},
    }
    summed_over_ranks = ("visits", "failures")
    presets = {"ppo": {**G1Velocity.presets["ppo"], "total_frames": 300_000_000, "epochs": 4, "eval_episodes": 256}}
    noise = NOISE
    longest_delay = 1
    command_ranges = {"phase": {"phase": (0.0, 1.0)}}  # and the clip, where there are several
    holds: ClassVar[Mapping[str, Any]] = {"falls": 0.05, "delay": (0, 1), "friction": (0.4, 1.2), "pushes": 0.5}

    motion: Any
    fps: float
    future: tuple[int, ...]
    max_delay: int
    frames: motions.Frames
    """The motions as tables."""

    anchor: ClassVar[str]
    """Body about which the reference is moved and turned."""
    bodies: ClassVar[Sequence[str]]
    """Bodies that follow; the base is the first, the anchor is among them."""
    ends: ClassVar[Sequence[str]]
    """Hands and feet."""
    motion_folder: ClassVar[Path]
    """Motions of the package for this robot."""
    estimates: ClassVar[bool] = True
    """Whether the policy sees where the anchor is and how fast the base moves, which a robot must estimate."""

    table = ("base", "anchor", "bodies", "ends")

    @classmethod
    def check_class(cls) -> None:
        """Checks the table of the robot beside what :meth:`torchrl_loco.LocoEnv.check_class` does."""
        super().check_class()
        bodies = list(cls.bodies)
        if apart := [name for name in (cls.base, cls.anchor, *cls.ends) if name not in bodies]:
            raise ValueError(f"bodies of {cls.__name__} must hold base, anchor and ends, but not {', '.join(apart)}")
        if twice := [name for name in bodies if bodies.count(name) > 1]:
            raise ValueError(f"bodies of {cls.__name__} has {twice[0]!r} twice")
        if bodies[0] != cls.base:
            raise ValueError(f"the first of bodies of {cls.__name__} must be the base, {cls.base!r}")

    @classmethod
    def faults(cls, m: mujoco.MjModel) -> list[str]:
        """Returns what is wrong with a model: also actuators that do not drive all joints, in the joints' order."""
        joints, bodies = [m.joint(j).name for j in range(1, m.njnt)], [m.body(i).name for i in range(1, m.nbody)]
        wrong = super().faults(m)
        wrong += [f"it has no body {name!r}{suggestion(name, bodies)}" for name in cls.bodies if name not in bodies]
        if not wrong and actuated(m) != joints:
            wrong.append(f"it must have an actuator for each joint, in their order: {', '.join(joints)}")
        return wrong

    @classmethod
    def checked_options(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """Returns options as a run keeps them: with the whole paths of files."""
        kept = super().checked_options(given)
        if "motion" in kept:
            kept["motion"] = [_kept(one) for one in several(kept["motion"])]
            if not kept["motion"]:
                raise ValueError("motion names none: without it, the motions of the package are followed")
        elif kept.get("fps"):
            raise ValueError("fps is that of motions in CSV files: pass motion too")
        check_int("max_delay", kept.get("max_delay", 0), Interval(0, cls.longest_delay, with_high=True))
        if "future" in kept:
            try:
                kept["future"] = [
                    check_int("each of future", int(step) if isinstance(step, str) else step, AHEAD)
                    for step in several(kept["future"])
                ]
            except (TypeError, ValueError) as error:
                raise ValueError(f"future must be whole numbers of control steps, 1 or more: {error}") from None
            if len(set(kept["future"])) < len(kept["future"]):
                raise ValueError(f"future names a frame twice: {kept['future']}")
        return kept

    @classmethod
    def stage_of(cls, info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns nothing: evaluations begin anywhere in the motions, not where the training had failed most."""
        return {}

    def constants(self) -> dict[str, Any]:
        """Returns the reference at each frame, and where clips and their pieces are.

        Raises:
            ValueError: a motion does not fit the robot, or there are too many.
            OSError: a file is not there.
        """
        self.frames = f = self._frames()
        clips = len(f.names)
        if clips > 1:
            self.command_ranges = {"clip": {"clip": (0.0, clips - 1.0)}, **type(self).command_ranges}
        length = max(PIECE / self.config.ctrl_dt, (len(f.qpos) - clips) / (PIECES - clips)) if clips < PIECES else 0
        if not length:
            raise ValueError(f"there are {clips} motions: at most {PIECES - 1} can be practised together")
        counts = [max(1, math.floor((last - first) / length)) for first, last in zip(f.first, f.last, strict=True)]
        edges = [np.linspace(*clip).astype(int) for clip in zip(f.first, f.last, np.add(counts, 1), strict=True)]
        begins, ends = (np.concatenate([edge[part] for edge in edges]) for part in (np.s_[:-1], np.s_[1:]))
        piece_of = np.searchsorted(begins, np.arange(len(f.qpos)), side="right") - 1
        is_last, self.pieces = np.isin(ends, f.last), len(begins)
        share = (ends - begins) * np.repeat(f.weights, counts)
        room = 0, PIECES - len(begins)
        last = np.repeat(f.last, f.last - f.first + 1)
        return {
            **{"joints": f.qpos[:, 7:], "rates": f.qvel[:, 6:], "root": f.qpos[:, :7], "root_rates": f.qvel[:, :6]},
            **{"pos": f.pos, "mat": f.mat, "lin": f.lin, "ang": f.ang},
            **{"clip_first": f.first, "clip_last": f.last, "last": last.astype(np.int32)},
            **{"piece_of": piece_of.astype(np.int32), "piece_begins": begins.astype(np.int32)},
            "piece_lengths": (ends - begins).astype(np.float32),
            "piece_share": np.pad((share / share.sum()).astype(np.float32), room),
            "any_piece": (share.cumsum() / share.sum()).astype(np.float32),
            "goes_on": np.pad((~is_last).astype(np.float32), room),
        }

    def _frames(self) -> motions.Frames:
        """Returns the motions as tables, which environments that are made one after the other share."""
        given, fps = (self.motion, self.fps) if "motion" in self.options_given else ([], OWN_RATE)
        if not given and not hasattr(self, "motion_folder"):
            raise ValueError(f"{type(self).__name__} has no motions of its own: pass motion, or set motion_folder")
        key = type(self), json.dumps(given), fps, self.config.ctrl_dt
        try:
            named = motions.named(given or self.motion_folder, fps)
            paths = [Path(one["path"]).resolve() for one in named if isinstance(one, dict)]
            stamp = [(path, file.st_mtime_ns, file.st_size, file.st_ino) for path in paths for file in (path.stat(),)]
        except FileNotFoundError:
            if key not in _tables:
                raise
            # a training that runs goes on without its files
            return _tables[key][1]
        if key not in _tables or _tables[key][0] != stamp:
            _tables.clear()
            read = motions.read(named)
            _tables[key] = stamp, motions.Frames.of(read, self.mj_model, self.bodies, self.config.ctrl_dt)
        return _tables[key][1]

    # What is compared.

    def errors(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns how far the robot is from the reference that the policy has seen.

        Returns:
            ``anchor_position`` (m) ``(num_envs, 3)``, ``anchor_angle`` (rad) ``(num_envs,)``; of the bodies, relative
            to the anchor, ``positions`` (m) ``(num_envs, bodies, 3)`` and ``angles`` (rad) ``(num_envs, bodies)``; and
            of both frames, ``base`` and ``anchor``, how much lower the upright axis is, ``(num_envs,)``.
        """
        anchor, base = self.bodies.index(self.anchor), self.bodies.index(self.base)
        pos, mat, wanted, frames = s.xpos(self.bodies), s.xmat(self.bodies), s.pos[s.frame], s.mat[s.frame]
        turn = mat[:, anchor] @ frames[:, anchor].mT
        yaw = torch.atan2(turn[:, 1, 0], turn[:, 0, 0])
        c, n, zero, one = yaw.cos(), yaw.sin(), torch.zeros_like(yaw), torch.ones_like(yaw)
        about = torch.stack([c, -n, zero, n, c, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3)).unsqueeze(1)
        place = torch.cat([pos[:, anchor, :2], wanted[:, anchor, 2:]], dim=-1).unsqueeze(1)
        from_anchor = wanted - wanted[:, anchor].unsqueeze(1)
        moved = place + (about @ from_anchor.unsqueeze(-1)).squeeze(-1)
        return {
            "anchor_position": wanted[:, anchor] - pos[:, anchor],
            "anchor_angle": angle(mat[:, anchor], frames[:, anchor]),
            "base_height": wanted[:, base, 2] - pos[:, base, 2],
            "positions": moved - pos,
            "angles": angle(mat, about @ frames),
            "base": (mat[:, base, 2, 2] - frames[:, base, 2, 2]).abs(),
            "anchor": (mat[:, anchor, 2, 2] - frames[:, anchor, 2, 2]).abs(),
        }

    @classmethod
    def facts(cls, m: mujoco.MjModel, info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns how actions become targets of the joints, which bodies are followed about which, and frames ahead."""
        tracking: dict[str, Any] = {"base": cls.base, "anchor": cls.anchor, "bodies": list(cls.bodies)}
        tracking["future"] = options_of_class(cls, info.get("options")).get("future", [])
        return {**super().facts(m, info), "tracking": tracking}

    # The hooks, in the order in which they are called.

    def reward(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns the terms of the reward."""
        wrong = self.errors(s)
        squared = {
            "anchor_position": squares(wrong["anchor_position"]),
            "anchor_orientation": wrong["anchor_angle"].square(),
            "body_positions": wrong["positions"].square().sum(-1).mean(-1),
            "body_orientations": wrong["angles"].square().mean(-1),
            "body_velocities": (s.lin[s.frame] - s.linvel(self.bodies)).square().sum(-1).mean(-1),
            "body_turn_rates": (s.ang[s.frame] - s.angvel(self.bodies)).square().sum(-1).mean(-1),
        }
        terms = {name: weight * torch.exp(-squared[name] / error**2) for name, (weight, error) in FOLLOWED.items()}
        penalties = {"action_rate": squares(s.action - s.last_action), "joint_limits": self.beyond_limits(s)}
        if self.own_geoms:
            penalties["self_collision"] = hard_contacts(s, self.own_geoms)
        terms |= {name: PENALTIES[name] * value for name, value in penalties.items()}
        return {name: s.dt * term for name, term in terms.items()}

    def terminated(self, s: "View") -> torch.Tensor:
        """Returns whether the reference is lost."""
        wrong = self.errors(s)
        if self.play:
            return (wrong["base"] > MAX_TILT) | (wrong["base_height"].abs() > MAX_HEIGHT)
        ends = [self.bodies.index(name) for name in self.ends]
        far = (wrong["positions"][:, ends, 2].abs() > MAX_HEIGHT).any(-1)
        return far | (wrong["anchor"] > MAX_TILT) | (wrong["anchor_position"][:, 2].abs() > MAX_HEIGHT)

    def truncated(self, s: "View") -> torch.Tensor:
        """Returns whether the clip ends."""
        return s.frame + 1 >= s.last[s.frame]

    def metrics(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns errors of joints (rad), of bodies relative to the anchor (m, rad), and of the anchor (m)."""
        wrong = self.errors(s)
        return {
            "joint_error": (s.joint_qpos(self.joints) - s.joints[s.frame]).abs().mean(-1),
            "body_error": wrong["positions"].norm(dim=-1).mean(-1),
            "body_angle_error": wrong["angles"].mean(-1),
            "anchor_error": wrong["anchor_position"].norm(dim=-1),
            "world_error": (s.pos[s.frame] - s.xpos(self.bodies)).norm(dim=-1).mean(-1),
        }

    def events(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns the next frame of the reference, the last action, and pushes."""
        rows = {"frame": torch.minimum(s.frame + 1, s.last[s.frame]), "last_action": s.action}
        if self.play:
            return {**rows, **self.moved(s)}
        return {**rows, **pushed(s, PUSH)}

    def adapt(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns how often pieces were visited and the reference lost in them, and where starts are drawn."""
        piece = s.piece_of[(s.frame - 1).clamp(min=0)].long() + PIECES * s.terminated
        counts = torch.zeros(2 * PIECES, dtype=torch.int64, device=s.device)
        counts = counts.index_add(0, piece, torch.ones_like(piece)).view(2, PIECES)
        total = torch.stack([s.visits + counts.sum(0), s.failures + counts[1]])
        recent = MEMORY * s.recent + (total - s.counted)  # what other ranks have counted meanwhile among it
        rate = recent[1] / (recent[0] + 1.0)
        after = torch.cat([rate[1:], torch.zeros_like(rate[:1])])
        weight = s.piece_share * (rate + BEFORE * s.goes_on * after)
        running = (weight * 2.0**40).long().cumsum(0)  # of integers: sums of floats have no fixed order on CUDA
        chance = running / running[-1].clamp(min=1)
        return {"visits": total[0], "failures": total[1], "counted": total, "recent": recent, "chance": chance}

    def observation(self, s: "View") -> dict[str, dict[str, torch.Tensor]]:
        """Returns what the policy sees, and for the critic the same without noise and the bodies."""
        anchor = self.bodies.index(self.anchor)
        pos, mat = s.xpos(self.bodies), s.xmat(self.bodies)
        into = mat[:, anchor].mT
        wanted, frames = s.pos[s.frame, anchor], s.mat[s.frame, anchor]
        seen = {
            "reference_joints": s.joints[s.frame],
            "reference_rates": s.rates[s.frame],
            "anchor_position": (into @ (wanted - pos[:, anchor]).unsqueeze(-1)).squeeze(-1),
            "anchor_orientation": (into @ frames)[..., :2].flatten(1),
            "linear_velocity": s.to_body(self.base, s.linvel(self.base)),
            "angular_velocity": s.to_body(self.base, s.angvel(self.base)),
            "joint_positions": s.joint_qpos(self.joints) - self.home(s),
            "joint_velocities": s.joint_qvel(self.joints),
            "last_action": s.last_action,
        }
        if self.future:
            seen["ahead"] = self.ahead(s).flatten(1)
        from_anchor = into.unsqueeze(1) @ (pos - pos[:, anchor].unsqueeze(1)).unsqueeze(-1)
        turned = (into.unsqueeze(1) @ mat)[..., :2]
        hidden = {"bodies": from_anchor.flatten(1), "orientations": turned.flatten(1)}
        measured = {name: values for name, values in seen.items() if self.estimates or name not in ESTIMATED}
        return {"observation": measured, "privileged": {**seen, **hidden}}

    def ahead(self, s: "View") -> torch.Tensor:
        """Returns what the policy sees of the frames ahead, the last at the end, ``(num_envs, frames, size)``."""
        steps = torch.tensor(self.future, dtype=torch.int32, device=s.device)
        frame = torch.minimum(s.frame.unsqueeze(-1) + steps, s.last[s.frame].unsqueeze(-1))
        base, rates, mat = s.root[frame], s.root_rates[frame], s.mat[frame, self.bodies.index(self.base)]
        linear = (mat.mT @ rates[..., :3].unsqueeze(-1)).squeeze(-1)
        floating = [base[..., 2:3], -mat[..., 2, :], linear, rates[..., 3:]]
        return torch.cat([s.joints[frame], s.rates[frame], *floating], dim=-1)

    def begin(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns the pose and velocities of a frame of the reference; in training something near it, and a push."""
        if self.play:
            return self.begun(s)
        anywhere = (s.uniform(0.0, 1.0) < UNIFORM) | (s.chance[-1] <= 0.0)  # nothing is known of failures at first
        drawn = s.uniform(0.0, 1.0)
        piece = torch.where(anywhere, torch.searchsorted(s.any_piece, drawn), torch.searchsorted(s.chance, drawn))
        piece = piece.clamp(max=self.pieces - 1)
        frame = s.piece_begins[piece] + (s.uniform(0.0, 1.0) * s.piece_lengths[piece]).int()
        rows = self.at(s, frame)
        root, joints = rows["qpos"][:, :7], rows["qpos"][:, 7:] + s.uniform(-BEND, BEND, len(self.joints))
        place = root[:, :3] + s.uniform(-1.0, 1.0, 3) * torch.tensor(NEAR, device=s.device)
        small = small_turn(s.uniform(-1.0, 1.0, 3) * torch.tensor(TILT, device=s.device))
        low, high = self.limits(s)
        push = s.uniform(-1.0, 1.0, 6) * torch.tensor(PUSH, device=s.device)
        return {
            "frame": frame,
            "qpos": torch.cat([place, product(small, root[:, 3:]), joints.clamp(low, high)], dim=-1),
            "qvel": torch.cat([rows["qvel"][:, :6] + push, rows["qvel"][:, 6:]], dim=-1),
            "bias": s.uniform(-BIAS, BIAS, len(self.joints)),
            "until_push": s.uniform(*PUSH_EVERY),
            "delay": s.uniform(0.0, self.max_delay + 1.0).floor() if self.max_delay else torch.zeros_like(drawn),
        }

    def at(self, s: "View", frame: torch.Tensor) -> dict[str, torch.Tensor]:
        """Returns pose and velocities of a frame of the reference."""
        qvel = torch.cat([s.root_rates[frame], s.rates[frame]], dim=-1)
        return {"frame": frame, "qpos": torch.cat([s.root[frame], s.joints[frame]], dim=-1), "qvel": qvel}

    def begun(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns what begins where world and commands say: at the first frame of the world's own clip, without any."""
        clip = (s.env_index + s.clip.round().long()) % len(self.frames.names)
        first, last = s.clip_first[clip], s.clip_last[clip]
        frame = torch.minimum(first + (s.phase.clamp(0.0, 1.0) * (last - first)).long(), last - 1).int()
        kept = {"clip": s.clip, "phase": s.phase, "began_clip": s.clip, "began_phase": s.phase}
        return {**self.at(s, frame), **kept}

    def moved(self, s: "View") -> dict[str, torch.Tensor]:
        """Returns what begins anew where clip or phase have been set to something else."""
        other = (s.clip != s.began_clip) | (s.phase != s.began_phase)
        begun = self.begun(s)
        held = {"frame": torch.minimum(s.frame + 1, s.last[s.frame]), "qpos": s.qpos, "qvel": s.qvel}
        held |= {"began_clip": s.began_clip, "began_phase": s.began_phase}
        rows = either(other, {name: begun[name] for name in held}, held)
        unset = torch.zeros_like(s.clip)  # what is set is written over it
        return {**rows, "clip": unset, "phase": unset}

    def cases(self) -> dict[str, int]:
        """Returns the clips by name, with their control steps."""
        f = self.frames
        steps = (f.last - f.first).tolist()
        names = [name if f.names.count(name) == 1 else f"{name} {k}" for k, name in enumerate(f.names)]
        if len({*names}) < len(names):  # one is called as if it were one of several
            names = [f"{name} {k}" for k, name in enumerate(f.names)]
        return dict(zip(names, steps, strict=True))

    def reference(self) -> dict[str, torch.Tensor]:
        """Returns the reference at each frame, by mjlab's names: joints, and the bodies that follow."""
        f = self.frames
        tables = motions.mjlabs_tables(f.qpos[:, 7:], f.qvel[:, 6:], f.pos, f.mat, f.lin, f.ang)
        return {name: torch.from_numpy(table) for name, table in tables.items()}

    def ghost(self) -> torch.Tensor:
        """Returns the poses of the reference, ``(num_envs, nq)``."""
        frame = self.world.memory["frame"].long()
        assert self.hooks is not None
        tables = self.hooks.catalog.constants
        return torch.cat([tables["root"][frame], tables["joints"][frame]], dim=-1)


def _kept(motion: Any) -> Any:
    """Returns a motion as a run keeps it: its whole path, or the arguments of a :class:`torchrl_loco.Motion`."""
    if isinstance(motion, motions.Motion):
        return motion.as_json()
    if isinstance(motion, Mapping):
        return dict(motion)
    if not isinstance(motion, str | Path):
        raise TypeError(f"motion must be a path, a Motion, or a list of these, got {motion!r}")
    return str(Path(motion).expanduser().absolute())


_tables: dict[Any, tuple[list[Any], motions.Frames]] = {}  # when files were changed, and what was read of them


def angle(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Returns the angles (rad) between rotations ``(..., 3, 3)``, at most a little less than half a turn."""
    half = ((one - other).square().sum((-1, -2)) / 8.0).clamp(0.0, 0.9998).sqrt()
    return 2.0 * torch.asin(half)


def both(*links: str) -> list[str]:
    """Returns the names of links on the left, then on the right."""
    return [f"{side}_{link}" for side in ("left", "right") for link in links]


class G1Tracking(Tracking):
    """A Unitree G1, a humanoid of 29 joints and 33 kg, follows motions."""

    body = "g1"
    model = G1Velocity.model
    memory = memory(joints=29)
    base, anchor = "pelvis", "torso_link"
    ends = both("ankle_roll_link", "wrist_yaw_link")
    bodies = [
        *(base, anchor),
        *both("hip_roll_link", "knee_link", "ankle_roll_link"),
        *both("shoulder_roll_link", "elbow_link", "wrist_yaw_link"),
    ]
    own_geoms = G1Velocity.own_geoms
    motion_folder = FOLDER / "g1"
    randomize = G1Velocity.randomize


class G1TrackingNoEstimation(G1Tracking):
    """A Unitree G1 follows motions by what it measures, without knowing where it is and how fast."""

    estimates = False
    noise = {name: most for name, most in NOISE.items() if name not in ESTIMATED}


class H1Tracking(Tracking):
    """A Unitree H1, a humanoid of 19 joints and 51 kg, follows motions."""

    body = "h1"
    model = H1Velocity.model
    config = H1Velocity.config
    memory = memory(joints=19)
    base, anchor = "pelvis", "torso_link"
    ends = both("ankle_link", "elbow_link")
    bodies = [
        *(base, anchor),
        *both("hip_roll_link", "knee_link", "ankle_link"),
        *both("shoulder_roll_link", "elbow_link"),
    ]
    action_scale = H1Velocity.action_scale
    motion_folder = FOLDER / "h1"
    randomize = H1Velocity.randomize
