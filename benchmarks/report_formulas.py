"""The closed form that divides by w, and its face crossings, in the form of VISGRAF TR-19-06.

For comparison only: the package uses neither. The crossings are those of twist 1. Any Dr.Jit type
of 32 or 64 bit; points in cells, directions as frame components, (c cos α, c sin α, w) in the
report's letters. Derived anew in that form, with the divisions by w and w² that make it fail.
"""

import drjit as dr

from nil_mitsuba import geometry


def _horizontal(v):
    return dr.sqrt(v.x * v.x + v.y * v.y), dr.atan2(v.y, v.x)


def geodesic(p, v, t, twist=1):
    """Point and direction after the arc length t, with k: it divides by w and by w².

    x = c/ω (sin(ωt + α) − sin α), y = −c/ω (cos(ωt + α) − cos α) with ω = k w, and
    z = w t + k c²/ω (t/2 − (sin(2ωt + 2α) − sin 2α)/4ω + sin α (cos(ωt + α) − cos α)/ω).
    """
    c, alpha, omega = dr.hypot(v.x, v.y), dr.atan2(v.y, v.x), twist * v.z
    sin_0, cos_0 = dr.sincos(alpha)
    sin_t, cos_t = dr.sincos(dr.fma(omega, t, alpha))
    x = c / omega * (sin_t - sin_0)
    y = -c / omega * (cos_t - cos_0)
    # sin 2φ = 2 sin φ cos φ
    z = v.z * t + twist * dr.square(c) / omega * (
        0.5 * t - (sin_t * cos_t - sin_0 * cos_0) / (2 * omega) + sin_0 * (cos_t - cos_0) / omega
    )
    return (
        type(p)(geometry.multiply(p, type(p)(x, y, z), twist)),
        type(v)(c * cos_t, c * sin_t, v.z),
    )


def crossing_of_x(p, v, c):
    """Arc length to the plane x = c, by the arcsine: one of the two branches."""
    (radius, alpha), w = _horizontal(v), v.z
    return (dr.asin(dr.sin(alpha) + w / radius * (c - p.x)) - alpha) / w


def crossing_of_y(p, v, c):
    """Arc length to the plane y = c, by the arccosine: one of the two branches."""
    (radius, alpha), w = _horizontal(v), v.z
    return (dr.acos(dr.cos(alpha) - w / radius * (c - p.y)) - alpha) / w
