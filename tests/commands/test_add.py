"""What ``add`` hands on to the fit, with everything that simulates taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from splatsoil.commands import _control, _criticism, _history, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.commands.add import added
from splatsoil.errors import RunError
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


def diagnosis(held_out: Sequence[str], notes: Sequence[str] = ()) -> dict[str, Any]:
    """What is used of a diagnosis.

    Args:
        held_out: effects whose error on what was set aside is told.
        notes: for people.
    """
    told = [{"model": "", "error": 5.0, "noise": 1.0}]
    told += [{"model": name, "error": 2.0, "noise": 1.5} for name in held_out]
    return {"held_out": told, "notes": list(notes)}


@dataclass
class Bench:
    """A run that has a fit of the friction angle, what is kept of its diagnosis, and what was asked of it."""

    kept: dict[str, Any] | None = None
    new: dict[str, Any] = field(default_factory=dict)
    diagnosed: list[Sequence[str]] = field(default_factory=list)
    fit_of: dict[str, Any] = field(
        default_factory=lambda: {
            "name": "base",
            "loss": 2.0,
            "parameters": {"friction_angle": {"estimate": 30.0, "std": 1.0, "unit": "deg", "title": "angle"}},
            "setup": {"effects": [], "preset": "tiny"},
        }
    )
    options: FitOptions | None = None
    history: list[dict[str, Any]] = field(default_factory=list)

    def diagnose(self, folder: object, model: object, begin: object, effects: Sequence[str]) -> dict[str, Any]:
        """A new diagnosis."""
        self.diagnosed.append(effects)
        return self.new

    def fitted(self, options: FitOptions, *others: Any) -> dict[str, Any]:
        """What the fit would keep."""
        self.options = options
        shown = {n: {"estimate": 1.0, "std": 0.5, "unit": "1", "title": n} for n in options.parameters}
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
        return added(cast(Any, folder), cast(Any, model), name, lambda stage: lambda what, share: None)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()
    monkeypatch.setattr(_criticism, "latest_diagnosis", lambda folder, effect: made.kept)
    monkeypatch.setattr(_criticism, "diagnosed", made.diagnose)
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
    bench.kept = diagnosis([known.name])
    entry = bench.add(effect)
    assert bench.options is not None
    assert bench.options.effects == (effect,)
    assert bench.options.parameters == ("friction_angle", *free)
    assert entry == bench.history[-1]
    assert entry["added"] == known.name
    assert set(entry["parameters"]) == {"friction_angle", *free}


def test_the_history_holds_errors_on_what_was_set_aside(bench: Bench) -> None:
    bench.kept = diagnosis(["cohesion"])
    bench.add("cohesion")
    assert [(entry["model"], entry["held_out"], entry["floor"]) for entry in bench.history] == [
        ("base", 5.0, 1.0),
        ("with it", 2.0, 1.5),
    ]


@pytest.mark.parametrize(
    ("kept", "asked"),
    [
        (diagnosis(["cohesion", "tilt"]), []),
        (None, [("cohesion",)]),
        (diagnosis(["tilt"]), [("cohesion",)]),
    ],
    ids=["all-known", "no-diagnosis", "error-unknown"],
)
def test_what_the_kept_diagnosis_does_not_say_is_asked_of_a_new_one(
    bench: Bench, kept: dict[str, Any] | None, asked: list[tuple[str, ...]]
) -> None:
    bench.kept, bench.new = kept, diagnosis(["cohesion"])
    entry = bench.add("cohesion")
    assert bench.diagnosed == asked
    assert entry["held_out"] == 2.0


def test_an_effect_that_cannot_be_simulated_is_refused(bench: Bench) -> None:
    bench.new = diagnosis([], notes=["cohesion: some simulations failed (soil left the bin)"])
    with pytest.raises(RunError, match=r"cohesion cannot be added: .*soil left the bin"):
        bench.add("cohesion")
    assert bench.options is None and bench.history == []


def test_a_diagnosis_by_other_code_is_none(tmp_path: Path) -> None:
    fit = {"name": "base", "setup": {"effects": []}, "parameters": {"friction_angle": {"estimate": 30.0}}}
    folder = cast(Any, SimpleNamespace(fit=lambda: fit, path=tmp_path))
    assert _criticism.latest_diagnosis(folder, "cohesion") is None
    data = {"format": "splatsoil-diagnosis/2", "model": [], "models": [], "values": {"friction_angle": 30.0}}
    data |= {"code": _control.code_of(()), "judged_by": _control.judged_by()}
    other = [{key: "of yesterday"} for key in ("code", "judged_by")] + [{"values": {"friction_angle": 31.0}}]
    for change, known in ({}, True), *((change, False) for change in other):
        write_json(tmp_path / "diagnoses" / "base.json", {**data, **change})
        assert (_criticism.latest_diagnosis(folder, "cohesion") is not None) is known
    (tmp_path / "own.py").write_text(OWN)
    assert _criticism.latest_diagnosis(folder, str(tmp_path / "own.py")) is None
