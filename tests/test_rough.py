"""Velocity tasks on rough ground: where robots begin, how their levels change, and what they see of the ground."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torchrl_loco as loco
from torchrl_loco import cli, registry, terrain
from torchrl_loco.conditions import Conditions
from torchrl_loco.tasks import rough
from torchrl_loco.verify import Exported, verify


class Hills(loco.Go1Rough):
    """Go1 on a small ground of two kinds."""

    ground = terrain.Terrain({"hill": rough.hill, "stairs": terrain.stairs}, rows=4, columns=3, border=5.0)


@pytest.fixture(scope="module")
def env():
    return Hills(24, "cpu", seed=0, metrics=True, on_overflow="ignore")


@pytest.fixture(scope="module")
def played():
    return Hills(16, "cpu", seed=0, play=True, on_overflow="ignore", engine="mujoco", compile_hooks=False)


def still(env):
    return torch.zeros(env.action_spec.shape)


def next_levels(env, **rows):
    """Returns the levels with which new episodes begin in worlds whose memory has these rows."""
    env.reset()
    for name, values in rows.items():
        env.world.memory[name][:] = torch.as_tensor(values).to(env.world.memory[name].dtype)
    env.reset()
    return env.world.memory["level"], env.world.memory["reached"]


def test_robots_begin_above_the_ground_in_the_middle_of_their_patch(env):
    env.reset()
    memory, ground = env.world.memory, Hills.ground
    assert len(memory["level"].unique()) > 1
    origins = memory["origin"].numpy()
    expected = ground.origins[memory["level"].numpy() - 1, (np.arange(24) + np.arange(24) // 12) % 3]
    np.testing.assert_allclose(origins, expected, atol=1e-6)
    assert (env.sim.qpos[:, :2] - memory["origin"][:, :2]).abs().max() <= 0.5
    m, data = env.mj_model, mujoco.MjData(env.mj_model)
    for qpos in env.sim.qpos.numpy():
        data.qpos[:] = qpos
        mujoco.mj_forward(m, data)
        assert data.ncon == 0
        lowest = min(data.geom_xpos[m.geom(name).id, 2] - 0.023 for name in Hills.feet.values())
        assert lowest - ground.height(qpos[:2]) < 0.1


def test_levels_rise_and_fall(env):
    """By what was crossed, and by what was commanded; standing still as told keeps them."""
    away = {"distance": [5.0] * 24, "commanded_distance": [9.0] * 24}
    level, reached = next_levels(env, level=[2] * 24, reached=[2] * 24, **away)
    assert (level == 3).all()
    assert (reached == 3).all()
    level, reached = next_levels(env, level=[4] * 24, reached=[4] * 24, **away)
    assert len(level.unique()) > 2  # beyond the last, a random one
    assert (reached == 4).all()
    for rows in ({"fell": [True] * 24}, {"commanded_distance": [9.0] * 24, "distance": [1.5] * 24}):
        level, reached = next_levels(env, level=[3] * 24, reached=[4] * 24, **rows)
        assert (level == 2).all()
        assert (reached == 2).all()
    assert (next_levels(env, level=[1] * 24, fell=[True] * 24)[0] == 1).all()
    for rows in ({}, {"commanded_distance": [1.0] * 24}, {"commanded_distance": [9.0] * 24, "distance": [3.0] * 24}):
        assert (next_levels(env, level=[3] * 24, **rows)[0] == 3).all()


def test_specs_hold_and_plain_torch_sees_what_kernels_see(env):
    """Scans too, also after episodes have begun anew."""
    check_env_specs(env)
    plain = Hills(24, "cpu", seed=0, compile_hooks=False, metrics=True, on_overflow="ignore")
    assert set(env.world.kinds.values()) == {"kernel"}
    td = env.reset()
    ours = plain.reset(env.get_state(), set_state=True)
    torch.testing.assert_close(ours["observation"], td["observation"], atol=1e-4, rtol=1e-4)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        action = torch.randn(env.action_spec.shape, generator=generator)
        state = env.get_state()
        state["qpos"][:3, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # on its back, where an episode ends
        td = env.step_and_maybe_reset(env.reset(state, set_state=True).set("action", action))[1]
        ours = plain.step_and_maybe_reset(plain.reset(state, set_state=True).set("action", action))[1]
        td, ours = (each.step_and_maybe_reset(now.set("action", action))[1] for each, now in ((env, td), (plain, ours)))
        place, ahead = env.sim.xpos[:, 1], torch.nn.functional.normalize(env.sim.xmat[:, 1, :2, 0], dim=-1)
        points = place[:, None, :2] + rough.turned(torch.tensor(rough.SCAN), ahead[:, None])
        expected = 0.2 * (place[:, 2:] - torch.tensor(Hills.ground.height(points.numpy())))
        assert ((td["privileged"][:, -187:] - expected).abs() < 1e-5).float().mean() > 0.995  # but at edges of steps
        for group in ("observation", "privileged"):
            torch.testing.assert_close(ours[group], td[group], atol=1e-3, rtol=1e-3)
        assert torch.equal(plain.world.memory["level"], env.world.memory["level"])


def test_the_way_that_commands_led_is_summed_up_in_the_world(env):
    td = env.reset()
    state = env.get_state()
    state["memory", "command"][:] = torch.tensor([1.0, 0.0, 0.0])
    state["memory", "until_command"][:] = 9.0
    state["memory", "holds_heading"][:] = 0.0
    td = env.reset(state, set_state=True)
    forward = env.sim.xmat[:, 1, :2, 0] / env.sim.xmat[:, 1, :2, 0].norm(dim=-1, keepdim=True)
    for _ in range(5):
        td = env.step(td.set("action", still(env)))["next"]
    told = env.world.memory["commanded_displacement"]
    torch.testing.assert_close(told, 0.1 * forward, atol=5e-3, rtol=0)
    torch.testing.assert_close(env.world.memory["commanded_distance"], told.norm(dim=-1), atol=1e-3, rtol=0)


def test_heights_of_feet_are_over_the_ground_and_a_trunk_leans_with_the_slope(env):
    """On the side of a hill: feet stand at height 0, and upright is along the normal of the ground."""

    class Seen(Hills):
        def observation(self, s):
            return torch.cat([self.heights(s), self.normal(s)], dim=-1)

        noise = {}

    seen = Seen(2, "cpu", seed=0, compile_hooks=False)
    seen.reset()
    state = seen.get_state()
    x, y = Seen.ground.center(3, 0)
    state["qpos"][:, :3] = torch.tensor([[x + 2.0, y, 1.4], [x, y - 2.0, 1.4]])
    state["qpos"][:, 3:7] = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # it looks along y
    found = seen.reset(state, set_state=True)["observation"]
    feet = seen.sim.mujoco_data().site_xpos.numpy()[:, [seen.mj_model.site(name).id for name in Seen.feet]]
    expected = feet[..., 2] - Seen.ground.height(feet[..., :2])
    np.testing.assert_allclose(found[:, :4], expected, atol=1e-5)
    along = found[:, 4:].numpy()
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0, atol=1e-6)
    downhill = np.array([[along[0, 0], along[0, 1]], [-along[1, 1], along[1, 0]]])  # where x grows, or y falls
    assert (downhill[:, 0] > 0.5).all()
    assert (np.abs(downhill[:, 1]) < 0.1).all()


def test_an_episode_ends_where_the_ground_does(env):
    td = env.reset()
    state = env.get_state()
    edge = torch.tensor(Hills.ground.half) + Hills.ground.border
    state["qpos"][0, :3] = torch.tensor([edge[0] - 0.2, 0.0, 0.5])
    td = env.reset(state, set_state=True)
    after = env.step(td.set("action", still(env)))["next"]
    assert after["truncated"][0]
    assert not after["terminated"][0]
    assert not after["truncated"][1:].any()


def test_an_episode_ends_where_a_robot_leaves_its_patch(env, played):
    """At once, as one that crossed it; in play it goes on."""
    for made in (env, played):
        made.reset()
        state = made.get_state()
        state["memory", "origin"][:] = state["qpos"][:, :3]
        state["memory", "origin"][0, 0] -= 4.1
        td = made.reset(state, set_state=True)
        after = made.step(td.set("action", still(made)))["next"]
        assert bool(after["truncated"][0]) is (made is env)
        assert not after["terminated"][0]
        assert not after["truncated"][1:].any()
        crossed = after.get(("metrics", "crossed"), None)
        if crossed is not None:
            assert crossed[0] == 1.0
            assert crossed[1:].isnan().all()


def test_a_world_that_is_not_finite_touches_nothing_and_ends_alone(env):
    td = env.reset()
    env.sim.qpos[:2, 0] = torch.tensor([torch.nan, torch.inf])
    after = env.step(td.set("action", still(env)))["next"]
    assert after["terminated"][:2].all()
    assert not after["terminated"][2:].any()


def test_worlds_to_play_with_begin_on_each_patch_and_where_they_are_told(played):
    td = played.reset()
    cases = list(played.cases())
    assert cases[:3] == ["hill at 1.00", "stairs at 1.00", "hill at 0.67"]
    assert len(cases) == 8
    level, ground = played.world.memory["level"], Hills.ground
    assert level[:9].tolist() == [4, 4, 3, 3, 2, 2, 1, 1, 4]
    kinds = [ground.kinds[round(float(y) / 8 + 1)] for y in played.world.memory["origin"][:, 1]]
    assert kinds[:4] == ["hill", "stairs"] * 2
    played.set_command([1.0, 0.34], "patch")
    for _ in range(2):  # a command holds from the next step on
        td = played.step(td.set("action", still(played)))["next"]
    try:
        assert (played.world.memory["level"] == 2).all()
        near = (played.sim.qpos[:, :2] - played.world.memory["origin"][:, :2]).abs().max()
        assert near <= 0.5
    finally:
        played.set_command(None, "patch")
    stays = played.step(td.set("action", still(played)))["next"]
    assert (played.world.memory["level"] == 2).all()
    assert not stays["done"].any()


def test_what_a_subclass_sets_stays_but_for_the_ground_under_its_robot(tmp_path):
    class Short(Hills):
        config = dataclasses.replace(Hills.config, episode_length=77)

    class Steep(rough.Rough):
        ground = Hills.ground

    class Other(Steep, loco.Go2Velocity):
        memory = rough.memory(joints=12, feet=4)

    class Own(Hills):
        model = loco.Go1Velocity.model

    class Long(loco.Go1Rough):
        config = dataclasses.replace(loco.Go1Velocity.config, episode_length=88)

    class Wide:  # mixed in
        ground = terrain.Terrain({"hill": rough.hill}, rows=2, columns=2, border=9.0)

    mixed = type("Mixed", (Wide, Hills), {})
    assert mixed.model.hfields[0].size[0] == max(Wide.ground.half) != max(Hills.ground.half)
    assert Long.config.solids_on_terrain == "spheres"
    short, whole = (Hills(1, "cpu", 0, on_overflow="ignore", **length) for length in ({"episode_length": 9}, {}))
    short.load_state_dict(whole.state_dict())  # the same cases
    assert short.episode_length == 9
    with pytest.raises(TypeError, match=r"ground of Groundless must be a .*Terrain, got 'stairs'"):
        type("Groundless", (loco.Go1Rough,), {"ground": "stairs"})
    with pytest.raises(TypeError, match="Footless must set feet"):
        type("Footless", (rough.Rough,), {"model": loco.Go1Velocity.model})
    assert Short.config.episode_length == 77
    assert Short.config.solids_on_terrain == "spheres"
    assert Short.model is Hills.model
    assert Other.config.solids_on_terrain == "spheres"
    assert Other.model.geom("terrain") is not None
    assert Own.model.geom("terrain") is not None
    assert Other.command_ranges["patch"]["kind"] == (0.0, 1.0)
    # A relative model lies beside its class, and not in the package, where there is one of this name.
    text = loco.Go1Velocity.model.read_text().replace(
        "</mujoco>", '<custom><text name="mine" data="1"/></custom></mujoco>'
    )
    (tmp_path / "go1.xml").write_text(text)
    for name, sets in (("by_model.py", "model"), ("by_robot.py", "robot")):
        file = tmp_path / name
        file.write_text(f"import torchrl_loco\nclass Mine(torchrl_loco.Go1Rough):\n    {sets} = 'go1.xml'\n")
        assert [each.name for each in registry.resolve(f"{file}:Mine", by_user=True).model.texts] == ["mine"]


def test_worlds_begin_on_all_patches_of_any_ground():
    for rows in range(1, 7):
        for columns in range(1, 9):
            world = torch.arange(rows * columns)
            column = rough.column_of(world, rows, columns)
            assert len(set(zip((world % rows).tolist(), column.tolist(), strict=True))) == rows * columns
    world = torch.arange(200)
    assert torch.equal(rough.column_of(world, 10, 10), (world + world // 10) % 10)


def test_evaluations_begin_on_all_levels(env):
    """Whatever the episodes before them did."""
    stage = Hills.stage_of({"stage": {"memory": {"trained": [7.0], "level": [3] * 5}}})
    assert stage["memory"]["trained"] == [7.0]
    env.reset()
    for name, value in (("fell", True), ("commanded_distance", 9.0)):
        env.world.memory[name].fill_(value)
    env.set_stage(stage)
    env.reset()
    assert env.world.memory["level"].tolist() == [1, 2, 3, 4] * 6


@pytest.mark.ci
def test_all_robots_stand_on_their_ground():
    """Without an action nobody falls over on a level patch, and what is seen has the same size for all kinds."""
    for name in ("go1", "go2", "g1", "h1"):
        cls = loco.registry.env_class(f"{name}_rough")
        small = type("Small", (cls,), {"ground": terrain.Terrain({"flat": terrain.flat}, 1, 1, border=2.0)})
        env = small(2, "cpu", seed=0, play=True)
        flat = loco.registry.env_class(f"{name}_velocity")
        td = env.reset()
        assert env.engine == "compiled"
        assert td["observation"].shape[-1] == 12 + 3 * flat.memory["last_action"] + len(rough.SCAN)
        for _ in range(10):
            td = env.step(td.set("action", still(env)))["next"]
        assert not td["terminated"].any()
        above = env.sim.qpos[:, 2:3]
        torch.testing.assert_close(td["observation"][:, -187:], (0.2 * above).expand(-1, 187), atol=1e-5, rtol=0)


@pytest.mark.ci
def test_the_shipped_policy_walks_in_c_mujoco_by_kind_and_difficulty(tmp_path):
    policy = loco.load_policy("go1_rough", "cpu")
    file = tmp_path / "policy.onnx"
    loco.export_policy(policy, file)
    report = verify(file, Conditions(episodes=70, seconds=2.0, max_falls=0.2), alone=True)
    assert report.holds
    by_case = report.figures["by_case"]["C MuJoCo"]
    assert len(by_case) == 70
    assert {"falls", "crossed", "level", "linear_error"} <= by_case["stairs at 1.00"].keys()
    assert by_case["hollow at 0.00"]["level"] == 0.0
    assert any(line.startswith("stairs at 1.00") for line in report.lines)
    assert Exported(file).facts["info"]["frames"] > 2e8


def test_a_picture_of_the_ground(tmp_path, capsys):
    picture = tmp_path / "ground.png"
    assert cli.main(["inspect", "go1_rough", "--terrain", str(picture)]) == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(SystemExit):
        cli.main(["inspect", "walker_walk", "--terrain", str(picture)])
    assert "walker_walk has no attribute ground" in capsys.readouterr().err
