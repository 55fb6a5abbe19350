"""
Where a geodesic of Nil first crosses a plane x = c, y = c or z = c: exactly, in any precision.

With α the azimuth of the direction, x and y move as sine and cosine of α + k w t, so that each
plane is met twice in a period 2π/|k w|; the arcsin of the report VISGRAF TR-19-06 gives one of the
two. The report leaves z = c open: no inverse of z(t) is known, but its extrema are, since
dz/dt = w + k x b and b = b₀ + k w (x − x₀) make them the roots of a quadratic in x. Between
extrema z is monotonous, so a crossing is bracketed, and periods that cannot hold the first one are
skipped. Nothing divides by w.
"""

from math import inf, pi

import drjit as dr

from nil_mitsuba import geometry

# Steps of false position and bisection by turns: each pair halves the bracket at least, so these
# leave less than one unit in the last place, in float32 and float64, of a bracket 10³ times as long
# as its root
MAX_STEPS = {False: 2 * (24 + 10), True: 2 * (53 + 10)}


def first_crossing(p, v, axis, c, t_max, twist=1):
    """
    Arc length t in (0, t_max] of the first crossing of the plane with coordinate ``axis`` = ``c``.

    p: points in cells; v: unit directions in frame components, Dr.Jit vectors of 32 or 64 bit;
    axis: 0, 1 or 2; c, t_max: cells, t_max finite, and at most 10⁴ periods 2π/|k w| where axis is
    2. Infinite where there is none. A tangent ray crosses where it touches, as far as rounding can
    tell; a start on the plane does not count.
    """
    value_t = dr.value_t(type(p))
    twist, c, t_max = value_t(twist), value_t(c), value_t(t_max)
    if axis == 2:
        t = _first_z(p, v, c, t_max, twist)
    else:
        period = _period(v, twist)
        t = dr.minimum(*_passings(v, c - p[axis], axis, twist, period))
    return dr.select(t <= t_max, t, inf)


def _period(v, twist):
    kw = dr.abs(twist * v.z)
    return dr.select(kw > 0, 2 * pi / dr.select(kw > 0, kw, 1), inf)


def _passings(v, step, axis, twist, period):
    """
    The two arc lengths in (0, period] at which x (or y) has moved by ``step``; infinite if it
    never does.

    The derivative of x is a = c cos(α + k w t), and b = b₀ + k w (x − x₀): where x has moved by
    ``step``, b is known and a up to its sign, and the turn is the angle between two directions.
    For y the pair (b, −a) takes the place of (a, b).
    """
    a, b = (v.x, v.y) if axis == 0 else (v.y, -v.x)
    kw = twist * v.z
    swing = kw * step  # b − b₀
    lost = swing * dr.fma(2, b, swing)  # a₀² − a²
    a2 = dr.fma(a, a, -lost)
    c2 = dr.fma(a, a, b * b)
    reached = (a2 >= 0) & (c2 > 0)
    same = dr.mulsign(dr.sqrt(dr.maximum(a2, 0)), a)  # a of the sign it had at the start
    b_there = b + swing
    c2 = dr.select(c2 > 0, c2, 1)

    # Same sign: sin(turn)/(k w) without the difference a b − b₀ a that would cancel
    total = a + same
    sine_by_kw = step * dr.fma(b, dr.fma(2, b, swing) / dr.select(total != 0, total, 1), a) / c2
    cosine = dr.fma(a, same, b * b_there) / c2
    sine = kw * sine_by_kw
    turn = dr.atan2(sine, cosine)
    t_same = sine_by_kw * dr.select(dr.abs(sine) > 0, turn / dr.select(sine != 0, sine, 1), 1)
    # Past a quarter of a turn the sine comes down again, and the angle itself is well-conditioned
    t_same = dr.select(cosine > 0, t_same, turn / dr.select(kw != 0, kw, 1))
    t_same = dr.select((total != 0) & ((kw != 0) | (cosine > 0)), t_same, inf)

    # Other sign: the turn is no small one unless a itself is
    sine, cosine = dr.fma(a, b_there, b * same) / c2, dr.fma(-a, same, b * b_there) / c2
    t_other = dr.select(kw != 0, dr.atan2(sine, cosine) / dr.select(kw != 0, kw, 1), inf)

    times = []
    for t in (t_same, t_other):
        t = dr.select(t > 0, t, t + period)
        times.append(dr.select(reached & (t > 0), t, inf))
    return times


def _first_z(p, v, c, t_max, twist):
    period = _period(v, twist)

    # Extrema: k² w X² + k (b + k w x₀) X + (w + k x₀ b) = 0 for X = x − x₀
    kw = twist * v.z
    lean = kw * p.x
    half = 0.5 * twist * (v.y + lean)
    across = v.y - lean
    root2 = 0.25 * dr.square(twist) * (across - 2 * v.z) * (across + 2 * v.z)
    turns = root2 >= 0
    q = -(half + dr.mulsign(dr.sqrt(dr.maximum(root2, 0)), half))
    rate = dr.fma(twist * p.x, v.y, v.z)  # dz/dt at the start
    square = twist * kw
    steps = (
        dr.select(square != 0, q / dr.select(square != 0, square, 1), inf),
        dr.select(q != 0, rate / dr.select(q != 0, q, 1), inf),
    )
    extrema = []
    for step in steps:
        possible = turns & dr.isfinite(step)
        for t in _passings(v, dr.select(possible, step, 0), 0, twist, period):
            extrema.append(dr.select(possible, t, inf))
    for i, j in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):  # sorting network of four
        extrema[i], extrema[j] = (
            dr.minimum(extrema[i], extrema[j]),
            dr.maximum(extrema[i], extrema[j]),
        )

    # g = ±(z − c) starts below zero; the crossing is where it first is not. A ray that starts on
    # the plane starts into the side that it goes to.
    bend = twist * v.x * dr.fma(twist * p.x, v.z, v.y)
    ahead = dr.select(p.z != c, c - p.z, dr.select(rate != 0, -rate, -bend))
    orientation = dr.select(ahead < 0, -1, type(c)(1))

    def g(t):
        return orientation * (geometry.flow(p, v, t, twist)[0].z - c)

    # z gains the same height in every period: the first crossing is in the first one whose
    # highest point is high enough, or, against the drift, in period 0
    top = g(dr.minimum(period, t_max))
    for t in extrema:
        top = dr.maximum(top, g(dr.select(t < inf, t, 0)))
    w_safe = dr.select(v.z != 0, v.z, 1)
    c2 = dr.fma(v.x, v.x, v.y * v.y)
    gain = orientation * dr.fma(0.5 * c2, dr.rcp(w_safe), v.z) * period
    skips = (period <= t_max) & (gain > 0) & (top < 0)
    # One part in 10⁴ less than the quotient: a rounded one must not skip the right period. Of 10⁴
    # periods it begins one early, and three are looked at
    first = dr.select(skips, dr.ceil(0.9999 * -top / dr.select(skips, gain, 1)), 0)
    first = dr.maximum(first - 1, 0)
    begin = dr.select(first > 0, first * period, 0)

    # Pieces between extrema, over three periods: the one before, the one aimed at, and the next
    ends = [dr.fma(n, period, t) if n else t for n in range(3) for t in extrema]
    # An extremum that does not exist ends a piece of no length
    ends = [dr.select(dr.isfinite(t), dr.minimum(begin + t, t_max), begin) for t in ends]
    lower, upper, found = begin, t_max, dr.mask_t(begin)(False)
    for end in [*ends, t_max]:
        piece = ~found & (end > lower)
        reached = piece & (g(end) >= 0)
        upper = dr.select(reached, end, upper)
        lower = dr.select(piece & ~reached, end, lower)
        found |= reached
    return dr.select(found, _bracketed(g, lower, upper, found), inf)


def _bracketed(g, a, b, active):
    """The root of g, monotonous on [a, b] with g(a) < 0 ≤ g(b), within MAX_STEPS steps."""
    double = dr.type_v(a) == dr.VarType.Float64
    ulp = 2 * dr.epsilon(type(a))

    def narrow(a, b, ga, gb, n):
        secant = a - ga * (b - a) / dr.select(gb > ga, gb - ga, 1)
        m = dr.select((n % 2 == 0) & (gb > ga), dr.clip(secant, a, b), 0.5 * (a + b))
        gm = g(m)
        beyond = gm >= 0
        return (
            dr.select(beyond, a, m),
            dr.select(beyond, m, b),
            dr.select(beyond, ga, gm),
            dr.select(beyond, gm, gb),
            n + 1,
        )

    uint_t = dr.uint32_array_t(type(a))
    _, b, _, _, _ = dr.while_loop(
        (a, b, g(a), g(b), uint_t(0)),
        lambda a, b, ga, gb, n: active & (n < MAX_STEPS[double]) & (b - a > ulp * b),
        narrow,
    )
    return b
