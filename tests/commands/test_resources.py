"""What a run needs, told before it works, and refused where the machine hasn't it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands import _resources, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement
from splatsoil.reconstruction.filling import fill
from splatsoil.reconstruction.height_field import HeightField


def test_needs_follow_from_the_set(small_set: Path) -> None:
    import numpy as np

    measurement = Measurement.load(small_set)
    tiny, small = (_resources.needs(measurement, preset, "cpu", 10) for preset in ("tiny", "small"))
    # A bed that is full to its top is what `fill` fills.
    ends = [np.linspace(a, b, 9) for a, b in zip(measurement.bed.lower[:2], measurement.bed.upper[:2], strict=True)]
    x, y = (0.5 * (end[1:] + end[:-1]) for end in ends)
    full = HeightField(x, y, np.full((8, 8), float(measurement.bed.upper[2])))
    assert tiny.particles == pytest.approx(len(fill(full, measurement.bed, 0.02)), rel=0.1)
    # half the cell: eight times the particles, twice the substeps
    assert small.particles == pytest.approx(8 * tiny.particles, rel=1e-3)
    assert small.seconds == pytest.approx(16 * tiny.seconds, rel=1e-3)
    assert small.memory > tiny.memory > _resources.PROGRAM
    more = _resources.needs(measurement, "tiny", "cpu", 10, particles=10 * tiny.particles)
    assert more.simulation == pytest.approx(10 * tiny.simulation) and more.memory > tiny.memory
    on_gpu = _resources.needs(measurement, "tiny", "cuda:0", 10, particles=10 * tiny.particles)
    assert on_gpu.memory < more.memory and on_gpu.simulation == more.simulation


@pytest.mark.parametrize("preset", ["tiny", "fine"])
def test_what_a_fit_needs_is_said_and_refused_where_no_memory_holds_it(
    small_set: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    refused: Callable[..., str],
    preset: str,
) -> None:
    """Before anything is written."""
    options = FitOptions(small_set, preset="tiny", device="cpu", run=tmp_path / "run")
    monkeypatch.setattr(_resources, "memory", lambda: 0.5)
    said = refused("fit", small_set, "--preset", preset, "--device", "cpu", "--run", tmp_path / "run")
    assert "and this machine has 0.5 GiB; choose a coarser --preset" in said
    assert not (tmp_path / "run").exists()
    monkeypatch.undo()
    _stages.prepare(options)
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("needs up to ") and "(13500 particles, cpu), 30 simulations" in said


def test_soil_that_no_memory_holds_is_refused_before_it_is_simulated(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How much there is is known after the reconstruction."""
    options = FitOptions(small_set, preset="tiny", device="cpu", run=tmp_path / "run")
    measurement, run = _stages.prepare(options)
    soil = range(10**9)
    model: Any = SimpleNamespace(
        measurement=measurement, space=lambda names: ["friction_angle"], device="cpu", particles=lambda seed: soil
    )
    with pytest.raises(ParameterError, match=r"1000000000 particles, and the pictures, need \d+ GiB of memory"):
        _stages.run_fit(options, cast(RunFolder, run), model, lambda what, share: None)


def test_a_control_groups_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def read(path: Path) -> str:
        if str(path) == "/sys/fs/cgroup/memory.max":
            return f"{2**30}\n"
        raise FileNotFoundError

    whole = _resources.memory()
    monkeypatch.setattr(Path, "read_text", read)
    assert _resources.memory() == 1.0 <= whole
    monkeypatch.setattr(Path, "read_text", lambda path: "max\n")
    assert _resources.memory() >= whole
