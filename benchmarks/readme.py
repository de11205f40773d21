"""The README's picture: what a camera observed, what the fitted model predicts, and their difference."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from splatsoil.api import Run, open_run
from splatsoil.errors import RunError

KINDS: tuple[Literal["observed", "predicted", "difference"], ...] = ("observed", "predicted", "difference")
HEADING = 28
"""Rows of pixels above the pictures."""
PACE = 300
"""Milliseconds from frame to frame."""


def strips(run: Run, camera: str) -> list[Image.Image]:
    """Observed, predicted and difference side by side under their headings, for each compared frame of a camera.

    Raises:
        RunError: the run has not been compared, or has no such camera.
    """
    comparison, angle = run.data.comparison, run.estimates["friction_angle"]
    frames = [] if comparison is None else [e["frame"] for e in comparison["frames"] if e["camera"] == camera]
    if comparison is None or not frames:
        raise RunError(f"{run.path}: has no comparison of camera {camera!r}; splatsoil compare makes one")
    predicted = f"predicted at {angle.value:.1f} ± {angle.std:.1f}°"
    font = ImageFont.truetype(findfont("DejaVu Sans"), 15)
    out = []
    for frame in frames:
        headings = (f"observed, frame {frame}", predicted, f"difference × {comparison['gain']:g}")
        pictures = np.concatenate([run.picture(camera, frame, kind) for kind in KINDS], axis=1)
        height, width, _ = pictures.shape
        strip = Image.new("RGB", (width, height + HEADING), "white")
        strip.paste(Image.fromarray(pictures), (0, HEADING))
        for k, heading in enumerate(headings):
            ImageDraw.Draw(strip).text((8 + k * width // 3, 5), heading, "black", font)
        out.append(strip)
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the picture, an animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("out", type=Path, help="image file, .webp or .gif")
    parser.add_argument("--camera", default="left", help="of the video")
    options = parser.parse_args(arguments)
    first, *others = strips(open_run(options.run), options.camera)
    first.save(options.out, save_all=True, append_images=others, duration=PACE, loop=0, quality=70)
    return 0
