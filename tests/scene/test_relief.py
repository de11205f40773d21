"""The surface of particles against the planes that bound them."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial import cKDTree

from splatsoil.measurement import Bed
from splatsoil.reconstruction import HeightField, fill
from splatsoil.scene import Relief, kernels_relief, relief_of_particles
from splatsoil.splats.warp_torch import as_warp, launch
from splatsoil.synthetic.soil_surface import soil_surface

LOWER, UPPER = np.zeros(3), np.array([0.4, 0.3, 0.2])


def filled(height, spacing=0.01, jitter=0.3, seed=0):
    """A jittered lattice of particles of equal volume under a surface height(x, y)."""
    generator = np.random.default_rng(seed)
    axes = [np.arange(spacing / 2, UPPER[k], spacing) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points += jitter * spacing * (generator.random(points.shape) - 0.5)
    points = points[points[:, 2] < height(points[:, 0], points[:, 1])]
    return torch.tensor(points, dtype=torch.float32)


@pytest.mark.parametrize("slope", [0.0, 0.15, -0.3])
def test_plane_is_found_without_bias(slope):
    """With beds filled as a reconstruction's are; a lattice cut off at the plane would have steps of its own."""
    x, y = np.linspace(0.0, 0.4, 41), np.linspace(0.0, 0.3, 31)
    plane = HeightField(x, y, np.broadcast_to(0.1 + slope * (x - 0.2), (31, 41)))
    particles = fill(plane, Bed(LOWER, UPPER, density=1600.0), 0.01, seed=3)
    relief = relief_of_particles(torch.tensor(particles, dtype=torch.float32), 0.01, LOWER, UPPER)
    points = relief.points.numpy()
    inside = (np.abs(points[..., 0] - 0.2) < 0.15) & (np.abs(points[..., 1] - 0.15) < 0.12)
    error = points[..., 2] - (0.1 + slope * (points[..., 0] - 0.2))
    assert abs(error[inside].mean()) < 0.0008
    assert error[inside].std() < 0.0008
    expected = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    assert np.allclose(relief.normal.numpy()[inside].mean(axis=0), expected, atol=0.02)


def share_left(length, **options):
    """How much of a wave of so many metres the surface of particles beneath it has."""
    particles = filled(lambda x, y: 0.1 + 0.05 * length * np.sin(2.0 * np.pi / length * x), jitter=1.0)
    points = relief_of_particles(particles, 0.01, LOWER, UPPER, **options).points.numpy()
    whole = 0.1 + length * int(0.25 / length)
    inside = (points[..., 0] > 0.1) & (points[..., 0] < whole) & (np.abs(points[..., 1] - 0.15) < 0.12)
    wave = np.sin(2.0 * np.pi / length * points[..., 0][inside])
    return np.polyfit(wave, points[..., 2][inside], 1)[0] / (0.05 * length)


@pytest.mark.parametrize("length", [0.06, 0.08, 0.12, 0.2])
def test_waves_are_rounded_off_by_one_spacing_and_twice_as_much_takes_as_much_again(length):
    """Against exp(-2 (pi s/l)^2), what a Gaussian of standard deviation s leaves of a wave of length l. The difference
    tells what the drawing has rounded off: with it the whole wave, to first order."""
    once, twice = share_left(length), share_left(length, smoothing=np.sqrt(2.0))
    lost = 1.0 - np.exp(-2.0 * (np.pi * 0.01 / length) ** 2)
    assert once == pytest.approx(1.0 - lost, abs=0.05)
    assert 2.0 * once - twice == pytest.approx(1.0, abs=0.05 + lost**2)
    assert once - twice > 0.5 * lost


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.8])
def test_a_step_stands_where_marching_cubes_says(turn):
    """Rim and foot of a wall against scikit-image's surface of the same particles, on a grid of its own."""
    level = filled(lambda x, y: 0.12 + 0.0 * x).numpy()
    side = (level[:, 0] - 0.204) * np.cos(turn) + (level[:, 1] - 0.15) * np.sin(turn)
    particles = level[(side > 0.0) | (level[:, 2] < 0.06)]
    relief = relief_of_particles(torch.tensor(particles), 0.01, LOWER, UPPER)
    mesh = soil_surface(particles, np.ones((len(particles), 3)), 0.01, Bed(LOWER, UPPER, density=1600.0))
    x, y, _ = mesh.points.T
    near = np.abs((x - 0.204) * np.cos(turn) + (y - 0.15) * np.sin(turn)) < 0.03
    chosen = near & (mesh.normals[:, 2] > 0.7) & (y > 0.05) & (y < 0.25)
    points = torch.tensor(mesh.points[chosen], dtype=torch.float32)
    off = relief.sample(relief.height, points).numpy() - mesh.points[chosen][:, 2]
    assert np.sqrt(np.mean(off**2)) < 0.0005
    normals = torch.nn.functional.normalize(relief.sample(relief.normal, points), dim=1).numpy()
    turned = np.degrees(np.arccos(np.clip(np.sum(normals * mesh.normals[chosen], axis=1), -1.0, 1.0)))
    assert np.sqrt(np.mean(turned**2)) < 8.0


def test_walls_do_not_pull_the_surface_down():
    relief = relief_of_particles(filled(lambda x, y: 0.1 + 0.0 * x), 0.01, LOWER, UPPER)
    assert abs(float(relief.height[:, 0].mean()) - float(relief.height.mean())) < 0.001


def test_sample_is_linear_between_cells_and_held_beyond():
    ramp = torch.arange(5.0).repeat(4, 1)
    relief = Relief.of_heights(ramp, (0.0, 0.0), (1.0, 1.0))
    at = torch.tensor([[0.25, 1.0], [3.5, 2.5], [-3.0, 0.0], [9.0, 9.0]])
    assert torch.allclose(relief.sample(relief.height, at), torch.tensor([0.25, 3.5, 0.0, 4.0]), atol=1e-5)


def test_depth_below_is_measured_along_the_normal():
    x = torch.arange(40.0) * 0.01
    relief = Relief.of_heights((0.5 * x).repeat(30, 1), (0.0, 0.0), (0.01, 0.01))
    depth = relief.depth_below(torch.tensor([[0.2, 0.15, 0.1 - 0.03]]))
    assert float(depth) == pytest.approx(0.03 / np.hypot(1.0, 0.5), rel=1e-4)


def test_what_lies_behind_a_steep_wall_is_near_the_surface():
    """Against the distance from every point to every point of the air above a terrace with a pit."""
    x, y = (torch.arange(n) * 0.004 for n in (60, 50))
    height = torch.where(x[None] < 0.12, 0.1, 0.03) * torch.ones((50, 1))
    height[20:30, 10:20] = 0.05
    relief = Relief.of_heights(height, (0.0, 0.0), (0.004, 0.004))
    rng = np.random.default_rng(2)
    points = rng.uniform([0.03, 0.03, 0.0], [0.2, 0.16, 0.1], (300, 3))
    z = np.arange(0.0, 0.14, 0.002)
    air = np.array([(a, b, c) for j, b in enumerate(y) for i, a in enumerate(x) for c in z if c >= height[j, i]])
    distance, _ = cKDTree(air).query(points)
    shown = relief.within(0.025, torch.tensor(points, dtype=torch.float32)).numpy()
    sure = np.abs(distance - 0.025) > 0.004  # a cell
    assert np.array_equal(shown[sure], distance[sure] < 0.025)
    behind = (points[:, 0] < 0.12) & (relief.depth_below(torch.tensor(points).float()).numpy() > 0.03) & sure
    assert shown[behind].any(), "some are near a wall though far below the rim"


def test_the_surface_is_the_uppermost_crossing():
    """A cavity, nothing at all, a column full to the top, and one that ends between two cells."""
    density = torch.tensor([[1.0, 0.0, 1.0, 0.9], [0.1, 0.0, 1.0, 0.7], [0.8, 0.0, 1.0, 0.2], [0.2, 0.0, 1.0, 0.0]])
    height = torch.zeros(1, 4)
    inputs = [as_warp(density[:, None].contiguous(), wp.float32), 0.5, 1.0, 0.1, as_warp(height, wp.float32)]
    launch(kernels_relief.crossing, (1, 4), inputs, height)
    assert height[0].tolist() == pytest.approx([1.0 + 0.1 * 3.0, 1.0, 1.0 + 0.1 * 3.5, 1.0 + 0.1 * 1.9])
