"""Published returns.

They are means over seeds, recomputed from the result files in the repositories nicklashansen/tdmpc2, wertyuilife2/bmpc
(``data_dmc_hard_4M.json``), molumitu/BOOM_MBRL (``results_dmc_2M.pkl``), cvoelcker/reppo and
naumix/BiggerRegularizedOptimistic (``trainingdata.zip``). FastSAC's is a single run of 100 million frames, 2.3 h on an
RTX 5080. For cheetah, hopper and quadruped none was found under ``playground``; under ``dm_control`` TD-MPC2's are of 4
million steps and 3 seeds. BRO's, of 1 million and 10 seeds: cheetah_run 825.4, hopper_hop 445.0, quadruped_run 890.5.
"""

import csv
from pathlib import Path

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


def read(folder: Path, name: str) -> list[dict[str, str]]:
    """Returns the rows of a CSV file in a folder of results."""
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))
