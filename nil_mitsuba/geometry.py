"""Closed-form geometry of Nil: group, geodesics, area density and unit cell.

Nil is R³ with the product ``p·q = (x + x', y + y', z + z' + k x y')``, where the *twist* ``k``
is 1 in VISGRAF TR-19-06 and 0 in Euclidean space. Left translations are its isometries, and they
leave the components of a direction in the orthonormal frame ``E1 = ∂x``, ``E2 = ∂y + k x ∂z``,
``E3 = ∂z`` unchanged. Every direction taken or returned here is in frame components, every length
is in cells.

All functions take the 3-vectors of any Dr.Jit backend (scalar or JIT, 32 or 64 bit, with or
without gradients, Mitsuba's points and vectors included), return points in the type of the point
and directions in the type of the direction they were given, and need no Mitsuba variant. ``twist``
is a Python number or a Dr.Jit float; pass ``dr.opaque`` values to share kernels between twists.
"""

from dataclasses import dataclass
from math import factorial, pi

import drjit as dr

__all__ = [
    "Connection",
    "area_density",
    "connect",
    "conormal",
    "flow",
    "from_frame",
    "inverse",
    "multiply",
    "to_frame",
    "wrap",
]


# ---------------------------------------------------------------------------
#  Group and frame
# ---------------------------------------------------------------------------


def multiply(p, q, twist=1):
    """Product ``p·q``: the left translation by ``p`` applied to ``q``.

    ``p``, ``q``: points in cells. Either may be a deck element of three integers; the result has
    the type of ``p``, or of ``q`` when only ``p`` is integral.
    """
    result_t = type(q) if dr.is_integral_v(p) and not dr.is_integral_v(q) else type(p)
    p, q = result_t(p), result_t(q)
    return result_t(p.x + q.x, p.y + q.y, dr.fma(twist * p.x, q.y, p.z + q.z))


def inverse(p, twist=1):
    """Group inverse ``p⁻¹`` with ``p·p⁻¹ = p⁻¹·p = 0``, in cells and the type of ``p``."""
    return type(p)(-p.x, -p.y, dr.fma(twist * p.x, p.y, -p.z))


def to_frame(p, v, twist=1):
    """Frame components at ``p`` (in cells) of a coordinate vector ``v``."""
    return type(v)(v.x, v.y, dr.fma(-twist * p.x, v.y, v.z))


def from_frame(p, v, twist=1):
    """Coordinate vector at ``p`` (in cells) with the frame components ``v``."""
    return type(v)(v.x, v.y, dr.fma(twist * p.x, v.y, v.z))


def conormal(p, n, twist=1):
    """Frame components at ``p`` (in cells) of the Euclidean unit normal ``n``, a covector.

    Its length is the ratio of Nil area to coordinate area; divided by its length it is the unit
    normal of Nil.
    """
    return type(n)(n.x, dr.fma(twist * p.x, n.z, n.y), n.z)


# ---------------------------------------------------------------------------
#  What inner loops need often
# ---------------------------------------------------------------------------

# One instruction on x86; dr.minimum and dr.maximum take seven each, to pass on what is not a number


def smaller(x, y):
    """The smaller of two numbers; ``y`` if one of them is not a number."""
    return dr.select(x < y, x, y)


def larger(x, y):
    """The larger of two numbers; ``y`` if one of them is not a number."""
    return dr.select(x > y, x, y)


# ---------------------------------------------------------------------------
#  Elementary functions of the half turn v
# ---------------------------------------------------------------------------


def _is_double(x):
    # The components of scalar arrays, of 32 bit too, are Python floats
    return not dr.is_array_v(x) or dr.type_v(x) == dr.VarType.Float64


def _polynomial(y, coefficients):
    result = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        result = dr.fma(result, y, coefficient)
    return result


def _cos_series(y, double):
    # On v² = y ≤ 2.5 the first term left out is below 7e-9, or 2e-17
    return _polynomial(y, [(-1) ** n / factorial(2 * n) for n in range(11 if double else 7)])


def _g_series(y, double):
    # On v² = y ≤ 2.5 the first term left out is below 7e-9 of the sum, or 2e-17
    return _polynomial(
        y, [(-1) ** n * (2 * n + 2) / factorial(2 * n + 3) for n in range(10 if double else 6)]
    )


def _length(x, y):
    # dr.hypot divides by zero at the origin, which Python floats refuse
    largest = dr.maximum(dr.abs(x), dr.abs(y))
    scale = dr.rcp(dr.select(largest > 0, largest, 1.0))
    return largest * dr.sqrt(dr.square(x * scale) + dr.square(y * scale))


def _half_turn(t, w, twist):
    """``v = k w t/2`` with its sine and cosine.

    The angle reaches tens of radians, where one rounding of it would cost the sine two digits:
    what the two products lose is kept and added to sine and cosine to first order.
    """
    kw = twist * w
    u = kw * t
    lost = 0.5 * dr.fma(dr.fma(twist, w, -kw), t, dr.fma(kw, t, -u))
    v = 0.5 * u
    s, c = dr.sincos(v)
    return v, dr.fma(lost, c, s), dr.fma(-lost, s, c)


def _sinc_and_g(v, s, c):
    """``sin v / v`` and ``g = (sin v − v cos v)/v³``, smooth through ``v = 0``.

    Below √2 the series of g is used; above it the closed form, which cancels nothing there.
    ``sin v / v = cos v + v² g`` needs no series of its own.
    """
    y = dr.square(v)
    near = y < 2
    g_near = _g_series(y, _is_double(v))
    sinc = dr.select(near, dr.fma(y, g_near, c), s / dr.select(near, 1, v))
    return sinc, dr.select(near, g_near, (sinc - c) / dr.select(near, 1, y))


def _lift(sinc, c, g):
    # (v − sin v cos v)/v³, which the subtraction would cancel, is sinc² − g cos v
    return dr.fma(sinc, sinc, -g * c)


# ---------------------------------------------------------------------------
#  Geodesics
# ---------------------------------------------------------------------------


def flow(p, v, t, twist=1):
    """Point and direction after the arc length ``t`` along the geodesic from ``p`` along ``v``.

    ``p``: point in cells; ``v``: unit direction in frame components; ``t``: length in cells, of
    either sign. Returns ``(point, direction)``. With the half turn ``h = k w t/2`` the geodesic
    from the origin is the helix ``(X, Y) = t (sin h / h) Rot(h) (a, b)``,
    ``z − k X Y/2 = t w + k c² t² (h − sin h cos h)/(4 h²)``.
    """
    h, s, c = _half_turn(t, v.z, twist)
    sinc, g = _sinc_and_g(h, s, c)
    c2 = dr.fma(v.x, v.x, v.y * v.y)
    middle = _turned(v, s, c)
    return _along_helix(p, middle, c2, t, twist, h, c, sinc, g), _turned(middle, s, c)


def short_flow(p, v, t, twist=1, lost=(0, 0)):
    """`flow` by a short step ``t`` (cells), |k w t| ≤ 1.5, of many.

    Returns point, direction and what the direction has ``lost`` to rounding, its x and y, which the
    next step wants: an error that stays moves the point by its product with k t²/2.
    """
    h = 0.5 * (twist * v.z) * t
    y = dr.square(h)
    # On y ≤ 9/16 the first terms left out are below 2e-8
    c = _polynomial(y, [(-1) ** n / factorial(2 * n) for n in range(5)])
    g = _polynomial(y, [(-1) ** n * (2 * n + 2) / factorial(2 * n + 3) for n in range(4)])
    sinc = dr.fma(y, g, c)
    s = h * sinc
    middle = _turned(v, s, c)
    c2 = dr.fma(v.x, v.x, v.y * v.y)
    point = _along_helix(p, middle, c2, t, twist, h, c, sinc, g)
    # 1 − cos 2h = 2 s² and sin 2h = 2 s c
    dx, dy = dr.fma(-2 * s, middle.y, lost[0]), dr.fma(2 * s, middle.x, lost[1])
    direction = type(v)(v.x + dx, v.y + dy, v.z)
    return point, direction, (dx - (direction.x - v.x), dy - (direction.y - v.y))


def turned(v, angle):
    """The frame direction ``v`` after its geodesic has turned by ``angle`` = k w t."""
    return _turned(v, *dr.sincos(angle))


def _turned(v, s, c):
    return type(v)(dr.fma(v.x, c, -v.y * s), dr.fma(v.y, c, v.x * s), v.z)


def _along_helix(p, middle, c2, t, twist, h, c, sinc, g):
    """End of an arc of length t with the half turn h, from the frame direction at its middle.

    That is the direction of the arc's chord, too.
    """
    chord = t * sinc
    x, y = chord * middle.x, chord * middle.y
    z = dr.fma(0.25 * twist * h * _lift(sinc, c, g), dr.square(t) * c2, t * middle.z)
    z = dr.fma(twist * y, dr.fma(0.5, x, p.x), z)
    return type(p)(p.x + x, p.y + y, p.z + z)


def area_density(t, w, twist=1):
    """Signed area ``dA/dω`` that a solid angle covers after the arc length ``t``, in cells².

    ``w``: fibre component of the unit direction. ``A = t² (sin v / v)(cos v + (k t/2)² g(v))``
    with ``v = k w t/2``; positive up to the first conjugate point, which is not before ``|v| = π``.
    """
    v, s, c = _half_turn(t, w, twist)
    sinc, g = _sinc_and_g(v, s, c)
    return _area_density(t, sinc, g, dr.square(0.5 * twist * t) * ((1 - w) * (1 + w)))


def _area_density(t, sinc, g, radius2):
    # With radius² = (k c t/2)², cos v + (k t/2)² g = sin v / v + radius² g: a sum of positive
    # terms up to |v| = π, where the left side cancels
    return dr.square(t) * sinc * dr.fma(radius2, g, sinc)


@dataclass
class Connection:
    """The shortest geodesic between two points, as ``connect`` finds it.

    ``direction``, ``arrival``: unit frame directions where it leaves and where it arrives, both
    pointing from the first point to the second; ``distance`` in cells; ``area_density`` in cells².
    """

    direction: object
    arrival: object
    distance: object
    area_density: object


def connect(p, q, twist=1):
    """Shortest geodesic from ``p`` to ``q``, two points in cells.

    Returns a ``Connection`` whose directions have the type of ``p``. Solves
    ``2v + R² (v − sin v cos v)/sin² v = ζ`` for the half turn ``|v| ≤ π``, where
    ``p⁻¹·q = (x, y, z)``, ``R = k √(x² + y²)/2`` and ``ζ = k (z − k x y/2)``. On a fibre beyond
    ``|ζ| = 2π`` a whole circle of geodesics is shortest: the one that starts in the half plane of
    E1 and E3 is returned. Points whose distance is 0 when squared (below 1e-19 in float32) are
    equal: they have distance 0 and the direction E3.
    """
    dx, dy, dz = q.x - p.x, q.y - p.y, q.z - p.z
    twist = type(dx)(twist)
    k = dr.abs(twist)
    R2 = dr.square(0.5 * k) * dr.fma(dx, dx, dy * dy)

    # Height z − k x y/2 of p⁻¹·q, and ζ to twice the precision: a fibre needs ζ − 2π
    shear = twist * (p.x + q.x)
    shear_lost = dr.fma(twist, p.x + q.x, -shear)
    rise = shear * dy
    rise_lost = dr.fma(shear_lost, dy, dr.fma(shear, dy, -rise))
    height = dr.fma(-0.5, rise, dz)
    height_lost = dr.fma(-0.5, rise, dz - height) - 0.5 * rise_lost
    zeta = twist * height
    zeta_lost = dr.fma(twist, height, -zeta) + twist * height_lost
    orientation = dr.select(zeta < 0, -1.0, 1.0)

    zeta, zeta_lost = zeta * orientation, zeta_lost * orientation

    # Half turns up to π/2, where the equation itself gives w T without dividing by k. An arc's
    # horizontal part X, Y is as long as the arc without its bend, and points along its chord.
    zeta_quarter = dr.fma(pi / 2, R2, pi)
    s, c, sinc, g, lift = _near_half_turn(R2, zeta)
    sinc2 = dr.square(sinc)
    denominator = dr.fma(0.5 * R2, lift, sinc2)
    inverse = dr.rcp(denominator * sinc)  # one division for both
    inv_sinc = denominator * inverse
    near = (s, c, sinc, g, dx * inv_sinc, dy * inv_sinc, height * sinc2 * sinc * inverse)

    def far(dx, dy, zeta, zeta_lost, height, k, near):
        # What a fibre makes of 0/0 is the limit of the circle radius R / sin v
        r = _length(dx, dy)
        R = dr.maximum(0.5 * k * r, _ON_FIBRE[_is_double(dx)])
        x = _far_half_turn(R, zeta, zeta_lost)
        s, c, _, _, _ = _on_quarter(x)
        v, c = pi - x, -c
        horizontal = 2 * R * v / (s * k)
        # The chord leaves a fibre in no direction; −E1 makes the geodesic start towards E1
        scale = horizontal / dr.select(r > 0, r, 1.0)
        return (
            s,
            c,
            s / v,
            (s - v * c) / (v * dr.square(v)),
            dr.select(r > 0, dx * scale, -horizontal),
            dy * scale,
            dr.copysign(2 * v / k, height),
        )

    # A branch: it costs as much as the rest, and few points lie beyond
    s, c, sinc, g, X, Y, vertical = dr.if_stmt(
        (dx, dy, zeta, zeta_lost, height, k, near),
        zeta > zeta_quarter,
        far,
        lambda dx, dy, zeta, zeta_lost, height, k, near: near,
    )

    horizontal2 = dr.fma(X, X, dr.square(Y))
    distance2 = dr.fma(vertical, vertical, horizontal2)
    apart = distance2 > 0
    inv_distance = dr.rsqrt(dr.select(apart, distance2, 1.0))
    distance = distance2 * inv_distance
    w = dr.select(apart, vertical * inv_distance, 1)
    # In azimuth v before the chord at the start, v past it on arrival
    along, across = c * inv_distance, s * orientation * inv_distance
    direction = type(p)(dr.fma(X, along, Y * across), dr.fma(Y, along, -X * across), w)
    arrival = type(p)(dr.fma(X, along, -Y * across), dr.fma(Y, along, X * across), w)
    density = _area_density(distance, sinc, g, dr.square(0.5 * k) * horizontal2)
    return Connection(direction, arrival, distance, density)


# A smaller R counts as this one, so that a point on a fibre needs no case of its own: too small
# to be seen beside one rounding of a direction, while its square stays clear of underflow
_ON_FIBRE = {False: 1e-15, True: 1e-60}

# Beyond π/2 the first guess is off by at most 2.5 %, which two steps of Newton's make 7e-8 and
# three 1e-15; below, by 2.4e-4, which one step makes 7e-8 and two 1e-14 (measured on
# 0 ≤ R ≤ 150, 0 ≤ ζ ≤ 1000, relative in v or in π − v)
_NEAR_STEPS, _FAR_STEPS = {False: 1, True: 3}, {False: 2, True: 3}

# μ(v)/v of the root of 2v + R² μ(v) = ζ, by powers of (ζ / ζ(π/2))², each of them a polynomial in
# 1/(1 + R²/2): fitted to 3e-4, weighted by what it changes in v
_MU = (
    (2 / 3,),
    (0.4894, -0.4537, 0.2059),
    (-0.2851, 1.1584, -0.9561),
    (0.1901, -1.1126, 1.2395),
    (-0.0613, 0.4088, -0.4902),
)

# 2π in two parts, the second what the first lacks
_TWO_PI = {
    False: (6.2831854820251465, -1.7484555e-07),
    True: (6.283185307179586, 2.4492935982947064e-16),
}


def _near_half_turn(R2, zeta):
    """The root v ≤ π/2 of ``2v + R² μ(v) = ζ``, as `_on_quarter` describes it.

    ``μ(v) = (v − sin v cos v)/sin² v``; 0 ≤ ζ ≤ π + π R²/2, its value at π/2.
    """
    double = _is_double(R2)
    straight = dr.rcp(dr.fma(0.5, R2, 1))
    quarter = dr.minimum(dr.square(zeta * straight / pi), 1)
    powers = [_polynomial(straight, coefficients) for coefficients in _MU]
    x = zeta / dr.fma(R2, _polynomial(quarter, powers), 2)
    for step in reversed(range(_NEAR_STEPS[double])):
        s, c, sinc, g, lift = _on_quarter(x)
        # Newton's step, both of its parts times sinc³
        cube = dr.square(sinc) * sinc
        residual = dr.fma(dr.fma(-2, x, zeta), cube, -R2 * x * lift * sinc)
        change = 0.5 * residual / dr.fma(R2, g, cube)
        if step:
            x = x + change
    # The last one is so small that it changes all by their slopes: g' = −v/15 + v³/210 − …
    y = dr.square(x)
    slope_g = x * dr.fma(y, dr.fma(y, -1 / 7560, 1 / 210), -1 / 15)
    s, c = dr.fma(change, c, s), dr.fma(-change, s, c)
    sinc, g = dr.fma(-change * x, g, sinc), dr.fma(change, slope_g, g)
    return s, c, sinc, g, _lift(sinc, c, g)


def _far_half_turn(R, zeta, zeta_lost):
    """The x ≤ π/2 for which ``v = π − x`` is the root of ``2v + R² μ(v) = ζ``.

    ``μ(π − x) = π/sin² x − μ(x)`` crowds the root against π on a fibre, where x is still
    well-conditioned.
    """
    double = _is_double(R)
    two_pi, two_pi_lost = _TWO_PI[double]
    excess = (zeta - two_pi) + (zeta_lost - two_pi_lost)
    R2 = dr.square(dr.maximum(R, _ON_FIBRE[double]))

    # μ(π − x) ≈ π/x² + π/3 − 0.477 x, exact at π/2 but for 1e-2, leaves x²(x + h) = n
    inv_slope = dr.rcp(dr.fma(0.477, R2, 2))
    n = pi * R2 * inv_slope
    unit = dr.cbrt(n)
    h = dr.fma(-pi / 3, R2, excess) * inv_slope / unit
    # Root of x²(x + h) = 1 to 1e-2, by what it tends to at h = 0 and at h = ±∞
    h_pos, h_neg = dr.maximum(h, 0), dr.maximum(-h, 0)
    root_pos = dr.rsqrt(h_pos + dr.rsqrt(dr.fma(2 / 3, h_pos, 1)))
    root_neg = h_neg + dr.rcp(dr.fma(h_neg, dr.fma(0.5, h_neg, 2 / 3), 1))
    x = dr.minimum(unit * dr.select(h > 0, root_pos, root_neg), pi / 2)

    for _ in range(_FAR_STEPS[double]):
        s, c, mu, slope = _mu(x)
        inv_s = dr.rcp(s)
        pole = pi * R2 * dr.square(inv_s)
        residual = dr.fma(R2, mu, 2 * x) - pole + excess
        x = x - residual / (dr.fma(R2, slope, 2) + 2 * pole * c * inv_s)
    return x


def _mu(x):
    """sin x, cos x, ``μ(x) = (x − sin x cos x)/sin² x`` and its derivative for 0 ≤ x ≤ π/2."""
    s, c, sinc, g, lift = _on_quarter(x)
    inv_sinc = dr.rcp(sinc)
    inv_sinc2 = dr.square(inv_sinc)
    # dμ/dx = 2 (sin x − x cos x)/sin³ x
    return s, c, x * lift * inv_sinc2, 2 * g * inv_sinc2 * inv_sinc


def _on_quarter(x):
    """sin x, cos x, sin x / x, g(x) and ``(x − sin x cos x)/x³`` for 0 ≤ x ≤ π/2, by series."""
    double = _is_double(x)
    y = dr.square(x)
    c, g = _cos_series(y, double), _g_series(y, double)
    sinc = dr.fma(y, g, c)
    return x * sinc, c, sinc, g, _lift(sinc, c, g)


# ---------------------------------------------------------------------------
#  Unit cell
# ---------------------------------------------------------------------------


def wrap(p, twist=1):
    """The image of ``p`` in the unit cell and the deck element that leads back to ``p``.

    ``p``: point in cells; ``twist``: an integer. Returns ``(p_in, g)`` with ``g·p_in = p``,
    ``0 ≤ p_in < 1`` in every component and ``g`` three integers, 32 bit for 32-bit points. The
    group of the cell is generated by ``(x + 1, y, z + k y)``, ``(x, y + 1, z)`` and
    ``(x, y, z + 1)``.
    """
    x_cell, y_cell, z_cell = dr.floor(p.x), dr.floor(p.y), dr.floor(p.z)
    below_one = dr.one_minus_epsilon(type(p))
    x = dr.minimum(p.x - x_cell, below_one)
    y = dr.minimum(p.y - y_cell, below_one)
    # p = g·p_in has z = z_in + g_z + k g_x y_in. The shear grows with the distance: reduce it on
    # its own, with what its product loses, so that the sum stays as accurate as the input
    shear = twist * x_cell
    rise = shear * y
    rise_lost = dr.fma(shear, y, -rise)
    rise_cell = dr.floor(rise)
    z = (p.z - z_cell) - (rise - rise_cell) - rise_lost
    extra = dr.floor(z)
    z = dr.minimum(z - extra, below_one)
    z_cell = z_cell - rise_cell + extra
    cell_t = (
        dr.int64_array_t(type(p))
        if dr.type_v(p) == dr.VarType.Float64
        else dr.int32_array_t(type(p))
    )
    if not dr.is_jit_v(p):
        return type(p)(x, y, z), cell_t(int(x_cell), int(y_cell), int(z_cell))
    return type(p)(x, y, z), cell_t(x_cell, y_cell, z_cell)
