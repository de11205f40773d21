"""``splatsoil element``, and what docs/effects.md says of it."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import shlex
from pathlib import Path

import pytest

from splatsoil import cli
from splatsoil.commands.element import LARGEST_STRAIN, MOST_RECORDS, Config


def test_the_triaxial_test_as_json_with_a_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Strength 2 sigma_3 sin / (1 - sin); a volume that the void ratio follows."""
    plot = tmp_path / "curve.png"
    words = ["element", "--friction-angle", "30", "--with", "dilatancy", "--set", "dilatancy_angle=10", "--json"]
    assert cli.main([*words, "--plot", str(plot), "--strain", "0.1"]) == 0
    printed = json.loads(capsys.readouterr().out)
    records = printed["records"]
    assert records["q [Pa]"][-1] == pytest.approx(2e5, rel=1e-3)
    assert len(records["axial strain"]) == 101
    assert records["void ratio"][-1] == pytest.approx(1.8 * math.exp(-records["volume strain"][-1]) - 1.0)
    assert records["volume strain"][-1] < -0.01
    assert printed["parameters"]["dilatancy_angle"] == 10.0
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("test", "column", "value"),
    [
        ("extension", "q [Pa]", -1e5 * 1.2 / 1.4),
        ("simple-shear", "normal stress [Pa]", 1e5),
        ("isotropic", "p [Pa]", 1e6),
    ],
)
def test_the_other_tests(
    test: str, column: str, value: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In extension, a cone matched in compression has |q| = M p, p = sigma_3 - |q| / 3, M = 6 sin / (3 - sin) = 1.2."""
    plot = str(tmp_path / "curve.svg")
    assert cli.main(["element", "--test", test, "--friction-angle", "30", "--json", "--plot", plot]) == 0
    records = json.loads(capsys.readouterr().out)["records"]
    assert records[column][-1] == pytest.approx(value, rel=1e-3)


def test_the_limits_are_in_the_help() -> None:
    texts = {field.name: field.metadata["text"] for field in dataclasses.fields(Config)}
    assert texts["strain"].endswith(f"at most {LARGEST_STRAIN:g}.") and f"2 to {MOST_RECORDS}." in texts["records"]


def test_commands_and_python_of_the_documents_run(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (repository / "docs" / "effects.md").read_text()
    monkeypatch.chdir(repository)
    commands = re.findall(r"^splatsoil (element .*)$", text, flags=re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        assert cli.main([*shlex.split(command), "--plot", str(tmp_path / "curve.png")]) == 0
    (snippet,) = (s for s in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL) if s.startswith("from"))
    exec(compile(snippet, "docs/effects.md", "exec"), {})
    assert "plot: " in capsys.readouterr().out
