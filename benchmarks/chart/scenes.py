"""The six scenes of the chart: surfaces that both Mitsuba and the truth know."""

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .. import truth
from ..truth import Array3f64, Cylinder, Float64, Rectangle, Sphere

TWIST = 1
# What the first chart shows, up to so many cells
MAIN = {"scene": "dense", "space": "quotient", "length": 5}


@dataclass
class Setup:
    """Surfaces, where the camera is, and what is special about the scene."""

    kind: str
    quotient: bool
    surfaces: list
    origin: tuple
    target: tuple
    fov: float = 70
    # A mesh of so many triangles a parallelogram instead of the shapes themselves
    mesh: int = 0
    # Index of the surface that reflects, if the second hit is what counts
    mirror: int | None = None

    @property
    def space(self):
        return "quotient" if self.quotient else "plain"


def geodesic(p, v, t):
    """End point of a geodesic in Python floats."""
    p, v = (Array3f64(*x) for x in (p, v))
    return tuple(x[0] for x in truth.flow(p, v, Float64(t), TWIST)[0])


def sheared(p, v):
    """Coordinates at p of the frame vector v: what a left translation makes of a flat thing."""
    return v[0], v[1], v[2] + TWIST * p[0] * v[1]


def square(p, a, b, size):
    """A parallelogram around p that looks like a square of the edge ``size`` from nearby."""
    u, v = (sheared(p, tuple(size * x for x in edge)) for edge in (a, b))
    return Rectangle(tuple(c - (x + y) / 2 for c, x, y in zip(p, u, v)), u, v)


def tumbled(turn):
    """Three orthogonal unit vectors; another ``turn``, another orientation."""
    s, c = math.sin(turn), math.cos(turn)
    t, d = math.sin(2.4 * turn + 1), math.cos(2.4 * turn + 1)
    return (c, s, 0), (-s * d, c * d, t), (s * t, -c * t, d)


def box(p, size, turn):
    """The six faces of a box that looks like a cube from nearby."""
    axes = [sheared(p, tuple(size * x for x in axis)) for axis in tumbled(turn)]
    corner = tuple(c - sum(axis[i] for axis in axes) / 2 for i, c in enumerate(p))
    far = tuple(c + sum(axis[i] for axis in axes) for i, c in enumerate(corner))
    minus = [tuple(-x for x in axis) for axis in axes]
    return [
        Rectangle(at, e[i - 1], e[i - 2])
        for at, e in ((corner, axes), (far, minus))
        for i in range(3)
    ]


def sparse_cell():
    """Little in a cell: two balls, a rod and a sheet. Half of the rays go further than 7 cells."""
    return [
        Sphere((0.31, 0.36, 0.42), 0.12),
        Sphere((0.72, 0.77, 0.64), 0.08),
        Cylinder((0.75, 0.25, 0.21), (0.66, 0.31, 0.79), 0.012),
        Rectangle((0.18, 0.72, 0.13), (0.21, 0.05, 0), (-0.03, 0.09, 0.17)),
    ]


def boxes_in_cell():
    places = (
        (0.29, 0.31, 0.27),
        (0.73, 0.29, 0.66),
        (0.31, 0.74, 0.69),
        (0.75, 0.76, 0.25),
        (0.47, 0.49, 0.81),
    )
    sizes = (0.29, 0.25, 0.27, 0.23, 0.17)
    return [face for i, (p, size) in enumerate(zip(places, sizes)) for face in box(p, size, 2 + i)]


def around(p, axis, fov, n):
    """End points of ``n`` geodesics from p within a cone, 0.5 to 20 cells long, and lengths."""
    first = math.cos(math.radians(fov) / 2)
    side = (axis[1], -axis[0], 0)
    norm = math.hypot(*side)
    side = tuple(x / norm for x in side)
    up = (side[1] * axis[2], -side[0] * axis[2], side[0] * axis[1] - side[1] * axis[0])
    for i in range(n):
        z = 1 - (1 - first) * (i + 0.5) / n
        phi = 2 * math.pi * i * (math.sqrt(5) - 1) / 2
        r = math.sqrt(1 - z * z)
        v = tuple(
            z * a + r * (math.cos(phi) * s + math.sin(phi) * u) for a, s, u in zip(axis, side, up)
        )
        # Another irrational step for the length, so that near and far are mixed in every direction
        t = 0.5 * 40 ** (i * math.sqrt(2) % 1)
        yield i, geodesic(p, v, t), t


def sparse_plain(p, axis):
    """Balls near by, squares further away: everything from 0.5 to 20 cells from the camera."""
    return [
        Sphere(q, 0.14 * t) if t < 2 else square(q, *tumbled(1 + i)[:2], 0.3 * t)
        for i, q, t in around(p, axis, 70, 30)
    ]


def boxes_plain(p, axis):
    return [face for i, q, t in around(p, axis, 50, 5) for face in box(q, 0.45 * t, 2 + i)]


def setups():
    """The six scenes."""
    axis = (0.05, 0.9, math.sqrt(1 - 0.05**2 - 0.9**2))
    eye = (0.103, -0.211, 0.157)
    ahead = tuple(a + b for a, b in zip(eye, axis))
    ball = (0.21, 0.6, 0.47)
    cell_eye, cell_target = (0.503, 0.021, 0.457), (0.531, 0.613, 0.671)
    # What a mirror ball reflects lies around it on all sides
    reflected = [
        square(q, *tumbled(1 + i)[:2], 0.9 * t)
        for i, q, t in around(ball, (0.6, 0, 0.8), 359.9, 30)
    ]
    return [
        Setup("sparse", False, sparse_plain(eye, axis), eye, ahead),
        Setup("sparse", True, sparse_cell(), cell_eye, cell_target),
        Setup("dense", False, boxes_plain(eye, axis), eye, ahead, mesh=2 * 64**2),
        Setup("dense", True, boxes_in_cell(), cell_eye, cell_target, mesh=2 * 64**2),
        Setup("glossy", False, [Sphere(ball, 0.3), *reflected], eye, ball, 40, mirror=0),
        Setup(
            "glossy",
            True,
            [Sphere((0.52, 0.51, 0.49), 0.15), *sparse_cell()],
            (0.43, 0.021, 0.457),
            (0.49, 0.49, 0.31),
            36,
            mirror=0,
        ),
    ]


def triangles(surfaces, count):
    """One mesh of all parallelograms, each cut into ``count`` = 2 n² triangles in order."""
    n = round(math.sqrt(count / 2))
    index = dr.arange(mi.UInt32, (n + 1) ** 2)
    alpha, beta = (mi.Float64(i) / n for i in (index % (n + 1), index // (n + 1)))
    points = [
        mi.Point3f(*(mi.Float(c + alpha * u + beta * v) for c, u, v in zip(s.corner, s.u, s.v)))
        for s in surfaces
    ]
    quad = dr.arange(mi.UInt32, n * n)
    corner = quad + quad // n
    faces = dr.zeros(mi.UInt32, 3 * count * len(surfaces))
    for k in range(len(surfaces)):
        first = k * (n + 1) ** 2 + corner
        for i, triangle in enumerate(
            ((first, first + n + 1, first + 1), (first + 1, first + n + 1, first + n + 2))
        ):
            for j in range(3):
                dr.scatter(faces, triangle[j], (2 * (quad + k * n * n) + i) * 3 + j)
    mesh = mi.Mesh("mesh", len(surfaces) * (n + 1) ** 2, len(surfaces) * count)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = dr.concat([dr.ravel(p) for p in points])
    parameters["faces"] = faces
    parameters.update()
    return mesh
