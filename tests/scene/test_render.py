"""Pictures of small scenes against what geometry says, and true particles against real frames."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from splatsoil.comparison import PATCH, Comparator
from splatsoil.measurement import Bed, Camera, Measurement
from splatsoil.reconstruction import HeightField
from splatsoil.scene import (
    Light,
    Relief,
    ToolBody,
    bind,
    build_scene,
    encoded,
    kernels,
    kernels_horizon,
    kernels_relief,
    kernels_visible,
    linear,
    relief_of_particles,
    render,
    seen_colours,
    still_frames,
)
from splatsoil.splats import Gaussians
from splatsoil.splats.steps import finished
from splatsoil.splats.warp_torch import as_warp, launch
from splatsoil.synthetic.setups import look_at

SPACING = 0.02
BED = Bed(np.zeros(3), np.array([0.4, 0.4, 0.2]), 1600.0)
SUN = Light.from_angles(180.0, 45.0, [0.4, 0.5, 0.6])
ALBEDO = torch.tensor([0.5, 0.4, 0.3])
TOOL = np.array([0.1, 0.2, 0.6])


def level_bed(height=0.1):
    axis = np.arange(SPACING / 2, 0.4, SPACING)
    levels = np.arange(SPACING / 2, height, SPACING)
    grid = np.stack(np.meshgrid(axis, axis, levels, indexing="ij"), axis=-1)
    return torch.tensor(grid.reshape(-1, 3), dtype=torch.float32)


@pytest.fixture
def scene_of(scene_on):
    """Makes a scene on particles, with a tool of a mesh."""
    return lambda particles, mesh=None: scene_on(particles, SPACING, BED, SUN, ALBEDO, mesh, TOOL)


def camera(eye=(0.2, -0.35, 0.6), target=(0.2, 0.2, 0.1), size=(120, 90)):
    return Camera(size[0], size[1], 150.0, 150.0, size[0] / 2, size[1] / 2, look_at(eye, target), model="PINHOLE")


def pixel(view, point):
    (u, v), _ = (a[0] for a in view.project([point]))
    return int(v), int(u)


def test_level_soil_shows_its_albedo(scene_of):
    bed, view = level_bed(), camera()
    image = scene_of(bed).render(bed, None, None, view)
    assert np.allclose(image[pixel(view, (0.2, 0.2, 0.1))], encoded(ALBEDO).numpy(), atol=0.01)


def test_sides_that_are_seen_are_drawn_in_their_own_light(scene_of):
    """A wall's picture from beside it: soil's albedo in the side's light, down to the floor and up to the surface."""
    bed, view = level_bed(), camera(eye=(0.2, -0.6, 0.12), target=(0.2, 0.0, 0.05))
    hidden = scene_of(bed)
    light = np.full((4, 3), 0.9)
    light[2] = [0.3, 0.4, 0.5]  # the side at the least y
    image = hidden.replace(side_light=light).render(bed, None, None, view)
    for height in (0.01, 0.03, 0.05):  # nearer to the side than to the surface, two layers in
        shown = linear(torch.tensor(image[pixel(view, (0.2, 0.0, height))])).numpy()
        assert np.allclose(shown, ALBEDO.numpy() * light[2], rtol=0.15)
    assert np.all(image[pixel(view, (0.2, 0.0, -0.02))] < 0.02)
    through = linear(torch.tensor(hidden.render(bed, None, None, view)[pixel(view, (0.2, 0.0, 0.03))])).numpy()
    assert not np.allclose(through, ALBEDO.numpy() * light[2], rtol=0.15)
    # Soil that sinks at the wall is seen to: the surface's own light falls on what is left of it.
    sunk = bed.clone()
    sunk[:, 2] *= 0.5
    lower = hidden.replace(side_light=light).render(sunk, None, None, view)
    assert np.allclose(linear(torch.tensor(lower[pixel(view, (0.2, 0.0, 0.02))])), ALBEDO.numpy() * light[2], rtol=0.1)
    above = linear(torch.tensor(lower[pixel(view, (0.2, 0.0, 0.085))])).numpy()
    assert not np.allclose(above, ALBEDO.numpy() * light[2], rtol=0.1)


def test_soil_in_the_shadow_of_a_box_keeps_the_sky_alone(scene_of):
    bed, view = level_bed(), camera()
    box = trimesh.creation.box((0.08, 0.08, 0.02))
    # 0.15 m above the soil under a sun at 45 degrees over -x: the shadow's middle is 0.15 m further along +x
    scene = scene_of(bed, mesh=box)
    image = scene.render(bed, None, (np.eye(3), np.array([0.12, 0.2, 0.25])), view)
    shade = linear(torch.tensor(image[pixel(view, (0.27, 0.2, 0.1))])).numpy()
    expected = ALBEDO.numpy() * SUN.ambient
    assert np.all(np.abs(shade / expected - 1.0) < 0.12)
    lit = linear(torch.tensor(image[pixel(view, (0.37, 0.1, 0.1))])).numpy()
    assert np.all(np.abs(lit / ALBEDO.numpy() - 1.0) < 0.08)


def test_tool_hides_soil_and_soil_hides_tool(scene_of):
    bed, view = level_bed(), camera()
    box = trimesh.creation.box((0.1, 0.02, 0.1))
    scene = scene_of(bed, mesh=box)
    for depth, shows in ((0.16, True), (0.04, False)):
        centre = (0.2, 0.2, depth)
        image = scene.render(bed, None, (np.eye(3), np.array(centre)), view)
        colour = image[pixel(view, (0.2, 0.19, depth))]
        assert (colour[2] > colour[0]) == shows


@pytest.mark.parametrize(("opacity", "shows"), [(0.1, True), (0.4, True), (0.6, False), (0.9, False)])
def test_half_of_the_light_decides_what_is_seen_of_a_tool_behind_a_veil(scene_of, opacity, shows):
    """A plate that soil stands against from behind; the veil is far before it, so that the mean depth is, too."""
    bed, view = level_bed(), camera()
    behind = bed[bed[:, 1] > 0.21] + torch.tensor([0.0, 0.0, 0.1])
    scene = scene_of(torch.cat([bed, behind]), mesh=trimesh.creation.box((0.3, 0.004, 0.14)))
    posed = scene.pose(scene.soil.particles, None, (np.eye(3), np.array([0.2, 0.2, 0.15])))
    point = np.array([0.2, 0.198, 0.17])
    veil = torch.tensor(0.5 * (point + view.position), dtype=torch.float32)[None]
    posed = replace(
        posed,
        centres=torch.cat([posed.centres, veil]),
        covariances=torch.cat([posed.covariances, 0.01 * torch.eye(3)[None]]),
        opacities=torch.cat([posed.opacities, torch.tensor([opacity])]),
        features=torch.cat([posed.features, torch.tensor([[1.0, 0.0, 0.0, 0.0]])]),
        nearest=torch.cat([posed.nearest, torch.tensor(point, dtype=torch.float32)[None]]),
    )
    share = scene.layers(posed, view).tool[..., 3][pixel(view, point)]
    assert float(share) == float(shows)


def test_what_lies_before_a_tool_is_told_by_its_nearest_point(scene_of):
    """Of a plate larger than the distance to it: on either side, and past its edges."""
    scene = scene_of(level_bed(), mesh=trimesh.creation.box((0.3, 0.004, 0.14)))
    posed = scene.pose(scene.soil.particles, None, (np.eye(3), np.array([0.2, 0.2, 0.15])))
    low, high = np.array([0.05, 0.198, 0.08]), np.array([0.35, 0.202, 0.22])
    exact = np.clip(posed.centres.numpy(), low, high)
    near = np.linalg.norm(posed.centres.numpy() - [0.2, 0.2, 0.15], axis=1) < 0.5 * np.linalg.norm(high - low)
    outside = near & (np.linalg.norm(exact - posed.centres.numpy(), axis=1) > 1e-6)
    assert outside.sum() > 100
    assert np.allclose(posed.nearest.numpy()[outside], exact[outside], atol=1e-5)


def test_background_is_seen_past_the_bed(scene_of):
    bed, view = level_bed(), camera()
    scene = scene_of(bed).replace(background=np.array([0.2, 0.3, 0.4]))
    assert np.allclose(scene.render(bed, None, None, view)[0, 0], [0.2, 0.3, 0.4], atol=1e-6)


def test_lifting_all_soil_is_moving_the_camera_down(scene_of):
    bed = level_bed()
    scene = scene_of(bed)
    lifted = scene.render(bed + torch.tensor([0.0, 0.0, 0.03]), None, None, camera())
    lowered = scene.render(bed, None, None, camera((0.2, -0.35, 0.57), (0.2, 0.2, 0.07)))
    middle = np.s_[30:60, 40:80]
    assert np.abs(lifted[middle] - lowered[middle]).max() < 0.02


def test_other_particles_carry_the_same_picture(scene_of):
    bed, view = level_bed(), camera()
    generator = torch.Generator().manual_seed(3)
    other = bed + 0.3 * SPACING * (torch.rand(bed.shape, generator=generator) - 0.5)
    scene = scene_of(bed)
    again = scene.with_particles(other)
    assert len(again.grain_albedo) == len(other)
    assert np.abs(again.render(other, None, None, view) - scene.render(bed, None, None, view)).mean() < 0.02


def test_kernels_compile_for_cuda(tmp_path):
    """NVRTC comes with Warp, so a compiler error shows without a GPU; sm_90 is an H100 or H200."""
    for module in (kernels, kernels_relief, kernels_horizon, kernels_visible):
        (artifact,) = wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
        assert ".entry" in Path(artifact).read_text()


def test_views_that_are_drawn_together_are_those_drawn_alone(scene_of):
    """With the tool elsewhere in each, so that other windows are drawn around it, and not at all in one."""
    bed, view = level_bed(), camera()
    scene = scene_of(bed, mesh=trimesh.creation.box((0.08, 0.08, 0.02)))
    tools = [(np.eye(3), np.array(place)) for place in ([0.12, 0.2, 0.105], [0.22, 0.2, 0.13])]
    moments = scene.poses([(bed, None, tool) for tool in (*tools, None)])
    views = [(moments[0], view), (moments[1], view), (moments[2], view), (moments[1], camera((0.3, -0.3, 0.5)))]
    together = finished(scene._layering(views)).image
    alone = scene.pictures([*views, (moments[0], view.scaled(0.5))])
    assert np.allclose(together, np.stack(alone[:4]), atol=1e-6)
    assert alone[4].shape == (view.height // 2, view.width // 2, 3)
    assert np.array_equal(alone[4], scene.picture(moments[0], view.scaled(0.5)))
    assert len({picture.tobytes() for picture in alone[:4]}) == 4


def test_no_gaussian_reaches_out_of_the_soil():
    """On a slope: those that did lie flat within it, as thin as at rest and as wide along it as before; the others stay
    as they are. Particles' own are flat beneath the surface and round far below."""
    slope = np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0)
    x = torch.arange(0.005, 0.4, 0.01).expand(40, 40)
    relief = Relief.of_heights(0.1 + 0.3 * x, (0.005, 0.005), (0.01, 0.01))
    generator = np.random.default_rng(1)
    count, thin = 200, 0.001
    place = generator.uniform(0.05, 0.35, (count, 3))
    depth = generator.uniform(-0.005, 0.03, count)
    place[:, 2] = 0.1 + 0.3 * place[:, 0]
    place -= depth[:, None] * slope
    turned = Rotation.random(count, random_state=2).as_matrix()
    shapes = turned @ np.diag([0.006, 0.004, thin]) ** 2 @ turned.transpose(0, 2, 1)
    tensors = [
        torch.tensor(t, dtype=torch.float32) for t in (place, shapes, np.full(count, thin), generator.random(count))
    ]
    albedo = torch.tensor(generator.random((count, 3)), dtype=torch.float32)
    out = [torch.zeros(count - 20, *shape) for shape in ((3,), (3, 3), (), (4,))]
    chosen = torch.arange(20, count, dtype=torch.int32)
    first = [relief.surface, as_warp(torch.zeros(0, 6), wp.float32), as_warp(chosen, wp.int32)]
    carried = [render.visible_form(tensors[0], tensors[1], tensors[3]), as_warp(albedo, wp.vec3)]
    drawn = [2.0, render.visible_form(*out)]
    launch(kernels_visible.settle, count - 20, [*first, *carried, as_warp(tensors[2], wp.float32), *drawn], albedo)
    centres, covariances, opacities, features = (t.double().numpy() for t in out)
    before, left = shapes[20:], depth[20:]
    across = np.sqrt(np.einsum("i,nij,j->n", slope, before, slope))
    reached = left < 2.0 * across
    assert 20 < reached.sum() < 160
    assert np.allclose(centres[~reached], place[20:][~reached], atol=1e-6)
    assert np.allclose(covariances[~reached], before[~reached], atol=1e-10)
    flat = covariances[reached]
    assert np.allclose(flat @ slope, thin**2 * slope, atol=1e-9)
    along = np.eye(3) - np.outer(slope, slope)
    assert np.allclose(along @ flat @ along, along @ before[reached] @ along, atol=1e-9)
    ends = (0.1 + 0.3 * centres[:, 0] - centres[:, 2]) * slope[2]
    assert np.allclose(ends[reached], np.maximum(left[reached], 2.0 * thin), atol=1e-6)
    assert np.array_equal(opacities, tensors[3].double().numpy()[20:]) and np.all(features[:, 3] == 1.0)
    assert np.array_equal(features[:, :3], albedo.double().numpy()[20:])

    sizes = SPACING * np.array([render.PARTICLE_SIZE, render.PARTICLE_THICKNESS, render.BURIED_SIZE])
    particles = [as_warp(tensors[0], wp.vec3), as_warp(albedo, wp.vec3), wp.vec3(*sizes)]
    launch(kernels_visible.grains, count - 20, [*first, *particles, 2.0, 0.95, drawn[1]], albedo)
    centres, covariances, opacities, _ = (t.double().numpy() for t in out)
    deep = left > 2.0 * render.BURIED_SIZE * SPACING
    assert 5 < deep.sum() < 175 and np.allclose(centres, place[20:], atol=1e-6) and np.allclose(opacities, 0.95)
    sizes = np.sqrt(np.linalg.eigvalsh(covariances)) / SPACING
    assert np.allclose(sizes[deep], render.BURIED_SIZE, atol=1e-4)
    assert np.allclose(sizes[~deep], [render.PARTICLE_THICKNESS, render.PARTICLE_SIZE, render.PARTICLE_SIZE], atol=1e-4)
    assert np.allclose(covariances[~deep] @ slope, (render.PARTICLE_THICKNESS * SPACING) ** 2 * slope, atol=1e-9)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cpu_and_cuda_agree(scene_of):
    bed, view, box = level_bed(), camera(), trimesh.creation.box((0.08, 0.08, 0.02))
    scene = scene_of(bed, mesh=box)
    pose = (np.eye(3), np.array([0.12, 0.2, 0.2]))
    there = scene.replace(
        soil=bind(scene.soil.rest.cuda(), scene.soil.covariances.cuda(), bed.cuda(), SPACING),
        soil_opacity=scene.soil_opacity.cuda(),
        soil_albedo=scene.soil_albedo.cuda(),
        grain_albedo=scene.grain_albedo.cuda(),
        surroundings=scene.surroundings.to("cuda:0"),
        tool=ToolBody(box, "cuda:0"),
    )
    difference = np.abs(scene.render(bed, None, pose, view) - there.render(bed, None, pose, view))
    assert difference.mean() < 1e-4
    assert np.quantile(difference, 0.999) < 0.02


def coloured_surface(measurement, particles, spacing, cell=0.004):
    """A reconstruction's stand-in: flat Gaussians on the particles' surface, coloured by the photographs."""
    relief = relief_of_particles(particles, spacing, measurement.bed.lower, measurement.bed.upper)
    low, high = measurement.bed.lower, measurement.bed.upper
    axes = [torch.arange(low[k] + cell / 2, high[k], cell, dtype=torch.float32) for k in (1, 0)]
    y, x = torch.meshgrid(*axes, indexing="ij")
    flat = torch.stack([x.reshape(-1), y.reshape(-1)], dim=1)
    points = torch.cat([flat, relief.sample(relief.height, flat)[:, None]], dim=1)
    motion = measurement.tool.motion
    body = ToolBody(measurement.tool.mesh)
    colours, _ = seen_colours(points, still_frames(measurement), relief, body.at(*motion.pose(float(motion.times[0]))))
    colours = torch.where(torch.isfinite(colours), colours, torch.nanmedian(colours, dim=0).values)
    normal = torch.nn.functional.normalize(relief.sample(relief.normal, points), dim=1)
    turn = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], torch.zeros(len(points))], dim=1)
    scales = torch.tensor([0.6, 0.6, 0.1]).mul(cell).expand(len(points), 3).contiguous()
    gaussians = Gaussians(points, scales, turn, torch.full((len(points),), 0.9), encoded(colours))
    soil = torch.ones(len(points), dtype=torch.bool)
    return SimpleNamespace(gaussians=gaussians, soil=soil, tool=~soil, background=(0.0, 0.0, 0.0), container="bin")


@pytest.mark.parametrize("turned", [0.0, 40.0, 90.0])
def test_soil_ends_at_its_surface_when_seen_at_a_grazing_angle(turned, scene_of):
    """A camera looks over level soil, 5° down at its far edge: where that is in the picture, geometry says. Soil that
    was turned over and stretched (what a Gaussian lay flat on stands up now) ends there, too."""
    particles = level_bed()
    scene = scene_of(particles)
    stretched = Rotation.from_euler("x", turned, degrees=True).as_matrix() @ np.diag([1.0, 1.8, 0.6])
    deformations = None if turned == 0.0 else np.tile(stretched, (len(particles), 1, 1))
    over = 0.1 + 0.8 * np.tan(np.radians(5.0))
    view = camera((0.2, -0.4, over), (0.2, 0.4, 0.1)).scaled(4.0)
    image = scene.render(particles, deformations, None, view)
    ((_, edge),), _ = view.project(np.array([[0.2, 0.4, 0.1]]))
    column = image[:, 220:260].mean(axis=(1, 2))
    bright = np.median(column[int(edge) + 12 : int(edge) + 32])
    first = int(np.argmax(column > 0.5 * bright))
    seen = first + 0.5 - (column[first] - 0.5 * bright) / (column[first] - column[first - 1])
    # A pixel is 1.3 mm, a fifteenth of a particle's spacing.
    assert seen == pytest.approx(edge, abs=1.5)


def test_nothing_shines_through_a_steep_wall(scene_of):
    """Soil on one half of the bed, as high as five layers of particles that lie at random: its cut face shows soil
    alone, whatever stands behind."""
    bed = level_bed()
    half = bed[bed[:, 1] > 0.2]
    particles = half + 0.25 * SPACING * torch.tensor(np.random.default_rng(0).uniform(-1.0, 1.0, half.shape)).float()
    blue = Gaussians(
        torch.tensor([[0.2, 0.5, 0.05]]),
        torch.tensor([[0.3, 0.01, 0.3]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([0.99]),
        torch.tensor([[0.0, 0.0, 1.0]]),
    )
    scene = scene_of(half).with_particles(particles).replace(surroundings=blue)
    view = camera((0.2, -0.3, 0.12), (0.2, 0.2, 0.06)).scaled(2.0)
    layers = scene.layers(scene.pose(particles, None, None), view)
    face = np.array(
        [pixel(view, (x, 0.2, z)) for x in np.linspace(0.06, 0.34, 57) for z in np.linspace(0.02, 0.08, 13)]
    )
    seen = layers.colour.numpy()[face[:, 0], face[:, 1]]
    assert np.allclose(seen, encoded(ALBEDO).numpy(), atol=0.05)


@pytest.mark.slow
def test_true_particles_look_like_the_measured_frames():
    """The renderer's floor, apart from any physics: an independent simulator's particles, its path-traced frames.

    The bound is well below what is left when light or motion are wrong: both controls must exceed twice the floor.
    """
    folder = Path(os.environ.get("SPLATSOIL_EXAMPLES", Path(__file__).parents[2] / "examples")) / "plow-dry"
    measurement = Measurement.load(folder)
    stored = np.load(folder / "truth_particles.npz")
    frames = (0, 50, 100, 150, 199)
    true = {f: (stored[f"f{f:03d}"] * float(stored["scale"])).astype(np.float32) for f in frames}
    start, spacing = torch.tensor(true[0]), float(stored["spacing"])
    reconstruction = coloured_surface(measurement, start, spacing)
    scene = build_scene(reconstruction, measurement, start, spacing)
    # the sun as its shadow shows it in the photographs, measured by hand: azimuth 145, elevation 53 degrees
    assert abs(scene.light.azimuth - 145.0) < 3.0
    assert abs(scene.light.elevation - 53.0) < 3.0
    level = float(relief_of_particles(start, spacing, measurement.bed.lower, measurement.bed.upper).height.mean())
    bed = measurement.bed
    surface = HeightField.over(bed.lower, bed.upper, PATCH, level)
    comparator = Comparator(measurement, surface=surface, frames=frames)

    def loss(scene, particles):
        images = {}
        for frame in frames:
            pose = measurement.tool.motion.pose(frame / measurement.frame_rate)
            posed = scene.pose(particles[frame], None, pose)
            for name, view in measurement.cameras.items():
                images[name, frame] = scene.picture(posed, view)
        return comparator.compare(images)

    floor = loss(scene, true)
    assert floor.loss < 0.11
    assert floor.rgb < 85e-5
    baked = scene.replace(light=Light(scene.light.direction, np.ones(3), scene.light.level))
    assert loss(baked, true).loss > 2.0 * floor.loss
    late = dict(zip(frames, (true[0], true[0], true[50], true[100], true[150]), strict=True))
    assert loss(scene, late).loss > 2.0 * floor.loss
