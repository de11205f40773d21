"""An option, declared once: a field of a dataclass with what the command line and its help need to know of it."""

from __future__ import annotations

import dataclasses
from typing import Any

JSON = "Print one JSON object and nothing else."
"""Text of the option ``json``, which every command has."""


def option(default: Any, text: str, *, name: str = "", metavar: str = "", expert: bool = False) -> Any:
    """A field that is given as ``--name VALUE``.

    Args:
        default: value if not given.
        text: for help.
        name: if it isn't the field's.
        metavar: what stands for the value in help; one word for each of several values.
        expert: a first run does without it.
    """
    metadata = {"text": text, "name": name, "metavar": metavar, "expert": expert}
    return dataclasses.field(default=default, kw_only=True, metadata=metadata)


def argument(text: str, *, default: Any = dataclasses.MISSING) -> Any:
    """A field that is given by its place."""
    return dataclasses.field(default=default, metadata={"text": text, "positional": True})
