"""Photographs -> Gaussians -> surface -> particles."""

from splatsoil.reconstruction.filling import fill, volume
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.pipeline import reconstruct
from splatsoil.reconstruction.presets import PRESETS, Preset
from splatsoil.reconstruction.result import HeldOut, Reconstruction
from splatsoil.reconstruction.surface import soil_mesh

__all__ = [
    "PRESETS",
    "HeightField",
    "HeldOut",
    "Preset",
    "Reconstruction",
    "fill",
    "reconstruct",
    "soil_mesh",
    "volume",
]
