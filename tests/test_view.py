"""`splatsoil view`: what the browser's scene holds, and a picture of it."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatsoil.comparison import Comparator
from splatsoil.export import replay
from splatsoil.measurement import HeightMaps, Measurement

viser = pytest.importorskip("viser")

VALUES = {"friction_angle": 33.0}
DEPTH = 0.15


@pytest.fixture
def server() -> Iterator[Any]:
    made = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield made
    made.stop()


@pytest.fixture
def columns(small_set: Path, over_level_soil: Callable[..., Any], spotted: Callable[..., Any]) -> list[Any]:
    """Level soil under the tool of plow-dry, ten frames long, with and without an effect that keeps plastic strain."""
    from splatsoil.view import Column

    measurement = Measurement.load(small_set)
    out = []
    for effects in ((), ("dilatancy",)):
        model = over_level_soil(measurement, DEPTH, *effects)
        particles = model.particles().astype(np.float32)
        scene = spotted(particles, model.resolution.spacing, measurement.bed, 0.004, measurement.tool.mesh)
        model._scene = lambda seed, scene=scene: scene  # type: ignore[assignment]
        comparator = Comparator(measurement, surface=model.reconstruction.surface, frames=model.frames)
        out.append(Column(" ".join(effects) or "base", model, VALUES, comparator))
        replay(model, VALUES, model.recorded, out[-1:])
    return out


def test_shear_strain_is_that_of_simple_and_pure_shear() -> None:
    from splatsoil.view import shear_strain

    turned = Rotation.from_euler("xyz", (20.0, 50.0, 10.0), degrees=True).as_matrix()
    stretched = np.diag([np.exp(0.3), np.exp(-0.3), 1.0])
    sheared = np.array([[1.0, 1e-4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    strains = shear_strain(np.stack([turned @ stretched, 1.1 * np.eye(3), sheared]))
    assert strains == pytest.approx([0.6 / np.sqrt(3.0), 0.0, 1e-4 / np.sqrt(3.0)], abs=1e-7)


def test_the_scene_of_a_run(server: Any, columns: list[Any]) -> None:
    from splatsoil.view import Viewer

    viewer = Viewer(server, columns[0].model.measurement, columns)
    node = server.scene.get_handle_by_name
    measurement = columns[0].model.measurement
    assert viewer.frames == (0, 10)
    assert viewer.colour.options == ("Gaussians", "speed", "shear strain", "misfit"), (
        "one model keeps no plastic strain"
    )
    assert "plastic shear" in columns[1].quantities and columns[1].title == "dilatancy"
    for k, column in enumerate(columns):
        splats, particles = node(f"/prediction {k}/splats"), node(f"/prediction {k}/particles")
        assert splats.visible and not particles.visible
        assert len(splats.centers) > 0.8 * len(column.positions[0])
    # Their beds don't overlap.
    assert abs(node("/prediction 1").position[1]) > measurement.bed.extents[1]

    viewer.colour.value, viewer.slider.value = "speed", 1
    viewer.show()
    particles = node("/prediction 0/particles")
    assert particles.visible and not node("/prediction 0/splats").visible
    np.testing.assert_allclose(particles.points, columns[0].positions[10], atol=1e-3)
    fast = columns[0].quantities["speed"][10] > viewer.limits["speed"]
    assert fast.any() and np.all(particles.colors[fast] == [253, 231, 37]), "the end of viridis"
    _, position = measurement.tool.motion.pose(10 / measurement.frame_rate)
    np.testing.assert_allclose(node("/prediction 1/tool").position, position)

    predicted = columns[0].pictures["predicted", "left", 10]
    observed = columns[0].pictures["observed", "left", 10]
    photograph = 255.0 * measurement.video_frame("left", 10).undistorted_image()
    assert np.abs(observed - photograph).max() <= 0.5
    viewer.picture.value = "predicted"
    viewer.show()
    assert np.array_equal(node("/video/left").image, predicted) and not np.array_equal(predicted, observed)


def test_the_scene_of_a_run_without_photographs_is_particles(
    server: Any, small_set: Path, over_level_soil: Callable[..., Any]
) -> None:
    from splatsoil.view import Column, Viewer

    measurement = Measurement.load(small_set)
    heights = HeightMaps(np.zeros(2), 0.1, {f: np.full((5, 8), DEPTH) for f in measurement.frames}, None)
    model = over_level_soil(replace(measurement, views=(), video=(), heights=heights), DEPTH)
    model.reconstruction.soil[:] = False
    comparator = Comparator(model.measurement, surface=model.reconstruction.surface, frames=model.frames)
    column = Column("base", model, VALUES, comparator)
    replay(model, VALUES, model.recorded, [column])
    viewer = Viewer(server, model.measurement, [column])
    assert viewer.colour.options == ("speed", "shear strain")
    particles = server.scene.get_handle_by_name("/prediction 0/particles")
    assert particles.visible and len(particles.points) == len(column.positions[0])


def test_the_scene_of_a_set(server: Any, small_set: Path) -> None:
    from splatsoil.view import Viewer

    measurement = Measurement.load(small_set)
    viewer = Viewer(server, measurement)
    assert not viewer.colour.visible
    for k, view in enumerate(measurement.views):
        node = server.scene.get_handle_by_name(f"/photographs/{k}")
        assert node.visible and node.image.shape == (view.camera.height, view.camera.width, 3)
        # viser's cameras look along +z, as OpenCV's do.
        centre = 0.5 * (measurement.bed.lower + measurement.bed.upper)
        ahead = Rotation.from_quat(node.wxyz, scalar_first=True).apply([0.0, 0.0, 1.0])
        assert ahead @ (centre - node.position) > 0.8 * np.linalg.norm(centre - node.position)
    viewer.photographs.value = False
    viewer.show()
    assert not server.scene.get_handle_by_name("/photographs/0").visible


@pytest.mark.slow
def test_ctrl_c_ends_the_command(small_set: Path) -> None:
    words = [sys.executable, "-m", "splatsoil", "view", str(small_set), "--port", "18080"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None and program.stderr is not None
        assert program.stdout.readline().startswith("http://127.0.0.1:18")
        program.send_signal(signal.SIGINT)
        assert program.wait(60) == 130
        assert f"splatsoil view {small_set}" in program.stderr.read()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_draws_it(server: Any, columns: list[Any], tmp_path: Path) -> None:
    from splatsoil.view import Viewer

    viewer = Viewer(server, columns[0].model.measurement, columns[:1])
    software = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    words = [
        "chromium",
        "--headless",
        "--no-sandbox",
        *software,
        f"--user-data-dir={tmp_path}",
        "--window-size=800,600",
    ]
    here = threading.Event()
    server.on_client_connect(lambda client: here.set())
    with subprocess.Popen(
        [*words, "--remote-debugging-port=0", f"http://127.0.0.1:{server.get_port()}"], stderr=subprocess.DEVNULL
    ) as browser:
        try:
            assert here.wait(120)
            (client,) = server.get_clients().values()
            time.sleep(5.0)  # a browser says nothing of when it has sorted the Gaussians
            gaussians = client.get_render(400, 600, timeout=120)
            viewer.colour.value = "speed"
            viewer.show()
            particles = client.get_render(400, 600, timeout=120)
        finally:
            browser.terminate()
    blue = np.all(np.abs(particles.astype(int) - [68, 1, 84]) < 60, axis=2)
    sand = (gaussians[..., 0] > gaussians[..., 2] + 20.0) & (gaussians.min(axis=2) < 230)
    assert blue.mean() > 0.05, "soil at rest has the colours' lower end"
    assert sand.mean() > 0.05
