"""From an exported policy to a report: whether it holds in C MuJoCo, beside the engine in which it was trained.

Both are the policy's own task, with ``engine="mujoco"`` and as it was trained: the same hooks, episodes and draws.
"""

import contextlib
import dataclasses
import json
import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from tqdm.auto import trange

from torchrl_loco.checks import check_bool, check_packages
from torchrl_loco.conditions import DEFAULT, PUSH, PUSH_EVERY, Conditions
from torchrl_loco.config import SimConfig, arguments_of
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.access import set_stage
from torchrl_loco.envs.task import folder_of, own_hooks
from torchrl_loco.envs.vary import Vary
from torchrl_loco.known_files import place_of
from torchrl_loco.policy import check_terms, in_task, with_options, without_returns
from torchrl_loco.registry import resolve
from torchrl_loco.sim import models
from torchrl_loco.source import is_edited

ENGINES = ("C MuJoCo", "training simulator")
UNDISTURBED = Conditions(delay=(0, 0), noise=0.0, pushes=0.0)  # in which each case of a task is played once


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        holds: whether the policy holds.
        lines: it, to be printed.
        figures: it, as JSON can hold it.
    """

    holds: bool
    lines: list[str]
    figures: dict[str, Any]


class Exported:
    """A policy in an ONNX file that :func:`torchrl_loco.export_policy` wrote, of the task that the user or it names."""

    def __init__(self, path: Path, task: str | None = None) -> None:
        import onnxruntime

        if not Path(path).is_file():
            raise FileNotFoundError(f"there is no file {path}")
        try:
            self._session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's have no base of their own
            raise ValueError(f"{path} cannot be read as an ONNX file: {error}") from error
        self.facts: dict[str, Any] = {}  # what the file says, by name: see torchrl_loco.export.of_robot
        for name, word in self._session.get_modelmeta().custom_metadata_map.items():
            self.facts[name] = word
            with contextlib.suppress(json.JSONDecodeError):  # words are not quoted
                self.facts[name] = json.loads(word)
        if "task" not in self.facts:
            raise ValueError(f"{path} does not say its task: it must be a file that torchrl-loco export wrote")
        self.facts["task"] = place_of(self.facts["task"], Path(path).parent)
        if task is not None:
            self.facts["info"] = in_task(self.facts.get("info", {}), self.facts["task"], task)
            self.facts["task"] = task
        self.reads = "pixels" if self.facts.get("info", {}).get("from_pixels") else "observation"

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Returns the actions ``(n, nu)`` for observations ``(n, size)``, on their device."""
        inputs = {"observation": observation.cpu().numpy()}
        if len(self._session.get_inputs()) > 1:  # the frame of a reference that it gives too
            inputs["time_step"] = np.zeros(len(observation), dtype=np.int64)
        (action,) = self._session.run(["action"], inputs)
        return torch.from_numpy(action).to(observation.device)


def verify(
    path: Path,
    conditions: Conditions = DEFAULT,
    device: str | None = None,
    *,
    alone: bool = False,
    task: str | None = None,
    options: Callable[[str], Mapping[str, Any]] | None = None,
) -> Report:
    """Plays an exported policy in C MuJoCo, beside the engine in which it was trained.

    Both play the same episodes of its task: the same starts, commands, late actions, noise, friction and pushes, where
    the task's own hooks reward, end and measure.

    Args:
        path: an ONNX file that :func:`torchrl_loco.export_policy` wrote.
        conditions: what it must hold in.
        device: where the engine of the training computes; ``None`` takes CUDA if there is any.
        alone: whether to play it in C MuJoCo alone, which is quicker on a CPU.
        task: the name of its task, as the user says; ``None`` for what the file says.
        options: returns options of the task that replace those of its training, from the task's name.

    Returns:
        What was found.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it does not fit its task, or the task cannot have these conditions.
        ImportError: onnxruntime is missing, or the task is.
    """
    check_packages("verifying", ("onnxruntime",), "onnx")
    conditions.check()
    check_bool("alone", alone)
    exported = Exported(path, task)
    cls = resolve(exported.facts["task"])
    info = exported.facts.get("info", {})
    if options is not None and (given := options(exported.facts["task"])):
        info = with_options(info, given)
    if is_edited(info, exported.facts["task"]):
        say = logging.getLogger("torchrl_loco").warning
        say("%s was edited since the training, whose return is not compared", exported.facts["task"])
        info = without_returns(info)
    exported.facts["info"] = info
    conditions = conditions.of(cls.holds)
    if alone:
        check_alone(cls, conditions)
    engines = ENGINES[:1] if alone else ENGINES
    cases = _by_case(cls, exported, conditions, engines, device)
    if cases:  # each is played
        conditions = dataclasses.replace(conditions, episodes=max(conditions.episodes, len(cases[ENGINES[0]])))
    outcomes, env = dict[str, Outcome](), None
    for name in engines:
        env = _worlds(cls, exported, conditions, name, device)
        if env.num_envs > 1 and name == ENGINES[0] and _begins_alike(env, conditions):
            conditions = dataclasses.replace(conditions, episodes=1)
            env = _worlds(cls, exported, conditions, name, device)
        outcomes[name] = play(exported, env, conditions, name)
    assert env is not None
    return _report(exported, cls, conditions, outcomes, env.config, cases)


def _by_case(
    cls: Any, exported: "Exported", conditions: Conditions, engines: tuple[str, ...], device: str | None
) -> dict[str, dict[str, dict[str, Any]]]:
    """Plays each case of a task once from its beginning, without delay, noise, pushes or another friction.

    Returns:
        By engine and case: what it earned of the terms that tell how well it was played, as a share of what is perfect,
        nothing after it has ended too soon; whether it has; and the share of its steps until then. Nothing where a task
        has no cases.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    if cls.cases is LocoEnv.cases or not cls.perfect:
        return found
    one = _worlds(cls, exported, dataclasses.replace(UNDISTURBED, episodes=1), ENGINES[0], device, compile_hooks=False)
    if not (cases := one.cases()):
        return found
    once = dataclasses.replace(UNDISTURBED, episodes=len(cases), seconds=conditions.seconds)
    for engine in engines:
        env = _worlds(cls, exported, once, engine, device)
        played = play(exported, env, once, f"cases, {engine}")
        steps = np.minimum(list(cases.values()), played.steps_of_episode)
        earned = np.sum([played.sums[name][0] for name in cls.perfect], axis=0)
        shares = earned / (sum(cls.perfect.values()) * env.config.ctrl_dt * steps)
        figures = {"return": shares.tolist(), "failed": played.fell.tolist(), "lasted": (played.steps / steps).tolist()}
        found[engine] = {name: {key: values[k] for key, values in figures.items()} for k, name in enumerate(cases)}
    return found


def _case_lines(cases: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    """Returns how each case was played by itself, the worst in C MuJoCo first."""
    if not cases:
        return []
    there = cases[ENGINES[0]]
    rows: list[tuple[str, list[str]]] = [("each once, undisturbed; return of 1 is perfect", list(cases))]
    for name in sorted(there, key=lambda name: there[name]["return"]):
        found = [played[name] for played in cases.values()]
        ends = [f", failed at {row['lasted']:.0%}" if row["failed"] else "" for row in found]
        rows.append((name, [f"{row['return']:.3f}{end}" for row, end in zip(found, ends, strict=True)]))
    of_all = [list(played.values()) for played in cases.values()]
    means = [np.mean([row["return"] for row in played]) for played in of_all]
    failed = [sum(row["failed"] for row in played) for played in of_all]
    words = [f"{mean:.4f}, {count} failed" for mean, count in zip(means, failed, strict=True)]
    return _table([*rows, (f"{len(there)} in all", words)], max(map(len, there)), 22)


def _worlds(
    cls: Any, exported: Exported, conditions: Conditions, engine: str, device: str | None, **more: Any
) -> LocoEnv:
    """Returns worlds of a policy's task, a world for each episode."""
    facts, settings = exported.facts, arguments_of(exported.facts.get("info", {}))
    if conditions.friction is not None:
        ground = cls.model.geom("terrain") if isinstance(cls.model, mujoco.MjSpec) else None
        geoms = None if ground is None else r"(?!terrain(_\d+)?$).*"  # numbers of many boxes cannot vary
        settings["randomize"] = [Vary("geom_friction", *conditions.friction, of=geoms, how="set", once=True)]
        if len(models.specification(cls.model, folder_of(cls)).pairs):  # which have a friction of their own
            settings["randomize"].append(Vary("pair_friction", *conditions.friction, how="set", once=True))
    if engine == ENGINES[0]:
        device, settings["engine"] = "cpu", "mujoco"
    env = cls(
        *(conditions.episodes, device, conditions.seed, facts["protocol"]),
        **{"world_offset": 0, "play": True, "noise_scale": conditions.noise, "metrics": True, "reward_terms": True},
        **settings,
        **more,
    )
    for name, size, asked in (
        ("observation", facts["observation_size"], env.observation_spec[exported.reads].shape[1:].numel()),
        ("action", facts["action_size"], env.mj_model.nu),
    ):
        if size != asked:
            raise ValueError(f"the policy has {size} numbers of the {name}, {facts['task']} has {asked}")
    terms = [(each["term"], each["size"]) for each in facts.get("observation", ())]
    check_terms(terms, env.observation_layout.get(exported.reads, {}), facts["task"])
    return env


def _begins_alike(env: LocoEnv, conditions: Conditions) -> bool:
    env.reset()
    same = all(bool((view == view[:1]).all()) for view in (env.sim.qpos, env.sim.qvel))
    least, most = conditions.delay or (0, 0)
    varied = conditions.friction is not None or conditions.pushes or least != most
    draws = env.hooks is not None and (env.hooks.own or env.memory)
    return same and not varied and not draws


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a policy did, by episode: each array is ``(n,)``."""

    fell: np.ndarray  # whether it terminated
    steps: np.ndarray  # control steps until then or to the end
    returns: np.ndarray
    sums: dict[str, tuple[np.ndarray, np.ndarray]]  # of terms and metrics, and over how many control steps
    delay: np.ndarray  # control steps by which actions were late
    is_fixed: np.ndarray  # whether it had one command throughout
    steps_of_episode: int  # control steps of a whole one
    metrics: tuple[str, ...]
    cases: tuple[str, ...]  # names of those that the episodes play in turn

    def by_case(self) -> dict[str, dict[str, Any]]:
        """Returns the figures of each case that was played, as :meth:`of` has them."""
        played = np.arange(len(self.fell))
        named = [(name, played % len(self.cases) == k) for k, name in enumerate(self.cases)]
        return {name: self.of(episodes) for name, episodes in named if episodes.any()}

    def rows(self) -> dict[str, np.ndarray]:
        """Returns by name the episodes of each kind, as masks ``(n,)``."""
        rows = {"all": np.ones(len(self.fell), dtype=bool)}
        if self.is_fixed.any():
            rows |= {"fixed commands": self.is_fixed, "drawn commands": ~self.is_fixed}
        if len(delays := np.unique(self.delay)) > 1:
            rows |= {f"delay {delay}": self.delay == delay for delay in delays}
        return rows

    def of(self, episodes: np.ndarray) -> dict[str, Any]:
        """Returns falls, mean length (control steps), mean return, and means of terms and metrics over control steps.

        A mean is ``None`` if no control step of these episodes counts.
        """
        means = {}
        for name, (total, counted) in self.sums.items():
            count = float(counted[episodes].sum())
            means[name] = float(total[episodes].sum()) / count if count else None
        return {
            "episodes": int(episodes.sum()),
            "falls": int(self.fell[episodes].sum()),
            "mean_steps": float(self.steps[episodes].mean()),
            "return": float(self.returns[episodes].mean()),
            **means,
        }


def keeps_a_share(cls: type[LocoEnv]) -> bool:
    """Returns whether a policy must keep a share of its return, as the task asks for neither falls nor a return."""
    return not {"falls", "return"} & cls.holds.keys()


def check_alone(cls: type[LocoEnv], conditions: Conditions) -> None:
    """Checks that C MuJoCo alone can tell whether a policy holds."""
    if conditions.min_return is not None:
        raise ValueError("min_return is a share of the return in the training simulator: it cannot be asked for alone")
    if not keeps_a_share(cls):
        return
    held = f"{cls.__name__} is held to its return in the training simulator"
    if "terminated" not in own_hooks(cls):
        raise ValueError(f"{held}, and no episode of it falls: it cannot be played alone")
    if conditions.max_falls is None:
        raise ValueError(f"{held}: to play it alone, ask for max_falls")


def play(exported: Exported, env: LocoEnv, conditions: Conditions, label: str) -> Outcome:
    """Returns how the policy does in worlds of its task, one for each episode, beside a progress bar with a label."""
    n, steps, dt = env.num_envs, env.config.episode_length, env.config.ctrl_dt
    if conditions.seconds is not None:
        steps = min(steps, max(round(conditions.seconds / dt), 1))
    generator, hold = np.random.default_rng(conditions.seed), int(exported.facts["action_repeat"])
    assert conditions.delay is not None
    least, most = conditions.delay
    delay = generator.permutation(least + np.arange(n) % (most - least + 1))
    pushes = _pushes(env, generator, steps, float(conditions.pushes or 0.0))
    first = dofs_of_robot(env.mj_model) if conditions.pushes else 0
    is_fixed = _fix_commands(env, exported.facts.get("info", {}))
    env.set_seed(conditions.seed)  # from the first episode on, in both engines
    set_stage(env, env.stage_of(exported.facts.get("info", {})))
    td = env.reset()
    behind = torch.from_numpy(delay).to(env.device)
    if "delay" in env.world.memory and (most_of_task := type(env).holds.get("delay")):  # whose hooks hold actions back
        held = behind.clamp(max=most_of_task[1])  # as far as it says
        env.world.memory["delay"].copy_(held)
        behind = behind - held
    late = torch.zeros(most + 1, n, env.mj_model.nu, device=env.device)
    alive, sums = torch.ones(n, dtype=torch.bool, device=env.device), dict[str, torch.Tensor]()
    counts = torch.zeros(3, n, dtype=torch.float64, device=env.device)
    taken, fell, returns = counts  # rows of it
    for t in trange(steps, desc=label, leave=False, disable=None):  # no bar in logs
        if t % hold == 0:
            action = exported.act(td[exported.reads])
        late = torch.cat([action.unsqueeze(0), late[:-1]])
        after = env.step(td.set("action", late.gather(0, behind.view(1, n, 1).expand(1, n, late.shape[2]))[0]))["next"]
        taken += alive
        fell += alive & after["terminated"].squeeze(-1)
        returns += torch.where(alive, after["reward"].squeeze(-1), 0.0)
        for name, values in {**after.get("reward_terms", {}), **after.get("metrics", {})}.items():
            value = values.squeeze(-1).double()
            counted = alive & value.isfinite()
            sums[name] = sums.get(name, 0.0) + torch.stack([torch.where(counted, value, 0.0), counted])
        alive = alive & ~after["done"].squeeze(-1)
        td = after.exclude("reward")
        if not alive.any():
            break
        if t in pushes:
            env.sim.qvel[:, first : first + 6] += torch.from_numpy(pushes[t]).float().to(env.device)  # poses stay
    cut_off = ~alive & (fell == 0)  # counts as in evaluations, as if it had gone on
    returns *= torch.where(cut_off, steps / taken, 1.0)
    steps_taken, falls, earned = counts.cpu().numpy()
    return Outcome(
        fell=falls > 0,
        steps=steps_taken,
        returns=earned,
        sums={name: tuple(total.cpu().numpy()) for name, total in sums.items()},
        delay=delay,
        is_fixed=is_fixed,
        steps_of_episode=steps,
        metrics=env.metric_names,
        cases=tuple(env.cases()),
    )


def dofs_of_robot(m: mujoco.MjModel) -> int:
    """Returns where the velocities of the free joint begin by which the robot floats, not a ball that it plays with."""
    free = m.jnt_dofadr[m.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    of_joints = m.actuator_trnid[m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    driven = m.dof_treeid[m.jnt_dofadr[of_joints]]
    of_robot = [int(first) for first in free if m.dof_treeid[first] in driven]
    if len(of_robot) != 1:
        raise ValueError(
            f"pushes need a body that floats and has actuated joints: this model has {len(of_robot)}, not one"
        )
    return of_robot[0]


def _pushes(env: LocoEnv, generator: np.random.Generator, steps: int, scale: float) -> dict[int, np.ndarray]:
    """Returns changes of the bases' velocities ``(n, 6)`` (m/s, rad/s), by the control step after which they come."""
    if not scale:
        return {}
    found = dict[int, np.ndarray]()
    for i in range(env.num_envs):
        t = round(generator.uniform(*PUSH_EVERY) / env.config.ctrl_dt)
        while t < steps:
            found.setdefault(t, np.zeros((env.num_envs, 6)))[i] = scale * generator.uniform(-1.0, 1.0, 6) * PUSH
            t += max(round(generator.uniform(*PUSH_EVERY) / env.config.ctrl_dt), 1)
    return found


def _fix_commands(env: LocoEnv, info: dict[str, Any]) -> np.ndarray:
    """Lets half of the worlds have one command throughout, if the task says which; returns in which, ``(n,)``."""
    n, fixed = env.num_envs, type(env).fixed_commands(info)
    is_fixed = np.arange(n) < (n // 2 if fixed else 0)
    for entry, rows in fixed.items():
        assert env.hooks is not None
        values, is_set = env.hooks.commands[entry]
        table = torch.tensor(rows, dtype=torch.float32, device=env.device)
        values.copy_(table[torch.arange(n, device=env.device) % len(table)])
        is_set.copy_(torch.from_numpy(is_fixed))
    return is_fixed


def _report(
    exported: Exported,
    cls: Any,
    conditions: Conditions,
    outcomes: dict[str, Outcome],
    config: SimConfig,
    cases: dict[str, dict[str, dict[str, Any]]],
) -> Report:
    """Returns whether a policy holds, and the figures by engine and kind of episodes."""
    table = {
        engine: {name: played.of(rows) for name, rows in played.rows().items()} for engine, played in outcomes.items()
    }
    steps = outcomes[ENGINES[0]].steps_of_episode
    there, here = (table.get(name, {}).get("all") for name in ENGINES)
    assert there is not None
    bounds = []
    max_falls = cls.holds.get("falls") if conditions.max_falls is None else conditions.max_falls
    if max_falls is not None:
        share = there["falls"] / there["episodes"]
        words = f"falls in {share:.1%} of the episodes, {max_falls:.1%} are allowed"
        bounds.append((share <= max_falls, words))
        if cases:
            failed = sum(row["failed"] for row in cases[ENGINES[0]].values())
            words = f"{failed} of {len(cases[ENGINES[0]])} fail undisturbed"
            bounds.append((failed <= max_falls * len(cases[ENGINES[0]]), words))
    if (least := cls.holds.get("return")) is not None:
        least *= steps / config.episode_length  # that of a whole episode
        bounds.append((there["return"] >= least, f"return {there['return']:.1f}, at least {least:.1f} is asked for"))
    kept = conditions.min_return
    if kept is None and keeps_a_share(cls):
        kept = cls.holds.get("kept", 0.9)
    if kept is not None and here is not None:
        trained, where = here["return"], "in the training simulator"
        ended = exported.facts.get("info", {}).get("mean", trained)
        if ended > trained and steps == config.episode_length:  # it was in whole episodes
            trained, where = ended, "when its training ended"
        least = trained - (1.0 - kept) * abs(trained)
        words = f"return {there['return']:.1f}, at least {least:.1f} is asked for"
        bounds.append((there["return"] >= least, f"{words}, {kept:.0%} of {trained:.1f} {where}"))
    holds = all(met for met, _ in bounds)
    words = "; ".join(text for met, text in bounds if met == holds)
    words += "; the return is not compared" if kept is not None and here is None else ""
    task, n, metrics = exported.facts["task"], there["episodes"], outcomes[ENGINES[0]].metrics
    episodes = "1 episode, since all begin alike," if n == 1 < DEFAULT.episodes else f"{n} episodes"
    by_case = {} if cls.perfect else {engine: played.by_case() for engine, played in outcomes.items()}
    lines = [
        *_case_lines(cases),
        f"{task} in C MuJoCo {mujoco.__version__}, {episodes} of {steps * config.ctrl_dt:g} s, {_describe(conditions)}",
        *_lines_by_case(by_case.get(ENGINES[0], {}), metrics),
        *_lines(table, metrics),
        f"{'holds' if holds else 'DOES NOT HOLD'}: {words}",
    ]
    about = {"task": task, "protocol": exported.facts["protocol"], "mujoco": mujoco.__version__}
    figures = {"holds": holds, **about, "conditions": dataclasses.asdict(conditions), "outcomes": table}
    figures |= {"by_case": by_case} if any(by_case.values()) else {}
    return Report(holds, lines, {**figures, "cases": cases})


def _describe(conditions: Conditions) -> str:
    assert conditions.delay is not None
    first, last = conditions.delay
    delay = f"{first}" if first == last else f"{first} to {last}"
    friction = "" if conditions.friction is None else "friction {:g} to {:g}, ".format(*conditions.friction)
    scales = f"noise x {conditions.noise:g}, pushes x {conditions.pushes:g}"
    return f"actions {delay} control steps late, {friction}{scales}"


def _lines_by_case(found: dict[str, dict[str, Any]], metrics: tuple[str, ...]) -> list[str]:
    """Returns how each case was played in C MuJoCo, the one with the most falls first."""
    if not found:
        return []
    rows = [("", ["falls", *metrics])]
    for name, row in sorted(found.items(), key=lambda pair: -pair[1]["falls"] / pair[1]["episodes"]):
        rows.append((name, [f"{row['falls']} of {row['episodes']}", *(_rounded(row[metric]) for metric in metrics)]))
    return _table(rows, max(map(len, found)), 16)


def _lines(table: dict[str, dict[str, dict[str, Any]]], metrics: tuple[str, ...]) -> list[str]:
    """Returns the figures, a line for each and a column for each engine: of a kind of episodes, falls and metrics."""
    rows, few = [("", list(table))], ["falls", *(metrics or ["return"])]
    for kind, row in table[ENGINES[0]].items():
        for name in few if kind != "all" else [name for name in row if name != "episodes"]:
            values = [figures[kind][name] for figures in table.values()]
            words = [f"{value} of {row['episodes']}" if name == "falls" else _rounded(value) for value in values]
            rows.append((name if kind == "all" else f"{kind}, {name}", words))
    return _table(rows, 34, 22)


def _table(rows: Iterable[tuple[str, Iterable[str]]], width: int, column: int) -> list[str]:
    """Returns lines of titles, of a width at least, and of words in columns of a width."""
    return [f"{title:<{width}}{''.join(f'{word:>{column}}' for word in words)}" for title, words in rows]


def _rounded(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"
