"""Tensors and kernels: memory that descriptors stand for."""

import torch
import warp as wp

from splatsoil.splats.warp_torch import as_warp, launch, upload


@wp.kernel
def _copy(source: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    out[wp.tid()] = source[wp.tid()]


def test_a_descriptor_keeps_the_memory_of_a_tensor_that_nobody_else_keeps() -> None:
    count = 1 << 20
    out = torch.zeros(count)
    # a copy that is made on the way, and a tensor that is gone as soon as the descriptor is there
    strided = as_warp(torch.full((count, 2), 7.0)[:, 0], wp.float32)
    other = as_warp(torch.full((count,), 5.0), wp.float32)
    torch.zeros(count), torch.zeros((count, 2))
    for descriptor, value in ((strided, 7.0), (other, 5.0)):
        launch(_copy, count, [descriptor, as_warp(out, wp.float32)], out)
        assert bool((out == value).all())


def test_numbers_of_the_host_keep_their_values_on_a_device() -> None:
    assert torch.equal(upload([0.1, 2.0], torch.device("cpu")), torch.tensor([0.1, 2.0]))
    assert upload([1, 2], torch.device("cpu"), torch.int32).dtype == torch.int32
