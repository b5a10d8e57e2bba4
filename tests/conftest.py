import os

os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")  # trio's, which is imported for nothing
if "PYTEST_XDIST_WORKER" in os.environ:  # workers share the cores: more threads than one each would slow them down
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import contextlib
import gc
import tempfile
import types

import pytest
from cases import ENGINES, KINDS

STATE = tempfile.TemporaryDirectory()
os.environ["XDG_STATE_HOME"] = STATE.name  # files that tests run are forgotten after them

gc.disable()  # until all is imported: see pytest_collection_finish

# torch and Warp are imported in functions: the process that distributes tests to workers reads this file, too.


def pytest_collectstart():
    """Prepares the process in which tests will run."""
    import hook_tasks  # noqa: F401, registers its tasks
    import quickly  # noqa: F401, before anything makes a kernel
    from hypothesis.internal.conjecture import providers

    # So that draws repeat: hypothesis takes constants from all that a process has imported, which differs by its tests.
    providers._get_local_constants = providers.Constants


def pytest_collection_finish():
    """Lets Python search for garbage again, but rarely, and not among what was imported, which takes it a second."""
    with contextlib.suppress(ModuleNotFoundError):  # on a machine that has a GPU and no videos
        import imageio.plugins.pyav

        imageio.plugins.pyav.gc = types.SimpleNamespace(collect=lambda: None)  # after each video
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


def pytest_collection_modifyitems(items):
    """Leaves what cannot run here, and MuJoCo-Warp's engine, out of the everyday part."""
    import torch

    for item in items:
        if hasattr(item, "callspec") and "mujoco_warp" in item.callspec.id:
            item.add_marker(pytest.mark.slow)
        if "gpu" in item.keywords and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="no CUDA device here"))


@pytest.fixture(autouse=True)
def torch_generator():
    """Seeds torch, so that random actions are the same whichever tests ran before in the same process."""
    import torch

    torch.manual_seed(0)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    return request.param


@pytest.fixture
def cuda_memory():
    """Returns a function that gives the bytes in use on the GPU by this process, whatever others have there."""
    import torch
    import warp as wp

    def used():
        gc.collect()
        torch.cuda.synchronize()
        # What is requested, not what is allocated for it: torch does not split a block to save less than 1 MB.
        requested = torch.cuda.memory_stats()["requested_bytes.all.current"]
        return requested + wp.get_mempool_used_mem_current("cuda")

    return used


@pytest.fixture(params=ENGINES)
def kinds(request):
    """The kinds of tasks that an engine steps, each a task, its protocol and its engine."""
    return [kind for kind in KINDS if kind[2] == request.param]


@pytest.fixture(params=ENGINES)
def engine(request):
    return request.param


@pytest.fixture(scope="session")
def shared():
    """Makes environments once in a session: ``shared(task, num_envs, device, seed, **options)``.

    Each use starts the random streams again, so that after a reset the environment does what a new one does. Pass
    ``copy`` for a second one of the same settings. A test that writes to the environment's internals makes its own.
    """
    import torchrl_loco

    made = {}

    def get(task="walker_run", num_envs=4, device="cpu", seed=0, *, copy=0, **options):
        if options.get("engine") == "auto":
            del options["engine"]  # the default
        key = (task, num_envs, device, copy, *sorted(options.items()))
        if key not in made:
            made[key] = torchrl_loco.make(task, num_envs, device, seed, **options)
        made[key].set_seed(seed)
        return made[key]

    return get


@pytest.fixture(scope="session")
def actions():
    """Draws reproducible actions for an environment: ``actions(env, steps)`` has shape (steps, num_envs, nu)."""
    import torch

    def draw(env, steps, seed=0):
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.rand(steps, *env.action_spec.shape, generator=generator) * 2 - 1
        return drawn.to(env.device)

    return draw
