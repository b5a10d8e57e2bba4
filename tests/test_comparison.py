"""docs/comparison.md: what it points to exists, and its speeds are the recorded ones."""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/comparison.md").read_text()
BODY, EVIDENCE = PAGE.split("\n## Evidence\n")
H200, CPU = "2026-11-21-h200", "2026-11-21-cpu"
BESIDE = "throughput-beside-peers"


def test_every_mark_has_its_evidence():
    mark = r"\[([A-Z]\d+)\]"
    listed = re.findall(rf"^- {mark}", EVIDENCE, re.MULTILINE)
    assert len(listed) == len(set(listed)) > 50
    assert set(re.findall(mark, BODY)) == set(listed)


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`((?:torchrl_loco|tests|benchmarks)/[\w./:-]+)`", PAGE))))
def test_what_it_says_of_ours_exists(path):
    file, _, function = path.partition("::")
    assert (ROOT / file).exists()
    if function:
        tree = ast.parse((ROOT / file).read_text())
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize(
    ("label", "folder", "file", "case", "worlds", "column", "digits"),
    [
        ("torchrl_loco, `step_and_maybe_reset`", H200, BESIDE, "env_step_and_maybe_reset", 8192, "ms", 2),
        ("torchrl_loco in TorchRL's `Collector`", H200, BESIDE, "torchrl_collector", 8192, "ms", 2),
        ("plain loop of `mujoco_warp.step`", H200, BESIDE, "bare_default", 8192, "ms", 2),
        ("Playground 0.2.0, jitted step", H200, "peers", "playground", 8192, "ms", 1),
        ("TorchRL's `MujocoPlaygroundEnv`", H200, "peers", "playground_torchrl", 8192, "ms", 1),
        ("torchrl_loco, 256 worlds", CPU, "peers", "env_step_and_maybe_reset", 256, "thousand steps/s", 1),
        ("dm_control, one world", CPU, "peers", "dm_control_suite", 1, "thousand steps/s", 1),
        ("C MuJoCo's `rollout`, 256 worlds, one", CPU, "peers", "c_mujoco_one_thread", 256, "thousand steps/s", 1),
        ("C MuJoCo's `rollout`, 256 worlds, two", CPU, "peers", "c_mujoco", 256, "thousand steps/s", 1),
    ],
)
def test_speeds_are_the_recorded_ones(label, folder, file, case, worlds, column, digits):
    rows = json.loads((ROOT / f"benchmarks/results/{folder}/{file}.json").read_text())["rows"]
    expected = [
        f"{row[column]:.{digits}f}"
        for body in ("walker", "humanoid")
        for row in rows
        if (row["body"], row["case"], row["worlds"]) == (body, case, worlds)
    ]
    (line,) = [line for line in BODY.splitlines() if line.startswith(f"| {label}")]
    assert [cell.strip() for cell in line.split("|")[2:4]] == expected
