"""randomize=[Vary(...)]: numbers of the model that differ from world to world."""

import json
import pickle

import mujoco
import numpy as np
import pytest
import torch
from cases import COARSE
from for_each import for_each
from torchrl.envs import Compose, RewardSum, TransformedEnv, check_env_specs

import torchrl_loco as loco
from torchrl_loco import doctor, nan_dump
from torchrl_loco.envs.variation import Variation
from torchrl_loco.training import PPOConfig
from torchrl_loco.training.environments import Environments

VARYS = (
    loco.Vary("geom_friction", 0.5, 1.25),
    loco.Vary("body_mass", 0.8, 1.2, of="torso"),
    loco.Vary("dof_damping", 0.5, 2.0, of=".*_(knee|hip)", shared=False, log=True),
    loco.Vary("body_ipos", (-0.02, 0.0, -0.03), (0.02, 0.0, 0.03), of="torso", how="add", once=True),
)
"""Of the walker: shared and own draws, factors and offsets, of each episode and of all."""

ARM = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.5" stiffness="3"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.04" mass="2"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
      </body>
    </body>
    <body name="ball" pos="1 0 1"><freejoint name="free"/><geom name="ball" size="0.1"/></body>
  </worldbody>
  <contact><pair name="touch" geom1="floor" geom2="lower"/></contact>
  <actuator>
    <position name="servo" joint="shoulder" kp="20" kv="2" forcerange="-5 5"/>
    <velocity name="brake" joint="elbow" kv="3"/>
    <motor name="motor" joint="elbow" gear="7"/>
  </actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def arm():
    return mujoco.MjModel.from_xml_string(ARM)


def drawn(model, *varys, worlds=2, episode=1, seed=0, offset=0, mask=None):
    """Returns what the fields are in all worlds, ``fields(name)``, of a draw in plain torch."""
    variation = Variation(varys, model, torch.device("cpu"))
    arrays = {
        "numbers": torch.zeros(worlds, variation.varied.count),
        "seed": torch.tensor([seed]),
        "world": torch.arange(offset, offset + worlds),
        "episode": torch.full((worlds,), episode, dtype=torch.int32),
        "mask": torch.ones(worlds, dtype=torch.bool) if mask is None else mask,
    }
    variation.vary(arrays)
    return lambda name: variation.field(name, arrays["numbers"])


OPTIONS = {**COARSE, "seed": 3, "device": "cpu", "world_offset": 0, "episode_length": 6}


def made(*varys, num_envs=4, engine="mujoco_warp", **options):
    return loco.make("walker_walk", num_envs, engine=engine, randomize=varys, **{**OPTIONS, **options})


@pytest.fixture
def varied(shared):
    """An environment with VARYS, ``varied(engine, device)``, which other tests use too."""

    def get(engine="mujoco_warp", device="cpu"):
        return shared("walker_walk", 4, engine=engine, randomize=VARYS, **{**OPTIONS, "device": device})

    return get


# What is drawn.


@for_each(("log", "half"), [(False, 0.55), (True, 0.1**0.5)])
def test_draws_are_uniform_between_low_and_high(arm, log, half):
    factors = drawn(arm, loco.Vary("body_mass", 0.1, 1.0, of="upper", log=log), worlds=4000)("body_mass")[:, 1] / 2
    assert (factors.min() >= 0.1, factors.max() <= 1.0) == (True, True)
    assert (factors < half).float().mean() == pytest.approx(0.5, abs=0.03)
    assert (factors.min() < 0.102, factors.max() > 0.99) == (True, True)
    assert len(factors.unique()) > 3900


def test_one_draw_for_all_or_one_for_each(arm):
    scales = (
        loco.Vary("body_mass", 0.5, 1.5, of="upper|lower"),
        loco.Vary("dof_armature", 0, 1, how="add", shared=False),
    )
    mass = drawn(arm, scales[0], worlds=4000)("body_mass")[:, 1:3] / torch.tensor([2.0, 1.0])
    torch.testing.assert_close(mass[:, 0], mass[:, 1])
    armature = drawn(arm, scales[1], worlds=4000)("dof_armature")
    assert (armature[:, 2:] == 0).all()  # free joints are left out unless they are named
    assert abs(torch.corrcoef(armature[:, :2].T)[0, 1]) < 0.05


def test_a_number_is_a_function_of_seed_world_and_episode(arm):
    friction, mass = loco.Vary("geom_friction", 0.5, 1.0), loco.Vary("body_mass", 0.5, 1.0)
    fixed = loco.Vary("body_mass", 0.5, 1.0, once=True)
    many = drawn(arm, mass, worlds=3000)("body_mass")
    assert torch.equal(drawn(arm, mass, worlds=3)("body_mass"), many[:3])
    assert torch.equal(drawn(arm, mass, worlds=3, offset=2000)("body_mass"), many[2000:2003])
    assert torch.equal(drawn(arm, friction, mass, worlds=3)("body_mass"), many[:3])  # whatever else varies
    for other in ({"episode": 2}, {"seed": 1}, {"offset": 1}):
        assert not torch.isclose(drawn(arm, mass, **other)("body_mass"), many[:2])[:, 1].any(), other
    once = drawn(arm, fixed, worlds=3)("body_mass")
    assert torch.equal(drawn(arm, fixed, worlds=3, episode=2)("body_mass"), once)
    assert not torch.isclose(drawn(arm, fixed, worlds=3, seed=1)("body_mass"), once)[:, 1].any()


def test_only_worlds_of_the_mask_draw(arm):
    mass = drawn(arm, loco.Vary("body_mass", 1.0, 2.0, of="upper"), worlds=3, mask=torch.tensor([True, False, True]))
    assert mass("body_mass")[:, 1].ge(2.0).tolist() == [True, False, True]


# What becomes of it.


def exactly(field, value, **options):
    return loco.Vary(field, value, value, **options)


ELEMENTS = [
    ([exactly("geom_friction", 0.5)], "geom_friction", "ball", [0.5, 0.0025, 0.00005]),
    ([exactly("geom_friction", 0.7, how="set")], "geom_friction", "ball", [0.7, 0.005, 0.0001]),
    ([exactly("geom_friction", (0.5, 1, 2))], "geom_friction", "ball", [0.5, 0.005, 0.0002]),
    ([exactly("geom_friction", 2, component=1)], "geom_friction", "ball", [1, 0.01, 0.0001]),
    ([exactly("pair_friction", 0.7, how="set")], "pair_friction", "touch", [0.7, 0.7, 0.005, 0.0001, 0.0001]),
    ([exactly("body_ipos", (0, 0.1, 0.2), how="add")], "body_ipos", "lower", [0, 0.1, 0.05]),
    ([exactly("actuator_gear", 2)], "actuator_gear", "motor", [14, 0, 0, 0, 0, 0]),
    ([exactly("actuator_gear", 2, how="set")], "actuator_gear", "motor", [2, 0, 0, 0, 0, 0]),
    ([exactly("actuator_forcerange", (-3, 4), how="set")], "actuator_forcerange", "servo", [-3, 4]),
    ([exactly("kp", 0.5)], "actuator_gainprm", "servo", [10, *[0] * 9]),
    ([exactly("kp", 0.5)], "actuator_biasprm", "servo", [0, -10, -2, *[0] * 7]),
    ([exactly("kp", 5, how="add")], "actuator_biasprm", "servo", [0, -25, -2, *[0] * 7]),
    ([exactly("kv", 5, how="set")], "actuator_biasprm", "servo", [0, -20, -5, *[0] * 7]),
    ([exactly("kv", 5, how="set")], "actuator_gainprm", "brake", [5, *[0] * 9]),
    ([exactly("kv", 5, how="set")], "actuator_biasprm", "brake", [0, 0, -5, *[0] * 7]),
    ([exactly("body_mass", 2), exactly("body_mass", 1, how="add", of="upper")], "body_mass", "upper", 5),
    ([exactly("body_mass", 1, how="add", of="upper"), exactly("body_mass", 2)], "body_mass", "upper", 6),
    ([exactly("body_mass", 2), exactly("body_mass", 1, how="add", of="upper")], "body_mass", "lower", 2),
    ([exactly("body_mass", 2, of=["ball", "lower"])], "body_mass", "lower", 2),
]


def test_numbers_of_an_element(arm):
    """Of several Varys each changes what the one before it has made."""
    for varys, field, of, expected in ELEMENTS:
        found = drawn(arm, *varys)(field)[1, getattr(arm, field.split("_")[0])(of).id]
        torch.testing.assert_close(found, torch.tensor(expected).float(), msg=f"{varys}: {found}, not {expected}")


def test_gravity_and_what_is_zero(arm):
    gravity = Variation([loco.Vary("gravity", 0.5, 1.0)], arm, torch.device("cpu"))
    assert gravity.varied.places["gravity"].tolist() == [2]  # the zeros stay constants
    x, y, z = drawn(arm, exactly("gravity", (0.1, 0.0, -5.0), how="set"))("gravity")[0].tolist()
    assert (round(x, 6), y, z) == (0.1, 0.0, -5.0)


IMPOSSIBLE = [
    ({"field": "body_mas"}, "unknown field 'body_mas', did you mean 'body_mass'.*choose one of geom_friction"),
    ({"field": "body_mass", "how": "times"}, "unknown how 'times'.*scale, add, set"),
    ({"field": "body_mass", "low": 2.0}, "low must not be greater"),
    ({"field": "body_mass", "low": 0.0, "log": True}, "needs low greater than 0"),
    ({"field": "geom_friction", "low": (1, 1)}, "or have 3, one for each"),
    ({"field": "geom_friction", "component": 3}, r"component must lie in \[0, 3\)"),
    ({"field": "actuator_biasprm", "how": "add"}, "say which of the 10 numbers"),
    ({"field": "gravity", "of": "upper"}, "takes no of="),
    ({"field": "body_mass", "of": []}, "of must be a name, names or a regular expression"),
    ({"field": "body_mass", "of": ["upper", 1]}, "of must be a name, names or a regular expression"),
]


def test_a_vary_that_cannot_be():
    for vary, message in IMPOSSIBLE:
        with pytest.raises((ValueError, TypeError), match=message):
            loco.Vary(**{"low": 0.5, "high": 1.5, **vary})


UNFIT = [
    ({"field": "body_mass", "of": "uper"}, "no body 'uper', did you mean 'upper'.*it has world, upper, lower"),
    ({"field": "body_mass", "of": "world"}, "the world has neither mass.*those that can vary are upper, lower"),
    ({"field": "body_mass", "low": -2.0, "how": "add", "of": "upper"}, "mass of upper could become 0, .* positive"),
    ({"field": "body_inertia", "low": (0.2, 0.2, 1), "high": (1, 1, 1)}, "inertia of upper.*sum of the other two"),
    ({"field": "dof_damping", "low": -0.6, "how": "add"}, "damping of shoulder could become -0.1, .* not be neg"),
    ({"field": "dof_armature"}, "dof_armature is 0 in the model, so nothing is scaled: use how='add' or 'set'"),
    (
        {"field": "actuator_forcerange", "of": "motor"},
        "no force range.*motor; those that can vary are servo",
    ),
    ({"field": "actuator_forcerange", "how": "set"}, "forcerange of servo.*lower limit below the upper"),
    ({"field": "kp", "of": ".*"}, "kp is of position actuators: brake, motor; those that can vary are servo"),
    ({"field": "kv", "low": -4.0, "how": "add", "of": "brake"}, "kv of brake could become"),
]


def test_a_vary_that_the_model_cannot_have(arm):
    for vary, message in UNFIT:
        with pytest.raises(ValueError, match=message):
            Variation([loco.Vary(**{"low": 0.5, "high": 1.5, **vary})], arm, torch.device("cpu"))


def test_inertias_that_a_body_may_have():
    """Of a flat body the greatest is the sum of the other two; a body without any may stay without."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="plate"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 2"/>'
        '<body name="frame"/></body></worldbody></mujoco>'
    )
    plate, device = {"of": "plate"}, torch.device("cpu")
    for vary in (
        loco.Vary("body_inertia", 0.5, 1.5, **plate),
        exactly("body_inertia", (3, 4, 7), how="set", **plate),
        exactly("body_inertia", 0, how="add", of="frame"),
    ):
        Variation([vary], model, device)
    for vary in (
        loco.Vary("body_inertia", (0.5, 1, 1), (1.5, 1, 1), **plate),
        exactly("body_inertia", (3, 4, 7.01), how="set", **plate),
        exactly("body_inertia", (0, 1, 1), how="set", **plate),
        exactly("body_inertia", -1.5, how="add", **plate),
    ):
        with pytest.raises(ValueError, match="inertia of plate could become"):
            Variation([vary], model, device)


def test_several_draws_are_checked_together(arm):
    """Each alone is possible."""
    varys = [exactly("body_mass", -1.5, how="add", of="upper"), loco.Vary("body_mass", 0.5, 1.0)]
    for alone in varys:
        Variation([alone], arm, torch.device("cpu"))
    Variation(varys, arm, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"could become -0\.5"):
        Variation(varys[::-1], arm, torch.device("cpu"))


def test_it_is_pickled_and_written_as_json(varied):
    for vary in VARYS:
        assert pickle.loads(pickle.dumps(vary)) == vary
        assert eval(repr(vary), {"Vary": loco.Vary}) == vary
    env = varied()
    assert repr(VARYS[0]) in repr(env)
    assert [loco.Vary(**vary) for vary in json.loads(json.dumps(env.settings()))["randomize"]] == list(VARYS)


# Of an environment.


def test_each_reset_draws_in_its_worlds_alone(engine, device):
    env = made(*VARYS, engine=engine, device=device)
    friction = env.model_value("geom_friction")
    assert (friction == torch.tensor(env.mj_model.geom_friction, device=env.device).float()).all()  # nothing drawn yet
    td = env.reset()
    assert env.world._vary.kind == "kernel"
    first = env.get_state()["model"]
    assert len(first["geom_friction"][:, 0].unique()) == 4
    td["_reset"] = torch.tensor([[False], [True], [False], [True]], device=env.device)
    env.reset(td)
    second = env.get_state()["model"]
    for name, numbers in first.items():
        same = (second[name] == numbers).all(-1).tolist()
        assert same == [True, name == "body_ipos", True, name == "body_ipos"], name
    action = env.action_spec.zero()
    env.step(td.exclude("_reset").set("action", action))
    assert (env.get_state()["model"] == second).all()  # a step changes nothing


def test_numbers_do_not_depend_on_batch_engine_or_rank(varied, device):
    whole = made(*VARYS, num_envs=3000, engine="compiled", device=device)
    whole.reset()
    expected = whole.get_state()["model"]
    last = made(*VARYS, num_envs=4, engine="compiled", device=device, world_offset=2996)
    plain = made(*VARYS, engine="compiled", device=device, compile_hooks=False)
    for env, worlds in ((varied("mujoco_warp", device), expected[:4]), (last, expected[2996:])):
        env.reset()
        assert (env.get_state()["model"] == worlds).all()
    plain.reset()
    torch.testing.assert_close(plain.get_state()["model"].to_dict(), expected[:4].to_dict())


@for_each("transformed", [False, True])
def test_a_state_holds_them(varied, engine, device, actions, transformed):
    env = base = varied(engine, device)
    if transformed:
        env = TransformedEnv(env, Compose(RewardSum()))
    moves, td = actions(base, 8), env.reset()
    state = base.get_state()

    def walk(td):
        rewards = []
        for action in moves:
            current, td = env.step_and_maybe_reset(td.set("action", action))
            rewards.append(current["next", "reward"])
        return torch.stack(rewards), base.get_state()["model"]

    first, drawn = walk(td)
    assert not (drawn["body_mass"] == state["model", "body_mass"]).any()  # a new episode
    second, again = walk(env.reset(state.clone(), set_state=True))
    torch.testing.assert_close(first, second, rtol=0, atol=0 if engine == "compiled" else 1e-4)
    assert (drawn == again).all()


def test_what_a_state_does_to_them(tmp_path, varied):
    env = varied()
    env.reset()
    state = env.get_state()
    torch.save(state, tmp_path / "state.pt")
    assert (torch.load(tmp_path / "state.pt") == state).all()
    env.reset(state.branch(2), set_state=True)
    assert (env.model_value("body_mass") == env.model_value("body_mass")[0]).all()
    assert torch.equal(env.get_state()["model", "body_mass"], state["model", "body_mass"][[2] * 4])
    kept = env.get_state()["model"]
    env.reset(state.select("qpos", "qvel"), set_state=True)
    assert (env.get_state()["model"] == kept).all()
    with pytest.raises(ValueError, match="the state has model 'geom_friction', randomize has none"):
        made().reset(state, set_state=True)
    with pytest.raises(ValueError, match=r"body_mass.*must have shape"):
        env.reset(loco.State({**state, "model": {"body_mass": torch.ones(4, 2)}}, batch_size=[4]), set_state=True)
    light = loco.State({"qpos": state["qpos"], "qvel": state["qvel"]}, batch_size=[4])
    light["model", "body_mass"] = torch.tensor([[1.0], [1.0], [-2.0], [1.0]])
    before = env.get_state()
    with pytest.raises(ValueError, match=r"the state's body_mass of \w+ is -2, but it must be positive"):
        env.reset(light, set_state=True)
    assert (env.get_state() == before).all()


class Seen(loco.WalkerWalk):
    """Observes the velocity of its center of mass, which depends on masses and where they are, and numbers."""

    randomize = [
        loco.Vary("body_ipos", -0.1, 0.1, of="torso", how="add"),
        loco.Vary("body_mass", 0.5, 2.0, shared=False),
        loco.Vary("actuator_gear", 0.8, 1.2, shared=False),
    ]

    def observation(self, s):
        numbers = s.model("actuator_gear")[:, :, 0], s.model("body_mass")[:, 1:3], s.model("gravity")
        return {"observation": s.sensor("torso_velocity"), "privileged": torch.cat(numbers, dim=-1)}

    def begin(self, s):
        return {"qvel": torch.zeros_like(s.qvel) + s.model("body_mass")[:, 1:2]}


@pytest.fixture
def seen(engine, device):
    return Seen(5, device, 0, engine=engine, world_offset=0, **COARSE)


def test_hooks_see_them_and_poses_and_sensors_follow_a_state_with_others(seen):
    env = seen
    for observe in (env.reset, env.reset, lambda: env.rollout(2)["next"][:, -1]):
        td = observe()
        gear, mass, gravity = env.model_value("actuator_gear"), env.model_value("body_mass"), env.mj_model.opt.gravity
        assert torch.equal(td["privileged"][:, :6], gear[:, :, 0])
        assert torch.equal(td["privileged"][:, 6:8], mass[:, 1:3])
        assert (td["privileged"][:, 8:].cpu().numpy() == gravity.astype(np.float32)).all()
        if observe == env.reset:
            assert torch.equal(env.get_state()["qvel"], mass[:, 1:2].expand(5, 9))
    assert len(gear[:, :, 0].unique()) == 30
    assert env.world._begin.kind == env.world._observe_begun.kind == "kernel"
    expected, first = env.rollout(3)["next", "observation"][:, -1], env.get_state()
    env.reset()
    torch.testing.assert_close(env.reset(first, set_state=True)["observation"], expected, rtol=0, atol=1e-4)
    env.reset()
    other = env.reset(first.exclude("model"), set_state=True)["observation"]
    assert (other - expected).abs().amax(-1).min() > 1e-3


def test_state_dict_of_another_process(varied):
    """As training resumes: the same numbers, and the same draws from there on."""
    env, other = varied(), made(*VARYS, seed=9)
    env.reset()
    other.load_state_dict(env.state_dict())
    for _ in range(2):
        assert (other.get_state() == env.get_state()).all()
        env.reset()
        other.reset()


def test_without_a_batch_dimension():
    env = made(*VARYS, num_envs=None)
    env.reset()
    state = env.get_state()
    assert env.model_value("geom_friction").shape == env.mj_model.geom_friction.shape
    env.reset()
    env.reset(state, set_state=True)
    assert (env.get_state() == state).all()


def test_the_argument_replaces_the_class():
    for env, different in ((Seen(2, "cpu", randomize=[], **COARSE), 1), (Seen(2, "cpu", **COARSE), 2)):
        env.reset()
        assert len(env.model_value("body_mass")[:, 1].unique()) == different
    with pytest.raises(TypeError, match=r"randomize must be a list of torchrl_loco\.Vary"):
        Seen(2, "cpu", randomize=loco.Vary("body_mass", 1, 2))
    with pytest.raises(TypeError, match=r"Odd\.randomize must be a list"):
        type("Odd", (Seen,), {"randomize": ["body_mass"]})(2, "cpu")


def test_fields_that_do_not_vary(varied):
    env = varied()
    env.reset()
    values = env.model_value("jnt_range")
    assert (values.numpy() == env.mj_model.jnt_range.astype(np.float32)).all()
    assert values.shape == (4, *env.mj_model.jnt_range.shape)
    assert env.model_value("gravity")[3].tolist() == pytest.approx(list(env.mj_model.opt.gravity))
    env.model_value("body_mass").zero_()  # a copy
    assert env.model_value("body_mass")[:, 1].all()
    for name in ("body_mas", "nv"):
        with pytest.raises(AttributeError, match=f"MjModel has no array '{name}'"):
            env.model_value(name)


def test_nothing_is_launched_without(actions):
    env = made()
    assert (env.variation, env.sim.numbers.shape) == (None, (4, 0))
    assert env.world._vary is env.world._rest
    assert "model" not in env.get_state()


FAR = loco.Vary("body_mass", 0.3, 3.0), loco.Vary("actuator_gear", 0.3, 3.0, shared=False)
"""Numbers far from the model's, so that a mistake is seen."""


def test_c_mujoco_steps_the_model_of_a_world(engine, actions):
    env = made(*FAR, engine=engine, protocol="dm_control")
    td = env.reset()
    for action in actions(env, 5):
        state = env.get_state()
        td = env.step(td.set("action", action))["next"].exclude("reward")
        errors = {True: [], False: []}
        for world in range(4):
            for edited, found in errors.items():
                model = env.mujoco_model(world) if edited else env.mj_model
                data = mujoco.MjData(model)
                data.qpos[:], data.qvel[:] = state["qpos"][world], state["qvel"][world]
                data.ctrl[:] = env.sim.ctrl[world]
                mujoco.mj_step(model, data, env.config.substeps)
                found.append(np.abs(data.qvel - env.sim.qvel[world].numpy()).max())
    assert np.median(errors[True]) < 1e-3
    assert np.median(errors[False]) > 0.1
    with pytest.raises(IndexError, match="there is no world 4"):
        env.mujoco_model(4)


@pytest.mark.slow
def test_a_nan_dump_replays_them(tmp_path, actions):
    file = tmp_path / "dump.safetensors"
    env = made(*FAR, engine="compiled", protocol="dm_control", nan_dump=file)
    td = env.reset()
    for action in actions(env, 4):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    numbers, repaired = env.get_state()["model", "body_mass"][2], action[2, 3].item()
    state = env.get_state()
    expected = env.step(td.set("action", action))["next"].exclude("reward")
    expected = env.sim.qvel[2].clone()
    action[2, 3] = torch.nan
    td = env.reset(state, set_state=True)
    env.step_and_maybe_reset(td.set("action", action))  # the world draws other numbers at once
    assert not torch.equal(env.get_state()["model", "body_mass"][2], numbers)
    with pytest.warns(loco.NonFiniteWarning):
        env.close()
    dump = nan_dump.load(file)
    assert torch.equal(dump.tensors["model.body_mass"], numbers)
    assert "with numbers of its own of actuator_gear, body_mass" in list(nan_dump.describe(dump, "cpu"))
    dump.tensors["action"][3] = repaired
    warp, c = nan_dump.warp_trace(dump, "cpu"), nan_dump.mujoco_trace(dump)
    np.testing.assert_allclose(warp[-1, env.mj_model.nq :], expected, atol=1e-5)
    np.testing.assert_allclose(warp, c, atol=1e-3)


class HeavyOrLight(loco.WalkerWalk):
    randomize = [loco.Vary("body_mass", 0.3, 3.0, shared=False)]


def test_of_a_class_the_doctor_and_evaluations_know_them(varied, device):
    _, error, _ = doctor.self_test(HeavyOrLight, device)
    assert error < doctor.TOLERANCE
    check_env_specs(HeavyOrLight(2, device))
    env = varied(device=device)
    config = PPOConfig("walker_walk", num_envs=4, minibatch_size=8, device=device)
    assert Environments(config, env).evaluation(2, seed=7).randomize == VARYS
    run = PPOConfig(f"{__name__}:HeavyOrLight", num_envs=4, minibatch_size=8, device=device)
    assert Environments(run).evaluation(2, seed=7).randomize == tuple(HeavyOrLight.randomize)


def test_as_the_design_has_it():
    env = loco.make(
        "humanoid_walk",
        num_envs=8,
        device="cpu",
        seed=0,
        randomize=[
            loco.Vary("geom_friction", 0.5, 1.25, of="floor"),
            loco.Vary("body_mass", 0.8, 1.2, of="torso"),
            loco.Vary("actuator_gear", 0.9, 1.1, shared=False),
        ],
    )
    assert env.rollout(3)["next", "reward"].isfinite().all()
    gear = env.model_value("actuator_gear")[:, :, 0] / torch.tensor(env.mj_model.actuator_gear[:, 0]).float()
    assert len(gear.unique()) == 8 * 21
    assert (gear.min() >= 0.9, gear.max() <= 1.1001) == (True, True)
    stiff = loco.Go1Velocity(3, "cpu", 0, play=True, randomize=[loco.Vary("kp", 0.5, 2.0)])
    stiff.step(stiff.reset().set("action", torch.ones(3, 12)))
    assert len(stiff.model_value("actuator_gainprm")[:, 0, 0].unique()) == 3
    assert len(stiff.sim.ctrl[:, 0].unique()) == 1  # an action asks for the same position all the same
