"""Video files, by ffmpeg."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.errors import MeasurementError, ParameterError

Picture = npt.NDArray[np.uint8]

#: Frames as they are in the file, each once: by default ffmpeg repeats and omits frames for an even rate.
_EACH_ONCE = ["-fps_mode", "passthrough"]
#: Containers of one file. Playlists, which ffmpeg knows by their contents, name other files.
_ONE_FILE = ["-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf,flv"]


@dataclass(frozen=True)
class Video:
    """A video file.

    Attributes:
        path: the file.
        rate: frames a second where frames follow each other without a gap.
        size: width and height, px.
        numbers: of its frames, by their times and ``rate``, from 0 on. Phones omit frames; of two with one number the
            first is used.
    """

    path: Path
    rate: float
    size: tuple[int, int]
    numbers: tuple[int, ...]

    @classmethod
    def open(cls, path: Path) -> Video:
        """Decode the whole video once, for its frames' times and to detect errors.

        Raises:
            ParameterError: imageio-ffmpeg isn't installed.
            MeasurementError: the file is missing, no video, or damaged.
        """
        try:
            import imageio_ffmpeg
        except ImportError as error:
            raise ParameterError("--video: needs imageio-ffmpeg; pip install 'splatsoil[video]'") from error
        if not path.is_file():
            raise MeasurementError("no such video", file=path)
        try:
            stream = imageio_ffmpeg.read_frames(_name(path), input_params=_ONE_FILE)
            facts = next(stream)
            stream.close()
        except (OSError, RuntimeError, StopIteration) as error:
            raise MeasurementError("cannot be read as a video; is it what its name says?", file=path) from error
        width, height = facts["size"]
        times = _times(path, imageio_ffmpeg.get_ffmpeg_exe())
        steps = np.diff(times)
        if len(steps) == 0 or not (steps > 0.0).all():
            raise MeasurementError("the video has less than two frames, or frames without times", file=path)
        rate = 1.0 / float(steps[steps < 1.5 * np.median(steps)].mean())
        numbers = np.rint((times - times[0]) * rate).astype(int)
        return cls(path, rate, (int(width), int(height)), tuple(numbers.tolist()))

    def pictures(self, wanted: set[int]) -> Iterator[tuple[int, Picture]]:
        """Number and picture (h, w, 3) of the wanted frames, in order.

        Raises:
            MeasurementError: the video ends before.
        """
        import imageio_ffmpeg

        width, height = self.size
        left = set(wanted)
        stream = imageio_ffmpeg.read_frames(_name(self.path), input_params=_ONE_FILE, output_params=_EACH_ONCE)
        try:
            next(stream)
            for number, data in zip(self.numbers, stream, strict=False):
                if number in left:
                    left.remove(number)
                    yield number, np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)
                if not left:
                    return
        except (OSError, RuntimeError) as error:
            raise MeasurementError("the video is damaged", file=self.path) from error
        finally:
            stream.close()
        raise MeasurementError(f"the video is damaged: it ends before frame {min(left)}", file=self.path)


def _name(path: Path) -> str:
    """A file's name for ffmpeg, which takes others with a colon for addresses."""
    return f"file:{path}"


def _times(path: Path, ffmpeg: str) -> npt.NDArray[np.float64]:
    """Times (n,) in s of a video's frames, all of them decoded; MeasurementError at the first error."""
    strict = ["-v", "error", "-nostdin", "-xerror", "-err_detect", "crccheck+bitstream+buffer+explode"]
    command = [ffmpeg, *strict, *_ONE_FILE, "-i", _name(path), "-map", "0:v:0", *_EACH_ONCE, "-f", "framecrc", "-"]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode or done.stderr:
        fault = (done.stderr.splitlines() or ["no reason given"])[0].rpartition("] ")[2].rstrip(".")
        raise MeasurementError(
            f"the video is damaged (decoding it: {fault}); copy it again, or let ffmpeg write it anew", file=path
        )
    unit, times = float("nan"), []
    for line in done.stdout.splitlines():
        if line.startswith("#tb 0:"):
            above, below = line.split(":")[1].split("/")
            unit = int(above) / int(below)
        elif not line.startswith("#"):
            times.append(int(line.split(",")[2]) * unit)
    return np.array(times, dtype=np.float64)
