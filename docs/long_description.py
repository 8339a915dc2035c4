"""Hook of Hatchling: make the README fit a package index, where its relative links and pictures lead nowhere.

If pyproject.toml names the ``Repository`` under ``[project.urls]``, they become absolute. Otherwise pictures are left
out and links become plain text.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_RELATIVE = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)]+)\)")


def standalone(markdown: str, repository: str = "") -> str:
    """Return Markdown that does not depend on the files beside it."""

    def replacement(link: re.Match[str]) -> str:
        picture, text, place = link.groups()
        if not repository:
            return "" if picture else text
        return f"{picture}[{text}]({repository.rstrip('/')}/{'raw' if picture else 'blob'}/main/{place})"

    return _RELATIVE.sub(replacement, markdown)


class LongDescription(MetadataHookInterface):
    """Sets ``readme``."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Put the standalone README into the metadata."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get("Repository", "")
        metadata["readme"] = {"content-type": "text/markdown", "text": standalone(text, repository)}
