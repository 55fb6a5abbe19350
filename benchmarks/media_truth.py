"""What a point light shows in a homogeneous medium, in float64 by quadrature over all geodesics.

It shares no code with the package: geodesics are those of `truth`, the ones that join two points
are found by a scan, and area densities are differences of geodesics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
from drjit.llvm import Array3f64, Float64, UInt32

from . import truth
from .light_truth import all_geodesics, enough_cells

# Differences of directions by which area densities are taken: their squares are the error
DIFFERENCE = 1e-5
# Pairs of points that are scanned at once, with a few hundred steps each
PAIRS = 50_000


@dataclass(frozen=True)
class Medium:
    """A homogeneous medium (per cell) with the phase function of Henyey and Greenstein."""

    extinction: float
    albedo: float
    g: float

    def phase(self, cosine):
        """Density of scattering by an angle of this ``cosine``: 1 is straight on."""
        return (1 - self.g**2) / (4 * math.pi * (1 + self.g**2 - 2 * self.g * cosine) ** 1.5)


def gauss(count):
    """Nodes and weights of Gauss and Legendre's quadrature on [0, 1]."""
    nodes, weights = [], []
    for i in range(count):
        x = math.cos(math.pi * (i + 0.75) / (count + 0.5))
        for _ in range(6):
            before, now = 1.0, x
            for n in range(2, count + 1):
                before, now = now, ((2 * n - 1) * x * now - (n - 1) * before) / n
            slope = count * (x * now - before) / (x * x - 1)
            x -= now / slope
        nodes.append(0.5 * (1 - x))
        weights.append(1 / ((1 - x * x) * slope**2))
    return nodes, weights


def area_density(v, t, twist):
    """|dA/dω| after the arc length t along the frame direction v, by differences of geodesics."""
    zero, h = dr.zeros(Array3f64), DIFFERENCE
    axis = dr.select(dr.abs(v.z) < 0.7, Array3f64(0, 0, 1), Array3f64(1, 0, 0))
    e1 = dr.normalize(dr.cross(axis, v))
    e2 = dr.cross(v, e1)
    end, arrival = truth.flow(zero, v, t, twist)

    def change(e):
        ahead, _ = truth.flow(zero, math.cos(h) * v + math.sin(h) * e, t, twist)
        behind, _ = truth.flow(zero, math.cos(h) * v - math.sin(h) * e, t, twist)
        d = (ahead - behind) / (2 * math.sin(h))
        return Array3f64(d.x, d.y, d.z - twist * end.x * d.y)

    return dr.abs(dr.dot(dr.cross(change(e1), change(e2)), arrival))


def quadrature(length, panels):
    """Nodes and weights on [0, length], eight in each of as many equal panels."""
    nodes, weights = gauss(8)
    h = length / panels
    s = [(i + x) * h for i in range(panels) for x in nodes]
    return Float64(s), Float64([w * h for _ in range(panels) for w in weights])


def images(points, light, twist, reach):
    """Index of a point and image of the light (float64) for all that ``reach`` may join."""
    index, cells = [], []
    for i, p in enumerate(zip(*points)):
        near = enough_cells(p, light, twist, reach)
        index += [i] * len(near)
        cells += near
    g = Array3f64(*(Float64([float(c[axis]) for c in cells]) for axis in range(3)))
    return UInt32(index), truth.multiply(g, Array3f64(*light), twist)


def single_scattering(p, v, light, twist, medium, reach, quotient, boundary=None, panels=64):
    """Radiance, along the geodesic from ``p`` in frame direction ``v``, of a point light of
    intensity 1 after one scattering.

    The geodesic ends after the length ``reach`` (cells), and so do all that join its points with
    the light, or with all its images in the ``quotient``. A ``boundary`` (`truth.Sphere`) ends the
    medium; nothing of it may leave it and come back.
    """
    p, v = Array3f64(*p), dr.normalize(Array3f64(*v))
    length = reach
    if boundary is not None:
        exit = truth.first_hit([boundary], p, v, reach, twist, False)
        length = exit.t[0]
        assert length < reach
        again = truth.first_hit([boundary], *truth.flow(p, v, length + 1e-6, twist), 20, twist, 0)
        assert again.label[0] == truth.NO_SURFACE, "the geodesic comes back into the medium"
    s, weight = quadrature(length, panels)
    points, arrival = truth.flow(p, v, s, twist)
    if quotient:
        index, q = images(points, light, twist, reach)
    else:
        index, q = dr.arange(UInt32, dr.width(s)), Array3f64(*light)
    q = truth.multiply_inverse(dr.gather(Array3f64, points, index), q, twist)
    dr.eval(points, arrival, index, q)

    σ, total = medium.extinction, 0.0
    for first in range(0, dr.width(index), PAIRS):
        pairs = dr.arange(UInt32, first, min(first + PAIRS, dr.width(index)))
        here, direction, distance = all_geodesics(
            (0, 0, 0), dr.gather(Array3f64, q, pairs), twist, reach
        )
        if dr.width(distance) == 0:
            continue
        here = dr.gather(UInt32, index, dr.gather(UInt32, pairs, here))
        if boundary is not None:
            start = dr.gather(Array3f64, points, here)
            hit = truth.first_hit([boundary], start, direction, distance, twist, False)
            assert dr.all(hit.label == truth.NO_SURFACE), "light comes from outside of the medium"
        cosine = dr.dot(dr.gather(Array3f64, arrival, here), direction)
        value = medium.phase(cosine) * dr.exp(-σ * (dr.gather(Float64, s, here) + distance))
        value /= area_density(direction, distance, twist)
        total += dr.sum(value * dr.gather(Float64, weight, here))[0]

    return σ * medium.albedo * total
