"""``python -m benchmarks``: measure throughput, or draw what was measured."""

import argparse
from pathlib import Path

import torch

from benchmarks.cases import CASES, TASKS
from benchmarks.plot import plot
from benchmarks.throughput import save, show, throughput

parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
commands = parser.add_subparsers(dest="command", required=True)
measure = commands.add_parser("throughput", help="measure, print a table, write JSON")
measure.add_argument("--worlds", type=int, nargs="+", default=[512, 2048, 8192, 32768])
measure.add_argument("--bodies", nargs="+", choices=list(TASKS), default=list(TASKS))
measure.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
measure.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
measure.add_argument("--out", type=Path, help="file for the results as JSON")
draw = commands.add_parser("plot", help="draw throughput against worlds from the JSON")
draw.add_argument("results", type=Path)
draw.add_argument("picture", type=Path)

args = parser.parse_args()
if args.command == "plot":
    plot(args.results, args.picture)
else:
    device = torch.device(args.device)
    rows = throughput(args.bodies, args.worlds, args.cases, device)
    show(rows)
    if args.out:
        save(rows, args.out, device)
