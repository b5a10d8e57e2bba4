"""A tool that holds docstrings to shapes, units and errors; ruff's rules (pyproject.toml) hold them to the rest."""

import ast
import re
from pathlib import Path

import pytest

import torchrl_loco

ROOT = Path(torchrl_loco.__file__).parent

ARRAY = re.compile(r"\b(Tensor|ndarray|array|TensorDict|TensorDictBase)\b")
SHAPE = re.compile(r"``\([^`\"]*[,.][^`\"]*\)``|\bscalar\b|\bsame shape\b|:(class|meth|func):`")
QUANTITY = re.compile(r"(^|_)(dt|seconds|time|interval|fps|rate|speed|height|width|length|radius|angle)(_|$)", re.I)
UNIT = re.compile(r"(\(|\d )(s|m|rad|m/s)\b|\b(seconds|frames|steps|pixels|rows|(any|the) unit)\b", re.I)


def complaints(source):
    """Yields what the docstrings of a module lack. Names that begin with an underscore, and Warp's kernels, are exempt.

    1. A parameter, result or field annotated as tensor, array or TensorDict has a shape: ``(num_envs, 3)``, "scalar",
       "same shape" as another, or a reference to the class or function that tells it.
    2. A parameter, field, property or constant named like a quantity (``ctrl_dt``, ``STAND_HEIGHT``) has a unit.
    3. What ``__init__`` and ``__post_init__`` raise stands under Raises in their class, where ruff does not look.

    Its entry under Args, Attributes or Returns has to tell; without an entry, the docstring that it would be in.
    """
    yield from in_body(ast.parse(source).body, "", "")


def in_body(body, doc, prefix):
    """Yields what the names in the body of a module or class lack; ``doc`` is the docstring of the class."""
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from in_body(node.body, ast.get_docstring(node) or "", f"{node.name}.")
        elif isinstance(node, ast.FunctionDef):
            yield from in_function(node, doc, prefix + node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            text = after.value.value if told else entry(doc, "Attributes", ast.unparse(target))
            yield from in_name(ast.unparse(target), getattr(node, "annotation", None), text, prefix)


def in_function(node, doc, name):
    """Yields what a function or method lacks; ``doc`` is the docstring of its class, for what makes an instance."""
    if node.name in ("__init__", "__post_init__"):
        for error in sorted(set(re.findall(r"\braise (\w+)", ast.unparse(node)))):
            if f"    {error}: " not in entry(doc, "Raises"):
                yield f"{name} raises {error}, which is not explained"
    elif node.name.startswith("_") or any("wp." in ast.unparse(decorator) for decorator in node.decorator_list):
        return
    else:
        doc = ast.get_docstring(node) or ""
    for argument in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
        yield from in_name(argument.arg, argument.annotation, entry(doc, "Args", argument.arg), f"{name}: ")
    is_property = any(ast.unparse(decorator) == "property" for decorator in node.decorator_list)
    yield from in_name(node.name if is_property else "", node.returns, entry(doc, "Returns"), f"{name}: ")


def in_name(name, annotation, text, where):
    """Yields what the text about a parameter, field, property, constant or result lacks."""
    kind = "" if annotation is None else ast.unparse(annotation)
    if not name.startswith("_") and ARRAY.search(kind) and not SHAPE.search(text):
        yield f"{where}{name or 'result'} has no shape"
    if not name.startswith("_") and QUANTITY.search(name) and kind not in ("bool", "str") and not UNIT.search(text):
        yield f"{where}{name} has no unit"


def entry(doc, section, name=None):
    """Returns what a section of a docstring says, about one name if given, or else the whole docstring."""
    found = re.search(rf"^{section}:\n((    .*\n|\n)*)", f"{doc}\n", re.M)
    if found and name:
        found = re.search(rf"^    {name}: (.*\n(     .*\n|\n)*)", found[1], re.M)
    return found[1] if found else doc


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_shapes_units_and_errors_are_told(path):
    assert list(complaints(path.read_text())) == []


@pytest.mark.parametrize(
    ("file", "cut", "complaint"),
    [
        ("rendering.py", ", shape ``(num_envs, height, width, 3)``", "Renderer.render: result has no shape"),
        ("envs/state.py", ", ``(num_envs,)``", "write_state: mask has no shape"),
        ("replay.py", ", shape ``(substeps + 1, nq + nv)``", "warp_trace: result has no shape"),
        ("config.py", "(s), a whole multiple", "SimConfig.ctrl_dt has no unit"),
        ("training/evaluation.py", "length of the video (s)", "record: seconds has no unit"),
        ("envs/walker.py", " (m)", "STAND_HEIGHT has no unit"),
        ("collector.py", "ValueError: ", "RolloutCollector.__init__ raises ValueError, which is not explained"),
        (
            "training/config.py",
            "ValueError: ",
            "TrainingConfig.__post_init__ raises ValueError, which is not explained",
        ),
    ],
)
def test_what_is_cut_out_is_missed(file, cut, complaint):
    source = (ROOT / file).read_text()
    assert complaint in complaints(source.replace(cut, "", 1))
