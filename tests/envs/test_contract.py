"""One contract for every task; on CUDA for one of each kind."""

import pytest
import torch
from cases import ENGINES, KINDS, TASKS, coarse
from compare import assert_repeats
from for_each import for_each
from hook_tasks import WalkBackwards
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv, check_env_specs

import torchrl_loco
from torchrl_loco import State

CASES = [(task, "playground", "auto") for task in TASKS]
CASES += [(task, "dm_control", "compiled") for task in ("walker_run", "humanoid_run")]


@for_each("task, protocol, engine", cpu=CASES, cuda=KINDS[:3])
def test_specs_and_a_rollout(shared, task, protocol, engine, device):
    env = shared(task, 4, device, protocol=protocol, engine=engine, reward_terms=True)
    check_env_specs(env)
    td = env.rollout(20, break_when_any_done=False)
    observation, reward = td["next", "observation"], td["next", "reward"]
    assert observation.shape == (4, 20, env.observation_size)
    assert observation.isfinite().all()
    assert ((reward >= 0) & (reward <= 1)).all()
    assert (reward > 0).all() or env.body in ("cheetah", "hopper", "quadruped")  # which may earn nothing
    assert reward.shape == td["next", "done"].shape == td["next", "terminated"].shape == (4, 20, 1)
    assert not td["next", "done"].any()
    assert env.action_spec.contains(td["action"][:, 0])
    product = torch.stack(list(td["next", "reward_terms"].values())).prod(0)
    torch.testing.assert_close(product, reward)
    assert all((term == 0).all() for term in env.reset()["reward_terms"].values())


@for_each("kind", "kinds")
def test_specs_under_transforms(shared, kind):
    task, protocol, engine = kind
    env = shared(task, protocol=protocol, engine=engine, reward_terms=True)
    check_env_specs(TransformedEnv(env, Compose(InitTracker(), RewardSum(), StepCounter())))


@for_each("kind", "kinds")
def test_a_step_returns_no_live_buffer(shared, kind, device, actions):
    """A rollout holds what a loop with copies holds, and no two steps share memory."""
    task, protocol, engine = kind
    env = shared(task, 4, device, protocol=protocol, engine=engine, reward_terms=True)
    moves = actions(env, 6)
    env.reset()
    state = env.get_state()
    originals = [env.reset(state, set_state=True)]
    copies = [originals[0].clone()]
    for action in moves:
        originals.append(env.step(originals[-1].exclude("reward").set("action", action))["next"])
        copies.append(originals[-1].clone())
    for original, copy in zip(originals, copies, strict=True):
        assert (original == copy).all()
    pointers = [value.data_ptr() for td in originals for value in td.values(True, True)]
    assert len(set(pointers)) == len(pointers)

    iterator = iter(moves)
    rollout = env.rollout(
        6,
        policy=lambda td: td.set("action", next(iterator)),
        tensordict=env.reset(state, set_state=True),
        auto_reset=False,
    )
    for key in ("observation", "reward"):
        loop = torch.stack([td[key] for td in copies[1:]], dim=1)
        assert_repeats(rollout["next", key], loop, engine)


@for_each("kind", "kinds")
def test_truncation_is_exact_and_the_terminal_observation_true(shared, kind, device):
    task, protocol, engine = kind
    options = {"protocol": protocol, "engine": engine, "reward_terms": True}
    env = shared(task, 4, device, 3, episode_length=7, **options)
    twin = shared(task, 4, device, 3, **options)  # not truncated here
    carried, td = env.reset(), twin.reset()
    for step in range(1, 8):
        action = env.action_spec.zero()
        current, carried = env.step_and_maybe_reset(carried.set("action", action))
        td = twin.step(td.set("action", action))["next"].exclude("reward")
        after = current["next"]
        torch.testing.assert_close(after["observation"], td["observation"], rtol=0, atol=1e-5)
        assert (after["truncated"] == (step == 7)).all()
        assert (after["done"] == (step == 7)).all()
        assert not after["terminated"].any()
    assert not carried["done"].any()
    assert not carried["truncated"].any()
    fresh = twin.reset()["observation"]  # the same second episode
    torch.testing.assert_close(carried["observation"], fresh)
    assert (carried["observation"] != after["observation"]).any()


def test_a_fallen_body_goes_on_until_1000_steps(shared):
    env = shared("walker_run", 2)
    lying = torch.zeros(2, 9)
    lying[:, 1], lying[:, 2] = -1.2, torch.pi / 2
    start = {"qpos": lying, "qvel": torch.zeros(2, 9), "elapsed_steps": torch.tensor([0, 980])}
    td, done = env.reset(State(start, batch_size=[2]), set_state=True), []
    for _ in range(20):
        current, td = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
        done.append(current["next", "truncated"].squeeze(-1))
    assert torch.stack(done).nonzero().tolist() == [[19, 1]]


@for_each("kind", "kinds")
def test_batches(kind):
    task, protocol, engine = kind
    for num_envs in (1, 300):
        env = torchrl_loco.make(task, num_envs, "cpu", 0, protocol, engine=engine, **coarse(task))
        td = env.rollout(3)
        assert td.shape == (num_envs, 3)
        assert td["next", "observation"].isfinite().all()
        assert env.health()["total", "constraint_overflow"] == env.health()["total", "contact_overflow"] == 0


def test_a_policy_with_gradients_leaves_no_autograd_graph_behind(shared):
    env = shared()
    layer = torch.nn.Linear(24, 6)
    env.rollout(3, TensorDictModule(layer, in_keys=["observation"], out_keys=["action"]))
    assert not env.world.action.torch.requires_grad
    after = env.rand_step(env.reset())["next"]
    loss = torch.nn.Linear(24, 1)(after["observation"]).square().sum()
    after["reward"].mul_(0.1)  # lies beside the observation, which the gradient reads
    loss.backward()


def test_the_callers_default_dtype_and_inference_mode_do_not_matter():
    torch.set_default_dtype(torch.float64)
    try:
        for task, options in (("walker_walk", {"reward_terms": True}), (WalkBackwards, {})):
            with torch.inference_mode():
                env = torchrl_loco.make(task, 2, "cpu", seed=0, **options)
            check_env_specs(env)
            assert env.rollout(2)["next", "reward"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("elsewhere", ["meta", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_the_callers_default_device_does_not_matter(elsewhere, shared):
    """An environment on the CPU stays there where tensors are made on another device by default."""
    action = torch.zeros(4, 21)
    options = {"protocol": "dm_control", "reward_terms": True}
    expected = shared("humanoid_run", **options).reset()["observation"]
    with torch.device(elsewhere):
        env = torchrl_loco.make("humanoid_run", 4, "cpu", seed=0, stagger=True, **options)
        td = env.reset()
        torch.testing.assert_close(td["observation"], expected, rtol=0, atol=0)
        for _ in range(101):
            _, td = env.step_and_maybe_reset(td.set("action", action))
        env.world.health.check()
        env.reset(env.get_state().branch(1), set_state=True)
        env.load_state_dict(env.state_dict())
        assert env.render(width=8, height=8).device == env.health()["total"].device == torch.device("cpu")
        torchrl_loco.make("go1_velocity", 1, "cpu", engine="mujoco", compile_hooks=False)


def test_making_an_environment_leaves_no_overflow_behind():
    """Recording steps through states that nobody asked for; what overflowed there does not count."""
    for engine in ENGINES:
        env = torchrl_loco.make("walker_run", 4, "cpu", seed=0, protocol="dm_control", iterations=1, engine=engine)
        assert (env.sim.overflow == 0).all()
        assert all(count == 0 for count in env.health()["total"].values())
        env.rollout(40)
        assert env.health()["total", "iteration_limit"] > 0, engine


def test_repr(shared):
    start = "WalkerRun(num_envs=4, device='cpu', seed=3, protocol='playground', engine="
    assert repr(shared(seed=3)) == start + "'compiled')"
    assert repr(shared(seed=3, engine="mujoco_warp")) == start + "'mujoco_warp (as asked)')"
