"""Small random models of everything that the compiled step supports, as MJCF, and states that they reach."""

import mujoco
import numpy as np
from hypothesis import strategies as st

DECIMALS = 3
"""Of the numbers drawn, so that a failing model can be read."""
DEEPEST = -0.02
"""Distance of geoms (m) below which a state is not used: forces of deep contacts leave no digits for the rest."""
FASTEST = 30.0
"""Velocity (m/s, rad/s) above which a state is not used."""
FARTHEST = 10.0
"""Distance of a body from the origin (m) above which a state is not used: inertias about a center of mass that is so
far away leave no digits for those of light bodies."""

AXES = st.sampled_from([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0), (1, 2, 0.5), (-0.3, 0.7, 1)])
SOLREF = st.sampled_from([(0.02, 1), (0.015, 1.2), (0.05, 0.7), (-800, -30)])
SOLIMP = st.sampled_from(
    [
        (0.9, 0.95, 0.001, 0.5, 2),
        (0, 0.99, 0.01, 0.5, 2),
        (0.8, 0.9, 0.02, 0.3, 3),
        (0.9, 0.95, 0.01, 0.4, 1),
        (0.95, 0.95, 0.01, 0.5, 2.5),
    ]
)
SURFACES = {
    "margin": [0.0, 0.01],
    "gap": [0.0, 0.005],
    "priority": [0, 0, 0, 1],
    "solmix": [1.0, 1.0, 0.3, 2.0],
}
"""Choices for what a geom's contacts are like; frequent ones are repeated."""
LAWS = {
    "sliding": {"cone": "pyramidal", "condim": [1, 3, 3], "impratio": [1.0, 3.0], "friction": [(0.2, 1.5)]},
    "pyramid": {"cone": "pyramidal", "condim": [1, 3, 4, 6], "impratio": [1.0, 3.0], "friction": [(0.2, 1.5)]},
    "cone": {
        "cone": "elliptic",
        "condim": [1, 3, 4, 6],
        "impratio": [1.0, 10.0, 100.0],
        "friction": [(0.2, 1.5), (0.2, 1.5), (0.001, 0.02)],
    },
}
"""Choices for the friction of contacts. A step that is traced has the first alone."""
SOLIDS = {
    "box": {"contype": 14, "conaffinity": 8},
    "cylinder": {"contype": 2, "conaffinity": 0},
    "ellipsoid": {"contype": 2, "conaffinity": 0},
    "mesh": {"contype": 2, "conaffinity": 0, "mesh": "wedge"},
}
"""Shapes of which some pairs are not compiled, and the masks that keep these apart."""
WEDGE = (0, 0, 0, 0.2, 0, 0, 0.25, 0.1, 0, 0.1, 0.2, 0, 0, 0.1, 0, 0, 0, 0.1, 0.2, 0, 0.15)
"""Vertices of a mesh (m)."""
RIGHT_ANGLES = st.lists(st.sampled_from([0, 90, 180]), min_size=3, max_size=3)


def numbers(low, high):
    return st.floats(low, high, allow_subnormal=False).map(lambda x: round(x, DECIMALS))


def vectors(low, high, count=3):
    return st.lists(numbers(low, high), min_size=count, max_size=count)


def rarely():
    return st.sampled_from([False, False, True])


def element(kind, *inner, **attributes):
    """Returns an element of MJCF; attributes that are tuples or lists become vectors."""
    values = {name: value if isinstance(value, tuple | list) else (value,) for name, value in attributes.items()}
    texts = [
        f' {name}="{" ".join(x if isinstance(x, str) else f"{x:g}" for x in row)}"' for name, row in values.items()
    ]
    return f"<{kind}{''.join(texts)}>{''.join(inner)}</{kind}>"


@st.composite
def surfaces(draw, law):
    """Returns the attributes of a geom that its contacts follow."""
    chosen = {name: draw(st.sampled_from(choices)) for name, choices in SURFACES.items()}
    chosen["condim"] = draw(st.sampled_from(LAWS[law]["condim"]))
    friction = [draw(numbers(*draw(st.sampled_from(LAWS[law]["friction"]))))]
    if law != "sliding":
        friction += draw(vectors(0.001, 0.3, 2))
    return {**chosen, "friction": friction, "solref": draw(SOLREF), "solimp": draw(SOLIMP)}


@st.composite
def geoms(draw, name, law, named=None):
    """Returns a sphere or a capsule; at times another shape if there is a list to add it to, by kind and name."""
    size, masks = [draw(numbers(0.03, 0.12))], {"conaffinity": 5}
    kind = draw(st.sampled_from(["sphere", "capsule", "capsule"]))
    if kind == "capsule":
        size.append(draw(numbers(0.05, 0.25)))
    pose = {"pos": draw(vectors(-0.15, 0.15)), "euler": draw(vectors(-180, 180))}
    if named is not None and draw(st.booleans()):
        kind, size = draw(st.sampled_from(list(SOLIDS))), draw(vectors(0.03, 0.15))
        pose["euler"] = draw(vectors(-180, 180) if draw(st.integers(0, 2)) else RIGHT_ANGLES)
        masks = SOLIDS[kind]
    attributes = {**pose, **draw(surfaces(law)), **masks}
    if named is not None:
        named.append((kind, name))
    if kind != "mesh":
        attributes["size"] = size
    return element("geom", name=name, type=kind, density=draw(numbers(200, 2000)), **attributes)


@st.composite
def zones(draw, body):
    """Returns a site of any shape that a touch sensor of a body feels with."""
    kind = draw(st.sampled_from(["sphere", "capsule", "ellipsoid", "cylinder", "box"]))
    pose = {"pos": draw(vectors(-0.15, 0.15)), "euler": draw(vectors(-180, 180))}
    return element("site", name=f"zone{body}", type=kind, size=draw(vectors(0.03, 0.3)), **pose)


@st.composite
def joints(draw, name, kind):
    """Returns a joint with springs, dampers, limits and dry friction, as far as its kind has them."""
    if kind == "free":
        return element("freejoint", name=name)
    fields = {"armature": draw(numbers(0.001, 0.05)), "damping": draw(st.sampled_from([0.0, 0.3, 2.0]))}
    if kind != "ball":
        fields |= {"axis": draw(AXES), "ref": draw(st.sampled_from([0.0, 0.0, 0.1]))}
        fields |= {"stiffness": draw(st.sampled_from([0.0, 0.0, 5.0])), "springref": draw(numbers(-10, 10))}
    if draw(st.booleans()):
        low, high = {"hinge": (40, 60), "slide": (0.2, 0.2), "ball": (0, 60)}[kind]
        fields |= {"range": (-draw(numbers(0, low)), draw(numbers(high / 10, high))), "limited": "true"}
        fields |= {"solreflimit": draw(SOLREF), "solimplimit": draw(SOLIMP), "margin": draw(st.sampled_from([0, 0.01]))}
    if draw(rarely()):
        fields["frictionloss"] = draw(numbers(0.05, 2))
    return element("joint", name=name, type=kind, pos=draw(vectors(-0.1, 0.1)), **fields)


@st.composite
def actuators(draw, joint):
    """Returns an actuator of a hinge or slide."""
    kind = draw(st.sampled_from(["motor", "position", "velocity"]))
    fields = {"joint": joint, "gear": draw(numbers(0.5, 20)), "ctrlrange": (-1, 1), "ctrllimited": "true"}
    if kind == "position":
        fields["kp"] = draw(numbers(0.5, 10))
    if kind == "velocity":
        fields["kv"] = draw(numbers(0.1, 2))
    if draw(st.booleans()):
        fields |= {"forcerange": (-2, 2), "forcelimited": "true"}
    return element(kind, **fields)


@st.composite
def trees(draw, children, body, parent, actuated, law, named):
    """Returns a body with all that hangs on it, and adds the joints that may have an actuator to ``actuated``."""
    root, parts = parent < 0, []
    count = draw(st.sampled_from([1, 1, 1, 2, 3])) if root or draw(st.integers(0, 7)) else 0
    for i in range(count):
        kinds = ["hinge", "slide"] if i else ["hinge", "slide", "ball", "free" if root else "hinge"]
        name, kind = f"joint{body}_{i}", draw(st.sampled_from(kinds))
        parts.append(draw(joints(name, kind)))
        if kind in ("free", "ball"):
            break  # MuJoCo allows no rotation after these
        actuated.append(name)
    parts += [draw(geoms(f"geom{body}_{i}", law, named)) for i in range(draw(st.sampled_from([1, 1, 2])))]
    parts.append(draw(zones(body)))
    height = numbers(0.2, 0.8) if root else numbers(0.0, 0.3)
    position = [*draw(vectors(-0.3, 0.3, 2)), draw(height)]
    inner = [draw(trees(children, child, body, actuated, law, named)) for child in children[body]]
    return element("body", *parts, *inner, name=f"body{body}", pos=position, euler=draw(vectors(-60, 60)))


@st.composite
def contact_pairs(draw, law, named):
    """Returns an explicit pair of two geoms, or of the floor and one, or nothing if their shapes cannot touch."""
    first, second = draw(st.sampled_from([("plane", "floor"), *named])), draw(st.sampled_from(named))
    kinds = {first[0], second[0]}
    if first == second or not (kinds <= {"sphere", "capsule", "box"} or "plane" in kinds) or kinds == {"box"}:
        return ""
    fields = draw(surfaces(law))
    sliding = numbers(*draw(st.sampled_from(LAWS[law]["friction"])))
    fields["friction"] = [draw(sliding), draw(sliding), *draw(vectors(0.001, 0.3))]
    fields = {name: fields[name] for name in ("condim", "margin", "gap", "friction", "solref", "solimp")}
    return element("pair", geom1=first[1], geom2=second[1], **fields)


@st.composite
def models(draw, max_bodies=8, lanes=False):
    """Returns MJCF of one or more trees of bodies, over one or two planes and at times a capsule that stands still.

    With ``lanes`` there are laws of friction, shapes and explicit pairs, which only lanes know.
    """
    law, named = (draw(st.sampled_from(list(LAWS))), []) if lanes else ("sliding", None)
    count, actuated = draw(st.integers(1, max_bodies)), []
    children = {i: [] for i in range(-1, count)}
    for i in range(count):
        children[draw(st.integers(-1, i - 1))].append(i)
    scene = [element("geom", name="floor", type="plane", size=(5, 5, 0.1), conaffinity=3, **draw(surfaces(law)))]
    if draw(rarely()):
        pose = {"pos": (-0.4, 0, 0), "euler": draw(vectors(-40, 40))}
        scene.append(element("geom", type="plane", size=(5, 5, 0.1), conaffinity=3, **pose, **draw(surfaces(law))))
    if draw(rarely()):
        pose = {"pos": (0.2, 0, 0.1), "euler": draw(vectors(-90, 90))}
        scene.append(element("geom", type="capsule", size=(0.1, 0.3), **pose, **draw(surfaces(law))))
    bodies = [draw(trees(children, i, -1, actuated, law, named)) for i in children[-1]]
    exclude = [element("exclude", body1="body0", body2="body1")] if count > 1 and draw(st.booleans()) else []
    flag = element("flag", eulerdamp=draw(st.sampled_from(["enable", "disable"])))
    option = {
        "timestep": draw(st.sampled_from([0.002, 0.005])),
        "impratio": draw(st.sampled_from(LAWS[law]["impratio"])),
        "gravity": draw(st.sampled_from([(0, 0, -9.81), (1, -2, -9)])),
        "iterations": 100,
        "ls_iterations": 50,
        "cone": LAWS[law]["cone"],
    }
    return element(
        "mujoco",
        element("option", flag, **option),
        element("asset", element("mesh", name="wedge", vertex=WEDGE)),
        element("worldbody", *scene, *bodies),
        element("contact", *exclude, *(draw(contact_pairs(law, named)) for _ in range(2 * lanes))),
        element("actuator", *(draw(actuators(joint)) for joint in actuated if draw(st.integers(0, 3)))),
        element(
            "sensor",
            element("subtreelinvel", body="body0"),
            element("subtreeangmom", body=f"body{count - 1}"),
            *(element("touch", site=f"zone{i}") for i in range(count)),
        ),
    )


def states(model, rng, count, longest=600):
    """Returns float32 states along trajectories of C MuJoCo: qpos, qvel, qacc_warmstart and ctrl, ``(count, …)`` each.

    Those that go too deep, too far or too fast are left out, so there may be fewer than ``count``.
    """
    found, data = [], mujoco.MjData(model)
    for _ in range(count + 20):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv) * 0.2, 1.0)
        data.qvel[:] = rng.normal(size=model.nv)
        for step in range(int(rng.integers(1, longest))):
            if step % 20 == 0:
                data.ctrl[:] = rng.uniform(-1.5, 1.5, model.nu)
            mujoco.mj_step(model, data)
        shallow = not data.ncon or data.contact.dist.min() > DEEPEST
        usual = np.abs(data.xpos).max() < FARTHEST and np.abs(data.qvel).max() < FASTEST
        if shallow and usual and not data.warning.number.any():
            rows = data.qpos, data.qvel, data.qacc_warmstart, data.ctrl
            found.append([row.astype(np.float32) for row in rows])
        if len(found) == count:
            break
    sizes = model.nq, model.nv, model.nv, model.nu
    return [np.array([rows[i] for rows in found]).reshape(len(found), size) for i, size in enumerate(sizes)]
