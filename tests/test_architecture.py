"""Arrows one way: docs/architecture.md lists the parts of the package, and none imports one below it."""

from __future__ import annotations

import re
from pathlib import Path


def test_no_part_imports_one_below_it(repository: Path, imports: dict[str, set[str]]) -> None:
    rows = re.findall(r"^\| (`.+?`) \|", (repository / "docs" / "architecture.md").read_text(), flags=re.MULTILINE)
    level = {part: k for k, row in enumerate(rows) for part in re.findall(r"`(.+?)`", row)}

    def part(name: str) -> str | None:
        found = [p for p in level if f"{name}.".startswith(f"splatsoil.{p}.")]
        return max(found, key=len, default=None)

    for name, others in imports.items():
        mine = part(name)
        assert mine or name == "splatsoil", f"{name} is in no row of docs/architecture.md"
        for other in filter(None, map(part, others)):
            assert mine is None or level[other] <= level[mine], f"{name} imports {other}"


def test_the_core_knows_no_command(imports: dict[str, set[str]]) -> None:
    """Spelt out, so that it holds whatever the page says."""
    core = tuple(f"splatsoil.{part}." for part in ("soil", "splats", "mpm", "scene", "reconstruction", "model"))
    outer = tuple(f"splatsoil.{part}" for part in ("commands", "cli", "api", "envs", "inverse", "benchmarks"))
    for name, others in imports.items():
        if f"{name}.".startswith(core):
            assert not [other for other in others if other.startswith(outer)], name
