"""One thread for linear algebra: the same digits on every machine, and no waiting for each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """While the block runs, torch, BLAS and OpenMP keep to one thread.

    Sums over several threads end in other digits than over one, and a search that goes on from its own numbers can end
    elsewhere. The tensors here are small: a second thread saves little on a free machine and costs tenfold on a busy
    one.
    """
    import torch
    from threadpoolctl import threadpool_limits

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        torch.set_num_threads(threads)
