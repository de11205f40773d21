"""``fit``, ``compare``, ``report`` and ``run`` as a user meets them, on a cut of an example set at the coarsest preset.

What they find there means nothing (three frames, cells of 4 cm); that they find it, keep it and go on is the point.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from splatsoil import cli
from splatsoil.report.words import misfit_verdict

BUDGET = 3


def cut(source: Path, folder: Path) -> Path:
    """A copy with every third view and video frames -2, -1, 0, 30 and 50."""
    folder.mkdir(parents=True)
    for name in ("experiment.json", "tool.stl", "tool_motion.csv", "tool_force.csv"):
        shutil.copy(source / name, folder)
    for kind in ("views", "video"):
        data = json.loads((source / kind / "transforms.json").read_text())
        frames = data["frames"]
        data["frames"] = frames[::3] if kind == "views" else [f for f in frames if f["frame"] in (-2, -1, 0, 30, 50)]
        for frame in data["frames"]:
            target = folder / kind / frame["file_path"]
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / kind / frame["file_path"], target)
        (folder / kind / "transforms.json").write_text(json.dumps(data))
    return folder


def command(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-m", "splatsoil", *words],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=environment,
        timeout=600,
    )


def essence(fit: dict[str, Any]) -> dict[str, Any]:
    """A fit without what the clock or the command added."""
    out = {
        k: v for k, v in fit.items() if k not in ("seconds", "ok", "run", "report", "comparison", "history", "misfit")
    }
    return out | {"history": [{k: v for k, v in step.items() if k != "seconds"} for step in fit["history"]]}


@pytest.fixture(scope="module")
def place(plow_dry: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    cut(plow_dry, folder / "set")
    return folder


@pytest.fixture(scope="module")
def whole(place: Path) -> dict[str, Any]:
    """``splatsoil run`` from nothing."""
    words = ["--preset", "tiny", "--budget", str(BUDGET), "--run", "whole", "--stop-at-floor", "--json"]
    done = command("run", "set", *words, cwd=place)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_one_command_leads_from_photographs_to_the_report(place: Path, whole: dict[str, Any]) -> None:
    assert whole["ok"] is True
    angle = whole["parameters"]["friction_angle"]
    assert 20.0 <= angle["estimate"] <= 50.0 and angle["std"] > 0.0 and angle["unit"] == "deg"
    assert {"loss", "evaluations", "seconds", "seed", "device", "preset", "version"} <= whole.keys()
    assert (whole["evaluations"], whole["preset"], whole["device"]) == (BUDGET, "tiny", "cpu")
    run = place / "whole"
    assert json.loads((run / "fit.json").read_text())["parameters"] == whole["parameters"]
    comparison = json.loads((run / "comparison" / "comparison.json").read_text())
    assert {(f["camera"], f["frame"]) for f in comparison["frames"]} == {
        (c, f) for c in ("left", "right") for f in (30, 50)
    }
    assert comparison["noise"]["robust"] > 0.0
    misfit = json.loads((run / "comparison" / "misfit.json").read_text())
    assert misfit["adequate"] is whole["misfit"]["adequate"] and misfit["checks"] == whole["misfit"]["checks"]
    told = misfit["estimates"]["friction_angle"]
    assert whole["misfit"]["estimates"]["friction_angle"] == told, "one answer"
    assert (told["value"], told["std"]) == (angle["estimate"], angle["std"])
    assert len(list((run / "features").glob("*.npy"))) == misfit["simulations"], "each is kept"
    page = (run / "report.html").read_text()
    assert "friction angle" in page and misfit_verdict(misfit) in page
    assert (run / "reconstruction" / "gaussians.ply").is_file()
    # The loss stored of an evaluation is that of a comparison: same scale, same name.
    assert comparison["total"]["robust"] == pytest.approx(whole["loss"], rel=0.3)


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on_to_the_same_end(
    place: Path, whole: dict[str, Any]
) -> None:
    words = ["fit", "set", "--preset", "tiny", "--budget", str(BUDGET), "--run", "broken", "--json"]
    process = subprocess.Popen(
        [sys.executable, "-m", "splatsoil", *words],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        # a shell's background jobs, tests in one among them, ignore the signal
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    database = place / "broken" / "evaluations.db"

    def stored() -> int:
        try:
            with sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True) as connection:
                return int(connection.execute("SELECT count(*) FROM evaluations").fetchone()[0])
        except sqlite3.Error:
            return 0

    deadline = time.monotonic() + 300.0
    while stored() < 1 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    kept = stored()
    assert 1 <= kept < BUDGET
    said = json.loads(out)
    assert said["ok"] is False and f"{kept} evaluation" in said["error"]
    assert "kept in broken; go on with: splatsoil fit set --budget 3 --preset tiny --run broken" in err
    assert "Traceback" not in err
    assert not (place / "broken" / "fit.json").exists()
    done = command(*words, cwd=place)
    assert done.returncode == 0, done.stderr
    assert essence(json.loads(done.stdout)) == essence(whole)


@pytest.mark.slow
def test_compare_and_report_work_on_a_finished_run(
    place: Path, whole: dict[str, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = place / "whole"
    before = json.loads((run / "comparison" / "comparison.json").read_text())
    shutil.rmtree(run / "comparison")
    (run / "report.html").unlink()

    def again_and_again(*_: object) -> None:
        raise AssertionError("the light is known")

    monkeypatch.setattr("splatsoil.scene.build.estimate_light", again_and_again)
    assert cli.main(["compare", str(run)]) == 0
    assert "soil at rest" in " ".join(capsys.readouterr().out.split())
    again = json.loads((run / "comparison" / "comparison.json").read_text())
    assert {k: v for k, v in again.items() if k != "seconds"} == {k: v for k, v in before.items() if k != "seconds"}
    assert cli.main(["report", str(run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"ok": True, "report": str(run / "report.html")}
    assert (run / "report.html").is_file()


@pytest.mark.slow
def test_a_run_folder_is_for_one_set_preset_and_seed(
    place: Path, whole: dict[str, Any], plow_damp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, says in (
        ([str(plow_damp), "--preset", "tiny"], "belongs to another measurement set (plow-dry)"),
        ([str(place / "set"), "--preset", "small"], "belongs to preset tiny, not small"),
        ([str(place / "set"), "--preset", "tiny", "--seed", "1"], "belongs to seed 0, not 1"),
    ):
        assert cli.main(["fit", *words, "--run", str(place / "whole")]) == 2
        assert says in capsys.readouterr().err


@pytest.mark.parametrize("name", ["fit", "run"])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--budget", "1"], "at least 2"),
        (["--seed", "-1"], "--seed"),
        (["--with", "antigravity"], "antigravity"),
        (["--parameters", "phi"], "unknown phi; this model has friction_angle"),
        (["--parameters", "cohesion"], "unknown cohesion"),
        (["--device", "cuda:77"], "cuda:77"),
    ],
)
def test_options_that_make_no_sense_write_nothing(
    plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, options: list[str], says: str
) -> None:
    assert cli.main([name, str(plow_dry), "--run", str(tmp_path / "run"), *options]) == 2
    captured = capsys.readouterr()
    assert says in captured.err and "Traceback" not in captured.err
    assert not (tmp_path / "run").exists()


def test_a_broken_set_leaves_no_run_folder(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (small_set / "tool.stl").write_bytes(b"")
    assert cli.main(["run", str(small_set), "--run", str(tmp_path / "run")]) == 2
    assert "tool.stl" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["compare", "report"])
def test_what_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert cli.main([name, str(tmp_path / "nothing")]) == 2
    assert "run folder" in capsys.readouterr().err
    assert cli.main([name, str(tmp_path)]) == 2
    assert "run.json" in capsys.readouterr().err


def test_somebody_elses_folder_is_left_alone(
    plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert cli.main(["fit", str(plow_dry), "--run", str(tmp_path)]) == 2
    assert "isn't a run folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_command_that_goes_on_is_the_one_that_was_given() -> None:
    from splatsoil.commands._options import FitOptions

    options = FitOptions(Path("my set"), effects=("cohesion",), budget=20, seed=3)
    assert options.again("fit") == "splatsoil fit 'my set' --with cohesion --budget 20 --seed 3"
    assert options.folder("plow") == Path("runs/plow-small-seed3")
