"""Illumination estimated from photographs of undisturbed soil."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as functional
import trimesh
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Frame, Measurement
from splatsoil.scene import kernels
from splatsoil.scene.light import Light, linear
from splatsoil.scene.light_fit import FINEST, LAG, MovedShadow, fit_light
from splatsoil.scene.relief import Relief
from splatsoil.scene.tool import ToolBody
from splatsoil.splats.warp_torch import as_warp, launch

_CELLS = 200
"""Cells along the longer side of the bed at which colours are compared."""

_MARGIN = 0.03
"""Strip along the walls that is left out, m: walls shade it and hide it."""

_BLUR = 1.5
"""How far photographs blur an edge, in their pixels: the eye's pixel and the interpolation between pixels."""

_CLEARANCE = 0.005
"""Between the tool and soil that it has not touched yet, m: more than the surface is known to."""

_MOVED_SHADOWS = 5
"""Frames at which the tool's shadow on untouched soil is looked at, at most."""

_WEDGE = 2.5
"""How far around where the tool has been in the soil that counts as moved, in depths of the tool there: a passive wedge
is tan(45° + φ/2) depths long, 2.4 at 45°. At most the tool's longest side: a deep tool doesn't push all that is
beside it."""


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
        inputs = [as_warp(points, wp.vec3), wp.vec3(*camera.position), relief.surface, tool, slack]
        launch(kernels.points_seen, len(points), [*inputs, as_warp(seen, wp.float32)], points)
        size = np.array([camera.width, camera.height])
        visible = (seen.cpu().numpy() > 0.5) & (depth > 0) & ((pixels > 1.0) & (pixels < size - 1.0)).all(axis=1)
        image = linear(torch.from_numpy(np.ascontiguousarray(frame.image())))
        normalised = torch.from_numpy(2.0 * pixels[visible] / size - 1.0).float()
        picked = functional.grid_sample(image.permute(2, 0, 1)[None], normalised[None, None], align_corners=False)
        samples[k, torch.from_numpy(visible)] = picked[0, :, 0].T
    count = torch.isfinite(samples[:, :, 0]).sum(dim=0)
    return samples.nanmedian(dim=0).values.to(points.device), count.to(points.device)


def estimate_light(measurement: Measurement, relief: Relief, body: ToolBody) -> Light:
    """Sun and sky over a measurement set, from its photographs of soil that hasn't moved.

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
    alone = untouched(measurement, points, relief, body, _moments(measurement.frames[1:]))
    shadows = [
        s for frame, rest in alone.items() for s in _moved_shadows(measurement, points, relief, body, frame, rest)
    ]
    return fit_light(points, colours, shape, relief, tool, blur=blur, moved_shadows=shadows)


def _moments(later: Sequence[int]) -> list[int]:
    """Some of the video's frames after the first, most of them early, when little has moved; of many, none later than
    half way."""
    last = max(len(later) / 2, min(_MOVED_SHADOWS, len(later)), 1.0)
    return sorted({later[round(place) - 1] for place in np.geomspace(1.0, last, _MOVED_SHADOWS)}) if later else []


def untouched(
    measurement: Measurement, points: Tensor, relief: Relief, body: ToolBody, frames: Sequence[int]
) -> dict[int, Tensor]:
    """Points of the surface so far from wherever the tool has been in the soil that hardly anything has moved them.

    Args:
        measurement: has the tool's motion.
        points: (n, 3), m.
        relief: the undisturbed surface.
        body: the tool.
        frames: of the video, up to each of which the tool has moved.

    Returns:
        (n,) by frame, True where nothing has come near.
    """
    motion, mesh, ends = measurement.tool.motion, measurement.tool.mesh, np.sort(frames) / measurement.frame_rate
    # Moments between which the tool moves no farther than the clearance: by the way of its box's corners so far.
    rows = np.union1d(motion.times, ends)
    box = trimesh.bounds.corners(mesh.bounds)
    corners = np.stack([box @ rotation.T + position for rotation, position in map(motion.pose, rows)])
    way = np.cumsum([0.0, *np.linalg.norm(np.diff(corners, axis=0), axis=2).max(axis=1)])
    where, moved, at = points[:, :2].double().cpu().numpy(), np.zeros(len(points), dtype=bool), 0.0
    out = {}
    for frame, end in zip(sorted(frames), np.interp(ends, rows, way), strict=True):
        for gone in np.linspace(at, end, math.ceil((end - at) / _CLEARANCE) + 1):
            discs, _ = body.discs(*motion.pose(float(np.interp(gone, way, rows))))
            depth = relief.sample(relief.height, discs) + _CLEARANCE - discs[:, 2]
            if (depth > 0.0).any():
                reach = min(_WEDGE * float(depth.max()), float(max(mesh.extents)))
                sunk = cKDTree(discs[depth > 0.0, :2].double().cpu().numpy())
                moved |= np.isfinite(sunk.query(where, distance_upper_bound=reach)[0])
        at, out[frame] = end, torch.from_numpy(~moved).to(points.device)
    return out


def _moved_shadows(
    measurement: Measurement, points: Tensor, relief: Relief, body: ToolBody, frame: int, alone: Tensor
) -> list[MovedShadow]:
    """Of each of the video's cameras: log brightness of undisturbed points over that in its still frames."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    then, rest = (body.at(*motion.pose(time)) for time in (frame / rate, float(motion.times[0])))
    still = still_frames(measurement)
    out = []
    for name in measurement.cameras:
        before = [f for f in still if f.frame is not None and f.camera_name == name]
        after = [f for f in measurement.video if f.frame == frame and f.camera_name == name]
        if before and after:
            shown, known = (
                seen_colours(points, frames, relief, tool)[0].clamp_min(1e-4).log()
                for frames, tool in ((after, then), (before, rest))
            )
            shown[~alone] = math.nan
            out.append(MovedShadow(then, shown - known))
    return out


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
