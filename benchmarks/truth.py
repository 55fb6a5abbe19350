"""
First hits of exact geodesics in Nil and in its quotient, in float64.

This is what the renderer is measured against, so it shares no code and no method with it: no
chords, no acceleration structure, no package import. Every ray is followed along the closed form
of its geodesic in small steps, and the implicit function of every surface is bracketed in them.

Conventions: Nil is R^3 with p·q = (x + x', y + y', z + z' + k x y') and twist k; directions are
components in the left-invariant frame E1 = dx, E2 = dy + k x dz, E3 = dz; lengths are in cells.
A deck element g = (gx, gy, gz) is the left translation p -> g·p by an integer point, and surfaces
are sets of coordinates (a sphere is |p - c| = r in coordinates).
"""

import math
from dataclasses import dataclass

import drjit as dr
from drjit.llvm import Array3f64, Array3i, Bool, Float64, Int32, UInt32, UInt64

STEP = 0.02  # arc length of one step of the scan, in cells; see first_hit()
ROOT_WIDTH = 1e-12  # arc length to which roots and cell crossings are bracketed
OVERLAP = 1e-8  # intervals of the scan overlap by this, so that no root falls between two
# A ray has left its cell when it is this far outside: above rounding, so that a ray along a face
# does not change cells for ever
FACE = 2e-13
NO_SURFACE = -1  # label of a ray that hits nothing


# ---------------------------------------------------------------------------------------------
#  The group and its geodesics
# ---------------------------------------------------------------------------------------------


def multiply(p, q, twist):
    """Group product p·q."""
    return Array3f64(p.x + q.x, p.y + q.y, p.z + q.z + twist * p.x * q.y)


def multiply_inverse(p, q, twist):
    """Group product p⁻¹·q: q as it is seen from p. Exact where p is a lattice point near q."""
    dy = q.y - p.y
    return Array3f64(q.x - p.x, dy, q.z - p.z - twist * p.x * dy)


def coordinate_velocity(p, v, twist):
    """Coordinate components, at p, of the frame direction v."""
    return Array3f64(v.x, v.y, v.z + twist * p.x * v.y)


def flow(p, v, t, twist):
    """
    Position and frame direction after arc length t of the geodesic from p along v.

    Written with the half angle h = k w t / 2: the horizontal part of a geodesic is a circular
    arc, whose chord has length c t sinc(h) and lies at the angle h from the start direction. The
    height over that chord is w t plus k/2 times twice the circular segment between them (the
    symmetric coordinate z - k x y / 2 of the report VISGRAF TR-19-06's curves).
    """
    u = twist * v.z * t
    sin_h, cos_h = dr.sincos(0.5 * u)
    sinc_h = dr.select(u == 0, 1, sin_h / dr.select(u == 0, 1, 0.5 * u))

    x = t * sinc_h * (v.x * cos_h - v.y * sin_h)
    y = t * sinc_h * (v.y * cos_h + v.x * sin_h)
    segment = t * t * (v.x * v.x + v.y * v.y) * _segment(u, 2 * sin_h * cos_h)
    end = Array3f64(x, y, v.z * t + 0.5 * twist * (segment + x * y))

    cos_u, sin_u = 1 - 2 * sin_h * sin_h, 2 * sin_h * cos_h
    turned = Array3f64(v.x * cos_u - v.y * sin_u, v.y * cos_u + v.x * sin_u, v.z)
    return multiply(p, end, twist), turned


def _segment(u, sin_u):
    """(u - sin u) / u², by its Taylor series where the difference would lose more than 3 bits."""
    u2 = u * u
    series = Float64(1)
    # (2n + 2)(2n + 3) for n = 8 … 1: at |u| = 1 the first term left out is below 1e-16
    for divisor in (342, 272, 210, 156, 110, 72, 42, 20):
        series = 1 - u2 / divisor * series
    near = dr.abs(u) < 1
    return dr.select(near, u / 6 * series, (u - sin_u) / dr.select(near, 1, u2))


# ---------------------------------------------------------------------------------------------
#  Surfaces
# ---------------------------------------------------------------------------------------------


def _sub(a, b):
    return tuple(x - y for x, y in zip(a, b))


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@dataclass(frozen=True)
class Sphere:
    """The points at coordinate distance `radius` from `center`."""

    center: tuple
    radius: float

    def implicit(self, p, velocity):
        """Implicit function at p and its rate of change along a coordinate velocity."""
        d = p - Array3f64(*self.center)
        return dr.squared_norm(d) - self.radius**2, 2 * dr.dot(d, velocity)

    def contains(self, p):
        """Whether a zero p of the implicit function belongs to the surface."""
        return Bool(True)

    def to_mitsuba(self, mi):
        """Mitsuba's description of the shape."""
        return {"type": "sphere", "center": list(self.center), "radius": self.radius}


@dataclass(frozen=True)
class Rectangle:
    """The parallelogram `corner` + α `u` + β `v` with α and β in [0, 1]."""

    corner: tuple
    u: tuple
    v: tuple

    def __post_init__(self):
        n = _cross(self.u, self.v)
        n2 = _dot(n, n)
        # Reciprocal basis: α and β are products with the first two
        object.__setattr__(self, "_normal", tuple(x / math.sqrt(n2) for x in n))
        object.__setattr__(self, "_alpha", tuple(x / n2 for x in _cross(self.v, n)))
        object.__setattr__(self, "_beta", tuple(x / n2 for x in _cross(n, self.u)))

    def implicit(self, p, velocity):
        """Implicit function at p and its rate of change along a coordinate velocity."""
        n = Array3f64(*self._normal)
        return dr.dot(n, p - Array3f64(*self.corner)), dr.dot(n, velocity)

    def contains(self, p):
        """Whether a zero p of the implicit function belongs to the surface."""
        d = p - Array3f64(*self.corner)
        alpha, beta = dr.dot(Array3f64(*self._alpha), d), dr.dot(Array3f64(*self._beta), d)
        return (alpha >= 0) & (alpha <= 1) & (beta >= 0) & (beta <= 1)

    def to_mitsuba(self, mi):
        """Mitsuba's description of the shape: its rectangle is [-1, 1]² before `to_world`."""
        columns = [
            [0.5 * x for x in self.u],
            [0.5 * x for x in self.v],
            self._normal,
            [c + 0.5 * (x + y) for c, x, y in zip(self.corner, self.u, self.v)],
        ]
        rows = [[float(column[i]) for column in columns] for i in range(3)] + [[0, 0, 0, 1]]
        return {"type": "rectangle", "to_world": mi.ScalarTransform4f(rows)}


@dataclass(frozen=True)
class Cylinder:
    """The points at coordinate distance `radius` from the segment `p0` `p1`, without caps."""

    p0: tuple
    p1: tuple
    radius: float

    def _split(self, vector):
        """Component along the axis, as a fraction of its length, and the vector across it."""
        axis = _sub(self.p1, self.p0)
        along = dr.dot(Array3f64(*(x / _dot(axis, axis) for x in axis)), vector)
        return along, vector - along * Array3f64(*axis)

    def implicit(self, p, velocity):
        """Implicit function at p and its rate of change along a coordinate velocity."""
        across = self._split(p - Array3f64(*self.p0))[1]
        return dr.squared_norm(across) - self.radius**2, 2 * dr.dot(across, velocity)

    def contains(self, p):
        """Whether a zero p of the implicit function belongs to the surface."""
        along = self._split(p - Array3f64(*self.p0))[0]
        return (along >= 0) & (along <= 1)

    def to_mitsuba(self, mi):
        """Mitsuba's description of the shape."""
        return {"type": "cylinder", "p0": list(self.p0), "p1": list(self.p1), "radius": self.radius}


def to_mitsuba(surfaces, mi):
    """The surfaces as entries s0, s1, … of a dictionary for `mi.load_dict` (cell = scene unit)."""
    return {f"s{i}": surface.to_mitsuba(mi) for i, surface in enumerate(surfaces)}


# ---------------------------------------------------------------------------------------------
#  First hits
# ---------------------------------------------------------------------------------------------


@dataclass
class Hit:
    """First hits: arrays of one entry per ray."""

    t: Float64  # arc length in cells, infinite where nothing is hit
    label: Int32  # index of the surface, NO_SURFACE where nothing is hit
    g: Array3i  # deck element: the image g·S of the surface S was hit (0 in plain Nil)
    p: Array3f64  # position in the universal cover (at the last step where nothing is hit)
    p_cell: Array3f64  # position g⁻¹·p in the home cell, where it lies on S itself
    v: Array3f64  # frame direction, the same in the cover and in the cell


def first_hit(surfaces, p, v, t_max, twist, quotient, step=STEP):
    """
    First hit of the geodesic from p along v with any of the surfaces, before arc length t_max.

    p: Array3f64, starts in cells. v: Array3f64, unit frame directions. t_max: finite, cells. With
    `quotient`, the surfaces are repeated by the integer lattice and only their parts inside the
    unit cube exist (a surface lying in a face of the cube does, and is seen from both sides); p
    may lie in any cell. Otherwise all that there is are the surfaces as given, in plain Nil. A
    ray that starts on a surface (within OVERLAP) hits it at once. Returns a Hit.

    Why a scan is enough. In each step a surface is hit if its implicit function F changes sign,
    or if F turns back on its way to zero (F' changes sign) and has crossed zero at its extremum,
    which is then found and both sides of it searched. So two hits in one step, however close, are
    missed only if F' has two zeros in it: F = F' = F'' = 0 to within a step's reach, |F'| of the
    order step² and |F| of the order step³, which is two conditions on a ray and not the one
    that makes a silhouette: some 1e-9 of all rays. In the quotient the local coordinates of the
    current cell are followed. A step ends where one of them turns back, and where the ray leaves
    the cell, which is bracketed to ROOT_WIDTH; so each step lies in one cell. (Surfaces in a face
    are the exception: below slopes of FACE / OVERLAP against it they may be missed.)
    """
    if len(surfaces) > 32:
        raise ValueError("first_hit() keeps its candidates in 32 bits: at most 32 surfaces.")
    twist, t_max = dr.opaque(Float64, twist), Float64(t_max)
    p, v = Array3f64(p), Array3f64(v)

    def local(g, t):
        """Position in cell g and its coordinate velocity, after arc length t."""
        q, direction = flow(p, v, t, twist)
        q = multiply_inverse(g, q, twist)
        return q, coordinate_velocity(q, direction, twist)

    def scan(t, t_hit, label, g_hit):
        q, direction = flow(p, v, t, twist)
        g = _cell(q, twist) if quotient else Array3f64(0)
        q0 = multiply_inverse(g, q, twist)
        velocity0 = coordinate_velocity(q0, direction, twist)

        t1 = dr.minimum(t + step, t_max)
        if quotient:
            t1 = dr.minimum(t1, t + _turning_point(q0, direction, twist, step))
            t1 = _leave_cell(local, g, t, q0, t1)
        # No ray can be stuck between two cells, whatever is rounded
        t1 = dr.maximum(t1, t + 0.1 * OVERLAP)
        q1, velocity1 = local(g, t1)

        # The overlap, to first order: what is left out is of the order 1e-16
        q0, q1 = q0 - OVERLAP * velocity0, q1 + OVERLAP * velocity1
        candidates = UInt32(0)
        for i, surface in enumerate(surfaces):
            f0, df0 = surface.implicit(q0, velocity0)
            f1, df1 = surface.implicit(q1, velocity1)
            candidates |= dr.select(
                (f0 * f1 <= 0) | _may_touch(f0, df0, f1, df1, step), UInt32(1 << i), UInt32(0)
            )

        t_root, index = _first_root(
            surfaces, candidates, lambda s: local(g, s), t - OVERLAP, t1 + OVERLAP
        )
        hit = t_root < t_hit
        return (
            t1,
            dr.select(hit, t_root, t_hit),
            dr.select(hit, index, label),
            dr.select(hit, g, g_hit),
        )

    size = dr.width(p, v, t_max)
    t, t_hit, label, g = dr.while_loop(
        (
            dr.zeros(Float64, size),
            dr.full(Float64, math.inf, size),
            dr.full(Int32, NO_SURFACE, size),
            dr.zeros(Array3f64, size),
        ),
        lambda t, t_hit, label, g: (t < t_max) & (t_hit == math.inf),
        scan,
        label="scan",
    )

    missed = t_hit > t_max  # the overlap reaches beyond the last step
    t_hit = dr.select(missed, math.inf, dr.maximum(t_hit, 0))
    label = dr.select(missed, NO_SURFACE, label)
    q, direction = flow(p, v, dr.select(missed, t, t_hit), twist)
    if quotient:
        g = dr.select(missed, _cell(q, twist), g)
    hit = Hit(t_hit, label, Array3i(g), q, multiply_inverse(g, q, twist), direction)
    dr.eval(hit)
    return hit


def _cell(p, twist):
    """Lattice point g for which g⁻¹·p lies in [0, 1)³."""
    gx, gy = dr.floor(p.x), dr.floor(p.y)
    return Array3f64(gx, gy, dr.floor(multiply_inverse(Array3f64(gx, gy, 0), p, twist).z))


def _turning_point(q, v, twist, step):
    """
    Arc length to where a coordinate first turns back, or `step` if that is not before it.

    Extrapolated from the first two derivatives; the next step starts near it and corrects it, so
    what can leave the cell and come back unseen goes less than about 1e-10 beyond the face.
    """
    acceleration = Array3f64(
        -twist * v.z * v.y,
        twist * v.z * v.x,
        twist * v.x * v.y + dr.square(twist) * q.x * v.z * v.x,
    )
    first = Float64(step)
    for d, dd in zip(coordinate_velocity(q, v, twist), acceleration):
        turn = -d / dr.select(dd == 0, 1, dd)
        # Nearer than 1e-6 cells we are there: the excursion is below (1e-6)²
        first = dr.select((dd != 0) & (turn > 1e-6), dr.minimum(first, turn), first)
    return first


def _leave_cell(local, g, t0, q0, t1):
    """Where a ray inside cell g at t0 is first outside of it, t1 if that is not before t1."""

    def excess(q):
        return dr.max(dr.maximum(-q, q - 1))

    def outside(q):
        return dr.any((q < -FACE) | (q > 1 + FACE))

    q1 = local(g, t1)[0]
    return _bracket(
        lambda t: excess(local(g, t)[0]),
        lambda t, f: outside(local(g, t)[0]),
        t0,
        t1,
        excess(q0),
        excess(q1),
        outside(q1),
    )[1]


def _may_touch(f0, df0, f1, df1, step):
    """
    Whether |F| falls and rises again within a step, and far enough to reach zero.

    F' changes sign, so while it is monotonous F moves by no more than step · max |F'| at the
    ends; twice that leaves room where it is not.
    """
    turns = (f0 * df0 <= 0) & (f1 * df1 >= 0)
    reach = 2 * step * dr.maximum(dr.abs(df0), dr.abs(df1))
    return turns & (dr.minimum(dr.abs(f0), dr.abs(f1)) <= reach)


def _first_root(surfaces, candidates, local, t0, t1):
    """Arc length and index of the first hit in [t0, t1] among the surfaces whose bit is set."""

    def implicit(index, t):
        q, velocity = local(t)
        value, slope, inside = Float64(0), Float64(0), Bool(False)
        for i, surface in enumerate(surfaces):
            f, df = surface.implicit(q, velocity)
            this = index == i
            value, slope = dr.select(this, f, value), dr.select(this, df, slope)
            inside |= this & surface.contains(q)
        return value, slope, inside

    def refine(candidates, best, best_index):
        index = Int32(dr.tzcnt(candidates))
        candidates &= candidates - 1
        f0, df0, _ = implicit(index, t0)
        f1, df1, _ = implicit(index, t1)

        # Split at the extremum where there is no sign change to rely on
        split = f0 * f1 > 0
        a, b = _bracket(
            lambda t: implicit(index, t)[1],
            lambda t, df: df * df1 > 0,
            t0,
            t1,
            df0,
            df1,
            split & (df0 * df1 < 0),
        )
        t_middle = dr.select(split, 0.5 * (a + b), t1)
        f_middle = implicit(index, t_middle)[0]

        for a, b, fa, fb, possible in (
            (t0, t_middle, f0, f_middle, Bool(True)),
            (t_middle, t1, f_middle, f1, split),
        ):
            possible &= fa * fb <= 0
            lower, upper = _bracket(
                lambda t: implicit(index, t)[0],
                lambda t, f: f * fa <= 0,
                a,
                b,
                fa,
                fb,
                possible & (fa * fb < 0),
            )
            root = dr.select(fa == 0, a, dr.select(fb == 0, b, 0.5 * (lower + upper)))
            closer = possible & (root < best) & implicit(index, root)[2]
            best, best_index = dr.select(closer, root, best), dr.select(closer, index, best_index)
        return candidates, best, best_index

    _, best, index = dr.while_loop(
        (candidates, dr.full(Float64, math.inf), Int32(NO_SURFACE)),
        lambda candidates, best, index: candidates != 0,
        refine,
        label="refine",
    )
    return best, index


def _bracket(f, beyond, a, b, fa, fb, active):
    """
    Narrow [a, b] to ROOT_WIDTH around the first place found where `beyond(t, f(t))` holds.

    `beyond` is false at a and true at b, and f goes from the sign of fa to that of fb. False
    position with the Illinois weights; a proposal keeps half a width from both ends, so that the
    far end comes close too; bisection after 12 steps, for f that false position cannot follow.
    Where not `active`, [a, b] is returned as it is.
    """

    def narrow(a, b, fa, fb, n):
        m = dr.select(fa * fb < 0, b - fb * (b - a) / (fb - fa), 0.5 * (a + b))
        m = dr.select(n < 12, m, 0.5 * (a + b))
        m = dr.clip(m, a + 0.5 * ROOT_WIDTH, b - 0.5 * ROOT_WIDTH)
        fm = f(m)
        right = beyond(m, fm)
        return (
            dr.select(right, a, m),
            dr.select(right, m, b),
            dr.select(right, 0.5 * fa, fm),
            dr.select(right, fm, 0.5 * fb),
            n + 1,
        )

    lower, upper, _, _, _ = dr.while_loop(
        (a, b, fa, fb, UInt32(0)),
        lambda a, b, fa, fb, n: active & (b - a > ROOT_WIDTH),
        narrow,
        label="bracket",
    )
    return lower, upper


# ---------------------------------------------------------------------------------------------
#  Measures of a renderer's answer
# ---------------------------------------------------------------------------------------------


def across_error(p, v, t, q, twist):
    """
    Distance of the point q from the geodesic from p along v, measured across it, in cells.

    q: Array3f64 in the universal cover, close to the geodesic at arc length t (which need not be
    accurate). The foot of the perpendicular is found by projecting on the tangent; each round
    shrinks what is left by the factor (distance · curvature), so that six do from 1e-2.
    """
    p, v, q, twist = Array3f64(p), Array3f64(v), Array3f64(q), Float64(twist)
    s = Float64(t)
    for _ in range(6):
        foot, tangent = flow(p, v, s, twist)
        s = s + dr.dot(_frame_offset(foot, q, twist), tangent)
    return dr.norm(_frame_offset(flow(p, v, s, twist)[0], q, twist))


def _frame_offset(p, q, twist):
    """Frame components at p of the step to the nearby point q (right to second order)."""
    d = multiply_inverse(p, q, twist)
    return Array3f64(d.x, d.y, d.z - 0.5 * twist * d.x * d.y)


def surface_hash(label, g):
    """One UInt64 for a surface and a deck element (16 bits each: |g| < 2¹⁵), 0 for no surface."""
    hashed = UInt64(UInt32(label + 1))
    for component in g:
        hashed = (hashed << 16) | UInt64(UInt32(component + 32768))
    return dr.select(label == NO_SURFACE, 0, hashed)


def near_silhouette(hashes, width, height):
    """
    Which pixels are within one pixel of a silhouette: one of the 8 neighbours has another hash.

    hashes: UInt64 of width × height entries, row by row, from surface_hash(). Returns a Bool of
    the same size. Beyond the image's border there is nothing to differ from.
    """
    pixel = dr.arange(Int32, width * height)
    x, y = pixel % width, pixel // width
    differs = dr.zeros(Bool, width * height)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            neighbour = dr.clip(y + dy, 0, height - 1) * width + dr.clip(x + dx, 0, width - 1)
            differs |= dr.gather(UInt64, hashes, UInt32(neighbour)) != hashes
    return differs


# ---------------------------------------------------------------------------------------------
#  Test scenes
# ---------------------------------------------------------------------------------------------


def cell_scene():
    """
    A scene for the quotient: ten surfaces strictly inside the unit cube, most of it free.

    Rays go 2 to 4 cells on average at twist 2 to 0. The odd digits keep lattice directions from
    meeting edges exactly, where there is no truth to speak of.
    """
    return [
        Rectangle((0.20, 0.20, 0.04), (0.60, 0, 0), (0, 0.60, 0)),  # floor
        Sphere((0.55, 0.50, 0.60), 0.12),
        Sphere((0.22, 0.25, 0.22), 0.10),
        Sphere((0.82, 0.28, 0.78), 0.07),
        Sphere((0.30, 0.80, 0.88), 0.05),
        Sphere((0.78, 0.80, 0.12), 0.03),
        Rectangle((0.10, 0.55, 0.25), (0.12, 0.16, 0), (-0.08, 0.06, 0.15)),  # slanted
        Cylinder((0.85, 0.88, 0.20), (0.90, 0.84, 0.80), 0.02),
        Cylinder((0.15, 0.12, 0.70), (0.60, 0.15, 0.92), 0.01),
        Rectangle((0.93, 0.3017, 0.2039), (0, 0.2111, 0), (0, 0, 0.2523)),  # facing x
    ]


def room_scene():
    """A scene for plain Nil: an open room of two units around the origin and what stands in it."""
    return [
        Rectangle((-1, -1, -1), (2, 0, 0), (0, 2, 0)),  # floor
        Rectangle((-1, 1, -1), (2, 0, 0), (0, 0, 2)),  # back wall
        Rectangle((-1, -1, -1), (0, 2, 0), (0, 0, 2)),  # left wall
        Sphere((0.30, 0.20, -0.50), 0.40),
        Sphere((-0.55, 0.45, -0.75), 0.20),
        Sphere((0.60, -0.50, 0.30), 0.12),
        Rectangle((-0.70, 0.10, 0.10), (0.36, 0.48, 0), (-0.16, 0.12, 0.40)),  # slanted
        Cylinder((0.70, 0.70, -0.95), (0.60, 0.75, 0.90), 0.05),
        Cylinder((-0.80, -0.60, 0.60), (0.50, -0.20, 0.85), 0.02),
    ]
