"""Tables that worlds look up, what they share, numbers for the log, and hooks on top of Warp functions."""

import itertools

import pytest
import torch
from for_each import for_each
from hook_tasks import Still
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco import HopperHop, LocoEnv, State, WalkerWalk
from torchrl_loco.envs.fixed_order import running_sum
from torchrl_loco.envs.tables import lookup

FRAMES = torch.arange(90_000.0).view(30_000, 3)


class Looks(WalkerWalk):
    """Looks up numbers of a long table, of a short one through another, and through what is shared."""

    constants = {"frames": FRAMES, "ids": [3, 5], "order": torch.arange(29_999, -1, -1), "small": [1.0, 2.0, 3.0]}
    memory = {"frame": torch.int32, "pair": ((2,), torch.int64), "fell": torch.bool}
    shared = {"rate": (4,), "falls": torch.int64, "upto": 4}

    def reward(self, s):
        return super().reward(s) + s.small[s.frame % 3]

    def terminated(self, s):
        return s.qpos[:, 0] < -0.3

    def metrics(self, s):
        return {"height": s.qpos[:, 0], "fell": s.terminated.float()}

    def events(self, s):
        return {"frame": s.frame + 1, "fell": s.terminated, "pair": torch.stack([s.frame.long(), s.env_index], dim=-1)}

    def adapt(self, s):
        rate = 0.9 * s.rate + torch.zeros_like(s.rate).index_add(0, s.frame % 4, s.qvel[:, 0].abs() + 0.1)
        return {"rate": rate, "falls": s.falls + s.terminated.sum(), "upto": rate.cumsum(0) / rate.sum()}

    def observation(self, s):
        place = torch.searchsorted(s.upto, s.uniform(0.0, 0.9)).clamp(max=3)
        looked_up = [
            s.frames[s.frame, 1:],
            s.frames[s.order[s.frame]][:, :1],
            s.frames[s.falls, :1].expand(s.num_envs, 1),
        ]
        return torch.cat([super().observation(s), *looked_up, s.rate[place, None], s.qpos[:, s.ids]], dim=-1)

    def begin(self, s):
        return {**super().begin(s), "frame": (s.env_index * 7) % 100}


def played(env, actions, td=None):
    """Returns what worlds return under actions, in a stack along the time."""
    td, found = env.reset() if td is None else td, []
    for action in actions.unbind(0):
        after = env.step(td.set("action", action))["next"]
        found.append(after.clone())
        td = env.maybe_reset(after.exclude("reward"))
    return torch.stack(found, 1)


ACTIONS = 2 * torch.rand(80, 5, 6, generator=torch.Generator().manual_seed(0)) - 1


def test_a_step_of_some_worlds_adapts_nothing():
    env = Looks(2, "cpu", 0)
    td = env.reset()
    for part in ([True, False], [True, True]):
        before = {name: values.clone() for name, values in env.world.shared.items()}
        td = env.step(env.rand_action(td.exclude("next")).set("_step", torch.tensor(part).unsqueeze(-1)))
        stays = [torch.equal(values, before[name]) for name, values in env.world.shared.items()]
        assert all(stays) == (not all(part))


class Averages(WalkerWalk):
    shared = {"mean": ()}

    def adapt(self, s):
        return {"mean": 0.9 * s.mean + 0.1 * s.qvel[:, 0].mean()}

    def reward(self, s):
        return s.qvel[:, 0] - s.mean


def test_a_world_that_is_not_finite_leaves_what_worlds_share():
    env = Averages(3, "cpu", 0)
    td = env.reset()
    env.sim.qvel[1] = torch.inf
    for ended in ([False, True, False], [False] * 3):
        step, td = env.step_and_maybe_reset(td.set("action", torch.zeros(3, 6)))
        assert step["next", "terminated"].flatten().tolist() == ended
    assert env.world.shared["mean"].isfinite()


def test_hooks_with_tables_are_kernels_and_equal_plain_torch():
    env, plain = (Looks(5, "cpu", 0, metrics=True, compile_hooks=kernels) for kernels in (True, False))
    assert {part.kind for part in (env.world._judge, env.world._observe, env.world._begin)} == {"kernel"}
    ours, theirs = played(env, ACTIONS), played(plain, ACTIONS)
    for key in ("observation", "reward", ("metrics", "height"), "done"):
        assert torch.equal(ours[key], theirs[key])
    assert ours["terminated"].any()
    assert torch.equal(ours["metrics", "fell"], ours["terminated"].float())
    for name, values in env.world.shared.items():
        assert torch.equal(values, plain.world.shared[name])
    assert env.world.shared["falls"] == ours["terminated"].sum()
    assert env.health()["total", "index_error"] == 0
    walker = WalkerWalk(5, "cpu", 0)
    alike = played(walker, ACTIONS[:5])  # until the first of ours ends
    assert not ours["done"][:, :5].any()
    assert torch.equal(ours["observation"][:, :5, :24], alike["observation"])
    small = torch.tensor([1.0, 2.0, 3.0])[(torch.arange(5)[:, None] * 7 + torch.arange(5)) % 3]
    assert torch.equal(ours["reward"][:, :5, 0], alike["reward"][..., 0] + small)


@for_each("kernels", [True, False])
def test_an_index_out_of_range_gives_nan_and_is_counted(kernels):
    env = Looks(5, "cpu", 0, compile_hooks=kernels)
    env.reset()
    state = env.get_state()
    state["memory", "frame"] = torch.tensor([5, 29_999, 40_000, -30_001, -3], dtype=torch.int32)
    after = played(env, ACTIONS[:1], env.reset(state, set_state=True))[:, 0]
    assert env.health()["worlds", "index_error"].tolist() == [0, 1, 1, 1, 0]
    assert env.health()["worlds", "non_finite"].tolist() == [0, 1, 1, 1, 0]
    assert after["terminated"].flatten().tolist() == [False, True, True, True, False]
    assert not (after["observation"] * after["terminated"]).any()
    assert after["observation"][4, 24:26].tolist() == [3 * 29_998 + 1, 3 * 29_998 + 2]


def test_what_worlds_share_is_part_of_the_state():
    env = Looks(5, "cpu", 0)
    played(env, ACTIONS[:20])
    state = env.get_state()
    assert state["shared", "rate"].shape == (5, 4)
    assert state["memory", "frame"].dtype == torch.int32
    first = played(env, ACTIONS[20:], env.reset(state.clone(), set_state=True))
    assert torch.equal(first["observation"], played(env, ACTIONS[20:], env.reset(state, set_state=True))["observation"])
    env.load_state_dict(saved := env.state_dict())
    assert torch.equal(env.get_state()["shared", "rate"], saved["_extra_state"]["worlds"]["shared"]["rate"])
    state["shared", "falls"] = torch.arange(5)
    with pytest.raises(ValueError, match="must be the same in all worlds"):
        env.reset(state, set_state=True)
    state["shared", "falls"].zero_()
    state["memory", "frame"] = torch.zeros(5)
    with pytest.raises(ValueError, match=r"must be of torch.int32, got torch.float32: it is of an earlier version"):
        env.reset(state, set_state=True)


@for_each("shape", [(1,), (2,), (37,), (3, 64), (5, 1)])
def test_running_sums_of_a_fixed_order(shape):
    """Which stand for ``cumsum`` on CUDA, where its order varies, within ``adapt``."""
    values = torch.rand(shape, dtype=torch.float64)
    for dim in range(len(shape)):
        torch.testing.assert_close(running_sum(values, dim), values.cumsum(dim))


@pytest.mark.gpu
def test_what_worlds_share_repeats_on_cuda():
    runs = []
    for _ in range(2):
        env = Looks(4096, "cuda", 0)
        played(env, 2 * torch.rand(20, 4096, 6, generator=torch.Generator().manual_seed(0)).cuda() - 1)
        runs.append({name: values.clone() for name, values in env.world.shared.items()})
    assert all(torch.equal(values, runs[1][name]) for name, values in runs[0].items())
    assert runs[0]["upto"][-1].item() == pytest.approx(1.0)


class Levels(HopperHop):
    """Starts where the level of the last episode was left, and counts all steps."""

    memory = {"level": ()}
    shared = {"steps": ()}

    def events(self, s):
        return {"level": s.level + 1.0}

    def adapt(self, s):
        return {"steps": s.steps + 1.0}

    def begin(self, s):
        return {**super().begin(s), "level": s.level}

    def reward(self, s):
        return {"hop": super().reward(s), "level": s.level, "steps": s.steps.expand(s.num_envs)}


class Plateau(Levels):
    """Its level is clamped, so that a small one does not show at the start."""

    def begin(self, s):
        return {"level": (s.level + 0.0).clamp(2.0, 50.0)}


def test_a_level_that_is_clamped_is_carried_on_too():
    assert Plateau(1, "cpu", 0).hooks.carried == ("level",)


class NextLevel(Levels):
    """Chooses its next level at each step, in an entry of its own, from how far it came."""

    memory = {"level": (), "next_level": (), "way": (), "best": ()}

    def update(self, s):
        return {"way": s.way + 2.0}

    def events(self, s):
        return {"next_level": s.level + s.way}

    def begin(self, s):
        return {"level": s.next_level, "best": torch.maximum(s.best, s.next_level)}


def climbed(s):
    return torch.where(s.way > 2.0, s.level + 1.0, s.level)


PLACES = torch.tensor([0.0, 8.0, 16.0])
BEGINNINGS = {  # what is in memory, what begin() makes of it, and what a stage carries on
    "an entry that begins from itself stands for what else it is made from, which a cut-off episode falsifies": (
        *({"level": (), "way": (), "place": ()}, lambda s: {"level": climbed(s), "place": PLACES[climbed(s).long()]}),
        ("level",),
    ),
    "successes in a row, which a failure ends, do not show at zero": (
        *({"way": (), "wins": ()}, lambda s: {"wins": torch.where(s.way > 2.0, s.wins + 1.0, 0.0)}),
        ("wins",),
    ),
    "an index of a table of poses may be no more than that": (
        {"level": torch.int64, "which": torch.int64},
        lambda s: {"level": s.uniform(0.0, 2.0).long(), "qpos": s.home + PLACES[:2, None].expand(2, 7)[s.which]},
        (),
    ),
    "other entries after another level": (
        *({"level": ()}, lambda s: {"level": s.level} if (s.level == 0.0).all() else {}),
        ("level",),
    ),
}


@for_each("name", list(BEGINNINGS))
def test_what_is_carried_on(name):
    memory, begin, carried = BEGINNINGS[name]
    entries = {"memory": memory, "begin": lambda self, s: begin(s)}
    assert type("Begun", (HopperHop,), entries)(1, "cpu", 0).hooks.carried == carried


def test_a_level_that_another_entry_becomes_is_carried_on():
    env = NextLevel(2, "cpu", 0)
    assert env.hooks.carried == ("next_level", "best")
    env.rollout(3, Still(env))
    env.close()
    env.reset()
    assert env.get_state()["memory", "level"].tolist() == [6.0, 6.0]


def test_a_closed_environment_goes_on_at_its_stage():
    env = Levels(2, "cpu", 0)
    env.rollout(4, Still(env))
    env.close()
    env.reset()
    assert env.get_stage() == {"shared": {"steps": 4.0}, "memory": {"level": [4.0, 4.0]}}


def test_each_world_goes_on_at_its_own_level():
    """Also of more worlds than a stage keeps."""
    closed, open_ = Levels(70, "cpu", 0), Levels(70, "cpu", 0)
    for env in (closed, open_):
        env.set_stage({"memory": {"level": [float(i) for i in range(70)]}})
    closed.close()
    open_.reset()
    closed.reset()
    levels = [env.get_state()["memory", "level"] for env in (closed, open_)]
    assert levels[1].max() - levels[1].min() == 69.0
    assert torch.equal(*levels)


def test_what_is_shared_may_begin_with_numbers():
    class Begun(Levels):
        shared = {"steps": torch.tensor(5.0)}

    env = Begun(2, "cpu", 0, reward_terms=True)
    terms = env.rollout(2, Still(env))["next", "reward_terms", "steps"]
    assert terms[0].flatten().tolist() == [5.0, 6.0]
    assert Begun.shared["steps"] == 5.0


def test_entries_may_be_called_histories():
    class Own(WalkerWalk):
        memory = {"pose_history": (2, 1), "count_history": torch.int64}

        def observation(self, s):
            return torch.cat([s.qpos, s.pose_history.flatten(1)], dim=-1)

    env = Own(2, "cpu", 0)
    env.reset()
    state = env.get_state()
    assert env.reset(state.clone(), set_state=True)["observation"].isfinite().all()
    by_hand = State({"qpos": state["qpos"], "qvel": state["qvel"]}, batch_size=[2])
    assert torch.equal(env.reset(by_hand, set_state=True)["observation"][:, -2:], torch.zeros(2, 2))


class Long(WalkerWalk):
    """Shares more numbers than are written out one by one, and looks rows and columns up."""

    constants = {"grid": torch.arange(24.0).view(2, 3, 4)}
    shared = {"big": 150_000}
    memory = {"i": torch.int64}

    def reward(self, s):
        return super().reward(s) + s.big[s.i * 10_000]

    def events(self, s):
        return {"i": (s.i + 1) % 2}

    def adapt(self, s):
        return {"big": s.big + 1.0}

    def observation(self, s):
        return torch.cat([s.grid[s.i, :, [3] * s.num_envs], s.qpos], dim=-1)


def test_what_is_shared_may_be_long_and_lists_are_indices():
    env = Long(3, "cpu", 0, reward_terms=True)
    assert env.world.kinds["reward"] == "kernel"
    td = env.rollout(3, Still(env), break_when_any_done=False)
    assert torch.equal(td["observation"][0, :, :3], Long.constants["grid"][[0, 1, 0], :, [3, 3, 3]])
    with pytest.raises(IndexError, match="takes numbers and slices, no masks"):
        type("Masked", (Long,), {"observation": lambda self, s: s.grid[s.i, s.qpos[:, 0] > 0]})(3, "cpu", 0)


def test_an_integer_chosen_beyond_the_end_shows_where_it_is_an_index():
    class Chooses(WalkerWalk):
        constants = {"table": [1.0, 2.0, 3.0]}
        memory = {"which": torch.int64, "ids": ((3,), torch.int64), "short": ((3,), torch.int32)}

        def events(self, s):
            return {"which": s.which + 1, "ids": s.ids % 3, "short": s.short % 3}

        def reward(self, s):
            chosen = s.ids.gather(1, s.which[:, None])[:, 0]
            return s.table[chosen] + s.table[s.short[torch.arange(s.num_envs), s.which].long()]

    env = Chooses(2, "cpu", 0)
    assert env.world._judge.kind == "kernel"
    td = env.reset()
    for beyond in (False, False, False, True):
        td = env.rand_step(td.exclude("next"))
        assert td["next", "terminated"].all() == beyond
        assert (env.health()["total", "index_error"] > 0) == beyond


class Forms(WalkerWalk):
    """Looks numbers up in every form that torch has for it."""

    constants = {
        "t1": torch.arange(7.0) ** 2,
        "t2": torch.linspace(0.0, 1.0, 350).view(70, 5),
        "t3": torch.arange(72.0).sin().view(4, 6, 3),
        "ints": torch.arange(70) * 7 % 6,
        "flags": torch.arange(9) % 3 > 0,
    }
    shared = {"u": (6,), "v": ((5, 3), torch.float32), "w": torch.int64}
    memory = {"i": torch.int64, "j": torch.int32, "k": ((2,), torch.int64)}

    def events(self, s):
        k = torch.stack([s.i.abs() % 4, (2 * s.j.long()) % 6], dim=-1)
        return {"i": (3 * s.i + 1) % 7 - 3, "j": (s.j + 1) % 5, "k": k}

    def adapt(self, s):
        return {"u": s.u + torch.arange(6.0) + 0.1, "v": s.v + torch.arange(15.0).view(5, 3), "w": s.w + 1}

    def observation(self, s):
        found = {
            "row": s.t2[s.i],
            "number": s.t2[s.i, 2],
            "part": s.t2[s.i, 1:4],
            "two": s.t2[s.i, s.j],
            "plane": s.t3[s.i % 4, s.j],
            "apart": s.t3[s.i % 4, :, s.j % 3],
            "last": s.t3[..., s.j % 3].movedim(-1, 0),
            "column": s.t2[:, 0][s.i],
            "later": s.t2[5:][s.j],
            "turned": s.t2.T[s.j],
            "several": s.t3[1][s.k],
            "pairs": s.t3[s.k[:, 0], s.k[:, 1]],
            "through": s.t2[s.ints[s.i.abs()]],
            "flag": s.flags[s.j].float(),
            "shared": s.v[s.j, s.i % 3],
            "all": s.u[s.w % 6].expand(s.num_envs),
            "more": s.t2[s.i, None],
            "computed": (2.0 * s.t2)[s.j] * s.t1[:5],
            "sums": s.t1.cumsum(0)[s.j],
            "selected": s.t3.index_select(0, s.j % 4),
            "left": torch.searchsorted(s.u, s.qpos[:, 0].contiguous()).float(),
            "right": torch.searchsorted(s.t1, 10.0 * s.qpos[:, :3].abs(), right=True).float(),
            "bins": torch.bucketize(s.qvel[:, :2].contiguous(), s.t1).float(),
        }
        return {"observation": found}


@for_each("num_envs", [4, 70])
def test_every_form_of_a_lookup_is_a_kernel(num_envs):
    env, plain = (Forms(num_envs, "cpu", 0, compile_hooks=kernels) for kernels in (True, False))
    assert env.world.kinds["observation"] == "kernel"
    actions = 2 * torch.rand(12, num_envs, 6, generator=torch.Generator().manual_seed(0)) - 1
    assert torch.equal(played(env, actions)["observation"], played(plain, actions)["observation"])
    assert env.health()["total", "index_error"] == 0


def test_noise_of_a_warp_functions_observation_is_refused():
    with pytest.raises(ValueError, match="has noise or history, but a Warp function observes"):
        type("Noisy", (WalkerWalk,), {"history": {"observation": 2}})(1, "cpu", 0)


def test_a_stage_is_where_episodes_go_on():
    env = Levels(3, "cpu", 0)
    assert env.hooks.carried == ("level",)
    env.rollout(4, Still(env))
    assert env.get_stage() == {"shared": {"steps": 4.0}, "memory": {"level": [4.0, 4.0, 4.0]}}
    other = Levels(5, "cpu", 1, reward_terms=True)
    other.set_stage({**env.get_stage(), "memory": {"level": [10.0, 20.0]}})
    after = other.rollout(1, Still(other))["next", "reward_terms"]
    assert after["level"].flatten().tolist() == [10.0, 20.0, 10.0, 20.0, 10.0]
    assert after["steps"].unique().tolist() == [4.0]
    with pytest.raises(ValueError, match="choose one of level"):
        other.set_stage({"memory": {"levels": [1.0]}})
    with pytest.raises(ValueError, match=r"'level' of a stage must have rows of shape \(\)"):
        other.set_stage({"memory": {"level": [[1.0]]}})
    plain = torchrl_loco.make("hopper_hop", 1, "cpu")
    assert plain.get_stage() == {}
    with pytest.raises(ValueError, match="a stage with shared, of which the task has none"):
        plain.set_stage(env.get_stage())
    robot = torchrl_loco.make("go1_velocity", 2, "cpu", 0)  # it has rows that go on, and shares nothing
    robot.set_stage(robot.get_stage())


def test_built_in_starts_and_controls_can_be_built_on():
    class Shifted(WalkerWalk):
        def begin(self, s):
            rows = super().begin(s)
            return {**rows, "qvel": rows["qvel"] + 1.0}

        def control(self, s, action):
            return super().control(s, action)

    own, built_in = (cls(4, "cpu", 3) for cls in (Shifted, WalkerWalk))
    for env in (own, built_in):
        env.reset()
    states = [env.get_state() for env in (own, built_in)]
    assert torch.equal(states[0]["qpos"], states[1]["qpos"])
    assert torch.equal(states[0]["qvel"], states[1]["qvel"] + 1.0)
    action = TensorDict({"action": ACTIONS[0, :4]}, batch_size=[4])
    for env in (own, built_in):
        env.step(action.clone())
    torch.testing.assert_close(own.sim.ctrl, built_in.sim.ctrl)

    class Alone(LocoEnv):
        model = WalkerWalk.model

        def reward(self, s):
            return super().reward(s)

        def observation(self, s):
            return s.qpos

    with pytest.raises(NotImplementedError, match=r"no class above this one has reward\(self, s\)"):
        Alone(1, "cpu")


@for_each(
    ("entries", "error", "message"),
    [
        (
            {"memory": {"frame": torch.float64}},
            ValueError,
            r"must be of torch.float32, torch.int32.* got torch.float64",
        ),
        ({"shared": {"rate": (0,)}}, ValueError, r"shared\['rate'\] must have sizes of 1 or more"),
        ({"shared": {"qpos": 3}}, ValueError, "'qpos' is taken"),
        ({"memory": {"a": torch.zeros(3)}}, TypeError, r"memory\['a'\] must be a shape or a dtype, not an array"),
        ({"holds": {"fals": 0.5}}, ValueError, "unknown Wrong.holds 'fals', did you mean 'falls'"),
        ({"holds": {"delay": 2}}, TypeError, "delay must be two numbers, the least and the greatest, got 2"),
        ({"noise": 0.1}, TypeError, "Wrong.noise must be a dict by name, got 0.1"),
        ({"summed_over_ranks": "falls"}, TypeError, "must be a tuple of names, got 'falls'"),
        (
            {"memory": {"i": ()}, "update": lambda self, s: setattr(s, "i", s.time)},
            AttributeError,
            "s.i cannot be set: return {'i': ...} from update",
        ),
        ({"memory": {"rate": ()}, "shared": {"rate": ()}}, ValueError, "'rate' is taken"),
        ({"memory": {"a": ()}, "constants": {"a": [1.0]}}, ValueError, "'a' is taken"),
        (
            {"memory": {"i": ()}, "constants": {"text": "abc"}},
            TypeError,
            r"constants\['text'\] must be an array of numbers",
        ),
        (
            {"memory": {"i": torch.int64}, "update": lambda self, s: {"i": s.time}},
            TypeError,
            "must return i of torch.int64",
        ),
        (
            {"shared": {"r": 2}, "adapt": lambda self, s: {"r": s.time}},
            ValueError,
            r"adapt must return r of shape \(2,\)",
        ),
        ({"update": lambda self, s: {"i": s.terminated}}, ValueError, r"s.terminated is not known in update\(\)"),
        ({"metrics": lambda self, s: {"m": s.qpos}}, ValueError, r"metrics\['m'\] must return shape \(3,\)"),
        ({"events": lambda self, s: None}, TypeError, "events must return new rows by name, got None"),
        (
            {"constants": {"a": [1.0]}, "update": lambda self, s: s.a.add_(1.0) and {}},
            ValueError,
            "update writes to s.a",
        ),
    ],
)
def test_what_is_wrong_is_said(entries, error, message):
    with pytest.raises(error, match=message):
        type("Wrong", (WalkerWalk,), entries)(3, "cpu", 0, metrics=True)


def test_a_table_is_indexed_as_torch_does_it():
    """By numbers, slices, indices of worlds and such without dimensions, in all orders."""
    table, worlds, pairs = torch.randn(3, 4, 2), torch.tensor([2, -1, 0, 1, 1]), torch.tensor([[0, 1], [1, 0], [0, 0]])
    for index in itertools.product(
        [slice(None), slice(1, 2), None, 0, ..., torch.tensor(1), worlds % 2, pairs], repeat=3
    ):
        if sum(part is Ellipsis for part in index) > 1:
            continue
        try:
            expected = table[index]
        except IndexError:
            continue
        lost = []
        assert torch.equal(lookup(table, index, lambda worlds, _, lost=lost: lost.append(worlds.any())), expected), (
            index
        )
        assert not any(lost)
