"""The documentation as a site."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs the extra docs")
def test_the_site_builds_without_a_warning(repository: Path, tmp_path: Path) -> None:
    """Links to pages and headings that are not there, and pages that no menu leads to, are warnings."""
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(
        words,
        cwd=repository,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    readme = (repository / "README.md").read_text()
    bold = re.findall(r"^- \*\*([^`*]+)\*\*", readme.split("## When not to trust it\n")[1], flags=re.MULTILINE)
    page = (tmp_path / "site" / "trust" / "index.html").read_text()
    assert bold and all(words in page for words in bold), "the README's list is a page"
