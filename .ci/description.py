"""Make the package's long description from the README, whose relative links would break there.

With an address under `Repository` in `[project.urls]` of pyproject.toml, links and pictures
become absolute. Without an address, the README is used unchanged.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

# A relative link [TEXT](TARGET), or a picture ![TEXT](TARGET), in Markdown.
LINK = re.compile(r"(?P<picture>!?)(?P<text>\[[^]]*\])\((?!https?:|#)(?P<target>[^)]+)\)")


class Description(MetadataHookInterface):
    """A hook of Hatchling that sets the long description when the package is built."""

    def update(self, metadata: dict) -> None:
        """Add the long description to the project's metadata."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        address = metadata.get("urls", {}).get("Repository", "").rstrip("/")
        if address:
            text = with_absolute_links(text, address)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def with_absolute_links(page: str, address: str) -> str:
    """Return a Markdown page with absolute links.

    `page` is the text of a page at the top level of the repository, and `address` is the
    repository's address, such as "https://example.org/someone/project".
    """

    def absolute(link: re.Match[str]) -> str:
        # A picture must be the raw file, and not the page that shows the file.
        view = "raw" if link["picture"] else "blob"
        return f"{link['picture']}{link['text']}({address}/{view}/HEAD/{link['target']})"

    return LINK.sub(absolute, page)
