"""Simulations that criticism asks for, each made once and kept, so that an interruption costs one."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.inverse.evaluations import digest

from splatsoil.errors import RunError
from splatsoil.experiment.base import Experiment
from splatsoil.files import write_bytes

from .free_strength import FreeStrength

FloatArray = npt.NDArray[np.float64]


class Simulations:
    """An experiment's predictions, from a folder where they are there already.

    Args:
        experiment: predicts.
        folder: where feature tables are kept; None keeps them in memory only.
        identity: everything beside the arguments of ``predict`` that decides a prediction.
        told: called before each new simulation with what it is for.
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path | None = None,
        identity: Mapping[str, Any] | None = None,
        told: Callable[[str], None] | None = None,
    ) -> None:
        self.experiment, self.folder = experiment, folder
        self.identity, self.told = dict(identity or {}), told
        self.made = 0
        """Simulations made, not read."""
        self.asked = 0
        """Different simulations that were needed."""
        self._known: dict[str, FloatArray] = {}

    def __call__(
        self,
        values: Mapping[str, float],
        *,
        effects: tuple[str | FreeStrength, ...] = (),
        seed: int = 0,
        numerics: str = "",
        purpose: str = "",
    ) -> FloatArray:
        """(t, s) predicted features.

        Raises:
            SimulationError: the simulation could not go on.
            RunError: what is kept of it is damaged.
        """
        names = sorted(e if isinstance(e, str) else e.identity for e in effects)
        what = {"values": dict(values), "effects": names, "seed": seed, "numerics": numerics}
        key = digest({**self.identity, **what})
        if key not in self._known:
            self._known[key] = self._find(key, {**what, "effects": effects}, purpose)
            self.asked += 1
        return self._known[key]

    def _find(self, key: str, what: Mapping[str, Any], purpose: str) -> FloatArray:
        path = None if self.folder is None else self.folder / f"{key[:32]}.npy"
        if path is not None and path.is_file():
            try:
                table = np.load(path, allow_pickle=False)
            except (OSError, ValueError) as error:
                raise RunError(f"{path}: cannot be read ({error}); delete it and run the command again") from error
            if table.shape == self.experiment.layout.shape:
                return table
        if self.told is not None:
            self.told(purpose)
        made = self.experiment.predict(
            what["values"], effects=tuple(what["effects"]), seed=what["seed"], numerics=what["numerics"]
        )
        self.made += 1
        if path is not None:
            stream = io.BytesIO()
            np.save(stream, made, allow_pickle=False)
            write_bytes(path, stream.getvalue())
        return made
