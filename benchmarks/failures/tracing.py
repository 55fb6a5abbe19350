"""Where tracers fail: edges and corners of the cell, long rays, sizes, contacts, thin things."""

import functools
import math
from unittest import mock

import drjit as dr
import mitsuba as mi
from drjit.llvm import PCG32, Array3f, Array3f64, Float, Float64, UInt32, UInt64

from nil_mitsuba import geometry

from .. import truth
from ..studio import ALBEDO, EMISSION, ROUNDING, cube_room, nil, sensor, write_ply
from ..tracers import SPREAD, Traced, allowance, naming, package
from .crossings import beyond, first_crossing, random_rays


def compare(surfaces, p, v, twist, quotient, max_distance=12.0):
    """(traced, exact, rays that name another surface, those of them that were not allowed to)."""
    traced, exact, wrong = naming(surfaces, p, v, twist, quotient, max_distance)
    p, v, wrong = Array3f64(p), Array3f64(v), dr.compress(wrong)
    unexplained = wrong
    if len(wrong) > 0:
        # Each wrong ray again, aside by up to twice its cone in 16 directions: turned, and moved,
        # as where geodesics focus no other direction takes them aside
        ring = dr.arange(UInt32, 160 * len(wrong))
        index = dr.gather(UInt32, wrong, ring // 160)
        start, way = dr.gather(Array3f64, p, index), dr.gather(Array3f64, v, index)
        s, c = dr.sincos(2 * math.pi / 16 * Float64(ring % 16))
        x, y = across(way)
        aside = 2 * SPREAD * dr.exp2(-math.log2(3) * Float64((ring % 80) // 16)) * (c * x + s * y)
        turn, length = ring % 160 < 80, dr.gather(Float64, dr.minimum(exact.t, traced.t), index)
        start = dr.select(turn, start, truth.multiply(start, length * aside, Float64(twist)))
        way = dr.select(turn, dr.normalize(way + aside), way)
        dr.eval(start, way)
        near = truth.first_hit(surfaces, start, way, max_distance * 1.001, twist, quotient)
        agrees = truth.surface_hash(near.label, near.g) == dr.gather(UInt64, traced.hashes, index)
        allowed = dr.block_reduce(dr.ReduceOp.Max, dr.select(agrees, UInt32(1), 0), 160)
        unexplained = dr.gather(UInt32, wrong, dr.compress(allowed == 0))
    return traced, exact, wrong, unexplained


def across(v):
    """Two unit vectors that are orthogonal to v and to each other."""
    axis = dr.select(dr.abs(v.z) < 0.9, Array3f64(0, 0, 1), Array3f64(1, 0, 0))
    s = dr.normalize(dr.cross(v, axis))
    return s, dr.cross(v, s)


# ---------------------------------------------------------------------------
#  Faces, edges and corners of the cell
# ---------------------------------------------------------------------------

COUNT = 5000


def unit(x, y, z):
    v = Array3f64(x, y, z)
    return v / dr.norm(v)


def through(target_of, twist, rng):
    """Rays along the shortest geodesics to points, from random starts in the cell."""
    p = Array3f64(*(rng.next_float64() for _ in range(3)))
    p = Array3f64(Array3f(p))
    whole = [dr.floor(5 * rng.next_float64()) - 2 for _ in range(3)]
    return p, geometry.connect(p, target_of(whole, rng), twist).direction


def on_face(axis, rng):
    p = Array3f64(*(rng.next_float64() for _ in range(3)))
    p[axis] = 0
    return p


def tangent(axis, twist, rng):
    """Rays that touch a face of the cell somewhere along their way."""
    p = on_face(axis, rng)
    a, b, w = (rng.next_float64() - 0.5 for _ in range(3))
    v = unit(0 if axis == 0 else a, 0 if axis == 1 else b, -twist * p.x * b if axis == 2 else w)
    p, v = truth.flow(p, v, -2 * rng.next_float64(), Float64(twist))
    return geometry.wrap(p, twist)[0], v


def along(axis, twist, rng):
    """Rays that stay in a face of the cell, or beside it by the last bit: x = 0 or 1 − 2⁻²⁴, y = 0
    or 1 − 2⁻²⁴, or z = 0 where x = 0 too."""
    p = on_face(axis, rng)
    if axis < 2:
        p[axis] = dr.select(rng.next_float64() < 0.5, 0, 1 - 2**-24)
    sign = dr.copysign(1.0, rng.next_float64() - 0.5)
    if axis == 0:
        upright = rng.next_float64() < 0.5
        v = dr.select(upright, Array3f64(0, 0, sign), Array3f64(0, sign, 0))
    elif axis == 1:
        v = Array3f64(sign, 0, 0)
    else:
        p.x, v = Float64(0), Array3f64(0, sign, 0)
    return p, v


def starting_on(axis, twist, rng):
    v = unit(*(rng.next_float64() - 0.5 for _ in range(3)))
    return on_face(axis, rng), v


AIMED = {
    "corner": lambda k, rng: through(lambda i, _: Array3f64(*i), k, rng),
    "edge along z": lambda k, rng: through(
        lambda i, r: Array3f64(i[0], i[1], r.next_float64()), k, rng
    ),
    "edge along y": lambda k, rng: through(
        lambda i, r: Array3f64(i[0], r.next_float64(), i[2]), k, rng
    ),
    "edge along x": lambda k, rng: through(
        lambda i, r: Array3f64(r.next_float64(), i[1], i[2]), k, rng
    ),
} | {
    f"{name} {'xyz'[axis]}": lambda k, rng, make=make, axis=axis: make(axis, k, rng)
    for name, make in (
        ("tangent to face", tangent),
        ("along face", along),
        ("starting on face", starting_on),
    )
    for axis in range(3)
}


def aimed_rays(kinds, twist, count=COUNT):
    """``count`` rays of each kind, one kind after the other."""
    rays = [AIMED[kind](twist, PCG32(count, initstate=9)) for kind in kinds]
    p, v = (
        Array3f(
            *(
                dr.concat([Float(dr.zeros(Float64, count) + ray[i][j]) for ray in rays])
                for j in range(3)
            )
        )
        for i in range(2)
    )
    dr.eval(p, v)
    return p, v


# Three walls across the cell, and beyond it, so that what runs in a face meets no edge of them
WALLS = [
    truth.Rectangle((0.6131, -0.1, -0.1), (0, 1.2, 0), (0, 0, 1.2)),
    truth.Rectangle((-0.1, 0.4137, -0.1), (1.2, 0, 0), (0, 0, 1.2)),
    truth.Rectangle((-0.1, -0.1, 0.3719), (1.2, 0, 0), (0, 1.2, 0)),
]


def walls_along_faces(axis, twist, make=package, count=COUNT):
    """(rays along a face that miss the wall before them, or name another copy of it; largest error
    of the others' arc lengths)"""
    p, v = along(axis, twist, PCG32(count, initstate=9))
    p, v = (Array3f(*(Float(c) + dr.zeros(Float, count) for c in x)) for x in (p, v))
    traced, exact, wrong = naming(WALLS, p, v, twist, True, make=make)
    assert dr.all(exact.label >= 0)
    error = dr.max(dr.select(wrong, 0, dr.abs(traced.t - exact.t)))[0]
    return dr.count(wrong)[0], error


# ---------------------------------------------------------------------------
#  Long rays, sizes, twists
# ---------------------------------------------------------------------------

SPARSE = [truth.Sphere((0.52, 0.47, 0.53), 0.05), truth.Sphere((0.21, 0.77, 0.23), 0.038)]

# Bands of distance with as many rays as lead to a thousand hits in each; a way is 80 cells long
NEAR, FAR = ((0, 5), (5, 20)), ((20, 100), (100, 500))
ENOUGH = {NEAR: 40_000, FAR: 16_000}


@functools.cache
def long_rays(twist, bins, count):
    """Rays and what they hit in truth."""
    p, v, _ = random_rays(count, 0, 1)
    return p, v, truth.first_hit(SPARSE, Array3f64(p), Array3f64(v), bins[-1][1], twist, True)


def long_ray_errors(twist, bins, count=None, make=package):
    """[(from, to, hits, share of other images named, 99 % and largest error)] by distance, in
    cells; the error is measured across the geodesic, of rays that hit the true image."""
    p, v, exact = long_rays(twist, bins, count or ENOUGH[bins])
    traced = Traced(truth.to_mitsuba(SPARSE, mi), p, v, twist, True, float(bins[-1][1]), make=make)
    other = traced.hashes != truth.surface_hash(exact.label, exact.g)
    error = truth.across_error(Array3f64(p), Array3f64(v), exact.t, traced.place, twist)
    error = dr.select(dr.isfinite(error), error, math.inf)
    rows = []
    for low, high in bins:
        inside = (exact.t >= low) & (exact.t < high)
        errors = sorted(dr.gather(Float64, error, dr.compress(inside & ~other)))
        hits = dr.count(inside)[0]
        rows.append(
            (
                low,
                high,
                hits,
                1 - len(errors) / max(hits, 1),
                *(
                    errors[int(share * (len(errors) - 1))] if errors else math.nan
                    for share in (0.99, 1)
                ),
            )
        )
    return rows


def scaled(surfaces, size, origin):
    T = mi.ScalarTransform4f
    move = T().translate(origin).scale(size)
    return {
        name: shape | {"to_world": move @ shape.get("to_world", T())}
        for name, shape in truth.to_mitsuba(surfaces, mi).items()
    }


def wrong_share_and_error(traced, exact, p, v, places):
    """(share of rays naming another surface, 99 % of the others' errors across the geodesic)."""
    same = traced.label == exact.label
    error = truth.across_error(p, v, exact.t, places, 1)
    error = dr.select(dr.isfinite(error), error, math.inf)
    errors = sorted(dr.gather(Float64, error, dr.compress(same & (exact.label >= 0))))
    return (
        1 - dr.count(same)[0] / dr.width(p),
        errors[int(0.99 * len(errors))] if errors else math.inf,
    )


def size_errors(size, distance, count=20_000, make=package):
    """(share of rays naming another surface, 99 % of the errors across the geodesic in cells) for
    a room of cells of the given size that lies, with the group's identity in it, ``distance`` cells
    from the scene's origin."""
    origin = [size * distance * c for c in (1.0, 0.7, -0.3)]
    p, v, _ = random_rays(count, -1, 1)
    surfaces = truth.room_scene()
    traced = Traced(scaled(surfaces, size, origin), p, v, 1, False, 12.0, origin, size, make)
    p, v = Array3f64(p), Array3f64(v)
    exact = truth.first_hit(surfaces, p, v, 12.0, 1, False)
    return wrong_share_and_error(traced, exact, p, v, traced.place)


def far_errors(distance, count=20_000, make=package):
    """The same for the room's walls, carried ``distance`` cells from the identity by a left
    translation, an isometry that shears them; the cube stays where it was."""
    walls = [s for s in truth.room_scene() if isinstance(s, truth.Rectangle)]
    g = Array3f64(*(distance * c for c in (1.0, 0.7, -0.3)))
    moved = []
    for wall in walls:
        corner = truth.multiply(g, Array3f64(*wall.corner), 1)
        edges = ((x, y, z + g.x[0] * y) for x, y, z in (wall.u, wall.v))
        moved.append(truth.Rectangle(tuple(c[0] for c in corner), *edges))
    p, v, _ = random_rays(count, -1, 1)
    p = Array3f(truth.multiply(g, Array3f64(p), 1))
    dr.eval(p)
    traced = Traced(truth.to_mitsuba(moved, mi), p, v, 1, False, 12.0, make=make)
    # As they lie after rounding
    p, v = truth.multiply_inverse(g, Array3f64(p), 1), Array3f64(v)
    exact = truth.first_hit(walls, p, v, 12.0, 1, False)
    return wrong_share_and_error(traced, exact, p, v, truth.multiply_inverse(g, traced.place, 1))


# ---------------------------------------------------------------------------
#  Contacts, corners, thin things
# ---------------------------------------------------------------------------


def grey(value):
    return {"type": "rgb", "value": value}


def lamp(value):
    return {"type": "area", "radiance": grey(value)}


PLASTER = {"type": "twosided", "sides": {"type": "diffuse", "reflectance": grey(0.8)}}


def lights_behind(x):
    """Lights around the room |x|, |y|, |z| ≤ 1, behind walls that reach to x.

    A shadow ray ends 2e-6 of its length before the light, and before an area light 32 roundings of
    its coordinates over the cosine there, which is taken for 1/32 at least: 1.2e-4 in all. What is
    2e-4 behind a wall must not shine through it.
    """
    x += 2e-4
    T = mi.ScalarTransform4f()
    return {
        "near": {"type": "point", "position": [x, 0.2, 0.1], "intensity": grey(10.0)},
        "far": {"type": "point", "position": [0.2, 0.3, 3.0], "intensity": grey(100.0)},
        "sky": {"type": "constant", "radiance": grey(10.0)},
        "ball": {
            "type": "sphere",
            "center": [0.3, -x - 0.3, 0.2],
            "radius": 0.3,
            "light": lamp(100.0),
        },
        "panel": {
            "type": "rectangle",
            "light": lamp(100.0),
            "to_world": T.translate([-x, 0, 0]).rotate([0, 1, 0], 90),
        },
    }


def box(lower, upper, bsdf):
    T = mi.ScalarTransform4f()
    middle = [0.5 * (a + b) for a, b in zip(lower, upper)]
    half = [0.5 * (b - a) for a, b in zip(lower, upper)]
    return {"type": "cube", "to_world": T.translate(middle).scale(half), "bsdf": bsdf}


def thin_walls(thickness):
    """Six sheets around the room, which overlap at its edges."""
    out, sheets = 1 + thickness, {}
    for axis in range(3):
        for side in (-1, 1):
            lower, upper = [-out] * 3, [out] * 3
            lower[axis], upper[axis] = sorted((side, side * out))
            sheets[f"sheet{axis}{side}"] = box(lower, upper, PLASTER)
    return sheets


def rendered(scene, integrator, spp, make=package):
    """Values of an image whose rays and shadow rays are traced by a tracer that ``make`` makes."""
    import nil_mitsuba.view

    with mock.patch.object(nil_mitsuba.view, "Tracer", make):
        image = mi.render(mi.load_dict({"type": "scene", **scene}), integrator=integrator, spp=spp)
        dr.eval(image)
    return image.array


def lit_pixels(scene, twist, quotient, spp=64, depth=6, make=package, **more):
    """How many of the 1,024 pixels are not black."""
    integrator = {"type": "nil", "twist": float(twist), "quotient": quotient, "max_depth": depth}
    image = rendered(scene, mi.load_dict(integrator | more), spp, make)
    return dr.count(~(image == 0))[0] // 3


def closed_room(walls):
    room = (
        {"room": {"type": "cube", "bsdf": PLASTER}} if walls == "one surface" else thin_walls(1e-3)
    )
    return room | lights_behind(1 if walls == "one surface" else 1.001)


def leaking_pixels(walls, twist, make=package, spp=64):
    """How many of 1,024 pixels are lit, in a closed room with lights around it."""
    scene = {"sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0])} | closed_room(walls)
    return lit_pixels(scene, twist, False, spp, make=make, max_distance=20.0)


SHEETS = [truth.Rectangle((-1, -1, z), (2, 0, 0), (0, 2, 0)) for z in (0.3, 0.301)] + [
    truth.Rectangle((x, -1, -1), (0, 2, 0), (0, 0, 2)) for x in (-0.4, -0.401)
]


def sheet_rays(count=20_000, make=package):
    """(rays that name another side of two sheets, a thousandth of a cell thick, hits)."""
    p, v, _ = random_rays(count, -1, 1, seed=5)
    _, exact, wrong = naming(SHEETS, p, v, 1, False, make=make)
    return dr.count(wrong)[0], dr.count(exact.label >= 0)[0]


def contact_rays(count=20_000, make=package):
    """(rays that name another surface, rays) that start next to where a ball touches the floor of
    a room, or next to its corner, as far off the floor as the package starts them."""
    ball = truth.Sphere((0.2, 0.3, -0.6), 0.4)
    surfaces = [*truth.room_scene()[:3], ball]
    _, v, u = random_rays(count, seed=6)
    rng = PCG32(count, initstate=7)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    # The gap under the ball is at least three times the offset there
    r, beside = 0.02 + 0.03 * rng.next_float64(), rng.next_float64()
    at_ball = dr.arange(UInt32, count) % 2 == 0
    x = dr.select(at_ball, 0.2 + r * c, -1 + 2e-3 + 0.02 * Float64(u))
    y = dr.select(at_ball, 0.3 + r * s, 1 - 2e-3 - 0.02 * beside)
    p = Array3f(Float(x), Float(y), Float(-1 + 32 * 2**-24))
    v.z = dr.abs(v.z)
    dr.eval(p, v)
    wrong = naming(surfaces, p, v, 1, False, make=make)[2]
    return dr.count(wrong)[0], count


def off_in_a_corner(twist, make=package):
    """How many of 1,024 pixels of 16 paths of 8 vertices are off, seen from a hundredth of a cell
    before the corner of a glowing room."""
    near = sensor([0.99, 0.985, 0.98], [1, 1, 1]) | {"near_clip": 1e-4}
    image = rendered({**cube_room(), "sensor": near}, nil(twist, False, 8), 16, make)
    exact = EMISSION * (1 - ALBEDO**8) / (1 - ALBEDO)
    return dr.count(~(dr.abs(image / exact - 1) <= ROUNDING))[0] // 3


def needles(folder, count=2000):
    """A square of 4,000 triangles, 2,000 times as long as wide."""
    vertices = [(-1 + 2 * i / count, y, 0.0) for i in range(count + 1) for y in (-1.0, 1.0)]
    triangles = [
        t for i in range(0, 2 * count, 2) for t in ((i, i + 2, i + 1), (i + 1, i + 2, i + 3))
    ]
    return write_ply(folder / "needles.ply", vertices, triangles)


def needles_passed(folder, twist, make=package, slack=1, count=50_000):
    """(rays that go through a square of needle triangles, or meet it further off than ``slack``
    times the allowance; rays that meet it in truth)."""
    p, v, _ = random_rays(count, -0.7, 0.7)
    p.z += dr.copysign(Float(0.01), p.z)
    shapes = {"s0": {"type": "ply", "filename": needles(folder)}}
    traced = Traced(shapes, p, v, twist, False, 20.0, make=make)
    p, v = Array3f64(p), Array3f64(v)
    exact = first_crossing(p, v, 2, Float64(0), 20.0, twist)
    q, _ = truth.flow(p, v, dr.select(dr.isfinite(exact), exact, 0), Float64(twist))
    inside = dr.isfinite(exact) & (dr.abs(q.x) < 0.99) & (dr.abs(q.y) < 0.99)
    side, δ = dr.sign(p.z), slack * allowance(20.0, twist)
    nearer = first_crossing(p, v, 2, side * δ, 20.0, twist)
    farther = first_crossing(p, v, 2, -side * δ, 20.0, twist)
    return dr.count(inside & beyond(traced.t, nearer, farther, δ))[0], dr.count(inside)[0]


# ---------------------------------------------------------------------------
#  Mirrors and glass
# ---------------------------------------------------------------------------


def off_between_mirrors(twist, depth, make=package):
    """(pixels of 1,024 that are off, energy lost by all of them) between the planes x = 1/4 and
    x = 3/4 of the quotient, which glow towards each other and are black behind: E (1 − ρⁿ)/(1 − ρ)
    after n bounces, of which at a depth of 200 the last is worth 1.5e-3."""
    albedo, emission = 0.99, 0.5
    T = mi.ScalarTransform4f()
    mirrors = {
        f"mirror{towards}": {
            "type": "rectangle",
            "light": lamp(emission),
            "to_world": T.translate([x, 0.5, 0.5]).rotate([0, 1, 0], 90 * towards).scale(0.5),
            "bsdf": {"type": "conductor", "specular_reflectance": grey(albedo)},
        }
        for x, towards in ((0.25, 1), (0.75, -1))
    }
    # A ray that stays between them for 12 cells is in equilibrium
    scene = {
        **mirrors,
        "sensor": sensor([0.5, 0.5, 0.5], [0.75, 0.6, 0.55]),
        "sky": {"type": "constant", "radiance": grey(emission / (1 - albedo))},
    }
    image = rendered(scene, nil(twist, True, depth), 1, make)
    exact = emission * (1 - albedo**depth) / (1 - albedo)
    off = dr.count(~(dr.abs(image / exact - 1) <= 1e-4))[0] // 3
    return off, 1 - dr.mean(image)[0] / exact


def inside_glass(twist, make=package):
    """(share of rays that are trapped, share that see the white sky other than n² times as bright)
    inside of a glass ball."""
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    scene = {
        "sky": {"type": "constant", "radiance": grey(1.0)},
        "ball": {"type": "sphere", "bsdf": glass},
        "sensor": sensor([0, 0, 0.9], [1, 0.3, 0.9]),
    }
    image = rendered(scene, nil(twist, False, 200), 1, make)
    trapped = image == 0
    off = ~trapped & ~(dr.abs(image / 1.5**2 - 1) < 1e-4)
    return dr.count(trapped)[0] / len(image), dr.count(off)[0] / len(image)


# ---------------------------------------------------------------------------
#  Beyond the cut point
# ---------------------------------------------------------------------------


def further_misses(count=20_000):
    """By how much geodesics of half turns between π and 4π miss a light, relative to its distance:
    numbers in order, for lights down to 1e-4 cells from the fibre through the patch, a caustic."""
    from nil_mitsuba.lights import further_geodesic

    p, v, u = random_rays(count, -1, 1, seed=8)
    p, v = mi.Point3f(p), mi.Vector3f(v)
    q = mi.Point3f(geometry.flow(p, v, 6.3 + 20 * mi.Float(u), 1)[0])
    misses = []
    for m in (1, 2, 3):
        for second in (False, True):
            exists, way = further_geodesic(p, q, mi.Float(1), mi.Float(m), mi.Bool(second))
            end, _ = geometry.flow(p, mi.Vector3f(way.direction), way.distance, 1)
            miss = dr.norm(mi.Vector3f(end - q)) / (1 + dr.norm(mi.Vector3f(q)))
            misses.extend(dr.gather(mi.Float, miss, dr.compress(exists)))
    return sorted(misses)
