"""Work in steps: the same results, and on a GPU one question to it for all of a round."""

from __future__ import annotations

import pytest
import torch

from splatsoil.splats.steps import Steps, stepwise, together

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def counting(name: str, numbers: list[int], device: str, log: list[str]) -> Steps[int]:
    """Asks for each number and adds up the answers."""
    total = 0
    for number in numbers:
        log.append(f"{name} asks for {number}")
        one, other = yield torch.tensor([number, 2 * number], device=device)
        assert other == 2 * one
        total += int(one)
    return total


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=[needs_cuda, pytest.mark.cuda])])
def test_each_gets_its_own_answers_and_a_gpu_is_asked_by_rounds(device: str) -> None:
    log: list[str] = []
    large = 2**40 + 1  # beyond single precision
    asked = {"a": [1, 2, large], "b": [], "c": [3, 4]}
    found = together([counting(name, numbers, device, log) for name, numbers in asked.items()])
    assert found == [3 + large, 0, 7]
    alone = ["a asks for 1", "a asks for 2", f"a asks for {large}", "c asks for 3", "c asks for 4"]
    rounds = [alone[0], alone[3], alone[1], alone[4], alone[2]]
    assert log == (alone if device == "cpu" else rounds)


def test_a_function_of_steps_is_called_like_any_other_and_fails_like_one() -> None:
    @stepwise
    def half(number: float) -> Steps[float]:
        """Of a number."""
        (answer,) = yield torch.tensor(number)
        if answer < 0.0:
            raise ValueError("below nothing")
        return 0.5 * answer

    assert half(3.0) == 1.5 and half.__doc__ == "Of a number."
    assert together([half.steps(1.0), half.steps(2.0)]) == [0.5, 1.0]
    with pytest.raises(ValueError, match="below"):
        half(-1.0)
