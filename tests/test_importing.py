"""``splatsoil import``: sets whose world, scale and clocks were thrown away come back; each format and each mistake."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from splatsoil import cli
from splatsoil.errors import MeasurementError
from splatsoil.importing.clock import Footage, clock_offset, late_cameras
from splatsoil.importing.robot import Grid, read_force
from splatsoil.importing.similarity import by_known_points, by_scale, read_marked
from splatsoil.importing.source import read_source
from splatsoil.measurement import Camera, Frame, Measurement, ToolMotion

RATE = 5.0
"""Frames a second of the videos: a tenth of the sets'."""
BEFORE = 4
"""Frames of pre-roll."""
CLOCK = 12.345
"""Of the robot when the tool begins to move, s."""


@dataclass(frozen=True)
class Recorded:
    """A set as instruments would have left it.

    Attributes:
        folder: of all files.
        true: the set itself.
        to_source: (4, 4) similarity from its world to the reconstruction's.
        words: options of the import.
    """

    folder: Path
    true: Measurement
    to_source: np.ndarray
    words: list[str]

    @property
    def unit(self) -> float:
        """Metres in the reconstruction's unit."""
        return 1.0 / float(np.cbrt(np.linalg.det(self.to_source[:3, :3])))


def rigid(seed: int, size: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.random(rng=rng).as_matrix(), size * rng.normal(size=3)
    return out


def colmap_model(folder: Path, frames: list[Frame], names: list[str], to_source: np.ndarray) -> None:
    """A text model of these photographs in a world of its own."""
    scale = float(np.cbrt(np.linalg.det(to_source[:3, :3])))
    cameras, images = [], []
    for k, (frame, name) in enumerate(zip(frames, names, strict=True), start=1):
        c = frame.camera
        values = (c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2)
        cameras.append(f"{k} OPENCV {c.width} {c.height} {' '.join(map(repr, map(float, values)))}")
        # World to camera is x = R X + t; of the other world's points x is as many times larger.
        pose = c.world_to_camera
        rotation = pose[:3, :3] @ (to_source[:3, :3] / scale).T
        translation = scale * pose[:3, 3] - rotation @ to_source[:3, 3]
        quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        images += [f"{k} {' '.join(map(repr, map(float, (*quaternion, *translation))))} {k} {name}", ""]
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def robots_record(folder: Path, true: Measurement) -> None:
    """Motion in mm, of a flange that the tool is mounted on askew, and force, in the robot's frame and by its clock."""
    motion = true.tool.motion
    base, mount = rigid(1, 0.5), rigid(2, 0.1)
    np.savetxt(folder / "robot_to_world.txt", base)
    np.savetxt(folder / "mesh_to_flange.csv", mount, delimiter=",")
    rows = ["time,x,y,z,qw,qx,qy,qz"]
    for time in motion.times:
        flange = np.linalg.inv(base) @ motion.matrix(float(time)) @ np.linalg.inv(mount)
        quaternion = Rotation.from_matrix(flange[:3, :3]).as_quat(scalar_first=True)
        values = (float(time) + CLOCK, *(1000.0 * flange[:3, 3]), *quaternion)
        rows.append(",".join(repr(float(v)) for v in values))
    (folder / "robot.csv").write_text("\n".join(rows) + "\n")


def film(file: Path, true: Measurement, camera: str, painted: Callable[[Frame, int], np.ndarray] | None = None) -> None:
    """The camera's frames at an even rate, painted on: pre-roll, then each tenth frame."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    numbers = [*range(-BEFORE, 0), *(n for n in true.frames if n % 10 == 0)]
    frames = [true.video_frame(camera, n) for n in numbers]
    size = (frames[0].camera.width, frames[0].camera.height)
    writer = ffmpeg.write_frames(str(file), size, fps=RATE, quality=9, macro_block_size=2)
    writer.send(None)
    for number, frame in zip(numbers, frames, strict=True):
        image = frame.image() if painted is None else painted(frame, number)
        writer.send(np.ascontiguousarray(np.rint(255.0 * image).astype(np.uint8)))
    writer.close()


def recorded(true: Measurement, folder: Path) -> Recorded:
    """Throw away world, scale and clocks; points of the bed are marked to a third of a pixel."""
    to_source = rigid(3, 4.0)
    to_source[:3, :3] *= 2.7
    (folder / "images" / "still").mkdir(parents=True)
    views = list(true.views)
    names = [f"still/{k}.jpg" for k in range(len(views))]
    for frame, name in zip(views, names, strict=True):
        shutil.copy(frame.path, folder / "images" / name)
    for camera in true.cameras:
        views.append(true.video_frame(camera, -1))
        names.append(f"{camera}.jpg")
        shutil.copy(views[-1].path, folder / "images" / names[-1])
        film(folder / f"{camera}.mp4", true, camera)
    colmap_model(folder / "sparse" / "0", views, names, to_source)
    robots_record(folder, true)
    low, high = true.bed.lower, true.bed.upper
    known = {
        f"p{k}": np.array([*np.where(pick, high[:2], low[:2]), z])
        for k, (pick, z) in enumerate([((0, 0), 0.12), ((0, 1), 0.12), ((1, 0), 0.12), ((1, 1), 0.12), ((0, 1), 0.0)])
    }
    rng = np.random.default_rng(0)
    marks = ["point,image,u,v"]
    for name, place in known.items():
        pixels = [frame.camera.project(place[None])[0][0] for frame in views[:6]]
        marks += [f"{name},{names[i]},{u},{v}" for i, (u, v) in enumerate(pixels + rng.normal(size=(6, 2)) / 3.0)]
    (folder / "marks.csv").write_text("\n".join(marks) + "\n")
    rows = [f"{name},{','.join(map(str, place))}" for name, place in known.items()]
    (folder / "known.csv").write_text("\n".join(["point,x,y,z", *rows]) + "\n")
    exchanged = [row.replace("p0,", "p,").replace("p2,", "p0,").replace("p,", "p2,") for row in rows]
    (folder / "exchanged.csv").write_text("\n".join(["point,x,y,z", *exchanged]) + "\n")
    np.savetxt(folder / "nan.txt", np.full((4, 4), np.nan))
    (folder / "still.json").write_text(json.dumps({"frame_rate": 0}))
    mesh = true.tool.mesh.copy()
    mesh.apply_scale(1000.0).export(folder / "tool.stl")
    bed = {"lower": low.tolist(), "upper": high.tolist(), "density": true.bed.density}
    (folder / "rest.json").write_text(json.dumps({"name": "again", "gravity": [0, 0, -9.81], "bed": bed}))
    words = ["--tool", "tool.stl", "mm", "--motion", "robot.csv", "mm", "--experiment", "rest.json"]
    words += ["--robot-to-world", "robot_to_world.txt", "--mesh-to-flange", "mesh_to_flange.csv"]
    words += ["--video", *(f"{name}.mp4={name}.jpg" for name in true.cameras)]
    return Recorded(folder, true, to_source, words)


@pytest.fixture(scope="module")
def plow(plow_dry: Path, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Of the example set, which no code here produced."""
    return recorded(Measurement.load(plow_dry), tmp_path_factory.mktemp("plow"))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Of a set that `splatsoil simulate` makes."""
    folder = tmp_path_factory.mktemp("simulated")
    words = ["simulate", str(folder / "set"), "--preset", "tiny", "--views", "8", "--seed", "1", "--json"]
    assert cli.main(words) == 0
    return recorded(Measurement.load(folder / "set"), folder / "recorded")


@pytest.fixture
def importing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., dict[str, Any]]:
    """Runs the command in a set's folder; what it prints as JSON, and its exit code."""

    def act(source: Recorded, *words: str, out: str = "made") -> dict[str, Any]:
        monkeypatch.chdir(source.folder)
        capsys.readouterr()  # what making the set has printed
        code = cli.main(["import", ".", str(tmp_path / out), *words, "--json"])
        return {"code": code, **json.loads(capsys.readouterr().out)}

    return act


@pytest.mark.parametrize("name", ["plow", pytest.param("simulated", marks=pytest.mark.slow)])
def test_world_scale_and_clocks_come_back(
    name: str, request: pytest.FixtureRequest, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    source: Recorded = request.getfixturevalue(name)
    said = importing(source, *source.words, "--known", "known.csv", "--points", "marks.csv")
    assert said["code"] == 0 and said["missing"] == [] and said["source"] == "COLMAP"
    assert said["scale"] == pytest.approx(source.unit, rel=0.005)
    assert 0.1 < said["marks_px"] < 0.6 and said["known_points_m"] < 0.002
    # The robot's clock shows CLOCK when frame 0 is filmed, which comes after the pre-roll.
    assert said["clock_offset"]["seconds"] == pytest.approx(CLOCK - BEFORE / RATE, abs=0.0015)

    made, true = Measurement.load(tmp_path / "made"), source.true
    assert len(made.views) == len(true.views) and made.frame_rate == RATE
    places = {frame.path.read_bytes(): frame.camera for frame in made.views}
    pairs = [(places[frame.path.read_bytes()], frame.camera) for frame in true.views]
    pairs += [(made.cameras[camera], true.cameras[camera]) for camera in true.cameras]
    for now, then in pairs:
        assert np.linalg.norm(now.position - then.position) < 0.002
        turn = Rotation.from_matrix(now.camera_to_world[:3, :3].T @ then.camera_to_world[:3, :3])
        assert np.degrees(turn.magnitude()) < 0.2
        assert (now.fx, now.cy, now.k1) == (then.fx, then.cy, then.k1)
    assert made.tool.mesh.volume == pytest.approx(true.tool.mesh.volume, rel=1e-4)
    # What is filmed at a time is where the tool is then: 5 ms are 1 mm at this tool's speed.
    zero = len(made.pre_roll) // 2 - BEFORE
    assert zero in (-1, 0), "the last frame before the tool moves is number 0"
    for frame in made.frames:
        rotation, position = made.tool.motion.pose(frame / RATE)
        wanted_rotation, wanted = true.tool.motion.pose((frame + zero) / RATE)
        assert np.linalg.norm(position - wanted) < 0.002, frame
        np.testing.assert_allclose(rotation, wanted_rotation, atol=1e-6)
        film, original = made.video_frame("left", frame).image(), true.video_frame("left", 10 * (frame + zero)).image()
        assert np.abs(film - original).mean() < 0.02, frame


def test_a_given_offset_is_taken_as_it_is(
    plow: Recorded, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    words = [*plow.words, "--scale", str(plow.unit), "--clock-offset", str(CLOCK - BEFORE / RATE + 0.02)]
    # Another world than the bed's: without an experiment the parts are not held against each other.
    words = [w for k, w in enumerate(words) if "rest.json" not in (w, *words[k : k + 2])]
    said = importing(plow, *words, "--up", "0", "0", "1", "--video-every", "4")
    assert said["code"] == 0 and said["clock_offset"] is None and said["missing"] == ["bed", "gravity"]
    rows = np.loadtxt(tmp_path / "made" / "tool_motion.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 1], rows[:, 0] / RATE)
    # The tool begins in the frame before the one that the offset puts its start in.
    wanted = [plow.true.tool.motion.pose(row[1] - 1 / RATE + 0.02)[1] for row in rows]
    np.testing.assert_allclose(rows[:, 2:5], wanted, atol=1e-6)
    entries = json.loads((tmp_path / "made" / "video" / "transforms.json").read_text())["frames"]
    numbers = sorted({entry["frame"] for entry in entries})
    assert [n for n in numbers if n >= 0] == [0, 4, 8, 12, 16, 20] and [n for n in numbers if n < 0] == [-3, -2, -1]
    assert not (tmp_path / "made" / "experiment.json").exists()


@pytest.mark.parametrize("marks", ["marks.csv", "places.csv"])
def test_two_points_and_their_distance(
    marks: str, plow: Recorded, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    """Marked in photographs, or where they are in the source's world: the bed is 0.8 m long."""
    places = {name: plow.to_source @ [x, 0.0, 0.12, 1.0] for name, x in (("p0", 0.0), ("p2", 0.8))}
    rows = [f"{name}\t{x}\t{y}\t{z}" for name, (x, y, z, _) in places.items()]
    (plow.folder / "places.csv").write_text("\n".join(["Point\tX\tY\tZ", *rows]) + "\n")
    up = [str(v) for v in plow.to_source[:3, 2]]
    said = importing(plow, "--points", marks, "--distance", "p0", "p2", "0.8", "--up", *up)
    assert said["code"] == 0 and said["scale"] == pytest.approx(plow.unit, rel=0.005)
    # Heights come back but for the origin's.
    frames = json.loads((tmp_path / "made" / "views" / "transforms.json").read_text())["frames"]
    heights = np.sort([frame["transform_matrix"][2][3] for frame in frames])
    true = np.sort(
        [*(f.camera.position[2] for f in plow.true.views), *(c.position[2] for c in plow.true.cameras.values())]
    )
    np.testing.assert_allclose(heights - heights[0], true - true[0], rtol=0.005, atol=1e-6)
    assert sorted(p.name for p in (tmp_path / "made").iterdir()) == ["views"]


@pytest.mark.parametrize("kind", ["nerfstudio", "instant-ngp", "Blender"])
def test_transforms_files(kind: str, plow_dry: Path, tmp_path: Path) -> None:
    data = json.loads((plow_dry / "views" / "transforms.json").read_text())
    lens = {key: data[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    frames = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in data["frames"][:3]]
    top: dict[str, Any] = lens
    if kind == "instant-ngp":
        top = {**lens, "aabb_scale": 16, "scale": 1.0, "is_fisheye": False}
        for frame in frames:
            frame |= {"file_path": "./" + frame["file_path"], "sharpness": 40.0}
    if kind == "Blender":
        top = {"camera_angle_x": 2.0 * float(np.arctan(0.5 * lens["w"] / lens["fl_x"]))}
        for frame in frames:
            frame["file_path"] = frame["file_path"].rsplit(".", 1)[0]
    (tmp_path / "images").mkdir()
    for frame in data["frames"][:3]:
        shutil.copy(plow_dry / "views" / frame["file_path"], tmp_path / "images")
    name = "transforms_train.json" if kind == "Blender" else "transforms.json"
    (tmp_path / name).write_text(json.dumps({**top, "frames": frames}))
    found = read_source(tmp_path)
    assert (found.kind, found.has_up, len(found.frames)) == (kind, True, 3)
    true = {f.path.name: f.camera for f in Measurement.load(plow_dry).views}
    for frame in found.frames:
        then = true[frame.path.name]
        np.testing.assert_allclose(frame.camera.camera_to_world, then.camera_to_world, atol=1e-12)
        assert (frame.camera.fx, frame.camera.cx) == pytest.approx((then.fx, then.cx))
    assert cli.main(["import", str(tmp_path), str(tmp_path / "out"), "--scale", "2"]) == 0
    written = json.loads((tmp_path / "out" / "views" / "transforms.json").read_text())["frames"]
    for entry, frame in zip(written, found.frames, strict=True):
        matrix = np.array(entry["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, 3], 2.0 * frame.camera.position)
        np.testing.assert_allclose(matrix[:3, :3], frame.camera.camera_to_world[:3, :3])


def test_files_that_an_experiment_names_are_missing_unless_they_are_imported(
    plow: Recorded, importing: Callable[..., dict[str, Any]]
) -> None:
    notes = json.loads((plow.folder / "rest.json").read_text())
    tool = {"mesh": "tool.stl", "motion": "robot.csv", "friction": 0.4}
    (plow.folder / "whole.json").write_text(json.dumps({**notes, "frame_rate": 5, "tool": tool, "video": "v.json"}))
    said = importing(plow, "--experiment", "whole.json", "--scale", "1", "--up", "0", "0", "1")
    assert said["code"] == 0 and said["missing"] == ["video", "tool.mesh", "tool.motion"]


def test_known_points_undo_any_similarity() -> None:
    rng = np.random.default_rng(5)
    places = {str(k): rng.normal(size=3) for k in range(5)}
    truth = rigid(6, 3.0)
    truth[:3, :3] *= 0.02
    known = {name: truth[:3, :3] @ place + truth[:3, 3] for name, place in places.items()}
    found, left = by_known_points(places, {**known, "unmarked": np.zeros(3)})
    np.testing.assert_allclose(found, truth, atol=1e-12)
    assert left < 1e-12
    mirrored = {name: place * [1.0, 1.0, -1.0] for name, place in places.items()}
    with pytest.raises(MeasurementError, match="an axis mirrored"):
        by_known_points(places, mirrored)
    line = {name: np.array([k, 2.0 * k, 0.0]) for k, name in enumerate(places)}
    with pytest.raises(MeasurementError, match="one line"):
        by_known_points(line, known)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 3.0), (0.0, 0.0, -1.0), (0.3, 0.2, 0.1)])
def test_up_becomes_z(up: tuple[float, float, float]) -> None:
    matrix = by_scale(2.0, up)
    np.testing.assert_allclose(matrix[:3, :3] @ up, [0.0, 0.0, 2.0 * np.linalg.norm(up)], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, 4.0 * np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_photographs_without_poses(
    plow: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Poses come back by structure from motion, scale and world by known points; a pixel is 2.9 mm on the bed."""
    pytest.importorskip("pycolmap")
    monkeypatch.chdir(plow.folder)
    words = ["import", "images", str(tmp_path / "made"), "--sfm", "--known", "known.csv", "--points", "marks.csv"]
    assert cli.main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    entries = json.loads((tmp_path / "made" / "views" / "transforms.json").read_text())["frames"]
    true = {frame.path.read_bytes(): frame.camera for frame in (*plow.true.views, *plow.true.pre_roll)}
    assert said["source"] == "pycolmap" and len(entries) == len(plow.true.views) + len(plow.true.cameras)
    off = []
    for entry in entries:
        camera = true[(tmp_path / "made" / "views" / entry["file_path"]).read_bytes()]
        off.append(np.array(entry["transform_matrix"])[:3, 3] - camera.position)
        assert entry["fl_x"] == pytest.approx(camera.fx, rel=0.02)
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) < 0.002


def test_photographs_that_cannot_be_posed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    (tmp_path / "grey").mkdir()
    for k in range(3):
        Image.new("RGB", (64, 48), (100 + k,) * 3).save(tmp_path / "grey" / f"{k}.png")
    for name, said in (("grey", "its photographs cannot be posed"), ("nowhere", "no such folder")):
        assert cli.main(["import", str(tmp_path / name), str(tmp_path / "out"), "--sfm", "--scale", "1", "--json"]) == 2
        assert f"{name}: {said}" in json.loads(capsys.readouterr().out)["error"]
        assert not (tmp_path / "out").exists()


CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)
"""The first of the family 36h11: 36 bits, row after row."""


def tag_squares() -> list[np.ndarray]:
    """(8, 8) black 0 and white 1, the white border with them, row after row from the top left."""
    squares = []
    for code in CODES:
        square = np.zeros((8, 8))
        square[1:7, 1:7] = [[code >> (35 - 6 * i - j) & 1 for j in range(6)] for i in range(6)]
        squares.append(square)
    return squares


def photographs_of_tags(folder: Path, edges: tuple[float, ...], unit: float) -> None:
    """A nerfstudio set of level, grey ground with a tag each 0.3 m along x, in a world of another unit (m)."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, (x, y) in enumerate([(-0.3, -0.5), (0.2, -0.6), (0.6, -0.4), (0.1, 0.6)]):
        eye, look = np.array([x, y, 0.6]), np.array([0.15, 0.0, 0.0])
        back = (eye - look) / np.linalg.norm(eye - look)
        right = np.cross([0.0, 0.0, 1.0], back) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], back))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(back, right), back], axis=1), eye
        camera = Camera(640, 480, 700.0, 700.0, 320.0, 240.0, pose)
        fine = camera.scaled(3)
        v, u = np.mgrid[: fine.height, : fine.width] + 0.5
        origins, ways = fine.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
        ground = origins - ways * (origins[:, 2:] / ways[:, 2:])
        shade = np.full(len(ground), 0.8)
        for number, (edge, square) in enumerate(zip(edges, tag_squares(), strict=False)):
            column = np.floor(8.0 * ((ground[:, 0] - 0.3 * number) / edge + 0.5)).astype(int)
            row = np.floor(8.0 * (0.5 - ground[:, 1] / edge)).astype(int)
            inside = (column >= 0) & (column < 8) & (row >= 0) & (row < 8)
            shade[inside] = 0.05 + 0.85 * square[row[inside], column[inside]]
        picture = shade.reshape(480, 3, 640, 3).mean(axis=(1, 3))
        Image.fromarray(np.rint(255.0 * picture).astype(np.uint8)).save(folder / "images" / f"{k}.png")
        pose[:3, 3] /= unit
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 640, "h": 480, "fl_x": 700.0, "fl_y": 700.0, "cx": 320.0, "cy": 240.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def test_scale_from_tags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pupil_apriltags")
    photographs_of_tags(tmp_path / "alike", (0.1, 0.1), 0.37)
    assert cli.main(["import", str(tmp_path / "alike"), str(tmp_path / "out"), "--tags", "0.1", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["scale"] == pytest.approx(0.37, rel=0.005) and said["marks_px"] < 0.5
    photographs_of_tags(tmp_path / "unlike", (0.1, 0.14), 0.37)
    assert cli.main(["import", str(tmp_path / "unlike"), str(tmp_path / "other"), "--tags", "0.1"]) == 2
    assert "edges of the tags 0, 1 differ by" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


CORNERS = ("lower left", "lower right", "upper right", "upper left")


def tags_on_the_tool() -> dict[int, np.ndarray]:
    """Corners (4, 3) in the tool's frame, m, from the lower left one on, as a tag is printed: two tags a camera, on two
    plates above the tool."""
    out = {}
    for plate, way in enumerate(([-0.5, -0.7, 0.45], [0.62, 0.62, 0.4])):
        normal = np.array(way) / np.linalg.norm(way)
        right = np.cross([0.0, 0.0, 1.0], normal)
        right /= np.linalg.norm(right)
        up = np.cross(normal, right)
        for k in range(2):
            middle = 0.05 * normal + (0.14 * k - 0.07) * right + [0.0, 0.0, 0.04]
            signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
            out[2 * plate + k] = middle + 0.05 * signs @ np.stack([right, up])
    return out


def tagged(frame: Frame, pose: np.ndarray) -> np.ndarray:
    """The picture (h, w, 3) with the tags in front of all else, by rays."""
    fine = frame.camera.scaled(3)
    v, u = np.mgrid[: fine.height, : fine.width] + 0.5
    origins, ways = fine.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    image = frame.image().repeat(3, axis=0).repeat(3, axis=1).reshape(-1, 3)
    for square, corners in zip(tag_squares(), tags_on_the_tool().values(), strict=True):
        first, right, _, up = corners @ pose[:3, :3].T + pose[:3, 3]
        axes = np.stack([right - first, up - first], axis=1)
        normal = np.cross(*axes.T)
        if normal @ (frame.camera.position - first) <= 0.0:
            continue
        hit = origins + ways * (((first - origins) @ normal) / (ways @ normal))[:, None]
        x, y = np.linalg.lstsq(axes, (hit - first).T, rcond=None)[0]
        column, row = np.floor(8.0 * x).astype(int), np.floor(8.0 * (1.0 - y)).astype(int)
        paper = (np.minimum(column, row) >= -1) & (np.maximum(column, row) <= 8)
        inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < 8)
        image[paper] = 0.9
        image[inside] = 0.05 + 0.85 * square[row[inside], column[inside]][:, None]
    return image.reshape(frame.camera.height, 3, frame.camera.width, 3, 3).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def tagged_plow(plow: Recorded) -> Recorded:
    """With videos, and photographs of a standing tool, that show tags on it."""
    pytest.importorskip("pupil_apriltags")
    motion = plow.true.tool.motion
    rows = ["tag,corner,x,y,z"]
    for tag, corners in tags_on_the_tool().items():
        for name, place in zip(CORNERS, corners, strict=True):
            rows.append(f"{tag},{name},{','.join(map(repr, place.tolist()))}")
    (plow.folder / "tags.csv").write_text("\n".join(rows) + "\n")
    for camera in plow.true.cameras:
        paint = lambda frame, number: tagged(frame, motion.matrix(float(motion.times[max(number, 0)])))  # noqa: E731
        film(plow.folder / f"{camera}-tags.mp4", plow.true, camera, paint)
    shutil.copytree(plow.folder / "images", plow.folder / "tagged")
    for k, frame in enumerate(plow.true.views[::5]):
        picture = np.rint(255.0 * tagged(frame, motion.matrix(0.0))).astype(np.uint8)
        Image.fromarray(picture).save(plow.folder / "tagged" / "still" / f"{5 * k}.jpg", quality=95)
    return plow


def test_scale_from_tags_on_the_tool(tagged_plow: Recorded, importing: Callable[..., dict[str, Any]]) -> None:
    """By two cameras; by one, and photographs of the tool before it moves."""
    up = [str(v) for v in tagged_plow.to_source[:3, 2]]
    words = ["--motion-tags", "tags.csv", "--up", *up, "--tool", "tool.stl", "mm"]
    both = importing(tagged_plow, *words, "--video", "left-tags.mp4=left.jpg", "right-tags.mp4=right.jpg")
    one = ["--video", "left-tags.mp4=left.jpg"]
    stood = importing(tagged_plow, *words, *one, "--images", "tagged", out="stood")
    for said in (both, stood):
        assert said["code"] == 0 and said["scale"] == pytest.approx(tagged_plow.unit, rel=0.005)
        assert said["marks_px"] < 0.5 and said["missing"] == ["bed", "gravity"]
    alone = importing(tagged_plow, *words, *one, out="alone")
    assert alone["code"] == 2 and "two cameras that see the tool's tags at one moment" in alone["error"]


def test_motion_from_tags_on_the_tool(
    tagged_plow: Recorded, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    plow, motion = tagged_plow, tagged_plow.true.tool.motion
    words = ["--tool", "tool.stl", "mm", "--experiment", "rest.json", "--motion-tags", "tags.csv"]
    words += ["--known", "known.csv", "--points", "marks.csv"]
    words += ["--video", *(f"{name}-tags.mp4={name}.jpg" for name in plow.true.cameras)]
    said = importing(plow, *words)
    assert said["code"] == 0 and said["missing"] == [] and said["clock_offset"] is None
    assert said["tool_tags"]["frames"] == BEFORE + 21 - 1 and said["tool_tags"]["error_px"] < 0.5
    made = Measurement.load(tmp_path / "made").tool.motion
    zero = len(Measurement.load(tmp_path / "made").pre_roll) // 2 - BEFORE
    assert zero in (-1, 0), "the last frame before the tool moves is number 0"
    for frame in made.frames:
        turn, place = made.pose(frame / RATE)
        wanted_turn, wanted = motion.pose((frame + zero) / RATE)
        assert np.linalg.norm(place - wanted) < 0.002, frame
        assert np.degrees(Rotation.from_matrix(turn.T @ wanted_turn).magnitude()) < 0.5, frame


@pytest.mark.parametrize(
    ("rows", "error"),
    [
        (["1,lower left,0,0,0"], "each tag needs one row for each of lower left, lower right, upper right, upper left"),
        (["one,lower left,0,0,0"], "'one' is no number of a tag"),
        ([f"7,{c},{x},{y},0" for c, x, y in zip(CORNERS, (0, 2, 2, 0), (0, 0, 1, 1), strict=True)], "it is a square"),
        ([f"7,{c},{x},{y},0" for c, x, y in zip(CORNERS, (0, 1, 1, 0), (0, 0, 1, 1), strict=True)], "in 0 frames"),
    ],
)
def test_faulty_tags_of_the_tool(
    rows: list[str], error: str, plow: Recorded, importing: Callable[..., dict[str, Any]]
) -> None:
    pytest.importorskip("pupil_apriltags")
    (plow.folder / "faulty.csv").write_text("\n".join(["tag,corner,x,y,z", *rows]) + "\n")
    words = ["--scale", str(plow.unit), "--up", "0", "0", "1", "--motion-tags", "faulty.csv"]
    assert "needs --video" in importing(plow, *words)["error"]
    said = importing(plow, *words, "--video", *(f"{name}.mp4={name}.jpg" for name in plow.true.cameras))
    assert said["code"] == 2 and error in said["error"]


def test_detectors_end_without_reading_freed_memory() -> None:
    """Which glibc overwrites here."""
    pytest.importorskip("pupil_apriltags")
    code = (
        "import numpy as np\nfrom splatsoil.importing.tags import _detector\n"
        "for _ in range(20):\n    _detector('--tags').detect(np.zeros((48, 64), np.uint8))\n"
    )
    words, perturbed = [sys.executable, "-c", code], {**os.environ, "MALLOC_PERTURB_": "165"}
    assert subprocess.run(words, env=perturbed, timeout=120, check=False).returncode == 0


def test_photographs_without_tags(plow: Recorded, importing: Callable[..., dict[str, Any]]) -> None:
    pytest.importorskip("pupil_apriltags")
    said = importing(plow, "--tags", "0.1", "--up", "0", "0", "1")
    assert said["code"] == 2 and "no tag of the family tag36h11 is seen in two photographs" in said["error"]


@pytest.mark.parametrize(
    ("module", "words", "said"),
    [
        ("pupil_apriltags", ["--tags", "0.1"], "--tags: needs pupil-apriltags; pip install 'splatsoil[tags]'"),
        ("pycolmap", ["--sfm"], "--sfm: needs pycolmap; pip install 'splatsoil[sfm]'"),
        (
            "imageio_ffmpeg",
            ["--scale", "1", "--video", "left.mp4=left.jpg"],
            "--video: needs imageio-ffmpeg; pip install 'splatsoil[video]'",
        ),
    ],
)
def test_a_missing_package_is_one_sentence(
    module: str,
    words: list[str],
    said: str,
    plow: Recorded,
    importing: Callable[..., dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    result = importing(plow, *words, "--up", "0", "0", "1")
    assert (result["code"], result["error"]) == (2, said)
    assert list(tmp_path.iterdir()) == []


def test_forces_are_means_over_frames_in_world_axes(tmp_path: Path) -> None:
    """Of F = (t, t², 0) along a robot's axes, one of which is the world's y."""
    times = np.linspace(3.0, 5.0, 2001)
    rows = [f"{t!r},{t - 3.0!r},{(t - 3.0) ** 2!r},0" for t in times.tolist()]
    (tmp_path / "force.csv").write_text("\n".join(["time,fx,fy,fz", *rows]))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    force = read_force(tmp_path / "force.csv", turn, Grid(rate=4.0, zero=2.5))
    np.testing.assert_array_equal(force[:, 0], np.arange(3, 11))
    end = force[:, 1] - 0.5
    begin = end - 0.25
    np.testing.assert_allclose(force[:, 3], 0.5 * (end**2 - begin**2) / 0.25, atol=1e-9)
    np.testing.assert_allclose(force[:, 2], -(end**3 - begin**3) / 0.75, atol=1e-6)
    assert np.abs(force[:, 4]).max() == 0.0


SCALED = ["--scale", "1", "--up", "0", "0", "1"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "no scale is given"),
        (["--scale", "1", "--known", "known.csv"], "--scale and --known contradict"),
        (["--scale", "0", "--up", "0", "0", "1"], "positive number of metres"),
        (["--scale", "1"], "COLMAP does not define which way is up"),
        (["--scale", "1", "--up", "0", "0", "0"], "up is a direction"),
        (["--known", "known.csv"], "--known: needs --points"),
        (
            ["--known", "known.csv", "--points", "marks.csv", "--up", "0", "0", "1"],
            "--up: the known points determine it",
        ),
        (
            ["--distance", "p0", "nowhere", "1", "--points", "marks.csv", "--up", "0", "0", "1"],
            "'nowhere' is not marked",
        ),
        (["--images", "sparse"], "NAME: no such file"),
        (["--video", "left.mp4"], "write FILE=IMAGE"),
        (["--video", "left.mp4=left.jpg", "a/left.mp4=right.jpg"], "two cameras would be called left"),
        (["--video", "left.mp4=middle.jpg"], "no posed photograph of the name 'middle.jpg'"),
        (["--video", "known.csv=left.jpg"], "cannot be read as a video"),
        (["--video", "left.mp4=left.jpg", "--video-every", "0"], "--video-every"),
        (["--motion", "robot.csv", "mm"], "a motion needs frames"),
        (["--motion", "known.csv", "mm"], "expected the header time,x,y,z,qw"),
        (["--motion", "robot.csv", "mm", "--robot-to-world", "known.csv"], "four rows of four numbers"),
        (["--motion", "robot.csv", "mm", "--video", "left.mp4=left.jpg"], "give --tool or --clock-offset"),
        (["--tool", "known.csv", "mm"], "known.csv"),
        (["--clock-offset", "nan", *SCALED], "--clock-offset: must be a number"),
        (["--motion", "robot.csv", "mm", "--robot-to-world", "nan.txt", *SCALED], "numbers are not finite"),
        (["--known", "exchanged.csv", "--points", "marks.csv"], "are names exchanged"),
        (["--experiment", "still.json", *SCALED], "frame_rate: 0 lies outside"),
        (["--motion", "robot.csv", "km"], "its unit 'km' is none of m, cm, mm, in"),
    ],
)
def test_mistakes_are_one_sentence_and_nothing_is_written(
    words: list[str], said: str, plow: Recorded, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    if said.startswith(
        ("write", "two", "no posed", "cannot", "--video", "a motion", "expected", "four", "give", "known", "its unit")
    ):
        words = [*words, *SCALED]
    result = importing(plow, *words)
    assert result["code"] == 2 and said in result["error"], result
    assert list(tmp_path.iterdir()) == []


def test_points_need_two_photographs(plow: Recorded, tmp_path: Path) -> None:
    frames = read_source(plow.folder).frames
    file = tmp_path / "marks.csv"
    file.write_text("point,image,u,v\na,still/0.jpg,3,4\na,still/0.jpg,3,4\n")
    with pytest.raises(MeasurementError, match="'a' needs marks in two photographs"):
        read_marked(file, frames)


def test_a_tool_that_the_video_does_not_show(
    plow: Recorded, importing: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    words = [w for w in plow.words if w not in ("--mesh-to-flange", "mesh_to_flange.csv")]
    far = np.eye(4)
    far[:3, 3] = 300.0
    np.savetxt(plow.folder / "far.txt", far)
    said = importing(plow, *words, "--mesh-to-flange", "far.txt", "--known", "known.csv", "--points", "marks.csv")
    assert said["code"] == 2 and "no camera of the video sees the tool's motion" in said["error"]
    assert list(tmp_path.iterdir()) == []


def footage(shown: bool) -> tuple[Footage, trimesh.Trimesh, ToolMotion]:
    """A grey box that crosses a picture of noise, filmed from above with 10 frames a second, 0.5 s late; or noise."""
    times = np.linspace(0.0, 3.0, 31)
    positions = np.stack([-0.3 + 0.2 * times, 0.0 * times, 0.0 * times], axis=1)
    motion = ToolMotion(np.arange(31), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (31, 1)))
    pose = np.eye(4)
    pose[2, 3] = 1.0 + 0.005
    camera = Camera(80, 60, 80.0, 80.0, 40.0, 30.0, pose, model="PINHOLE")
    filmed = np.arange(0.7, 1.9, 0.1)
    pictures = np.random.default_rng(0).integers(0, 120, (len(filmed), 60, 80, 3)).astype(np.uint8)
    for picture, time in zip(pictures, filmed, strict=True):
        # Seen from 1 m above its top, 80 px a metre.
        left, right = (40.0 + 80.0 * (-0.3 + 0.2 * time + side) for side in (-0.1, 0.1))
        share = np.clip(np.minimum(right, np.arange(80) + 1.0) - np.maximum(left, np.arange(80)), 0.0, 1.0)
        if shown:
            rows = picture[22:38]
            picture[22:38] = np.rint(rows + share[None, :, None] * (200.0 - rows))
    box = trimesh.creation.box((0.2, 0.2, 0.01))
    return Footage(camera, filmed - 0.5, pictures), box, motion


def test_the_clock_of_a_box_that_crosses_the_picture() -> None:
    """A pixel is 60 ms of its way."""
    found = clock_offset(*([one] if isinstance(one, Footage) else one for one in footage(shown=True)))
    assert found.seconds == pytest.approx(0.5, abs=0.005) and found.by_camera == pytest.approx(
        [found.seconds], abs=1e-3
    )


def test_no_clock_is_told_from_noise() -> None:
    with pytest.raises(MeasurementError, match="colours of what is behind it"):
        clock_offset(*([one] if isinstance(one, Footage) else one for one in footage(shown=False)))


def test_a_video_on_another_clock_than_the_tools_is_known(plow_dry: Path) -> None:
    """A real picture of the example set, on clocks that differ by more and by less than half a frame of 20 ms."""
    given = Measurement.load(plow_dry)
    frames = [f for f in given.video if f.camera_name == "left" and (f.frame or 0) >= 0][::2]

    def late(seconds: float, video: list[Frame]) -> dict[str, float]:
        shifted = tuple(replace(f, time=(f.time or 0.0) + seconds) for f in video)
        return late_cameras(replace(given, video=shifted))

    assert late(0.005, frames) == {}
    assert late(-0.05, frames) == {"left": pytest.approx(0.05, abs=0.005)}
    assert late(-0.05, frames[:3]) == {}, "too few to tell"
