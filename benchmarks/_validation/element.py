"""Part ``element``: the law at one point against closed forms."""

from __future__ import annotations

import math

import numpy as np
from splatsoil.benchmarks._common import FloatArray
from splatsoil.benchmarks._parts import Row, Section

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
    if matching in (Matching.COMPRESSION, Matching.EXTENSION):
        sign = 1.0 if matching is Matching.COMPRESSION else -1.0
        pressed = triaxial(law, sets, confining=CONFINING, strains=[0.05 * sign], matching=matching, young=2e7)
        return sign * pressed.q[:, -1], 2.0 * (CONFINING * sine + cohesion * cosine) / (1.0 - sign * sine)
    sheared = simple_shear(law, sets, confining=CONFINING, strains=[0.3], matching=matching, young=2e7)
    found, p = sheared.shear_stress[:, -1], sheared.p[:, -1]
    return found, p * sine + cohesion * cosine if matching is Matching.PLANE_STRAIN else p * sine / cosine + cohesion


def inertia(inertial_number: float) -> tuple[float, float]:
    """Found and exact stress ratio of steady shear under the mu(I) law with the constants of glass beads."""
    slow, fast, number = math.tan(math.radians(20.9)), math.tan(math.radians(32.8)), 0.279
    test = simple_shear(
        Law(find_effects(["rate_dependence"])),
        {"friction_angle": 20.9, "rate_gain": fast / slow - 1.0},
        confining=CONFINING,
        strains=[0.3],
        strain_rate=inertial_number * math.sqrt(CONFINING / 2500.0) / 1e-3,
        matching=Matching.SIMPLE_SHEAR,
    )
    p = float(test.p[0, -1])
    own = inertial_number * math.sqrt(CONFINING / p)
    return float(test.shear_stress[0, -1]) / p, slow + (fast - slow) / (1.0 + number / own)


def validate(device: str) -> Section:
    """All angles, matchings and cohesions, and the mu(I) law."""
    del device
    rows = []
    for matching in Matching:
        for cohesion in COHESIONS:
            found, exact = strength(matching, cohesion)
            worst = float(np.abs(found / exact - 1.0).max())
            values = ", ".join(f"{v / 1e3:.3f}" for v in exact)
            case = f"{matching.value.replace('_', ' ')}, c = {cohesion:g} Pa"
            rows.append(Row(case, f"off by {100 * worst:.4f} % at most", f"{values} kPa ± 0.1 %", worst <= ALLOWED))
    rows += [
        Row.near(f"μ(I) at I = {number:g}", *inertia(number), ALLOWED, "τ/p = {:.5f}") for number in (3e-3, 0.03, 0.3)
    ]
    return Section("The law at one point", rows)
