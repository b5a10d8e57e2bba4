"""A network that predicts one control step of a robot whose base floats."""

from collections.abc import Sequence

import mujoco
import torch
from torch import nn
from torch.nn.functional import normalize, smooth_l1_loss

from torchrl_loco.envs.rotations import matrix, product, small_turn
from torchrl_loco.envs.sensors import into_frame, out_of_frame
from torchrl_loco.policy import ObservationNorm, moments
from torchrl_loco.sim.compiled.collision.pairs import of_ground
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import normed_layers

REACH = 8  # control steps whose way, at the usual speed, is the unit of errors of place and orientation
LIMIT = 10.0  # of what the network gives, in standard deviations of what was seen
LEAST = 1e-4  # variance that is added where something hardly varies


class Dynamics(nn.Module):
    """Predicts how velocities change in a control step, and how joints move beyond what velocities say.

    The network reads height, upright axis and velocities of the base in its own frame, joints and their rates, and the
    controls. Place and heading do not matter to it: it knows level ground alone.

    Args:
        m: the model.
        dt: time of a control step (s).
        substeps: physics steps in it.
        hidden: widths of the network's layers.

    Raises:
        ValueError: the base does not float, a joint is neither a hinge nor a slide, or there is something of which the
            network would not know: activations, other bodies that move, ground that is not level.
    """

    def __init__(self, m: mujoco.MjModel, dt: float, substeps: int, hidden: Sequence[int]) -> None:
        super().__init__()
        if why := unpredictable(m):
            raise ValueError(f"svg learns no model of this robot: {why}; train it with ppo or reppo")
        self.nq, self.nv, self._dt, self._joints = int(m.nq), int(m.nv), dt, int(m.nv) - 6
        self._ahead = 0.5 * (substeps + 1) / substeps  # share of a step's change that velocities have on its average
        self.inputs = ObservationNorm(10 + 2 * self._joints + int(m.nu))
        self.outputs = ObservationNorm(2 * self.nv)
        last = nn.Linear(hidden[-1], 2 * self.nv)
        nn.init.zeros_(last.weight)
        self.net = nn.Sequential(*normed_layers(len(self.inputs.mean), hidden), last)

    def forward(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions ``(n, nq)`` and velocities ``(n, nv)`` after a control step."""
        frame, seen = self._seen(qpos, qvel)
        found = self.net(self.inputs(torch.cat([seen, ctrl], dim=-1))).float()
        found = found.clamp(-LIMIT, LIMIT) * (self.outputs.var + 1e-8).sqrt() + self.outputs.mean
        change, beyond = found.split(self.nv, dim=-1)
        rate = self._local(seen, qvel) + self._ahead * change + beyond
        turned = product(qpos[:, 3:7], small_turn(self._dt * rate[:, 3:6]))
        turned = normalize(turned, dim=-1, eps=1e-6)
        place = qpos[:, :3] + self._dt * out_of_frame(frame, rate[:, :3])
        linear = qvel[:, :3] + out_of_frame(frame, change[:, :3])
        after = torch.cat([place, turned, qpos[:, 7:] + self._dt * rate[:, 6:]], dim=-1)
        return after, torch.cat([linear, qvel[:, 3:] + change[:, 3:]], dim=-1)

    def _seen(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the frame of the base, ``(n, 3, 3)``, and what the network reads of a state."""
        frame = matrix(qpos[:, 3:7])
        linear = into_frame(frame, qvel[:, :3])
        return frame, torch.cat([qpos[:, 2:3], frame[:, 2], linear, qvel[:, 3:], qpos[:, 7:]], dim=-1)

    def _local(self, seen: torch.Tensor, qvel: torch.Tensor) -> torch.Tensor:
        """Returns velocities, those of the base in its frame, ``(n, nv)``."""
        return torch.cat([seen[:, 4:7], qvel[:, 3:]], dim=-1)

    @torch.no_grad()
    def learn_moments(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor, after: torch.Tensor) -> None:
        """Updates the normalisation with steps.

        Args:
            qpos: positions before them, ``(n, nq)``.
            qvel: velocities before them, ``(n, nv)``.
            ctrl: controls, ``(n, nu)``.
            after: positions and velocities after them, ``(n, nq + nv)``.
        """
        frame, seen = self._seen(qpos, qvel)
        later, fast = after.split([self.nq, self.nv], dim=-1)
        change = torch.cat([into_frame(frame, (fast - qvel)[:, :3]), (fast - qvel)[:, 3:]], dim=-1)
        turn = product(qpos[:, 3:7] * qpos.new_tensor([1.0, -1.0, -1.0, -1.0]), later[:, 3:7])
        moved = into_frame(frame, (later - qpos)[:, :3]), 2.0 * turn[:, 1:] * turn[:, :1].sign(), (later - qpos)[:, 7:]
        beyond = torch.cat(moved, dim=-1) / self._dt - self._local(seen, qvel) - self._ahead * change
        read, given = torch.cat([seen, ctrl], dim=-1), torch.cat([change, beyond], dim=-1)
        for norm, rows in ((self.inputs, read), (self.outputs, given)):
            norm.merge(*distributed.merged_moments(*moments(rows)))

    def errors(self, qpos: torch.Tensor, qvel: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """Returns how far predictions are from what came, ``(n,)``, in units of how far states differ (Huber loss)."""
        later, fast = after.split([self.nq, self.nv], dim=-1)
        std = (self.inputs.var + LEAST).sqrt()
        speed, turn = std[4:7].mean(), std[7:10].mean()
        rates, joints = std[10 : 10 + self._joints], std[10 + self._joints : 10 + 2 * self._joints]
        reach = REACH * self._dt
        wrong = [
            (qpos - later)[:, :3] / (reach * speed),
            (matrix(qpos[:, 3:7]) - matrix(later[:, 3:7])).flatten(1) / (reach * turn),
            (qpos - later)[:, 7:] / joints,
            (qvel - fast)[:, :3] / speed,
            (qvel - fast)[:, 3:6] / turn,
            (qvel - fast)[:, 6:] / rates,
        ]
        rows = torch.cat(wrong, dim=-1)
        return smooth_l1_loss(rows, torch.zeros_like(rows), reduction="none").mean(-1)


def unpredictable(m: mujoco.MjModel) -> str:
    """Returns what of a model a network could not predict from the state of a robot, or an empty string."""
    free, slide, plane = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtGeom.mjGEOM_PLANE
    kinds = m.jnt_type.tolist()
    if kinds[:1] != [int(free)] or any(kind < int(slide) for kind in kinds[1:]):
        return "its base must float, and its joints be hinges or slides"
    if len(set(m.body_rootid[m.jnt_bodyid].tolist())) > 1:
        return "another body moves, too"
    if m.na:
        return "its actuators have activations"
    if m.nmocap:
        return "a mocap body is moved by hand"
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    level = (m.geom_type == int(plane)) & (data.geom_xmat[:, 8] > 1.0 - 1e-9)
    return "the ground must be a level plane" if (of_ground(m) & ~level).any() else ""
