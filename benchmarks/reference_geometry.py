"""Truth for the geometry of Nil that shares no code with the package: mpmath and an ODE.

``python -m benchmarks.reference_geometry`` prints the worst errors of ``nil_mitsuba.geometry``
beside their limits.
"""

import random
from functools import cache
from itertools import product
from math import hypot, inf, pi, sqrt

import drjit as dr
from mpmath import mp, mpf

# 30 digits are promised; what the differences below lose near w = 0 is added
mp.dps = 75


# ---------------------------------------------------------------------------
#  Truth
# ---------------------------------------------------------------------------


def _circle_functions(u):
    if u == 0:
        return mpf(1), mpf(0), mpf(0)
    return mp.sin(u) / u, (1 - mp.cos(u)) / u, (u - mp.sin(u)) / u**2


@cache
def flow(p, v, t, k):
    """Closed form with the full turn u = k w t, for directions of any length."""
    (x, y, z), (a, b, w), t, k = map(mpf, p), map(mpf, v), mpf(t), mpf(k)
    u = k * w * t
    S, C, Q = _circle_functions(u)
    X, Y = t * (a * S - b * C), t * (b * S + a * C)
    Z = w * t + k * (a * a + b * b) * t * t * Q / 2 + k * X * Y / 2
    cos_u, sin_u = mp.cos(u), mp.sin(u)
    return ((x + X, y + Y, z + Z + k * x * Y), (a * cos_u - b * sin_u, b * cos_u + a * sin_u, w))


@cache
def area_density(t, w, k):
    """Jacobian of the exponential map by differences of ``flow``, without the closed form of A."""
    t, w, k = mpf(t), mpf(w), mpf(k)
    c = mp.sqrt(1 - w * w)
    v, e1, e2 = (c, mpf(0), w), (-w, mpf(0), c), (mpf(0), mpf(-1), mpf(0))
    h = mpf(10) ** -20
    (x, _, _), end = flow((0, 0, 0), v, t, k)
    rows = []
    for e in (e1, e2):
        (xp, yp, zp), _ = flow((0, 0, 0), tuple(i + h * j for i, j in zip(v, e)), t, k)
        (xm, ym, zm), _ = flow((0, 0, 0), tuple(i - h * j for i, j in zip(v, e)), t, k)
        dx, dy, dz = ((i - j) / (2 * h) for i, j in ((xp, xm), (yp, ym), (zp, zm)))
        rows.append((dx, dy, dz - k * x * dy))
    return mp.det(mp.matrix([rows[0], rows[1], end]))


@cache
def connect(p, q, k):
    """(direction, arrival, distance) by bisection for the half turn; None where they coincide."""
    (px, py, pz), (qx, qy, qz), k = map(mpf, p), map(mpf, q), mpf(k)
    x, y = qx - px, qy - py
    z = qz - pz - k * px * y - k * x * y / 2
    r = mp.sqrt(x * x + y * y)
    if k == 0:
        v, horizontal, vertical = mpf(0), r, z
    else:
        zeta, R = abs(k * z), abs(k) * r / 2
        if R == 0 and zeta > 2 * mp.pi:
            v = mp.pi
            horizontal = 2 * v / abs(k) * mp.sqrt((zeta - 2 * mp.pi) / mp.pi)
        else:
            v = zeta / 2 if R == 0 else _half_turn(R, zeta)
            horizontal = r * v / mp.sin(v) if v else r
        sign = mp.sign(z)
        vertical = sign * 2 * v / abs(k) if v else z
        v *= sign * mp.sign(k)
    distance = mp.sqrt(horizontal**2 + vertical**2)
    if distance == 0:
        return None
    # On a fibre the geodesic that starts at azimuth 0
    azimuth = mp.atan2(y, x) if r else v
    c, w = horizontal / distance, vertical / distance
    return (
        (c * mp.cos(azimuth - v), c * mp.sin(azimuth - v), w),
        (c * mp.cos(azimuth + v), c * mp.sin(azimuth + v), w),
        distance,
    )


def _half_turn(R, zeta):
    if zeta == 0:
        return mpf(0)

    def mismatch(v):
        s, c = mp.sin(v), mp.cos(v)
        return 2 * v + R * R * (v - s * c) / (s * s) - zeta

    # From whichever end of (0, π) is nearer, as the root may crowd either: for v or for π − v
    middle = mp.pi / 2
    rising = mismatch(middle) > 0
    # There μ(v) ≤ v, or μ(v) ≥ π/2 / (π − v)²
    a, b = zeta / (3 + R * R) if rising else R * mp.sqrt(mp.pi / (2 * zeta)), middle

    def unknown(x):
        return x if rising else mp.pi - x

    while b - a > mpf(10) ** -5 * a:
        m = mp.sqrt(a * b)
        if (mismatch(unknown(m)) > 0) == rising:
            b = m
        else:
            a = m
    # Newton about doubles the 5 digits each time
    x = (a + b) / 2
    for _ in range(4):
        v = unknown(x)
        s, c = mp.sin(v), mp.cos(v)
        step = mismatch(v) / (2 + 2 * R * R * (s - v * c) / s**3)
        x = x - step if rising else x + step
    return unknown(x)


def metric(x, k):
    """Coordinate metric of ds² = dx² + dy² + (dz − k x dy)², its inverse and ∂ of it along x."""
    g = ((1, 0, 0), (0, 1 + (k * x) ** 2, -k * x), (0, -k * x, 1))
    g_inv = ((1, 0, 0), (0, 1, k * x), (0, k * x, 1 + (k * x) ** 2))
    dg_dx = ((0, 0, 0), (0, 2 * k * k * x, -k), (0, -k, 0))
    return g, g_inv, dg_dx


def christoffel(x, k):
    """Γ^i_jl of the metric, from its derivatives; only those along x do not vanish."""
    _, g_inv, dg_dx = metric(x, k)

    def d(m, j, l):
        return dg_dx[j][l] if m == 0 else 0

    return [
        [
            [
                sum(g_inv[i][m] * (d(j, m, l) + d(l, m, j) - d(m, j, l)) for m in range(3)) / 2
                for l in range(3)
            ]
            for j in range(3)
        ]
        for i in range(3)
    ]


def integrate(p, v, t, k, step=0.2):
    """Geodesic equation in coordinates, by extrapolated midpoint steps in double precision."""
    state = [*p, v[0], v[1], v[2] + k * p[0] * v[1]]

    def rate(s):
        gamma = christoffel(s[0], k)
        u = s[3:]
        return u + [
            -sum(gamma[i][j][l] * u[j] * u[l] for j in range(3) for l in range(3) if gamma[i][j][l])
            for i in range(3)
        ]

    def midpoint(s, H, n):
        h = H / n
        before, now = s, [i + h * j for i, j in zip(s, rate(s))]
        for _ in range(n - 1):
            before, now = now, [i + 2 * h * j for i, j in zip(before, rate(now))]
        return [(i + j + h * l) / 2 for i, j, l in zip(before, now, rate(now))]

    steps = max(1, round(abs(t) / step))
    H = t / steps
    counts = (2, 4, 6, 8, 10, 12)
    for _ in range(steps):
        table = []
        for n in counts:  # Gragg, Bulirsch and Stoer: powers of h²
            row = [midpoint(state, H, n)]
            for j, m in enumerate(reversed(counts[: len(table)])):
                ratio = (n / m) ** 2 - 1
                row.append([i + (i - l) / ratio for i, l in zip(row[j], table[-1][j])])
            table.append(row)
        state = table[-1][-1]
    x, y, z, a, b, dz = state
    return (x, y, z), (a, b, dz - k * x * b)


# ---------------------------------------------------------------------------
#  Cases: lists of plain numbers
# ---------------------------------------------------------------------------

TWISTS = (-3, -2, -1, -0.5, -1e-6, 0, 1e-6, 1e-3, 0.375, 1, 2, 3)


def unit(a, b, w):
    """The direction with azimuth of (a, b) and exactly the fibre component w."""
    c = sqrt(1 - w * w) / hypot(a, b)
    return a * c, b * c, w


def flow_cases(t_max, seed=1):
    """(p, v, t, k) with random and hostile directions, for lengths up to ``t_max``."""
    rng = random.Random(seed)
    hostile = (0, 1e-12, -1e-12, 1e-7, -1e-4, 1e-2, 0.3, -0.9, 1 - 1e-7, 1, -1)
    cases = []
    for k, w in product(TWISTS, hostile):
        for t in (t_max, rng.uniform(0, t_max)):
            p = [rng.choice((-1, 0, 1, rng.uniform(-1, 1))) for _ in range(3)]
            cases.append((p, unit(rng.gauss(0, 1), rng.gauss(0, 1), w), t, k))
    for k in TWISTS:
        for _ in range(25):
            p = [rng.uniform(-1, 1) for _ in range(3)]
            t = rng.choice((0, 1e-6, rng.uniform(0, t_max), t_max))
            cases.append((p, unit(rng.gauss(0, 1), rng.gauss(0, 1), rng.uniform(-1, 1)), t, k))
    return cases


def area_cases(seed=2):
    """(t, w, k) with |k w t/2| ≤ 3."""
    rng = random.Random(seed)
    cases = [
        (t, w, k)
        for k in TWISTS
        for t in (0.01, 1, 2.5, 20)
        for w in (0, 1e-12, -1e-7, 1e-3, 0.25, -1, 0.999)
    ]
    for _ in range(300):
        k, v = rng.choice(TWISTS), rng.uniform(-3, 3)
        w = rng.uniform(-1, 1)
        cases.append((min(50, abs(2 * v / (k * w))) if k else 5, w, k))
    return [(t, w, k) for t, w, k in cases if abs(k * w * t) / 2 <= 3]


def connect_cases(seed=3):
    """(q, k) as seen from the origin: horizontal distance and symmetric height up to 50."""
    rng = random.Random(seed)
    radii = (0, 1e-7, 1e-5, 1e-3, 0.03, 0.3, 1, 2, 7, 50)
    cases = []
    for k in TWISTS:
        heights = [0, 1e-7, 1e-3, 0.5, 3, 7, 20, 50]
        if abs(2 * pi / (k or 1e-9)) < 49:
            fibre = 2 * pi / abs(k)
            heights += [fibre, fibre * (1 + 2e-5), fibre * (1 - 2e-5), fibre * 1.01, fibre * 0.99]
        for r, height in product(radii, heights):
            azimuth = rng.uniform(-pi, pi)
            cases.append((r, azimuth, rng.choice((-1, 1)) * height, k))
        for _ in range(20):
            cases.append((rng.uniform(0, 50), rng.uniform(-pi, pi), rng.uniform(-50, 50), k))
            cases.append((10 ** rng.uniform(-7, 1), rng.uniform(-pi, pi), rng.uniform(-50, 50), k))
    result = []
    for r, azimuth, height, k in cases:
        e = mp.expjpi(azimuth / pi)
        x, y = r * float(e.real), r * float(e.imag)
        result.append(((x, y, height + k * x * y / 2), k))
    return result


# ---------------------------------------------------------------------------
#  Comparison: all cases in one call of the package
# ---------------------------------------------------------------------------


def _numbers(array):
    return list(array) if dr.is_jit_v(array) else [array]


def _column(vector_t, values):
    if isinstance(values[0], (tuple, list)):
        return vector_t(*(dr.value_t(vector_t)(list(c)) for c in zip(*values)))
    return dr.value_t(vector_t)(list(values))


def _rows(column):
    if dr.size_v(column) == 3:
        return list(zip(*(_numbers(c) for c in column)))
    return _numbers(column)


def evaluate(vector_t, function, *columns):
    """``function`` of every row of ``columns``, which hold triples or numbers.

    One call for JIT arrays, one a row for scalar arrays. Returns the rows as ``vector_t`` rounds
    them and the results, tuples of triples and numbers.
    """
    if dr.is_jit_v(vector_t):
        arrays = [_column(vector_t, c) for c in columns]
        outputs = function(*arrays)
        dr.eval(outputs)
        return list(zip(*map(_rows, arrays))), list(zip(*map(_rows, outputs)))
    rounded, results = [], []
    for row in zip(*columns):
        row = [vector_t(*i) if isinstance(i, (tuple, list)) else vector_t(i, 0, 0).x for i in row]
        rounded.append(tuple(tuple(i) if dr.is_array_v(i) else i for i in row))
        results.append(tuple(tuple(i) if dr.is_array_v(i) else i for i in function(*row)))
    return rounded, results


def norm(a):
    return mp.sqrt(sum(i * i for i in a))


def difference(a, b):
    """Norm of a − b; infinite where a is not finite."""
    if not all(-inf < i < inf for i in a):
        return mpf(inf)
    return norm([i - j for i, j in zip(a, b)])


def size(*triples):
    return 1 + max(abs(i) for triple in triples for i in triple)


def flow_errors(geometry, vector_t, cases):
    """[(error of the point, error of the direction, case)], relative as their limits are."""
    rows, results = evaluate(vector_t, geometry.flow, *zip(*cases))
    errors = []
    for (p, v, t, k), (end, direction) in zip(rows, results):
        true_end, true_direction = flow(p, v, t, k)
        scale = max(1, abs(k) / 2)
        errors.append(
            (
                difference(end, true_end) / size(p, true_end) / scale,
                difference(direction, true_direction) / scale,
                (p, v, t, k),
            )
        )
    return errors


def area_errors(geometry, vector_t, cases):
    """[(relative error, case)]."""
    rows, results = evaluate(
        vector_t, lambda t, w, k: (geometry.area_density(t, w, k),), *zip(*cases)
    )
    return [
        (difference(area, (true,)) / abs(true), case)
        for case, area, true in zip(rows, results, (area_density(*row) for row in rows))
    ]


def is_ill_conditioned(q, k, margin):
    """Within ``margin`` of |ζ| = 2π on or near the axis, here a tenth of the circle's radius."""
    x, y, z = map(mpf, q)
    zeta, R = abs(k * (z - k * x * y / 2)), abs(k) * mp.sqrt(x * x + y * y) / 2
    return R < 0.1 and abs(zeta - 2 * mp.pi) < margin


def connect_errors(geometry, vector_t, cases, margin):
    """[(errors of distance, direction, arrival, area density, landing, case)].

    All but the last are None where ill-conditioned within ``margin``, and so is that of the area
    density, relative like the distance, where |k w T/2| > 3. Landing: how far from the point
    ``flow`` ends along the result, relative as for ``flow``.
    """

    def both_ways(q, k):
        origin = dr.zeros(vector_t)
        c = geometry.connect(origin, q, k)
        end, _ = geometry.flow(origin, c.direction, c.distance, k)
        return c.direction, c.arrival, c.distance, c.area_density, end

    rows, results = evaluate(vector_t, both_ways, *zip(*cases))
    errors = []
    for (q, k), (direction, arrival, distance, area, end) in zip(rows, results):
        landing = difference(end, q) / size(q)
        truth = connect((0, 0, 0), q, k)
        error = None, None, None, None
        if truth is None:
            error = abs(distance), abs(norm(direction) - 1), abs(norm(arrival) - 1), abs(area)
        elif not is_ill_conditioned(q, k, margin):
            true_direction, true_arrival, true_distance = truth
            w = true_direction[2]
            error = (
                abs(distance / true_distance - 1),
                difference(direction, true_direction),
                difference(arrival, true_arrival),
                None,
            )
            if abs(k * w * true_distance) / 2 <= 3 and abs(w) < 1:
                error = *error[:3], abs(area / area_density(true_distance, w, k) - 1)
        errors.append((*error, landing, (q, k)))
    return errors


def worst(errors, column):
    """(largest error of a column, its case)."""
    known = [e for e in errors if e[column] is not None]
    return max(((e[column], e[-1]) for e in known), key=lambda e: e[0])


LIMITS = {  # 32 bit, 64 bit
    "flow, t ≤ 5": (2e-6, 1e-13),
    "flow, t ≤ 20": (1e-5, 1e-12),
    "area_density": (2e-5, 1e-12),
    "connect": (2e-5, 1e-11),
}
ILL_CONDITIONED = (1e-4, 1e-9)


def main():
    from nil_mitsuba import geometry

    for name, vector_t in (
        ("LLVM", (dr.llvm.Array3f, dr.llvm.Array3f64)),
        ("scalar", (dr.scalar.Array3f, dr.scalar.Array3f64)),
    ):
        for bits, double in ((32, 0), (64, 1)):
            array_t = vector_t[double]
            table = []
            for t_max in (5, 20):
                errors = flow_errors(geometry, array_t, flow_cases(t_max))
                for i, what in enumerate(("point", "direction")):
                    table.append((f"flow, t ≤ {t_max}", what, worst(errors, i)))
            table.append(
                ("area_density", "", worst(area_errors(geometry, array_t, area_cases()), 0))
            )
            errors = connect_errors(geometry, array_t, connect_cases(), ILL_CONDITIONED[double])
            for i, what in enumerate(("distance", "direction", "arrival", "area", "landing")):
                table.append(("connect", what, worst(errors, i)))
            print(f"{name}, {bits} bit")
            for function, what, (error, case) in table:
                print(
                    f"  {function:14}{what:10} {float(error):8.1e}  (limit "
                    f"{LIMITS[function][double]:.0e})  at {case}"
                )


if __name__ == "__main__":
    main()
