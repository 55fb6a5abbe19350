"""Where methods fail along a single geodesic: w → 0, c → 0, long ways, sizes, small twists.

The package in float32 against float64 that shares no code with it, and beside it the formula of
the report, to show that these are the places where it fails.
"""

import math
import subprocess
import sys

import drjit as dr
import pytest
from drjit.llvm import PCG32, Array3f, Array3f64, Float, Float64

from benchmarks import face_crossing, report_formulas, truth
from benchmarks import reference_geometry as reference
from benchmarks.failures.geodesics import (
    LENGTHS,
    about_the_cut,
    about_the_switch,
    dormand_prince,
    end_point_errors,
    errors_of_a_way,
    package,
    random_rays,
    report,
    runge_kutta,
    stepped,
    walk_errors,
    walked,
)
from conftest import ENVIRONMENT, ROOT
from nil_mitsuba import geometry

ROUNDING = 2**-24


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
        return dr.max(
            errors_of_a_way(lambda p, v, t: report_formulas.geodesic(p, v, t)[0], p, v, 5.0, 1)
        )[0]

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


@pytest.mark.parametrize("twist", [1, -3])
def test_one_flow_over_a_long_way_errs_by_the_rounding_of_its_terms(twist):
    p, v = random_rays(4000)
    for t in LENGTHS:
        error = errors_of_a_way(lambda p, v, t: geometry.flow(p, v, t, twist)[0], p, v, t, twist)
        assert dr.max(error)[0] <= 8 * ROUNDING * longest_terms(t, twist)


# Largest of 4,000 rays: where a walk ends, and where it is back at its start
WALKS = {
    1: {
        1: (2.2e-7, 2.7e-7),
        5: (1.3e-6, 2.1e-6),
        20: (1.8e-5, 2.3e-5),
        100: (2.6e-4, 7.7e-4),
        500: (5.2e-3, 0.011),
    },
    -3: {
        1: (4.1e-7, 5.2e-7),
        5: (4.6e-6, 5.7e-6),
        20: (5.9e-5, 8.5e-5),
        100: (1.1e-3, 1.1e-3),
        500: (0.015, 0.021),
    },
}


@pytest.mark.parametrize("t", LENGTHS)
@pytest.mark.parametrize("twist", WALKS)
def test_a_wrapped_ray_ends_where_the_unwrapped_one_does_and_walked_back_returns(twist, t):
    """To three times what was measured; to 1e-3 cells up to a length of 100 at twist 1."""
    for error, measured in zip(walk_errors(t, twist), WALKS[twist][t]):
        assert dr.max(error)[0] <= 3 * measured


def test_a_walk_by_the_directions_that_its_steps_end_in_is_lost(rgb):
    """A direction that is rounded at each step shortens: after 500 cells, and so by the ODE
    methods, which step so, rays end a cell off, a hundred times as far as by turning the first."""
    for twist in (1, -3):
        wrapped, returned = walk_errors(500, twist, walked=lambda *ray: walked(*ray, chained=True))
        assert dr.max(wrapped)[0] > 1 and dr.max(returned)[0] > 2
    for name, knob in (("Runge–Kutta 4", 0.05), ("Dormand–Prince", 1e-4), ("printed form", 0.05)):
        wrapped, returned = walk_errors(500, 1, 500, stepped(name, knob))
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


def test_one_command_prints_the_tables_of_failures():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.failures", "--quick"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        env=ENVIRONMENT,
    )
    assert done.returncode == 0, done.stderr
    rows = [line.strip(" |").split(" | ") for line in done.stdout.splitlines() if "|" in line]
    heads = [i for i, row in enumerate(rows) if row[0] == "Where"]
    assert len(heads) == 2 and len(rows) > 40
    assert all(len(row) == 5 for row in rows if not row[0].startswith("---"))
    assert rows[heads[0] + 2][:2] == ["w = 0, length 5", "NaN"]


# ---------------------------------------------------------------------------
#  Cut points
# ---------------------------------------------------------------------------


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
