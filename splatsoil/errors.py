"""Errors a user can act on: one sentence that says what is wrong, where, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path


class SplatsoilError(Exception):
    """Base of every error that is the user's to mend; the command line prints it without a traceback.

    Attributes:
        code: exit code of a command that ends by it.
    """

    code = 2

    def __str__(self) -> str:
        """The message, with escapes for characters that could act on a terminal, or that it cannot show."""
        message = super().__str__()
        return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in message)


class MeasurementError(SplatsoilError):
    """A measurement set breaks its contract.

    Args:
        message: what is wrong and what to do about it.
        file: the offending file, if one is to blame.
        field: the field (JSON key, CSV column) inside it.
    """

    def __init__(self, message: str, *, file: str | Path | None = None, field: str | None = None) -> None:
        self.file = None if file is None else Path(file)
        self.field = field
        where = "" if file is None else f"{file}: "
        what = "" if field is None else f"{field}: "
        super().__init__(f"{where}{what}{message}")


class ParameterError(SplatsoilError):
    """A parameter, effect or option is unknown, out of its bounds, or meaningless in combination."""


class SimulationError(SplatsoilError):
    """The simulation cannot go on: non-finite state, particles off the grid, a broken step limit."""


class CombinationError(ParameterError, SimulationError):
    """Values, each within its bounds, that have no meaning together: a search takes it for a failed simulation."""


class NoAnswer(SplatsoilError):
    """All was computed and is kept, but the data give no estimate that means anything.

    Args:
        message: why, and what to look at.
        places: folders by ``run`` and ``set``.
    """

    code = 3

    def __init__(self, message: str, places: Mapping[str, str]) -> None:
        super().__init__(message)
        self.places = dict(places)


class RunError(SplatsoilError):
    """A run folder is missing, unreadable, or belongs to another experiment."""


class SetWarning(UserWarning):
    """Something odd about a measurement set, or a machine, that can be used all the same; the command line prints it as
    a remark."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """ ", did you mean …?" where a known word is much like this one, else nothing."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f", did you mean {near[0]}?" if near else ""
