"""Synthetic sets: whole, true to what they say, and made of physics."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatsoil import cli
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.measurement import Measurement, ToolMotion, remarks
from splatsoil.mpm import Resolution, simulate
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.synthetic import Appearance, Recipe, Setup, World, like, make_set, paper, plow
from splatsoil.synthetic.setups import video_frames
from splatsoil.synthetic.world import truth_frames

LAST = 60
DRY = Recipe(friction_angle=31.0, preset="tiny")


def short(seed: int = 0, views: int = 12) -> Setup:
    """The plow scene up to frame 60, in pictures of 48 x 36."""
    setup = plow(seed, views=views).resized(0.15)
    motion = setup.tool.motion
    rows = slice(0, LAST + 1)
    cut = ToolMotion(motion.frames[rows], motion.times[rows], motion.positions[rows], motion.quaternions[rows])
    return replace(setup, tool=replace(setup.tool, motion=cut), frames=(0, 20, 40, LAST))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A dry world."""
    return make_set(tmp_path_factory.mktemp("worlds") / "dry", short(), DRY)


def particles(folder: Path, frame: int) -> np.ndarray:
    data = np.load(folder / "truth_particles.npz")
    return data[f"f{frame:03d}"] * float(data["scale"]) + data["origin"]


def test_the_set_is_whole(world: World) -> None:
    measurement = Measurement.load(world.measurement.folder)
    assert remarks(measurement) == ()
    assert measurement.frames == (0, 20, 40, LAST)
    assert sorted({f.frame for f in measurement.pre_roll}) == [-4, -3, -2, -1]
    assert list(measurement.cameras) == ["left", "right"] and len(measurement.views) == 12
    assert measurement.tool.force is not None and len(measurement.tool.force) == LAST
    assert measurement.name == "dry"


def test_check_has_no_complaint(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(world.measurement.folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["remarks"] == []


def test_the_truth_is_told(world: World) -> None:
    truth = json.loads((world.measurement.folder / "truth.json").read_text())
    assert truth == json.loads(json.dumps(world.truth))
    assert truth["parameters"] == {"friction_angle": 31.0} and truth["effects"] == []
    assert truth["settings"]["tool_friction"] == 0.3 and truth["preset"] == "tiny" and truth["seed"] == 0
    sum_of_all = sum(p.stat().st_size for p in world.measurement.folder.rglob("*") if p.is_file())
    assert sum_of_all < 2e6


def test_particles_fill_the_bed_and_keep_their_number(world: World) -> None:
    folder, bed = world.measurement.folder, world.measurement.bed
    spacing = float(np.load(folder / "truth_particles.npz")["spacing"])
    for frame in truth_frames(world.measurement.frames):
        x = particles(folder, frame)
        assert len(x) == world.particles
        assert (x[:, :2] >= bed.lower[:2] - 1e-4).all() and (x[:, :2] <= bed.upper[:2] + 1e-4).all()
        assert x[:, 2].min() >= bed.lower[2] - 0.1 * spacing
    area = float(np.prod(bed.extents[:2]))
    assert world.particles * spacing**3 / area == pytest.approx(0.12, rel=0.005)


def test_a_model_of_the_set_that_starts_from_its_particles_makes_it_again(world: World) -> None:
    """The set's tool is of single precision; half of a cell more or less across the bed would be another solver."""
    measurement, truth = world.measurement, world.truth
    resolution = Resolution.derive(measurement, "tiny")
    start = fill(short().surface, measurement.bed, resolution.spacing, seed=truth["particle_seed"])
    values = {"friction_angle": truth["parameters"]["friction_angle"]}
    again = simulate(measurement, start, values, law=Law(()), resolution=resolution, frames=(LAST,))[0]
    np.testing.assert_allclose(again.at(LAST)[0], particles(measurement.folder, LAST), atol=2e-5)
    assert measurement.tool.force is not None
    np.testing.assert_allclose(again.force, measurement.tool.force[:LAST, 2:], rtol=1e-4, atol=1e-3)


def test_the_soil_pushes_back(world: World) -> None:
    """Nothing before the plate touches; then against the push along +x, and up, between McKyes' blades in soil of the
    angle that the cone has in triaxial compression (31) and of that which it has in plane strain (45.9 degrees)."""
    force = world.measurement.tool.force
    assert force is not None
    assert np.abs(force[:3, 2:]).max() == 0.0
    pushing = force[force[:, 0] > 45, 2:].mean(axis=0)
    assert pushing[0] < -20.0 and pushing[2] > 0.0 and abs(pushing[1]) < 0.1 * abs(pushing[0])
    depth, width, weight = 0.07, 0.12, 1600.0 * 9.81
    along = world.measurement.tool.motion.positions[:, 0]
    way = along[45:].mean() - along[0]

    def blade(factor: float, slip_plane: float) -> float:
        """Upright, delta = 16.7 deg, with N_gamma at its slip plane (deg), narrow, and with what it has pushed up by
        then, half the way on, as a surcharge on the wedge, for which N_q = 2 N_gamma."""
        reach = depth / np.tan(np.radians(slip_plane))
        narrow = 1.0 + 2.0 / 3.0 * reach / width
        heap = depth * width * way / (reach * width * narrow)
        return float(weight * depth * (depth + 2.0 * heap) * width * factor * narrow)

    assert blade(2.81, 19.4) < -pushing[0] < blade(7.46, 13.1)


def test_nothing_moves_in_the_pre_roll_but_the_noise(world: World) -> None:
    for name in world.measurement.cameras:
        frames = [f.image() for f in world.measurement.pre_roll if f.camera_name == name]
        noise = np.std(np.stack(frames), axis=0, ddof=1)
        # The sensor's 1.5 grey levels, those of the light paths, and what JPEG makes of both.
        assert 1.2 < 255.0 * np.sqrt(np.mean(noise**2)) < 3.0
        assert all((a != b).any() for a, b in pairwise(frames))


def test_pictures_show_the_push(world: World) -> None:
    measurement = world.measurement
    still = np.abs(measurement.video_frame("left", 0).image() - measurement.video_frame("left", -1).image()).mean()
    moved = np.abs(measurement.video_frame("left", LAST).image() - measurement.video_frame("left", 0).image()).mean()
    assert moved > 2.0 * still
    colours = np.stack([f.image().mean(axis=(0, 1)) for f in measurement.views])
    assert (colours > 0.2).all() and (colours < 0.9).all()
    assert (colours[:, 0] > colours[:, 2]).all(), "sand is more red than blue"


def test_the_same_seed_gives_the_same_bytes(world: World, tmp_path: Path) -> None:
    again = make_set(tmp_path / "dry", short(), DRY)
    assert again.measurement.hash == world.measurement.hash
    ours, theirs = (np.load(w.measurement.folder / "truth_particles.npz") for w in (again, world))
    for key in theirs:
        np.testing.assert_array_equal(ours[key], theirs[key])
    for name in ("tool_motion.csv", "tool_force.csv", "truth.json"):
        assert (again.measurement.folder / name).read_bytes() == (world.measurement.folder / name).read_bytes()


def test_what_cameras_report_changes_the_video_and_nothing_else(world: World, tmp_path: Path) -> None:
    """A gain of 0.6, and a pan of the left camera by a pixel."""
    per_pixel = float(np.degrees(1.0 / short().video["left"].fx))
    values = {"exposure_gain": 0.6, "camera_1_pan": per_pixel}
    seen = make_set(tmp_path / "seen", short(), replace(DRY, effects=("exposure", "camera_pose"), values=values))
    assert seen.truth["parameters"]["camera_1_pan"] == per_pixel
    for frame in truth_frames(world.measurement.frames):
        np.testing.assert_array_equal(
            particles(seen.measurement.folder, frame), particles(world.measurement.folder, frame)
        )
    for ours, theirs in zip(seen.measurement.views, world.measurement.views, strict=True):
        np.testing.assert_array_equal(ours.image(), theirs.image())

    def linear(set_: World, camera: str, frame: int) -> np.ndarray:
        image = set_.measurement.video_frame(camera, frame).image().astype(np.float64)
        return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)

    for camera, shift in (("left", 1), ("right", 0)):
        before, after = linear(world, camera, -1), linear(seen, camera, -1)
        expected = 0.6 * np.roll(before, -shift, axis=1)[:, 4:-4]
        found = after[:, 4:-4]
        assert np.median(found / expected) == pytest.approx(1.0, abs=0.02)
        still = np.abs(found - 0.6 * before[:, 4:-4]).mean()
        assert shift == 0 or np.abs(found - expected).mean() < 0.7 * still
    assert Measurement.load(seen.measurement.folder).cameras["left"].camera_to_world == pytest.approx(
        world.measurement.cameras["left"].camera_to_world
    ), "the set says nothing of the bump"


def test_a_late_video_shows_soil_and_tool_as_they_are_later(tmp_path: Path) -> None:
    """Late by two frames of 0.02 s, the picture of frame 38 is that of frame 40, when nothing is late."""

    def seen(name: str, frame: int, **effects: Any) -> Measurement:
        setup = replace(short(views=2), frames=(0, frame))
        return make_set(tmp_path / name, setup, replace(DRY, **effects)).measurement

    late = seen("late", 38, effects=("time_offset",), values={"time_offset": 0.04})
    in_time, later = seen("in-time", 38), seen("later", 40)

    def apart(one: Measurement, first: int, other: Measurement, second: int) -> float:
        """Root of the mean of the largest twentieth of squared differences: where the tool moves."""
        square = np.square(
            np.subtract(one.video_frame("left", first).image(), other.video_frame("left", second).image())
        )
        return float(np.sqrt(np.mean(np.sort(square, axis=None)[-square.size // 20 :])))

    noise = apart(late, -2, late, -1)
    assert apart(late, 38, later, 40) < 1.2 * noise
    assert apart(in_time, 38, later, 40) > 1.4 * noise, "in time, the tool would stand elsewhere"


def test_cohesion_acts(world: World, tmp_path: Path) -> None:
    """With all else equal, it moves the sand by far more than rounding, and the plate needs more force."""
    recipe = replace(DRY, effects=["cohesion"], values={"cohesion": 1000.0})
    damp = make_set(tmp_path / "damp", short(views=1), recipe)
    assert damp.truth["parameters"] == {"friction_angle": 31.0, "cohesion": 1000.0}
    a, b = (particles(w.measurement.folder, LAST) for w in (world, damp))
    start = [particles(w.measurement.folder, 0) for w in (world, damp)]
    np.testing.assert_array_equal(*start)
    assert np.sqrt(np.mean((a - b) ** 2)) > 1e-3
    dry_force, damp_force = world.measurement.tool.force, damp.measurement.tool.force
    assert dry_force is not None and damp_force is not None
    # c d N_c w with N_c of about 1 alone is 1000 * 0.07 * 0.12 = 8 N.
    assert dry_force[50:, 2].mean() - damp_force[50:, 2].mean() > 8.0


def test_other_seeds_are_other_worlds() -> None:
    a, b = plow(0).surface.height, plow(1).surface.height
    assert np.abs(a - b).max() > 0.005
    assert Appearance.drawn(0) != Appearance.drawn(1) and Appearance.drawn(0) == Appearance.drawn(0)
    for seed in range(20):
        surface = plow(seed).surface
        assert surface.height.mean() == pytest.approx(0.12, abs=1e-9)
        slope = np.hypot(*np.gradient(surface.height, *surface.cell[::-1])).max()
        assert slope <= np.tan(np.radians(12.0)) + 1e-9


def test_the_plow_scene_is_that_of_plow_dry(plow_dry: Path) -> None:
    example, setup = Measurement.load(plow_dry), plow()
    np.testing.assert_allclose(setup.bed.corners, example.bed.corners)
    ours, theirs = setup.tool.motion, example.tool.motion
    np.testing.assert_allclose(ours.positions, theirs.positions, atol=1e-9)
    np.testing.assert_allclose(ours.quaternions, theirs.quaternions, atol=1e-6)
    np.testing.assert_allclose(setup.tool.mesh.bounds, example.tool.mesh.bounds, atol=1e-6)
    assert setup.frames == example.frames and setup.frame_rate == example.frame_rate
    for name, camera in example.cameras.items():
        np.testing.assert_allclose(setup.video[name].camera_to_world, camera.camera_to_world, atol=1e-9)
        assert setup.video[name].fx == pytest.approx(camera.fx, rel=1e-4)


def test_the_papers_scene_is_the_papers() -> None:
    setup = paper()
    assert setup.surface.height.mean() / 0.015625**3 == pytest.approx(77_000, rel=0.01)  # 8 particles in cells of 1/32
    x, z = 0.31, 0.42  # theirs
    wave = 0.22 + 0.1 * (np.sin(np.pi * x) + 0.5 * np.sin(1.5 * np.pi * z) + 0.05 * np.sin(4 * np.pi * x))
    assert setup.surface.sample(np.array([[x, 1.0 - z]]))[0] == pytest.approx(wave, abs=2e-5)
    motion = setup.tool.motion
    for frame, place in (
        (0, (0.1, 0.5, 0.4)),
        (25, (0.1, 0.5, 0.35)),
        (100, (0.55, 0.5, 0.35)),
        (125, (0.55, 0.5, 0.35)),
    ):
        np.testing.assert_allclose(motion.positions[frame], place, atol=1e-9)
    camera = setup.video["left"]
    assert 2.0 * np.degrees(np.arctan(0.5 * camera.width / camera.fx)) == pytest.approx(61.93)
    assert (camera.width, camera.height, len(setup.views)) == (1280, 720, 40)
    # Their (x, y, z) is our (x, 1 - z, y).
    np.testing.assert_allclose(camera.position, (-0.5, -0.5, 0.5))
    np.testing.assert_allclose(setup.video["right"].position, (-0.5, 1.5, 0.5))
    assert {50, 100, 150, 199} <= set(setup.frames)


def test_like_takes_bed_tool_motion_and_cameras(plow_dry: Path) -> None:
    example = Measurement.load(plow_dry)
    setup = like(example, seed=4, views=5)
    assert setup.bed is example.bed and setup.tool.motion is example.tool.motion and setup.tool.force is None
    assert len(setup.views) == 5 and set(setup.video) == {"left", "right"} and setup.frames == example.frames
    assert setup.surface.height.mean() == pytest.approx(0.45 * 0.27)
    assert like(example, depth=0.1).surface.height.mean() == pytest.approx(0.1)


def test_truth_is_kept_at_quarters_of_the_run() -> None:
    assert truth_frames(video_frames(199)) == (0, 50, 100, 150, 199)
    assert truth_frames((0,)) == (0,)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"effects": ["cohesion"], "values": {"cohesion": -5.0}}, "outside"),
        ({"friction_angle": float("nan")}, "finite"),
        ({"preset": "enormous"}, "enormous"),
        ({"particle_seed": -2}, "-2"),
    ],
)
def test_bad_options_are_refused_before_any_work(options: dict[str, object], said: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=said):
        make_set(tmp_path / "new", short(views=1), replace(DRY, **options))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moment", ["sand", "pictures"])
def test_an_interruption_leaves_nothing(moment: str, tmp_path: Path) -> None:
    def stop(what: str, share: float) -> None:
        if what == moment:
            raise KeyboardInterrupt

    setup = replace(short(views=1), frames=(0, 1))
    with pytest.raises(KeyboardInterrupt):
        make_set(tmp_path / "deep" / "new", setup, DRY, stop)
    assert list(tmp_path.iterdir()) == []


def test_a_fault_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    motion = plow().tool.motion
    cut = ToolMotion(motion.frames[:2], motion.times[:2], motion.positions[:2], motion.quaternions[:2])
    setup = short(views=1)
    setup = replace(setup, tool=replace(setup.tool, motion=cut), frames=(0, 1))
    monkeypatch.setattr("splatsoil.synthetic.world.np.savez_compressed", full)
    with pytest.raises(MeasurementError, match="No space left"):
        make_set(tmp_path / "deep" / "new", setup, DRY)
    assert list(tmp_path.iterdir()) == []


def test_soil_must_leave_room_for_the_tool() -> None:
    with pytest.raises(ParameterError, match="--depth"):
        plow(depth=0.16)
    with pytest.raises(ParameterError, match="does not fit"):
        plow(depth=0.5)
