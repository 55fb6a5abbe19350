"""Prints how often rays of a small lattice meet something, by distance, against finer chords.

In the quotient, at twist 1: rays that leave surfaces by the cosine's law and rays from anywhere in
any direction, as behind rough bounces ("soft") and as towards lights ("shadow"), and rays from a
camera. The hazard is the rate at which rays that have come so far meet something; printed is by how
many per cent it differs, and the number of rays that meet nothing, each with its standard error.
From 2π cells on there are conjugate points: rays from a thin thing come back to it.
"""

import argparse
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .workloads import small_lattice

mi.set_variant("llvm_ad_rgb")

EDGES = (0, 0.5, 1, 3, 5.5, 6.5, 7.5, 9, 10.5, 12)  # cells
EXACT = 1e-4  # spread of the cone of rays that stand for exact
EYE = (0.1, 0.12, 0.6)
PIXEL = 2 * math.tan(math.radians(75 / 2)) / 128  # angle


@dataclass
class Rays:
    """Starts (cells) and frame directions (scene axes)."""

    p: mi.Point3f
    v: mi.Vector3f


def numbers(count, seed):
    rng = mi.PCG32(count, seed)
    return rng.next_float32


def anywhere(scene, space, count, seed):
    """Rays from anywhere in the cell, in any direction."""
    u = numbers(count, seed)
    p = mi.Point3f(u(), u(), u())
    return Rays(p, mi.warp.square_to_uniform_sphere(mi.Point2f(u(), u())))


def from_surfaces(scene, space, count, seed):
    """Rays from where straight lines meet the scene, by the cosine's law."""
    from nil_mitsuba.interaction import offset, unit_conormal

    u = numbers(8 * count, seed)
    box = scene.bbox()
    o = mi.Point3f(*(dr.lerp(box.min[i], box.max[i], u()) for i in range(3)))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u(), u()))
    si = scene.ray_intersect(mi.Ray3f(o, d))
    # Those from within things do not count
    outside = dr.compress(si.is_valid() & (dr.dot(si.n, d) < 0))
    o, d = dr.gather(mi.Point3f, o, outside), dr.gather(mi.Vector3f, d, outside)
    si = scene.ray_intersect(mi.Ray3f(o, d))
    u = numbers(dr.width(outside), seed + 1)
    n = unit_conormal(space.to_cells(si.p), si.n, space)
    v = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u(), u())))
    return Rays(offset(si.p, n, v, mi.Float(1e-5), space), v)


def from_the_eye(scene, space, count, seed):
    """Rays from one point in any direction."""
    u = numbers(count, seed)
    p = mi.Point3f(*(dr.full(mi.Float, x, count) for x in EYE))
    return Rays(p, mi.warp.square_to_uniform_sphere(mi.Point2f(u(), u())))


def distances(tracer, rays, kind, spread):
    """Where rays meet something first (cells), infinite where they do not."""
    from nil_mitsuba.tracer import Cone

    p, v, active = rays.p, rays.v, mi.Bool(True)
    reach = tracer.reach(p, v)
    if kind == "shadow":
        hit = tracer.obstacle(p, p, v, Cone(0, spread), reach, active)
    else:
        hit = tracer.intersect(p, v, Cone(0, spread, kind == "soft"), reach, active)
    distance = dr.select(hit.valid, hit.distance, dr.inf)
    dr.eval(distance)
    return distance


def count(mask):
    return float(dr.count(mask)[0])


def differences(found, exact, edges=EDGES):
    """By how much the hazards between the edges and, last, the number of rays that meet nothing
    differ from the exact ones, relatively, each with its standard error."""

    def hazard(distance, near, far):
        left = count(distance >= near)
        hits = count((distance >= near) & (distance < far))
        return -math.log1p(-hits / left) if hits < left else math.inf

    for near, far in zip(edges, edges[1:]):
        a, b = ((x >= near) & (x < far) for x in (found, exact))
        error = math.sqrt(count(a ^ b)) / max(1, count(b))
        yield hazard(found, near, far) / (hazard(exact, near, far) or math.nan) - 1, error
    a, b = (dr.isinf(x) for x in (found, exact))
    yield count(a) / count(b) - 1, math.sqrt(count(a ^ b)) / count(b)


ROWS = {
    "from surfaces, soft": (from_surfaces, "soft"),
    "from surfaces, shadow": (from_surfaces, "shadow"),
    "from anywhere, soft": (anywhere, "soft"),
    "from anywhere, shadow": (anywhere, "shadow"),
    "from a camera, seen": (from_the_eye, "seen"),
}


def compare(row, size, seed, edges=EDGES):
    """`differences` of a row's rays, about ``size`` of them."""
    from nil_mitsuba.view import ROUGH_SPREAD

    start, kind = ROWS[row]
    scene = small_lattice(16, 1)
    integrator = scene.integrator()
    view = integrator.view(scene)
    rays = start(scene, view.space, size, seed)
    spread = integrator.tolerance * (PIXEL if kind == "seen" else ROUGH_SPREAD)
    exact = distances(view.tracer, rays, "seen", min(EXACT, spread / 64))
    return list(differences(distances(view.tracer, rays, kind, spread), exact, edges))


def main():
    parser = argparse.ArgumentParser(prog="benchmarks.conjugate_points", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few rays, to see that it runs")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()

    import nil_mitsuba  # noqa: F401  the integrator

    print(
        "per cent".ljust(22),
        *(f"{a:g} to {b:g}".rjust(14) for a, b in zip(EDGES, EDGES[1:])),
        "meet nothing".rjust(14),
    )
    for row in ROWS:
        values = compare(row, 2**14 if arguments.quick else 2**22, arguments.seed)
        cells = (f"{100 * x:+.2f} ± {100 * error:.2f}".rjust(14) for x, error in values)
        print(row.ljust(22), *cells, flush=True)


if __name__ == "__main__":
    main()
