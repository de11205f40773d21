"""Kernels that run once a step: particles to grid, grid to particles."""

from __future__ import annotations

import warp as wp

from splatsoil.mpm.grid import (
    Grid,
    base_node,
    cell_of,
    corner_gradient,
    corner_offset,
    corner_sign,
    corner_twist,
    corner_weight,
    local_coordinates,
)
from splatsoil.mpm.state import Cells, Nodes, Particles
from splatsoil.mpm.tool import FAR, Tool, distance_normal, signed_distance, tool_position, tool_rotation

RUNAWAY = wp.constant(1.0e3)
"""Most that the visual deformation's norm comes to between two frames."""


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
        for corner in range(8):
            cells.gradient[8 * entry + corner] = wp.vec3(0.0)


@wp.kernel(enable_backward=False)
def particles_to_grid(particles: Particles, cells: Cells, nodes: Nodes, grid: Grid) -> None:
    """Add each particle's mass and momentum to nodes, its stress and shape to its cell.

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
    volume = particles.volume
    wp.atomic_add(cells.volume, entry, volume)
    wp.atomic_add(cells.normal, entry, volume * particles.normal[p])
    wp.atomic_add(cells.shear, entry, volume * particles.shear[p])
    wp.atomic_add(cells.elastic, entry, volume * particles.elastic[p])
    wp.atomic_add(cells.opening, entry, volume * particles.opening[p])
    if p < particles.history.shape[0]:
        wp.atomic_add(cells.history, entry, volume * particles.history[p])
        wp.atomic_add(cells.depth, entry, volume * particles.depth[p])
    v = particles.velocity[p]
    affine = particles.affine[p]
    bilinear = particles.bilinear[p]
    trilinear = particles.trilinear[p]
    mass = particles.mass * particles.density[p]
    for corner in range(8):
        node = base + corner_offset(grid, corner)
        weight = mass * corner_weight(f, corner)
        offset = wp.vec3(float(corner >> 2), float((corner >> 1) & 1), float(corner & 1)) - f
        wp.atomic_add(nodes.mass, node, weight)
        mixed = wp.vec3(offset[1] * offset[2], offset[0] * offset[2], offset[0] * offset[1])
        there = v + affine * wp.cw_mul(offset, grid.cell) + bilinear * mixed + (offset[0] * mixed[0]) * trilinear
        wp.atomic_add(nodes.velocity, node, weight * there)
        wp.atomic_add(cells.gradient, 8 * entry + corner, volume * corner_gradient(f, corner, grid.inverse))


@wp.kernel(enable_backward=False)
def average_cells(cells: Cells, nodes: Nodes, grid: Grid, stiffness: float) -> None:
    """Sums to means; ``stiffness`` = c (K + 4G/3) dt^2 turns a node's share of stiffness into the least stable inertia.

    Trilinear weights vanish at a cell's faces but their gradients do not, so a node reached only by the edge of a
    particle would be flung away by stress. The inertia bound is the central-difference limit node by node.
    """
    entry = wp.tid()
    if entry < cells.count[0]:
        volume = cells.volume[entry]
        share = 1.0 / volume
        cells.normal[entry] = share * cells.normal[entry]
        cells.shear[entry] = share * cells.shear[entry]
        cells.elastic[entry] = share * cells.elastic[entry]
        cells.opening[entry] = share * cells.opening[entry]
        if entry < cells.history.shape[0]:
            cells.history[entry] = share * cells.history[entry]
            cells.depth[entry] = share * cells.depth[entry]
        for corner in range(8):
            gradient = share * cells.gradient[8 * entry + corner]
            cells.gradient[8 * entry + corner] = gradient
            node = cells.node[entry] + corner_offset(grid, corner)
            wp.atomic_add(nodes.inertia, node, stiffness * volume * wp.length_sq(gradient))


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
    particles: Particles,
    tool: Tool,
    pose: wp.array(dtype=float),
    reach: float,
    near: wp.array(dtype=int),
    count: wp.array(dtype=int),
) -> None:
    """Distance and normal of each particle to the tool; those within ``reach`` (m) are listed in ``near``."""
    p = wp.tid()
    rotation = tool_rotation(pose)
    local = wp.quat_rotate_inv(rotation, particles.position[p] - tool_position(pose))
    gap = signed_distance(tool, local)
    particles.gap[p] = gap
    if gap < reach:
        particles.gap_normal[p] = wp.quat_rotate(rotation, distance_normal(tool, local))
        particles.drift[p] = wp.vec3(0.0)
        near[wp.atomic_add(count, 0, 1)] = p


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
    memory: float,
    broken: wp.array(dtype=int),
    strays: wp.array(dtype=int),
) -> None:
    """Move particles with the step's displacement; take over velocity, stress and volume of the cell.

    The mean gradient of a cell doesn't see the bilinear and trilinear parts of its velocity, so stress can't resist
    them (hourglass modes); a particle keeps the fraction ``keep`` of them. A particle that has sunk into the tool is
    moved out by the fraction ``release`` of its depth, and to ``deepest`` (m) at once; its spring keeps the fraction
    ``memory`` of the load that this takes off, until soil and tool part.

    A particle faster than ``limit`` (m/s) or without a finite state counts as ``broken``; one that rises above
    ``ceiling`` (m) counts as a stray, loses its velocity and falls back.
    """
    p = wp.tid()
    x = particles.position[p]
    f = local_coordinates(grid, x, cell_of(grid, x))
    entry = particles.cell[p]
    base = cells.node[entry]
    velocity = wp.vec3(0.0)
    displacement = wp.vec3(0.0)
    affine = wp.mat33(0.0)
    stretch = wp.mat33(0.0)
    bilinear = wp.mat33(0.0)
    trilinear = wp.vec3(0.0)
    for corner in range(8):
        node = base + corner_offset(grid, corner)
        weight = corner_weight(f, corner)
        gradient = corner_gradient(f, corner, grid.inverse)
        bilinear += wp.outer(nodes.velocity[node], corner_twist(f, corner))
        trilinear += corner_sign(corner) * nodes.velocity[node]
        velocity += weight * nodes.velocity[node]
        displacement += weight * nodes.displacement[node]
        affine += wp.outer(nodes.velocity[node], gradient)
        stretch += wp.outer(nodes.displacement[node], gradient)
    particles.velocity[p] = velocity
    particles.affine[p] = affine
    particles.bilinear[p] = keep * bilinear
    particles.trilinear[p] = keep * trilinear
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
    half = f + 0.5 * wp.cw_mul(displacement, grid.inverse)
    half = wp.vec3(wp.clamp(half[0], 0.0, 1.0), wp.clamp(half[1], 0.0, 1.0), wp.clamp(half[2], 0.0, 1.0))
    displacement = wp.vec3(0.0)
    for corner in range(8):
        displacement += corner_weight(half, corner) * nodes.displacement[base + corner_offset(grid, corner)]
    x += displacement
    gap = particles.gap[p]
    if gap < 0.0 and gap > -FAR:
        out = -wp.min(release * gap, gap + deepest)
        x += out * particles.gap_normal[p]
        preload = particles.preload[p]
        if preload < 0.0:
            preload = wp.max((1.0 - release) * preload, -deepest)
        particles.preload[p] = wp.min(preload + memory * out, deepest)
    elif gap > particles.preload[p]:
        particles.preload[p] = 0.0
    low = grid.origin
    high = low + wp.cw_mul(
        grid.cell, wp.vec3(float(grid.shape[0] - 1), float(grid.shape[1] - 1), float(grid.shape[2] - 1))
    )
    margin = 1.0e-3 * grid.cell
    # comparisons with NaN are false: "not slower" catches a broken state as well as a runaway
    if not wp.length(velocity) < limit:
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
    u = wp.mat33()
    sigma = wp.vec3()
    v = wp.mat33()
    wp.svd3(particles.deformation[p], u, sigma, v)
    sigma = wp.vec3(wp.clamp(sigma[0], least, most), wp.clamp(sigma[1], least, most), wp.clamp(sigma[2], least, most))
    particles.deformation[p] = u * wp.diag(sigma) * wp.transpose(v)
