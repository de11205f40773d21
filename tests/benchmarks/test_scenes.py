"""``splatsoil benchmark scenes``: what it reports of a run, and that what is there is not made again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from splatsoil.benchmarks import scenes
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.errors import RunError
from splatsoil.files import write_json
from splatsoil.reconstruction import Reconstruction
from splatsoil.reconstruction.pipeline import no_gaussians
from splatsoil.reconstruction.result import HeldOut
from splatsoil.reconstruction.surface import soil_mesh


def test_a_surface_2_mm_too_high_and_a_fit_at_a_bound_are_reported(
    run: RunFolder, fit_of: Callable[..., dict[str, Any]]
) -> None:
    setup, none = scenes.scene("open"), torch.zeros(0, dtype=torch.bool)
    surface = replace(setup.surface, height=setup.surface.height + 0.002)
    mesh = soil_mesh(surface, setup.bed)
    Reconstruction(no_gaussians(), none, none, surface, mesh, (0.0, 0.0, 0.0), ()).save(run.reconstruction)
    fit = fit_of()
    write_json(run.comparison / "misfit.json", {"adequate": False})
    run.write_fit("base", fit)
    row = scenes.found(run.path, "open")
    assert row["surface"] == pytest.approx(2.0, abs=1e-3) and row["surface_median"] == pytest.approx(2.0, abs=1e-3)
    angle = fit["parameters"]["friction_angle"]
    text = scenes.table([row])
    assert f"{angle['estimate']:.1f} ± {angle['std']:.1f}°" in text and "not adequate" in text
    fit["parameters"]["friction_angle"] |= {"at_bound": "upper", "bounds": [20.0, 50.0]}
    run.write_fit("base", fit)
    text = scenes.table([scenes.found(run.path, "open")])
    assert "ends at the upper bound" in text and "±" not in text


def test_what_is_there_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    makes = True

    def make_set(place: Path, *_: object) -> None:
        asked.append("set")
        write_json(place / "truth.json", {})

    def command(words: list[str], **_: object) -> SimpleNamespace:
        asked.append(words[3])
        if makes:
            write_json(Path(words[words.index("--run") + 1]) / "comparison" / "misfit.json", {})
        return SimpleNamespace(returncode=2)

    monkeypatch.setattr(scenes, "make_set", make_set)
    monkeypatch.setattr("subprocess.run", command)
    for _ in range(2):
        assert scenes.answered("heap", "tiny", "cpu", tmp_path) == tmp_path / "runs" / "heap"
    assert asked == ["set", "run"]
    makes = False
    with pytest.raises(RunError, match="exit code 2 before"):
        scenes.answered("bin", "tiny", "cpu", tmp_path)


def test_the_published_scene_is_held_against_its_formula(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setup, none = scenes.paper(), torch.zeros(0, dtype=torch.bool)
    surface = replace(setup.surface, height=setup.surface.height - 0.003)
    aside = tuple(HeldOut("a.jpg", psnr, 0.9, 25.0) for psnr in (30.0, 34.0))
    black = (0.0, 0.0, 0.0)
    made = Reconstruction(no_gaussians(), none, none, surface, soil_mesh(surface, setup.bed), black, aside)
    monkeypatch.setattr(scenes, "reconstructed", lambda *_: made)
    text = scenes.table_of_published(scenes.published(small_set, "tiny", "cpu", tmp_path))
    assert "| `tiny` | 32.0 dB (30.0 to 34.0) | 25.0 dB | 3.0; 3.0 mm |" in text
