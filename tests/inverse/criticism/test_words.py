"""Sentences of a diagnosis."""

from splatsoil.inverse.criticism.estimates import Estimate
from splatsoil.inverse.criticism.words import of_estimates


def test_what_is_not_determined_gets_no_number() -> None:
    known = Estimate(34.6, 2.0, 1.0, "deg")
    anything = Estimate(2000.0, 23000.0, 900.0, "Pa", determined=False)
    angle, _, cohesion = of_estimates({"friction_angle": known, "cohesion": anything})
    assert "friction angle is 34.6 ± 2.2° (± 2° by noise and chance, ± 1° systematic)." in angle
    assert "doesn't determine the cohesion" in cohesion and not any(c.isdigit() for c in cohesion)


def test_one_sentence_says_all_that_is_determined_and_the_next_what_is_systematic() -> None:
    told = of_estimates(
        {"friction_angle": Estimate(34.6, 2.0, 1.0, "deg"), "cohesion": Estimate(410.0, 30.0, 90.0, "Pa")}
    )
    assert len(told) == 2
    assert "friction angle is 34.6 ± 2.2°" in told[0] and "and the cohesion is 410 ± 90 Pa (± 30 Pa" in told[0]
    assert of_estimates({"cohesion": Estimate(2000.0, 23000.0, 900.0, "Pa", determined=False)})[1:] == []
