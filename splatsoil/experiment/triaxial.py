"""Drained triaxial tests as an experiment: the law at a single point, no pictures; deterministic."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from splatsoil.arrays import FloatArray
from splatsoil.experiment.laboratory import Specimen, SpecimenExperiment
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law

RATIO_SPREAD = 0.04
"""Standard deviation of q/p between specimens of one density: 1° of friction (Wichtmann & Triantafyllidis 2016)."""
VOLUME_SPREAD = 0.005
"""Standard deviation of volume strain between specimens: 1° of dilatancy over a strain of 15 %."""
YOUNG, REFERENCE = 2.0e7, 1.0e5
"""Young's modulus in Pa for a stiffness factor of 1 at this confining pressure in Pa; it is proportional to the root of
the pressure (Hardin & Richart 1963, J. Soil Mech. Found. Div. 89(1))."""


def young_at(stress: float) -> float:
    """Young's modulus in Pa under a stress in Pa."""
    return YOUNG * float(np.sqrt(stress / REFERENCE))


class TriaxialExperiment(SpecimenExperiment):
    """Drained triaxial tests; stress ratios are q/p.

    One test does not separate cohesion, friction and rate; a series at several pressures and rates does.
    """

    kind = "triaxial"
    spreads = (RATIO_SPREAD, VOLUME_SPREAD)
    strain_name = "axial strain, %"

    def tested(self, law: Law, values: Mapping[str, float], test: Specimen) -> tuple[FloatArray, FloatArray]:
        """q/p and volume strain."""
        found = triaxial(
            law,
            values,
            confining=test.stress,
            strains=-np.log(1.0 - test.strain),
            void_ratio=test.void_ratio,
            young=young_at(test.stress),
            strain_rate=test.strain_rate,
        )
        return (found.q / found.p)[0, 1:], found.volume_strain[0, 1:]
