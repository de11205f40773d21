"""Light on simple surfaces against closed forms."""

import math

import numpy as np
import pytest
import torch
import trimesh

from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.scene import Light, Relief, ToolBody, encoded, linear, shade
from splatsoil.scene.shading import sun_visibility_at
from splatsoil.synthetic import stage as synthetic

CELL = 0.005


def surface(height, size=(120, 160)):
    """A relief of height(x, y) around the origin."""
    y, x = np.meshgrid(*((np.arange(count) - count / 2) * CELL for count in size), indexing="ij")
    values = torch.tensor(np.broadcast_to(height(x, y), x.shape).copy(), dtype=torch.float32)
    return Relief.of_heights(values, (float(x[0, 0]), float(y[0, 0])), (CELL, CELL))


NONE = ToolBody(None).absent()
OVERHEAD = Light.from_angles(0.0, 90.0, 0.5)


def at(relief, values, x, y):
    return float(relief.sample(values, torch.tensor([[x, y]])))


def test_srgb_encoding_matches_the_standard():
    # IEC 61966-2-1: the middle grey of sRGB 118 is 18.1 % linear; black, white and the break are fixed points
    assert float(linear(torch.tensor(118 / 255))) == pytest.approx(0.1812, abs=2e-4)
    values = torch.linspace(0.0, 1.0, 101)
    assert torch.allclose(linear(encoded(values)), values, atol=1e-6)
    assert torch.allclose(encoded(torch.tensor([0.0, 0.0031308, 1.0])), torch.tensor([0.0, 0.04045, 1.0]), atol=1e-5)


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.4])
def test_plane_is_lit_by_lamberts_law(slope):
    relief = surface(lambda x, y: slope * x)
    light = Light.from_angles(30.0, 50.0, [0.3, 0.5, 0.7])
    lit = shade(relief, light, NONE)
    normal = np.array([-slope, 0.0, 1.0]) / math.hypot(slope, 1.0)
    direct = normal @ light.direction / light.direction[2]
    expected = light.ambient + (1.0 - light.ambient) * direct
    assert np.allclose(lit.irradiance(torch.tensor([[0.0, 0.0, 0.0]])).numpy()[0], expected, atol=5e-3)


@pytest.mark.parametrize("distance", [0.03, 0.06, 0.12])
def test_sky_over_ground_before_a_long_wall(distance):
    # View factor of a level patch to an endless strip that ends at elevation t: (1 - cos t) / 2.
    wall = 0.08
    relief = surface(lambda x, y: np.where(x > 0.0, wall, 0.0), (400, 160))
    lit = shade(relief, OVERHEAD, NONE)
    elevation = math.atan2(wall, distance)
    # 12 directions and steps of a fifth cost up to 0.025; no occlusion at all would be off by 0.32, 0.2 and 0.08
    assert at(relief, lit.sky_visibility, -distance, 0.0) == pytest.approx(0.5 * (1 + math.cos(elevation)), abs=0.03)
    assert float(lit.tool_occlusion.max()) == 0.0


def test_sky_under_a_plate():
    # View factor of a level patch to a parallel square plate of half side a, straight above at height h.
    a, h = 0.06, 0.05
    plate = ToolBody(trimesh.creation.box((2 * a, 2 * a, 0.004)))
    relief = surface(lambda x, y: 0.0 * x)
    hidden = shade(relief, OVERHEAD, plate.at(np.eye(3), (0.0, 0.0, h + 0.002))).tool_occlusion
    s = a / h
    quarter = 2 * s / math.sqrt(1 + s * s) * math.atan(s / math.sqrt(1 + s * s)) / (2 * math.pi)
    # steps of a fifth lose up to a tenth of the plate's reach
    assert at(relief, hidden, 0.0, 0.0) == pytest.approx(4 * quarter, abs=0.08)
    assert at(relief, hidden, 0.35, 0.0) < 0.02


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 40.0), (120.0, 55.0), (-75.0, 30.0)])
def test_shadow_of_a_box_lands_where_geometry_says(azimuth, elevation):
    side, lift = 0.04, 0.06
    box = ToolBody(trimesh.creation.box((side, side, side)))
    light = Light.from_angles(azimuth, elevation, 0.5)
    lit = shade(surface(lambda x, y: 0.0 * x), light, box.at(np.eye(3), (0.0, 0.0, lift)))
    generator = np.random.default_rng(0)
    points = np.concatenate([generator.uniform(-0.25, 0.25, (4000, 2)), np.zeros((4000, 1))], axis=1)
    # Slab test of the ray towards the sun against the box, in closed form.
    lower, upper = np.array([-side / 2] * 2 + [lift - side / 2]), np.array([side / 2] * 2 + [lift + side / 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.stack([(lower - points) / light.direction, (upper - points) / light.direction])
    margin = crossings.max(axis=0).min(axis=1) - crossings.min(axis=0).max(axis=1)
    sun, places = (torch.tensor(v, dtype=torch.float32) for v in (light.direction[None], points))
    shadow = sun_visibility_at(lit.relief, lit.tool, sun, places, 0.0)[0].numpy()
    clear = np.abs(margin) > 0.002
    assert (margin > 0.002).sum() > 30
    assert np.array_equal(shadow[clear] < 0.5, margin[clear] > 0)


def test_shadow_of_a_step_ends_at_height_over_tangent():
    height, elevation = 0.06, 35.0
    relief = surface(lambda x, y: np.where(x < 0.0, height, 0.0))
    lit = shade(relief, Light.from_angles(180.0, elevation, 0.5), NONE)
    row = lit.sun_visibility[60].numpy()
    x = relief.points[60, :, 0].numpy()
    dark = x[(row < 0.5) & (x > 0.0)]
    assert dark.max() == pytest.approx(height / math.tan(math.radians(elevation)), abs=1.5 * CELL)
    assert np.all(row[(x > 0.01) & (x < 0.07)] < 0.05)


def test_trench_walls_light_each_other_in_the_soils_colour():
    trench = surface(lambda x, y: np.where(np.abs(x) < 0.03, -0.08, 0.0))
    light = Light.from_angles(0.0, 60.0, 0.5, level=np.array([0.6, 0.4, 0.2]))
    lit = shade(trench, light, NONE)
    inside = lit.relief.sample(lit.interreflection, torch.tensor([[0.0, 0.0]]))[0]
    outside = lit.relief.sample(lit.interreflection, torch.tensor([[0.25, 0.0]]))[0]
    assert float(inside[0]) > 0.05
    assert float(outside[0]) < 0.01
    # more than in proportion to the colour: light that has been back and forth has it twice
    assert float(inside[0] / inside[2]) > 3.0


def test_a_bowl_lights_itself_as_a_piece_of_a_sphere_does():
    # Every place of a sphere sees every other alike: of a part f of it under an even sky, each place sends back
    # reflectance times f times what it gets, to each place, and so on (integrating sphere).
    radius, f = 0.15, 0.4
    lowest = 2.0 * radius * f
    middle = radius - lowest
    rim = math.sqrt(radius**2 - middle**2)

    def bowl(x, y):
        r2 = x**2 + y**2
        return np.where(r2 < rim**2, middle - np.sqrt(np.maximum(radius**2 - r2, 0.0)), 0.0)

    lit = shade(surface(bowl), Light.from_angles(0.0, 60.0, 1.0), NONE)
    reflected = 0.4 * f
    for x, y in ((0.0, 0.0), (0.04, 0.02), (-0.03, 0.08)):
        assert at(lit.relief, lit.interreflection[..., 1].contiguous(), x, y) == pytest.approx(
            (1.0 - f) * reflected / (1.0 - reflected), rel=0.05
        )


def test_a_trench_in_the_sun_against_the_path_tracer():
    """Slopes that face each other, one in the sun and one in shade: each gets the other's light, not the mean's."""
    depth, albedo, azimuth, elevation = 0.06, 0.4, 0.0, 50.0
    trench = surface(lambda x, y: np.minimum(1.2 * np.abs(x) - depth, 0.0))
    light = Light.from_angles(azimuth, elevation, 0.4, level=np.full(3, albedo))
    lit = shade(trench, light, NONE)
    points, (ny, nx) = trench.points.reshape(-1, 3).double().numpy(), trench.height.shape
    first = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).reshape(-1)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + nx], 1), np.stack([first + 1, first + nx + 1, first + nx], 1)]
    )
    normals = trench.normal.reshape(-1, 3).double().numpy()
    body = synthetic.Body(points, faces, normals, np.full((len(points), 3), albedo))
    sun = 0.6 / math.sin(math.radians(elevation))
    stage = synthetic.Stage([body], synthetic.Light.from_angles(azimuth, elevation, sun, 0.4), ground=-0.1)
    above = np.eye(4)
    above[2, 3] = 4.0
    pixels = 61
    camera = Camera(pixels, 3, 4.0 / CELL, 4.0 / CELL, pixels / 2, 1.5, above)
    traced = stage.radiance(camera, seed=1, side=24)[1, :, 1] / albedo
    across = (np.arange(pixels) - pixels // 2) * CELL
    ours = lit.irradiance(torch.tensor(np.stack([across, 0.0 * across, 0.0 * across], 1), dtype=torch.float32))
    shaded, sunlit = (np.abs(across - side * 0.025) < 0.012 for side in (1.0, -1.0))
    assert traced[shaded].max() < 0.45 < 1.05 < traced[sunlit].min()  # as meant
    # with light from the mean of both slopes it was 0.05 too little in the shade and 0.08 too much in the sun
    assert np.mean((ours[:, 1].numpy() - traced)[shaded]) == pytest.approx(0.0, abs=0.02)
    assert np.mean((ours[:, 1].numpy() - traced)[sunlit]) == pytest.approx(0.0, abs=0.02)


def test_impossible_lights_are_refused():
    with pytest.raises(ParameterError, match="horizon"):
        Light(np.array([1.0, 0.0, 0.0]), np.full(3, 0.5))
    with pytest.raises(ParameterError, match="ambient"):
        Light(np.array([0.0, 0.0, 1.0]), np.full(3, 1.5))
