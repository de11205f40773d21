"""Where commands print: the result on stdout, everything else on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement

_stdout: ContextVar[TextIO | None] = ContextVar("stdout", default=None)


@contextmanager
def only_json() -> Iterator[None]:
    """Send whatever is printed to stderr, so that stdout holds nothing but the one object of ``print_json``."""
    token = _stdout.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _stdout.reset(token)


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout, also inside ``only_json``.

    Raises:
        ValueError: the data holds NaN or infinity, which JSON cannot.
    """
    print(json.dumps(data, indent=1, allow_nan=False), file=_stdout.get() or sys.stdout, flush=True)


def say_remarks(measurement: Measurement) -> None:
    """Print on stderr what is odd about a set that is about to be worked on."""
    from splatsoil.measurement import remarks

    for remark in remarks(measurement):
        print(f"remark {remark.about}: {remark.text}", file=sys.stderr)
