"""Gaussians to and from the ``.ply`` layout of the reference 3-D Gaussian splatting code, which common viewers open.

One binary little-endian ``vertex`` element of float32 properties, in this order: ``x y z nx ny nz f_dc_0..2
f_rest_0..44 opacity scale_0..2 rot_0..3``. Normals are zero, opacity is a logit, scales are natural logarithms of
standard deviations, ``rot`` is wxyz and need not be normalised, colour is 0.5 + Y00·f_dc; ``f_rest`` (view-dependent
terms) is zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from splatsoil.errors import MeasurementError
from splatsoil.splats.gaussians import Gaussians

SH_C0 = 0.28209479177387814
"""Y00, the constant spherical harmonic 1/(2√π)."""

_POSITION = ["x", "y", "z"]
_NORMAL = ["nx", "ny", "nz"]
_DC = [f"f_dc_{i}" for i in range(3)]
_REST = [f"f_rest_{i}" for i in range(45)]
_SCALE = [f"scale_{i}" for i in range(3)]
_ROTATION = [f"rot_{i}" for i in range(4)]
_LAYOUT = [*_POSITION, *_NORMAL, *_DC, *_REST, "opacity", *_SCALE, *_ROTATION]


def save_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians to ``path``; opacities of 0 and 1 and scales of 0 are moved to where logarithms are finite."""
    vertices = np.zeros(len(gaussians), dtype=[(name, "<f4") for name in _LAYOUT])
    g = gaussians.detach().to("cpu")
    opacities = g.opacities.double().clamp(1e-6, 1 - 1e-6)
    columns = {
        **dict(zip(_POSITION, g.means.T, strict=True)),
        **dict(zip(_DC, (g.colours.T - 0.5) / SH_C0, strict=True)),
        "opacity": torch.logit(opacities),
        **dict(zip(_SCALE, g.scales.double().clamp_min(1e-12).log().T, strict=True)),
        **dict(zip(_ROTATION, g.quaternions.T, strict=True)),
    }
    for name, column in columns.items():
        vertices[name] = column.numpy()
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))


def load_ply(path: str | Path) -> Gaussians:
    """Read Gaussians (CPU, float32); view-dependent terms (``f_rest``) and extra properties are ignored.

    Raises:
        MeasurementError: the file is missing, no ``.ply``, lacks a property, or holds numbers that are not finite.
    """
    try:
        data = PlyData.read(str(path))
    except (OSError, PlyParseError, ValueError) as error:
        raise MeasurementError(f"cannot be read as a .ply file ({error}); give a 3DGS .ply", file=path) from error
    if "vertex" not in data:
        raise MeasurementError("has no vertex element; give a 3DGS .ply", file=path)
    vertices = data["vertex"].data
    for name in [*_POSITION, *_DC, "opacity", *_SCALE, *_ROTATION]:
        if name not in (vertices.dtype.names or ()):
            raise MeasurementError(
                "this property is missing; give a 3DGS .ply, not a plain mesh", file=path, field=name
            )

    def columns(names: list[str]) -> torch.Tensor:
        table = np.stack([np.asarray(vertices[name], dtype=np.float64) for name in names], axis=1)
        if not np.isfinite(table).all():
            raise MeasurementError("contains values that are not finite", file=path, field=names[0])
        return torch.from_numpy(table)

    return Gaussians(
        means=columns(_POSITION).float(),
        scales=columns(_SCALE).exp().float(),
        quaternions=columns(_ROTATION).float(),
        opacities=torch.sigmoid(columns(["opacity"]))[:, 0].float(),
        colours=(0.5 + SH_C0 * columns(_DC)).float(),
    )
