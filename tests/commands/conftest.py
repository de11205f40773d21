"""A run folder with a finished fit, which nothing was simulated for, and sets that are quickly simulated."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import __version__
from splatsoil.commands import _model, _stages
from splatsoil.files import code_of, write_json


@pytest.fixture
def fit_of() -> Callable[..., dict[str, Any]]:
    """Makes what ``fit.json`` holds of a model with some effects, by the sources as they are."""

    def make(effects: Sequence[str] = (), **values: float) -> dict[str, Any]:
        estimates = {"friction_angle": 35.0, **values}
        setup = {"effects": sorted(effects), "preset": "tiny", "device": "cpu", "version": __version__}
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
            "setup": {**setup, "code": code_of(effects)},
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
    for place, name in ((_model, "model_of"), (_model, "reconstructed"), (_stages, "run_fit")):
        monkeypatch.setattr(place, name, lambda *_, **__: pytest.fail("work has begun"))


MISFIT = {
    "adequate": True,
    "probability": 0.9,
    "passes": True,
    "checks": [],
    "sentences": [],
    "estimates": {"friction_angle": {"value": 35.1, "std": 2.8, "unit": "deg", "determined": True}},
}
DIAGNOSIS = {
    **MISFIT,
    "fit": "base",
    "verdict": "adequate",
    "class": [],
    "models": [],
    "notes": [],
    "held_out": [{"model": ""}],
    "simulations": 1,
    "simulated_now": 0,
    "seconds": 1.0,
}


@pytest.fixture
def results(run: RunFolder, fit_of: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What stages give that aren't run, by their names; an error is raised."""
    comparison = {"loss": "robust", "total": {"robust": 1.29, "rgb": 1.0}, "noise": {}, "cameras": [], "frames": []}
    found: dict[str, Any] = {
        "prepare": (None, run),
        "reconstructed": None,
        "model_on": None,
        "model_of": SimpleNamespace(law=None),
        "run_fit": fit_of(),
        "draw_comparison": comparison,
        "check_adequacy": dict(MISFIT),
        "run_diagnosis": dict(DIAGNOSIS),
    }

    def giving(name: str) -> Callable[..., Any]:
        def give(*_: object, **__: object) -> Any:
            if isinstance(found[name], Exception):
                raise found[name]
            return found[name]

        return give

    for name in found:
        monkeypatch.setattr(_model if hasattr(_model, name) else _stages, name, giving(name))
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: path / "report.html")
    monkeypatch.setattr("splatsoil.commands._crew.Crew", lambda *_: nullcontext())
    file = {"format": "splatsoil-comparison/1", "fit": "another", "parameters": {}, **comparison}
    write_json(run.comparison / "comparison.json", file)
    return found


@pytest.fixture(scope="session")
def cut() -> Callable[..., Path]:
    """Makes a copy of a set with every third view and some video frames."""

    def make(source: Path, folder: Path, *frames: int) -> Path:
        folder.mkdir(parents=True)
        for name in ("experiment.json", "tool.stl", "tool_motion.csv", "tool_force.csv"):
            shutil.copy(source / name, folder)
        for kind in ("views", "video"):
            data = json.loads((source / kind / "transforms.json").read_text())
            every = data["frames"]
            data["frames"] = every[::3] if kind == "views" else [f for f in every if f["frame"] in (-2, -1, 0, *frames)]
            for frame in data["frames"]:
                target = folder / kind / frame["file_path"]
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(source / kind / frame["file_path"], target)
            (folder / kind / "transforms.json").write_text(json.dumps(data))
        return folder

    return make


@pytest.fixture(scope="session")
def program() -> Callable[..., Any]:
    """Runs a command in a process of its own, and returns the JSON object that it prints; the error where it is to
    fail."""

    def command(*words: str | Path, cwd: Path, code: int = 0, cores: int | None = None) -> Any:
        mine = sorted(os.sched_getaffinity(0))[:cores]
        done = subprocess.run(
            [sys.executable, "-m", "splatsoil", *map(str, words), "--json"],
            cwd=cwd,
            capture_output=True,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            timeout=900,
            check=False,
            preexec_fn=lambda: os.sched_setaffinity(0, mine),
        )
        assert done.returncode == code and "Traceback" not in done.stderr, done.stderr
        told = json.loads(done.stdout)
        return told if code == 0 else told["error"]

    return command
