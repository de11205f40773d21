"""The page as a browser's parser sees it: complete, self-contained, and true to the run folder's files."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatsoil.errors import RunError
from splatsoil.files import write_json
from splatsoil.report import write_report

VOID = {"meta", "img", "input", "br", "link"}
FRAMES = (0, 50)


def fit(name: str = "base", **changes: Any) -> dict[str, Any]:
    x = np.linspace(20.0, 50.0, 31)
    return {
        "format": "splatsoil-fit/2",
        "name": name,
        "parameters": {
            "friction_angle": {
                "estimate": 35.62,
                "std": 0.81,
                "low": 34.0,
                "high": 37.1,
                "unit": "deg",
                "title": "friction angle [°]",
                "bounds": [20.0, 50.0],
                "at_bound": None,
                "determined": True,
            }
        },
        "loss": 0.123,
        "estimated_from": "loss",
        "minimum": {"friction_angle": {"estimate": 35.6, "low": 34.0, "high": 37.1}},
        "loss_std": 0.01,
        "noise_std": 0.02,
        "evaluations": 3,
        "failed": 1,
        "seconds": 83.0,
        "seed": 5,
        "device": "cpu",
        "preset": "small",
        "version": "0.1.0",
        "setup": {"effects": [], "preset": "small"},
        "notes": [],
        "facts": {"cell": "20 mm", "time step": "0.25 ms"},
        "curves": {"friction_angle": {"x": list(x), "mean": list((x - 35.6) ** 2), "std": [0.1] * 31}},
        "history": [
            {
                "step": 0,
                "seed": 7,
                "level": "full",
                "parameters": {"friction_angle": 30.0},
                "loss": 31.0,
                "status": "ok",
                "message": "",
                "seconds": 8.0,
            },
            {
                "step": 1,
                "seed": 7,
                "level": "full",
                "parameters": {"friction_angle": 40.0},
                "loss": 20.0,
                "status": "ok",
                "message": "",
                "seconds": 8.0,
            },
            {
                "step": 2,
                "seed": 7,
                "level": "full",
                "parameters": {"friction_angle": 21.0},
                "loss": None,
                "status": "failed",
                "message": "particles left the grid",
                "seconds": 2.0,
            },
        ],
    } | changes


def make_run(folder: Path, name: str = "plow", *, compare: bool = True, **changes: Any) -> Path:
    write_json(
        folder / "run.json",
        {
            "format": "splatsoil-run/1",
            "measurement": {"name": name, "folder": "sets/plow", "hash": "ab" * 32},
            "preset": "small",
            "seed": 5,
        },
    )
    latest = fit(**changes)
    write_json(folder / "fit.json", latest)
    write_json(folder / "fits" / f"{latest['name']}.json", latest)
    reconstruction = {
        "format": "splatsoil-reconstruction/1",
        "held_out": [{}, {}],
        "psnr": 31.24,
        "ssim": 0.931,
        "gaussians": 24011,
        "seconds": 131.0,
    }
    write_json(folder / "reconstruction" / "reconstruction.json", reconstruction)
    x, y = np.linspace(0.0025, 0.0975, 20), np.linspace(0.0025, 0.0475, 10)
    np.savez(folder / "reconstruction" / "surface.npz", x=x, y=y, height=0.1 + 0.1 * y[:, None] * x)
    if compare:
        frames = []
        for camera in ("left", "right"):
            for frame in FRAMES:
                entry: dict[str, Any] = {"camera": camera, "frame": frame, "losses": {"robust": 0.02, "rgb": 0.001}}
                for kind in ("observed", "predicted", "difference"):
                    entry[kind] = f"{camera}_{frame}_{kind}.jpg"
                    colour = (frame, 50 * len(kind) % 256, 100)
                    (folder / "comparison").mkdir(exist_ok=True)
                    Image.new("RGB", (8, 6), colour).save(folder / "comparison" / entry[kind])
                frames.append(entry)
        comparison = {
            "format": "splatsoil-comparison/1",
            "fit": latest["name"],
            "parameters": {"friction_angle": 35.62},
            "loss": "robust",
            "total": {"robust": 0.02},
            "noise": {"robust": 0.005},
            "motionless": {"robust": 1.0},
            "gain": 4.0,
            "cameras": ["left", "right"],
            "frames": frames,
        }
        write_json(folder / "comparison" / "comparison.json", comparison)
    return folder


class Page(HTMLParser):
    """Tags in balance, text, and every address the page mentions."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.tags: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attributes if k in ("src", "href", "xlink:href", "action", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.addresses += [v or "" for k, v in attributes if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def test_everything_is_on_the_page(tmp_path: Path) -> None:
    path = write_report(make_run(tmp_path))
    assert path == tmp_path / "report.html"
    page = Page(path.read_text())
    assert page.open == []
    for phrase in (
        "35.6 ± 0.8°",
        "The misfit is 2 % of that of soil at rest, 4.0 × the camera noise",
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


def test_the_page_asks_for_nothing_from_anywhere(tmp_path: Path) -> None:
    text = write_report(make_run(tmp_path)).read_text()
    page = Page(text)
    assert page.addresses
    assert all(a.startswith(("data:image/", "#")) for a in page.addresses)
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest|<link", text)
    assert "default-src 'none'" in text


def test_every_compared_frame_of_every_camera_is_there(tmp_path: Path) -> None:
    text = write_report(make_run(tmp_path)).read_text()
    found = re.search(r'<script type="application/json" id="frames">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    cameras = json.loads(found.group(1))
    assert [c["camera"] for c in cameras] == ["left", "right"]
    assert all([f["frame"] for f in c["frames"]] == list(FRAMES) for c in cameras)
    pictures = {f[kind] for c in cameras for f in c["frames"] for kind in ("observed", "predicted", "difference")}
    assert len(pictures) == 6 and all(p.startswith("data:image/jpeg;base64,") for p in pictures)


def test_names_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    evil = "</title></script><script>alert(1)</script>\"'"
    text = write_report(make_run(tmp_path, name=evil)).read_text()
    assert "alert(1)</script>" not in text.replace("&lt;", "<lt>")
    page = Page(text)
    assert page.open == [] and "<script>alert(1)" in page.text


def test_colours_follow_the_theme(tmp_path: Path) -> None:
    text = write_report(make_run(tmp_path)).read_text()
    assert "prefers-color-scheme: dark" in text
    charts = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    for chart in charts:
        assert "var(--ink)" in chart
        assert not re.search(r"(fill|stroke): #(?!none)(000000|ffffff)", chart)
        assert "width=" not in chart.split(">", 1)[0]


def test_a_run_that_has_only_been_fitted(tmp_path: Path) -> None:
    make_run(tmp_path, compare=False)
    shutil.rmtree(tmp_path / "reconstruction")
    page = Page(write_report(tmp_path).read_text())
    assert page.open == [] and page.tags.count("svg") == 1
    assert "has not been compared" in page.text


def test_a_comparison_at_another_estimate_is_not_shown(tmp_path: Path) -> None:
    make_run(tmp_path)
    latest = fit()
    latest["parameters"]["friction_angle"]["estimate"] = 33.0
    write_json(tmp_path / "fit.json", latest)
    assert "has not been compared" in Page(write_report(tmp_path).read_text()).text


def test_a_comparison_judges_the_estimate_that_it_was_made_at(tmp_path: Path, misfit: dict[str, Any]) -> None:
    make_run(tmp_path)
    misfit["values"] = {"friction_angle": 35.62}
    misfit["estimates"] = {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}}
    for change, verdict, quoted in (
        ({}, "The model is adequate.", "33.2 ± 1.6°"),
        ({"adequate": False}, "The model is not adequate", "33.2 ± 1.6°"),
        ({"values": {"friction_angle": 33.0}}, "", "35.6 ± 0.8°"),
    ):
        write_json(tmp_path / "comparison" / "misfit.json", {**misfit, **change})
        page = write_report(tmp_path).read_text()
        text = Page(page).text
        assert quoted in text and verdict in text
        assert (misfit["sentences"][0] in text) is bool(verdict) is ('id="checks"' in page)
        assert "Which model?" not in text
        # what is left is no alarm where noise and numerics leave as much
        assert ('class="verdict open"' in page) is not (verdict == "The model is adequate.")


def test_the_truth_of_a_simulated_set_stands_beside_the_estimate(tmp_path: Path) -> None:
    make_run(tmp_path)
    truths = tmp_path / "set"
    described = json.loads((tmp_path / "run.json").read_text())
    described["measurement"]["folder"] = str(truths)
    write_json(tmp_path / "run.json", described)
    assert "true" not in Page(write_report(tmp_path).read_text()).text.lower()
    for truth in ({"parameters": {"friction_angle": 36}}, {"phi": 36.04}):
        write_json(truths / "truth.json", truth)
        assert "35.6 ± 0.8° true: 36.0°" in Page(write_report(tmp_path).read_text()).text
    write_json(truths / "truth.json", {"phi": "36", "parameters": 3})
    assert "true:" not in Page(write_report(tmp_path).read_text()).text


def test_an_adequate_page_has_no_alarm_and_only_an_adequate_one_has_a_large_number(
    tmp_path: Path, misfit: dict[str, Any]
) -> None:
    make_run(tmp_path)
    misfit["values"] = {"friction_angle": 35.62}
    misfit["estimates"] = {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}}
    for adequate in (True, False, None):
        if adequate is None:
            (tmp_path / "comparison" / "misfit.json").unlink()
        else:
            write_json(tmp_path / "comparison" / "misfit.json", {**misfit, "adequate": adequate})
        page = write_report(tmp_path).read_text()
        # A simulation failed and the cameras' noise is small: neither is an alarm where the model is adequate.
        body = re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
        assert bool(re.search(r'class="(warning|[a-z]+ open)"', body)) is not (adequate is True)
        assert bool(re.search(r'class="answer determined small"', body)) is not (adequate is True)
        assert ("of a model that is not adequate" in body) is (adequate is False)


def test_several_models_are_set_side_by_side(tmp_path: Path) -> None:
    make_run(tmp_path)
    write_json(tmp_path / "fits" / "cohesion.json", fit("cohesion", loss=0.05))
    page = Page(write_report(tmp_path).read_text())
    assert page.tags.count("svg") == 4
    assert page.text.index("base model with cohesion") > page.text.index("Models tried")


def test_same_files_same_page(tmp_path: Path) -> None:
    make_run(tmp_path)
    assert write_report(tmp_path).read_bytes() == write_report(tmp_path).read_bytes()


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda f: (f / "run.json").unlink(), "run.json"),
        (lambda f: (f / "fit.json").unlink(), "no fit has been finished"),
        (lambda f: (f / "fit.json").write_text("{"), "fit.json"),
        (lambda f: (f / "fit.json").write_text("{}"), "fit.json: isn't of format"),
        (lambda f: (f / "fit.json").write_text('{"format": "splatsoil-fit/2", "name": "base"}'), "lacks .*parameters"),
        (lambda f: (f / "comparison" / "left_0_observed.jpg").unlink(), "left_0_observed.jpg"),
        (lambda f: (f / "comparison" / "left_0_observed.jpg").write_text("<svg>"), "neither PNG nor JPEG"),
        (lambda f: (f / "reconstruction" / "surface.npz").write_text("x"), r"surface\.npz"),
        (
            lambda f: cut_short(f / "reconstruction" / "surface.npz"),
            r"surface\.npz.*; delete the folder .*reconstruction;",
        ),
        (
            lambda f: (f / "reconstruction" / "reconstruction.json").write_text("[]"),
            "reconstruction.json: isn't of format",
        ),
        (lambda f: (f / "history.json").write_text('{"format": "splatsoil-history/1"}'), "history.json.*lacks models"),
    ],
)
def test_what_is_missing_or_damaged_is_named(tmp_path: Path, damage: Any, says: str) -> None:
    make_run(tmp_path)
    damage(tmp_path)
    with pytest.raises(RunError, match=says):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


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
    out = subprocess.run(
        [*command, "--virtual-time-budget=20000", "--dump-dom", framed.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout
    found = re.search(r"<output>(.*)</output>", out, re.DOTALL)
    assert found is not None and found.group(1)
    return html.unescape(found.group(1))


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_lays_it_out_without_sideways_scrolling(tmp_path: Path, width: int) -> None:
    found = in_a_frame(
        write_report(make_run(tmp_path)),
        width,
        "(() => { const s = document.getElementById('frame'); s.value = 0; s.dispatchEvent(new Event('input'));"
        "return [document.documentElement.scrollWidth, innerWidth, document.querySelector('.frame').textContent]"
        ".join(' '); })()",
    )
    content, window, frame = map(int, found.split())
    assert window == width
    assert content <= window
    # Moving the slider to the left end shows the first frame.
    assert frame == FRAMES[0]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_every_picture_is_as_large_as_the_next_on_a_phone(tmp_path: Path) -> None:
    sizes = in_a_frame(
        write_report(make_run(tmp_path)),
        390,
        "[...document.querySelectorAll('.strip img')].map(i => Math.round(i.getBoundingClientRect().width)).join(' ')",
    ).split()
    assert len(sizes) == 6 and len(set(sizes)) == 1


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_keyboard_reaches_what_scrolls(tmp_path: Path, misfit: dict[str, Any]) -> None:
    make_run(tmp_path)
    misfit["estimates"] = {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}}
    misfit["checks"][1]["region"] = "behind-the-tool-and-beside-it"
    write_json(tmp_path / "comparison" / "misfit.json", {**misfit, "values": {"friction_angle": 35.62}})
    found = in_a_frame(
        write_report(tmp_path),
        250,
        "[...document.querySelectorAll('main *')].filter(e => e.scrollWidth > e.clientWidth + 1"
        " && getComputedStyle(e).overflowX == 'auto').map(e => e.tabIndex).join(' ')",
    )
    assert set(found.split()) == {"0"}


def axe() -> Path | None:
    """The rules of accessibility that a browser is to check, where they are installed."""
    if find_spec("axe_core_python") is None:
        return None
    return Path(str(files("axe_core_python") / "axe.min.js"))


@pytest.mark.skipif(shutil.which("chromium") is None or axe() is None, reason="needs chromium and axe-core")
@pytest.mark.parametrize(("adequate", "width"), [(True, 1200), (False, 390)])
def test_accessibility_has_no_serious_fault(tmp_path: Path, misfit: dict[str, Any], adequate: bool, width: int) -> None:
    rules = axe()
    assert rules is not None
    make_run(tmp_path)
    misfit["estimates"] = {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}}
    said = {**misfit, "values": {"friction_angle": 35.62}, "adequate": adequate}
    write_json(tmp_path / "comparison" / "misfit.json", said)
    found = in_a_frame(
        write_report(tmp_path),
        width,
        "JSON.stringify((await axe.run(document)).violations.filter(v => ['serious', 'critical'].includes(v.impact))"
        ".map(v => [v.id, v.nodes.map(n => n.html.slice(0, 200))]))",
        script=rules.read_text(encoding="utf-8"),
    )
    assert json.loads(found) == []


def test_the_report_knows_nothing_of_how_a_fit_is_made() -> None:
    script = (
        "import sys, splatsoil.report, splatsoil.report.page, splatsoil.report.figures, splatsoil.report.data;"
        "print([m for m in sys.modules if m.startswith(('splatsoil.inverse', 'splatsoil.model', 'torch'))])"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def marginal(verdict: str, contraction: float, title: str, unit: str) -> dict[str, Any]:
    return {
        "mean": 35.0,
        "std": 1.0,
        "median": 35.0,
        "low": 33.41,
        "high": 36.58,
        "low_50": 34.3,
        "high_50": 35.7,
        "unit": unit,
        "title": title,
        "bounds": [20.0, 50.0],
        "contraction": contraction,
        "verdict": verdict,
        "at_bound": [],
        "histogram": {"edges": [20.0, 30.0, 40.0, 50.0], "density": [0.2, 2.5, 0.3]},
    }


def posterior(folder: Path, fitted: str, angle: float) -> None:
    write_json(
        folder / "posterior.json",
        {
            "format": "splatsoil-posterior/2",
            "parameters": {
                "friction_angle": marginal("determined", 0.12, "friction angle [°]", "deg"),
                "cohesion": marginal("not determined", 0.97, "cohesion [Pa]", "Pa"),
            },
            "notes": ["cohesion is not determined by this experiment: …", "The chains have not converged."],
            "simulations": 31,
            "chains": {"effective": 5268.0, "r_hat": 1.001},
            "fit": fitted,
            "values": {"friction_angle": angle},
        },
    )
    (folder / "posterior").mkdir(exist_ok=True)
    Image.new("RGB", (9, 9)).save(folder / "posterior" / "corner.png")


def test_a_posterior_is_told_and_what_it_leaves_open_has_no_number(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    before = write_report(folder).read_text()
    assert "What the pictures leave possible" not in before
    posterior(folder, "base", 35.62)
    text = write_report(folder).read_text()
    page = Page(text)
    told = " ".join(" ".join(page.words).split())
    assert "With 90 % probability the friction angle lies between 33.4 and 36.6°." in told
    assert "The cohesion is not identified: its spread is still 97 %" in told
    (sentence,) = re.findall(r"<p class=\"reason\">(The cohesion[^<]*)</p>", text)
    assert re.findall(r"\d+", sentence) == ["97"], "no value of what is not identified"
    assert "The chains have not converged." in told and "cohesion is not determined by" not in told
    # A picture for each parameter, and the corner with all of them.
    section = text[text.index('id="posterior"') : text.index("Loss over the")]
    assert section.count("<svg") == 2 and section.count("data:image/png;base64") == 1
    assert all(address.startswith(("data:", "#")) for address in page.addresses)


@pytest.mark.parametrize(("fitted", "angle"), [("cohesion", 35.62), ("base", 35.0)])
def test_a_posterior_of_another_fit_is_not_shown(tmp_path: Path, fitted: str, angle: float) -> None:
    folder = make_run(tmp_path)
    posterior(folder, fitted, angle)
    assert "What the pictures leave possible" not in write_report(folder).read_text()


@pytest.mark.parametrize(
    "text",
    [
        '{"format": "splatsoil-run/1", "meas',
        "[]",
        "{}",
        '{"format": "splatsoil-run/1"}',
        '{"format": "splatsoil-run/9", "measurement": {"name": "", "folder": "", "hash": ""}, "preset": "", "seed": 0}',
    ],
)
def test_a_damaged_run_json_is_named_before_anything_else(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run\.json"):
        write_report(tmp_path)
