"""Soil whose sides are seen, soil that goes on beyond the box, and a heap on a floor, ray-cast by code of the tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatsoil.errors import SetWarning
from splatsoil.measurement import Contents, Measurement, Picture, write_measurement
from splatsoil.reconstruction import reconstruct
from splatsoil.reconstruction.presets import preset_named
from splatsoil.reconstruction.sides import sides_seen
from splatsoil.reconstruction.surface import find_geometry
from splatsoil.reconstruction.views import load_views, silhouettes


def measured(scene, folder, container=None) -> Measurement:
    """16 views, the lower ones from beside the bed."""
    low = scene.cameras(16, 128, 96, rise=(12.0, 60.0))
    views = [Picture(camera, scene.render(camera, seed=k)) for k, camera in enumerate(low)]
    video = [Picture(replace(low[1], name="left"), views[1].image, frame=0, time=0.0)]
    bed = replace(scene.bed, container=container)
    contents = Contents(name="kind", bed=bed, tool=scene.tool(), frame_rate=50.0, views=views, video=video)
    return write_measurement(folder, contents, suffix=".png")


@pytest.fixture(scope="module")
def glass(scene):
    """The scene without a bin: soil stands upright, as behind glass."""
    return replace(scene, wall=None)


@pytest.fixture(scope="module")
def behind_glass(glass, tmp_path_factory) -> Measurement:
    return measured(glass, tmp_path_factory.mktemp("glass") / "set")


def test_soil_behind_glass_keeps_its_surface_and_gets_its_sides(glass, behind_glass):
    with pytest.warns(SetWarning, match=r"bed\.container is not given.*transparent"):
        made = reconstruct(behind_glass, preset="tiny", seed=0)
    assert made.container == "transparent"
    assert made.surface.rmse(glass.surface(made.surface)) < 5e-3
    assert made.psnr > 26.0
    lower, upper = glass.bed.lower, glass.bed.upper
    place = made.gaussians.means.numpy()[made.soil.numpy()]
    deep = place[place[:, 2] < glass.level - 0.03]
    away = np.abs(np.column_stack([deep[:, :2] - lower[:2], upper[:2] - deep[:, :2]])).min(axis=1)
    assert len(deep) > 100 and np.median(away) < 3e-3
    assert deep[:, 2].min() < lower[2] + 0.03


def test_soil_at_the_sides_is_told_from_walls_and_fields(scene, glass, behind_glass, tmp_path):
    field = measured(replace(scene, wall=0.0), tmp_path / "field")
    walled = measured(scene, tmp_path / "bin")
    preset = preset_named("tiny")
    found = []
    for measurement in (behind_glass, field, walled):
        views = load_views(measurement.views, preset.longest_side)
        hidden = silhouettes(views, measurement.tool.placed(0.0))
        geometry = find_geometry(views, measurement.bed, hidden, preset, lambda *_: None)
        found.append(sides_seen(views, measurement.bed, geometry))
    assert found == [True, False, False]


def test_the_set_has_the_last_word(glass, tmp_path):
    made = reconstruct(measured(glass, tmp_path / "set", "bin"), preset="tiny", seed=0)
    assert made.container == "bin"
    soil = made.gaussians.means.numpy()[made.soil.numpy()]
    assert np.median(np.abs(soil[:, 2] - glass.height(soil[:, 0], soil[:, 1]))) < 0.02


def test_a_heap_ends_on_the_floor(scene, tmp_path):
    heap = replace(scene, wall=None, heap=True)
    made = reconstruct(measured(heap, tmp_path / "set", "heap"), preset="tiny", seed=0)
    surface, truth = made.surface, heap.surface(made.surface)
    assert surface.rmse(truth) < 5e-3
    bare = truth.height <= heap.bed.lower[2]
    assert 0.2 < bare.mean() < 0.6
    assert np.mean(surface.height[bare] <= heap.bed.lower[2]) > 0.7
    place = made.gaussians.means.numpy()
    soil = made.soil.numpy()
    assert np.all(surface.sample(place[soil, :2]) > heap.bed.lower[2])
    # The floor is still there to be seen.
    inside = np.all((place[:, :2] > heap.bed.lower[:2]) & (place[:, :2] < heap.bed.upper[:2]), axis=1)
    assert (inside & made.surroundings.numpy() & (place[:, 2] < heap.bed.lower[2] + 0.02)).sum() > 20
