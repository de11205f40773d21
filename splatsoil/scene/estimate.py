"""The light estimated from photographs of the undisturbed bed: what they show of points all over it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.measurement import Frame, Measurement
from splatsoil.scene import kernels
from splatsoil.scene.light import linear
from splatsoil.scene.light_fit import FINEST, LAG, LightEstimate, Passing, fit_light
from splatsoil.scene.lit import ceiling, march_step
from splatsoil.scene.relief import Relief, grid_of
from splatsoil.scene.tool import ToolBody
from splatsoil.splats.warp_torch import as_warp, launch

FloatArray = npt.NDArray[np.float64]

_CELLS = 200
"""Cells along the longer side of the bed at which colours are compared."""

_MARGIN = 0.03
"""Strip along the walls that is left out, m: walls shade it and hide it."""

_BLUR = 1.5
"""How far photographs blur an edge, in their pixels: the eye's pixel and the interpolation between pixels."""

_CLEARANCE = 0.002
"""Between the tool and soil that it has not touched yet, m."""

_PASSING = 3
"""Frames with the tool in the air that are looked at, at most."""


def still_frames(measurement: Measurement) -> list[Frame]:
    """Every photograph in which nothing has moved: the views, the pre-roll and frame 0 of the video."""
    still = [f for f in measurement.video if f.frame is not None and f.frame <= 0]
    return [*measurement.views, *still]


def seen_colours(
    points: Tensor, frames: Sequence[Frame], relief: Relief, tool: object, *, slack: float = 0.004
) -> tuple[Tensor, Tensor]:
    """Linear colours of points on the surface, the median over the photographs that see them.

    Args:
        points: (n, 3), m.
        frames: photographs.
        relief: the surface, for what hides what.
        tool: the tool's pose in these photographs, in the kernels' form.
        slack: how far a point may lie beneath the surface and still count as seen, m.

    Returns:
        (n, 3) colours, NaN where no photograph sees the point, and (n,) how many do.
    """
    samples = torch.full((len(frames), len(points), 3), math.nan)
    where = points.double().cpu().numpy()
    for k, frame in enumerate(frames):
        camera = frame.camera
        pixels, depth = camera.project(where)
        seen = torch.empty(len(points), dtype=torch.float32, device=points.device)
        inputs = [
            as_warp(points, wp.vec3),
            wp.vec3(*camera.position),
            as_warp(relief.height, wp.float32),
            grid_of(relief),
        ]
        inputs += [tool, march_step(relief), ceiling(relief), slack, as_warp(seen, wp.float32)]
        launch(kernels.points_seen, len(points), inputs, points)
        inside = (
            (depth > 0) & (pixels > 1.0).all(axis=1) & (pixels < [camera.width - 1.0, camera.height - 1.0]).all(axis=1)
        )
        visible = (seen.cpu().numpy() > 0.5) & inside
        image = linear(torch.from_numpy(np.ascontiguousarray(frame.image())))
        normalised = torch.from_numpy(2.0 * pixels[visible] / [camera.width, camera.height] - 1.0).float()
        picked = functional.grid_sample(
            image.permute(2, 0, 1)[None], normalised[None, None], mode="bilinear", align_corners=False
        )
        samples[k, torch.from_numpy(visible)] = picked[0, :, 0].T
    count = torch.isfinite(samples[:, :, 0]).sum(dim=0)
    return samples.nanmedian(dim=0).values.to(points.device), count.to(points.device)


def estimate_light(measurement: Measurement, relief: Relief, body: ToolBody) -> LightEstimate:
    """Sun and sky over a measurement set, from its photographs before the soil moves.

    Args:
        measurement: the set; its tool stands where its motion begins.
        relief: the undisturbed surface.
        body: the tool.
    """
    motion = measurement.tool.motion
    tool = body.at(*motion.pose(float(motion.times[0])))
    lower, upper = np.asarray(measurement.bed.lower), np.asarray(measurement.bed.upper)
    points, shape = _cells(relief, lower, upper)
    colours, count = seen_colours(points, still_frames(measurement), relief, tool)
    colours[count < 2] = math.nan
    middle = 0.5 * (lower + upper)
    pixel = float(np.median([np.linalg.norm(v.camera.position - middle) / v.camera.fx for v in measurement.views]))
    across = float((points[1] - points[0]).norm())
    blur = max(1, math.ceil(_BLUR * pixel / across))
    passing = [_passing(measurement, points, relief, body, frame) for frame in in_the_air(measurement, relief, body)]
    return fit_light(points, colours, shape, relief, tool, blur=blur, passing=passing)


def in_the_air(measurement: Measurement, relief: Relief, body: ToolBody) -> list[int]:
    """Some video frames after the first up to which the tool has touched no soil."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    times = np.union1d(motion.times, [f / rate for f in measurement.frames])
    free = []
    for time in times[times >= measurement.frames[0] / rate - 1e-9] if measurement.frames else ():
        centres, _ = body.discs(*motion.pose(float(time)))
        if float((centres[:, 2] - relief.sample(relief.height, centres)).min()) < _CLEARANCE:
            break
        free.append(float(time))
    frames = [f for f in measurement.frames[1:] if free and f / rate <= free[-1] + 1e-9]
    return sorted({frames[round(i)] for i in np.linspace(0, len(frames) - 1, min(_PASSING, len(frames)))})


def _passing(measurement: Measurement, points: Tensor, relief: Relief, body: ToolBody, frame: int) -> Passing:
    """What the video's cameras say of the points at a frame, compared with the same cameras' still frames."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    then, rest = (body.at(*motion.pose(time)) for time in (frame / rate, float(motion.times[0])))
    still = still_frames(measurement)
    changes = []
    for name in measurement.cameras:
        before = [f for f in still if f.frame is not None and f.camera_name == name]
        after = [f for f in measurement.video if f.frame == frame and f.camera_name == name]
        if before and after:
            shown, known = (
                seen_colours(points, frames, relief, tool)[0].clamp_min(1e-4).log()
                for frames, tool in ((after, then), (before, rest))
            )
            changes.append(shown - known)
    return Passing(then, torch.stack(changes).nanmean(dim=0) if changes else torch.full_like(points, math.nan))


def _cells(relief: Relief, lower: FloatArray, upper: FloatArray) -> tuple[Tensor, tuple[int, int]]:
    """Points of a regular grid on the surface, away from the walls."""
    extent = upper[:2] - lower[:2]
    margin = min(_MARGIN, 0.1 * float(extent.min()))
    size = max(FINEST, float(extent.max()) / _CELLS)
    nx, ny = (max(4 * LAG, int((extent[k] - 2 * margin) / size)) for k in (0, 1))
    x = torch.linspace(float(lower[0] + margin), float(upper[0] - margin), nx, device=relief.device)
    y = torch.linspace(float(lower[1] + margin), float(upper[1] - margin), ny, device=relief.device)
    ys, xs = torch.meshgrid(y, x, indexing="ij")
    flat = torch.stack([xs.reshape(-1), ys.reshape(-1)], dim=1)
    return torch.cat([flat, relief.sample(relief.height, flat)[:, None]], dim=1), (ny, nx)
