import os

if "PYTEST_XDIST_WORKER" in os.environ:  # side by side, each on one core: threads would fight for them
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

from torchrl_loco import registry

TASKS = list(registry.ENVS)  # what others may have installed beside is theirs to test
PROTOCOLS = ("playground", "dm_control")


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="no CUDA device here"))


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    return request.param


@pytest.fixture(params=TASKS)
def task(request):
    return request.param


@pytest.fixture(params=PROTOCOLS)
def protocol(request):
    return request.param


@pytest.fixture
def actions():
    """Draws reproducible actions for an environment: ``actions(env, steps)`` has shape (steps, num_envs, nu)."""

    def draw(env, steps, seed=0):
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.rand(steps, *env.action_spec.shape, generator=generator) * 2 - 1
        return drawn.to(env.device)

    return draw
