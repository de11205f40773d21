"""Putting the page together."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

import splatsoil
from splatsoil.errors import RunError
from splatsoil.files import write_text
from splatsoil.report import figures, text
from splatsoil.report.data import RunData, load, read_picture

HERE = Path(__file__).parent
KINDS = ("observed", "predicted", "difference")
#: What the template asks: words for numbers, and sentences and figures.
WORDS = (text.duration, text.estimate, text.model_label, text.model_name, text.probability)
DRAWN = (
    *(text.fitted_sentence, text.posterior_sentences, text.posterior_notes),
    *(figures.surrogate, figures.marginal, figures.losses, figures.surface_map),
)
OUTLINED = 3
"""Blocks that fail and are drawn on their photographs."""


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` into a run folder from what is in it, and return its path.

    The page is one file: it asks for nothing from anywhere, and says nothing that the folder's files don't.

    Raises:
        RunError: not a run folder, no finished fit, a damaged file, or the folder can't be written.
    """
    from jinja2 import UndefinedError

    try:
        page = render(load(folder))
    except (TypeError, ValueError, LookupError, AttributeError, UndefinedError) as error:
        raise RunError(
            f"{folder}: fit.json, posterior.json, or one in comparison/ or diagnoses/ isn't what the page needs "
            f"({error!r}); it is damaged or made by another version: fit and compare again"
        ) from error
    return write_text(Path(folder) / "report.html", page)


def render(data: RunData) -> str:
    """The page as a string."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update({function.__name__: function for function in WORDS})
    environment.globals.update({function.__name__: function for function in DRAWN})
    comparison, judged, no_answer = data.comparison, data.judged, text.no_answer(data.fit)
    adequate, ratio = text.called_adequate(data.fit, judged), text.ratio_to_noise(comparison)
    pictures = [] if comparison is None else _pictures(data.folder / "comparison", comparison)
    kinds = list(KINDS)
    if pictures and data.before is not None and _join(pictures, _pictures(data.folder / "before", data.before)):
        # Observed, before, after, difference: what the added effect changed.
        kinds.insert(1, "before")
    return environment.get_template("page.html").render(
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        script=Markup((HERE / "page.js").read_text(encoding="utf-8")),
        program=splatsoil.__version__,
        text=text,
        data=data,
        fit=data.fit,
        judged=judged,
        no_answer=no_answer,
        answers=[] if no_answer else text.answers(data.fit, judged, data.truth),
        adequate=adequate,
        residual=text.residual_sentence(comparison, adequate) if judged is None else text.misfit_sentence(judged),
        calm=(ratio is not None and ratio <= text.AT_THE_NOISE) if adequate is None else adequate,
        findings=_findings(data, judged),
        falling=_falling(data),
        pictures=pictures,
        kinds=kinds,
        titles={"predicted": "after"} if "before" in kinds else {},
        forces=_forces(data, judged),
        failing=None if judged is None else _failing(judged, comparison, data.folder / "comparison"),
        corner=_corner(data),
        order=sorted(data.fits, key=lambda name: (name != "base", -data.fits[name]["loss"])),
    )


def _pictures(folder: Path, comparison: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each camera its frames in order, each with three data URLs and its loss."""
    name = comparison["loss"]
    return [
        {
            "camera": camera,
            "frames": [
                {
                    "frame": entry["frame"],
                    "loss": f"{entry['losses'][name]:.4g}",
                    **{kind: data_url(folder / entry[kind]) for kind in KINDS},
                }
                for entry in sorted(comparison["frames"], key=lambda e: e["frame"])
                if entry["camera"] == camera
            ],
        }
        for camera in comparison["cameras"]
    ]


def _join(pictures: list[dict[str, Any]], earlier: list[dict[str, Any]]) -> bool:
    """Put each frame's earlier prediction beside the present one; False where the two don't match."""
    known = {(c["camera"], f["frame"]): f["predicted"] for c in earlier for f in c["frames"]}
    wanted = [(c["camera"], f) for c in pictures for f in c["frames"]]
    if any((camera, frame["frame"]) not in known for camera, frame in wanted):
        return False
    for camera, frame in wanted:
        frame["before"] = known[camera, frame["frame"]]
    return True


def _corner(data: RunData) -> str:
    """The picture of every pair of parameters of a posterior, where it has several."""
    file = data.folder / "posterior" / "corner.png"
    there = data.posterior is not None and len(data.posterior["parameters"]) > 1 and file.is_file()
    return data_url(file, "posterior") if there else ""


def _findings(data: RunData, judged: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Verdicts of the diagnosis, and of the latest fit's comparison where the diagnosis is of a smaller model."""
    out = []
    if data.diagnosis is not None:
        named = data.diagnosis["class"] if data.diagnosis["verdict"] in ("missing", "one of") else ()
        added, of = set(named) & set(data.fit["name"].split("+")), data.diagnosis["fit"]
        later = "" if of == data.fit["name"] else "Added." if added else f"({text.model_name(of)})"
        calm = data.diagnosis["verdict"] == "adequate"
        sentences = data.diagnosis["sentences"]
        out.append({"text": text.verdict(data.diagnosis), "calm": calm, "later": later, "sentences": sentences})
    if judged is not None and judged is data.misfit:
        said = {"text": text.misfit_verdict(judged), "calm": judged["adequate"], "later": ""}
        out.append({**said, "sentences": judged["sentences"]})
    return out


def _failing(judged: Mapping[str, Any], comparison: Mapping[str, Any] | None, folder: Path) -> dict[str, Any]:
    """Plan views of the residual, of the model as it is and with the best effect, and pictures of what fails."""
    which = [("as it is", "before")]
    which += [(f"with {text.model_label(n)}", n) for n in judged.get("class", ())[:1] if n in judged["maps"]]
    drawn = figures.plan_maps(judged, which)
    return {
        "maps": [(title, svg) for (title, _), svg in zip(which, drawn, strict=True)],
        "pictures": [] if comparison is None else _outlined(judged, comparison, folder),
    }


def _outlined(judged: Mapping[str, Any], comparison: Mapping[str, Any], folder: Path) -> list[dict[str, Any]]:
    """The blocks that fail most: each on the photograph nearest to where it fails most, with words on when it
    begins."""
    out, seen = [], comparison["cameras"]
    failed = [check for check in judged["checks"] if check["p"] < text.SIGNIFICANT and check["channel"] in seen]
    for check in failed[:OUTLINED]:
        row, squares = text.worst_row(judged, check)
        mine = (entry for entry in comparison["frames"] if entry["camera"] == check["channel"])
        entry = min(mine, key=lambda entry: abs(entry["frame"] - judged["times"][row]))
        name = text.block(check)
        out.append(
            {
                "title": name[:1].upper() + name[1:],
                "ratio": check["ratio"],
                "begins": text.begins(judged, check),
                "frame": entry["frame"],
                "photograph": data_url(folder / entry["observed"]),
                "squares": figures.outlined(check, judged, squares),
            }
        )
    return out


def _forces(data: RunData, judged: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Force on the tool, measured and predicted: by the comparison at each frame, before and after an addition, and
    what a diagnosis of this fit expects and predicts."""
    own = judged if judged is not None and judged["fit"] == data.fit["name"] else None
    curves = {} if own is None else {curve["channel"]: curve for curve in own["curves"]}
    now, before = ((c or {}).get("force") for c in (data.comparison, data.before))
    if now is None:
        return None
    drawn, sentences, unit = [], [], now["unit"]
    for number, channel in enumerate(now["channels"]):
        name = channel["channel"]
        frames, measured, predicted = _series(now["frames"], channel["measured"], channel["predicted"])
        lines: dict[str, tuple[np.ndarray, ...]] = {"predicted": (frames, predicted)}
        expected, curve = None, curves.get(name)
        if before is not None:
            earlier = _series(before["frames"], before["channels"][number]["predicted"])
            lines = {"before": earlier, "after": (frames, predicted)}
        if own is not None and curve is not None:
            expected = _series(own["times"], curve["low"], curve["high"])
            for model in own.get("class", ())[:1] if before is None else ():
                if model in curve["predicted"]:
                    lines[f"with {text.model_label(model)}"] = _series(own["times"], curve["predicted"][model])
        drawn.append(figures.readings(name, unit, (frames, measured), lines, expected, "frame"))
        error, largest = np.sqrt(np.nanmean((predicted - measured) ** 2)), np.nanmax(np.abs(measured))
        sentences.append(
            f"{name.capitalize()}: root mean square error {text.rounded(float(error))} {unit}; "
            f"largest measured {text.rounded(float(largest))} {unit}."
        )
    return {"figures": drawn, "sentences": sentences}


def _series(*columns: Sequence[float | None]) -> tuple[np.ndarray, ...]:
    """Columns as arrays (n,), null as NaN."""
    return tuple(np.array(column, dtype=np.float64) for column in columns)


def _falling(data: RunData) -> dict[str, Any] | None:
    """The error on data set aside: of the models tried or, where there is only one, of those that were compared."""
    diagnosis = data.diagnosis or {"held_out": [], "held_out_data": "data set aside", "unit": "grey levels"}
    if len(data.history) > 1:
        rows = [(entry["held_out"], entry["noise_level"]) for entry in data.history]
        names = text.steps(data.history)
    else:
        rows = [(entry["error"], entry["noise"]) for entry in diagnosis["held_out"]]
        names = [text.model_label(entry["model"]) for entry in diagnosis["held_out"]]
    if len(rows) < 2:
        return None
    errors, noise = zip(*rows, strict=True)
    figure = figures.falling(errors, noise, names, diagnosis["unit"])
    return {"figure": figure, "falls": errors[-1] < errors[0], "held_out_data": diagnosis["held_out_data"]}


def data_url(path: Path, made_by: str = "compare") -> str:
    """A picture as a ``data:`` URL; see `read_picture`."""
    contents, kind = read_picture(path, made_by)
    return f"data:image/{kind};base64,{base64.b64encode(contents).decode()}"
