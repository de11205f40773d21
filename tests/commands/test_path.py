"""From photographs to the report as a user goes, on cuts of the example sets at the coarsest preset.

What is found there means nothing (few frames, cells of 4 cm); that it is found, kept and gone on from is the point.
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
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from splatsoil import cli
from splatsoil.commands.compare import MISFIT
from splatsoil.files import read_json, write_json
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.report.text import misfit_verdict

BUDGET = 3
QUICK = ("--preset", "tiny", "--budget", str(BUDGET), "--device", "cpu")
Program = Callable[..., Any]


def essence(fit: dict[str, Any]) -> dict[str, Any]:
    """A fit without what the clock or the command added."""
    added = ("seconds", "ok", "run", "report", "comparison", "history", "misfit")
    steps = [{k: v for k, v in step.items() if k != "seconds"} for step in fit["history"]]
    return {key: value for key, value in fit.items() if key not in added} | {"history": steps}


@pytest.fixture(scope="module")
def place(plow_dry: Path, cut: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    cut(plow_dry, folder / "set", 30, 50)
    return folder


@pytest.fixture(scope="module")
def whole(place: Path, program: Program) -> dict[str, Any]:
    """``splatsoil run`` from nothing."""
    printed: dict[str, Any] = program("run", "set", *QUICK, "--run", "whole", "--no-effects", cwd=place)
    return printed


@pytest.mark.slow
def test_one_command_leads_from_photographs_to_the_report(place: Path, whole: dict[str, Any]) -> None:
    assert whole["ok"] is True
    angle = whole["parameters"]["friction_angle"]
    assert 20.0 <= angle["estimate"] <= 50.0 and angle["std"] > 0.0 and angle["unit"] == "deg"
    assert {"loss", "evaluations", "seconds", "seed", "device", "preset", "version"} <= whole.keys()
    assert (whole["evaluations"], whole["preset"], whole["device"]) == (BUDGET, "tiny", "cpu")
    run = place / "whole"
    assert read_json(run / "fit.json")["parameters"] == whole["parameters"]
    comparison = read_json(run / "comparison" / "comparison.json")
    seen = {(f["camera"], f["frame"]) for f in comparison["frames"]}
    assert seen == {(camera, frame) for camera in ("left", "right") for frame in (30, 50)}
    assert comparison["noise"]["robust"] > 0.0
    misfit = read_json(run / "comparison" / "misfit.json")
    assert misfit["adequate"] is whole["misfit"]["adequate"] and misfit["checks"] == whole["misfit"]["checks"]
    printed = misfit["estimates"]["friction_angle"]
    assert whole["misfit"]["estimates"]["friction_angle"] == printed, "one answer"
    assert (printed["value"], printed["std"]) == (angle["estimate"], angle["std"])
    assert len(list((run / "features").glob("*.npy"))) == misfit["simulations"], "each is kept"
    page = (run / "report.html").read_text()
    assert "friction angle" in page and misfit_verdict(misfit) in page
    assert (run / "reconstruction" / "gaussians.ply").is_file()
    # The loss stored of an evaluation is that of a comparison: same scale, same name.
    assert comparison["total"]["robust"] == pytest.approx(whole["loss"], rel=0.3)


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on_to_the_same_end(
    place: Path, whole: dict[str, Any], program: Program
) -> None:
    words = ("fit", "set", *QUICK, "--run", "broken")
    process = subprocess.Popen(
        [sys.executable, "-m", "splatsoil", *words, "--json"],
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
    again = "splatsoil fit set --budget 3 --preset tiny --run broken --device cpu"
    assert f"kept in broken; go on with: {again}" in err and "Traceback" not in err
    assert not (place / "broken" / "fit.json").exists()
    assert essence(program(*words, cwd=place)) == essence(whole)


@pytest.mark.slow
def test_compare_and_report_work_on_a_finished_run(
    place: Path, whole: dict[str, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = place / "whole"
    before = read_json(run / "comparison" / "comparison.json")
    shutil.rmtree(run / "comparison")
    (run / "report.html").unlink()
    monkeypatch.setattr("splatsoil.scene.build.estimate_light", lambda *_: pytest.fail("the light is known"))
    assert cli.main(["compare", str(run)]) == 0
    assert "soil at rest" in " ".join(capsys.readouterr().out.split())
    again = read_json(run / "comparison" / "comparison.json")
    assert again | {"seconds": 0} == before | {"seconds": 0}
    assert cli.main(["report", str(run), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["ok"], printed["report"]) == (True, str(run / "report.html"))
    assert (run / "report.html").is_file()


@pytest.mark.slow
def test_a_run_folder_is_for_one_set_preset_and_seed(
    place: Path, whole: dict[str, Any], plow_damp: Path, refused: Callable[..., str]
) -> None:
    for words, says in (
        ([str(plow_damp), "--preset", "tiny"], "belongs to another measurement set (plow-dry)"),
        ([str(place / "set"), "--preset", "small"], "belongs to preset tiny, not small"),
        ([str(place / "set"), "--preset", "tiny", "--seed", "1"], "belongs to seed 0, not 1"),
    ):
        assert says in refused("fit", *words, "--run", place / "whole")


@pytest.mark.slow
def test_a_fit_and_its_posterior(place: Path, whole: dict[str, Any], program: Program) -> None:
    fitted = whole["parameters"]["friction_angle"]
    shutil.copytree(place / "whole", place / "sampled")
    printed = program("posterior", "sampled", "--checks", "1", cwd=place)
    angle = printed["parameters"]["friction_angle"]
    assert len(printed["checks"]) == 1
    assert angle["mean"] == pytest.approx(fitted["estimate"], abs=0.15 * fitted["std"])
    assert angle["std"] == pytest.approx(fitted["std"], rel=0.15)
    assert 20.0 <= angle["low"] <= angle["median"] <= angle["high"] <= 50.0
    assert angle["verdict"] in ("determined", "weakly determined", "not determined")
    assert printed["figures"] == ["corner.png"]
    assert (place / "sampled" / "posterior" / "posterior.nc").is_file()
    kept = {file.name: file.stat().st_mtime_ns for file in (place / "sampled" / "features").glob("*.npy")}
    again = program("posterior", "sampled", "--checks", "1", cwd=place)
    assert again["parameters"] == printed["parameters"]
    assert {file.name: file.stat().st_mtime_ns for file in (place / "sampled" / "features").glob("*.npy")} == kept
    fit = read_json(place / "sampled" / "fit.json")
    fit["setup"]["code"] = "other"
    write_json(place / "sampled" / "fit.json", fit)
    assert "other sources" in program("posterior", "sampled", cwd=place, code=2)


@pytest.mark.slow
def test_a_run_is_compared_diagnosed_added_to_and_gets_its_next_stroke(
    plow_damp: Path, cut: Callable[..., Path], program: Program, tmp_path: Path, repository: Path
) -> None:
    cut(plow_damp, tmp_path / "set", 20, 30, 40, 50)
    run = tmp_path / "run"
    program("fit", "set", *QUICK, "--run", "run", cwd=tmp_path)
    made = len(list((run / "features").glob("*.npy")))
    compared = program("compare", "run", cwd=tmp_path)
    assert set(MISFIT) == compared["misfit"].keys()
    assert len(list((run / "features").glob("*.npy"))) == made, "the fit has simulated all of it"
    assert {"stage", "region", "channel", "ratio", "p"} <= compared["misfit"]["checks"][0].keys()

    few = program("diagnose", "run", "--effects", "exposure", cwd=tmp_path)
    assert {m["name"] for m in few["models"]} == {"", "something else", "exposure"}
    assert few["simulated_now"] < few["simulations"], "those of the comparison are there"

    own = str(repository / "examples" / "effects" / "suction.py")
    words = ("--effects", "exposure", own)
    shutil.copytree(run, tmp_path / "alone")
    alone = program("diagnose", "alone", *words, cwd=tmp_path, cores=1)
    assert alone["simulated_now"] <= alone["simulations"] - made, "a file counts for its own effect alone"
    first = program("diagnose", "run", *words, cwd=tmp_path)
    assert first["models"] == alone["models"], "a second core changes nothing"
    if len(os.sched_getaffinity(0)) > 1:
        assert first["simulated_now"] == alone["simulated_now"], "and makes nothing twice"
    assert {m["name"] for m in first["models"]} == {"", "something else", "exposure", "suction"}
    assert sum(m["probability"] for m in first["models"]) == pytest.approx(1.0)
    assert read_json(run / "diagnosis.json")["models"] == first["models"]
    again = program("diagnose", "run", *words, cwd=tmp_path)
    assert again["simulated_now"] == 0, "everything was kept"
    assert again["models"] == first["models"]
    next_stroke(tmp_path, program, plow_damp)

    added = program("add", "run", own, "--budget", "3", cwd=tmp_path)
    before, after = added["models"]
    assert (before["model"], after["added"]) == ("base", "suction")
    assert set(after["parameters"]) == {"friction_angle", "suction_gradient"}
    assert read_json(run / "fit.json")["setup"]["effects"] == [own]
    assert read_json(run / "before" / "comparison.json")["fit"] == "base"
    page = (run / "report.html").read_text()
    falls = after["held_out"] < before["held_out"]
    assert f"The error {'falls' if falls else 'does not fall'}" in page
    assert "Observed, before, after, difference" in page


def next_stroke(place: Path, program: Program, source: Path) -> None:
    """A design is kept, resumed, and can be made."""
    run = place / "run"
    # Probable models, whatever these few frames say.
    data = read_json(run / "diagnosis.json")
    for model in data["models"]:
        model["probability"] = {"": 0.5, "suction": 0.4}.get(model["name"], 0.05)
    data["draws"].setdefault("suction", [{**draw, "suction_gradient": 400.0} for draw in data["draws"][""]])
    write_json(run / "diagnosis.json", data)
    first = program("design", "run", "--draws", "3", cwd=place)
    assert first["simulated_now"] > 0
    again = program("design", "run", "--draws", "3", cwd=place)
    assert again["simulated_now"] == 0 and again["strokes"] == first["strokes"], "everything was kept"
    kept = read_json(run / "design" / "design.json")
    assert kept["format"] == "splatsoil-design/2" and kept["strokes"] == first["strokes"]
    assert first["stroke"] == first["strokes"][0]["name"]
    bits = [stroke["bits"] for stroke in first["strokes"]]
    assert bits == sorted(bits, reverse=True) and all(0.0 <= b <= first["entropy"] + 1e-9 for b in bits)
    motion = ToolMotion.read(run / "design" / "tool_motion.csv")
    assert (abs(motion.times - motion.frames / Measurement.load(source).frame_rate) < 1e-9).all()
    # A set with this motion is one; its force is still to be measured.
    shutil.copytree(place / "set", place / "next")
    shutil.copy(run / "design" / "tool_motion.csv", place / "next")
    experiment = read_json(place / "next" / "experiment.json")
    del experiment["tool"]["force"]
    write_json(place / "next" / "experiment.json", experiment)
    assert Measurement.load(place / "next").tool.motion.times[-1] == motion.times[-1]


def test_a_broken_set_leaves_no_run_folder(small_set: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    (small_set / "tool.stl").write_bytes(b"")
    assert "tool.stl" in refused("run", small_set, "--run", tmp_path / "run")
    assert not (tmp_path / "run").exists()
