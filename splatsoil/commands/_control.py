"""What decides features and verdicts: digests of the code, so that what is kept is only used where it still holds."""

from __future__ import annotations

from collections.abc import Iterable

#: Parts of the package that decide verdicts.
JUDGING = ("inverse/criticism",)


def code_of(effects: Iterable[str]) -> str:
    """Digest of the code that decides features, users' own effects in it."""
    from splatsoil.files import code_digest

    return code_digest(others=own_files(effects))


def judged_by() -> str:
    """Digest of the code that draws verdicts from features."""
    from splatsoil.files import code_digest

    return code_digest(JUDGING)


def own_files(effects: Iterable[str]) -> list[str]:
    """Of effects' names those that are a user's own files."""
    return [name for name in effects if name.endswith(".py")]
