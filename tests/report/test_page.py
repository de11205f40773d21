"""The page: complete, self-contained, and true to the run folder's files."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatsoil.errors import RunError
from splatsoil.files import read_json, write_json
from splatsoil.report import figures, write_report

FRAMES = [0, 50]
PageOf = Callable[[Path], Any]


def update(file: Path, **changes: Any) -> None:
    """Change some keys of a JSON file."""
    write_json(file, {**read_json(file), **changes})


def shown(source: str) -> str:
    """The text of a part of the page."""
    return " ".join(re.sub(r"<[^>]+>", " ", source).split())


def test_everything_is_on_the_page(run: Path, page_of: PageOf) -> None:
    page = page_of(run)
    assert write_report(run) == run / "report.html"
    assert page.addresses and all(a.startswith(("data:image/", "#")) for a in page.addresses), "it asks nobody"
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest|<link", page.html)
    assert "default-src 'none'" in page.html
    for phrase in (
        "35.6 ± 0.8°",
        "The misfit is 2 % of that of soil at rest, 4.0 × the instruments' noise",
        "4 times as strong",
        "31.2 dB",
        "0.931",
        "failed: particles left the grid",
        "small, cpu, 5",
        "0.25 ms",
        "1 min 23 s for the fit",
        "1 of 3 simulations failed",
        "friction angle [°]",
    ):
        assert phrase in page.text, phrase
    assert page.tags.count("svg") == 3
    assert write_report(run).read_text() == page.html, "same files, same page"
    update(run / "fits" / "base.json", name="cohesion", loss=0.05)
    shutil.copy(run / "fits" / "base.json", run / "fits" / "cohesion.json")
    page = page_of(run)
    assert "base model with cohesion" in page.text.split("Models tried")[1]


def frames_of(page: Any) -> list[dict[str, Any]]:
    """The pictures that the slider shows, by camera."""
    (found,) = re.findall(r'<script type="application/json" id="frames">(.*?)</script>', page.html, re.DOTALL)
    return list(json.loads(found))


def test_every_compared_frame_of_every_camera_is_there(run: Path, page_of: PageOf) -> None:
    cameras = frames_of(page_of(run))
    assert [c["camera"] for c in cameras] == ["left", "right"]
    assert all([f["frame"] for f in c["frames"]] == FRAMES for c in cameras)
    pictures = {f[kind] for c in cameras for f in c["frames"] for kind in ("observed", "predicted", "difference")}
    assert len(pictures) == 6 and all(p.startswith("data:image/jpeg;base64,") for p in pictures)


def test_names_cannot_break_out_of_the_page(
    make_run: Callable[[str], Path], page_of: PageOf, misfit: dict[str, Any]
) -> None:
    """Neither out of its text, nor of attributes, nor of figures, which take no name for mathematics."""
    evil = "</title></script><script>alert(1)</script>\"' $a_{$ `x`\n$(x) \\frac"
    run = make_run(evil)
    for name, table in (("comparison", read_json(run / "comparison" / "comparison.json")), ("misfit", misfit)):
        text = json.dumps(table).replace('"left"', json.dumps(evil))
        write_json(run / "comparison" / f"{name}.json", json.loads(text))
    page = page_of(run)
    assert "alert(1)</script>" not in page.html.replace("&lt;", "<lt>")
    assert page.text.count("<script>alert(1)") > 4 and frames_of(page)[0]["camera"] == evil
    figure = page.html[page.html.index("Loss of each frame") :].split("</section>")[0]
    assert "$a_{$ `x`" in figure


def test_a_fit_without_an_answer_is_said_to_be_one_first(
    run: Path, page_of: PageOf, misfit: dict[str, Any], diagnosis: dict[str, Any]
) -> None:
    write_json(run / "comparison" / "misfit.json", misfit)
    update(run / "fit.json", loss=1.29)
    page = page_of(run)
    assert page.html.split("<header>")[1].split(">", 1)[0].strip() == '<p class="banner" role="alert"'
    assert "No answer: where all instruments together put it the model explains the measurement no better" in page.text
    assert "33.2" not in page.text.split("Every evaluation")[0] and "The model is adequate." in page.text


def test_charts_follow_the_theme_and_say_what_they_show(added: Path, page_of: PageOf) -> None:
    text = page_of(added).html
    assert "prefers-color-scheme: dark" in text and not re.search(r"<th(?! scope=)[ >]", text)
    for chart in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        head = chart.split(">", 1)[0]
        assert 'role="img"' in head and re.search(r'aria-label="[^"]+"', head) and "width=" not in head
        assert "var(--ink)" in chart or "polygon" in chart
        assert not re.search(r"(fill|stroke): #(?!none)(000000|ffffff)", chart)


def test_a_run_that_has_only_been_fitted(run: Path, page_of: PageOf) -> None:
    shutil.rmtree(run / "comparison")
    shutil.rmtree(run / "reconstruction")
    page = page_of(run)
    assert page.tags.count("svg") == 1 and "has not been compared" in page.text
    assert "Missing" not in page.text and "The error falls" not in page.text


def test_what_is_of_another_estimate_is_not_shown(added: Path, page_of: PageOf, diagnosis: dict[str, Any]) -> None:
    write_json(added / "diagnoses" / "base.json", {**diagnosis, "values": {"friction_angle": 9.0}})
    fit = read_json(added / "fit.json")
    fit["parameters"]["friction_angle"]["estimate"] = 33.0
    write_json(added / "fit.json", fit)
    text = page_of(added).text
    assert "has not been compared" in text and "Missing" not in text


@pytest.mark.parametrize(
    ("change", "verdict", "quoted"),
    [
        ({}, "The model is adequate.", "33.2 ± 1.6°"),
        ({"adequate": False}, "The model is not adequate", "33.2 ± 1.6°"),
        ({"values": {"friction_angle": 33.0}}, "", "35.6 ± 0.8°"),
    ],
)
def test_a_comparison_judges_the_estimate_that_it_was_made_at(
    run: Path, page_of: PageOf, misfit: dict[str, Any], change: dict[str, Any], verdict: str, quoted: str
) -> None:
    write_json(run / "comparison" / "misfit.json", {**misfit, **change})
    page = page_of(run)
    assert quoted in page.text and verdict in page.text and "Which model?" not in page.text
    assert (misfit["sentences"][0] in page.text) is bool(verdict) is ('id="checks"' in page.html)
    # A simulation failed and the cameras' noise is small: neither is an alarm where the model is adequate, and no
    # other one has a large number.
    adequate, body = verdict == "The model is adequate.", re.sub(r"<style>.*?</style>", "", page.html, flags=re.DOTALL)
    assert bool(re.search(r'class="(warning|[a-z]+ open)"', body)) is not adequate
    assert bool(re.search(r'class="answer determined small"', body)) is not adequate
    assert ("of a model that is not adequate" in body) is ("adequate" in change)


def test_the_truth_of_a_simulated_set_stands_beside_the_estimate(run: Path, page_of: PageOf) -> None:
    file = run / "set" / "truth.json"
    assert "true" not in page_of(run).text.lower()
    for truth in ({"parameters": {"friction_angle": 36}}, {"phi": 36.04}):
        write_json(file, truth)
        assert "35.6 ± 0.8° true: 36.0°" in page_of(run).text
    write_json(file, {"phi": "36", "parameters": 3})
    assert "true:" not in page_of(run).text


# A diagnosis, and an effect that was added.


def test_the_verdict_stands_on_top_with_its_reasons(added: Path, page_of: PageOf, misfit: dict[str, Any]) -> None:
    page = page_of(added)
    assert all(f["before"] != f["predicted"] for camera in frames_of(page) for f in camera["frames"])
    assert "Observed, before, after, difference" in page.text
    assert "Missing: effect 2. Added. A sentence that says why." in page.text
    assert page.text.index("Missing: effect 2.") < page.text.index("Which model?") < page.text.index("Where it fails")
    assert "The error falls" in page.text and "camera right and the withdrawal" in page.text
    assert "base: 5.2, noise 1.2; + effect 2: 1.3, noise 1.2" in page.html
    models = page.section("models")
    assert [shown(row) for row in re.findall(r"<tr.*?</tr>", models, re.DOTALL)[1:]] == [
        "effect 2 97 % 550 ± 160 Pa 120 Pa",
        "as it is 2.2 % – –",
        "something else &lt; 0.5 % – –",
        "tilt &lt; 0.5 % 0.31 ± 0.22° 0.54°",
    ]
    assert models.count('class="little"') == 2
    assert "effect 2 : adds strength." in shown(models) and "leans." not in models
    checks = page.section("checks")
    assert re.search(r"<tr><td>push</td><td>berm</td><td>left</td><td>2.3</td><td>0.003</td>", checks)
    assert re.search(r'<tr class="little"><td>push</td><td>track</td>', checks)
    assert "1.3 × that of pairs of coarse and fine runs" in shown(checks)
    told = {**misfit, "fit": "effect_2", "values": {"friction_angle": 35.62, "effect_2": 7.0}}
    write_json(added / "comparison" / "misfit.json", told)
    text = page_of(added).text
    assert text.index("Missing: effect 2. Added.") < text.index("The model is adequate."), "of the latest fit"
    assert "No check fails." in text


def test_blocks_that_fail_are_outlined_on_their_photographs(
    added: Path, page_of: PageOf, diagnosis: dict[str, Any]
) -> None:
    diagnosis["maps"]["effect_2"][2][3:6] = [2.5, 3.0, -1.0]
    write_json(added / "diagnoses" / "base.json", diagnosis)
    (figure,) = re.findall(r'<figure class="outlined">.*?</figure>', page_of(added).html, re.DOTALL)
    assert shown(figure) == "Berm during push, left camera : 2.3 × expected. It begins at frame 30."
    # The compared frame nearest to 30 is 50.
    assert base64.b64encode((added / "comparison" / "left_50_observed.jpg").read_bytes()).decode() in figure
    squares = re.findall(r'<polygon points="([^"]+)" class="(\w+)"', figure)
    assert sorted(kind for _, kind in squares) == ["beyond", "beyond", "within"]
    corners = " ".join(f"{u},{v}" for u, v in diagnosis["sites"][4][3])
    assert (corners, "beyond") in squares


def test_force_before_and_after_an_addition_is_in_newtons_without_a_diagnosis(added: Path, page_of: PageOf) -> None:
    (added / "diagnoses" / "base.json").unlink()
    for folder, predicted in (("before", [10.0, 20.0]), ("comparison", [33.0, None])):
        channel = {"channel": "force along", "measured": [30.0, None], "predicted": predicted}
        force = {"unit": "N", "frames": FRAMES, "channels": [channel]}
        update(added / folder / "comparison.json", force=force)
    section = page_of(added).section("force")
    assert "Force along: root mean square error 3 N; largest measured 30 N." in shown(section)
    for label in ("measured", "before", "after", "force along [N]"):
        assert f">{label}<" in section
    assert "± expected" not in section


def test_one_answer_is_averaged_over_models(added: Path, page_of: PageOf, diagnosis: dict[str, Any]) -> None:
    shutil.copy(added / "fits" / "base.json", added / "fit.json")
    text = page_of(added).text
    assert "friction angle 33.2 ± 1.6°" in text and "Added." not in text and "averaged over models" in text
    write_json(added / "diagnoses" / "base.json", {**diagnosis, "verdict": "undecided"})
    text = page_of(added).text
    assert "Undecided: the data do not discriminate" in text and "friction angle 33.2 ± 1.6°" in text


def test_without_an_added_effect_the_error_is_of_the_models_compared(
    added: Path, page_of: PageOf, diagnosis: dict[str, Any]
) -> None:
    (added / "history.json").unlink()
    page = page_of(added)
    assert "as it is: 5.2, noise 1.2; effect 2: 1.3, noise 1.2" in page.html and "The error falls" in page.text
    held_out = [{**entry, "error": 1.25} for entry in diagnosis["held_out"]]
    for told, says in ((held_out, True), (held_out[:1], False)):
        write_json(added / "diagnoses" / "base.json", {**diagnosis, "held_out": told})
        text = page_of(added).text
        assert ("The error does not fall" in text) is says and ("The error" in text) is says


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


# What is missing or damaged.


@pytest.mark.parametrize(
    ("file", "contents", "says"),
    [
        ("run.json", None, "run.json"),
        ("run.json", '{"format": "splatsoil-run/1", "meas', "run.json: is not JSON"),
        ("run.json", '{"format": "splatsoil-run/9"}', "run.json: isn't of format"),
        ("fit.json", None, "no fit has been finished"),
        ("fit.json", "{", "fit.json"),
        ("comparison/left_0_observed.jpg", None, "left_0_observed.jpg"),
        ("comparison/left_0_observed.jpg", "<svg>", r"left_0_observed\.jpg: is no whole JPEG or PNG image"),
        (
            "comparison/left_50_difference.jpg",
            -300,
            r"left_50_difference\.jpg: is no whole .*; run `splatsoil compare`",
        ),
        ("reconstruction/surface.npz", "x", r"surface\.npz"),
        ("reconstruction/surface.npz", -100, r"surface\.npz.*; delete the folder .*reconstruction;"),
        ("reconstruction/reconstruction.json", "[]", "reconstruction.json: isn't of format"),
        ("history.json", '{"format": "splatsoil-history/2"}', "history.json.*lacks models"),
    ],
)
def test_what_is_missing_or_damaged_is_named(run: Path, file: str, contents: str | int | None, says: str) -> None:
    path = run / file
    if contents is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:contents] if isinstance(contents, int) else contents.encode())
    with pytest.raises(RunError, match=says):
        write_report(run)
    assert not (run / "report.html").exists()


# A browser.

needs_browser = pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")


def in_a_frame(page: Path, width: int, expression: str, script: str = "") -> str:
    """What a JavaScript expression gives in a page, once it is loaded. Headless windows are never narrower than 500
    pixels: a frame is."""
    probe = (
        f"<script>{script}</script><script>addEventListener('load', async () => {{ "
        f"parent.document.querySelector('output').textContent = {expression}; }});</script></body>"
    )
    inner = page.read_text().replace("</body>", probe)
    framed = page.parent / "framed.html"
    framed.write_text(
        f'<title></title><iframe style="border:0;width:{width}px;height:900px" srcdoc="{html.escape(inner)}"></iframe>'
        "<output></output>"
    )
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={page.parent}/profile"]
    done = subprocess.run(
        [*command, "--enable-logging=stderr", "--virtual-time-budget=20000", "--dump-dom", framed.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found = re.search(r"<output>(.*)</output>", done.stdout, re.DOTALL)
    assert found is not None and found.group(1) and "CONSOLE" not in done.stderr, done.stderr
    return html.unescape(found.group(1))


@needs_browser
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_lays_it_out_without_sideways_scrolling(added: Path, width: int) -> None:
    """Moved to its left end, the slider shows the first frame; on a phone all pictures are of one size."""
    content, window, frame, sizes = in_a_frame(
        write_report(added),
        width,
        "(() => { const s = document.getElementById('frame'); s.value = 0; s.dispatchEvent(new Event('input'));"
        "const sizes = [...document.querySelectorAll('.strip img')]"
        ".map(i => Math.round(i.getBoundingClientRect().width));"
        "return [document.documentElement.scrollWidth, innerWidth, document.querySelector('.frame').textContent,"
        "sizes.join(',')].join(' '); })()",
    ).split()
    assert int(window) == width >= int(content) and int(frame) == FRAMES[0]
    assert len(sizes.split(",")) == 8 and (width > 390 or len(set(sizes.split(","))) == 1)


@needs_browser
def test_a_keyboard_reaches_what_scrolls(run: Path, misfit: dict[str, Any]) -> None:
    misfit["checks"][1]["region"] = "behind-the-tool-and-beside-it"
    write_json(run / "comparison" / "misfit.json", misfit)
    found = in_a_frame(
        write_report(run),
        250,
        "[...document.querySelectorAll('main *')].filter(e => e.scrollWidth > e.clientWidth + 1"
        " && getComputedStyle(e).overflowX == 'auto').map(e => e.tabIndex).join(' ')",
    )
    assert set(found.split()) == {"0"}


@needs_browser
@pytest.mark.skipif(find_spec("axe_core_python") is None, reason="needs axe-core")
@pytest.mark.parametrize(("adequate", "width"), [(True, 1200), (False, 390)])
def test_accessibility_has_no_serious_fault(run: Path, misfit: dict[str, Any], adequate: bool, width: int) -> None:
    write_json(run / "comparison" / "misfit.json", {**misfit, "adequate": adequate})
    found = in_a_frame(
        write_report(run),
        width,
        "JSON.stringify((await axe.run(document)).violations.filter(v => ['serious', 'critical'].includes(v.impact))"
        ".map(v => [v.id, v.nodes.map(n => n.html.slice(0, 200))]))",
        script=Path(str(files("axe_core_python") / "axe.min.js")).read_text(encoding="utf-8"),
    )
    assert json.loads(found) == []


def test_the_report_knows_nothing_of_how_a_fit_is_made() -> None:
    script = (
        "import sys, splatsoil.report, splatsoil.report.page, splatsoil.report.figures, splatsoil.report.data;"
        "print([m for m in sys.modules if m.startswith(('splatsoil.inverse', 'splatsoil.model', 'torch'))])"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


# A posterior.


MARGINAL = {
    "mean": 35.0,
    "std": 1.0,
    "low": 33.41,
    "high": 36.58,
    "low_50": 34.3,
    "high_50": 35.7,
    "unit": "deg",
    "histogram": {"edges": [20.0, 30.0, 40.0, 50.0], "density": [0.2, 2.5, 0.3]},
}
POSTERIOR = {
    "format": "splatsoil-posterior/2",
    "parameters": {
        "friction_angle": {**MARGINAL, "verdict": "determined", "contraction": 0.12, "title": "friction angle [°]"},
        "cohesion": {**MARGINAL, "verdict": "not determined", "contraction": 0.97, "title": "cohesion [Pa]"},
    },
    "notes": ["cohesion is not determined by this experiment: …", "The chains have not converged."],
    "simulations": 31,
    "chains": {"effective": 5268.0, "r_hat": 1.001},
    "fit": "base",
    "values": {"friction_angle": 35.62},
}


def test_a_posterior_is_told_and_what_it_leaves_open_has_no_number(run: Path, page_of: PageOf) -> None:
    write_json(run / "posterior.json", POSTERIOR)
    (run / "posterior").mkdir()
    Image.new("RGB", (9, 9)).save(run / "posterior" / "corner.png")
    page = page_of(run)
    assert "With 90 % probability the friction angle lies between 33.4 and 36.6°." in page.text
    assert "The cohesion is not identified: its spread is still 97 %" in page.text
    (sentence,) = re.findall(r"<p class=\"reason\">(The cohesion[^<]*)</p>", page.html)
    assert re.findall(r"\d+", sentence) == ["97"], "no value of what is not identified"
    assert "The chains have not converged." in page.text and "cohesion is not determined by" not in page.text
    # A picture for each parameter, and the corner with all of them.
    section = page.section("posterior")
    assert section.count("<svg") == 2 and section.count("data:image/png;base64") == 1
    for change in ({"fit": "cohesion"}, {"values": {"friction_angle": 35.0}}):
        update(run / "posterior.json", **{**POSTERIOR, **change})
        assert "What the pictures leave possible" not in page_of(run).text, "it is of another fit"
