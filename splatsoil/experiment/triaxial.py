"""Drained triaxial tests as an experiment: the law at a single point, no pictures, no chance."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.errors import MeasurementError, ParameterError, SimulationError
from splatsoil.experiment.base import candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter
from splatsoil.soil.element import ElementTest, triaxial
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
SLOW = 1.0e-5
"""Strain rate of a laboratory's test, 1/s."""
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
        strain_rate: of the axial strain, 1/s; slow unless it is told.
    """

    name: str
    strain: FloatArray
    volume: FloatArray
    ratio: FloatArray
    confining: float
    strain_rate: float = SLOW


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
    """One triaxial test, or several of the same soil, and a model of it.

    Features are q/p and the volume strain, each in units of its spread between specimens. The elastic stiffness is a
    parameter of the model: a laboratory's sand is not rigid. One test at one pressure cannot tell cohesion from
    friction, nor rate from either; a series at several pressures and rates can.

    Args:
        curves: what was measured; several tests need the same strains.
        effects: names of the effects that are on.
        void_ratio: at the start.
        candidates: names of effects to consider; all that act on strength by default.

    Raises:
        ParameterError: tests whose strains differ.
    """

    chance = False
    sensor_memory = MEMORY
    numerics: tuple[str, ...] = ()
    redrawn: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()

    def __init__(
        self,
        curves: Curve | Sequence[Curve],
        effects: Iterable[str] = (),
        *,
        void_ratio: float = 0.8,
        candidates: Iterable[str] | None = None,
    ) -> None:
        self.curves = (curves,) if isinstance(curves, Curve) else tuple(curves)
        if not self.curves or any(not np.array_equal(c.strain, self.curve.strain) for c in self.curves):
            raise ParameterError("triaxial tests of one experiment need the same strains; interpolate their curves")
        self.void_ratio = void_ratio
        self.name = ", ".join(curve.name for curve in self.curves)
        self.model = tuple(dict.fromkeys(("stiffness", *effects)))
        law = Law(find_effects(self.model))
        self.parameters: tuple[Parameter, ...] = tuple(
            p for p in law.parameters if p.off is not None or p.name == "friction_angle"
        )
        wanted = tuple(library().values()) if candidates is None else find_effects(candidates)
        self.candidates = candidates_of((e for e in wanted if e.strength is not None), law.effects)
        strain = self.curve.strain
        middle = 0.5 * float(strain[-1])
        several = len(self.curves) > 1
        channels = [
            f"{what}, {curve.name}" if several else what
            for curve in self.curves
            for what in ("stress ratio", "volume strain")
        ]
        self.layout = Layout(
            times=tuple(float(100.0 * s) for s in strain),
            sites=tuple(Site(channel) for channel in channels),
            time_name="axial strain, %",
            unit="spreads between specimens",
            stages=tuple("first half" if s <= middle else "second half" for s in strain),
            regions=np.full((len(strain), len(channels)), "specimen"),
        )
        self.observed = np.concatenate([self._features(c.ratio, c.volume) for c in self.curves], axis=1)
        self.seen = np.ones(self.layout.shape, dtype=bool)
        self.quiet = np.zeros(self.layout.shape, dtype=bool)
        self.sensor = np.ones(self.layout.shape)

    @property
    def curve(self) -> Curve:
        """The first test."""
        return self.curves[0]

    def predict(
        self,
        values: Mapping[str, float],
        *,
        effects: Iterable[str] = (),
        seed: int = 0,
        numerics: str = "",
    ) -> FloatArray:
        """(t, 2 tests) features; nothing about them is chance."""
        del seed, numerics
        law = Law(find_effects(dict.fromkeys((*self.model, *effects))))
        out = []
        for curve in self.curves:
            test = self._test(law, values, curve)
            ratio = (test.q / test.p)[0, 1:]
            if not np.all(np.isfinite(ratio)):
                raise SimulationError(f"the triaxial test with {dict(values)} came to no finite stress")
            out.append(self._features(ratio, 1.0 - np.exp(-test.volume_strain[0, 1:])))
        return np.concatenate(out, axis=1)

    def _test(self, law: Law, values: Mapping[str, float], curve: Curve) -> ElementTest:
        return triaxial(
            law,
            dict(values),
            confining=curve.confining,
            strains=-np.log(1.0 - curve.strain),
            void_ratio=self.void_ratio,
            young=YOUNG,
            strain_rate=curve.strain_rate,
        )

    @staticmethod
    def _features(ratio: FloatArray, volume: FloatArray) -> FloatArray:
        return np.stack([ratio / RATIO_SPREAD, volume / VOLUME_SPREAD], axis=1)
