"""Threads: how many there may be, and one for linear algebra where digits count."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def cores() -> int:
    """How many cores of the CPU this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not every system knows affinities
        return os.cpu_count() or 1


@contextmanager
def at_most(threads: int) -> Iterator[None]:
    """While the block runs, torch, BLAS and OpenMP keep to a number of threads, or to fewer where the user wants it."""
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    allowed = min(threads, before)
    torch.set_num_threads(allowed)
    try:
        with threadpool_limits(limits=allowed):
            yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """While the block runs, torch, BLAS and OpenMP keep to one thread: the same digits on every machine.

    Sums over several threads end in other digits than over one, and a search that goes on from its own numbers can end
    elsewhere. The tensors here are small: a second thread saves little on a free machine and costs tenfold on a busy
    one.
    """
    with at_most(1):
        yield
