"""Prints how often the next ray meets the surface that it leaves, or is on its other side.

Of rays that start off a convex shape, those that lead outward should meet nothing and those that
lead inward should meet its other side: the shares of those that do otherwise, "out / in", for the
package's offset, for offsets by 8, 16 and 32 roundings of the largest number that goes into the
hit, and for Mitsuba's own. Straight rays: the package's offset does not depend on the twist.

Then by how much light changes far from zero, the paths that leak out of a closed mesh room, and
those that glass leaves with radiance that is off by the factor η², since they enter or leave it
alone.
"""

from __future__ import annotations

import argparse
import math
import statistics
from tempfile import NamedTemporaryFile
from unittest import mock

import drjit as dr
import mitsuba as mi

from .studio import ALBEDO, EMISSION, ROUNDING, cube_room, film, nil, sensor

ROUNDINGS = (8, 16, 32)
COUNT = 100_000

# (where, middle, size): at home, small, the origin on the surface of what is large, far from zero
HOME = ("at home", (0.5, 0.6, 0.3), 0.1)
PLACES = (
    HOME,
    ("small, 3 off", (3.0, 2.0, 1.0), 1e-3),
    ("large, touching 0", (0.0, 0.0, -1000.0), 1000.0),
    ("1,000 off", (1000.0, 1000.0, 1000.0), 0.2),
    ("3,000 off", (3000.0, 3000.0, 3000.0), 0.2),
    ("10,000 off", (10_000.0, 10_000.0, 10_000.0), 0.2),
)
SPHERE_RADII = tuple(10.0**e for e in range(-3, 4))
TILT = (1 / 3, 2 / 3, 2 / 3)  # a unit vector: by any other, Mitsuba shears


def to(middle, size=1.0):
    """Places a shape of about unit size, turned so that no axis is special."""
    return mi.ScalarTransform4f().translate(list(middle)).rotate(TILT, 40).scale(size)


def sphere_mesh(n, middle, size):
    """A sphere of 2 n² triangles."""
    corner = dr.arange(mi.UInt32, (n + 1) * (n + 1))
    polar = dr.pi / n * mi.Float(corner // (n + 1))
    s, c = dr.sincos(polar)
    sp, cp = dr.sincos(2 * dr.pi / n * mi.Float(corner % (n + 1)))
    mesh = mi.Mesh("sphere", (n + 1) ** 2, 2 * n * n)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = dr.ravel(
        dr.fma(size, mi.Point3f(s * cp, s * sp, c), mi.Point3f(*middle))
    )
    square = dr.arange(mi.UInt32, n * n)
    first = square + square // n
    faces = dr.zeros(mi.UInt32, 6 * n * n)
    for i, corners in enumerate(((0, n + 1, 1), (1, n + 1, n + 2))):
        for j, offset in enumerate(corners):
            dr.scatter(faces, first + offset, 6 * square + 3 * i + j)
    parameters["faces"] = faces
    parameters.update()
    return mesh


def cylinder(middle, size):
    """A cylinder between two disks."""
    at = to(middle, 0.8 * size)
    T = mi.ScalarTransform4f()
    ends = {f"p{i}": at @ mi.ScalarPoint3f(0, 0, z) for i, z in enumerate((-0.6, 0.6))}
    return {
        "side": {"type": "cylinder", "radius": 0.8 * size, **ends},
        "top": {"type": "disk", "to_world": at @ T.translate([0, 0, 0.6])},
        "bottom": {
            "type": "disk",
            "to_world": at @ T.translate([0, 0, -0.6]).rotate([1, 0, 0], 180),
        },
    }


def rectangles(middle, size):
    """Six rectangles around a cube."""
    T = mi.ScalarTransform4f()
    turns = [([1, 0, 0], angle) for angle in (0, 90, 180, 270)]
    turns += [([0, 1, 0], angle) for angle in (90, 270)]
    return {
        f"side{i}": {
            "type": "rectangle",
            "to_world": to(middle, 0.5 * size) @ T.rotate(*turn).translate([0, 0, 1]),
        }
        for i, turn in enumerate(turns)
    }


def instance(child, middle, size, lift=0.0):
    """An instance of a shape around ``lift`` times (1, −2, 1), where its own coordinates are."""
    there = [lift, -2 * lift, lift]
    T = mi.ScalarTransform4f()
    if isinstance(child, dict):
        child = child | {"to_world": T.translate(there)}
    return {
        "group": {"type": "shapegroup", "child": child},
        "instance": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": to(middle, size) @ T.translate([-c for c in there]),
        },
    }


def curve(kind, middle, size):
    """A straight curve."""
    points = [[0.3 * size * (i - 2.5) + c for c in middle] + [0.3 * size] for i in range(6)]
    with NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(" ".join(f"{c:.9g}" for c in p) for p in points) + "\n")
        file.flush()
        return {"curve": mi.load_dict({"type": kind, "filename": file.name})}


FINE = "mesh of 1M triangles"
KINDS = {
    "mesh of 12 triangles": lambda c, r: {"cube": {"type": "cube", "to_world": to(c, 0.5 * r)}},
    FINE: lambda c, r: {"mesh": sphere_mesh(708, c, r)},
    "sphere": lambda c, r: {"sphere": {"type": "sphere", "center": list(c), "radius": r}},
    "cylinder, disks": cylinder,
    "rectangles": rectangles,
    "instance of a mesh": lambda c, r: instance(sphere_mesh(100, (0, 0, 0), 1.0), c, r),
    "instance of a mesh, 9 off": lambda c, r: instance({"type": "cube"}, c, 0.5 * r, 9.0),
    "instance of a sphere": lambda c, r: instance({"type": "sphere"}, c, r),
    "the same, scaled by 1/30": lambda c, r: instance(
        {"type": "sphere", "radius": 30 * r}, c, 1 / 30
    ),
    "linearcurve": lambda c, r: curve("linearcurve", c, r),
    "bsplinecurve": lambda c, r: curve("bsplinecurve", c, r),
}
# Mitsuba culls their back sides
ONE_SIDED = ("linearcurve", "bsplinecurve")


class Hits:
    """Hits of rays on a convex shape, half of them from inside, and next rays from there."""

    def __init__(self, kind, middle, size, count=COUNT):
        from nil_mitsuba import shapes  # only after a variant is set

        rng = mi.PCG32(count, initstate=12)

        def pair():
            return mi.Point2f(rng.next_float32(), rng.next_float32())

        if kind == FINE:
            # So large that its rounded vertices leave it convex: its triangles are 1/225 as long
            size = max(size, abs(middle[0]) / 30)
        self.scene = mi.load_dict({"type": "scene", **KINDS[kind](middle, size)})
        inside = (rng.next_float32() < 0.5) & (kind not in ONE_SIDED)
        start = dr.select(inside, 0.3, 3) * mi.warp.square_to_uniform_sphere(pair())
        target = 0.45 * mi.warp.square_to_uniform_sphere(pair())
        o = mi.Point3f(middle) + size * mi.Vector3f(start)
        self.si = self.scene.ray_intersect(mi.Ray3f(o, dr.normalize(mi.Vector3f(target - start))))
        self.valid = self.si.is_valid()
        # Most of them graze the surface, but so that rounding does not decide to which side they go
        wo = mi.warp.square_to_uniform_hemisphere(pair())
        wo.z = dr.maximum(wo.z * dr.square(rng.next_float32()), 1e-5)
        self.d = mi.Frame3f(self.si.n).to_world(dr.normalize(wo))
        self.table = shapes.Shapes(self.scene)
        dr.eval(self.si, self.d)

    def __len__(self):
        return dr.count(self.valid)[0]

    def margin(self, roundings=None):
        """The package's margin, or one of so many roundings."""
        if roundings is None:
            return self.table.margin(self.si, self.si.t)
        with mock.patch.multiple(
            "nil_mitsuba.shapes", ROUNDINGS=roundings, OTHER_ROUNDINGS=roundings
        ):
            return self.table.margin(self.si, self.si.t)

    def wrong(self, margin=None):
        """How many outward rays meet the shape again, and how many inward rays do not, from starts
        a ``margin`` off the surface, or from where Mitsuba starts them."""
        rays = []
        for side in (1, -1):
            if margin is None:
                rays.append(self.si.spawn_ray(side * self.d))
            else:
                rays.append(
                    mi.Ray3f(self.si.p + mi.Vector3f(self.si.n) * (side * margin), side * self.d)
                )
        out, into = (self.scene.ray_test(ray, self.valid) for ray in rays)
        return dr.count(self.valid & out)[0], dr.count(self.valid & ~into)[0]


def leaking_paths(twist, size=256, spp=16, depth=10):
    """(pixels too dark or bright, vertices) of a glowing room of 12 triangles."""
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0], size), **cube_room()}
    )
    image = mi.render(scene, integrator=nil(twist, False, depth), spp=spp)
    exact = EMISSION * (1 - ALBEDO**depth) / (1 - ALBEDO)
    off = dr.abs(image.array / exact - 1) > ROUNDING
    return dr.count(off)[0] // 3, size * size * spp * depth


def unequal_glass(twist, size=1024):
    """(paths whose radiance is off, paths) through balls of glass under a white sky."""
    glass = {"type": "dielectric"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor([4, 0, 0], [0, 0, 0], size),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}},
            "a": {"type": "sphere", "radius": 1.2, "bsdf": glass},
            "b": {"type": "sphere", "center": [0, 1.8, 0.2], "radius": 0.5, "bsdf": glass},
            "c": {"type": "sphere", "center": [0.5, -1.5, -0.3], "radius": 0.3, "bsdf": glass},
        }
    )
    image = mi.render(scene, integrator=nil(twist, False, 40), spp=1).array
    # What ``max_depth`` ends is black
    off = (image != 0) & (dr.abs(image / 0.7 - 1) > ROUNDING)
    return dr.count(off)[0] // 3, size * size


def grey(value):
    return {"type": "rgb", "value": value}


def lit_room(d):
    """A floor, a ball and a lamp under a dim sky, moved by d along all axes."""
    T = mi.ScalarTransform4f()

    def at(x, y, z):
        return [x + d, y + d, z + d]

    return mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": grey(0.2)},
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "near_clip": 1e-3,
                "film": film(48, 48),
                "to_world": T.look_at(at(0.1, 0.1, 0.6), at(0.7, 1, 0.4), [0, 0, 1]),
            },
            "floor": {
                "type": "rectangle",
                "to_world": T.translate(at(0.5, 0.5, 0.1)).scale(0.45),
                "bsdf": {"type": "twosided", "b": {"type": "diffuse"}},
            },
            "ball": {"type": "sphere", "center": at(0.5, 0.6, 0.25), "radius": 0.15},
            "lamp": {
                "type": "rectangle",
                "emitter": {"type": "area", "radiance": grey(5.0)},
                "to_world": T.translate(at(0.5, 0.4, 0.9)).rotate([1, 0, 0], 180).scale(0.1),
            },
        }
    )


def difference_of_means(first, second, integrators, spp, passes):
    """By what part the mean of one picture differs from that of another, with standard error."""
    ratios = []
    for seed in range(passes):
        means = [
            dr.mean(mi.render(scene, integrator=integrator, spp=spp, seed=seed).array)[0]
            for scene, integrator in zip((first, second), integrators)
        ]
        ratios.append(means[0] / means[1] - 1)
    return statistics.mean(ratios), statistics.stdev(ratios) / math.sqrt(passes)


def moved(twist, quotient, d, spp, passes):
    """`difference_of_means` of the lit room moved by ``d``, its cell too, and the one at home."""
    integrators = [
        mi.load_dict(
            {
                "type": "nil",
                "twist": float(twist),
                "quotient": quotient,
                "max_depth": 6,
                "cell_origin": [float(c)] * 3,
            }
        )
        for c in (d, 0)
    ]
    return difference_of_means(lit_room(d), lit_room(0), integrators, spp, passes)


def share(part, whole):
    return "0" if part == 0 else f"{part / whole:.1e}".replace("e-0", "e-")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few rays, to see that it runs")
    mi.set_variant("llvm_ad_rgb")
    quick = parser.parse_args().quick
    count = 1000 if quick else COUNT
    print(
        "| shape | where | hits | package | "
        + " | ".join(f"{n} roundings" for n in ROUNDINGS)
        + " | spawn_ray |"
    )
    print("|---" * (5 + len(ROUNDINGS)) + "|")
    cases = [(kind, *place) for kind in KINDS for place in PLACES]
    cases += [("sphere", f"radius {r:g}", (0.5, 0.6, 0.3), r) for r in SPHERE_RADII]
    for kind, where, middle, size in cases:
        hits = Hits(kind, middle, size, count)
        margins = [hits.margin()] + [hits.margin(n) for n in ROUNDINGS] + [None]
        shares = []
        for margin in margins:
            out, into = hits.wrong(margin)
            shares.append(
                share(out, len(hits))
                + ("" if kind in ONE_SIDED else f" / {share(into, len(hits))}")
            )
        print(f"| {kind} | {where} | {len(hits):,} | " + " | ".join(shares) + " |", flush=True)

    print("\n| a scene moved with its cell by | twist 0, plain: mean off by | twist 1, quotient |")
    print("|---" * 3 + "|")
    for d in (1000, 3000, 10_000):
        cells = [
            "{:+.3f} ± {:.3f} %".format(*(100 * x for x in moved(*kind, d, *size)))
            for kind, size in (
                ((0, False), (1 if quick else 256, 2 if quick else 8)),
                ((1, True), (1 if quick else 256, 2 if quick else 12)),
            )
        ]
        print(f"| {d:,} | " + " | ".join(cells) + " |", flush=True)

    print("\n| twist | pixels off in a closed room | of vertices | paths off behind glass | of |")
    print("|---" * 5 + "|")
    for twist in (0, 1, 3):
        leaks, vertices = leaking_paths(twist, 32 if quick else 256)
        off, paths = unequal_glass(twist, 32 if quick else 1024)
        print(f"| {twist} | {leaks} | {vertices:,} | {off} | {paths:,} |", flush=True)


if __name__ == "__main__":
    main()
