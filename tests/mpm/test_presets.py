"""What a preset makes of a measurement set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution


@pytest.mark.parametrize("name", PRESETS)
def test_a_faster_tool_loses_as_much_soil_on_its_way(name: str, plow_dry: Path) -> None:
    """Dry sand that is pushed slowly doesn't know how fast: rates follow the tool, soil gives way to it by its way, and
    steps go no farther."""
    slow = Measurement.load(plow_dry)
    motion = slow.tool.motion
    start = motion.positions[0]
    quick = replace(motion, positions=start + 3.0 * (motion.positions - start))
    sets = (slow, replace(slow, tool=replace(slow.tool, motion=quick)))
    before, after = (Resolution.derive(measurement, name) for measurement in sets)
    assert before.give > 0.0
    assert after.give == before.give
    assert after.relaxation == pytest.approx(3.0 * before.relaxation)
    for measurement, resolution in zip(sets, (before, after), strict=True):
        speed = np.linalg.norm(np.diff(measurement.tool.motion.positions, axis=0), axis=1) * slow.frame_rate
        assert speed.max() * resolution.frame_time / resolution.steps <= 1.001 * PRESETS[name].transport * before.cell
