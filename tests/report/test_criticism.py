"""What the page says of a diagnosis and of added effects."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from splatsoil.benchmarks.hidden_effects import emulated, fitted
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.record import record

from splatsoil.files import write_json
from splatsoil.report import figures, write_report
from splatsoil.report.words import steps, verdict

CHROMIUM = shutil.which("chromium")
FRAMES = (10, 20)


@pytest.fixture(scope="module")
def diagnosis() -> dict[str, Any]:
    experiment = emulated(77)
    experiment = replace(experiment, observed=experiment.measured({"angle": 1.0, "effect 2": 7.0}, [77, 99]))
    return {**record(experiment, diagnose(experiment, {"angle": fitted(experiment)})), "fit": "base"}


def fit(name: str, angle: float, effects: list[str], extra: dict[str, float]) -> dict[str, Any]:
    x = np.linspace(-10.0, 10.0, 11)
    parameters = {
        key: {
            "estimate": value,
            "std": 0.5,
            "low": value - 1.0,
            "high": value + 1.0,
            "unit": "deg" if key == "angle" else "1",
            "title": key,
            "bounds": [-10.0, 10.0],
            "at_bound": None,
            "determined": True,
        }
        for key, value in {"angle": angle, **extra}.items()
    }
    step = {"step": 0, "parameters": dict.fromkeys(parameters, 0.0), "loss": 0.3, "status": "ok", "message": ""}
    return {
        "format": "splatsoil-fit/1",
        "name": name,
        "parameters": parameters,
        "loss": 0.2,
        "estimated_from": "features",
        "loss_std": 0.01,
        "noise_std": 0.01,
        "evaluations": 1,
        "failed": 0,
        "seconds": 10.0,
        "seed": 0,
        "device": "cpu",
        "preset": "tiny",
        "version": "0",
        "setup": {"effects": effects, "preset": "tiny"},
        "notes": [],
        "facts": {},
        "curves": {k: {"x": list(x), "mean": list(x**2), "std": [1.0] * 11} for k in parameters},
        "history": [{**step, "seconds": 1.0}],
    }


def comparison(folder: Path, made_from: dict[str, Any], shade: int) -> None:
    folder.mkdir(parents=True)
    frames = []
    for camera in ("left", "right"):
        for frame in FRAMES:
            entry: dict[str, Any] = {"camera": camera, "frame": frame, "losses": {"robust": 0.1, "rgb": 0.01}}
            for kind in ("observed", "predicted", "difference"):
                entry[kind] = f"{camera}_{frame}_{kind}.jpg"
                Image.new("RGB", (64, 48), (shade, frame, 9 * len(kind))).save(folder / entry[kind])
            frames.append(entry)
    data = {
        "format": "splatsoil-comparison/1",
        "fit": made_from["name"],
        "parameters": {k: p["estimate"] for k, p in made_from["parameters"].items()},
        "loss": "robust",
        "total": {"robust": 0.1},
        "noise": {"robust": 0.01},
        "motionless": {"robust": 1.0},
        "gain": 4.0,
        "cameras": ["left", "right"],
        "frames": frames,
    }
    write_json(folder / "comparison.json", data)


@pytest.fixture
def run(tmp_path: Path, diagnosis: dict[str, Any]) -> Path:
    base = fit("base", diagnosis["values"]["angle"], [], {})
    after = fit("effect 2", 1.0, ["effect 2"], {"effect 2": 7.0})
    write_json(
        tmp_path / "run.json",
        {
            "format": "splatsoil-run/1",
            "measurement": {"name": "emulated", "folder": "sets/e", "hash": "ab" * 32},
            "preset": "tiny",
            "seed": 0,
        },
    )
    for each in (base, after):
        write_json(tmp_path / "fits" / f"{each['name']}.json", each)
    write_json(tmp_path / "fit.json", after)
    write_json(tmp_path / "diagnoses" / "base.json", diagnosis)
    models = []
    for each, error in ((base, 5.2), (after, 1.31)):
        kept = {
            k: {"estimate": p["estimate"], "std": p["std"], "unit": p["unit"]} for k, p in each["parameters"].items()
        }
        line = {"model": each["name"], "effects": each["setup"]["effects"], "parameters": kept}
        models.append({**line, "loss": 0.2, "held_out": error, "floor": 1.24})
    models[1]["added"] = "effect 2"
    write_json(tmp_path / "history.json", {"format": "splatsoil-history/1", "models": models})
    comparison(tmp_path / "before", base, 40)
    comparison(tmp_path / "comparison", after, 200)
    return tmp_path


def words_of(text: str) -> str:
    body = re.sub(r"<(script|style).*?</\1>", " ", text, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", body).split())


def test_the_verdict_stands_on_top_with_its_reasons(run: Path, diagnosis: dict[str, Any]) -> None:
    text = words_of(write_report(run).read_text())
    assert "Missing: effect 2." in text and "Added." in text
    assert text.index("Missing: effect 2.") < text.index("The error falls") < text.index("Where it fails")
    for sentence in diagnosis["sentences"]:
        assert sentence in text
    for phrase in ("5.2", "1.3", "noise alone", "Effects that are off", "has moved by is the bias"):
        assert phrase in text, phrase


def test_every_effect_has_its_line(run: Path, diagnosis: dict[str, Any]) -> None:
    text = write_report(run).read_text()
    table = text[text.index("Effects that are off") :]
    for effect in diagnosis["effects"]:
        assert re.search(rf">{effect['name']}</td><td>{effect['verdict']}</td>", table), effect["name"]


def test_before_and_after_are_side_by_side_for_every_frame(run: Path) -> None:
    text = write_report(run).read_text()
    found = re.search(r'<script type="application/json" id="frames">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    for camera in json.loads(found.group(1)):
        assert [f["frame"] for f in camera["frames"]] == list(FRAMES)
        assert all(f["before"] != f["predicted"] for f in camera["frames"])
    assert "Observed, before, after, difference" in text


def test_maps_before_and_after_have_colours_of_one_scale(diagnosis: dict[str, Any]) -> None:
    before = np.array(diagnosis["maps"]["before"], dtype=np.float64)
    there = {"before": before.tolist(), "after": (0.1 * before).tolist()}
    one, other = (
        {float(number) for number in re.findall(r">([-\u2212]?\d+\.?\d*)<", svg.replace("\u2212", "-"))}
        for svg in figures.plan_maps({**diagnosis, "maps": there}, list(there))
    )
    assert one == other and max(one) > 0.1 * np.nanmax(np.abs(before))


def test_a_run_without_criticism_says_nothing_of_it(run: Path) -> None:
    for name in ("diagnoses", "before"):
        shutil.rmtree(run / name)
    (run / "history.json").unlink()
    text = words_of(write_report(run).read_text())
    assert "Missing" not in text and "The error falls" not in text and "Observed, predicted, difference" in text


def test_a_free_strength_is_drawn_over_what_was_visited(run: Path, diagnosis: dict[str, Any]) -> None:
    at = np.geomspace(100.0, 2000.0, 9)
    shape = {"argument": "pressure", "reading": "cohesion-like", "at": list(at), "factor": list(at**-0.1)}
    shape |= {"low": list(0.9 * at**-0.1), "high": list(1.1 * at**-0.1)}
    found = {"explained": 0.93, "readings": ["cohesion-like"], "shapes": [shape]}
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "verdict": "outside the library", "strength": found})
    page = write_report(run).read_text()
    text = words_of(page)
    assert "What the missing strength looks like" in text and "cohesion-like" in text and "93 %" in text
    assert "too little to read" not in text and "pressure [Pa]" in page
    faint = {**found, "explained": 0.2, "shapes": [{**shape, "reading": ""}]}
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "strength": faint})
    assert "too little to read anything into them" in words_of(write_report(run).read_text())
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "strength": None})
    assert "What the missing strength" not in words_of(write_report(run).read_text())


def test_a_diagnosis_of_another_estimate_is_not_shown(run: Path, diagnosis: dict[str, Any]) -> None:
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "values": {"angle": 9.0}})
    assert "Missing" not in words_of(write_report(run).read_text())


def test_words() -> None:
    assert (
        verdict({"verdict": "missing", "class": ["tool_friction", "cohesion"]}) == "Missing: tool friction or cohesion."
    )
    assert verdict({"verdict": "adequate", "class": []}) == "The model is adequate."
    assert steps([{"model": "base"}, {"model": "cohesion", "added": "cohesion"}]) == ["base", "+ cohesion"]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to look with")
@pytest.mark.slow
def test_a_browser_moves_the_slider_and_finds_nothing_to_complain_about(run: Path) -> None:
    page = write_report(run)
    probe = """
    <script>addEventListener("load", () => {
      const slider = document.getElementById("frame");
      const before = document.querySelector("img[data-kind=before]").src;
      slider.value = "0"; slider.dispatchEvent(new Event("input"));
      const moved = document.querySelector("figure.camera .frame").textContent;
      const wide = document.documentElement.scrollWidth <= innerWidth;
      document.title = ["PROBE", moved, before.length > 100, wide].join("|");
    });</script></body>"""
    looked = run / "probe.html"
    looked.write_text(page.read_text().replace("</body>", probe))
    for width in (400, 1200):
        words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
        words += [f"--window-size={width},900", "--virtual-time-budget=4000", "--dump-dom", looked.as_uri()]
        done = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120, check=True)
        title = re.search(r"<title>(.*?)</title>", done.stdout)
        assert title is not None and title.group(1) == f"PROBE|{FRAMES[0]}|true|true", done.stderr[-500:]
        assert "CONSOLE" not in done.stderr, done.stderr
