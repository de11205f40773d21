"""``splatsoil posterior`` as a user meets it, on a small cut of an example set at the coarsest preset.

What it finds there means nothing; that it says so, keeps it and goes on is the point.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatsoil import cli


def command(*words: str | Path) -> SimpleNamespace:
    done = subprocess.run(
        [sys.executable, "-m", "splatsoil", *map(str, words)],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        timeout=600,
    )
    return SimpleNamespace(code=done.returncode, out=done.stdout, err=done.stderr)


@pytest.fixture
def cut(plow_dry: Path, tmp_path: Path) -> Path:
    """A copy of the example with every third view and video frames -2, -1, 0, 30 and 50."""
    folder = tmp_path / "cut"
    folder.mkdir()
    for name in ("experiment.json", "tool.stl", "tool_motion.csv", "tool_force.csv"):
        shutil.copy(plow_dry / name, folder)
    for kind in ("views", "video"):
        data = json.loads((plow_dry / kind / "transforms.json").read_text())
        frames = data["frames"]
        data["frames"] = frames[::3] if kind == "views" else [f for f in frames if f["frame"] in (-2, -1, 0, 30, 50)]
        for frame in data["frames"]:
            target = folder / kind / frame["file_path"]
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(plow_dry / kind / frame["file_path"], target)
        (folder / kind / "transforms.json").write_text(json.dumps(data))
    return folder


@pytest.mark.slow
def test_a_fit_and_its_posterior(cut: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fitted = command("fit", cut, "--preset", "tiny", "--run", run, "--budget", "5", "--device", "cpu", "--json")
    assert fitted.code == 0, fitted.err
    options = ("--checks", "1", "--json")
    done = command("posterior", run, *options)
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert told["ok"] and len(told["checks"]) == 1
    angle, estimate = (r["parameters"]["friction_angle"] for r in (told, json.loads(fitted.out)))
    assert angle["mean"] == pytest.approx(estimate["estimate"], abs=0.15 * estimate["std"])
    assert angle["std"] == pytest.approx(estimate["std"], rel=0.15)
    assert 20.0 <= angle["low"] <= angle["median"] <= angle["high"] <= 50.0
    assert angle["verdict"] in ("determined", "weakly determined", "not determined")
    assert told["figures"] == ["corner.png"]
    assert (run / "posterior" / "posterior.nc").is_file()
    # What has been simulated isn't again, and the answer stays.
    kept = {file.name: file.stat().st_mtime_ns for file in (run / "features").glob("*.npy")}
    again = json.loads(command("posterior", run, *options).out)
    assert again["parameters"] == told["parameters"]
    assert {file.name: file.stat().st_mtime_ns for file in (run / "features").glob("*.npy")} == kept
    # A fit by other sources is refused before anything is simulated.
    changed = json.loads((run / "fit.json").read_text())
    changed["setup"]["code"] = "other"
    (run / "fit.json").write_text(json.dumps(changed))
    refused = command("posterior", run)
    assert refused.code == 2 and "other sources" in refused.err and "Traceback" not in refused.err


def test_mistakes_get_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["posterior", str(tmp_path / "nowhere")]) == 2
    assert "no such run folder" in capsys.readouterr().err
    assert cli.main(["posterior", str(tmp_path), "--checks", "-1"]) == 2
    assert "--checks" in capsys.readouterr().err
