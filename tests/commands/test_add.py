"""``add``, with everything that simulates taken out: what it hands to the fit, keeps, and goes on from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import _model, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.files import CRITICISM, code_digest, code_of, read_json, write_json
from splatsoil.report.data import estimates
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

FitOf = Callable[..., dict[str, Any]]
ERRORS = {"base": 9.0, "cohesion": 5.0, "cohesion+tilt": 3.0}
SIZES = {"cohesion": 300.0, "tilt_x": 2.0, "tilt_y": 1.0}
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


class Stages:
    """Simulating ones, which count what they did and can be interrupted."""

    def __init__(self, run: RunFolder, fit_of: FitOf, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run, self.fit_of, self.done = run, fit_of, list[str]()
        self.stops_at: tuple[str, int] | None = None
        self.options = list[FitOptions]()
        self.simulated = True
        for place, name in (
            (_model, "model_of"),
            (_stages, "run_diagnosis"),
            (_stages, "run_fit"),
            (_stages, "draw_comparison"),
        ):
            monkeypatch.setattr(place, name, getattr(self, name))
        monkeypatch.setattr("splatsoil.report.write_report", self.report)
        self.draw_comparison(run)
        self.done.clear()

    def passed(self, what: str) -> None:
        """Something is done, or Ctrl-C is pressed."""
        self.done.append(what)
        if self.stops_at == (what, self.done.count(what)):
            raise KeyboardInterrupt

    def model_of(self, folder: RunFolder, *_: object, **__: object) -> Any:
        return self.model(folder.fit()["setup"]["effects"])

    def model(self, effects: Sequence[str]) -> Any:
        measurement = SimpleNamespace(folder=self.run.path)
        return SimpleNamespace(
            law=Law(find_effects(effects)), variant=self.model, measurement=measurement, device="cpu"
        )

    def run_diagnosis(self, folder: RunFolder, model: object, begin: object, effects: Sequence[str]) -> dict[str, Any]:
        (effect,) = find_effects(effects)
        self.passed(f"diagnose {effect.name}")
        return self.diagnosis(effect.name if self.simulated else "")

    def diagnosis(self, *names: str) -> dict[str, Any]:
        """Of the latest fit, with errors of the model as it is and of the best effect."""
        before = self.run.fit()
        after = {name: "+".join(sorted([*before["setup"]["effects"], name])) for name in names if name}
        fits = {"": before["name"], **after}
        held_out = [{"model": key, "error": ERRORS.get(fit, 4.0), "noise": 1.0} for key, fit in fits.items()]
        return {"held_out": held_out, "notes": ["it could not be simulated (soil left the bin)"]}

    def run_fit(self, options: FitOptions, *_: object) -> dict[str, Any]:
        self.options.append(options)
        fit = self.fit_of(options.effects, **{name: SIZES.get(name, 35.0) for name in options.parameters})
        fit["name"] = fit["name"].replace("/", "|")
        self.passed("fit")
        self.run.write_fit(fit["name"], fit)
        self.passed("fitted")
        return fit

    def draw_comparison(self, folder: RunFolder, *_: object) -> None:
        self.passed("compare")
        fit = folder.fit()
        data = {"format": "splatsoil-comparison/1", "fit": fit["name"], "parameters": estimates(fit)}
        write_json(folder.comparison / "comparison.json", data)
        self.passed("compared")

    def report(self, path: object) -> object:
        self.passed("report")
        return path

    def add(self, *effects: str) -> int:
        return cli.main(["add", str(self.run.path), *effects])

    def history(self) -> dict[str, Any]:
        return cast(dict[str, Any], read_json(self.run.path / "history.json"))


@pytest.fixture
def stages(run: RunFolder, fit_of: FitOf, monkeypatch: pytest.MonkeyPatch) -> Stages:
    return Stages(run, fit_of, monkeypatch)


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
    stages: Stages, tmp_path: Path, effect: str, free: list[str], held: list[str]
) -> None:
    if effect.endswith(".py"):
        (tmp_path / effect).write_text(OWN)
        effect = str(tmp_path / effect)
    (known,) = find_effects([effect])
    assert {p.name for p in known.parameters} == {*free, *held}
    assert stages.add(effect) == 0
    (options,) = stages.options
    assert options.effects == (effect,) and options.parameters == ("friction_angle", *free)
    after = stages.history()["models"][-1]
    assert after["added"] == known.name and set(after["parameters"]) == {"friction_angle", *free}


def test_what_a_current_diagnosis_says_is_not_asked_again(stages: Stages, tmp_path: Path) -> None:
    """One of another estimate, by other code, or without the effect's error, is none."""
    run = stages.run
    whole = {
        "format": "splatsoil-diagnosis/3",
        "fit": "base",
        "model": [],
        "models": [],
        "values": {"friction_angle": 35.0},
        "code": code_of(()),
        "criticism_code": code_digest(CRITICISM),
        **stages.diagnosis("cohesion"),
    }
    file = run.path / "diagnoses" / "base.json"
    for change in (
        {},
        {"code": "of yesterday"},
        {"criticism_code": "of yesterday"},
        {"values": {"friction_angle": 31.0}},
        stages.diagnosis("tilt"),
    ):
        stages.done.clear()
        write_json(file, {**whole, **change})
        stages.stops_at = ("fit", 1)
        assert stages.add("cohesion") == 130
        assert stages.done == [*(["diagnose cohesion"] if change else []), "fit"], change
    (tmp_path / "own.py").write_text(OWN)
    assert _model.current_diagnosis(run, file, (str(tmp_path / "own.py"),)) is None


def test_an_effect_that_cannot_be_simulated_is_refused(stages: Stages, capsys: pytest.CaptureFixture[str]) -> None:
    stages.simulated = False
    assert stages.add("cohesion") == 2
    assert "cohesion cannot be added: it could not be simulated (soil left the bin)" in capsys.readouterr().err
    assert stages.options == [] and not (stages.run.path / "history.json").exists()


STOPS = [("diagnose cohesion", 1), ("fit", 1), ("fitted", 1), ("compare", 1), ("compared", 1), ("report", 1)]


@pytest.mark.parametrize(
    ("effects", "stop"),
    [
        *((["cohesion"], stop) for stop in STOPS),
        *((["cohesion", "tilt"], stop) for stop in STOPS),
        *((["cohesion", "tilt"], stop) for stop in [("diagnose tilt", 1), *((what, 2) for what, _ in STOPS[1:-1])]),
    ],
)
def test_the_same_command_goes_on_to_the_same_end(
    stages: Stages, capsys: pytest.CaptureFixture[str], effects: list[str], stop: tuple[str, int]
) -> None:
    stages.stops_at = stop
    assert stages.add(*effects) == 130
    assert f"go on with: splatsoil add '{stages.run.path}' {' '.join(effects)}" in capsys.readouterr().err
    stages.stops_at = None
    assert stages.add(*effects) == 0, capsys.readouterr().err
    assert stages.done.count("fitted") == len(effects), "no fit twice"
    kept = stages.history()
    models = kept["models"]
    assert [entry["model"] for entry in models] == ["base", "cohesion", "cohesion+tilt"][: len(effects) + 1]
    assert [entry.get("added") for entry in models] == [None, *effects]
    assert [entry["held_out"] for entry in models] == [ERRORS[entry["model"]] for entry in models]
    assert [entry["noise_level"] for entry in models] == [1.0] * len(models)
    before = read_json(stages.run.path / "before" / "comparison.json")
    assert before["fit"] == models[-2]["model"] and stages.run.fit()["name"] == models[-1]["model"]
    assert "adding" not in kept, "nothing is under way any more"
    assert stages.done[-1] == "report"
    capsys.readouterr()
    assert stages.add(*effects) == 2
    assert "effect cohesion is on already; name one that is off" in capsys.readouterr().err


def test_another_addition_first_ends_the_one_that_was_interrupted(stages: Stages) -> None:
    stages.stops_at = ("compare", 1)
    assert stages.add("cohesion") == 130
    stages.stops_at = None
    assert stages.add("tilt") == 0
    assert [entry["model"] for entry in stages.history()["models"]] == ["base", "cohesion", "cohesion+tilt"]


def test_what_another_command_put_in_is_on_already(
    stages: Stages, capsys: pytest.CaptureFixture[str], fit_of: FitOf
) -> None:
    """Not only what an interrupted one was about to."""
    stages.stops_at = ("fit", 1)
    assert stages.add("cohesion") == 130
    stages.run.write_fit("cohesion+tilt", fit_of(["cohesion", "tilt"], cohesion=100.0, tilt_x=1.0))
    capsys.readouterr()
    assert stages.add("cohesion") == 2
    assert "effect cohesion is on already" in capsys.readouterr().err
