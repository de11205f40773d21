"""Which stroke tells effects apart: exact answers from element tests, and the strokes' geometry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from splatsoil.inverse.criticism.strokes import advise

from splatsoil.experiment.strokes import MEASURED, motions
from splatsoil.experiment.triaxial import Curve, TriaxialExperiment
from splatsoil.measurement import Measurement

STRAIN = np.linspace(0.01, 0.2, 12)
CURVE = Curve("made", STRAIN, np.zeros(12), np.ones(12), 1e4)
VALUES = {"friction_angle": 33.0, "stiffness_factor": 1.0, "cohesion": 500.0, "rate_gain": 0.4, "softening_angle": 4.0}


def experiment(*names: str) -> TriaxialExperiment:
    return TriaxialExperiment(CURVE, candidates=names)


def test_softening_and_cohesion_are_told_apart_at_another_pressure() -> None:
    made = experiment("cohesion", "softening")
    (advice,) = advise(made, VALUES, made.candidates)
    assert advice.pair == ("cohesion", "softening") and set(advice.alike) == set(made.strokes())
    # At one pressure cohesion only raises friction, which is fitted: nothing of it is left to tell.
    assert advice.alike[MEASURED] > 0.3
    assert advice.best == "at a fifth of the pressure" and advice.alike[advice.best] < advice.alike[MEASURED] - 0.1


def test_what_noise_hides_is_alike() -> None:
    made = experiment("cohesion", "pressure_dependence")
    (advice,) = advise(made, VALUES, made.candidates)
    # Neither hangs on the rate, and at one pressure both are friction: nothing is left of them.
    assert advice.alike[MEASURED] > 0.99 and advice.alike["a thousand times as fast"] > 0.99


def test_one_effect_or_no_stroke_needs_no_advice() -> None:
    made = experiment("cohesion")
    assert advise(made, VALUES, made.candidates) == ()

    class Still:
        parameters = made.parameters

    assert advise(Still(), VALUES, experiment("cohesion", "softening").candidates) == ()  # type: ignore[arg-type]


def test_a_stroke_that_is_no_better_is_not_suggested() -> None:
    made = experiment("cohesion", "softening")

    class Same(TriaxialExperiment):
        def strokes(self) -> Mapping[str, object]:  # type: ignore[override]
            predict = super().strokes()[MEASURED]
            return {MEASURED: predict, "again": predict}

    same = Same(CURVE, candidates=("cohesion", "softening"))
    (advice,) = advise(same, VALUES, made.candidates)
    assert advice.best == "" and advice.alike["again"] == pytest.approx(advice.alike[MEASURED])


def test_effects_are_compared_in_the_shape_that_their_refits_found() -> None:
    names, asked = ("cohesion", "softening"), []

    class Watched(TriaxialExperiment):
        def strokes(self) -> Mapping[str, object]:  # type: ignore[override]
            def predict(values: Mapping[str, float], effects: tuple[str, ...]) -> np.ndarray:
                asked.append((effects, values.get("softening_strain")))
                return made[MEASURED](values, effects)

            made = super().strokes()
            return {MEASURED: predict}

    found = {}
    for strain in (None, 0.3, 3.0):
        asked.clear()
        values = VALUES if strain is None else {**VALUES, "softening_strain": strain}
        watched = Watched(CURVE, candidates=names)
        (advice,) = advise(watched, values, watched.candidates)
        assert {at for effects, at in asked if effects == ("softening",)} == {strain}
        assert {at for effects, at in asked if effects != ("softening",)} == {None}
        found[strain] = advice.alike[MEASURED]
    assert found[0.3] == found[None], "0.3 is the default"
    assert abs(found[3.0] - found[0.3]) > 0.02


def test_strokes_do_what_their_names_say(repository: Path) -> None:
    measurement = Measurement.load(repository / "examples" / "plow-dry")
    surface = float(measurement.bed.lower[2]) + 0.7 * float((measurement.bed.upper - measurement.bed.lower)[2])
    made = motions(measurement, surface)
    corners = np.asarray(measurement.tool.mesh.vertices)

    def lowest(m: Measurement) -> np.ndarray:
        motion, rate = m.tool.motion, m.frame_rate
        poses = [motion.pose(frame / rate) for frame in motion.frames]
        return np.array([(corners @ np.asarray(r).T + p)[:, 2].min() for r, p in poses])

    was = lowest(made[MEASURED])
    sunk = was < surface
    assert sunk.any()
    assert np.allclose(surface - lowest(made["half as deep"])[sunk], 0.5 * (surface - was)[sunk], atol=1e-6)
    for name in ("with the tool's edge ahead", "with the tool's edge behind", "twice as fast", "half as fast"):
        assert np.allclose(lowest(made[name]), was, atol=1e-6), name
    fast, slow = (np.diff(made[n].tool.motion.times).sum() for n in ("twice as fast", "half as fast"))
    assert slow == pytest.approx(4.0 * fast)
    for name, m in made.items():
        assert lowest(m).min() > measurement.bed.lower[2] - 1e-9, name
