"""For `make docs`: docs/trust.md gets the README's section, so that it is written once."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The text of a page."""
    if page.file.src_uri != "trust.md":
        return markdown
    heading = "## When not to trust it\n"
    section = (Path(__file__).parent / "README.md").read_text().split(heading)[1].split("\n## ")[0]
    return heading[1:] + section.replace("](docs/", "](")
