"""Heights as features, of surfaces that are formulas, and of a simulated world."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatsoil.cli import main
from splatsoil.comparison import Comparator
from splatsoil.experiment.base import Run
from splatsoil.experiment.heights import CHANNEL, LEAST_NOISE, UNKNOWN_NOISE, Heights
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.measurement import Contents, Frame, HeightMaps, Measurement, write_measurement
from splatsoil.model import Model
from splatsoil.mpm import Resolution, Trajectory, simulate
from splatsoil.reconstruction import HeightField, fill, reconstruct
from splatsoil.scene import Relief
from splatsoil.soil.law import Law
from splatsoil.synthetic import Appearance, Recorder, plow
from splatsoil.synthetic.recording import GRID_NOISE

FRAMES = (-2, -1, 0, 100, 199)
DEEP = 0.03
"""Of the furrow in the last frame, m."""


def level(x: np.ndarray, y: np.ndarray, frame: int) -> np.ndarray:
    """A tilted plane, in which a furrow along x grows from frame 0 on."""
    furrow = max(frame, 0) / 199.0 * DEEP * np.exp(-(((y - 0.25) / 0.06) ** 2))
    return 0.12 + 0.05 * (x - 0.4) - furrow


def surfaces(bed: HeightField, frames: tuple[int, ...]) -> dict[int, Relief]:
    x, y = np.meshgrid(bed.x, bed.y)
    at = (float(bed.x[0]), float(bed.y[0]))
    return {f: Relief.of_heights(torch.from_numpy(level(x, y, f)), at, bed.cell) for f in frames if f >= 0}


@pytest.fixture(scope="module")
def dry(plow_dry: Path) -> Measurement:
    """The example set's bed, motion and cameras, at some of its frames."""
    measurement = Measurement.load(plow_dry)
    last = measurement.frames[-1]
    video = tuple(replace(f, frame=199 if f.frame == last else f.frame) for f in measurement.video)
    return replace(measurement, video=tuple(f for f in video if f.frame in FRAMES))


def of_grids(measurement: Measurement, cell: float, noise: float = 0.0, stated: float | None = None) -> Measurement:
    """The same with grids of the formula's heights."""
    rng, bed = np.random.default_rng(0), measurement.bed
    nx, ny = (round(float(v) / cell) for v in bed.extents[:2])
    x, y = np.meshgrid(cell * (np.arange(nx) + 0.5), cell * (np.arange(ny) + 0.5))
    grids = {f: level(x, y, f) + noise * rng.standard_normal(x.shape) for f in FRAMES}
    return replace(measurement, heights=HeightMaps(bed.lower[:2], cell, grids, stated))


class Depths(Frame):
    """A frame whose depth map is of the formula's heights."""

    def mask(self) -> None:
        return None

    def depth(self) -> np.ndarray:
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        origins, rays = self.camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
        along = np.zeros(len(rays))
        for _ in range(60):  # the surface is all but level: its height over the last point is nearly that over the next
            x, y, _ = (origins + along[:, None] * rays).T
            along = (level(x, y, self.frame or 0) - origins[:, 2]) / rays[:, 2]
        depth = along * (rays @ -self.camera.camera_to_world[:3, 2])
        return depth.reshape(rows.shape).astype(np.float32)


def of_depths(measurement: Measurement) -> Measurement:
    return replace(measurement, video=tuple(Depths(**{**vars(f), "depth_path": f.path}) for f in measurement.video))


def heights_of(measurement: Measurement) -> Heights:
    bed = measurement.bed
    surface = HeightField.over(bed.lower, bed.upper, 0.02, 0.12)
    comparator = Comparator(measurement, surface=surface, frames=measurement.frames)
    found = Heights.of(measurement, comparator, [[0], [1]])
    assert found is not None
    return found


def test_grids_and_depth_maps_of_one_surface_give_the_same_features_and_those_of_its_formula(dry: Measurement) -> None:
    bed = HeightField.over(dry.bed.lower, dry.bed.upper, 0.005)
    true = surfaces(bed, FRAMES)
    tables: list[Mapping[tuple[float, float], np.ndarray]] = []
    for measurement in (of_grids(dry, 0.01), of_grids(dry, 0.02), of_depths(dry)):
        found = heights_of(measurement)
        assert {(s.channel, s.unit) for s in found.sites} == {(CHANNEL, "mm")}
        np.testing.assert_allclose(found.predicted(true), found.observed, atol=0.15)
        assert np.mean(list(found.losses(true).values())) < 1e-4
        still = dict.fromkeys(true, true[0])
        assert np.mean(list(found.losses(still).values())) == pytest.approx(1.0, abs=0.1)
        tables.append({(round(s.x, 4), round(s.y, 4)): found.observed[:, k] for k, s in enumerate(found.sites)})
    places = set(tables[0]) & set(tables[1]) & set(tables[2])
    assert len(places) > 100
    for place in places:
        x, y = (v + 0.04 * (np.arange(20) / 20 - 0.475) for v in place)
        mean = 1e3 * np.mean(level(*np.meshgrid(x, y), 199) - level(*np.meshgrid(x, y), 0))
        for table in tables:
            # cells of a square that lie beneath the tool, or in the wall's strip, are not in its mean
            assert table[place][1] == pytest.approx(mean, abs=3.0)
    inside = [p for p in places if 0.1 < p[0] < 0.7 and abs(p[1] - 0.25) > 0.13]
    for one, other in ((0, 1), (0, 2)):
        apart = [tables[one][p] - tables[other][p] for p in inside]
        assert np.abs(apart).max() < 0.2


def test_where_the_tool_stands_nothing_is_seen(dry: Measurement) -> None:
    found = heights_of(of_grids(dry, 0.005))
    low, high = dry.tool.bounds(100 / dry.frame_rate)
    middle = 0.5 * (low + high)[:2]
    nearest = int(np.argmin([np.hypot(s.x - middle[0], s.y - middle[1]) for s in found.sites]))
    assert not found.seen[0, nearest] and found.observed[0, nearest] == 0.0
    far = [k for k, s in enumerate(found.sites) if s.x > high[0] + 0.1]
    assert found.seen[:, far].all()


def test_noise_is_measured_before_anything_moves_or_else_stated(dry: Measurement) -> None:
    spread = 0.004
    noisy = heights_of(of_grids(dry, 0.01, spread))
    # 16 cells a square; three still frames, each less the mean of the others
    assert noisy.noise.max() == pytest.approx(1e3 * spread / 4.0 * np.sqrt(1.5), rel=0.15)
    assert heights_of(of_grids(dry, 0.01)).noise.max() == LEAST_NOISE
    for stated, level_ in ((0.002, 2.0), (None, UNKNOWN_NOISE)):
        grids = of_grids(dry, 0.01, spread, stated).heights
        assert grids is not None
        alone = replace(grids, grids={f: g for f, g in grids.grids.items() if f >= 0})
        assert heights_of(replace(dry, heights=alone)).noise.max() == level_


def test_without_heights_of_the_first_frame_there_is_no_instrument(dry: Measurement) -> None:
    surface = HeightField.over(dry.bed.lower, dry.bed.upper, 0.02, 0.12)
    comparator = Comparator(dry, surface=surface, frames=dry.frames)
    assert Heights.of(dry, comparator, [[0], [1]]) is None
    late = of_depths(dry)
    late = replace(late, video=tuple(f for f in late.video if f.frame == 100) + dry.video[:1])
    assert Heights.of(late, comparator, [[0], [1]]) is None


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world of 33°, of which a scanner and the tool's force are all that is known."""
    setup = plow(3)
    experiment = setup.experiment()
    resolution = Resolution.derive(experiment, "tiny")
    run: Trajectory = simulate(
        experiment,
        fill(setup.surface, setup.bed, resolution.spacing, seed=70_000),
        {"friction_angle": 33.0},
        law=Law(()),
        resolution=resolution,
        frames=setup.frames,
    )[0]
    frames = np.arange(1, len(run.force) + 1)
    contents = Contents(
        name="scanned",
        bed=setup.bed,
        tool=replace(setup.tool, force=np.column_stack([frames, frames / setup.frame_rate, run.force])),
        frame_rate=setup.frame_rate,
        heights=Recorder(setup, run, Appearance.drawn(0)).heights(),
    )
    return write_measurement(tmp_path_factory.mktemp("scanned") / "set", contents).folder


def test_heights_alone_tell_the_angle(scanned: Path) -> None:
    measurement = Measurement.load(scanned)
    start = reconstruct(measurement, preset="tiny")
    assert start.surface.rmse(plow(3).surface) < 0.002
    experiment = PlowExperiment(Model(measurement, start, preset="tiny"), candidates=())
    assert experiment.layout.unit == "mm" and set(experiment.layout.channels) > {CHANNEL}
    placed = experiment.layout.placed
    assert 1e-3 * experiment.sensor[:, placed].max() < GRID_NOISE
    counted = experiment.seen & ~experiment.quiet & placed

    def left(angle: float) -> float:
        tables = [experiment.predict(Run({"friction_angle": angle}, seed=seed)) for seed in (0, 1)]
        return float(np.mean((np.mean(tables, axis=0) - experiment.observed)[counted] ** 2))

    assert left(33.0) < min(left(23.0), left(43.0))
    assert left(33.0) < 0.1 * float(np.mean(experiment.observed[counted] ** 2))


@pytest.mark.slow
def test_a_set_without_pictures_goes_the_whole_path(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(["run", str(scanned), "--run", str(run), "--preset", "tiny", "--no-effects", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    angle = printed["parameters"]["friction_angle"]
    assert abs(angle["estimate"] - 33.0) < 2.0 * angle["std"] + 1.0
    assert main(["diagnose", str(run), "--effects", "cohesion", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"]
    printed = re.sub(r"<(style|script|svg).*?</\1>|<[^>]+>", " ", (run / "report.html").read_text(), flags=re.DOTALL)
    assert CHANNEL in printed and not re.search("photograph|camera|video|Gaussians", printed)
    assert main(["export", str(run), "--to", "csv", "ply"]) == 0
    assert {p.name for p in (run / "export").iterdir()} == {"export.json", "csv"}
