# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels of shading, shadows and the tool; the same source runs on CPU and CUDA.

Every kernel is a gather: each thread writes its own outputs, so results do not depend on the order of threads.
"""

# ruff: noqa: UP018 - Warp takes a bare literal for a constant, so what a loop changes starts as float(...)

from __future__ import annotations

import warp as wp

from splatsoil.scene.kernels_horizon import scan_horizon
from splatsoil.scene.kernels_maps import Maps, Surface, ToolPose, cell_centre, height_at, outward, sample

STEEP, STEEPEST = wp.constant(0.7), wp.constant(0.5)
"""Upward parts of normals (45°, 60°) between which a surface's slope is less and less that of its heights."""

SUN_SOFTNESS = wp.constant(0.0047)
"""Tangent of the sun's angular radius."""


@wp.struct
class Illumination:
    """Sun and sky (see ``light.Light``), what level ground and the tool's shaded side send back, and the tool's
    colour."""

    sun: wp.vec3
    ambient: wp.vec3
    ground: wp.vec3
    side: wp.vec3
    tool: wp.vec3


@wp.struct
class Pixels:
    """What splats say of each pixel (depth, share of soil, and alpha of those before the tool), and what is found for
    it: light on its soil, and the tool's radiance times its share of the pixel with that share."""

    depth: wp.array2d(dtype=wp.float32)
    before: wp.array2d(dtype=wp.float32)
    soil: wp.array2d(dtype=wp.float32)
    light: wp.array2d(dtype=wp.vec3)
    tool: wp.array2d(dtype=wp.vec4)


@wp.func
def near_tool(tool: ToolPose, origin: wp.vec3, direction: wp.vec3, margin: float) -> bool:
    """Whether a ray of unit direction passes within a margin of the sphere around the tool."""
    if tool.mesh == wp.uint64(0):
        return False
    to = tool.centre - origin
    along = wp.dot(to, direction)
    radius = tool.radius + margin
    return wp.dot(to, to) - along * along <= radius * radius and along >= -radius


@wp.func
def tool_hit(tool: ToolPose, origin: wp.vec3, direction: wp.vec3, reach: float) -> float:
    """Distance at which a ray meets the tool, or -1."""
    if not near_tool(tool, origin, direction, 0.0):
        return -1.0
    back = wp.transpose(tool.rotation)
    query = wp.mesh_query_ray(tool.mesh, back * (origin - tool.position), back * direction, reach)
    if query.result:
        return query.t
    return -1.0


@wp.kernel(enable_backward=False)
def nearest_of_tool(tool: ToolPose, points: wp.array(dtype=wp.vec3), nearest: wp.array(dtype=wp.vec3)) -> None:
    """The tool's point nearest to each point; of points outside of the sphere around it, that sphere's middle."""
    k = wp.tid()
    nearest[k] = tool.centre
    if tool.mesh != wp.uint64(0) and wp.length(points[k] - tool.centre) < tool.radius:
        local = wp.transpose(tool.rotation) * (points[k] - tool.position)
        query = wp.mesh_query_point_no_sign(tool.mesh, local, 2.0 * tool.radius)
        if query.result:
            found = wp.mesh_eval_position(tool.mesh, query.face, query.u, query.v)
            nearest[k] = tool.rotation * found + tool.position


@wp.func
def tool_normal(tool: ToolPose, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """World normal of the face that a ray is known to meet, turned towards the ray's origin."""
    back = wp.transpose(tool.rotation)
    query = wp.mesh_query_ray(tool.mesh, back * (origin - tool.position), back * direction, 1.0e3)
    normal = tool.rotation * query.normal
    return wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)


@wp.func
def soil_shadow(surface: Surface, point: wp.vec3, sun: wp.vec3) -> float:
    """Share of the sun (0 to 1) that the soil's surface lets through to a point; soft by the sun's width."""
    open_share = float(1.0)
    flat = wp.sqrt(sun[0] * sun[0] + sun[1] * sun[1])
    if flat < 1.0e-4:
        return open_share
    ray = sun / flat
    r = float(surface.step)
    z = point[2] + r * ray[2]
    while z < surface.top and open_share > 0.0:
        gap = z - height_at(surface, point[0] + r * ray[0], point[1] + r * ray[1])
        # A cell's worth of blur near the blocker, the sun's own width farther out.
        width = SUN_SOFTNESS * r + 0.35 * surface.step
        open_share = wp.min(open_share, wp.clamp(0.5 + 0.5 * gap / width, 0.0, 1.0))
        r += surface.step
        z = point[2] + r * ray[2]
    return open_share


@wp.kernel(enable_backward=False)
def tool_columns(
    surface: Surface, tool: ToolPose, ceiling: float, floor: float, columns: wp.array2d(dtype=wp.vec2)
) -> None:
    """Lowest and highest point of the tool over each cell; the former higher where there is none."""
    i, j = wp.tid()
    x = cell_centre(surface, i, j)
    columns[i, j] = wp.vec2(1.0e6, -1.0e6)
    down = tool_hit(tool, wp.vec3(x[0], x[1], ceiling), wp.vec3(0.0, 0.0, -1.0), ceiling - floor)
    if down >= 0.0:
        up = tool_hit(tool, wp.vec3(x[0], x[1], floor), wp.vec3(0.0, 0.0, 1.0), ceiling - floor)
        columns[i, j] = wp.vec2(floor + wp.max(up, 0.0), ceiling - down)


@wp.kernel(enable_backward=False)
def sun_visibility(surface: Surface, light: Illumination, visible: wp.array2d(dtype=wp.float32)) -> None:
    """Share of the sun that the soil lets through to each cell."""
    i, j = wp.tid()
    visible[i, j] = soil_shadow(surface, cell_centre(surface, i, j), light.sun)


@wp.func
def tool_shadow(tool: ToolPose, sun: wp.vec3, point: wp.vec3, spread: float) -> float:
    """Share of the sun that the tool lets through to a patch of half width ``spread`` around a point."""
    if not near_tool(tool, point, sun, spread + 1.0e-3):
        return 1.0
    lit = float(0.0)
    for k in range(4):
        sx = wp.where(k % 2 == 0, -0.5, 0.5)
        sy = wp.where(k < 2, -0.5, 0.5)
        # A turned square covers more distinct edges' positions than an upright one.
        shift = wp.vec3(0.8 * sx - 0.6 * sy, 0.6 * sx + 0.8 * sy, 0.0) * spread
        if tool_hit(tool, point + shift + sun * 1.0e-3, sun, 1.0e3) < 0.0:
            lit += 0.25
    return lit


@wp.kernel(enable_backward=False)
def sun_visibility_at(
    points: wp.array(dtype=wp.vec3),
    spread: float,
    surface: Surface,
    suns: wp.array(dtype=wp.vec3),
    tool: ToolPose,
    visible: wp.array2d(dtype=wp.float32),
) -> None:
    """Share of each of some suns that soil and tool let through to any points on the soil."""
    k, p = wp.tid()
    share = tool_shadow(tool, suns[k], points[p], spread)
    if share > 0.0:
        share *= soil_shadow(surface, points[p], suns[k])
    visible[k, p] = share


@wp.kernel(enable_backward=False)
def points_seen(
    points: wp.array(dtype=wp.vec3),
    eye: wp.vec3,
    surface: Surface,
    tool: ToolPose,
    slack: float,
    seen: wp.array(dtype=wp.float32),
) -> None:
    """1 where neither soil (by more than ``slack``) nor tool stands between a point and the eye, else 0."""
    p = wp.tid()
    distance = wp.length(eye - points[p])
    direction = wp.normalize(eye - points[p])
    seen[p] = 0.0
    if tool_hit(tool, points[p] + direction * 1.0e-3, direction, distance) >= 0.0:
        return
    r = float(surface.step)
    q = points[p] + direction * r
    while r < distance and q[2] < surface.top:
        if q[2] + slack < height_at(surface, q[0], q[1]):
            return
        r += surface.step
        q = points[p] + direction * r
    seen[p] = 1.0


@wp.struct
class Eye:
    """A pinhole: world from camera (OpenCV axes), position, focal lengths and principal point in pixels."""

    rotation: wp.mat33
    position: wp.vec3
    fx: float
    fy: float
    cx: float
    cy: float


@wp.func
def pixel_ray(eye: Eye, u: float, v: float) -> wp.vec3:
    """Direction through a point of the image, with length 1 along the camera's axis."""
    return eye.rotation * wp.vec3((u - eye.cx) / eye.fx, (v - eye.cy) / eye.fy, 1.0)


@wp.func
def surface_depth(surface: Surface, origin: wp.vec3, ray: wp.vec3) -> float:
    """Depth at which a ray from above first falls beneath the surface, or -1 where it leaves its map before.

    Far above the surface the steps are as long as slopes of 1.2 allow; steeper ones are met a little late.
    """
    if ray[2] >= -1.0e-3:
        return -1.0
    z = wp.max((surface.top - origin[2]) / ray[2], 0.0)
    x = origin + ray * z
    gap = x[2] - height_at(surface, x[0], x[1])
    if gap < 0.0:
        return -1.0
    shortest = 0.5 * surface.step / wp.length(ray)
    closing = 1.0 / (1.2 * wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1]) - ray[2])
    while gap >= 0.0:
        stride = wp.max(shortest, gap * closing)
        z += stride
        x = origin + ray * z
        above = gap
        gap = x[2] - height_at(surface, x[0], x[1])
        if gap < 0.0:
            # Between two points that straddle the surface: regula falsi, with halved weights (Illinois) for walls.
            before = z - stride
            for _ in range(4):
                stride = (z - before) * above / (above - gap)
                x = origin + ray * (before + stride)
                middle = x[2] - height_at(surface, x[0], x[1])
                if middle < 0.0:
                    z = before + stride
                    gap = middle
                    above *= 0.5
                else:
                    before += stride
                    above = middle
                    gap *= 0.5
            # Beyond its map it goes on level.
            u = (origin[0] + ray[0] * z - surface.grid.x0) * surface.grid.inverse_x + 0.5
            v = (origin[1] + ray[1] * z - surface.grid.y0) * surface.grid.inverse_y + 0.5
            rows = float(surface.height.shape[0])
            inside = u >= 0.0 and v >= 0.0 and u <= float(surface.height.shape[1]) and v <= rows
            return wp.where(inside, z, -1.0)
    return -1.0


@wp.kernel(enable_backward=False)
def illuminate(
    first: int,
    eye: Eye,
    surface: Surface,
    maps: Maps,
    light: Illumination,
    tool: ToolPose,
    pixels: Pixels,
) -> None:
    """For each pixel: the light on the soil it shows; the tool's radiance times its share of the pixel, and that share.

    The splats say that a pixel shows soil; light is looked up where the pixel's ray meets the surface, however far
    behind their depth, because blobs end a little before or behind it, and at a rim their mean depth lies in the air,
    over a trench's floor where what is seen is its far wall. Where heights say that it is steep, and there is any
    density ``filling``, it slopes as that says, and what it sees around it is looked for from there: a wall falls from
    one cell to the next, so that maps don't tell how it stands, nor what it sees.
    """
    pixel = first + wp.tid()
    i = pixel // pixels.depth.shape[1]
    j = pixel - i * pixels.depth.shape[1]
    ray = pixel_ray(eye, float(j) + 0.5, float(i) + 0.5)
    one = wp.vec3(1.0, 1.0, 1.0)
    z = pixels.depth[i, j]
    pixels.light[i, j] = one
    pixels.tool[i, j] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if pixels.soil[i, j] > 0.01 and z > 0.0:
        found = surface_depth(surface, eye.position, ray)
        if found > 0.0:
            z = found
        x = eye.position + ray * z
        shade = sample(maps.shades, surface.grid, x[0], x[1])
        n = wp.normalize(wp.vec3(shade[0], shade[1], shade[2]))
        sky = shade[3]
        back = wp.vec3(shade[5], shade[6], shade[7])
        steep = wp.clamp((STEEP - n[2]) / (STEEP - STEEPEST), 0.0, 1.0)
        if steep > 0.0 and found > 0.0 and surface.filling.shape[0] > 0:
            n = wp.normalize(n + steep * (outward(surface, x) - n))
            seen = scan_horizon(surface, maps, tool, x, n)
            # The tool takes the share of its sky that it takes of the cell's.
            taken = sample(maps.tool_occlusion, surface.grid, x[0], x[1])
            by_tool = seen.sky * taken / wp.max(taken + shade[3], 1.0e-3)
            sky += steep * (seen.sky - by_tool - sky)
            back += steep * (seen.light + by_tool * light.side - back)
        direct = wp.max(wp.dot(n, light.sun), 0.0) / light.sun[2]
        if direct > 0.0:
            sunny = shade[4]
            if sunny > 0.01 and sunny < 0.99:
                # An edge of a shadow, or a wall too steep for a map: look from the point itself.
                sunny = soil_shadow(surface, x, light.sun)
            direct *= sunny
        if direct > 0.0:
            direct *= tool_shadow(tool, light.sun, x, 0.5 * z / eye.fx)
        pixels.light[i, j] = light.ambient * sky + (one - light.ambient) * direct + back
    axis = wp.normalize(ray)
    # A pixel's corner lies less than 1.5 of its width off its axis.
    if not near_tool(tool, eye.position, axis, 1.5 * (wp.length(tool.centre - eye.position) + tool.radius) / eye.fx):
        return
    # Soil is opaque: what shines through between its Gaussians is not there.
    if pixels.before[i, j] > 0.5:
        return
    share = float(0.0)
    radiance = wp.vec3(0.0, 0.0, 0.0)
    for k in range(4):
        sx = wp.where(k % 2 == 0, -0.25, 0.25)
        sy = wp.where(k < 2, -0.25, 0.25)
        fine = pixel_ray(eye, float(j) + 0.5 + 0.8 * sx - 0.6 * sy, float(i) + 0.5 + 0.6 * sx + 0.8 * sy)
        way = wp.normalize(fine)
        t = tool_hit(tool, eye.position, way, 1.0e3)
        if t >= 0.0:
            share += 0.25
            point = eye.position + way * t
            n = tool_normal(tool, eye.position, way)
            sky = 0.5 * (1.0 + n[2])
            direct = wp.max(wp.dot(n, light.sun), 0.0) / light.sun[2]
            if direct > 0.0:
                direct *= soil_shadow(surface, point, light.sun)
                if tool_hit(tool, point + n * 1.0e-4, light.sun, 1.0e3) >= 0.0:
                    direct = 0.0
            lit = light.ambient * sky + (one - light.ambient) * direct + light.ground * (1.0 - sky)
            radiance += 0.25 * wp.cw_mul(light.tool, lit)
    pixels.tool[i, j] = wp.vec4(radiance[0], radiance[1], radiance[2], share)


@wp.kernel(enable_backward=False)
def silhouette(eye: Eye, tool: ToolPose, shows: wp.array2d(dtype=wp.uint8)) -> None:
    """1 for each pixel whose middle would show the tool if nothing hid it."""
    i, j = wp.tid()
    ray = wp.normalize(pixel_ray(eye, float(j) + 0.5, float(i) + 0.5))
    shows[i, j] = wp.uint8(wp.where(tool_hit(tool, eye.position, ray, 1.0e3) >= 0.0, 1, 0))
