"""Whether a fit's estimate is an answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Loss of a prediction in which nothing moves. The loss is measured in units of it, so this is no choice of ours: a
#: model that comes to it has explained nothing of what was seen, wherever its estimate lies.
NOTHING_MOVES = 1.0


def why_none(fit: Mapping[str, Any]) -> str:
    """Why an estimate means nothing, in one sentence; empty where it means something.

    Args:
        fit: what ``fit.json`` holds.

    Raises:
        RunError: it is damaged.
    """
    from splatsoil.errors import RunError
    from splatsoil.files import ANEW

    try:
        return _why_none(fit)
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise RunError(
            f"fit.json: is damaged, it lacks loss, best, or a parameter's bounds ({error!r}); {ANEW}"
        ) from error


def _why_none(fit: Mapping[str, Any]) -> str:
    from splatsoil.report.words import symbol

    least, loss = fit["best"]["loss"], max(fit["loss"], fit["best"]["loss"])
    if loss >= NOTHING_MOVES:
        where = "everywhere it was tried" if least >= NOTHING_MOVES else "where pictures and force together put it"
        return (
            f"no answer: {where} the model explains the video no better than soil that never moves (loss {loss:.3g}; "
            f"such soil has {NOTHING_MOVES:g}); photographs, poses, clock or tool are wrong, or the soil is another"
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


def need_answer(fit: Mapping[str, Any], look: str) -> None:
    """Go on only with an answer.

    Args:
        fit: what ``fit.json`` holds.
        look: what to look at where there is none.

    Raises:
        NoAnswer: there is none.
    """
    from splatsoil.errors import NoAnswer

    if said := why_none(fit):
        raise NoAnswer(f"{said}: {look}")
