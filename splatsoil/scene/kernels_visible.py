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
    end: float,
    centres_out: wp.array(dtype=wp.vec3),
    covariances_out: wp.array(dtype=wp.mat33),
    opacities_out: wp.array(dtype=wp.float32),
    features_out: wp.array(dtype=wp.vec4),
) -> None:
    """Soil's Gaussians, laid flat and moved in where one reaches out of the surface by its ``end`` standard deviations.

    Soil that is sheared turns and stretches what it carries, so that flat Gaussians stand up in it, and seen along the
    ground a heap would end pixels too late. Those that reach out are laid flat again, as thin as at rest.
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
    if depth < end * wp.sqrt(wp.max(across, 0.0)):
        mixed = wp.outer(normal, along)
        shape = shape - mixed - wp.transpose(mixed) + (across + thin * thin) * wp.outer(normal, normal)
        c = c - wp.max(end * thin - depth, 0.0) * normal
    centres_out[k] = c
    covariances_out[k] = shape
    opacities_out[k] = opacities[i]
    features_out[k] = wp.vec4(albedo[i][0], albedo[i][1], albedo[i][2], 1.0)


@wp.kernel(enable_backward=False)
def grains(
    height: wp.array2d(dtype=wp.float32),
    normals: wp.array2d(dtype=wp.vec3),
    origin: wp.vec2,
    cell: wp.vec2,
    chosen: wp.array(dtype=wp.int32),
    positions: wp.array(dtype=wp.vec3),
    albedo: wp.array(dtype=wp.vec3),
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
    so deep that a round one of the standard deviation ``buried`` ends, by ``end`` of these, beneath it all the same."""
    k = wp.tid()
    i = chosen[k]
    x = positions[i]
    here = _blended(height, normals, origin, cell, x)
    normal = wp.normalize(wp.vec3(here[0], here[1], here[2]))
    one = wp.identity(n=3, dtype=wp.float32)
    shape = along * along * one - (along * along - across * across) * wp.outer(normal, normal)
    if (here[3] - x[2]) * here[2] > end * buried:
        shape = buried * buried * one
    centres_out[k] = x
    covariances_out[k] = shape
    opacities_out[k] = opacity
    features_out[k] = wp.vec4(albedo[i][0], albedo[i][1], albedo[i][2], 1.0)
