"""What ``compare`` says of the floor."""

import pytest

from splatsoil.commands.compare import show_misfit


@pytest.mark.parametrize(
    ("p", "adequate", "explained"), [(0.001, True, True), (0.5, True, False), (0.001, False, False)]
)
def test_blocks_that_stand_out_of_an_adequate_model_are_explained(
    p: float, adequate: bool, explained: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    block = {"stage": "pushing", "region": "berm", "channel": "left", "ratio": 5.0, "p": p}
    test = {"dispersion": 1.44, "p": 0.2}
    whole = {"ratio": 1.15, "p": 0.3, "n": 700}
    show_misfit({"blocks": [block], "misfit": test, "whole": whole, "adequate": adequate, "sentences": []}, "runs/x")
    said = " ".join(capsys.readouterr().out.split())
    assert "the residual is 1.15 times what noise leaves (p 0.3), slow waves of it 1.2 times (p 0.2)" in said
    assert ("A part may stand out by itself" in said) is explained
    assert ("1 of 1 blocks stand out" if p < 0.01 else "0 of 1 blocks stand out") in said
    assert ("not adequate" in said) is not adequate
