"""Where methods fail: the faces x = c, y = c and z = c, and walls that stand there.

The first crossing of a plane by a ray that starts on one side moves away, never nearer, as the
plane does. So a computed crossing that is right for a plane within ε of the true one lies between
the crossings of the planes at −ε and +ε, for grazing and tangent rays as well: no ray is left out.
"""

import math

import drjit as dr
import pytest
from drjit.llvm import Array3f, Array3f64, Bool, Float, Float64

from benchmarks import report_formulas, truth
from benchmarks.failures.crossings import (
    FURTHER,
    LONGEST,
    beyond,
    crossings_ahead,
    crossings_just_reached,
    first_crossing,
    random_rays,
    rays_off,
    sign_change,
    tangent_rays,
)
from benchmarks.tracers import SPREAD, Traced, allowance


class Plane:
    """All points whose coordinate ``axis`` is c, a number for each ray, for truth.first_hit."""

    def __init__(self, axis, c):
        self.axis, self.c = axis, c

    def implicit(self, p, velocity):
        return p[self.axis] - self.c, velocity[self.axis]

    def contains(self, p):
        return Bool(True)


def scanned(p, v, axis, c, t_max, twist, step=truth.STEP):
    return truth.first_hit([Plane(axis, c)], p, v, t_max, twist, quotient=False, step=step).t


def check_against_scan(p, v, c, axis, twist, t_max=12.0):
    """Compare every ray with the float64 scan; returns the share of rays that cross the plane."""
    t = first_crossing(p, v, axis, c, t_max, twist)

    def disagrees(p, v, c, t, step):
        side = dr.select(c > p[axis], 1, Float64(-1))
        # Ten roundings of numbers below 10³, and what the scan can tell
        ε = 2e-12
        nearer = scanned(p, v, axis, c - side * ε, t_max, twist, step)
        farther = scanned(p, v, axis, c + side * ε, t_max, twist, step)
        # The scan sees a little further than t_max
        at_end = ~dr.isfinite(t) & (farther > t_max - 1e-7)
        return dr.compress(beyond(t, nearer, farther, 1e-11) & ~at_end)

    # Where a plane is touched next to an inflection, three crossings lie within one step of the
    # scan, which sees the last of them: those rays, one in 2,000, are looked at again more closely
    again = disagrees(p, v, c, t, truth.STEP)
    count = dr.width(p)
    assert len(again) <= 1e-3 * count
    if len(again) > 0:
        rays = dr.gather(Array3f64, p, again), dr.gather(Array3f64, v, again)
        wrong = disagrees(
            *rays, dr.gather(Float64, c, again), dr.gather(Float64, t, again), truth.STEP / 100
        )
        assert len(wrong) == 0
    return dr.count(dr.isfinite(t))[0] / count


def check_faces(count, axis, twist):
    p, v, u = random_rays(count)
    p, v, c = Array3f64(p), Array3f64(v), 8 * Float64(u) - 4
    assert check_against_scan(p, v, c, axis, twist) > 0.1
    crossing = check_against_scan(*tangent_rays(count // 4, axis, twist, 12.0), axis, twist)
    # With hardly a twist a tangent ray runs along its plane
    assert crossing > 0.4 or abs(twist) < 0.1


@pytest.mark.parametrize("twist", [0, 1e-6, 1, -3])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_first_crossing_of_a_face_is_that_of_the_scan(axis, twist):
    check_faces(4000, axis, twist)


@pytest.mark.verify
@pytest.mark.parametrize("axis, twist", [(0, 1), (1, 1), (2, 1), (2, -2)])
def test_first_crossings_of_a_million_rays_are_those_of_the_scan(axis, twist):
    check_faces(800_000, axis, twist)


def largest_coordinate(p, v, t_max, twist):
    """Largest coordinate along each ray, from 20 steps."""
    largest = dr.zeros(Float64, dr.width(p))
    for i in range(21):
        q, _ = truth.flow(p, v, dr.opaque(Float64, t_max * i / 20), dr.opaque(Float64, twist))
        largest = dr.maximum(largest, dr.max(dr.abs(q)))
        dr.eval(largest)
    return largest


def check_float32(count, axis, twist):
    """``count`` random rays and as many tangent ones in float32, for a plane off by what ``flow``
    may err in it."""
    t_max = 5.0
    p, v, u = random_rays(count)
    touching = tangent_rays(count, axis, twist, t_max)
    tangent = Array3f(touching[0]), Array3f(touching[1]), Float(touching[2])
    for rays in ((p, v, 8 * u - 4), tangent):
        p, v, c = rays
        t = Float64(first_crossing(p, v, axis, c, t_max, twist))
        p, v, c = Array3f64(p), Array3f64(v), Float64(c)
        # The limit of ``flow`` for lengths up to 5, reference_geometry.py
        ε = 2e-6 * max(1, abs(twist) / 2) * (1 + largest_coordinate(p, v, t_max, twist))
        side = dr.select(c > p[axis], 1, Float64(-1))
        nearer = first_crossing(p, v, axis, c - side * ε, 2 * t_max, twist)
        farther = first_crossing(p, v, axis, c + side * ε, 2 * t_max, twist)
        # Starts within ε of the plane have no nearer one
        nearer = dr.select(dr.abs(c - p[axis]) <= ε, 0, nearer)
        at_end = ~dr.isfinite(t) & (farther > t_max * (1 - 1e-6))
        # What rounding of t itself and of its terms may do
        wrong = beyond(t, nearer, farther, 1e-6 * t_max) & ~at_end & (c != p[axis])
        assert dr.count(wrong)[0] == 0
        assert dr.all(~dr.isnan(t))


@pytest.mark.parametrize("twist", [1e-6, 1, -3])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_first_crossing_of_a_face_in_float32_is_right_to_rounding(axis, twist):
    check_float32(40_000, axis, twist)


@pytest.mark.verify
@pytest.mark.parametrize("twist", [1, -3])
def test_first_crossings_of_z_of_a_million_rays_in_float32_are_right_to_rounding(twist):
    check_float32(500_000, 2, twist)


# ---------------------------------------------------------------------------
#  What other methods give
# ---------------------------------------------------------------------------


@pytest.mark.parametrize("vector_t", [Array3f, Array3f64], ids=["float32", "float64"])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_reports_crossing_of_the_face_ahead_is_wrong_for_half_of_all_rays(vector_t, axis):
    """x = c by the arcsine, y = c by the arccosine: one branch of two.

    Of the rays from the unit cell that meet the face they head for within 20 cells; three quarters
    would be the share if each branch were right by chance for one half of each half circle.
    """
    p, v, face, exact = crossings_ahead(vector_t, axis)
    formula = (report_formulas.crossing_of_x, report_formulas.crossing_of_y)[axis]
    meets = dr.count(exact <= LONGEST)[0]
    found = Float64(formula(p, v, face))
    missed = dr.count((exact <= LONGEST) & ~(dr.abs(found - exact) <= 1e-3))[0]
    assert 0.45 < missed / meets < 0.55
    assert rays_off(found, exact) >= missed
    # The same rays, both branches, in the same precision
    assert rays_off(first_crossing(p, v, axis, face, FURTHER), exact) == 0


@pytest.mark.parametrize("name", ["Runge–Kutta 4", "Dormand–Prince"])
def test_chords_of_an_ode_method_pass_faces_that_a_ray_only_just_crosses(rgb, name):
    """One in 1,000 faces ahead, one in 30 planes that are crossed twice within a chord."""
    for axis in range(3):
        p, v, face, exact = crossings_ahead(Array3f, axis)
        off = rays_off(sign_change(name, p, v, axis, face, FURTHER), exact)
        assert 5e-4 < off / dr.width(p) < 0.01
        assert rays_off(first_crossing(p, v, axis, face, FURTHER), exact) <= 1
    p, v, c, exact = crossings_just_reached()
    off = rays_off(sign_change(name, p, v, 2, c, 12.0), exact, 0.01, 11.9)
    assert 0.02 < off / dr.width(p) < 0.06
    assert rays_off(first_crossing(p, v, 2, c, 12.0), exact, 0.01, 11.9) <= 1


# ---------------------------------------------------------------------------
#  Walls
# ---------------------------------------------------------------------------


@pytest.mark.parametrize("twist", [0, 1e-6, 0.3, 1, 2, 3, 8])
def test_walls_of_a_room_are_met_where_their_planes_are_crossed(rgb, twist):
    """No ray leaves the cube |x|, |y|, |z| ≤ 1 early, late, or never, through edges neither."""
    p, v, _ = random_rays(40_000, -0.99, 0.99)
    hit = Traced({"s0": {"type": "cube"}}, p, v, twist, False, math.inf)
    assert dr.all(hit.valid)
    p, v, t = Array3f64(p), Array3f64(v), hit.t
    δ = allowance(t, twist)

    def leaves_room(half_width):
        walls = [
            first_crossing(p, v, axis, side * half_width, 40.0, twist)
            for axis in range(3)
            for side in (-1, 1)
        ]
        nearest = walls[0]
        for wall in walls[1:]:
            nearest = dr.minimum(nearest, wall)
        return nearest

    wrong = dr.count(beyond(t, leaves_room(1 - δ), leaves_room(1 + δ), δ))[0]
    assert wrong == 0


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("twist", [1, -2])
def test_a_wall_through_the_cell_is_met_through_all_other_faces(rgb, axis, twist):
    """The images of a wall x = c, as of y = c, are the planes x = c + n: rays on their way to them
    are wrapped at the faces of the cube, and come out where the unwrapped geodesic does."""
    c, t_max, count = 0.4, 12.0, 40_000
    corner, u, w = [0.0] * 3, [0.0] * 3, [0.0] * 3
    corner[axis], u[1 - axis], w[2] = c, 1.0, 1.0
    wall = truth.Rectangle(tuple(corner), tuple(u), tuple(w))
    p, v, _ = random_rays(count, 0, 1)
    p[axis] = dr.select(dr.abs(p[axis] - c) < 0.01, p[axis] + 0.02, p[axis])
    hit = Traced(truth.to_mitsuba([wall], rgb), p, v, twist, True, t_max)

    p, v, t = Array3f64(p), Array3f64(v), hit.t
    below = dr.select(p[axis] > c, c, c - 1)

    def leaves_layer(δ):
        lower = first_crossing(p, v, axis, below - δ, t_max + 1, twist)
        upper = first_crossing(p, v, axis, below + 1 + δ, t_max + 1, twist)
        return dr.minimum(lower, upper), lower < upper

    δ = 2e-5 + 2e-6 * dr.minimum(t, t_max)
    early, late, (exact, down) = leaves_layer(-δ)[0], leaves_layer(δ)[0], leaves_layer(0.0)
    at_end = ~dr.isfinite(t) & (late > t_max - 1e-4)
    wrong = beyond(t, early, late, δ) & ~at_end
    # A ray that grazes the plane within its cone may go either way
    grazing = wrong & ~beyond(
        t, leaves_layer(-SPREAD * t_max)[0], leaves_layer(SPREAD * t_max)[0], SPREAD * t_max
    )
    assert dr.count(wrong & ~grazing)[0] == 0
    assert dr.count(wrong)[0] <= 1e-4 * count
    # The copy that was hit is the one that the plane belongs to
    number = Float64(hit.g[axis])
    expected = dr.select(down, below - c, below - c + 1)
    sure = dr.abs(t - exact) < 0.01
    assert dr.count(sure & (dr.abs(number - expected) > 0.5))[0] == 0
    assert dr.count(sure)[0] > 0.5 * count


@pytest.mark.parametrize("twist", [0, 1, -2])
def test_a_wall_across_the_fibres_is_met_where_its_plane_is_crossed(rgb, twist):
    """The images of z = c in one column of cells, 0 < x < 1, are the planes z = c + n."""
    c, t_max, count = 0.4, 12.0, 40_000
    wall = truth.Rectangle((0.0, 0.0, c), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    p, v, _ = random_rays(count, 0, 1)
    p.z = dr.select(dr.abs(p.z - c) < 0.01, p.z + 0.02, p.z)
    hit = Traced(truth.to_mitsuba([wall], rgb), p, v, twist, True, t_max)

    p, v, t = Array3f64(p), Array3f64(v), hit.t
    column = dr.minimum(
        first_crossing(p, v, 0, Float64(0), t_max, twist),
        first_crossing(p, v, 0, Float64(1), t_max, twist),
    )
    below = dr.select(p.z > c, c, c - 1)

    def leaves_layer(δ):
        return dr.minimum(
            first_crossing(p, v, 2, below - δ, t_max + 1, twist),
            first_crossing(p, v, 2, below + 1 + δ, t_max + 1, twist),
        )

    δ = allowance(dr.minimum(t, t_max), twist)
    early, late = leaves_layer(-δ), leaves_layer(δ)
    inside = late < dr.minimum(column, t_max) - 1e-3
    wrong = inside & beyond(t, early, late, δ)
    wide = SPREAD * t_max * math.sqrt(1 + twist**2)
    grazing = wrong & ~beyond(t, leaves_layer(-wide), leaves_layer(wide), wide)
    assert dr.count(wrong & ~grazing)[0] == 0
    assert dr.count(wrong)[0] <= 1e-4 * count
    assert dr.count(inside)[0] > 0.3 * count
