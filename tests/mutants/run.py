"""Mutants: one small fault at a time in a copy of the package, and whether the tests that concern it see it.

    python tests/mutants/run.py --count 25 --seed 0 [--only splatsoil/mpm inverse]

A seeded sample of faults, Warp kernels' too, equally many of each kind. The tests of a fault are those that import its
module and those of its folder, but for the slow ones. Outcomes go to a file of JSON lines, and a second call goes on
where the first was stopped. mutmut leaves out whatever is decorated, and so all kernels; cosmic-ray has one test
command for all modules.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import copy
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import accumulate, islice, zip_longest
from pathlib import Path
from py_compile import PycInvalidationMode
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
OUT = REPOSITORY / "build" / "mutants.jsonl"
LIMIT = 900.0
"""Seconds for the tests of a mutant."""

COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
EXTREMES = {"min": "max", "minimum": "maximum", "argmin": "argmax", "floor": "ceil", "any": "all"}
EXTREMES |= {other: one for one, other in EXTREMES.items()}


@dataclass(frozen=True)
class Mutant:
    """A fault: bytes of a file of the package, and what stands there instead."""

    file: str
    line: int
    start: int
    end: int
    kind: str
    before: str
    after: str


def replaced(node: ast.AST, **fields: Any) -> str:
    """The source of a node with other fields."""
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return f"({ast.unparse(other)})"


def faults(node: ast.AST) -> Iterator[tuple[str, ast.AST, str]]:
    """Kind, node and new source of every fault at a node."""
    match node:
        case ast.Compare(ops=[op]):
            yield "comparison", node, replaced(node, ops=[COMPARISONS[type(op)]()])
        case ast.BinOp(op=op) if type(op) in OPERATORS:
            yield "operator", node, replaced(node, op=OPERATORS[type(op)]())
        case ast.Constant(value=float(value)):
            yield "constant", node, replaced(node, value=1.5 * value or 1.0)
        case ast.Constant(value=int(value)) if not isinstance(value, bool):
            yield "constant", node, replaced(node, value=value + 1)
        case ast.If() | ast.IfExp() | ast.While():
            yield "condition", node.test, f"(not ({ast.unparse(node.test)}))"
        case ast.Call():
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in EXTREMES:
                field = "attr" if isinstance(node.func, ast.Attribute) else "id"
                yield "extreme", node.func, replaced(node.func, **{field: EXTREMES[name]})
            if len(node.args) > 1:
                yield "argument", node, replaced(node, args=[node.args[1], node.args[0], *node.args[2:]])
            if node.keywords:
                yield "argument", node, replaced(node, keywords=node.keywords[:-1])
        case ast.FunctionDef() | ast.AsyncFunctionDef():
            for statement in node.body:
                if isinstance(statement, ast.If | ast.For | ast.While | ast.With):
                    yield "return", statement, "return"
                elif isinstance(statement, ast.AugAssign | ast.Expr) and not isinstance(statement.value, ast.Constant):
                    yield "return", statement, "pass"


def changeable(node: ast.AST, index: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """A node and all below it, each with whether it stands in an index; annotations, decorators, messages of errors,
    f-strings and imports for types alone stay as they are."""
    if isinstance(node, ast.Raise | ast.JoinedStr) or ast.unparse(getattr(node, "test", node)) == "TYPE_CHECKING":
        return
    yield node, index
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from changeable(child, index or (isinstance(node, ast.Subscript) and name == "slice"))


def mutants_of(file: str, source: bytes) -> Iterator[Mutant]:
    """All mutants of a module; in an index, constants only."""
    lines = [0, *accumulate(map(len, source.splitlines(keepends=True)))]
    for node, index in changeable(ast.parse(source)):
        if index and not isinstance(node, ast.Constant):
            continue
        for kind, changed, after in faults(node):
            start, end = (
                lines[line - 1] + column
                for line, column in ((changed.lineno, changed.col_offset), (changed.end_lineno, changed.end_col_offset))
            )
            yield Mutant(
                file, changed.lineno, start, end, "index" if index else kind, source[start:end].decode(), after
            )


def package_view(folder: Path) -> None:
    """The package as it installs. Its bytecode is checked by content: two faults may follow within a second."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]
    for name, source in {"splatsoil": "splatsoil", **project["package-dir"]}.items():
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / source, folder / name.replace(".", "/"), ignore=ignored, dirs_exist_ok=True)
    compileall.compile_dir(folder, quiet=1, invalidation_mode=PycInvalidationMode.CHECKED_HASH)


def sample(view: Path, only: list[str], seed: int) -> Iterator[Mutant]:
    """Mutants in random order, one of each kind in turn, of the given folders and files of the source."""
    wanted = tuple(f"splatsoil/{place.removeprefix('splatsoil/')}" for place in only or [""])
    kinds: dict[str, list[Mutant]] = {}
    for path in sorted(view.rglob("*.py")):
        file = path.relative_to(view).as_posix()
        if file.startswith(wanted):
            for mutant in mutants_of(file, path.read_bytes()):
                kinds.setdefault(mutant.kind, []).append(mutant)
    rng = random.Random(seed)
    shuffled = [rng.sample(kinds[kind], len(kinds[kind])) for kind in sorted(kinds)]
    for turn in zip_longest(*shuffled):
        yield from filter(None, turn)


def tests_of(file: str) -> list[str]:
    """Test files that import a module, then those of its package's folder; commands' where there are none."""
    *packages, name = Path(file).with_suffix("").parts
    package, tests = ".".join(packages), REPOSITORY / "tests"
    importing = re.compile(rf"(from|import) {package}\.{name}\b|from {package} import .*\b{name}\b")
    first = [f for f in sorted(tests.rglob("test_*.py")) if importing.search(f.read_text())]
    folder = tests.joinpath(*packages[1:]) if packages[1:] or first else tests / "commands"
    while not folder.is_dir():
        folder = folder.parent
    beside = sorted(folder.rglob("test_*.py")) if folder != tests else []
    return [f.relative_to(REPOSITORY).as_posix() for f in dict.fromkeys((*first, *beside))]


def failure(tests: list[str], view: Path, limit: float | None = None) -> str | None:
    """The first test that fails, empty for none; None where they took longer than ``limit`` seconds."""
    variables = {"PYTHONSAFEPATH": "1", "PYTHONPATH": f"{view}{os.pathsep}{REPOSITORY}", "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "pytest", "-xq", "--tb=no", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    with subprocess.Popen(
        words, cwd=REPOSITORY, env=os.environ | variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            told, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    named = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", told, flags=re.MULTILINE)
    return "" if process.returncode == 0 else named[1] if named else tests[0]


def judged(mutants: Iterable[Mutant], view: Path) -> Iterator[tuple[Mutant, str]]:
    """Each mutant and its outcome, which is kept. A test that fails must pass without the fault."""
    kept = [json.loads(line) for line in OUT.read_text().splitlines()] if OUT.exists() else []
    outcomes = {Mutant(**row["mutant"]): row["outcome"] for row in kept}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    for mutant in mutants:
        if mutant not in outcomes:
            path = view / mutant.file
            source = path.read_bytes()
            path.write_bytes(source[: mutant.start] + mutant.after.encode() + source[mutant.end :])
            test = failure(tests_of(mutant.file), view, LIMIT)
            path.write_bytes(source)
            if test and failure([test], view):
                raise SystemExit(f"mutants: {test} fails without any fault")
            outcomes[mutant] = {None: "timed out", "": "survived"}.get(test, "killed")
            with OUT.open("a") as file:
                file.write(json.dumps({"outcome": outcomes[mutant], "by": test, "mutant": asdict(mutant)}) + "\n")
        yield mutant, outcomes[mutant]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=25, help="mutants")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--only", nargs="+", default=[], help="folders or files of the source")
    given = parser.parse_args()
    counts = dict.fromkeys(("killed", "survived", "timed out"), 0)
    with tempfile.TemporaryDirectory() as folder:
        view = Path(folder)
        package_view(view)
        drawn = islice(sample(view, given.only, given.seed), given.count)
        for mutant, outcome in judged(drawn, view):
            counts[outcome] += 1
            before, after = (" ".join(text.split())[:70] for text in (mutant.before, mutant.after))
            print(f"{outcome:9}  {mutant.file}:{mutant.line}  {mutant.kind}: {before} -> {after}", flush=True)
    print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))


if __name__ == "__main__":
    main()
