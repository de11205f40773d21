"""A drained triaxial test as an experiment: the law at a single point, no pictures, no chance."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.errors import MeasurementError, SimulationError
from splatsoil.experiment.base import candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library

FloatArray = npt.NDArray[np.float64]

RATIO_SPREAD = 0.04
"""Of q/p between specimens of one density: 1° of friction, as peaks scatter in Wichtmann & Triantafyllidis (2016)."""
VOLUME_SPREAD = 0.005
"""Of volume strain between specimens: 1° of dilation over a strain of 15 %."""
MEMORY = 0.8
"""Correlation of neighbouring readings: a specimen that is off stays off."""
YOUNG = 2.0e7
"""Young's modulus in Pa for a stiffness factor of 1; the factor is a parameter of the model."""
COLUMNS = ("test_id", "eps_a[%]", "eps_v[%]", "sigma_r[kPa]", "sigma_v[kPa]")


@dataclass(frozen=True)
class Curve:
    """What a laboratory measured; compression is positive.

    Attributes:
        name: of the test.
        strain: nominal axial strain (n,).
        volume: nominal volume strain (n,).
        ratio: q/p (n,).
        confining: lateral stress in Pa.
    """

    name: str
    strain: FloatArray
    volume: FloatArray
    ratio: FloatArray
    confining: float


def read_triaxial(path: str | Path) -> dict[str, Curve]:
    """Tests of a CSV file with columns ``test_id, eps_a[%], eps_v[%], sigma_r[kPa], sigma_v[kPa]``, by name.

    The first row of a test, the isotropic state, gives no feature.

    Raises:
        MeasurementError: the file, a column or a number is missing.
    """
    file = Path(path)
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    except OSError as error:
        raise MeasurementError(f"cannot be read ({error.strerror})", file=file) from error
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise MeasurementError("the column is missing; see the docs for the format", file=file, field=missing[0])
    tests: dict[str, list[list[float]]] = {}
    for number, row in enumerate(rows, start=2):
        try:
            values = [float(row[name]) for name in COLUMNS[1:]]
        except (TypeError, ValueError) as error:
            raise MeasurementError(f"line {number} has something that is no number", file=file) from error
        if not all(map(math.isfinite, values)):
            raise MeasurementError(f"line {number} has a number that is not finite", file=file)
        tests.setdefault(row["test_id"], []).append(values)
    out = {}
    for name, records in tests.items():
        table = np.array(records)
        table = table[table[:, 0] > 0.0]
        radial, axial = 1e3 * table[:, 2], 1e3 * table[:, 3]
        ratio = (axial - radial) / ((axial + 2.0 * radial) / 3.0)
        out[name] = Curve(name, table[:, 0] / 100.0, table[:, 1] / 100.0, ratio, float(np.median(radial)))
    return out


class TriaxialExperiment:
    """One triaxial test and a model of it.

    Features are q/p and the volume strain, each in units of its spread between specimens. The elastic stiffness is a
    parameter of the model: a laboratory's sand is not rigid.

    Args:
        curve: what was measured.
        effects: names of the effects that are on.
        void_ratio: at the start.
    """

    chance = False
    sensor_memory = MEMORY
    numerics: tuple[str, ...] = ()

    def __init__(self, curve: Curve, effects: Iterable[str] = (), *, void_ratio: float = 0.8) -> None:
        self.curve, self.void_ratio = curve, void_ratio
        self.name = curve.name
        self.model = tuple(dict.fromkeys(("stiffness", *effects)))
        law = Law(find_effects(self.model))
        self.parameters: tuple[Parameter, ...] = tuple(
            p for p in law.parameters if p.off is not None or p.name == "friction_angle"
        )
        self.candidates = candidates_of((e for e in library().values() if e.strength is not None), law.effects)
        count = len(curve.strain)
        middle = 0.5 * float(curve.strain[-1])
        self.layout = Layout(
            times=tuple(float(100.0 * s) for s in curve.strain),
            sites=(Site("stress ratio"), Site("volume strain")),
            time_name="axial strain, %",
            unit="spreads between specimens",
            stages=tuple("first half" if s <= middle else "second half" for s in curve.strain),
            regions=np.full((count, 2), "specimen"),
        )
        self.observed = self._features(curve.ratio, curve.volume)
        self.seen = np.ones(self.layout.shape, dtype=bool)
        self.quiet = np.zeros(self.layout.shape, dtype=bool)
        self.sensor = np.ones(self.layout.shape)

    def predict(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, 2) features; nothing about them is chance."""
        del seed, numerics
        law = Law(find_effects(dict.fromkeys((*self.model, *effects))))
        test = triaxial(
            law,
            dict(values),
            confining=self.curve.confining,
            strains=-np.log(1.0 - self.curve.strain),
            void_ratio=self.void_ratio,
            young=YOUNG,
        )
        ratio = (test.q / test.p)[0, 1:]
        if not np.all(np.isfinite(ratio)):
            raise SimulationError(f"the triaxial test with {dict(values)} came to no finite stress")
        return self._features(ratio, 1.0 - np.exp(-test.volume_strain[0, 1:]))

    @staticmethod
    def _features(ratio: FloatArray, volume: FloatArray) -> FloatArray:
        return np.stack([ratio / RATIO_SPREAD, volume / VOLUME_SPREAD], axis=1)
