"""Guesses of the colour of buried soil against the correlation that they are said to have."""

import math

import numpy as np
import torch

from splatsoil.scene.albedo import SurfaceAlbedo, sampled_albedo

LENGTH, CONTRAST = 0.03, 0.2


def guesses(points, depth, count=400):
    """Logarithms (count, p) of guesses over the best one, for a surface whose log albedo has a spread of CONTRAST."""
    generator = np.random.default_rng(1)
    above = np.exp(CONTRAST * generator.standard_normal((len(points), 1))) * np.array([0.5, 0.4, 0.3])
    best = torch.full((len(points), 3), 0.3)
    grains = torch.tensor(points, dtype=torch.float32)
    parts = (grains, torch.full((len(points),), depth), best, torch.tensor(above, dtype=torch.float32), LENGTH)
    found = [sampled_albedo(*parts, np.random.default_rng(seed)) for seed in range(count)]
    return np.log(torch.stack(found)[..., 0].numpy() / 0.3)


def cloud(count=300):
    return np.random.default_rng(0).uniform(0.0, 0.2, (count, 3))


def test_what_photographs_show_is_not_guessed():
    assert np.abs(guesses(cloud(), 0.0, 2)).max() == 0.0


def test_deep_soil_varies_as_the_surface_does_about_the_best_guess():
    logs = guesses(cloud(), 10.0 * LENGTH)
    assert abs(np.exp(logs).mean() - 1.0) < 0.02
    assert 0.8 * CONTRAST < logs.std() < 1.1 * CONTRAST  # of 300 places, the outermost are cut


def test_guesses_hang_together_as_far_as_blotches_reach():
    points = cloud(2)
    for share in (0.3, 1.0, 2.0):
        points[1] = points[0] + [share * LENGTH, 0.0, 0.0]
        pair = np.concatenate([points, cloud()])
        logs = guesses(pair, 10.0 * LENGTH)
        assert abs(np.corrcoef(logs[:, 0], logs[:, 1])[0, 1] - math.exp(-share)) < 0.12


def test_best_guess_and_what_is_left_open_make_up_the_whole_variance():
    # kriging: the best guess explains exp(-2 d / length) of the variance, the rest is open
    depth = 0.5 * LENGTH
    axis = np.arange(0.0, 0.3, 0.01)
    centres = np.stack([*(m.ravel() for m in np.meshgrid(axis, axis)), np.zeros(len(axis) ** 2)], 1)
    wave = np.sin(centres[:, 0] * 2.0 * np.pi / 0.15) * np.sin(centres[:, 1] * 2.0 * np.pi / 0.15)
    colours = 0.3 * np.exp(CONTRAST * wave)[:, None] * np.ones(3)
    grains = torch.tensor(centres - [0.0, 0.0, depth], dtype=torch.float32)
    surface = torch.tensor(colours, dtype=torch.float32)
    deep = torch.full((len(centres),), depth)
    corners = (-0.005, -0.005), (0.295, 0.295)
    shown = SurfaceAlbedo(torch.tensor(centres, dtype=torch.float32), surface, 0.01, *corners, LENGTH)
    assert torch.allclose(shown.above(grains), surface, rtol=0.08)
    best = shown.beneath(grains, deep)
    told = np.log(best[:, 0].numpy()).var() / np.log(colours[:, 0]).var()
    opened = guesses(cloud(), depth).var() / guesses(cloud(), 10.0 * LENGTH).var()
    assert abs(told - math.exp(-1.0)) < 0.03
    assert abs(opened - (1.0 - math.exp(-1.0))) < 0.02


def test_the_mean_is_the_beds_however_densely_gaussians_stand_on_dark_soil():
    rng = np.random.default_rng(2)
    dark, bright = (rng.uniform([x, 0.0, 0.0], [x + 0.1, 0.2, 0.0], (n, 3)) for x, n in ((0.0, 4000), (0.1, 400)))
    centres = torch.tensor(np.concatenate([dark, bright]), dtype=torch.float32)
    colours = torch.tensor(np.repeat([0.2, 0.4], [4000, 400])[:, None] * np.ones(3), dtype=torch.float32)
    shown = SurfaceAlbedo(centres, colours, 0.01, (0.0, 0.0), (0.2, 0.2), LENGTH)
    deep = shown.beneath(centres, torch.full((4400,), 1.0))
    assert torch.allclose(deep, torch.tensor(0.3), rtol=0.03)  # 0.22 by Gaussians; at the border dark ones are nearer
