"""Scenes for the tests of pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from splatsoil.scene import Scene, ToolBody, encoded, relief_of_particles
from splatsoil.splats import Gaussians


@pytest.fixture(scope="session")
def scene_on() -> Callable[..., Scene]:
    """Makes a scene: particles (n, 3) in a bed under a light, soil of one linear albedo (3,) on their surface, and a
    tool of a mesh and a linear colour."""

    def make(particles, spacing, bed, light, albedo, mesh=None, tool_albedo=(0.0, 0.0, 0.0)) -> Scene:
        relief = relief_of_particles(particles, spacing, bed.lower, bed.upper)
        points, cell = relief.points.reshape(-1, 3), relief.cell[0]
        colour = encoded(torch.as_tensor(albedo, dtype=torch.float32))
        return Scene.of(
            Gaussians.discs(points, 0.6 * cell, 0.1 * cell, 0.9, colour.expand(len(points), 3)),
            particles,
            spacing,
            grain_albedo=colour.expand(len(particles), 3).contiguous(),
            light=light,
            tool=ToolBody(mesh),
            tool_albedo=np.array(tool_albedo),
            bed=bed,
            background=np.zeros(3),
        )

    return make
