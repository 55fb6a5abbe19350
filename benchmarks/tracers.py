"""The tracers that are compared, and the first hits of rays by any of them.

A tracer is made by a function of the scene, the space, the longest distance and the scene's shapes
if they are known, once a variant is set.
"""

import math

import drjit as dr
import mitsuba as mi
from drjit.llvm import Array3f, Array3f64, Array3i, Float64, Int32

from . import truth

# Length of chords, or the tolerance for them
KNOBS = {"printed form": 0.05, "Runge–Kutta 4": 0.05, "Dormand–Prince": 1e-4}

# A camera's cone at the default tolerance, a quarter of a pixel of 1/1000
SPREAD = 0.25e-3


def allowance(t, twist):
    """How far, in a coordinate, a wall may be off where |x| ≤ 1: as far as camera_rays.py
    allows hits to be across their ray."""
    return (2e-5 + 2e-6 * t) * math.sqrt(1 + twist**2)


def package(scene, space, max_distance, shapes=None, focus=None):
    from nil_mitsuba.tracer import Tracer

    return Tracer(scene, space, max_distance, shapes, focus)


def chords(method, knob):
    """What makes a tracer by a method of ``tracing_methods``, which needs a variant."""

    def make(scene, space, max_distance, shapes=None, focus=None):
        from .tracing_methods import METHODS, ChordTracer

        return ChordTracer(scene, space, max_distance, METHODS[method], knob, shapes)

    return make


# Of chords a ray takes 41 (fixed) and 52 (Dormand–Prince) in ``room_scene``, 52 and 59 in
# ``cell_scene``; the package, which leaps, takes fewer
TRACERS = {name: chords(name, knob) for name, knob in KNOBS.items()} | {"package": package}
OTHERS = [name for name in TRACERS if name != "package"]


class Traced:
    """First hits by a tracer, with labels and places in the truth's types."""

    def __init__(
        self,
        shapes,
        p,
        v,
        twist,
        quotient,
        max_distance=12.0,
        origin=(0, 0, 0),
        size=1.0,
        make=package,
    ):
        from nil_mitsuba.interaction import surface_interaction
        from nil_mitsuba.quotient import Space
        from nil_mitsuba.tracer import Cone

        scene = mi.load_dict({"type": "scene", **shapes})
        space = Space(float(twist), quotient, list(origin), float(size))
        tracer = make(scene, space, max_distance)
        start, direction = mi.Point3f(p), mi.Vector3f(v)
        hit = tracer.intersect(
            start, direction, Cone(0, SPREAD), tracer.reach(start, direction), mi.Bool(True)
        )
        si = surface_interaction(hit, direction, space, mi.Color0f())
        label = mi.Int32(truth.NO_SURFACE)
        for shape in scene.shapes():
            found = hit.valid & (si.shape == mi.ShapePtr(shape))
            label = dr.select(found, int(shape.id()[1:]), label)
        place = space.to_cells(si.p)
        dr.eval(hit, label, place)
        self.label, self.g = Int32(label), Array3i(*(Int32(c) for c in hit.cell))
        self.t, self.valid = Float64(hit.distance), hit.valid
        self.arrival = Array3f(hit.arrival)
        self.in_cell = Array3f64(*(Float64(c) for c in place))
        self.place = truth.multiply(Array3f64(self.g), self.in_cell, Float64(twist))
        self.hashes = truth.surface_hash(self.label, self.g)


def naming(surfaces, p, v, twist, quotient, max_distance=12.0, make=package):
    """(traced, exact, whether a ray names another surface than the truth)."""
    traced = Traced(truth.to_mitsuba(surfaces, mi), p, v, twist, quotient, max_distance, make=make)
    exact = truth.first_hit(surfaces, Array3f64(p), Array3f64(v), max_distance, twist, quotient)
    return traced, exact, traced.hashes != truth.surface_hash(exact.label, exact.g)
