"""Patches of ground, the grid that they lie on, and the model that comes of it."""

import functools

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

from torchrl_loco import Go1Velocity, SimConfig, terrain
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled.support import unsupported
from torchrl_loco.sim.warp_init import init_warp

SLOPE_DOWN = functools.partial(terrain.slope, down=True)
STAIRS_DOWN = functools.partial(terrain.stairs, down=True)
KINDS = {
    "flat": terrain.flat,
    "slope": terrain.slope,
    "slope down": SLOPE_DOWN,
    "rough": terrain.rough,
    "wave": terrain.wave,
    "stairs": terrain.stairs,
    "stairs down": STAIRS_DOWN,
    "obstacles": terrain.obstacles,
    "stepping stones": terrain.stepping_stones,
    "gap": terrain.gap,
    "pit": terrain.pit,
}
MARBLE = """
<mujoco>
  <option timestep="0.002" iterations="100" ls_iterations="50" tolerance="1e-10"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".6" condim="3"/>
    <body pos="0 0 2"><freejoint/><geom name="marble" size=".05"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def ground():
    return terrain.Terrain(KINDS, rows=3, columns=12, size=6.0, border=5.0, seed=1)


def test_robots_begin_above_the_ground_and_edges_are_level(ground):
    """Of every kind and difficulty; where the middle is level, they begin on it."""
    rng = np.random.default_rng(5)
    near = ground.origins[..., None, :2] + rng.uniform(-0.75, 0.75, (3, 12, 200, 2))
    below = ground.height(near)
    assert (below <= ground.origins[..., 2:] + 0.02).all()
    assert (below.max(axis=-1) > ground.origins[..., 2] - 0.06).all()
    level = [column for column, kind in enumerate(ground.kinds) if kind not in ("rough", "wave")]
    np.testing.assert_allclose(ground.height(ground.origins[..., :2])[:, level], ground.origins[:, level, 2], atol=1e-9)
    x, y = ground.half
    along = np.linspace(-1.0, 1.0, 301)
    for row in range(ground.rows + 1):
        edge = np.stack([np.full(301, (row - ground.rows / 2) * ground.size), y * along], axis=-1)
        assert np.abs(ground.height(edge)).max() < 1e-9
    assert np.isnan(ground.height([x + 6.0, 0.0]))
    assert ground.height([x + 3.0, y + 3.0]) == 0.0


@for_each("name", KINDS)
def test_harder_patches_are_harder(name):
    """Their ground deviates more from level, but for level ground."""
    spread = []
    for difficulty in (0.0, 0.5, 1.0):
        kinds = {name: lambda _, rng, size, cell, d=difficulty: KINDS[name](d, rng, size, cell)}
        ground = terrain.Terrain(kinds, rows=1, columns=1, border=1.0)
        across = np.linspace(-3.9, 3.9, 157)
        seen = ground.height(np.stack(np.meshgrid(across, across), axis=-1))
        assert np.isfinite(seen).all()
        spread.append(np.abs(seen).mean())
    assert spread == [0.0] * 3 if name == "flat" else spread[0] < spread[1] < spread[2]


@for_each("difficulty", (0.0, 0.5, 1.0))
def test_stones_are_as_far_from_each_other_as_from_platform_and_edge(difficulty):
    gap = 0.05 + 0.25 * difficulty
    kinds = {"stones": lambda _, rng, size, cell: terrain.stepping_stones(difficulty, rng, size, cell)}
    ground = terrain.Terrain(kinds, rows=1, columns=1, border=1.0)
    x = np.arange(-4.0, 4.0, 0.001)
    for y in (0.3, -3.4):
        deep = ground.height(np.stack([x, np.full_like(x, y)], axis=-1)) < -0.5
        ends = np.flatnonzero(np.diff(deep.astype(int)))
        widths = 0.001 * np.diff(ends)[::2]
        crossed = widths[widths < 2 * gap]  # else the line runs along a gap
        np.testing.assert_allclose(crossed, gap, atol=2e-3)
    assert ground.height([0.99, 0.99]) == 0.0


def test_an_origin_is_over_all_that_is_near():
    """However narrow it is."""

    def spike(difficulty, rng, size, cell):
        heights = np.zeros((round(size / cell) + 1,) * 2)
        heights[len(heights) // 2, len(heights) // 2] = 0.4
        return terrain.Patch(heights=heights)

    def plank(difficulty, rng, size, cell):
        return terrain.Patch(boxes=np.array([[0.03, 0.0, 0.1, 0.01, 0.3, 0.2]]))

    for cell in (0.1, 0.25, 0.5, 1.0):
        ground = terrain.Terrain({"spike": spike, "plank": plank}, rows=1, columns=2, cell=cell)
        np.testing.assert_allclose(ground.origins[0, :, 2], [0.4, 0.3])


def test_heights_are_those_of_rays_in_mujoco(ground):
    m = ground.under(MARBLE).compile()
    data = mujoco.MjData(m)
    data.qpos[:3] = 0.0, 0.0, 900.0
    mujoco.mj_forward(m, data)
    rng, hit = np.random.default_rng(0), np.zeros(1, dtype=np.int32)
    xy = rng.uniform(-1.0, 1.0, (3000, 2)) * (np.array(ground.half) + 3.0)
    down = np.array([0.0, 0.0, -1.0])
    rays = [50.0 - mujoco.mj_ray(m, data, np.array([*p, 50.0]), down, None, 1, -1, hit) for p in xy]
    np.testing.assert_allclose(ground.height(xy), rays, atol=2e-6)


def test_the_same_seed_makes_the_same_ground(ground):
    same, other = (terrain.Terrain(KINDS, rows=3, columns=12, size=6.0, border=5.0, seed=seed) for seed in (1, 2))
    assert np.array_equal(ground.heights, same.heights)
    assert np.array_equal(ground.boxes, same.boxes)
    assert not np.array_equal(ground.heights, other.heights)
    assert not np.array_equal(ground.boxes, other.boxes)


def test_columns_follow_the_shares():
    kinds = {"flat": (terrain.flat, 1.0), "wave": (terrain.wave, 3.0), "pit": (terrain.pit, 0.01)}
    ground = terrain.Terrain(kinds, rows=1, columns=13, size=4.0)
    assert [ground.kinds.count(name) for name in kinds] == [3, 9, 1]


def test_a_model_stands_on_it_with_the_contacts_of_its_floor(ground, tmp_path):
    """In a file too; balls come to rest where C MuJoCo has them."""
    init_warp()
    spec = ground.under(MARBLE)
    m = spec.compile()
    path = tmp_path / "ground.xml"
    path.write_text(spec.to_xml())
    assert mujoco.MjModel.from_xml_path(str(path)).ngeom == m.ngeom
    assert unsupported(m) == []
    of_ground = [g for g in range(m.ngeom) if m.geom(g).name.startswith("terrain")]
    assert len(of_ground) == 1 + len(ground.boxes)
    assert (m.geom_friction[of_ground, 0] == 0.6).all()
    places = ground.origins.reshape(-1, 3)
    sim = Simulation(m, SimConfig.of(m, ctrl_dt=0.02, engine="compiled"), len(places), torch.device("cpu"))
    start = np.tile(m.qpos0, (len(places), 1))
    start[:, :3] = places + np.array([0.013, 0.021, 0.3])
    sim.qpos.copy_(torch.tensor(start))
    for _ in range(25):
        sim.step()
    data, expected = mujoco.MjData(m), []
    for qpos in start:
        mujoco.mj_resetData(m, data)
        data.qpos[:] = qpos
        mujoco.mj_step(m, data, 250)
        expected.append(data.qpos[2])
    assert np.abs(sim.qpos[:, 2].numpy() - expected).max() < 2e-3
    assert (sim.qpos[:, 2].numpy() > ground.height(sim.qpos[:, :2].numpy()) + 0.04).all()


def test_a_robot_stands_on_the_ground_of_a_task(ground, tmp_path):
    spec = ground.under(Go1Velocity.model)
    m = spec.compile()
    assert m.nhfield == 1
    assert "solids_on_terrain='spheres'" in unsupported(m)[0]
    ground.picture(tmp_path / "ground.png")
    assert (tmp_path / "ground.png").exists()


def one(difficulty, rng, size, cell):
    return terrain.Patch(boxes=np.array([[0.0, 0.0, -0.4, 1.0, 1.0, 0.5]]))


def test_a_kind_of_ones_own_may_be_as_low_as_one_says():
    ground = terrain.Terrain({"step": one}, rows=2, columns=1, size=4.0)
    assert ground.height(ground.origins[..., :2]).tolist() == [[pytest.approx(0.1)], [pytest.approx(0.1)]]
    level = functools.partial(terrain.rough, height=(0.0, 0.02))
    nothing = lambda *args: terrain.Patch(boxes=np.zeros((0, 6)))  # noqa: E731
    listed = lambda difficulty, rng, size, cell: terrain.Patch(heights=np.zeros((41, 41)).tolist())  # noqa: E731
    ground = terrain.Terrain({"rough": level, "nothing": nothing, "listed": listed}, rows=2, columns=3, size=4.0)
    highest = ground.origins[..., 2]
    assert (highest[0] == 0.0).all()
    assert highest[1].tolist() == [pytest.approx(0.02), 0.0, 0.0]


@for_each(
    ("kinds", "settings", "message"),
    [
        ({}, {}, "kinds must be 1 to 20"),
        ({"a": terrain.flat}, {"size": 1.05}, r"size \(1.05\) must be a whole multiple of cell \(0.1\)"),
        ({"a": (terrain.flat, -1.0)}, {}, "share of a"),
        ({"a": 3}, {}, "kind a must be a function"),
        ({"a": lambda difficulty: None}, {}, "kind a must take difficulty, generator, size and cell"),
        ({"a": lambda *args: 3}, {}, "kind a must return a Patch, got int"),
        ({"a": lambda *args: terrain.Patch(heights=np.zeros((3, 3)))}, {}, "heights of a must be 81 x 81 finite"),
        ({"a": lambda *args: terrain.Patch(heights=np.full((81, 81), np.nan))}, {}, "81 x 81 finite"),
        ({"a": lambda *args: terrain.Patch(boxes=np.array([[0, 0, 0, 1, 1, -1]]))}, {}, "positive half sizes"),
        ({"a": lambda *args: terrain.Patch(boxes=np.ones((2, 5)))}, {}, r"rows of 6, .*, got \(2, 5\)"),
        ({"a": terrain.stairs}, {"size": 4.0}, r"stairs, and their platform \(5.6 m\) must fit into a patch of 4 m"),
        ({"a": functools.partial(terrain.stairs, width=0.0)}, {}, "width of stairs must lie in"),
        ({"a": functools.partial(terrain.rough, step=0.0)}, {}, "step must lie in"),
        ({"a": functools.partial(terrain.rough, height=(-0.1, 0.1))}, {}, "height of rough must lie in"),
        ({"a": functools.partial(terrain.slope, platform=9.0)}, {}, "platform of a slope"),
        ({"a": functools.partial(terrain.obstacles, platform=9.0)}, {}, "free middle between obstacles"),
        ({"a": terrain.stepping_stones}, {"size": 4.0}, "a stone, gaps and the edge"),
        ({"a": terrain.gap}, {"size": 2.0}, "platform and the gap around it"),
        ({"a": terrain.pit}, {"size": 2.0}, "floor of a pit"),
        (
            {"a": lambda *args: terrain.Patch(boxes=np.array([[4, 0, 0, 1, 1, 1]]))},
            {},
            "reach beyond their patch of 8 m",
        ),
        ({"a": terrain.flat}, {"size": 1.0, "border": 0.2}, "must be at least 0.8 m"),
    ],
)
def test_bad_input(kinds, settings, message):
    with pytest.raises((ValueError, TypeError), match=message):
        terrain.Terrain(kinds, **settings)


def test_a_pit_may_be_as_wide_as_its_patch():
    pit = terrain.Terrain({"a": terrain.pit}, rows=1, columns=1, size=3.0)
    assert pit.height(np.zeros((1, 2))) == pytest.approx(-0.5)


def test_there_must_be_a_level_floor():
    ground = terrain.Terrain({"a": terrain.flat}, rows=1, columns=1)
    with pytest.raises(ValueError, match="no plane 'ground' to replace: choose one of 'floor'"):
        ground.under(MARBLE, floor="ground")
    for where in ('pos="0 0 -.5"', 'euler="0 10 0"'):
        with pytest.raises(ValueError, match="plane 'floor' must be level at height 0"):
            ground.under(MARBLE.replace('name="floor"', f'name="floor" {where}'))


def test_seams_of_boxes_have_no_width():
    """Steps that meet do so for points in between, whatever rounding makes of their edges."""
    ground = terrain.Terrain({"stairs": terrain.stairs}, rows=7, columns=3)
    for row in range(7):
        center, seams = ground.center(row, 1), np.array([1.5 + 0.3 * k for k in range(6)])
        for points in (np.stack([seams, 0 * seams + 0.1], -1), np.stack([0.1 + 0 * seams, -seams], -1)):
            assert (ground.height(points + center) > -0.1).all()


def test_low_relief_is_as_high_in_the_model():
    def gravel(difficulty, rng, size, cell):
        return terrain.Patch(heights=np.pad(np.full((2, 2), 1e-4), (4, round(size / cell) - 5)))

    ground = terrain.Terrain({"gravel": gravel}, rows=1, columns=1, size=2.0)
    m = ground.under('<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/></worldbody></mujoco>').compile()
    assert m.hfield_size[0, 2] == pytest.approx(np.ptp(ground.heights))
    assert np.ptp(ground.heights) == pytest.approx(1e-4)
