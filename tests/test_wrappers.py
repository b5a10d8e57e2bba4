"""The wrappers deliver what ``step_and_maybe_reset`` of a twin with the same seed delivers, in their library's form."""

import copy
import functools
import math
import sys
import warnings

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from for_each import for_each
from torchrl.envs import (
    ActionDiscretizer,
    CatTensors,
    FrameSkipTransform,
    InitTracker,
    RenameTransform,
    SerialEnv,
)

import torchrl_loco
from torchrl_loco import wrappers

NUM_ENVS, LENGTH, STEPS = 4, 5, 12
settings = {"device": "cpu", "seed": 3, "episode_length": LENGTH, "reward_terms": True}
make = functools.partial(torchrl_loco.make, "walker_stand", NUM_ENVS, **settings)


def make_with_groups(**options):
    """Returns an environment with a second group of observations."""
    second = CatTensors(["observation"], "privileged", del_keys=False)
    return torchrl_loco.TransformedEnv(make(**options), second)


class Fall(torchrl_loco.WalkerStand):
    """Episodes that end early, a group for the critic, and actions without bounds."""

    action_range = (-torch.inf, torch.inf)

    def control(self, s, action):
        return action.tanh()

    def observation(self, s):
        return {"observation": s.qvel, "privileged": torch.cat([s.qpos, s.qvel], dim=-1)}

    def terminated(self, s):
        return s.xpos("torso")[:, 2] < 1.0


@pytest.fixture
def steps(actions):
    """What the twin delivers: its pairs (step, TensorDict after the resets).

    The worlds are truncated at different steps, and world 1 is terminated by a NaN in the third.
    """
    twin = make(stagger=True)
    drawn = actions(twin, STEPS)
    drawn[2, 1, 0] = torch.nan
    td, pairs = twin.reset(), []
    for action in drawn:
        step, td = twin.step_and_maybe_reset(td.set("action", action))
        pairs.append((step, td))
    after = torch.stack([step["next"] for step, _ in pairs])
    assert after["terminated"].nonzero().tolist() == [[2, 1, 0]]
    assert after["truncated"].any(dim=0).all()
    assert not after["truncated"].all(dim=1).any()
    return pairs


@pytest.fixture
def gymnasium():
    return pytest.importorskip("gymnasium")


@pytest.fixture
def rsl_rl():
    return pytest.importorskip("rsl_rl")


@pytest.fixture
def stable_baselines3():
    return pytest.importorskip("stable_baselines3")


CLASSES = {
    "gymnasium": "GymnasiumVectorEnv",
    "rsl_rl": "RslRlVecEnv",
    "stable_baselines3": "StableBaselines3VecEnv",
}

# All of them.


def test_a_missing_library_is_named(monkeypatch):
    for library, name in CLASSES.items():
        monkeypatch.setitem(sys.modules, library, None)  # as if it were not installed
        needs = rf"{name} needs {library}: pip install 'torchrl-loco\[wrappers\]'"
        with pytest.raises(ImportError, match=needs):
            getattr(wrappers, name)
    with pytest.raises(AttributeError, match="has no GymEnv: it has GymnasiumEnv, GymnasiumVectorEnv"):
        wrappers.GymEnv  # noqa: B018


@pytest.mark.ci
@for_each("library", CLASSES)
def test_what_is_wrapped(library):
    pytest.importorskip(library)
    cls = getattr(wrappers, CLASSES[library])
    assert cls("walker_stand", **settings).num_envs == 1
    for env in (cls("walker_stand", 2, **settings), cls(torchrl_loco.WalkerStand, 2, **settings)):
        assert type(env.env) is torchrl_loco.WalkerStand
        assert env.num_envs == 2
        assert env.env.config.episode_length == LENGTH
        env.close()
        assert env.env.is_closed
    own = make()
    assert cls(own).env is own
    assert cls(make_with_groups()).num_envs == NUM_ENVS
    assert isinstance(type("Mine", (cls,), {})(own), cls)
    with pytest.raises(TypeError, match="num_envs, seed: the environment is made already"):
        cls(own, 4, seed=0)
    several = SerialEnv(1, make)
    with pytest.raises(TypeError, match="id, a class or an environment of torchrl_loco, got SerialEnv"):
        cls(several)
    with pytest.raises(ValueError, match="no batch of worlds: make it with num_envs=1"):
        cls(torchrl_loco.make("walker_stand", None, "cpu"))
    with pytest.raises(ValueError, match="did you mean 'walker_stand'"):
        cls("walker_stnd", 2)
    if library != "rsl_rl":
        for wrong, match in (({"camera": "nope"}, "unknown camera 'nope'"), ({"width": 0}, "width must lie in")):
            with pytest.raises(ValueError, match=match):
                cls(own, render_mode="rgb_array", **wrong)


# Gymnasium.


@pytest.mark.ci
def test_classes_are_those_of_their_libraries(gymnasium):
    assert issubclass(wrappers.GymnasiumVectorEnv, gymnasium.vector.VectorEnv)
    assert issubclass(wrappers.GymnasiumEnv, gymnasium.Env)


@pytest.mark.ci
def test_one_world_of_gymnasium(gymnasium, actions):
    """As Gymnasium's own checker and wrappers take it; ``make_vec`` and ``gymnasium.wrappers`` see an ordinary env."""
    from gymnasium.utils.env_checker import check_env

    options = {"device": "cpu", "episode_length": LENGTH, "reward_terms": True, "render_mode": "rgb_array"}
    env = wrappers.GymnasiumEnv("walker_stand", width=32, height=24, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # observations have no bounds
        check_env(env, skip_render_check=True)
    twin = torchrl_loco.make("walker_stand", 1, "cpu", 7, episode_length=LENGTH)
    drawn, td = actions(twin, 2 * LENGTH), twin.reset()
    seen, _ = env.reset(seed=7)
    for t, action in enumerate(drawn):
        np.testing.assert_array_equal(seen, td["observation"][0].numpy())
        step, td = twin.step_and_maybe_reset(td.set("action", action))
        seen, reward, terminated, truncated, infos = env.step(action[0].numpy())
        assert (reward, terminated) == (float(step["next", "reward"]), False)
        assert infos["reward_terms"]["stand"] > 0.0
        assert truncated == ((t + 1) % LENGTH == 0)
        if truncated:
            np.testing.assert_array_equal(seen, step["next", "observation"][0].numpy())
            with pytest.raises(gymnasium.error.ResetNeeded, match="after an episode has ended"):
                env.step(action[0].numpy())
            seen, _ = env.reset()
    assert env.render().shape == (24, 32, 3)
    with pytest.raises(ValueError, match="has 4 worlds: take GymnasiumVectorEnv"):
        wrappers.GymnasiumEnv(make())


@pytest.mark.ci
def test_gymnasium_with_tensors(gymnasium, steps):
    env = wrappers.GymnasiumVectorEnv(make(stagger=True), arrays="torch")
    assert isinstance(env, gymnasium.vector.VectorEnv)
    observations, info = env.reset()
    assert torch.equal(observations, steps[0][0]["observation"])
    assert info == {}
    for step, td in steps:
        after = step["next"]
        observations, rewards, terminations, truncations, info = env.step(step["action"])
        assert torch.equal(observations, td["observation"])
        assert torch.equal(rewards, after["reward"].squeeze(-1))
        assert torch.equal(terminations, after["terminated"].squeeze(-1))
        assert torch.equal(truncations, after["truncated"].squeeze(-1))
        assert torch.equal(info["_final_obs"], after["done"].squeeze(-1))
        assert torch.equal(info["final_obs"], after["observation"])
        for name, term in after["reward_terms"].items():
            assert torch.equal(info["reward_terms"][name], term.squeeze(-1))


@pytest.mark.ci
def test_gymnasium_with_arrays(gymnasium, steps):
    """The infos have the form of Gymnasium's own vector environments."""
    env = wrappers.GymnasiumVectorEnv(make_with_groups(stagger=True))
    observations, _ = env.reset()
    for step, td in steps:
        after = step["next"]
        assert env.observation_space.contains(observations)
        observations, rewards, terminations, truncations, info = env.step(step["action"].numpy())
        assert {type(x) for x in (*observations.values(), rewards, terminations, truncations)} == {np.ndarray}
        for x in observations.values():
            assert np.array_equal(x, td["observation"])
        assert np.array_equal(rewards, after["reward"].squeeze(-1))
        assert np.array_equal(terminations, after["terminated"].squeeze(-1))
        assert np.array_equal(truncations, after["truncated"].squeeze(-1))
        done = after["done"].squeeze(-1)
        assert ("final_obs" in info) == done.any()
        if not done.any():
            continue
        assert np.array_equal(info["_final_obs"], done)
        for world in range(NUM_ENVS):
            last = info["final_obs"][world]
            if not done[world]:
                assert last is None
                continue
            assert env.single_observation_space.contains(last)
            for x in last.values():
                assert np.array_equal(x, after["observation"][world])
        terms = info["final_info"]["reward_terms"]
        assert np.array_equal(info["_final_info"], done)
        for name, term in after["reward_terms"].items():
            assert np.array_equal(terms[name][done], term.squeeze(-1)[done])
            assert np.array_equal(terms[f"_{name}"], done)


@pytest.mark.ci
def test_gymnasium_with_a_task_that_ends_early(gymnasium):
    options = {"device": "cpu", "seed": 3, "episode_length": 100}
    env, twin = wrappers.GymnasiumVectorEnv(Fall, NUM_ENVS, **options), Fall(NUM_ENVS, **options)
    env.reset()
    env.action_space.seed(0)
    td, ended = twin.reset(), 0
    for _ in range(60):
        actions = env.action_space.sample()
        observations, _, terminations, truncations, info = env.step(actions)
        step, td = twin.step_and_maybe_reset(td.set("action", torch.as_tensor(actions)))
        assert np.array_equal(terminations, step["next", "terminated"].squeeze(-1))
        assert not truncations.any()
        for group in ("observation", "privileged"):
            assert np.array_equal(observations[group], td[group])
            for world in terminations.nonzero()[0]:
                last = info["final_obs"][world][group]
                assert np.array_equal(last, step["next", group][world])
                assert not np.array_equal(last, observations[group][world])
        ended += terminations.sum()
    assert ended >= NUM_ENVS


@pytest.mark.ci
def test_spaces(gymnasium, stable_baselines3):
    from gymnasium.spaces import Box, Dict

    for wrap in (wrappers.GymnasiumVectorEnv, wrappers.StableBaselines3VecEnv):
        env = wrap(make())
        batch = (NUM_ENVS,) if wrap is wrappers.GymnasiumVectorEnv else ()
        assert env.observation_space == Box(-np.inf, np.inf, (*batch, 24))
        assert env.action_space == Box(-1, 1, (*batch, 6))
        grouped = wrap(make_with_groups()).observation_space
        assert grouped == Dict(dict.fromkeys(("observation", "privileged"), env.observation_space))
        assert wrap(Fall, NUM_ENVS, **settings).action_space == Box(-np.inf, np.inf, (*batch, 6))
    env = wrappers.GymnasiumVectorEnv(make())
    assert env.single_observation_space == Box(-np.inf, np.inf, (24,))
    assert env.single_action_space == Box(-1, 1, (6,))
    transformed = lambda transform: wrappers.GymnasiumVectorEnv(torchrl_loco.TransformedEnv(make(), transform))  # noqa: E731
    assert transformed(InitTracker()).single_observation_space["is_init"] == Box(0, 1, (1,), bool)
    assert transformed(FrameSkipTransform(4)).metadata["render_fps"] == 10
    with pytest.raises(ValueError, match="makes MultiCategorical of it: these wrappers take numbers"):
        transformed(ActionDiscretizer(num_intervals=3))
    with pytest.raises(ValueError, match="observations in agent are nested"):
        transformed(RenameTransform(["observation"], [("agent", "observation")]))


@pytest.mark.ci
def test_gymnasium_resets_worlds_of_a_mask(gymnasium):
    env = wrappers.GymnasiumVectorEnv(make())
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(np.zeros((NUM_ENVS, 6)))
    env.reset(seed=0)
    before, *_ = env.step(env.action_space.sample())
    for wrong in (np.zeros((NUM_ENVS, 2)), np.zeros(6)):
        with pytest.raises(ValueError, match=rf"actions must have shape \({NUM_ENVS}, 6\), got"):
            env.step(wrong)
    mask = np.array([True, False, False, True])
    for options, match in (
        ({"mask": mask}, "unknown option of reset 'mask'"),
        ({"reset_mask": mask[:2]}, "reset_mask must be bool of shape"),
        ({"reset_mask": mask.astype(float)}, "reset_mask must be bool of shape"),
    ):
        with pytest.raises(ValueError, match=match):
            env.reset(options=options)
    kept = before.copy()
    before -= 100.0  # what was returned is the caller's
    after, _ = env.reset(options={"reset_mask": mask})
    assert np.array_equal((after == kept).all(axis=1), ~mask)
    truncations = [env.step(env.action_space.sample())[3] for _ in range(LENGTH)]
    assert np.array_equal(truncations[-2], ~mask)
    assert np.array_equal(truncations[-1], mask)


@pytest.mark.ci
def test_gymnasium_checks_and_statistics(gymnasium):
    """Its check of seeds (others are for single environments), and a wrapper that goes by the autoreset mode."""
    from gymnasium.utils import env_checker
    from gymnasium.wrappers.vector import RecordEpisodeStatistics

    make_env = functools.partial(wrappers.GymnasiumVectorEnv, "walker_stand", **settings)
    gymnasium.register("WalkerStand-v0", vector_entry_point=make_env)
    env = gymnasium.make_vec("WalkerStand-v0", NUM_ENVS)
    env_checker.check_reset_seed_determinism(env)
    env = RecordEpisodeStatistics(env)
    env.reset(seed=0)
    env.action_space.seed(0)
    total = np.zeros(NUM_ENVS)
    for i in range(2 * LENGTH):
        _, rewards, _, _, info = env.step(env.action_space.sample())
        total = rewards + (i != LENGTH) * total
        assert ("episode" in info) == (i % LENGTH == LENGTH - 1)
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
    assert list(env.length_queue) == [LENGTH] * 2 * NUM_ENVS


@pytest.mark.ci
def test_gymnasium_converts_tensors(gymnasium):
    pytest.importorskip("array_api_compat")
    from gymnasium.wrappers.vector import ArrayConversion

    env = ArrayConversion(wrappers.GymnasiumVectorEnv(make(), arrays="torch"), env_xp=torch, target_xp=np)
    env.reset(seed=0)
    *arrays, info = env.step(env.action_space.sample())
    assert {type(x) for x in (*arrays, info["final_obs"])} == {np.ndarray}


PICTURE = {"render_mode": "rgb_array", "camera": "back", "width": 48, "height": 32}


@pytest.mark.ci
def test_gymnasium_records_a_video(gymnasium, tmp_path):
    pytest.importorskip("moviepy")
    from gymnasium.wrappers.vector import RecordVideo

    env = wrappers.GymnasiumVectorEnv(make(), **PICTURE)
    env.reset(seed=0)
    pictures = env.render()
    assert np.array_equal(np.stack(pictures), env.env.render("back", 48, 32))
    with pytest.warns(UserWarning, match="same-step"):
        env = RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: episode == 0)
    env.reset(seed=0)
    for _ in range(LENGTH):
        env.step(env.action_space.sample())
    env.close()
    (video,) = (tmp_path / "videos").iterdir()
    frames = imageio.imread(video, plugin="pyav")
    assert frames.shape == (LENGTH, 2 * 32, 2 * 48, 3)  # without the last observation's, as Gymnasium warns
    assert (frames[0] != frames[-1]).any()
    assert imageio.immeta(video, plugin="pyav")["fps"] == 1 / 0.025


@pytest.mark.ci
def test_gymnasium_without_a_render_mode(gymnasium):
    env = wrappers.GymnasiumVectorEnv(make())
    env.reset()
    with pytest.raises(ValueError, match='make the environment with render_mode="rgb_array"'):
        env.render()
    with pytest.raises(ValueError, match="unknown render_mode 'human': choose one of rgb_array"):
        wrappers.GymnasiumVectorEnv(make(), render_mode="human")
    with pytest.raises(TypeError, match="this is one world, take GymnasiumVectorEnv"):
        wrappers.GymnasiumEnv("walker_stand", num_envs=1)
    for _ in range(2):  # what a reset opens again is closed again
        env.reset()
        env.close()
        assert env.env.is_closed


@pytest.mark.ci
def test_pixels_are_those_of_the_camera_and_metrics_are_infos(gymnasium):
    class Timed(torchrl_loco.WalkerStand):
        def metrics(self, s):
            return {"clock": s.time}

    seen = {"from_pixels": True, "pixels_only": True, "size": (12, 12), "device": "cpu", "seed": 0}
    for camera in ("side", "back"):
        env = wrappers.GymnasiumVectorEnv(Timed, 2, camera=camera, metrics=True, **seen)
        observations, _ = env.reset()
        plain = torchrl_loco.make(Timed, 2, camera=camera, **seen)
        assert np.array_equal(observations["pixels"], plain.reset()["pixels"])
        *_, info = env.step(np.zeros((2, 6), dtype=np.float32))
        np.testing.assert_allclose(info["metrics"]["clock"], 0.025)
    with pytest.raises(ValueError, match="camera"):
        wrappers.GymnasiumVectorEnv(Timed, 2, camera="nowhere", **seen)
    with pytest.raises(TypeError, match="are of another camera than 'side': pass none"):
        wrappers.GymnasiumVectorEnv(plain, camera="side")


# RSL-RL.


@pytest.mark.ci
def test_rsl_rl(rsl_rl, steps):
    env = wrappers.RslRlVecEnv(make_with_groups(stagger=True))
    assert isinstance(env, rsl_rl.env.VecEnv)
    assert set(env.get_observations().keys()) == {"policy", "privileged"}
    env.get_observations()["policy"].fill_(100.0)  # what was returned is the caller's
    assert torch.equal(env.get_observations()["policy"], steps[0][0]["observation"])
    for step, td in steps:
        after = step["next"]
        observations, rewards, dones, extras = env.step(step["action"])
        for group in ("policy", "privileged"):
            assert torch.equal(observations[group], td["observation"])
            assert torch.equal(env.get_observations()[group], td["observation"])
            assert torch.equal(extras["final_observations"][group], after["observation"])
        assert torch.equal(rewards, after["reward"].squeeze(-1))
        assert torch.equal(dones, after["done"].squeeze(-1))
        assert torch.equal(extras["time_outs"], (after["truncated"] & ~after["terminated"]).squeeze(-1))
        for name, term in after["reward_terms"].items():
            assert extras["log"][f"/reward_terms/{name}"] == term.mean()


@pytest.mark.ci
def test_rsl_rl_logs_the_last_mean_where_no_world_counts(rsl_rl):
    """Its logger takes the plain mean over steps."""

    class Settles(torchrl_loco.WalkerStand):
        def metrics(self, s):
            return {"late": torch.where(s.step % 4 == 2, s.step.float(), math.nan)}

    env = wrappers.RslRlVecEnv(Settles, 2, device="cpu", seed=0, metrics=True)
    told = [env.step(torch.zeros(2, 6))[-1]["log"]["/metrics/late"].item() for _ in range(8)]
    assert math.isnan(told[0])
    assert told[1:] == [2.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0]


class FallAtTheEnd(torchrl_loco.WalkerStand):
    """Episodes that end in the step of their time limit."""

    def terminated(self, s):
        return s.time > (LENGTH - 0.5) * 0.025


@pytest.mark.ci
def test_rsl_rl_loses_no_group(rsl_rl):
    def observation(self, s):
        return {"observation": s.qpos, "policy": s.qvel}

    with pytest.raises(ValueError, match="'observation' is called 'policy' in RSL-RL"):
        wrappers.RslRlVecEnv(type("Twice", (torchrl_loco.WalkerStand,), {"observation": observation}), 1, device="cpu")


@pytest.mark.ci
def test_rsl_rl_does_not_bootstrap_from_a_terminal_state(rsl_rl):
    env = wrappers.RslRlVecEnv(FallAtTheEnd, 2, **settings)
    for _ in range(LENGTH):
        _, _, dones, extras = env.step(torch.zeros(2, env.num_actions))
    assert dones.all()
    assert not extras["time_outs"].any()


@pytest.mark.ci
def test_stable_baselines3_does_not_bootstrap_from_a_terminal_state(stable_baselines3):
    env = wrappers.StableBaselines3VecEnv(FallAtTheEnd, 2, **settings)
    env.reset()
    for _ in range(LENGTH):
        _, _, dones, infos = env.step(np.zeros((2, 6)))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]


@pytest.mark.ci
def test_rsl_rl_may_pass_actions_out_of_bounds(rsl_rl):
    env, twin = wrappers.RslRlVecEnv(make()), make()
    action = torch.linspace(-2, 2, NUM_ENVS * env.num_actions).reshape(NUM_ENVS, env.num_actions)
    expected = twin.step(twin.reset().set("action", action.clamp(-1, 1)))["next", "observation"]
    assert torch.equal(env.step(action)[0]["policy"], expected)


@pytest.mark.ci
@for_each("make_env", [make, make_with_groups])
def test_rsl_rl_sets_episode_lengths(rsl_rl, make_env):
    env = wrappers.RslRlVecEnv(make_env())
    env.episode_length_buf = torch.tensor([0, 1, 3, 4])
    assert env.episode_length_buf.tolist() == [0, 1, 3, 4]
    for expected in ([3], [2], [], [1], [0], [3]):
        _, _, _, extras = env.step(torch.zeros(NUM_ENVS, env.num_actions))
        assert extras["time_outs"].nonzero().flatten().tolist() == expected


@pytest.mark.ci
def test_rsl_rl_trains_and_bootstraps_from_the_final_observation(rsl_rl, tmp_path):
    from rsl_rl.runners import OnPolicyRunner

    from examples.train_with_rsl_rl import CONFIG

    env = wrappers.RslRlVecEnv(make_with_groups(stagger=True))
    config = copy.deepcopy(CONFIG) | {"num_steps_per_env": 8}
    config["obs_groups"] = {"actor": ["policy"], "critic": ["policy", "privileged"]}
    runner = OnPolicyRunner(env, config, log_dir=str(tmp_path))
    alg, ended = runner.alg, 0
    with torch.inference_mode():
        observations = env.get_observations()
        for i in range(8):
            observations, rewards, dones, extras = env.step(alg.act(observations))
            alg.process_env_step(observations, rewards, dones, extras)
            value = alg.critic(extras["final_observations"]).squeeze(-1)
            expected = torch.where(extras["time_outs"], rewards + alg.gamma * value, rewards)
            assert torch.equal(alg.storage.rewards[i].squeeze(-1), expected)
            ended += dones.sum().item()
    assert ended >= NUM_ENVS
    alg.storage.clear()
    runner.learn(1, init_at_random_ep_len=True)


# Stable-Baselines3.


@pytest.mark.ci
@for_each("make_env", [make, make_with_groups])
def test_stable_baselines3(stable_baselines3, steps, make_env):
    env = wrappers.StableBaselines3VecEnv(make_env(stagger=True))
    assert isinstance(env, stable_baselines3.common.vec_env.VecEnv)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(steps[0][0]["action"].numpy())

    def arrays(observation):
        return list(observation.values()) if make_env is make_with_groups else [observation]

    for x in arrays(env.reset()):
        assert np.array_equal(x, steps[0][0]["observation"])
    for step, td in steps:
        after = step["next"]
        observations, rewards, dones, infos = env.step(step["action"].numpy())
        for x in arrays(observations):
            assert np.array_equal(x, td["observation"])
        assert np.array_equal(rewards, after["reward"].squeeze(-1))
        assert np.array_equal(dones, after["done"].squeeze(-1))
        for world, info in enumerate(infos):
            if not dones[world]:
                assert info == {}
                continue
            for x in arrays(info["terminal_observation"]):
                assert np.array_equal(x, after["observation"][world])
            assert info["TimeLimit.truncated"] != after["terminated"][world].item()


@pytest.mark.ci
@for_each(("make_env", "policy"), [(make, "MlpPolicy"), (make_with_groups, "MultiInputPolicy")])
def test_stable_baselines3_seeds_and_trains(stable_baselines3, make_env, policy):
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    env = wrappers.StableBaselines3VecEnv(make_env())
    env.seed(7)
    first = env.reset()
    first = first["privileged"] if policy == "MultiInputPolicy" else first
    assert np.array_equal(first, torchrl_loco.make("walker_stand", NUM_ENVS, "cpu", 7).reset()["observation"])
    model = PPO(policy, VecMonitor(env), n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(total_timesteps=128)
    assert {episode["l"] for episode in model.ep_info_buffer} == {LENGTH}


@pytest.mark.ci
def test_stable_baselines3_records_a_video(stable_baselines3, tmp_path):
    pytest.importorskip("moviepy")
    from stable_baselines3.common.vec_env import VecVideoRecorder

    env = wrappers.StableBaselines3VecEnv(make(), **PICTURE)
    env.reset()
    assert env.render().shape == (2 * 32, 2 * 48, 3)
    env = VecVideoRecorder(env, str(tmp_path), lambda step: step == 0, video_length=3)
    env.reset()
    for _ in range(4):
        env.step(np.zeros((NUM_ENVS, 6)))
    env.close()
    (video,) = tmp_path.iterdir()
    assert len(imageio.imread(video, plugin="pyav")) == 4
    assert imageio.immeta(video, plugin="pyav")["fps"] == 1 / 0.025


@pytest.mark.ci
def test_stable_baselines3_has_one_environment(stable_baselines3):
    env = wrappers.StableBaselines3VecEnv(make())
    assert env.get_attr("render_mode") == [None] * NUM_ENVS
    assert env.get_attr("num_envs", indices=[0, 2]) == [NUM_ENVS] * 2
    assert env.env_is_wrapped(object, indices=1) == [False]
    with pytest.raises(NotImplementedError, match=r"use \.env"):
        env.env_method("health")
    with pytest.raises(NotImplementedError, match=r"set it in \.env"):
        env.set_attr("seed", 0)
