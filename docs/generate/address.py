"""What follows from the project's public address, ``[tool.torchrl_loco] address`` in pyproject.toml."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
ADDRESS: str = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["torchrl_loco"]["address"]


def badges(address: str = ADDRESS) -> str:
    """Returns the badges of the README."""
    if not address:
        return ""
    test = f"{address}/actions/workflows/test.yml"
    package = "https://img.shields.io/pypi/v/torchrl-loco"
    return f"[![test]({test}/badge.svg)]({test}) [![package]({package})](https://pypi.org/project/torchrl-loco)\n"


def colab(address: str = ADDRESS) -> str:
    """Returns links that open the notebooks in Colab, which reads them from GitHub."""
    if not address.startswith("https://github.com/"):
        return ""
    opened = (
        f"https://colab.research.google.com/github/{address.removeprefix('https://github.com/')}/blob/main/notebooks"
    )
    names = sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))
    return "In Colab: " + ", ".join(f"[{name}]({opened}/{name}.ipynb)" for name in names) + ".\n"
