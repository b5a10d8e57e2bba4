"""Runs notebooks from a clean kernel: ``python notebooks/execute.py notebooks/*.ipynb`` stores what they print."""

import argparse
import os
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

KERNEL = "python3"
TIMEOUT = 600
"""Seconds that a cell may take: with cold kernels, the first waits for the compiler."""
ASIDE = "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver.", "stopping after this update"
"""Beginnings of messages on stderr that are left out: about a machine without a GPU, and on Ctrl-C."""
WIDGET = "application/vnd.jupyter.widget-view+json"
"""Type of an output that shows nothing without its kernel, such as a progress bar."""


def execute(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """Returns a notebook with the outputs of all its cells, run in order in a new kernel.

    Args:
        notebook: is changed in place.
        folder: where the cells run.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell raised an error; the message shows the cell and the error.
    """
    environment = {**os.environ, "TQDM_DISABLE": "1"}  # a progress bar at its end is no result
    environment.pop("PYTHONWARNINGS", None)  # the warnings that users see
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT,
        kernel_name=KERNEL,
        resources={"metadata": {"path": str(folder)}},
        record_timing=False,
        store_widget_state=False,
    )
    client.execute(env=environment)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if is_worth_keeping(output)]
    notebook.metadata["language_info"] = {"name": "python"}  # without the machine's version
    return notebook


def is_worth_keeping(output: nbformat.NotebookNode) -> bool:
    """Returns whether an output is the notebook's own, and shows something when it is read."""
    if output.output_type == "stream":
        return not output.text.lstrip().startswith(ASIDE)
    return WIDGET not in output.get("data", {})


def main(args: list[str] | None = None) -> None:
    """Runs notebooks in place."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebooks", nargs="+", type=Path, help="files to run; each is overwritten")
    paths = parser.parse_args(args).notebooks
    for path in paths:
        if path.suffix != ".ipynb" or not path.is_file():
            known = ", ".join(sorted(os.path.relpath(known) for known in Path(__file__).parent.glob("*.ipynb")))
            parser.error(f"there is no notebook {path}: choose from {known}")
    for path in paths:
        start = time.perf_counter()
        notebook = execute(nbformat.read(path, as_version=4), path.parent)
        path.write_text(nbformat.writes(notebook) + "\n")
        print(f"{path}: {time.perf_counter() - start:.0f} s, {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
