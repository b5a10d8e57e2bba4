"""Published returns, and the table of stored training runs beside them.

They are means over seeds, recomputed from the result files in the repositories nicklashansen/tdmpc2, wertyuilife2/bmpc
(``data_dmc_hard_4M.json``), molumitu/BOOM_MBRL (``results_dmc_2M.pkl``), cvoelcker/reppo and
naumix/BiggerRegularizedOptimistic (``trainingdata.zip``). FastSAC's is a single run of 100 million frames, 2.3 h on an
RTX 5080. For cheetah, hopper and quadruped none was found under ``playground``; under ``dm_control`` TD-MPC2's are of 4
million steps and 3 seeds. BRO's, of 1 million and 10 seeds: cheetah_run 825.4, hopper_hop 445.0, quadruped_run 890.5.
"""

import csv
import statistics
from pathlib import Path

from benchmarks.results import Row

PUBLISHED: dict[tuple[str, str], tuple[float, str]] = {
    ("walker_stand", "playground"): (992.4, "FastTD3"),
    ("walker_walk", "playground"): (982.9, "FastTD3"),
    ("walker_run", "playground"): (910.7, "REPPO"),
    ("humanoid_stand", "playground"): (996.8, "REPPO"),
    ("humanoid_walk", "playground"): (991.3, "REPPO"),
    ("humanoid_run", "playground"): (892.0, "FastSAC"),
    ("walker_stand", "dm_control"): (992.7, "TD-MPC2"),
    ("walker_walk", "dm_control"): (981.1, "TD-MPC2"),
    ("walker_run", "dm_control"): (877.2, "TD-MPC2"),
    ("humanoid_stand", "dm_control"): (962.1, "BOOM"),
    ("humanoid_walk", "dm_control"): (942.6, "BMPC"),
    ("humanoid_run", "dm_control"): (669.3, "BMPC"),
    ("cheetah_run", "dm_control"): (895.8, "TD-MPC2"),
    ("hopper_stand", "dm_control"): (954.8, "TD-MPC2"),
    ("hopper_hop", "dm_control"): (449.2, "TD-MPC2"),
    ("quadruped_walk", "dm_control"): (971.0, "TD-MPC2"),
    ("quadruped_run", "dm_control"): (953.8, "TD-MPC2"),
}
"""The best published mean return and the method that earned it, by task and protocol."""

COLUMNS = {
    **{"task": "", "protocol": "", "seeds": "d", "mean": ".1f", "worst": ".1f", "training (s)": ".0f"},
    **{"threshold": ".0f", "passed after (s)": ".0f", "from start (s)": ".0f", "published": ".1f", "by": ""},
}
"""Columns of :func:`learning`, and how their values are formatted."""


def learning(folder: Path) -> list[Row]:
    """Returns a row for each task and protocol in a folder's ``results.csv``: all seeds, and the published return.

    The time of training is the mean over seeds. The times to the threshold, of training and from the start of the
    process, are those of the slowest seed, and empty if a seed did not pass it.
    """
    groups: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in read(folder, "results.csv"):
        groups.setdefault((row["task"], row["protocol"]), []).append(row)
    return [_row(*key, groups[key]) for key in dict.fromkeys([*PUBLISHED, *groups]) if key in groups]


def _row(task: str, protocol: str, seeds: list[dict[str, str]]) -> Row:
    """Returns the row of the results of all seeds."""
    means = [float(seed["mean"]) for seed in seeds]
    threshold = seeds[0]["threshold"]
    published, by = PUBLISHED.get((task, protocol), (None, ""))
    return {
        **{
            "task": task,
            "protocol": protocol,
            "seeds": len(seeds),
            "mean": statistics.mean(means),
            "worst": min(means),
        },
        "training (s)": statistics.mean(float(seed["seconds"]) for seed in seeds),
        "threshold": float(threshold) if threshold else None,
        "passed after (s)": _slowest([seed["seconds_to_threshold"] for seed in seeds]),
        "from start (s)": _slowest([seed["wall_to_threshold"] for seed in seeds]),
        **{"published": published, "by": by},
    }


def _slowest(times: list[str]) -> float | None:
    return max(map(float, times)) if all(times) else None


def read(folder: Path, name: str) -> list[dict[str, str]]:
    """Returns the rows of a CSV file in a folder of results."""
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))
