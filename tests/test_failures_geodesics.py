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
from conftest import ROOT
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
def walk(p, v, steps: UInt32, length: Float, twist: Float, chained: bool):
    """``steps`` flows of equal length in float32, wrapped into the unit cell after each.

    Each flow starts in the direction of the start, turned by all of the way, as the tracer does;
    or, ``chained``, in the direction that the last one ended in.
    """
    direction, cell = Array3f(v), Array3i(0)
    n = UInt32(0)
    while n < steps:
        p, ended = geometry.flow(p, direction, length, twist)
        p, step = geometry.wrap(p, twist)
        cell = geometry.multiply(cell, step, Int32(twist))
        n += 1
        s, c = dr.sincos(twist * v.z * length * Float(n))
        turned = Array3f(dr.fma(v.x, c, -v.y * s), dr.fma(v.y, c, v.x * s), v.z)
        direction = ended if chained else turned
    return p, direction, cell


def walked(p, v, t, twist, chained=False):
    end = walk(p, v, dr.opaque(UInt32, round(t / STEP)), dr.opaque(Float, STEP),
               dr.opaque(Float, twist), chained)
    dr.eval(end)
    return end


def stepped(method, knob):
    """A walk like ``walked`` by a method of ``tracing_methods``, wrapped after each step."""
    def walked(p, v, t, twist):
        steps = method(dr.opaque(Float, knob), dr.opaque(Float, twist))
        length, k = dr.opaque(Float, t), dr.opaque(Int32, twist)

        def step(s, state, cell):
            state, h, good = steps.step(state, length - s)
            p, moved = geometry.wrap(state["p"], steps.twist)
            state = steps.behind_face(state | {"p": p}, dr.any(moved != 0))
            return (dr.select(good, dr.select(h < length - s, s + h, length), s), state,
                    geometry.multiply(cell, moved, k))

        count = dr.width(p)
        _, state, cell = dr.while_loop(
            (dr.zeros(Float, count), steps.start(p, v), dr.zeros(Array3i, count)),
            lambda s, state, cell: s < length, step)
        dr.eval(state, cell)
        return state["p"], state["v"], cell
    return walked


def walk_errors(t, twist, count=4000, walked=walked):
    """Errors in cells of a wrapped walk of the length t: (where it ends, back at its start)."""
    p, v = random_rays(count)
    end, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    q, u, cell = walked(p, v, t, twist)
    wrapped = distance(truth.multiply_inverse(Array3f64(cell), end, Float64(twist)), q, twist)
    home, _, back = walked(q, -u, t, twist)
    cell = Array3f64(geometry.multiply(cell, back, Int32(twist)))
    returned = distance(p, truth.multiply(cell, Array3f64(home), Float64(twist)), twist)
    wrapped, returned = (dr.select(dr.isfinite(x), x, math.inf) for x in (wrapped, returned))
    dr.eval(wrapped, returned)
    return wrapped, returned


@pytest.mark.parametrize("twist", [1, -3])
def test_one_flow_over_a_long_way_errs_by_the_rounding_of_its_terms(twist):
    p, v = random_rays(4000)
    for t in LENGTHS:
        error = errors_of_a_way(lambda p, v, t: geometry.flow(p, v, t, twist)[0], p, v, t, twist)
        assert dr.max(error)[0] <= 8 * ROUNDING * longest_terms(t, twist)


# Largest of 4,000 rays: where a walk ends, and where it is back at its start
WALKS = {1: {1: (2.2e-7, 2.7e-7), 5: (1.3e-6, 2.1e-6), 20: (1.8e-5, 2.3e-5),
             100: (2.6e-4, 7.7e-4), 500: (5.2e-3, 0.011)},
         -3: {1: (4.1e-7, 5.2e-7), 5: (4.6e-6, 5.7e-6), 20: (5.9e-5, 8.5e-5),
              100: (1.1e-3, 1.1e-3), 500: (0.015, 0.021)}}


@pytest.mark.parametrize("t", LENGTHS)
@pytest.mark.parametrize("twist", WALKS)
def test_a_wrapped_ray_ends_where_the_unwrapped_one_does_and_walked_back_returns(twist, t):
    """To three times what was measured; to 1e-3 cells up to a length of 100 at twist 1."""
    for error, measured in zip(walk_errors(t, twist), WALKS[twist][t]):
        assert dr.max(error)[0] <= 3 * measured


def test_a_walk_by_the_directions_that_its_steps_end_in_is_lost(rgb):
    """A direction that is rounded at each step shortens: after 500 cells, and so by the ODE
    methods, which step so, rays end a cell off, a hundred times as far as by turning the first."""
    import tracing_methods

    for twist in (1, -3):
        wrapped, returned = walk_errors(
            500, twist, walked=lambda *ray: walked(*ray, chained=True))
        assert dr.max(wrapped)[0] > 1 and dr.max(returned)[0] > 2
    for name, knob in (("Runge–Kutta 4", 0.05), ("Dormand–Prince", 1e-4), ("printed form", 0.05)):
        wrapped, returned = walk_errors(
            500, 1, 500, stepped(tracing_methods.METHODS[name], knob))
        assert dr.max(wrapped)[0] > 1 and dr.max(returned)[0] > 1


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
#  What other methods give
# ---------------------------------------------------------------------------

RK4_STEP, TOLERANCE = 0.05, 1e-6


def runge_kutta(p, v, t, twist):
    import tracing_methods

    return tracing_methods.fixed_steps(p, v, t, math.ceil(t / RK4_STEP), twist)


def dormand_prince(p, v, t, twist):
    import tracing_methods

    return tracing_methods.adaptive_steps(p, v, t, TOLERANCE, twist)


def report(p, v, t, twist):
    return report_formulas.geodesic(p, v, dr.opaque(Float, t), dr.opaque(Float, twist))[0]


def package(p, v, t, twist):
    return geometry.flow(p, v, dr.opaque(Float, t), dr.opaque(Float, twist))[0]


def end_point_errors(method, p, v, t, twist=1):
    return errors_of_a_way(lambda p, v, _: method(p, v, t, twist), p, v, t, twist)


FAILURES = {
    # What is asked of a ray: w, length, distance from the origin, twist. Then errors that the
    # report's formula, Runge–Kutta 4 and Dormand–Prince exceed (0: they do not fail), and one that
    # the package does not
    "a nearly horizontal way": (1e-5, 5, 0, 1, (100, 0, 0), 8e-6),
    "a vertical way": (1.0, 5, 0, 1, (0, 1e-6, 0), 8e-7),
    "100 cells": (None, 100, 0, 1, (0.1, 1, 0.3), 2e-3),
    "500 cells": (None, 500, 0, 1, (0.1, 1000, 500), 0.04),
    "100 cells from the origin": (None, 5, 100, 1, (0.1, 5e-3, 2e-3), 1.3e-3),
    "a twist of 1e-6": (None, 5, 0, 1e-6, (1000, 5e-6, 0), 2.1e-6),
    "a twist of 8": (None, 5, 0, 8, (0.02, 0.01, 1e-3), 6e-5),
}


@pytest.mark.parametrize("where", FAILURES)
def test_each_failure_of_another_method_is_there_and_the_package_has_none(rgb, where):
    """The largest error of 4,000 rays; the package's bound is three times what was measured."""
    w, t, out, twist, lost, bound = FAILURES[where]
    p, v = random_rays(4000, w)
    for method, least in zip((report, runge_kutta, dormand_prince), lost):
        assert dr.max(end_point_errors(method, p + out, v, t, twist))[0] > least or least == 0
    assert dr.max(end_point_errors(package, p + out, v, t, twist))[0] <= bound


def test_one_command_prints_the_tables_of_failures(fresh_python):
    script = ROOT / "examples" / "failures.py"
    done = fresh_python(
        "import runpy, sys; sys.argv = ['', '--quick']\n"
        f"sys.path.insert(0, {str(script.parent)!r})\n"
        f"runpy.run_path({str(script)!r}, run_name='__main__')")
    assert done.returncode == 0, done.stderr
    rows = [line.strip(" |").split(" | ") for line in done.stdout.splitlines() if "|" in line]
    heads = [i for i, row in enumerate(rows) if row[0] == "Where"]
    assert len(heads) == 2 and len(rows) > 40
    assert all(len(row) == 5 for row in rows if not row[0].startswith("---"))
    assert rows[heads[0] + 2][:2] == ["w = 0, length 5", "NaN"]


# ---------------------------------------------------------------------------
#  Cut points
# ---------------------------------------------------------------------------

def connected(vector_t, x, y, height, twist):
    """(relative miss of ``connect``'s geodesics, connections, arrival by ``flow``) from a point off
    the origin to points at the horizontal place (x, y) and the symmetric height."""
    q = Array3f64(x, y, height + 0.5 * twist * x * y)
    p = vector_t(0.25, -0.5, 0.125)
    q = vector_t(geometry.multiply(Array3f64(p), q, twist))
    way = geometry.connect(p, q, twist)
    end, arrival = geometry.flow(p, way.direction, way.distance, twist)
    return dr.max(dr.abs(end - q)) / (1 + dr.max(dr.abs(q))), way, arrival


def about_the_cut(vector_t, twist, count=50_000):
    rng = PCG32(count, initstate=4)
    radius = dr.exp2(-40 * rng.next_float64()) * (rng.next_float64() > 0.1)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    off = dr.copysign(dr.exp2(-40 * rng.next_float64()), rng.next_float64() - 0.5)
    off *= rng.next_float64() > 0.1
    height = (2 * math.pi + off) / abs(twist)
    return connected(vector_t, radius * c, radius * s, height, twist)


def about_the_switch(vector_t, twist, side, count=50_000):
    """Points where the formula of ``connect`` changes: ζ = π R²/2 + π, the half turn π/2."""
    rng = PCG32(count, initstate=4)
    radius = dr.exp2(4 * rng.next_float64() - 2)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    zeta = math.pi * (0.5 * dr.square(0.5 * twist * radius) + 1)
    height = zeta * (1 + side * 64 * dr.epsilon(vector_t)) / twist
    return connected(vector_t, radius * c, radius * s, height, twist)


@pytest.mark.parametrize("vector_t", [Array3f, Array3f64], ids=["float32", "float64"])
@pytest.mark.parametrize("twist", [1, -2])
def test_connections_about_the_cut_point_land_on_it(vector_t, twist):
    """Random points about |ζ| = 2π and the fibre, down to and on both, from a start off the origin.

    Landing is all that can be asked for there: the direction is ill-conditioned.
    """
    miss, way, arrival = about_the_cut(vector_t, twist)
    limit = reference.LIMITS["connect"][vector_t is Array3f64]
    assert dr.all(miss <= limit)
    assert dr.all(dr.abs(dr.norm(way.direction) - 1) <= 8 * dr.epsilon(vector_t))
    assert dr.all(dr.isfinite(way.area_density) & (way.area_density >= 0))
    # As far as q is away, at most 6 cells here
    assert dr.all(dr.max(dr.abs(arrival - way.arrival)) <= 8 * limit)


@pytest.mark.parametrize("vector_t", [Array3f, Array3f64], ids=["float32", "float64"])
@pytest.mark.parametrize("twist", [1, -2])
def test_connections_are_alike_on_both_sides_of_the_switch_of_formula(vector_t, twist):
    below, above = (about_the_switch(vector_t, twist, side)[0] for side in (-1, 1))
    assert dr.max(dr.maximum(below, above))[0] <= 70 * abs(twist) * dr.epsilon(vector_t)
    assert 1 / 3 < dr.mean(above)[0] / dr.mean(below)[0] < 3
