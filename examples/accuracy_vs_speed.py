"""Charts accuracy against speed for every serious way of tracing geodesics of Nil.

Traces the same camera rays by the package and by the methods of ``tracing_methods.py``, through
sparse, dense and glossy scenes in plain Nil and in the quotient, up to 1, 5 and 20 cells, and
compares each hit with float64 root finding on analytic surfaces (``tests/truth.py``), which shares
no code with any of them. Writes tables and charts into the folder ``charts``.

The dense scene is a mesh of 245,760 triangles that makes up the 30 faces of five boxes: planes cut
into triangles are still planes, so the truth about the mesh is exact.

Times are processor time of kernels on two threads; see ``timed``. Take them on an idle machine.
"""

import argparse
import importlib.util
import json
import math
import pathlib
import re
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from unittest import mock

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses LLVM

# isort: split
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from nil_mitsuba import geometry, integrator  # noqa: E402 - these need a variant
from nil_mitsuba.camera import Camera  # noqa: E402
from nil_mitsuba.interaction import surface_interaction  # noqa: E402
from nil_mitsuba.quotient import Space, multiply_cells  # noqa: E402
from nil_mitsuba.tracer import Cone, Tracer  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))

import truth  # noqa: E402
from flip import flip  # noqa: E402
from tracing_methods import METHODS, ChordTracer, adaptive_steps, fixed_steps  # noqa: E402
from truth import Array3f64, Array3i, Cylinder, Float64, Int32, Rectangle, Sphere  # noqa: E402

TWIST = 1
LENGTHS = (1, 5, 20)


# ---------------------------------------------------------------------------
#  Scenes
# ---------------------------------------------------------------------------

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


def spiral(n):
    """Directions spread evenly over the sphere: the golden spiral."""
    for i in range(n):
        z = 1 - (2 * i + 1) / n
        phi = 2 * math.pi * i * (math.sqrt(5) - 1) / 2
        r = math.sqrt(1 - z * z)
        yield r * math.cos(phi), r * math.sin(phi), z


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
    return [Rectangle(at, e[i - 1], e[i - 2])
            for at, e in ((corner, axes), (far, minus)) for i in range(3)]


def sparse_cell():
    """Little in a cell: two balls, a rod and a sheet. Half of the rays go further than 7 cells."""
    return [
        Sphere((0.31, 0.36, 0.42), 0.12), Sphere((0.72, 0.77, 0.64), 0.08),
        Cylinder((0.75, 0.25, 0.21), (0.66, 0.31, 0.79), 0.012),
        Rectangle((0.18, 0.72, 0.13), (0.21, 0.05, 0), (-0.03, 0.09, 0.17)),
    ]


def boxes_in_cell():
    places = ((0.29, 0.31, 0.27), (0.73, 0.29, 0.66), (0.31, 0.74, 0.69), (0.75, 0.76, 0.25),
              (0.47, 0.49, 0.81))
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
        v = tuple(z * a + r * (math.cos(phi) * s + math.sin(phi) * u)
                  for a, s, u in zip(axis, side, up))
        # Another irrational step for the length, so that near and far are mixed in every direction
        t = 0.5 * 40 ** (i * math.sqrt(2) % 1)
        yield i, geodesic(p, v, t), t


def sparse_plain(p, axis):
    """Balls near by, squares further away: everything from 0.5 to 20 cells from the camera."""
    return [Sphere(q, 0.14 * t) if t < 2 else square(q, *tumbled(1 + i)[:2], 0.3 * t)
            for i, q, t in around(p, axis, 70, 30)]


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
    reflected = [square(q, *tumbled(1 + i)[:2], 0.9 * t)
                 for i, q, t in around(ball, (0.6, 0, 0.8), 359.9, 30)]
    return [
        Setup("sparse", False, sparse_plain(eye, axis), eye, ahead),
        Setup("sparse", True, sparse_cell(), cell_eye, cell_target),
        Setup("dense", False, boxes_plain(eye, axis), eye, ahead, mesh=2 * 64**2),
        Setup("dense", True, boxes_in_cell(), cell_eye, cell_target, mesh=2 * 64**2),
        Setup("glossy", False, [Sphere(ball, 0.3), *reflected], eye, ball, 40, mirror=0),
        Setup("glossy", True, [Sphere((0.52, 0.51, 0.49), 0.15), *sparse_cell()],
              (0.43, 0.021, 0.457), (0.49, 0.49, 0.31), 36, mirror=0),
    ]


def triangles(surfaces, count):
    """One mesh of all parallelograms, each cut into ``count`` = 2 n² triangles in order."""
    n = round(math.sqrt(count / 2))
    index = dr.arange(mi.UInt32, (n + 1) ** 2)
    alpha, beta = (mi.Float64(i) / n for i in (index % (n + 1), index // (n + 1)))
    points = [mi.Point3f(*(mi.Float(c + alpha * u + beta * v)
                           for c, u, v in zip(s.corner, s.u, s.v))) for s in surfaces]
    quad = dr.arange(mi.UInt32, n * n)
    corner = quad + quad // n
    faces = dr.zeros(mi.UInt32, 3 * count * len(surfaces))
    for k in range(len(surfaces)):
        first = k * (n + 1) ** 2 + corner
        for i, triangle in enumerate(((first, first + n + 1, first + 1),
                                      (first + 1, first + n + 1, first + n + 2))):
            for j in range(3):
                dr.scatter(faces, triangle[j], (2 * (quad + k * n * n) + i) * 3 + j)
    mesh = mi.Mesh("mesh", len(surfaces) * (n + 1) ** 2, len(surfaces) * count)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = dr.concat([dr.ravel(p) for p in points])
    parameters["faces"] = faces
    parameters.update()
    return mesh


# ---------------------------------------------------------------------------
#  Rays and their truth
# ---------------------------------------------------------------------------

# The cone of a ray is that of a pixel of an image of this width, whose rays go through fewer pixels
IMAGE = 512
# Dr.Jit gives a thread so many rays at a time
BLOCK = 16384
# Mirrored rays start so far along themselves (cells)
OFF = 1e-3


class Rays:
    """Camera rays of a setup and what they hit in truth, up to the longest of ``LENGTHS``."""

    def __init__(self, setup, width):
        self.setup, self.width = setup, width
        self.space = Space(TWIST, setup.quotient, [0, 0, 0], 1.0)
        if setup.mesh:
            shapes = {"s0": triangles(setup.surfaces, setup.mesh)}
        else:
            shapes = truth.to_mitsuba(setup.surfaces, mi)
        self.scene = mi.load_dict({"type": "scene", **shapes})
        sensor = mi.load_dict({
            "type": "perspective", "fov": setup.fov,
            "to_world": mi.ScalarTransform4f().look_at(list(setup.origin), list(setup.target),
                                                       [0.01, 0.02, 1]),
            "film": {"type": "hdrfilm", "width": IMAGE, "height": IMAGE},
        })
        index = dr.arange(mi.UInt32, width * width)
        place = mi.Point2f(index % width + 0.5, index // width + 0.5) / width
        ray, _ = sensor.sample_ray_differential(0, 0.5, place, mi.Point2f(0.5))
        # The cone of a tolerance of one pixel
        p, self.v, self.cone, _ = Camera(
            sensor, self.space, 1.0).start(ray, mi.Float(0))
        self.p = mi.Point3f(p)
        dr.eval(self.p, self.v, self.cone)

        wide = [Array3f64(*(Float64(dr.detach(c)) for c in x)) for x in (self.p, self.v)]
        exact = truth.first_hit(setup.surfaces, *wide, LENGTHS[-1], TWIST, setup.quotient)
        self.first_t, self.on_mirror = exact.t, dr.full(truth.Bool, True, width * width)
        # Silhouettes of what is seen at once, and of what the mirror shows
        seen = truth.surface_hash(exact.label, exact.g)
        near = truth.near_silhouette(seen, width, width)
        if setup.mirror is not None:
            self.on_mirror = exact.label == setup.mirror
            exact = self._reflected(exact)
            seen = dr.select(self.on_mirror, truth.surface_hash(exact.label, exact.g), seen)
            near |= truth.near_silhouette(seen, width, width)
        self.exact, self.near = exact, near
        dr.eval(self.first_t, self.on_mirror, self.exact, self.near)

    def _reflected(self, exact):
        """What the rays that met the mirror sphere hit next.

        They start OFF from the sphere, which is convex and has nothing so near.
        """
        sphere = self.setup.surfaces[self.setup.mirror]
        n = exact.p_cell - Array3f64(*sphere.center)
        conormal = Array3f64(n.x, n.y + TWIST * exact.p_cell.x * n.z, n.z)
        n = dr.normalize(conormal)
        v = exact.v - 2 * dr.dot(exact.v, n) * n
        dr.eval(v)
        p, v = truth.flow(exact.p, v, Float64(OFF), TWIST)
        dr.eval(p, v)
        length = dr.select(self.on_mirror, LENGTHS[-1] - OFF, 0)
        hit = truth.first_hit(self.setup.surfaces, p, v, length, TWIST, self.setup.quotient)
        hit.t = hit.t + OFF
        return hit

    def indices(self, length):
        """The rays as indices; if there is a mirror, those that meet it.

        Neighbours in a row stay neighbours, as in a render. Rows are in such an order that every
        block has some from all parts of the image, and the number of blocks is even if there is
        more than one: so two threads have the same to do.
        """
        usable = self.on_mirror & (self.first_t < length if self.setup.mirror is not None else True)
        place, groups = dr.arange(truth.UInt32, self.width**2), 8
        row, column = place // self.width, place % self.width
        row = row % (self.width // groups) * groups + row // (self.width // groups)
        order = row * self.width + column
        order = dr.gather(truth.UInt32, order, dr.compress(dr.gather(truth.Bool, usable, order)))
        found = dr.width(order)
        count = found // (2 * BLOCK) * 2 * BLOCK or found
        # Evenly spread over those that were found
        chosen = dr.arange(truth.Float64, count) * (found / count)
        return mi.UInt32(dr.gather(truth.UInt32, order, truth.UInt32(chosen)))


@dataclass
class Selection:
    """Some of the rays, ready to be traced up to a length."""
    rays: Rays
    index: object
    length: float

    def __post_init__(self):
        rays = self.rays

        def chosen(x):
            return dr.gather(type(x), x, self.index) if dr.width(x) > 1 else x

        self.p, self.v = chosen(rays.p), chosen(rays.v)
        self.cone = Cone(chosen(rays.cone.width), chosen(rays.cone.spread))
        dr.eval(self.p, self.v, self.cone)


def trace(tracer, selection, tolerance):
    """The hit that counts, the direction in which its segment started, and its cell."""
    setup, space = selection.rays.setup, selection.rays.space
    p, v = selection.p, selection.v
    # Opaque: one kernel for all tolerances and lengths
    tolerance, length = (dr.opaque(mi.Float, x) for x in (tolerance, selection.length))
    cone = Cone(tolerance * selection.cone.width, tolerance * selection.cone.spread)
    hit = tracer.intersect(p, v, cone, dr.minimum(tracer.reach(p, v), length), mi.Bool(True))
    if setup.mirror is None:
        return hit, v, hit.cell
    si = surface_interaction(hit, v, space, mi.Color0f())
    mirror = si.shape == mi.ShapePtr(next(s for s in selection.rays.scene.shapes()
                                          if s.id() == f"s{setup.mirror}"))
    # Where the integrator moves the start along the normal, which shifts a mirrored ray sideways
    # by 1e-4 cells whatever the method, these rays start further along themselves.
    v = mi.Vector3f(si.to_world(mi.reflect(si.wi)))
    p, v = geometry.flow(space.to_cells(si.p), v, OFF, space.twist)
    cell = hit.cell
    if setup.quotient:
        p, home = geometry.wrap(p, space.twist)
        cell = multiply_cells(cell, mi.Vector3i(home), space)
    # As behind the integrator's mirrors
    cone = Cone(dr.fma(cone.spread, hit.distance, cone.width), cone.spread)
    hit = tracer.intersect(p, v, cone, dr.minimum(tracer.reach(p, v), length - OFF),
                           hit.valid & mirror)
    if setup.quotient:
        cell = multiply_cells(cell, hit.cell, space)
    return hit, v, cell


def wide(x):
    """Mitsuba's vector as one of the truth's."""
    return Array3f64(*(Float64(dr.detach(c)) for c in x))


def quantiles(values, shares):
    values = sorted(values)
    return [values[min(len(values) - 1, int(share * len(values)))] if values else math.nan
            for share in shares]


class Watched:
    """A scene that counts the segments that each of ``count`` rays searches in it.

    ``lost`` are those of them that are not a number: there Embree finds nothing and says so.
    """

    def __init__(self, scene, count):
        self.scene, self.ray = scene, dr.arange(mi.UInt32, count)
        self.segments, self.lost = (dr.zeros(mi.UInt32, count) for _ in range(2))

    def ray_intersect_preliminary(self, ray, coherent, active):
        dr.scatter_add(self.segments, mi.UInt32(1), self.ray, active)
        number = dr.isfinite(dr.sum(ray.o) + dr.sum(ray.d))
        dr.scatter_add(self.lost, mi.UInt32(1), self.ray, active & ~number)
        return self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)


def errors(tracer, selection, tolerance):
    """How far the hits are from the truth, and the segments that took: a row of the table."""
    rays, index = selection.rays, truth.UInt32(selection.index)
    setup, scene = rays.setup, tracer.scene
    tracer.scene = watched = Watched(scene, dr.width(index))
    hit, v, cell = trace(tracer, selection, tolerance)
    tracer.scene = scene
    si = surface_interaction(hit, v, rays.space, mi.Color0f())
    if setup.mesh:
        label = dr.select(hit.valid, mi.Int32(hit.preliminary.prim_index // setup.mesh), -1)
    else:
        label = mi.Int32(-1)
        for shape in rays.scene.shapes():
            named = hit.valid & (hit.preliminary.shape == mi.ShapePtr(shape))
            label = dr.select(named, int(shape.id()[1:]), label)
    p, arrival, distance, valid, cell = (mi.Point3f(si.p), mi.Vector3f(hit.arrival), hit.distance,
                                         hit.valid, mi.Vector3i(cell))
    dr.eval(p, arrival, distance, valid, label, cell, watched.segments, watched.lost)

    exact = rays.exact
    t = dr.gather(Float64, exact.t, index)
    length = dr.opaque(Float64, selection.length)
    true_label = dr.select(t <= length, dr.gather(Int32, exact.label, index), -1)
    true_g, true_p, true_v = (dr.gather(Array3i, exact.g, index),
                              dr.gather(Array3f64, exact.p_cell, index),
                              dr.gather(Array3f64, exact.v, index))
    near = dr.gather(truth.Bool, rays.near, index)
    label = Int32(label)
    cell = Array3i(*(Int32(c) for c in cell))
    valid = truth.Bool(valid)
    hollow = valid & ~dr.isfinite(Float64(distance) + dr.sum(wide(p)))
    hollow |= truth.Bool(watched.lost > 0)
    same = (label == true_label) & ((label < 0) | dr.all(cell == true_g))
    wrong = ~same | hollow
    right = same & (label >= 0) & ~hollow
    d = wide(p) - true_p
    position = dr.norm(Array3f64(d.x, d.y, d.z - TWIST * true_p.x * d.y))
    direction = dr.norm(wide(arrival) - true_v)
    kept = dr.compress(right)
    position, direction = (list(dr.gather(Float64, x, kept)) for x in (position, direction))
    count = dr.width(index)

    def share(what, among=None):
        total = count if among is None else dr.count(among)[0]
        return dr.count(what if among is None else what & among)[0] / max(1, total)

    median, most, largest = quantiles(position, (0.5, 0.99, 1))
    return {
        "rays": count, "hits": len(position),
        "position": median, "position 99 %": most, "position max": largest,
        **dict(zip(("direction", "direction 99 %", "direction max"),
                   quantiles(direction, (0.5, 0.99, 1)))),
        "other surface": share(wrong), "other surface, away": share(wrong, ~near),
        "other surface, near": share(wrong, near), "not a number": share(hollow),
        "chords": dr.sum(watched.segments)[0] / count,
    }


def timed(run):
    """What ``run()`` makes of Dr.Jit arrays, and the processor time (seconds) of its kernels.

    From the start of each kernel to its end, times the threads, which large kernels keep busy. What
    Python and the compiler take before it starts is a renderer's overhead and not a method's.
    """
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        result = run()
        dr.eval(result)
        dr.sync_thread()
        kernels = dr.kernel_history()
    return result, 1e-3 * sum(kernel["execution_time"] for kernel in kernels) * dr.thread_count()


# ---------------------------------------------------------------------------
#  Methods and their knobs
# ---------------------------------------------------------------------------

PACKAGE = "nil_mitsuba"
STEPS = (0.3, 0.1, 0.03, 0.01, 0.003)
KNOBS = {
    "Euler pieces": STEPS, "Runge–Kutta 4": STEPS, "printed form": STEPS, "stable form": STEPS,
    "Dormand–Prince": (1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    PACKAGE: (64, 16, 4, 1, 0.25, 0.0625, 0.015625),
}
DEFAULT = mi.load_dict({"type": "nil"}).tolerance


def tracer_of(method, knob, scene, space, max_distance=math.inf):
    """A tracer with one setting of the method's knob."""
    if method == PACKAGE:
        return Tracer(scene, space, max_distance)
    return ChordTracer(scene, space, max_distance, METHODS[method], knob)


def chords_expected(method, knob, length):
    """Roughly how many chords a ray of this length takes."""
    if method == PACKAGE:
        return 6 * length / math.sqrt(knob)
    step = 4 * math.sqrt(knob) if method == "Dormand–Prince" else knob
    return length / step


def measure(rays, length, rounds, most):
    """Rows of the table for one setup and length: every method with every setting of its knob.

    All of them trace the same rays. Settings that take more than about ``most`` chords for one are
    left out.
    """
    entries = []
    selection = Selection(rays, rays.indices(length), length)
    for method, knobs in KNOBS.items():
        for knob in knobs:
            if chords_expected(method, knob, length) > most:
                continue
            tolerance = knob if method == PACKAGE else 1.0
            tracer = tracer_of(method, knob, rays.scene, rays.space)
            row = {"scene": rays.setup.kind, "space": rays.setup.space, "length": length,
                   "method": method, "knob": knob, **errors(tracer, selection, tolerance)}
            entries.append((row, tracer, tolerance, []))
    for _ in range(rounds):
        for _, tracer, tolerance, times in entries:
            times.append(timed(lambda: trace(tracer, selection, tolerance)[0])[1])
    for row, _, _, times in entries:
        # The fastest round: what else the machine does can only add
        row["microseconds"] = 1e6 * min(times) / row["rays"]
        row["rays per second"] = row["rays"] / min(times)
    return [entry[0] for entry in entries]


# ---------------------------------------------------------------------------
#  End points alone
# ---------------------------------------------------------------------------

def random_starts(count, float_t):
    """Starts in the unit cube and directions in all of the sphere, the same for all types."""
    random = mi.PCG32(count)    # stream i is ray i's, whatever their number
    numbers = [dr.llvm.Float(dr.detach(random.next_float32())) for _ in range(5)]
    z, phi = 2 * numbers[3] - 1, 2 * math.pi * numbers[4]
    c = dr.sqrt((1 - z) * (1 + z))
    array_t = {dr.llvm.Float: dr.llvm.Array3f, dr.llvm.Float64: Array3f64}[float_t]
    p, v = numbers[:3], [c * dr.cos(phi), c * dr.sin(phi), z]
    dr.eval(p, v)
    return (array_t(*(float_t(x) for x in y)) for y in (p, v))


def closed_form(p, v, length):
    float_t = type(p.x)
    return geometry.flow(p, v, dr.opaque(float_t, length), dr.opaque(float_t, TWIST))[0]


# End points of each launch, of the ODE methods and, for it to be as long, of the closed form; those
# that heyoka finds; and those that are compared with the truth
ENDS, CLOSED_ENDS, HEYOKA_ENDS, CHECKED = 2**16, 2**18, 2**14, 2**12
# Launches are repeated until they took so long together (seconds of processor time)
LONG_ENOUGH = 0.2


def root_mean_square_error(ends, length):
    """Of the first end points, in cells."""
    p, v = random_starts(CHECKED, Float64)
    exact = truth.flow(p, v, Float64(length), Float64(TWIST))[0]
    first = dr.arange(dr.llvm.UInt32, CHECKED)
    d = dr.gather(Array3f64, ends, first) - exact
    square = d.x**2 + d.y**2 + (d.z - TWIST * exact.x * d.y) ** 2
    return math.sqrt(dr.mean(square)[0])


def end_points(lengths, rounds, quick=False):
    """Time and error of end points alone: rows of method, precision, knob, length.

    Every ODE method may work in float64; settings are a factor of √2 or √10 apart. ``quick`` keeps
    to those that reach an error near 1e-6.
    """
    contestants = []
    for length in lengths:
        for name, float_t in (("float32", dr.llvm.Float), ("float64", dr.llvm.Float64)):
            contestants.append((length, PACKAGE, name, float_t, 0.0, closed_form))
            for i in range(8, 9) if quick else range(4, 13):
                steps = round(length * 2 ** (i / 2))
                contestants.append((length, "Runge–Kutta 4", name, float_t, length / steps,
                                    lambda p, v, length, steps=steps:
                                    fixed_steps(p, v, length, steps, TWIST)))
            tightest = 25 if name == "float64" else 15
            for i in range(13, 14) if quick else range(8, tightest):
                tolerance = 10 ** (-i / 2)
                contestants.append((length, "Dormand–Prince", name, float_t, tolerance,
                                    lambda p, v, length, tolerance=tolerance:
                                    adaptive_steps(p, v, length, tolerance, TWIST)))
    starts = {}
    for float_t in (dr.llvm.Float, dr.llvm.Float64):
        for count in (ENDS, CLOSED_ENDS):
            starts[float_t, count] = tuple(random_starts(count, float_t))
    dr.eval(starts)

    rows = []
    for turn in range(rounds):
        for i, (length, method, precision, float_t, knob, run) in enumerate(contestants):
            count = CLOSED_ENDS if method == PACKAGE else ENDS
            p, v = starts[float_t, count]
            times = []
            while sum(times) < LONG_ENOUGH:
                ends, seconds = timed(lambda: run(p, v, length))
                times.append(seconds)
            nanoseconds = 1e9 * min(times) / count
            if turn == 0:
                error = root_mean_square_error(Array3f64(*(Float64(x) for x in ends)), length)
                rows.append({"length": length, "method": method, "precision": precision,
                             "knob": knob, "error": error, "nanoseconds": nanoseconds})
            rows[i]["nanoseconds"] = min(rows[i]["nanoseconds"], nanoseconds)
    for row in rows:
        row["per second"] = 1e9 / row["nanoseconds"]
    return rows


def heyoka_rows(lengths):
    """The same of heyoka in a process of its own, or nothing where it is not installed."""
    if importlib.util.find_spec("heyoka") is None:
        return []
    p, v = random_starts(HEYOKA_ENDS, Float64)
    starts = list(zip(*(list(x) for x in (*p, *v))))
    rows = []
    for length in lengths:
        for tolerance in (1e-3, 1e-5, 1e-8, 1e-12):
            task = {"starts": starts, "length": length, "tolerance": tolerance}
            done = subprocess.run([sys.executable, ROOT / "examples" / "heyoka_end_points.py"],
                                  input=json.dumps(task), capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(f"heyoka_end_points.py failed:\n{done.stderr}")
            result = json.loads(done.stdout)
            ends = Array3f64(*(Float64(x) for x in zip(*result["ends"])))
            nanoseconds = 1e9 * result["seconds"] / len(starts)
            rows.append({"length": length, "method": "heyoka", "precision": "float64",
                         "knob": tolerance, "error": root_mean_square_error(ends, length),
                         "nanoseconds": nanoseconds, "per second": 1e9 / nanoseconds})
    return rows


def throughput_ratio(rows, length, error, precision):
    """How many times faster the closed form is than the fastest ODE setting of that error."""
    rows = [row for row in rows if row["length"] == length and row["error"] <= error]
    ours = [r for r in rows if r["method"] == PACKAGE and r["precision"] == precision]
    best = min((r for r in rows if r["method"] != PACKAGE), key=lambda r: r["nanoseconds"])
    return best["nanoseconds"] / ours[0]["nanoseconds"], ours[0], best


# ---------------------------------------------------------------------------
#  Images
# ---------------------------------------------------------------------------

COLOURS = ((0.75, 0.25, 0.15), (0.2, 0.45, 0.7), (0.8, 0.65, 0.25), (0.35, 0.6, 0.3))

# Settings with about as many chords a ray as the package takes at 1 to 4 pixels; for the package
# those between which its default is to be chosen
IMAGE_KNOBS = (("Euler pieces", 0.03), ("Runge–Kutta 4", 0.1), ("Dormand–Prince", 1e-3),
               ("printed form", 0.1), ("stable form", 0.1),
               (PACKAGE, 4), (PACKAGE, 1), (PACKAGE, DEFAULT))
# What images are compared with is not the package's tracer: chords whose sagitta is 1e-4 cells at
# most, a few thousandths of a pixel. That the package comes to the same is seen from its CHECK.
REFERENCE = ("stable form", 0.03)
CHECK = (PACKAGE, DEFAULT / 16)


def picture(setup, width, height):
    """The setup with materials, a sky and a lamp by the camera."""
    def coloured(i):
        return {"type": "diffuse",
                "reflectance": {"type": "rgb", "value": list(COLOURS[i % len(COLOURS)])}}

    if setup.mesh:
        mesh = triangles(setup.surfaces, setup.mesh)
        mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": coloured(0)}))
        shapes = {"s0": mesh}
    else:
        shapes = truth.to_mitsuba(setup.surfaces, mi)
        for i, shape in enumerate(shapes.values()):
            shape["bsdf"] = ({"type": "conductor"} if i == setup.mirror
                             else {"type": "twosided", "bsdf": coloured(i)})
    lamp = [o + d for o, d in zip(setup.origin, (0.07, 0.03, 0.11))]
    return mi.load_dict({
        "type": "scene", **shapes,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.35, 0.42, 0.5]}},
        "lamp": {"type": "sphere", "center": lamp, "radius": 0.02,
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 60.0}}},
        "sensor": {"type": "perspective", "fov": setup.fov,
                   "to_world": mi.ScalarTransform4f().look_at(list(setup.origin),
                                                              list(setup.target), [0.01, 0.02, 1]),
                   "film": {"type": "hdrfilm", "width": width, "height": height,
                            "pixel_format": "rgb", "rfilter": {"type": "box"}}},
    }, optimize=False)    # Mitsuba 3.9 would merge shapes of one material, and lose their bounds


def rendered(scene, setup, method, knob, spp, seed):
    """An image and the processor seconds it took."""
    renderer = mi.load_dict({"type": "nil", "twist": float(TWIST), "quotient": setup.quotient,
                             "max_depth": 3, "max_distance": float(MAIN["length"]),
                             "tolerance": knob if method == PACKAGE else DEFAULT})

    def tracer(scene, space, max_distance):
        return tracer_of(method, knob, scene, space, max_distance)

    with mock.patch.object(integrator, "Tracer", tracer):
        return timed(lambda: mi.render(scene, integrator=renderer, spp=spp, seed=seed))


def images(setup, knobs, width, height, spp, numbers, reference_spp):
    """Rows of image error over time, and of what is left of it without noise, for one setup.

    ``knobs``: pairs of a method and its knob. Each renders images of ``spp`` samples per pixel with
    the seeds 0, 1, …, of which the first so many as ``numbers`` tell are averaged.

    relMSE is (I − R)(I − R')/(R̄² + 0.01) with two references of other seeds that know nothing of
    each other, so that their own noise has mean zero in it. The error without noise has D D' in
    its numerator, where D = I − R is of images of one seed, whose paths are the same as far as the
    tracers agree and their noise with them, and D' the same of another seed. Its standard error is
    that of the mean over pairs of seeds that have none in common.
    """
    scene = picture(setup, width, height)

    def several(method, knob):
        return [rendered(scene, setup, method, knob, spp, seed) for seed in range(numbers[-1])]

    references = [rendered(scene, setup, *REFERENCE, reference_spp, seed)[0]
                  for seed in (1001, 1002)]
    mean = 0.5 * (references[0] + references[1])
    weight = dr.rcp(dr.square(mean.array) + 0.01)
    same_seeds = [image.array for image, _ in several(*REFERENCE)]
    rows, differences = [], []
    for method, knob in (*knobs, CHECK):
        pictures = several(method, knob)
        setting = {"scene": setup.kind, "space": setup.space, "method": method, "knob": knob}
        for n in numbers if (method, knob) != CHECK else ():
            image = sum(image for image, _ in pictures[:n]) / n
            off = [image.array - reference.array for reference in references]
            rows.append(setting | {
                "spp": n * spp, "seconds": sum(seconds for _, seconds in pictures[:n]),
                "relMSE": dr.mean(off[0] * off[1] * weight)[0],
                "FLIP": dr.mean(flip(image, mean).array)[0],
            })
        off = [image.array - other for (image, _), other in zip(pictures, same_seeds)]
        pairs = [dr.mean(d * other * weight)[0] for d, other in zip(off[::2], off[1::2])]
        error = statistics.mean(pairs)
        deviation = statistics.stdev(pairs) / math.sqrt(len(pairs))
        root = math.sqrt(max(error, 0))
        differences.append(setting | {
            "relMSE without noise": error, "± relMSE": deviation,
            "relative error": root, "± up": math.sqrt(max(error, 0) + deviation) - root,
        })
    return rows, differences


# ---------------------------------------------------------------------------
#  Tables and charts
# ---------------------------------------------------------------------------

# Colours that the colour-blind can tell apart (Okabe and Ito); the package in black
STYLES = {
    PACKAGE: "#000000", "stable form": "#0072B2", "printed form": "#CC79A7",
    "Runge–Kutta 4": "#009E73", "Dormand–Prince": "#56B4E9", "Euler pieces": "#E69F00",
}
# What tables and legends call methods where their name would not do
SHORT_NAMES = {"printed form": "report's form"}
LONG_NAMES = {"printed form": "report's form (divides by w)"}
MAIN = {"scene": "dense", "space": "quotient", "length": 5}


def chosen(rows, **values):
    return [row for row in rows if all(row[key] == value for key, value in values.items())]


# Columns of the rays in JSON only
UNPRINTED = ("hits", "direction", "direction max")
SHORT = {"microseconds": "µs", "rays per second": "rays/s", "nanoseconds": "ns",
         "position 99 %": "99 %", "position max": "max", "direction 99 %": "direction",
         "other surface": "other", "not a number": "NaN",
         "other surface, away": "away", "other surface, near": "near"}


def table(rows):
    """The rows as lines of text."""
    names = [name for name in rows[0] if name not in UNPRINTED]
    cells = [[f"{row[name]:.2g}" if isinstance(row[name], float)
              else SHORT_NAMES.get(row[name], str(row[name])) for name in names] for row in rows]
    names = [SHORT.get(name, name) for name in names]
    widths = [max(len(name), *(len(line[i]) for line in cells)) for i, name in enumerate(names)]
    return "\n".join(" ".join(cell.rjust(width) for cell, width in zip(line, widths))
                     for line in (names, *cells))


def columns(rows):
    """The rows as JSON: the names once."""
    def short(x):
        # JSON knows no NaN
        return x if not isinstance(x, float) else float(f"{x:.3g}") if math.isfinite(x) else None

    return {"columns": list(rows[0]), "rows": [[short(x) for x in row.values()] for row in rows]}


def logarithmic(alt, values, title, between, below=1.3):
    """Arguments of a logarithmic axis with ticks at 10ⁿ · ``between``, as far as values go.

    There is room for another value that is smaller by the factor ``below``.
    """
    low, high = min(values), max(values)
    ticks = [float(f"{b}e{n}") for n in range(-12, 6) for b in between]
    ticks = [t for t in ticks if low / below < t < 1.3 * high]
    scale = alt.Scale(type="log", domain=[low / below, 1.3 * high], nice=False)
    decades = high / low > 1e3
    return {"title": title, "scale": scale,
            "axis": alt.Axis(values=ticks, format="~e" if decades else "~g")}


def curves(alt, data, title_x, title_y, width, height, domain=None, size=34):
    """Curves, one a method, with the package's default marked.

    ``domain``: data whose range the axes span, if it is more than ``data``. ``size`` of the points.
    """
    span = domain or data
    base = alt.Chart(alt.Data(values=data)).encode(
        alt.X("time:Q", **logarithmic(alt, [d["time"] for d in span], title_x, (1, 2, 5))),
        alt.Y("value:Q", **logarithmic(alt, [d["value"] for d in span], title_y, (1,), below=2.5)),
        alt.Color("method:N", title=None,
                  scale=alt.Scale(domain=[LONG_NAMES.get(name, name) for name in STYLES],
                                  range=list(STYLES.values())),
                  legend=alt.Legend(orient="top", columns=6, symbolType="stroke",
                                    symbolStrokeWidth=3, labelFontSize=12, labelLimit=300)),
        order=alt.Order("knob:Q"),
    ).properties(width=width, height=height)
    seen, ours = ~alt.datum.none, alt.datum.method == PACKAGE
    return (
        base.transform_filter(seen & ~ours).mark_line(strokeWidth=1.7),
        base.transform_filter(seen & ours).mark_line(strokeWidth=3.2),
        base.transform_filter(seen).mark_point(
            shape="square" if size < 20 else "circle", filled=True, size=size, opacity=1),
        base.transform_filter(alt.datum.none).mark_point(size=40, fill="white", opacity=1),
        base.transform_filter(alt.datum.default).mark_point(
            shape="diamond", size=180, filled=True, opacity=1, color=STYLES[PACKAGE]),
    )


def plotted(rows, measure):
    """Points of the chart: what was not seen once among N is drawn, hollow, at half of 1/N."""
    result = []
    for row in rows:
        value, none = row[measure], False
        if measure.startswith("other surface") and value == 0:
            value, none = 0.5 / row["rays"], True
        if value and math.isfinite(value):
            result.append({"method": LONG_NAMES.get(row["method"], row["method"]),
                           "knob": row["knob"], "none": none,
                           "default": (row["method"], row["knob"]) == (PACKAGE, DEFAULT),
                           "time": float(f"{row['microseconds']:.4g}"),
                           "value": float(f"{value:.4g}")})
    return result


def main_chart(alt, rows):
    """Two panels for one scene: error of position and share of wrong surfaces."""
    rows = chosen(rows, **MAIN)
    panels = []
    # The label stands where the package's own curve is not
    for measure, title, align, dx in (
            ("position 99 %", "position error that 1 % of the hits exceed (cells)", "left", 4),
            ("other surface", "share of rays that name another surface", "right", -6)):
        data = plotted(rows, measure)
        layers = curves(alt, data, "processor time per ray (µs)", title, 360, 330)
        default = next(d for d in data if d["default"])
        label = alt.Chart(alt.Data(values=[default])).mark_text(
            text="default", dx=dx, dy=16, align=align, fontSize=13, fontWeight="bold",
        ).encode(alt.X("time:Q"), alt.Y("value:Q"))
        panels.append(alt.layer(*layers, label))
    count = max(row["rays"] for row in rows)
    return alt.hconcat(*panels, spacing=30).properties(
        title=alt.TitleParams(
            "Accuracy against speed of tracing geodesics of Nil: lower left is better",
            subtitle=[f"Camera rays in the quotient, twist {TWIST}, up to {MAIN['length']} cells, "
                      f"mesh of {30 * 2 * 64**2:,} triangles, a {IMAGE}×{IMAGE} image; float64 "
                      "root finding as truth.",
                      "Each curve: one method, its step or tolerance varied. Hollow: none among "
                      f"{count:,} rays (drawn at half of one)."],
            anchor="start", fontSize=16, subtitleFontSize=12, offset=14))


def scenes_chart(alt, rows):
    """Small multiples: one row a scene, error of position at one length, surfaces at all."""
    panels = [("position 99 %", MAIN["length"])] + [("other surface", n) for n in LENGTHS]
    grid = []
    for scene in dict.fromkeys((row["scene"], row["space"]) for row in rows):
        line = []
        for measure, length in panels:
            part = chosen(rows, scene=scene[0], space=scene[1], length=length)
            span = plotted(chosen(rows, length=length), measure)
            data = plotted(part, measure)
            name = "position error (cells)" if measure == "position 99 %" else "other surface"
            chart = alt.layer(*curves(alt, data, "", "", 170, 120, domain=span, size=16))
            if not grid:
                chart = chart.properties(title=f"{name}, up to {length}")
            line.append(chart)
        grid.append(alt.hconcat(*line, title=alt.TitleParams(
            ", ".join(scene), orient="left", anchor="middle", fontSize=13)))
    return alt.vconcat(*grid).properties(title=alt.TitleParams(
        "Position error that 1 % of the hits exceed, and share of rays that name another surface, "
        "over processor time per ray (µs)", anchor="start", fontSize=14, offset=12,
        subtitle="Up to so many cells. Diamond: the package's default. Hollow: none seen (drawn at "
                 "half of one ray)."))


def image_chart(alt, rows):
    """relMSE and FLIP over time."""
    greys = {4: "#C0C0C0", 1: "#808080", DEFAULT: STYLES[PACKAGE]}
    series, data = {}, []
    for row in rows:
        ours = row["method"] == PACKAGE
        name = (f"{LONG_NAMES.get(row['method'], row['method'])}, {row['knob']:g} "
                f"{'pixels' if ours else 'cells'}")
        series[name] = greys[row["knob"]] if ours else STYLES[row["method"]]
        # The estimate of relMSE may be below zero where there is next to none
        data += [{"scene": f"{row['scene']}, {row['space']}", "measure": measure, "series": name,
                  "time": float(f"{row['seconds']:.4g}"), "value": float(f"{row[measure]:.4g}"),
                  "spp": row["spp"]} for measure in ("relMSE", "FLIP") if row[measure] > 0]
    grid = []
    for measure in ("relMSE", "FLIP"):
        line = []
        for scene in dict.fromkeys(d["scene"] for d in data):
            part = chosen(data, scene=scene, measure=measure)
            values = [d["value"] for d in chosen(data, measure=measure)]
            base = alt.Chart(alt.Data(values=part)).encode(
                alt.X("time:Q", **logarithmic(alt, [d["time"] for d in part],
                                              "processor time (s)" if grid else "", (1, 2, 5))),
                alt.Y("value:Q", **logarithmic(alt, values, "" if line else measure, (1, 2, 5))),
                alt.Color("series:N", title=None,
                          scale=alt.Scale(domain=list(series), range=list(series.values())),
                          legend=alt.Legend(orient="top", columns=5, symbolType="stroke",
                                            symbolStrokeWidth=3, labelFontSize=12,
                                            labelLimit=300)),
                order=alt.Order("spp:Q"),
            ).properties(width=155, height=150, title="" if grid else scene)
            line.append(base.mark_line(strokeWidth=2)
                        + base.mark_point(filled=True, size=36, opacity=1))
        grid.append(alt.hconcat(*line))
    counts = ", ".join(str(n) for n in sorted({row["spp"] for row in rows}))
    return alt.vconcat(*grid).properties(title=alt.TitleParams(
        "Error of images over time: lower left is better", anchor="start", fontSize=16,
        subtitle=f"{counts} samples per pixel, against a converged render. FLIP is a perceptual "
                 "difference from 0 to 1. Each method with the step or tolerance named.",
        subtitleFontSize=12, offset=12))


def draw(folder, rows, image_rows):
    """Write the charts as SVG and PNG, if altair and vl-convert are installed."""
    try:
        import altair as alt
        import vl_convert  # noqa: F401 - what altair saves with
    except ImportError:
        print("no charts: pip install altair vl-convert-python")
        return
    drawings = {"accuracy_vs_speed": (main_chart(alt, rows), 90)}
    if len({(row["scene"], row["space"]) for row in rows}) > 1:
        drawings["by_scene"] = (scenes_chart(alt, rows), 72)
    if image_rows:
        drawings["images_over_time"] = (image_chart(alt, image_rows), 72)
    for name, (drawing, resolution) in drawings.items():
        drawing = drawing.configure(aria=False)
        drawing = drawing.configure_axis(gridOpacity=0.4, labelFontSize=11, titleFontSize=12)
        vector = folder / f"{name}.svg"
        drawing.save(vector)
        # Half of the file says nothing to a picture: classes, roles, a millionth of a pixel
        text = re.sub(r' (aria-\w+|role|class|pointer-events)="[^"]*"', "", vector.read_text())
        text = text.replace('<path d="" display="none"/>', "")
        vector.write_text(re.sub(r"(\.\d\d)\d+", r"\1", text))
        picture = str(folder / f"{name}.png")
        drawing.save(picture, ppi=resolution)
        # Without its alpha channel and packed more tightly it is a quarter of the size
        mi.Bitmap(picture).convert(mi.Bitmap.PixelFormat.RGB).write(picture)
        print(f"wrote {folder / name}.svg and .png")


def main():
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "charts",
                        help="folder of the charts and tables (default: charts)")
    arguments = parser.parse_args()
    quick, folder = arguments.quick, arguments.output
    folder.mkdir(parents=True, exist_ok=True)

    # Two threads on any machine: what is launched is large enough for so many
    dr.set_thread_count(min(2, dr.thread_count()))
    rows = []
    for setup in setups():
        main = setup.kind == MAIN["scene"] and setup.space == MAIN["space"]
        if quick and not main:
            continue
        # Four blocks of rays, eight for the first chart; two where all are traced twice
        rays = Rays(setup, 64 if quick else 368 if main else 256)
        for length in (MAIN["length"],) if quick else LENGTHS:
            if main and length == MAIN["length"]:
                rows += measure(rays, length, 1 if quick else 2, 2000)
            else:
                rows += measure(rays, length, 1, 300)
        report(f"traced: {setup.kind}, {setup.space}", began)
    lengths = (5,) if quick else (5, 1, 20)
    end_rows = end_points(lengths, 1 if quick else 2, quick)
    if not quick:
        end_rows += heyoka_rows(lengths)
    report("end points: done", began)
    image_rows, differences = [], []
    for setup in setups():
        if quick and (setup.kind, setup.space) != ("sparse", "plain"):
            continue
        found = (images(setup, IMAGE_KNOBS[-2:], 32, 24, 1, (1, 2, 4), 4) if quick
                 else images(setup, IMAGE_KNOBS, 80, 60, 8, (1, 2, 4), 128))
        image_rows += found[0]
        differences += found[1]
        report(f"rendered: {setup.kind}, {setup.space}", began)

    write(folder, rows, end_rows, image_rows, differences)
    print("\n".join(["", table(chosen(rows, **MAIN)), "", *ratio_lines(end_rows)]))
    draw(folder, rows, image_rows)
    report("done", began)


def report(what, began):
    print(f"{time.perf_counter() - began:4.0f} s  {what}", file=sys.stderr, flush=True)


def write(folder, rows, end_rows, image_rows, differences):
    """Write the tables as text and as JSON."""
    text = ["Rays: error of position (cells: median, 99 %, max) and direction (99 %), share that",
            "names another surface (of all; of those whose eight neighbours, 1.4 to 2.8 pixels",
            "away, all see the same one; of the others), share for which a segment is no number",
            "(they count as naming another surface), segments searched per ray, and",
            "processor time per ray or rays per second of one processor core",
            table(rows), "",
            "End points alone (nanoseconds of processor time, or end points per second of one",
            "core; error: root mean square, cells)",
            table(end_rows), "", *ratio_lines(end_rows), "",
            "Images (processor seconds)", table(image_rows), "",
            "What is left of the images' error without noise: the mean of (I - R)²/(R² + 0.01) and",
            "its standard error; its root and what one standard error more adds to that. R is by",
            f"the {REFERENCE[0]}, chords of {REFERENCE[1]} cells.",
            table(differences), ""]
    (folder / "accuracy_vs_speed.txt").write_text("\n".join(text))
    tables = {"rays": rows, "end points": end_rows, "images": image_rows,
              "images without noise": differences}
    (folder / "accuracy_vs_speed.json").write_text(json.dumps(
        {name: columns(x) for name, x in tables.items()}, ensure_ascii=False,
        separators=(",", ":")))


def ratio_lines(rows):
    """What the closed form is worth, against the fastest ODE method of the same error."""
    lines = []
    for length in dict.fromkeys(row["length"] for row in rows):
        for precision in ("float32", "float64"):
            ours = chosen(rows, length=length, method=PACKAGE, precision=precision)[0]["error"]
            tightest = min(row["error"] for row in rows
                           if row["method"] != PACKAGE and row["length"] == length)
            error = 1e-6 if length == 5 else 1.001 * max(ours, tightest)
            ratio, us, best = throughput_ratio(rows, length, error, precision)
            lines.append(
                f"end points at length {length}, error {error:.1e}: flow in {precision} "
                f"{us['nanoseconds']:.2f} ns, best ODE {best['nanoseconds']:.0f} ns "
                f"({best['method']}, {best['precision']}, {best['knob']:.2g}): {ratio:.0f} times")
    if importlib.util.find_spec("heyoka") is None:
        lines.append("heyoka took no part: it is not installed")
    return lines


if __name__ == "__main__":
    main()
