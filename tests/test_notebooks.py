"""The notebooks run from a clean kernel, and what is stored of them is what a clean kernel printed."""

import re
from pathlib import Path

import nbformat
import pytest

from notebooks.execute import execute, main

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
ABSOLUTE = re.compile(r"/(?:home|Users|root|tmp|work|var|usr|opt|mnt)/|[A-Z]:\\\\")


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(output):
    """Yields what an output says in words; pictures and videos are left out."""
    yield from (output.get(name, "") for name in ("text", "ename", "evalue"))
    yield from (text for kind, text in output.get("data", {}).items() if kind == "text/plain")


@pytest.mark.ci
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_from_a_clean_kernel(path, tmp_path):
    """In a folder of its own, laid out as the repository is, where it leaves nothing behind."""
    folder = tmp_path / "notebooks"
    folder.mkdir()
    (tmp_path / "benchmarks").symlink_to(ROOT / "benchmarks")
    cells = code_cells(execute(read(path), folder))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert list(folder.iterdir()) == []


def test_stored_outputs_are_those_of_a_clean_run():
    """Run in order, without errors and warnings, and without paths of the machine."""
    for path in NOTEBOOKS:
        notebook = read(path)
        cells = code_cells(notebook)
        outputs = [output for cell in cells for output in cell.outputs]
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), path
        assert [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"] == [], path
        said = [str(notebook.metadata), *(text for output in outputs for text in texts(output))]
        assert [text for text in said if ABSOLUTE.search(text)] == [], path


def test_an_unknown_notebook_is_refused(capsys):
    for name in ("quickstrat.ipynb", "README.md"):
        with pytest.raises(SystemExit, match="2"):
            main([str(ROOT / "notebooks" / "quickstart.ipynb"), str(ROOT / "notebooks" / name)])
        said = capsys.readouterr()
        assert said.out == ""  # not even the first was run
        assert f"{name}: choose from " in said.err
        assert all(path.name in said.err for path in NOTEBOOKS)
