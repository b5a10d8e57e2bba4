"""``python -m benchmarks``: measure, print a table, write JSON, draw."""

import argparse
import sys
from pathlib import Path

import torch

from benchmarks.cases import CASES, INTERRUPTED, LEARNING, VARIANTS
from benchmarks.results import save, show
from benchmarks.tables import PARTS
from benchmarks.tasks import RUNNERS, TASKS
from torchrl_loco import list_envs
from torchrl_loco.policy import shipped_policies

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"

parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
commands = parser.add_subparsers(dest="command", required=True)


def add(name: str, description: str, worlds: list[int]) -> argparse.ArgumentParser:
    """Adds a command that measures."""
    command = commands.add_parser(name, help=description, description=description)
    command.add_argument("--worlds", type=int, nargs="+", default=worlds)
    command.add_argument("--bodies", nargs="+", choices=list(TASKS), default=RUNNERS)
    command.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
    command.add_argument("--out", type=Path, help="file for the results as JSON")
    return command


small = [256] if DEVICE == "cpu" else [8192]
add("throughput", "from the bare simulator to a collector", small if DEVICE == "cpu" else [512, 2048, 8192, 32768])
add("fidelity", "deviation from C MuJoCo in double precision", [256])
commands.choices["fidelity"].add_argument("--picture", type=Path, help="file for a plot")
add("profile", "time of each kernel (CUDA)", small)
add("pixels", "what cameras cost, beside MuJoCo-Warp's renderer", small)
commands.choices["pixels"].add_argument("--sizes", type=int, nargs="+", default=[64], help="sides of pictures")
add("hooks", "what a task in plain torch costs beside the physics", small)
commands.choices["hooks"].add_argument("--task", required=True, help="id, or file.py:Class")
add("soak", "millions of steps under hostile actions and states", small)
commands.choices["soak"].add_argument("--frames", type=float, default=1e5 if DEVICE == "cpu" else 5e7)
followers = [task for task in list_envs() if task.endswith("_velocity")]
falls = commands.add_parser(
    "rollouts", help="episodes of random actions that no fall ends: what is lost, how fast it gets"
)
falls.add_argument("--tasks", nargs="+", choices=list_envs(), default=followers)
falls.add_argument("--worlds", type=int, default=small[0])
falls.add_argument("--frames", type=float, default=1e7, help="steps of each task, over all worlds")
falls.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
falls.add_argument("--out", type=Path, help="file for the results as JSON")
walk = commands.add_parser("robots", help="robots that follow commands: training, mjlab's reward, falls in C MuJoCo")
walk.add_argument("folder", type=Path, help="where each run's small files are; what is there is not done again")
walk.add_argument("--tasks", nargs="+", choices=followers, default=followers)
walk.add_argument("--seeds", type=int, nargs="+", default=[], help="default: none, verify what is there")
walk.add_argument("--settings", nargs="+", default=[], metavar="NAME=VALUE", help="further ones of train")
walk.add_argument("--episodes", type=int, default=256, help="in which a policy is verified, 0 for later")
walk.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
for name, further, default in (("throughput", {}, list(CASES)), ("profile", LEARNING, ["env_step_and_maybe_reset"])):
    commands.choices[name].add_argument("--cases", nargs="+", choices=[*CASES, *VARIANTS, *further], default=default)
every = commands.add_parser("tables", help="what the tables of speeds are made of: ours and other libraries")
every.add_argument("folder", type=Path, help="has a file for each part; what is there is not measured again")
every.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
every.add_argument("--worlds", type=int, default=small[0])
every.add_argument("--frames", type=int, default=40_000_000, help="of each of our trainings")
every.add_argument("--settings", nargs="+", default=[], metavar="NAME=VALUE", help="further ones of train")
every.add_argument("--path", type=Path, help="folder that the peers' packages were installed in")
every.add_argument("--mjlab", type=Path, help="folder that mjlab and the packages it pins were installed in")
every.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
every.set_defaults(out=None)
train = commands.add_parser("training", help="time to a return, compared with Brax's PPO on Playground")
train.add_argument("--tasks", nargs="+", choices=list_envs(), default=["walker_walk"])
train.add_argument("--frames", type=int, default=10_000_000)
train.add_argument("--peer", action="store_true", help="train Brax's PPO too")
train.add_argument("--path", type=Path, help="folder that the peer's packages were installed in")
train.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
train.add_argument("--out", type=Path, help="file for the results as JSON")
elsewhere = commands.add_parser("suite", help="what the policies of protocol dm_control earn in dm_control itself")
shipped = sorted(shipped_policies("dm_control"))
elsewhere.add_argument("--tasks", nargs="+", choices=shipped, default=shipped)
elsewhere.add_argument("--episodes", type=int, default=32)
elsewhere.add_argument("--path", type=Path, help="folder that dm_control and its MuJoCo were installed in")
elsewhere.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
elsewhere.add_argument("--out", type=Path, help="file for the results as JSON")
vary = commands.add_parser("variation", help="returns of humanoid_walk over a grid of friction, masses and gears")
vary.add_argument("--policies", type=Path, nargs="*", default=[], help="files of policies beside the shipped one")
vary.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
vary.add_argument("--out", type=Path, help="file for the results as JSON")
vary.add_argument("--picture", type=Path, help="file for a plot")
numbers = commands.add_parser("price", help="what numbers that differ from world to world cost (CUDA)")
numbers.add_argument(
    "--models", nargs="+", choices=["humanoid", "go1", "go2", "g1", "h1"], default=["humanoid", "g1", "go1"]
)
numbers.add_argument("--worlds", type=int, nargs="+", default=[8192, 32768])
numbers.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
numbers.add_argument("--out", type=Path, help="file for the results as JSON")
begin = commands.add_parser("startup", help="a training's start by phase, with empty and with filled kernel caches")
begin.add_argument(
    "--tasks", nargs="+", choices=list_envs(), default=["walker_walk", "go1_velocity", "g1_velocity", "g1_tracking"]
)
begin.add_argument("--iterations", type=int, default=4, help="of each training")
begin.add_argument("--repeats", type=int, default=1, help="trainings with filled caches")
begin.add_argument("--settings", nargs="+", default=[], metavar="NAME=VALUE", help="further ones of train")
begin.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
begin.add_argument("--out", type=Path, help="file for the results as JSON")
begin.add_argument("--picture", type=Path, help="file for a plot")
spread = commands.add_parser("scaling", help="several GPUs beside one, with the same worlds on each")
spread.add_argument("--tasks", nargs="+", choices=list_envs(), default=["walker_walk"])
spread.add_argument("--algorithms", nargs="+", choices=["ppo", "reppo"], default=["ppo", "reppo"])
spread.add_argument("--gpus", type=int, nargs="+", default=[1, 2], help="numbers of GPUs, or of processes on the CPU")
spread.add_argument("--device", type=torch.device, default=torch.device(DEVICE))
spread.add_argument("--out", type=Path, help="file for the results as JSON")
models = commands.add_parser("coverage", help="which models of installed packages and of folders compile, and why not")
models.add_argument("folders", type=Path, nargs="*", metavar="FOLDER")
models.add_argument("--path", type=Path, help="folder that the packages were installed in")
models.add_argument("--check", action="store_true", help="step those that are accepted beside C MuJoCo")
models.add_argument("--out", type=Path, help="file for the results as JSON")
models.set_defaults(device=torch.device("cpu"))
draw = commands.add_parser("plot", help="draw throughput or return from the JSON, or a folder of stored runs")
draw.add_argument("results", type=Path)
draw.add_argument("picture", type=Path)

args = parser.parse_args()
notes = {}
if args.command == "plot":
    from benchmarks.plot import plot

    plot(args.results, args.picture)
    raise SystemExit
if args.command == "throughput":
    from benchmarks.throughput import COLUMNS, PHASES, phases, throughput

    rows = throughput(args.bodies, args.worlds, args.cases, args.device)
    show(phases(rows), {"body": "", "worlds": "d", **dict.fromkeys(PHASES, ".3f")})
elif args.command == "tables":
    from benchmarks.tables import COLUMNS, tables

    options = {name: getattr(args, name) for name in ("device", "worlds", "frames", "settings", "path", "mjlab")}
    rows = tables(args.folder, args.parts, **options)
elif args.command == "pixels":
    from benchmarks.pixels import COLUMNS, pixels

    rows = pixels(args.bodies, args.worlds, args.sizes, args.device)
elif args.command == "startup":
    from benchmarks.startup import COLUMNS, plot_startup, startup

    rows = startup(args.tasks, args.device, args.iterations, args.repeats, args.settings)
    if args.picture:
        plot_startup(rows, args.picture)
elif args.command == "fidelity":
    from benchmarks.fidelity import COLUMNS, fidelity, plot_fidelity

    rows = fidelity(args.bodies, args.worlds[0], args.device)
    if args.picture:
        plot_fidelity(rows, args.picture)
elif args.command == "hooks":
    from benchmarks.hooks import COLUMNS, hooks

    rows = hooks(args.task, args.worlds, args.device)
elif args.command == "soak":
    from benchmarks.soak import COLUMNS, soak

    rows = soak(args.bodies, args.worlds[0], int(args.frames), args.device)
elif args.command == "rollouts":
    from benchmarks.rollouts import COLUMNS, rollouts

    rows = rollouts(args.tasks, args.worlds, int(args.frames), args.device)
elif args.command == "robots":
    from benchmarks.robots import COLUMNS, robots

    rows = robots(args.folder, args.tasks, args.seeds, args.device, args.settings, args.episodes)
    args.out = args.folder / "results.json"
elif args.command == "scaling":
    from benchmarks.scaling import COLUMNS, scaling

    rows = scaling(args.tasks, args.gpus, args.device, args.algorithms)
elif args.command == "variation":
    from benchmarks.variation import COLUMNS, GRID, plot_variation, variation

    notes["grid"] = dict(zip(("friction", "mass", "gear"), GRID, strict=True))
    rows, notes["returns"] = variation(args.policies, args.device)
    if args.picture:
        plot_variation(notes["returns"], args.picture)
elif args.command == "price":
    from benchmarks.price import COLUMNS, price

    if args.device.type != "cuda":
        parser.error("price needs a CUDA device")
    rows = price(args.models, args.worlds, args.device)
elif args.command == "suite":
    from benchmarks.suite import COLUMNS, suite

    rows = suite(args.tasks, args.episodes, args.device, args.path)
elif args.command == "coverage":
    from benchmarks.coverage import COLUMNS, TOTALS, coverage, folders

    sys.path += [str(args.path)] if args.path else []
    found = [coverage(title, folder, check=args.check) for title, folder in folders(args.folders).items()]
    rows = [row for table, _ in found for row in table]
    show([total for _, total in found], TOTALS)
elif args.command == "training":
    from benchmarks.training import COLUMNS, training

    rows = training(args.tasks, args.device, args.frames, args.peer, args.path)
else:
    from benchmarks.profile import COLUMNS, profile

    if args.device.type != "cuda":
        parser.error("profile needs a CUDA device")
    rows = profile(args.bodies, args.worlds[0], args.cases, args.device)
show(rows, COLUMNS)
if args.out:
    save(rows, args.out, args.device, notes | ({"interrupted": True} if INTERRUPTED.is_set() else {}))
raise SystemExit(130 if INTERRUPTED.is_set() else 0)
