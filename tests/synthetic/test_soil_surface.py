"""From particles to a surface: places and colours that are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from splatsoil.errors import SimulationError
from splatsoil.measurement import Bed, Measurement
from splatsoil.synthetic import soil_surface

SPACING = 0.01
BED = Bed(np.array([-0.1, 0.05, 0.02]), np.array([0.1, 0.17, 0.2]), density=1600.0)
DEPTH = 0.08


def lattice(depth: float = DEPTH) -> np.ndarray:
    """Particles in the middle of cubes that fill the bed up to a depth."""
    counts = [round(float(e) / SPACING) for e in (*BED.extents[:2], depth)]
    index = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    return BED.lower + (index + 0.5) * SPACING


def test_level_soil_is_level_up_to_the_walls() -> None:
    """And its top is where its volume ends: what is seen, filled, is as much soil as there is."""
    particles = lattice()
    body = soil_surface(particles, np.ones((len(particles), 3)), SPACING, BED)
    assert np.abs(body.points[:, 2] - (BED.lower[2] + DEPTH)).max() < 0.05 * SPACING
    assert (body.normals[:, 2] > 0.999).all()
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    assert (low[:2] <= BED.lower[:2]).all() and (high[:2] >= BED.upper[:2]).all(), "a gap along the walls"
    triangles = body.points[body.faces]
    turned = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (np.einsum("ij,ij->i", turned, body.normals[body.faces[:, 0]]) > 0.0).all(), "faces point inward"


def test_sides_stand_where_the_bed_ends() -> None:
    particles = lattice()
    body = soil_surface(particles, np.ones((len(particles), 3)), SPACING, BED, sides=True)
    np.testing.assert_allclose(body.points[:, :2].min(axis=0), BED.lower[:2], atol=0.1 * SPACING)
    np.testing.assert_allclose(body.points[:, :2].max(axis=0), BED.upper[:2], atol=0.1 * SPACING)
    assert body.points[:, 2].min() <= BED.lower[2]


def test_a_slope_has_its_normal() -> None:
    particles = lattice(0.12)
    slope = 0.3
    particles = particles[particles[:, 2] < BED.lower[2] + 0.07 + slope * particles[:, 0]]
    body = soil_surface(particles, np.ones((len(particles), 3)), SPACING, BED)
    inner = np.abs(body.points[:, 0]) < 0.07
    expected = np.array([-slope, 0.0, 1.0]) / math.hypot(slope, 1.0)
    np.testing.assert_allclose(body.normals[inner].mean(axis=0), expected, atol=0.02)


def test_particles_carry_their_colours() -> None:
    particles = lattice()
    left = particles[:, 0] < 0.0
    colours = np.where(left[:, None], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8])
    moved = particles + np.array([0.0, 0.0, 0.01])
    body = soil_surface(moved, colours, SPACING, BED)
    beyond = body.points[:, 0] < -2.0 * SPACING
    np.testing.assert_allclose(body.colours[beyond], np.broadcast_to([0.8, 0.1, 0.1], (beyond.sum(), 3)), atol=1e-3)
    np.testing.assert_allclose(body.colours.mean(axis=0), [0.45, 0.1, 0.45], atol=0.02)


def test_a_stray_particle_is_no_surface() -> None:
    particles = np.concatenate([lattice(), [[0.0, 0.1, 0.19]]])
    body = soil_surface(particles, np.ones((len(particles), 3)), SPACING, BED)
    assert body.points[:, 2].max() < BED.lower[2] + DEPTH + SPACING


def test_no_soil_is_an_error() -> None:
    with pytest.raises(SimulationError, match="no surface"):
        soil_surface(np.array([[0.0, 0.1, 0.1]]), np.ones((1, 3)), SPACING, BED)


def test_the_trench_of_an_independent_solver(plow_dry: Path) -> None:
    """Over plow-dry's true particles the surface keeps near each column's highest particle."""
    measurement = Measurement.load(plow_dry)
    data = np.load(plow_dry / "truth_particles.npz")
    particles = data["f100"] * float(data["scale"])
    spacing = float(data["spacing"])
    body = soil_surface(particles, np.ones((len(particles), 3)), spacing, measurement.bed)
    cells = (measurement.bed.extents[:2] / 0.02).round().astype(int)

    def highest(points: np.ndarray) -> np.ndarray:
        index = np.clip((points[:, :2] / 0.02).astype(int), 0, cells - 1)
        out = np.full(tuple(cells), -np.inf)
        np.maximum.at(out, tuple(index.T), points[:, 2])
        return out

    difference = highest(body.points) - highest(particles)
    assert np.quantile(np.abs(difference), 0.95) < 1.2 * spacing
    assert abs(float(np.median(difference))) < 0.7 * spacing
