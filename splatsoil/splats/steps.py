"""Coroutines that share their synchronisations with a GPU.

The host waits for the GPU whenever it reads a number from it. A generator that yields the tensors it must read runs
beside others, and each round of reads is one synchronisation for all of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Generator, Sequence
from typing import Generic, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")

Steps: TypeAlias = Generator[Tensor, list[float], T]
"""Yields tensors, gets their numbers back in a row, and returns a result."""


class stepwise(Generic[P, T]):
    """A generator function as an ordinary one; ``.steps`` is the generator function."""

    def __init__(self, steps: Callable[P, Steps[T]]) -> None:
        self.steps = steps
        functools.update_wrapper(self, steps)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        return finished(self.steps(*args, **kwargs))


def finished(steps: Steps[T]) -> T:
    """The result of one piece of work."""
    return together([steps])[0]


def together(works: Sequence[Steps[T]]) -> list[T]:
    """The results of several, on a GPU in rounds; on a CPU, where reads cost nothing, one after the other."""
    results: dict[int, T] = {}
    asked: dict[int, Tensor] = {}

    def go_on(k: int, numbers: list[float] | None) -> None:
        asked.pop(k, None)
        try:
            asked[k] = works[k].send(numbers)  # type: ignore[arg-type]  # a generator begins with None
        except StopIteration as end:
            results[k] = end.value

    for k in range(len(works)):
        go_on(k, None)
        while k in asked and not asked[k].is_cuda:
            go_on(k, asked[k].reshape(-1).tolist())
    while asked:
        questions = {k: tensor.reshape(-1) for k, tensor in asked.items()}
        numbers = iter(torch.cat([q.double() for q in questions.values()]).tolist())
        for k, question in questions.items():
            go_on(k, [next(numbers) for _ in range(len(question))])
    return [results[k] for k in range(len(works))]
