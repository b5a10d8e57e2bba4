"""The engine that steps all worlds with the compiled step."""

import collections
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from typing_extensions import override

from torchrl_loco.sim import mjw
from torchrl_loco.sim.compiled import step
from torchrl_loco.sim.compiled.collision.ground import BOX_NUMBERS, Ground
from torchrl_loco.sim.compiled.collision.kinds import FIELD
from torchrl_loco.sim.compiled.collision.pairs import looked_up, stand_ins
from torchrl_loco.sim.compiled.ir.parameters import VariedModel
from torchrl_loco.sim.compiled.read_only import ReadOnly, read_only
from torchrl_loco.sim.compiled.schedules.shared import Asked
from torchrl_loco.sim.engine import Engine, Setup
from torchrl_loco.sim.world_func import ALONE, Around, Chain, WorldFunc, fill

ROWS = {
    "qpos": ("nq", wp.float32),
    "qvel": ("nv", wp.float32),
    "act": ("na", wp.float32),
    "qacc_warmstart": ("nv", wp.float32),
    "ctrl": ("nu", wp.float32),
    "time": (None, wp.float32),
    "xpos": ("nbody", wp.vec3),
    "xmat": ("nbody", wp.mat33),
    "cvel": ("nbody", wp.spatial_vector),
    "subtree_com": ("nbody", wp.vec3),
    "contact_force": ("contacts", wp.vec3),
    "in_contact": ("contacts", wp.bool),
    "sensordata": ("nsensordata", wp.float32),
    "overflow": (None, wp.int32),
}
"""Type of each array of :class:`Data`, and the size in the model that is the length of its rows."""

LATER = ("cvel", "subtree_com")  # arrays that are made, and computed, if they are asked for before the first step

WORLD_ARRAYS = {
    **{"terrain_in": wp.array(dtype=float), "ctrl_in": wp.array2d(dtype=float), "numbers_out": wp.array2d(dtype=float)},
    **{
        f"{name}_out": wp.array(dtype=dtype, ndim=1 if size is None else 2)
        for name, (size, dtype) in ROWS.items()
        if name != "ctrl"
    },
}
"""What the C++ of a step reads and writes, by the names that it has there."""
Arrays: Any = wp.struct(type("Arrays", (), {"__annotations__": WORLD_ARRAYS}))


class Data:
    """The state of all worlds, and what an observation reads.

    Names and units are those of the views of :class:`torchrl_loco.sim.Simulation`, with a row for each world: vec3 for
    points and forces, mat33 for ``xmat``, spatial_vector for ``cvel``. ``cvel`` and ``subtree_com`` are computed if
    they were asked for before the first step, as an environment's ``observation_func`` does; rows of ``subtree_com``
    but those of roots are zero. ``contact_force`` and ``in_contact`` are ``(nworld, contact_rows * geoms)``, of the
    geoms that were asked for, substep by substep.
    """

    def __init__(self, setup: Setup) -> None:
        m, by_world = setup.mj_model, step.structure_of_arrays(setup.mj_model, setup.device)

        def make(name: str) -> wp.array:
            return _zeros(_shape(setup, name), ROWS[name][1], setup.device, structure_of_arrays=by_world)

        self._make: Callable[[str], wp.array] | None = make
        for name in ROWS:
            if name not in LATER:
                setattr(self, name, make(name))
        start = mujoco.MjData(m)
        mujoco.mj_kinematics(m, start)
        mujoco.mj_comPos(m, start)
        roots = np.arange(m.nbody) == m.body_rootid
        roots[0] = False
        self._start_com = np.where(roots[:, None], start.subtree_com, 0.0)
        _fill_rows(self.xpos, start.xpos)  # the step leaves out what is constant
        _fill_rows(self.xmat, start.xmat)

    def __getattr__(self, name: str) -> Any:
        """Returns one of ``LATER``, which is made, and computed from then on, unless it is too late."""
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in LATER:
            raise AttributeError(
                f"the compiled engine has no data.{name}, only {', '.join(ROWS)}: pass engine='mujoco_warp', or set it "
                "in the defaults of the body"
            )
        if self._make is None:
            raise RuntimeError(f"{name} is not computed: ask for data.{name} before the first step")
        array = self._make(name)
        if name == "subtree_com":
            _fill_rows(array, self._start_com)
        setattr(self, name, array)
        return array

    def outputs(self) -> dict[str, wp.array | None]:
        """Returns what the kernels write, by name; ``None`` for those of ``LATER`` that nothing has asked for."""
        self._make = None
        return {name: self.__dict__.get(name) for name in ROWS if name != "ctrl"}


def _zeros(shape: tuple[int, ...], dtype: Any, device: wp.Device, *, structure_of_arrays: bool) -> wp.array:
    if structure_of_arrays:
        return wp.zeros(shape[::-1], dtype=dtype, device=device).transpose()
    return wp.zeros(shape, dtype=dtype, device=device)


def _fill_rows(array: wp.array, row: np.ndarray) -> None:
    """Writes the same row into all worlds."""
    shape = array.numpy().shape
    array.assign(np.broadcast_to(row.reshape(shape[1:]), shape))


def _shape(setup: Setup, name: str) -> tuple[int, ...]:
    match ROWS[name][0]:
        case None:
            return (setup.num_envs,)
        case "contacts":
            return setup.num_envs, len(setup.contact_geoms) * setup.contact_rows
        case size:
            return setup.num_envs, getattr(setup.mj_model, size)


class Model(ReadOnly):
    """The model on the device: what ``mujoco_warp.Model`` has, under the same names, to be read only.

    Only what environments read when they are made is copied here. Anything else makes the model of MuJoCo-Warp, which
    imports it and takes a second or two.
    """

    def __init__(self, m: mujoco.MjModel, device: wp.Device) -> None:
        kinds = {"qpos0": wp.float32, "jnt_range": wp.vec2, "actuator_ctrlrange": wp.vec2}
        arrays = {name: wp.array(getattr(m, name)[None], dtype=kind, device=device) for name, kind in kinds.items()}
        self.__dict__.update({name: read_only(array) for name, array in arrays.items()}, _mj_model=m, _device=device)

    @functools.cached_property
    def _source(self) -> "mjw.Model":
        with wp.ScopedDevice(self._device):
            return mjw.put_model(self._mj_model)


class CompiledEngine(Engine):
    """Steps all worlds with one kernel, made for the model.

    There is no table of constraints, and nothing of one world depends on another: a trajectory is a function of its own
    state and actions, bit for bit, for any number of worlds.

    Raises:
        ValueError: there are more worlds than Warp can address.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        mj_model, num_envs, device = setup.mj_model, setup.num_envs, setup.device
        self._mj_model = mj_model if setup.varied is None else VariedModel(mj_model, setup.varied)
        self._contact_geoms, self._contact_rows = setup.contact_geoms, setup.contact_rows
        step.check_worlds(mj_model, num_envs, device)
        _check_forces(mj_model, self._contact_geoms)
        self.model = Model(mj_model, device)
        self._launch_size = step.launch_size(self._mj_model, num_envs, device)
        by_world = step.structure_of_arrays(mj_model, device)
        self.data = Data(setup)
        self.contact_arrays = self.data.contact_force, self.data.in_contact
        self._rows = self.numbers = wp.zeros((num_envs, 0), dtype=float, device=device)
        if isinstance(self._mj_model, VariedModel):
            row = step.nominal_row(self._mj_model)
            self._rows = _zeros((num_envs, row.size), wp.float32, device, structure_of_arrays=by_world)
            _fill_rows(self._rows, row)
            self.numbers = self._rows[:, : self._mj_model.varied.count]
        self._terrain = wp.array(Ground.of(mj_model).numbers(), dtype=wp.float32, device=device)
        self.coalesced = by_world and not self._launch_size.one_kernel
        self._steps: dict[tuple, tuple[wp.Kernel, Chain, Chain]] = {}

    @override
    @staticmethod
    def memory(setup: Setup) -> int:
        rows = sum(
            math.prod(_shape(setup, name)) * wp.types.type_size_in_bytes(dtype)
            for name, (_, dtype) in ROWS.items()
            if name not in LATER
        )
        if setup.varied is None:
            return rows
        return rows + 4 * setup.num_envs * step.nominal_row(VariedModel(setup.mj_model, setup.varied)).size

    @override
    def remedy(self, dropped: str, most: int) -> str:
        other = "mujoco" if FIELD in self._mj_model.geom_type else "mujoco_warp"  # which has fewer contacts with fields
        return f"a world of the compiled engine has no more places for {dropped}: pass engine={other!r}"

    @override
    def step(self, around: Around = ALONE) -> None:
        if self._launch_size.one_kernel:
            self._launch(self._substeps, self._all, *around, self._contact_geoms)
            return
        self._kernels.launch(around.before, self._all)
        self._launch(self._substeps, self._all, (), (), self._contact_geoms)
        self._kernels.launch(around.after, self._all)

    @override
    def forward(self, mask: wp.array, around: Around, *, contacts: bool = True) -> None:
        self._launch(0, mask, *around, self._contact_geoms if contacts else ())

    def _launch(
        self,
        substeps: int,
        mask: wp.array,
        before: Sequence[WorldFunc],
        after: Sequence[WorldFunc],
        contact_geoms: tuple[int, ...],
    ) -> None:
        outputs = self.data.outputs()
        key = substeps, contact_geoms, *(func for func, _ in before), None, *(func for func, _ in after)
        if key not in self._steps:
            with_cvel, with_com = (outputs[name] is not None for name in LATER)
            asked = Asked(with_cvel, with_com, contact_geoms, self._contact_rows)
            text = step.kept_source(self._mj_model, substeps, asked)
            start, end = Chain(before), Chain(after)
            self._steps[key] = _kernel(text, start, end, self._launch_size.registers), start, end
        kernel, start, end = self._steps[key]
        size = self._launch_size
        arrays = arrays_of(self.data, self._terrain, self._rows)
        inputs = [size.worlds_per_warp, size.lanes, mask, start.args(before), end.args(after), arrays]
        wp.launch(kernel, size.threads, inputs, device=self._device, block_dim=size.block)


def arrays_of(data: Data, terrain: wp.array, numbers: wp.array) -> Any:
    """Returns what a step reads and writes, as its kernel takes it."""
    outputs = {f"{name}_out": array for name, array in data.outputs().items()}
    return fill(Arrays, terrain_in=terrain, ctrl_in=data.ctrl, numbers_out=numbers, **outputs)


def ground_bytes(m: mujoco.MjModel) -> int:
    """Returns about how much memory the ground takes that is looked up, which lies once on the device (bytes)."""
    return 4 * (m.nhfielddata + BOX_NUMBERS * int(looked_up(m).sum()))


def _check_forces(m: mujoco.MjModel, contact_geoms: Sequence[int]) -> None:
    """Checks that forces are asked of no geom of the ground that shares its pairs with others."""
    like = stand_ins(m)
    shared = collections.Counter(like.values())
    for geom in contact_geoms:
        if geom in like and shared[like[geom]] > 1:
            raise ValueError(
                f"geom {m.geom(geom).name or geom!r} is one of {shared[like[geom]]} of the ground that are alike: ask "
                "for the contact forces of what touches them, or pass engine='mujoco_warp'"
            )


def _kernel(text: str, start: Chain, end: Chain, registers: int | None = None) -> wp.Kernel:
    """Returns a kernel that calls functions, the C++ of a control step and further functions in each world."""
    before, after = start.func, end.func
    Before: Any = start.struct  # noqa: N806
    After: Any = end.struct  # noqa: N806
    named = "".join(f"const auto& {name} = arrays.{name};\n" for name in WORLD_ARRAYS)

    @wp.func_native(named + text)
    def advance(world: int, lane: int, live: bool, arrays: Arrays): ...

    @wp.kernel(enable_backward=False, module="unique", cuda_max_registers=registers)
    def compiled_step(
        worlds_per_warp: int,
        lanes: int,
        mask_in: wp.array[bool],
        before_args: Before,
        after_args: After,
        arrays: Arrays,
    ):
        place = wp.tid() % step.WARP // lanes  # of the world in its warp
        lane = wp.tid() % lanes  # of the thread in its world
        world = wp.tid() // step.WARP * worlds_per_warp + place
        live = place < worlds_per_warp and world < mask_in.shape[0]
        if live:
            live = mask_in[world]
        if live and lane == 0:
            before(world, before_args)
        advance(world, lane, live, arrays)  # lanes of a block may wait for those that are not live
        if live and lane == 0:
            after(world, after_args)

    return compiled_step
