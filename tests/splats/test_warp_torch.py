"""Tensors and kernels: memory that descriptors stand for."""

import warnings

import numpy as np
import pytest
import torch
import warp as wp

from splatsoil.splats.warp_torch import as_warp, launch, upload

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


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


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=needs_cuda)])
def test_numbers_of_the_host_keep_their_values_on_a_device(device: str) -> None:
    there = torch.device(device)
    sealed = np.array([0.1, 2.0])
    sealed.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for values in ([0.1, 2.0], sealed, sealed.astype(np.float32), torch.tensor([0.1, 2.0])):
            assert torch.equal(upload(values, there).cpu(), torch.tensor([0.1, 2.0]))
    assert upload([1, 2], there, torch.int32).dtype == torch.int32
    many = [upload(np.full(100_000, float(k)), there) for k in range(50)]  # sources that are gone at once
    assert all(bool((tensor == k).all()) for k, tensor in enumerate(many))
