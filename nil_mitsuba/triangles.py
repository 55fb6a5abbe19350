"""A packed table of a scene's triangles, and what is known of the one that a ray has met.

Mitsuba keeps corners, normals and uv of a mesh in buffers of their own, and gathers 27 numbers for
each hit one by one: a fifth of what a path costs. Here a triangle's numbers lie side by side and
come four at a time. Should a later Mitsuba pack its own, drop this file: `surface_interaction` asks
Mitsuba where a hit names no triangle.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .quotient import Space
from .shapes import Shapes

# Normals of corners that differ by less from their triangle's are as good as that one: what a box's
# file, or its rotation, loses to rounding.
SAME_NORMAL = 1e-6
# Longer steps (cells) than this are no corrections: where the geodesic runs along the plane
LONGEST_STEP = 0.1


@dataclass
class Triangle:
    """The triangle that was hit, in scene units: ``p0`` + b1 ``e1`` + b2 ``e2``.

    In lanes that are not ``valid`` nothing was hit, or another shape. ``side`` is −1 where normals
    are flipped. ``uv`` of the first corner and its differences to the others, ``normals`` of the
    corners: None if no mesh of the scene has its own. ``others``: whether the scene has shapes that
    are no meshes.
    """

    valid: mi.Bool
    p0: mi.Point3f
    e1: mi.Vector3f
    e2: mi.Vector3f
    side: mi.Float
    uv: list[mi.Vector2f] | None
    normals: list[mi.Normal3f] | None
    others: bool

    def onto_plane(
        self, b: mi.Point2f, near: mi.Point3f, along: mi.Vector3f, space: Space
    ) -> tuple[mi.Float, mi.Point2f, mi.Bool]:
        """Newton's step along a geodesic to the plane of the triangle.

        ``near`` (cells) is the geodesic's point where something close to it has met the triangle
        at the barycentric coordinates ``b``, and ``along`` its coordinate tangent there (cells per
        cell of arc length). Returns the step in arc length (cells), the barycentric coordinates of
        where it leads, and whether that is a hit of the triangle after a short step.

        What is rounded is relative to the largest corner's coordinate: the step is to the plane
        from the point at ``b``, whatever the error of ``b``, which is corrected by what remains.
        """
        n = dr.cross(self.e1, self.e2)
        near, along = space.to_scene_axes(near), space.to_scene_axes(along)
        there = dr.fma(self.e1, b.x, dr.fma(self.e2, b.y, self.p0 - space.origin))
        rest = mi.Vector3f(dr.fma(-space.size, near, there))
        step = dr.dot(n, rest) / dr.dot(n, along)
        rest = dr.fma(along, step, -rest)
        inverse = dr.rcp(dr.squared_norm(n))
        b = mi.Point2f(
            dr.fma(dr.dot(dr.cross(rest, self.e2), n), inverse, b.x),
            dr.fma(dr.dot(dr.cross(self.e1, rest), n), inverse, b.y),
        )
        step *= space.cells_per_unit
        inside = (b.x >= 0) & (b.y >= 0) & (b.x + b.y <= 1)
        return step, b, self.valid & inside & (dr.abs(step) < LONGEST_STEP)

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """What ``pi.compute_surface_interaction(ray)`` is for meshes, at ``pi.prim_uv``."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t = dr.select(self.valid, pi.t, dr.inf)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        si.shape = dr.select(self.valid, pi.shape, dr.zeros(mi.ShapePtr))
        si.prim_index = pi.prim_index
        # Embree leaves any bits where a ray has met nothing
        b1, b2 = dr.select(self.valid, pi.prim_uv, 0)
        si.p = dr.fma(self.e1, b1, dr.fma(self.e2, b2, self.p0))
        n = dr.cross(self.e1, self.e2)
        n.z = dr.select(self.valid, n.z, 1)  # no infinities where nothing was hit
        n = dr.normalize(n)
        si.n = n * self.side

        si.uv, si.dp_du, si.dp_dv = mi.Point2f(b1, b2), self.e1, self.e2
        if self.uv is not None:
            uv, d1, d2 = self.uv
            si.uv = mi.Point2f(dr.fma(d1, b1, dr.fma(d2, b2, uv)))
            det = dr.fma(d1.x, d2.y, -d1.y * d2.x)
            inverse = dr.rcp(det)
            # Any tangents, but Mitsuba's, where all corners have the same uv
            u, v = mi.coordinate_system(mi.Vector3f(n))
            si.dp_du = dr.select(det == 0, u, (d2.y * self.e1 - d1.y * self.e2) * inverse)
            si.dp_dv = dr.select(det == 0, v, (d1.x * self.e2 - d2.x * self.e1) * inverse)

        si.sh_frame.n = si.n
        if self.normals is not None:
            n0, n1, n2 = self.normals
            n0.z = dr.select(self.valid, n0.z, 1)
            si.sh_frame.n = dr.normalize(
                dr.fma(n0, 1 - b1 - b2, dr.fma(n1, b1, n2 * b2)) * self.side
            )
        si.initialize_sh_frame()
        si.wi = dr.select(self.valid, si.to_local(-ray.d), -ray.d)
        return si


class Triangles:
    """Corners, uv and normals of all triangles of a scene as they are now, in packets of four.

    64 bytes a triangle, 48 more if any is smooth; 16 less if none has uv.
    """

    def __init__(self, shapes: Shapes):
        self.shapes = shapes
        meshes = shapes.meshes
        self.count = sum(mesh.face_count() for mesh in meshes)
        self.have_uv = any(mesh.has_vertex_texcoords() for mesh in meshes)
        self.packets = 4 if self.have_uv else 3
        if not meshes:
            return
        self.table = dr.empty(mi.Float, 4 * self.packets * self.count)
        first, smooth = 0, []
        for mesh in meshes:
            triangle = dr.arange(mi.UInt32, mesh.face_count())
            corners = mesh.face_indices(triangle)
            p0, p1, p2 = (mesh.vertex_position(i) for i in corners)
            e1, e2 = p1 - p0, p2 - p0
            uv = [mi.Vector2f(0, 0), mi.Vector2f(1, 0), mi.Vector2f(0, 1)]
            if mesh.has_vertex_texcoords():
                uv = [mi.Vector2f(mesh.vertex_texcoord(i)) for i in corners]
                uv = [uv[0], uv[1] - uv[0], uv[2] - uv[0]]
            side = -1 if mesh.has_flipped_normals() else 1
            packets = ((*p0, side), (*e1, uv[0].x), (*e2, uv[0].y), (*uv[1], *uv[2]))
            _write(self.table, packets[: self.packets], first + triangle)
            if mesh.has_vertex_normals():
                n = dr.normalize(dr.cross(e1, e2))
                off = [dr.squared_norm(mesh.vertex_normal(i) - n) for i in corners]
                off = dr.maximum(off[0], dr.maximum(off[1], off[2]))
                smooth.append(dr.any(off > SAME_NORMAL**2))
            first += mesh.face_count()
        self.smooth = dr.any(dr.concat(smooth))[0] if smooth else False
        if self.smooth:
            self._tabulate_normals(meshes)

    def _tabulate_normals(self, meshes):
        self.normals = dr.empty(mi.Float, 12 * self.count)
        first = 0
        for mesh in meshes:
            triangle = dr.arange(mi.UInt32, mesh.face_count())
            normals = [mi.Normal3f(mesh.face_normal(triangle))] * 3
            if mesh.has_vertex_normals():
                normals = [mesh.vertex_normal(i) for i in mesh.face_indices(triangle)]
            _write(self.normals, [(*n, 0) for n in normals], first + triangle)
            first += mesh.face_count()

    def at(self, pi: mi.PreliminaryIntersection3f) -> Triangle | None:
        """The triangle that a ray has met; None if there is none in the scene."""
        if not self.shapes.has_meshes:
            return None
        valid = pi.is_valid()
        index, by_triangle = self.shapes.index(pi.shape, pi.instance, pi.prim_index, valid)
        row, valid = index - self.shapes.first_triangle, valid & by_triangle
        p, e1, e2, *uv = _read(self.table, self.packets, row, valid)
        normals = None
        if self.smooth:
            normals = [mi.Normal3f(*n[:3]) for n in _read(self.normals, 3, row, valid)]
        if uv:
            (du,) = uv
            uv = [mi.Vector2f(e1[3], e2[3]), mi.Vector2f(*du[:2]), mi.Vector2f(*du[2:])]
        return Triangle(
            valid,
            mi.Point3f(*p[:3]),
            mi.Vector3f(*e1[:3]),
            mi.Vector3f(*e2[:3]),
            dr.select(valid, p[3], 1),
            uv or None,
            normals,
            self.shapes.has_others,
        )


def _write(table, packets, row):
    for i, packet in enumerate(packets):
        dr.scatter(table, mi.Vector4f(*packet), len(packets) * row + i)


def _read(table, packets, row, active):
    rows = (dr.gather(mi.Vector4f, table, packets * row + i, active) for i in range(packets))
    return [list(packet) for packet in rows]
