"""The last lines of ``splatsoil run``: one answer, and what it rests on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from splatsoil.report import text
from splatsoil.report.data import RunData


def headline(data: RunData) -> str:
    """The set's name, whether its model is adequate, and why."""
    adequate, judged, fit = text.called_adequate(data.fit, data.judged), data.judged, data.fit["name"]
    name = data.run["measurement"]["name"]
    if adequate is None or judged is None:
        return f"{name}: NOT TESTED. Whether the model is adequate is not known."
    if adequate:
        effects = "" if fit == "base" else f" WITH {text.listed(fit.replace('_', ' ').upper().split('+'), 'AND')}"
        return " ".join([f"{name}: ADEQUATE{effects}.", *judged["sentences"]])
    verdict = text.verdict(judged) if "verdict" in judged else text.misfit_verdict(judged)
    return " ".join([f"{name}: NOT EXPLAINED. {verdict}", *judged["sentences"]])


def rows(data: RunData) -> list[tuple[str, str]]:
    """Labels and texts: the parameters, and what they rest on. Those of a rejected model are marked."""
    judged, truth = data.judged, []
    adequate = text.called_adequate(data.fit, judged)
    out = []
    for answer in text.answers(data.fit, judged, data.truth):
        out.append((answer["name"], f"({answer['number']}, rejected)" if adequate is False else answer["number"]))
        out += [("", answer["remark"])] if answer["remark"] else []
        truth += [f"{answer['name']} {answer['truth']}"] if answer["truth"] else []
    if judged is None:
        out.append(("frame by frame", text.residual_sentence(data.comparison)))
    else:
        out.append(("probability", _probabilities(judged)))
        if adequate and (shown := _detectable(judged)):
            out.append(("would have shown", f"{shown} (80 % power)"))
        said = text.misfit_sentence(judged).removeprefix("Misfit ").rstrip(".")
        out += [("misfit", said)] if said else []
    return [*out, ("truth.json says", f"{text.listed(truth)} (this set is simulated)")] if truth else out


def _probabilities(judged: Mapping[str, Any]) -> str:
    if "models" not in judged:
        return f"model as it is {text.probability(judged['probability'])}, against something else"
    models = sorted(judged["models"], key=lambda model: -model["probability"])
    told = [m for m in models if m["probability"] >= text.LITTLE]
    return "; ".join(f"{text.model_label(m['name'])} {text.probability(m['probability'])}" for m in told)


def _detectable(judged: Mapping[str, Any]) -> str:
    found = [m for m in judged.get("models", ()) if m["detectable"] is not None]
    return ", ".join(
        f"{text.model_label(m['name'])} ≥ {text.estimate(m['detectable'], None, m['unit'])}" for m in found
    )
