"""Random programs as hooks: each is a kernel with the numbers of plain torch, or runs without one; none is an error."""

import random
import re

import pytest
import torch

import torchrl_loco as loco
from torchrl_loco.envs.fusion import CannotFuse, fuse, trace
from torchrl_loco.envs.view import View

TABLES = {"t": torch.linspace(-1, 1, 5), "u": torch.linspace(-2, 2, 12).view(4, 3)}
NAMES = {"torch": torch, "F": torch.nn.functional, **TABLES}
ATOMS = """s.qpos; s.qvel; s.qpos[:, 1]; s.xmat('torso').flatten(1); s.xmat('torso')[:, 0]; s.xpos('torso'); s.action
s.time[:, None]; s.uniform(-1, 1, 2); t; t[0]; u; u[1]; torch.ones(3); torch.tensor([0.5, -1.0]); 2.0 * t[2]"""
FORMS = """-x; x.abs(); x.sin(); x.tanh(); x.exp().clamp(max=9.0); x.square(); x.clamp(-0.5, 0.8); x.softmax(-1)
x.flip(-1); x.flip(0); x.cumsum(-1); x.cumsum(0); x.roll(1, -1); x.diff(dim=-1); x.sort(-1)[0]; x.logsumexp(-1)
x.sum(-1, keepdim=True); x.sum(-1); x.mean(-1, keepdim=True); x.amax(-1); x.amin(-1, keepdim=True); x.prod(-1)
x.norm(dim=-1, keepdim=True); F.normalize(x, dim=-1); x.argmax(-1).float(); x.var(-1, correction=0); F.pad(x, (1, 1))
x[..., :2]; x[..., -1:]; x[..., ::2]; x[..., 0]; x[:, [1, 0, 1]]; x[1]; x.unsqueeze(-1); x.squeeze(-1); x.t()
x.flatten(1); x.transpose(-1, -2); x.repeat(1, 2); x.clone().fill_(0.5); x.clone().mul_(2.0); torch.zeros_like(x); x + y
x - y; x * y; x / (y.abs() + 0.5); torch.minimum(x, y); torch.where(x > y, x, y); torch.where(x > 0, y, 0.3); x @ y
x % (y.abs() + 0.3); torch.cat([x, y], -1); torch.stack([x, y], -1); torch.stack([x, y]).sum(0); torch.atan2(x, y)
t[(x * 3).long() % 5]; u[(x * 3).long() % 4]; x.gather(-1, (y * 3).long() % 2); x.masked_fill(y > 0.2, -1.0)"""


def program(rng, depth=4):
    """Returns the text of a random expression of a view ``s`` and of tables; many are no torch."""
    form = rng.choice(re.split(r";\s+|\n", FORMS if depth else ATOMS))
    return re.sub(r"\b[xy]\b", lambda _: f"({program(rng, rng.randrange(depth))})", form)


def evaluate(text, s):
    return 0 * s.time + eval(text, {"s": s, **NAMES}).float().sum(-1)


class Programs(loco.WalkerWalk):
    texts = ("s.qpos", "s.action")

    def reward(self, s):
        return {text: evaluate(text, s) for text in self.texts}


@torch.no_grad()
@pytest.mark.parametrize(("count", "seed"), [(60, 0), pytest.param(500, 1, marks=pytest.mark.ci)])
def test_random_programs_give_the_numbers_of_plain_torch(count, seed):
    rng, n, fused = random.Random(seed), 5, []
    env = Programs(n, "cpu", 0, compile_hooks=False)
    env.rollout(3)
    arrays, catalog = env.world._judge._arrays, env.hooks.catalog
    while len(fused) < count:
        text = program(rng)
        work = lambda a, text=text: a["reward"].copy_(evaluate(text, View(catalog, a, "reward", 1)))  # noqa: E731
        try:
            work(arrays)
        except (RuntimeError, IndexError, TypeError):  # it is no torch
            continue
        try:
            fuse(trace(work, arrays), arrays, n, env.sim.device)
        except CannotFuse:
            continue
        except RuntimeError as error:
            assert "reads a number out of a tensor" in str(error), text  # noqa: PT017
        else:
            fused.append(text)
    for first in range(0, count, 100):
        task = type("Programs", (Programs,), {"texts": tuple(dict.fromkeys(fused[first : first + 100]))})
        found = []
        for compiled in (True, False):
            torch.manual_seed(0)
            env = task(n, "cpu", 0, reward_terms=True, compile_hooks=compiled)
            found.append(env.rollout(5)["next", "reward_terms"])
            assert env.world._judge.kind == ("kernel" if compiled else "plain torch")
        for text in task.texts:
            one, other = (terms[text] for terms in found)
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3, equal_nan=True, msg=text)
