"""Path-tracing kernel: triangles over an infinite ground, under a sun and a uniform sky.

Radiance is counted in units in which an even sky of radiance A lights a level plane with A, so that a diffuse surface
sends back albedo times what falls on it, without factors of pi.
"""

from __future__ import annotations

import warp as wp

BOUNCES = wp.constant(3)
"""Surfaces a path may meet. Light over more of them is left out: albedo⁴ of that in a closed hollow, 3 % for sand."""
MOST_ROUNDS = wp.constant(8)
"""Rounds of paths for pixels whose light is uncertain after the first: shade with many surfaces around."""
UNCERTAINTY = wp.constant(0.08)
"""Standard error of a pixel's light, as a share of it, that asks for no further round. It is reckoned as if the paths
were independent; being spread evenly, they err by a third of it or less."""
FAR = wp.constant(1.0e4)
LIFT = wp.constant(2.0e-4)
"""Rays start this far above the surface they leave, m: more than rounding, less than can be seen."""
GOLDEN = wp.constant(0.6180339887)


@wp.struct
class Stage:
    """All that can be seen, and its light.

    Attributes:
        mesh: triangles with a ray tree.
        corners: (3 m,) vertices of the triangles.
        normals: (n,) shading normals, unit.
        colours: (n,) albedo, linear.
        grain: (n,) contrast of a fine pattern that is fixed in the world.
        ground: height of the ground, m.
        ground_colour: its albedo, linear.
        ground_grain: contrast of its pattern.
        sun_direction: unit vector to the sun.
        sun_across: vectors to the sun's edge, at right angles to its direction and to each other.
        sun: light of the sun on a surface that faces it.
        sky: light of the whole sky on a level plane, and its radiance.
        pattern: seed of the fine patterns.
    """

    mesh: wp.uint64
    corners: wp.array(dtype=int)
    normals: wp.array(dtype=wp.vec3)
    colours: wp.array(dtype=wp.vec3)
    grain: wp.array(dtype=float)
    ground: float
    ground_colour: wp.vec3
    ground_grain: float
    sun_direction: wp.vec3
    sun_across: wp.vec3
    sun_along: wp.vec3
    sun: wp.vec3
    sky: wp.vec3
    pattern: int


@wp.struct
class Hit:
    """Where a ray ends: shading and geometric normal face the side it came from."""

    found: bool
    point: wp.vec3
    normal: wp.vec3
    face: wp.vec3
    albedo: wp.vec3


@wp.func
def grain_factor(stage: Stage, point: wp.vec3, contrast: float) -> float:
    """What the fine pattern multiplies an albedo with: two octaves of noise, 25 and 7 mm long."""
    if contrast <= 0.0:
        return 1.0
    state = wp.rand_init(stage.pattern)
    value = wp.noise(state, point / 0.025) + 0.7 * wp.noise(state, point / 0.007)
    return wp.max(1.0 + contrast * value, 0.0)


@wp.func
def first_hit(stage: Stage, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """The nearest surface along a ray."""
    hit = Hit()
    hit.found = False
    reach = FAR
    if direction[2] < 0.0:
        down = (stage.ground - origin[2]) / direction[2]
        if down > 0.0 and down < FAR:
            reach = down
            hit.found = True
    query = wp.mesh_query_ray(stage.mesh, origin, direction, reach)
    if query.result:
        hit.found = True
        hit.point = origin + query.t * direction
        a = stage.corners[3 * query.face]
        b = stage.corners[3 * query.face + 1]
        c = stage.corners[3 * query.face + 2]
        u = query.u
        v = query.v
        w = 1.0 - u - v
        hit.normal = wp.normalize(u * stage.normals[a] + v * stage.normals[b] + w * stage.normals[c])
        hit.face = query.normal
        if wp.dot(hit.face, direction) > 0.0:
            hit.face = -hit.face
        if wp.dot(hit.normal, hit.face) < 0.0:
            hit.normal = -hit.normal
        contrast = u * stage.grain[a] + v * stage.grain[b] + w * stage.grain[c]
        hit.albedo = u * stage.colours[a] + v * stage.colours[b] + w * stage.colours[c]
        hit.albedo = hit.albedo * grain_factor(stage, hit.point, contrast)
    elif hit.found:
        hit.point = origin + reach * direction
        hit.normal = wp.vec3(0.0, 0.0, 1.0)
        hit.face = hit.normal
        hit.albedo = stage.ground_colour * grain_factor(stage, hit.point, stage.ground_grain)
    return hit


@wp.func
def around(normal: wp.vec3, u: float, v: float) -> wp.vec3:
    """A direction about a unit normal, as likely as its cosine, from two numbers in [0, 1)."""
    # Basis without branches: Duff et al. (2017), "Building an Orthonormal Basis, Revisited".
    sign = wp.where(normal[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + normal[2])
    b = normal[0] * normal[1] * a
    across = wp.vec3(1.0 + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0])
    along = wp.vec3(b, sign + normal[1] * normal[1] * a, -normal[1])
    radius = wp.sqrt(u)
    turn = 2.0 * wp.pi * v
    return wp.normalize(
        radius * wp.cos(turn) * across + radius * wp.sin(turn) * along + wp.sqrt(wp.max(1.0 - u, 0.0)) * normal
    )


@wp.func
def sunlight(stage: Stage, hit: Hit, u: float, v: float) -> wp.vec3:
    """Direct light of the sun at a surface, from a point of its disc given by two numbers in [0, 1)."""
    radius = wp.sqrt(u)
    turn = 2.0 * wp.pi * v
    direction = wp.normalize(
        stage.sun_direction + radius * wp.cos(turn) * stage.sun_across + radius * wp.sin(turn) * stage.sun_along
    )
    cosine = wp.dot(hit.normal, direction)
    if cosine <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if wp.mesh_query_ray_anyhit(stage.mesh, hit.point + LIFT * hit.face, direction, FAR):
        return wp.vec3(0.0, 0.0, 0.0)
    return cosine * stage.sun


@wp.func
def fraction(value: float) -> float:
    """What stands behind the point."""
    return value - wp.floor(value)


@wp.func
def radiance(stage: Stage, eye: wp.vec3, towards: wp.vec3, u: float, v: float, state: wp.uint32) -> wp.vec4:
    """Light that arrives at the eye along one path, whose first turn u and v steer; last the light without colour.

    The fourth number is what falls on the first surface (green), so that a pattern is not taken for noise.
    """
    origin = eye
    direction = towards
    through = wp.vec3(1.0, 1.0, 1.0)
    light = wp.vec3(0.0, 0.0, 0.0)
    first = wp.float32(1.0)
    for bounce in range(BOUNCES):
        hit = first_hit(stage, origin, direction)
        if not hit.found:
            light += wp.cw_mul(through, stage.sky)
            break
        through = wp.cw_mul(through, hit.albedo)
        if bounce == 0:
            first = wp.max(hit.albedo[1], 1.0e-6)
        light += wp.cw_mul(through, sunlight(stage, hit, wp.randf(state), wp.randf(state)))
        turn_u = wp.randf(state)
        turn_v = wp.randf(state)
        if bounce == 0:
            turn_u = u
            turn_v = v
        direction = around(hit.normal, turn_u, turn_v)
        if wp.dot(direction, hit.face) <= 0.0:
            break
        origin = hit.point + LIFT * hit.face
        if bounce == BOUNCES - 1:
            # The sky of the last surface is still counted; light from further surfaces is not.
            last = first_hit(stage, origin, direction)
            if not last.found:
                light += wp.cw_mul(through, stage.sky)
    return wp.vec4(light[0], light[1], light[2], light[1] / first)


@wp.func
def one_round(
    stage: Stage,
    eye: wp.vec3,
    directions: wp.array2d(dtype=wp.vec3),
    row: int,
    column: int,
    side: int,
    state: wp.uint32,
) -> wp.vec4:
    """side² paths from the strata of a pixel: the sum of their light, and the standard error of its mean, relative."""
    shift_u = wp.randf(state)
    shift_v = wp.randf(state)
    upper_left = directions[row, column]
    upper_right = directions[row, column + 1]
    lower_left = directions[row + 1, column]
    lower_right = directions[row + 1, column + 1]
    count = float(side * side)
    total = wp.vec3(0.0, 0.0, 0.0)
    brightness = wp.float32(0.0)
    squares = wp.float32(0.0)
    for i in range(side):
        for j in range(side):
            x = (float(j) + wp.randf(state)) / float(side)
            y = (float(i) + wp.randf(state)) / float(side)
            towards = wp.normalize(wp.lerp(wp.lerp(upper_left, upper_right, x), wp.lerp(lower_left, lower_right, x), y))
            # A lattice over the hemisphere, shifted for each pixel, is less noisy than independent directions.
            number = float(i * side + j)
            u = fraction((number + 0.5) / count + shift_u)
            v = fraction(number * GOLDEN + shift_v)
            seen = radiance(stage, eye, towards, u, v, state + wp.uint32(i * side + j))
            total += wp.vec3(seen[0], seen[1], seen[2])
            brightness += seen[3]
            squares += seen[3] * seen[3]
    mean = brightness / count
    spread = wp.sqrt(wp.max(squares / count - mean * mean, 0.0) / count) / wp.max(mean, 1.0e-6)
    return wp.vec4(total[0], total[1], total[2], spread)


@wp.kernel
def trace(
    begin: int,
    stage: Stage,
    eye: wp.vec3,
    directions: wp.array2d(dtype=wp.vec3),
    width: int,
    side: int,
    seed: int,
    out: wp.array(dtype=wp.vec3),
) -> None:
    """One pixel: side² paths from the pixel's strata, and again as often as its shade is uncertain.

    Args:
        begin: number of this launch's first pixel.
        stage: what there is to see.
        eye: centre of projection.
        directions: (height + 1, width + 1) unit directions through the pixels' corners.
        width: pixels in a row.
        side: strata along a pixel's edges.
        seed: of the paths.
        out: (height · width,) mean radiance.
    """
    pixel = begin + wp.tid()
    row = pixel // width
    column = pixel - row * width
    state = wp.rand_init(seed, pixel)
    first = one_round(stage, eye, directions, row, column, side, state)
    total = wp.vec3(first[0], first[1], first[2])
    excess = first[3] / UNCERTAINTY
    rounds = wp.clamp(int(wp.ceil(excess * excess)), 1, MOST_ROUNDS)
    for k in range(1, rounds):
        more = one_round(stage, eye, directions, row, column, side, wp.rand_init(seed, pixel + k * 16777216))
        total += wp.vec3(more[0], more[1], more[2])
    out[pixel] = total / float(rounds * side * side)
