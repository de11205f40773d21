"""Arrows one way: docs/architecture.md lists the parts of the package, and none imports one below it."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

PACKAGES = ("splatsoil", "splatsoil.envs", "splatsoil.inverse", "splatsoil.benchmarks")


def modules() -> dict[str, Path]:
    """Files by the names under which they are imported, wherever they are installed."""
    out = {}
    for package in PACKAGES:
        (root,) = importlib.util.find_spec(package).submodule_search_locations  # type: ignore[union-attr,misc]
        for file in Path(root).rglob("*.py"):
            out[".".join((package, *file.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")] = file
    return out


def imported(name: str, file: Path) -> Iterator[str]:
    """Full names of what a module imports anywhere, for types alone aside."""
    nodes: list[ast.AST] = [ast.parse(file.read_text())]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = name.split(".")[: -node.level if file.stem != "__init__" else 1 - node.level or None]
            base = ".".join((*(package if node.level else ()), *([node.module] if node.module else ())))
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            nodes += ast.iter_child_nodes(node)


def test_no_part_imports_one_below_it(repository: Path) -> None:
    rows = re.findall(r"^\| (`.+?`) \|", (repository / "docs" / "architecture.md").read_text(), flags=re.MULTILINE)
    level = {part: k for k, row in enumerate(rows) for part in re.findall(r"`(.+?)`", row)}

    def part(name: str) -> str | None:
        found = [p for p in level if f"{name}.".startswith(f"splatsoil.{p}.")]
        return max(found, key=len, default=None)

    for name, file in modules().items():
        mine = part(name)
        assert mine or name == "splatsoil", f"{name} is in no row of docs/architecture.md"
        for other in filter(None, map(part, imported(name, file))):
            assert mine is None or level[other] <= level[mine], f"{name} imports {other}"


def test_the_core_knows_no_command() -> None:
    """Spelt out, so that it holds whatever the page says."""
    core = tuple(f"splatsoil.{part}." for part in ("soil", "splats", "mpm", "scene", "reconstruction", "model"))
    outer = tuple(f"splatsoil.{part}" for part in ("commands", "cli", "api", "envs", "inverse", "benchmarks"))
    for name, file in modules().items():
        if f"{name}.".startswith(core):
            assert not [other for other in imported(name, file) if other.startswith(outer)], name
