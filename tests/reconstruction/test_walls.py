"""A bin whose walls stand high over the soil, ray-cast by code of the tests: what they hide of the bed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from splatsoil.comparison import Comparator
from splatsoil.measurement import Contents, Picture, write_measurement
from splatsoil.reconstruction import reconstruct
from splatsoil.reconstruction.surface import footprint, wall_top
from splatsoil.reconstruction.views import Views, silhouettes

RIM = 0.06


@pytest.fixture(scope="module")
def walled(scene):
    return replace(scene, rim=RIM)


@pytest.fixture(scope="module")
def measurement(walled, tmp_path_factory):
    cameras = walled.cameras(16, 128, 96)
    views = [Picture(camera, walled.render(camera, seed=k)) for k, camera in enumerate(cameras)]
    low = [replace(camera, name=f"low{k}") for k, camera in enumerate(walled.cameras(2, 128, 96, rise=(30.0, 36.0)))]
    video = [Picture(c, walled.render(c, seed=50 + f), frame=f, time=f / 50.0) for f in (0, 1) for c in low]
    contents = Contents(name="walls", bed=walled.bed, tool=walled.tool(), frame_rate=50.0, views=views, video=video)
    return write_measurement(tmp_path_factory.mktemp("walls") / "set", contents, suffix=".png")


@pytest.fixture(scope="module")
def made(measurement):
    return reconstruct(measurement, preset="tiny", seed=0)


@pytest.mark.parametrize("rim", [0.1, RIM, 0.0])
def test_the_walls_top_is_found_to_a_pixel(scene, rim):
    there = replace(scene, rim=rim)
    cameras = there.cameras(16, 128, 96)
    images = [there.render(camera, seed=k) for k, camera in enumerate(cameras)]
    views = Views.of(cameras, images, [np.ones(image.shape[:2], dtype=bool) for image in images], "x" * len(images))
    usable = 1.0 - silhouettes(views, there.tool().placed(0.0))
    pixel = footprint(views, there.bed)
    assert wall_top(views, there.bed, usable) == pytest.approx(there.level + rim, abs=1.2 * pixel)


def test_what_walls_hide_is_not_compared(walled, measurement, made):
    hidden = Comparator(measurement, surface=made.surface, frames=(0, 1), surroundings=made.standing)
    plain = Comparator(measurement, surface=made.surface, frames=(0, 1))
    for name, camera in measurement.cameras.items():
        wall = walled.shows_wall(camera)
        assert (plain.interior[name] & wall).sum() > 300
        # but for pixels at the walls' edges, which are mixed
        edge = binary_dilation(wall, iterations=2) & binary_dilation(~wall, iterations=2)
        assert not (hidden.interior[name] & wall & ~edge).any()
        open_bed = plain.interior[name] & ~wall & ~edge
        assert hidden.interior[name][open_bed].mean() > 0.97
