"""The order of constraint rows: the same whichever came first, and nothing but an order."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from cases import CONFIGS, MODELS

from torchrl_loco.checks import check_device
from torchrl_loco.config import sim_config
from torchrl_loco.sim import Simulation, models
from torchrl_loco.sim.row_order import FIRST_CONTACT, ROW_FIELDS, RowOrder

pytestmark = pytest.mark.slow

WORLDS = 3


@pytest.fixture(scope="module")
def sim():
    """A simulation of a body that fell under random actions: contacts, and joints at their limits."""
    config = sim_config(CONFIGS["humanoid"], "dm_control", WORLDS, {"deterministic": True, "engine": "mujoco_warp"})
    sim = Simulation(models.load(MODELS["humanoid"]), config, WORLDS, check_device("cpu"))
    rng = np.random.default_rng(0)
    step = sim.capture(sim.step)
    sim.reset(wp.ones(WORLDS, dtype=bool))
    for _ in range(60):
        sim.ctrl.copy_(sim.ctrl.new_tensor(rng.choice([-1.0, 1.0], sim.ctrl.shape)))
        step.replay()
    assert sim.data.nefc.numpy().sum() > 15
    return sim


def read(sim):
    """Returns the rows of each world and, for those of contacts, the geoms of their contact."""
    efc, geoms, worlds = sim.data.efc, sim.data.contact.geom.numpy(), []
    jacobian, fields = efc.J.numpy(), {name: getattr(efc, name).numpy() for name in ROW_FIELDS}
    for world, rows in enumerate(sim.data.nefc.numpy()):
        found = {name: values[world, :rows].copy() for name, values in fields.items()}
        of_contact = found["type"] >= FIRST_CONTACT
        ids = found.pop("id")
        found["where"] = np.where(of_contact[:, None], geoms[ids], ids[:, None])
        worlds.append({"J": jacobian[world, :rows].copy(), **found})
    return worlds


def shuffle(sim, rng):
    """Puts contacts and constraints in another order, as threads on CUDA may; those of one thread stay in order."""
    d = sim.data
    contacts = int(d.nacon.numpy()[0])
    owner, geom, address = (a.numpy()[:contacts] for a in (d.contact.worldid, d.contact.geom, d.contact.efc_address))
    place = rng.permutation(contacts)
    threads = np.unique(np.column_stack([owner, geom]), axis=0, return_inverse=True)[1].reshape(-1)
    for thread in np.unique(threads):
        place[threads == thread] = np.sort(place[threads == thread])

    rows = {name: getattr(d.efc, name).numpy() for name in (*ROW_FIELDS, "J")}
    for world, count in enumerate(d.nefc.numpy()):
        ids = rows["id"][world, :count]
        of_contact = rows["type"][world, :count] >= FIRST_CONTACT
        ids[of_contact] = place[ids[of_contact]]
        # Limits come first, in any order; then contacts, in any order, the rows of each together.
        keys = np.where(of_contact, 1.0 + rng.permutation(contacts)[np.where(of_contact, ids, 0)], rng.random(count))
        order = np.argsort(keys, kind="stable")
        for values in rows.values():
            values[world, :count] = values[world, order]
        mine = owner == world
        address[mine] = np.where(address[mine] < 0, -1, np.argsort(order)[address[mine]])
    for name, values in rows.items():
        getattr(d.efc, name).assign(values)
    for array, values in ((d.contact.worldid, owner), (d.contact.geom, geom), (d.contact.efc_address, address)):
        shuffled = array.numpy()
        shuffled[place] = values
        array.assign(shuffled)


def test_the_order_does_not_depend_on_which_row_came_first(sim):
    order = RowOrder(sim.model, sim.data)
    order.apply()
    expected = read(sim)
    for seed in range(3):
        shuffle(sim, np.random.default_rng(seed))
        assert any(not np.array_equal(a["J"], b["J"]) for a, b in zip(read(sim), expected, strict=True))
        order.apply()
        for found, wanted in zip(read(sim), expected, strict=True):
            for name, values in wanted.items():
                np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_rows_are_moved_and_not_changed(sim):
    shuffle(sim, np.random.default_rng(0))
    before = read(sim)
    RowOrder(sim.model, sim.data).apply()
    for found, wanted in zip(read(sim), before, strict=True):
        for name in wanted:
            rows = [np.column_stack([world["J"], world[name]]) for world in (found, wanted)]
            assert sorted(row.tobytes() for row in rows[0]) == sorted(row.tobytes() for row in rows[1]), name


def test_contacts_know_their_rows_afterwards(sim):
    shuffle(sim, np.random.default_rng(0))
    RowOrder(sim.model, sim.data).apply()
    d = sim.data
    ids, owner, address = d.efc.id.numpy(), d.contact.worldid.numpy(), d.contact.efc_address.numpy()
    rows = 0
    for contact in range(int(d.nacon.numpy()[0])):
        for row in address[contact][address[contact] >= 0]:
            assert ids[owner[contact], row] == contact
            rows += 1
    assert rows


def test_the_solver_finds_rows_in_order_and_sums_in_order(sim, monkeypatch):
    rng, found = np.random.default_rng(0), []
    step1, step2 = mjw.step1, mjw.step2

    def look(model, data):
        before = data.efc.J.numpy().copy()
        RowOrder(model, data).apply()
        found.append((np.array_equal(before, data.efc.J.numpy()), model.opt.deterministic))
        step2(model, data)

    monkeypatch.setattr(mjw, "step1", lambda model, data: (step1(model, data), shuffle(sim, rng)))
    monkeypatch.setattr(mjw, "step2", look)
    sim.step()
    assert found == [(True, mjw.DeterminismType.ATOMICS)] * len(found)
    assert len(found) > 1
    assert sim.model.opt.deterministic == mjw.DeterminismType.NONE


def test_rows_beyond_the_room_for_them_are_left_out():
    """MuJoCo-Warp counts them, but has them nowhere."""
    spheres = "".join(f'<geom size="0.1" pos="{0.3 * i} 0 0.09"/>' for i in range(4))
    body = f'<body><joint type="slide" axis="0 0 1"/>{spheres}</body>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="5 5 1"/>{body}</worldbody></mujoco>'
    )
    with wp.ScopedDevice("cpu"):
        m, d = mjw.put_model(model), mjw.make_data(model, nworld=3, njmax=6)
        mjw.step1(m, d)
        assert (d.nefc.numpy() > 6).all()
        for world, first in enumerate(((4, 3, 2, 1, 4, 3), (2, 2, 1, 1, 3, 4), (1, 2, 3, 4, 1, 2))):
            d.contact.geom.assign([(0, geom) for geom in np.arange(len(d.contact.geom)) + 1])
            d.efc.id[world].assign(np.array(first) - 1)
            d.efc.pos[world].assign(np.array(first, dtype=np.float32))
        RowOrder(m, d).apply()
    assert d.efc.pos.numpy().tolist() == [[1, 2, 3, 3, 4, 4], [1, 1, 2, 2, 3, 4], [1, 1, 2, 2, 3, 4]]


def test_other_models_are_refused():
    body = '<body gravcomp="1"><joint/><geom size="1"/></body>'
    xml = f'<mujoco><option cone="elliptic"/><worldbody>{body}</worldbody></mujoco>'
    mj_model = mujoco.MjModel.from_xml_string(xml)
    with wp.ScopedDevice("cpu"), pytest.raises(ValueError, match="elliptic friction cones, gravity compensation"):
        RowOrder(mjw.put_model(mj_model), mjw.make_data(mj_model))
