"""Rough: the robots of ``velocity`` on ground that gets harder as they cross it. One recipe, and a table for each."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch

from torchrl_loco import motion, terrain
from torchrl_loco.envs.names import matching
from torchrl_loco.envs.task import folder_of
from torchrl_loco.envs.view import View
from torchrl_loco.sim import models
from torchrl_loco.tasks import velocity
from torchrl_loco.tasks.robots import com, either, hard_contacts, sliding, squares
from torchrl_loco.tasks.velocity import WEIGHTS, G1Velocity, Go1Velocity, Go2Velocity, H1Velocity, Velocity
from torchrl_loco.terrain.kinds import Patch, points

SCAN = tuple((round(0.1 * x, 1), round(0.1 * y, 1)) for y in range(-5, 6) for x in range(-8, 9))
"""Where the heights around a robot are seen, ahead of it and to its left (m)."""
MISS, SCALE = 5.0, 0.2  # height over the ground where there is none (m), and how heights are scaled
FIRST_LEVELS = 6  # levels among which first episodes begin
EXPECTED, COUNTS_FROM = 0.5, 0.25
"""Share of the way that commands led at which a robot keeps its level; which way counts, in sides of a patch."""
EDGE = 0.3  # how near the end of the ground an episode is cut off (m)
AROUND = ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.25), (0.0, -0.25))
"""Points ahead and to the left by which the slope of the ground is judged (m)."""


def hill(difficulty: float, rng: np.random.Generator, size: float, cell: float, down: bool = False) -> Patch:
    """Returns a hill with a level top, or a hollow, that is as steep as 45 degrees in the middle of its sides."""
    reach = size / 2 - 0.2  # around it the ground is level
    along = np.clip(1.0 - np.abs(points(size, cell)) / reach, 0.0, None)
    heights = reach * difficulty * np.minimum(along[:, None] * along[None], (1.0 - 1.0 / reach) ** 2)
    return Patch(heights=-heights if down else heights)


GROUND = terrain.Terrain(
    {
        "stairs": (functools.partial(terrain.stairs, height=(0.0, 0.1)), 2.0),
        "stairs down": (functools.partial(terrain.stairs, height=(0.0, 0.1), down=True), 2.0),
        "hill": hill,
        "hollow": functools.partial(hill, down=True),
        "rough": functools.partial(terrain.rough, height=(0.1, 0.1), step=0.02),
        "wave": terrain.wave,
        "flat": (terrain.flat, 2.0),
    },
    rows=10,
    columns=10,
)
"""mjlab's patches: ten difficulties, and its shares of kinds."""


def memory(joints: int, feet: int) -> dict[str, Any]:
    """Returns what a robot with so many actuated joints and feet remembers."""
    return {
        **velocity.memory(joints, feet),
        **{"level": torch.int32, "reached": torch.int32},  # rows of the ground, from 1 on; 0 before the first episode
        **{"origin": 3, "distance": ()},  # where it began, and the farthest from there (m)
        **{"commanded_displacement": 2, "commanded_distance": ()},  # by its commands, and the farthest (m)
        **{"fell": torch.bool, "asked": torch.bool},  # asked whether it left its patch
        **{"patch": 2, "began_patch": 2},  # of play: number of the kind, difficulty
    }


class Rough(Velocity):
    """What robots share that follow a velocity command over rough ground; a robot sets what ``Velocity`` asks for.

    ``ground`` lies under the robot of the class below. Another ground is a line in a subclass.

    Observation:
        That of :class:`torchrl_loco.tasks.velocity.Velocity`, and last the height of the base over the ground at the
        points ``SCAN``, which turn with its yaw, times 0.2; 1 where there is no ground.

    Reward:
        That on flat ground. Heights of feet are over the ground below them; where :attr:`leans`, the trunk stands
        upright on the slope below it, and each of the groups of geoms in :attr:`scrapes` costs what
        ``weights["scrapes"]`` says for each physics step in which one of it has a hard contact.

    Start:
        At rest in the home pose, just above the ground below feet and base, in the middle of a patch of its level;
        nothing else may reach up to the trunk there. The level rises when a robot has left its patch, and falls when it
        fell, or made less than half of the way that its commands led; after the last level comes a random one.

    Termination:
        When the trunk is tilted by more than 70 degrees; truncation after 1000 steps, where a robot has left its patch,
        so that the next level comes at once, and at the end of the ground.

    Source:
        mjlab 1.6.0, rough velocity task. There episodes begin in the ground of waves and go on beyond their patch,
        slow commands let levels fall, and a Go1's episode ends by a thigh that touches the ground, not by its tilt.
    """

    noise = {**Velocity.noise, "scan": 0.02}
    presets = {"ppo": {**Velocity.presets["ppo"], "total_frames": 300_000_000, "norm_eps": 0.1}}
    holds: ClassVar[Mapping[str, Any]] = {"falls": 0.05, "delay": (0, 2), "friction": (0.6, 1.2), "pushes": 0.5}

    ground: ClassVar[terrain.Terrain] = GROUND
    """What lies under the robots."""
    leans: ClassVar[bool] = False
    """Whether the trunk is to lean with the slope."""
    scrapes: ClassVar[tuple[str, ...]] = ()
    """Regular expressions of groups of geoms that are not to touch anything."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Lays the ground under the robot, whose feet decide on friction, as they do on the floor."""
        super().__init_subclass__(**kwargs)
        order, above = cls.__mro__, [base for base in cls.__mro__[1:] if "model" in vars(base)]
        laid = next((base for base in above if issubclass(base, Rough)), None)
        # What is its own, or that of classes without a ground that are mixed in.
        given = {name for base in order[: order.index(laid) if laid else 1] for name in vars(base)}
        if "model" not in given and not above and not hasattr(cls, "robot"):
            return  # what several robots share
        if "config" in given or laid is None:
            cls.config = dataclasses.replace(cls.config, solids_on_terrain="spheres")
        if laid and given.isdisjoint(("ground", "robot", "model", "feet")):
            return
        if not isinstance(cls.ground, terrain.Terrain):
            raise TypeError(f"ground of {cls.__name__} must be a torchrl_loco.terrain.Terrain, got {cls.ground!r}")
        if not hasattr(cls, "feet"):
            raise TypeError(f"{cls.__name__} must set feet: see help(torchrl_loco.Velocity)")
        if "model" in given or not hasattr(cls, "robot"):
            cls.robot = models.specification(cls.model, folder_of(cls))
        spec = cls.ground.under(models.specification(cls.robot, folder_of(cls, "robot")))
        geoms = list(spec.geoms)
        for pattern in cls.feet.values():
            for g in matching([geom.name for geom in geoms], pattern):
                geoms[g].priority = 1
        kinds = len(dict.fromkeys(cls.ground.kinds))
        patch = {"kind": (0.0, max(kinds - 1.0, 1.0)), "difficulty": (0.0, 1.0)}
        cls.model, cls.command_ranges = spec, {**cls.command_ranges, "patch": patch}

    robot: ClassVar[Path | str | mujoco.MjSpec]
    """The robot on its floor."""

    def constants(self) -> dict[str, np.ndarray]:
        """Returns patches, the columns of each kind, and where feet are in the home pose, and how deep (m)."""
        names = list(dict.fromkeys(self.ground.kinds))
        counts = [self.ground.kinds.count(name) for name in names]
        m, data = self.mj_model, mujoco.MjData(self.mj_model)
        data.qpos[:] = models.home_pose(m)
        mujoco.mj_kinematics(m, data)
        known = [m.geom(g).name for g in range(m.ngeom)]
        geoms = sorted({g for feet in self.feet.values() for g in matching(known, feet)})
        (lowest,) = motion.lowest_points(m, data.xpos[None], data.xmat.reshape(1, -1, 3, 3), geoms)
        return {
            "origins": self.ground.origins.reshape(-1, 3).astype(np.float32),
            "first_column": np.cumsum([0, *counts[:-1]]).astype(np.int32),
            "columns_of": np.array(counts, dtype=np.int32),
            "standing": np.vstack([data.geom_xpos[geoms, :2] - data.qpos[:2], np.zeros(2)]).astype(np.float32),
            "sunk": np.array([max(0.0, -lowest)], dtype=np.float32),
        }

    @classmethod
    def stage_of(cls, info: Mapping[str, Any]) -> Mapping[str, Any]:
        """Returns how far the commands have come, and all levels: evaluations begin on each as often."""
        trained = {"trained": super().stage_of(info)["memory"]["trained"]}
        levels = list(range(1, cls.ground.rows + 1))
        of_last = {"distance": [0.0], "commanded_distance": [0.0], "fell": [False]}  # which would change them
        return {"memory": {**trained, "level": levels, "reached": levels, **of_last}}

    @classmethod
    def fixed_commands(cls, info: Mapping[str, Any]) -> dict[str, list[list[float]]]:
        """Returns one, straight ahead: across the patch."""
        return {"command": [[1.0, 0.0, 0.0]]}

    def cases(self) -> dict[str, int]:
        """Returns the patches by kind and difficulty, the hardest first."""
        kinds, rows = dict.fromkeys(self.ground.kinds), self.ground.difficulties[::-1]
        digits = max(2, math.ceil(math.log10(len(rows))))
        # The class's: a run with another length has the same cases.
        length = type(self).episode_length or self.config.episode_length
        return {f"{kind} at {row:.{digits}f}": length for row in rows for kind in kinds}

    # What hooks share.

    def heights(self, s: View) -> torch.Tensor:
        """Returns the heights of the feet over the ground below them (m), ``(num_envs, feet)``."""
        sites = s.site_xpos(list(self.feet))
        return sites[..., 2] - s.terrain_height(sites).nan_to_num(0.0)

    def has_left(self, s: View) -> torch.Tensor:
        """Returns whether a robot has been farther from where it began than its patch reaches, ``(num_envs,)``."""
        return s.distance > self.ground.size / 2

    def is_settled(self, s: View) -> torch.Tensor:
        """Returns whether a robot has left its patch, or its commands have led twice as far, ``(num_envs,)``."""
        return self.has_left(s) | (s.commanded_distance >= self.ground.size)

    def ahead(self, s: View) -> torch.Tensor:
        """Returns the horizontal direction in which the base looks, ``(num_envs, 2)``."""
        return torch.nn.functional.normalize(s.xmat(self.base)[:, :2, 0], dim=-1)

    def normal(self, s: View) -> torch.Tensor:
        """Returns the direction in which the ground around the base faces, ``(num_envs, 3)``."""
        around, ahead = torch.tensor(AROUND, device=s.device), self.ahead(s)
        place = s.xpos(self.base)[:, :2].unsqueeze(1)
        front, back, left, right = (
            s.terrain_height(place + turned(around, ahead.unsqueeze(1))).nan_to_num(0.0).unbind(-1)
        )
        rise = torch.stack([(back - front) / (2 * AROUND[0][0]), (right - left) / (2 * AROUND[2][1])], dim=-1)
        normal = torch.cat([turned(rise, ahead), torch.ones_like(rise[:, :1])], dim=-1)
        return torch.nn.functional.normalize(normal, dim=-1)

    # The hooks, in the order in which they are called.

    def update(self, s: View) -> dict[str, torch.Tensor]:
        """Returns also how far a robot has been from where it began, and how far by its commands."""
        commanded = s.commanded_displacement + s.dt * turned(s.command[:, :2], self.ahead(s))
        return {
            **super().update(s),
            "distance": torch.maximum(s.distance, (s.qpos[:, :2] - s.origin[:, :2]).norm(dim=-1)),
            "commanded_displacement": commanded,
            "commanded_distance": torch.maximum(s.commanded_distance, commanded.norm(dim=-1)),
        }

    def terms(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the terms on flat ground, the trunk being upright on the slope."""
        terms = super().terms(s)
        if self.leans:
            tilt = s.to_body(self.trunk, self.normal(s))[:, :2]
            terms["upright"] = torch.exp(-squares(tilt) / 0.2)
        if "scrapes" in self.weights or self.scrapes:
            scraping = [hard_contacts(s, geoms) for geoms in self.scrapes]
            terms["scrapes"] = torch.stack(scraping).sum(0) if scraping else torch.zeros_like(s.time)
        return terms

    def truncated(self, s: View) -> torch.Tensor:
        """Returns whether the ground ends, or the robot has left its patch; in play it may go on."""
        half = torch.tensor(self.ground.half, device=s.device) + (self.ground.border - EDGE)
        ends = (s.qpos[:, :2].abs() > half).any(-1)
        return ends if self.play else ends | self.has_left(s)

    def metrics(self, s: View) -> dict[str, torch.Tensor]:
        """Returns also the level and the best level, from 0 on, and the share of robots that leave their patch.

        A robot is asked once: when it falls, when it leaves, or when its commands have led a patch's side away.
        """
        asked = ~s.asked & (s.terminated | self.is_settled(s))
        return {
            **super().metrics(s),
            "level": s.level - 1.0,
            "reached": s.reached - 1.0,
            "crossed": torch.where(asked, self.has_left(s).float(), math.nan),
        }

    def events(self, s: View) -> dict[str, torch.Tensor]:
        """Returns also who fell and was asked; in play, what begins anew where kind or difficulty were set."""
        rows = {**super().events(s), "fell": s.terminated, "asked": self.is_settled(s)}
        if not self.play:
            return rows
        other = (s.patch != s.began_patch).any(-1)
        ways = ("distance", "commanded_displacement", "commanded_distance")
        begun = {**self.begin(s), **{name: torch.zeros_like(getattr(s, name)) for name in ways}}
        anew = either(other, begun, {**{name: getattr(s, name) for name in begun}, **rows})
        return {**rows, **anew, "qvel": torch.where(other.unsqueeze(-1), 0.0, s.qvel)}

    def observation(self, s: View) -> dict[str, dict[str, torch.Tensor]]:
        """Returns that on flat ground, and the heights around the robot."""
        scan = SCALE * s.height_scan(self.base, SCAN, miss=MISS)
        return {group: {**terms, "scan": scan} for group, terms in super().observation(s).items()}

    def begin(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the home pose over the middle of a patch, and a command."""
        start = super().begin(s)
        rows = self.chosen_level(s) if self.play else self.next_level(s)
        level, columns = rows["level"] - 1, self.ground.columns
        origin = s.origins[(level * columns + rows.pop("column")).int()]
        place, z = start["qpos"][:, :2] + origin[:, :2], start["qpos"][:, 2:3]
        half = start["qpos"][:, 3:7]
        ahead = torch.stack([1.0 - 2.0 * half[:, 3].square(), 2.0 * half[:, 0] * half[:, 3]], dim=-1)
        under = place.unsqueeze(1) + turned(s.standing, ahead.unsqueeze(1))
        highest = s.terrain_height(under).amax(-1, keepdim=True).nan_to_num(0.0)
        pose = torch.cat([place, z + highest + s.sunk, start["qpos"][:, 3:]], dim=-1)
        return {**start, **rows, "qpos": pose, "origin": origin}

    def next_level(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the next level, the best, and the column, which stays."""
        rows, columns = self.ground.rows, self.ground.columns
        up = self.has_left(s)
        slow = (s.commanded_distance > COUNTS_FROM * self.ground.size) & (
            s.distance < EXPECTED * s.commanded_distance.clamp(max=self.ground.size / 2)
        )
        down = ~up & (s.fell | slow)
        level = torch.where(up, s.level + 1, torch.where(down, (s.level - 1).clamp(min=1), s.level))
        reached = torch.where(down, level, torch.maximum(s.reached, level)).clamp(max=rows)
        anywhere = s.uniform(1.0, rows + 1.0).int().clamp(max=rows)
        first = s.uniform(1.0, min(FIRST_LEVELS, rows) + 1.0).int().clamp(max=min(FIRST_LEVELS, rows))
        level = torch.where(level > rows, anywhere, level)
        level = torch.where(s.level == 0, first, level)
        column = column_of(s.env_index, rows, columns)
        return {"level": level, "reached": torch.where(s.level == 0, level, reached), "column": column}

    def chosen_level(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the level and column that are set, or at first those of the world's own case."""
        rows, kinds = self.ground.rows, len(s.columns_of)
        case, turn = s.env_index % (rows * kinds), torch.div(s.env_index, rows * kinds, rounding_mode="floor")
        row_of_case = rows - 1 - torch.div(case, kinds, rounding_mode="floor")
        of_case = torch.stack([(case % kinds).float(), row_of_case / max(rows - 1, 1)], dim=-1)
        patch = torch.where((s.level == 0).unsqueeze(-1), of_case, s.patch)
        kind = patch[:, 0].round().clamp(0, kinds - 1).int()
        row = (patch[:, 1].clamp(0.0, 1.0) * (rows - 1)).round().int()
        column = s.first_column[kind] + turn % s.columns_of[kind]
        return {"level": row + 1, "reached": row + 1, "column": column, "patch": patch, "began_patch": patch}


def column_of(world: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
    """Returns the columns in which worlds begin, such that with row ``world % rows`` all patches occur as often."""
    return (world + torch.div(world, math.lcm(rows, columns), rounding_mode="floor")) % columns


def turned(vectors: torch.Tensor, ahead: torch.Tensor) -> torch.Tensor:
    """Returns horizontal vectors ``(..., 2)`` turned from the x axis to a direction ``(..., 2)``."""
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([x * ahead[..., 0] - y * ahead[..., 1], x * ahead[..., 1] + y * ahead[..., 0]], dim=-1)


class Go1Rough(Rough, Go1Velocity):
    """A Unitree Go1, a quadruped of 12 kg, follows a velocity command over rough ground."""

    memory = memory(joints=12, feet=4)
    leans = True
    scrapes = (".*_calf_collision.*", "trunk_collision.*|head_collision")
    weights = {**WEIGHTS, "scrapes": -0.1}


class Go2Rough(Rough, Go2Velocity):
    """A Unitree Go2, a quadruped of 15 kg, follows a velocity command over rough ground."""

    memory = memory(joints=12, feet=4)
    leans = True


class G1Rough(Rough, G1Velocity):
    """A Unitree G1, a humanoid of 29 joints and 33 kg, follows a velocity command over rough ground."""

    memory = memory(joints=29, feet=2)
    presets = {"ppo": {**G1Velocity.presets["ppo"], "epochs": 4, "norm_eps": 0.1}}


class H1Rough(Rough, H1Velocity):
    """A Unitree H1, a humanoid of 19 joints and 51 kg, follows a velocity command over rough ground."""

    memory = memory(joints=19, feet=2)
    randomize = [sliding(r".*_foot\d"), com("torso_link")]
