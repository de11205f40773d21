"""What a calibration says of parameters, in the form that scores and refits need it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from splatsoil.experiment.base import Calibration

FloatArray = npt.NDArray[np.float64]


def precision_of(calibration: Calibration | None, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Inverse covariance (k, k) and centre (k,), as distances from off, of the named parameters; 0 where nothing is
    known of one, and the others not asked for marginalised."""
    precision, centre = np.zeros((len(names), len(names))), np.zeros(len(names))
    if calibration is None:
        return precision, centre
    there = [k for k, name in enumerate(names) if name in calibration.names]
    theirs = [calibration.names.index(names[k]) for k in there]
    if there:
        precision[np.ix_(there, there)] = np.linalg.inv(calibration.covariance[np.ix_(theirs, theirs)])
        centre[there] = calibration.estimate[theirs]
    return precision, centre
