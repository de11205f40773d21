"""Kernels of a substep, with constant weights: stress, contact, motion of the nodes."""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil.mpm.compiler import OPTIONS
from splatsoil.mpm.grid import Grid, base_node, cell_of, corner_offset, corner_weight, local_coordinates
from splatsoil.mpm.state import Cells, Contacts, Nodes, Particles
from splatsoil.mpm.tool import Tool, signed_distance, tool_position, tool_rotation, tool_velocity
from splatsoil.soil.law import (
    FLOOR_FRICTION,
    GRAVITY,
    OBSTACLE,
    STIFFNESS,
    TOOL_ADHESION,
    TOOL_FRICTION,
    WALL_FRICTION,
    Stress,
)

wp.set_module_options(OPTIONS)

# Of a particle's spacing: soil that slides along the tool chatters on the contact spring, and clings all the while.
ADHESION_REACH = wp.constant(0.05)


@cache
def make_stress_kernel(update: Any, history: bool) -> Any:
    """Kernel that advances every active cell's stress by ``update`` and adds its force to the nodes.

    ``history`` says whether the law keeps any.

    One stress point a cell, from the mean velocity gradient of its soil (Flanagan & Belytschko 1981): eight particles a
    cell that each held their volume would lock and make the soil too strong, the more so the stiffer it is.
    """

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def stress_forces(
        cells: Cells,
        nodes: Nodes,
        grid: Grid,
        bulk: float,
        shear: float,
        viscosity: float,
        dt: float,
        values: wp.array2d(dtype=float),
    ) -> None:
        entry = wp.tid()
        if entry < cells.count[0]:
            base = cells.node[entry]
            gradient = wp.mat33(0.0)
            for corner in range(8):
                node = base + corner_offset(grid, corner)
                gradient += wp.outer(nodes.velocity[node], cells.gradient[8 * entry + corner])
            stress = Stress()
            stress.normal = cells.normal[entry]
            stress.shear = cells.shear[entry]
            stress.elastic = cells.elastic[entry]
            stress.opening = cells.opening[entry]
            row = base / grid.nodes
            stiffness = values[row, STIFFNESS]
            if wp.static(history):
                stress.plastic_strain = cells.history[entry][0]
                stress.dilated = cells.history[entry][1]
                stress.depth = cells.depth[entry]
            stress = update(stress, gradient, stiffness * bulk, stiffness * shear, dt, values, row)
            if cells.volume[entry] == 0.0:
                # loose grains bear nothing, and must close up before they do
                stress.normal = wp.vec3()
                stress.shear = wp.vec3()
                stress.opening = wp.max(stress.opening + stress.elastic, 0.0)
                stress.elastic = 0.0
            if wp.static(history):
                cells.history[entry] = wp.vec2(stress.plastic_strain, stress.dilated)
            cells.normal[entry] = stress.normal
            cells.shear[entry] = stress.shear
            cells.elastic[entry] = stress.elastic
            cells.opening[entry] = stress.opening
            pressure = -stiffness * bulk * stress.elastic
            if pressure > 0.0:
                # bulk viscosity takes the ringing out of pressure waves and never pulls
                pressure = wp.max(pressure - viscosity * wp.trace(gradient), 0.0)
            n = stress.normal
            o = stress.shear
            sigma = wp.mat33(n[0] - pressure, o[0], o[1], o[0], n[1] - pressure, o[2], o[1], o[2], n[2] - pressure) * (
                -cells.volume[entry]
            )
            for corner in range(8):
                node = base + corner_offset(grid, corner)
                wp.atomic_add(nodes.force, node, sigma * cells.gradient[8 * entry + corner])

    return stress_forces


@wp.kernel(enable_backward=False)
def contact_forces(
    particles: Particles,
    nodes: Nodes,
    grid: Grid,
    tool: Tool,
    pose: wp.array(dtype=float),
    contacts: Contacts,
    dt: float,
    share: float,
    values: wp.array2d(dtype=float),
    force: wp.array(dtype=wp.vec3),
) -> None:
    """Penalty contact with Coulomb friction between particles and tool; ``force`` (simulations) gains share * force.

    A spring is loaded no further than ``contacts.deepest``, so that soil in which a tool starts is not shot out of it.
    Friction is a tangential spring whose force returns to Coulomb's
    limit where it exceeds it, so that soil sticks or slips, and does neither by the step's length (Wriggers 2006,
    Computational Contact Mechanics, sec. 5.2 and 10.5; Cundall & Strack 1979).

    A particle keeps the side of the tool it is on, so a plate thinner than a cell holds soil on both its faces, and
    what the soil feels is exactly what the tool feels. It moves with the whole field of its cell, and is held by the
    weights of the corners that the tool covers (:func:`~splatsoil.mpm.transfer.find_gaps`).
    """
    i = wp.tid()
    if i < contacts.count[0]:
        p = contacts.particle[i]
        row = p / particles.per_simulation
        x = particles.position[p]
        cell = cell_of(grid, x)
        f = local_coordinates(grid, x, cell)
        base = row * grid.nodes + base_node(grid, cell)
        velocity = wp.vec3(0.0)
        for corner in range(8):
            velocity += corner_weight(f, corner) * nodes.velocity[base + corner_offset(grid, corner)]
        normal = particles.gap_normal[p]
        slip = velocity - tool_velocity(pose, x)
        closing = wp.dot(slip, normal)
        # not "+=", which Warp takes for an atomic addition; each place is one thread's
        drift = particles.drift[p] + dt * slip
        particles.drift[p] = drift
        gap = particles.gap[p] + dt * closing
        preload = particles.preload[p]
        if gap < preload:
            # the flat estimate would push on where a particle has slid off an edge: measure
            place = x + drift - tool_position(pose)
            gap = signed_distance(tool, wp.quat_rotate_inv(tool_rotation(pose), place))
        particles.gap[p] = gap
        depth = preload - gap
        adhesion = values[row, TOOL_ADHESION] * contacts.area
        if depth > 0.0 or (adhesion > 0.0 and gap < ADHESION_REACH * wp.sqrt(contacts.area)):
            spring = tool.stiffness * wp.clamp(depth, 0.0, contacts.deepest)
            push = wp.where(depth > 0.0, wp.max(spring - tool.damping * closing, 0.0), 0.0)
            slip -= closing * normal
            grip = particles.grip[p]
            grip = grip - wp.dot(grip, normal) * normal + dt * slip
            hold = values[row, TOOL_FRICTION] * push + adhesion
            drag = tool.stiffness * grip + tool.damping * slip
            strength = wp.length(drag)
            if strength > hold:
                kept = hold / strength
                drag = kept * drag
                grip = kept * grip
            particles.grip[p] = grip
            pull = push * normal - drag
            wp.atomic_add(force, row, -share * pull)
            for corner in range(8):
                wp.atomic_add(nodes.force, base + corner_offset(grid, corner), contacts.weight[8 * i + corner] * pull)


@wp.func
def slide(velocity: wp.vec3, inward: wp.vec3, friction: float) -> wp.vec3:
    """Velocity at a fixed wall with unit normal ``inward``: no entry, Coulomb friction on what remains."""
    entry = wp.dot(velocity, inward)
    result = velocity
    if entry < 0.0:
        along = velocity - entry * inward
        speed = wp.length(along)
        result = along * wp.max(0.0, 1.0 + friction * entry / wp.max(speed, 1.0e-9))
    return result


@wp.kernel(enable_backward=False)
def move_nodes(nodes: Nodes, grid: Grid, dt: float, values: wp.array2d(dtype=float)) -> None:
    """Advance velocities by the gathered forces and gravity; hold floor and walls; add up displacements."""
    k = wp.tid()
    if k < nodes.count[0]:
        i = nodes.active[k]
        row = i / grid.nodes
        gravity = wp.vec3(values[row, GRAVITY], values[row, GRAVITY + 1], values[row, GRAVITY + 2])
        velocity = nodes.velocity[i] + (dt / nodes.inertia[i]) * (nodes.force[i] + nodes.mass[i] * gravity)
        local = i % grid.nodes
        iz = local % grid.shape[2]
        iy = (local / grid.shape[2]) % grid.shape[1]
        ix = local / (grid.shape[2] * grid.shape[1])
        wall = values[row, WALL_FRICTION]
        if iz == 0:
            velocity = slide(velocity, wp.vec3(0.0, 0.0, 1.0), values[row, FLOOR_FRICTION])
        if ix == 0:
            velocity = slide(velocity, wp.vec3(1.0, 0.0, 0.0), wall)
        if ix == grid.shape[0] - 1:
            velocity = slide(velocity, wp.vec3(-1.0, 0.0, 0.0), wall)
        if iy == 0:
            velocity = slide(velocity, wp.vec3(0.0, 1.0, 0.0), wall)
        if iy == grid.shape[1] - 1:
            velocity = slide(velocity, wp.vec3(0.0, -1.0, 0.0), wall)
        radius = values[row, OBSTACLE + 3]
        if radius > 0.0:
            # a rough stone: what touches it sticks, and friction acts within the soil around it
            middle = 0.5 * wp.vec2(grid.cell[0] * float(grid.shape[0] - 1), grid.cell[1] * float(grid.shape[1] - 1))
            centre = wp.vec3(
                middle[0] + values[row, OBSTACLE], middle[1] + values[row, OBSTACLE + 1], values[row, OBSTACLE + 2]
            )
            if wp.length(wp.cw_mul(grid.cell, wp.vec3(float(ix), float(iy), float(iz))) - centre) < radius:
                velocity = wp.vec3(0.0)
        nodes.velocity[i] = velocity
        nodes.displacement[i] = nodes.displacement[i] + dt * velocity
        nodes.force[i] = wp.vec3(0.0)
