"""The light is found again from colours it has made, over soil with blotches."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter

from splatsoil.measurement import Bed, Frame, Measurement, ToolMotion
from splatsoil.scene import Light, Relief, ToolBody, estimate, estimate_light, shade
from splatsoil.scene.estimate import untouched
from splatsoil.scene.light_fit import MovedShadow, fit_light
from splatsoil.scene.relief import relief_of_particles
from splatsoil.scene.shading import sun_visibility_at
from splatsoil.synthetic import paper
from splatsoil.synthetic.setups import staged_motion

AZIMUTHS = [(145.0, 53.0, 0.6), (-60.0, 35.0, 0.4), (20.0, 65.0, 0.5)]


def seen(azimuth, elevation, ambient, blur=0.0, size=(110, 160), plate=(0.4, 0.27, 0.21)):
    """A light, and what photographs tell of a bed with slopes, blotches and the shadow of a plate."""
    generator = np.random.default_rng(4)
    (ny, nx), cell = size, 0.005
    heights = 0.1 + 0.06 * gaussian_filter(generator.normal(size=(ny, nx)), 10.0) / 0.03 * 0.12
    relief = Relief.of_heights(torch.tensor(heights, dtype=torch.float32), (0.0, 0.0), (cell, cell))
    tool = ToolBody(trimesh.creation.box((0.012, 0.12, 0.12)))
    place = tool.at(np.eye(3), plate)
    truth = Light.from_angles(azimuth, elevation, [ambient, ambient + 0.03, ambient + 0.08])
    blotches = gaussian_filter(generator.normal(size=(ny, nx)), 3.0)
    albedo = np.exp(0.12 * blotches / blotches.std())[..., None] * np.array([0.69, 0.55, 0.37])
    points = relief.points.reshape(-1, 3)
    light = shade(relief, truth, place).irradiance(points, 0.001).numpy()
    shown = gaussian_filter(albedo * light.reshape(ny, nx, 3), (blur, blur, 0.0))
    noise = 1.0 + 0.01 * generator.normal(size=shown.shape)
    colours = torch.tensor((shown * noise).reshape(-1, 3), dtype=torch.float32)
    return truth, (points, colours, (ny, nx), relief, place), tool


def off(found, truth):
    """Degrees between the directions of two suns."""
    return np.degrees(np.arccos(np.clip(found.direction @ truth.direction, -1.0, 1.0)))


@pytest.mark.parametrize(
    ("light", "scene", "blur", "angle", "share"),
    [
        *((light, {}, 1, 1.5, 0.05) for light in AZIMUTHS),
        # the sun looks along a plate high up: its shadow lies beside those of all directions that are tried first
        ((85.0, 65.0, 0.5), {"plate": (0.4, 0.2, 0.36)}, 1, 1.0, 0.03),
        # the sun looks along the plate: a shadow too narrow for the blur still tells the sky
        *(((90.0, 53.0, 0.6), {}, blur, 180.0, 0.03) for blur in (2, 3, 6)),
        # a few cells with a wide blur tell what they can
        ((145.0, 53.0, 0.6), {"size": (14, 16), "plate": (0.04, 0.03, 0.16)}, 8, 180.0, 0.1),
    ],
)
def test_light_is_found_from_slopes_and_a_shadow(light, scene, blur, angle, share):
    truth, what, _tool = seen(*light, **scene)
    found = fit_light(*what, blur=blur)
    assert off(found, truth) < angle
    assert np.allclose(found.ambient, truth.ambient, atol=share)
    assert scene or np.allclose(found.level, [0.69, 0.55, 0.37], rtol=0.12)


def test_a_blurred_shadow_is_not_taken_for_more_sky():
    errors = []
    for light in AZIMUTHS:
        truth, what, _tool = seen(*light, blur=0.8)
        errors.append(fit_light(*what).ambient - truth.ambient)
    # with the shadow's edge among what is compared it was 0.07
    assert abs(np.mean(errors)) < 0.02


def passed(truth, what, tool, plate, blur=0.0):
    """The change that the plate's shadow makes somewhere else, with noise of its own."""
    points, _, shape, relief, place = what
    there = tool.at(np.eye(3), plate)
    lights = (shade(relief, truth, p).irradiance(points, 0.001).numpy() for p in (there, place))
    blurred = (gaussian_filter(light.reshape(*shape, 3), (blur, blur, 0.0)).reshape(-1, 3) for light in lights)
    then, rest = (torch.tensor(light) for light in blurred)
    noise = torch.tensor(0.01 * np.random.default_rng(7).normal(size=tuple(then.shape)), dtype=torch.float32)
    return MovedShadow(there, (then / rest).log() + noise)


@pytest.mark.parametrize(("azimuth", "elevation", "ambient"), AZIMUTHS)
def test_a_shadow_that_comes_later_tells_the_light(azimuth, elevation, ambient):
    # at rest the plate stands far away, and little but blotches is seen
    truth, what, tool = seen(azimuth, elevation, ambient, plate=(0.4, 5.0, 0.21))
    later = [passed(truth, what, tool, (x, 0.27, 0.19)) for x in (0.3, 0.4)]
    found = fit_light(*what, moved_shadows=later)
    assert off(found, truth) < 2.0
    assert np.allclose(found.ambient, truth.ambient, atol=0.03)
    brighter = [replace(p, change=p.change + 0.05) for p in later]
    assert np.allclose(fit_light(*what, moved_shadows=brighter).ambient, found.ambient, atol=1e-3)
    without = fit_light(*what)
    assert abs(without.ambient - truth.ambient).max() > 0.1
    unknown = MovedShadow(later[0].tool, torch.full_like(later[0].change, np.nan))
    assert np.array_equal(fit_light(*what, moved_shadows=[unknown]).ambient, without.ambient)


def test_a_passing_shadow_known_at_its_edge_only_hardly_counts():
    truth, what, tool = seen(145.0, 53.0, 0.6)
    later = passed(truth, what, tool, (0.25, 0.27, 0.21))
    sun = torch.tensor(truth.direction[None], dtype=torch.float32)
    share = sun_visibility_at(what[3], later.tool, sun, what[0], 0.001)[0].numpy()
    rim = (share > 0.02) & (gaussian_filter(share.reshape(what[2]), 0.8).reshape(-1) < 0.98)
    later.change[~torch.tensor(rim)] = np.nan
    assert rim.sum() >= 30
    assert np.allclose(fit_light(*what, moved_shadows=[later]).ambient, truth.ambient, atol=0.05)


@pytest.fixture
def flat():
    """A level bed of the paper's setup, points all over it, and the setup."""
    setup = paper().resized(0.05)
    relief = Relief.of_heights(torch.full((200, 200), 0.2), (0.0025, 0.0025), (0.005, 0.005))
    return setup, relief, relief.points.reshape(-1, 3)


def left_alone(flat, motion, frame):
    """Points of the flat bed that a tool on its way has not moved, (n, 3), and those that it may have."""
    setup, relief, points = flat
    measurement = replace(setup.experiment(), tool=replace(setup.tool, motion=motion))
    rest = untouched(measurement, points, relief, ToolBody(setup.tool.mesh), [frame])[frame].numpy()
    return points[rest].numpy(), points[~rest].numpy()


def test_soil_is_untouched_while_the_tool_is_in_the_air(flat):
    # The plate, 0.1 m long and tilted by 30°, comes down by 4 mm a frame: its lower edge is at the soil after 28.
    reach = 0.05 * np.cos(np.radians(30.0)) + 0.005 * np.sin(np.radians(30.0))
    touches = (0.36 - reach - 0.2) / 0.004
    assert 20 < touches < 30
    for frame, moved in ((20, False), (40, True)):
        _, near = left_alone(flat, down(0.36), frame)
        assert bool(len(near)) == moved


def test_soil_around_the_tool_may_have_moved_as_far_as_a_wedge_of_it_reaches(flat):
    """Beside a plate 1 and 4 cm deep: a passive wedge is tan(45° + φ/2) depths long (Rankine), 2.4 at 45°."""
    half = 0.5 * flat[0].tool.mesh.extents[1]
    for frame, depth in ((31, 0.01), (38, 0.04)):
        alone, near = left_alone(flat, down(0.36), frame)
        beyond = np.abs(near[:, 1] - 0.5).max() - half
        assert 2.4 * depth < beyond < 4.0 * depth + 0.02
        assert np.abs(alone[:, :2] - 0.5).max() > 0.45


def test_a_deep_tool_moves_no_more_than_what_is_near_it(flat):
    near = left_alone(flat, down(0.36), 60)[1]  # 13 cm deep, and no longer than 10
    longest = flat[0].tool.mesh.extents.max()
    beyond = np.abs(near[:, 1] - 0.5).max() - 0.5 * flat[0].tool.mesh.extents[1]
    assert 0.8 * longest < beyond < 1.1 * longest


def test_a_tool_that_turns_moves_what_it_sweeps(flat):
    """An arm that turns about its own origin, by half a turn from one row of its motion to the next."""
    setup, relief, points = flat
    arm = trimesh.creation.box((0.02, 0.02, 0.08), transform=trimesh.transformations.translation_matrix((0.2, 0, 0)))
    turns = np.array([[1.0, 0.0, 0.0, 0.0], [np.cos(1.5), 0.0, 0.0, np.sin(1.5)]])
    about = ToolMotion(np.array([0, 10]), np.array([0.0, 0.2]), np.full((2, 3), (0.5, 0.5, 0.2)), turns)
    measurement = replace(setup.experiment(), tool=replace(setup.tool, mesh=arm, motion=about))
    alone = untouched(measurement, points, relief, ToolBody(arm), [10])[10].numpy()
    place = points[:, :2].numpy() - 0.5
    swept = (np.abs(np.hypot(*place.T) - 0.2) < 0.01) & (place[:, 1] > 0.02)
    assert swept.sum() > 100 and not alone[swept].any()
    assert alone[(np.hypot(*place.T) < 0.05) | (place[:, 1] < -0.15)].all()


def down(height):
    """Straight down."""
    return staged_motion((0.5, 0.5, height), tilt=30.0, down=0.2, push=0.0, stages=(100, 1, 1, 1))


def test_soil_stays_touched_when_the_tool_has_left_it(flat):
    there = down(0.36)
    back = np.concatenate([there.positions[:61], there.positions[60::-1]])
    frames = np.arange(len(back))
    lifted = ToolMotion(frames, frames / 50.0, back, np.tile(there.quaternions[0], (len(back), 1)))
    alone, near = left_alone(flat, lifted, 120)
    assert np.abs(near[:, :2] - 0.5).max() > 0.1
    assert len(alone) > len(near) > 0


def filmed(height):
    """Two frames of a plate that comes from beside a bed and goes down to a height, its way, and the plate."""
    setup = paper().resized(0.05)
    beside = (0.4, -0.2, 0.36)  # at rest its shadow falls outside of the bed
    path = np.array([beside, (0.4, 0.27, 0.36), (0.4, 0.27, height)])
    way = ToolMotion(np.array([0, 10, 20]), np.array([0.0, 0.2, 0.4]), path, np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)))
    made = setup.experiment()
    bed = Bed(np.zeros(3), np.array([0.8, 0.55, 0.3]), density=1600.0)
    views = tuple(Frame(camera, Path(), "view") for camera in setup.views[:4])
    video = tuple(f for f in made.video if f.frame <= 20 and (f.camera_name, f.frame) != ("right", 10))
    return (
        replace(made, bed=bed, tool=replace(setup.tool, motion=way), views=views, video=video),
        way,
        ToolBody(setup.tool.mesh),
    )


def test_what_the_tool_may_have_moved_tells_nothing_of_the_light(monkeypatch: pytest.MonkeyPatch):
    _, (_, _, _, relief, _), _ = seen(20.0, 50.0, 0.5)
    measurement, _, body = filmed(0.13)

    def grey(points, *_):
        return torch.full((len(points), 3), 0.5), torch.full((len(points),), 5)

    given = {}
    monkeypatch.setattr(estimate, "seen_colours", grey)
    monkeypatch.setattr(estimate, "fit_light", lambda points, *_, **told: given.update(told, points=points))
    estimate_light(measurement, relief, body)
    moved = torch.isnan(given["moved_shadows"][-1].change).all(dim=1)
    assert torch.equal(moved, ~untouched(measurement, given["points"], relief, body, [20])[20])
    assert 0.01 < moved.float().mean() < 0.5
    assert torch.isfinite(given["moved_shadows"][0].change).all()


def test_the_video_tells_the_light(monkeypatch: pytest.MonkeyPatch):
    """Colours by the light at each frame's own pose, through cameras whose exposures drift apart."""
    truth, (_, _, shape, relief, _), _ = seen(20.0, 50.0, 0.5)
    measurement, way, body = filmed(0.21)
    albedo = 0.5 * np.exp(0.1 * gaussian_filter(np.random.default_rng(1).normal(size=shape), 3.0) / 0.1).reshape(-1, 1)
    asked = []

    def colours(where, frames, relief, tool):
        (moment,) = {0 if f.frame is None else f.frame for f in frames}
        assert np.allclose(np.array(tool.position), way.pose(moment / 50.0)[1], atol=1e-6)
        names = {f.camera_name for f in frames}
        asked.append((moment, tuple(sorted(names))))
        light = shade(relief, truth, tool).irradiance(where, 0.001)
        spots = torch.tensor(np.resize(albedo, (len(where), 1)))
        drift = 1.0 + 0.02 * moment / 10 * (1.0 if names == {"left"} else -1.0)
        return (light * spots * drift).float(), torch.full((len(where),), 5)

    monkeypatch.setattr(estimate, "seen_colours", colours)
    found = estimate_light(measurement, relief, body)
    assert off(found, truth) < 2.0
    assert np.allclose(found.ambient, truth.ambient, atol=0.04)
    assert {(10, ("left",)), (20, ("left",)), (20, ("right",))} <= set(asked) and (10, ("right",)) not in asked


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cpu_and_cuda_read_the_same_light(plow_dry: Path):
    measurement = Measurement.load(plow_dry)
    with np.load(plow_dry / "truth_particles.npz") as truth:
        soil, spacing = torch.tensor(truth["f000"] * truth["scale"], dtype=torch.float32), float(truth["spacing"])
    found = []
    for device in ("cpu", "cuda:0"):
        relief = relief_of_particles(soil.to(device), spacing, measurement.bed.lower, measurement.bed.upper)
        found.append(estimate_light(measurement, relief, ToolBody(measurement.tool.mesh, device)))
    assert np.allclose(found[0].direction, found[1].direction, atol=2e-3)
    assert np.allclose(found[0].ambient, found[1].ambient, atol=2e-3)
