"""What the package index is told: the README with links that work there, and the project's pages."""

import re
import tomllib
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class Hook(MetadataHookInterface):
    """Derives readme and urls from ``[tool.torchrl_loco] address``; without one, links stay as they are."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Fills in the metadata of the project."""
        root = Path(self.root)
        address = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["torchrl_loco"]["address"]
        text = (root / "README.md").read_text()
        if address:
            text = absolute(text, address, f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        metadata["urls"] = urls(address)


def absolute(text: str, address: str, tag: str) -> str:
    """Returns Markdown with links to files and pictures of the repository as they are at a tag."""

    def full(found: re.Match[str]) -> str:
        kind = "raw" if found[1] else "blob"
        return f"{found[1]}[{found[2]}]({address}/{kind}/{tag}/{found[3]})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)", full, text)


def urls(address: str) -> dict[str, str]:
    """Returns the project's pages by their names."""
    if not address:
        return {}
    pages = {"Repository": address, "Issues": f"{address}/issues", "Changelog": f"{address}/blob/main/CHANGELOG.md"}
    if found := re.fullmatch(r"https://github\.com/([^/]+)/([^/]+)", address):
        pages["Documentation"] = f"https://{found[1].lower()}.github.io/{found[2]}/"
    return pages
