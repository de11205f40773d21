"""Torch tensors as Warp arrays, without copies."""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor


def as_warp(tensor: Tensor, dtype: Any) -> Any:
    """A contiguous float32 or int32 tensor as a Warp array of ``dtype`` (scalar, vector, matrix) over its memory."""
    wp.init()
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)


def launch(kernel: Any, count: int, inputs: list[Any], like: Tensor, block: int = 256) -> None:
    """Run ``count`` threads of a kernel where ``like`` lives, on torch's current stream."""
    if like.is_cuda:
        stream = wp.stream_from_torch(like.device)
        wp.launch(kernel, dim=count, inputs=inputs, device=stream.device, stream=stream, block_dim=block)
    else:
        wp.launch(kernel, dim=count, inputs=inputs, device="cpu")
