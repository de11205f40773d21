"""Comparison of observed and predicted pictures: losses, residual pictures, and block residuals for inference.

There are two losses. ``rgb`` is the mean square colour difference of the literature. ``robust`` allows for the random
fine shape of disturbed sand:

- It compares changes since frame 0 (observed I_t − I_0 with predicted I_t − I_0). A constant error of the
  reconstruction cancels.
- It averages differences over centimetres, at several scales. Single lumps average out; trench, berm and shadows do
  not.
- It is quadratic for small and linear for large differences (Huber): one pixel at the tool's edge does not dominate.
- Each scale is normalised by the loss of a model without motion: 0 is a perfect model, 1 a useless one.

Pixels of the bed's interior and of its crests are compared. Pixels in which either picture shows the tool are omitted,
because there a millimetre decides what is visible. Where the tool was at frame 0, pictures themselves are compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from splatsoil.arrays import BoolArray, FloatArray, Image
from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.robust_loss import robust_losses
from splatsoil.scene import Relief, ToolBody, ground_of_pixels, silhouette
from splatsoil.splats import Gaussians

Key = tuple[str, int]
"""Camera and frame."""

PATCH = 0.04
"""Side of a block on the bed, m."""

MARGIN = 0.02
"""Omitted strip along the walls, m."""

RISE = 0.5
"""Height of heaps above a crest, as a share of the tool's width."""

GAIN = 4.0
"""Factor of differences in pictures."""

_MIN_PIXELS = 12
"""Minimum number of pixels of a block."""

_MIN_SEPARATION = 4.0
"""Minimum distance between the colours of tool and soil, in standard deviations, for a classification by colour."""


@dataclass(frozen=True)
class Block:
    """A square of the bed as one camera sees it at one frame.

    Attributes:
        camera: name.
        frame: number.
        x: centre of the square, m.
        y: centre of the square, m.
    """

    camera: str
    frame: int
    x: float
    y: float


@dataclass(frozen=True)
class Comparison:
    """Differences between observation and prediction.

    Attributes:
        loss: mean of ``losses``; NaN without cameras.
        losses: the robust loss by camera and frame.
        rgb_mse: mean square colour difference (sRGB in [0, 1]) by camera and frame.
        blocks: (b,) observed minus predicted mean change of each block, in grey levels of 255; 0 behind the tool.
        labels: of the blocks, in the same order.
    """

    loss: float
    losses: Mapping[Key, float]
    rgb_mse: Mapping[Key, float]
    blocks: FloatArray
    labels: tuple[Block, ...]

    @property
    def rgb(self) -> float:
        """Mean of ``rgb_mse``."""
        return float(np.mean(list(self.rgb_mse.values())))


class Comparator:
    """The measured pictures, prepared for comparisons.

    Args:
        measurement: video, cameras, bed, tool.
        surface: the undisturbed surface, which determines the pixels of the bed.
        frames: to compare. The first one in the video is the reference of changes.
        patch: side of a block on the bed, m.
        surroundings: Gaussians of what does not move, which may hide parts of the bed; none by default.

    Attributes:
        observed: (h, w, 3) undistorted photographs by camera and frame.
        before: (h, w, 3) by camera, the mean of all frames before the tool moves.
        ground: (h, w, 2) by camera, where each pixel's ray meets the undisturbed surface or passes closely above a
            crest, m; NaN elsewhere.
        interior: (h, w) by camera, pixels with such a position.
        bed: (h, w) by camera, those whose ray meets the surface.
        silhouettes: (h, w) by camera and frame, the tool's, dilated.
        block: (2,) size of a block, m: about ``patch``; whole blocks fill the bed.
        patches: (h, w) by camera, the block of a pixel, or -1.
        noise: expected robust loss of a perfect model, from the cameras' noise; None if unknown.

    Raises:
        ParameterError: a frame is not in the video, or there is none to compare.
    """

    def __init__(
        self,
        measurement: Measurement,
        *,
        surface: HeightField,
        frames: Iterable[int],
        patch: float = PATCH,
        surroundings: Gaussians | None = None,
    ) -> None:
        self.measurement, self._surroundings = measurement, surroundings
        self.reference = int(measurement.frames[0])
        self.cameras = tuple(measurement.cameras)
        self.frames = tuple(sorted({int(f) for f in frames} - {self.reference}))
        unknown = [str(f) for f in self.frames if f not in measurement.frames]
        if unknown:
            raise ParameterError(f"the video has no frame {', '.join(unknown)}")
        if not self.frames:
            raise ParameterError("there is nothing to compare: name a frame after the first")
        self.keys: tuple[Key, ...] = tuple((c, f) for c in self.cameras for f in self.frames)
        self._views = {c: measurement.cameras[c].undistorted() for c in self.cameras}
        self.observed: dict[Key, Image] = {
            (c, f): measurement.video_frame(c, f).undistorted_image()
            for c in self.cameras
            for f in (self.reference, *self.frames)
        }
        self._relief = relief = _relief(surface)
        self.ground = self._places(relief, RISE * float(np.sort(measurement.tool.mesh.extents)[1]))
        self.bed = {c: np.isfinite(place[..., 0]) for c, place in self._places(relief, -1.0).items()}
        self.interior = {c: np.isfinite(place[..., 0]) for c, place in self.ground.items()}
        self._still = {
            c: [f.undistorted_image() for f in measurement.pre_roll if f.camera_name == c] for c in self.cameras
        }
        self.before = {c: np.mean([*self._still[c], self.observed[c, self.reference]], axis=0) for c in self.cameras}
        self.silhouettes = self._tool_silhouettes()
        self._tool_colour = {c: self._discriminant(c) for c in self.cameras}
        extent = measurement.bed.upper[:2] - measurement.bed.lower[:2]
        self.block: FloatArray = extent / np.maximum(np.round(extent / patch), 1.0)
        self.labels, self.patches = self._layout()
        self._unit = self._motionless()
        self.noise = self._noise()

    def compare(self, images: Mapping[Key, Image]) -> Comparison:
        """Compare predicted and observed pictures.

        Args:
            images: (h, w, 3) sRGB in [0, 1] by camera and frame of undistorted cameras, including the reference frame.

        Raises:
            ParameterError: a picture is missing or has another size.
        """
        losses, squares, means = {}, {}, []
        for camera, change, masks in self._changes(images):
            for frame, mask in zip(self.frames, masks, strict=True):
                difference = (self.observed[camera, frame] - images[camera, frame])[mask]
                squares[camera, frame] = float(np.mean(np.square(difference, dtype=np.float64))) if mask.any() else 0.0
            scaled = self._scaled_losses(camera, change, masks) / self._unit[camera]
            losses.update({(camera, f): float(v) for f, v in zip(self.frames, scaled.mean(axis=1), strict=True)})
            means.append(self._block_means(camera, change, masks))
        loss = float(np.mean(list(losses.values()))) if losses else math.nan
        return Comparison(loss, losses, squares, _in_order(means), self.labels)

    def blocks(self, images: Mapping[Key, Image]) -> FloatArray:
        """(b,) `Comparison.blocks` alone, in half the time; raises like ``compare``."""
        return _in_order([self._block_means(*changed) for changed in self._changes(images)])

    def _changes(self, images: Mapping[Key, Image]) -> Iterator[tuple[str, list[Image], list[BoolArray]]]:
        """Each camera with its (h, w, 3) observed minus predicted changes and compared pixels (h, w), by frame."""
        for key in (*self.keys, *((c, self.reference) for c in self.cameras)):
            if key not in images:
                raise ParameterError(f"the prediction has no picture of camera {key[0]!r} at frame {key[1]}")
            if images[key].shape != self.observed[key].shape:
                raise ParameterError(
                    f"camera {key[0]!r}, frame {key[1]}: the prediction is {images[key].shape}, "
                    f"the photograph {self.observed[key].shape}"
                )
        for camera in self.cameras:
            still = self.before[camera] - images[camera, self.reference]
            still[self._shows_tool(camera, self.reference, images[camera, self.reference])] = 0.0
            masks = [self.interior[camera] & ~self._shows_tool(camera, f, images[camera, f]) for f in self.frames]
            yield camera, [self.observed[camera, f] - images[camera, f] - still for f in self.frames], masks

    def against(self, images: Mapping[Key, Image]) -> Comparator:
        """The same comparison with these pictures, including the reference frame, in place of the photographs; their
        noise is unknown."""
        other = copy(self)
        other.observed = {key: images[key] for key in self.observed}
        other._still = {camera: [] for camera in self.cameras}
        other.before = {camera: images[camera, self.reference] for camera in self.cameras}
        other._tool_colour = {camera: other._discriminant(camera) for camera in self.cameras}
        other._unit = other._motionless()
        other.noise = None
        return other

    def open_shares(self) -> FloatArray:
        """(b,) share of each block's pixels outside the tool's silhouette, in the order of ``labels``."""
        out = []
        for camera in self.cameras:
            patch = self.patches[camera]
            blocks, known = int(patch.max()) + 1, patch >= 0
            pixels = np.bincount(patch[known], minlength=blocks)
            for frame in self.frames:
                free = known & ~self.silhouettes[camera, frame]
                out.append(np.bincount(patch[free], minlength=blocks) / np.maximum(pixels, 1))
        return np.concatenate([np.zeros(0), *out])

    def still_blocks(self) -> dict[str, FloatArray]:
        """(frames, blocks) noise of each camera in grey levels: a frame before the tool moves minus the mean of the
        other ones. A camera with fewer than two such frames is omitted."""
        return {camera: 255.0 * self._block_means(camera, *changed) for camera, changed in self._still_changes()}

    def block_noise(self) -> float:
        """Standard deviation of a block's change by the cameras' noise, in grey levels of 255; 0 if unknown."""
        # Noise of a later frame and of the mean of n still frames.
        variances = [float(np.mean(c**2)) * (1.0 - 1.0 / len(c) ** 2) for c in self.still_blocks().values()]
        return float(np.mean(variances)) ** 0.5 if variances else 0.0

    def _still_changes(self) -> Iterator[tuple[str, tuple[list[Image], list[BoolArray]]]]:
        """Each camera with its (h, w, 3) still frames minus the mean of the others, and compared pixels (h, w)."""
        for camera, still in self._still.items():
            frames = [*still, self.observed[camera, self.reference]]
            if len(frames) > 1:
                total = np.sum(frames, axis=0)
                mask = self.interior[camera] & ~self.silhouettes[camera, self.reference]
                yield camera, ([f - (total - f) / (len(frames) - 1) for f in frames], [mask] * len(frames))

    def pictures(self, images: Mapping[Key, Image], camera: str, frame: int) -> dict[str, Image]:
        """(h, w, 3) observed, predicted and their difference by these names; the difference is grey for equal pictures
        and scaled by `GAIN`."""
        observed, predicted = self.observed[camera, frame], images[camera, frame]
        difference = np.clip(0.5 + GAIN * (observed - predicted), 0.0, 1.0)
        return {"observed": observed, "predicted": predicted, "difference": difference.astype(np.float32)}

    def outlines(self, camera: str) -> FloatArray:
        """(blocks, 4, 2) corners of a camera's blocks on the undisturbed surface in its undistorted picture, as shares
        of width and height."""
        centres = np.array([(b.x, b.y) for b in self.labels if (b.camera, b.frame) == (camera, self.frames[0])])
        around = 0.5 * self.block * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        flat = (centres[:, None] + around).reshape(-1, 2)
        xy = torch.from_numpy(flat.astype(np.float32))
        height = self._relief.sample(self._relief.height, xy).numpy().astype(np.float64)
        view = self._views[camera]
        pixels, _ = view.project(np.column_stack([flat, height]))
        return (pixels / (view.width, view.height)).reshape(-1, 4, 2)

    def _places(self, relief: Relief, rise: float) -> dict[str, FloatArray]:
        """Position on the ground of each pixel, without a strip along the walls."""
        low, high = self.measurement.bed.lower[:2], self.measurement.bed.upper[:2]
        margin = min(MARGIN, 0.1 * float(np.min(high - low)))
        return {
            c: ground_of_pixels(relief, view, low + margin, high - margin, rise, self._surroundings)
            for c, view in self._views.items()
        }

    def _tool_silhouettes(self) -> dict[Key, BoolArray]:
        body, motion = ToolBody(self.measurement.tool.mesh), self.measurement.tool.motion
        out = {}
        for frame in (self.reference, *self.frames):
            pose = motion.pose(frame / self.measurement.frame_rate)
            for camera in self.cameras:
                shape = silhouette(body.at(*pose), self._views[camera]).numpy()
                out[camera, frame] = binary_dilation(shape, iterations=2)
        return out

    def _discriminant(self, camera: str) -> tuple[FloatArray, float] | None:
        """Linear discriminant (weights (2,), threshold) of tool and soil on log colour ratios, which do not depend on
        brightness; None if the colours are too similar."""
        shape = self.silhouettes[camera, self.reference]
        ratios = _log_ratios(self.before[camera])
        tool = ratios[binary_erosion(shape, iterations=4)]
        soil = ratios[self.bed[camera] & ~shape]
        if len(tool) < 20 or len(soil) < 20:
            return None
        spread = 0.5 * (np.cov(tool.T) + np.cov(soil.T)) + 1e-6 * np.eye(2)
        apart = tool.mean(axis=0) - soil.mean(axis=0)
        weights = np.linalg.solve(spread, apart)
        if float(np.sqrt(weights @ apart)) < _MIN_SEPARATION:
            return None
        return weights, float(weights @ (tool.mean(axis=0) + soil.mean(axis=0)) / 2)

    def _shows_tool(self, camera: str, frame: int, predicted: Image) -> BoolArray:
        """Pixels in which either picture shows the tool, dilated; its silhouette without a discriminant."""
        shape = self.silhouettes[camera, frame]
        rule = self._tool_colour[camera]
        if rule is None:
            return shape
        shown = np.zeros_like(shape)
        for image in (self.observed[camera, frame], predicted):
            shown[shape] |= _log_ratios(image[shape]) @ rule[0] > rule[1]
        return binary_dilation(shown, iterations=2)

    def _layout(self) -> tuple[tuple[Block, ...], dict[str, npt.NDArray[np.int64]]]:
        """Labels of all blocks, and by camera the block of each pixel, or -1."""
        low, size = self.measurement.bed.lower[:2], self.block
        count = np.round((self.measurement.bed.upper[:2] - low) / size).astype(int)
        labels: list[Block] = []
        patches = {}
        for camera in self.cameras:
            inside = self.interior[camera]
            cell = np.full((*inside.shape, 2), -1)
            cell[inside] = np.clip(((self.ground[camera][inside] - low) / size).astype(int), 0, count - 1)
            flat = np.where(inside, cell[..., 1] * count[0] + cell[..., 0], -1)
            pixels = np.bincount(flat[inside], minlength=int(np.prod(count)))
            kept = np.flatnonzero(pixels >= _MIN_PIXELS)
            number = np.full(int(np.prod(count)) + 1, -1)
            number[kept] = np.arange(len(kept))
            patches[camera] = number[flat]
            centres = low + (np.stack([kept % count[0], kept // count[0]], axis=1) + 0.5) * size
            labels += [Block(camera, f, float(x), float(y)) for f in self.frames for x, y in centres]
        return tuple(labels), patches

    def _block_means(self, camera: str, change: list[Image], masks: list[BoolArray]) -> FloatArray:
        """(frames, blocks) mean residual over the compared pixels of each block."""
        patch = self.patches[camera]
        blocks = int(patch.max()) + 1
        out = np.zeros((len(change), blocks))
        for k, (residual, mask) in enumerate(zip(change, masks, strict=True)):
            good = mask & (patch >= 0)
            count = np.bincount(patch[good], minlength=blocks)
            total = np.bincount(patch[good], residual.mean(axis=-1, dtype=np.float64)[good], minlength=blocks)
            out[k] = np.where(count >= _MIN_PIXELS / 2, total / np.maximum(count, 1), 0.0)
        return out

    def _scaled_losses(self, camera: str, change: list[Image], masks: list[BoolArray]) -> FloatArray:
        """(frames, scales) robust loss of residual changes before normalisation."""
        return robust_losses(change, masks, self._pixels_per_metre(camera))

    def _pixels_per_metre(self, camera: str) -> float:
        """Scale of the image at the middle of the bed."""
        view, point = self._views[camera], self.ground[camera]
        inside = point[self.interior[camera]]
        if len(inside) == 0:
            raise ParameterError(f"camera {camera!r} does not see the inside of the bed")
        middle = np.array([*inside.mean(axis=0), float(self.measurement.bed.lower[2])])
        return 0.5 * (view.fx + view.fy) / float(np.linalg.norm(middle - view.position))

    def _motionless(self) -> dict[str, FloatArray]:
        """(scales,) loss of a model without motion, by camera: the normalisation."""
        out = {}
        for camera in self.cameras:
            first = self.observed[camera, self.reference]
            hidden = self._shows_tool(camera, self.reference, first)
            masks = [self.interior[camera] & ~hidden & ~self._shows_tool(camera, f, first) for f in self.frames]
            change = [self.observed[camera, f] - self.before[camera] for f in self.frames]
            out[camera] = np.maximum(self._scaled_losses(camera, change, masks).mean(axis=0), 1e-12)
        return out

    def _noise(self) -> float | None:
        """Robust loss of the cameras' noise, from frames before the tool moves; None without these."""
        found = [
            float((self._scaled_losses(camera, *changed) / self._unit[camera]).mean())
            for camera, changed in self._still_changes()
        ]
        return float(np.mean(found)) if found else None


def _relief(surface: HeightField) -> Relief:
    """The surface; an unknown cell has the height of the nearest known one."""
    nearest = distance_transform_edt(~np.isfinite(surface.height), return_distances=False, return_indices=True)
    height = torch.from_numpy(surface.height[tuple(nearest)])
    return Relief.of_heights(height, (float(surface.x[0]), float(surface.y[0])), surface.cell)


def _in_order(means: list[FloatArray]) -> FloatArray:
    """(b,) mean residuals (frames, blocks) of all cameras, in grey levels, in the order of labels."""
    return np.asarray(255.0 * np.concatenate([np.zeros(0), *(m.reshape(-1) for m in means)]))


def _log_ratios(image: Image) -> FloatArray:
    """(…, 2) log red/green and blue/green: colour without brightness."""
    logs = np.log(np.maximum(image.astype(np.float64), 0.02))
    return np.stack([logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1]], axis=-1)
