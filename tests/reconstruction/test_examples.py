"""The promise on sets that no code here produced: time apart, every number that the README states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from splatsoil.benchmarks._truth import Truth
from splatsoil.benchmarks.whole_path import true_surface

from splatsoil.measurement import Measurement
from splatsoil.reconstruction import HeightField, fill, reconstruct, volume


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plow-dry", "plow-damp"])
def test_pictures_and_surface(repository: Path, name: str):
    truth = Truth.load(repository / "examples" / name)
    measurement = truth.measurement
    result = reconstruct(measurement)
    exact = true_surface(truth, result.surface)
    assert result.psnr >= 30.0
    assert result.surface.rmse(exact) <= 4e-3 and abs(result.surface.bias(exact)) <= 1e-3
    assert volume(result.surface, measurement.bed) == pytest.approx(len(truth.particles[0]) * truth.volume, rel=0.01)
    # A level bed of the right mean height would not do: the bound on RMSE means something.
    level = HeightField(exact.x, exact.y, np.full_like(exact.height, np.nanmean(exact.height)))
    assert level.rmse(exact) > 4e-3
    particles = fill(result.surface, measurement.bed, 0.01)
    assert len(particles) * 1e-6 == pytest.approx(result.mesh.volume, rel=3e-3)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_does_as_well_as_the_cpu(plow_dry: Path):
    measurement = Measurement.load(plow_dry)
    cpu, cuda = (reconstruct(measurement, preset="tiny", device=device) for device in ("cpu", "cuda:0"))
    assert abs(cpu.psnr - cuda.psnr) < 0.3
    assert cpu.surface.rmse(cuda.surface) < 3e-4
