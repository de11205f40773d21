"""Torch tensors as Warp arrays, without copies."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor


def as_warp(tensor: Tensor, dtype: Any) -> Any:
    """A contiguous float32 or int32 tensor as a Warp array of ``dtype`` (scalar, vector, matrix) over its memory."""
    wp.init()
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)


def warp_device(tensor: Tensor) -> Any:
    """The Warp device a tensor lives on."""
    return wp.device_from_torch(tensor.device)


def launch(kernel: Any, count: int, inputs: list[Any], like: Tensor, **options: Any) -> None:
    """Run a kernel where ``like`` lives, on torch's current stream."""
    device = warp_device(like)
    if device.is_cuda:
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)), sync_enter=False):
            wp.launch(kernel, dim=count, inputs=inputs, device=device, **options)
    else:
        wp.launch(kernel, dim=count, inputs=inputs, device=device, **options)
