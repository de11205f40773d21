"""The report's sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: Loss of a prediction in which nothing moves. The loss is measured in units of it, so this is no choice of ours: a
#: model that comes to it has explained nothing of what was seen, wherever its estimate lies.
NOTHING_MOVES = 1.0
#: A residual up to this many times the noise is called noise: the noise itself is only known to about this.
AT_THE_NOISE = 1.5
#: A check fails below this p.
SIGNIFICANT = 0.05
#: Expected standard deviations beyond which a block is said to have begun to fail.
BEYOND = 2.0
#: Key of the residuals of the model as it is.
BEFORE = "before"
#: Probabilities this close to 0 or to 1 are given as a limit: the evidences aren't known any better.
LITTLE = 0.005


def with_std(value: float, std: float) -> tuple[str, str]:
    """A value and its std with the std's two leading digits (one when it begins with 3 or more): "35.6", "0.8"."""
    if not std > 0.0:
        return f"{value:.4g}", "0"
    exponent = int(f"{std:e}".split("e")[1])
    leading = std / 10.0**exponent
    decimals = -exponent + (1 if leading < 2.95 else 0)
    if decimals >= 0:
        return f"{round(value, decimals) + 0.0:.{decimals}f}", f"{std:.{decimals}f}"  # + 0.0: no "-0.0"
    return f"{round(value, decimals):.0f}", f"{round(std, decimals):.0f}"


def symbol(unit: str) -> str:
    """A unit as it is printed after a number."""
    return {"deg": "°", "1": ""}.get(unit, f" {unit}")


def averaged(fit: Mapping[str, Any], judged: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """The parameters by name, averaged over models by a diagnosis, or a comparison, of this very fit; empty without
    one."""
    if judged is None or judged["fit"] != fit["name"]:
        return {}
    known: Mapping[str, Any] = judged["estimates"]
    return known


def called_adequate(fit: Mapping[str, Any], judged: Mapping[str, Any] | None) -> bool | None:
    """Whether a diagnosis, or a comparison, calls this very fit adequate; None where it is of another, or there is
    none."""
    if judged is None or judged["fit"] != fit["name"]:
        return None
    return bool(judged.get("verdict") == "adequate" or judged.get("adequate"))


def answers(
    fit: Mapping[str, Any], judged: Mapping[str, Any] | None = None, truth: Mapping[str, float] | None = None
) -> list[dict[str, str]]:
    """The parameters as a reader wants them: averaged over models where a diagnosis or a comparison of this fit is
    there, else as fitted.

    Each has a ``name`` ("friction angle"), a ``number`` ("35.6 ± 0.8°"), a ``state`` (``determined``, ``bound`` or
    ``open``), a ``remark`` where that isn't ``determined``, and the ``truth`` ("36.0°") where a simulated set has it.
    """
    out, better = [], averaged(fit, judged)
    for name, entry in fit["parameters"].items():
        plain, state, remark = name.replace("_", " "), "determined", ""
        told, key = (better[name], "value") if name in better else (entry, "estimate")
        if not told["determined"]:
            state, remark = "open", undetermined(name)
            if fit["estimated_from"] == "loss" and name not in better:
                remark = f"These evaluations do not determine the {plain}: the loss hardly varies over the range."
        elif entry["at_bound"] is not None:
            state = "bound"
            remark = (
                f"The {plain} lies on the {entry['at_bound']} bound of its range: "
                "the best value may lie beyond it, or the model may lack an effect."
            )
        value, std = with_std(told[key], told["std"])
        unit, true = symbol(entry["unit"]), (truth or {}).get(name)
        decimals = len(value.partition(".")[2])
        said = "" if true is None else f"{true:.{decimals}f}{unit}"
        number = f"{value} ± {std}{unit}"
        out.append({"name": plain, "number": number, "state": state, "remark": remark, "truth": said})
    return out


def no_answer(fit: Mapping[str, Any]) -> str:
    """Why the estimate of ``fit.json`` means nothing, in one sentence; empty where it means something."""
    least, loss = fit["best"]["loss"], max(fit["loss"], fit["best"]["loss"])
    if loss >= NOTHING_MOVES:
        where = "everywhere it was tried" if least >= NOTHING_MOVES else "where all instruments together put it"
        return (
            f"no answer: {where} the model explains the measurement no better than soil that never moves (loss "
            f"{loss:.3g}; such soil has {NOTHING_MOVES:g}); pictures, heights, poses, clock or tool are wrong, or "
            "the soil is another"
        )
    for name, entry in fit["parameters"].items():
        if entry["at_bound"] is None:
            continue
        bound = entry["bounds"][0 if entry["at_bound"] == "lower" else 1]
        # An effect that is off is no bound of knowledge: it isn't there.
        if bound != entry.get("off"):
            return (
                f"no answer: the {name.replace('_', ' ')} ends at the {entry['at_bound']} bound of its range "
                f"({bound:g}{symbol(entry['unit'])}); the best value lies beyond it, or the model lacks an effect"
            )
    return ""


def averaged_sentence(estimates: Mapping[str, Mapping[str, Any]]) -> str:
    """The parameters, averaged over models, in one line."""
    said = listed(
        [f"{n.replace('_', ' ')} {amount(e['value'], e['std'], e.get('unit', '1'))}" for n, e in estimates.items()]
    )
    return f"{said[:1].upper()}{said[1:]}, averaged over models."


def undetermined(name: str) -> str:
    """Of a parameter that the data leave open."""
    return f"The data do not determine the {name.replace('_', ' ')}: its standard deviation is about that of its range."


def fitted_sentence(fit: Mapping[str, Any], judged: Mapping[str, Any] | None) -> str:
    """What the ± contains."""
    if fit["estimated_from"] == "loss" and not averaged(fit, judged):
        return (
            f"The ± is one standard deviation of the loss minimum, given {fit['evaluations']} evaluations of this "
            "model. It does not contain model discrepancy."
        )
    return (
        "The ± is one standard deviation of the posterior, averaged over models. It contains instrument noise, "
        "seed-to-seed scatter, discretisation error (measured by pairs of coarse and fine runs) and, of pictures, "
        "unknown albedo of buried soil."
    )


def ratio_to_noise(comparison: Mapping[str, Any] | None) -> float | None:
    """The loss over that of the instruments' noise alone; None where that isn't known, or there is none."""
    if comparison is None:
        return None
    name = comparison["loss"]
    noise = comparison.get("noise", {}).get(name)
    return None if not noise else float(comparison["total"][name]) / float(noise)


def residual_sentence(comparison: Mapping[str, Any] | None, adequate: bool | None = None) -> str:
    """How far the prediction is from what was observed, and what that means.

    Args:
        comparison: frame by frame; None where there is none.
        adequate: whether a diagnosis or a comparison calls this very fit adequate; None without one.
    """
    if comparison is None:
        return "The prediction has not been compared frame by frame yet."
    name = comparison["loss"]
    total, rest = float(comparison["total"][name]), comparison.get("motionless", {}).get(name)
    left = f"The misfit is {percent(total / rest)} of that of soil at rest" if rest else ""
    ratio = ratio_to_noise(comparison)
    if ratio is None:
        unknown = "the set has no pre-roll frames to measure the noise on"
        if comparison.get("noise", {}).get(name) is not None:
            from splatsoil.experiment.plow import LEAST_NOISE

            unknown = (
                "the frames before the tool moves are equal to the last bit, so they show no noise; a standard "
                f"deviation of {LEAST_NOISE:g} grey levels is assumed"
            )
        return (f"{left}. " if left else "") + f"Its ratio to the instruments' noise is unknown: {unknown}."
    if ratio <= AT_THE_NOISE and adequate is not False:
        return f"The misfit is {ratio:.1f} × the instruments' noise: nothing more to explain here."
    above = f"{ratio:.{1 if ratio < 10.0 else 0}f} × the instruments' noise"
    said = f"{left}, {above}." if left else f"The misfit is {above}."
    if adequate:
        return f"{said} Instruments' noise, seed-to-seed scatter and discretisation error together are as large."
    if adequate is not None:
        return said
    return (
        f"{said} Part of the rest is seed-to-seed scatter. Whether the other part is the model's, the reconstruction's "
        "or the light's, has not been estimated yet."
    )


def verdict(diagnosis: Mapping[str, Any]) -> str:
    """The diagnosis in one line."""
    named = listed([name.replace("_", " ") for name in diagnosis["class"]], "or")
    said = {
        "adequate": "The model is adequate.",
        "missing": f"Missing: {named}.",
        "one of": f"Missing: {named}.",
        "something else": "Something is missing that the library does not have.",
        "undecided": "Undecided: the data do not discriminate between the models.",
    }
    return said[str(diagnosis["verdict"])]


def misfit_verdict(misfit: Mapping[str, Any]) -> str:
    """A comparison of the model as it is with something else, in one line."""
    return "The model is adequate." if misfit["adequate"] else "The model is not adequate: something may be missing."


def misfit_sentence(judged: Mapping[str, Any]) -> str:
    """The standardised residual of the most probable model, and its largest block."""
    size = misfit(judged)
    said = "" if size is None else f"Misfit {size:.2f} × the expected standard deviation"
    if not judged["checks"]:
        return f"{said}." if said else ""
    largest = max(judged["checks"], key=lambda check: check["ratio"])
    return f"{said or 'Misfit'}; largest: {block(largest)}, {largest['ratio']:.1f} ×."


def misfit(judged: Mapping[str, Any]) -> float | None:
    """Root mean square of residual over expected standard deviation, all features of the most probable model; None
    where nothing is compared."""
    table = _residuals(judged)
    return float(np.sqrt(np.nanmean(table**2))) if np.isfinite(table).any() else None


def _residuals(judged: Mapping[str, Any]) -> np.ndarray:
    """Residual over expected standard deviation (times, sites) of the most probable model, NaN where there is none."""
    return np.array(judged["maps"][most_probable(judged)], dtype=np.float64)


def most_probable(judged: Mapping[str, Any]) -> str:
    """Key of the most probable model's residuals in ``maps``; checks are of that one."""
    share = {model["name"] or BEFORE: model["probability"] for model in judged.get("models", ())}
    return max(judged["maps"], key=lambda name: share.get(name, 0.0))


def block(check: Mapping[str, Any]) -> str:
    """A check's block: "berm while pushing, left camera"."""
    stage, channel = str(check["stage"]), str(check["channel"])
    when = f"while {stage}" if stage.endswith("ing") else f"during {stage}"
    return f"{check['region']} {when}, {channel if channel.startswith(('force', 'heights')) else f'{channel} camera'}"


def begins(judged: Mapping[str, Any], check: Mapping[str, Any]) -> str:
    """When a check's block begins to fail: the first time at which its root mean square residual is beyond `BEYOND`
    expected standard deviations."""
    rows = block_rows(judged, check)
    first = next((row for row, values in rows.items() if _root_mean_square(values) > BEYOND), None)
    if first is None:
        return f"No {judged['time_name']} by itself is beyond {BEYOND:g} expected standard deviations."
    return f"It begins at {judged['time_name']} {judged['times'][first]:g}."


def worst_row(judged: Mapping[str, Any], check: Mapping[str, Any]) -> tuple[int, dict[int, float]]:
    """The row in which a check's block fails most, and its residuals there by site."""
    return max(block_rows(judged, check).items(), key=lambda item: _root_mean_square(item[1]))


def block_rows(judged: Mapping[str, Any], check: Mapping[str, Any]) -> dict[int, dict[int, float]]:
    """Residual over expected standard deviation by row and site in a check's block."""
    table, out = _residuals(judged), dict[int, dict[int, float]]()
    mine = np.isfinite(table) & (np.array(judged["regions"]) == check["region"])
    mine &= np.array([site[0] for site in judged["sites"]]) == check["channel"]
    mine &= (np.array(judged["stages"]) == check["stage"])[:, None]
    for row, site in np.argwhere(mine).tolist():
        out.setdefault(row, {})[site] = float(table[row, site])
    return out


def _root_mean_square(values: Mapping[int, float]) -> float:
    return math.sqrt(sum(v * v for v in values.values()) / len(values))


def model_label(name: str) -> str:
    """A compared model for readers: "as it is", "cohesion", "something else"."""
    return name.replace("_", " ") or "as it is"


def probability(share: float) -> str:
    """A probability for readers: "87 %", "1.2 %", "< 0.5 %", "> 99.5 %"."""
    if share < LITTLE:
        return f"< {100.0 * LITTLE:g} %"
    return percent(share) if share <= 1.0 - LITTLE else f"> {100.0 * (1.0 - LITTLE):g} %"


def steps(models: Sequence[Mapping[str, Any]]) -> list[str]:
    """Short names of models that grow by one effect each: base, + cohesion, + dilatancy."""
    first = str(models[0]["model"]).replace("_", " ") if models else ""
    return [first, *(f"+ {str(entry.get('added', '?')).replace('_', ' ')}" for entry in models[1:])]


def posterior_sentences(posterior: Mapping[str, Any]) -> list[str]:
    """What the data leave possible, a sentence for each parameter; a number only where there is one to give."""
    out = []
    for name, entry in posterior["parameters"].items():
        plain, unit = name.replace("_", " "), symbol(entry["unit"])
        share = min(round(100.0 * float(entry["contraction"])), 100)
        (low, _), (high, _) = (with_std(entry[key], 0.5 * entry["std"]) for key in ("low", "high"))
        if entry["verdict"] == "not determined":
            out.append(
                f"The {plain} is not identified: its spread is still {share} % of what it was before these data, "
                "so no value is given."
            )
        elif entry["verdict"] == "weakly determined":
            out.append(
                f"The {plain} is only weakly identified: with 90 % probability it lies between {low} and {high}{unit}, "
                f"a spread of {share} % of what it was before these data."
            )
        else:
            out.append(f"With 90 % probability the {plain} lies between {low} and {high}{unit}.")
    return out


def posterior_notes(posterior: Mapping[str, Any]) -> list[str]:
    """The posterior's notes but those on what is determined, which the sentences say."""
    said = tuple(f"{name} is " for name in posterior["parameters"])
    return [str(note) for note in posterior["notes"] if not str(note).startswith(said)]


def estimate(value: Any, std: Any, unit: str) -> str:
    """An estimate that may not exist."""
    return "–" if value is None else amount(float(value), float(std or 0.0), unit)


def amount(value: float, std: float, unit: str) -> str:
    """A value with its spread, if it has one, and unit."""
    return (" ± ".join(with_std(value, std)) if 0.0 < std < math.inf else rounded(value)) + symbol(unit)


def interval(entry: Mapping[str, Any]) -> str:
    """The 5 to 95 % of a parameter."""
    return f"{entry['low']:.4g} to {entry['high']:.4g}{symbol(entry['unit'])}"


def title(name: str) -> str:
    """An effect's name at the beginning of a sentence."""
    return name.replace("_", " ").capitalize()


def listed(words: Sequence[str], last: str = "and") -> str:
    """a, b and c."""
    return f" {last} ".join(part for part in (", ".join(words[:-1]), *words[-1:]) if part)


def rounded(value: float) -> str:
    """A number of three digits without an exponent: "25400", "0.0034"."""
    return f"{float(f'{value:.3g}'):g}"


def percent(share: float) -> str:
    """A share for readers: "7.3 %", "0.26 %", "81 %"."""
    value = 100.0 * share
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %"


def model_name(name: str) -> str:
    """A fit's name for readers: "base model", "base model with cohesion, dilatancy"."""
    return "base model" if name == "base" else f"base model with {name.replace('+', ', ').replace('_', ' ')}"


def duration(seconds: float) -> str:
    """A time for readers: "48 s", "3 min 20 s", "2 h 5 min", "40 d 2 h"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"
