"""What hooks see of all worlds: the view ``s``, by MuJoCo's names and by the names in the model."""

import difflib
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch

from torchrl_loco.checks import Interval, check_float, check_int
from torchrl_loco.envs import actuation, draws, heights, sensors
from torchrl_loco.envs.names import Elements, Names
from torchrl_loco.envs.scan import DepthRequest, RayRequest, Request, ScanRequest
from torchrl_loco.envs.tables import Entry, Table
from torchrl_loco.envs.variation import Variation, constant_of
from torchrl_loco.eyes.placing import bytes_placed
from torchrl_loco.eyes.scene import for_rays
from torchrl_loco.eyes.shapes import MISS
from torchrl_loco.sim import models
from torchrl_loco.sim.corners import corners_of
from torchrl_loco.sim.simulation import check_memory
from torchrl_loco.sim.varied import subtree_masses

DISTANCES = Interval(0, float(MISS), with_low=False)  # that can be seen (m): what is not met is farther
OF_A_STEP = frozenset({"action", "ctrl"})
"""What belongs to a step: an observation is also made after a reset, where there was none."""
CONTACT_HISTORY = ("contact_force_history", "in_contact_history")  # arrays of contacts with a row for each substep
OF_THE_LAST_EPISODE = frozenset(
    ("xpos", "xmat", "cvel", "subtree_com", "sensordata", "contact_force", "in_contact", *CONTACT_HISTORY)
)
"""What ``begin`` must not read: poses and sensors are updated after it."""
COPIES_IN_HOOKS = 2  # how often what eyes see lies in memory: where it is found, and in what a hook makes of it


class Catalog(Elements):
    """What is the same at every step: the model's names, its numbers as tensors, and what hooks have asked for.

    It keeps no reference to the environment.
    """

    def __init__(
        self, env: Any, mj_model: mujoco.MjModel, memory: Mapping[str, Entry], shared: Mapping[str, Entry]
    ) -> None:
        super().__init__(mj_model)
        self.num_envs: int = env.num_envs
        self.device: torch.device = env.device
        self.variation: Variation | None = env.variation  # which numbers of the model differ from world to world
        self.memory, self.shared, self.constants = dict(memory), dict(shared), dict[str, torch.Tensor]()
        self.ctrl_dt, self.bounded = env.config.ctrl_dt, env.action_range != (-math.inf, math.inf)
        self.starts: dict[str, torch.Tensor] = {}  # what entries of shared begin with, where it is not zero
        self.warp_outputs: int | None = None  # size of the observation of the class's Warp function, if it has one
        self.draws_states = False  # whether a Warp function or a table of the class begins its episodes
        self.arrays: set[str] = set()  # those that hooks have read
        self.sensors: set[int] = set()  # ids of those that only an engine can evaluate
        self.contact_geoms: list[int] = []  # ids of those whose contacts were asked for: the engine's columns
        self.scans: dict[str, Request] = {}  # the scans, depths and rays that were asked for, by their array
        self.bytes_scanned = 0  # memory that they take in a world
        self.scanning: dict[str, set[str]] = {}  # by hook, the names of those that it reads
        self.complete = False  # whether all that hooks ask for is known: what else they ask for later is refused
        self.sensor_address = {i: int(mj_model.sensor_adr[i]) for i in range(mj_model.nsensor)}  # in sensordata
        self.corners = corners_of(mj_model)
        self.home = self._tensor(models.home_pose(mj_model))  # (nq,)
        self._index: dict[tuple[int, ...], torch.Tensor] = {}
        self.of_model: dict[Any, torch.Tensor] = {}  # numbers of the model that were asked for
        self._tables: dict[Any, torch.Tensor] = {}
        self._places: dict[tuple[int, int], torch.Tensor] = {}

    @functools.cached_property
    def ground(self) -> heights.Ground:
        """What a ray from above can meet."""
        return heights.Ground.of(self.mj_model)

    def zeros(self) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Returns the entries of memory ``(num_envs, *shape)``, and of what worlds share, all of them zero."""
        kept: dict[str, Any] = {"device": self.device}
        memory = {
            name: torch.zeros(self.num_envs, *shape, dtype=kind, **kept) for name, (shape, kind) in self.memory.items()
        }
        return memory, {name: torch.zeros(shape, dtype=kind, **kept) for name, (shape, kind) in self.shared.items()}

    def pick(self, values: torch.Tensor, ids: list[int], one: bool) -> torch.Tensor:
        """Returns the columns ``ids`` of an array ``(num_envs, count, ...)``, without their dimension for one."""
        if one:
            return values[:, ids[0]]
        key = tuple(ids)
        if key not in self._index:
            self._index[key] = torch.tensor(ids, device=self.device)
        return values.index_select(1, self._index[key])

    def field(self, name: str, numbers: Callable[[], torch.Tensor]) -> torch.Tensor:
        """Returns a field in all worlds, ``(num_envs, *shape)``; one that varies, by their ``numbers()``."""
        if self.variation is not None and name in self.variation.varied.places:
            return self.variation.field(name, numbers())
        if name == "body_subtreemass" and self.variation is not None and "body_mass" in self.variation.varied.places:
            masses, m = self.variation.field("body_mass", numbers()), self.mj_model
            of_each = self.derived("subtrees", lambda: subtree_masses(m, np.eye(m.nbody)).T)  # of each body's mass
            return (masses.unsqueeze(-1) * of_each).sum(1)
        values = self.derived(name, lambda: constant_of(self.mj_model, name))
        return values.expand(self.num_envs, *values.shape)

    def fixed(self) -> list[torch.Tensor]:
        """Returns tensors that never change: of indices, and the task's tables."""
        variation = self.variation.fixed() if self.variation else []
        return [*self._index.values(), *self.constants.values(), *self._tables.values(), *variation]

    def places(self, first: int, count: int) -> torch.Tensor:
        """Returns places of random streams, which torch.compile would compute wrongly: they wrap around 64 bits."""
        if (first, count) not in self._places:
            self._places[first, count] = draws.places(first, count, self.device)
        return self._places[first, count]

    def table(self, key: Any, make: Any) -> torch.Tensor:
        """Returns what :meth:`derived` does, of a table in which hooks look things up."""
        if key not in self._tables:
            self._tables[key] = self._tensor(make())
        return self._tables[key]

    def derived(self, key: Any, make: Any) -> torch.Tensor:
        """Returns a tensor made by ``make()`` from the model when it is first asked for."""
        if key not in self.of_model:
            self.of_model[key] = self._tensor(make())
        return self.of_model[key]

    def _tensor(self, values: Any) -> torch.Tensor:
        return torch.tensor(np.array(values), dtype=torch.float32, device=self.device)


Arrays = Mapping[str, torch.Tensor]
"""The arrays of all worlds by name: physics, ``memory.<name>``, ``out.<group>``, counters and flags."""


class View:
    """All worlds, as a hook sees them. The first dimension of every tensor is the world; hooks must not write to it.

    Names are those of the model; several names, or a regular expression, add a dimension behind the world's.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays, hook: str, steps: int = 0) -> None:
        self._catalog, self._arrays, self._hook = catalog, arrays, hook  # random numbers depend on the hook's name
        self._steps = steps  # that the worlds have taken beyond those that are counted
        self._stream: torch.Tensor | None = None
        self._drawn = 0
        # In which worlds an index of a table was out of range, by whether that gave NaN.
        self._lost: dict[bool, torch.Tensor] = {}

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuses to set what a hook sees."""
        if not name.startswith("_"):
            raise AttributeError(
                f"s.{name} cannot be set: return {{{name!r}: ...}} from update, events, adapt or begin"
            )
        super().__setattr__(name, value)

    # The state.

    def _array(self, name: str) -> torch.Tensor:
        if name in OF_A_STEP and self._hook in ("observation", "begin"):
            raise ValueError(  # an AttributeError of a property would go on to __getattr__
                f"s.{name} belongs to a step, and {self._hook}() is also called after a reset: "
                f"keep what you need of it in memory, by returning it from events()"
            )
        if name == "ctrl" and self._hook == "control":  # the last ones would outlive their episode
            raise ValueError(
                "s.ctrl is what control() returns: keep the last controls in memory, by returning them from update()"
            )
        if name in OF_THE_LAST_EPISODE:
            self._refuse_in_begin(name)
        self._catalog.arrays.add(name)
        if name not in self._arrays:
            raise ValueError(f"{name} was not asked for when the hooks were first called, so it is not computed")
        return self._arrays[name]

    def _refuse_in_begin(self, what: str) -> None:
        if self._hook == "begin":
            raise ValueError(
                f"begin() is called before poses and sensors are updated, so {what} would be of the last episode: "
                "begin from s.home, and keep what you need of an episode in memory, by returning it from events()"
            )

    @property
    def qpos(self) -> torch.Tensor:
        """Positions (m, rad, unit quaternions), ``(num_envs, nq)``."""
        return self._array("qpos")

    @property
    def qvel(self) -> torch.Tensor:
        """Velocities (m/s, rad/s), ``(num_envs, nv)``."""
        return self._array("qvel")

    @property
    def ctrl(self) -> torch.Tensor:
        """Controls of the step, ``(num_envs, nu)``; not in ``control``, ``observation`` and ``begin``."""
        return self._array("ctrl")

    @property
    def actuator_force(self) -> torch.Tensor:
        """Forces of motors and servos (N, N m) by the step's controls, in the state after it, ``(num_envs, nu)``."""
        return actuation.force(self)

    @property
    def action(self) -> torch.Tensor:
        """Actions as they were used, ``(num_envs, nu)``: clipped to ``action_range``, zero where one is not finite.

        Not in ``observation`` and ``begin``: return it from ``events`` into ``memory`` to observe it.
        """
        return usable(self._array("action"), self._catalog.bounded)

    @property
    def time(self) -> torch.Tensor:
        """Time of the episode's limit that is gone (s), ``(num_envs,)``: control steps times :attr:`dt`.

        That is the time since its start, but in first episodes that are staggered, as those of a training.
        """
        return (self._arrays["elapsed_steps"] + self._steps).float() * self._catalog.ctrl_dt

    @property
    def step(self) -> torch.Tensor:
        """Control steps of the episode's limit that are gone, ``(num_envs,)``, int64; exact, as :attr:`time` is not."""
        return (self._arrays["elapsed_steps"] + self._steps).long()

    @property
    def dt(self) -> float:
        """Time of a control step (s)."""
        return self._catalog.ctrl_dt

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return self._catalog.num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self._catalog.device

    @property
    def home(self) -> torch.Tensor:
        """Home pose, ``(num_envs, nq)``: the model's keyframe ``home`` if there is one, else its ``qpos0``."""
        return self._catalog.home.expand(self._catalog.num_envs, -1)

    def model(self, field: str) -> torch.Tensor:
        """Returns a field of the model, such as ``"geom_friction"``: ``(num_envs, *shape)``, float32.

        What ``randomize`` varies is each world's own; ``"gravity"`` is that of the model's options.

        Raises:
            AttributeError: ``MjModel`` has no such field, or it is no array of numbers.
        """
        return self._catalog.field(field, lambda: self._array("numbers"))

    @property
    def env_index(self) -> torch.Tensor:
        """Number of each env, int64 ``(num_envs,)``: from ``world_offset`` on, else from 0."""
        return self._arrays["world"]

    @property
    def terminated(self) -> torch.Tensor:
        """Whether ``terminated()`` ends the episode in this step, bool ``(num_envs,)``.

        Raises:
            ValueError: the hook comes before it.
        """
        if self._hook not in ("events", "adapt", "metrics"):
            raise ValueError(f"s.terminated is not known in {self._hook}(): read it in events, adapt or metrics")
        return self._arrays["ended"]

    def __getattr__(self, name: str) -> torch.Tensor:
        """Returns an entry of the memory, ``(num_envs, *row)``, one of ``shared``, or a table of ``constants``.

        Raises:
            AttributeError: there is no such entry.
        """
        if name.startswith("_"):
            raise AttributeError(name)
        catalog = self._catalog
        if name in catalog.memory:
            return self._arrays[f"memory.{name}"]
        if name in catalog.shared:
            return Table.of(self._arrays[f"shared.{name}"], self._note)
        if name in catalog.constants:
            return Table.of(catalog.constants[name], self._note)
        entries = [*catalog.memory, *catalog.shared, *catalog.constants]
        near = difflib.get_close_matches(name, [*PUBLIC, *entries], n=1)
        hint = f", did you mean s.{near[0]}?" if near else ""
        known = ", ".join(entries) or "no entries"
        raise AttributeError(f"s has no {name!r}{hint}: memory, shared and constants have {known}")

    def _note(self, lost: torch.Tensor, gave_nan: bool) -> None:
        if lost.shape[0] not in (1, self.num_envs):  # of an index that is the same in all worlds
            lost = lost.any().reshape(1)
        self._lost[gave_nan] = self._lost[gave_nan] | lost if gave_nan in self._lost else lost

    def _by_warp(self, name: str) -> torch.Tensor:
        """Returns what the Warp function of the class has made in this step, its ``observation`` or ``reward``."""
        if self._catalog.warp_outputs is None:
            raise NotImplementedError(f"no class above this one has {name}(self, s)")
        self._catalog.arrays.add("warp")
        return self._arrays[f"warp.{name}"]

    def _begun_by_warp(self) -> dict[str, torch.Tensor]:
        """Returns the pose and velocities that the class's Warp function or table has drawn, if it has any."""
        if not self._catalog.draws_states:
            return {}
        self._catalog.arrays.add("warp.begin")
        return {"qpos": self.qpos, "qvel": self.qvel}

    # Poses and velocities.

    def xpos(self, bodies: Names) -> torch.Tensor:
        """Returns positions of bodies (m), ``(num_envs, 3)``, or ``(num_envs, count, 3)`` for several."""
        return self._frames("body", bodies).position

    def xmat(self, bodies: Names) -> torch.Tensor:
        """Returns orientations of bodies, ``(num_envs, 3, 3)``, or ``(num_envs, count, 3, 3)`` for several."""
        return self._frames("body", bodies).axes

    def linvel(self, bodies: Names) -> torch.Tensor:
        """Returns velocities of the origins of bodies in the world's frame (m/s), shaped as :meth:`xpos`."""
        return self._frames("body", bodies).velocity

    def angvel(self, bodies: Names) -> torch.Tensor:
        """Returns angular velocities of bodies in the world's frame (rad/s), shaped as :meth:`xpos`."""
        return self._frames("body", bodies).rotation

    def site_xpos(self, sites: Names) -> torch.Tensor:
        """Returns positions of sites (m), shaped as :meth:`xpos`."""
        return self._frames("site", sites).position

    def site_xmat(self, sites: Names) -> torch.Tensor:
        """Returns orientations of sites, shaped as :meth:`xmat`."""
        return self._frames("site", sites).axes

    def site_linvel(self, sites: Names) -> torch.Tensor:
        """Returns velocities of sites in the world's frame (m/s), shaped as :meth:`xpos`."""
        return self._frames("site", sites).velocity

    def geom_xpos(self, geoms: Names) -> torch.Tensor:
        """Returns positions of the centers of geoms (m), shaped as :meth:`xpos`."""
        return self._frames("geom", geoms).position

    def _frames(self, kind: str, names: Names) -> sensors.Frames:
        return sensors.Frames(self, kind, *self._catalog.ids(kind, names))

    # The ground, and what is seen.

    def terrain_height(self, points: torch.Tensor) -> torch.Tensor:
        """Returns the height of the ground below points, as a ray from above finds it, ``(num_envs, ...)`` (m).

        The ground is what is fixed to the world and may be touched: height fields, boxes and level planes.

        Args:
            points: x and y in the world's frame (m), and anything behind them, ``(num_envs, ..., 2 or more)``.

        Returns:
            The heights, NaN where there is no ground.

        Raises:
            ValueError: the model has no ground, or a part of it is turned.
        """
        return heights.below(self._catalog, points[..., 0], points[..., 1])

    def height_scan(self, body: str, grid: Any, miss: float = math.nan) -> torch.Tensor:
        """Returns how far the ground lies below the height of a body, at points that turn with its yaw.

        Yaw is that of the body's x axis laid flat; of its y axis where the x axis stands within 0.1 of upright.

        Args:
            body: name of the body.
            grid: where the points are, ahead of the body and to its left (m), ``(points, 2)``.
            miss: what it is where there is no ground.

        Returns:
            Height of the body's origin less that of the ground (m), ``(num_envs, points)``.

        Raises:
            ValueError: as :meth:`terrain_height`; or the grid has another shape.
        """
        where = np.asarray(grid, dtype=float)
        if where.ndim != 2 or where.shape[1] != 2:
            raise ValueError(f"grid must be points ahead and to the left, (points, 2), got {where.shape}")
        if not np.isfinite(where).all():
            raise ValueError("grid must be finite numbers (m)")
        scan = self._scanned(ScanRequest(self._id("body", body), tuple(map(tuple, where.tolist()))), (len(where),))
        return scan if math.isnan(miss) else torch.where(scan.isnan(), miss, scan)

    def depth(self, camera: str, width: int, height: int, far: float = 10.0) -> torch.Tensor:
        """Returns how far along a camera's axis lies what it sees, shapes of all kinds and meshes among it.

        Args:
            camera: name of a camera of the model. It sees through a shape that it is in.
            width: pixels in a row.
            height: rows.
            far: greatest depth (m), also where there is nothing.

        Returns:
            Depths (m), ``(num_envs, height, width)``, the upper left pixel first.

        Raises:
            KeyError: the model has no such camera.
            ValueError: several cameras match, a number is not positive, ``far`` is not less than 1e10, or ``fovy``
                alone does not tell the camera's perspective.
            MemoryError: the device has no room for them.
        """
        which = self._id("camera", camera)
        size = check_int("height", height), check_int("width", width)
        return self._scanned(DepthRequest(which, size[1], size[0], check_float("far", far, DISTANCES)), size)

    def ray(self, site: str, directions: Any, far: float = 10.0) -> torch.Tensor:
        """Returns how far from a site lies what rays meet: shapes of all kinds, meshes among them, and of all groups.

        Args:
            site: name of a site. Rays leave a shape that it is in unhindered.
            directions: of the rays, in the site's frame, ``(rays, 3)``; their length does not matter.
            far: greatest distance (m), also where there is nothing.

        Returns:
            Distances (m), ``(num_envs, rays)``.

        Raises:
            KeyError: the model has no such site.
            ValueError: several sites match, ``far`` is not positive and less than 1e10, or the directions have another
                shape, or one is no direction.
            MemoryError: the device has no room for them.
        """
        which = self._id("site", site)
        rows = np.array(directions, dtype=float)
        if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all() or not rows.any(1).all():
            raise ValueError(f"directions must be rows of 3 finite numbers that are not all 0, (rays, 3), got {rows!r}")
        rows /= np.abs(rows).max(axis=1, keepdims=True)  # first, as squares of small ones are 0
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        asked = RayRequest(which, tuple(map(tuple, rows.tolist())), check_float("far", far, DISTANCES))
        return self._scanned(asked, (len(rows),))

    def _id(self, kind: str, name: str) -> int:
        """Returns the id of the one element that a name or a regular expression matches."""
        if not isinstance(name, str):
            raise TypeError(f"name one {kind}, got {name!r}")
        ids, _ = self._catalog.ids(kind, name)
        if len(ids) > 1:
            raise ValueError(f"name one {kind}: {name!r} matches {len(ids)}")
        return ids[0]

    def _scanned(self, asked: Request, shape: tuple[int, ...]) -> torch.Tensor:
        """Returns the array of a scan, depths or rays, of a shape in each world: at first, numbers like them."""
        self._refuse_in_begin("what is seen of the ground")
        scans = self._catalog.scans
        name = next((name for name, other in scans.items() if other == asked), f"scan.{len(scans)}")
        if not self._catalog.complete:
            if name not in scans:
                scans[name], catalog = asked, self._catalog
                seen = for_rays(catalog.mj_model) if isinstance(asked, RayRequest) else catalog.mj_model
                of_eyes = 0 if isinstance(asked, ScanRequest) else bytes_placed(seen)
                catalog.bytes_scanned += 4 * COPIES_IN_HOOKS * math.prod(shape) + of_eyes
                check_memory(catalog.num_envs * catalog.bytes_scanned, catalog.num_envs, catalog.device)
            self._catalog.scanning.setdefault(self._hook, set()).add(name)
            if isinstance(asked, ScanRequest):
                _ = self._catalog.ground  # which may refuse
            return self.qpos[:, :1].view(-1, *[1] * len(shape)).expand(-1, *shape).clone()
        if name not in self._catalog.scanning.get(self._hook, ()):
            raise ValueError(f"{self._hook}() did not ask for this scan when it was first called: it is not computed")
        return self._array(name)

    # Joints.

    def joint_qpos(self, joints: Names) -> torch.Tensor:
        """Returns positions of joints: ``(num_envs, count)`` for several hinges and slides (rad, m).

        One joint that is named has ``(num_envs,)``; a free or ball joint, which must be named, 7 or 4 numbers.
        """
        return self._of_joints("qpos", joints)

    def joint_qvel(self, joints: Names) -> torch.Tensor:
        """Returns velocities of joints (rad/s, m/s), shaped as :meth:`joint_qpos`; 6 or 3 for a free or ball joint."""
        return self._of_joints("qvel", joints)

    def _of_joints(self, array: str, joints: Names) -> torch.Tensor:
        m, (ids, one) = self._catalog.mj_model, self._catalog.ids("joint", joints)
        address = m.jnt_qposadr if array == "qpos" else m.jnt_dofadr
        sizes = {0: (7, 6), 1: (4, 3)}
        size = [sizes.get(int(m.jnt_type[j]), (1, 1))[array == "qvel"] for j in ids]
        if one and size[0] > 1:
            first = int(address[ids[0]])
            return self._array(array)[:, first : first + size[0]]
        if max(size) > 1:
            wide = [self._catalog.names("joint")[j] for j, n in zip(ids, size, strict=True) if n > 1]
            raise ValueError(f"name a free or ball joint alone: {', '.join(wide)} is among several joints")
        return self._catalog.pick(self._array(array), [int(address[j]) for j in ids], one)

    # Frames.

    def to_body(self, body: str, vectors: torch.Tensor) -> torch.Tensor:
        """Returns vectors of the world's frame, ``(num_envs, ..., 3)``, in the frame of a body."""
        return sensors.into_frame(self.xmat(body), vectors)

    def projected_gravity(self, body: str) -> torch.Tensor:
        """Returns the direction of gravity in the frame of a body, ``(num_envs, 3)``: (0, 0, -1) if it is upright.

        Where the model has no gravity, it is that of -z.
        """
        catalog = self._catalog
        x, y, z = catalog.mj_model.opt.gravity
        varies = catalog.variation is not None and "gravity" in catalog.variation.varied.places
        if not varies and x == y == 0.0 and z <= 0.0:
            return -self.xmat(body)[:, 2]
        return self.to_body(body, torch.nn.functional.normalize(self.model("gravity"), dim=-1))

    # Sensors and contacts.

    def sensor(self, name: str) -> torch.Tensor:
        """Returns a sensor of the model, ``(num_envs, size)``, in MuJoCo's units.

        Those of poses and velocities (gyro, velocimeter, frame*, joint*) are computed here; touch, accelerometer, force
        and torque at a site, and velocity and angular momentum of a subtree, by the engine. Any other is refused where
        the task is made.
        """
        sensor = self._id("sensor", name)
        derived = sensors.evaluate(self, sensor)
        if derived is not None:
            return derived
        self._catalog.sensors.add(sensor)
        first = self._catalog.sensor_address[sensor]
        return self._array("sensordata")[:, first : first + int(self._catalog.mj_model.sensor_dim[sensor])]

    def contact_force(self, geoms: Names, *, history: bool = False) -> torch.Tensor:
        """Returns the net force of all contacts on each geom, world frame (N), of the last physics step.

        Shape ``(num_envs, 3)``, or ``(num_envs, count, 3)`` for several. A solid has those of the spheres that
        touch the ground in its place (``solids_on_terrain="spheres"``), which have names too,
        ``<solid>_corner_0`` ... With ``history`` that of each physics step of the control step, in their order:
        ``(num_envs, substeps, 3)`` or ``(num_envs, substeps, count, 3)``. After a reset, all are those of the
        present state.
        """
        return self._of_contacts("contact_force", geoms, history)

    def in_contact(self, geoms: Names, *, history: bool = False) -> torch.Tensor:
        """Returns whether each geom had a contact in the last physics step, bool ``(num_envs,)`` or with ``count``.

        With ``history`` as :meth:`contact_force`, ``(num_envs, substeps)`` or ``(num_envs, substeps, count)``.
        """
        return self._of_contacts("in_contact", geoms, history) > 0

    def _of_contacts(self, name: str, geoms: Names, history: bool) -> torch.Tensor:
        named, one = self._catalog.ids("geom", geoms)
        parts = [[geom, *self._catalog.corners.get(geom, ())] for geom in named]
        ids, columns = [geom for each in parts for geom in each], self._catalog.contact_geoms
        new = [geom for geom in dict.fromkeys(ids) if geom not in columns]
        if new and self._catalog.complete:
            names = ", ".join(self._catalog.names("geom")[geom] for geom in new)
            raise ValueError(f"contacts of {names} were not asked for when the hooks were first called")
        columns += new
        values = self._array(f"{name}_history").transpose(1, 2) if history else self._array(name)
        if not self._catalog.complete:
            values = values[:, :1].expand(-1, len(columns), *values.shape[2:])
        found = self._catalog.pick(values, [columns.index(geom) for geom in ids], one and len(ids) == 1)
        if len(ids) > len(named):
            sums = [part.sum(1) for part in found.split(list(map(len, parts)), dim=1)]
            found = sums[0] if one else torch.stack(sums, dim=1)
        return found.transpose(1, 2) if history and not one else found

    # Random numbers.

    def uniform(self, low: float | torch.Tensor, high: float | torch.Tensor, *shape: int) -> torch.Tensor:
        """Returns draws from [low, high), ``(num_envs, *shape)``, a function of (seed, world, episode, step).

        The same numbers come for any number of worlds and at every run; on another device up to rounding.

        Raises:
            ValueError: ``low`` is above ``high``, if both are numbers.
        """
        if isinstance(low, int | float) and isinstance(high, int | float) and low > high:
            raise ValueError(f"uniform draws from {low} to {high}: the first must be the lower")
        return low + (high - low) * self._units_in(shape, 1)[0]

    def normal(self, *shape: int) -> torch.Tensor:
        """Returns draws from the standard normal distribution, ``(num_envs, *shape)``; see :meth:`uniform`.

        Raises:
            TypeError: the sizes are not whole numbers, as the mean and the deviation that torch takes.
        """
        return draws.to_normal(*self._units_in(shape, 2))

    def _units_in(self, shape: Sequence[Any], count: int) -> list[torch.Tensor]:
        """Returns ``count`` draws from [0, 1) in a shape of each world: sizes, or one tuple of them."""
        if len(shape) == 1 and isinstance(shape[0], tuple | list):
            (shape,) = shape
        if any(isinstance(size, float | torch.Tensor) for size in shape) or (len(shape) > 1 and shape[0] == 0):
            scaled = "; of another normal distribution is mean + deviation * s.normal(3)" if count == 2 else ""
            raise TypeError(
                f"a draw takes its sizes beyond that of the worlds, such as 3, got {', '.join(map(str, shape))}{scaled}"
            )
        size = int(math.prod(shape))
        if size == 0:
            return [self.env_index.new_empty(self.num_envs, *shape, dtype=torch.float32)] * count
        return [rows.view(self.num_envs, *shape) for rows in self._units(count * size).split(size, dim=1)]

    def _units(self, count: int) -> torch.Tensor:
        """Returns draws from [0, 1), ``(num_envs, count)``."""
        if self._stream is None:
            a = self._arrays
            self._stream = draws.stream(
                a["seed"], a["world"], a["episode"], a["elapsed_steps"] + self._steps, self._hook
            )
        first, self._drawn = self._drawn, self._drawn + count
        return draws.to_unit(draws.mix(self._stream + self._catalog.places(first, count)))


PUBLIC = [name for name in vars(View) if not name.startswith("_")]
"""Names that ``s`` has in all tasks."""


def usable(action: torch.Tensor, bounded: bool) -> torch.Tensor:
    """Returns actions ``(num_envs, nu)`` as a step uses them: zero in worlds where one is not finite, else clipped."""
    finite = action.isfinite().all(dim=-1, keepdim=True)
    action = torch.where(finite, action, 0.0)
    return action.clamp(-1.0, 1.0) if bounded else action
