"""The light's benchmark: what it holds an estimate against, and what it says."""

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks.light import Score, main, table, true_light

from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.synthetic import Appearance


def _told(folder: Path, truth: object) -> Path:
    folder.mkdir()
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


def test_the_true_share_is_what_the_sky_gives_to_level_ground(tmp_path: Path) -> None:
    look = Appearance.drawn(7)
    direction, share = true_light(_told(tmp_path / "simulated", {"appearance": asdict(look)}))
    rise, turn = math.radians(look.elevation), math.radians(look.azimuth)
    assert direction == pytest.approx(
        [math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)]
    )
    # Sun and sky are tinted, so that there is more sky in blue and less in red than their green says.
    assert share[1] == pytest.approx(look.sky_share)
    assert share[0] < share[1] < share[2]


def test_sealed_worlds_tell_their_looks_by_seed(tmp_path: Path) -> None:
    direction, share = true_light(_told(tmp_path / "hidden", {"hidden": "nothing", "seed": 7}))
    again = true_light(_told(tmp_path / "simulated", {"appearance": asdict(Appearance.drawn(7))}))
    assert np.array_equal(direction, again[0])
    assert np.array_equal(share, again[1])


def test_a_set_without_told_light_and_worlds_without_a_folder_are_mistakes(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="tells nothing of the light"):
        main([str(_told(tmp_path / "other", {"phi": 36.0}))])
    with pytest.raises(MeasurementError, match="tells nothing of the light"):
        true_light(tmp_path)
    with pytest.raises(ParameterError, match="--out"):
        main([])


def test_the_table_ends_in_root_mean_squares() -> None:
    told = table([Score("a", 3.0, 0.3, 0.03), Score("b", 4.0, 0.4, -0.04)])
    assert told.splitlines()[-1] == "| root mean square | 3.54° | | 0.035 |"
    assert "| b | 4.00° | 0.400 | -0.040 |" in told


@pytest.mark.slow
def test_the_light_of_a_made_up_world_is_read(tmp_path: Path) -> None:
    """Photographed by the path tracer, reconstructed, and read as any fit does it."""
    assert main(["--count", "1", "--seed", "3", "--preset", "tiny", "--out", str(tmp_path)]) == 0
    (found,) = json.loads((tmp_path / "result.json").read_text())["sets"]
    assert found["turned"] < 2.0
    assert abs(found["off"]) < 0.05
    assert found["share"] == pytest.approx(Appearance.drawn(3).sky_share)
