"""Calibration: what pictures tell of cameras, exposure, light, focus, clock and tool where soil plays no part.

Before anything moves, the photographs tell how the bed looks from where the camera is said to stand: how the video's
first frames differ from that tells how it really stands, how it is exposed and focused, and what the light is. Where
the tool stands clear of the soil, its edges tell by how much it or the clock is off; where the tool never was,
brightness tells a drift. Soil that moves otherwise than the model thinks touches none of them.

The scene that is drawn is made of photographs alone: the model's own takes its albedo from the video's first frames
too, and so hides a part of what is wrong with them. A few photographs are left out of it, and the same is done
with them as with the video. Nothing is wrong with them, so what is found of them is error, of shape, albedo and
drawing: its mean is taken off, its scatter is what one more picture may be off.

Differences are regressed on derivatives of drawn pictures in Gauss-Newton steps (`bands`). To what is found of the
photographs, a jackknife over squares of the bed, or looks at the tool, adds what this picture's own errors do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatsoil.comparison import Comparator
from splatsoil.experiment.bands import SCALES, misfit, regression, shaped, shrunk
from splatsoil.experiment.base import Calibration
from splatsoil.experiment.calibration_bench import VAGUE, Bench, parameters_of
from splatsoil.measurement import Frame, Measurement
from splatsoil.model import Model
from splatsoil.mpm import Trajectory
from splatsoil.parameters import Parameter
from splatsoil.scene import Scene, build_scene

FloatArray = npt.NDArray[np.float64]

ROUNDS = {"still": (1, 2, 4, 4, 4), "tool": (3, 4, 4), "drift": (1,)}
"""Bands, from the coarsest on, that Gauss-Newton steps go by: shifts of many pixels mislead the fine ones."""
LIKELY = 0.08
"""Size of what may be wrong, in units of a parameter's range, for first steps; the last one knows no bounds."""
CONTROLS = 8
"""Photographs, at most, that are treated as if they were the video."""
FEWEST_CONTROLS = 5
"""From which on their mean is taken for the drawing's own."""


def calibrate(
    model: Model, comparator: Comparator, parameters: Sequence[Parameter], trajectory: Trajectory, seed: int = 0
) -> Calibration:
    """What first frames, the tool's edges and untouched soil tell of parameters of observation.

    Args:
        model: of the experiment; its effects need not have the parameters.
        comparator: with the observed frames.
        parameters: those asked for, of observation effects of the library or the model.
        trajectory: of the model's soil, with the frames that a time offset needs if one is asked for.
        seed: of the trajectory's particles.

    Raises:
        ParameterError: a parameter that no observation effect has, or frames that the trajectory lacks.
    """
    bench = Bench(model, comparator, parameters, trajectory, seed, _scene_of_photographs(model, seed))
    value, spread = np.zeros(len(parameters)), np.diag(bench.vague**2)
    for kind, look in (("still", bench.bed), ("tool", bench.tool), ("drift", bench.quiet)):
        free = [k for k, found in enumerate(bench.kinds) if found == kind]
        known: list[int] = []
        if not free:
            continue
        if kind == "tool" and bench.clocks:
            value = min(bench.early_and_late(value), key=bench.tool_misfit)
        best = (np.inf, value)
        for number, bands in enumerate(ROUNDS[kind], start=1):
            if kind == "tool" and bands == len(SCALES):
                known = bench.poses
            value = bench.inside(value)
            rows = look(value, [*free, *known])
            if not rows:
                break
            cost = misfit(rows)
            if stuck := cost > best[0]:
                value = best[1]
                rows = look(value, [*free, *known])
            best = (min(cost, best[0]), value.copy())
            beside = len(rows[0].slopes) - len(free) - len(known)
            vague = np.append(bench.vague[free], np.ones(beside))
            start = np.append(value[free], np.zeros(beside))
            step, covariance, lean, inner = (p[: len(free)] for p in regression(rows, bands, vague, start))
            covariance, inner = covariance[:, : len(free)], inner[:, : len(free)]
            small = np.all(np.abs(step) < np.sqrt(np.diag(covariance)))
            if number == len(ROUNDS[kind]) or (bands == len(SCALES) and (stuck or small)):
                value[free] += step
                break
            value[free] += shrunk(step, covariance, inner, bench.vague[free] * (LIKELY / VAGUE))
        if not rows:
            continue
        variance = np.diag(covariance).copy()
        if kind == "still":
            # What photographs show of a camera that is right is the drawing's, and no camera's.
            bias, error = _errors_of_photographs(model, bench)
            value[free] -= bias[free]
            variance += error[free]
        if kind == "tool":
            variance += bench.errors_of_edges(value, free)
        mixed = lean @ spread[known]
        spread[free], spread[:, free] = mixed, mixed.T
        spread[np.ix_(free, free)] = shaped(variance, inner) + mixed[:, known] @ lean.T
    estimate, covariance = bench.reported(value, spread)
    # How errors of different effects go together isn't known: what each one says stands for itself.
    mine = {p.name: e.name for e in bench.effects for p in parameters_of(e, model.measurement)}
    owner = np.array([mine[p.name] for p in parameters])
    covariance = np.where(owner[:, None] == owner[None], covariance, 0.0)
    return Calibration(tuple(p.name for p in parameters), estimate, covariance)


def _aside(measurement: Measurement) -> list[Frame]:
    """Photographs that are treated as if they were the video: those that see the bed from a height most like its."""
    middle = 0.5 * (measurement.bed.lower + measurement.bed.upper)

    def rise(position: FloatArray) -> float:
        return float(np.arctan2((position - middle)[2], np.hypot(*(position - middle)[:2])))

    level = np.mean([rise(view.position) for view in measurement.cameras.values()])
    corners = [np.where(pick, measurement.bed.lower, measurement.bed.upper) for pick in np.ndindex(2, 2, 1)]
    whole = [
        v
        for v in measurement.views
        if np.isfinite(v.camera.undistorted().project(np.array([middle, *corners]))[0]).all()
    ]
    return sorted(whole, key=lambda v: abs(rise(v.camera.position) - level))[: min(CONTROLS, len(whole) // 3)]


def _scene_of_photographs(model: Model, seed: int) -> Scene:
    """The model's scene, its albedo from photographs alone and without those set aside."""
    seen, aside = model.measurement, _aside(model.measurement)
    views = tuple(v for v in seen.views if v not in aside)
    later = tuple(f for f in seen.video if f.frame is not None and f.frame > 0)
    return build_scene(
        model.reconstruction,
        replace(seen, views=views, video=later),
        model.particles(seed),
        model.resolution.spacing,
        light=model.scene(seed).light,
        device=model.device,
    )


def _errors_of_photographs(model: Model, bench: Bench) -> tuple[FloatArray, FloatArray]:
    """(k,) mean, and (k,) mean square error about it, of what is found of photographs with which nothing is wrong.

    Each photograph is one camera by itself, and what it says of light and exposure is taken for the error of all
    cameras together: their errors are alike.
    """
    seen, aside = model.measurement, _aside(model.measurement)
    video = [
        replace(v, camera=replace(v.camera, name=str(i)), camera_name=str(i), frame=f, time=f / seen.frame_rate)
        for f in (0, 1)
        for i, v in enumerate(aside)
    ]
    bias, error = np.zeros(len(bench.parameters)), np.zeros(len(bench.parameters))
    if not aside:
        return bias, error
    mock = Model(replace(seen, video=tuple(video)), model.reconstruction, preset=model.preset, device=model.device)
    mock.resolution = model.resolution
    comparator = Comparator(mock.measurement, surface=model.reconstruction.surface)
    every = [p for e in bench.effects for p in parameters_of(e, mock.measurement)]
    control = Bench(mock, comparator, every, bench.trajectory, bench.seed, bench.model.scene(bench.seed))
    whole = [p for e in bench.effects for p in parameters_of(e, seen)]
    real = Bench(model, bench.comparator, whole, bench.trajectory, bench.seed, bench.model.scene(bench.seed))
    still = [k for k, kind in enumerate(control.kinds) if kind == "still"]
    rows, found = control.bed(np.zeros(len(every)), still), []
    for camera, row in zip(comparator.cameras, rows, strict=True):
        mine = [i for i, k in enumerate(still) if camera in control.cameras[k]]
        part = replace(row, slopes=row.slopes[mine])
        vague = control.vague[[still[i] for i in mine]]
        found.append(regression([part], len(SCALES), vague, np.zeros(len(mine)))[0])
    count, table = len(found), np.array(found)
    if count < FEWEST_CONTROLS:
        # too few to tell what is common to all
        means, squares = np.zeros(table.shape[1]), np.sum(table**2, axis=0) / max(count - 2, 1)
    else:
        # One more draw, predicted from so few (Student).
        means = table.mean(axis=0)
        squares = table.var(axis=0, ddof=1) * (1.0 + 1.0 / count) * (count - 1) / (count - 3)
    names = [p.name for p in bench.parameters]
    for camera in bench.comparator.cameras:
        mine = [k for k, kind in enumerate(real.kinds) if kind == "still" and camera in real.cameras[k]]
        for mean, square, k in zip(means, squares, mine, strict=True):
            if whole[k].name in names:
                share = 1 if k in real.poses else len(bench.comparator.cameras)
                place = names.index(whole[k].name)
                bias[place] += mean / share
                error[place] += square / share
    return bias, error
