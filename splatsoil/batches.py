"""Work in batches, in smaller ones once memory has been full."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

from splatsoil.errors import SetWarning

Item = TypeVar("Item")
Result = TypeVar("Result")

_most: dict[str, int] = {}
"""Largest batch by kind, of those that didn't fit as a whole."""


def full_memory(error: RuntimeError) -> str:
    """Which memory an error of torch or Warp says is full; empty for any other error."""
    if type(error).__name__ != "OutOfMemoryError" and "Failed to allocate" not in str(error):
        return ""
    return "memory" if "device 'cpu'" in str(error) else "GPU memory"


def in_batches(work: Callable[[Sequence[Item]], Sequence[Result]], items: Sequence[Item], kind: str) -> list[Result]:
    """What ``work`` makes of all items at once or, where memory is full, of half as many at a time.

    Args:
        work: items to as many results.
        items: any number of them.
        kind: what they are, for the warning; batches of one kind stay small once they had to be.

    Raises:
        RuntimeError: memory is full with a single one.
    """
    done: list[Result] = []
    while len(done) < len(items):
        batch = items[len(done) : len(done) + _most.get(kind, len(items))]
        try:
            done += work(batch)
        except RuntimeError as error:
            memory = full_memory(error)
            if len(batch) == 1 or not memory:
                raise
            _most[kind] = len(batch) // 2
            text = f"{memory} is full: {_most[kind]} instead of {len(batch)} {kind} at a time"
            warnings.warn(text, SetWarning, stacklevel=2)
        else:
            continue
        # Only here: while the error is known, so are the arrays of the functions that it came through.
        _release()
    return done


def _release() -> None:
    """Hand back what torch holds but does not use, which Warp can't take."""
    import torch

    torch.cuda.empty_cache()
