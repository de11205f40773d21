"""Video files as phones, editors and bad disks leave them."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatsoil.errors import MeasurementError
from splatsoil.importing.video import Video

ffmpeg = pytest.importorskip("imageio_ffmpeg")
COUNT, RATE, SIZE = 60, 30, (160, 120)
Film = Callable[..., Path]


@pytest.fixture
def film(tmp_path: Path) -> Film:
    """Writes 60 frames that get brighter by 4 of 255 each, over noise, by ffmpeg's own options."""

    def write(name: str, *options: str) -> Path:
        noise = np.random.default_rng(0).integers(-8, 9, (COUNT, *SIZE[::-1], 1))
        frames = np.uint8(10 + 4 * np.arange(COUNT)[:, None, None, None] + noise).repeat(3, axis=3)
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "160x120", "-r", str(RATE), "-i", "-"]
        command = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *raw, *options, str(tmp_path / name)]
        subprocess.run(command, input=frames.tobytes(), check=True)
        return tmp_path / name

    return write


@pytest.mark.parametrize("name", ["a.mp4", "b.mkv", "c.webm", "d.avi", "of: two.mov", "-e.mp4"])
def test_each_frame_has_its_number(film: Film, name: str) -> None:
    video = Video.open(film(name))
    assert video.rate == pytest.approx(RATE, rel=1e-3) and video.size == SIZE
    assert video.numbers == tuple(range(COUNT))
    for number, picture in video.pictures({0, 17, COUNT - 1}):
        assert picture.mean() == pytest.approx(10 + 4 * number, abs=2.0)


def test_frames_that_a_phone_left_out_do_not_shift_the_others(film: Film) -> None:
    """A file says 20 frames a second of these, and ffmpeg fills the gap by repeating one frame."""
    video = Video.open(film("gap.mp4", "-vf", "select='not(between(n,20,39))'", "-fps_mode", "vfr"))
    assert video.rate == pytest.approx(RATE, rel=1e-3)
    assert video.numbers == (*range(20), *range(40, COUNT))
    found = dict(video.pictures({19, 40, 59}))
    assert {number: round((picture.mean() - 10) / 4) for number, picture in found.items()} == {19: 19, 40: 40, 59: 59}
    with pytest.raises(MeasurementError, match="ends before frame 30"):
        list(video.pictures({19, 30}))


@pytest.mark.parametrize("name", ["a.mp4", "b.mkv", "d.avi"])
@pytest.mark.parametrize("harm", ["cut", "sector"])
def test_a_damaged_video_is_refused(film: Film, name: str, harm: str) -> None:
    """H.264 and MPEG-4 without their end, or with a disk's lost sector."""
    file = film(name, *(["-movflags", "faststart"] if name == "a.mp4" else []))
    data = file.read_bytes()
    half = len(data) // 2
    file.write_bytes(data[:half] if harm == "cut" else data[:half] + bytes(4096) + data[half + 4096 :])
    with pytest.raises(MeasurementError, match="is damaged"):
        Video.open(file)


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\nsecret.mp4\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile secret.mp4\n",
    ],
)
def test_a_playlist_reads_no_other_file(film: Film, text: str) -> None:
    list_of_others = film("secret.mp4").with_name("x.mp4")
    list_of_others.write_text(text)
    with pytest.raises(MeasurementError, match="cannot be read as a video"):
        Video.open(list_of_others)
