"""Part ``element``: the law at one point against closed forms."""

from __future__ import annotations

import math

import numpy as np
from splatsoil.benchmarks._validation.page import Row, Section
from splatsoil.benchmarks._validation.scene import FloatArray

from splatsoil.soil.element import simple_shear, triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.matching import Matching

ANGLES = (25.0, 30.0, 35.0, 40.0, 45.0)
COHESIONS = (0.0, 300.0)
CONFINING = 1.0e4
ALLOWED = 1.0e-3


def strength(matching: Matching, cohesion: float) -> tuple[FloatArray, FloatArray]:
    """Found and exact stress at failure (angles,) in Pa, in the test after which a matching is named."""
    law = Law(find_effects(["cohesion"]))
    sets = [{"friction_angle": angle, "cohesion": cohesion} for angle in ANGLES]
    sine, cosine = np.sin(np.radians(ANGLES)), np.cos(np.radians(ANGLES))
    if matching is Matching.COMPRESSION:
        test = triaxial(law, sets, confining=CONFINING, strains=[0.05], matching=matching, young=2e7)
        return test.q[:, -1], (2.0 * CONFINING * sine + 2.0 * cohesion * cosine) / (1.0 - sine)
    if matching is Matching.EXTENSION:
        test = triaxial(law, sets, confining=CONFINING, strains=[-0.05], matching=matching, young=2e7)
        return -test.q[:, -1], (2.0 * CONFINING * sine + 2.0 * cohesion * cosine) / (1.0 + sine)
    test = simple_shear(law, sets, confining=CONFINING, strains=[0.3], matching=matching, young=2e7)
    if matching is Matching.PLANE_STRAIN:
        return test.shear_stress[:, -1], test.p[:, -1] * sine + cohesion * cosine
    return test.shear_stress[:, -1], test.p[:, -1] * sine / cosine + cohesion


def inertia(inertial_number: float) -> tuple[float, float]:
    """Found and exact stress ratio of steady shear under the mu(I) law with the constants of glass beads."""
    slow, fast, number = math.tan(math.radians(20.9)), math.tan(math.radians(32.8)), 0.279
    values = {"friction_angle": 20.9, "rate_gain": fast / slow - 1.0}
    rate = inertial_number * math.sqrt(CONFINING / 2500.0) / 1e-3
    test = simple_shear(
        Law(find_effects(["rate_dependence"])),
        values,
        confining=CONFINING,
        strains=[0.3],
        strain_rate=rate,
        matching=Matching.SIMPLE_SHEAR,
    )
    ratio, p = float(test.shear_stress[0, -1] / test.p[0, -1]), float(test.p[0, -1])
    own = rate * 1e-3 / math.sqrt(p / 2500.0)
    return ratio, slow + (fast - slow) / (1.0 + number / own)


def validate() -> Section:
    """All angles, matchings and cohesions, and the mu(I) law."""
    rows = []
    for matching in Matching:
        for cohesion in COHESIONS:
            found, exact = strength(matching, cohesion)
            worst = float(np.abs(found / exact - 1.0).max())
            values = ", ".join(f"{v / 1e3:.3f}" for v in exact)
            case = f"{matching.value.replace('_', ' ')}, c = {cohesion:g} Pa"
            rows.append(Row(case, f"off by {100 * worst:.4f} % at most", f"{values} kPa ± 0.1 %", worst <= ALLOWED))
    for number in (0.003, 0.03, 0.3):
        ratio, wanted = inertia(number)
        held = abs(ratio / wanted - 1.0) <= ALLOWED
        rows.append(Row(f"μ(I) at I = {number:g}", f"τ/p = {ratio:.5f}", f"{wanted:.5f} ± 0.1 %", held))
    return Section(
        "The law at one point",
        "Strength at friction angles of 25, 30, 35, 40 and 45° under 10 kPa in `splatsoil.soil.element`, which runs "
        "the function that the solver runs. Compression and extension: axial less lateral stress against "
        "Mohr–Coulomb. Plane strain and simple shear: shear stress at the pressure of the sheared sample against "
        "p sin φ + c cos φ and p tan φ + c. μ(I): Jop, Forterre & Pouliquen (2006), tan 20.9° to 32.8°, I₀ = 0.279.",
        tuple(rows),
    )
