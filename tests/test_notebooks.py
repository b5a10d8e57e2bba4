"""The notebooks run from a clean kernel, and what is stored of them is what a clean kernel printed."""

from pathlib import Path

import nbformat
import pytest
from for_each import for_each

from notebooks.execute import execute, main

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.ci
@for_each("path", NOTEBOOKS)
def test_runs_from_a_clean_kernel(path, tmp_path):
    """In a folder of its own, laid out as the repository is, where it leaves nothing behind."""
    folder = tmp_path / path.stem / "notebooks"
    folder.mkdir(parents=True)
    (folder.parent / "benchmarks").symlink_to(ROOT / "benchmarks")
    cells = code_cells(execute(read(path), folder))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert list(folder.iterdir()) == []


def test_stored_outputs_are_those_of_a_clean_run():
    """Run in order, without errors and warnings."""
    for path in NOTEBOOKS:
        notebook = read(path)
        cells = code_cells(notebook)
        outputs = [output for cell in cells for output in cell.outputs]
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), path
        assert [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"] == [], path


def test_an_unknown_notebook_is_refused(capsys):
    for name in ("quickstrat.ipynb", "README.md"):
        with pytest.raises(SystemExit, match="2"):
            main([str(ROOT / "notebooks" / "quickstart.ipynb"), str(ROOT / "notebooks" / name)])
        said = capsys.readouterr()
        assert said.out == ""  # not even the first was run
        assert f"{name}: choose from " in said.err
        assert all(path.name in said.err for path in NOTEBOOKS)
