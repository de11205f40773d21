"""The solver against another one: an implicit MPM's particles, which came with the example sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter

from splatsoil.measurement import Measurement
from splatsoil.mpm import simulate
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = (50, 100, 150, 199)
DRY, DAMP = {"friction_angle": 36.0}, {"friction_angle": 33.0, "cohesion": 600.0}
"""The damp set's file says 300 Pa, which its simulator was given twice: docs/numerics.md."""
CELL, FINE = 0.01, 0.005


def truth(name: str) -> tuple[dict[int, npt.NDArray[np.float64]], float]:
    with np.load(EXAMPLES / name / "truth_particles.npz") as file:
        return {f: file[f"f{f:03d}"] * float(file["scale"]) for f in (0, *FRAMES)}, float(file["spacing"])


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
    measurement = Measurement.load(EXAMPLES / name)
    particles, spacing = truth(name)
    law = Law(find_effects([effect for effect in ("cohesion",) if effect in values]))
    run = simulate(measurement, particles[0], values, law=law, preset="small", frames=FRAMES)[0]
    volume = spacing**3
    start = heights(particles[0], measurement, volume)
    for k, frame in enumerate(FRAMES):
        predicted = heights(run.positions[k], measurement, volume)
        observed = heights(particles[frame], measurement, volume)
        assert 1e3 * np.sqrt(np.mean((predicted - observed) ** 2)) < limits[k]
        assert predicted.mean() < 1.005 * start.mean()  # no volume gain
        # a bed that nothing had happened to would be further off by far: the check can fail
        assert 1e3 * np.sqrt(np.mean((start - observed) ** 2)) > 3.0 * limits[k]


@pytest.mark.parametrize(("name", "values"), [("plow-dry", DRY), ("plow-damp", DAMP)])
def test_heaps_grow_as_the_implicit_solvers_do(name: str, values: dict[str, float]) -> None:
    """From where the blade was lowered on, not only once soil has piled up before it: soil that gives way to it by
    pressure alone is a sixth short at frame 50."""
    measurement = Measurement.load(EXAMPLES / name)
    particles, spacing = truth(name)
    law = Law(find_effects([effect for effect in ("cohesion",) if effect in values]))
    run = simulate(measurement, particles[0], values, law=law, preset="small", frames=[50, 100])[0]
    start = heights(particles[0], measurement, spacing**3)
    for frame, positions in zip(run.frames, run.positions, strict=True):
        mine, theirs = (heights(x, measurement, spacing**3) - start for x in (positions, particles[frame]))
        heap = theirs > 0.003
        assert mine[heap].sum() == pytest.approx(theirs[heap].sum(), rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "values"), [("plow-dry", DRY), ("plow-damp", DAMP)])
def test_force_agrees_with_the_implicit_solver(name: str, values: dict[str, float]) -> None:
    """The mean force along the way is within 15 % of the other solver's while pushing, within 30 % while standing."""
    measurement = Measurement.load(EXAMPLES / name)
    particles, _ = truth(name)
    law = Law(find_effects([effect for effect in ("cohesion",) if effect in values]))
    run = simulate(measurement, particles[0], values, law=law, preset="small", frames=[121])[0]
    recorded = measurement.tool.force
    assert recorded is not None
    for first, last, near in ((60, 98, 0.15), (110, 121, 0.3)):
        there = (recorded[:, 0] >= first) & (recorded[:, 0] < last)
        assert run.force[first - 1 : last - 1, 0].mean() == pytest.approx(recorded[there, 2].mean(), rel=near)
