"""The tables and pictures of README and docs: results, from benchmarks/results, and what the package says of its tasks.

``make tables`` writes them into the pages, between two comments each, because GitHub shows the pages as they are.
"""

import functools
import json
import re
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from benchmarks.published import PUBLISHED, read
from benchmarks.tables import OF_RUNNERS, PARTS
from benchmarks.tasks import RUNNERS
from benchmarks.tasks import TASKS as TASKS_OF
from benchmarks.variation import plot_variation
from generate import address, bodies, fields, rewards, robots, shapes, tasks
from generate.markdown import table

Row = dict[str, Any]
ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "docs" / "_static"

SPEED = "2026-11-30/tables"
"""Folder of ``python -m benchmarks tables``, from which all speeds are."""
SUITE = "2026-11-24/cpu/suite.json"
VARIATION = "2026-11-25/h100-third/variation.json"


class Measured(NamedTuple):
    """A line of a table of speeds: what was measured, and by which case."""

    label: str
    case: str


STEPS = (
    Measured("loop of `mujoco_warp.step` in a CUDA graph", "bare_default"),
    Measured("our physics alone", "bare_compiled"),
    Measured("our step: physics, observation, reward", "env_step"),
    Measured("the same under `dm_control`", "env_step_dm_control"),
    Measured("`env.step_and_maybe_reset`", "env_step_and_maybe_reset"),
    Measured("`RolloutCollector`, policy 2 x 256", "rollout_collector"),
    Measured("MuJoCo Playground 0.2, jitted step", "playground"),
    Measured("TorchRL's `MujocoPlaygroundEnv`", "playground_torchrl"),
    Measured("mjlab 1.6, `env.step`", "mjlab"),
)
COLLECTED = (
    Measured("`env.step_and_maybe_reset`", "env_step_and_maybe_reset"),
    Measured("TorchRL's `Collector`", "torchrl_collector"),
    Measured("`RolloutCollector`", "rollout_collector"),
)
OTHERS = ("bare_default", "playground", "playground_torchrl", "mjlab")
"""Cases of other libraries."""
BESIDE = {
    "Go1": {"mjlab 1.6": "mjlab"},
    "G1": {"mjlab 1.6": "mjlab"},
    "humanoid": {"Playground 0.2": "playground", "`mujoco_warp`, physics alone": "bare_default"},
    "walker": {"Playground 0.2": "playground", "`mujoco_warp`, physics alone": "bare_default"},
}
"""What a control step of a body is compared with first."""
WORLDS = (2048, 8192, 32768, 131072)
TRAINED = {
    "go1_velocity": "a Go1 learns to follow velocity commands",
    "g1_velocity": "a G1 learns the same",
    "go1_rough": "a Go1 learns to walk over rough ground",
    "g1_tracking": "a G1 learns to follow a motion",
}
SEEDS = ("2026-11-23/h200-presets/campaign", "2026-11-23/h200-seeds/campaign")
FIRST, ALONE, LAST = "2026-11-23/h200/campaign", "2026-11-23/h200-alone/campaign", "2026-11-24/h200-alone/campaign"
FURTHER, RUN = "2026-11-22/h200-runners/campaign", "2026-11-24/h100/walker-run"
BY_KERNELS = "2026-11-30/h200-seeds"
RUNS: dict[tuple[str, str], Sequence[str]] = {
    ("walker_stand", "playground"): SEEDS,
    ("walker_walk", "playground"): SEEDS,
    ("walker_run", "playground"): [RUN],
    ("humanoid_stand", "playground"): SEEDS,
    ("humanoid_walk", "playground"): SEEDS,
    ("humanoid_run", "playground"): [BY_KERNELS],
    ("cheetah_run", "playground"): [FURTHER],
    ("hopper_stand", "playground"): [FURTHER],
    ("hopper_hop", "playground"): [FURTHER],
    ("quadruped_walk", "playground"): [FURTHER],
    ("quadruped_run", "playground"): [BY_KERNELS],
    ("walker_stand", "dm_control"): SEEDS,
    ("walker_walk", "dm_control"): SEEDS,
    ("walker_run", "dm_control"): [RUN],
    ("humanoid_stand", "dm_control"): [*SEEDS, ALONE],
    ("humanoid_walk", "dm_control"): [*SEEDS, ALONE],
    ("humanoid_run", "dm_control"): [FIRST, ALONE, LAST],
}
"""Folders of the seeds that the presets were trained with, by task and protocol."""
ALONE_NOW = "2026-11-30/h200-runners"
"""Runs that had their GPU to themselves, one for each task, which tell how long it trains."""
LIKE = {"hopper_stand": "hopper_hop"}
"""A task without such a run, and the one of the same body whose speed it has."""
TASKS = [task for task, protocol in RUNS if protocol == "playground"]


@functools.cache
def tables() -> dict[str, str]:
    """Returns the tables as Markdown, by the names that the comments in the pages give them."""
    return {
        "steps": of_bodies(STEPS, list(TASKS_OF)) + sources([[f"{SPEED}/{part}.json" for part in PARTS]]),
        "worlds": by_worlds(),
        "collected": of_bodies(COLLECTED, RUNNERS[:2]),
        "speed": speed(),
        "trained": trained(),
        "returns": returns() + sources([[f"{path}/results.csv" for path in folders] for folders in RUNS.values()]),
        "tasks": tasks.overview(),
        "variation": variation(),
        "fields": fields.fields(),
        "pairs": shapes.pairs(),
        **robots.tables(),
        **of_tasks(),
        "badges": address.badges(),
        "colab": address.colab(),
    }


def of_tasks() -> dict[str, str]:
    """Returns what the pages of tasks and bodies take from the package; not of plug-ins that happen to be installed."""
    made = {
        "velocity-weights": tasks.velocity_weights(),
        "velocity-observation": tasks.observation(("go1_velocity", "g1_velocity")),
        "tracking-observation": tasks.observation(("g1_tracking", "h1_tracking")),
        "tracking-reward": tasks.tracking_reward(),
    }
    for name in tasks.RUNNERS:
        label = name.replace("_", "-")
        made[f"{label}-properties"] = tasks.properties(name, training(name))
        made[f"{label}-reward"] = rewards.formula(name)
        made[f"{label}-policy"] = tasks.shipped_policy(name)
    for body in tasks.CLASSES:
        made[f"{body}-observation"] = bodies.observation_table(body)
        made[f"{body}-action"] = bodies.action_table(body)
        made[f"{body}-protocols"] = tasks.protocols(body)
    return made


def filled(text: str) -> str:
    """Returns a page with its tables as they are now.

    Raises:
        KeyError: a comment names a table that does not exist.
    """
    made = tables()
    block = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
    return block.sub(lambda found: f"{found[1]}\n{made[found[2]]}\n{found[3]}", text)


@functools.cache
def measured() -> dict[tuple[str, str, int], Row]:
    """Returns what was measured of speeds, by task, case and worlds; each row names its GPU as ``device``.

    Raises:
        FileNotFoundError: a part was not.
    """
    files = [RESULTS / SPEED / f"{part}.json" for part in PARTS]
    if missing := [file.stem for file in files if not file.exists()]:
        command = f"python -m benchmarks tables benchmarks/results/{SPEED} --parts {' '.join(missing)}"
        raise FileNotFoundError(f"speeds are not measured yet: {command}")
    found = {}
    for file in files:
        for row in json.loads(file.read_text())["rows"]:
            if "error" not in row:
                found[row.get("task") or TASKS_OF[row["body"]], row["case"], row["worlds"]] = row
    return found


@functools.cache
def card() -> str:
    """Returns the name of the GPU on which most speeds were measured."""
    devices = [row["device"] for row in measured().values()]
    return max(dict.fromkeys(devices), key=devices.count)


def _figure(task: str, case: str, worlds: int = 8192, key: str = "ms", unit: float = 1.0) -> str:
    """Returns a figure to three digits, with its GPU if most others are of another; empty where there is none."""
    if (row := measured().get((task, case, worlds))) is None:
        return ""
    elsewhere = "" if row["device"] == card() else f" ({_short(row['device'])})"
    return f"{row[key] / unit:#.3g}".rstrip(".") + elsewhere


def _short(device: str) -> str:
    """Returns what a GPU is called for short."""
    return next((word for word in device.split() if re.fullmatch(r"[A-Z]+\d+", word)), device)


def of_bodies(lines: Iterable[Measured], bodies: Sequence[str]) -> str:
    """Returns the milliseconds that a control step of 8192 worlds takes, for bodies of which ours was measured."""
    shown = [body for body in bodies if _figure(TASKS_OF[body], "env_step")]
    rows = [(line.label, *(_figure(TASKS_OF[body], line.case) for body in shown)) for line in lines]
    return table((f"ms on one {_short(card())}", *shown), rows)


def by_worlds() -> str:
    """Returns what is measured of walker and humanoid for several numbers of worlds."""
    rows = []
    for task, body in ((TASKS_OF[body], body) for body in RUNNERS[:2] if _figure(TASKS_OF[body], "env_step")):
        speeds = measured()
        times = [speeds[task, "bare_default", n]["ms"] / speeds[task, "env_step", n]["ms"] for n in WORLDS]
        collected = [_figure(task, "rollout_collector", n, "million steps/s") for n in WORLDS]
        rows.append((f"{body}, our step (ms)", *(_figure(task, "env_step", n) for n in WORLDS)))
        rows.append((f"{body}, times as long in the loop, same card", *(f"{t:#.3g}".rstrip(".") for t in times)))
        rows.append((f"{body}, collected (million frames/s)", *collected))
    return table(("worlds", *WORLDS), rows)


def training(task: str) -> list[tuple[str, str]]:
    """Returns lines for the page of a task: what policies of its preset earn, and how long they train."""
    seeds = seeds_of(task, "playground")
    earned = f"{_mean(seeds, 'mean'):.0f} on average over {len(seeds)} seeds"
    return [
        ("return after training", earned),
        ("training (s)", f"{time_of_training(task, 'playground')}, on one GPU"),
    ]


def returns() -> str:
    """Returns the returns of all runs, beside the published ones and those of shipped policies in dm_control."""
    suite = {row["task"]: row for row in _json(SUITE) if row["where"] == "dm_control"}
    rows = []
    for task, protocol in RUNS:
        seeds = seeds_of(task, protocol)
        under = protocol if (task, protocol) in PUBLISHED else "dm_control"
        published, by = PUBLISHED[task, under]
        there = suite[task] if protocol == "dm_control" else None
        alone, is_whole = _alone(task, protocol)
        rows.append(
            (
                task,
                protocol,
                f"{_mean(seeds, 'mean'):.1f}",
                ", ".join(f"{float(row['mean']):.0f}" for row in seeds),
                f"{float(alone['mean']):.0f}" if is_whole else "",
                f"{_mean(seeds, 'frames') / 1e6:.0f}",
                time_of_training(task, protocol),
                f"{there['mean']:.1f} +- {there['std']:.1f}" if there else "",
                f"{by} {published}{'' if under == protocol else f' ({under})'}",
            )
        )
    columns = ("task", "protocol", "mean", "by seed", "today", "million frames", "training (s)")
    return table((*columns, "shipped policy in dm_control", "published"), rows)


def speed() -> str:
    """Returns how fast the library is beside others, as far as it was measured: steps of rollouts, and training."""
    rows = []
    for body, others in BESIDE.items():
        ours = _figure(TASKS_OF[body], "rollout_collector")
        found = {name: _figure(TASKS_OF[body], case) for name, case in others.items()}
        if ours and all(found.values()):
            beside = ", ".join(f"{name}: {figure}" for name, figure in found.items())
            rows.append((f"control step of 8192 {body}s (ms)", ours, beside))
    rows += [(f"{words} (million frames/s)", ours, f"mjlab 1.6: {mjlab}") for words, ours, mjlab in _rates()[:3]]
    return table((f"on one {_short(card())}", "torchrl_loco", "beside it"), rows)


def trained() -> str:
    """Returns frames per second of training beside mjlab's own."""
    return table((f"million frames/s on one {_short(card())}", "torchrl_loco", "mjlab 1.6"), _rates())


def _rates() -> list[tuple[str, str, str]]:
    """Returns what is trained, and the million frames per second of ours and of mjlab's, of tasks with both."""
    found = []
    for task, words in TRAINED.items():
        ours, mjlab = (_figure(task, case, key="frames/s", unit=1e6) for case in ("ours", "mjlab"))
        if ours and mjlab:
            found.append((words, ours, mjlab))
    return found


def variation() -> str:
    """Returns what policies earn on a grid of numbers, in all of it and within what they were trained on."""
    keys = ("nominal", "inside", "worst inside", "mean")
    head = ("policy", "model itself", "mean where trained", "worst cell there", "mean of the whole grid")
    return table(head, [(row["policy"], *(f"{row[key]:.0f}" for key in keys)) for row in _json(VARIATION)])


def seeds_of(task: str, protocol: str) -> list[dict[str, str]]:
    """Returns the rows of results of a task's runs, one for each seed, by seed."""
    rows = [row for folder in RUNS[task, protocol] for row in _results(folder, task, protocol)]
    by_seed = {row["seed"]: row for row in reversed(rows)}  # the first folder that has a seed counts
    return [by_seed[seed] for seed in sorted(by_seed, key=int)]


def time_of_training(task: str, protocol: str) -> str:
    """Returns the seconds that a run takes on a GPU of its own, with ~ where another run tells its speed."""
    alone, is_whole = _alone(task, protocol)
    seconds = float(alone["seconds"]) * _mean(seeds_of(task, protocol), "frames") / float(alone["frames"])
    return f"{'' if is_whole else '~'}{seconds:.0f}"


def _alone(task: str, protocol: str) -> tuple[dict[str, str], bool]:
    """Returns the run that had its GPU to itself, and whether it is of the task, not one like it, and as long."""
    (row,) = _results(ALONE_NOW, LIKE.get(task, task), protocol)
    return row, row["task"] == task and float(row["frames"]) == _mean(seeds_of(task, protocol), "frames")


def _results(folder: str, task: str, protocol: str) -> list[dict[str, str]]:
    return [row for row in read(RESULTS / folder, "results.csv") if (row["task"], row["protocol"]) == (task, protocol)]


def _mean(rows: Iterable[dict[str, str]], key: str) -> float:
    return statistics.mean(float(row[key]) for row in rows)


def _json(file: str) -> list[Row]:
    return json.loads((RESULTS / file).read_text())["rows"]


def sources(files: Iterable[Iterable[str]]) -> str:
    """Returns a line of links to files of results, each once."""
    named = dict.fromkeys(file for group in files for file in group)
    return "\nFrom " + ", ".join(f"[{file}](../benchmarks/results/{file})" for file in named) + ".\n"


def draw_steps(picture: Path) -> None:
    """Draws the times of a control step of 8192 worlds as bars, a panel for each of four bodies."""
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    bodies = ("walker", "humanoid", "Go1", "G1")
    for body, axes in zip(bodies, figure.subplots(2, 2, sharex=True, sharey="row").flat, strict=True):
        rows = {line: measured().get((TASKS_OF[body], line.case, 8192)) for line in reversed(STEPS)}
        shown = {line: row["ms"] for line, row in rows.items() if row and line.case not in OF_RUNNERS}
        colors = ["#9aa7ad" if line.case in OTHERS else "#f5a623" for line in shown]
        bars = axes.barh([line.label.replace("`", "") for line in shown], [*shown.values()], color=colors)
        axes.bar_label(bars, [_figure(TASKS_OF[body], line.case) for line in shown], padding=3)
        axes.set(title=f"8192 {body}s", xscale="log", xlim=(0.01, 2000))
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(f"ms for a control step, one {_short(card())} unless a bar says otherwise")
    figure.savefig(picture, dpi=130)


def draw(picture: Path) -> None:
    """Draws the return of every run under playground against its frames, a panel for each task."""
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    panels = figure.subplots(3, 4).flat
    for task, axes in zip(TASKS, panels, strict=False):
        rows = [row for folder in RUNS[task, "playground"] for row in read(RESULTS / folder, "evaluations.csv")]
        for seed in seeds_of(task, "playground"):
            key = (task, "playground", seed["seed"])
            found = [row for row in rows if (row["task"], row["protocol"], row["seed"]) == key]
            points = [(float(row["frames"]) / 1e6, float(row["mean"])) for row in found]
            axes.plot(*zip(*points, strict=True), "o-", color="C0", markersize=2, linewidth=1)
        if (task, "playground") in PUBLISHED:
            value, by = PUBLISHED[task, "playground"]
            axes.axhline(value, color="C1", linestyle="--", linewidth=1, label=f"{by} {value}")
            axes.legend(loc="lower right", fontsize="small")
        axes.set(title=task, ylim=(0, 1020), xlim=(0, None))
        axes.grid(alpha=0.3)
    for axes in panels:  # what is left
        axes.remove()
    figure.supxlabel("million frames")
    figure.supylabel("return over 1000 steps")
    figure.savefig(picture, dpi=100)


PAGES = (
    ROOT / "README.md",
    ROOT / "notebooks" / "README.md",
    *(
        ROOT / "docs" / name
        for name in (
            "benchmarks.md",
            "compiled-step.md",
            "robots.md",
            "api/model-numbers.md",
            "guides/in-torchrl.md",
            "guides/your-own-task.md",
        )
    ),
    *sorted((ROOT / "docs" / "tasks").glob("*.md")),
)

if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
    draw_steps(PICTURES / "steps.png")
    draw(PICTURES / "returns.png")
    if robots.rows_of():
        robots.draw(robots.CURVES)
    plot_variation(json.loads((RESULTS / VARIATION).read_text())["returns"], PICTURES / "variation.png")
