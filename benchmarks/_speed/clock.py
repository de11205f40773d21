"""Clocks: what to read, when, and how often."""

from __future__ import annotations

import hashlib
import statistics
import threading
import time
from collections.abc import Callable, Sequence

from splatsoil.benchmarks._speed.rows import Sample


def synchronise(device: str) -> None:
    """Wait until a GPU has done what it was given, by Warp and by torch; nothing on a CPU."""
    if device != "cpu":
        import torch
        import warp as wp

        wp.init()
        wp.synchronize_device(device)
        torch.cuda.synchronize(device)


def timed(task: Callable[[], object], device: str = "cpu") -> float:
    """Seconds of one call: on a CPU those of this thread, which other programs disturb less than the clock's."""
    clock = time.thread_time if device == "cpu" else time.perf_counter
    synchronise(device)
    began = clock()
    task()
    synchronise(device)
    return clock() - began


def repeated(task: Callable[[], object], repeats: int, device: str = "cpu", warm: int = 1, label: str = "") -> Sample:
    """Times of a task in s, after ``warm`` calls that are not counted."""
    for _ in range(warm):
        task()
    return Sample(tuple(timed(task, device) for _ in range(repeats)), label)


def together(tasks: Sequence[Callable[[], object]]) -> tuple[float, float]:
    """Run tasks side by side, a thread each.

    Returns:
        Seconds until the last has ended, and how many cores this process had meanwhile.

    Raises:
        BaseException: what the first failing task raised.
    """
    failed: list[BaseException] = []

    def guarded(task: Callable[[], object]) -> None:
        try:
            task()
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=guarded, args=(task,)) for task in tasks]
    wall, used = time.perf_counter(), time.process_time()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    seconds = time.perf_counter() - wall
    if failed:
        raise failed[0]
    return seconds, (time.process_time() - used) / seconds


def side_by_side(tasks: Sequence[Callable[[], object]], repeats: int, label: str = "") -> Sample:
    """Times of :func:`together` in s."""
    found = [together(tasks) for _ in range(repeats)]
    return Sample(tuple(seconds for seconds, _ in found), label, min(cores for _, cores in found))


def free_cores(count: int = 2, megabytes: int = 64) -> float:
    """How many of so many cores other programs leave to this one just now: as many threads count sums meanwhile."""
    block = bytes(megabytes << 20)
    # hashing lets other Python threads run
    return together([lambda: hashlib.blake2b(block)] * count)[1]


def on_threads(task: Callable[[], object], repeats: int, label: str = "") -> Sample:
    """The clock's times in s of a task that takes two cores by itself, after one call to warm up.

    How many cores the task keeps at work is in the label; ``cores`` is what other programs left before and after.
    """
    task()
    values, cores, free = [], [], free_cores()
    for _ in range(repeats):
        wall, used = time.perf_counter(), time.process_time()
        task()
        seconds = time.perf_counter() - wall
        values.append(seconds)
        cores.append((time.process_time() - used) / seconds)
    return Sample(tuple(values), f"{label}, {statistics.median(cores):.1f} cores at work", min(free, free_cores()))
