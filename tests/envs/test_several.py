"""Several environments at once: side by side, in threads, in forked processes, on other streams and devices."""

import contextlib
import functools
import gc
import os
import pickle
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from cases import COARSE
from compare import assert_repeats, played

import torchrl_loco
from torchrl_loco.garbage import no_collection
from torchrl_loco.sim import EXCLUSIVE

WORLDS = 4


def made(device="cpu", seed=0, **options):
    return torchrl_loco.make("walker_walk", WORLDS, device, seed, episode_length=6, **COARSE, **options)


def run(program, *args):
    """Runs a program in an interpreter of its own."""
    command = [sys.executable, "-c", "import quickly\n" + textwrap.dedent(program), *args]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)


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


@pytest.mark.slow
def test_threads_make_step_and_render_at_once(device, actions):
    env = made(device)
    moves, expected = actions(env, 20), []
    for seed in range(4):
        env.set_seed(seed)
        expected.append(played(env, moves))
    start = threading.Barrier(4)

    def work(seed):
        start.wait()
        env = made(device, seed)
        pixels = env.render(width=16, height=12)
        return played(env, moves), pixels.float().mean() > 0

    with ThreadPoolExecutor(4) as pool:
        for (result, lit), single in zip(pool.map(work, range(4)), expected, strict=True):
            assert_repeats(result, single)
            assert lit

    first, second = contextlib.ExitStack(), contextlib.ExitStack()  # threads in which garbage must wait
    for thread in (first, second):
        thread.enter_context(no_collection())
    first.close()
    assert not gc.isenabled()
    second.close()
    assert gc.isenabled()


def test_one_at_a_time_on_the_cpu(shared):
    """While another thread works, a reset or a picture waits for its turn."""
    env = shared()
    env.reset()
    env.render(width=16, height=12)
    for work in (env.reset, functools.partial(env.render, width=16, height=12)):
        with ThreadPoolExecutor(1) as pool:
            with EXCLUSIVE:
                waiting = pool.submit(work)
                with pytest.raises(TimeoutError):
                    waiting.result(timeout=0.3)
            waiting.result(timeout=60)


def test_what_makes_an_environment_is_pickled_and_not_the_environment(shared):
    creator = functools.partial(torchrl_loco.make, "walker_walk", 2, "cpu", 3, **COARSE)
    again = pickle.loads(pickle.dumps(creator))
    assert torch.equal(creator().reset()["observation"], again().reset()["observation"])
    with pytest.raises(TypeError, match=r"functools\.partial"):
        pickle.dumps(shared())


@pytest.mark.ci
def test_forks_and_the_end_of_a_program(tmp_path):
    """A forked child goes on by itself on the CPU, even if another thread held the lock when it was forked. A program
    may end without closing its environments: what a monitor has not reported yet is reported then, and by the parent.
    """
    good, bad = tmp_path / "good", tmp_path / "bad"
    program = f"""
        import functools, gc, os, threading, time
        import torch, torchrl_loco
        from torchrl.envs import StepCounter
        make = functools.partial(torchrl_loco.make, "walker_walk", device="cpu", seed=0, sim_dt=0.0125)
        env = make(2, nan_dump={str(bad)!r})
        busy = torchrl_loco.TransformedEnv(make(128, nan_dump={str(good)!r}), StepCounter())
        zero = torch.zeros(2, 6)

        def show(who):
            total = env.rollout(3, lambda td: td.set("action", zero))["next", "observation"].sum()
            print(who, float(total), flush=True)

        env.step(env.reset().set("action", zero + float("nan")))
        going = True

        def work():
            td = busy.reset()
            while going:
                busy._step(td.set("action", torch.zeros(128, 6)))

        thread = threading.Thread(target=work)
        thread.start()
        time.sleep(0.2)
        pid = os.fork()
        if pid == 0:
            show("child")
            del env
            gc.collect()
            raise SystemExit
        going = False
        deadline, done = time.time() + 60, 0
        while not done and time.time() < deadline:
            done, status = os.waitpid(pid, os.WNOHANG)
            time.sleep(0.02)
        if not done:
            os.kill(pid, 9)
            print("the child hangs", flush=True)
        thread.join()
        show("parent")
        """
    found = run(program)
    assert found.returncode == 0, found.stderr
    (child, of_child), (parent, of_parent) = (line.split() for line in found.stdout.splitlines())
    assert (child, parent) == ("child", "parent")
    assert of_child == of_parent
    assert bad.exists()
    assert not good.exists()
    assert found.stderr.count("became non-finite in step 1") == 1


@pytest.mark.gpu
def test_a_fork_is_refused_on_cuda():
    program = """
        import os, warnings
        warnings.simplefilter("ignore")
        import torch, torchrl_loco
        env = torchrl_loco.make("walker_walk", 2, "cuda", 0)
        td = env.reset()
        env.step(td.set("action", torch.zeros(2, 6, device=env.device)))
        pid = os.fork()
        if pid == 0:
            try:
                env.reset()
            except Exception as error:
                print(type(error).__name__, error, flush=True)
            os._exit(0)
        os.waitpid(pid, 0)
        """
    found = run(program)
    assert "RuntimeError CUDA cannot be used after a fork" in found.stdout, found.stdout + found.stderr


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
def test_on_the_second_device(actions):
    expected = played(made("cuda:0"), actions(made("cuda:0"), 8))
    for current in (0, 1):
        with torch.cuda.device(current):
            env = made("cuda:1")
            result = played(env, actions(env, 8))
            pixels = env.render(width=16, height=12)
        assert env.device == result.device == pixels.device == torch.device("cuda:1")
        torch.testing.assert_close(result.cpu(), expected.cpu(), rtol=1e-2, atol=1e-2)
