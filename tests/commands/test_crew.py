"""What other processes do for criticism."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatsoil.commands import _crew
from splatsoil.errors import SimulationError


@pytest.mark.parametrize("count", [1, 3])
def test_a_helper_prepares_what_goes_together_and_makes_what_can_be_made(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[Sequence[Any]] = []
    made: list[int] = []

    def simulate(*, number: int) -> None:
        if number == 1:
            raise SimulationError("blew up")
        made.append(number)

    experiment = SimpleNamespace(prepare=prepared.append)
    monkeypatch.setitem(_crew._known, (tmp_path, "cpu", ()), (None, experiment, simulate))  # type: ignore[misc]
    jobs = [{"number": number} for number in range(count)]
    _crew._simulate(tmp_path, "cpu", (), 1, jobs)
    assert made == [number for number in range(count) if number != 1]
    assert prepared == ([] if count == 1 else [jobs])
