"""Parts of a step as one kernel: the numbers of plain torch, for any number of worlds, or a refusal that says why."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp
from for_each import for_each
from hook_tasks import FollowVelocity, WalkBackwards, WalkBlindly
from torch.nn import functional as F  # noqa: N812

from torchrl_loco.envs.fusion import CannotFuse, fuse, trace
from torchrl_loco.envs.part import Part

CPU = torch.device("cpu")
PARTS = ("control", "judge", "observe", "begin", "observe_begun")


def copies(arrays):
    return {name: values.clone() for name, values in arrays.items()}


def fused(work, arrays, n, fixed=(), device=CPU):
    """Returns ``work`` on arrays as a kernel; tracing runs it on copies."""
    with torch.no_grad():
        traced = trace(work, copies(arrays))
    return fuse(traced, arrays, n, wp.get_device(str(device)), fixed)


def assert_same(found, expected):
    for name, values in expected.items():
        exact = not values.is_floating_point()
        torch.testing.assert_close(
            found[name],
            values,
            rtol=0 if exact else 1e-5,
            atol=0 if exact else 1e-6,
            equal_nan=True,
            msg=lambda text, name=name: f"{name}: {text}",
        )


def by_world(values):
    """Returns a copy in which the world is the fastest index in memory."""
    return values.movedim(0, -1).contiguous().movedim(-1, 0)


@for_each("cls", [FollowVelocity, WalkBackwards, WalkBlindly])
def test_parts_of_tasks_do_what_plain_torch_does(cls, device):
    n = 6 if device == "cpu" else 75  # of which some fill warps, which write their rows together
    env = cls(n, device=device)
    env.reset()
    env.rand_step()
    wait = torch.cuda.synchronize if device != "cpu" else wp.synchronize
    world, generator = env.world, torch.Generator(device).manual_seed(0)
    parts = [part for name in PARTS if isinstance(part := getattr(world, f"_{name}"), Part)]
    assert parts
    for part in parts:
        arrays = copies(part._arrays)
        for name, values in arrays.items():
            if values.dtype == torch.float32:
                values += 0.3 * torch.randn(values.shape, generator=generator, device=device)
                values[1], values[2] = torch.nan, torch.inf
            elif values.dtype == torch.bool:
                values.copy_(torch.rand(values.shape, generator=generator, device=device) < 0.5)
            if name in ("qpos", "qvel", "xmat", "terms"):
                arrays[name] = by_world(values)
        expected = copies(arrays)
        launch = fused(part._work, arrays, n, part._fixed, torch.device(device))
        with torch.no_grad():
            part._work(expected)
        wait()  # the kernel runs on Warp's stream
        launch()
        wp.synchronize()
        assert_same(arrays, expected)


OPERATORS = {
    "arithmetic": lambda x, y, i, b: (x + y * 2 - 3 / x) / y - (5 - x),
    "types": lambda x, y, i, b: (
        x * b + i * 0.5 + i / 3 + (x > 0) * 2,
        i + b,
        i.float() * b,
        x.long(),
        i.int().bool(),
        b + b,
    ),
    "functions": lambda x, y, i, b: (
        x.exp(),
        x.abs().log(),
        x.abs().sqrt(),
        x.abs().rsqrt(),
        x.sin(),
        x.cos(),
        x.tan(),
        x.tanh(),
        x.sigmoid(),
    ),
    "more functions": lambda x, y, i, b: (
        x.log1p(),
        x.expm1(),
        x.erf(),
        x.asin(),
        x.acos(),
        x.atan(),
        x.sinh(),
        x.cosh(),
        x.exp2(),
        x.abs().log2(),
        x.abs().log10(),
    ),
    "rounding": lambda x, y, i, b: (
        (3 * x).round(),
        x.floor(),
        x.ceil(),
        x.trunc(),
        x.sign(),
        i.sign(),
        x.square(),
        x.reciprocal(),
        (x * 2).frac(),
        (i + 16777217).floor(),
        (i.long() + 2**53 + 1).ceil(),
        (i - 16777217).trunc(),
    ),
    "atan2": lambda x, y, i, b: torch.atan2(x, y),
    "signs and lengths": lambda x, y, i, b: (
        torch.copysign(x, y),
        x.copysign(-0.0),
        torch.copysign(torch.full_like(x, 1.5), i),
        (0 * torch.nan_to_num(x, 1.0, 1.0, -1.0)).signbit(),
        i.signbit(),
        torch.hypot(x, y),
        torch.hypot(1e-25 * x, 0 * y),
        torch.hypot(1e25 * x, 1e25 * y),
        torch.fmax(x, y),
        torch.fmin(x, torch.where(b, math.nan, y)),
    ),
    "diagonals": lambda x, y, i, b: (
        (x[:, :4].reshape(-1, 2, 2) * 2).diagonal(dim1=1, dim2=2).sum(-1),
        torch.diagonal(y.view(-1, 2, 3), 1, 1, 2),
        (x + y).unfold(1, 3, 2).amax(-1),
    ),
    "powers": lambda x, y, i, b: (
        *(x**2, x**3, x**7, x**-1, x**-2, x**0.5, x**-0.5, (i * -0.0) ** 0.5, (i * -0.0) ** -0.5),
        *(x.abs() ** 1.5, x.abs() ** y, 2.0**x, i**2, x ** torch.tensor([-0.5, 0.5]).repeat(3)),
    ),
    "constants of other types": lambda x, y, i, b: (
        i + torch.full_like(i, 3_000_000_000).int(),
        i + torch.full_like(i, 16777217).float().long(),
        i + torch.full_like(x, 16777217.0).long(),
        x + torch.full_like(x, -2.9).int(),
        torch.full_like(i, -256).bool() & b,
        torch.full_like(x, 3e9).int().bool() & b,
    ),
    "limits": lambda x, y, i, b: (
        x.clamp(-0.5, 0.5),
        x.clamp(min=0.1),
        x.clamp(max=y),
        torch.minimum(x, y),
        torch.maximum(x, y),
        i.clamp(-2, 3),
        x.relu(),
    ),
    "remainders": lambda x, y, i, b: (
        x % 0.3,
        torch.fmod(x, 0.3),
        x // 0.3,
        i % 3,
        i // 3,
        torch.fmod(i, 3),
        i % -4,
        i // -4,
        (i.long() * 2**61) // 10**18,
        torch.div(x, 0.3, rounding_mode="trunc"),
        x // torch.where(b, math.inf, y),
        y // torch.where(b, -math.inf, 0 * x - 0.7),
        i.long() >> (i.abs() + 61),
        (i - 9) >> (i.abs() + 29),
    ),
    "comparisons": lambda x, y, i, b: (x < y, x <= 0.1, x > y, x >= y, x == x, x != y, i == 2, i > 1.5, b == (i > 0)),
    "logic": lambda x, y, i, b: (
        b & (x > 0),
        b | (x > 0),
        b ^ (x > 0),
        ~b,
        b.logical_not(),
        x.logical_and(i),
        x.logical_or(b),
        x.logical_xor(y),
    ),
    "finite": lambda x, y, i, b: (x.isfinite(), x.isnan(), x.isinf(), torch.nan_to_num(x, 0.5, 2.0, -2.0)),
    "bits": lambda x, y, i, b: (
        i & 6,
        i | 9,
        i ^ 5,
        ~i,
        i >> 1,
        i << 3,
        (i * -7046029254386353131) >> 30,
        i * 2**62 * 7,
        -i,
        i.abs(),
    ),
    "where": lambda x, y, i, b: (
        torch.where(b, x, 0.0),
        torch.where(x > y, i, 2),
        x.masked_fill(b, 7.0),
        torch.where(b[:, :1], x, y),
    ),
    "shapes": lambda x, y, i, b: (
        x.view(-1, 2, 3).transpose(1, 2).reshape(-1, 6),
        x.unsqueeze(1).expand(-1, 4, 6).flatten(1),
        x.view(-1, 2, 3).mT.permute(0, 2, 1),
        x.unsqueeze(-1).squeeze(-1),
        x[:, None].squeeze(1),
    ),
    "turned": lambda x, y, i, b: (
        (x.t() * 2).t(),
        torch.stack([x, y]).sum(0),
        torch.stack([x > y, b]).any(0),
        torch.stack([x[:, 0], y[:, 1]]).amax(0),
        x.movedim(1, 0)[2],
    ),
    "parts": lambda x, y, i, b: (
        x[:, 2],
        x[:, 1:5:2],
        x[..., -1:],
        x[:, [0, 3, 3]],
        x.index_select(1, torch.tensor([5, 0])),
        *x.split([2, 4], 1),
        *x.chunk(2, -1),
        *x.unbind(1),
        x.flip(1),
        x.roll(1, 1),
        x.repeat(1, 2),
        x[:, torch.tensor([True, False] * 3)],
    ),
    "joined": lambda x, y, i, b: (
        torch.cat([x, y[:, :2], i], -1),
        torch.stack([x, y], 1),
        torch.stack([x, y], -1),
        torch.cat([x, torch.zeros(x.shape[0], 1)], 1),
        F.pad(x, (1, 2)),
    ),
    "sums": lambda x, y, i, b: (
        x.sum(-1),
        x.mean(1, keepdim=True),
        i.sum(1),
        b.sum(-1),
        x.prod(1),
        b.all(1),
        b.any(1, keepdim=True),
        x.view(-1, 2, 3).sum((1, 2)),
        x.cumsum(1),
        x.var(1),
        x.std(1),
        x[:, :0].sum(1),
    ),
    "largest": lambda x, y, i, b: (
        x.amax(1),
        x.amin(1, keepdim=True),
        *x.max(1),
        *x.min(-1, keepdim=True),
        x.argmax(1),
        i.argmin(1),
        x.softmax(-1),
    ),
    "norms": lambda x, y, i, b: (
        x.norm(dim=-1),
        x.view(-1, 2, 3).norm(dim=-1, keepdim=True),
        torch.linalg.vector_norm(x, 1, -1),
        torch.linalg.vector_norm(x, torch.inf, -1),
        F.normalize(x, dim=-1),
    ),
    "products": lambda x, y, i, b: (
        torch.linalg.cross(x[:, :3], y[:, 3:]),
        torch.linalg.cross(x.view(-1, 2, 3), y[:, None, :3]),
        x.view(-1, 2, 3) @ y.view(-1, 3, 2),
        x @ torch.ones(6, 2),
        x @ torch.arange(6.0),
        x.view(-1, 2, 3) @ torch.eye(3),
        F.linear(x, torch.full((2, 6), 0.5), torch.ones(2)),
        torch.einsum("nij,nj->ni", x.view(-1, 2, 3), y[:, :3]),
    ),
    "mixtures": lambda x, y, i, b: (
        torch.addcmul(x, x, y, value=0.5),
        torch.lerp(x, y, 0.3),
        torch.lerp(x, y, y),
        torch.add(x, y, alpha=2),
        F.silu(x),
        F.elu(x),
        F.softplus(x),
        F.huber_loss(x, y, reduction="none"),
        F.leaky_relu(x),
    ),
    "made": lambda x, y, i, b: (
        torch.zeros_like(x) + 1,
        torch.ones(x.shape[0], 2) * x[:, :2],
        torch.full((3,), 2.0) * x[:, :3],
        x.new_zeros(x.shape[0]),
        torch.arange(6) * x,
        torch.empty_like(x).fill_(2.0),
        torch.linspace(0, 1, 6) + x,
        x * (torch.tensor([1.0, 2.0]) * 3).sum().item(),
        torch.eye(3)[1] * x[:, :3],
    ),
    "chosen": lambda x, y, i, b: (
        x.gather(1, i % 6),
        x.gather(1, x.argmax(1, keepdim=True)),
        torch.arange(12.0).view(6, 2)[i[:, 0] % 6],
        x[torch.arange(x.shape[0]), i[:, 0] % 6],
        torch.take_along_dim(x, i % 6, 1),
    ),
}


TABLE = torch.linspace(-1, 1, 5)
OPERATORS["numbers of tables"] = lambda x, y, i, b: (
    x * TABLE.cumsum(0)[-1],
    x * TABLE.cumsum(0).clamp(-1, 1)[2],
    x * TABLE.var(-1),
    x * F.normalize(TABLE[0], dim=-1),
    x * TABLE[0].flip(-1) + TABLE[0].cumsum(0) + TABLE.t()[1],
)


def inplace(x, y, i, b):
    out = x.clone()
    out[:, 2:4] += 1.0
    out[:, 0] = y[:, 1]
    view = out.view(-1, 2, 3)
    view[:, 1].mul_(2.0)
    out[b[:, 0]] = 0.5
    out.masked_fill_(b, -1.0)
    made = torch.zeros(x.shape[0], 2)
    made[:, 1] = out.sum(-1)
    return out, made, view.transpose(1, 2).clone().clamp_(-1, 1)


OPERATORS["in place"] = inplace


def operands(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.randn(2, n, 6, generator=generator)
    x[0, :3] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    y[0, 3:5] = torch.tensor([torch.nan, torch.inf])
    return {"x": x, "y": by_world(y), "i": torch.randint(-9, 9, (n, 6), generator=generator), "b": x > 0.2}


def results(func, arrays):
    with torch.no_grad():
        found = func(*(arrays[name] for name in "xyib"))
    return found if isinstance(found, tuple) else (found,)


def writer(func):
    """Returns a function that writes the results of ``func`` to the arrays ``out0``, ``out1``, ..."""

    def work(a):
        for k, values in enumerate(results(func, a)):
            a[f"out{k}"].copy_(values)

    return work


def with_room(func, arrays):
    made = results(func, arrays)
    return arrays | {f"out{k}": torch.zeros_like(values) for k, values in enumerate(made)}


def test_operators_are_those_of_torch():
    for name, operator in OPERATORS.items():
        arrays = operands(5)
        if name in ("types", "functions", "norms"):  # of a NaN as an integer there is no telling
            arrays["x"] = torch.nan_to_num(arrays["x"], 0.3, 0.7, -0.7)
        arrays = with_room(operator, arrays)
        expected = copies(arrays)
        launch = fused(writer(operator), arrays, 5)
        writer(operator)(expected)
        launch()
        assert_same(arrays, expected)


REFUSED = {
    "a mean of all worlds": (lambda x, y, i, b: x - x.mean(0), r"aten\.mean\.dim goes across worlds"),
    "a sum of everything": (lambda x, y, i, b: x * x.sum(), "goes across worlds"),
    "another world": (lambda x, y, i, b: x - x[0], r"aten\.select\.int goes across worlds"),
    "worlds in another order": (lambda x, y, i, b: x.flip(0), "goes across worlds"),
    "worlds side by side": (lambda x, y, i, b: x[:, :5].t() + x[:, :5], "mixes worlds"),
    "a product over worlds": (lambda x, y, i, b: x @ (x.t() @ y), "goes across worlds"),
    "one shape for all": (lambda x, y, i, b: x.view(-1)[:5] + x[:, 0], "goes across worlds"),
    "random numbers": (lambda x, y, i, b: x + torch.rand(5, 6), r"aten\.rand\.default draws numbers"),
    "sorting": (lambda x, y, i, b: x.sort(1)[0], r"aten\.sort\.default has no rule"),
    "other types": (lambda x, y, i, b: x.double().float(), "float64"),
}


def test_what_cannot_be_fused_is_named():
    for func, message in REFUSED.values():
        with pytest.raises(CannotFuse, match=message):
            fused(writer(func), with_room(func, operands(5)), 5)


@for_each("sizes", [(4, 4), (1, 3)])
def test_what_torch_refuses_is_its_error(sizes):
    with pytest.raises(RuntimeError, match=r"linalg\.cross"):
        trace(lambda arrays: torch.linalg.cross(*(arrays["x"][:, :size] for size in sizes)), operands(5))


@for_each("n", [1, 3, 6, 100])
def test_tensors_of_a_task_are_read_at_each_launch(n):
    """Of each size that may be mistaken for that of the worlds; literals of a hook stay what they are."""
    table = torch.arange(12.0).view(6, 2)
    scale, rows, one = torch.ones(6), torch.arange(2.0 * n).view(n, 2), torch.tensor(2.0)

    def work(a):
        a["out0"].copy_(a["x"] * scale + one + torch.tensor([1.0] * 6))
        a["out1"].copy_(a["x"][:, :2] - rows + torch.ones(n).unsqueeze(1) * table.expand(n, 6, 2)[0, 1:3, 1].sum())

    arrays = {"x": torch.ones(n, 6), "out0": torch.zeros(n, 6), "out1": torch.zeros(n, 2)}
    launch = fused(work, arrays, n)
    for factor in (1.0, 3.0):
        scale.fill_(factor)
        rows.add_(1.0)
        one.sub_(0.5)
        expected = copies(arrays)
        work(expected)
        launch()
        assert_same(arrays, expected)


def test_what_is_written_is_read_anew():
    def work(a):
        a["x"].add_(1.0)
        a["y"].copy_(a["x"].flip(1) * 2)
        a["x"].copy_(a["y"].flip(1) - a["x"])
        a["i"][:, 0].add_(a["i"][:, 1])

    arrays = operands(5)
    expected = copies(arrays)
    launch = fused(work, arrays, 5)
    for _ in range(2):
        work(expected)
        launch()
    assert_same(arrays, expected)


def test_written_tensors_that_share_memory_are_refused():
    whole = torch.zeros(5, 8)
    with pytest.raises(CannotFuse, match="shares memory"):
        fused(lambda a: a["x"].add_(a["y"]), {"x": whole[:, :6], "y": whole[:, 2:]}, 5)


def test_a_world_does_the_same_among_few_and_many():
    func = OPERATORS["functions"]
    many, ends = operands(300), []
    for n in (3, 300):
        arrays = with_room(func, copies({name: values[:n] for name, values in many.items()}))
        fused(writer(func), arrays, n)()
        ends.append([arrays[name][:3] for name in arrays if name.startswith("out")])
    for few, among_many in zip(*ends, strict=True):
        assert torch.equal(few.view(torch.int32), among_many.view(torch.int32))


TESTS = Path(__file__).parents[1]
TELL = """
import hashlib, sys, torchrl_loco
from torchrl_loco.envs import fusion
from torchrl_loco.sim import Simulation

plain = fusion.Program.run
def told(*args):
    source = plain(*args)
    print(hashlib.sha256(source.text.encode()).hexdigest())
    return source
Simulation.compile = lambda *args: sys.exit()  # when all texts are written
fusion.Program.run = told
torchrl_loco.make("go1_velocity", 2, "cpu", seed=0)
"""


@pytest.mark.ci
def test_kernels_are_found_in_the_cache_by_every_process():
    """Whatever the order of Python's sets in it."""
    texts = set()
    for seed in ("0", "1"):  # between which the order of the arrays of contacts differs
        env = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", TELL]
        made = subprocess.run(command, env=env, cwd=TESTS, capture_output=True, text=True, check=True)
        texts.add(made.stdout)
    assert len(texts) == 1
    assert len(texts.pop().split()) == 6
