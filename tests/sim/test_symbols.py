"""Traced expressions: their values, how they simplify, and that what is assigned again is computed again."""

import math
import re
import types

import hypothesis
import numpy as np
import pytest
from cases import MODELS
from evaluate import evaluate
from hypothesis import strategies as st

from torchrl_loco.sim import models
from torchrl_loco.sim.compiled.ir.symbols import (
    Block,
    Scalar,
    absolute,
    array,
    cell,
    cross,
    literal,
    maximum,
    minimum,
    name,
    names,
    scalar,
    select,
    sincos,
    sqrt,
)
from torchrl_loco.sim.compiled.physics.dynamics import Dynamics

SYMBOLS = ("a", "b", "c")
NUMBERS = st.sampled_from([-2.0, -1.0, 0.0, 0.5, 1.0, 3.0])
BINARY = {
    "+": lambda x, y: x + y,
    "-": lambda x, y: x - y,
    "*": lambda x, y: x * y,
    "min": lambda x, y: minimum(x, y) if isinstance(x, Scalar) or isinstance(y, Scalar) else min(x, y),
    "max": lambda x, y: maximum(x, y) if isinstance(x, Scalar) or isinstance(y, Scalar) else max(x, y),
    "choose": lambda x, y: select(x, "<", y, x * 2, y) if isinstance(x, Scalar) else (x * 2 if x < y else y),
}
UNARY = {
    "neg": lambda x: -x,
    "abs": lambda x: absolute(x) if isinstance(x, Scalar) else abs(x),
    "root": lambda x: sqrt(x * x + 1) if isinstance(x, Scalar) else math.sqrt(x * x + 1),
    "sine": lambda x: sincos(x)[0] if isinstance(x, Scalar) else math.sin(x),
    "cosine": lambda x: sincos(x)[1] if isinstance(x, Scalar) else math.cos(x),
    "divide": lambda x: 3.0 / (x * x + 2),
}
EXPRESSIONS = st.recursive(
    st.sampled_from(SYMBOLS) | NUMBERS,
    lambda inner: st.tuples(st.sampled_from([*UNARY]), inner) | st.tuples(st.sampled_from([*BINARY]), inner, inner),
    max_leaves=12,
)


def built(tree, leaf):
    """Returns the value of a tree of operations, with ``leaf`` in the place of symbols and numbers."""
    if not isinstance(tree, tuple):
        return leaf(tree)
    operation, *parts = tree
    return {**UNARY, **BINARY}[operation](*(built(part, leaf) for part in parts))


def traced(tree):
    return scalar(built(tree, lambda x: name(x) if isinstance(x, str) else scalar(x)))


VALUES = st.fixed_dictionaries({symbol: st.sampled_from([-1.7, -0.4, 0.0, 0.3, 1.0, 2.5]) for symbol in SYMBOLS})


@pytest.mark.slow
@hypothesis.settings(deadline=None, derandomize=True, max_examples=300)
@hypothesis.given(tree=EXPRESSIONS, values=VALUES)
def test_values_are_those_of_plain_arithmetic(tree, values):
    """However an expression was simplified, and as C++ too."""
    expected = built(tree, lambda x: values.get(x, x))
    found = traced(tree)
    assert float(evaluate(found, values)) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    block = Block()
    result = block.value(found)
    assert run(block, values, result) == pytest.approx(expected, rel=1e-6, abs=1e-6)


MATH = types.SimpleNamespace(divide=lambda a, b: a / b, root=math.sqrt, smaller=min, larger=max)


def run(block, variables, result):
    """Returns the value of a C++ expression after the statements of a block, which are straight-line code."""
    scope = {"Math": MATH, "fabsf": abs, **variables, "math": math}
    for line in [*block.lines, f"result = {result};"]:
        text = line.replace("::", ".")
        text = re.sub(
            r"float (\w+), \w+; Math\.sincos\((.*), \w+, (\w+)\);", r"\1, \3 = math.sin(\2), math.cos(\2)", text
        )
        text = re.sub(r"(?<=\d)f\b", "", text).removeprefix("const ").removeprefix("float ").removesuffix(";")
        text = re.sub(r"= (.*) \? (.*) : (.*)$", r"= (\2) if (\1) else (\3)", text)
        exec(text, scope)
    return scope["result"]


def test_equal_expressions_are_one():
    a, b = name("a"), name("b")
    assert a * b + sqrt(a) is a * b + sqrt(a)
    assert scalar(2) * a is a * 2.0
    block = Block()
    assert block.value(a * b) == block.value(a * b)
    assert len(block.lines) == 1


def test_zeros_vanish_and_constants_fold():
    x = name("x")
    minus = -x
    assert (x * 0).constant == (0 * x).constant == (x - x).constant == (scalar(0) / x).constant == 0
    for same in (x + 0, 0 + x, x - 0, x * 1, 1 * x, x / 1, -minus, -1 * minus, x + (scalar(0.3) - 0.1 - 0.2)):
        assert same is x
    assert (scalar(2) * 3 + 4 / scalar(8)).constant == 6.5
    assert sqrt(9).constant == 3
    assert [value.constant for value in sincos(0)] == [0, 1]
    assert select(x, "<", 0, x + 1, 1 + x - 0) is not None
    assert select(x, "<", 0, x, x + 0) is x
    assert (2 * (3 * x)) is 6 * x
    turned = cross(array([0, 1, 0]), np.array([x, scalar(0), scalar(0)]))
    assert [value.constant for value in turned[:2]] == [0, 0]
    assert turned[2] is -x


def test_a_planar_body_has_planar_arithmetic():
    """The walker moves in a plane: nothing is computed for what is out of it."""
    m = models.load(MODELS["walker"])
    tree = Dynamics(m, names("qpos", m.nq), names("qvel", m.nv), names("ctrl", m.nu))
    for motion in [*tree.cdof, *tree.cvel[1:]]:
        angular, linear = motion[:3], motion[3:]
        assert [scalar(value).constant for value in (angular[0], angular[2], linear[1])] == [0, 0, 0]
    for pose in tree.poses.xmat[1:]:
        assert [pose[0, 1].constant, pose[1, 0].constant, pose[1, 1].constant] == [0, 0, 1]
        assert pose[0, 0].constant is None


def test_what_was_assigned_is_computed_again():
    """And what is not assigned, or kept before, is not."""
    block, x, y = Block(), cell("x"), name("y")
    twice, other, kept = block.value(x * 2), block.value(y * 2), block.keep(x * 3)
    block.set("x", x + 10)
    again = block.value(x * 2)
    assert block.value(y * 2) == other
    assert block.value(kept) == kept.args[0]
    values = {"x": 1.0, "y": 5.0}
    assert [run(block, dict(values), result) for result in (twice, again, kept.args[0])] == [2, 22, 3]


def test_an_element_stands_for_its_array():
    block, first, second = Block(), cell("x[0]"), cell("x[i]")
    before = block.value(second * 2)
    block.set("x[0]", 1.0)
    assert block.value(second * 2) != before  # i may be 0
    assert block.value(first * 2) == block.value(first * 2)


def test_inner_blocks_share_what_cannot_change():
    """An inner block may run again, after its cells were assigned: it computes anew what depends on them."""
    block, x, y = Block(), cell("x"), name("y")
    of_cell, of_name = block.value(x * 2), block.value(y * 2)
    with block.loop("i", 3) as inner:
        assert inner.value(y * 2) == of_name
        assert inner.value(x * 2) != of_cell
        inside = inner.value(y * 7)
        inner.set("x", x + 1)
    assert block.value(x * 2) != of_cell  # the loop assigned it
    assert block.value(y * 2) == of_name
    assert block.value(y * 7) != inside  # that name ended with its block


def test_literals_keep_every_bit_of_float32():
    for x in (0.0, 1.0, -2.5, 1e-20, 3.4e38, 1 / 3, 123456.789, 1e-4, 9.999999e6, 1e7, 27700832.0, 5e8):
        text = literal(x)
        assert text.endswith("f")
        assert np.float32(text.removesuffix("f")) == np.float32(x)
        assert "." in text or "e" in text
