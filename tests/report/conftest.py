"""A diagnosis and a comparison as their commands keep them."""

from __future__ import annotations

from typing import Any

import pytest

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
    return {
        "fit": "base",
        "values": {"angle": -2.0},
        "estimates": {"angle": {"value": 1.03, "std": 0.42, "determined": True}},
        "sentences": ["A sentence that says why."],
        "checks": [
            {"stage": "push", "region": "berm", "channel": "left", "ratio": 2.31, "p": 0.003, "n": 40},
            {"stage": "push", "region": "track", "channel": "left", "ratio": 1.12, "p": 0.6, "n": 40},
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
        "experiment": "emulated",
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
