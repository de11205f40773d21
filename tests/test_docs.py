"""The documentation as a site, and notebooks."""

from __future__ import annotations

import importlib.util
import json
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
    section = readme.split("## When not to trust it\n")[1].split("\n## ")[0]
    bold = re.findall(r"^- \*\*([^`*]+)\*\*", section, flags=re.MULTILINE)
    page = (tmp_path / "site" / "trust" / "index.html").read_text()
    assert bold and all(words in page for words in bold), "the README's list is a page"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["engineer", "researcher"])
def test_notebooks_run(name: str, repository: Path, tmp_path: Path) -> None:
    notebook = json.loads((repository / "examples" / "notebooks" / f"{name}.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells), "results that no test holds would grow old"
    code = "\n".join("".join(cell["source"]) for cell in cells)
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    said = {
        "engineer": r"^[\d.]+ ± [\d.]+ deg; true: 34\.0$",
        "researcher": r"^Bayesian: best guesses are [\d.]+° off$",
    }
    assert re.search(said[name], done.stdout, flags=re.MULTILINE)
