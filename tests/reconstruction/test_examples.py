"""The promise on sets that no code here produced: time apart, every number that the README states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from splatsoil.benchmarks.reconstruction import score, true_surface

from splatsoil.measurement import Measurement
from splatsoil.reconstruction import HeightField, fill, reconstruct


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plow-dry", "plow-damp"])
def test_pictures_and_surface(repository: Path, name: str):
    folder = repository / "examples" / name
    measurement = Measurement.load(folder)
    result = reconstruct(measurement)
    numbers = score(folder, result, measurement)
    assert numbers.psnr >= 30.0
    assert numbers.rmse is not None and numbers.rmse <= 4e-3
    assert numbers.bias is not None and abs(numbers.bias) <= 1e-3
    assert numbers.volume is not None and abs(numbers.volume) <= 0.01
    # A level bed of the right mean height would not do: the bound on RMSE means something.
    exact = true_surface(folder, measurement, result.surface)
    assert exact is not None
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
