"""Illumination and albedo on file: their estimate takes seconds and depends on no parameter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError, RunError
from splatsoil.files import read_npz, write_npz
from splatsoil.scene.light import Light
from splatsoil.scene.render import Scene


@dataclass(frozen=True)
class Intrinsic:
    """A scene's intrinsic decomposition: illumination and albedo.

    Attributes:
        light: sun and sky.
        soil: (s, 3) float32, sRGB-encoded albedo of the reconstruction's soil Gaussians.
        grains: (p, 3) float32, of the particles.
        tool: (3,) linear.
    """

    light: Light
    soil: npt.NDArray[np.float32]
    grains: npt.NDArray[np.float32]
    tool: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> Intrinsic:
        """A scene's."""
        soil, grains = (t.detach().cpu().numpy() for t in (scene.soil_albedo, scene.grain_albedo))
        return cls(scene.light, soil, grains, scene.tool_albedo)

    @classmethod
    def load(cls, path: Path) -> Intrinsic:
        """From a file that `save` wrote.

        Raises:
            RunError: it can't be read.
        """
        names = ("direction", "ambient", "level", "soil", "grains", "tool")
        kept = read_npz(path, names, remedy="delete it, it will be made anew")
        try:
            light = Light(kept["direction"], kept["ambient"], kept["level"])
        except (TypeError, ValueError, ParameterError) as error:
            raise RunError(f"{path}: holds no light ({error}); delete it, it will be made anew") from error
        return cls(light, kept["soil"], kept["grains"], kept["tool"])

    def save(self, path: Path) -> None:
        """Write a NumPy archive, whole or not at all.

        Raises:
            RunError: the folder can't be written to.
        """
        light = {name: getattr(self.light, name) for name in ("direction", "ambient", "level")}
        write_npz(path, soil=self.soil, grains=self.grains, tool=self.tool, **light)

    def coloured(self, scene: Scene) -> Scene:
        """A scene of as many Gaussians and particles with this albedo.

        Raises:
            ParameterError: it has others.
        """
        for name, mine, its in (("soil", self.soil, scene.soil_albedo), ("grains", self.grains, scene.grain_albedo)):
            if mine.shape != tuple(its.shape):
                raise ParameterError(f"albedo of {name} has shape {mine.shape}, the scene {tuple(its.shape)}")
        soil, grains = (torch.from_numpy(a).to(scene.device) for a in (self.soil, self.grains))
        return scene.replace(soil_albedo=soil, grain_albedo=grains, tool_albedo=self.tool)
