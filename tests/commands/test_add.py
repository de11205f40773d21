"""What ``add`` hands on to the fit, with everything that simulates taken out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.criticism.diagnosis import Options

from splatsoil.commands import _control, _criticism, _history, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.commands.add import added
from splatsoil.files import write_json
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

OWN = """
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect

class Crust(Effect):
    name = "crust"
    parameters = (
        Parameter("crust_angle", "deg", 0.0, 9.0, 0.0, off=0.0),
        Parameter("crust_depth", "m", 0.01, 1.0, 0.1, log=True),
        Parameter("crust_grain", "m", 1e-4, 1e-2, 1e-3, log=True),
    )
    shapes = ("crust_depth",)
"""


@dataclass
class Bench:
    """A run that has a fit of the friction angle, and what was asked of it."""

    refits: dict[str, Any]
    confirmed: dict[str, Any] | None = None
    fit_of: dict[str, Any] = field(
        default_factory=lambda: {
            "name": "base",
            "loss": 2.0,
            "parameters": {"friction_angle": {"estimate": 30.0, "std": 1.0, "unit": "deg", "title": "angle"}},
            "setup": {"effects": [], "preset": "tiny"},
        }
    )
    options: FitOptions | None = None
    refitted: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)

    def fitted(self, options: FitOptions, *others: Any, refitted: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
        """What the fit would keep: the refit's values."""
        self.options, self.refitted = options, refitted
        shown = {n: {"estimate": v, "std": s, "unit": "1", "title": n} for n, (v, s) in refitted.items()}
        setup = {"effects": list(options.effects), "preset": options.preset}
        return {"name": "with it", "loss": 1.0, "parameters": shown, "setup": setup}

    def add(self, name: str) -> dict[str, Any]:
        """One effect."""
        folder = SimpleNamespace(fit=lambda: self.fit_of, description={"seed": 0}, path=Path("run"))
        model = SimpleNamespace(
            measurement=SimpleNamespace(folder=Path("set")),
            device="cpu",
            variant=lambda effects: SimpleNamespace(law=Law(find_effects(effects))),
        )
        return added(cast(Any, folder), cast(Any, model), name, Options(), lambda stage: lambda what, share: None)


def refit(values: Mapping[str, float], chi2: float) -> dict[str, Any]:
    return {
        "values": dict(values),
        "stds": {name: 0.1 * value for name, value in values.items()},
        "chi2": chi2,
        "held_out": 0.1 * chi2,
        "floor": 1.0,
    }


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench({"as it is": refit({"friction_angle": 30.0}, 50.0)})
    monkeypatch.setattr(_criticism, "latest_diagnosis", lambda folder, effect: {"refits": made.refits})
    monkeypatch.setattr(_criticism, "confirmed", lambda *others: {"refits": made.confirmed})
    monkeypatch.setattr(_history, "history", lambda folder: made.history)
    monkeypatch.setattr(_history, "remember", lambda folder, entries, *_: setattr(made, "history", entries))
    monkeypatch.setattr(_criticism, "pictured", lambda folder: True)
    monkeypatch.setattr(_criticism, "keep_pictures", lambda folder: None)
    monkeypatch.setattr(_stages, "compared", lambda *others: {})
    monkeypatch.setattr(_stages, "fitted", made.fitted)
    return made


@pytest.mark.parametrize(
    ("effect", "free", "held"),
    [
        ("cohesion", ["cohesion"], []),
        ("dilatancy", ["dilatancy_angle", "dilatancy_strain"], []),
        ("layering", ["layer_friction", "layer_depth", "layer_density"], []),
        ("rate_dependence", ["rate_gain", "rate_inertial_number"], ["rate_grain_size", "rate_grain_density"]),
        ("crust.py", ["crust_angle", "crust_depth"], ["crust_grain"]),
    ],
)
def test_what_shapes_an_effect_is_fitted_with_it(
    bench: Bench, tmp_path: Path, effect: str, free: list[str], held: list[str]
) -> None:
    if effect.endswith(".py"):
        (tmp_path / effect).write_text(OWN)
        effect = str(tmp_path / effect)
    (known,) = find_effects([effect])
    assert {p.name for p in known.parameters} == {*free, *held}
    found = {"friction_angle": 33.0, **{name: 2.0 + k for k, name in enumerate(free)}}
    bench.refits[known.name] = refit(found, 20.0)
    entry = bench.add(effect)
    assert bench.options is not None
    assert bench.options.effects == (effect,)
    assert bench.options.parameters == ("friction_angle", *free)
    assert bench.refitted == {name: (value, pytest.approx(0.1 * value)) for name, value in found.items()}
    assert entry == bench.history[-1]
    assert (entry["added"], entry["fall"]) == (known.name, 30.0)
    assert {name: p["estimate"] for name, p in entry["parameters"].items()} == found


def test_a_refit_that_stopped_at_its_first_steps_is_made_anew(bench: Bench) -> None:
    first, whole = ({"friction_angle": 33.0, "cohesion": size} for size in (200.0, 300.0))
    bench.confirmed = {"as it is": refit({"friction_angle": 30.0}, 50.0), "cohesion": refit(whole, 20.0)}
    bench.refits["cohesion"] = {**refit(first, 40.0), "stopped": False}
    bench.add("cohesion")
    assert bench.refitted["cohesion"] == (200.0, pytest.approx(20.0))
    bench.refits["cohesion"]["stopped"] = True
    bench.add("cohesion")
    assert bench.refitted["cohesion"] == (300.0, pytest.approx(30.0))


def test_a_diagnosis_by_other_code_is_none(tmp_path: Path) -> None:
    fit = {"name": "base", "setup": {"effects": []}, "parameters": {"friction_angle": {"estimate": 30.0}}}
    folder = cast(Any, SimpleNamespace(fit=lambda: fit, path=tmp_path))
    assert _criticism.latest_diagnosis(folder, "cohesion") is None
    data = {"format": "splatsoil-diagnosis/1", "model": [], "refits": {}, "values": {"friction_angle": 30.0}}
    data |= {"code": _control.code_of(()), "judged_by": _control.judged_by()}
    other = [{key: "of yesterday"} for key in ("code", "judged_by")] + [{"values": {"friction_angle": 31.0}}]
    for change, known in ({}, True), *((change, False) for change in other):
        write_json(tmp_path / "diagnoses" / "base.json", {**data, **change})
        assert (_criticism.latest_diagnosis(folder, "cohesion") is not None) is known
    (tmp_path / "own.py").write_text(OWN)
    assert _criticism.latest_diagnosis(folder, str(tmp_path / "own.py")) is None


@pytest.mark.parametrize("kept", [None, ("friction_angle", "dilatancy_angle")], ids=["none", "before-shapes"])
def test_a_diagnosis_from_before_shapes_were_free_is_none(bench: Bench, kept: tuple[str, ...] | None) -> None:
    if kept is not None:
        bench.refits["dilatancy"] = refit(dict.fromkeys(kept, 9.0), 40.0)
    found = {"friction_angle": 33.0, "dilatancy_angle": 10.0, "dilatancy_strain": 2.0}
    bench.confirmed = {
        "as it is": refit({"friction_angle": 31.0}, 60.0),
        "dilatancy": refit(found, 20.0) | {"floor": 1.5},
    }
    entry = bench.add("dilatancy")
    assert {name: value for name, (value, _) in bench.refitted.items()} == found
    assert (entry["fall"], bench.history[0]["held_out"]) == (40.0, pytest.approx(6.0))
    assert [each["floor"] for each in bench.history] == [1.0, 1.5], "each model has what its own soil leaves"
