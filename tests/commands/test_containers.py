"""A made-up set of each kind of container, through the whole path as a user goes it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatsoil.cli import main
from splatsoil.synthetic import make_set, plow


@pytest.mark.slow
@pytest.mark.parametrize("container", ["bin", "transparent", "open", "heap"])
def test_each_container_is_reconstructed_fitted_compared_and_diagnosed(
    container: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setup = plow(3, views=16, container=container).resized(0.5)
    make_set(tmp_path / "set", setup, friction_angle=33.0, preset="tiny", seed=3)
    run = tmp_path / "run"
    code = main(["run", str(tmp_path / "set"), "--run", str(run), "--preset", "tiny", "--criticise", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert code in (0, 3) and "Traceback" not in str(said)
    made = json.loads((run / "reconstruction" / "reconstruction.json").read_text())
    assert made["container"] == container and made["psnr"] > 28.0
    fit = json.loads((run / "fit.json").read_text())
    assert abs(fit["parameters"]["friction_angle"]["estimate"] - 33.0) < 8.0
    assert (run / "report.html").is_file()
    assert any(run.glob("diagnosis*"))
