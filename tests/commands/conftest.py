"""Stages that are not run, and sets that are quickly simulated."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import _model, _stages, _workers, add
from splatsoil.files import write_json


@pytest.fixture(scope="session")
def words() -> Callable[..., list[str]]:
    """The words of a command on a run folder, with what it needs."""

    def make(command: str, run: Any, *more: object) -> list[str]:
        own = {"add": ["cohesion"], "export": ["--to", "csv"]}.get(command, [])
        return [command, str(getattr(run, "path", run)), *own, *map(str, more)]

    return make


@pytest.fixture
def refused(words: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Gives a command that is to be refused, and returns what it says on stderr: one sentence in the end, the same as
    the JSON object."""

    def give(command: str, place: Any, *more: object) -> str:
        capsys.readouterr()
        assert cli.main([*words(command, place, *more), "--json"]) == 2, command
        out, err = capsys.readouterr()
        assert json.loads(out) == {"ok": False, "error": err.splitlines()[-1].removeprefix("splatsoil: ")}
        return err

    return give


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
        "add_effect": None,
    }

    def giving(name: str) -> Callable[..., Any]:
        def give(*_: object, **__: object) -> Any:
            if isinstance(found[name], Exception):
                raise found[name]
            return found[name]

        return give

    for name in found:
        monkeypatch.setattr(next(m for m in (_model, _stages, add) if hasattr(m, name)), name, giving(name))
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: path / "report.html")
    monkeypatch.setattr(_workers, "Workers", lambda *_: nullcontext())
    file = {"format": "splatsoil-comparison/1", "fit": "another", "parameters": {}, **comparison}
    write_json(run.comparison / "comparison.json", file)
    return found


@pytest.fixture(scope="session")
def cut() -> Callable[..., Path]:
    """Makes a copy of a set with every so many views, some frames of some cameras, and pictures of a size."""

    def make(
        source: Path, folder: Path, *frames: int, every: int = 3, cameras: str = "left right", shrunk: int = 1
    ) -> Path:
        folder.mkdir(parents=True)
        for name in ("experiment.json", "tool.stl", "tool_motion.csv", "tool_force.csv"):
            shutil.copy(source / name, folder)
        for kind in ("views", "video"):
            data = json.loads((source / kind / "transforms.json").read_text())
            kept = [f for f in data["frames"] if f.get("frame") in (-2, -1, 0, *frames) and f["camera"] in cameras]
            data["frames"] = data["frames"][::every] if kind == "views" else kept
            for entry in (data, *data["frames"]):
                for key in {"w", "h", "fl_x", "fl_y", "cx", "cy"} & entry.keys():
                    entry[key] = entry[key] // shrunk if key in "wh" else entry[key] / shrunk
            for frame in data["frames"]:
                target = folder / kind / frame["file_path"]
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(source / kind / frame["file_path"], target)
                if shrunk > 1:
                    with Image.open(source / kind / frame["file_path"]) as image:
                        image.reduce(shrunk).save(target, quality=95)
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
        printed = json.loads(done.stdout)
        return printed if code == 0 else printed["error"]

    return command
