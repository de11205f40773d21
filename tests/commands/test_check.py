"""What a set's remarks and faults are, every command that works on it says."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import pytest
from PIL import Image
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.cli import main
from splatsoil.commands._stages import without_noise
from splatsoil.errors import RunError
from splatsoil.measurement import Measurement


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reconstruction ends where it would begin."""

    def enough(*_: object, **__: object) -> None:
        raise RunError("work would begin here")

    monkeypatch.setattr("splatsoil.reconstruction.reconstruct", enough)


def turned(folder: Path) -> None:
    """Have a view's EXIF data ask for a half turn."""
    exif = Image.Exif()
    exif[0x0112] = 3
    path = folder / "views/images/002.jpg"
    Image.open(path).convert("RGB").save(path, exif=exif)


@pytest.mark.parametrize("command", ["check", "reconstruct", "fit", "run"])
@pytest.mark.usefixtures("no_work")
def test_every_command_says_what_is_odd_and_refuses_what_shows_nothing(
    command: str, small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    turned(small_set)
    assert main([command, str(small_set)]) == (0 if command == "check" else 2)
    out, err = capsys.readouterr()
    said = " ".join((out + err).split())
    assert "EXIF rotation" in said and "002.jpg" in said
    assert ("work would begin here" in said) == (command != "check")

    view, stream = small_set / "views/images/002.jpg", io.BytesIO()
    Image.new("RGB", (320, 240)).save(stream, format="JPEG")
    half = view.read_bytes()[: view.stat().st_size // 2]
    for contents, says in ((stream.getvalue(), "one even grey"), (half, "damaged or truncated")):
        view.write_bytes(contents)
        assert main([command, str(small_set)]) == 2
        out, err = capsys.readouterr()
        assert says in err and "002.jpg" in err and "work would begin" not in err and out == ""


@pytest.mark.parametrize("command", [("compare", "--quick"), ("add", "cohesion")], ids=lambda c: c[0])
@pytest.mark.usefixtures("no_work")
def test_commands_on_a_run_say_it_too(
    command: tuple[str, str], small_set: Path, tmp_path: Path, run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    turned(small_set)
    described = {"name": "plow", "folder": str(small_set), "hash": Measurement.load(small_set).hash}
    other = RunFolder.prepare(tmp_path / "other", measurement=described, preset="tiny", seed=0, version="1")
    other.write_fit("base", run.fit())
    assert main([command[0], str(other.path), command[1]]) == 2
    err = " ".join(capsys.readouterr().err.split())
    assert err.count("EXIF rotation") == 1 and "work would begin here" in err


def test_frames_without_noise_are_told_from_a_cameras(small_set: Path) -> None:
    """As a renderer makes them: all that is seen before the tool moves is the same to the last bit."""
    assert not without_noise(Measurement.load(small_set))
    frames = json.loads((small_set / "video/transforms.json").read_text())["frames"]
    stills = {frame["camera"]: small_set / "video" / frame["file_path"] for frame in frames if frame["frame"] == 0}
    for frame in frames:
        if frame["frame"] < 0:
            shutil.copy(stills[frame["camera"]], small_set / "video" / frame["file_path"])
    assert without_noise(Measurement.load(small_set))
