"""A plain explicit MLS-MPM for sand in Taichi, the yardstick of the benchmark's row ``taichi``.

Run as a program of its own, so that Taichi's compiler meets no other: ``python sand_taichi.py SCENE.npz RESULT.npz``.
Quadratic B-splines and affine particles (Hu et al. 2018), one stress point on every particle, one exchange of particles
and grid in every step. The law is ours with every effect off (:mod:`splatsoil.soil.law`): hypoelastic with Jaumann
rate, a return to the Drucker-Prager cone, volume that opened in tension closing before it bears load; so no matrix is
decomposed here, either. The tool is a box that nodes inside can't enter; that is cheaper than our contact.
"""

# No postponed annotations here: Taichi reads those of its kernels as values.
import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import taichi as ti

PAD = 3
"""Cells around the bed: splines reach that far past it."""


def build(
    scene: Any, threads: int = 1, atomic: bool = False
) -> tuple[Callable[[], None], Callable[[int], None], Callable[[], dict[str, Any]]]:
    """Fields and kernels for a scene.

    Args:
        scene: arrays by name: ``positions`` (n, 3) m; ``lower``, ``upper``, ``cell`` (3,) m; ``step`` s; ``spacing`` m;
            ``density`` kg/m³; ``bulk``, ``shear`` Pa; ``slope`` of the cone; ``gravity`` (3,) m/s²; ``elastic`` (n,)
            first volume strain; ``floor_friction``, ``wall_friction``, ``tool_friction``; ``tool`` (3,) half extents of
            the box in m, 0 for none; ``poses`` (frames, 15): position, rotation (row by row), velocity at each frame's
            start; ``frame_steps`` steps in a frame.
        threads: that gather particles on grids of their own: Taichi's atomic additions would take seven eighths of a
            step.
        atomic: add atomically on one grid nevertheless, as Taichi programs usually do.

    Returns:
        Functions that put everything back to the start, go on by a number of steps, and tell the state.
    """
    x0 = np.asarray(scene["positions"], dtype=np.float32)
    n = len(x0)
    lower, upper, cell = (np.asarray(scene[k], dtype=np.float64) for k in ("lower", "upper", "cell"))
    inside = np.rint((upper - lower) / cell).astype(int)
    shape = tuple(int(k) for k in inside + 1 + 2 * PAD)
    dt, spacing = float(scene["step"]), float(scene["spacing"])
    volume = spacing**3
    mass = volume * float(scene["density"])
    bulk, shear, slope = (float(scene[k]) for k in ("bulk", "shear", "slope"))
    floor, wall, plate = (float(scene[f"{k}_friction"]) for k in ("floor", "wall", "tool"))
    half = np.asarray(scene["tool"], dtype=np.float64)
    ploughs = bool(half.max() > 0.0)
    poses = np.asarray(scene["poses"], dtype=np.float32).reshape(-1, 15)
    frame_steps = int(scene["frame_steps"])

    vec = ti.types.vector(3, ti.f32)
    origin = ti.Vector(list(lower - PAD * cell), ti.f32)
    size, inverse = ti.Vector(list(cell), ti.f32), ti.Vector(list(1.0 / cell), ti.f32)
    gravity = ti.Vector(list(np.asarray(scene["gravity"], dtype=np.float64)), ti.f32)
    low, high = ti.Vector(list(lower + 1e-3 * cell), ti.f32), ti.Vector(list(upper - 1e-3 * cell), ti.f32)
    box = ti.Vector(list(half), ti.f32)
    last = [int(k) + PAD for k in inside]

    x, v = ti.Vector.field(3, ti.f32, n), ti.Vector.field(3, ti.f32, n)
    affine, deviator = ti.Matrix.field(3, 3, ti.f32, n), ti.Matrix.field(3, 3, ti.f32, n)
    elastic, opening = ti.field(ti.f32, n), ti.field(ti.f32, n)
    # momentum and mass of every thread's own grid; the sum, and then the velocity, goes into the first
    grids = 1 if atomic else threads
    nodes = ti.Vector.field(4, ti.f32, (grids, *shape))
    pose = ti.field(ti.f32, 15)

    @ti.func
    def splines(f):  # type: ignore[no-untyped-def]
        return [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]

    @ti.func
    def prepared(p):  # type: ignore[no-untyped-def]
        q = (x[p] - origin) * inverse
        base = (q - 0.5).cast(ti.i32)
        sigma = deviator[p] + bulk * elastic[p] * ti.Matrix.identity(ti.f32, 3)
        # MLS-MPM: the stress' force through the affine field's own moment matrix, h²/4 along each axis
        field = mass * affine[p]
        for r, c in ti.static(ti.ndrange(3, 3)):
            field[r, c] -= dt * volume * 4.0 * inverse[c] * inverse[c] * sigma[r, c]
        return base, q - base.cast(ti.f32), field

    @ti.kernel
    def clear():  # type: ignore[no-untyped-def]
        for i in ti.grouped(nodes):
            nodes[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])

    @ti.kernel
    def particles_to_grid():  # type: ignore[no-untyped-def]
        ti.loop_config(block_dim=1, parallelize=threads)
        for t in range(threads):
            for p in range(t * n // threads, (t + 1) * n // threads):
                base, f, field = prepared(p)
                w = splines(f)
                carried = mass * v[p]
                for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                    there = carried + field @ ((vec(i, j, k) - f) * size)
                    share = w[i][0] * w[j][1] * w[k][2]
                    a, b, c = base[0] + i, base[1] + j, base[2] + k
                    # no "+=", which would be atomic
                    nodes[t, a, b, c] = nodes[t, a, b, c] + share * ti.Vector([there[0], there[1], there[2], mass])

    @ti.kernel
    def particles_to_grid_atomically():  # type: ignore[no-untyped-def]
        for p in range(n):
            base, f, field = prepared(p)
            w = splines(f)
            carried = mass * v[p]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                there = carried + field @ ((vec(i, j, k) - f) * size)
                share = w[i][0] * w[j][1] * w[k][2]
                node = ti.Vector([0, base[0] + i, base[1] + j, base[2] + k])
                nodes[node] += share * ti.Vector([there[0], there[1], there[2], mass])

    @ti.func
    def held(velocity, inward, friction):  # type: ignore[no-untyped-def]
        entry = velocity.dot(inward)
        result = velocity
        if entry < 0.0:
            along = velocity - entry * inward
            result = along * ti.max(0.0, 1.0 + friction * entry / ti.max(along.norm(), 1.0e-9))
        return result

    @ti.kernel
    def move_nodes(way: ti.f32):  # type: ignore[no-untyped-def]
        for i, j, k in ti.ndrange(*shape):
            total = nodes[0, i, j, k]
            for t in ti.static(range(1, grids)):
                total += nodes[t, i, j, k]
            if total[3] > 0.0:
                u = total[:3] / total[3] + dt * gravity
                if ti.static(ploughs):
                    place = origin + vec(i, j, k) * size
                    speed = vec(pose[12], pose[13], pose[14])
                    turn = ti.Matrix(
                        [[pose[3], pose[4], pose[5]], [pose[6], pose[7], pose[8]], [pose[9], pose[10], pose[11]]]
                    )
                    local = turn.transpose() @ (place - vec(pose[0], pose[1], pose[2]) - way * speed)
                    depth = ti.abs(local) - box
                    if depth.max() < 0.0:
                        normal = vec(0.0)
                        for axis in ti.static(range(3)):
                            if depth[axis] == depth.max():
                                normal[axis] = 1.0 if local[axis] > 0.0 else -1.0
                        u = speed + held(u - speed, turn @ normal, plate)
                if k <= PAD:
                    u = held(u, vec(0.0, 0.0, 1.0), floor)
                if i <= PAD:
                    u = held(u, vec(1.0, 0.0, 0.0), wall)
                if i >= last[0]:
                    u = held(u, vec(-1.0, 0.0, 0.0), wall)
                if j <= PAD:
                    u = held(u, vec(0.0, 1.0, 0.0), wall)
                if j >= last[1]:
                    u = held(u, vec(0.0, -1.0, 0.0), wall)
                nodes[0, i, j, k] = ti.Vector([u[0], u[1], u[2], total[3]])

    @ti.kernel
    def grid_to_particles():  # type: ignore[no-untyped-def]
        for p in range(n):
            q = (x[p] - origin) * inverse
            base = (q - 0.5).cast(ti.i32)
            f = q - base.cast(ti.f32)
            w = splines(f)
            u = vec(0.0)
            gradient = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = vec(i, j, k) - f
                there = nodes[0, base[0] + i, base[1] + j, base[2] + k][:3]
                share = w[i][0] * w[j][1] * w[k][2]
                u += share * there
                gradient += 4.0 * share * there.outer_product(offset * inverse)
            v[p] = u
            affine[p] = gradient
            x[p] = ti.math.clamp(x[p] + dt * u, low, high)

            rate = 0.5 * (gradient + gradient.transpose())
            spin = 0.5 * (gradient - gradient.transpose())
            dilation = rate.trace()
            strain, open_volume = elastic[p] + dt * dilation, opening[p]
            if strain < 0.0 and open_volume > 0.0:
                closing = ti.min(open_volume, -strain)
                open_volume -= closing
                strain += closing
            s = deviator[p]
            turned = spin @ s
            s += dt * (
                2.0 * shear * (rate - dilation / 3.0 * ti.Matrix.identity(ti.f32, 3)) + turned + turned.transpose()
            )
            if strain > 0.0:
                open_volume += strain
                strain = 0.0
            limit = slope * bulk * -strain
            measure = ti.sqrt(0.5 * (s * s).sum())
            if measure > limit:
                s *= limit / ti.max(measure, 1.0e-12)
            deviator[p] = s
            elastic[p] = strain
            opening[p] = open_volume

    gather = particles_to_grid_atomically if atomic else particles_to_grid
    done = 0

    def restart() -> None:
        """Everything as at the start."""
        nonlocal done
        for array in (v, affine, deviator, opening):
            array.fill(0.0)
        x.from_numpy(x0)
        elastic.from_numpy(np.asarray(scene["elastic"], dtype=np.float32))
        done = 0

    def advance(steps: int) -> None:
        """That many steps, to their end."""
        nonlocal done
        for _ in range(steps):
            within = done % frame_steps
            if ploughs and within == 0:
                pose.from_numpy(poses[min(done // frame_steps, len(poses) - 1)])
            clear()
            gather()
            move_nodes(within * dt)
            grid_to_particles()
            done += 1
        ti.sync()

    def state() -> dict[str, Any]:
        velocity = v.to_numpy().astype(np.float64)
        return {
            "positions": x.to_numpy(),
            "momentum": mass * velocity.sum(axis=0),
            "mass": mass * n,
            "grid_mass": float(nodes.to_numpy()[0, ..., 3].astype(np.float64).sum()),
            "fastest": float(np.linalg.norm(velocity, axis=1).max()),
        }

    restart()
    return restart, advance, state


def main() -> None:
    """Go through frames, time each, and write where particles were with the times."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--atomic", action="store_true")
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--record", type=int, nargs="*", default=[], help="frames whose particles are kept")
    options = parser.parse_args()
    ti.init(arch=ti.cpu, default_fp=ti.f32, cpu_max_num_threads=options.threads, offline_cache=True, log_level=ti.ERROR)
    with np.load(options.scene) as file:
        scene = dict(file)
    restart, advance, state = build(scene, options.threads, options.atomic)
    # the first step compiles; the run that counts starts afresh
    advance(1)
    restart()
    seconds: list[float] = []
    used: list[float] = []
    kept: dict[str, Any] = {}
    for frame in range(1, options.frames + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        advance(int(scene["frame_steps"]))
        seconds.append(time.perf_counter() - wall)
        used.append(time.process_time() - cpu)
        if frame in options.record:
            kept[f"f{frame}"] = state()["positions"]
    told: dict[str, Any] = {"version": ".".join(map(str, ti.__version__)), "wall": seconds, "used": used}
    np.savez(options.result, **told, **kept, **state())


if __name__ == "__main__":
    main()
