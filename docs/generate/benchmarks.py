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
from benchmarks.variation import plot_variation
from generate import address, bodies, fields, rewards, robots, shapes, tasks
from generate.markdown import table

Row = dict[str, Any]
ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "docs" / "_static"

LOOP, DAY = "2026-11-22/h200-loop", "2026-11-23/h200"
ENGINES = (f"{LOOP}/engines.json", f"{LOOP}/engines-others.json")
COLLECTED = (f"{DAY}/throughput.json", f"{DAY}/throughput-many.json", f"{LOOP}/throughput-apart.json")
PEERS = (f"{LOOP}/peers.json",)
SUITE = "2026-11-24/cpu/suite.json"
VARIATION = "2026-11-25/h100-third/variation.json"
TO_950 = "2026-11-23/h200-presets/time-to-return.csv"
BRAX_TO_950 = "2026-11-21/h200/training/time-to-return.json"
ROBOTS = f"{robots.RESULTS[-1].relative_to(RESULTS)}/results.json"
MJLAB = str(robots.BEFORE.relative_to(RESULTS))


class Measured(NamedTuple):
    """A line of a table of speeds: what was measured, in which files, in which of their rows, under which key."""

    label: str
    files: Sequence[str]
    rows: dict[str, Any]
    key: str


BODIES = ("walker", "humanoid", "cheetah", "hopper", "quadruped")
STEPS = (
    Measured("loop of `mujoco_warp.step` in a CUDA graph", ENGINES, {"protocol": "playground"}, "mujoco_warp"),
    Measured("our step: physics, observation, reward", ENGINES, {"protocol": "playground"}, "with observation"),
    Measured("the same under `dm_control`", ENGINES, {"protocol": "dm_control"}, "with observation"),
    Measured("`RolloutCollector`, policy 2 x 256", COLLECTED, {"case": "rollout_collector"}, "ms"),
    Measured("`env.step_and_maybe_reset`", PEERS, {"case": "env_step_and_maybe_reset"}, "ms"),
    Measured("MuJoCo Playground 0.2, jitted step", PEERS, {"case": "playground"}, "ms"),
    Measured("TorchRL's `MujocoPlaygroundEnv`", PEERS, {"case": "playground_torchrl"}, "ms"),
)
LAST_STEPS, LAST_MJLAB = ("2026-11-28/h100-tables/steps.json",), ("2026-11-28/h100-tables/mjlab.json",)
OF_ROBOTS = (
    Measured("`env.step_and_maybe_reset`", LAST_STEPS, {"case": "env_step_and_maybe_reset"}, "ms"),
    Measured("loop of `mujoco_warp.step` in a CUDA graph", LAST_STEPS, {"case": "bare_default"}, "ms"),
)
OF_MJLAB = Measured("`env.step`", LAST_MJLAB, {"case": "mjlab"}, "ms")
WORLDS = (2048, 8192, 32768, 131072)
BY_WORLDS = (
    Measured("our step (ms)", ENGINES, {"protocol": "playground"}, "with observation"),
    Measured("times as long in the loop", ENGINES, {"protocol": "playground"}, "ratio"),
    Measured("collected (million frames/s)", COLLECTED, {"case": "rollout_collector"}, "million steps/s"),
)


class Runs(NamedTuple):
    """Training runs of a task: the folders that hold its seeds, and runs that had their GPU to themselves.

    ``alone`` names folder, task, protocol and seeds (None: all) of those runs, where they are not the same ones.
    """

    folders: Sequence[str]
    alone: tuple[str, str, str, str | None] | None = None


SEEDS = ("2026-11-23/h200-presets/campaign", "2026-11-23/h200-seeds/campaign")
FIRST, ALONE, LAST = f"{DAY}/campaign", "2026-11-23/h200-alone/campaign", "2026-11-24/h200-alone/campaign"
RUNNERS, RUN = "2026-11-22/h200-runners/campaign", "2026-11-24/h100/walker-run"
RUNS = {
    ("walker_stand", "playground"): Runs(SEEDS, (ALONE, "walker_stand", "playground", None)),
    ("walker_walk", "playground"): Runs(SEEDS, (SEEDS[1], "walker_walk", "playground", "4")),
    ("walker_run", "playground"): Runs([RUN]),
    ("humanoid_stand", "playground"): Runs(SEEDS, (FIRST, "humanoid_stand", "playground", None)),
    ("humanoid_walk", "playground"): Runs(SEEDS, (FIRST, "humanoid_walk", "playground", None)),
    ("humanoid_run", "playground"): Runs([FIRST, SEEDS[1]], (FIRST, "humanoid_run", "playground", None)),
    ("cheetah_run", "playground"): Runs([RUNNERS]),
    ("hopper_stand", "playground"): Runs([RUNNERS]),
    ("hopper_hop", "playground"): Runs([RUNNERS]),
    ("quadruped_walk", "playground"): Runs([RUNNERS]),
    ("quadruped_run", "playground"): Runs([RUNNERS]),
    ("walker_stand", "dm_control"): Runs(SEEDS, (ALONE, "walker_stand", "dm_control", None)),
    ("walker_walk", "dm_control"): Runs(SEEDS, (SEEDS[1], "walker_walk", "playground", "4")),
    ("walker_run", "dm_control"): Runs([RUN]),
    ("humanoid_stand", "dm_control"): Runs([*SEEDS, ALONE], (ALONE, "humanoid_stand", "dm_control", None)),
    ("humanoid_walk", "dm_control"): Runs([*SEEDS, ALONE], (ALONE, "humanoid_walk", "dm_control", None)),
    ("humanoid_run", "dm_control"): Runs([FIRST, ALONE, LAST], (ALONE, "humanoid_run", "dm_control", None)),
}
"""The runs of the presets, by task and protocol."""
TASKS = [task for task, protocol in RUNS if protocol == "playground"]


@functools.cache
def tables() -> dict[str, str]:
    """Returns the tables as Markdown, by the names that the comments in the pages give them."""
    return {
        "steps": speeds(BODIES, STEPS) + sources(line.files for line in STEPS),
        "worlds": by_worlds() + sources(line.files for line in BY_WORLDS),
        "returns": returns() + sources([[f"{path}/results.csv" for path in runs.folders] for runs in RUNS.values()]),
        "tasks": tasks.overview(),
        "speed": speed(),
        "speed-sources": sources([(TO_950, BRAX_TO_950, ROBOTS, MJLAB, *LAST_STEPS, *LAST_MJLAB)]),
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


def speeds(bodies: Sequence[str], lines: Iterable[Measured]) -> str:
    """Returns the milliseconds that a control step of 8192 worlds takes."""
    return table(
        ("", *bodies), [(line.label, *(_found(line, body=body, worlds=8192) for body in bodies)) for line in lines]
    )


def by_worlds() -> str:
    """Returns what is measured of walker and humanoid for several numbers of worlds."""
    rows = [
        (f"{body}, {line.label}", *(_found(line, body=body, worlds=worlds) for worlds in WORLDS))
        for body in BODIES[:2]
        for line in BY_WORLDS
    ]
    return table(("worlds", *WORLDS), rows)


def _found(line: Measured, **where: Any) -> str:
    """Returns a figure to three digits, empty if no file has it; the first file that does counts."""
    wanted = line.rows | where
    for file in line.files:
        for row in json.loads((RESULTS / file).read_text())["rows"]:
            if line.key in row and wanted.items() <= row.items():
                return f"{row[line.key]:#.3g}".rstrip(".")
    return ""


def training(task: str) -> list[tuple[str, str]]:
    """Returns lines for the page of a task: what policies of its preset earn, and how long they train."""
    runs = RUNS[task, "playground"]
    seeds = seeds_of(task, "playground", runs)
    earned = f"{_mean(seeds, 'mean'):.0f} on average over {len(seeds)} seeds"
    return [
        ("return after training", earned),
        ("training (s)", f"{time_of_training(task, 'playground', runs)}, on one GPU"),
    ]


def returns() -> str:
    """Returns the returns of all runs, beside the published ones and those of shipped policies in dm_control."""
    suite = {row["task"]: row for row in _json(SUITE) if row["where"] == "dm_control"}
    rows = []
    for (task, protocol), runs in RUNS.items():
        seeds = seeds_of(task, protocol, runs)
        under = protocol if (task, protocol) in PUBLISHED else "dm_control"
        published, by = PUBLISHED[task, under]
        there = suite[task] if protocol == "dm_control" else None
        rows.append(
            (
                task,
                protocol,
                f"{_mean(seeds, 'mean'):.1f}",
                ", ".join(f"{float(row['mean']):.0f}" for row in seeds),
                f"{_mean(seeds, 'frames') / 1e6:.0f}",
                time_of_training(task, protocol, runs),
                f"{there['mean']:.1f} +- {there['std']:.1f}" if there else "",
                f"{by} {published}{'' if under == protocol else f' ({under})'}",
            )
        )
    columns = ("task", "protocol", "mean", "by seed", "million frames", "training (s)")
    return table((*columns, "shipped policy in dm_control", "published"), rows)


def speed() -> str:
    """Returns how fast the library is beside others: steps, time to a return, and training of a robot."""
    loop, ours, playground = STEPS[0], STEPS[1], STEPS[5]
    rows: list[tuple[str, ...]] = []
    for body in BODIES[:2]:
        step = (_found(line, body=body, worlds=8192) for line in (ours, loop))
        rows.append((f"control step of 8192 {body}s (ms, H200)", *step, "", _found(playground, body=body, worlds=8192)))
    for robot, task in (("Go1", "go1_velocity"), ("G1", "g1_velocity")):
        step = (_found(line, worlds=8192, body=robot) for line in OF_ROBOTS)
        peer = _found(OF_MJLAB, worlds=8192, task=task)
        rows.append((f"control step of 8192 {robot}, with resets (ms, H100)", *step, peer, ""))
    folder, file = TO_950.rsplit("/", 1)
    run = [row for row in read(RESULTS / folder, file) if row["task"] == "walker_walk"]
    brax = [row for row in _json(BRAX_TO_950) if row["trainer"] != "ours"]
    seconds = [
        f"{next(float(row[key]) for row in found if float(row['mean']) >= 950):.0f}"
        for found, key in ((run, "wall"), (brax, "seconds"))
    ]
    rows.append(("walker walks, return 950, from the start of the process (s, H200)", seconds[0], "", "", seconds[1]))
    ours_go1, mjlab = (
        f"{_mean(seeds['go1_velocity', trainer, 'H100'], 'frames/s') / 1e6:.3g}"
        for seeds, trainer in (
            (robots.by_trainer(robots.rows_of()), "torchrl_loco, PPO"),
            (robots.before(), "mjlab 1.6"),
        )
    )
    rows.append(("training a Go1 to follow velocity commands (million frames/s, H100)", ours_go1, "", mjlab, ""))
    return table(("", "torchrl_loco", "`mujoco_warp`", "mjlab 1.6", "Playground 0.2"), rows)


def variation() -> str:
    """Returns what policies earn on a grid of numbers, in all of it and within what they were trained on."""
    keys = ("nominal", "inside", "worst inside", "mean")
    head = ("policy", "model itself", "mean where trained", "worst cell there", "mean of the whole grid")
    return table(head, [(row["policy"], *(f"{row[key]:.0f}" for key in keys)) for row in _json(VARIATION)])


def seeds_of(task: str, protocol: str, runs: Runs) -> list[dict[str, str]]:
    """Returns the rows of results of a task's runs, one for each seed, by seed."""
    rows = [row for folder in runs.folders for row in _results(folder, task, protocol)]
    by_seed = {row["seed"]: row for row in reversed(rows)}  # the first folder that has a seed counts
    return [by_seed[seed] for seed in sorted(by_seed, key=int)]


def time_of_training(task: str, protocol: str, runs: Runs) -> str:
    """Returns the seconds that a run takes on a GPU of its own, with ~ where runs of another length tell its speed."""
    frames = _mean(seeds_of(task, protocol, runs), "frames")
    if runs.alone is None:
        alone = seeds_of(task, protocol, runs)
    else:
        folder, *key, seed = runs.alone
        alone = [row for row in _results(folder, *key) if seed in (None, row["seed"])]
    seconds = _mean(alone, "seconds") * frames / _mean(alone, "frames")
    same = runs.alone is None or runs.alone[1:3] == (task, protocol)
    return f"{'' if same and frames == _mean(alone, 'frames') else '~'}{seconds:.0f}"


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
    """Draws the times of a control step of 8192 worlds, walker and humanoid, as bars."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for body, axes in zip(BODIES[:2], figure.subplots(1, 2, sharey=True), strict=True):
        lines = [line for line in reversed(STEPS) if line.rows.get("protocol") != "dm_control"]
        times = [float(_found(line, body=body, worlds=8192)) for line in lines]
        others = ("loop", "MuJoCo Playground", "TorchRL's")
        colors = ["#9aa7ad" if line.label.startswith(others) else "#f5a623" for line in lines]
        axes.bar_label(
            axes.barh([line.label.replace("`", "") for line in lines], times, color=colors), fmt="%g", padding=3
        )
        axes.set(title=f"8192 {body}s", xscale="log", xlabel="ms for a control step, one H200", xlim=(0.05, 300))
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(picture, dpi=130)


def draw(picture: Path) -> None:
    """Draws the return of every run under playground against its frames, a panel for each task."""
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    panels = figure.subplots(3, 4).flat
    for task, axes in zip(TASKS, panels, strict=False):
        runs = RUNS[task, "playground"]
        rows = [row for folder in runs.folders for row in read(RESULTS / folder, "evaluations.csv")]
        for seed in seeds_of(task, "playground", runs):
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
