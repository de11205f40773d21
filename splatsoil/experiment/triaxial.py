"""Drained triaxial tests as an experiment: the law at a single point, no pictures, no chance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatsoil.errors import ParameterError, SimulationError
from splatsoil.experiment.laboratory import FloatArray, LaboratoryExperiment
from splatsoil.soil.effect import Effect
from splatsoil.soil.element import triaxial
from splatsoil.soil.packing import at_void_ratio

RATIO_SPREAD = 0.04
"""Of q/p between specimens of one density: 1° of friction, as peaks scatter in Wichtmann & Triantafyllidis (2016)."""
VOLUME_SPREAD = 0.005
"""Of volume strain between specimens: 1° of dilation over a strain of 15 %."""
YOUNG, REFERENCE = 2.0e7, 1.0e5
"""Young's modulus in Pa for a stiffness factor of 1 under this confining pressure in Pa; it goes with the root of
that (Hardin & Richart 1963, J. Soil Mech. Found. Div. 89(1)). The factor is a parameter of the model."""
SLOW = 1.0e-5
"""Strain rate of a laboratory's test, 1/s."""


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
        void_ratio: at the start.
    """

    name: str
    strain: FloatArray
    volume: FloatArray
    ratio: FloatArray
    confining: float
    strain_rate: float = SLOW
    void_ratio: float = 0.8


class TriaxialExperiment(LaboratoryExperiment):
    """One triaxial test, or several of the same soil, and a model of it.

    Features are q/p and the volume strain, each in units of its spread between specimens. The elastic stiffness is a
    parameter of the model: a laboratory's sand is not rigid. One test at one pressure cannot tell cohesion from
    friction, nor rate from either; a series at several pressures and rates can. Parameters are those of the first
    test's void ratio, see :func:`~splatsoil.soil.packing.at_void_ratio`.

    Args:
        curves: what was measured; several tests need the same strains.
        effects: that are on.
        candidates: effects to consider; all that act on strength by default.
        known: parameters that are not fitted, at the first test's void ratio.

    Raises:
        ParameterError: tests whose strains differ.
    """

    kind = "triaxial"
    always = (*LaboratoryExperiment.always, "stiffness")

    def __init__(
        self,
        curves: Curve | Sequence[Curve],
        effects: Iterable[str | Effect] = (),
        *,
        candidates: Iterable[str | Effect] | None = None,
        known: Mapping[str, float] | None = None,
    ) -> None:
        self.curves = (curves,) if isinstance(curves, Curve) else tuple(curves)
        if not self.curves or any(not np.array_equal(c.strain, self.curve.strain) for c in self.curves):
            raise ParameterError("triaxial tests of one experiment need the same strains; interpolate their curves")
        super().__init__(", ".join(curve.name for curve in self.curves), effects, candidates, known)
        several = len(self.curves) > 1
        observed = self.features(np.concatenate([np.stack([c.ratio, c.volume], axis=1) for c in self.curves], axis=1))
        self._read(
            observed,
            np.ones_like(observed),
            100.0 * self.curve.strain,
            "axial strain, %",
            "spreads between specimens",
            [
                f"{what}, {curve.name}" if several else what
                for curve in self.curves
                for what in ("stress ratio", "volume strain")
            ],
            "specimen",
        )

    @property
    def curve(self) -> Curve:
        """The first test."""
        return self.curves[0]

    def acts(self, effect: Effect) -> bool:
        """Whether it acts on strength."""
        return effect.strength is not None

    def readings(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, 2 tests) q/p and nominal volume strain; nothing about them is chance."""
        del seed, numerics
        law, out = self.law(effects), []
        for curve in self.curves:
            test = triaxial(
                law,
                at_void_ratio(self.values(values), self.curve.void_ratio, curve.void_ratio),
                confining=curve.confining,
                strains=-np.log(1.0 - curve.strain),
                void_ratio=curve.void_ratio,
                young=YOUNG * float(np.sqrt(curve.confining / REFERENCE)),
                strain_rate=curve.strain_rate,
            )
            ratio = (test.q / test.p)[0, 1:]
            if not np.all(np.isfinite(ratio)):
                raise SimulationError(f"the triaxial test with {dict(values)} came to no finite stress")
            out += [ratio, 1.0 - np.exp(-test.volume_strain[0, 1:])]
        return np.stack(out, axis=1)

    def features(self, readings: FloatArray) -> FloatArray:
        """In units of spreads."""
        return readings / np.tile([RATIO_SPREAD, VOLUME_SPREAD], len(self.curves))
