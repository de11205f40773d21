"""Element tests: the law that the solver runs, at a single stress point, as a soil laboratory would test it.

A batch of parameter sets goes through the same test. Each of the three axes is controlled by strain or by stress. A
step that misses its stress stops the test with an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
import numpy.typing as npt
import warp as wp

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError, SimulationError
from splatsoil.soil.kernels_element import OUTPUTS, element_kernel
from splatsoil.soil.law import Law
from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import FRICTION_ANGLE, Settings

Values = Mapping[str, float] | Sequence[Mapping[str, float]]

TOLERANCE = 1.0e-5
"""Largest miss of a wanted stress, relative to the test's stress."""
MOST_STEPS = 10_000_000
"""Steps of the law that a test may take, over all of its records; a strain of 1 takes 5000 of the usual ones."""


@dataclass(frozen=True)
class ElementTest:
    """What a test measured, for a batch of parameter sets; compression is positive, strains are logarithmic.

    Attributes:
        values: all parameters by name, one mapping for each set.
        strain: principal-axis strains x, y, z (sets, steps + 1, 3).
        stress: stresses on the same axes (sets, steps + 1, 3), Pa.
        shear_strain: engineering shear strain xz (sets, steps + 1).
        shear_stress: shear stress xz (sets, steps + 1), Pa.
        plastic_strain: plastic shear strain gone through (sets, steps + 1); 0 where the law does not keep it.
        initial_void_ratio: void ratio at the start.
    """

    values: tuple[Mapping[str, float], ...]
    strain: FloatArray
    stress: FloatArray
    shear_strain: FloatArray
    shear_stress: FloatArray
    plastic_strain: FloatArray
    initial_void_ratio: float

    @property
    def p(self) -> FloatArray:
        """Mean stress (sets, steps + 1), Pa."""
        return self.stress.mean(axis=2)

    @property
    def q(self) -> FloatArray:
        """Axial less mean lateral stress (sets, steps + 1), Pa; negative in extension."""
        return self.stress[..., 2] - 0.5 * (self.stress[..., 0] + self.stress[..., 1])

    @property
    def axial_strain(self) -> FloatArray:
        """Strain along z (sets, steps + 1)."""
        return self.strain[..., 2]

    @property
    def volume_strain(self) -> FloatArray:
        """Logarithmic volume strain (sets, steps + 1), positive where the soil became denser."""
        return self.strain.sum(axis=2)

    @property
    def void_ratio(self) -> FloatArray:
        """Void ratio e (sets, steps + 1): 1 + e = (1 + e0) exp(-volume strain)."""
        return (1.0 + self.initial_void_ratio) * np.exp(-self.volume_strain) - 1.0


class Options(TypedDict, total=False):
    """What all tests share.

    Attributes:
        void_ratio: at the start; 0.8 by default.
        young: Young's modulus in Pa; 5e7 by default.
        poisson: Poisson's ratio; 0.2 by default.
        strain_rate: of the controlled strain, 1/s; only effects of rate feel it. 1e-5 by default.
        depth: below the undisturbed surface in m, 0 by default; only effects of depth feel it.
        largest_step: most strain in one step of the law, so that records may lie far apart; 2e-4 by default. A test
            that would take more than 10 million steps is refused.
        matching: of the friction cone; triaxial compression by default.
    """

    void_ratio: float
    young: float
    poisson: float
    strain_rate: float
    depth: float
    largest_step: float
    matching: Matching


def triaxial(
    law: Law, values: Values, *, confining: float, strains: npt.ArrayLike, **options: Unpack[Options]
) -> ElementTest:
    """Drained triaxial test: constant stress on x and y, given strain along z.

    Args:
        law: the soil law with its effects.
        values: parameters by name, one mapping or one for each set of the batch.
        confining: lateral stress in Pa, positive.
        strains: axial logarithmic strains (n,) at which to record, from the isotropic state on; positive and rising in
            compression, negative and falling in extension, any path in between. A nominal strain s is -ln(1 - s).
        options: see :class:`Options`.

    Returns:
        The start and the n records.

    Raises:
        SimulationError: a step did not reach its stresses.
        ParameterError: parameters, strains or constants without meaning.
    """
    _positive(confining=confining)
    path = _path(strains)
    targets = np.full((len(path), 4), confining)
    targets[:, 2], targets[:, 3] = path, 0.0
    return drive(law, values, targets, by_stress=(True, True, False), confining=confining, **options)


def simple_shear(
    law: Law,
    values: Values,
    *,
    confining: float,
    strains: npt.ArrayLike,
    constant_volume: bool = False,
    **options: Unpack[Options],
) -> ElementTest:
    """Simple shear in the plane xz: constant stress along z (or constant volume), no strain along x and y.

    Args:
        confining: stress in Pa on all axes at the start, and along z throughout.
        strains: engineering shear strains (n,) at which to record.
        constant_volume: hold the height instead of the stress along z.

    The other arguments, the result and the errors are those of :func:`triaxial`.
    """
    _positive(confining=confining)
    path = _path(strains)
    targets = np.zeros((len(path), 4))
    targets[:, 3] = path
    if not constant_volume:
        targets[:, 2] = confining
    return drive(law, values, targets, by_stress=(False, False, not constant_volume), confining=confining, **options)


def isotropic_compression(
    law: Law, values: Values, *, confining: float, pressures: npt.ArrayLike, **options: Unpack[Options]
) -> ElementTest:
    """Equal stress on all three axes, from ``confining`` through ``pressures`` (n,) in Pa at which to record.

    The other arguments, the result and the errors are those of :func:`triaxial`.
    """
    _positive(confining=confining)
    path = np.asarray(pressures, dtype=np.float64).reshape(-1)
    if path.size == 0 or not (np.isfinite(path).all() and (path > 0.0).all()):
        raise ParameterError("pressures: give at least one positive number of Pa")
    targets = np.concatenate([np.repeat(path[:, None], 3, axis=1), np.zeros((len(path), 1))], axis=1)
    return drive(law, values, targets, by_stress=(True, True, True), confining=confining, **options)


def drive(
    law: Law,
    values: Values,
    targets: FloatArray,
    *,
    by_stress: tuple[bool, bool, bool],
    confining: float,
    void_ratio: float = 0.8,
    young: float = 5.0e7,
    poisson: float = 0.2,
    strain_rate: float = 1.0e-5,
    depth: float = 0.0,
    largest_step: float = 2.0e-4,
    matching: Matching = Matching.COMPRESSION,
) -> ElementTest:
    """Any test: from an isotropic stress through ``targets``, each axis under stress or strain.

    Args:
        targets: (n, 4) at which to record: of x, y and z the stress in Pa (compression positive) where ``by_stress``
            says so, else the logarithmic strain (shortening positive); and the engineering shear strain xz.
        by_stress: whether x, y and z are under stress control.
        confining: stress on all axes at the start, Pa.

    The other arguments, the result and the errors are those of :func:`triaxial`.
    """
    _positive(void_ratio=void_ratio, young=young, strain_rate=strain_rate, largest_step=largest_step)
    if not (math.isfinite(depth) and depth >= 0.0):
        raise ParameterError(f"depth: {depth} is not a depth in m; give a number >= 0")
    if not -1.0 < poisson < 0.5:
        raise ParameterError(f"poisson: {poisson} is no Poisson's ratio; give one between -1 and 0.5")
    batch = [values] if isinstance(values, Mapping) else list(values)
    if not batch:
        raise ParameterError("an element test needs at least one set of parameters")
    base = Settings(friction_angle=FRICTION_ANGLE.default, matching=matching)
    bulk, shear = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
    start = np.array([confining if s else 0.0 for s in by_stress] + [0.0])
    moves = np.diff(np.vstack([start, targets]), axis=0)
    way = np.abs(np.where([*by_stress, False], moves / (3.0 * bulk), moves)).max(axis=1)
    needed = np.maximum(np.ceil(way / largest_step - 1e-9), 1)
    if not needed.sum() <= MOST_STEPS:
        raise ParameterError(
            f"element test: the path would take {needed.sum():.3g} steps of a strain of {largest_step:g}, and "
            f"{MOST_STEPS} are the most; give a shorter path or a longer step"
        )
    steps = needed.astype(np.int32)
    seconds = np.maximum(way, 1.0e-12) / steps / strain_rate

    sets, records = len(batch), len(targets)
    table = wp.array(law.table(base, batch).astype(np.float32), dtype=float, device="cpu")
    out = wp.zeros((sets, records, OUTPUTS), dtype=wp.float64, device="cpu")
    failed = wp.full(sets, -1, dtype=int, device="cpu")
    miss = wp.zeros(sets, dtype=float, device="cpu")
    wp.launch(
        element_kernel(law.update),
        dim=sets,
        inputs=[
            wp.array(targets, dtype=wp.float64, device="cpu"),
            wp.array(steps, dtype=int, device="cpu"),
            wp.array(seconds.astype(np.float32), dtype=float, device="cpu"),
            wp.vec3i(*(int(s) for s in by_stress)),
            confining,
            depth,
            bulk,
            shear,
            TOLERANCE * float(max(confining, np.abs(targets[:, :3][:, list(by_stress)]).max(initial=0.0))),
            table,
        ],
        outputs=[out, failed, miss],
        device="cpu",
    )
    bad = np.flatnonzero(failed.numpy() >= 0)
    if bad.size:
        k = int(bad[0])
        record = int(failed.numpy()[k])
        raise SimulationError(
            f"element test: {bad.size} of {sets} parameter sets did not reach their stress; the first one missed it by "
            f"{float(miss.numpy()[k]):.3g} Pa before record {record + 1} of {records} (target {targets[record]}), "
            f"parameters {dict(batch[k])}; take smaller steps, or a path that this soil can follow"
        )
    result = out.numpy()
    first = np.zeros((sets, 1, OUTPUTS))
    first[..., 3:6] = confining
    full = np.concatenate([first, result], axis=1)
    if not np.isfinite(full).all():
        raise SimulationError(f"element test: the state is not finite; parameters {[dict(v) for v in batch][:3]}")
    return ElementTest(
        values=tuple(law.values(v) for v in batch),
        strain=full[..., 0:3],
        stress=full[..., 3:6],
        shear_strain=full[..., 6],
        shear_stress=full[..., 7],
        plastic_strain=full[..., 8],
        initial_void_ratio=void_ratio,
    )


def _path(strains: npt.ArrayLike) -> FloatArray:
    path = np.asarray(strains, dtype=np.float64).reshape(-1)
    if path.size == 0 or not np.isfinite(path).all():
        raise ParameterError("strains: give at least one finite number")
    return path


def _positive(**numbers: float) -> None:
    for name, value in numbers.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ParameterError(f"{name}: {value} is not a positive number")
