"""What a loaded set says, its hash, and writing one."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from skimage.draw import polygon

from splatsoil.errors import MeasurementError
from splatsoil.measurement import (
    Bed,
    Camera,
    Contents,
    Measurement,
    Picture,
    Tool,
    ToolMotion,
    remarks,
    write_measurement,
)


def test_plow_dry_holds_what_its_files_say(plow_dry: Path) -> None:
    m = Measurement.load(plow_dry)
    assert (m.name, m.frame_rate, len(m.views), len(m.video)) == ("plow-dry", 50.0, 40, 50)
    np.testing.assert_array_equal(m.gravity, [0, 0, -9.81])
    np.testing.assert_array_equal(m.bed.upper, [0.8, 0.5, 0.27])
    assert (m.bed.density, m.bed.wall_friction, m.bed.floor_friction, m.tool.friction) == (1600.0, 0.0, 0.6, 0.3)
    assert list(m.cameras) == ["left", "right"]
    assert m.frames == (*range(0, 200, 10), 199)
    assert sorted(f.frame for f in m.pre_roll) == [-4, -4, -3, -3, -2, -2, -1, -1]
    frame = m.video_frame("right", 100)
    assert frame.time == 2.0 and frame.path == plow_dry / "video/right/+100.jpg"
    np.testing.assert_allclose(frame.camera.position, [0.95, 0.85, 0.58])
    assert frame.image().shape == (240, 320, 3)
    assert m.tool.force is not None and m.tool.force.shape == (200, 5)
    np.testing.assert_allclose(m.tool.mesh.extents, [0.012, 0.12, 0.12])
    assert m.tool.mesh.volume == pytest.approx(0.012 * 0.12 * 0.12)
    assert remarks(m) == ()
    with pytest.raises(MeasurementError, match="no frame 5 of camera 'left'"):
        m.video_frame("left", 5)


def test_cameras_see_the_tool_where_it_is(plow_dry: Path) -> None:
    """Mesh, motion and projection together: the image has changed most in the blade's outline, not 8 pixels off."""
    m = Measurement.load(plow_dry)
    for name, camera in m.cameras.items():
        for frame in (100, 150):
            change = np.abs(m.video_frame(name, frame).image() - m.video_frame(name, 0).image()).mean(axis=2)
            rotation, position = m.tool.motion.pose(frame / 50.0)
            pixels, depth = camera.project(m.tool.mesh.vertices @ rotation.T + position)
            assert (depth > 0).all()
            outline = pixels[ConvexHull(pixels).vertices] - 0.5

            def inside(dx: float, dy: float, outline: np.ndarray = outline, change: np.ndarray = change) -> float:
                return float(change[polygon(outline[:, 1] + dy, outline[:, 0] + dx, change.shape)].mean())

            off = [inside(dx, dy) for dx, dy in ((8, 0), (-8, 0), (0, 8), (0, -8))]
            assert inside(0, 0) > 1.01 * max(off), (name, frame)


def test_the_hash_is_of_what_the_set_consists_of(small_set: Path) -> None:
    before = Measurement.load(small_set).hash
    assert len(before) == 64
    (small_set / "truth.json").write_text("{}")
    (small_set / "notes.txt").write_text("windy")
    moved = small_set.parent / "elsewhere"
    shutil.copytree(small_set, moved)
    assert Measurement.load(moved).hash == before, "neither its place, nor truth, nor strangers matter"
    pixels = np.asarray(Image.open(moved / "views/images/002.jpg")).copy()
    pixels[0, 0] ^= 255
    Image.fromarray(pixels).save(moved / "views/images/002.jpg", quality=100)
    assert Measurement.load(moved).hash != before
    shutil.copy(small_set / "views/images/002.jpg", moved / "views/images/002.jpg")
    assert Measurement.load(moved).hash == before
    (moved / "tool_motion.csv").open("a").write("\n")
    assert Measurement.load(moved).hash != before


@pytest.mark.parametrize("kind", ["views", "video"])
def test_the_order_of_frames_in_a_file_changes_nothing(kind: str, plow_dry: Path, tmp_path: Path) -> None:
    shutil.copytree(plow_dry, tmp_path / "set")
    file = tmp_path / "set" / kind / "transforms.json"
    data = json.loads(file.read_text())
    np.random.default_rng(0).shuffle(data["frames"])
    file.write_text(json.dumps(data))
    loaded = (Measurement.load(plow_dry), Measurement.load(tmp_path / "set"))
    listed, shuffled = (
        [
            (f.path.relative_to(m.folder), f.camera_name, f.frame, f.time, f.camera.camera_to_world.tobytes())
            for f in (*m.views, *m.video, *m.pre_roll)
        ]
        for m in loaded
    )
    assert shuffled == listed and list(loaded[1].cameras) == ["left", "right"]


def test_a_relative_set_is_found_from_another_working_folder(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small_set.parent)
    m = Measurement.load(small_set.name)
    monkeypatch.chdir("/")
    there = Measurement.load(small_set)
    assert m.hash == there.hash and remarks(m) == remarks(there) and m.folder == there.folder
    np.testing.assert_array_equal(m.views[0].image(), there.views[0].image())


def made_up(**bend: float) -> Contents:
    """A set that stands on nothing but this file."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    matrix[:3, 3] = [0.2, -0.7, 0.9]
    camera = Camera(32, 24, 40.0, 41.0, 15.5, 12.25, matrix, **bend)
    rng = np.random.default_rng(0)
    picture = rng.random((24, 32, 3))
    tool = Tool(
        trimesh.creation.icosphere(radius=0.04),
        ToolMotion([0, 1, 2], [0.0, 0.1, 0.2], [[0.1, 0.1, 0.1]] * 3, Rotation.random(3, rng=1).as_quat()),
        friction=0.25,
        force=np.array([[1, 0.1, 3.0, -1.0, 0.125]]),
    )
    return Contents(
        name="made up",
        bed=Bed([0, 0, 0], [0.4, 0.3, 0.2], 1500.0, 0.1, 0.4),
        tool=tool,
        views=[Picture(camera, picture), Picture(camera, 1.0 - picture)],
        video=[Picture(replace(camera, name="side"), picture, n, 0.1 * n) for n in (-1, 0, 1, 2)],
        frame_rate=10.0,
        gravity=(0.1, 0.0, -1.62),
    )


@pytest.mark.parametrize("container", [None, "bin", "transparent", "open", "heap"])
def test_the_container_is_kept_and_says_what_is_simulated(container: str | None, tmp_path: Path) -> None:
    parts = made_up()
    bed = write_measurement(tmp_path / "set", replace(parts, bed=replace(parts.bed, container=container))).bed
    assert bed.container == container
    margin = 0.06 if container in ("open", "heap") else 0.0
    np.testing.assert_allclose(bed.domain.lower, [-margin, -margin, 0.0])
    np.testing.assert_allclose(bed.domain.upper, [0.4 + margin, 0.3 + margin, 0.2])


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    parts = made_up(k1=-0.1, p2=0.002)
    m = write_measurement(tmp_path / "out" / "set", parts, suffix=".png", truth={"phi": 36.0})
    assert (m.name, m.frame_rate, m.frames, list(m.cameras)) == ("made up", 10.0, (0, 1, 2), ["side"])
    np.testing.assert_array_equal(m.gravity, parts.gravity)
    np.testing.assert_array_equal(m.bed.upper, parts.bed.upper)
    assert (m.bed.density, m.bed.wall_friction, m.bed.floor_friction) == (1500.0, 0.1, 0.4)
    assert m.tool.friction == 0.25
    np.testing.assert_array_equal(m.tool.force, parts.tool.force)
    np.testing.assert_allclose(m.tool.mesh.volume, parts.tool.mesh.volume, rtol=1e-5)
    np.testing.assert_allclose(m.tool.motion.table, parts.tool.motion.table, atol=1e-15)
    wanted, got = parts.views[0].camera, m.views[0].camera
    np.testing.assert_allclose(got.camera_to_world, wanted.camera_to_world, atol=1e-12)
    np.testing.assert_array_equal(got.intrinsics, wanted.intrinsics)
    assert got.distortion == wanted.distortion
    np.testing.assert_allclose(m.views[1].image(), parts.views[1].image, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(m.video_frame("side", -1).image(), parts.video[0].image, atol=0.5 / 255 + 1e-6)
    assert json.loads((tmp_path / "out/set/truth.json").read_text()) == {"phi": 36.0}
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["set"], "no temporary folder stays"


def test_frames_of_another_set_are_copied_bit_by_bit(plow_dry: Path, tmp_path: Path) -> None:
    m = Measurement.load(plow_dry)
    contents = Contents(name=m.name, bed=m.bed, tool=m.tool, views=m.views[:3], video=m.video[:6], frame_rate=50.0)
    copy = write_measurement(tmp_path / "copy", contents)
    assert copy.views[2].path.read_bytes() == m.views[2].path.read_bytes()
    np.testing.assert_allclose(copy.views[2].camera.camera_to_world, m.views[2].camera.camera_to_world, atol=1e-12)
    assert copy.frames == () and len(copy.pre_roll) == 6
    np.testing.assert_allclose(copy.tool.motion.pose(1.234)[0], m.tool.motion.pose(1.234)[0], atol=1e-12)


def test_nothing_is_overwritten_and_faults_leave_nothing(tmp_path: Path) -> None:
    parts = made_up()
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.txt").write_text("three years")
    with pytest.raises(MeasurementError, match="nothing is overwritten"):
        write_measurement(taken, parts)
    assert [p.name for p in taken.iterdir()] == ["thesis.txt"]

    nameless, side, black = parts.views[0].camera, parts.video[0].camera, np.zeros((24, 32, 3))
    faults = {
        "does not point down": {"gravity": (0, 0, 9.81)},
        "not finite": {"views": [Picture(nameless, black * np.nan)]},
        "camera says": {"views": [Picture(nameless, black[1:])]},
        "no name for a camera": {"video": [Picture(nameless, black, 0, 0.0)]},
        "needs a number": {"video": [Picture(side, black)]},
    }
    for says, change in faults.items():
        with pytest.raises(MeasurementError, match=says):
            write_measurement(tmp_path / "new", replace(parts, **change))
        assert [p.name for p in tmp_path.iterdir()] == ["taken"], says


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda e, v, w: e["bed"].pop("floor_friction"), "bed.floor_friction is not given; 0.6 is taken"),
        (lambda e, v, w: None, "only 4 views"),
        (lambda e, v, w: w.update(frames=[f for f in w["frames"] if f["frame"] >= 0]), "no pre-roll"),
        (lambda e, v, w: w.update(frames=[f for f in w["frames"] if f["frame"] < 0]), "nothing to compare with"),
        (lambda e, v, w: w["frames"].pop(), "Camera 'right' lacks 1 frames that others have: 10"),
        (lambda e, v, w: w["frames"][-1].update(time=0.215), "1 video frames are not where 50 frames a second"),
        (lambda e, v, w: [f.update(frame=90, time=1.8) for f in w["frames"] if f["frame"] == 10], "does not cover"),
        (lambda e, v, w: e["bed"].update(lower=[0.1, 0.2, -0.1], upper=[0.5, 0.3, 0.06]), "in only 44 %"),
        (lambda e, v, w: v.update(k1=-3.0), "folds over before the image's corners"),
        (lambda e, v, w: v.update(cx=0.5, cy=0.5), "principal point of the views' camera is 0.5, 0.5"),
        (lambda e, v, w: w.update(cx=0.0, cy=0.0), "principal point of camera 'left' is 0, 0"),
        (lambda e, v, w: e.update(gravity=[0.0, 0.0, -1.0]), "Gravity is 1 m/s²"),
        (lambda e, v, w: v["frames"][2]["transform_matrix"][2].__setitem__(3, -0.2), "below the bed's floor: 002.jpg"),
        (lambda e, v, w: v["frames"][2]["transform_matrix"][0].__setitem__(3, 9.0), "do not show the soil's box: 002"),
    ],
)
def test_remarks_say_in_plain_words_what_is_odd(small_set: Path, spoil: object, says: str) -> None:
    files = [small_set / name for name in ("experiment.json", "views/transforms.json", "video/transforms.json")]
    data = [json.loads(file.read_text()) for file in files]
    spoil(*data)  # type: ignore[operator]
    for file, content in zip(files, data, strict=True):
        file.write_text(json.dumps(content))
    texts = [remark.text for remark in remarks(Measurement.load(small_set))]
    assert any(says in text for text in texts), texts


def test_a_gltf_gets_a_remark_on_its_axes(small_set: Path) -> None:
    trimesh.load_mesh(small_set / "tool.stl").export(small_set / "tool.glb")
    file = small_set / "experiment.json"
    file.write_text(file.read_text().replace("tool.stl", "tool.glb"))
    assert "y is up" in " ".join(remark.text for remark in remarks(Measurement.load(small_set)))


def test_the_folders_name_is_a_sets_name(small_set: Path) -> None:
    file = small_set / "experiment.json"
    file.write_text(json.dumps({k: v for k, v in json.loads(file.read_text()).items() if k != "name"}))
    assert Measurement.load(small_set).name == small_set.name
    odd = small_set.rename(small_set.parent / "red\x1b[31m")
    with pytest.raises(MeasurementError, match="unprintable") as caught:
        Measurement.load(odd)
    assert caught.value.field == "name"


def test_lost_video_frames_are_named(plow_dry: Path, tmp_path: Path) -> None:
    """Frame 110 is missing from both cameras; that 199 follows 190 is no gap."""
    shutil.copytree(plow_dry, tmp_path / "set")
    file = tmp_path / "set" / "video" / "transforms.json"
    data = json.loads(file.read_text())
    data["frames"] = [frame for frame in data["frames"] if frame["frame"] != 110]
    file.write_text(json.dumps(data))
    (remark,) = remarks(Measurement.load(tmp_path / "set"))
    assert remark.text == "The video lacks 1 frames in an otherwise even row: 110."


def test_cameras_and_sets_survive_pickling(plow_dry: Path) -> None:
    m = pickle.loads(pickle.dumps(Measurement.load(plow_dry)))
    np.testing.assert_array_equal(m.cameras["left"].camera_to_world[3], [0, 0, 0, 1])
    assert m.tool.mesh.is_watertight and m.hash == Measurement.load(plow_dry).hash


def test_remarks_on_the_tools_motion(small_set: Path) -> None:
    file = small_set / "tool_motion.csv"
    head, *rows = file.read_text().splitlines()

    def said(changed: list[str]) -> str:
        file.write_text("\n".join([head, *changed]))
        return " ".join(remark.text for remark in remarks(Measurement.load(small_set)) if remark.about == "tool")

    assert said(rows) == ""
    assert "skips frames (first 7)" in said(rows[:7] + rows[8:])
    w, x, y, z = (slice(k, k + 1) for k in range(5, 9))
    swapped = [row.split(",") for row in rows]
    swapped = [r[:5] + r[x] + r[y] + r[z] + r[w] for r in swapped]
    assert "is their order x, y, z, w" in said([",".join(row) for row in swapped])
    jump = [row.replace(",0.2,", ",0.4,", 1) if i == 20 else row for i, row in enumerate(rows)]
    assert "jumps by 200 mm before frame 20" in said(jump)


@pytest.mark.parametrize("rate", [50, 5000])
def test_a_motion_in_which_nothing_falls_gets_a_remark(rate: int, plow_dry: Path, tmp_path: Path) -> None:
    """All clocks a hundredth as long, at once: soil falls by g (0.04 s)² / 2 in the whole of it, 7.8 mm."""
    folder = tmp_path / "set"
    shutil.copytree(plow_dry, folder)
    for name in ("tool_motion.csv", "tool_force.csv"):
        head, *rows = (row.split(",") for row in (folder / name).read_text().splitlines())
        timed = [[row[0], str(int(row[0]) / rate), *row[2:]] for row in rows]
        (folder / name).write_text("\n".join(",".join(row) for row in (head, *timed)))
    for name, place in (("experiment.json", None), ("video/transforms.json", "frames")):
        data = json.loads((folder / name).read_text())
        data["frame_rate"] = rate
        for frame in data[place] if place else ():
            frame["time"] = frame["frame"] / rate
        (folder / name).write_text(json.dumps(data))
    said = " ".join(remark.text for remark in remarks(Measurement.load(folder)))
    assert ("soil falls by 7.8 mm" in said) == (rate == 5000)


def test_remarks_on_the_tools_force(small_set: Path) -> None:
    file = small_set / "tool_force.csv"

    def said(rows: list[str]) -> str:
        file.write_text("\n".join(["frame,time,fx,fy,fz", *rows]))
        description = json.loads((small_set / "experiment.json").read_text())
        description["tool"]["force"] = file.name
        (small_set / "experiment.json").write_text(json.dumps(description))
        return " ".join(remark.text for remark in remarks(Measurement.load(small_set)) if remark.about == "tool")

    rate = Measurement.load(small_set).frame_rate
    # A litre of soil weighs 16 N, a cube as wide as the tool 27 N.
    for size, odd in ((1.0, False), (500.0, False), (0.001, True), (1e4, True)):
        assert ("is it in newtons" in said([f"{k},{k / rate},{-20 * size},0,0" for k in range(1, 30)])) == odd
    assert said([f"{k},{k / rate},-5,0,3" for k in range(1, 30)]) == ""
    assert "0 throughout" in said([f"{k},{k / rate},0,0,0" for k in range(1, 30)])
    assert "in no frame in which the tool moves" in said([f"{k},{k / rate},-5,0,3" for k in range(5000, 5003)])
    assert "29 rows of the tool's force" in said([f"{k},{10.0 + k / rate},-5,0,3" for k in range(1, 30)])
