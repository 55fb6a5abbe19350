"""Prints where methods of tracing geodesics of Nil fail, and by how much: two Markdown tables."""

import argparse
import math
import tempfile
from pathlib import Path

import drjit as dr
import mitsuba as mi
from drjit.llvm import Array3f, Array3f64, Float64

from .. import camera_rays, report_formulas, truth
from ..tracers import KNOBS, TRACERS, Traced
from . import geodesics, tracing
from .crossings import (
    FURTHER,
    crossings_ahead,
    crossings_just_reached,
    first_crossing,
    rays_off,
    sign_change,
)

METHODS = {
    "report's formula": geodesics.report,
    "Runge–Kutta 4, step 0.05": geodesics.runge_kutta,
    "Dormand–Prince, 1e-6": geodesics.dormand_prince,
    "package": geodesics.package,
}
COLUMNS = {
    "printed form, chords 0.05": "printed form",
    "Runge–Kutta 4, chords 0.05": "Runge–Kutta 4",
    "Dormand–Prince, 1e-4": "Dormand–Prince",
    "package": "package",
}
NOT_GIVEN, NOTHING = "not given", "–"


class Sizes:
    """How much is measured: all of it, or enough to see that it runs."""

    def __init__(self, quick):
        self.quick = quick

    def rays(self, count):
        return count // 100 if self.quick else count

    def lengths(self, lengths):
        return lengths[:1] if self.quick else lengths


def number(error):
    if math.isnan(error):
        return "NaN"
    if 0.01 <= error < 1000:
        return f"{float(f'{error:.2g}'):g}"
    return "∞" if math.isinf(error) else f"{error:.1e}".replace("e-0", "e-").replace("e+0", "e")


def share(part, whole=1):
    percent = 100 * part / max(whole, 1)
    return "0" if part == 0 else f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"


# ---------------------------------------------------------------------------
#  Geodesics alone
# ---------------------------------------------------------------------------


def worst_errors(*rays, k=1):
    """Largest error of each method over sets of rays (p, v, length), and the share beyond 1e-3."""
    cells = []
    for method in METHODS.values():
        # An end point that is not a number counts as infinitely far
        errors = [geodesics.end_point_errors(method, p, v, t, k) for p, v, t in rays]
        off = sum(dr.count(error > 1e-3)[0] for error in errors)
        count = sum(map(len, errors))
        if all(dr.all(error == math.inf) for error in errors):
            cells.append("NaN")
        else:
            largest = max(dr.max(error)[0] for error in errors)
            cells.append(number(largest) + (f" ({share(off, count)})" if off else ""))
    return cells


def directions(sizes):
    count = sizes.rays(20_000)
    for name, components in (
        ("w = 0", [0]),
        ("w = 1e-5", [1e-5]),
        ("w = 1e-3", [1e-3]),
        ("w = ±1, c = 0", [1, -1]),
        ("w = ±(1 − 1e-6)", [1 - 1e-6, 1e-6 - 1]),
    ):
        yield (
            f"{name}, length 5",
            worst_errors(*((*geodesics.random_rays(count, w), 5) for w in components)),
        )
    rays = geodesics.random_rays(count, 0.75)
    t = 2 * math.sqrt(2) / 0.75
    yield (
        "both sides of the switch of formula, k w t/2 = √2",
        worst_errors((*rays, t * (1 - 1e-5)), (*rays, t * (1 + 1e-5))),
    )


def lengths(sizes):
    p, v = geodesics.random_rays(sizes.rays(20_000))
    for t in geodesics.LENGTHS:
        yield f"any direction, length {t}", worst_errors((p, v, t))


def places_and_twists(sizes):
    p, v = geodesics.random_rays(sizes.rays(20_000))
    for out in (100, 10_000):
        yield f"{out:,} cells from the identity, length 5", worst_errors((p + out, v, 5))
    for k in (1e-6, 3, 8):
        yield f"twist {k:g}, length 5".replace("e-0", "e-"), worst_errors((p, v, 5), k=k)


def crossings(sizes):
    """The first crossing of the face of the unit cell that a ray heads for: off by a thousandth of
    a cell, missed, or found where there is none within 20 cells. Of all rays."""
    for axis, name in enumerate("xyz"):
        p, v, ahead, exact = crossings_ahead(Array3f, axis, sizes.rays(100_000))
        formula = (report_formulas.crossing_of_x, report_formulas.crossing_of_y, None)[axis]
        found = [formula(p, v, ahead) if formula else None]
        found += [
            sign_change(method, p, v, axis, ahead, FURTHER)
            for method in ("Runge–Kutta 4", "Dormand–Prince")
        ]
        found += [first_crossing(p, v, axis, ahead, FURTHER)]
        yield (
            f"crossing of the face {name} ahead, off for",
            [NOT_GIVEN if t is None else share(rays_off(t, exact), dr.width(p)) for t in found],
        )


def tangents(sizes):
    p, v, c, exact = crossings_just_reached(sizes.rays(100_000))
    found = [
        sign_change(method, p, v, 2, c, 12.0) for method in ("Runge–Kutta 4", "Dormand–Prince")
    ]
    found += [first_crossing(p, v, 2, c, 12.0)]
    yield (
        "crossing of a plane z = c that a ray only just reaches, off for",
        [NOT_GIVEN] + [share(rays_off(t, exact, 0.01, 11.9), dr.width(p)) for t in found],
    )


# ---------------------------------------------------------------------------
#  Tracing
# ---------------------------------------------------------------------------


def by_each(measure):
    """A row: what ``measure`` says of each tracer, given its name and what makes it."""
    return [measure(name, TRACERS[name]) for name in COLUMNS.values()]


def faces(sizes):
    each = sizes.rays(tracing.COUNT)
    kinds = {
        "through edges and corners": ["corner", *(f"edge along {axis}" for axis in "xyz")],
        "tangent to a face": [f"tangent to face {axis}" for axis in "xyz"],
        "starting on a face": [f"starting on face {axis}" for axis in "xyz"],
    }
    for kind, names in kinds.items():
        p, v = tracing.aimed_rays(names, 1, each)
        count = each * len(names)
        yield (
            f"{kind}: name another surface, of {count:,} rays",
            by_each(
                lambda _, make: share(
                    dr.count(tracing.naming(truth.cell_scene(), p, v, 1, True, make=make)[2])[0],
                    count,
                )
            ),
        )
    yield (
        f"along a face: miss the wall ahead, of {3 * each:,} rays",
        by_each(
            lambda _, make: share(
                sum(tracing.walls_along_faces(axis, 1, make, each)[0] for axis in range(3)),
                3 * each,
            )
        ),
    )


def off(error, wrong):
    """An error, and the share of rays that name another surface."""
    return number(error) + (f" ({share(wrong)})" if wrong else "")


def walls(sizes):
    """Walls of 100 cells at two opposite faces, met or passed by rays from between them."""
    count = sizes.rays(20_000)
    p, v = geodesics.random_rays(count)
    scenes = []
    for axis in range(3):
        shapes = {}
        for face in (0, 1):
            corner, sides = [-50.0] * 3, [[0.0] * 3, [0.0] * 3]
            corner[axis] = float(face)
            sides[0][axis - 2] = sides[1][axis - 1] = 100.0
            shapes[f"s{face}"] = truth.Rectangle(tuple(corner), *map(tuple, sides)).to_mitsuba(mi)
        exact = [
            first_crossing(Array3f64(p), Array3f64(v), axis, Float64(face), FURTHER)
            for face in (0, 1)
        ]
        scenes.append((shapes, dr.minimum(*exact)))

    def passed(_, make):
        return share(
            sum(
                rays_off(Traced(shapes, p, v, 1, False, FURTHER, make=make).t, exact)
                for shapes, exact in scenes
            ),
            3 * count,
        )

    yield f"walls at the faces: met 1e-3 off or not at all, of {3 * count:,} rays", by_each(passed)


def long_ways(sizes):
    for t in sizes.lengths((20, 100, 500)):

        def walk(name, _):
            walked = geodesics.walked if name == "package" else geodesics.stepped(name, KNOBS[name])
            errors = geodesics.walk_errors(t, 1, sizes.rays(4000), walked)
            return " / ".join(number(dr.max(error)[0]) for error in errors)

        yield f"wrapped way of {t} cells: error there / walked back", by_each(walk)
    for bins in sizes.lengths((tracing.NEAR, tracing.FAR)):
        count = sizes.rays(tracing.ENOUGH[bins])
        columns = by_each(lambda _, make: tracing.long_ray_errors(1, bins, count, make))
        for i, (low, high, hits, *_) in enumerate(columns[0]):
            yield (
                f"hits {low} to {high} cells away: error, largest of {hits:,}",
                [off(rows[i][5], rows[i][3]) for rows in columns],
            )


def places_and_sizes(sizes):
    count = sizes.rays(20_000)

    def text(wrong_and_error):
        return off(*reversed(wrong_and_error))

    yield (
        "cell_size 1e-3 and 1e4: error of 99 %",
        by_each(
            lambda _, make: text(
                max(tracing.size_errors(size, 0, count, make) for size in (1e-3, 1e4))
            )
        ),
    )
    yield (
        "10,000 cells from the origin, cell_origin too: error of 99 %",
        by_each(lambda _, make: text(tracing.size_errors(1.0, 10_000, count, make))),
    )
    for distance in (100, 1000):
        yield (
            f"{distance:,} cells from the identity: error of 99 %",
            by_each(
                # Fewer rays: the adaptive pair takes its smallest steps here
                lambda _, make: text(tracing.far_errors(distance, count // 10, make))
            ),
        )


def thin_things(sizes):
    count = sizes.rays(20_000)
    yield (
        "sheets 1e-3 thick: name the other side",
        by_each(lambda _, make: share(*tracing.sheet_rays(count, make))),
    )
    with tempfile.TemporaryDirectory() as folder:
        yield (
            "needle triangles: passed, or met 8e-4 off",
            by_each(
                lambda _, make: share(
                    *tracing.needles_passed(Path(folder), 1, make, 10, sizes.rays(50_000))
                )
            ),
        )
    width = 32 if sizes.quick else 512
    found = by_each(lambda _, make: camera_rays.compare(mi, "quotient", 1, 0.25, width, make)[:2])
    for i, where in enumerate(("away from silhouettes", "within a pixel of silhouettes")):
        yield f"camera rays {where}: name another surface", [share(row[i]) for row in found]


def contacts(sizes):
    yield (
        "from contacts and corners: name another surface",
        by_each(lambda _, make: share(*tracing.contact_rays(sizes.rays(20_000), make))),
    )
    spp = 1 if sizes.quick else 64
    yield (
        "closed rooms, of one surface and of sheets, lights outside: pixels lit",
        by_each(
            lambda _, make: share(
                sum(
                    tracing.leaking_pixels(kind, 1, make, spp) for kind in ("one surface", "sheets")
                ),
                2048,
            )
        ),
    )
    yield (
        "glowing corner: pixels too dark or too bright",
        by_each(lambda _, make: share(tracing.off_in_a_corner(1, make), 1024)),
    )


def mirrors_and_glass(sizes):
    yield (
        "inside a glass ball: rays trapped / of another energy",
        by_each(lambda _, make: " / ".join(share(part) for part in tracing.inside_glass(1, make))),
    )

    def mirrors(_, make):
        wrong, lost = tracing.off_between_mirrors(1, 10 if sizes.quick else 200, make)
        return f"{share(wrong, 1024)} / {number(abs(lost))}"

    yield "two mirrors, depth 200: pixels off / energy off", by_each(mirrors)


def connections(sizes):
    count = sizes.rays(50_000)

    def row(miss):
        return [NOT_GIVEN, NOTHING, NOTHING, number(miss)]

    yield (
        "connection to a point about its switch of formula: largest miss",
        row(
            max(
                dr.max(geodesics.about_the_switch(Array3f, 1, side, count)[0])[0]
                for side in (-1, 1)
            )
        ),
    )
    yield (
        "connection to a point about its cut: largest miss",
        row(dr.max(geodesics.about_the_cut(Array3f, 1, count)[0])[0]),
    )
    misses = tracing.further_misses(sizes.rays(20_000))
    yield "further geodesics to a light: miss of 99 %", row(misses[len(misses) * 99 // 100])
    yield "down to 2e-4 cells from a caustic: largest miss", row(misses[-1])


def print_table(columns, groups, sizes):
    print("| Where | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for rows in groups:
        for where, row in rows(sizes):
            print(f"| {where} | " + " | ".join(row) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few rays, to see that it runs")
    sizes = Sizes(parser.parse_args().quick)
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # sheared cylinders are meant
    print_table(METHODS, (directions, lengths, places_and_twists, crossings, tangents), sizes)
    print()
    print_table(
        COLUMNS,
        (
            faces,
            walls,
            long_ways,
            places_and_sizes,
            thin_things,
            contacts,
            mirrors_and_glass,
            connections,
        ),
        sizes,
    )


if __name__ == "__main__":
    main()
