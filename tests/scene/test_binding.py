"""Gaussians ride on particles: identities of rigid motion and stretch."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatsoil.scene import bind
from splatsoil.scene.binding import STRETCH

SPACING = 0.01


@pytest.fixture
def bound():
    generator = np.random.default_rng(1)
    axis = np.arange(6) * SPACING
    particles = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    particles += 0.2 * SPACING * generator.normal(size=particles.shape)
    centres = generator.uniform(0.0, 0.05, (50, 3))
    roots = 0.003 * generator.normal(size=(50, 3, 3))
    tensors = (torch.tensor(a, dtype=torch.float32) for a in (centres, roots @ roots.transpose(0, 2, 1), particles))
    return bind(*tensors, SPACING)


def everywhere(binding, matrix):
    return torch.tensor(matrix, dtype=torch.float32).expand(len(binding.particles), 3, 3).contiguous()


def test_no_deformation_changes_nothing(bound):
    for deformations in (None, everywhere(bound, np.eye(3))):
        centres, covariances = bound.carry(bound.particles, deformations)
        assert torch.allclose(centres, bound.rest, atol=1e-7)
        assert torch.allclose(covariances, bound.covariances, atol=1e-11)


def test_a_rigid_motion_moves_gaussians_rigidly(bound):
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    shift = np.array([0.2, -0.1, 0.05])
    moved = bound.particles.double().numpy() @ turn.T + shift
    centres, covariances = bound.carry(torch.tensor(moved, dtype=torch.float32), everywhere(bound, turn))
    assert np.allclose(centres, bound.rest.double().numpy() @ turn.T + shift, atol=1e-6)
    assert torch.allclose(
        torch.linalg.eigvalsh(covariances), torch.linalg.eigvalsh(bound.covariances), atol=1e-10, rtol=1e-4
    )
    assert np.allclose(covariances, turn @ bound.covariances.double().numpy() @ turn.T, atol=1e-10)


def test_an_affine_motion_carries_the_covariance(bound):
    stretch = np.diag([1.3, 0.8, 1.0]) @ np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    moved = torch.tensor(bound.particles.double().numpy() @ stretch.T, dtype=torch.float32)
    centres, covariances = bound.carry(moved, everywhere(bound, stretch))
    assert np.allclose(centres, bound.rest.double().numpy() @ stretch.T, atol=1e-6)
    assert np.allclose(covariances, stretch @ bound.covariances.double().numpy() @ stretch.T, atol=1e-10)


def test_needles_and_flakes_are_held(bound):
    turn = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix()
    extreme = turn @ np.diag([30.0, 1.0, 0.001]) @ turn.T
    _, covariances = bound.carry(bound.particles, everywhere(bound, extreme))
    held = turn @ np.diag([STRETCH[1], 1.0, STRETCH[0]]) @ turn.T
    assert np.allclose(covariances, held @ bound.covariances.double().numpy() @ held.T, rtol=1e-2, atol=1e-9)


def test_weights_sum_to_one_even_far_from_all_particles():
    centres = torch.tensor([[5.0, 5.0, 5.0], [0.0, 0.0, 0.0]])
    particles = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) * 0.05
    binding = bind(centres, torch.eye(3).repeat(2, 1, 1), particles, SPACING)
    assert torch.allclose(binding.weights.sum(dim=1), torch.ones(2))
