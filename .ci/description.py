"""Make the package's long description from the README, whose relative links would break there.

With an address under `Repository` in `[project.urls]` of pyproject.toml, links and pictures
become absolute. Without one, the README is used unchanged.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(?P<picture>!?)(?P<text>\[[^]]*\])\((?!https?:|#)(?P<target>[^)]+)\)")


class Description(MetadataHookInterface):
    """Set `readme` when the package is built."""

    def update(self, metadata: dict) -> None:
        """Add the description to the project's metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        address = metadata.get("urls", {}).get("Repository", "").rstrip("/")
        if address:
            text = absolute(text, address)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text: str, address: str) -> str:
    """Make the relative links of a page at the repository's top level absolute."""

    def whole(link: re.Match[str]) -> str:
        # A picture must be the raw file, not the page that shows it.
        kind = "raw" if link["picture"] else "blob"
        return f"{link['picture']}{link['text']}({address}/{kind}/HEAD/{link['target']})"

    return LINK.sub(whole, text)
