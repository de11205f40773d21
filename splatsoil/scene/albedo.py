"""Albedo of the soil's Gaussians, of the particles beneath them and of the tool, from their colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
from scipy.spatial import cKDTree
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Camera, Frame
from splatsoil.scene.light import encoded, linear
from splatsoil.splats import rasterise_features

BRIGHTEST = 2.0
"""Largest linear albedo, in units of level sunlit soil's mean; only errors lie beyond."""

OUTLYING = 3.0
"""Standard deviations beyond which a place counts as no farther from the median."""

FOURIER_TERMS = 256
"""Of a random field, whose spectral representation is a sum of so many waves."""

LONGEST = 0.1
"""Blotches of albedo wider than this count as this wide, m."""

_FINE = 0.33
"""Cells of the surface's map, in particle spacings."""


def correlation_length(points: Tensor, values: Tensor, longest: float) -> float:
    """Distance at which the values' correlation has fallen to 1/e, m.

    Args:
        points: (n, 2) or (n, 3); x and y are used, m.
        values: (n,).
        longest: pairs farther apart than this are not looked at, and it is the answer where nothing falls, m.
    """
    xy = points[:, :2].cpu().numpy().astype(np.float64)
    v = values.cpu().numpy().astype(np.float64)
    v = v - v.mean()
    variance = float(np.mean(v * v))
    if variance < 1e-12 or len(v) < 10:
        return longest
    chosen = np.random.default_rng(0).permutation(len(v))[:2000]
    edges = np.linspace(0.0, longest, 21)
    total, count, tree = np.zeros(20), np.zeros(20), cKDTree(xy)
    for some in np.array_split(chosen, max(len(chosen) // 200, 1)):  # all pairs at once may fill the memory
        pairs = cKDTree(xy[some]).sparse_distance_matrix(tree, longest, output_type="ndarray")
        pairs = pairs[some[pairs["i"]] != pairs["j"]]
        bins = np.minimum((pairs["v"] / longest * 20).astype(int), 19)
        total += np.bincount(bins, v[some[pairs["i"]]] * v[pairs["j"]], 20)
        count += np.bincount(bins, minlength=20)
    correlation = total / np.maximum(count, 1.0) / variance
    known = count > 30
    centre = 0.5 * (edges[1:] + edges[:-1])
    fallen = np.flatnonzero(known & (correlation < np.exp(-1.0)))
    return float(centre[fallen[0]]) if fallen.size else longest


class SurfaceAlbedo:
    """Albedo of the undisturbed surface as a map over the bed, and its extrapolation to the soil beneath.

    Args:
        centres: (n, 3) the surface's Gaussians, m.
        albedo: (n, 3) theirs, linear.
        spacing: of the particles, m; the map is averaged over about a particle.
        low: (2,) or (3,) corner of the bed, m.
        high: the opposite corner.
        length: how deep blotches reach, m; their correlation length by default.

    Attributes:
        mean: (3,) linear, over the bed's area.
        length: m.
    """

    def __init__(
        self,
        centres: Tensor,
        albedo: Tensor,
        spacing: float,
        low: npt.ArrayLike,
        high: npt.ArrayLike,
        length: float | None = None,
    ) -> None:
        if length is None:
            length = correlation_length(centres, albedo.clamp_min(1e-3).log().mean(dim=1), LONGEST)
        self.length = length
        self._low = np.asarray(low, dtype=np.float64)[:2]
        self._extent = np.asarray(high, dtype=np.float64)[:2] - self._low
        count = np.maximum(np.ceil(self._extent / (_FINE * spacing)).astype(int), 2)
        x, y = (self._low[k] + (np.arange(count[k]) + 0.5) * self._extent[k] / count[k] for k in (0, 1))
        cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        k = min(16, len(centres))
        away, index = cKDTree(centres[:, :2].cpu().numpy()).query(cells, k=k, workers=torch.get_num_threads())
        distance = torch.from_numpy(away.reshape(len(cells), k)).to(albedo.device)
        weight = torch.exp(-0.5 * (distance.square() - distance[:, :1].square()) / (0.5 * spacing) ** 2).float()
        near = albedo[torch.from_numpy(index.reshape(len(cells), k)).to(albedo.device)]
        mean = (weight[..., None] * near).sum(dim=1) / weight.sum(dim=1, keepdim=True)
        self._map = mean.T.reshape(1, 3, int(count[1]), int(count[0])).contiguous()
        # Over the bed's area: Gaussians stand closer where the soil is dark or patterned.
        self.mean = self._map.mean(dim=(0, 2, 3))

    def above(self, points: Tensor) -> Tensor:
        """Linear albedo (p, 3) of the surface over points (p, 3), m."""
        low, extent = (torch.tensor(v.tolist(), device=points.device) for v in (self._low, self._extent))
        places = 2.0 * (points[:, :2] - low) / extent - 1.0
        found = functional.grid_sample(self._map, places[None, None], padding_mode="border", align_corners=False)
        return found[0, :, 0].T.contiguous()

    def beneath(self, points: Tensor, depth: Tensor) -> Tensor:
        """Expected linear albedo (p, 3) of soil at points (p, 3), m, at depths (p,) below the surface, m.

        The correlation is taken to fall with depth as it does along the surface. At a depth d the best linear
        prediction is the mean plus exp(−d/length) times the deviation of the surface above from it.
        """
        share = torch.exp(-depth.clamp_min(0.0) / self.length)[:, None]
        return self.mean + share * (self.above(points) - self.mean)


def sampled_albedo(
    grains: Tensor, depth: Tensor, expected: Tensor, above: Tensor, length: float, generator: np.random.Generator
) -> Tensor:
    """A random sample of the unknown albedo of buried soil.

    The expected albedo is multiplied with a log-normal random field of the surface's variance and an exponential
    correlation. At a depth d the share 1 − exp(−2 d/length) of the variance is unknown, as in `SurfaceAlbedo`.

    Args:
        grains: (p, 3) particles, m.
        depth: (p,) below the surface, m.
        expected: (p, 3) linear albedo from `SurfaceAlbedo.beneath`; its mean is kept.
        above: (p, 3) linear albedo of the surface above each.
        length: correlation length of the surface's albedo, m.
        generator: of the field.

    Returns:
        (p, 3) linear.
    """
    values, vectors = np.linalg.eigh(_log_covariance(above.cpu().numpy().astype(np.float64)))
    mixing = torch.from_numpy(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T).float().to(grains.device)
    field = torch.stack([_random_field(grains, length, generator) for _ in range(3)], dim=1) @ mixing
    open_variance = (1.0 - torch.exp(-2.0 * depth.clamp_min(0.0) / length))[:, None]
    variance = open_variance * mixing.square().sum(dim=0)
    return expected * torch.exp(open_variance.sqrt() * field - 0.5 * variance)


def _log_covariance(albedo: FloatArray) -> FloatArray:
    """(3, 3) covariance of the logarithm of albedo (n, 3), of which walls and tool may have spoilt a part."""
    logs = np.log(np.maximum(albedo, 1e-3))
    logs -= np.median(logs, axis=0)
    most = OUTLYING * 1.4826 * np.median(np.abs(logs), axis=0)
    return np.asarray(np.cov(np.clip(logs, -most, most).T), dtype=np.float64)


def _random_field(points: Tensor, length: float, generator: np.random.Generator) -> Tensor:
    """(n,) Gaussian field of variance 1 and correlation exp(-distance/length) at points (n, 3), m: a sum of waves."""
    # exp(-|x|) in space is the characteristic function of Cauchy's distribution there
    waves = (
        generator.standard_normal((FOURIER_TERMS, 3)) / np.abs(generator.standard_normal((FOURIER_TERMS, 1))) / length
    )
    phases = generator.uniform(0.0, 2.0 * np.pi, FOURIER_TERMS)
    turns, starts = (torch.from_numpy(a).float().to(points.device) for a in (waves.T.copy(), phases))
    return math.sqrt(2.0 / FOURIER_TERMS) * torch.cos(points @ turns + starts).sum(dim=1)


def refined(
    centres: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    albedo: Tensor,
    targets: Sequence[tuple[Camera, Tensor, Tensor]],
) -> Tensor:
    """Albedo by which the drawn Gaussians agree better with unlit photographs.

    The drawn colour is linear in the Gaussians' colours. Every Gaussian is moved by the mean of the residuals of the
    pixels it shows in, weighted by how much (a step of simultaneous algebraic reconstruction; a second one changes
    pictures by less than cameras' noise); one that shows nowhere keeps what it has.

    Args:
        centres: (n, 3) m; covariances: (n, 3, 3) m²; opacities: (n,): every Gaussian that is drawn.
        albedo: (n, 3) sRGB-encoded, the start.
        targets: camera, unlit photograph (h, w, 3) encoded like the albedo, weight (h, w) of its pixels.
    """
    push, weight = torch.zeros_like(albedo), albedo.new_zeros(len(albedo), 1)
    for camera, target, mask in targets:
        features = functional.pad(albedo, (0, 1), value=1.0).requires_grad_()
        with torch.enable_grad():
            image, alpha = rasterise_features(centres, covariances, opacities, features, camera, antialias=True)
        covered = alpha.detach().clamp_min(1e-3)[..., None]
        residual = (target - image[..., :3].detach() / covered) * mask[..., None]
        # of a number: for the gradient of a picture torch would load half a thousand modules
        with torch.enable_grad():
            pulled = (image * torch.cat([residual, mask[..., None]], dim=2)).sum()
        (gradient,) = torch.autograd.grad(pulled, features)
        push += gradient[:, :3]
        weight += gradient[:, 3:]
    return (albedo + push / (weight + 0.5)).clamp(0.0, encoded(torch.tensor(BRIGHTEST)).item())


def tool_albedo(frames: Sequence[Frame], lit_tool: Callable[[Camera], Tensor]) -> FloatArray:
    """Linear albedo (3,) of the tool, one for all of it: the median over the pixels that show nothing else.

    Args:
        frames: photographs.
        lit_tool: for a camera, (h, w, 4): the radiance of a white tool times its share of each pixel, and that share.
    """
    found = []
    for frame in frames:
        white = lit_tool(frame.camera.undistorted())
        whole = white[..., 3] > 0.99
        image = linear(torch.from_numpy(np.ascontiguousarray(frame.undistorted_image())))
        found.append(image[whole.cpu()] / white[..., :3][whole].cpu().clamp_min(1e-2))
    pixels = torch.cat(found)
    if len(pixels) == 0:
        return np.full(3, 0.5)
    return pixels.median(dim=0).values.numpy().astype(np.float64)
