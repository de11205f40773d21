"""Gaussians that a hole dug into the bed would bring to light."""

from __future__ import annotations

import numpy as np
import torch

from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.hidden import reaching_into_soil
from splatsoil.splats import Gaussians

LOWER, UPPER = np.array([0.0, 0.0, 0.0]), np.array([0.6, 0.4, 0.2])
SURFACE = HeightField.over(LOWER, UPPER, 0.01, 0.1)


def gaussians(means: list[list[float]], scales: list[list[float]], opacity: float = 0.9) -> Gaussians:
    n = len(means)
    return Gaussians(
        torch.tensor(means),
        torch.tensor(scales),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        torch.full((n,), opacity),
        torch.full((n, 3), 0.5),
    )


def test_a_large_one_under_the_bed_reaches_into_it() -> None:
    found = gaussians(
        [[0.3, 0.2, -0.05], [0.3, 0.2, -0.3], [-0.1, 0.2, 0.05], [-0.1, 0.2, 0.05]],
        [[0.1, 0.1, 0.05], [0.1, 0.1, 0.05], [0.08, 0.05, 0.02], [0.005, 0.1, 0.1]],
    )
    # one standard deviation under the floor; six; wide across the wall; a thin pane outside of it
    assert reaching_into_soil(found, SURFACE, 0.0).tolist() == [True, False, True, False]


def test_the_walls_own_and_what_lies_on_the_soil_stay() -> None:
    pane = [[0.0, 0.2, 0.12], [0.3, 0.0, 0.12]]
    found = gaussians([*pane, [0.3, 0.2, 0.13]], [[0.001, 0.1, 0.03], [0.1, 0.001, 0.03], [0.05, 0.05, 0.005]])
    assert not reaching_into_soil(found, SURFACE, 0.0).any()


def test_what_is_too_faint_to_be_seen_stays() -> None:
    place, size = [[0.3, 0.2, -0.05]], [[0.1, 0.1, 0.05]]
    assert reaching_into_soil(gaussians(place, size, 0.5), SURFACE, 0.0).all()
    assert not reaching_into_soil(gaussians(place, size, 0.015), SURFACE, 0.0).any()


def test_a_turned_one_reaches_where_it_points() -> None:
    along, across = (gaussians([[0.3, 0.2, -0.08]], [[0.06, 0.004, 0.004]]) for _ in range(2))
    half = float(np.sqrt(0.5))
    along = along.replace(quaternions=torch.tensor([[half, 0.0, -half, 0.0]]))  # x turned to z
    assert reaching_into_soil(along, SURFACE, 0.0).all() and not reaching_into_soil(across, SURFACE, 0.0).any()
