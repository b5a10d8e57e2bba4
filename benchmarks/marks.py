"""What a campaign's returns are held against: marks of our own and published returns, and the table beside them.

The published returns are means over seeds, recomputed from the result files in the repositories nicklashansen/tdmpc2,
wertyuilife2/bmpc (``data_dmc_hard_4M.json``), molumitu/BOOM_MBRL (``results_dmc_2M.pkl``), cvoelcker/reppo and
naumix/BiggerRegularizedOptimistic (``trainingdata.zip``). FastSAC's is a single run of 100 million frames, 2.3 h on an
RTX 5080. For cheetah, hopper and quadruped none was found under ``playground``; under ``dm_control`` TD-MPC2's are of 4
million steps and 3 seeds. BRO's, of 1 million and 10 seeds: cheetah_run 825.4, hopper_hop 445.0, quadruped_run 890.5.
"""

import csv
import dataclasses
import statistics
from pathlib import Path

from benchmarks.results import Row


@dataclasses.dataclass(frozen=True)
class Mark:
    """What is aimed at for a task in a protocol, and what was published."""

    mean: float | None = None
    """Mean return over seeds."""
    worst: float | None = None
    """Return of the worst seed."""
    seconds: float | None = None
    """Training time on one H200 (s)."""
    published: float | None = None
    """The best published mean return."""
    by: str = ""
    """The method that earned it."""


MARKS = {
    ("walker_stand", "playground"): Mark(993, 990, 30, 992.4, "FastTD3"),
    ("walker_walk", "playground"): Mark(984, 980, 30, 982.9, "FastTD3"),
    ("walker_run", "playground"): Mark(925, 910, 180, 910.7, "REPPO"),
    ("humanoid_stand", "playground"): Mark(997, 995, 180, 996.8, "REPPO"),
    ("humanoid_walk", "playground"): Mark(992, 990, 180, 991.3, "REPPO"),
    ("humanoid_run", "playground"): Mark(900, 850, 360, 892.0, "FastSAC"),
    ("walker_stand", "dm_control"): Mark(990, None, 30, 992.7, "TD-MPC2"),
    ("walker_walk", "dm_control"): Mark(983, None, 30, 981.1, "TD-MPC2"),
    ("walker_run", "dm_control"): Mark(880, None, 180, 877.2, "TD-MPC2"),
    ("humanoid_stand", "dm_control"): Mark(962, None, 180, 962.1, "BOOM"),
    ("humanoid_walk", "dm_control"): Mark(943, None, 180, 942.6, "BMPC"),
    ("humanoid_run", "dm_control"): Mark(670, None, 360, 669.3, "BMPC"),
    ("cheetah_run", "playground"): Mark(920),
    ("hopper_stand", "playground"): Mark(950),
    ("hopper_hop", "playground"): Mark(550),
    ("quadruped_walk", "playground"): Mark(960),
    ("quadruped_run", "playground"): Mark(940),
    ("cheetah_run", "dm_control"): Mark(published=895.8, by="TD-MPC2"),
    ("hopper_stand", "dm_control"): Mark(published=954.8, by="TD-MPC2"),
    ("hopper_hop", "dm_control"): Mark(published=449.2, by="TD-MPC2"),
    ("quadruped_walk", "dm_control"): Mark(published=971.0, by="TD-MPC2"),
    ("quadruped_run", "dm_control"): Mark(published=953.8, by="TD-MPC2"),
}
"""By task and protocol."""

COLUMNS = {
    **{"task": "", "protocol": "", "seeds": "d", "mean": ".1f", "mark": ".0f", "worst": ".1f", "worst: mark": ".0f"},
    **{"training (s)": ".0f", "training: mark (s)": ".0f", "threshold": ".0f", "passed after (s)": ".0f"},
    **{"from start (s)": ".0f", "published": ".1f", "by": ""},
}
"""Columns of :func:`learning`, and how their values are formatted."""


def threshold(task: str, protocol: str) -> float | None:
    """Returns the return of which it is noted when it was first passed: 950, or the task's mark if that is less."""
    mark = MARKS.get((task, protocol))
    return None if mark is None or mark.mean is None else min(950.0, mark.mean)


def learning(folder: Path) -> list[Row]:
    """Returns a row for each task and protocol in a campaign's ``results.csv``: the finished seeds beside the marks.

    The time of training is the mean over seeds. The times to the threshold, of training and from the start of the
    process, are those of the slowest seed, and empty if a seed did not pass it.
    """
    groups: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in read(folder, "results.csv"):
        groups.setdefault((row["task"], row["protocol"]), []).append(row)
    return [_row(*key, groups[key]) for key in dict.fromkeys([*MARKS, *groups]) if key in groups]


def _row(task: str, protocol: str, seeds: list[dict[str, str]]) -> Row:
    """Returns the row of the results of all seeds."""
    mark = MARKS.get((task, protocol), Mark())
    means = [float(seed["mean"]) for seed in seeds]
    return {
        **{"task": task, "protocol": protocol, "seeds": len(seeds)},
        **{"mean": statistics.mean(means), "mark": mark.mean, "worst": min(means), "worst: mark": mark.worst},
        "training (s)": statistics.mean(float(seed["seconds"]) for seed in seeds),
        **{"training: mark (s)": mark.seconds, "threshold": threshold(task, protocol)},
        "passed after (s)": _slowest([seed["seconds_to_threshold"] for seed in seeds]),
        "from start (s)": _slowest([seed["wall_to_threshold"] for seed in seeds]),
        **{"published": mark.published, "by": mark.by},
    }


def _slowest(times: list[str]) -> float | None:
    return max(map(float, times)) if all(times) else None


def read(folder: Path, name: str) -> list[dict[str, str]]:
    """Returns the rows of a CSV file of a campaign.

    Raises:
        FileNotFoundError: there is no such file.
    """
    path = folder / name
    if not path.is_file():
        raise FileNotFoundError(f"{folder} is not the folder of a campaign: it has no {name}")
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
