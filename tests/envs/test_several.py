"""Several environments at once: side by side, in threads, in other processes, on other streams and devices; and the end
of one."""

import functools
import gc
import pickle
import subprocess
import sys
import textwrap
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector

import torchrl_loco
from torchrl_loco.sim import EXCLUSIVE

WORLDS = 4


def made(device="cpu", seed=0, task="walker_walk", **options):
    return torchrl_loco.make(task, WORLDS, device, seed, episode_length=6, **options)


def played(env, moves):
    """Returns the observations of a rollout of ``moves`` across episodes."""
    td, observations = env.reset(), []
    for action in moves:
        current, td = env.step_and_maybe_reset(td.set("action", action))
        observations.append(current["next", "observation"])
    return torch.stack(observations)


def assert_repeats(first, second):
    """Equal bit for bit on the CPU; on CUDA, where sums are in no fixed order, for as long as rounding stays small."""
    exact = first.device.type == "cpu"
    torch.testing.assert_close(first, second, rtol=0 if exact else 1e-2, atol=0 if exact else 1e-2)


def test_two_on_one_device_do_not_mix(device, actions):
    envs = [made(device, seed) for seed in (1, 2)]
    moves = actions(envs[0], 8)
    alone = [played(env, moves) for env in envs]
    for env in envs:
        env.set_seed(env.seed)
    tds = [env.reset() for env in envs]
    for step, action in enumerate(moves):
        for i, env in enumerate(envs):
            current, tds[i] = env.step_and_maybe_reset(tds[i].set("action", action))
            assert_repeats(current["next", "observation"], alone[i][step])


def test_threads_make_step_and_render_at_once(device, actions):
    expected = [played(made(device, seed), actions(made(device), 20)) for seed in range(4)]
    start = threading.Barrier(4)

    def work(seed):
        start.wait()
        env = made(device, seed)
        pixels = env.render(width=16, height=12)
        result = played(env, actions(env, 20))
        return result, pixels.float().mean() > 0

    with ThreadPoolExecutor(4) as pool:
        for (result, lit), single in zip(pool.map(work, range(4)), expected, strict=True):
            assert_repeats(result, single)
            assert lit


@pytest.mark.parametrize("work", ["reset", "render"])
def test_one_at_a_time_on_the_cpu(work):
    """While another thread works, a step or a picture waits for its turn."""
    env = made()
    env.reset()
    env.render()
    with ThreadPoolExecutor(1) as pool:
        with EXCLUSIVE:
            waiting = pool.submit(getattr(env, work))
            with pytest.raises(TimeoutError):
                waiting.result(timeout=0.5)
        waiting.result(timeout=60)


def test_a_pickled_creator_makes_the_same():
    creator = functools.partial(torchrl_loco.make, "walker_walk", 2, "cpu", 3)
    again = pickle.loads(pickle.dumps(creator))
    assert torch.equal(creator().rollout(3)["observation"][:, 0], again().rollout(3)["observation"][:, 0])


def test_an_environment_itself_is_not_pickled():
    with pytest.raises(TypeError, match="pass on what makes it"):
        pickle.dumps(made())


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:TensorFloat32")  # of Inductor's
@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.gpu)])
def test_a_compiled_policy(backend, actions):
    device = "cuda" if backend == "inductor" else "cpu"
    env = made(device)
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(24, 8), nn.Tanh(), nn.Linear(8, 6), nn.Tanh()).to(device)
    plain = TensorDictModule(network, in_keys=["observation"], out_keys=["action"])
    compiled = TensorDictModule(torch.compile(network, backend=backend), in_keys=["observation"], out_keys=["action"])
    results = []
    for policy in (plain, compiled):
        env.set_seed(0)
        with torch.no_grad():
            results.append(env.rollout(8, policy, break_when_any_done=False)["observation"])
    torch.testing.assert_close(*results, rtol=1e-2, atol=1e-2)


def forked(body):
    """Runs a program that forks after it has made and stepped ``env``; the child runs ``body``."""
    program = f"""
        import os, sys, warnings
        warnings.simplefilter("ignore")
        import torch, torchrl_loco
        env = torchrl_loco.make("walker_walk", 2, sys.argv[1], 0)
        td = env.reset()
        env.step(td.set("action", torch.zeros(2, 6, device=env.device)))
        pid = os.fork()
        if pid == 0:
            try:
                {body}
            except Exception as error:
                print(type(error).__name__, error, flush=True)
            os._exit(0)
        os.waitpid(pid, 0)
        """
    return textwrap.dedent(program)


@pytest.mark.slow
def test_a_fork_goes_on_by_itself_on_the_cpu():
    program = forked('print("sum", float(env.rollout(3)["next", "observation"].sum()), flush=True)')
    program += 'print("sum", float(env.rollout(3)["next", "observation"].sum()), flush=True)\n'
    program = program.replace("env.rollout(3)", 'env.rollout(3, lambda td: td.set("action", torch.zeros(2, 6)))')
    found = subprocess.run([sys.executable, "-c", program, "cpu"], capture_output=True, text=True, timeout=300)
    child, parent = found.stdout.splitlines()
    assert child.startswith("sum")
    assert child == parent, found.stdout + found.stderr


@pytest.mark.gpu
def test_a_fork_is_refused_on_cuda():
    program = forked("env.reset()")
    found = subprocess.run([sys.executable, "-c", program, "cuda"], capture_output=True, text=True, timeout=300)
    assert "RuntimeError CUDA does not survive a fork" in found.stdout, found.stdout + found.stderr


@pytest.mark.gpu
def test_made_and_stepped_on_another_stream(actions):
    expected = played(made("cuda"), actions(made("cuda"), 8))
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        env = made("cuda")
        result = played(env, actions(env, 8))
    stream.synchronize()
    assert_repeats(result, expected)


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
@pytest.mark.parametrize("current", [0, 1])
def test_on_the_second_device(current, actions):
    expected = played(made("cuda:0"), actions(made("cuda:0"), 8))
    with torch.cuda.device(current):
        env = made("cuda:1")
        result = played(env, actions(env, 8))
        pixels = env.render(width=16, height=12)
    assert env.device == result.device == pixels.device == torch.device("cuda:1")
    torch.testing.assert_close(result.cpu(), expected.cpu(), rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize(
    "use",
    [
        lambda env: env.step(env.fake_tensordict()),
        lambda env: env.health(),
        lambda env: env.get_state(),
        lambda env: env.render(),
        lambda env: env.mj_model,
        lambda env: env.state_dict(),
        lambda env: env.set_seed(1),
    ],
    ids=["step", "health", "get_state", "render", "mj_model", "state_dict", "set_seed"],
)
def test_closed_means_closed(use):
    env = made()
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match=r"this WalkerWalk is closed: reset\(\) opens it again"):
        use(env)


def test_reset_opens_it_again(device, tmp_path, actions):
    """As it was when it was made, but for the random streams, which go on."""
    options = {"reward_terms": True, "bad_world_file": tmp_path / "bad"}
    env, never_closed = made(device, **options), made(device)
    moves = actions(env, 8)
    for other in (env, never_closed):
        played(other, moves)
    env.close()
    assert_repeats(played(env, moves), played(never_closed, moves))
    assert env.health()["total", "non_finite"] == 0
    assert not env.is_closed
    env.step(env.reset().set("action", torch.full_like(moves[0], float("nan"))))
    with pytest.warns(torchrl_loco.NonFiniteWarning):
        env.close()
    env.reset()  # the file is there now


@pytest.mark.filterwarnings("ignore:The default value of `auto_register_policy_transforms`")
def test_a_collector_closes_and_the_environment_goes_on():
    env = made()
    options = {"frames_per_batch": 8, "total_frames": 16, "auto_register_policy_transforms": False}
    assert len(list(Collector(env, None, **options))) == 2
    assert env.rollout(3).shape == (WORLDS, 3)


@pytest.mark.parametrize("way", ["close", "del", "transformed"])
def test_nothing_holds_on_to_a_closed_environment(way):
    env = made()
    env.rollout(3)
    env.render(width=16, height=12)
    held = [weakref.ref(thing) for thing in (env.sim, env.sim.data, env._step_graph, env._observation)]
    if way == "close":
        env.close()
    elif way == "transformed":
        env = torchrl_loco.TransformedEnv(env)
        env.close()
    else:
        del env
    gc.collect()
    assert [ref() for ref in held] == [None] * len(held)


@pytest.mark.gpu
def test_close_frees_device_memory():
    def used():
        gc.collect()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info()
        return (total - free) / 2**20

    def live(num_envs):
        env = torchrl_loco.make("humanoid_walk", num_envs, "cuda", 0)
        env.rollout(3)
        return env

    live(4096).close()  # loads what stays loaded
    before = used()
    left = []
    for _ in range(3):
        env = live(4096)
        taken = used() - before
        env.close()
        left.append(used() - before)
    assert taken > 300  # MiB
    assert left[0] < 0.15 * taken  # Warp's pool holds on to some
    assert left[2] <= left[0]


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", [False, True], ids=["well", "bad"])
def test_a_program_may_end_without_closing(spoilt, tmp_path):
    """It ends in peace, and what was caught in its last steps is written."""
    program = f"""
        import torch, torchrl_loco
        from torchrl.envs import StepCounter
        env = torchrl_loco.make("walker_walk", 2, "cpu", 0, bad_world_file={str(tmp_path / "bad")!r})
        other = torchrl_loco.TransformedEnv(torchrl_loco.make("walker_walk", 2, "cpu", 0), StepCounter())
        other.rollout(2)
        td = env.reset()
        env.step(td.set("action", torch.full((2, 6), float("nan") if {spoilt} else 0.0)))
        """
    found = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=300
    )
    assert found.returncode == 0, found.stderr
    assert (tmp_path / "bad").exists() == spoilt
    assert ("no longer finite at step 1" in found.stderr) == spoilt


def test_a_failed_opening_leaves_nothing_behind(actions, monkeypatch):
    env, never_closed = made(), made()
    moves = actions(env, 8)
    for other in (env, never_closed):
        played(other, moves)
    env.close()
    with monkeypatch.context() as broken:
        broken.setattr(type(env), "_prepare", lambda self: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.reset()
    env.close()
    assert env.is_closed
    assert_repeats(played(env, moves), played(never_closed, moves))
    held = weakref.ref(env.sim)
    env.close()
    gc.collect()
    assert held() is None


def test_a_closed_environment_is_reset_as_a_whole():
    env = made()
    td = env.reset()
    env.close()
    mask = torch.tensor([[True], [False], [False], [False]])
    with pytest.raises(ValueError, match="reset all of them"):
        env.reset(td.set("_reset", mask))


@pytest.mark.slow
def test_a_fork_while_another_thread_works():
    """The child does not wait for a lock that a thread held which it does not have."""
    program = """
        import os, threading, time, warnings
        warnings.simplefilter("ignore")
        import torch, torchrl_loco
        busy, env = (torchrl_loco.make("walker_walk", n, "cpu", 0) for n in (256, 2))
        going = True
        def work():
            td = busy.reset()
            while going:
                busy._step(td.set("action", torch.zeros(256, 6)))
        thread = threading.Thread(target=work)
        thread.start()
        time.sleep(1)
        pid = os.fork()
        if pid == 0:
            env.reset()
            os._exit(7)
        deadline = time.time() + 60
        done, status = 0, 0
        while not done and time.time() < deadline:
            done, status = os.waitpid(pid, os.WNOHANG)
            time.sleep(0.1)
        if not done:
            os.kill(pid, 9)
        going = False
        thread.join()
        print(os.waitstatus_to_exitcode(status) if done else "hangs")
        """
    found = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=300
    )
    assert found.stdout.split() == ["7"], found.stdout + found.stderr
