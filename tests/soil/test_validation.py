"""Real sand in a laboratory's triaxial cell: Wichtmann & Triantafyllidis (2016), where the data are at hand."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._validation.element import ALLOWED, inertia, strength
from splatsoil.benchmarks._validation.sand import LADDER, LIMITS, from_one_to_another, karlsruhe

from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.matching import Matching
from splatsoil.soil.packing import at_void_ratio, of_limits

FILE = Path(os.environ.get("SPLATSOIL_MEASURED", "")) / "karlsruhe_triaxial" / "tmd2_loose_tmd22_dense_subset.csv"
SUMMARY = FILE.with_name("summary_25_drained_tests_derived.csv")

PEAK = 42.14
"""Peak friction angle of TMD22, from the data set's own table of all 25 tests, degrees."""
CRITICAL = 33.1
"""Published critical friction angle, degrees."""


@pytest.mark.parametrize("matching", list(Matching))
@pytest.mark.parametrize("cohesion", [0.0, 300.0])
def test_strength_is_exact_in_the_test_a_matching_is_named_after(matching: Matching, cohesion: float) -> None:
    found, exact = strength(matching, cohesion)
    assert found == pytest.approx(exact, rel=ALLOWED)


@pytest.mark.parametrize("inertial_number", [0.01, 0.279, 3.0])
def test_friction_follows_the_inertial_number(inertial_number: float) -> None:
    """mu(I) of glass beads (Jop et al. 2006)."""
    found, exact = inertia(inertial_number)
    assert found == pytest.approx(exact, rel=ALLOWED)


@pytest.mark.skipif(not FILE.is_file(), reason="SPLATSOIL_MEASURED names no folder with karlsruhe_triaxial")
@pytest.mark.parametrize(("fit", "other"), [("TMD2", "TMD22"), ("TMD22", "TMD2")])
def test_each_effect_lowers_the_error_on_a_density_that_was_not_fitted(fit: str, other: str) -> None:
    curves = karlsruhe(FILE.parents[1])
    known = of_limits(curves[fit].void_ratio, *LIMITS)
    rows = from_one_to_another("sand", curves, [fit], LADDER[:3], known)
    assert [row.held for row in rows] == [None, True, True]
    assert all(row.found.startswith(f"{other} q/p") for row in rows)
    ratio = curves["TMD22"].ratio.max()
    assert math.degrees(math.asin(3.0 * ratio / (6.0 + ratio))) == pytest.approx(PEAK, abs=0.1)


@pytest.mark.skipif(not SUMMARY.is_file(), reason="SPLATSOIL_MEASURED names no folder with karlsruhe_triaxial")
def test_published_index_numbers_predict_the_peaks_of_25_tests() -> None:
    """Critical angle and void ratio limits as published, and no fit: densities from 0.15 to 1, 50 to 400 kPa."""
    law = Law(find_effects(["critical_state", "hardening", "stiffness"]))
    soil = {
        "friction_angle": CRITICAL,
        "relative_density": 0.2,
        "volume_range": math.log(2.054 / 1.677),
        "hardening_strain": 0.008,
        "stiffness_factor": 5.0,
    }
    loose = 2.054 * math.exp(-0.2 * soil["volume_range"]) - 1.0
    strains = np.linspace(0.002, 0.3, 100)
    off = []
    with SUMMARY.open(newline="") as stream:
        for row in csv.DictReader(stream):
            values = at_void_ratio(soil, loose, float(row["e0"]))
            test = triaxial(law, values, confining=1e3 * float(row["p0_kPa"]), strains=strains, young=2e7)
            ratio = (test.q / test.p)[0].max()
            gained = -np.diff(test.volume_strain[0, 1:]) / np.diff(strains)
            peak = math.degrees(math.asin(3.0 * ratio / (6.0 + ratio)))
            dilation = math.degrees(math.asin(np.max(gained / (2.0 + gained))))
            off.append((peak - float(row["phi_peak_deg"]), dilation - float(row["psi_max_deg"])))
    assert len(off) == 25
    assert np.sqrt(np.mean(np.square(off), axis=0)) == pytest.approx([1.0, 1.0], abs=0.5)
