"""``splatsoil benchmark whole-path``: what misses a target, the true surface, and its parts on few particles."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks import whole_path
from splatsoil.benchmarks._truth import Truth
from splatsoil.benchmarks.whole_path import true_surface

from splatsoil.reconstruction import HeightField


@pytest.fixture
def task(plow_dry: Path, plow_damp: Path, tmp_path: Path) -> Namespace:
    return Namespace(dry=plow_dry, damp=plow_damp, preset="tiny", device="cpu", out=tmp_path)


def test_the_surface_of_a_level_bed_is_level(plow_dry: Path) -> None:
    """A lattice 10 cm high: half of the bulk remains at the height of its topmost cubes' faces, 0.45 a little above."""
    truth = Truth.load(plow_dry)
    bed, spacing = truth.measurement.bed, 0.01
    axes = [np.arange(0.5 * spacing, length, spacing) for length in (*bed.extents[:2], 0.1)]
    x = bed.lower + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = HeightField(np.linspace(0.2, 0.6, 5), np.linspace(0.2, 0.3, 3), np.zeros((3, 5)))
    found = true_surface(replace(truth, particles={0: x}, volume=spacing**3), cells)
    assert found.height == pytest.approx(bed.lower[2] + 0.1, abs=2e-3)


@pytest.mark.slow
def test_reconstruction_and_renderer_on_few_particles(task: Namespace) -> None:
    rows = whole_path.reconstruction(task).rows
    assert len(rows) == 2 and rows[1].held is not None
    loss, raw = whole_path.renderer(task).rows
    least, weak, strong = (float(word) for word in loss.found.replace(";", " and").split(" and"))
    assert 0.0 < least < min(weak, strong) and loss.held == (least < 0.5 * min(weak, strong))
    assert raw.held is None
