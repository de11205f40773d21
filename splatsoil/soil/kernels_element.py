"""Warp kernel of element tests: a soil law at a single stress point, each axis controlled by strain or by stress.

The strain increments that a wanted stress needs are found by Broyden's method (Broyden 1965), whose estimate of the
stiffness is carried from step to step.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil.soil.law import STIFFNESS, Stress

MOST_ITERATIONS = 60
CONSOLIDATION = 2000
"""Most steps in which a specimen settles under its first stress."""
OUTPUTS = 12


@wp.func
def _axes(stress: Stress, bulk: float) -> wp.vec3:
    """Normal stresses, compression positive, Pa."""
    pressure = -bulk * stress.elastic
    return wp.vec3(pressure - stress.normal[0], pressure - stress.normal[1], pressure - stress.normal[2])


@wp.func
def _wanted(by_stress: wp.vec3i, hooke: wp.mat33) -> wp.mat33:
    """Inverse of the elastic stiffness of stress-controlled axes, with ones for those controlled by strain."""
    matrix = hooke
    for i in range(3):
        if by_stress[i] == 0:
            for j in range(3):
                matrix[i, j] = 0.0
                matrix[j, i] = 0.0
            matrix[i, i] = 1.0
    inverse = wp.inverse(matrix)
    for i in range(3):
        if by_stress[i] == 0:
            inverse[i, i] = 0.0
    return inverse


@cache
def element_kernel(update: Any) -> Any:
    """The kernel that takes each parameter set through its test; ``update`` is a law's."""

    @wp.kernel(module="unique", enable_backward=False)
    def element_test(
        targets: wp.array2d(dtype=wp.float64),
        steps: wp.array(dtype=int),
        seconds: wp.array(dtype=float),
        by_stress: wp.vec3i,
        confining: float,
        depth: float,
        bulk_modulus: float,
        shear_modulus: float,
        tolerance: float,
        values: wp.array2d(dtype=float),
        out: wp.array3d(dtype=wp.float64),
        failed: wp.array(dtype=int),
        miss: wp.array(dtype=float),
    ) -> None:
        row = wp.tid()
        bulk = bulk_modulus * values[row, STIFFNESS]
        shear = shear_modulus * values[row, STIFFNESS]
        along = bulk + 4.0 * shear / 3.0
        across = bulk - 2.0 * shear / 3.0
        elastic = _wanted(by_stress, wp.mat33(along, across, across, across, along, across, across, across, along))
        inverse = elastic
        stress = Stress()
        stress.elastic = -confining / bulk
        stress.depth = depth
        # a skeleton that gives way under the first stress has done so before the test begins
        for _ in range(wp.static(CONSOLIDATION)):
            consolidated = update(stress, wp.mat33(0.0), bulk, shear, seconds[0], values, row)
            if consolidated.elastic == stress.elastic:
                break
            stress.dilated = consolidated.dilated
        total = wp.vec3d()
        sheared = wp.float64(0.0)
        before = wp.vec4d(
            wp.float64(confining) * wp.float64(by_stress[0]),
            wp.float64(confining) * wp.float64(by_stress[1]),
            wp.float64(confining) * wp.float64(by_stress[2]),
            wp.float64(0.0),
        )
        guess = wp.vec3(0.0)
        for record in range(targets.shape[0]):
            count = steps[record]
            dt = seconds[record]
            for step in range(count):
                part = wp.float64(step + 1) / wp.float64(count)
                # strain-controlled components move by what is left to the exact total, free ones start as last time
                want = wp.vec3(0.0)
                move = guess
                for i in range(3):
                    goal = before[i] + part * (targets[record, i] - before[i])
                    want[i] = float(goal)
                    if by_stress[i] == 0:
                        move[i] = float(goal - total[i])
                turn = float(before[3] + part * (targets[record, 3] - before[3]) - sheared)
                best = wp.float32(1.0e30)
                near = Stress()
                chosen = move
                error = wp.vec3(0.0)
                previous = wp.vec3(0.0)
                change = wp.vec3(0.0)
                for iteration in range(wp.static(MOST_ITERATIONS)):
                    gradient = wp.mat33(-move[0], 0.0, turn, 0.0, -move[1], 0.0, 0.0, 0.0, -move[2]) * (1.0 / dt)
                    trial = update(stress, gradient, bulk, shear, dt, values, row)
                    got = _axes(trial, bulk)
                    for i in range(3):
                        error[i] = wp.where(by_stress[i] == 0, 0.0, want[i] - got[i])
                    size = wp.max(wp.max(wp.abs(error[0]), wp.abs(error[1])), wp.abs(error[2]))
                    if size < best:
                        best = size
                        near = trial
                        chosen = move
                    if size <= tolerance:
                        break
                    if iteration == wp.static(MOST_ITERATIONS // 2):
                        inverse = elastic
                    elif iteration > 0:
                        # Broyden: the inverse must turn the last change of stress into the last change of strain
                        gained = previous - error
                        foreseen = inverse * gained
                        weight = wp.dot(change, foreseen)
                        if wp.abs(weight) > 1.0e-30:
                            inverse = inverse + wp.outer(change - foreseen, wp.transpose(inverse) * change) / weight
                    previous = error
                    change = inverse * error
                    reach = wp.length(change)
                    # a poor inverse must not throw the state far off
                    most = 10.0 * (wp.length(move) + wp.abs(turn)) + 1.0e-6
                    if reach > most:
                        change = change * (most / reach)
                    move = move + change
                if not best <= 20.0 * tolerance:
                    failed[row] = record
                    miss[row] = best
                    return
                stress = near
                guess = chosen
                for i in range(3):
                    total[i] = total[i] + wp.float64(chosen[i])
                sheared = sheared + wp.float64(turn)
            now = _axes(stress, bulk)
            for i in range(3):
                out[row, record, i] = total[i]
                out[row, record, 3 + i] = wp.float64(now[i])
                before[i] = targets[record, i]
            before[3] = targets[record, 3]
            out[row, record, 6] = sheared
            out[row, record, 7] = wp.float64(stress.shear[1])
            out[row, record, 8] = wp.float64(stress.plastic_strain)

    return element_test
