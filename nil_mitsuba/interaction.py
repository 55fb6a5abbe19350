"""Mitsuba's surface interaction, moved from scene coordinates into Nil's orthonormal frame.

In the left-invariant frame (E1, E2, E3) the metric is the identity, so Mitsuba's shading
mathematics (``Frame3f``, ``wi``, cosines, BSDFs) holds unchanged on frame components.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import geometry
from .quotient import Space
from .tracer import Hit
from .triangles import Triangle


def unit_conormal(p: mi.Point3f, n: mi.Normal3f, space: Space) -> mi.Normal3f:
    """Nil unit normal (frame components) at ``p`` (cells) of a surface with Euclidean normal ``n``.

    A normal is a covector: (nx, ny + k x nz, nz), normalised. A zero normal stays zero.
    """
    conormal = geometry.conormal(p, space.to_cell_axes(mi.Normal3f(n)), space.twist)
    conormal = space.to_scene_axes(conormal)
    return conormal * dr.rsqrt(dr.maximum(dr.squared_norm(conormal), 1e-30))


def _to_frame(p, v, space):
    """Frame components at ``p`` (cells) of a scene's vector ``v``."""
    v = geometry.to_frame(p, space.to_cell_axes(v), space.twist)
    return space.to_scene_axes(v)


def surface_interaction(
    hit: Hit, start_direction: mi.Vector3f, space: Space, wavelengths
) -> mi.SurfaceInteraction3f:
    """Surface interaction of a geodesic's hit: ``p`` in scene coordinates, all directions in frame.

    ``n``, ``sh_frame``, ``dp_du``, ``dp_dv`` and ``wi`` are frame components (Mitsuba computes no
    ``dn_du``, ``dn_dv`` here), ``t`` is the geodesic's length in scene units. Where nothing was
    hit, ``wi`` points against the direction in which the segment *started*: environments are
    looked up by it.
    """
    si = _in_scene(hit)
    si.wavelengths = wavelengths
    si.t = dr.select(hit.valid, hit.distance * space.size, dr.inf)

    if not space.flat:
        p = space.to_cells(si.p)
        si.dp_du = _to_frame(p, si.dp_du, space)
        si.dp_dv = _to_frame(p, si.dp_dv, space)
        si.n = unit_conormal(p, si.n, space)

        # As Mitsuba does, but orthogonal in Nil: tangents are vectors, normals covectors
        si.sh_frame.n = unit_conormal(p, si.sh_frame.n, space)
        si.initialize_sh_frame()

    # A geodesic that only grazes a surface may turn away from it within the tolerance, where the
    # line that was traced goes through: what was hit from one side is seen from that side.
    line = mi.Vector3f(hit.ray.d) if space.flat else _to_frame(p, hit.ray.d, space)
    same_side = dr.dot(hit.arrival, si.n) * dr.dot(line, si.n) > 0
    arrival = dr.select(same_side, hit.arrival, dr.normalize(mi.Vector3f(line)))
    incoming = dr.select(hit.valid, arrival, start_direction)
    si.wi = dr.select(hit.valid, si.to_local(-incoming), -incoming)
    return si


def _in_scene(hit: Hit) -> mi.SurfaceInteraction3f:
    """Surface interaction in scene coordinates, as Mitsuba computes it for straight rays."""
    if hit.triangle is None:
        return hit.preliminary.compute_surface_interaction(hit.ray, mi.RayFlags.All, hit.valid)
    si = hit.triangle.interaction(hit.preliminary, hit.ray)
    return _of_other_shapes(hit, hit.triangle, si) if hit.triangle.others else si


@dr.syntax
def _of_other_shapes(
    hit: Hit, triangle: Triangle, si: mi.SurfaceInteraction3f
) -> mi.SurfaceInteraction3f:
    other = hit.valid & ~triangle.valid
    if other:  # a branch: most packets of rays meet nothing but triangles
        si = hit.preliminary.compute_surface_interaction(hit.ray, mi.RayFlags.All, other)
    return si


def offset(
    p: mi.Point3f, n: mi.Normal3f, d: mi.Vector3f, margin: mi.Float, space: Space
) -> mi.Point3f:
    """Start (cells) of a ray that leaves a surface point ``p`` (scene) in frame direction ``d``.

    The point is moved by ``margin`` (scene units), to the side that ``d`` points to, along the
    surface's Euclidean normal, which is got back from the conormal ``n`` (frame components). The
    metric dual of ``n`` would lead through walls that meet this one at a right angle.
    """
    cells = space.to_cells(p)
    normal = mi.Vector3f(geometry.conormal(cells, space.to_cell_axes(n), -space.twist))
    normal = dr.mulsign(dr.normalize(normal), dr.dot(n, d))
    return cells + mi.Point3f(normal) * (margin / space.size)
