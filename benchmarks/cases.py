"""What is measured: each case makes a function that advances all worlds by one control step."""

import itertools
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import mujoco_warp as mjw
import torch
import warp as wp
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from tqdm import tqdm

import torchrl_loco
from benchmarks.tasks import TASKS
from torchrl_loco import RolloutCollector
from torchrl_loco.config import sim_config
from torchrl_loco.registry import env_class
from torchrl_loco.sim import Simulation, current_stream, models
from torchrl_loco.training import preset
from torchrl_loco.training.actor import Spaces
from torchrl_loco.training.algorithm import settings_for_small_networks
from torchrl_loco.training.process import interruptible
from torchrl_loco.training.reppo import REPPO

Run = TypeVar("Run")
INTERRUPTED = threading.Event()
"""Whether only a part was measured."""

BATCH_STEPS = 20
"""Control steps in a batch of the collectors."""


def until_interrupted(runs: Sequence[Run], name: str) -> Iterator[Run]:
    """Yields what is to be measured, under a progress bar.

    Ctrl-C or SIGTERM ends it after the present one, and sets ``INTERRUPTED``: what was measured until then is shown and
    kept. A second signal stops at once.
    """
    with interruptible() as interrupted:
        for run in tqdm(runs, desc=name):
            yield run
            if interrupted():
                INTERRUPTED.set()
                return


def waiter(device: torch.device) -> Callable[[], None]:
    """Returns what waits for all work on a device."""
    return (lambda: torch.cuda.synchronize(device)) if device.type == "cuda" else (lambda: None)


def bare_default(body: str, n: int, device: torch.device, protocol: str = "playground") -> Callable[[], None]:
    """A plain loop of ``mujoco_warp.step`` in a graph, with mujoco_warp's own settings but for the printing."""
    config = sim_config(env_class(TASKS[body]).config, protocol, n, {"engine": "mujoco_warp"})
    sim = Simulation(models.load(env_class(TASKS[body]).model), config, n, device)
    sim.model.opt.graph_conditional, sim.model.opt.run_qacc_smooth = True, True
    mask, draw = wp.ones(n, dtype=bool, device=sim.device), random_controls(sim)
    with wp.ScopedDevice(sim.device):
        sim.reset(mask)
        mjw.step(sim.model, sim.data)
        with wp.ScopedCapture(device=sim.device) as capture:
            for _ in range(config.substeps):
                mjw.step(sim.model, sim.data)
    wp.synchronize_device(sim.device)

    def step() -> None:
        draw()
        wp.capture_launch(capture.graph, stream=current_stream(sim.device))

    return step


def bare_tuned(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """MuJoCo-Warp as this library sets it, in a graph, without observation or reward."""
    return _bare(body, n, device, "mujoco_warp")


def bare_compiled(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """The compiled step, without observation or reward."""
    return _bare(body, n, device, "compiled")


def _bare(body: str, n: int, device: torch.device, engine: str) -> Callable[[], None]:
    config = sim_config(env_class(TASKS[body]).config, "playground", n, {"engine": engine})
    sim = Simulation(models.load(env_class(TASKS[body]).model), config, n, device)
    mask, draw = wp.ones(n, dtype=bool, device=sim.device), random_controls(sim)
    graph = sim.capture(sim.step)
    sim.capture(lambda: sim.reset(mask)).replay()

    def step() -> None:
        draw()
        graph.replay()

    return step


def random_controls(sim: Simulation) -> Callable[[], None]:
    """Returns what draws all controls anew: of servos, targets that are at most 0.5 rad from the home pose."""
    m, middle, reach = sim.mj_model, torch.zeros(sim.mj_model.nu), 1.0
    if m.actuator_biastype.any():
        middle, reach = torch.tensor(models.home_pose(m)[m.jnt_qposadr[m.actuator_trnid[:, 0]]]).float(), 0.5
    middle = middle.to(sim.ctrl.device)

    def draw() -> None:
        sim.ctrl.uniform_(-reach, reach)
        if reach < 1.0:
            sim.ctrl.add_(middle)

    return draw


def env_step(body: str, n: int, device: torch.device, **options: Any) -> Callable[[], None]:
    """Physics, observation and reward on random actions, as graphs on CUDA, without TensorDicts and resets."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True, **options)
    env.reset()
    return lambda: env.world.step(env.world.action.torch.uniform_(-1.0, 1.0))


def env_step_and_maybe_reset(body: str, n: int, device: torch.device, **options: Any) -> Callable[[], None]:
    """``env.step_and_maybe_reset`` on random actions, worlds at different points of their episodes."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True, **options)
    carried = [env.reset()]

    def step() -> None:
        action = torch.empty(env.action_spec.shape, device=device).uniform_(-1.0, 1.0)
        _, carried[0] = env.step_and_maybe_reset(carried[0].set("action", action))

    return step


def env_step_dm_control(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """``env_step`` under ``protocol="dm_control"``."""
    return env_step(body, n, device, protocol="dm_control")


def env_deterministic(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """``env_step_and_maybe_reset`` under MuJoCo-Warp with ``deterministic=True``, as the compiled engine always is."""
    return env_step_and_maybe_reset(body, n, device, engine="mujoco_warp", deterministic=True)


def rollout_collector(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """Our collection loop with a policy of two hidden layers of 256."""
    env, policy = env_and_policy(body, n, device)
    return every_batch(RolloutCollector(env, policy, frames_per_batch=n * BATCH_STEPS))


def torchrl_collector(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """TorchRL's Collector with the same policy and batches."""
    env, policy = env_and_policy(body, n, device)
    collector = Collector(
        env,
        policy,
        frames_per_batch=n * BATCH_STEPS,
        total_frames=-1,
        device=device,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
        trust_policy=True,
    )
    return every_batch(collector)


def update(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """REPPO's gradient steps on one step of all worlds, with the settings for the task."""
    config = preset(TASKS[body], device, "reppo", num_envs=n, num_steps=1, epochs=1)
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True)
    learner = REPPO(config, Spaces.of(env))
    batch = RolloutCollector(env, learner.acting(), frames_per_batch=n).rollout().clone()

    def step() -> None:
        with settings_for_small_networks(), torch.enable_grad():
            learner.update(batch, progress=0.0)

    return step


def env_and_policy(body: str, n: int, device: torch.device) -> tuple[EnvBase, TensorDictModule]:
    """An environment with staggered episodes, and a policy for it."""
    torch.set_float32_matmul_precision("high")  # TF32, as training does
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True)
    policy = NoisyMLP(env.observation_size, env.action_spec.shape[-1]).to(device)
    return env, TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])


class NoisyMLP(nn.Module):
    """The work of two hidden layers of 256, under noise that makes the worlds move as under random actions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        layers = [nn.Linear(inputs, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), nn.Linear(256, outputs)]
        self.net = nn.Sequential(*layers, nn.Tanh())

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        action = self.net(observation)
        return torch.empty_like(action).uniform_(-1.0, 1.0).add_(action, alpha=1e-3).clamp_(-1.0, 1.0)


def every_batch(collector: Iterable[TensorDictBase]) -> Callable[[], None]:
    """Takes a batch at every 20th call, so that a call costs a step on average."""
    batches, calls = iter(collector), itertools.count()

    def step() -> None:
        if next(calls) % BATCH_STEPS == 0:
            next(batches)

    return step


CASES = {
    case.__name__: case
    for case in (
        bare_default,
        bare_tuned,
        bare_compiled,
        env_step,
        env_step_and_maybe_reset,
        rollout_collector,
        torchrl_collector,
    )
}
"""From the bare simulator to a collector."""
VARIANTS = {case.__name__: case for case in (env_step_dm_control, env_deterministic)}
"""What settings cost."""
LEARNING = {update.__name__: update}
"""What learning costs, of which only a profile is taken."""
