"""Prints where methods of following a geodesic of Nil fail, and by how much: a Markdown table.

The formula is the closed form of VISGRAF TR-19-06, which divides by w; RK4 takes steps of 1/20 of a
cell; the adaptive pair is that of Dormand and Prince with a tolerance of 1e-6. All are in float32.
Errors are distances in cells from the true point, which is computed in float64 by code of its own
(tests/truth.py): the largest of all rays. Crossings of faces are those of tests/face_crossing.py,
which brackets the package's ``flow`` between its extrema. Twist 1 unless a row says otherwise.
"""

import math
import sys
from pathlib import Path

import drjit as dr
from drjit.llvm import Array3f, Array3f64, Float, Float64

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / part) for part in ("", "tests")]

import nil_mitsuba  # noqa: E402, F401 - before mitsuba: it chooses LLVM

# isort: split
import mitsuba as mi  # noqa: E402

mi.set_variant("llvm_ad_rgb")

import face_crossing  # noqa: E402
import report_formulas  # noqa: E402
import test_failures_geodesics as geodesics  # noqa: E402
import test_failures_tracing as tracing  # noqa: E402
import tracing_methods  # noqa: E402
import truth  # noqa: E402
from nil_mitsuba import geometry  # noqa: E402

RK4_STEP = 0.05
TOLERANCE = 1e-6
RAYS = 20_000


def rk4(p, v, t, k):
    return tracing_methods.fixed_steps(p, v, t, math.ceil(t / RK4_STEP), k)


def dormand_prince(p, v, t, k):
    return tracing_methods.adaptive_steps(p, v, t, TOLERANCE, k)


def package(p, v, t, k):
    return geometry.flow(p, v, dr.opaque(Float, t), dr.opaque(Float, k))[0]


def report(p, v, t, k):
    return report_formulas.geodesic(p, v, dr.opaque(Float, t), dr.opaque(Float, k))[0]


METHODS = {"report's formula": report, "RK4": rk4, "Dormand–Prince": dormand_prince,
           "package": package}


# ---------------------------------------------------------------------------
#  Rows
# ---------------------------------------------------------------------------

def number(error):
    return "NaN" if not math.isfinite(error) else f"{error:.1e}".replace("e-0", "e-")


def worst_errors(p, v, t, k=1):
    """Largest error of each method, as text."""
    return [number(dr.max(geodesics.errors_of_a_way(
        lambda p, v, _: method(p, v, t, k), p, v, t, k))[0]) for method in METHODS.values()]


def directions():
    for w in (0, 1e-7, 1e-5, 1e-3, 1e-2, 1e-1):
        yield f"w = {w:g}, length 5", worst_errors(*geodesics.random_rays(RAYS, w), 5)
    for w in (1, 1 - 1e-6):
        yield f"w = {w:g} (along the fibre), length 5", worst_errors(
            *geodesics.random_rays(RAYS, w), 5)
    p, v = geodesics.random_rays(RAYS, 0.75)
    t = 2 * math.sqrt(2) / 0.75
    yield "the switch of formula, k w t/2 = √2", worst_errors(p, v, t)


def lengths():
    p, v = geodesics.random_rays(4000)
    for t in geodesics.LENGTHS:
        yield f"length {t}, random directions", worst_errors(p, v, t)


def places_and_twists():
    for out in (1e2, 1e4):
        p, v = geodesics.random_rays(4000)
        yield f"length 5, {out:g} cells from the origin", worst_errors(p + out, v, 5)
    for k in (1e-6, 3, 8):
        yield f"length 5, twist {k:g}", worst_errors(*geodesics.random_rays(RAYS), 5, k)


def sign_change(p, v, axis, c, t_max):
    """First sign change of the coordinate between steps of RK4, and the secant's root."""
    method = tracing_methods.RungeKutta4(dr.opaque(Float, RK4_STEP), dr.opaque(Float, 1))
    state = method.start(p, v)
    before, found = p[axis] - c, dr.full(Float, math.inf, dr.width(p))
    for n in range(1, round(t_max / RK4_STEP) + 1):
        state = method.step(state, dr.inf)[0]
        now = state["p"][axis] - c
        crossed = (before * now <= 0) & (found == math.inf)
        found = dr.select(crossed, RK4_STEP * (n - 1 + before / (before - now)), found)
        before = now
        dr.eval(state, before, found)
    return found


def crossing_times(p, v, axis, faces, t_max):
    exact = [face_crossing.first_crossing(Array3f64(p), Array3f64(v), axis, Float64(face),
                                          Float64(t_max)) for face in faces]
    return exact[0] if len(exact) == 1 else dr.minimum(*exact)


def share_off(found, exact, allowed=1e-3):
    meets = dr.isfinite(exact)
    off = meets & ~(dr.abs(Float64(found) - exact) <= allowed)
    return f"{dr.count(off)[0] / dr.count(meets)[0]:.2%}"


def faces():
    """Share of rays from the unit cell whose first crossing of the face that they head for is off
    by a thousandth of a cell or more, or not found, of those that cross it within 20 cells."""
    p, v = geodesics.random_rays(100_000)
    for axis, name in enumerate("xyz"):
        ahead = dr.select(v[axis] > 0, Float(1), 0)
        exact = crossing_times(p, v, axis, [ahead], 20)
        formula = (report_formulas.crossing_of_x, report_formulas.crossing_of_y, None)[axis]
        stepped = sign_change(p, v, axis, ahead, 20)
        yield (f"the face {name} ahead, crossed by ray: wrong for",
               [share_off(formula(p, v, ahead), exact) if formula else "not given",
                share_off(stepped, exact), "like RK4",
                share_off(face_crossing.first_crossing(p, v, axis, ahead, Float(20)), exact)])


def walls():
    """The same for the package's tracer and two walls of 100 cells at a face and its opposite."""
    p, v = geodesics.random_rays(20_000)
    for axis, name in enumerate("xyz"):
        shapes = {}
        for face in (0, 1):
            corner, sides = [-50.0] * 3, [[0.0] * 3, [0.0] * 3]
            corner[axis] = float(face)
            sides[0][axis - 2] = sides[1][axis - 1] = 100.0
            shapes[f"s{face}"] = truth.Rectangle(tuple(corner), *map(tuple, sides)).to_mitsuba(mi)
        t = tracing.Traced(shapes, p, v, 1, False, 20.0).t
        yield (f"walls at the faces {name}, met by the tracer: wrong for",
               share_off(t, crossing_times(p, v, axis, (0, 1), 20)))


def tangents():
    """Planes that a ray crosses twice within less than a step, touching them to 1e-2 … 1e-5 cells
    (closer, rounding decides whether it touches them at all)."""
    from test_failures_faces import tangent_rays

    p, v, c = tangent_rays(100_000, 2, 1, 12.0)
    p, v, c = Array3f(p), Array3f(v), Float(c)
    shifted = [crossing_times(p, v, 2, [Float64(c) + shift], 12) for shift in (0, -1e-5, 1e-5)]
    exact = dr.select(dr.abs(shifted[2] - shifted[1]) < 0.01, shifted[0], math.inf)
    stepped = sign_change(p, v, 2, c, 12)
    yield ("planes z = c that a ray only just crosses: wrong for",
           ["not given", share_off(stepped, exact, 0.01), "like RK4",
            share_off(face_crossing.first_crossing(p, v, 2, c, Float(12)), exact, 0.01)])


def tracer():
    """What only a tracer can get wrong, for the package's at the default tolerance."""
    for twist in (1, 3):
        for low, high, hits, other, most, largest in tracing.long_ray_errors(twist):
            yield (f"hits {low} to {high} cells away, twist {twist} ({hits} rays)",
                   f"error 99 % {most:.1e}, largest {largest:.1e}; {other:.2%} name another copy")
        for t in geodesics.LENGTHS:
            _, wrapped, returned = geodesics.long_way_errors(t, twist)
            yield (f"a wrapped walk of {t} cells, twist {twist}",
                   f"largest error {dr.max(wrapped)[0]:.1e}, {dr.max(returned)[0]:.1e} "
                   "back at its start")
    for distance in (0, 1e2, 1e3, 1e4):
        wrong, error = tracing.size_errors(1.0, distance)
        yield (f"a scene {distance:g} cells from the origin",
               f"error 99 % {error:.1e}; {wrong:.2%} name another surface")
    for size in (1e-3, 1e4):
        wrong, error = tracing.size_errors(size, 0)
        yield (f"cell_size {size:g}", f"error 99 % {error:.1e}; {wrong:.2%} name another surface")


def main():
    print("| Where | " + " | ".join(METHODS) + " |")
    print("|---" * (len(METHODS) + 1) + "|")
    for rows in (directions, lengths, places_and_twists, faces, tangents):
        for where, row in rows():
            print(f"| {where} | " + " | ".join(row) + " |", flush=True)
    print("\n| Where | the package's tracer |\n|---|---|")
    for rows in (walls, tracer):
        for where, what in rows():
            print(f"| {where} | {what} |", flush=True)


if __name__ == "__main__":
    main()
