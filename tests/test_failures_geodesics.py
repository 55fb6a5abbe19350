"""Where methods fail along a single geodesic: w → 0, c → 0, long ways, sizes, small twists.

The package in float32 against float64 that shares no code with it, and beside it the formula of
the report, to show that these are the places where it fails.
"""

import math

import drjit as dr
import pytest
from drjit.llvm import PCG32, Array3f, Array3f64, Array3i, Float, Float64, Int32, UInt32

import face_crossing
import reference_geometry as reference
import report_formulas
import truth
from nil_mitsuba import geometry

ROUNDING = 2**-24


def random_rays(count, w=None, seed=1):
    """Starts in the unit cell and directions, as float32 holds them; w: the fibre component."""
    rng = PCG32(count, initstate=seed)
    p = Array3f(*(Float(rng.next_float64()) for _ in range(3)))
    w = 2 * rng.next_float64() - 1 if w is None else Float64(w)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    r = dr.sqrt((1 - w) * (1 + w))
    v = Array3f(Float(r * c), Float(r * s), Float(w))
    dr.eval(p, v)
    return p, v


def distance(p, q, twist):
    """Length of the short step from p to q, in the frame."""
    d = truth.multiply_inverse(Array3f64(p), Array3f64(q), Float64(twist))
    return dr.norm(Array3f64(d.x, d.y, d.z - 0.5 * twist * d.x * d.y))


def errors_of_a_way(method, p, v, t, twist):
    """Distance of each ray's end point from the true one; infinite where it is not a number."""
    true, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    error = distance(true, method(p, v, Float(t)), twist)
    return dr.select(dr.isfinite(error), error, math.inf)


def longest_terms(t, twist):
    """Size of the terms that a coordinate is the sum of, after the length t from the unit cell."""
    return 1 + t + abs(twist) * t + 0.5 * abs(twist) * t * t


# ---------------------------------------------------------------------------
#  Directions
# ---------------------------------------------------------------------------

HORIZONTAL = [0.0, 1e-30, 1e-7, 1e-5, -1e-4, 1e-3, 1e-2]
VERTICAL = [1.0, -1.0, 1 - 2**-24, 1 - 1e-5, -1 + 1e-3]


@pytest.mark.parametrize("w", HORIZONTAL + VERTICAL + [0.3, -0.7])
@pytest.mark.parametrize("twist", [1e-6, 1, -3])
def test_no_fibre_component_costs_digits(w, twist):
    """Eight roundings of the terms, for horizontal, nearly horizontal and vertical rays alike."""
    p, v = random_rays(5000, w)
    for t in (1.0, 5.0, 20.0):
        error = errors_of_a_way(lambda p, v, t: geometry.flow(p, v, t, twist)[0], p, v, t, twist)
        assert dr.max(error)[0] <= 8 * ROUNDING * longest_terms(t, twist)


def test_the_reports_geodesic_is_lost_as_the_ray_turns_horizontal():
    """Division by w²: nothing at w = 0, no digit below 1e-4, and three lost at w = 1e-2."""
    def worst(w):
        p, v = random_rays(5000, w)
        return dr.max(errors_of_a_way(
            lambda p, v, t: report_formulas.geodesic(p, v, t)[0], p, v, 5.0, 1))[0]

    assert worst(0.0) == math.inf
    assert worst(1e-5) > 1
    assert worst(1e-3) > 1e-2
    assert worst(1e-2) > 1e3 * ROUNDING
    # It is the same geodesic where nothing cancels
    assert worst(0.7) < 1e-4


@pytest.mark.parametrize("w", [1.0, -1.0])
def test_vertical_rays_cross_the_faces_across_them_only(w):
    p, v = random_rays(1000, w)
    for vector_t in (Array3f, Array3f64):
        p, v = vector_t(p), vector_t(v)
        value_t = dr.value_t(vector_t)
        for axis in (0, 1):
            assert dr.all(face_crossing.first_crossing(p, v, axis, value_t(1), 100.0) == math.inf)
            report = (report_formulas.crossing_of_x, report_formulas.crossing_of_y)[axis]
            assert not dr.any(dr.isfinite(report(p, v, value_t(1))))
        t = face_crossing.first_crossing(p, v, 2, value_t(2 * w), 100.0)
        assert dr.all(dr.abs(t - dr.abs(2 * w - p.z)) <= 1e-6)


@pytest.mark.parametrize("vector_t", [Array3f, Array3f64], ids=["float32", "float64"])
@pytest.mark.parametrize("twist", [1, -3])
def test_flow_is_smooth_where_its_formula_changes_for_every_direction(vector_t, twist):
    """At |k w t/2| = √2, for every w: the mean error just below is the mean error just above."""
    rng = PCG32(20_000)
    w = 0.05 + 0.9 * rng.next_float64()
    p, v = random_rays(20_000, w)
    p, v = vector_t(p), vector_t(v)
    value_t = dr.value_t(vector_t)
    eps = dr.epsilon(value_t)
    t = value_t(2 * math.sqrt(2)) / (abs(twist) * v.z)

    def mean_errors(side):
        s = t * (1 + side * 64 * eps)
        end, direction = geometry.flow(p, v, s, twist)
        far, turned = truth.flow(Array3f64(p), Array3f64(v), Float64(s), Float64(twist))
        scale = 1 / longest_terms(Float64(s), twist)
        difference = (Array3f64(end) - far) * scale
        return [dr.mean(x)[0] for x in (*difference, *(Array3f64(direction) - turned))]

    for below, above in zip(mean_errors(-1), mean_errors(1)):
        # A mean of 20,000 roundings is below a hundredth of one, and the float64 truth rounds too
        assert abs(below - above) <= (0.1 if vector_t is Array3f else 1) * eps


# ---------------------------------------------------------------------------
#  Long ways
# ---------------------------------------------------------------------------

LENGTHS = (1, 5, 20, 100, 500)
STEP = 0.5


@dr.syntax
def walk(p, v, steps: UInt32, length: Float, twist: Float):
    """``steps`` flows of equal length in float32, wrapped into the unit cell after each."""
    cell = Array3i(0)
    n = UInt32(0)
    while n < steps:
        p, v = geometry.flow(p, v, length, twist)
        p, step = geometry.wrap(p, twist)
        cell = geometry.multiply(cell, step, Int32(twist))
        n += 1
    return p, v, cell


def walked(p, v, t, twist):
    end = walk(p, v, dr.opaque(UInt32, round(t / STEP)), dr.opaque(Float, STEP),
               dr.opaque(Float, twist))
    dr.eval(end)
    return end


def worst_case_of_a_walk(t, twist):
    """Bound on the error of a walk of the length t, by steps of STEP, all roundings adding up.

    Each step rounds the point, whose coordinates are below two, and the direction, by six
    roundings each. An error δ of a point is one of δ (1 + k s) after a further length s; one of a
    direction (w is not touched) one of δ s horizontally and δ k s²/2 along the fibre.
    """
    k, total = abs(twist), 0.0
    for n in range(round(t / STEP)):
        s = t - n * STEP
        total += 6 * ROUNDING * (2 * (1 + k * s) + s + 0.5 * k * s * s)
    return total


def long_way_errors(t, twist, count=4000):
    """Errors in cells after the length t: (one flow, wrapped walk, wrapped walk there and back)."""
    p, v = random_rays(count)
    end, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    at_once = errors_of_a_way(lambda p, v, t: geometry.flow(p, v, t, twist)[0], p, v, t, twist)
    q, u, cell = walked(p, v, t, twist)
    wrapped = distance(truth.multiply_inverse(Array3f64(cell), end, Float64(twist)), q, twist)
    home, _, back = walked(q, -u, t, twist)
    cell = Array3f64(geometry.multiply(cell, back, Int32(twist)))
    returned = distance(p, truth.multiply(cell, Array3f64(home), Float64(twist)), twist)
    dr.eval(at_once, wrapped, returned)
    return at_once, wrapped, returned


@pytest.mark.parametrize("twist", [1, -3])
def test_one_flow_over_a_long_way_errs_by_the_rounding_of_its_terms(twist):
    for t in LENGTHS:
        at_once, _, _ = long_way_errors(t, twist)
        assert dr.max(at_once)[0] <= 8 * ROUNDING * longest_terms(t, twist)


@pytest.mark.parametrize("twist", [1, -3])
def test_a_wrapped_walk_errs_less_than_all_its_roundings_together(twist):
    for t in LENGTHS:
        _, wrapped, _ = long_way_errors(t, twist)
        assert dr.max(wrapped)[0] <= worst_case_of_a_walk(t, twist)


@pytest.mark.parametrize("twist", [1, -3])
def test_a_wrapped_ray_walked_back_returns_to_its_start(twist):
    for t in LENGTHS:
        _, _, returned = long_way_errors(t, twist)
        # Errors of the way out grow on the way back: a walk twice as long, which ends at home
        assert dr.max(returned)[0] <= worst_case_of_a_walk(2 * t, twist)
    # Not by luck of a loose bound: to a thousandth of a cell after 20 there and 20 back
    _, _, returned = long_way_errors(20, twist)
    assert dr.mean(returned)[0] < 1e-3


# ---------------------------------------------------------------------------
#  Sizes
# ---------------------------------------------------------------------------

@pytest.mark.parametrize("exponent", [0, 2, 4, 6])
def test_far_from_the_origin_a_point_is_as_sharp_as_its_coordinates(exponent):
    """Error of a way of length 5 that starts 10^n cells out: roundings of 10^n (1 + k t)."""
    out = 10.0**exponent
    p, v = random_rays(5000)
    p = p + out
    t, twist = 5.0, 1
    true, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    end, direction = geometry.flow(p, v, Float(t), twist)
    error = dr.max(dr.abs(Array3f64(end) - true))
    assert dr.max(error)[0] <= 8 * ROUNDING * (1 + out) * longest_terms(t, twist)
    # The direction knows nothing of the place
    here, there = geometry.flow(Array3f(0), v, Float(t), twist)[1], direction
    assert dr.all(here == there, axis=None)


@pytest.mark.parametrize("twist", [1e-6, 1e-4, 1e-2, 0.3, 1, 2, 3, 8])
def test_a_geodesic_of_any_twist_is_right_to_rounding(twist):
    p, v = random_rays(20_000)
    for t in (1.0, 5.0, 20.0):
        error = errors_of_a_way(lambda p, v, t: geometry.flow(p, v, t, twist)[0], p, v, t, twist)
        assert dr.max(error)[0] <= 8 * ROUNDING * longest_terms(t, twist)


@pytest.mark.parametrize("twist", [1e-6, 1e-12, 1e-20])
def test_a_small_twist_bends_in_proportion(twist):
    """What k bends comes out with digits of its own, where nothing straight covers it: to first
    order (x, y, z) = t v + k (−w b, w a, a b) t²/2, and y is all bend where b = 0."""
    _, v = random_rays(1000)
    end, _ = geometry.flow(Array3f(0), Array3f(v.x, 0, v.z), Float(1), twist)
    bend = 0.5 * v.z * v.x
    assert dr.all(dr.abs(end.y / twist - bend) <= 8 * ROUNDING * dr.abs(bend) + twist)


# ---------------------------------------------------------------------------
#  Cut points
# ---------------------------------------------------------------------------

@pytest.mark.parametrize("vector_t", [Array3f, Array3f64], ids=["float32", "float64"])
@pytest.mark.parametrize("twist", [1, -2])
def test_connections_about_the_cut_point_land_on_it(vector_t, twist):
    """Random points about |ζ| = 2π and the fibre, down to and on both, from a start off the origin.

    Landing is all that can be asked for there: the direction is ill-conditioned.
    """
    count = 50_000
    rng = PCG32(count, initstate=4)
    radius = dr.exp2(-40 * rng.next_float64()) * (rng.next_float64() > 0.1)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    off = dr.copysign(dr.exp2(-40 * rng.next_float64()), rng.next_float64() - 0.5)
    off *= rng.next_float64() > 0.1
    x, y = radius * c, radius * s
    # Symmetric height ζ/k of p⁻¹·q
    q = Array3f64(x, y, (2 * math.pi + off) / abs(twist) + 0.5 * twist * x * y)
    p = vector_t(0.25, -0.5, 0.125)
    q = vector_t(geometry.multiply(Array3f64(p), q, twist))
    way = geometry.connect(p, q, twist)
    end, arrival = geometry.flow(p, way.direction, way.distance, twist)
    limit = reference.LIMITS["connect"][vector_t is Array3f64] * (1 + dr.max(dr.abs(q)))
    assert dr.all(dr.max(dr.abs(end - q)) <= limit)
    assert dr.all(dr.abs(dr.norm(way.direction) - 1) <= 8 * dr.epsilon(vector_t))
    assert dr.all(dr.isfinite(way.area_density) & (way.area_density >= 0))
    assert dr.all(dr.max(dr.abs(arrival - way.arrival)) <= limit)
