"""A run folder with a finished fit, which nothing was simulated for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands import _experiments, _stages


@pytest.fixture
def fit_of() -> Callable[..., dict[str, Any]]:
    """Makes what ``fit.json`` holds of a model with some effects, by the sources as they are."""

    def make(effects: Sequence[str] = (), **values: float) -> dict[str, Any]:
        version, code = _stages.sources(effects)
        estimates = {"friction_angle": 35.0, **values}
        return {
            "format": "splatsoil-fit/2",
            "name": "+".join(sorted(effects)) or "base",
            "loss": 0.5,
            "loss_std": 0.1,
            "best": {"loss": 0.5},
            "evaluations": 10,
            "parameters": {
                name: {
                    "estimate": value,
                    "std": 1.0,
                    "unit": "1",
                    "title": name,
                    "bounds": [value - 10.0, value + 10.0],
                    "at_bound": None,
                    "off": None,
                }
                for name, value in estimates.items()
            },
            "minimum": {name: {"estimate": v, "low": v - 1.0, "high": v + 1.0} for name, v in estimates.items()},
            "history": [],
            "setup": {"effects": sorted(effects), "preset": "tiny", "version": version, "code": code},
        }

    return make


@pytest.fixture
def run(tmp_path: Path, fit_of: Callable[..., dict[str, Any]]) -> RunFolder:
    """The run, in a folder whose name a shell would split."""
    measurement = {"name": "plow", "folder": str(tmp_path / "my set"), "hash": "a" * 64}
    made = RunFolder.prepare(tmp_path / "my run", measurement=measurement, preset="tiny", seed=0, version="1")
    made.write_fit("base", fit_of())
    return made


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever begins to work, fails."""
    for place, name in ((_experiments, "model_of"), (_stages, "reconstructed"), (_stages, "fitted")):
        monkeypatch.setattr(place, name, lambda *_, **__: pytest.fail("work has begun"))
