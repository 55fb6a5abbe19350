"""Where a scene sits in Nil, and how a straight chord passes through the glued faces of its cell.

The quotient Nil/Γ is a box with the edges A, B and C, its faces glued by the generators
(x+A, y, z + k A y), (x, y+B, z) and (x, y, z+C) of Γ (VISGRAF TR-19-06, section 4, where the box is
the unit cube). They close if n = k A B/C is an integer. All three are affine, so a straight chord
stays straight when it is carried into the neighbouring cell.
"""

from __future__ import annotations

from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from . import geometry
from .geometry import larger, smaller

Vector = TypeVar("Vector", bound=Any)  # any of Mitsuba's types with three components


def table(points) -> mi.Point3f:
    """Points (three numbers each) that kernels gather from memory."""
    return opaque(mi.Point3f(*(mi.Float([p[axis] for p in points]) for axis in range(3))))


def opaque(value):
    """The value as an array that kernels read from memory, so that they do for any value."""
    dr.make_opaque(value)
    return value


class Space:
    """The scene's Nil space: twist, quotient or not, and the cube's place in the scene.

    ``origin`` (scene units) is the group's identity and the cube's lower corner, ``size`` (scene
    units) the length of its edge. Numbers that vary between renders are opaque, so that kernels
    are compiled once for all of them. Only the twist 0 is written into them, and what it makes 0
    falls away: such a space is ``flat``. If it is ``general``, kernels do for the twist 0, too.

    ``fibres`` is the scene's axis ("x", "y" or "z") along which the cell's z runs; its x and y are
    the two that follow in the cycle. Points in cells have cell axes, and so has all of `geometry`.
    Points in scene units, and frame components wherever Mitsuba sees them, have scene axes.
    """

    EDGES = (1.0, 1.0, 1.0)  # A, B and C of the quotient's box, in cells

    def __init__(
        self,
        twist: float,
        quotient: bool,
        origin: list[float],
        size: float,
        general: bool = False,
        fibres: str = "z",
    ):
        first = "xyz".index(fibres) + 1
        # The scene's axis of each of the cell's, and back
        self._scene_axes = [(first + i) % 3 for i in range(3)]
        self._cell_axes = [(i - first) % 3 for i in range(3)]
        self.quotient = quotient
        self.flat = twist == 0 and not general
        self.twist_number = twist
        self._twist = 0 if self.flat else dr.opaque(mi.Float, twist)
        a, b, c = self.EDGES
        self._integer_twist = 0 if self.flat else dr.opaque(mi.Int32, round(twist * a * b / c))
        self.origin = opaque(mi.Point3f(*origin))
        self.size_number = size
        self.size = dr.opaque(mi.Float, size)
        self.cells_per_unit = dr.opaque(mi.Float, 1 / size)  # a division costs thirteen products
        self.largest = dr.opaque(mi.Float, max(map(abs, origin)))  # of the origin's coordinates
        self.periods = opaque(mi.Vector3f(self.EDGES))
        self.per_period = opaque(mi.Vector3f([1 / edge for edge in self.EDGES]))
        # A few units in the last place of the largest scene coordinate near the cube, in cells:
        # what Mitsuba's float32 arithmetic may lose at the joint of two chords.
        extent = 1 + max(abs(c) for c in origin) / size
        self.slack = dr.opaque(mi.Float, 16 * 2**-24 * extent)

    # Dr.Jit makes a 0 as wide as what it is multiplied by, in its place: it must not be kept

    @property
    def twist(self) -> mi.Float:
        return mi.Float(self._twist)

    @property
    def integer_twist(self) -> mi.Int32:
        """n = k A B/C."""
        return mi.Int32(self._integer_twist)

    def to_cells(self, p: mi.Point3f) -> mi.Point3f:
        """Scene coordinates to cell coordinates."""
        return self.to_cell_axes(mi.Point3f((p - self.origin) * self.cells_per_unit))

    def to_scene(self, p: mi.Point3f) -> mi.Point3f:
        """Cell coordinates to scene coordinates."""
        return dr.fma(self.size, self.to_scene_axes(p), self.origin)

    # Other names for what is there: kernels do nothing for it

    def to_cell_axes(self, v: Vector) -> Vector:
        """Components along the scene's axes, as of a frame direction, to those along the cell's."""
        return type(v)(*(v[i] for i in self._scene_axes))

    def to_scene_axes(self, v: Vector) -> Vector:
        """Components along the cell's axes to those along the scene's."""
        return type(v)(*(v[i] for i in self._cell_axes))


def exit_through_face(p: mi.Point3f, d: mi.Vector3f, space: Space) -> tuple[mi.Float, mi.Vector3i]:
    """Where the segment p + s d, 0 ≤ s ≤ 1, leaves the cell.

    Returns s (clipped to ≥ 0; > 1 if it does not leave) and the face as a vector with one entry
    of ±1. An edge or a corner is left through one face after the other, by steps of length 0.
    """
    inf = dr.inf
    s = [
        dr.select(d[i] == 0, inf, (dr.select(d[i] > 0, space.periods[i], 0) - p[i]) / d[i])
        for i in range(3)
    ]
    nearest = smaller(s[0], smaller(s[1], s[2]))
    on_x = s[0] == nearest
    on_y = ~on_x & (s[1] == nearest)
    on_z = ~on_x & ~on_y
    face = mi.Vector3i(
        *(
            dr.select(on, dr.select(d[i] > 0, mi.Int32(1), mi.Int32(-1)), 0)
            for i, on in enumerate((on_x, on_y, on_z))
        )
    )
    return larger(0, nearest), face  # what is not a number stays so


def through_face(
    p: mi.Point3f, others: list[mi.Point3f], cell: mi.Vector3i, face: mi.Vector3i, space: Space
) -> tuple[mi.Point3f, list[mi.Point3f], mi.Vector3i]:
    """Carry a point ``p`` on a face, ``others`` that belong to it and ``cell`` into the next cell.

    ``face`` is zero in lanes that stay. Crossing x = 0 or A shears z by k A y, which can leave
    [0, C) on either side whatever the direction of the ray, so z is reduced at once.
    """
    edges = space.periods
    step = mi.Vector3f(face) * edges
    shear = space.twist * step.x
    q = mi.Point3f(
        dr.select(face.x == 0, p.x, dr.select(face.x > 0, 0, edges.x)),
        dr.select(face.y == 0, p.y, dr.select(face.y > 0, 0, edges.y)),
        dr.select(face.z == 0, dr.fma(-shear, p.y, p.z), dr.select(face.z > 0, 0, edges.z)),
    )
    lift = dr.select(face.x == 0, 0, dr.floor(q.z * space.per_period.z))
    drop = lift * edges.z
    q.z -= drop
    drop += step.z
    moved = [
        mi.Point3f(o.x - step.x, o.y - step.y, dr.fma(-shear, o.y, o.z) - drop) for o in others
    ]
    g = mi.Vector3i(
        cell.x + face.x,
        cell.y + face.y,
        cell.z + face.z + mi.Int32(lift) + space.integer_twist * cell.x * face.y,
    )
    return q, moved, g


def into_cell(
    p: mi.Point3f, others: list[mi.Point3f], cell: mi.Vector3i, active: mi.Bool, space: Space
) -> tuple[mi.Point3f, list[mi.Point3f], mi.Vector3i]:
    """Carry a point ``p`` that may lie in any cell into the first one, as `through_face` does."""
    edges = space.periods
    inverse = space.per_period
    fx = dr.select(active, dr.floor(p.x * inverse.x), 0)
    fy = dr.select(active, dr.floor(p.y * inverse.y), 0)
    step_x, step_y = fx * edges.x, fy * edges.y
    shear = space.twist * step_x
    y = p.y - step_y
    z = dr.fma(-shear, y, p.z)
    fz = dr.select(active, dr.floor(z * inverse.z), 0)
    step_z = fz * edges.z
    moved = [
        mi.Point3f(o.x - step_x, o.y - step_y, dr.fma(-shear, o.y - step_y, o.z) - step_z)
        for o in others
    ]
    g = multiply_cells(cell, mi.Vector3i(fx, fy, fz), space)
    return mi.Point3f(p.x - step_x, y, z - step_z), moved, g


def seen_from(cell: mi.Vector3i, p: mi.Point3f, space: Space) -> mi.Point3f:
    """A point ``p`` (cells) as it is seen from the cell that a deck element leads to."""
    inverse = mi.Point3f(geometry.inverse(cell, space.integer_twist))
    return mi.Point3f(geometry.multiply(inverse, p, space.twist))


def multiply_cells(g: mi.Vector3i, h: mi.Vector3i, space: Space) -> mi.Vector3i:
    """The group product g·h of two deck elements."""
    return mi.Vector3i(g.x + h.x, g.y + h.y, g.z + h.z + space.integer_twist * g.x * h.y)
