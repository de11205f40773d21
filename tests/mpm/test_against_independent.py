"""The solver against another one: an implicit MPM's particles, which came with the example sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._truth import Truth

from splatsoil.measurement import Measurement
from splatsoil.mpm import Resolution, Trajectory, simulate
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = (50, 100, 150, 199)
DRY, DAMP = {"friction_angle": 36.0}, {"friction_angle": 33.0, "cohesion": 300.0}
CELL, FINE = 0.01, 0.005


def truth(name: str) -> tuple[dict[int, npt.NDArray[np.float64]], float]:
    with np.load(EXAMPLES / name / "truth_particles.npz") as file:
        return {f: file[f"f{f:03d}"] * float(file["scale"]) for f in (0, *FRAMES)}, float(file["spacing"])


def ploughed(
    name: str, values: dict[str, float], frames: Sequence[int]
) -> tuple[Measurement, Trajectory, npt.NDArray[np.float64]]:
    """Ours at the truth, from particles of its own that fill the other solver's bed."""
    measurement, known = Measurement.load(EXAMPLES / name), Truth.load(EXAMPLES / name)
    resolution = Resolution.derive(measurement, "small")
    x = known.start(resolution.spacing, 0)
    law = Law(find_effects([effect for effect in ("cohesion",) if effect in values]))
    return measurement, simulate(measurement, x, values, law=law, resolution=resolution, frames=frames)[0], x


def heights(x: npt.NDArray[np.floating], measurement: Measurement, volume: float) -> npt.NDArray[np.float64]:
    """Surface (m) in 1 cm cells: where smoothed particle counts, seen from above, reach 0.45 of the bulk."""
    lower, upper = measurement.bed.lower, measurement.bed.upper
    count = np.ceil((upper - lower) / FINE - 1e-9).astype(int)
    index = np.clip(((x - lower) / FINE).astype(int), 0, count - 1)
    density = np.bincount(np.ravel_multi_index(tuple(index.T), tuple(count)), minlength=int(count.prod()))
    density = density.reshape(count) * (volume / FINE**3)
    density = gaussian_filter(density, CELL / FINE, mode=("nearest", "nearest", "constant"), truncate=3.0)
    top = count[2] - 1 - np.argmax((density > 0.45)[:, :, ::-1], axis=2)
    here = np.take_along_axis(density, top[..., None], axis=2)[..., 0]
    above = np.take_along_axis(density, np.minimum(top + 1, count[2] - 1)[..., None], axis=2)[..., 0]
    height = (top + 0.5 + np.clip((here - 0.45) / np.maximum(here - above, 1e-6), 0.0, 1.0)) * FINE
    coarse = round(CELL / FINE)
    nx, ny = count[0] // coarse, count[1] // coarse
    height = height[: nx * coarse, : ny * coarse].reshape(nx, coarse, ny, coarse).mean(axis=(1, 3))
    return gaussian_filter(height, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "values", "limits"),
    [
        ("plow-dry", DRY, (1.5, 2.5, 3.0, 3.0)),
        # damp sand stands in clods whose fine shape is chance: the other solver repeats itself to 0.8, 2.5, 1.7, 2.7 mm
        ("plow-damp", DAMP, (2.0, 3.0, 4.5, 5.5)),
    ],
)
def test_heights_agree_with_the_implicit_solver(name: str, values: dict[str, float], limits: tuple[float, ...]) -> None:
    """Root mean square over the bed, mm, by frame."""
    measurement, run, _ = ploughed(name, values, FRAMES)
    particles, spacing = truth(name)
    start = heights(particles[0], measurement, spacing**3)
    for k, frame in enumerate(FRAMES):
        predicted = heights(run.positions[k], measurement, run.spacing**3)
        observed = heights(particles[frame], measurement, spacing**3)
        assert 1e3 * np.sqrt(np.mean((predicted - observed) ** 2)) < limits[k]
        assert predicted.mean() < 1.005 * start.mean()  # no volume gain
        # a bed that nothing had happened to would be further off by far: the check can fail
        assert 1e3 * np.sqrt(np.mean((start - observed) ** 2)) > 3.0 * limits[k]


@pytest.mark.parametrize(("name", "values"), [("plow-dry", DRY), ("plow-damp", DAMP)])
def test_as_much_soil_is_cut_and_none_is_lost(name: str, values: dict[str, float]) -> None:
    """The tool takes about as much out of the bed as the implicit solver's does, 7 % more on these cells, 10 % on those
    of 13.3 mm. All of it is heaped up, damp soil with gaps between its clods; the implicit solver's heaps miss a sixth
    (docs/numerics.md)."""
    measurement, run, x = ploughed(name, values, [50, 100])
    particles, spacing = truth(name)
    start, own = heights(particles[0], measurement, spacing**3), heights(x, measurement, run.spacing**3)
    for frame, positions in zip(run.frames, run.positions, strict=True):
        mine = heights(positions, measurement, run.spacing**3) - own
        theirs = heights(particles[frame], measurement, spacing**3) - start
        assert mine[mine < 0.0].sum() == pytest.approx(theirs[theirs < 0.0].sum(), rel=0.1)
        assert -0.002 * start.sum() < mine.sum() < 0.005 * start.sum()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "values"), [("plow-dry", DRY), ("plow-damp", DAMP)])
def test_force_agrees_with_the_implicit_solver(name: str, values: dict[str, float]) -> None:
    """The mean force along the way is within 5 % of the other solver's while the tool is pushed."""
    measurement, run, _ = ploughed(name, values, [100])
    recorded = measurement.tool.force
    assert recorded is not None
    there = (recorded[:, 0] >= 61) & (recorded[:, 0] < 101)
    assert run.force[60:100, 0].mean() == pytest.approx(recorded[there, 2].mean(), rel=0.05)
