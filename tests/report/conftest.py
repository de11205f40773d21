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


def compared(name: str, probability: float, **size: Any) -> dict[str, Any]:
    kind = {"": "base", "something else": "discrepancy"}.get(name, "physics")
    none = {"parameter": None, "estimate": None, "std": None, "unit": "1", "off": 0.0, "meaningful": 0.0}
    told = {"name": name, "kind": kind, "note": "", "probability": probability, "log_evidence": 0.0}
    return {**told, "values": {"angle": 1.0}, "stds": {"angle": 0.5}, **none, "detectable": None, **size}


def judgement() -> dict[str, Any]:
    """What a diagnosis and a comparison have in common."""
    before = [[0.5 * t - 0.3 * s for s in range(len(SITES))] for t in range(len(STAGES))]
    before[0][2] = None
    check = {"stage": "push", "channel": "left", "n": 40}
    return {
        "fit": "base",
        "values": {"friction_angle": 35.62},
        "estimates": {"friction_angle": {"value": 33.21, "std": 1.64, "determined": True}},
        "sentences": ["A sentence that says why."],
        "checks": [
            {**check, "region": "berm", "ratio": 2.31, "p": 0.003},
            {**check, "region": "track", "ratio": 1.12, "p": 0.6},
        ],
        "passes": False,
        "numerics": 1.3,
        "unit": "grey levels",
        "time_name": "frame",
        "times": [10, 20, 30, 40],
        "stages": STAGES,
        "sites": SITES,
        "regions": REGIONS,
        "curves": [
            {
                "channel": "force",
                "unit": "N",
                "measured": [1.0, 4.0, None, 2.0],
                "low": [0.9, 3.6, None, 1.8],
                "high": [1.1, 4.4, None, 2.2],
                "predicted": {"before": [1.0, 3.0, None, 2.0]},
            }
        ],
        "maps": {"before": before},
        "simulations": 57,
    }


@pytest.fixture
def diagnosis() -> dict[str, Any]:
    """Effect 2 is missing in the base model."""
    told = judgement()
    told["maps"]["effect_2"] = [[None if v is None else 0.1 * v for v in row] for row in told["maps"]["before"]]
    told["curves"][0]["predicted"]["effect_2"] = [1.0, 4.1, None, 2.0]
    size = {"parameter": "effect_2", "unit": "Pa", "meaningful": 40.0}
    return {
        "format": "splatsoil-diagnosis/2",
        "model": [],
        **told,
        "verdict": "missing",
        "class": ["effect_2"],
        "models": [
            compared("effect_2", 0.973, estimate=553.7, std=160.7, detectable=120.0, note="adds strength.", **size),
            compared("", 0.022),
            compared("something else", 0.0042),
            compared("tilt", 0.0008, estimate=0.31, std=0.22, unit="deg", detectable=0.54, note="leans."),
        ],
        "held_out": [
            {"model": "", "error": 5.2, "noise": 1.24, "log_score": -900.0},
            {"model": "effect_2", "error": 1.31, "noise": 1.24, "log_score": -700.0},
        ],
        "aside": "camera right and the withdrawal",
        "simulated_now": 12,
        "seconds": 81.2,
        "preset": "tiny",
        "device": "cpu",
        "version": "0",
        "code": "ab",
        "seed": 0,
        "notes": ["One thing to know."],
    }


@pytest.fixture
def misfit() -> dict[str, Any]:
    """The base model is adequate."""
    return {"format": "splatsoil-misfit/2", "adequate": True, "probability": 0.971, **judgement(), "passes": True}


def fit(name: str = "base", effects: tuple[str, ...] = (), **changes: Any) -> dict[str, Any]:
    """What ``fit.json`` holds: 35.62 ± 0.81°, and 7 of each effect."""
    x = np.linspace(20.0, 50.0, 31)
    entry = {"std": 0.81, "low": 34.0, "high": 37.1, "bounds": [20.0, 50.0], "at_bound": None, "determined": True}
    parameters = {"friction_angle": {"estimate": 35.62, "unit": "deg", "title": "friction angle [°]", **entry}}
    parameters |= {effect: {"estimate": 7.0, "unit": "1", "title": effect, **entry} for effect in effects}
    steps = [(30.0, 31.0, "ok", ""), (40.0, 20.0, "ok", ""), (21.0, None, "failed", "particles left the grid")]
    return {
        "format": "splatsoil-fit/2",
        "name": name,
        "parameters": parameters,
        "loss": 0.123,
        "best": {"loss": 0.12},
        "estimated_from": "loss",
        "minimum": {key: {"estimate": p["estimate"], "low": 34.0, "high": 37.1} for key, p in parameters.items()},
        "loss_std": 0.01,
        "noise_std": 0.02,
        "evaluations": 3,
        "failed": 1,
        "seconds": 83.0,
        "seed": 5,
        "device": "cpu",
        "preset": "small",
        "version": "0.1.0",
        "setup": {"effects": list(effects), "preset": "small"},
        "notes": [],
        "facts": {"cell": "20 mm", "time step": "0.25 ms"},
        "curves": {key: {"x": list(x), "mean": list((x - 35.6) ** 2), "std": [0.1] * 31} for key in parameters},
        "history": [
            {
                "step": step,
                "seed": 7,
                "parameters": dict.fromkeys(parameters, value),
                "loss": loss,
                "status": status,
                "message": message,
                "seconds": 8.0,
            }
            for step, (value, loss, status, message) in enumerate(steps)
        ],
    } | changes


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
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Makes a run folder that was fitted, reconstructed and compared."""

    def make(name: str = "plow") -> Path:
        measurement = {"name": name, "folder": str(tmp_path / "set"), "hash": "ab" * 32}
        description = {"format": "splatsoil-run/1", "measurement": measurement, "preset": "small", "seed": 5}
        write_json(tmp_path / "run.json", description)
        for file in ("fit.json", "fits/base.json"):
            write_json(tmp_path / file, fit())
        told = {"held_out": [{}, {}], "psnr": 31.24, "ssim": 0.931, "gaussians": 24011, "seconds": 131.0}
        file = tmp_path / "reconstruction" / "reconstruction.json"
        write_json(file, {"format": "splatsoil-reconstruction/1", **told})
        x, y = np.linspace(0.0025, 0.0975, 20), np.linspace(0.0025, 0.0475, 10)
        np.savez(tmp_path / "reconstruction" / "surface.npz", x=x, y=y, height=0.1 + 0.1 * y[:, None] * x)
        write_comparison(tmp_path / "comparison", fit())
        return tmp_path

    return make


@pytest.fixture
def run(make_run: Callable[..., Path]) -> Path:
    """One that was not diagnosed."""
    return make_run()


@pytest.fixture
def added(run: Path, diagnosis: dict[str, Any]) -> Path:
    """One whose diagnosis named effect 2, which was added."""
    base, after = fit(), fit("effect_2", ("effect_2",))
    for file in ("fit.json", "fits/effect_2.json"):
        write_json(run / file, after)
    write_json(run / "diagnoses" / "base.json", diagnosis)
    lines = [
        {
            "model": made["name"],
            "effects": made["setup"]["effects"],
            "parameters": {k: {n: p[n] for n in ("estimate", "std", "unit")} for k, p in made["parameters"].items()},
            "loss": 0.2,
            "held_out": error,
            "floor": 1.24,
        }
        for made, error in ((base, 5.2), (after, 1.31))
    ]
    lines[1]["added"] = "effect_2"
    write_json(run / "history.json", {"format": "splatsoil-history/1", "models": lines})
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
