# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels of the Gaussians of one moment: those bound to the soil, and one for each particle near its surface."""

import warp as wp

from splatsoil.scene.kernels_maps import Surface, height_at, sample


@wp.struct
class Visible:
    """Gaussians that can be seen: centres, covariances, opacities, and features (albedo, and 1 for soil that a
    picture's light is yet to fall on)."""

    centres: wp.array(dtype=wp.vec3)
    covariances: wp.array(dtype=wp.mat33)
    opacities: wp.array(dtype=wp.float32)
    features: wp.array(dtype=wp.vec4)


@wp.func
def _over(surface: Surface, point: wp.vec3) -> wp.vec4:
    """The surface's unit normal over a point, and how deep the point lies beneath, measured along it."""
    normal = sample(surface.normal, surface.grid, point[0], point[1])
    unit = wp.normalize(normal)
    return wp.vec4(unit[0], unit[1], unit[2], (height_at(surface, point[0], point[1]) - point[2]) * normal[2])


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
    surface: Surface,
    sides: wp.array2d(dtype=float),
    chosen: wp.array(dtype=wp.int32),
    soil: Visible,
    albedo: wp.array(dtype=wp.vec3),
    thickness: wp.array(dtype=wp.float32),
    end: float,
    out: Visible,
) -> None:
    """Soil's Gaussians, laid flat and moved in where one reaches out of the surface by its ``end`` standard deviations.

    Soil that is sheared turns and stretches what it carries, so that flat Gaussians stand up in it, and seen along the
    ground a heap would end pixels too late. Those that reach out are laid flat again, as thin as at rest. At sides that
    are seen nothing heaves, and they stay as they are.
    """
    k = wp.tid()
    i = chosen[k]
    c = soil.centres[i]
    shape = soil.covariances[i]
    thin = thickness[i]
    over = _over(surface, c)
    normal = wp.vec3(over[0], over[1], over[2])
    along = shape * normal
    across = wp.dot(along, normal)
    side = _side(sides, c, over[3])
    if side < 0 and over[3] < end * wp.sqrt(wp.max(across, 0.0)):
        mixed = wp.outer(normal, along)
        shape = shape - mixed - wp.transpose(mixed) + (across + thin * thin) * wp.outer(normal, normal)
        c = c - wp.max(end * thin - over[3], 0.0) * normal
    out.centres[k] = c
    out.covariances[k] = shape
    out.opacities[k] = soil.opacities[i]
    out.features[k] = _lit(albedo[i], sides, side)


@wp.kernel(enable_backward=False)
def grains(
    surface: Surface,
    sides: wp.array2d(dtype=float),
    chosen: wp.array(dtype=wp.int32),
    positions: wp.array(dtype=wp.vec3),
    albedo: wp.array(dtype=wp.vec3),
    sizes: wp.vec3,
    end: float,
    opacity: float,
    out: Visible,
) -> None:
    """Particles' own Gaussians, of standard deviations ``sizes``: flat along the surface over them, by the first two,
    and round, by the third, where they lie so deep that this ends, by ``end`` of it, beneath the surface all the same.
    At sides that are seen they are flat along these."""
    k = wp.tid()
    i = chosen[k]
    x = positions[i]
    over = _over(surface, x)
    normal = wp.vec3(over[0], over[1], over[2])
    depth = over[3]
    one = wp.identity(n=3, dtype=wp.float32)
    side = _side(sides, x, depth)
    if side >= 0:
        normal = wp.vec3(sides[side, 0], sides[side, 1], 0.0)
        depth = sides[side, 2] - wp.dot(normal, x)
    shape = sizes[0] * sizes[0] * one - (sizes[0] * sizes[0] - sizes[1] * sizes[1]) * wp.outer(normal, normal)
    if depth > end * sizes[2]:
        shape = sizes[2] * sizes[2] * one
    out.centres[k] = x
    out.covariances[k] = shape
    out.opacities[k] = opacity
    out.features[k] = _lit(albedo[i], sides, side)
