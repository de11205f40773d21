"""Warp structs of the state of particles, cells and nodes."""

from __future__ import annotations

import warp as wp


@wp.struct
class Particles:
    """Particles of all simulations of a batch, simulation after simulation.

    Attributes:
        position: m.
        velocity: m/s.
        affine: APIC velocity gradient, 1/s.
        bilinear: of the velocity's field in the particle's cell, the coefficients of yz, xz and xy (columns) about the
            particle, in m/s per cell and cell.
        trilinear: that of xyz, in m/s per cell, cell and cell.
        deformation: visual deformation since frame 0 (rotation and bounded stretch).
        normal: deviatoric stress, diagonal, Pa.
        shear: deviatoric stress, off-diagonal (xy, xz, yz), Pa.
        elastic: elastic logarithmic volume strain.
        opening: logarithmic volume opened in tension.
        history: plastic shear strain and dilated volume; empty unless the law keeps them, like ``depth``.
        depth: below the surface at the start, m.
        density: at the start, over the nominal one.
        cell: entry of the particle's cell among the active cells.
        gap: signed distance to the tool, m, carried through a step's substeps.
        drift: way the particle has gone relative to the tool since the step began, m.
        gap_normal: outward normal of the tool there, in the world.
        preload: what the contact spring is loaded by beyond its depth in the tool, m; negative: the depth up to which
            it isn't loaded, where the tool started in the soil.
        grip: tangential displacement that the contact's friction holds, m.
        per_simulation: particles of one simulation.
        volume: of a particle, m^3.
        mass: kg, of a particle of nominal density.
    """

    position: wp.array(dtype=wp.vec3)
    velocity: wp.array(dtype=wp.vec3)
    affine: wp.array(dtype=wp.mat33)
    bilinear: wp.array(dtype=wp.mat33)
    trilinear: wp.array(dtype=wp.vec3)
    deformation: wp.array(dtype=wp.mat33)
    normal: wp.array(dtype=wp.vec3)
    shear: wp.array(dtype=wp.vec3)
    elastic: wp.array(dtype=float)
    opening: wp.array(dtype=float)
    history: wp.array(dtype=wp.vec2)
    depth: wp.array(dtype=float)
    density: wp.array(dtype=float)
    cell: wp.array(dtype=int)
    gap: wp.array(dtype=float)
    drift: wp.array(dtype=wp.vec3)
    gap_normal: wp.array(dtype=wp.vec3)
    preload: wp.array(dtype=float)
    grip: wp.array(dtype=wp.vec3)
    per_simulation: int
    volume: float
    mass: float


@wp.struct
class Nodes:
    """Nodes of all simulations of a batch.

    Attributes:
        mass: kg.
        inertia: mass that resists stress forces, kg; at least ``mass``, raised at nearly empty nodes for stability.
        velocity: m/s.
        force: N, gathered in a substep.
        displacement: m, gathered in a step.
        active: the numbers of nodes with mass, packed.
        count: how many are active.
    """

    mass: wp.array(dtype=float)
    inertia: wp.array(dtype=float)
    velocity: wp.array(dtype=wp.vec3)
    force: wp.array(dtype=wp.vec3)
    displacement: wp.array(dtype=wp.vec3)
    active: wp.array(dtype=int)
    count: wp.array(dtype=int)


@wp.struct
class Contacts:
    """Particles near the tool, packed.

    Attributes:
        particle: number of each.
        weight: of the eight corners of its cell, by which contact acts on them; entry 8 * contact + corner.
        count: how many there are.
        area: of the tool that a particle covers, m^2.
        deepest: compression to which a contact spring is loaded at most, m.
    """

    particle: wp.array(dtype=int)
    weight: wp.array(dtype=float)
    count: wp.array(dtype=int)
    area: float
    deepest: float


@wp.struct
class Cells:
    """Cells with soil in them, packed; each is one stress point.

    Attributes:
        slot: entry among the active cells for every cell of the batch, -1 where empty (indexed by lowest node).
        node: lowest node of each active cell.
        count: how many are active.
        volume: soil in the cell, m^3; the number of its particles until all are counted.
        gradient: mean gradient of the eight corners' weights over the cell's soil, 1/m; entry 8 * cell + corner.
        normal: deviatoric stress, diagonal, Pa.
        shear: deviatoric stress, off-diagonal, Pa.
        elastic: elastic logarithmic volume strain.
        opening: logarithmic volume opened in tension.
        history: plastic shear strain and dilated volume; empty unless the law keeps them, like ``depth``.
        depth: of the cell's soil below the surface at the start, m.
    """

    slot: wp.array(dtype=int)
    node: wp.array(dtype=int)
    count: wp.array(dtype=int)
    volume: wp.array(dtype=float)
    gradient: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    shear: wp.array(dtype=wp.vec3)
    elastic: wp.array(dtype=float)
    opening: wp.array(dtype=float)
    history: wp.array(dtype=wp.vec2)
    depth: wp.array(dtype=float)
