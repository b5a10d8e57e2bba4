"""Lists what a model needs that the compiled step does not support. Everything else is supported."""

from collections import defaultdict

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import FIELD, GROUND, described, title
from torchrl_loco.sim.compiled.collision.pairs import MOST_LISTED, Pair, is_elliptic, kind, looked_up, pairs
from torchrl_loco.sim.compiled.ir.parameters import VariedModel, nominal
from torchrl_loco.sim.compiled.physics import equalities
from torchrl_loco.sim.compiled.physics.actuators import BIASES, FILTERS, acting
from torchrl_loco.sim.compiled.physics.dynamics import BALL, FREE
from torchrl_loco.sim.compiled.physics.lengths import OF_JOINT, OF_TENDON
from torchrl_loco.sim.compiled.physics.sensors import ANGULAR_MOMENTUM, AT_SITES, FORCE, SUBTREE_VELOCITY, TORQUE, TOUCH
from torchrl_loco.sim.compiled.schedules import lanes
from torchrl_loco.sim.compiled.step import is_traced
from torchrl_loco.sim.varied import Varied

IGNORED_FLAGS = ("EULERDAMP", "FILTERPARENT", "REFSAFE", "MIDPHASE", "NATIVECCD", "ISLAND", "AUTORESET")
"""Flags that may be set: the compiled step follows them, or they change nothing in it."""

MAX_TOUCH = 31  # touch sensors that fit into the bits of an int

SHOWN = 3  # names of elements that a line shows

Found = defaultdict[str, list[str]]  # names of the elements that need something, by what it is


def unsupported(mj_model: mujoco.MjModel, varied: Varied | None = None) -> list[str]:
    """Returns what a model needs that the compiled step does not have, in words; an empty list if nothing.

    It raises nothing: what cannot be read is not supported.

    Args:
        mj_model: the model.
        varied: which of its numbers differ from world to world.
    """
    m = mj_model if varied is None else VariedModel(mj_model, varied)
    if isinstance(m, VariedModel) and (count := _varied_ground(m)) > MOST_LISTED:
        return [f"numbers of {count} geoms of the ground that vary: let those of what touches it vary"]
    found: list[str] = []
    for part in (_options, _elements, _joints, _actuators, _contacts, _sensors):
        try:
            found += part(m)
        except Exception as error:  # a kind of element that nobody has thought of
            found.append(f"{part.__name__[1:]} of an unknown kind ({type(error).__name__}: {error})")
    return found or _size(m)


def _varied_ground(m: VariedModel) -> int:
    """Returns how many geoms that are looked up have numbers that vary."""
    places = [
        part // (getattr(m.nominal, name).size // m.nominal.ngeom)
        for name, part in m.varied.places.items()
        if name.startswith("geom_")
    ]
    return int(looked_up(m.nominal)[np.unique(np.concatenate(places))].sum()) if places else 0


def _size(m: mujoco.MjModel) -> list[str]:
    if is_traced(m):
        return []
    try:
        lanes.Description(m)
    except ValueError as error:
        return [str(error)]
    return []


def _options(m: mujoco.MjModel) -> list[str]:
    option, found = m.opt, []
    if option.solver != int(mujoco.mjtSolver.mjSOL_NEWTON):
        found.append("a solver other than Newton")
    if option.integrator != int(mujoco.mjtIntegrator.mjINT_EULER) and not lanes.is_implicitfast(m):
        found.append("an integrator other than Euler and implicitfast")
    if option.noslip_iterations:
        found.append("noslip iterations")
    if option.density or option.viscosity:
        found.append("forces of a fluid")
    allowed = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0)) for flag in IGNORED_FLAGS)
    if option.disableflags & int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD) and any(kind(m, p).searched for p in pairs(m)):
        found.append("disabled nativeccd, by which C MuJoCo finds contacts of ellipsoids and cylinders")
    found += [f"disabled {flag}" for flag in _flags(mujoco.mjtDisableBit, option.disableflags & ~allowed)]
    found += [f"enabled {flag}" for flag in _flags(mujoco.mjtEnableBit, option.enableflags)]
    return found


def _flags(kind: type, bits: int) -> list[str]:
    titles = {int(getattr(kind, title)): title for title in dir(kind) if title.startswith(("mjDSBL_", "mjENBL_"))}
    return [title.split("_", 1)[1].lower() for bit, title in titles.items() if bits & bit]


def _elements(m: mujoco.MjModel) -> list[str]:
    counts = {
        "flexes": m.nflex,
        "plugins": m.nplugin,
        "mocap bodies": m.nmocap,
        "plastic joints": m.nplastic,
        "gravity compensation": m.ngravcomp,
        "adhesive geoms": m.flg_adhesion,
        "moving surfaces": m.flg_surfacevel,
    }
    found = [title for title, count in counts.items() if count]
    if not all(_is_plain(m, t) for t in range(m.ntendon)):
        found.append("tendons that are not fixed, or have more than a length")
    if not set(m.eq_type[m.eq_active0 != 0].tolist()) <= set(equalities.KINDS):
        found.append("equality constraints but for those of joints, tendons, connections and welds")
    for i in equalities.active(m, (equalities.CONNECT, equalities.WELD)):
        first, second = m.body_weldid[list(equalities.Weld.of(nominal(m), i).bodies)]
        if first == second != 0:
            found.append(f"equality {m.equality(i).name!r}, which holds a body to itself")
    if m.nv == 0:
        found.append("a model without joints")
    return found


def _is_plain(m: mujoco.MjModel, t: int) -> bool:
    """Returns whether a tendon is fixed, without limit, spring, damper, friction or armature."""
    wraps = range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t])
    fixed = all(m.wrap_type[k] == int(mujoco.mjtWrap.mjWRAP_JOINT) for k in wraps)
    names = "limited actfrclimited stiffness stiffnesspoly damping dampingpoly frictionloss armature"
    return fixed and not any(np.any(getattr(m, f"tendon_{name}")[t]) for name in names.split())


def _joints(m: mujoco.MjModel) -> list[str]:
    found = Found(list)
    for j in range(m.njnt):
        name = m.joint(j).name
        if m.jnt_type[j] in (FREE, BALL) and m.jnt_stiffness[j]:
            found["stiffness of a free or ball joint"].append(name)
        if lanes.is_implicitfast(m) and m.jnt_type[j] == FREE and m.tree_dofnum[m.dof_treeid[m.jnt_dofadr[j]]] == 6:
            found["implicitfast for a body that is alone in its tree"].append(name)
        last = m.body_jntadr[m.jnt_bodyid[j]] + m.body_jntnum[m.jnt_bodyid[j]] - 1
        if m.jnt_type[j] == BALL and j != last and not is_traced(m):
            found["a ball joint that another joint of the body follows, in a world of lanes"].append(name)
        if m.jnt_stiffnesspoly[j].any():
            found["springs that are not linear"].append(name)
    dampers = ["dampers that are not linear"] if m.dof_dampingpoly.any() else []
    return _lines("joint", found) + dampers


def _actuators(m: mujoco.MjModel) -> list[str]:
    found = Found(list)
    for i in range(m.nactuator):  # not nu: an actuator may have several controls
        name, of = m.actuator(i).name, m.actuator_trnid[i, 0]
        of_tendon = m.actuator_trntype[i] == OF_TENDON
        if m.actuator_ctrlnum[i] != 1:
            found["other than one control"].append(name)
        if not of_tendon and (m.actuator_trntype[i] != OF_JOINT or m.jnt_type[of] in (FREE, BALL)):
            found["a transmission other than a hinge, slide or fixed tendon"].append(name)
        if of_tendon and lanes.is_implicitfast(m) and m.actuator_biasprm[i, 2]:
            found["implicitfast for a tendon's bias by velocity"].append(name)
        plain = m.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
        if not plain and (m.actuator_dyntype[i] not in FILTERS or m.actuator_actearly[i] or i not in acting(m)):
            found["activation other than a filter or integrator that acts"].append(name)
        if m.actuator_gaintype[i] != int(mujoco.mjtGain.mjGAIN_FIXED) or m.actuator_biastype[i] not in BIASES:
            found["a gain that is not fixed or a bias that is not affine"].append(name)
        if m.actuator_delay[i] or m.actuator_damping[i] or m.actuator_armature[i] or m.actuator_dampingpoly[i].any():
            found["delay, damping or armature of an actuator"].append(name)
    return _lines("actuator", found)


def _lines(kind: str, found: dict[str, list[str]]) -> list[str]:
    """Returns a line for each thing that was found, with the names of the first elements that need it."""
    lines = []
    for what, names in found.items():
        others = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        lines.append(f"{kind} {', '.join(map(repr, names[:SHOWN]))}{others}: {what}")
    return lines


def _contacts(m: mujoco.MjModel) -> list[str]:
    kinds, found, moving, on_field = set(), [], False, False
    for pair in pairs(m):
        if not _collides(m, pair):
            on_field = on_field or m.geom_type[pair.geoms[0]] == FIELD
            moving = moving or m.body_weldid[m.geom_bodyid[list(pair.geoms)]].all()
            kinds.add(" and ".join(title(m.geom_type[geom]) for geom in pair.geoms))
    if kinds:
        choice = "; contacts='ground' leaves out those of moving bodies with each other" if moving else ""
        if on_field:
            choice += "; solids_on_terrain='spheres' lets spheres in their corners touch height fields"
        found.append(f"contacts of {', '.join(sorted(kinds))}: it has those of {described()}{choice}")
    if is_elliptic(m) and m.pair_solreffriction.any():  # pyramids do without
        found.append("solreffriction of an explicit pair with an elliptic cone")
    return found


def _collides(m: mujoco.MjModel, pair: Pair) -> bool:
    first = pair.geoms[0]
    of_world = m.geom_type[first] not in GROUND or m.body_weldid[m.geom_bodyid[first]] == 0
    return bool(kind(m, pair).points and of_world)


def _sensors(m: mujoco.MjModel) -> list[str]:
    at_sites = set(AT_SITES)
    if at_sites.intersection((FORCE, TORQUE), m.sensor_type.tolist()):
        welds = equalities.active(m, (equalities.CONNECT, equalities.WELD))
        if welds or any(pair.condim > 3 for pair in pairs(m)):
            at_sites -= {FORCE, TORQUE}
    names = [
        m.sensor(i).name
        for i in range(m.nsensor)
        if not _is_sensed(m, m.sensor_type[i], m.sensor_objid[i], at_sites)
        or m.sensor_cutoff[i]
        or m.sensor_interval[i].any()
        or m.sensor_delay[i]
    ]
    what = (
        "anything but touch; velocimeter, gyro, accelerometer, force and torque of what moves (the last two where "
        "neither friction resists turning nor a weld or connection holds); and velocity and angular momentum of a "
        "moving subtree with mass, as they are"
    )
    found = {what: names} if names else {}
    touch = [m.sensor(i).name for i in range(m.nsensor) if m.sensor_type[i] == TOUCH]
    if len(touch) > MAX_TOUCH:
        found[f"more than {MAX_TOUCH} sensors of touch"] = touch[MAX_TOUCH:]
    return _lines("sensor", found)


def _is_sensed(m: mujoco.MjModel, kind: int, of: int, at_sites: set[int]) -> bool:
    """Returns whether there is a sensor of a kind, of a body or site; sites may have those of ``at_sites``."""
    if kind in AT_SITES:
        return kind in at_sites and bool(m.body_weldid[m.site_bodyid[of]])
    if kind == ANGULAR_MOMENTUM and m.body_weldid[of] == 0:
        return False
    return kind == TOUCH or (kind in (SUBTREE_VELOCITY, ANGULAR_MOMENTUM) and nominal(m).body_subtreemass[of] > 0)
