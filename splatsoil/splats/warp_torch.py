"""Torch tensors as Warp arrays, without copies; kernels on torch's stream."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from threading import Thread
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor


def as_warp(tensor: Tensor, dtype: Any) -> Any:
    """A float32 or int32 tensor as kernels take an array of ``dtype`` (scalar, vector, matrix), over its memory.

    It is Warp's descriptor of an array and not an array, which takes three times as long to make: a picture needs
    thirty. Kernels check neither its device nor its number of dimensions. It keeps the tensor's memory, also that of a
    copy made here.
    """
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False, return_ctype=True)


def upload(values: npt.ArrayLike | Tensor, device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """Numbers of the host as a tensor on a device; the host doesn't wait until a GPU gets there.

    CUDA copies ordinary memory to a buffer of its own before the call returns, so the source may go. What is there
    already, in this type, is not copied.
    """
    if not isinstance(values, Tensor):
        array = np.asarray(values)
        values = torch.from_numpy(array if array.flags.writeable else array.copy())
    return values.to(dtype).to(device, non_blocking=device.type == "cuda")


@cache
def _stream(device: torch.device, handle: int) -> Any:
    """Torch's current stream on a device, of that handle, as Warp's; to ask for it each time takes as long as to
    describe two arrays."""
    wp.init()  # a stream can't be asked for before; making descriptors doesn't do it
    return wp.stream_from_torch(torch.cuda.current_stream(device))


def launch(kernel: Any, count: int | tuple[int, ...], inputs: list[Any], like: Tensor, block: int = 256) -> None:
    """Run ``count`` threads (along one or more axes) of a kernel where ``like`` lives, on torch's current stream."""
    if like.is_cuda:
        stream = _stream(like.device, torch.cuda.current_stream(like.device.index).cuda_stream)
        wp.launch(kernel, dim=count, inputs=inputs, device=stream.device, stream=stream, block_dim=block)
    else:
        wp.launch(kernel, dim=count, inputs=inputs, device="cpu")


def launch_parts(kernel: Any, bounds: Sequence[int], inputs: list[Any]) -> None:
    """Run a CPU kernel in several Python threads, which a call into compiled code sets free of Python's lock.

    Args:
        kernel: its first argument is the number of its first task, and its tasks write to disjoint memory.
        bounds: part i does the tasks from ``bounds[i]`` up to ``bounds[i + 1]``; the caller's thread does the last.
        inputs: the other arguments.
    """
    parts = [
        wp.launch(kernel, dim=end - begin, inputs=[begin, *inputs], device="cpu", record_cmd=True)
        for begin, end in pairwise(bounds)
        if end > begin
    ]
    threads = [Thread(target=part.launch) for part in parts[:-1]]
    for thread in threads:
        thread.start()
    for part in parts[-1:]:
        part.launch()
    for thread in threads:
        thread.join()


def thread_count(work: float) -> int:
    """Threads to draw with: as many as torch may use, but each should have a millisecond of ``work`` (in ms)."""
    return max(1, min(torch.get_num_threads(), int(work)))
