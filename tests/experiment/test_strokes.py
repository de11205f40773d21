"""Other strokes: where the tool goes in them, by the mesh itself, and what would be seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatsoil.commands.design import motion_csv
from splatsoil.experiment.forces import ALONG, SCALE, SENSOR
from splatsoil.experiment.plow import MAX_FEATURES, PlowExperiment
from splatsoil.experiment.strokes import StrokeExperiment, strokes
from splatsoil.measurement import HeightMaps, Measurement, ToolMotion
from splatsoil.model import Model

SURFACE = 0.13


@pytest.fixture(scope="module")
def damp(plow_damp: Path) -> Measurement:
    return Measurement.load(plow_damp)


def swept(motion: ToolMotion, measurement: Measurement) -> np.ndarray:
    """(rows, vertices, 3) where the tool is."""
    poses = [motion.matrix(float(t)) for t in motion.times]
    return np.stack([measurement.tool.mesh.vertices @ m[:3, :3].T + m[:3, 3] for m in poses])


def test_motions_are_what_their_names_say(damp: Measurement) -> None:
    rate = damp.frame_rate
    made = {s.name: s.motion(rate) for s in strokes(damp, SURFACE)}
    where = {name: swept(motion, damp) for name, motion in made.items()}
    depth = {name: SURFACE - places[..., 2].min() for name, places in where.items()}
    measured = swept(damp.tool.motion, damp)
    assert depth["as measured"] == pytest.approx(SURFACE - measured[..., 2].min())
    # A fifth of the soil stays beneath the tool, so that not all of a half more is possible.
    assert depth["deeper by 33 %"] == pytest.approx(0.8 * SURFACE)
    assert depth["half as deep"] == pytest.approx(0.5 * depth["as measured"])

    def fastest(motion: ToolMotion) -> float:
        return float((np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)).max())

    assert fastest(made["twice as fast"]) == pytest.approx(2.0 * fastest(damp.tool.motion))
    assert fastest(made["half as fast"]) == pytest.approx(0.5 * fastest(damp.tool.motion))
    assert made["half as fast"].times[-1] == pytest.approx(2.0 * damp.tool.motion.times[-1])
    for name, ahead in (("upper edge ahead", 1.0), ("lower edge ahead", -1.0)):
        assert depth[name] == pytest.approx(depth["as measured"])
        middle = where[name][60] - measured[60]
        # The tool is pushed towards +x.
        assert ahead * (middle[np.argmax(measured[60, :, 2]), 0] - middle[np.argmin(measured[60, :, 2]), 0]) > 0.02
    beside = where["a second one on the left"]
    width = np.ptp(damp.tool.mesh.vertices[:, 1])
    assert np.allclose(beside - measured, [0.0, width, 0.0], atol=1e-6)
    for places in where.values():
        low = places[places[..., 2] < damp.bed.upper[2]]
        assert (low[:, :2] > damp.bed.lower[:2]).all() and (low[:, :2] < damp.bed.upper[:2]).all()


def test_where_there_is_no_room_there_is_no_such_stroke(damp: Measurement) -> None:
    narrow = replace(damp, bed=replace(damp.bed, lower=np.array([0.0, 0.15, 0.0]), upper=np.array([0.8, 0.42, 0.27])))
    assert not any("second" in s.name for s in strokes(narrow, SURFACE))
    right = replace(damp, bed=replace(damp.bed, lower=np.array([0.0, 0.0, 0.0]), upper=np.array([0.8, 0.4, 0.27])))
    assert "a second one on the right" in {s.name for s in strokes(right, SURFACE)}
    shallow = replace(damp, bed=replace(damp.bed, lower=np.array([0.0, 0.0, 0.045])))
    assert not any(s.name.startswith("deeper") for s in strokes(shallow, SURFACE))


def test_a_second_stroke_begins_after_the_first_and_in_the_air(damp: Measurement) -> None:
    second = strokes(damp, SURFACE)[-1]
    motion = second.measurement.tool.motion
    first = damp.tool.motion
    assert np.array_equal(motion.positions[: len(first.times)], first.positions)
    between = motion.positions[len(first.times) : second.start + 1]
    sideways = np.abs(np.diff(between[:, 1])) > 0.0
    assert (between[1:][sideways, 2] == first.positions[:, 2].max()).all()
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)
    was = np.linalg.norm(np.diff(first.positions, axis=0), axis=1) / np.diff(first.times)
    assert speed.max() <= was.max() * (1.0 + 1e-9)


def test_a_written_motion_reads_as_the_stroke(damp: Measurement, tmp_path: Path) -> None:
    for stroke in strokes(damp, SURFACE):
        motion = stroke.motion(damp.frame_rate)
        (tmp_path / "tool_motion.csv").write_text(motion_csv(motion))
        read = ToolMotion.read(tmp_path / "tool_motion.csv")
        assert np.array_equal(read.frames, np.arange(len(read.frames)))
        assert np.allclose(read.times, read.frames / damp.frame_rate)
        for share in (0.0, 0.3, 0.7, 1.0):
            time = share * float(read.times[-1])
            wanted = stroke.measurement.tool.motion.matrix(time + stroke.start / stroke.measurement.frame_rate)
            assert np.allclose(read.matrix(time), wanted, atol=2e-3)


def test_what_models_differ_by_is_told_without_a_photograph(
    damp: Measurement, over_level_soil: Callable[..., Model]
) -> None:
    """Pictures that are darker by 10 grey levels, and twice the force, are told as that; the force's noise is that of
    the size that is expected."""
    measured = PlowExperiment(over_level_soil(damp, SURFACE))
    assert 0.8 * MAX_FEATURES < measured.layout.placed.sum() * measured.layout.shape[0] < 1.1 * MAX_FEATURES
    second = strokes(damp, SURFACE)[-1]
    experiment = StrokeExperiment(over_level_soil(second.prepared(measured), SURFACE), measured)
    assert experiment.layout.times[-1] == measured.layout.times[-1] + second.start
    assert experiment.layout.channels == measured.layout.channels
    last = experiment.base.frames[-1]

    def features(grey: float, force: float) -> np.ndarray:
        shades = {second.start: 0.5}
        images = {
            key: np.full_like(picture, shades.get(key[1], grey))
            for key, picture in experiment.comparator.observed.items()
        }
        newtons = np.tile([-force, 0.0, 0.0], (last, 1))
        prediction = SimpleNamespace(trajectory=SimpleNamespace(force=newtons), surfaces={})
        return experiment.features_of(experiment.comparator.blocks(images), cast(Any, prediction))

    assert measured.forces is not None
    largest = measured.forces.largest
    one, other = features(0.5, 0.1 * largest), features(0.5 - 10.0 / 255.0, 0.2 * largest)
    placed = experiment.layout.placed
    differs = (other - one)[:, placed][experiment.seen[:, placed]]
    assert np.allclose(differs[differs != 0.0], -10.0, atol=0.01) and np.mean(differs != 0.0) > 0.9
    along = [site.channel for site in experiment.layout.sites].index(ALONG)
    assert np.allclose(SCALE * np.sinh(one[:, along] / SCALE), 10.0)
    assert np.allclose(SCALE * np.sinh(other[:, along] / SCALE), 20.0)
    assert np.allclose(experiment.sensor[:, placed], measured.sensor[:, measured.layout.placed])
    experiment.expect(other)
    assert np.array_equal(experiment.observed, other)
    moves = np.array(experiment.layout.stages) != "pause"
    assert np.allclose(experiment.sensor[moves, along], SENSOR / np.sqrt(1.0 + (20.0 / SCALE) ** 2))


@pytest.mark.parametrize("pictures", [True, False])
def test_heights_of_another_stroke_are_seen_where_they_were_measured_but_for_the_tool(
    damp: Measurement, over_level_soil: Callable[..., Model], pictures: bool
) -> None:
    shape = tuple(round(float(v) / 0.01) for v in damp.bed.extents[1::-1])
    level = {f: np.full(shape, SURFACE) for f in damp.frames}
    scanned = replace(damp, heights=HeightMaps(damp.bed.lower[:2], 0.01, level, 0.002))
    if not pictures:
        scanned = replace(scanned, views=(), video=())
    measured = PlowExperiment(over_level_soil(scanned, SURFACE))
    second = strokes(scanned, SURFACE)[-1]
    model = over_level_soil(second.prepared(measured), SURFACE)
    experiment = StrokeExperiment(model, measured)
    assert experiment.layout.channels == measured.layout.channels and measured.layout.channels[0] == "heights"
    heights = np.array([site.channel == "heights" for site in experiment.layout.sites])
    seen, place = experiment.seen[:, heights], np.array([(s.x, s.y) for s in experiment.layout.sites])[heights]
    # two frames a row
    assert seen.mean() > 0.8 and experiment.sensor[:, heights].max() == pytest.approx(2.0 / np.sqrt(2.0))
    row, frame = next((i, t) for i, t in enumerate(experiment.layout.times) if not seen[i].all())
    low, high = model.measurement.tool.bounds(frame / model.measurement.frame_rate)
    assert (np.abs(place[~seen[row]] - 0.5 * (low + high)[:2]) < 0.5 * (high - low)[:2] + 0.08).all()
