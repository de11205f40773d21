"""The models of a run that were tried so far: ``history.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from splatsoil.inverse.run_folder import RunFolder


def history(folder: RunFolder) -> list[dict[str, Any]]:
    """The models tried so far, the first one first."""
    return list(_history(folder).get("models", ()))


def adding(folder: RunFolder) -> dict[str, Any]:
    """What `remember` was last told of an addition that is under way; nothing where none is."""
    return dict(_history(folder).get("adding", {}))


def _history(folder: RunFolder) -> dict[str, Any]:
    from splatsoil.run_files import HISTORY_FORMAT, read_kept

    path = folder.path / "history.json"
    return read_kept(path, HISTORY_FORMAT) if path.is_file() else {}


def remember(folder: RunFolder, entries: list[dict[str, Any]], under_way: Mapping[str, Any] | None = None) -> Path:
    """Keep the models tried, and what is needed to go on with an addition that is under way."""
    from splatsoil.files import write_json
    from splatsoil.run_files import HISTORY_FORMAT

    more = {"adding": dict(under_way)} if under_way else {}
    return write_json(folder.path / "history.json", {"format": HISTORY_FORMAT, "models": entries, **more})
