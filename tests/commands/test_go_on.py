"""An ``add`` that was interrupted goes on where it stopped, with everything that simulates taken out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import _criticism, _experiments, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.files import read_json, write_json
from splatsoil.report.data import estimates
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

ERRORS = {"base": 9.0, "cohesion": 5.0, "cohesion+tilt": 3.0}
SIZES = {"cohesion": 300.0, "tilt_x": 2.0, "tilt_y": 1.0}


class Stages:
    """Simulating ones, which count what they did and can be interrupted."""

    def __init__(self, run: RunFolder, fit_of: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
        self.run, self.fit_of, self.done = run, fit_of, list[str]()
        self.stops_at: tuple[str, int] | None = None
        for place, name in (
            (_experiments, "model_of"),
            (_criticism, "diagnosed"),
            (_stages, "fitted"),
            (_stages, "compared"),
        ):
            monkeypatch.setattr(place, name, getattr(self, name))
        monkeypatch.setattr("splatsoil.report.write_report", self.report)
        self.compared(run)
        self.done.clear()

    def passed(self, what: str) -> None:
        """Something is done, or Ctrl-C is pressed."""
        self.done.append(what)
        if self.stops_at == (what, self.done.count(what)):
            raise KeyboardInterrupt

    def model_of(self, folder: RunFolder, *_: object) -> Any:
        return self.model(folder.fit()["setup"]["effects"])

    def model(self, effects: tuple[str, ...]) -> Any:
        measurement = SimpleNamespace(folder=self.run.path)
        return SimpleNamespace(
            law=Law(find_effects(effects)), variant=self.model, measurement=measurement, device="cpu"
        )

    def diagnosed(self, folder: RunFolder, model: object, begin: object, effects: Sequence[str]) -> dict[str, Any]:
        (name,) = effects
        self.passed(f"diagnose {name}")
        before = folder.fit()
        after = "+".join(sorted([*before["setup"]["effects"], name]))
        told = (("", before["name"]), (name, after))
        return {"held_out": [{"model": key, "error": ERRORS[fit], "noise": 1.0} for key, fit in told]}

    def fitted(self, options: FitOptions, *_: object) -> dict[str, Any]:
        fit = self.fit_of(options.effects, **{name: SIZES.get(name, 35.0) for name in options.parameters})
        self.passed("fit")
        self.run.write_fit(fit["name"], fit)
        self.passed("fitted")
        return fit

    def compared(self, folder: RunFolder, *_: object) -> None:
        self.passed("compare")
        fit = folder.fit()
        data = {"format": "splatsoil-comparison/1", "fit": fit["name"], "parameters": estimates(fit)}
        write_json(folder.comparison / "comparison.json", data)
        self.passed("compared")

    def report(self, path: object) -> object:
        self.passed("report")
        return path

    def result(self) -> Any:
        """What there is in the end."""
        before = read_json(self.run.path / "before" / "comparison.json")["fit"]
        return read_json(self.run.path / "history.json"), before, read_json(self.run.path / "fit.json")


@pytest.fixture
def stages(run: RunFolder, fit_of: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> Stages:
    return Stages(run, fit_of, monkeypatch)


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
    words = ["add", str(stages.run.path), *effects]
    stages.stops_at = stop
    assert cli.main(words) == 130
    assert f"go on with: splatsoil add '{stages.run.path}' {' '.join(effects)}" in capsys.readouterr().err
    stages.stops_at = None
    first = list(stages.done)
    assert cli.main(words) == 0, capsys.readouterr().err
    assert stages.done.count("fitted") == len(effects), "no fit twice"
    kept, before, fit = stages.result()
    models = kept["models"]
    assert [entry["model"] for entry in models] == ["base", "cohesion", "cohesion+tilt"][: len(effects) + 1]
    assert [entry.get("added") for entry in models] == [None, *effects]
    assert [entry["held_out"] for entry in models] == [ERRORS[entry["model"]] for entry in models]
    assert before == models[-2]["model"] and fit["name"] == models[-1]["model"]
    assert "adding" not in kept, "nothing is under way any more"
    assert stages.done[-1] == "report" and first != stages.done
    capsys.readouterr()
    assert cli.main(words) == 2
    assert "effect cohesion is on already; name one that is off" in capsys.readouterr().err


def test_another_addition_first_ends_the_one_that_was_interrupted(stages: Stages) -> None:
    stages.stops_at = ("compare", 1)
    assert cli.main(["add", str(stages.run.path), "cohesion"]) == 130
    stages.stops_at = None
    assert cli.main(["add", str(stages.run.path), "tilt"]) == 0
    assert [entry["model"] for entry in stages.result()[0]["models"]] == ["base", "cohesion", "cohesion+tilt"]


def test_what_another_command_put_in_is_on_already(
    stages: Stages, capsys: pytest.CaptureFixture[str], fit_of: Callable[..., dict[str, Any]]
) -> None:
    """Not only what an interrupted one was about to."""
    stages.stops_at = ("fit", 1)
    assert cli.main(["add", str(stages.run.path), "cohesion"]) == 130
    stages.run.write_fit("cohesion+tilt", fit_of(["cohesion", "tilt"], cohesion=100.0, tilt_x=1.0))
    capsys.readouterr()
    assert cli.main(["add", str(stages.run.path), "cohesion"]) == 2
    assert "effect cohesion is on already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["add", "cohesion", "cohesion"], "effect named twice: cohesion"),
        (["add", "cohesion", "--budget", "0"], "--budget: a fit needs at least 2 evaluations, not 0"),
        (["add", "cohesion", "--budget", "1"], "--budget: a fit needs at least 2 evaluations, not 1"),
        (["add", "nonsense"], "effect 'nonsense' is unknown"),
        (["diagnose", "--effects", "nonsense"], "effect 'nonsense' is unknown"),
        (["diagnose", "--effects", "tilt"], "effect tilt is on already; name one that is off"),
        (["add", "tilt"], "effect tilt is on already; name one that is off"),
    ],
)
@pytest.mark.usefixtures("no_work")
def test_what_makes_no_sense_is_refused_before_any_work(
    run: RunFolder,
    capsys: pytest.CaptureFixture[str],
    fit_of: Callable[..., dict[str, Any]],
    words: list[str],
    says: str,
) -> None:
    run.write_fit("tilt", fit_of(["tilt"], tilt_x=1.0))
    assert cli.main([words[0], str(run.path), *words[1:], "--json"]) == 2
    assert says in cast(str, json.loads(capsys.readouterr().out)["error"])
