"""Part ``cuts`` of ``splatsoil benchmark validate``: which soil the crest is."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from splatsoil.benchmarks._validation import cuts
from splatsoil.benchmarks._validation.scene import Scene


@pytest.mark.parametrize(("crest", "share"), [(True, 0.1), (False, 0.0)])
def test_the_crest_is_the_topmost_soil_at_the_face(crest: bool, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Soil sinks by a tenth of the height: the topmost cell behind the face, or all other soil."""
    scene = cuts.cut(100.0, 33.0, 8)
    x, cell = scene.x.copy(), scene.resolution.cell
    from_face = x[:, 0].max() - x[:, 0]
    near = (from_face < cell) & (x[:, 2] > cuts.HEIGHT - cell)
    x[near if crest else ~near, 2] -= 0.1 * cuts.HEIGHT
    monkeypatch.setattr(Scene, "rest", lambda *_: SimpleNamespace(positions=lambda: x[None]))
    assert cuts.sinks(scene, "cpu") == pytest.approx(share, abs=1e-9)
