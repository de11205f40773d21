# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels that make the Gaussians of one moment that can be seen: those that soil carries, and particles' own."""

import warp as wp

from splatsoil.scene.kernels_relief import place_of


@wp.func
def _blended(
    height: wp.array2d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    origin: wp.vec2,
    cell: wp.vec2,
    point: wp.vec3,
) -> wp.vec4:
    """Normal, not of unit length, and height over or under a point; constant beyond the outermost cells' centres."""
    place = place_of(point[0], point[1], origin, cell, height.shape[0], height.shape[1])
    i = int(place[0])
    j = int(place[1])
    u = place[2]
    v = place[3]
    low = normals[i, j] * (1.0 - v) + normals[i, j + 1] * v
    high = normals[i + 1, j] * (1.0 - v) + normals[i + 1, j + 1] * v
    normal = low * (1.0 - u) + high * u
    near = height[i, j] * (1.0 - v) + height[i, j + 1] * v
    far = height[i + 1, j] * (1.0 - v) + height[i + 1, j + 1] * v
    return wp.vec4(normal[0], normal[1], normal[2], near * (1.0 - u) + far * u)


@wp.func
def _side(sides: wp.array2d(dtype=float), point: wp.vec3, depth: float) -> int:
    """Which of the bed's sides a point lies nearer to than to the surface that it lies ``depth`` beneath; -1 for none.

    Sides are rows of outward x and y, distance from the origin along these, and light.
    """
    nearest = int(-1)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
    least = float(depth)
    for k in range(sides.shape[0]):
        distance = sides[k, 2] - sides[k, 0] * point[0] - sides[k, 1] * point[1]
        if distance < least:
            nearest = k
            least = distance
    return nearest


@wp.func
def _linear(srgb: float) -> float:
    return wp.where(srgb <= 0.04045, srgb / 12.92, wp.pow((wp.max(srgb, 0.04045) + 0.055) / 1.055, 2.4))


@wp.func
def _encoded(colour: float) -> float:
    root = 1.055 * wp.pow(wp.max(colour, 0.0031308), 1.0 / 2.4) - 0.055
    return wp.where(colour <= 0.0031308, colour * 12.92, root)


@wp.func
def _lit(albedo: wp.vec3, sides: wp.array2d(dtype=float), side: int) -> wp.vec4:
    """Albedo, and 1 for soil that a picture's light is yet to fall on; or colour in its side's light, and 0."""
    out = wp.vec4(albedo[0], albedo[1], albedo[2], 1.0)
    if side >= 0:
        for c in range(3):
            out[c] = _encoded(_linear(albedo[c]) * sides[side, 3 + c])
        out[3] = 0.0
    return out


@wp.kernel(enable_backward=False)
def settle(
    height: wp.array2d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    origin: wp.vec2,
    cell: wp.vec2,
    chosen: wp.array(dtype=wp.int32),
    centres: wp.array(dtype=wp.vec3),
    covariances: wp.array(dtype=wp.mat33),
    thickness: wp.array(dtype=wp.float32),
    opacities: wp.array(dtype=wp.float32),
    albedo: wp.array(dtype=wp.vec3),
    sides: wp.array2d(dtype=float),
    end: float,
    centres_out: wp.array(dtype=wp.vec3),
    covariances_out: wp.array(dtype=wp.mat33),
    opacities_out: wp.array(dtype=wp.float32),
    features_out: wp.array(dtype=wp.vec4),
) -> None:
    """Soil's Gaussians, laid flat and moved in where one reaches out of the surface by its ``end`` standard deviations.

    Soil that is sheared turns and stretches what it carries, so that flat Gaussians stand up in it, and seen along the
    ground a heap would end pixels too late. Those that reach out are laid flat again, as thin as at rest. At sides that
    are seen nothing heaves, and they stay as they are.
    """
    k = wp.tid()
    i = chosen[k]
    c = centres[i]
    shape = covariances[i]
    thin = thickness[i]
    here = _blended(height, normals, origin, cell, c)
    normal = wp.normalize(wp.vec3(here[0], here[1], here[2]))
    along = shape * normal
    across = wp.dot(along, normal)
    depth = (here[3] - c[2]) * here[2]
    side = _side(sides, c, depth)
    if side < 0 and depth < end * wp.sqrt(wp.max(across, 0.0)):
        mixed = wp.outer(normal, along)
        shape = shape - mixed - wp.transpose(mixed) + (across + thin * thin) * wp.outer(normal, normal)
        c = c - wp.max(end * thin - depth, 0.0) * normal
    centres_out[k] = c
    covariances_out[k] = shape
    opacities_out[k] = opacities[i]
    features_out[k] = _lit(albedo[i], sides, side)


@wp.kernel(enable_backward=False)
def grains(
    height: wp.array2d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    origin: wp.vec2,
    cell: wp.vec2,
    chosen: wp.array(dtype=wp.int32),
    positions: wp.array(dtype=wp.vec3),
    albedo: wp.array(dtype=wp.vec3),
    sides: wp.array2d(dtype=float),
    along: float,
    across: float,
    buried: float,
    end: float,
    opacity: float,
    centres_out: wp.array(dtype=wp.vec3),
    covariances_out: wp.array(dtype=wp.mat33),
    opacities_out: wp.array(dtype=wp.float32),
    features_out: wp.array(dtype=wp.vec4),
) -> None:
    """Particles' own Gaussians: flat along the surface over them, by two standard deviations, and round where they lie
    so deep that a round one of the standard deviation ``buried`` ends, by ``end`` of these, beneath it all the same. At
    sides that are seen they are flat along these."""
    k = wp.tid()
    i = chosen[k]
    x = positions[i]
    here = _blended(height, normals, origin, cell, x)
    normal = wp.normalize(wp.vec3(here[0], here[1], here[2]))
    one = wp.identity(n=3, dtype=wp.float32)
    depth = (here[3] - x[2]) * here[2]
    side = _side(sides, x, depth)
    if side >= 0:
        normal = wp.vec3(sides[side, 0], sides[side, 1], 0.0)
        depth = sides[side, 2] - wp.dot(normal, x)
    shape = along * along * one - (along * along - across * across) * wp.outer(normal, normal)
    if depth > end * buried:
        shape = buried * buried * one
    centres_out[k] = x
    covariances_out[k] = shape
    opacities_out[k] = opacity
    features_out[k] = _lit(albedo[i], sides, side)
