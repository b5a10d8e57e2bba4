"""Resets: what they draw, from which stream, and which worlds they leave alone."""

import mujoco
import numpy as np
import pytest
import torch
from cases import KINDS, MODELS
from for_each import for_each
from oracle import FORCES, Oracle, arrays
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco.sim import models

SIGNIFICANCE = 1e-4
# Under playground the humanoid draws nothing.
DRAWING = [("walker_run", "playground"), ("humanoid_run", "dm_control"), ("quadruped_run", "dm_control")]


def from_one_distribution(ours, theirs):
    """Whether the columns of two samples do not differ by more than chance, by Kolmogorov's and Smirnov's test."""
    critical = np.sqrt(-0.5 * np.log(SIGNIFICANCE / ours.shape[1] / 2) * (1 / len(ours) + 1 / len(theirs)))
    for x, y in zip(ours.T, theirs.T, strict=True):
        both = np.concatenate([x, y])
        share = [np.searchsorted(np.sort(z), both, side="right") / len(z) for z in (x, y)]
        if np.abs(share[0] - share[1]).max() >= critical:
            return False
    return True


def kolmogorov_smirnov(x, cdf):
    """Distance of a sample from a distribution, and the distance that chance exceeds with SIGNIFICANCE."""
    x = np.sort(x)
    steps = np.arange(len(x) + 1) / len(x)
    distance = max(np.abs(cdf(x) - steps[1:]).max(), np.abs(cdf(x) - steps[:-1]).max())
    return distance, np.sqrt(-0.5 * np.log(SIGNIFICANCE / 2) / len(x))


@pytest.fixture
def draws(shared):
    """Returns qpos at the start of consecutive episodes, shape (episodes, num_envs, nq)."""

    def draw(task, num_envs, episodes, seed, protocol="playground", device="cpu"):
        env, starts = shared(task, num_envs, device, seed, protocol=protocol), []
        for _ in range(episodes):
            env.reset()
            starts.append(env.get_state()["qpos"].cpu())
        return torch.stack(starts)

    return draw


@for_each("task, protocol, engine", cpu=[*KINDS, ("cheetah_run", "playground", "compiled")], cuda=KINDS)
def test_masked_reset_leaves_the_others_bitwise_unchanged(shared, task, protocol, engine, device, actions):
    env = shared(task, 4, device, protocol=protocol, engine=engine, reward_terms=True)
    td = env.reset()
    for action in actions(env, 8):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    before, health = env.get_state(), env.health()
    mask = torch.tensor([True, False, False, True], device=device).unsqueeze(-1)
    after_td = env.reset(td.clone().set("_reset", mask))
    after = env.get_state()
    kept = ~mask.squeeze(-1)
    for key, value in before.items():
        assert (value[kept] == after[key][kept]).all(), key
    assert (env.health() == health).all()
    assert torch.equal(after_td["observation"][kept], td["observation"][kept])
    assert (after["elapsed_steps"][~kept] == 0).all()
    assert (after["elapsed_steps"][kept] == 8).all()
    assert (after["episode"][~kept] == 2).all()
    for name in ("qvel", "qacc_warmstart", "ctrl", "time", *(("act",) if "act" in before else ())):
        values = getattr(env.sim, name)
        if (name, task) != ("qvel", "cheetah_run"):  # it begins in motion
            assert (values[~kept] == 0).all(), name
        assert (values[kept] != 0).any(), name

    if device == "cpu" or engine == "compiled":  # and they go on as if nothing had happened
        action = actions(env, 1, seed=1)[0]
        observation = env.step(after_td.set("action", action))["next", "observation"]
        env.reset(before, set_state=True)
        undisturbed = env.step(after_td.set("action", action))["next", "observation"]
        assert torch.equal(observation[kept], undisturbed[kept])


@pytest.mark.slow
@for_each("task", ["walker_walk", "hopper_stand"])
def test_planar_bodies_start_uniformly(draws, task):
    body = task.split("_")[0]
    qpos = draws(task, 4096, 1, seed=12)[0].numpy().astype(np.float64)
    model = models.load(MODELS[body])
    assert (qpos[:, :2] == 0).all()
    ranges = [(-np.pi, np.pi), *model.jnt_range[3:]]
    for angle, (low, high) in zip(qpos[:, 2:].T, ranges, strict=True):
        assert low <= angle.min()
        assert angle.max() <= high
        distance, critical = kolmogorov_smirnov(angle, lambda x, low=low, high=high: (x - low) / (high - low))
        assert distance < critical
    correlation = np.corrcoef(qpos[:, 2:].T) - np.eye(model.nq - 2)
    assert np.abs(correlation).max() < 5 / np.sqrt(len(qpos))
    assert from_one_distribution(qpos[:, 2:], arrays(f"{body}_resets_dm_control")["qpos"][:, 2:])


def test_a_hopper_feels_the_ground_before_its_first_step(shared, engine):
    """What C MuJoCo finds without control, and not the forces of the episode before."""
    env = shared("hopper_hop", 24, protocol="dm_control", engine=engine)
    reference = Oracle("hopper_hop", env.model)
    for lowered in (0.0, 0.2):
        env.rollout(30, break_when_any_done=False)
        td, state = env.reset(), env.get_state()
        if lowered:
            state["qpos"][:, 1] -= lowered
            td = env.reset(state, set_state=True)
        rows = zip(*(state[key].double().numpy() for key in ("qpos", "qvel")), strict=True)
        expected = np.array([reference.observation("dm_control", *row) for row in rows])
        error = np.abs(td["observation"].numpy() - expected)[:, FORCES["hopper"]].max(axis=1)
        assert (expected[:, FORCES["hopper"]] > 0).any() == (lowered > 0)
        assert np.quantile(error, 0.95) < 1e-4


@pytest.mark.slow
def test_quadruped_starts_just_above_the_floor(draws):
    """In any orientation, 1 cm above the highest place of a centimeter grid where C MuJoCo finds a contact."""
    qpos = draws("quadruped_run", 1024, 1, seed=5, protocol="dm_control")[0].numpy().astype(np.float64)
    model = models.load(MODELS["quadruped"])
    assert (qpos[:, :2] == 0).all()
    assert (qpos[:, 7:] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(qpos[:, 2], qpos[:, 2].round(2), atol=1e-6)
    data, contacts = mujoco.MjData(model), []
    for lowered in (0.0, 0.01):
        for q in qpos[:512]:
            data.qpos[:] = q
            data.qpos[2] -= lowered
            mujoco.mj_fwdPosition(model, data)
            contacts.append(data.ncon)
    free, touching = np.split(np.array(contacts), 2)
    assert (free == 0).all()
    assert (touching > 0).all()
    assert from_one_distribution(qpos[:, 2:7], arrays("quadruped_resets_dm_control")["qpos"][:, 2:7])


@pytest.mark.slow
def test_humanoid_starts_free_of_contact(draws):
    """dm_control's start, judged by C MuJoCo, with the distribution that dm_control recorded."""
    qpos = draws("humanoid_walk", 2048, 1, seed=5, protocol="dm_control")[0].numpy().astype(np.float64)
    model = models.load(MODELS["humanoid"])
    data = mujoco.MjData(model)
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        assert data.ncon == 0
    assert (qpos[:, :3] == [0, 0, 1.5]).all()
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
    recorded = arrays("humanoid_resets_dm_control")["qpos"]
    assert from_one_distribution(qpos[:, 3:], recorded[:, 3:])


@pytest.mark.slow
def test_cheetah_starts_settled(shared, engine):
    """It stands on the floor, nearly at rest, with the distribution that dm_control recorded."""
    env = shared("cheetah_run", 64, protocol="dm_control", engine=engine)
    states, record = env.initial_states(), arrays("cheetah_resets_dm_control")
    assert from_one_distribution(states, np.concatenate([record["qpos"], record["qvel"]], axis=1))
    observation, start = env.reset()["observation"], env.get_state()
    assert torch.equal(observation, torch.cat([start["qpos"][:, 1:], start["qvel"]], dim=1))
    assert len(start["qpos"].unique(dim=0)) > 48
    assert (start["qvel"] != 0).any()
    data = mujoco.MjData(env.mj_model)
    for qpos, qvel, velocity in zip(start["qpos"], start["qvel"], env.sim.data.sensordata.numpy(), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(env.mj_model, data)
        assert data.ncon >= 2
        assert data.contact.dist.min() > -0.02
        np.testing.assert_allclose(velocity, data.sensordata, atol=1e-5)


def test_humanoid_playground_start_is_the_default_pose(draws):
    qpos = draws("humanoid_run", 3, 2, seed=0)
    expected = torch.as_tensor(models.load(MODELS["humanoid"]).qpos0, dtype=torch.float32)
    assert torch.equal(qpos, expected.expand_as(qpos))


@for_each("task, protocol", cpu=DRAWING, cuda=DRAWING[1:])
def test_a_world_draws_from_seed_world_and_episode_alone(shared, draws, task, protocol, device):
    few, many = (draws(task, n, 3, seed=9, protocol=protocol, device=device) for n in (3, 64))
    assert torch.equal(few, many[:, :3])
    assert not torch.equal(few, draws(task, 3, 3, seed=10, protocol=protocol, device=device))
    other_seed = draws(task, 64, 3, seed=10, protocol=protocol, device=device)
    starts = torch.cat([many, other_seed]).reshape(-1, many.shape[-1])
    assert len(starts.unique(dim=0)) == len(starts)  # no seed, world or episode repeats another

    # Episodes count by world: a world that is reset alone draws what it would have drawn with the others.
    env = shared(task, 3, device, 9, protocol=protocol)
    env.reset()
    mask = torch.tensor([[False], [True], [False]], device=device)
    for episode in (1, 2):
        env.reset(TensorDict({"_reset": mask, "done": mask}, batch_size=[3], device=device))
        assert torch.equal(env.get_state()["qpos"][1].cpu(), few[episode, 1])
        assert torch.equal(env.get_state()["qpos"][0].cpu(), few[0, 0])


def test_no_global_generator_is_read_or_seeded():
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    env = torchrl_loco.make("walker_walk", 4, "cpu")
    env.reset()
    env.set_seed(5)
    env.reset()
    assert torch.equal(torch_state, torch.get_rng_state())
    assert (numpy_state == np.random.get_state()[1]).all()  # noqa: NPY002


def test_without_a_seed_environments_differ():
    env, other = (torchrl_loco.make("walker_walk", 2, "cpu") for _ in range(2))
    first = env.reset()["observation"]
    assert not torch.equal(first, other.reset()["observation"])
    env.set_seed(None)
    assert not torch.equal(first, env.reset()["observation"])


@pytest.mark.slow
def test_stagger_spreads_the_time_limits():
    env = torchrl_loco.make("walker_stand", 2000, "cpu", seed=0, stagger=True, episode_length=100)
    env.reset()
    elapsed = env.get_state()["elapsed_steps"].numpy()
    distance, critical = kolmogorov_smirnov(elapsed + 0.5, lambda x: x / 100)
    assert distance < critical + 0.01
    assert elapsed.min() >= 0
    assert elapsed.max() < 100
    mask = torch.zeros(2000, 1, dtype=torch.bool)
    mask[:1000] = True
    env.reset(TensorDict({"_reset": mask, "done": ~mask}, batch_size=[2000]))
    assert (env.get_state()["elapsed_steps"][:1000] == 0).all()  # only a full reset staggers
