"""Kernels of a step: transfer from particles to grid and from grid to particles."""

from __future__ import annotations

import warp as wp

from splatsoil.mpm.compiler import OPTIONS
from splatsoil.mpm.grid import (
    Field,
    Grid,
    base_node,
    cell_of,
    corner_offset,
    corner_weight,
    field_at,
    field_beside,
    local_coordinates,
)
from splatsoil.mpm.state import Cells, Contacts, Nodes, Particles
from splatsoil.mpm.tool import FAR, Tool, distance_normal, signed_distance, tool_position, tool_rotation

wp.set_module_options(OPTIONS)

vec8 = wp.types.vector(length=8, dtype=float)

RUNAWAY = wp.constant(1.0e3)
"""Most that the visual deformation's norm comes to between two frames."""
AFFINE_SHARE = 7.0 / 16.0
"""Of a bilinear mode, what affine fields of eight particles in a cell carry over an exchange."""
HOURGLASS_DAMPING = (1.0 - AFFINE_SHARE) / (1.0 + AFFINE_SHARE)
SUBCELLS = wp.constant(4)
"""Along a cell's edge: pieces of which each counts as soil by its middle."""


def hourglass_share(exchanges: float) -> float:
    """What particles must keep of the hourglass modes for them to be damped as by this many plain APIC exchanges.

    With eight particles to a cell, affine fields alone carry 7/16 of a bilinear mode over an exchange. Under a steady
    force the mode's mean velocity is what the trapezoidal rule makes of that: (1 - q) / (1 + q) = 7/16, q = 9/23. Where
    it makes less, particles keep the reverse of the mode, against what affine fields carry.
    """
    carried = (1.0 - HOURGLASS_DAMPING * exchanges) / (1.0 + HOURGLASS_DAMPING * exchanges)
    return (carried - AFFINE_SHARE) / (1.0 - AFFINE_SHARE)


@wp.kernel(enable_backward=False)
def mark_cells(particles: Particles, cells: Cells, grid: Grid) -> None:
    """Mark every cell that holds a particle, and note for each particle the lowest node of its cell."""
    p = wp.tid()
    cell = cell_of(grid, particles.position[p])
    node = (p / particles.per_simulation) * grid.nodes + base_node(grid, cell)
    cells.slot[node] = 0
    particles.cell[p] = node


@wp.kernel(enable_backward=False)
def list_cells(cells: Cells) -> None:
    """Pack the marked cells."""
    node = wp.tid()
    if cells.slot[node] == 0:
        cells.node[wp.atomic_add(cells.count, 0, 1)] = node


@wp.kernel(enable_backward=False)
def number_cells(cells: Cells) -> None:
    """Write each active cell's entry back into the map and clear its sums."""
    entry = wp.tid()
    if entry < cells.count[0]:
        cells.slot[cells.node[entry]] = entry
        cells.volume[entry] = 0.0
        cells.normal[entry] = wp.vec3(0.0)
        cells.shear[entry] = wp.vec3(0.0)
        cells.elastic[entry] = 0.0
        cells.opening[entry] = 0.0
        if entry < cells.history.shape[0]:
            cells.history[entry] = wp.vec2(0.0)
            cells.depth[entry] = 0.0


@wp.kernel(enable_backward=False)
def particles_to_grid(particles: Particles, cells: Cells, nodes: Nodes, grid: Grid) -> None:
    """Add each particle's mass and momentum to nodes, its stress to its cell.

    A particle carries the whole trilinear field of velocity around it, not the affine part alone (APIC, Jiang et al.
    2015; PolyPIC, Fu et al. 2017): what it takes from the nodes it gives back to them, and an exchange loses nothing
    unless it is told to.
    """
    p = wp.tid()
    x = particles.position[p]
    f = local_coordinates(grid, x, cell_of(grid, x))
    base = particles.cell[p]
    entry = cells.slot[base]
    particles.cell[p] = entry
    wp.atomic_add(cells.volume, entry, 1.0)
    wp.atomic_add(cells.normal, entry, particles.normal[p])
    wp.atomic_add(cells.shear, entry, particles.shear[p])
    wp.atomic_add(cells.elastic, entry, particles.elastic[p])
    wp.atomic_add(cells.opening, entry, particles.opening[p])
    if p < particles.history.shape[0]:
        wp.atomic_add(cells.history, entry, particles.history[p])
        wp.atomic_add(cells.depth, entry, particles.depth[p])
    affine = particles.affine[p]
    bilinear = particles.bilinear[p]
    field = Field()
    field.value = particles.velocity[p]
    field.x = grid.cell[0] * wp.vec3(affine[0, 0], affine[1, 0], affine[2, 0])
    field.y = grid.cell[1] * wp.vec3(affine[0, 1], affine[1, 1], affine[2, 1])
    field.z = grid.cell[2] * wp.vec3(affine[0, 2], affine[1, 2], affine[2, 2])
    field.yz = wp.vec3(bilinear[0, 0], bilinear[1, 0], bilinear[2, 0])
    field.xz = wp.vec3(bilinear[0, 1], bilinear[1, 1], bilinear[2, 1])
    field.xy = wp.vec3(bilinear[0, 2], bilinear[1, 2], bilinear[2, 2])
    field.xyz = particles.trilinear[p]
    mass = particles.mass * particles.density[p]
    for corner in range(8):
        node = base + corner_offset(grid, corner)
        weight = mass * corner_weight(f, corner)
        offset = wp.vec3(float(corner >> 2), float((corner >> 1) & 1), float(corner & 1)) - f
        wp.atomic_add(nodes.mass, node, weight)
        wp.atomic_add(nodes.velocity, node, weight * field_beside(field, offset))


@wp.func
def mean_gradient(middle: wp.vec3, spread: wp.vec3, corner: int, inverse: wp.vec3) -> wp.vec3:
    """Mean gradient in 1/m of a corner's trilinear weight over soil whose local coordinates have the means ``middle``
    and whose products yz, xz and xy have the means ``spread``."""
    x, y, z = corner >> 2, (corner >> 1) & 1, corner & 1
    gradient = wp.vec3(
        mean_weight(middle[1], middle[2], spread[0], y, z),
        mean_weight(middle[0], middle[2], spread[1], x, z),
        mean_weight(middle[0], middle[1], spread[2], x, y),
    )
    return wp.cw_mul(wp.cw_mul(side_of(corner), inverse), gradient)


@wp.func
def side_of(corner: int) -> wp.vec3:
    """-1 or 1 along each axis."""
    x, y, z = corner >> 2, (corner >> 1) & 1, corner & 1
    return wp.vec3(2.0 * float(x) - 1.0, 2.0 * float(y) - 1.0, 2.0 * float(z) - 1.0)


@wp.func
def mean_weight(a: float, b: float, both: float, upper_a: int, upper_b: int) -> float:
    """Mean of a face's bilinear weight at one of its corners."""
    # on the side along a, and of that on the upper side along b
    whole = wp.where(upper_a == 1, a, 1.0 - a)
    above = wp.where(upper_a == 1, both, b - both)
    return wp.where(upper_b == 1, above, whole - above)


@wp.func
def packing(nodes: Nodes, grid: Grid, node: int, full: float) -> float:
    """Density at a node over that of the bulk, whose cells hold the mass ``full`` (kg); walls and floor mirror it."""
    local = node % grid.nodes
    iz = local % grid.shape[2]
    iy = (local / grid.shape[2]) % grid.shape[1]
    ix = local / (grid.shape[2] * grid.shape[1])
    mass = nodes.mass[node]
    if iz == 0:
        mass *= 2.0
    if ix == 0 or ix == grid.shape[0] - 1:
        mass *= 2.0
    if iy == 0 or iy == grid.shape[1] - 1:
        mass *= 2.0
    return mass / full


@wp.struct
class Soil:
    """What of a cell is soil: its share, and the means of local coordinates and of their products yz, xz and xy."""

    volume: float
    middle: wp.vec3
    spread: wp.vec3


@wp.func
def soil_of_cell(nodes: Nodes, grid: Grid, base: int, full: float) -> Soil:
    """Soil is where the nodes' density (trilinear) is above half of the bulk's: where the surface of level ground lies.

    So a cell within the soil is full, however its particles lie (Beuth, Wieckowski & Vermeer 2011). Counted by these,
    it would hold an eighth more or less whenever one of eight crosses its face, and flow would lose volume. A cell
    that the surface cuts is summed up by pieces, of which a plane may cut off a share.
    """
    above = vec8()
    slope = wp.vec3()
    for corner in range(8):
        above[corner] = packing(nodes, grid, base + corner_offset(grid, corner), full) - 0.5
        slope += 0.25 * above[corner] * side_of(corner)
    # by how much the density changes across a piece
    change = (wp.abs(slope[0]) + wp.abs(slope[1]) + wp.abs(slope[2])) / float(SUBCELLS) + 1.0e-6
    soil = Soil()
    if wp.min(above) >= 0.5 * change:
        soil.volume = 1.0
        soil.middle = wp.vec3(0.5)
        soil.spread = wp.vec3(0.25)
    else:
        for piece in range(SUBCELLS * SUBCELLS * SUBCELLS):
            x, y, z = piece / (SUBCELLS * SUBCELLS), (piece / SUBCELLS) % SUBCELLS, piece % SUBCELLS
            f = (wp.vec3(float(x), float(y), float(z)) + wp.vec3(0.5)) / float(SUBCELLS)
            value = wp.float32(0.0)
            for corner in range(8):
                value += corner_weight(f, corner) * above[corner]
            part = wp.clamp(0.5 + value / change, 0.0, 1.0) / float(SUBCELLS * SUBCELLS * SUBCELLS)
            soil.volume += part
            soil.middle += part * f
            soil.spread += part * wp.vec3(f[1] * f[2], f[0] * f[2], f[0] * f[1])
        soil.middle = soil.middle / wp.max(soil.volume, 1.0e-6)
        soil.spread = soil.spread / wp.max(soil.volume, 1.0e-6)
    return soil


@wp.kernel(enable_backward=False)
def average_cells(
    particles: Particles, cells: Cells, nodes: Nodes, grid: Grid, density: float, stiffness: float
) -> None:
    """Sums to means, and the part of each cell that is soil; ``stiffness`` = c (K + 4G/3) dt^2 turns a node's share of
    stiffness into the least stable inertia.

    Trilinear weights vanish at a cell's faces but their gradients do not, so a node reached only by the edge of a
    particle would be flung away by stress. The inertia bound is the central-difference limit node by node.
    """
    entry = wp.tid()
    if entry < cells.count[0]:
        share = 1.0 / cells.volume[entry]
        cells.normal[entry] = share * cells.normal[entry]
        cells.shear[entry] = share * cells.shear[entry]
        cells.elastic[entry] = share * cells.elastic[entry]
        cells.opening[entry] = share * cells.opening[entry]
        if entry < cells.history.shape[0]:
            cells.history[entry] = share * cells.history[entry]
            cells.depth[entry] = share * cells.depth[entry]
        capacity = grid.cell[0] * grid.cell[1] * grid.cell[2]
        base = cells.node[entry]
        soil = soil_of_cell(nodes, grid, base, density * capacity)
        cells.volume[entry] = soil.volume * capacity
        # loose grains bear nothing, but the tool may strike them
        stiff = stiffness * wp.max(cells.volume[entry], particles.volume / share)
        for corner in range(8):
            gradient = mean_gradient(soil.middle, soil.spread, corner, grid.inverse)
            cells.gradient[8 * entry + corner] = gradient
            wp.atomic_add(nodes.inertia, base + corner_offset(grid, corner), stiff * wp.length_sq(gradient))


@wp.kernel(enable_backward=False)
def momentum_to_velocity(nodes: Nodes) -> None:
    """Divide by mass, and pack the nodes that have any."""
    i = wp.tid()
    mass = nodes.mass[i]
    if mass > 0.0:
        nodes.velocity[i] = nodes.velocity[i] / mass
        nodes.inertia[i] = wp.max(nodes.inertia[i], mass)
        nodes.active[wp.atomic_add(nodes.count, 0, 1)] = i


@wp.kernel(enable_backward=False)
def find_gaps(
    particles: Particles, grid: Grid, tool: Tool, pose: wp.array(dtype=float), reach: float, contacts: Contacts
) -> None:
    """Distance and normal of each particle to the tool; those within ``reach`` (m) are listed as contacts.

    Trilinear weights carry contact up to a cell beyond the tool's edges, as if it were wider and deeper. So a corner
    counts by 1 - d / l: l is its way from the point of contact along the tangent plane, d how far off the tool it ends.
    """
    p = wp.tid()
    rotation = tool_rotation(pose)
    local = wp.quat_rotate_inv(rotation, particles.position[p] - tool_position(pose))
    gap = signed_distance(tool, local)
    particles.gap[p] = gap
    if gap < reach:
        outward = distance_normal(tool, local)
        particles.gap_normal[p] = wp.quat_rotate(rotation, outward)
        particles.drift[p] = wp.vec3(0.0)
        listed = wp.atomic_add(contacts.count, 0, 1)
        contacts.particle[listed] = p
        foot = local - gap * outward
        cell = cell_of(grid, particles.position[p])
        f = local_coordinates(grid, particles.position[p], cell)
        total = 0.0
        for corner in range(8):
            offset = wp.vec3(float(corner >> 2), float((corner >> 1) & 1), float(corner & 1)) - f
            aside = wp.quat_rotate_inv(rotation, wp.cw_mul(grid.cell, offset))
            aside -= wp.dot(aside, outward) * outward
            beyond = signed_distance(tool, foot + aside) / wp.max(wp.length(aside), 1.0e-9)
            share = corner_weight(f, corner) * wp.clamp(1.0 - beyond, 0.0, 1.0)
            contacts.weight[8 * listed + corner] = share
            total += share
        for corner in range(8):
            if total > 0.0:
                contacts.weight[8 * listed + corner] = contacts.weight[8 * listed + corner] / total
            else:
                contacts.weight[8 * listed + corner] = corner_weight(f, corner)


@wp.kernel(enable_backward=False)
def allow_start(particles: Particles) -> None:
    """Soil in which the tool starts doesn't load its contact, or it would be shot out of it."""
    p = wp.tid()
    if particles.gap[p] < 0.0 and particles.gap[p] > -FAR:
        particles.preload[p] = particles.gap[p]


@wp.kernel(enable_backward=False)
def grid_to_particles(
    particles: Particles,
    cells: Cells,
    nodes: Nodes,
    grid: Grid,
    ceiling: float,
    limit: float,
    keep: float,
    release: float,
    deepest: float,
    broken: wp.array(dtype=int),
    strays: wp.array(dtype=int),
) -> None:
    """Move particles with the step's displacement; take over velocity, stress and volume of the cell.

    The mean gradient of a cell doesn't see the bilinear and trilinear parts of its velocity, so stress can't resist
    them (hourglass modes); a particle keeps the fraction ``keep`` of them. A particle that has sunk into the tool is
    moved out by the fraction ``release`` of its depth, and to ``deepest`` (m) at once; its spring keeps the load, until
    soil and tool part.

    A particle faster than ``limit`` (m/s) or without a finite state counts as ``broken``; one that rises above
    ``ceiling`` (m) counts as a stray, loses its velocity and falls back.
    """
    p = wp.tid()
    x = particles.position[p]
    f = local_coordinates(grid, x, cell_of(grid, x))
    entry = particles.cell[p]
    base = cells.node[entry]
    velocity = field_at(nodes.velocity, grid, base, f)
    moved = field_at(nodes.displacement, grid, base, f)
    inverse = grid.inverse
    particles.velocity[p] = velocity.value
    particles.affine[p] = wp.matrix_from_cols(inverse[0] * velocity.x, inverse[1] * velocity.y, inverse[2] * velocity.z)
    particles.bilinear[p] = keep * wp.matrix_from_cols(velocity.yz, velocity.xz, velocity.xy)
    particles.trilinear[p] = keep * velocity.xyz
    stretch = wp.matrix_from_cols(inverse[0] * moved.x, inverse[1] * moved.y, inverse[2] * moved.z)
    # bounded when a frame is recorded; what tumbles freely until then must not outgrow single precision
    grown = particles.deformation[p] + stretch * particles.deformation[p]
    particles.deformation[p] = grown * wp.min(1.0, RUNAWAY / wp.sqrt(wp.ddot(grown, grown)))
    particles.normal[p] = cells.normal[entry]
    particles.shear[p] = cells.shear[entry]
    particles.elastic[p] = cells.elastic[entry]
    particles.opening[p] = cells.opening[entry]
    if p < particles.history.shape[0]:
        particles.history[p] = cells.history[entry]

    # the midpoint rule: with the displacement where it starts, turning soil would swell and shearing soil shrink
    # (within the particle's cell, beyond which its field is another)
    half = f + 0.5 * wp.cw_mul(moved.value, inverse)
    half = wp.vec3(wp.clamp(half[0], 0.0, 1.0), wp.clamp(half[1], 0.0, 1.0), wp.clamp(half[2], 0.0, 1.0))
    x += field_beside(moved, half - f)
    gap = particles.gap[p]
    if gap < 0.0 and gap > -FAR:
        out = -wp.min(release * gap, gap + deepest)
        x += out * particles.gap_normal[p]
        particles.preload[p] = wp.min(particles.preload[p] + out, deepest)
    elif gap > particles.preload[p]:
        particles.preload[p] = 0.0
        particles.grip[p] = wp.vec3(0.0)
    low = grid.origin
    high = low + wp.cw_mul(
        grid.cell, wp.vec3(float(grid.shape[0] - 1), float(grid.shape[1] - 1), float(grid.shape[2] - 1))
    )
    margin = 1.0e-3 * grid.cell
    # comparisons with NaN are false: "not slower" catches a broken state as well as a runaway
    if not wp.length(velocity.value) < limit:
        wp.atomic_add(broken, 0, 1)
        x = particles.position[p]
    elif x[2] > ceiling:
        wp.atomic_add(strays, 0, 1)
        particles.velocity[p] = wp.vec3(0.0)
        particles.affine[p] = wp.mat33(0.0)
        particles.bilinear[p] = wp.mat33(0.0)
        particles.trilinear[p] = wp.vec3(0.0)
        x = wp.vec3(x[0], x[1], ceiling)
    particles.position[p] = wp.vec3(
        wp.clamp(x[0], low[0] + margin[0], high[0] - margin[0]),
        wp.clamp(x[1], low[1] + margin[1], high[1] - margin[1]),
        wp.clamp(x[2], low[2] + margin[2], high[2] - margin[2]),
    )


@wp.kernel(enable_backward=False)
def bound_stretch(particles: Particles, least: float, most: float) -> None:
    """Clamp the singular values of the visual deformation, so that flowing sand does not become needles."""
    p = wp.tid()
    grown = particles.deformation[p]
    # With the squares' sum q, none is above sqrt(q), nor below det / (q / 2): most soil needs no decomposition.
    square = wp.ddot(grown, grown)
    if square > most * most or wp.determinant(grown) < 0.5 * least * square:
        u = wp.mat33()
        sigma = wp.vec3()
        v = wp.mat33()
        wp.svd3(grown, u, sigma, v)
        sigma = wp.vec3(
            wp.clamp(sigma[0], least, most), wp.clamp(sigma[1], least, most), wp.clamp(sigma[2], least, most)
        )
        particles.deformation[p] = u * wp.diag(sigma) * wp.transpose(v)
