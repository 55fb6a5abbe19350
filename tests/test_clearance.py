"""The grid of clearances promises no space that a surface takes, and most of the rest."""

import drjit as dr
import mitsuba as mi
import pytest
from drjit.llvm import Array3f64, Float64

from nil_mitsuba import geometry

POINTS, SAMPLES = 4_000, 20_000
ROUNDING = 2e-6  # of the points that Mitsuba samples on surfaces, in scenes a few units large

TWISTS = [1.0, -1.0, 3.0, 0.0, -6.0]


def transform():
    return mi.ScalarTransform4f()


def lattice():
    """A ball, a rod, a sheet, a tilted disk and a box, some across the faces of the cube."""
    t = transform()
    return {
        "type": "scene",
        "ball": {"type": "sphere", "center": [0.3, 0.4, 0.95], "radius": 0.17},
        "rod": {"type": "cylinder", "p0": [0.7, 0.2, 0.2], "p1": [0.9, 0.35, 1.1], "radius": 0.05},
        "sheet": {
            "type": "rectangle",
            "to_world": t.translate([0.1, 0.8, 0.4]).rotate([1, 1, 0.3], 50).scale([0.2, 0.05, 1]),
        },
        "disk": {
            "type": "disk",
            "to_world": t.translate([0.8, 0.7, 0.7]).rotate([0.2, 1, 0], 70).scale(0.13),
        },
        "box": {
            "type": "cube",
            "to_world": t.translate([0.45, 0.1, 0.4]).rotate([1, 2, 3], 33).scale([0.1, 0.06, 0.1]),
        },
    }


def ground():
    """Balls on a plane in open space."""
    scene = {
        "type": "scene",
        "ground": {"type": "rectangle", "to_world": transform().scale(4)},
    }
    for i, (x, y) in enumerate([(-2, -1), (-0.6, 0.8), (0.5, -1.2), (1.8, 0.4), (0.2, 2.4)]):
        scene[f"ball{i}"] = {"type": "sphere", "center": [x, y, 0.5], "radius": 0.5}
    return scene


def clearance_of(scene, twist=1.0, quotient=True, origin=(0, 0, 0), size=1.0, focus=None):
    from nil_mitsuba.clearance import Clearance
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.shapes import Shapes

    space = Space(twist, quotient, list(origin), size)
    return Clearance(space, Shapes(scene), focus)


def points_in(low, high, seed, count=POINTS):
    rng = mi.PCG32(count, seed)
    u = mi.Point3f([rng.next_float32() for _ in range(3)])
    return mi.Point3f(low) + u * (mi.Vector3f(high) - mi.Vector3f(low))


def points_on(scene, low, high, seed=5):
    """Points (scene units) on the surfaces of a scene: where rays through a box meet them."""
    o, q = points_in(low, high, seed, SAMPLES), points_in(low, high, seed + 1, SAMPLES)
    ray = mi.Ray3f(o, dr.normalize(q - o))
    si = scene.ray_intersect(ray)
    return mi.Point3f(dr.gather(mi.Point3f, si.p, dr.compress(si.is_valid())))


@dr.syntax
def distances(p, q, space):
    """Least distance (cells) from each p to the points q, and in the quotient to their images."""
    p, q = Array3f64(p), Array3f64(space.to_cells(q))
    twist = Float64(space.twist)
    if space.quotient:  # what lies outside of the cube does not exist
        q = Array3f64(dr.select(dr.all((q >= 0) & (q <= 1)), q, 1e9))
    dr.eval(p, q)
    best = dr.full(Float64, 1e18, dr.width(p))
    i, count = dr.uint32_array_t(Float64)(0), dr.width(q)
    while i < count:
        one = dr.gather(Array3f64, q, i)
        for g in (-1, 0, 1) if space.quotient else (0,):
            d = one - p
            if dr.hint(space.quotient, mode="scalar"):
                d = Array3f64(d.x + g, d.y, d.z + twist * g * one.y)
                d = Array3f64(d.x, d.y - dr.round(d.y), d.z - dr.round(d.z))
            best = dr.minimum(best, dr.squared_norm(d))
        i += 1
    return dr.sqrt(best)


@pytest.mark.parametrize("twist", TWISTS)
def test_no_surface_and_no_image_of_one_lies_closer_than_a_cell_says(rgb, twist):
    scene = mi.load_dict(lattice())
    clearance = clearance_of(scene, twist)
    p = points_in((0, 0, 0), (1, 1, 1), 1)
    says, least = (
        clearance.at(p),
        distances(p, points_on(scene, (0, 0, 0), (1, 1, 1)), clearance.space),
    )
    assert not dr.any(Float64(says) > least + ROUNDING)[0]
    assert dr.mean(says)[0] > 0.05


def test_no_surface_lies_closer_than_a_plain_scene_says(rgb):
    scene = mi.load_dict(ground())
    clearance = clearance_of(scene, quotient=False)
    p = points_in((-6, -6, -1), (6, 6, 3), 2)  # inside of the scene's box and outside
    says, least = (
        clearance.at(p),
        distances(p, points_on(scene, (-4, -4, -0.1), (4, 4, 2)), clearance.space),
    )
    assert not dr.any(Float64(says) > least + ROUNDING)[0]
    assert dr.mean(says)[0] > 0.5


@pytest.mark.parametrize("twist", TWISTS)
def test_a_leap_stays_within_the_clearance(rgb, twist):
    """Everywhere along float64 geodesics, from points far off the identity too."""
    from nil_mitsuba.clearance import within

    count, steps = 20_000, 32
    rng = mi.PCG32(count, 7)
    v = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    p = points_in((-3, -3, -3), (3, 3, 3), 8, count)
    clearance = dr.power(10, 3 * rng.next_float32() - 2.5)
    length = within(p, v, clearance, mi.Float(twist))
    p, v, length, clearance = (
        dr.repeat(x, steps)
        for x in (Array3f64(p), Array3f64(v), Float64(length), Float64(clearance))
    )
    part = (Float64(dr.arange(dr.uint32_array_t(Float64), count * steps) % steps) + 1) / steps
    q, _ = geometry.flow(p, v, length * part, twist)
    assert dr.all(dr.norm(q - p) <= clearance)[0]
    # and does not fall far short of it where nothing bends
    if twist == 0:
        assert dr.all(length > 0.9999 * clearance)[0]
