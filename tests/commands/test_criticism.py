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
    compared = command("compare", "run", "--repeats", "2", "--no-replay", cwd=place)
    assert {"adequate", "misfit", "blocks", "floor"} <= compared["misfit"].keys()
    assert {"stage", "region", "channel", "ratio", "p"} <= compared["misfit"]["blocks"][0].keys()

    words = (
        "diagnose",
        "run",
        "--effects",
        "cohesion",
        "exposure",
        str(repository / "examples" / "effects" / "suction.py"),
        "--repeats",
        "2",
        "--refit-steps",
        "2",
    )
    shutil.copytree(place / "run", place / "alone")
    alone = command(words[0], "alone", *words[2:], cwd=place, cores=1)
    first = command(*words, cwd=place)
    assert first["effects"] == alone["effects"], "a second core changes nothing"
    if len(os.sched_getaffinity(0)) > 1:
        assert first["simulated_now"] == alone["simulated_now"], "and makes nothing twice"
    assert {e["name"] for e in first["effects"]} == {"cohesion", "exposure", "suction"}
    assert first["verdict"] in ("adequate", "missing", "outside the library")
    controls = [list((place / name / "features").glob("replay-*.npy")) for name in ("alone", "run")]
    assert [len(files) for files in controls] == [1, 1]
    assert controls[0][0].read_bytes() == controls[1][0].read_bytes(), "a helper makes the same control"
    kept = json.loads((place / "run" / "diagnosis.json").read_text())
    assert kept["floor"]["guesses"] > 0.0
    assert kept["effects"] == first["effects"]
    again = command(*words, cwd=place)
    assert again["simulated_now"] == 0, "everything was kept"
    judged = command("compare", "run", "--repeats", "2", cwd=place)
    assert len(list((place / "run" / "features").glob("replay-*.npy"))) == 1, "one control for all candidates"
    assert judged["misfit"]["floor"]["reconstruction"] != compared["misfit"]["floor"]["reconstruction"]
    assert again["effects"] == first["effects"]

    added = command("add", "run", "cohesion", "--budget", "3", "--repeats", "2", cwd=place)
    assert [m["model"] for m in added["models"]] == ["base", "cohesion"]
    assert added["models"][1]["added"] == "cohesion"
    assert set(added["models"][1]["parameters"]) == {"friction_angle", "cohesion"}
    run = place / "run"
    assert json.loads((run / "fit.json").read_text())["name"] == "cohesion"
    assert (run / "before" / "comparison.json").is_file()
    page = (run / "report.html").read_text()
    assert "The error falls" in page and "Observed, before, after, difference" in page


def test_what_cannot_be_diagnosed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["diagnose", str(tmp_path)], ["add", str(tmp_path), "cohesion"]):
        assert cli.main(words) == 2
        assert "run.json" in capsys.readouterr().err
    assert cli.main(["diagnose", str(tmp_path), "--repeats", "1"]) == 2
    assert "--repeats" in capsys.readouterr().err
