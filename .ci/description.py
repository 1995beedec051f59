"""The README as the long description of the package, where its relative links lead nowhere.

With an address under `Repository` in `[project.urls]` of pyproject.toml, links and pictures
become absolute. Without one the description is the README as it is.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(?P<picture>!?)(?P<text>\[[^]]*\])\((?!https?:|#)(?P<target>[^)]+)\)")


class Description(MetadataHookInterface):
    """Sets `readme` when the package is built."""

    def update(self, metadata: dict) -> None:
        """Add the text to the metadata of the project."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        address = metadata.get("urls", {}).get("Repository", "").rstrip("/")
        if address:
            text = absolute(text, address)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text: str, address: str) -> str:
    """Return a page of the repository's top level with its relative links made absolute."""

    def whole(link: re.Match[str]) -> str:
        # A picture has to be the file itself, not the page that shows it.
        kind = "raw" if link["picture"] else "blob"
        return f"{link['picture']}{link['text']}({address}/{kind}/HEAD/{link['target']})"

    return LINK.sub(whole, text)
