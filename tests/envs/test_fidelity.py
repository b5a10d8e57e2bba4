"""Observations, rewards and physics against dm_control's recordings and C MuJoCo."""

import numpy as np
import pytest
import torch
from cases import MODELS, PROTOCOLS, TASKS
from for_each import for_each
from oracle import FORCES, Oracle, recorded, without_forces

import torchrl_loco

WALKER_ROW = [-0.8415, -0.5403, -0.7934, 0.6087, -0.9945, 0.1048, -0.9205, -0.3908, -0.8747, -0.4847, 0.911, -0.4125]
WALKER_ROW += [0.4919, -0.8707, -0.8415] + [0.0] * 9
HUMANOID_LIMBS = [0.36, 0.17, 0.06, -0.0027, 0.09, -1.258, 0.36, -0.17, 0.06, -0.0027, -0.09, -1.258]


def state(record, extra=()):
    """The recorded states as a TensorDict for set_state."""
    keys = {"qpos": "qpos", "qvel": "qvel", **({"act": "act"} if "act" in record else {}), **dict(extra)}
    entries = {key: torch.as_tensor(record[name], dtype=torch.float32) for key, name in keys.items()}
    return torchrl_loco.State(entries, batch_size=[len(record["qpos"])])


@pytest.fixture
def tasks(engine, device):
    """The last task first: meanwhile another worker, in test_contract, compiles the kernels of the first ones."""
    if engine == "mujoco_warp":
        return ["humanoid_run"]  # for others see test_engines_agree
    return TASKS[::-1] if device == "cpu" else ["walker_run", "humanoid_run", "hopper_hop", "quadruped_run"]


def test_the_oracle_agrees_with_dm_control():
    """The NumPy formulas that the rewards are held against are dm_control's own."""
    for task in TASKS:
        record, oracle = recorded(task), Oracle(task, MODELS[task.split("_")[0]])
        rows = zip(record["next_qpos"], record["next_qvel"], record["action"], strict=True)
        rewards = [oracle.reward(*row) for row in rows]
        np.testing.assert_allclose(rewards, record["reward"], rtol=0, atol=1e-6, err_msg=task)


@for_each("task", "tasks")
def test_observation_and_physics_agree_with_dm_control(shared, task, engine, device):
    record = recorded(task)
    env = shared(task, 192, device, protocol="dm_control", engine=engine)
    after = {name: record[f"next_{name}"] for name in ("qpos", "qvel", "act") if name in record}
    td = env.reset(state(after).to(device), set_state=True)
    observed, expected = (without_forces(env.body, rows) for rows in (td["observation"].cpu(), record["obs"]))
    np.testing.assert_allclose(observed, expected, rtol=0, atol=1e-5)

    td = env.reset(state(record, {"qacc_warmstart": "warmstart"}.items()).to(device), set_state=True)
    action = torch.as_tensor(actions_of(env, record), dtype=torch.float32, device=device)
    observed = env.step(td.set("action", action))["next", "observation"].cpu().numpy()
    error = np.abs(env.get_state()["qpos"].cpu().numpy() - record["next_qpos"]).max(axis=1)
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.95) < 1e-4
    if env.body in FORCES:  # a rounding error of 1e-7 m is one of 1e-4 where bodies overlap by 1 mm
        entries = FORCES[env.body]
        error = np.abs(observed[:, entries] - record["obs"][:, entries]).max(axis=1)
        assert np.median(error) < 1e-4
        assert np.quantile(error, 0.95) < 5e-4


def actions_of(env, record):
    """The recorded actions, which are controls, as those in [-1, 1] that are scaled to them."""
    low, high = env.mj_model.actuator_ctrlrange.T
    return 2 * (record["action"] - low) / (high - low) - 1


def interpolated_states(task):
    """Recorded states, every second one changed, so that rewards reach from nearly 0 to nearly 1."""
    record = recorded(task)
    beyond = {"cheetah_run": 13, "hopper_hop": 4}  # the target speed
    if task in beyond:
        record["qvel"][::2, 0] += np.linspace(-2, beyond[task], 96)
    if task.startswith("quadruped"):  # some upside down, others faster, in any direction
        record["qvel"][::2, :3] *= np.linspace(0, 10, 96)[:, None]
        record["qpos"][::4, 3:7] = record["qpos"][::4, [4, 3, 6, 5]] * [-1, 1, -1, 1]
    if task.startswith(("cheetah", "hopper", "quadruped")):
        return record
    height, velocity = (0, 1) if task.startswith("walker") else (2, 0)
    record["qpos"][::2, height] -= 0.7
    record["qvel"][::2, velocity] = 0.0
    return record


@for_each("task", "tasks")
def test_reward_agrees_with_numpy(shared, task, device):
    record = interpolated_states(task)
    env = shared(task, 192, device, protocol="dm_control")
    td = env.reset(state(record).to(device), set_state=True)
    action = torch.as_tensor(actions_of(env, record), dtype=torch.float32, device=device)
    rewards = env.step(td.set("action", action))["next", "reward"].squeeze(-1).cpu().numpy()

    after = {key: env.get_state()[key].cpu().numpy().astype(np.float64) for key in ("qpos", "qvel")}
    oracle = Oracle(task, MODELS[env.body])
    expected = [oracle.reward(after["qpos"][i], after["qvel"][i], record["action"][i]) for i in range(192)]
    np.testing.assert_allclose(rewards, expected, rtol=0, atol=1e-4)
    assert min(expected) < 0.2
    assert max(expected) > 0.9


def test_playground_rows():
    humanoid = torchrl_loco.make("humanoid_walk", 2, "cpu").reset()["observation"]
    expected = torch.zeros(67)
    expected[21], expected[36] = 1.69, 1.0
    expected[22:34] = torch.tensor(HUMANOID_LIMBS)
    torch.testing.assert_close(humanoid, expected.expand(2, -1), atol=1e-4, rtol=0)

    env = torchrl_loco.make("walker_walk", 1, "cpu")
    angles = walker_angles(WALKER_ROW)
    td = torchrl_loco.State({"qpos": torch.tensor([angles]), "qvel": torch.zeros(1, 9)}, batch_size=[1])
    walker = env.reset(td, set_state=True)["observation"]
    torch.testing.assert_close(walker, torch.tensor([WALKER_ROW]), atol=2e-4, rtol=0)


def walker_angles(row):
    """qpos of a walker that shows the orientations of ``row``: pitch downstream is the sum of the hinges, negated."""
    pitch = [float(np.arctan2(row[i + 1], row[i])) for i in range(0, 14, 2)]
    torso, right, left = pitch[0], pitch[1:4], pitch[4:7]
    hinges = []
    for leg in (right, left):
        hinges += [-(angle - parent) for angle, parent in zip(leg, [torso, *leg[:2]], strict=True)]
    return [0.0, 0.0, torso, *hinges]


def test_walker_height_entry(shared):
    for protocol in PROTOCOLS:
        env = shared("walker_stand", 192, protocol=protocol)
        height = env.reset()["observation"][:, 14]
        expected = env.sim.xpos[:, 1, 2] if protocol == "dm_control" else env.sim.xmat[:, 1, 2, 2]
        torch.testing.assert_close(height, expected)
