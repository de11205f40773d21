"""What the page says of a diagnosis and of added effects."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatsoil.files import write_json
from splatsoil.report import figures, write_report
from splatsoil.report.text import steps

CHROMIUM = shutil.which("chromium")
FRAMES = (10, 20)


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
    step = {
        "step": 0,
        "seed": 1,
        "level": "full",
        "parameters": dict.fromkeys(parameters, 0.0),
        "loss": 0.3,
        "status": "ok",
        "message": "",
    }
    return {
        "format": "splatsoil-fit/2",
        "name": name,
        "parameters": parameters,
        "loss": 0.2,
        "estimated_from": "comparison",
        "minimum": {k: {"estimate": p["estimate"], "low": -1.0, "high": 1.0} for k, p in parameters.items()},
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
    after = fit("effect_2", 1.0, ["effect_2"], {"effect_2": 7.0})
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
    models[1]["added"] = "effect_2"
    write_json(tmp_path / "history.json", {"format": "splatsoil-history/1", "models": models})
    comparison(tmp_path / "before", base, 40)
    comparison(tmp_path / "comparison", after, 200)
    return tmp_path


def words_of(text: str) -> str:
    body = re.sub(r"<(script|style).*?</\1>", " ", text, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", body).split())


def test_the_verdict_stands_on_top_with_its_reasons(run: Path) -> None:
    page = write_report(run).read_text()
    text = words_of(page)
    assert "Missing: effect 2. Added. A sentence that says why." in text
    assert text.index("Missing: effect 2.") < text.index("Which model?") < text.index("Where it fails")
    assert "The error falls" in text and "camera right and the withdrawal" in text
    assert "base: 5.2, noise 1.2; + effect 2: 1.3, noise 1.2" in page


def test_every_model_has_its_line(run: Path) -> None:
    page = write_report(run).read_text()
    section = re.findall(r'<section id="models">.*?</section>', page, re.DOTALL)[0]
    assert [words_of(row) for row in re.findall(r"<tr.*?</tr>", section, re.DOTALL)[1:]] == [
        "effect 2 97 % 550 ± 160 Pa 120 Pa",
        "as it is 2.2 % – –",
        "something else &lt; 0.5 % – –",
        "tilt &lt; 0.5 % 0.31 ± 0.22° 0.54°",
    ]
    assert section.count('class="little"') == 2
    assert "effect 2 : adds strength." in words_of(section) and "leans." not in section


def test_checks_that_hold_stand_back(run: Path) -> None:
    page = write_report(run).read_text()
    section = page[page.index('id="checks"') :]
    assert re.search(r"<tr><td>push</td><td>berm</td><td>left</td><td>2.3</td><td>0.003</td>", section)
    assert re.search(r'<tr class="little"><td>push</td><td>track</td>', section)
    assert "1.3 × that of pairs of coarse and fine runs" in words_of(section)


def test_blocks_that_fail_are_outlined_on_their_photographs(run: Path, diagnosis: dict[str, Any]) -> None:
    diagnosis["maps"]["effect_2"][2][3:6] = [2.5, 3.0, -1.0]
    write_json(run / "diagnoses" / "base.json", diagnosis)
    page = write_report(run).read_text()
    (figure,) = re.findall(r'<figure class="outlined">.*?</figure>', page, re.DOTALL)
    assert words_of(figure) == "Berm during push, left camera : 2.3 × expected. It begins at frame 30."
    # The compared frame nearest to 30 is 20.
    seen = base64.b64encode((run / "comparison" / "left_20_observed.jpg").read_bytes()).decode()
    assert seen in figure
    squares = re.findall(r'<polygon points="([^"]+)" class="(\w+)"', figure)
    assert sorted(kind for _, kind in squares) == ["beyond", "beyond", "within"]
    corners = " ".join(f"{u},{v}" for u, v in diagnosis["sites"][4][3])
    assert (corners, "beyond") in squares


def test_force_before_and_after_an_addition_is_in_newtons_without_a_diagnosis(run: Path) -> None:
    (run / "diagnoses" / "base.json").unlink()
    for folder, predicted in (("before", [10.0, 20.0]), ("comparison", [33.0, None])):
        path = run / folder / "comparison.json"
        channel = {"channel": "force along", "measured": [30.0, None], "predicted": predicted}
        told = {"unit": "N", "frames": list(FRAMES), "channels": [channel]}
        write_json(path, {**json.loads(path.read_text()), "force": told})
    page = write_report(run).read_text()
    section = page[page.index('id="force"') :].split("</section>")[0]
    assert "Force along: root mean square error 3 N; largest measured 30 N." in words_of(section)
    for label in ("measured", "before", "after", "force along [N]"):
        assert f">{label}<" in section
    assert "± expected" not in section


def test_one_answer_is_averaged_over_models(run: Path, diagnosis: dict[str, Any]) -> None:
    write_json(run / "fit.json", json.loads((run / "fits" / "base.json").read_text()))
    text = words_of(write_report(run).read_text())
    assert "angle 1.0 ± 0.4°" in text and "Added." not in text
    assert "averaged over models" in text
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "verdict": "undecided"})
    text = words_of(write_report(run).read_text())
    assert "Undecided: the data do not discriminate" in text and "angle 1.0 ± 0.4°" in text


def test_without_an_added_effect_the_error_is_of_the_models_compared(run: Path, diagnosis: dict[str, Any]) -> None:
    (run / "history.json").unlink()
    page = write_report(run).read_text()
    assert "as it is: 5.2, noise 1.2; effect 2: 1.3, noise 1.2" in page and "The error falls" in page
    held_out = [{**entry, "error": 1.25} for entry in diagnosis["held_out"]]
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "held_out": held_out})
    assert "The error does not fall" in write_report(run).read_text()
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "held_out": held_out[:1]})
    assert "The error" not in words_of(write_report(run).read_text())


def test_a_comparison_of_the_latest_fit_judges_it_after_an_addition(run: Path, misfit: dict[str, Any]) -> None:
    told = {**misfit, "fit": "effect_2", "values": {"angle": 1.0, "effect_2": 7.0}}
    write_json(run / "comparison" / "misfit.json", told)
    text = words_of(write_report(run).read_text())
    assert text.index("Missing: effect 2. Added.") < text.index("The model is adequate.")
    assert "No check fails." in text


def test_before_and_after_are_side_by_side_for_every_frame(run: Path) -> None:
    text = write_report(run).read_text()
    found = re.search(r'<script type="application/json" id="frames">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    for camera in json.loads(found.group(1)):
        assert [f["frame"] for f in camera["frames"]] == list(FRAMES)
        assert all(f["before"] != f["predicted"] for f in camera["frames"])
    assert "Observed, before, after, difference" in text


def test_maps_before_and_after_have_colours_of_one_scale(diagnosis: dict[str, Any]) -> None:
    diagnosis["maps"] = {
        key: [[None if v is None else 20.0 * v for v in row] for row in rows] for key, rows in diagnosis["maps"].items()
    }
    before = np.array(diagnosis["maps"]["before"], dtype=np.float64)
    one, other = (
        {float(number) for number in re.findall(r">([-\u2212]?\d+\.?\d*)<", svg.replace("\u2212", "-"))}
        for svg in figures.plan_maps(diagnosis, [(key, key) for key in diagnosis["maps"]])
    )
    assert one == other and max(one) > 0.1 * np.nanmax(np.abs(before))


def test_a_run_without_criticism_says_nothing_of_it(run: Path) -> None:
    for name in ("diagnoses", "before"):
        shutil.rmtree(run / name)
    (run / "history.json").unlink()
    text = words_of(write_report(run).read_text())
    assert "Missing" not in text and "The error falls" not in text and "Observed, predicted, difference" in text


def test_charts_say_in_words_what_they_show(run: Path) -> None:
    page = write_report(run).read_text()
    charts = re.findall(r"<svg[^>]*>", page)
    assert charts and all('role="img"' in c and re.search(r'aria-label="[^"]+"', c) for c in charts)
    assert not re.search(r"<th(?! scope=)[ >]", page)


def test_a_diagnosis_of_another_estimate_is_not_shown(run: Path, diagnosis: dict[str, Any]) -> None:
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "values": {"angle": 9.0}})
    assert "Missing" not in words_of(write_report(run).read_text())


def test_models_that_grow_have_short_names() -> None:
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
