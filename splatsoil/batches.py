"""Batch processing that halves its batches when memory is full."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

from splatsoil.errors import SetWarning

Item = TypeVar("Item")
Result = TypeVar("Result")

_most: dict[str, int] = {}
"""Largest batch that fits, by kind."""


def full_memory(error: RuntimeError) -> str:
    """Which memory is full by an error of torch or Warp; empty for any other error."""
    if type(error).__name__ != "OutOfMemoryError" and "Failed to allocate" not in str(error):
        return ""
    return "memory" if "device 'cpu'" in str(error) else "GPU memory"


def in_batches(work: Callable[[Sequence[Item]], Sequence[Result]], items: Sequence[Item], kind: str) -> list[Result]:
    """Results of ``work`` for all items at once or, if memory is full, for half as many at a time.

    Args:
        work: items to as many results.
        items: any number of them.
        kind: of the items, for the warning; the batch size of a kind is remembered.

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
        # Only here: the error refers to arrays of the functions that it came through.
        _release()
    return done


def _release() -> None:
    """Return torch's unused memory to the device, for Warp."""
    import torch

    torch.cuda.empty_cache()
