import signal

import pytest
import torch
from small_runs import small_walker, trained


@pytest.fixture(autouse=True)
def small():
    """All runs are of the small walker, and torch computes in one thread: several would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with small_walker():
        yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def ctrl_c():
    """Ctrl-C as in a terminal: a shell starts processes in the background with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def run_of(tmp_path_factory):
    """Returns the finished run of an algorithm, trained once in a session: copy its folder to change it."""
    runs = {}

    def get(algorithm):
        if algorithm not in runs:
            with small_walker():
                runs[algorithm] = trained(tmp_path_factory.mktemp("runs"), algorithm, video_seconds=0.05)
        return runs[algorithm]

    return get


@pytest.fixture(params=["ppo", "reppo"])
def run(request, run_of):
    return run_of(request.param)


@pytest.fixture
def ppo_run(run_of):
    return run_of("ppo")
