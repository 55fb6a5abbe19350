"""Nil's geometry against mpmath, against its own metric and against its symmetries."""

import random
from fractions import Fraction
from math import cos, floor, inf, isfinite, log2, pi, sin, sqrt

import drjit as dr
import mitsuba as mi
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from benchmarks import reference_geometry as reference
from nil_mitsuba import geometry

ARRAYS = [dr.llvm.Array3f, dr.llvm.Array3f64, dr.scalar.Array3f, dr.scalar.Array3f64]
every_array = pytest.mark.parametrize(
    "vector_t", ARRAYS, ids=lambda t: t.__module__.split(".")[-1] + "." + t.__name__
)
# Where the reference takes seconds: what renders here, and the others with -m verify
each_precision = pytest.mark.parametrize(
    "vector_t",
    [ARRAYS[0], *(pytest.param(array, marks=pytest.mark.verify) for array in ARRAYS[1:])],
    ids=lambda t: t.__module__.split(".")[-1] + "." + t.__name__,
)
Point = dr.scalar.Array3f64


def is_double(vector_t):
    return dr.type_v(vector_t) == dr.VarType.Float64


def limit(name, vector_t):
    return reference.LIMITS[name][is_double(vector_t)]


def assert_below(errors, column, bound):
    error, case = reference.worst(errors, column)
    assert error <= bound, f"{float(error):.2e} at {case}"


# ---------------------------------------------------------------------------
#  Against 30 digits
# ---------------------------------------------------------------------------


@every_array
@pytest.mark.parametrize("t_max", [5, 20])
def test_flow_follows_the_geodesic_within_its_limits(vector_t, t_max):
    cases = reference.flow_cases(t_max)
    assert len(cases) >= 300
    errors = reference.flow_errors(geometry, vector_t, cases)
    assert_below(errors, 0, limit(f"flow, t ≤ {t_max}", vector_t))
    assert_below(errors, 1, limit(f"flow, t ≤ {t_max}", vector_t))


@every_array
def test_area_density_is_the_jacobian_of_flow(vector_t):
    cases = reference.area_cases()
    assert len(cases) >= 300
    errors = reference.area_errors(geometry, vector_t, cases)
    assert_below(errors, 0, limit("area_density", vector_t))


@pytest.mark.parametrize(
    "vector_t, step",
    [(ARRAYS[0], 4), *(pytest.param(array, 1, marks=pytest.mark.verify) for array in ARRAYS)],
)
def test_connect_finds_the_shortest_geodesic_within_its_limits(vector_t, step):
    """All cases with -m verify, since the reference takes long, and each fourth here."""
    cases = reference.connect_cases()[::step]
    assert len(cases) >= 300 / step
    errors = reference.connect_errors(
        geometry, vector_t, cases, reference.ILL_CONDITIONED[is_double(vector_t)]
    )
    for column in range(3):
        assert_below(errors, column, limit("connect", vector_t))
    assert_below(errors, 3, limit("area_density", vector_t))
    assert_below(errors, 4, limit("connect", vector_t))


@pytest.mark.parametrize("vector_t", [ARRAYS[0], pytest.param(ARRAYS[1], marks=pytest.mark.verify)])
def test_connect_lands_on_the_point_next_to_the_end_of_the_axis_geodesics(vector_t):
    margin = reference.ILL_CONDITIONED[is_double(vector_t)]
    cases = [
        ((r, 0, sign * (2 * pi + margin * i / 10) / k), k)
        for r in (0, 1e-12, 1e-7, 1e-5, 1e-4, 1e-3)
        for i in range(-10, 11)
        for k in (0.375, 1, 3)
        for sign in (-1, 1)
    ]
    # More than landing is reached, as ζ − 2π is taken to twice the precision: no margin at all
    errors = reference.connect_errors(geometry, vector_t, cases, 0)
    for column in (0, 1, 2, 4):
        assert_below(errors, column, limit("connect", vector_t))


@every_array
def test_directions_are_as_sharp_after_a_long_way_as_after_a_short_one(vector_t):
    # To six roundings, though one rounding of the angle turned, 60 radians, is 30 times coarser
    errors = reference.flow_errors(geometry, vector_t, reference.flow_cases(20))
    assert_below(errors, 1, 6 * dr.epsilon(vector_t))


def test_flow_solves_the_geodesic_equation_of_the_metric():
    """A wrong sign or factor in the closed form, which the reference shares, would show here."""
    rng = random.Random(4)
    rows = [
        (
            [rng.uniform(-1, 1) for _ in range(3)],
            reference.unit(rng.gauss(0, 1), rng.gauss(0, 1), w),
            rng.uniform(1, 6),
            k,
        )
        for k in (-3, -1, 0, 0.375, 1, 2)
        for w in (-0.8, 0, 1e-3, 0.5, 1)
    ]
    rows, results = reference.evaluate(dr.llvm.Array3f64, geometry.flow, *zip(*rows))
    for row, (end, direction) in zip(rows, results):
        true_end, true_direction = reference.integrate(*row)
        # What the integration itself reaches
        assert reference.difference(end, true_end) / reference.size(true_end) < 1e-10, row
        assert reference.difference(direction, true_direction) < 1e-10, row


def test_the_frame_is_orthonormal_in_the_metric_and_the_inverse_metric_measures_conormals():
    p, k = Point(0.7, -0.3, 2), 1.5
    g, g_inv, _ = reference.metric(p.x, k)
    frame = [geometry.from_frame(p, Point(*e), k) for e in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    for i, a in enumerate(frame):
        for j, b in enumerate(frame):
            product = sum(a[m] * g[m][n] * b[n] for m in range(3) for n in range(3))
            assert product == pytest.approx(float(i == j), abs=1e-15)
    n = Point(0.36, -0.48, 0.8)
    length2 = sum(n[i] * g_inv[i][j] * n[j] for i in range(3) for j in range(3))
    assert dr.squared_norm(geometry.conormal(p, n, k)) == pytest.approx(length2, rel=1e-15)


def assert_no_jump(vector_t, function, truth, middle):
    """Compare ``function`` of 200 neighbouring floats on either side of ``middle`` with truth.

    The mean error, from which rounding averages out, may differ by two units in the last place
    between the sides.
    """
    ulp = 2 * dr.epsilon(vector_t)
    spacing = ulp * 2 ** floor(log2(middle))
    rows, results = reference.evaluate(
        vector_t, function, [middle + i * spacing for i in range(-200, 200)]
    )
    errors = [
        [float((value - true) / max(1, abs(true))) for value, true in zip(result, truth(*row))]
        for row, result in zip(rows, results)
    ]
    for below, above in zip(zip(*errors[:199]), zip(*errors[201:])):
        assert abs(sum(below) - sum(above)) / len(below) <= 2 * ulp
        assert max(map(abs, below + above)) <= 10 * ulp


@every_array
def test_flow_and_area_density_do_not_jump_where_their_formula_changes(vector_t):
    v, k = (0.75, 0.25, -0.625), 1  # exact in either precision; not quite a unit vector
    middle = 2 * sqrt(2) / (k * abs(v[2]))  # |k w t/2| = √2

    def values(t):
        end, direction = geometry.flow(vector_t(0), vector_t(*v), t, k)
        return (*end, *direction, geometry.area_density(t, v[2], k))

    def truth(t):
        end, direction = reference.flow((0, 0, 0), v, t, k)
        return (*end, *direction, reference.area_density(t, v[2], k))

    assert_no_jump(vector_t, values, truth, middle)


@each_precision
@pytest.mark.parametrize("r", [0, 0.125, 2, 20])
def test_connect_does_not_jump_where_it_changes_its_unknown(vector_t, r):
    middle = pi * (1 + (r / 2) ** 2 / 2)  # ζ at v = π/2

    def values(z):
        c = geometry.connect(vector_t(0), vector_t(r, 0, z), 1)
        return (*c.direction, *c.arrival, c.distance)

    def truth(z):
        direction, arrival, distance = reference.connect((0, 0, 0), (r, 0, z), 1)
        return (*direction, *arrival, distance)

    assert_no_jump(vector_t, values, truth, middle)


# ---------------------------------------------------------------------------
#  Special places
# ---------------------------------------------------------------------------


@every_array
def test_twist_zero_is_euclidean_space(vector_t):
    p, q, v = vector_t(1, 2, 3), vector_t(3, -1, 9), vector_t(0.6, 0, 0.8)
    tolerance = 4 * dr.epsilon(vector_t)
    c = geometry.connect(p, q, 0)
    assert dr.all(dr.abs(c.distance - 7) <= 7 * tolerance)
    assert dr.all(dr.abs(c.direction - (q - p) / 7) <= tolerance, axis=None)
    assert dr.all(dr.abs(c.area_density - 49) <= 49 * tolerance)
    assert dr.all(c.direction == c.arrival, axis=None)
    end, direction = geometry.flow(p, v, 10, 0)
    assert dr.all(dr.abs(end - vector_t(7, 2, 11)) <= 11 * tolerance, axis=None)
    assert dr.all(direction == v, axis=None)
    assert dr.all(geometry.area_density(5, v.z, 0) == 25)


@every_array
@pytest.mark.parametrize("twist", [-3, 0, 1e-6, 1, 8])
def test_equal_points_have_distance_zero_and_a_unit_direction(vector_t, twist):
    p = vector_t(0.3, -0.7, 0.2)
    c = geometry.connect(p, p, twist)
    assert dr.all(c.distance == 0) and dr.all(c.area_density == 0)
    assert dr.all(c.direction == vector_t(0, 0, 1), axis=None)
    assert dr.all(c.arrival == vector_t(0, 0, 1), axis=None)


@every_array
def test_the_axis_beyond_a_full_turn_is_reached_by_a_circle_of_shorter_geodesics(vector_t):
    k, height = 2, 5
    q = vector_t(0, 0, height)
    c = geometry.connect(vector_t(0, 0, 0), q, k)
    tolerance = 4 * dr.epsilon(vector_t)
    # A full turn k w T = 2π, which rises by 2π/k, around a circle, whose area adds the rest
    radius = sqrt((height - 2 * pi / k) / (k * pi))
    distance = sqrt((2 * pi / k) ** 2 + (2 * pi * radius) ** 2)
    assert distance < height
    assert dr.all(dr.abs(c.distance - distance) <= distance * tolerance)
    assert dr.all(c.direction.x > 0) and dr.all(dr.abs(c.direction.y) <= tolerance)
    assert dr.all(dr.abs(c.arrival - c.direction) <= tolerance, axis=None)
    # The circle is a caustic
    assert dr.all(dr.abs(c.area_density) <= tolerance)
    for azimuth in (1, 2.5, 4):
        a, w = c.direction.x, c.direction.z
        turned = vector_t(a * cos(azimuth), a * sin(azimuth), w)
        end, _ = geometry.flow(vector_t(0, 0, 0), turned, c.distance, k)
        assert dr.all(dr.abs(end - q) <= 5 * height * tolerance, axis=None)


@every_array
def test_area_density_is_signed_beyond_the_caustics(vector_t):
    k, w = 1, 0.75
    lengths = [2 * v / (k * w) for v in (3, 3.3, 4.2, 4.6, 6, 6.5, 7.6, 7.8)]
    rows, results = reference.evaluate(
        vector_t, lambda t, w: (geometry.area_density(t, w, k),), lengths, [w] * len(lengths)
    )
    truths = [reference.area_density(t, w, k) for t, w in rows]
    assert min(truths) < 0 < max(truths[1:])
    for (t, _), (area,), true in zip(rows, results, truths):
        # Zeros lie between these lengths: the error is relative to what the terms reach
        assert abs(area - true) <= limit("area_density", vector_t) * t * t


@every_array
def test_a_twist_of_eight_still_connects(vector_t):
    rng = random.Random(5)
    cases = [((rng.uniform(-2, 2), rng.uniform(-2, 2), rng.uniform(-9, 9)), 8) for _ in range(50)]
    errors = reference.connect_errors(geometry, vector_t, cases, 1e-4)
    assert_below(errors, 4, limit("connect", vector_t))


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono"])
def test_mitsuba_points_stay_points_and_vectors_stay_vectors(variant):
    previous = mi.variant()
    mi.set_variant(variant)
    try:
        p, q, v = mi.Point3f(0.1, 0.2, 0.3), mi.Point3f(1, 2, 3), mi.Vector3f(0, 0.6, 0.8)
        end, direction = geometry.flow(p, v, 1)
        assert type(end) is mi.Point3f and type(direction) is mi.Vector3f
        assert type(geometry.multiply(p, v)) is mi.Point3f
        assert type(geometry.to_frame(p, v)) is mi.Vector3f
        assert type(geometry.from_frame(p, v)) is mi.Vector3f
        assert type(geometry.conormal(p, mi.Normal3f(0, 0, 1))) is mi.Normal3f
        assert type(geometry.inverse(p)) is mi.Point3f
        assert type(geometry.wrap(q)[0]) is mi.Point3f
        c = geometry.connect(p, q)
        assert type(c.direction) is mi.Point3f and type(c.arrival) is mi.Point3f
        assert type(c.distance) is mi.Float and type(c.area_density) is mi.Float
    finally:
        if previous:
            mi.set_variant(previous)


def test_an_opaque_twist_shares_its_kernel():
    p, q = dr.llvm.Array3f([0.1, 1], 0.2, 0.3), dr.llvm.Array3f(1, [2, 3], 3)
    dr.eval(p, q)

    def compiled(twist):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            c = geometry.connect(p, q, twist)
            dr.eval(geometry.flow(p, c.direction, c.distance, twist))
            return sum(
                not kernel["cache_hit"]
                for kernel in dr.kernel_history()
                if kernel["type"] == dr.KernelType.JIT
            )

    twists = [dr.opaque(dr.llvm.Float, k) for k in (1, 2, 0)]
    for _ in range(2):  # what a first call leaves behind orders the kernels of all others
        compiled(twists[0])
    assert compiled(twists[1]) == 0 and compiled(twists[2]) == 0


# ---------------------------------------------------------------------------
#  Symmetries
# ---------------------------------------------------------------------------

properties = settings(max_examples=150, deadline=None, derandomize=True)
coordinate = st.floats(-2, 2, allow_subnormal=False)
a_point = st.tuples(coordinate, coordinate, coordinate).map(lambda c: Point(*c))
twist = st.one_of(st.sampled_from([-3.0, -1.0, 0.0, 1e-6, 1e-12, 1.0, 2.0]), st.floats(-3, 3))
azimuth = st.floats(-pi, pi)
fibre_component = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-12, -1e-12]), st.floats(-1, 1))
a_direction = st.builds(
    lambda f, w: Point(sqrt(1 - w * w) * cos(f), sqrt(1 - w * w) * sin(f), w),
    azimuth,
    fibre_component,
)


def close(a, b, tolerance):
    """Equal to ``tolerance`` relative to 1 + the largest component."""
    scale = 1 + max(dr.max(dr.abs(a)), dr.max(dr.abs(b)))
    return dr.max(dr.abs(a - b)) <= tolerance * scale


# The coordinates below stay under 10² and their products with the twist under 10³: 1e-12 allows
# for ten roundings of such numbers
ROUNDING = 1e-12


@properties
@given(a_point, a_point, a_point, twist)
def test_points_form_a_group(p, q, r, k):
    m = geometry.multiply
    assert close(m(m(p, q, k), r, k), m(p, m(q, r, k), k), ROUNDING)
    assert close(m(p, Point(0), k), p, 0) and close(m(Point(0), p, k), p, 0)
    assert close(m(p, geometry.inverse(p, k), k), Point(0), ROUNDING)
    assert close(m(geometry.inverse(p, k), p, k), Point(0), ROUNDING)


@properties
@given(a_point, a_point, a_point, twist)
def test_frame_components_are_read_and_written_back_and_pair_with_conormals(p, v, n, k):
    in_frame = geometry.to_frame(p, v, k)
    assert close(geometry.from_frame(p, in_frame, k), v, ROUNDING)
    assert close(dr.dot(geometry.conormal(p, n, k), in_frame), dr.dot(n, v), 10 * ROUNDING)


@properties
@given(a_point, a_point, a_direction, st.floats(0, 5), twist)
def test_left_translations_preserve_flow(h, p, v, t, k):
    end, direction = geometry.flow(p, v, t, k)
    moved, moved_direction = geometry.flow(geometry.multiply(h, p, k), v, t, k)
    assert close(geometry.multiply(h, end, k), moved, ROUNDING)
    assert close(direction, moved_direction, ROUNDING)


@properties
@given(a_point, a_point, a_point, twist)
def test_left_translations_preserve_distance_directions_and_area_density(h, p, q, k):
    a = geometry.connect(p, q, k)
    assume(a.distance > 0.1)
    # A fibre's own geodesic and the circle beyond it part here
    assume(abs(k * a.direction.z * a.distance) < 6)
    b = geometry.connect(geometry.multiply(h, p, k), geometry.multiply(h, q, k), k)
    # 30 times the rounding of the points at most, as their difference is not below 0.1, and the
    # root is less sharp by 1/sinc v ≤ 22 and its square
    assert close(a.distance, b.distance, 1e-10)
    assert close(a.direction, b.direction, 1e-10) and close(a.arrival, b.arrival, 1e-10)
    assert close(a.area_density, b.area_density, 1e-9)


@properties
@given(a_point, a_direction, st.floats(0, 20), twist)
def test_flow_there_and_back_returns_to_the_start(p, v, t, k):
    end, direction = geometry.flow(p, v, t, k)
    back, direction = geometry.flow(end, direction, -t, k)
    # The way leads up to t (1 + k t/2) away
    assert dr.max(dr.abs(back - p)) <= 1e-14 * (1 + t) * (1 + 3 * abs(k) * (1 + t))
    assert close(direction, v, 1e-13)


@properties
@given(a_point, a_direction, st.floats(0, 10), st.floats(0, 10), twist)
def test_two_short_flows_make_a_long_one(p, v, s, t, k):
    end, direction = geometry.flow(*geometry.flow(p, v, s, k), t, k)
    whole, whole_direction = geometry.flow(p, v, s + t, k)
    assert close(end, whole, ROUNDING) and close(direction, whole_direction, ROUNDING)


@properties
@given(a_point, a_direction, st.floats(0.1, 20), twist)
def test_connect_inverts_flow_up_to_half_a_turn(p, v, t, k):
    # At |v| = π, the first conjugate point of the fibre, neighbouring geodesics meet
    assume(abs(k * v.z * t) / 2 < 3)
    end, direction = geometry.flow(p, v, t, k)
    c = geometry.connect(p, end, k)
    assert abs(c.distance - t) <= 1e-11 * (1 + t) * (1 + abs(k) * t)
    assert close(c.direction, v, 1e-10) and close(c.arrival, direction, 1e-10)
    area = geometry.area_density(t, v.z, k)
    assert abs(c.area_density - area) <= 1e-9 * abs(area)


@properties
@given(a_point, a_point, twist)
def test_connections_are_never_longer_than_a_way_around(p, q, k):
    around = geometry.connect(p, Point(0), k).distance + geometry.connect(Point(0), q, k).distance
    assert geometry.connect(p, q, k).distance <= around * (1 + 1e-12) + 1e-12


@properties
@given(a_point, a_point, twist)
def test_the_way_back_is_the_same_geodesic_with_the_same_area_density(p, q, k):
    there, back = geometry.connect(p, q, k), geometry.connect(q, p, k)
    assume(there.distance > 1e-3)
    assert close(there.distance, back.distance, ROUNDING)
    assert close(there.area_density, back.area_density, 1e-10)
    if abs(k * there.direction.z * there.distance) < 6:
        assert close(there.direction, -back.arrival, 1e-10)


@properties
@given(a_direction, st.floats(0, 20), twist)
def test_area_density_does_not_depend_on_the_orientation_of_the_fibre(v, t, k):
    area = geometry.area_density(t, v.z, k)
    assert close(area, geometry.area_density(t, -v.z, k), ROUNDING)
    assert close(area, geometry.area_density(t, v.z, -k), ROUNDING)
    assert close(area, geometry.area_density(-t, v.z, k), ROUNDING)


# ---------------------------------------------------------------------------
#  The unit cell
# ---------------------------------------------------------------------------


def image(g, p, k):
    """g·p in exact arithmetic."""
    g, p = [Fraction(int(i)) for i in g], [Fraction(i) for i in p]
    return [g[0] + p[0], g[1] + p[1], g[2] + p[2] + k * g[0] * p[1]]


WRAPPED = [
    (0, 0, 0),
    (1, 1, 1),
    (-1, 0, 0),
    (0.5, 0.75, 0.25),
    (1, 0.5, 0.25),
    (-1, 0.75, 0.25),
    (-1e-9, 0.5, 0.5),
    (0.5, -1e-9, 0.5),
    (0.5, 0.5, -1e-9),
    (-1e-30, -1e-30, -1e-30),
    (3, 0.999, -2),
    (-3, 1e-9, -1e-9),
    (-7.3, 2.2, 1e-12),
] + [
    tuple(random.Random(6 + i).uniform(-s, s) for _ in range(3))
    for i, s in enumerate([1.5, 5, 30, 300, 5000] * 20)
]


@every_array
@pytest.mark.parametrize("k", [-3, 0, 1, 2])
def test_wrap_finds_the_cell_that_the_point_lies_in(vector_t, k):
    rows, results = reference.evaluate(vector_t, lambda p: geometry.wrap(p, k), WRAPPED)
    eps = dr.epsilon(vector_t)
    for (p,), (inside, g) in zip(rows, results):
        assert all(0 <= i < 1 for i in inside), (p, inside)
        assert all(isinstance(i, int) for i in g)
        # Four roundings of numbers below one, however far out the point
        error = max(abs(a - Fraction(b)) for a, b in zip(image(g, inside, k), p))
        assert error <= 4 * eps, (p, inside, g, float(error))
        assert (g[0], g[1]) == (floor(p[0]), floor(p[1]))
        # z lies in the cell below the true one only if it lies on the face to rounding
        y = Fraction(p[1]) - g[1]
        z = Fraction(p[2]) - k * g[0] * y
        assert g[2] == floor(z) or min(z % 1, 1 - z % 1) <= 4 * eps * (1 + abs(k * g[0]))


def test_crossing_one_face_in_x_can_leave_z_on_either_side():
    y = 0.75
    _, g = geometry.wrap(Point(1.25, y, 0.5), 1)
    assert list(g) == [1, 0, -1]
    _, g = geometry.wrap(Point(-0.25, y, 0.5), 1)
    assert list(g) == [-1, 0, 1]


@properties
@given(
    st.tuples(*[st.floats(-50, 50)] * 3), st.tuples(*[st.integers(-9, 9)] * 3), st.integers(-3, 3)
)
def test_wrap_does_not_depend_on_the_image_of_a_point(p, h, k):
    inside, g = geometry.wrap(Point(*p), k)
    again, g_again = geometry.wrap(geometry.multiply(Point(*h), inside, k), k)
    # The same up to the rounding of the image, which may carry a point through a face
    apart = dr.abs(again - inside)
    tolerance = 1e-14 * (1 + 10 * abs(k))
    assume(dr.all(apart < 0.5))
    assert dr.max(apart) <= tolerance
    assert list(g_again) == list(h)


def test_deck_elements_multiply_as_integers_and_act_on_points():
    g, h = dr.llvm.Array3i(1, -2, 3), dr.llvm.Array3i(-4, 5, 6)
    product = geometry.multiply(g, h, 2)
    assert type(product) is dr.llvm.Array3i and dr.all(product == [-3, 3, 19], axis=None)
    undone = geometry.multiply(g, geometry.inverse(g, 2), 2)
    assert type(undone) is dr.llvm.Array3i and dr.all(undone == 0, axis=None)
    p = dr.llvm.Array3f(0.5, 0.25, 0.125)
    moved = geometry.multiply(g, p, 2)
    assert type(moved) is dr.llvm.Array3f
    assert dr.all(moved == [1.5, -1.75, 3.625], axis=None)


def test_nothing_overflows_or_is_lost_for_points_far_out():
    far = dr.llvm.Array3f([1e4, 0, 1e-15, 3e3], [0, 1e-3, 1e-15, -3e3], [1e4, -1e4, 1e-15, 9e6])
    for k in (-3, 0, 1):
        c = geometry.connect(dr.llvm.Array3f(0), far, k)
        end, _ = geometry.flow(dr.llvm.Array3f(0), c.direction, c.distance, k)
        assert all(isfinite(i) and i < inf for i in c.distance)
        for component, true in zip(end, far):
            assert dr.all(dr.abs(component - true) <= 1e-4 * dr.max(dr.abs(far)))
