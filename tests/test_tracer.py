"""Single rays of the tracer against float64 root finding that shares no code with it."""

import contextlib
import itertools
import math

import drjit as dr
import pytest

from benchmarks import truth
from benchmarks.camera_rays import compare
from nil_mitsuba import geometry

# Three times what is measured: the share of rays near silhouettes that name another surface
LIMITS = {"quotient": 3.3e-3, "plain": 2.1e-3}


@pytest.mark.parametrize(
    "kind, twist",
    [
        ("quotient", 1),
        ("plain", 1),
        *(
            pytest.param(*setup, marks=pytest.mark.verify)
            for setup in (("quotient", 0), ("quotient", 2), ("plain", 2))
        ),
    ],
)
def test_every_ray_names_the_true_surface(rgb, kind, twist):
    far, close, error, _ = compare(rgb, kind, twist, 0.25)
    assert far == 0
    assert close <= LIMITS[kind]
    assert error <= 1
    finer, coarser = (compare(rgb, kind, twist, tolerance)[1] for tolerance in (0.25 / 4, 1))
    # Sagittas are as large as the tolerance; float32 leaves a ray or two at any
    assert twist == 0 or (close < 0.5 * coarser and finer < 0.25 * coarser)


def test_shapes_that_mitsuba_merges_keep_their_box(rgb):
    """Mitsuba 3.9.1 merges meshes of one material while loading, but not their bounding boxes."""
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.shapes import Shapes
    from nil_mitsuba.tracer import Cone, Tracer

    mi = rgb
    up = mi.ScalarTransform4f().translate
    grey = {"type": "diffuse"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "bsdf": grey},
            "ceiling": {"type": "rectangle", "to_world": up([0, 0, 10]), "bsdf": grey},
        }
    )
    assert len(scene.shapes()) == 1
    assert Shapes(scene).box.max.z == 10
    tracer = Tracer(scene, Space(1.0, False, [0, 0, 0], 1.0), dr.inf)
    p, v = mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, mi.Float([1, -1]))
    hit = tracer.intersect(p, v, Cone(0, 1e-3), tracer.reach(p, v), mi.Bool(True))
    assert dr.allclose(hit.distance, 5)


def test_a_shadow_ray_ends_at_a_light_thousands_of_cells_away(rgb):
    """Near the light its chords are shorter than what float32 can add to its arc length."""
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    mi = rgb
    p, v = mi.Point3f(0, 0, 0.2), mi.Vector3f(0.1, 0, math.sqrt(0.99))
    end = geometry.flow(p, v, 5000.0)[0]
    x, y, z = (c[0] for c in end)
    # An open tube around the light: outside of its box chords would be leapt over
    tube = {"type": "cylinder", "p0": [x, y, z - 20], "p1": [x, y, z + 20], "radius": 5}
    wall = mi.ScalarTransform4f().translate([x, y, z - 10]).scale(10)
    for scene, expected in (
        ({"tube": tube}, False),
        ({"tube": tube} | {"wall": {"type": "rectangle", "to_world": wall}}, True),
    ):
        scene = mi.load_dict({"type": "scene"} | scene)
        tracer = Tracer(scene, Space(1.0, False, [0] * 3, 1.0), dr.inf)
        blocked = tracer.occluded(p, p, v, Cone(0, 1e-6), mi.Float(5000), mi.Bool(True))
        assert blocked[0] == expected


@contextlib.contextmanager
def counted_leaps(monkeypatch, most):
    """No more than so many steps of leaps, counted one by one; yields their counter."""
    from nil_mitsuba.tracer import Tracer

    free, calls = Tracer._free, itertools.count(1)

    def counted(*args):
        assert next(calls) <= most
        return free(*args)

    monkeypatch.setattr(Tracer, "_free", counted)
    with (
        dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False),
        dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False),
    ):
        yield calls


def test_rays_into_the_sky_over_a_large_ground_are_gone_after_a_few_leaps(rgb, monkeypatch):
    """By the bound of their reach alone, most might come back within hundreds of cells."""
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    mi = rgb
    wide = mi.ScalarTransform4f().scale(50)
    scene = {
        "type": "scene",
        "ground": {"type": "rectangle", "to_world": wide},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
    }
    focus = mi.ScalarPoint3f(0, -3, 1.5)
    tracer = Tracer(mi.load_dict(scene), Space(1.0, False, [0] * 3, 1.0), dr.inf, focus=focus)
    assert tracer.clearance is not None
    rng = mi.PCG32(1000)
    v = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    p = mi.Point3f(focus)
    reach = tracer.reach(p, v)
    assert dr.count(reach > 300)[0] > 500
    with counted_leaps(monkeypatch, 200) as leaps:
        dr.eval(tracer.intersect(p, v, Cone(0, 1e-3), reach, mi.Bool(True)).valid)
    assert next(leaps) > 10  # they do leap


def test_a_leap_that_rounding_takes_away_is_none(rgb, monkeypatch):
    """Far along a ray the shortest chord is two roundings of its arc length long."""
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import LEAST_LEAP, Chords, Cone, Foot, Front, Tracer

    mi = rgb
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 2}})
    tracer = Tracer(scene, Space(1.0, False, [0] * 3, 1.0), dr.inf)
    p, v, t = mi.Point3f(0.1, 0, 0), mi.Vector3f(0, 0.6, 0.8), mi.Float(300)
    chords = Chords(v, tracer.space.twist, Cone(), 1, 0, tracer.least)
    # Just worth it, for a ray with a phase of a half
    free = 1.501 * LEAST_LEAP * chords.shortest(t)
    monkeypatch.setattr(Tracer, "_free", lambda *_: mi.Float(free))
    with counted_leaps(monkeypatch, 1):
        front = Front(p, Foot(p, v, mi.Vector2f(0)), t, mi.Vector3i(0))
        front = tracer._leapt(front, chords, mi.Float(0.5), mi.Float(0), t + 1, mi.Bool(True))
    assert front.t[0] == 300


@pytest.mark.parametrize("t", [1e4, 1e6])
def test_every_chord_moves_on_also_near_a_conjugate_point(rgb, t):
    """At twist 8 the shortest chord of a million cells is longer than any that is wanted there."""
    from nil_mitsuba.tracer import Chords, Cone

    mi = rgb
    t = mi.Float(t) + dr.arange(mi.Float, 100) / 64
    for remaining in (1, 1e3):
        chords = Chords(mi.Vector3f(0.6, 0, 0.8), mi.Float(8), Cone(0, 1e-3), 1, 0, mi.Float(1e-4))
        length = chords.between(t, remaining)
        assert dr.all((t + length) - t > 0)


def test_chords_are_as_far_inside_of_the_curve_as_outside(rgb):
    """In the mean of all first chords, in sagittas of a chord of length 1, on a parabola."""
    from nil_mitsuba.tracer import CORNER, STEEPEST

    def offset(x, first):
        """Inwards, where the first corner is at ``first``, at x from the start."""
        corner = CORNER * min(1, STEEPEST * first) ** 2
        if x < first:
            return 4 * x * (first - x) - corner * x / first
        along = (x - first) % 1
        behind = corner if x < first + 1 else CORNER
        return 4 * along * (1 - along) - behind * (1 - along) - CORNER * along

    firsts = [(i + 0.5) / 200 for i in range(200)]
    means = [sum(offset((j + 0.5) / 100, u) for u in firsts) / 200 for j in range(300)]
    assert max(map(abs, means)) <= 0.11
    # Wherever the first corner was, all phases are alike behind the second
    assert max(map(abs, means[200:])) <= 1e-3


def check_that_rays_end(mi, p, v, twist):
    """Each ray ends by a hit within the cube or at ``max_distance``, with finite values."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    scene = mi.load_dict({"type": "scene", **truth.to_mitsuba(truth.cell_scene(), mi)})
    tracer = Tracer(scene, Space(twist, True, [0, 0, 0], 1.0), 12.0)
    hit = tracer.intersect(p, v, Cone(0, 3e-4), tracer.reach(p, v), mi.Bool(True))
    si = surface_interaction(hit, v, tracer.space, mi.Color0f())
    dr.eval(hit, si)
    assert dr.all(~hit.valid | ((hit.distance >= 0) & (hit.distance <= 12)))
    assert dr.all(~hit.valid | dr.all((si.p > -1e-4) & (si.p < 1 + 1e-4)))
    assert dr.all(~hit.valid | (dr.abs(dr.norm(hit.arrival) - 1) < 1e-5))
    assert dr.all(~hit.valid | (dr.abs(dr.norm(si.wi) - 1) < 1e-4))
    # Most rays of this scene hit something: an empty result would pass the lines above.
    assert dr.count(hit.valid)[0] > 0.2 * dr.width(p)


@pytest.mark.parametrize(
    "twist", [-2, *(pytest.param(twist, marks=pytest.mark.verify) for twist in (0, 1))]
)
def test_aimed_rays_end(rgb, twist):
    """Through corners and edges, along faces and edges, horizontal and vertical."""
    mi, count = rgb, 60_000
    random = mi.PCG32(count)

    def number():
        return random.next_float32()

    whole = [mi.Float(dr.floor(5 * number())) - 2 for _ in range(3)]
    p = mi.Point3f(number(), number(), number())
    starts = {
        "corner": (p, mi.Vector3f(mi.Point3f(*whole) - p)),
        "edge": (p, mi.Vector3f(whole[0] - p.x, whole[1] - p.y, number() - 0.5)),
        "along a face": (mi.Point3f(0, p.y, p.z), mi.Vector3f(0, number() - 0.5, number() - 0.5)),
        "along an edge": (mi.Point3f(p.x, 0, 0), mi.Vector3f(dr.sign(number() - 0.5), 0, 0)),
        "horizontal": (p, mi.Vector3f(number() - 0.5, number() - 0.5, 0)),
        "vertical": (p, mi.Vector3f(0, 0, dr.sign(number() - 0.5))),
    }
    p = [
        dr.concat([mi.Float(start[0][i]) + dr.zeros(mi.Float, count) for start in starts.values()])
        for i in range(3)
    ]
    v = [
        dr.concat([mi.Float(start[1][i]) + dr.zeros(mi.Float, count) for start in starts.values()])
        for i in range(3)
    ]
    v = mi.Vector3f(*v)
    v = dr.select(dr.norm(v) > 1e-6, dr.normalize(v), mi.Vector3f(0, 0, 1))
    check_that_rays_end(mi, mi.Point3f(*p), v, twist)


@pytest.mark.verify
@pytest.mark.parametrize("twist", [0, 1, 2, -3])
def test_ten_million_random_rays_end(rgb, twist):
    mi = rgb
    for seed in range(3):
        random = mi.PCG32(1_000_000, seed)
        p = mi.Point3f(*(random.next_float32() for _ in range(3)))
        v = mi.warp.square_to_uniform_sphere(
            mi.Point2f(random.next_float32(), random.next_float32())
        )
        check_that_rays_end(mi, p, v, twist)


@pytest.mark.parametrize("quotient", [False, True])
def test_rays_that_are_not_numbers_end(rgb, quotient):
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    mi = rgb
    scene = mi.load_dict({"type": "scene", **truth.to_mitsuba(truth.cell_scene(), mi)})
    tracer = Tracer(scene, Space(1, quotient, [0, 0, 0], 1.0), 12.0 if quotient else dr.inf)
    nan = dr.nan
    p = mi.Point3f([nan, 0.5, 0.5, 0.5, nan], [0.1, nan, 0.1, 0.1, nan], [0.2] * 5)
    v = mi.Vector3f([0.6, 0.6, nan, 0.6, nan], [0.8, 0.8, 0.8, nan, nan], [0] * 5)
    reach = tracer.reach(p, v)
    hit = tracer.intersect(p, v, Cone(0, 3e-4), reach, mi.Bool(True))
    assert dr.none(hit.valid)
    blocked = tracer.occluded(p, p, v, Cone(0, 3e-4), reach, mi.Bool(True))
    assert dr.none(blocked)
