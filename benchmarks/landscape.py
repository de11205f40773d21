"""What do the pictures say? The loss over friction angles, from photographs, beside the renderer's own floor.

``python -m splatsoil.benchmarks.landscape examples/plow-dry --device cuda:0`` reconstructs the set, simulates each
angle with each particle seed, compares all frames, and prints the losses and the angle of the least. Where a set
carries its true particles, these are drawn through the same scene: what the loss leaves then is the renderer's floor,
and what it leaves beyond that is the soil's.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from splatsoil.benchmarks._common import at_least, here
from splatsoil.benchmarks.numerics import Truth

from splatsoil.comparison import Comparator, Comparison
from splatsoil.errors import MeasurementError
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.scene import build_scene


def floor(truth: Truth, reconstruction: Reconstruction, device: str) -> tuple[tuple[int, ...], Comparison]:
    """Frames that the truth has, and the comparison of its true particles, drawn, with the photographs."""
    measurement = truth.measurement
    frames = tuple(sorted(truth.particles))
    spacing = truth.volume ** (1.0 / 3.0)
    scene = build_scene(reconstruction, measurement, truth.particles[0], spacing, device=device)
    images = {}
    for frame in frames:
        posed = scene.pose(truth.particles[frame], None, measurement.tool.motion.pose(frame / measurement.frame_rate))
        for name, camera in measurement.cameras.items():
            images[name, frame] = scene.picture(posed, camera.undistorted())
    return frames, Comparator(measurement, surface=reconstruction.surface, frames=frames).compare(images)


def run(
    folder: Path,
    angles: Sequence[float],
    *,
    seeds: int = 2,
    preset: str = "small",
    device: str = "cpu",
    given: Mapping[str, float] | None = None,
    effects: Sequence[str] = (),
) -> dict[str, Any]:
    """Losses of all angles and seeds; a JSON-able result."""
    measurement = Measurement.load(folder)
    reconstruction = reconstruct(measurement, device=device)
    model = Model(measurement, reconstruction, effects=effects, preset=preset, device=device)
    result: dict[str, Any] = {"set": measurement.name, "preset": preset, "angles": list(angles), "seeds": []}
    shared: tuple[int, ...] = ()
    try:
        shared, best = floor(Truth.load(folder), reconstruction, device)
        result["floor"] = {"frames": shared, "loss": best.loss, "rgb_mse": best.rgb}
    except MeasurementError:
        result["floor"] = None
    everything = Comparator(measurement, surface=reconstruction.surface, frames=model.frames)
    result["noise"] = everything.noise
    few = Comparator(measurement, surface=reconstruction.surface, frames=shared) if shared else None
    fine = np.linspace(angles[0], angles[-1], 1001)
    for seed in range(seeds):
        losses, rgb, at_truth = [], [], []
        for angle in angles:
            images = model.predict({"friction_angle": float(angle), **(given or {})}, seed).images
            found = everything.compare(images)
            losses.append(found.loss)
            rgb.append(found.rgb)
            if few is not None:
                at_truth.append(few.compare(images).loss)
        best_angle = float(fine[np.argmin(CubicSpline(angles, losses)(fine))])
        result["seeds"].append({"loss": losses, "rgb_mse": rgb, "loss_at_floor_frames": at_truth, "best": best_angle})
    return result


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    lines = [
        f"`{result['set']}`, preset `{result['preset']}`: loss over the friction angle (0 perfect, 1 no motion).",
        "",
        "| seed | " + " | ".join(f"{a:g}°" for a in result["angles"]) + " | least at |",
        "|---" * (len(result["angles"]) + 2) + "|",
    ]
    for seed, entry in enumerate(result["seeds"]):
        lines.append(f"| {seed} | " + " | ".join(f"{v:.3f}" for v in entry["loss"]) + f" | {entry['best']:.1f}° |")
    if result["floor"] is not None:
        frames = ", ".join(map(str, result["floor"]["frames"][1:]))
        lines += [
            "",
            f"True particles drawn through the same scene, frames {frames}: {result['floor']['loss']:.3f} "
            f"(raw colour error {1e5 * result['floor']['rgb_mse']:.0f}e-5). The simulations on the same frames:",
            "",
        ]
        for seed, entry in enumerate(result["seeds"]):
            lines.append(f"- seed {seed}: " + ", ".join(f"{v:.3f}" for v in entry["loss_at_floor_frames"]))
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("--angles", type=float, nargs="+", default=[26.0, 31.0, 34.0, 36.0, 38.0, 41.0, 46.0])
    parser.add_argument("--seeds", type=at_least(1), default=2)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--cohesion", type=float, help="switches the effect on, at this value in Pa")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    given = {} if options.cohesion is None else {"cohesion": options.cohesion}
    result = run(
        options.set,
        sorted(options.angles),
        seeds=options.seeds,
        preset=options.preset,
        device=options.device,
        given=given,
        effects=tuple(given),
    )
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
