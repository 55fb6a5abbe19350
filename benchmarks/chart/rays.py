"""Camera rays of a scene, their truth, and how far a tracer's hits are from it."""

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nil_mitsuba import geometry
from nil_mitsuba.camera import Camera
from nil_mitsuba.interaction import surface_interaction
from nil_mitsuba.quotient import Space, multiply_cells
from nil_mitsuba.tracer import Cone

from .. import truth
from ..truth import Array3f64, Array3i, Float64, Int32
from .scenes import TWIST, triangles

# Rays are traced up to so many cells
LENGTHS = (1, 5, 20)
# The cone of a ray is that of a pixel of an image of this width, whose rays go through fewer pixels
IMAGE = 512
# Dr.Jit gives a thread so many rays at a time
BLOCK = 16384
# Mirrored rays start so far along themselves (cells)
OFF = 1e-3


class CameraRays:
    """Camera rays of a setup."""

    def __init__(self, setup, width):
        self.setup, self.width = setup, width
        self.space = Space(TWIST, setup.quotient, [0, 0, 0], 1.0)
        if setup.mesh:
            shapes = {"s0": triangles(setup.surfaces, setup.mesh)}
        else:
            shapes = truth.to_mitsuba(setup.surfaces, mi)
        self.scene = mi.load_dict({"type": "scene", **shapes})
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": setup.fov,
                "to_world": mi.ScalarTransform4f().look_at(
                    list(setup.origin), list(setup.target), [0.01, 0.02, 1]
                ),
                "film": {"type": "hdrfilm", "width": IMAGE, "height": IMAGE},
            }
        )
        index = dr.arange(mi.UInt32, width * width)
        place = mi.Point2f(index % width + 0.5, index // width + 0.5) / width
        ray, _ = sensor.sample_ray_differential(0, 0.5, place, mi.Point2f(0.5))
        # The cone of a tolerance of one pixel
        p, self.v, self.cone, *_ = Camera(sensor, self.space, 1.0).start(ray, mi.Float(0))
        self.p = mi.Point3f(p)
        dr.eval(self.p, self.v, self.cone)

    def usable(self, length):
        """Which rays are traced up to this length."""
        return dr.full(truth.Bool, True, self.width**2)

    def indices(self, length):
        """The rays as indices; if there is a mirror, those that meet it.

        Neighbours in a row stay neighbours, as in a render. Rows are in such an order that every
        block has some from all parts of the image, and the number of blocks is even if there is
        more than one: so two threads have the same to do.
        """
        usable = self.usable(length)
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


class Rays(CameraRays):
    """Camera rays of a setup and what they hit in truth, up to the longest of ``LENGTHS``."""

    def __init__(self, setup, width):
        super().__init__(setup, width)
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

    def usable(self, length):
        if self.setup.mirror is None:
            return super().usable(length)
        return self.on_mirror & (self.first_t < length)


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
    mirror = si.shape == mi.ShapePtr(
        next(s for s in selection.rays.scene.shapes() if s.id() == f"s{setup.mirror}")
    )
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
    hit = tracer.intersect(
        p, v, cone, dr.minimum(tracer.reach(p, v), length - OFF), hit.valid & mirror
    )
    if setup.quotient:
        cell = multiply_cells(cell, hit.cell, space)
    return hit, v, cell


def wide(x):
    """Mitsuba's vector as one of the truth's."""
    return Array3f64(*(Float64(dr.detach(c)) for c in x))


def quantiles(values, shares):
    values = sorted(values)
    return [
        values[min(len(values) - 1, int(share * len(values)))] if values else math.nan
        for share in shares
    ]


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
    p, arrival, distance, valid, cell = (
        mi.Point3f(si.p),
        mi.Vector3f(hit.arrival),
        hit.distance,
        hit.valid,
        mi.Vector3i(cell),
    )
    dr.eval(p, arrival, distance, valid, label, cell, watched.segments, watched.lost)

    exact = rays.exact
    t = dr.gather(Float64, exact.t, index)
    length = dr.opaque(Float64, selection.length)
    true_label = dr.select(t <= length, dr.gather(Int32, exact.label, index), -1)
    true_g, true_p, true_v = (
        dr.gather(Array3i, exact.g, index),
        dr.gather(Array3f64, exact.p_cell, index),
        dr.gather(Array3f64, exact.v, index),
    )
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
        "rays": count,
        "hits": len(position),
        "position": median,
        "position 99 %": most,
        "position max": largest,
        **dict(
            zip(
                ("direction", "direction 99 %", "direction max"),
                quantiles(direction, (0.5, 0.99, 1)),
            )
        ),
        "other surface": share(wrong),
        "other surface, away": share(wrong, ~near),
        "other surface, near": share(wrong, near),
        "not a number": share(hollow),
        "chords": dr.sum(watched.segments)[0] / count,
    }
