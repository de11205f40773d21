"""What a run needs, told before it works, and refused where the machine hasn't it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
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
    assert said.startswith("needs up to ") and "(13500 particles, cpu), 30 simulations, " in said


def test_a_frame_far_after_the_others_is_remarked_on_and_its_time_said_or_refused(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    """A number with a digit too many, and one that is a time in Unix's nanoseconds."""
    file = small_set / "video" / "transforms.json"
    video = json.loads(file.read_text())
    rate = json.loads((small_set / "experiment.json").read_text())["frame_rate"]
    for frame in video["frames"][-2:]:
        frame |= {"frame": 1000, "time": 1000 / rate}
    file.write_text(json.dumps(video))
    assert cli.main(["check", str(small_set)]) == 0
    assert "does not cover" in capsys.readouterr().out
    late = Measurement.load(small_set)
    need = _resources.needs(late, "tiny", "cpu", 10)
    assert need.seconds == pytest.approx(100 * _resources.needs(_until(late, 10), "tiny", "cpu", 10).seconds)
    for frame in video["frames"][-2:]:
        frame |= {"frame": 10**9, "time": 10**9 / rate}
    file.write_text(json.dumps(video))
    assert cli.main(["check", str(small_set)]) == 0
    said = refused("fit", small_set, "--preset", "tiny", "--device", "cpu", "--run", tmp_path / "run")
    assert "30 simulations to frame 1000000000 take" in said and not (tmp_path / "run").exists()


def _until(measurement: Measurement, last: int) -> Measurement:
    """The set without later frames, which are numbered anew."""
    return replace(measurement, video=tuple(replace(f, frame=min(f.frame or 0, last)) for f in measurement.video))


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
