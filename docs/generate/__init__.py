"""What the site and its pages take from the package instead of repeating it."""

import shutil
from pathlib import Path

from generate.markdown import write

DOCS = Path(__file__).parent.parent
OUT = DOCS / "generated"
NOTEBOOKS = DOCS.parent / "notebooks"


def everything() -> None:
    """Writes all that pages include to docs/generated, and leaves alone what has not changed."""
    write(OUT / "fragments" / "notebooks.md", notebooks(NOTEBOOKS, OUT / "notebooks"))


def notebooks(source: Path, target: Path) -> str:
    """Returns the table of contents of the notebooks, which are copied to where Sphinx finds them."""
    shutil.rmtree(target, ignore_errors=True)
    if not source.is_dir():
        return "There are none in this copy of the repository.\n"
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("[!a-zA-Z]*", "runs"))
    lines = (source / "README.md").read_text().splitlines()
    table = "\n".join(line for line in ["", *lines] if not line or line.startswith(("|", "In Colab")))
    table = table.replace("](", "](/generated/notebooks/").replace("/generated/notebooks/https", "https")
    entries = "\n".join(f"generated/notebooks/{path.stem}" for path in sorted(source.glob("*.ipynb")))
    return f"{table}\n```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
