"""How far from a point there is certainly no surface: a coarse grid of a scene's empty space.

The grid is filled from the shapes once per render: voxels that a surface may touch are marked, and
each voxel is told how far any of its points is at least from any point of a marked one. In the
quotient the marked voxels go on periodically under the group.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from . import geometry
from .geometry import larger, smaller
from .quotient import Space, opaque
from .shapes import FAR, Shapes, corners_of

# Voxels along the cell's edges in the quotient; in all, and at least along each edge, elsewhere.
# From 32 to 96 along an edge a small lattice takes the same time, to a twentieth: finer ones save
# chords, but are looked up more slowly.
QUOTIENT_VOXELS = 56
PLAIN_VOXELS = 2**18
LEAST_VOXELS = 16
# Grids around the focus: voxels along an edge, edge (cells) of the finest ones, and how many
FOCUS_VOXELS, FINEST, MOST_LEVELS = 48, 1 / 32, 16
WORTHWHILE = 0.02  # cells, in the mean
# Clearances are not followed further: in the quotient (cells), where farther copies are not
# looked at, and elsewhere (voxels along the longest edge of one). Twice as far saves a small
# lattice's camera rays a twentieth of their time at most.
FURTHEST, MOST_STEPS = 0.25, 12
# Surfaces are thickened by this part of a voxel, and by so much of their largest coordinate: the
# rounding of what says in which voxel they lie, and of Embree's own arithmetic.
THICKER, ROUNDING = 1e-3, 2**-20
SHORT = 1 - 1e-5
# Triangles that are thinner than this part of their length are taken for their boxes
NEEDLE = 1e-3
# Each is looked at on its own, which takes 1 ms of a mesh and 0.2 ms of a transform. Of further
# shapes the boxes have to do, and of further meshes those with the fewest triangles.
MOST_MESHES, MOST_TRANSFORMS = 64, 256


SPHERE, CYLINDER = int(mi.ShapeType.Sphere), int(mi.ShapeType.Cylinder)
SQUARES = (int(mi.ShapeType.Rectangle), int(mi.ShapeType.Disk))
LINEAR, BSPLINE = int(mi.ShapeType.LinearCurve), int(mi.ShapeType.BSplineCurve)
CURVES = (LINEAR, BSPLINE)
PIECES = 8  # of a spline's segment, each taken for straight


class Clearance:
    """Distances (cells) within which certainly no surface lies, by voxels.

    In plain Nil the grid is that of the shapes' box. Around ``focus`` (scene units), where the
    camera is, there are finer ones, each half as large as the next: what is near is small.
    """

    def __init__(
        self,
        space: Space,
        shapes: Shapes,
        focus: mi.ScalarPoint3f | None = None,
        voxels: int | None = None,
    ):
        self.space = space
        size = space.size_number
        box = shapes.box if shapes.box.valid() else mi.ScalarBoundingBox3f([0, 0, 0], [0, 0, 0])
        self.slack = space.slack + opaque(mi.Float(ROUNDING * _largest(shapes, space) / size))
        self.levels = 0
        pieces = _Pieces(shapes)
        if space.quotient:
            n = voxels or QUOTIENT_VOXELS
            edges = [edge / n for edge in space.EDGES]
            self.grid = _Grid(space, pieces, mi.Point3f(0), edges, (n, n, n))
            self.table = opaque(dr.maximum(self.grid.least - self.slack, 0))
        else:
            extents = [float(x) / size for x in space.to_cell_axes(box.extents())]
            counts = _counts(extents, voxels**3 if voxels else PLAIN_VOXELS)
            # A flat box has one layer of voxels without a height
            edges = [x / n for x, n in zip(extents, counts)]
            self.lower = space.to_cells(opaque(mi.Point3f(box.min)))
            self.upper = space.to_cells(opaque(mi.Point3f(box.max)))
            self.grid = _Grid(space, pieces, self.lower, edges, counts)
            finest, levels = _levels(box, focus, size, max(edges))
            entries = math.prod(counts) + levels * FOCUS_VOXELS**3
            self.table = dr.empty(mi.Float, entries)
            self._keep(0, dr.maximum(self.grid.least - self.slack, 0))
            if levels:
                self._add_levels(pieces, focus, finest, levels)
        # Whether it is worth asking: the alternative are chords of about a twentieth of a cell.
        # (A kernel for dr.mean would be another one for each size of the table.)
        self.useful = dr.sum(self.table)[0] > WORTHWHILE * dr.width(self.table)

    def _keep(self, place, values):
        index = dr.arange(mi.UInt32, dr.width(values)) + opaque(mi.UInt32(place))
        dr.scatter(self.table, values, index)
        dr.eval(self.table)

    def _add_levels(self, pieces, focus, finest, levels):
        n = FOCUS_VOXELS
        self.focus = opaque(self.space.to_cells(opaque(mi.Point3f(focus))))
        self.per_half = opaque(mi.Float(2 / (n * finest)))
        self.first = opaque(mi.Int32(levels))  # none of them holds anything yet
        self.count = opaque(mi.Int32(levels))
        self.base = opaque(mi.UInt32(math.prod(self.grid.counts)))
        self.levels = levels
        for level in reversed(range(levels)):
            edge = finest * 2**level
            lower = self.focus - opaque(mi.Float(0.5 * n * edge))
            grid = _Grid(self.space, pieces, lower, [edge] * 3, (n, n, n))
            # What lies beyond it is no closer than its end, and no closer than the others say
            voxel = grid.places()
            end = dr.min(dr.minimum(voxel, grid.last - voxel)) * grid.edges.x
            least = dr.maximum(dr.minimum(grid.least, end) - self.slack, 0)
            centre = lower + (mi.Vector3f(voxel) + 0.5) * grid.edges
            others = self.at(centre) - (0.5 + THICKER) * dr.norm(grid.edges)
            values = dr.maximum(least, others)
            dr.eval(values)
            self._keep(math.prod(self.grid.counts) + level * n**3, values)
            self.first = opaque(mi.Int32(level))

    # ------------------------------------------------------------------ looking up

    def at(self, p: mi.Point3f) -> mi.Float:
        """The clearance (cells) at ``p`` (cells): in the first cell, or anywhere in plain Nil."""
        grid = self.grid
        index = grid.index(p)
        if self.space.quotient:
            return dr.gather(mi.Float, self.table, index)
        inner = mi.Bool(False)
        if self.levels:
            # The level that holds p is the exponent of its distance from the focus
            n = FOCUS_VOXELS
            offset = p - self.focus
            aside = dr.abs(offset)
            ratio = self.per_half * larger(larger(aside.x, aside.y), aside.z)
            bits = dr.reinterpret_array(mi.Int32, larger(ratio, 0.25)) >> 23
            level = larger(bits - 126, self.first)
            inner = level < self.count
            # Half a level's voxels per half of its size, which is 2^level of the finest
            scale = dr.reinterpret_array(mi.Float, (127 - smaller(level, 60)) << 23)
            scale *= 0.5 * n * self.per_half
            voxel = dr.fma(offset, scale, 0.5 * n)
            voxel = mi.Vector3u(smaller(larger(voxel, 0), n - 1))
            place = ((mi.UInt32(level) * n + voxel.z) * n + voxel.y) * n + voxel.x
            index = dr.select(inner, self.base + place, index)
        inside = dr.gather(mi.Float, self.table, index)
        # What lies in the box is seen from p at no less than a right angle over its nearest point
        outside = dr.squared_norm(p - smaller(larger(p, self.lower), self.upper))
        distance = SHORT * dr.sqrt(dr.fma(inside, inside, outside)) - self.slack
        return dr.select((outside > 0) & ~inner, larger(distance, 0), inside)


class _Grid:
    """A grid of ``counts`` voxels with ``edges`` (cells) from the corner ``lower`` (cells) on.

    ``least`` is how far any point of a voxel is at least from any of the shapes' points in it, and
    in the quotient in its copies. Elsewhere what lies outside of the grid is not seen.
    """

    def __init__(self, space, pieces, lower, edges, counts):
        self.space = space
        self.counts = counts
        self.lower = lower
        self.edges = opaque(mi.Vector3f(edges))
        self.per_cell = opaque(mi.Vector3f([1 / edge if edge > 0 else 0 for edge in edges]))
        nx, ny, nz = counts
        self.last = opaque(mi.Vector3f(nx - 1, ny - 1, nz - 1))
        self.stride = opaque(mi.Vector3u(1, nx, nx * ny))
        # Squares of distances in the making: 0 where a surface may be
        self.furthest = FURTHEST if space.quotient else MOST_STEPS * max(edges)
        self._table = dr.full(mi.Float, 1, nx * ny * nz) * opaque(mi.Float(self.furthest**2))
        dr.make_opaque(self._table)
        for corners in pieces.triangles:
            self._mark_triangles(*corners)
        for rods in pieces.rods:
            self._mark_rods(*rods)
        self.least = self._spread()
        del self._table

    def index(self, p: mi.Point3f) -> mi.UInt32:
        """The voxel that holds ``p`` (cells), or the closest one."""
        return dr.dot(mi.Vector3u(smaller(larger(self._to_voxels(p), 0), self.last)), self.stride)

    def places(self) -> mi.Vector3i:
        """Each voxel's place in the grid."""
        index = dr.arange(mi.UInt32, math.prod(self.counts))
        row = index // self.stride.y
        ny = opaque(mi.UInt32(self.counts[1]))
        return mi.Vector3i(index - row * self.stride.y, row % ny, row // ny)

    def _to_voxels(self, p):
        return (p - self.lower) * self.per_cell

    @dr.syntax
    def _mark_triangles(self, a: mi.Point3f, b: mi.Point3f, c: mi.Point3f):
        """Mark the voxels that triangles (scene units) may touch.

        In units of voxels: for each column of them along the axis that is nearest to the normal,
        which lies over the triangle, those between the lowest and the highest point of the plane.
        """
        finite = dr.all((dr.abs(a) < FAR) & (dr.abs(b) < FAR) & (dr.abs(c) < FAR))
        a, b, c = (self._to_voxels(self.space.to_cells(x)) for x in (a, b, c))
        low, high = dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))
        thicker = dr.fma(ROUNDING, dr.max(dr.maximum(dr.abs(low), dr.abs(high))), THICKER)
        low, high = low - thicker, high + thicker
        met = finite & dr.all((high >= 0) & (low <= self.last + 1))
        first, last = (mi.Vector3i(dr.clip(x, 0, self.last)) for x in (low, high))

        n = dr.cross(b - a, c - a)
        steep = dr.abs(n)
        on_x = (steep.x >= steep.y) & (steep.x >= steep.z)
        on_y = ~on_x & (steep.y >= steep.z)

        def turned(q):
            """Coordinates with the axis of the columns last."""
            return type(q)(
                dr.select(on_x, q.y, dr.select(on_y, q.z, q.x)),
                dr.select(on_x, q.z, dr.select(on_y, q.x, q.y)),
                dr.select(on_x, q.x, dr.select(on_y, q.y, q.z)),
            )

        a, b, c, n = turned(a), turned(b), turned(c), turned(n)
        first, last, stride = turned(first), turned(last), turned(mi.Vector3i(self.stride))
        bottom, top = turned(low).z, turned(high).z
        # Depth of the plane over the point a; a triangle without area is bounded by its box alone
        inverse = dr.rcp(n.z)
        slope_x, slope_y = -n.x * inverse, -n.y * inverse
        # A needle's normal is lost in rounding: its box has to do
        longest = dr.max(high - low)
        plane = dr.abs(n.z) > NEEDLE * dr.square(longest)
        half = dr.fma(0.5 + thicker, dr.abs(slope_x) + dr.abs(slope_y), 2 * thicker)

        # Over the triangle: inward of its three edges, by the farthest corner of a column
        sides = []
        for p, q in ((a, b), (b, c), (c, a)):
            ex, ey = q.y - p.y, p.x - q.x
            inward = dr.select(n.z > 0, -1.0, 1.0)
            ex, ey = inward * ex, inward * ey
            reach = (0.5 + thicker) * (dr.abs(ex) + dr.abs(ey))
            sides.append((p, ex, ey, reach))

        i, j = mi.Int32(first.x), mi.Int32(first.y)
        looking = mi.Bool(met)
        while looking:
            x, y = mi.Float(i) + 0.5, mi.Float(j) + 0.5
            outside = mi.Bool(False)
            for p, ex, ey, reach in sides:
                outside |= dr.fma(x - p.x, ex, (y - p.y) * ey) + reach < 0
            depth = dr.fma(x - a.x, slope_x, dr.fma(y - a.y, slope_y, a.z))
            from_, to = dr.maximum(bottom, depth - half), dr.minimum(top, depth + half)
            from_, to = dr.select(plane, from_, bottom), dr.select(plane, to, top)
            level = dr.maximum(mi.Int32(dr.floor(from_)), first.z)
            end = dr.minimum(mi.Int32(dr.floor(to)), last.z)
            end = dr.select(outside & plane, -1, end)
            column = i * stride.x + j * stride.y
            while level <= end:
                dr.scatter(self._table, mi.Float(0), mi.UInt32(column + level * stride.z))
                level += 1
            i += 1
            row = i > last.x
            i = dr.select(row, first.x, i)
            j = dr.select(row, j + 1, j)
            looking &= j <= last.y
        # Or meshes of the same size become one kernel, another one in each scene
        dr.eval(self._table)

    @dr.syntax
    def _mark_rods(
        self,
        low: mi.Point3f,
        high: mi.Point3f,
        a: mi.Point3f,
        b: mi.Point3f,
        inner: mi.Float,
        outer: mi.Float,
    ):
        """Mark the voxels of the boxes from ``low`` to ``high`` in which the distance to the
        segment from ``a`` to ``b`` may lie between ``inner`` and ``outer`` (all scene units)."""
        space, edges = self.space, self.edges
        low, high, a, b = (space.to_cells(x) for x in (low, high, a, b))
        size = dr.maximum(dr.abs(low), dr.abs(high))
        thicker = dr.fma(ROUNDING, size, THICKER * edges)
        low = (low - thicker - self.lower) * self.per_cell
        high = (high + thicker - self.lower) * self.per_cell
        met = dr.all((high >= 0) & (low <= self.last + 1))
        first, last = (mi.Vector3i(dr.clip(x, 0, self.last)) for x in (low, high))
        along = b - a
        per_length = dr.rcp(dr.maximum(dr.squared_norm(along), 1e-30))
        # And how far a point of the voxel is from its centre
        thickness = dr.fma(ROUNDING, dr.max(size), (0.5 + THICKER) * dr.norm(edges))
        inner, outer = inner / space.size - thickness, outer / space.size + thickness
        at = mi.Vector3i(first)
        looking = mi.Bool(met)
        while looking:
            centre = self.lower + (mi.Vector3f(at) + 0.5) * edges - a
            part = dr.clip(dr.dot(centre, along) * per_length, 0, 1)
            distance = dr.norm(centre - part * along)
            clear = (distance < inner) | (distance > outer)
            dr.scatter(
                self._table, mi.Float(0), dr.dot(mi.Vector3u(at), self.stride), looking & ~clear
            )
            at.x += 1
            row = at.x > last.x
            at.x = dr.select(row, first.x, at.x)
            at.y = dr.select(row, at.y + 1, at.y)
            layer = at.y > last.y
            at.y = dr.select(layer, first.y, at.y)
            at.z = dr.select(layer, at.z + 1, at.z)
            looking &= at.z <= last.z
        dr.eval(self._table)

    def _spread(self):
        """From marked voxels to distances: squares of them along one axis after the other."""
        nx, ny, nz = self.counts
        edge = self.edges
        quotient = self.space.quotient
        if quotient:
            # Copies on both sides in x; z and y are periodic there as well, since k A B/C is an
            # integer: (x, y + B, z) follows from (x − A, y + B, z − k A (y + B)).
            reach = min(int(FURTHEST / self.space.EDGES[0] * nx), nx)
            table, wide = self._extended(reach)
        else:
            table, wide = self._table, nx
        table = _along_axis(table, wide * ny, nz, edge.z, quotient)
        table = _along_axis(table, wide, ny, edge.y, quotient)
        table = _along_axis(table, 1, wide, edge.x, False)
        if quotient:
            index = dr.arange(mi.UInt32, nx * ny * nz)
            row, column = index // opaque(mi.UInt32(nx)), index % opaque(mi.UInt32(nx))
            table = dr.gather(
                mi.Float,
                table,
                dr.fma(row, opaque(mi.UInt32(wide)), column + opaque(mi.UInt32(reach))),
            )
        return SHORT * dr.sqrt(table)

    @dr.syntax
    def _extended(self, reach):
        """The marked voxels and, on both sides in x, ``reach`` voxels of their copies there."""
        nx, ny, nz = self.counts
        wide = nx + 2 * reach
        n, twist = opaque(mi.Int32(nx)), self.space.integer_twist
        index = mi.Int32(dr.arange(mi.UInt32, wide * ny * nz))
        across = opaque(mi.Int32(wide))
        x, y, z = index % across, (index // across) % n, index // (across * n)
        x -= opaque(mi.Int32(reach))
        cell = dr.select(x < 0, -1, dr.select(x >= n, mi.Int32(1), 0))
        # Over a voxel's height in y the copies are sheared by k A B/C voxels
        shear = twist * cell
        level = z - shear * y - dr.maximum(shear, 0)
        end = z - shear * y - dr.minimum(shear, 0)
        result = mi.Float(FURTHEST**2)
        while level <= end:
            row = ((level % n + n) % n * n + y) * n + x - cell * n
            result = dr.minimum(result, dr.gather(mi.Float, self._table, mi.UInt32(row)))
            level += 1
        dr.eval(result)
        return result, wide


@dr.syntax
def _along_axis(table: mi.Float, stride: int, count: int, edge: mi.Float, periodic: bool):
    """Least sum of an entry and the squared gap to it along one axis, from each voxel."""
    stride, count = opaque(mi.Int32(stride)), opaque(mi.Int32(count))
    index = mi.Int32(dr.arange(mi.UInt32, dr.width(table)))
    here = (index // stride) % count
    best = dr.gather(mi.Float, table, mi.UInt32(index))
    step = mi.Int32(1)
    gap = mi.Float(0)
    while (step < count) & (dr.square(gap) < best):
        for sign in (1, -1):
            there = here + sign * step
            if dr.hint(periodic, mode="scalar"):
                wrapped = dr.select(
                    there < 0, there + count, dr.select(there >= count, there - count, there)
                )
                inside = mi.Bool(True)
            else:
                wrapped = mi.Int32(there)
                inside = (there >= 0) & (there < count)
            other = dr.gather(mi.Float, table, mi.UInt32(index + (wrapped - here) * stride), inside)
            best = dr.minimum(best, dr.select(inside, dr.fma(gap, gap, other), dr.inf))
        gap += edge
        step += 1
    dr.eval(best)
    return best


def within(p: mi.Point3f, v: mi.Vector3f, clearance: mi.Float, twist: mi.Float) -> mi.Float:
    """Arc length for which the geodesic at ``p`` in direction ``v`` keeps within ``clearance``.

    All in cells. It is at most u s + M s²/2 off after s, where u is its speed now and M bounds its
    acceleration k (−w b, w a, a (b + k x w)): b − k x w is conserved, and x moves by no more than
    the clearance r. Since s is at most r/u, r u/(u² + M r/2) is short enough; no root in it has to
    wait for r. It grows with r up to u/|k| at least.
    """
    velocity = geometry.from_frame(p, v, twist)
    speed2 = dr.squared_norm(velocity)
    speed = dr.sqrt(speed2)
    k, turn = dr.abs(twist), twist * v.z
    level = k * dr.sqrt(dr.fma(v.x, v.x, v.y * v.y))
    lean = dr.fma(turn, p.x, v.y)
    bend = level * dr.sqrt(dr.fma(lean, lean, v.z * v.z))
    r = smaller(clearance, speed / larger(k, 1e-9))
    most = dr.fma(2 * dr.abs(turn) * level, r, bend)
    return SHORT * r * speed / dr.fma(0.5 * most, r, speed2)


def _counts(extents, total):
    """Voxels along the edges of a box: about cubes, but no fewer than a few layers."""
    counts = [0 if x > 0 else 1 for x in extents]
    while 0 in counts:
        free = [i for i, n in enumerate(counts) if n == 0]
        room = total / math.prod(n for n in counts if n)
        edge = math.prod(extents[i] for i in free) ** (1 / len(free)) / room ** (1 / len(free))
        thin = [i for i in free if extents[i] < LEAST_VOXELS * edge]
        if thin:
            counts[min(thin, key=lambda i: extents[i])] = LEAST_VOXELS
            continue
        for i in free:
            counts[i] = max(1, int(extents[i] / edge))
    return tuple(counts)


def _largest(shapes, space):
    """The largest coordinate (scene units) of shapes, in the quotient of those in the cell."""
    low = mi.ScalarPoint3f([c[0] for c in space.origin])
    edges = space.to_scene_axes(mi.ScalarVector3f(*space.EDGES))
    cell = mi.ScalarBoundingBox3f(low, low + space.size_number * edges)
    boxes = [extent.box for extent in shapes.extents if extent.box.valid()]
    if space.quotient:
        boxes = [box for box in boxes if box.overlaps(cell)]
    return max((abs(c) for box in boxes for c in (*box.min, *box.max)), default=0.0)


def _levels(box, focus, size, coarsest):
    """Edge (cells) of the voxels of the finest grid around ``focus``, and how many grids there are
    up to one with voxels about as large as ``coarsest``."""
    if focus is None:
        return FINEST, 0
    away = max(max(a - x, x - b, 0) for a, b, x in zip(box.min, box.max, focus)) / size
    edge, levels = FINEST, 0
    while edge * FOCUS_VOXELS < 4 * away:  # it would hold little of the box
        edge *= 2
    while edge * 2**levels < coarsest / 1.5 and levels < MOST_LEVELS:
        levels += 1
    return edge, levels


class _Pieces:
    """What surfaces consist of, in scene units: triangles by their corners, and what
    `_Grid._mark_rods` takes."""

    def __init__(self, shapes):
        meshes = [shape for shape in shapes.shapes if shape.is_mesh()]
        meshes = sorted(meshes, key=lambda mesh: -mesh.face_count())[:MOST_MESHES]
        self.triangles = [corners_of(mesh) for mesh in meshes]
        self.rods = []
        rods: list[tuple[float, ...]] = []
        squares: list[tuple[float, ...]] = []
        for shape, extent in zip(shapes.shapes, shapes.extents):
            box = extent.box
            if shape in meshes or not box.valid():
                continue
            kind = shape.shape_type()
            transformed = len(rods) + len(squares) < MOST_TRANSFORMS
            if kind in CURVES:
                self.rods.append(_segments(shape, kind))
            elif kind == SPHERE:
                radius = 0.5 * float(box.extents().x)
                rods.append((*box.min, *box.max, *box.center(), *box.center(), radius, radius))
            elif kind == CYLINDER and transformed:
                x, _, z, o = _columns(shape)
                end, radius = [a + b for a, b in zip(o, z)], math.hypot(*x)
                rods.append((*box.min, *box.max, *o, *end, radius, radius))
            elif kind in SQUARES and transformed and min(box.extents()) > 0:
                x, y, _, o = _columns(shape)
                squares.append((*x, *y, *o))
            else:  # boxes of rectangles along the axes are flat
                rods.append((*box.min, *box.max, *box.min, *box.min, -dr.inf, dr.inf))
        if squares:
            n = [opaque(mi.Float(column)) for column in zip(*squares)]
            x, y, o = mi.Vector3f(n[:3]), mi.Vector3f(n[3:6]), mi.Point3f(n[6:])
            self.triangles.append([o - x - y, o + x - y, o + x + y])
            self.triangles.append([o - x - y, o + x + y, o - x + y])
        if rods:
            n = [opaque(mi.Float(column)) for column in zip(*rods)]
            self.rods.append((*(mi.Point3f(n[i : i + 3]) for i in (0, 3, 6, 9)), *n[12:]))


def _columns(shape):
    """The columns of a shape's transform, in Python floats."""
    matrix = mi.traverse(shape)["to_world"].matrix
    return [[matrix[i, j][0] for i in range(3)] for j in range(4)]


def _segments(curve, kind):
    """Boxes, axes and radii (scene units) of a curve's segments, for `_Grid._mark_rods`.

    A piece of a spline keeps within an eighth of its second derivative from its chord.
    """
    parameters = mi.traverse(curve)
    points, segments = parameters["control_points"], parameters["segment_indices"]
    spline = kind == BSPLINE
    around = [dr.gather(mi.Vector4f, points, segments + i) for i in range(4 if spline else 2)]
    radius = around[0].w
    for point in around[1:]:
        radius = dr.maximum(radius, point.w)
    if spline:
        p, q, r, s = around = [dr.repeat(point, PIECES) for point in around]
        bend = dr.maximum(dr.norm((p - 2 * q + r).xyz), dr.norm((q - 2 * r + s).xyz))
        radius = dr.fma(bend, 1 / (8 * PIECES**2), dr.repeat(radius, PIECES))
        piece = mi.Float(dr.arange(mi.UInt32, dr.width(radius)) % PIECES)
        around = [
            ((1 - u) ** 3 * p + (3 * (u - 2) * u * u + 4) * q + u**3 * s) / 6
            + (3 * u * (1 + u - u * u) + 1) / 6 * r
            for u in (piece / PIECES, (piece + 1) / PIECES)
        ]
    a, b = (point.xyz for point in around)
    low, high = dr.minimum(a, b) - radius, dr.maximum(a, b) + radius
    return low, high, a, b, mi.Float(-dr.inf), radius
