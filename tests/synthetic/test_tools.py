"""Tools other than a pushed plate: a set of each is made and read, and its soil stays out of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from splatsoil.measurement import Measurement, Tool, ToolMotion
from splatsoil.synthetic import Recipe, make_set, plow
from splatsoil.synthetic.setups import FRAME_RATE, drum, plate, staged_motion

STAGES = (25, 35, 0, 0)
"""Frames of the way down and forward."""
START = (0.25, 0.25, 0.21)


def staged(
    tilt: float = 0.0, down: float = 0.2, push: float = 0.2, height: float = 0.21, roll: float = 0.0
) -> ToolMotion:
    return staged_motion((*START[:2], height), tilt=tilt, down=down, push=push, stages=STAGES, roll=roll)


def boxes(*corners: Sequence[Sequence[float]]) -> trimesh.Trimesh:
    """Of boxes between lowest and highest corners."""
    return trimesh.util.concatenate([trimesh.creation.box(bounds=c) for c in corners])


def bucket() -> trimesh.Trimesh:
    """12 cm wide, 8 cm long and high, open in front and above: a floor, a back and two sides, 1 cm thick."""
    return boxes(
        [[-0.04, -0.06, -0.06], [0.04, 0.06, -0.05]],
        [[-0.04, -0.06, -0.05], [-0.03, 0.06, 0.02]],
        [[-0.03, -0.06, -0.05], [0.04, -0.05, 0.02]],
        [[-0.03, 0.05, -0.05], [0.04, 0.06, 0.02]],
    )


def cone() -> trimesh.Trimesh:
    """10 cm wide and high, its apex down at the frame's origin less 6 cm."""
    mesh = trimesh.creation.cone(0.05, 0.1, sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi, (1.0, 0.0, 0.0)))
    mesh.apply_translation((0.0, 0.0, 0.04))
    return mesh


def tumbling() -> ToolMotion:
    """Down, forward and aside, turning about all three axes."""
    way = staged(tilt=20.0)
    share = np.linspace(0.0, 1.0, len(way.frames))
    positions = way.positions + np.outer(share, (0.0, 0.05, 0.01))
    turns = Rotation.from_euler("zyx", np.outer(share, (30.0, 10.0, -20.0)) + np.array([0.0, 20.0, 0.0]), degrees=True)
    return replace(way, positions=positions, quaternions=turns.as_quat(scalar_first=True))


def sunk() -> ToolMotion:
    """Forward alone, from where the way down ends."""
    way, after = staged(tilt=20.0), slice(STAGES[0], None)
    frames = np.arange(len(way.frames) - STAGES[0])
    return ToolMotion(frames, frames / FRAME_RATE, way.positions[after], way.quaternions[after])


def depths(body: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(n,) how deep points (n, 3) are in a convex body, m; negative outside."""
    return -np.max(np.sum((points[:, None] - body.triangles_center) * body.face_normals, axis=2), axis=1)


TOOLS: dict[str, Callable[[], tuple[trimesh.Trimesh, ToolMotion]]] = {
    "a drum that rolls": lambda: (drum(), staged(roll=1.0 / 0.06)),
    "a drum that slips": lambda: (drum(), staged(roll=2.0 / 0.06)),
    "a bucket": lambda: (bucket(), staged()),
    "a cone pressed in": lambda: (cone(), staged(push=0.0)),
    "a plate pressed in": lambda: (trimesh.creation.box((0.12, 0.12, 0.012)), staged(down=0.1, push=0.0, height=0.157)),
    "two plates": lambda: (
        boxes([[-0.006, -0.1, -0.06], [0.006, -0.03, 0.06]], [[-0.006, 0.03, -0.06], [0.006, 0.1, 0.06]]),
        staged(tilt=20.0),
    ),
    "six degrees of freedom": lambda: (plate(), tumbling()),
    "a start in the soil": lambda: (plate(), sunk()),
}


@pytest.mark.parametrize("name", TOOLS)
def test_a_set_of_each_tool_is_made_and_soil_stays_out_of_it(name: str, tmp_path: Path) -> None:
    """By convex bodies and Newton's third law: soil lifts what is lowered, and pushes back what is pushed."""
    mesh, motion = TOOLS[name]()
    setup = plow(3, views=1).resized(0.25)
    last = int(motion.frames[-1])
    setup = replace(setup, tool=Tool(mesh, motion, friction=0.3), frames=(0, last), pre_roll=(-1,))
    made = make_set(tmp_path / "set", setup, Recipe(33.0, preset="tiny", seed=3))
    measurement = Measurement.load(made.measurement.folder)
    stored = np.load(measurement.folder / "truth_particles.npz")
    particles = stored[f"f{last:03d}"] * float(stored["scale"]) + stored["origin"]
    bodies = measurement.tool.placed(last / measurement.frame_rate).split()
    assert np.max([depths(body, particles) for body in bodies]) < 0.25 * float(stored["spacing"])
    force, speed = measurement.tool.force, np.diff(motion.positions, axis=0)
    assert force is not None
    lowered, pushed = speed[:, 2] < -1e-3, speed[:, 0] > 1e-3
    assert not lowered.any() or force[lowered, 4].mean() > 0.0
    assert not pushed.any() or force[pushed, 2].mean() < 0.0
