"""What a set's remarks and faults are, every command that works on it says."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from splatsoil.cli import main
from splatsoil.errors import RunError


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reconstruction ends where it would begin."""

    def enough(*_: object, **__: object) -> None:
        raise RunError("work would begin here")

    monkeypatch.setattr("splatsoil.reconstruction.reconstruct", enough)


@pytest.mark.parametrize("command", ["check", "reconstruct", "fit", "run"])
@pytest.mark.usefixtures("no_work")
def test_every_command_says_what_is_odd_and_refuses_what_shows_nothing(
    command: str, small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 3
    path = small_set / "views/images/002.jpg"
    image = Image.open(path).convert("RGB")
    image.save(path, exif=exif)
    assert main([command, str(small_set)]) == (0 if command == "check" else 2)
    out, err = capsys.readouterr()
    said = " ".join((out + err).split())
    assert "EXIF rotation" in said and "002.jpg" in said
    assert ("work would begin here" in said) == (command != "check")

    Image.new("RGB", image.size).save(path)
    assert main([command, str(small_set)]) == 2
    out, err = capsys.readouterr()
    assert "one even grey" in err and "work would begin" not in err and out == ""
