"""What benchmarks share: options, and results as files."""

from __future__ import annotations

import argparse
import io
import json
import platform
import sys
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil import __version__
from splatsoil.errors import ParameterError
from splatsoil.files import code_digest, read_json, write_bytes, write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from splatsoil.benchmarks._simulations import Data
    from splatsoil.inverse.executors import Executor

#: Everything that a benchmark's numbers may hang on: parts of the package, and packages beside it.
PARTS = ("measurement", "splats", "reconstruction", "soil", "mpm", "scene", "experiment", "synthetic")
FILES = ("parameters.py", "model.py", "comparison.py", "robust_loss.py")
BESIDE = ("splatsoil.envs", "splatsoil.inverse")


def here(name: str) -> str:
    """A device that is here, for an argument parser."""
    from splatsoil.envs.devices import resolve_device

    try:
        return resolve_device(name)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def at_least(least: int) -> Callable[[str], int]:
    """Whole numbers from one on, for an argument parser."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: give {least} or more")
        return value

    return number


def world_options(parser: argparse.ArgumentParser) -> None:
    """Options that choose a world to simulate."""
    parser.add_argument("set", type=Path, nargs="?", help="measurement set; none: the made-up world of PlowSand-v0")
    parser.add_argument("--reconstruction", type=Path, help="of the set, if there is one already")
    parser.add_argument("--parameters", nargs="+", default=["friction_angle"])
    parser.add_argument("--with", dest="effects", nargs="*", default=[], metavar="EFFECT")
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--executor", default="serial", help="serial, processes:N or dask:ADDRESS")


def simulated(options: argparse.Namespace, count: int, pool: Executor, seed: int = 0) -> tuple[Data, Path]:
    """Simulations at ``count`` Sobol points of the world that `world_options` chose, and where they are kept."""
    from splatsoil.benchmarks._simulations import simulations

    return simulations(
        count,
        options.parameters,
        options.effects,
        measurement=options.set,
        reconstruction=options.reconstruction,
        preset=options.preset,
        device=options.device,
        seed=seed,
        executor=pool,
        progress=ticker("simulations"),
    )


def output_options(parser: argparse.ArgumentParser) -> None:
    """Options that say where results go."""
    parser.add_argument("--out", type=Path, help="folder for result.json, table.md and figures")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def sources(others: Iterable[Path] = ()) -> str:
    """Digest of the sources behind a benchmark's numbers, from photographs to estimates, and of other files."""
    specs = [find_spec(name) for name in BESIDE]
    folders = [Path(p) for spec in specs if spec is not None for p in spec.submodule_search_locations or ()]
    return code_digest((*PARTS, *FILES), [*sorted(f for d in folders for f in d.rglob("*.py")), *others])


def keep_to_one_protocol(out: Path, described: Mapping[str, Any]) -> None:
    """Write down in a folder what decides its results, sources included; what is there goes on only with the same.

    Raises:
        ParameterError: the folder holds results of something else.
    """
    file, told = out / "protocol.json", json.loads(json.dumps(dict(described)))
    if file.is_file() and read_json(file) != told:
        raise ParameterError(f"{out}: holds results of another protocol or other sources; choose another --out")
    write_json(file, told)


def stamp(device: str) -> dict[str, Any]:
    """What made a result."""
    return {
        "version": __version__,
        "code": sources(),
        "device": device.split(":")[0],
        "machine": platform.machine(),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def write_result(out: Path, result: Mapping[str, Any], table: str, figures: Mapping[str, Figure]) -> None:
    """A benchmark's folder, each file whole or not there."""
    write_json(out / "result.json", dict(result))
    write_text(out / "table.md", table + "\n")
    for name, figure in figures.items():
        stream = io.BytesIO()
        figure.savefig(stream, format="svg" if name.endswith(".svg") else "png", bbox_inches="tight")
        write_bytes(out / name, stream.getvalue())


def ticker(what: str) -> Callable[[int, int], None]:
    """Progress as lines on stderr, one each tenth."""
    told = -1

    def report(done: int, total: int) -> None:
        nonlocal told
        tenth = 10 * done // max(total, 1)
        if tenth != told:
            told = tenth
            print(f"{what}: {done} of {total}", file=sys.stderr, flush=True)

    return report
