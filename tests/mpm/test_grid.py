"""The grid's cells against exact fractions."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from splatsoil.mpm.grid import HEADROOM, GridShape


def rounded(value: Fraction) -> tuple[float, ...]:
    """A length, and what it may come back as: from single precision, and from a step or two of arithmetic."""
    exact, single = float(value), np.float32(float(value))
    near = [math.nextafter(exact, 0.0), math.nextafter(exact, math.inf)]
    near += [float(np.nextafter(single, np.float32(end))) for end in (0.0, np.inf)]
    return (exact, float(single), *near)


@pytest.mark.parametrize("tool", ["0.12", "0.1", "0.16", "0.07"])
@pytest.mark.parametrize("halves", [1, 5, 24, 25, 27, 80, 399])
def test_halves_of_a_cell_and_whole_ones_come_to_the_same_grid_however_they_are_rounded(tool: str, halves: int) -> None:
    cell = Fraction(tool) / 3
    side, height = cell * halves / 2, cell * halves
    # Of two whole numbers as near, the odd one.
    across = next(n for n in (halves // 2, halves // 2 + 1) if n % 2) if halves % 2 else halves // 2
    expected = (across, halves + HEADROOM)
    for width in rounded(Fraction(tool)):
        for a, b in zip(rounded(side), rounded(height), strict=True):
            shape = GridShape.covering([0.0, 0.0, 0.0], [a, side, b], width / 3.0)
            assert shape.nodes == (expected[0] + 1, expected[0] + 1, expected[1] + 1)
            assert shape.cell[0] * expected[0] == pytest.approx(a, rel=1e-12)


def test_what_is_more_than_rounding_off_a_half_goes_to_the_nearest_whole() -> None:
    for sides, cells in ((12.4999, 12), (12.5001, 13), (0.2, 1)):
        shape = GridShape.covering([0.0, 0.0, 0.0], [0.04 * sides, 0.4, 0.2001], 0.04)
        assert shape.nodes == (cells + 1, 11, 6 + HEADROOM + 1)
