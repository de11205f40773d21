"""``compare``, ``diagnose`` and ``add`` as a user meets them, on a cut of an example set at the coarsest preset.

What they find there means nothing (three frames, cells of 4 cm); that they find it, keep it and go on is the point.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from splatsoil import cli
from splatsoil.commands.compare import TOLD


def cut(source: Path, folder: Path) -> Path:
    """A copy with every third view and five video frames from 0 on."""
    folder.mkdir(parents=True)
    for name in ("experiment.json", "tool.stl", "tool_motion.csv", "tool_force.csv"):
        shutil.copy(source / name, folder)
    for kind in ("views", "video"):
        data = json.loads((source / kind / "transforms.json").read_text())
        frames, kept = data["frames"], (-2, -1, 0, 20, 30, 40, 50)
        data["frames"] = frames[::3] if kind == "views" else [f for f in frames if f["frame"] in kept]
        for frame in data["frames"]:
            target = folder / kind / frame["file_path"]
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / kind / frame["file_path"], target)
        (folder / kind / "transforms.json").write_text(json.dumps(data))
    return folder


def command(*words: str, cwd: Path, cores: int | None = None) -> dict[str, Any]:
    mine = sorted(os.sched_getaffinity(0))[:cores]
    done = subprocess.run(
        [sys.executable, "-m", "splatsoil", *words, "--json"],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        timeout=900,
        check=False,
        preexec_fn=lambda: os.sched_setaffinity(0, mine),
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def place(plow_damp: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("criticism")
    cut(plow_damp, folder / "set")
    command("fit", "set", "--preset", "tiny", "--budget", "3", "--run", "run", cwd=folder)
    return folder


@pytest.mark.slow
def test_a_run_is_compared_diagnosed_and_added_to(place: Path, repository: Path) -> None:
    made = len(list((place / "run" / "features").glob("*.npy")))
    compared = command("compare", "run", cwd=place)
    assert set(TOLD) == compared["misfit"].keys()
    assert len(list((place / "run" / "features").glob("*.npy"))) == made, "the fit has simulated all of it"
    assert {"stage", "region", "channel", "ratio", "p"} <= compared["misfit"]["checks"][0].keys()

    few = command("diagnose", "run", "--effects", "exposure", cwd=place)
    assert {m["name"] for m in few["models"]} == {"", "something else", "exposure"}
    assert few["simulated_now"] < few["simulations"], "those of the comparison are there"

    own = str(repository / "examples" / "effects" / "suction.py")
    words = ("--effects", "exposure", own)
    shutil.copytree(place / "run", place / "alone")
    alone = command("diagnose", "alone", *words, cwd=place, cores=1)
    assert alone["simulated_now"] <= alone["simulations"] - made, "a file counts for its own effect alone"
    first = command("diagnose", "run", *words, cwd=place)
    assert first["models"] == alone["models"], "a second core changes nothing"
    if len(os.sched_getaffinity(0)) > 1:
        assert first["simulated_now"] == alone["simulated_now"], "and makes nothing twice"
    assert {m["name"] for m in first["models"]} == {"", "something else", "exposure", "suction"}
    assert sum(m["probability"] for m in first["models"]) == pytest.approx(1.0)
    run = place / "run"
    assert json.loads((run / "diagnosis.json").read_text())["models"] == first["models"]
    again = command("diagnose", "run", *words, cwd=place)
    assert again["simulated_now"] == 0, "everything was kept"
    assert again["models"] == first["models"]

    added = command("add", "run", own, "--budget", "3", cwd=place)
    before, after = added["models"]
    assert (before["model"], after["added"]) == ("base", "suction")
    assert set(after["parameters"]) == {"friction_angle", "suction_gradient"}
    assert json.loads((run / "fit.json").read_text())["setup"]["effects"] == [own]
    assert json.loads((run / "before" / "comparison.json").read_text())["fit"] == "base"
    page = (run / "report.html").read_text()
    falls = after["held_out"] < before["held_out"]
    assert f"The error {'falls' if falls else 'does not fall'}" in page
    assert "Observed, before, after, difference" in page


def test_what_cannot_be_diagnosed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["diagnose", str(tmp_path)], ["add", str(tmp_path), "cohesion"]):
        assert cli.main(words) == 2
        assert "run.json" in capsys.readouterr().err
