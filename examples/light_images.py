"""Count the images of one point light in the quotient, and draw them against theory.

The quotient has volume 1. So the ball of radius L about a receiver holds as many images of the
light, on average over all places of the light, as it has volume: the integral of the area density
over directions and lengths, up to where geodesics cease to be shortest at the length 2π/(k |w|).
Without that bound, and with |A|, the integral is the mean number of geodesics that connect the two,
each of which is seen as a light of its own. Needs altair and vl-convert-python for its chart.
"""

from __future__ import annotations

import argparse
import math

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from nil_mitsuba import geometry  # noqa: E402 - after the variant is set
from nil_mitsuba.lights import further_geodesic  # noqa: E402

RECEIVER, LIGHT = (0.31, 0.42, 0.17), (0.62, 0.55, 0.71)


def images(p, q, twist, length):
    """All images of ``q`` that a geodesic of this length from ``p`` may reach, as points."""
    reach = int(length) + 2
    # The symmetric height of a geodesic is at most T + k T² (u − sin u)/2u², the fraction < 0.16.
    height = int(length * (1 + 0.16 * twist * length)) + 2
    wide, high = 2 * reach + 1, 2 * height + 1
    i = dr.arange(mi.UInt32, wide * wide * high)
    gx, gy = mi.Int32(i % wide) - reach, mi.Int32(i // wide % wide) - reach
    # Columns of images are counted from the receiver's height in the symmetric coordinate.
    dy = gy + (q.y - p.y)
    rise = twist * (gx * q.y - p.x * dy - 0.5 * dy * (gx + (q.x - p.x)))
    gz = mi.Int32(i // (wide * wide)) - height - mi.Int32(dr.round(rise))
    return mi.Point3f(geometry.multiply(mi.Point3f(gx, gy, gz), q, twist))


def shortest(p, q, twist, length):
    """Lengths up to ``length``, directions and area densities of the shortest geodesics."""
    way = geometry.connect(p, images(p, q, twist, length), twist)
    return taken(way, length)


def further(p, q, twist, length):
    """The same of all other geodesics, which half turns |v| > π set apart."""
    there = images(p, q, twist, length)
    found = []
    for m in range(1, int(length * twist / (2 * math.pi)) + 1):
        for second in (False, True):
            exists, way = further_geodesic(p, there, mi.Float(twist), mi.Float(m), mi.Bool(second))
            found += taken(way, length, exists)
    return found


def taken(way, length, exists=True):
    index = dr.compress(exists & (way.distance <= length))
    direction = dr.gather(mi.Vector3f, mi.Vector3f(way.direction), index)
    distance, density = (
        dr.gather(mi.Float, mi.Float(x), index) for x in (way.distance, way.area_density)
    )
    return list(zip(distance, direction.x, direction.y, direction.z, dr.abs(density)))


def expected(lengths, twist, shortest_only, steps=500):
    """∫∫ |A| dω dt up to each of the equidistant ``lengths``."""
    step = lengths[1] - lengths[0]
    # Midpoints in |w| and t; geodesics are the same in all azimuths.
    w, t = dr.meshgrid(
        (dr.arange(mi.Float, steps) + 0.5) / steps, (dr.arange(mi.Float, steps) + 0.5) / steps
    )
    totals = [0.0]
    for begin in lengths[:-1]:
        length = begin + step * t
        density = dr.abs(geometry.area_density(length, w, twist))
        if shortest_only:
            density = dr.select(twist * w * length <= 2 * dr.pi, density, 0)
        totals.append(totals[-1] + 4 * math.pi * step * dr.mean(mi.Float64(density))[0])
    return totals


def draw(path, size, counts, sky, near):
    import altair as alt

    counts = [row for row in counts if row["count"] >= 1]  # the axis is logarithmic
    base = alt.Chart(alt.Data(values=counts)).encode(
        x=alt.X("length:Q", title="length of the geodesic (cells)"),
        y=alt.Y(
            "count:Q",
            scale=alt.Scale(type="log", nice=False),
            axis=alt.Axis(format="~s"),
            title="how many",
        ),
        color=alt.Color(
            "what:N",
            title=None,
            sort=None,
            scale=alt.Scale(range=["#1f5fa8", "#d1495b"]),
            legend=alt.Legend(orient="top-left"),
        ),
    )
    theory = base.mark_line().transform_filter("datum.by == 'theory'")
    counted = base.mark_point(size=24).transform_filter("datum.by == 'counted'")
    lines = (theory + counted).properties(
        width=size, height=0.75 * size, title="Counted (circles) and expected (lines)"
    )
    # Equal areas for equal solid angles: azimuth by sine of the elevation.
    dots = (
        alt.Chart(alt.Data(values=sky))
        .mark_circle(opacity=0.8)
        .encode(
            x=alt.X(
                "azimuth:Q",
                scale=alt.Scale(domain=[-180, 180], nice=False),
                axis=alt.Axis(values=list(range(-180, 181, 60))),
                title="azimuth (degrees)",
            ),
            y=alt.Y(
                "w:Q", scale=alt.Scale(domain=[-1, 1]), title="fibre component of the direction"
            ),
            # Areas as the light that arrives
            size=alt.Size("light:Q", scale=alt.Scale(range=[0.5, 400]), legend=None),
            color=alt.Color(
                "length:Q", scale=alt.Scale(scheme="viridis", reverse=True), title="length"
            ),
        )
        .properties(
            width=size,
            height=0.75 * size,
            title=f"The receiver's sky: {len(sky)} images within {near:.1f} cells",
        )
    )
    (lines | dots).resolve_scale(color="independent").save(path, scale_factor=2)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", default="light_images.png", help="a .png or .svg file")
    parser.add_argument("--size", type=int, default=420, help="width of each panel")
    parser.add_argument("--length", type=float, default=12, help="longest geodesic, in cells")
    parser.add_argument("--twist", type=int, default=1, help="at least 1")
    options = parser.parse_args()
    twist, length = options.twist, options.length

    p, q = mi.Point3f(*RECEIVER), mi.Point3f(*LIGHT)
    near = shortest(p, q, twist, length)
    far = further(p, q, twist, length)
    # Within 2π/k there is one geodesic to each image.
    sky_length = min(length, 2 * math.pi / twist)
    sky = [
        {"azimuth": math.degrees(math.atan2(b, a)), "w": w, "length": t, "light": 1 / area}
        for t, a, b, w, area in near
        if t <= sky_length
    ]

    lengths = [length * i / 48 for i in range(49)]
    images_expected = expected(lengths, twist, shortest_only=True)
    all_expected = expected(lengths, twist, shortest_only=False)
    further_expected = [total - part for total, part in zip(all_expected, images_expected)]
    counts, summary = [], []
    for what, found, theory in (
        ("images", near, images_expected),
        ("further geodesics to them", far, further_expected),
    ):
        counted = [sum(way[0] <= at for way in found) for at in lengths]
        for by, values in (("counted", counted), ("theory", theory)):
            counts += [
                {"length": at, "count": count, "what": what, "by": by}
                for at, count in zip(lengths, values)
            ]
        summary.append(f"{counted[-1]} {what} (theory {theory[-1]:.0f})")
    draw(options.output, options.size, counts, sky, sky_length)
    print(f"{options.output}: within {length:g} cells {' and '.join(summary)}")


if __name__ == "__main__":
    main()
