"""
The formulas of the report VISGRAF TR-19-06 as they stand there, for comparison only.

They are those of twist 1, and divide by w and by w². Any Dr.Jit type of 32 or 64 bit; points in
cells, directions as frame components, (c cos α, c sin α, w) in the report's letters.
"""

import drjit as dr


def _horizontal(v):
    return dr.sqrt(v.x * v.x + v.y * v.y), dr.atan2(v.y, v.x)


def geodesic(p, v, t):
    """The point after arc length t of the geodesic from p along v."""
    (c, alpha), w = _horizontal(v), v.z
    x = c / w * (dr.sin(w * t + alpha) - dr.sin(alpha))
    y = c / w * (dr.cos(alpha) - dr.cos(w * t + alpha))
    z = ((w + c * c / (2 * w)) * t
         - c * c / (4 * w * w) * (dr.sin(2 * w * t + 2 * alpha) - dr.sin(2 * alpha))
         + c * c / (2 * w * w) * (dr.sin(w * t + 2 * alpha) - dr.sin(2 * alpha) - dr.sin(w * t)))
    return type(p)(p.x + x, p.y + y, p.z + z + p.x * y)


def crossing_of_x(p, v, c):
    """Arc length to the plane x = c, by the arcsine: one of the two branches."""
    (radius, alpha), w = _horizontal(v), v.z
    return (dr.asin(dr.sin(alpha) + w / radius * (c - p.x)) - alpha) / w


def crossing_of_y(p, v, c):
    """Arc length to the plane y = c, by the arccosine: one of the two branches."""
    (radius, alpha), w = _horizontal(v), v.z
    return (dr.acos(dr.cos(alpha) - w / radius * (c - p.y)) - alpha) / w
