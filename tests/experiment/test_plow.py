"""What a plow experiment draws without simulating anew."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from splatsoil.experiment.plow import PlowExperiment


def asked(numerics: str) -> tuple[list[Any], list[Any]]:
    """How a prediction was simulated (effects and numerics of the model, numerics) and drawn (seed, albedo)."""
    simulated: list[Any] = []
    drawn: list[Any] = []
    model = SimpleNamespace(draw=lambda trajectory, seed, values, albedo: drawn.append((seed, albedo)))

    def variant(effects: tuple[str, ...], way: str) -> Any:
        simulated.append((effects, way))
        return model

    def trajectory(model: Any, values: Any, seed: int, way: str) -> None:
        simulated.append(way)

    experiment = SimpleNamespace(
        model=("cohesion",), guesses=PlowExperiment.guesses, _variant=variant, _trajectory=trajectory
    )
    PlowExperiment.prediction(cast(Any, experiment), {}, effects=("tilt",), seed=3, numerics=numerics)
    return simulated, drawn


@pytest.mark.parametrize(
    ("numerics", "way", "albedo"), [("", "", None), ("grid", "grid", None), ("albedo 1", "", 1), ("albedo 6", "", 6)]
)
def test_a_guess_is_another_drawing_of_the_same_simulation(numerics: str, way: str, albedo: int | None) -> None:
    simulated, drawn = asked(numerics)
    assert simulated == [(("cohesion", "tilt"), way), way]
    assert drawn == [(3, albedo)]
