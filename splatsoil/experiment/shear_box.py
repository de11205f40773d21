"""Direct shear tests and the angle of repose as experiments: the law in simple shear at a single point."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.laboratory import SLOW, LaboratoryExperiment, Specimen, SpecimenExperiment
from splatsoil.experiment.triaxial import VOLUME_SPREAD, young_at
from splatsoil.soil.effect import Effect
from splatsoil.soil.element import simple_shear
from splatsoil.soil.law import Law

RATIO_SPREAD = 0.024
"""Standard deviation of shear over normal stress between specimens: 1° of friction."""

REPOSE_SPREAD = 1.0
"""Standard deviation of an angle of repose between heaps, degrees, for fewer than three trials."""
REPOSE_STRAIN = 1.0
"""Shear strain of soil that comes to rest on a heap."""
GRAVITY = 9.81


class ShearBoxExperiment(SpecimenExperiment):
    """Shear box tests under constant normal stress, with uniform shear."""

    kind = "shear_box"
    spreads = (RATIO_SPREAD, VOLUME_SPREAD)
    strain_name = "displacement over height, %"

    def tested(self, law: Law, values: Mapping[str, float], test: Specimen) -> tuple[FloatArray, FloatArray]:
        """Shear stress over normal stress, and volume strain."""
        found = simple_shear(
            law,
            values,
            confining=test.stress,
            strains=test.strain,
            void_ratio=test.void_ratio,
            young=young_at(test.stress),
            strain_rate=SLOW,
        )
        return found.shear_stress[0, 1:] / test.stress, found.volume_strain[0, 1:]


class ReposeExperiment(LaboratoryExperiment):
    """The angle of repose: the surface layer of a long slope is in simple shear at critical state.

    Args:
        angles: (trials,) measured, degrees.
        height: of the heap, m; half of it is the moving layer.
        density: bulk density, kg/m³.
        effects: that are on.
        candidates: effects to consider; all that act on strength by default.

    Raises:
        ParameterError: no angles, or lengths without meaning.
    """

    kind = "repose"
    of_strength = True

    def __init__(
        self,
        angles: npt.ArrayLike,
        *,
        height: float = 0.1,
        density: float = 1600.0,
        effects: Iterable[str | Effect] = (),
        candidates: Iterable[str | Effect] | None = None,
        name: str = "repose",
    ) -> None:
        measured = np.asarray(angles, dtype=np.float64).reshape(-1)
        if not (measured.size and height > 0.0 and density > 0.0):
            raise ParameterError("a heap needs an angle of repose, a height and a density")
        super().__init__(name, effects, candidates)
        self.normal = 0.5 * height * density * GRAVITY
        spread = float(measured.std(ddof=1)) if len(measured) > 2 else REPOSE_SPREAD
        self._set_observation(
            np.array([[measured.mean()]]), np.array([[spread]]), (1.0,), "heap at rest", "deg", ("angle",), "heap"
        )

    def readings(self, run: Run) -> FloatArray:
        """(1, 1) degrees; the test is deterministic."""
        sheared = simple_shear(
            self.law(run.effects),
            self.values(run.values),
            confining=self.normal,
            strains=[REPOSE_STRAIN],
            young=young_at(self.normal),
            strain_rate=SLOW,
        )
        return np.array([[np.degrees(np.arctan(sheared.shear_stress[0, -1] / self.normal))]])

    def features(self, readings: FloatArray) -> FloatArray:
        """Degrees."""
        return readings
