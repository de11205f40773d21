"""Video files, by ffmpeg."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.errors import MeasurementError, ParameterError

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Video:
    """A video file.

    Attributes:
        path: the file.
        rate: frames a second, by the file.
        size: width and height, px.
        count: of its frames.
    """

    path: Path
    rate: float
    size: tuple[int, int]
    count: int

    @classmethod
    def open(cls, path: Path) -> Video:
        """Look at a video; all of it is decoded once, to count.

        Raises:
            ParameterError: imageio-ffmpeg isn't installed.
            MeasurementError: the file is missing, or no video.
        """
        try:
            import imageio_ffmpeg
        except ImportError as error:
            raise ParameterError("--video: needs imageio-ffmpeg; pip install 'splatsoil[video]'") from error
        if not path.is_file():
            raise MeasurementError("no such video", file=path)
        try:
            stream = imageio_ffmpeg.read_frames(str(path))
            facts = next(stream)
            stream.close()
            count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
        except (OSError, RuntimeError, StopIteration) as error:
            raise MeasurementError("cannot be read as a video; is it what its name says?", file=path) from error
        width, height = facts["size"]
        if not facts["fps"] > 0.0 or count < 1:
            raise MeasurementError("the video has no frame rate or no frames", file=path)
        return cls(path, float(facts["fps"]), (int(width), int(height)), int(count))

    def pictures(self, wanted: set[int]) -> Iterator[tuple[int, Picture]]:
        """Number and picture (h, w, 3) of the wanted frames, in order.

        Raises:
            MeasurementError: the video ends before.
        """
        import imageio_ffmpeg

        width, height = self.size
        stream = imageio_ffmpeg.read_frames(str(self.path))
        try:
            next(stream)
            for number, data in enumerate(stream):
                if number in wanted:
                    yield number, np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3)
                if number >= max(wanted):
                    return
        except (OSError, RuntimeError) as error:
            raise MeasurementError("the video is damaged", file=self.path) from error
        finally:
            stream.close()
