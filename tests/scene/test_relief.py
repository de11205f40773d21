"""The surface of particles against the planes that bound them."""

import numpy as np
import pytest
import torch

from splatsoil.scene import Relief, relief_of_particles

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
    relief = relief_of_particles(filled(lambda x, y: 0.1 + slope * (x - 0.2)), 0.01, LOWER, UPPER)
    points = relief.points.numpy()
    inside = (np.abs(points[..., 0] - 0.2) < 0.15) & (np.abs(points[..., 1] - 0.15) < 0.12)
    error = points[..., 2] - (0.1 + slope * (points[..., 0] - 0.2))
    assert abs(error[inside].mean()) < 0.0008
    assert error[inside].std() < 0.0012
    expected = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    assert np.allclose(relief.normal.numpy()[inside].mean(axis=0), expected, atol=0.02)


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


def test_the_same_particles_give_the_same_bits():
    x = filled(lambda x, y: 0.1 + 0.02 * np.sin(20 * x))
    first, second = (relief_of_particles(x, 0.01, LOWER, UPPER).height for _ in range(2))
    assert torch.equal(first, second)
