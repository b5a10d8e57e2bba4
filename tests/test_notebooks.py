"""The notebooks run from a clean kernel, and what is stored of them is what a clean kernel printed."""

import re
from pathlib import Path

import nbformat
import pytest

from notebooks.execute import execute, main

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LIMIT = 1_000_000
"""Bytes of a stored notebook."""
PRIVATE = re.compile(r"\._[a-z]|import _[a-z]|from _[a-z]|from \S+\._[a-z]")
ABSOLUTE = re.compile(r"/(?:home|Users|root|tmp|work|var|usr|opt|mnt)/|[A-Z]:\\\\")

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(path):
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def texts(output):
    """Yields what an output says in words; pictures and videos are left out."""
    yield from (output.get(name, "") for name in ("text", "ename", "evalue"))
    yield from (text for kind, text in output.get("data", {}).items() if kind == "text/plain")


def test_there_are_five():
    assert [path.stem for path in NOTEBOOKS] == ["physics", "quickstart", "rewards", "throughput", "training"]


@pytest.mark.slow
@each
def test_runs_from_a_clean_kernel(path, tmp_path):
    """In a folder of its own, laid out as the repository is, where it leaves nothing behind."""
    folder = tmp_path / "notebooks"
    folder.mkdir()
    (tmp_path / "benchmarks").symlink_to(ROOT / "benchmarks")
    executed = execute(read(path), folder)
    cells = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("name", ["quickstrat.ipynb", "README.md"])
def test_an_unknown_notebook_is_refused(name, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(ROOT / "notebooks" / "quickstart.ipynb"), str(ROOT / "notebooks" / name)])
    said = capsys.readouterr()
    assert said.out == ""  # not even the first was run
    assert f"{name}: choose from " in said.err
    assert all(path.name in said.err for path in NOTEBOOKS)


@each
def test_was_run_in_order_from_a_clean_kernel(path):
    cells = code_cells(path)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert [output for cell in cells for output in cell.outputs if output.output_type == "error"] == []


@each
def test_stores_no_warnings(path):
    streams = [output for cell in code_cells(path) for output in cell.outputs if output.output_type == "stream"]
    assert [stream.text for stream in streams if stream.name == "stderr"] == []


@each
def test_shows_pictures(path):
    kinds = [kind for cell in code_cells(path) for output in cell.outputs for kind in output.get("data", {})]
    assert "image/png" in kinds


@each
def test_is_small(path):
    assert path.stat().st_size < LIMIT


@each
def test_uses_the_public_interface_only(path):
    found = {cell.execution_count: PRIVATE.findall(cell.source) for cell in code_cells(path)}
    assert {count: names for count, names in found.items() if names} == {}


@each
def test_names_no_place_on_the_machine(path):
    notebook = read(path)
    said = [text for cell in code_cells(path) for output in cell.outputs for text in texts(output)]
    assert [text for text in said if ABSOLUTE.search(text)] == []
    assert ABSOLUTE.search(str(notebook.metadata)) is None
    assert [cell.id for cell in notebook.cells if "execution" in cell.metadata] == []
