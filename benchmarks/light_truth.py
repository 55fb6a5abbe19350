"""Which geodesics join a patch and a light, and what they bring: in float64, by a scan.

Every geodesic between two points is a root of one smooth function of its half turn. That finds them
all, and knows nothing of the package's solvers; of its formulas it uses distance and area density
in float64, which `reference_geometry` checks.
"""

import math

import drjit as dr
import mitsuba as mi
from drjit.llvm import Array3f64, Float64, UInt32

from . import reference_geometry as reference
from . import truth


def geodesics(p, q, twist, half_turns):
    """Every geodesic from p to q (triples) with a half turn |v| < ``half_turns``, by scanning.

    A geodesic with half turn v has the horizontal chord r = c T sin v / v and the symmetric height
    ζ/k with 2v + R² (v − sin v cos v)/sin² v = ζ, R = k r/2; times sin² v this has no poles.
    Returns a list of (direction, distance, half turn) and raises if a root is nearly double.
    """
    (px, py, pz), (qx, qy, qz), k = p, q, twist
    dx, dy = qx - px, qy - py
    height = qz - pz - k * px * dy - 0.5 * k * dx * dy
    r = math.hypot(dx, dy)
    zeta, R2 = k * height, (0.5 * k * r) ** 2
    orientation = -1 if zeta < 0 else 1

    def excess(v):
        s, c = math.sin(v), math.cos(v)
        return (2 * v - abs(zeta)) * s * s + R2 * (v - s * c)

    steps = 2000 * math.ceil(half_turns / math.pi)
    grid = [max(i / steps * half_turns, 1e-9) for i in range(steps + 1)]
    values = [excess(v) for v in grid]
    found = []
    for a, b, fa, fb in zip(grid, grid[1:], values, values[1:]):
        if (fa < 0) == (fb < 0):
            continue
        for _ in range(60):
            m = 0.5 * (a + b)
            if (excess(m) < 0) == (fa < 0):
                a = m
            else:
                b = m
        v = 0.5 * (a + b)
        horizontal = r * v / math.sin(v)  # negative where the arc has turned past its start
        distance = math.hypot(horizontal, 2 * v / k)
        azimuth = math.atan2(dy, dx) - orientation * v
        c = horizontal / distance
        w = orientation * 2 * v / k / distance
        found.append(((c * math.cos(azimuth), c * math.sin(azimuth), w), distance, v))
    return found


def irradiance(p, n, q, twist, reach):
    """Σ cos θ / |A| over the geodesics from p (unit conormal n) to a light q of intensity 1."""
    total = 0.0
    for direction, distance, _ in geodesics(p, q, twist, 0.5 * abs(twist) * reach):
        end, _ = reference.flow(p, direction, distance, twist)
        assert reference.difference(end, q) < 1e-9, "the scan has found no geodesic"
        cosine = sum(a * b for a, b in zip(direction, n))
        if distance <= reach and cosine > 0:
            density = abs(float(reference.area_density(distance, direction[2], twist)))
            # A caustic would make the comparison one of rounding errors.
            assert density > 0.02 * distance**2, f"{p}, {q} lie near a caustic"
            total += cosine / density
    return total


# ---------------------------------------------------------------------------
#  Images
# ---------------------------------------------------------------------------


def columns(triples, repeat, vector_t=None):
    """Triples as a Dr.Jit vector, each repeated."""
    vector_t = vector_t or mi.Point3f
    value_t = dr.value_t(vector_t)
    index = dr.arange(UInt32, len(triples) * repeat) // repeat
    return vector_t(
        *(dr.gather(value_t, value_t([float(t[i]) for t in triples]), index) for i in range(3))
    )


def enough_cells(p, q, twist, reach):
    """All (g, image of q) within the horizontal distance and the height that ``reach`` allows."""
    k, images = abs(twist), []
    height = reach * (1 + 0.16 * k * reach)
    for gx in range(math.floor(p[0] - q[0] - reach), math.ceil(p[0] - q[0] + reach) + 1):
        for gy in range(math.floor(p[1] - q[1] - reach), math.ceil(p[1] - q[1] + reach) + 1):
            dx, dy = gx + q[0] - p[0], gy + q[1] - p[1]
            if dx * dx + dy * dy > reach**2:
                continue
            rise = q[2] + twist * gx * q[1] - p[2] - twist * p[0] * dy - 0.5 * twist * dx * dy
            for gz in range(math.ceil(-height - rise), math.floor(height - rise) + 1):
                images.append((gx, gy, gz))
    return images


def images_within(p, q, twist, reach):
    """Deck elements and positions (float64) of the images of q within the distance ``reach``."""
    from nil_mitsuba import geometry

    cells = enough_cells(p, q, twist, reach)
    g = columns(cells, 1, Array3f64)
    image = truth.multiply(g, Array3f64(*q), twist)
    near = geometry.connect(Array3f64(*p), image, twist).distance <= reach
    keep = dr.compress(near)
    return dr.gather(Array3f64, g, keep), dr.gather(Array3f64, image, keep)


def all_geodesics(p, q, twist, reach):
    """Index, direction and distance of every geodesic within ``reach`` from p to points q, in
    float64 by a scan of 1,000 steps per π of the half turn. Twist 0: the straight lines."""
    p = Array3f64(*p)
    count = dr.width(q)
    if twist == 0:
        d = q - p
        distance = dr.norm(d)
        return dr.arange(UInt32, count), d / distance, distance

    def terms(index):
        at = dr.gather(Array3f64, q, index)
        dx, dy = at.x - p.x, at.y - p.y
        height = at.z - p.z - twist * p.x * dy - 0.5 * twist * dx * dy
        return dr.atan2(dy, dx), dr.hypot(dx, dy), twist * height

    def excess(v, r, zeta):
        s, c = dr.sincos(v)
        return (2 * v - zeta) * s * s + dr.square(0.5 * twist * r) * (v - s * c)

    half_turns = 0.5 * abs(twist) * reach
    steps = math.ceil(1000 * half_turns / math.pi)
    lane = dr.arange(dr.llvm.UInt64, count * steps)
    index, v = UInt32(lane // steps), Float64(lane % steps) / steps * half_turns
    _, r, zeta = terms(index)
    zeta = dr.abs(zeta)
    b = v + half_turns / steps
    # v = 0 itself is no root: the excess starts with −ζ v² there
    crossing = (excess(dr.maximum(v, 1e-9), r, zeta) < 0) != (excess(b, r, zeta) < 0)
    keep = dr.compress(crossing)
    index, a, b = (
        dr.gather(UInt32, index, keep),
        dr.gather(Float64, v, keep),
        dr.gather(Float64, b, keep),
    )
    a = dr.maximum(a, 1e-9)
    azimuth, r, zeta = terms(index)
    orientation = dr.select(zeta < 0, Float64(-1), 1)
    zeta = dr.abs(zeta)
    low = excess(a, r, zeta) < 0
    for _ in range(45):
        m = 0.5 * (a + b)
        same = (excess(m, r, zeta) < 0) == low
        a, b = dr.select(same, m, a), dr.select(same, b, m)
        dr.eval(a, b)
    v = 0.5 * (a + b)
    horizontal = r * v / dr.sin(v)
    distance = dr.hypot(horizontal, 2 * v / abs(twist))
    angle = azimuth - orientation * v
    c = horizontal / distance
    direction = Array3f64(
        c * dr.cos(angle), c * dr.sin(angle), orientation * 2 * v / (twist * distance)
    )
    keep = dr.compress(distance <= reach)
    return (
        dr.gather(UInt32, index, keep),
        dr.gather(Array3f64, direction, keep),
        dr.gather(Float64, distance, keep),
    )


def sum_over_images(p, n, q, twist, reach):
    """Σ cos θ / |A| over all images of q within ``reach`` and all geodesics to each, in float64."""
    from nil_mitsuba import geometry

    _, images = images_within(p, q, twist, reach)
    _, direction, distance = all_geodesics(p, images, twist, reach)
    density = dr.abs(geometry.area_density(distance, direction.z, float(twist)))
    cosine = dr.maximum(dr.dot(direction, Array3f64(*n)), 0)
    return dr.sum(cosine / density)[0], dr.width(distance)
