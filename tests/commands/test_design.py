"""``design``: what it refuses and says; tests/commands/test_path.py makes one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands.design import show
from splatsoil.files import CRITICISM, code_digest, code_of, write_json
from splatsoil.report.data import estimates

KINDS = {"": "base", "something else": "discrepancy", "light": "observation"}


def diagnose(run: RunFolder, **changes: Any) -> None:
    """A diagnosis of the latest fit by the code as it is."""
    fit = run.fit()
    probability = changes.pop("probability", {"": 0.5, "cohesion": 0.5})
    data = {
        "format": "splatsoil-diagnosis/3",
        "fit": fit["name"],
        "values": estimates(fit),
        "model": [],
        "models": [{"name": n, "kind": KINDS.get(n, "physics"), "probability": p} for n, p in probability.items()],
        "draws": {},
        "candidates": [],
        "criticism_code": code_digest(CRITICISM),
        "code": code_of(fit["setup"]["effects"]),
        **changes,
    }
    write_json(run.path / "diagnosis.json", data)


@pytest.mark.usefixtures("no_work")
def test_what_there_is_nothing_to_design_from_is_refused(run: RunFolder, refused: Callable[..., str]) -> None:
    make = f"make one first: splatsoil diagnose '{run.path}'\n"
    assert refused("design", run).endswith(f"has no diagnosis; {make}")
    for changes in ({"values": {"friction_angle": 1.0}}, {"criticism_code": "other code"}, {"code": "other code"}):
        diagnose(run, **changes)
        assert refused("design", run).endswith(f"its diagnosis is of another fit, or by other code; {make}")
    for probability in ({"": 0.97, "cohesion": 0.03}, {"something else": 0.6, "light": 0.3, "": 0.1}):
        diagnose(run, probability=probability)
        assert "a stroke has no two models to distinguish" in refused("design", run)
    assert not (run.path / "design").exists()


def result(*alike: str) -> dict[str, Any]:
    """A design by which some strokes are as good as the best."""
    bits = {"half as fast": 0.8, "as measured": 0.7, "half as deep": 0.1}
    strokes = [
        {"name": n, "bits": b, "std": 0.05, "distinguished": [], "less_than_best": n not in alike}
        for n, b in bits.items()
    ]
    strokes[0]["distinguished"] = [["", "tool_adhesion"]]
    return {
        "models": {"": 0.6, "tool_adhesion": 0.4},
        "entropy": 0.97,
        "strokes": strokes,
        "notes": ["twice as fast: could not be simulated (no step is short enough)"],
        "simulated_now": 3,
        "seconds": 4.0,
    }


def test_the_table_shows_information_and_distinguished_models(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stroke is called better only beyond the error."""
    monkeypatch.setenv("COLUMNS", "120")
    best = "Largest expected information: half as fast, 0.80 ± 0.05 bits"
    show(result("as measured"))
    assert f"{best}; not significantly better than as measured." in capsys.readouterr().out
    show(result())
    out = capsys.readouterr().out
    assert f"{best}, significantly more than the others." in out
    assert "models: as it is (60 %) and tool adhesion (40 %); at most 0.97 bits of information" in out
    row = next(line for line in out.splitlines() if line.strip().startswith("half as fast"))
    assert "0.80 ± 0.05 bits" in row and "as it is from tool adhesion" in row
    assert "could not be simulated" in out
