"""The benchmark runs, and the kernels beat what they replace."""

from __future__ import annotations

import pytest
import torch
from splatsoil.benchmarks import rasteriser


def test_benchmark_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        (row,) = rasteriser.run(counts=(500,), size=64)
    finally:
        torch.set_num_threads(before)
    assert "500" in capsys.readouterr().out
    assert 0 < row.forward < row.both
    assert row.reference_ratio > 5
    assert row.ssim < row.ssim_kornia
