"""What can be imported."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from splatsoil.errors import MeasurementError
from splatsoil.options import argument, option


@dataclass(frozen=True)
class ImportOptions:
    """What is imported; one of `scale`, `distance`, `tags` and `known` determines the scale, else `motion_tags`."""

    source: Path = argument("transforms.json, or the folder of it or of a COLMAP model; of photographs, with --sfm.")
    out: Path = argument("Folder of the new set, or of parts of one; new or empty.")
    images: Path | None = option(None, "Photographs of a COLMAP model.", metavar="FOLDER")
    sfm: bool = option(False, "SOURCE has photographs without poses; pycolmap finds them.")
    scale: float | None = option(None, "Length of SOURCE's unit.", metavar="METRES")
    distance: tuple[str, str, float] | None = option(
        None, "Between two of --points, for the scale.", metavar="A B METRES"
    )
    tags: float | None = option(None, "Edge of AprilTags (36h11) in photographs, for the scale.", metavar="METRES")
    known: Path | None = option(
        None, "point,x,y,z in the set's world: scale, turn, origin.", metavar="CSV", expert=True
    )
    points: Path | None = option(None, "point,image,u,v or point,x,y,z in SOURCE's world.", metavar="CSV", expert=True)
    up: tuple[float, float, float] | None = option(
        None, "What is up in SOURCE's world; z but for COLMAP.", metavar="X Y Z"
    )
    tool: tuple[Path, str] | None = option(None, "The tool; m, cm, mm or in.", metavar="MESH UNIT")
    motion: tuple[Path, str] | None = option(
        None, "Flange in the robot's frame: time,x,y,z,qw,qx,qy,qz.", metavar="CSV UNIT"
    )
    motion_tags: Path | None = option(None, "AprilTags on the tool: tag,corner,x,y,z (m).", metavar="CSV", expert=True)
    force: Path | None = option(None, "On the tool, robot's axes: time,fx,fy,fz (N).", metavar="CSV")
    robot_to_world: Path | None = option(None, "4 x 4 (m), from hand-eye calibration.", metavar="FILE", expert=True)
    mesh_to_flange: Path | None = option(None, "4 x 4 (m), how the mesh is mounted.", metavar="FILE", expert=True)
    video: tuple[str, ...] = option((), "Video, and its camera's photograph in SOURCE.", metavar="FILE=IMAGE")
    video_every: int = option(1, "Keep every N-th frame.", expert=True)
    clock_offset: float | None = option(None, "Robot's time minus video's; estimated if not given.", metavar="SECONDS")
    experiment: Path | None = option(None, "experiment.json with the rest: bed, gravity …", metavar="JSON")

    @cached_property
    def cameras(self) -> dict[str, tuple[Path, str]]:
        """By camera, which is called as its video, the file and the photograph that has its pose.

        Raises:
            MeasurementError: a word of another form, or two files of one name.
        """
        out: dict[str, tuple[Path, str]] = {}
        for word in self.video:
            file, sign, image = word.partition("=")
            if not sign or not file or not image:
                raise MeasurementError(
                    f"--video {word}: write FILE=IMAGE, with the photograph of SOURCE it was posed by"
                )
            if Path(file).stem in out:
                raise MeasurementError(f"--video {word}: two cameras would be called {Path(file).stem}")
            out[Path(file).stem] = Path(file), image
        return out

    @property
    def needs_clock(self) -> bool:
        """Whether the video's clock is estimated from its images."""
        return bool(self.video) and self.motion is not None and self.clock_offset is None
