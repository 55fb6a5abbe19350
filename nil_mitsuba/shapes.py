"""What is read of a scene's shapes once per render: where they are, how exact their hits are."""

from __future__ import annotations

import re
from dataclasses import dataclass
from textwrap import shorten

import drjit as dr
import mitsuba as mi

from .quotient import opaque

ROUNDING = 2**-24  # of float32, relative
FAR = 1e15  # scene units; squares of the distances between larger numbers overflow

# By how many roundings of the largest number that goes into a hit the next ray starts off the
# surface. A quarter is enough for spheres and coarse meshes, the half for fine ones, cylinders and
# disks, of 100,000 hits each (benchmarks/offsets.py). Mitsuba's own offset has 1,500, of the hit's
# own coordinates.
ROUNDINGS = 32
SPHERE = int(mi.ShapeType.Sphere)
PRECISE = (
    mi.ShapeType.Mesh | mi.ShapeType.Rectangle | mi.ShapeType.Disk | mi.ShapeType.Cylinder | SPHERE
)
# Straight curves need no more than 32 either, but for linear ones as thin as 1e-4 of where they
# lie. Of bent ones, and of grids and ellipsoids, little is known.
OTHER_ROUNDINGS = 1500
# Mitsuba 3.9 intersects spheres in an instance in float32, and with a direction as long as the
# instance is small: their relative error is some 16 roundings times the square of that length. As
# a part of the radius, what is not given away to it; at a scale of 1/200 nothing is exact any more.
MOST_OF_RADIUS = 1 / 8
# Mitsuba 3.9.1 finds a B-spline curve's segment again from the v that a hit's place has been
# rounded to, for the tangents there. At the end of the last one that is a segment too many, which
# it reads from behind its table. The part of all segments that no rounding of v exceeds:
WITHIN_SPLINE = 1 - 2**-22
SPLINE = int(mi.ShapeType.BSplineCurve)


@dataclass(frozen=True)
class Extent:
    """Bounding box (scene units) of what of a shape can be hit, not valid if nothing can.

    ``lost`` says what of the shape cannot, since its coordinates are no numbers, infinite or beyond
    `FAR`; "" if all of it can.
    """

    box: mi.ScalarBoundingBox3f
    lost: str = ""


class Shapes:
    """The shapes of a scene as they are now: their extents, and the rounding of hits on them.

    The boxes of meshes follow from the triangles that there are, not from Mitsuba's own boxes:
    vertices that no triangle uses count in those, and version 3.9.1, which merges meshes while it
    loads a scene, keeps some of them only.
    """

    def __init__(self, scene: mi.Scene):
        self.shapes = scene.shapes()
        self.meshes = [shape for shape in self.shapes if shape.is_mesh()]
        # All are on their way before the first is waited for
        meshes = {i: _Triangles(shape) for i, shape in enumerate(self.shapes) if shape.is_mesh()}
        self.extents = [
            meshes[i].extent() if i in meshes else _extent(shape)
            for i, shape in enumerate(self.shapes)
        ]
        self.box = mi.ScalarBoundingBox3f()
        for extent in self.extents:
            self.box.expand(extent.box)
        self._tabulate(scene, meshes)

    def _tabulate(self, scene, meshes):
        """Tables of the largest coordinates that go into hits: of each triangle's corners, and one
        for each other shape.

        A shape's part of them begins at a place that the number of its pointer tells, together
        with a bit: whether there is an entry for each triangle.
        """
        instances = [shape.class_name() == "Instance" for shape in self.shapes]
        self.has_meshes, self.has_others = bool(meshes), len(meshes) < len(self.shapes)
        self.has_instances = any(instances)
        self.has_unknown = not all(shape.shape_type() & PRECISE for shape in self.shapes)
        pointers = list(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
        places = [0] * (max(pointers, default=0) + 1)
        others = [i for i in range(len(self.shapes)) if i not in meshes]
        largest = (
            [mi.Float([_largest(self.shapes[i], self.extents[i].box) for i in others])]
            if others
            else []
        )
        for place, i in enumerate(others):
            places[pointers[i]] = place << 1
        place = self.first_triangle = len(others)
        for i, triangles in meshes.items():
            places[pointers[i]] = place << 1 | 1
            place += triangles.count
            largest.append(triangles.largest)
        self.places = opaque(mi.UInt32(places))
        self.largest = opaque(dr.concat(largest) if largest else mi.Float(0))
        if self.has_instances:
            self.shrinkage = opaque(
                mi.Float([_shrinkage(self.shapes[i]) if instances[i] else 0 for i in others])
            )
        self._tabulate_splines(scene)

    def _tabulate_splines(self, scene):
        """Table by a pointer's number of how many segments from its start a curve may be hit."""
        shapes = self.shapes
        if self.has_instances:
            shapes = [node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.Shape)]
        splines = [shape for shape in shapes if shape.shape_type() == SPLINE]
        self.has_splines = bool(splines)
        self.has_splines_in_instances = not set(splines) <= set(self.shapes)
        if not splines:
            return
        pointers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in shapes]
        lengths = [dr.inf] * (max(pointers) + 1)
        for shape, pointer in zip(shapes, pointers):
            if shape.shape_type() == SPLINE:
                lengths[pointer] = WITHIN_SPLINE * shape.primitive_count()
        self.spline_lengths = opaque(mi.Float(lengths))

    def index(
        self, shape: mi.ShapePtr, instance: mi.ShapePtr, prim_index: mi.UInt32, valid: mi.Bool
    ) -> tuple[mi.UInt32, mi.Bool]:
        """Where the entry of what was hit is, and whether that is a triangle's."""
        if self.has_instances:
            shape = dr.select(instance != None, instance, shape)  # noqa: E711
        place = dr.gather(mi.UInt32, self.places, dr.reinterpret_array(mi.UInt32, shape), valid)
        by_triangle = (place & 1) == 1
        index = place >> 1
        if self.has_meshes:
            index += dr.select(by_triangle, prim_index, 0)
        return index, by_triangle

    def within_splines(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.PreliminaryIntersection3f:
        """What ``ray`` has met, but a B-spline curve's last end by a rounding before it.

        Of the end itself Mitsuba's surface interaction reads memory that may not be there.
        """
        if not self.has_splines:
            return pi
        valid, shape = pi.is_valid(), pi.shape
        if self.has_splines_in_instances:  # only their interaction tells which shape that is
            shape = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, valid).shape
        number = dr.reinterpret_array(mi.UInt32, shape)
        valid &= shape != None  # noqa: E711 - as an instance is
        length = dr.gather(mi.Float, self.spline_lengths, number, valid)
        beyond = valid & (pi.prim_uv.x + pi.prim_index > length)
        segment = mi.UInt32(dr.select(beyond, length, 0))
        pi = mi.PreliminaryIntersection3f(pi)
        pi.prim_index = dr.select(beyond, segment, pi.prim_index)
        pi.prim_uv.x = dr.select(beyond, length - segment, pi.prim_uv.x)
        return pi

    def margin(self, si: mi.SurfaceInteraction3f, length: mi.Float) -> mi.Float:
        """How far (scene units) from a hit a ray has to start, not to meet the surface again.

        ``length`` (scene units) of the straight ray that hit counts where the hit depends on it.
        """
        valid = si.is_valid()
        index, by_triangle = self.index(si.shape, si.instance, si.prim_index, valid)
        largest = dr.gather(mi.Float, self.largest, index, valid)
        if self.has_others:
            if self.has_meshes:
                length = dr.select(by_triangle, 0, length)
            largest = dr.maximum(largest, length)
        if not self.has_unknown:
            return ROUNDINGS * ROUNDING * largest
        kind = si.shape.shape_type()
        margin = dr.select((kind & PRECISE) != 0, ROUNDINGS, OTHER_ROUNDINGS) * ROUNDING * largest
        if self.has_instances:
            instanced = si.instance != None  # noqa: E711
            radius = dr.norm(si.dp_dv) * dr.inv_pi
            shrinkage = dr.gather(mi.Float, self.shrinkage, index, valid & instanced)
            shrunk = dr.minimum(ROUNDINGS * ROUNDING * shrinkage, MOST_OF_RADIUS) * radius
            margin = dr.select(instanced & (kind == SPHERE), dr.maximum(margin, shrunk), margin)
        return margin


def name_of(shape: mi.Shape) -> str:
    """How a sentence names a shape: its id in quotation marks, or its type, file and place.

    Meshes that are merged while a scene is loaded have lost their ids; their files tell them.
    """
    if shape.id():
        return f'"{shape.id()}"'
    words = [shape.class_name()]
    file = re.search(r'^  name = "(.+)",$', str(shape), re.M) if shape.is_mesh() else None
    if file and "." in file[1]:  # not a mesh that Mitsuba has made
        words.append(f'"{shorten(file[1], 60, placeholder=" ...")}"')
    box = extent_of(shape).box
    if box.valid():
        words.append("at ({:.4g}, {:.4g}, {:.4g})".format(*box.center()))
    return " ".join(words)


def margin_on(shape: mi.Shape | None) -> float:
    """How far (scene units) from any point of a shape a ray has to end, not to meet it."""
    if shape is None:
        return 0.0
    extent = extent_of(shape)
    known = shape.shape_type() & PRECISE
    return (ROUNDINGS if known else OTHER_ROUNDINGS) * ROUNDING * _largest(shape, extent.box)


def extent_of(shape: mi.Shape) -> Extent:
    """The extent of one shape."""
    return _Triangles(shape).extent() if shape.is_mesh() else _extent(shape)


def _extent(shape):
    box = shape.bbox()
    if not all(abs(c) < FAR for c in (*box.min, *box.max)) and box.valid():
        return Extent(mi.ScalarBoundingBox3f(), "its position or size is no number up to 1e15")
    return Extent(box)


def _largest(shape, box):
    """The largest coordinate (scene units) of a shape, which for an instance may be one that it
    would have if it were only rotated and scaled, or only moved."""
    if not box.valid():
        return 0.0
    corner = [max(abs(low), abs(high)) for low, high in zip(box.min, box.max)]
    if shape.class_name() != "Instance":
        return max(corner)
    matrix = mi.traverse(shape)["to_world"].matrix
    inverse = dr.rcp(matrix)

    def absolute(m):
        return [[abs(m[i, j][0]) for j in range(4)] for i in range(3)]

    turn, back = absolute(matrix), absolute(inverse)
    moved = [c + turn[i][3] for i, c in enumerate(corner)]
    local = [sum(row[j] * moved[j] for j in range(3)) for row in back]
    return max(sum(row[j] * local[j] for j in range(3)) + row[3] for row in turn)


def _shrinkage(instance):
    """Square of how much longer an instance makes a ray's direction than it is, or a little more:
    for a uniform scale s, 3/s²."""
    inverse = dr.rcp(mi.traverse(instance)["to_world"].matrix)
    return sum(inverse[i, j][0] ** 2 for i in range(3) for j in range(3))


def corners_of(mesh: mi.Mesh) -> list[mi.Point3f]:
    """The first, second and third corners (scene units) of all triangles of a mesh."""
    positions, faces = mesh.vertex_positions_buffer(), mesh.faces_buffer()
    triangle = dr.arange(mi.UInt32, mesh.face_count())
    return [
        dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * triangle + i))
        for i in range(3)
    ]


class _Triangles:
    """The box of a mesh's triangles and the largest coordinate of each, still to be waited for."""

    def __init__(self, mesh):
        self.count = mesh.face_count()
        a, b, c = corners_of(mesh)
        finite = dr.all((dr.abs(a) < FAR) & (dr.abs(b) < FAR) & (dr.abs(c) < FAR))
        low, high = dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))
        self.largest = dr.max(dr.maximum(dr.abs(low), dr.abs(high)))
        low, high = dr.select(finite, low, dr.inf), dr.select(finite, high, -dr.inf)
        dr.eval(low, high, finite, self.largest)
        self.low, self.high = [dr.min(x) for x in low], [dr.max(x) for x in high]
        self.whole = dr.count(finite)

    def extent(self):
        box = mi.ScalarBoundingBox3f()
        if self.whole[0]:
            box = mi.ScalarBoundingBox3f([x[0] for x in self.low], [x[0] for x in self.high])
        lost = self.count - self.whole[0]
        return Extent(
            box,
            f"{lost} of its {self.count} triangles have corners that are no numbers up to 1e15"
            if lost
            else "",
        )
