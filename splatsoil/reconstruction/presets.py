"""Presets of the reconstruction's resolution and effort."""

from __future__ import annotations

from dataclasses import dataclass

from splatsoil.errors import ParameterError


@dataclass(frozen=True)
class Preset:
    """Sizes and counts.

    Attributes:
        longest_side: photographs with a longer side are shrunk to it, pixels.
        cells: about how many cells the height field has.
        soil_spacing: distance between the soil's first Gaussians, in cells.
        iterations: training steps, one photograph each.
        growth: at most this many times the first Gaussians after densification.
        candidates: heights tried in the first sweep.
    """

    longest_side: int
    cells: int
    soil_spacing: float
    iterations: int
    growth: float
    candidates: int


PRESETS = {
    "tiny": Preset(160, 1_500, 1.0, 120, 1.3, 31),
    "small": Preset(400, 16_000, 1.2, 700, 1.5, 51),
    "paper": Preset(800, 40_000, 1.0, 5_000, 2.0, 81),
    "fine": Preset(1600, 100_000, 1.0, 20_000, 3.0, 121),
}


def preset_named(name: str) -> Preset:
    """The preset of that name.

    Raises:
        ParameterError: there is none.
    """
    if name not in PRESETS:
        raise ParameterError(f"there is no preset {name!r} of the reconstruction; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
