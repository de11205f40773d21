"""The photographs as one batch of tensors, free of distortion, with a mask of valid pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_closing, binary_dilation

from splatsoil.errors import MeasurementError
from splatsoil.measurement import Camera, Frame, Measurement

Array = NDArray[np.float64]
Picture = NDArray[np.float32]


@dataclass(frozen=True)
class Views:
    """A batch of undistorted photographs. Smaller pictures are padded to the largest; `valid` is 0 on the padding.

    Attributes:
        images: (v, 3, h, w) float32 sRGB in [0, 1].
        valid: (v, h, w) float32, 1 where the pixel may be used (not padding, not masked, not beyond the lens's edge).
        projection: (v, 3, 4) float32, world point -> homogeneous pixel; the third row is the depth along z.
        positions: (v, 3) float32 camera centres.
        cameras: the undistorted cameras.
        names: the pictures' file names.
    """

    images: torch.Tensor
    valid: torch.Tensor
    projection: torch.Tensor
    positions: torch.Tensor
    cameras: tuple[Camera, ...]
    names: tuple[str, ...]

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        pictures: Sequence[Picture],
        masks: Sequence[NDArray[np.bool_]],
        names: Sequence[str],
    ) -> Views:
        """Pictures (h, w, 3) by cameras free of distortion, and where they may be used (h, w)."""
        size = [max(side) for side in zip(*(mask.shape for mask in masks), strict=True)]
        projections = np.stack([camera.intrinsics @ camera.world_to_camera[:3] for camera in cameras])
        return cls(
            images=torch.stack([_padded(torch.from_numpy(p).permute(2, 0, 1), size) for p in pictures]).contiguous(),
            valid=torch.stack([_padded(torch.from_numpy(m).to(torch.float32), size) for m in masks]),
            projection=torch.tensor(projections, dtype=torch.float32),
            positions=torch.tensor(np.stack([camera.position for camera in cameras]), dtype=torch.float32),
            cameras=tuple(cameras),
            names=tuple(names),
        )

    def __len__(self) -> int:
        return len(self.cameras)

    def to(self, device: torch.device | str) -> Views:
        """The same on a device."""
        moved = {name: getattr(self, name).to(device) for name in ("images", "valid", "projection", "positions")}
        return replace(self, **moved)

    def subset(self, indices: Sequence[int]) -> Views:
        """The views at the given places, in that order."""
        index = torch.as_tensor(list(indices), dtype=torch.long, device=self.images.device)
        return Views(
            self.images[index],
            self.valid[index],
            self.projection[index],
            self.positions[index],
            tuple(self.cameras[i] for i in indices),
            tuple(self.names[i] for i in indices),
        )

    def joined(self, other: Views) -> Views:
        """These views, then the other ones."""
        size = [max(a, b) for a, b in zip(self.valid.shape[1:], other.valid.shape[1:], strict=True)]
        return Views(
            torch.cat([_padded(v.images, size) for v in (self, other)]),
            torch.cat([_padded(v.valid, size) for v in (self, other)]),
            torch.cat([self.projection, other.projection]),
            torch.cat([self.positions, other.positions]),
            self.cameras + other.cameras,
            self.names + other.names,
        )

    def merged(self, groups: Sequence[Sequence[int]]) -> Views:
        """One view for each group of views of the same camera in the same place: the mean of their pictures."""
        chosen = self.subset([group[0] for group in groups])
        images = torch.stack([self.images[list(group)].mean(dim=0) for group in groups])
        valid = torch.stack([self.valid[list(group)].amin(dim=0) for group in groups])
        return replace(chosen, images=images, valid=valid)

    def photograph(self, index: int) -> torch.Tensor:
        """(h, w, 3) one photograph at its own size."""
        camera = self.cameras[index]
        return self.images[index, :, : camera.height, : camera.width].permute(1, 2, 0)

    @property
    def noise(self) -> float:
        """Standard deviation of the pixel noise (sRGB in [0, 1]), by the median absolute second difference.

        Immerkær's operator (CVIU 64, 1996) with a median in place of the mean, so that edges do not count.
        """
        grey = self.images.mean(dim=1)
        operator = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], device=grey.device)
        response = torch.nn.functional.conv2d(grey[:, None], operator[None, None])
        grey_noise = float(response.abs().median()) / 0.6745 / 6.0
        return max(grey_noise * 3.0**0.5, 1.0 / 255.0)


def _shrink(image: Picture, width: int, height: int) -> Picture:
    """An image (h, w) or (h, w, channels) area-averaged to another size: a box filter, exact for any ratio."""
    if image.ndim == 3:
        return np.stack([_shrink(channel, width, height) for channel in np.moveaxis(image, -1, 0)], axis=-1)
    whole = Image.fromarray(np.ascontiguousarray(image), mode="F")
    return np.asarray(whole.resize((width, height), Image.Resampling.BOX))


def load_views(frames: Sequence[Frame], longest_side: int) -> Views:
    """Read, undistort and, where a side is longer than `longest_side` pixels, shrink the photographs.

    Raises:
        MeasurementError: there are no photographs.
    """
    if not frames:
        raise MeasurementError("there are no photographs to reconstruct from", field="views")
    pictures, masks, cameras = [], [], []
    for frame in frames:
        camera = frame.camera.undistorted()
        image, seen = frame.undistorted_image(), frame.undistorted_mask().astype(np.float32)
        factor = longest_side / max(camera.width, camera.height)
        if factor < 1.0:
            camera = camera.scaled(factor)
            image, seen = (_shrink(values, camera.width, camera.height) for values in (image, seen))
        pictures.append(image)
        masks.append(seen > 0.999)
        cameras.append(camera)
    return Views.of(cameras, pictures, masks, [frame.path.name for frame in frames])


def still_video(measurement: Measurement, longest_side: int) -> Views | None:
    """What each fixed camera sees before anything moves, the mean of its frames up to number 0; None without any."""
    still = [f for f in measurement.video if f.frame is not None and f.frame <= 0]
    if not still:
        return None
    groups: dict[str, list[int]] = {}
    for k, frame in enumerate(still):
        groups.setdefault(frame.camera_name, []).append(k)
    return load_views(still, longest_side).merged(list(groups.values()))


def _padded(values: torch.Tensor, size: Sequence[int]) -> torch.Tensor:
    """Maps (..., h, w) with zeros to the right and below, up to a size (rows, columns)."""
    return torch.nn.functional.pad(values, (0, size[1] - values.shape[-1], 0, size[0] - values.shape[-2]))


def silhouettes(views: Views, mesh: trimesh.Trimesh, margin: int = 2) -> torch.Tensor:
    """(v, h, w) float32, 1 where a mesh in world coordinates covers the picture, grown by `margin` pixels.

    Points sampled on its faces, closer together than half a pixel in the nearest view, are projected; so any mesh will
    do.
    """
    height, width = views.images.shape[-2:]
    result = np.zeros((len(views), height, width), dtype=np.float32)
    centre, reach = mesh.bounds.mean(axis=0), float(np.ptp(mesh.bounds, axis=0).max())
    footprint = min(
        (max(float(np.linalg.norm(c.position - centre)) - reach, 1e-3) / max(c.fx, c.fy) for c in views.cameras),
        default=reach,
    )
    points, _ = surface_points(mesh, max(0.7 * footprint, (mesh.area / 400_000) ** 0.5))
    for k, camera in enumerate(views.cameras):
        pixels, depth = camera.project(points)
        whole = np.floor(np.nan_to_num(pixels, nan=-1.0)).astype(int)
        seen = (depth > 0) & (whole >= 0).all(1) & (whole[:, 0] < camera.width) & (whole[:, 1] < camera.height)
        mask = np.zeros((height + 8, width + 8), dtype=bool)
        mask[whole[seen, 1] + 4, whole[seen, 0] + 4] = True
        mask = binary_closing(mask, iterations=2)
        if margin:
            mask = binary_dilation(mask, structure=np.ones((3, 3)), iterations=margin)
        result[k] = mask[4:-4, 4:-4]
    return torch.from_numpy(result)


def surface_points(mesh: trimesh.Trimesh, spacing: float) -> tuple[Array, NDArray[np.int64]]:
    """(n, 3) points no farther than about `spacing` metres apart that cover a mesh, and (n,) the faces they lie on.

    The faces are split until their edges are that short; the points are the pieces' centres.
    """
    vertices, faces, origin = trimesh.remesh.subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=1.4 * spacing, max_iter=30, return_index=True
    )
    return vertices[faces].mean(axis=1), np.asarray(origin)
