"""Sentences of a diagnosis."""

from splatsoil.inverse.criticism.estimates import Estimate
from splatsoil.inverse.criticism.words import of_estimates


def test_what_is_not_determined_gets_no_number() -> None:
    known = Estimate(34.6, 2.0, 1.0, "deg")
    anything = Estimate(2000.0, 23000.0, 900.0, "Pa", determined=False)
    angle, cohesion = of_estimates({"friction_angle": known, "cohesion": anything})
    assert "friction angle is 34.6 ± 2.2°" in angle
    assert "doesn't determine the cohesion" in cohesion and not any(c.isdigit() for c in cohesion)
