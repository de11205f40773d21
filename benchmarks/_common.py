"""What benchmarks share: options, progress, tables, pages, and what a result was made with."""

from __future__ import annotations

import argparse
import io
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from splatsoil import __version__
from splatsoil.devices import resolve_device
from splatsoil.errors import ParameterError, RunError
from splatsoil.files import code_digest, plain, read_json, write_bytes, write_json, write_text
from splatsoil.parameters import Parameter
from splatsoil.threads import cores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]

PARTS = (
    *("measurement", "splats", "reconstruction", "soil", "mpm", "scene", "experiment", "synthetic", "envs", "inverse"),
    *("parameters.py", "model.py", "comparison.py", "robust_loss.py"),
)
"""Parts of the package that a benchmark's numbers may depend on."""
PACKAGES = ("numpy", "torch", "warp-lang", "newton")
"""Packages whose versions are stated."""


def at_least(least: int) -> Callable[[str], int]:
    """Type of an option: an integer that is not smaller."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: give {least} or more")
        return value

    return number


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Shows descriptions as they are, and the defaults of options that have one."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        without = action.default in (None, False, argparse.SUPPRESS, "", [])
        return action.help if without else f"{action.help} (default: %(default)s)"


def parser_of(module_doc: str | None, out: str = "", *, page: bool = False) -> argparse.ArgumentParser:
    """An argument parser with ``--device``; with ``--out`` and ``--json`` where results have a folder; with ``--page``
    where they have a place on a page."""
    parser = argparse.ArgumentParser(description=module_doc, formatter_class=Formatter)
    parser.add_argument("--device", type=resolve_device, default="cpu", help="cpu or cuda:0")
    if out:
        parser.add_argument("--out", type=Path, default=Path(out), help="folder of results, to continue from")
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    if page:
        parser.add_argument("--page", type=Path, help="write the tables into their place on this page (.md)")
    return parser


def tell(
    options: argparse.Namespace, result: Mapping[str, Any], text: str, figures: Mapping[str, Figure] | None = None
) -> None:
    """Keep a result, its text and its figures by file name in ``options.out``, and print the one or the other."""
    write_json(options.out / "result.json", dict(result))
    write_text(options.out / "table.md", text + "\n")
    for name, figure in (figures or {}).items():
        write_figure(options.out / name, figure)
    print(json.dumps(plain(dict(result)), indent=1) if options.json else text)


def sized(p: Parameter, times: float) -> float:
    """A parameter whose distance from off is a multiple of its smallest meaningful change, within its bounds; upwards
    where it has two sides."""
    return float(np.clip((p.off or 0.0) + (p.sign or 1) * times * p.meaningful, p.lower, p.upper))


def write_figure(file: Path, figure: Figure) -> None:
    """A figure in the format of the file's name."""
    stream = io.BytesIO()
    figure.savefig(stream, format=file.suffix[1:] or "png", dpi=110, bbox_inches="tight")
    write_bytes(file, stream.getvalue())


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def with_section(page: Path, name: str, text: str) -> str:
    """A page's text with what stands between its two lines ``<!-- NAME: … -->`` and ``<!-- NAME: end -->`` replaced.

    Raises:
        RunError: the page cannot be read, or does not have each of the lines once.
    """
    first, last = f"<!-- {name}: written by the command, what stands here is overwritten -->", f"<!-- {name}: end -->"
    try:
        old = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{page}: cannot be read as text ({error}); choose another page") from error
    before, begin, rest = old.partition(f"{first}\n")
    _, end, after = rest.partition(last)
    if not begin or not end or old.count(first) + old.count(last) > 2:
        raise RunError(f"{page}: has no lines {first!r} and {last!r}, once each, to write between")
    return f"{before}{begin}{text}\n{end}{after}"


def sources(*benchmarks: str) -> str:
    """Digest of the sources behind a benchmark's numbers: the package's, and those of modules beside this one."""
    return code_digest((*PARTS, *(f"benchmarks/{name}.py" for name in benchmarks)))


def keep_to_one_protocol(out: Path, described: Mapping[str, Any]) -> None:
    """Write what determines a folder's results, sources included; a folder of the same protocol is continued.

    Raises:
        ParameterError: the folder contains results of another protocol.
    """
    file, protocol = out / "protocol.json", plain(dict(described))
    if file.is_file() and read_json(file) != protocol:
        raise ParameterError(f"{out}: contains results of another protocol or other sources; choose another --out")
    write_json(file, protocol)


def stamp(device: str) -> dict[str, str]:
    """What makes a result: code, device, processor, versions of packages, date."""
    made = {
        "version": __version__,
        "code": sources(),
        "device": device.split(":")[0],
        "processor": _processor(),
        "cores": str(cores()),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "load": f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            made[name] = version(name)
    if device != "cpu":
        import torch

        made["gpu"] = f"{torch.cuda.get_device_name(device)} (CUDA {torch.version.cuda})"
    return made


def sentence(made: Mapping[str, str]) -> str:
    """A stamp in words."""
    packages = ", ".join(f"{name} {made[name]}" for name in PACKAGES if name in made)
    gpu = f"{made['gpu']}, " if "gpu" in made else ""
    return (
        f"{made['made'][:10]}: {gpu}{made['processor']}, {made['cores']} cores; {made['system']}; splatsoil "
        f"{made['version']} (code {made['code']}), {packages}; load {made['load']}"
    )


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or "unknown processor")


class Clock:
    """Prints progress on stderr, with the seconds since the start."""

    def __init__(self) -> None:
        self.began = time.monotonic()

    def __call__(self, what: str) -> None:
        print(f"{time.monotonic() - self.began:7.0f} s  {what}", file=sys.stderr, flush=True)
