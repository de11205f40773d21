"""Run folders as commands leave them, and the page as a browser's parser sees it."""

from __future__ import annotations

from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatsoil.files import write_json
from splatsoil.report import write_report

FRAMES = (0, 50)
STAGES = ["plunge", "push", "push", "withdrawal"]
SITES = [
    ["left", x, y, [[x, y], [x + 0.1, y], [x + 0.1, y + 0.1], [x, y + 0.1]]]
    for y in (0.0, 0.1)
    for x in (0.0, 0.1, 0.2)
] + [["force", None, None, []]]
REGIONS = [["track"] * 3 + ["berm"] * 3 + ["tool"]] * len(STAGES)


def compared(name: str, probability: float, estimate: Any, std: Any, unit: str, detectable: Any, note: str) -> Any:
    """A model of a diagnosis."""
    kind = {"": "base", "something else": "discrepancy"}.get(name, "physics")
    size = {"estimate": estimate, "std": std, "unit": unit, "detectable": detectable}
    return {"name": name, "kind": kind, "note": note, "probability": probability, **size}


@pytest.fixture
def misfit() -> dict[str, Any]:
    """The base model is adequate; also what a diagnosis has in common with that."""
    before: list[list[float | None]] = [[0.5 * t - 0.3 * s for s in range(len(SITES))] for t in range(len(STAGES))]
    before[0][2] = None
    check = {"stage": "push", "channel": "left", "n": 40}
    curve = {"channel": "force", "unit": "N", "measured": [1.0, 4.0, None, 2.0]}
    band = {"low": [0.9, 3.6, None, 1.8], "high": [1.1, 4.4, None, 2.2]}
    return {
        "format": "splatsoil-misfit/3",
        "adequate": True,
        "probability": 0.971,
        "passes": True,
        "fit": "base",
        "values": {"friction_angle": 35.62},
        "estimates": {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}},
        "sentences": ["A sentence that says why."],
        "checks": [
            {**check, "region": "berm", "ratio": 2.31, "p": 0.003},
            {**check, "region": "track", "ratio": 1.12, "p": 0.6},
        ],
        "discretisation_factor": 1.3,
        "unit": "grey levels",
        "time_name": "frame",
        "times": [10, 20, 30, 40],
        "stages": STAGES,
        "sites": SITES,
        "regions": REGIONS,
        "curves": [{**curve, **band, "predicted": {"before": [1.0, 3.0, None, 2.0]}}],
        "maps": {"before": before},
    }


@pytest.fixture
def diagnosis(misfit: dict[str, Any]) -> dict[str, Any]:
    """Effect 2 is missing in the base model."""
    shared = {key: value for key, value in misfit.items() if key not in ("adequate", "probability")}
    (curve,), before = misfit["curves"], misfit["maps"]["before"]
    effect = [[None if v is None else 0.1 * v for v in row] for row in before]
    predicted = {**curve["predicted"], "effect_2": [1.0, 4.1, None, 2.0]}
    return {
        **shared,
        "format": "splatsoil-diagnosis/3",
        "passes": False,
        "model": [],
        "maps": {"before": before, "effect_2": effect},
        "curves": [{**curve, "predicted": predicted}],
        "verdict": "missing",
        "class": ["effect_2"],
        "models": [
            compared("effect_2", 0.973, 553.7, 160.7, "Pa", 120.0, "adds strength."),
            compared("", 0.022, None, None, "1", None, ""),
            compared("something else", 0.0042, None, None, "1", None, ""),
            compared("tilt", 0.0008, 0.31, 0.22, "deg", 0.54, "leans."),
        ],
        "held_out": [
            {"model": "", "error": 5.2, "noise": 1.24, "log_score": -900.0},
            {"model": "effect_2", "error": 1.31, "noise": 1.24, "log_score": -700.0},
        ],
        "held_out_data": "camera right and the withdrawal",
        "notes": ["One thing to know."],
    }


def write_comparison(folder: Path, of: dict[str, Any], shade: int = 100) -> None:
    """Pictures and losses at a fit's estimate."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for camera in ("left", "right"):
        for frame in FRAMES:
            entry: dict[str, Any] = {"camera": camera, "frame": frame, "losses": {"robust": 0.02, "rgb": 0.001}}
            for kind in ("observed", "predicted", "difference"):
                entry[kind] = f"{camera}_{frame}_{kind}.jpg"
                Image.new("RGB", (64, 48), (frame, 20 * len(kind), shade)).save(folder / entry[kind])
            frames.append(entry)
    data = {
        "format": "splatsoil-comparison/1",
        "fit": of["name"],
        "parameters": {name: p["estimate"] for name, p in of["parameters"].items()},
        "loss": "robust",
        "total": {"robust": 0.02},
        "noise": {"robust": 0.005},
        "motionless": {"robust": 1.0},
        "gain": 4.0,
        "cameras": ["left", "right"],
        "frames": frames,
    }
    write_json(folder / "comparison.json", data)


@pytest.fixture
def make_run(tmp_path: Path, fit_of: Callable[..., dict[str, Any]]) -> Callable[..., Path]:
    """Makes a run folder that was fitted, reconstructed and compared."""

    def make(name: str = "plow") -> Path:
        measurement = {"name": name, "folder": str(tmp_path / "set"), "hash": "ab" * 32}
        description = {"format": "splatsoil-run/1", "measurement": measurement, "preset": "small", "seed": 5}
        write_json(tmp_path / "run.json", description)
        fit = fit_of(friction_angle=35.62)
        for file in ("fit.json", "fits/base.json"):
            write_json(tmp_path / file, fit)
        told = {"held_out": [{}, {}], "psnr": 31.24, "ssim": 0.931, "gaussians": 24011, "seconds": 131.0}
        file = tmp_path / "reconstruction" / "reconstruction.json"
        write_json(file, {"format": "splatsoil-reconstruction/1", **told})
        x, y = np.linspace(0.0025, 0.0975, 20), np.linspace(0.0025, 0.0475, 10)
        np.savez(tmp_path / "reconstruction" / "surface.npz", x=x, y=y, height=0.1 + 0.1 * y[:, None] * x)
        write_comparison(tmp_path / "comparison", fit)
        return tmp_path

    return make


@pytest.fixture
def run(make_run: Callable[..., Path]) -> Path:
    """One that was not diagnosed."""
    return make_run()


@pytest.fixture
def added(run: Path, diagnosis: dict[str, Any], fit_of: Callable[..., dict[str, Any]]) -> Path:
    """One whose diagnosis named effect 2, which was added."""
    base, after = fit_of(friction_angle=35.62), fit_of(["effect_2"], friction_angle=35.62, effect_2=7.0)
    for file in ("fit.json", "fits/effect_2.json"):
        write_json(run / file, after)
    write_json(run / "diagnoses" / "base.json", diagnosis)
    lines = [
        {"effects": made["setup"]["effects"], "loss": 0.2, "noise_level": 1.24, "model": made["name"]}
        | {"held_out": error}
        | {"parameters": {k: {n: p[n] for n in ("estimate", "std", "unit")} for k, p in made["parameters"].items()}}
        for made, error in ((base, 5.2), (after, 1.31))
    ]
    lines[1]["added"] = "effect_2"
    write_json(run / "history.json", {"format": "splatsoil-history/2", "models": lines})
    write_comparison(run / "before", base, 40)
    write_comparison(run / "comparison", after, 200)
    return run


class Page(HTMLParser):
    """Tags in balance, text, and every address that the page mentions.

    Attributes:
        html: the source.
    """

    VOID = ("meta", "img", "input", "br", "link")

    def __init__(self, run: Path) -> None:
        super().__init__()
        self.html = write_report(run).read_text()
        self.open = list[str]()
        self.addresses, self.words, self.tags = list[str](), list[str](), list[str]()
        self.feed(self.html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attributes if k in ("src", "href", "xlink:href", "action", "srcset")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def section(self, name: str) -> str:
        """The source of a part of the page."""
        return self.html[self.html.index(f'id="{name}"') :].split("</section>")[0]


@pytest.fixture(scope="session")
def page_of() -> Callable[[Path], Page]:
    """Writes a run's page, and reads it."""
    return Page
