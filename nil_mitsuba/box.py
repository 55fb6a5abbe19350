"""How far a geodesic certainly stays outside of boxes, however many turns of its helix that takes.

Along a geodesic x and y are sinusoids of the angle u = k w t. b − k w x = 2 m and a + k w y = n are
conserved, and so z' = w + k x b = (w² + b² − 2 m b)/w. It follows that |z''| = 2 |k a (b − m)|,
that z falls (rises, if w < 0) only in the half of each turn in which b has the sign of m, by no
more than `Passage.dip` in one turn, and that it gains the same height in every turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from . import geometry
from .geometry import larger, smaller
from .quotient import Space, opaque

# Roundings of the conserved quantities, times ten: a helix that misses a box by less may meet it.
MARGIN = 1e-5
# A little less, or rounding takes the ray behind what lies on the box.
SHORT = 0.999

# Each box costs as much arithmetic as the last, in every step outside of them.
MOST_BOXES = 4
# More shapes are not looked at one by one, which takes the cube of their number.
MOST_SHAPES = 16


class Passage:
    """What is the same all along the geodesic from ``p`` (cells) in frame direction ``v``."""

    def __init__(self, p: mi.Point3f, v: mi.Vector3f, twist: mi.Float):
        self.twist = twist
        k, w = larger(dr.abs(twist), 1e-9), dr.abs(v.z)
        c2 = dr.fma(v.x, v.x, v.y * v.y)
        c = dr.sqrt(c2)
        self.rate = twist * v.z
        self.c = c
        self.m2 = dr.fma(-self.rate, p.x, v.y)
        self.n = dr.fma(self.rate, p.y, v.x)
        self.upward = v.z > 0

        # Bounds of |x''|, |y''| and of |z''|: |a b| ≤ c²/2 and |a| ≤ c
        m2 = dr.abs(self.m2)
        self.turn = larger(k * w * c, 1e-12)
        self.rise = larger(k * dr.fma(c, m2, c2), 1e-12)

        # The integral of (2 |m b| − b² − w²)/(k w²) over the half turn in which it may be positive:
        # the first bound takes the largest integrand, the second leaves w² out
        fall = dr.pi * larger(dr.fma(0.25 * m2, m2, -w * w), 0)
        fall = dr.select(m2 > c, smaller(fall, dr.fma(2 * m2, c, -0.5 * dr.pi * c2)), fall)
        self.dip = fall * dr.rcp(larger(k * w * w, 1e-30))
        self.period = 2 * dr.pi / larger(k * w, 1e-12)
        self.per_gain = dr.rcp(self.period * dr.fma(0.5 * c2, dr.rcp(larger(w, 1e-12)), w))


class Box:
    """An axis-aligned box from ``lower`` to ``upper`` (cells)."""

    def __init__(self, lower: mi.Point3f, upper: mi.Point3f):
        self.lower = lower
        self.upper = upper

    def excludes(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies outside."""
        return dr.any((p < self.lower) | (p > self.upper))

    def gap(self, p: mi.Point3f) -> mi.Float:
        """No more than the distance (cells) of a point from the box; not positive inside."""
        off = larger(self.lower - p, p - self.upper)
        return larger(larger(off.x, off.y), off.z)

    def clearance(self, p: mi.Point3f, v: mi.Vector3f, passage: Passage) -> mi.Float:
        """Arc length (cells) for which the geodesic at ``p`` in direction ``v`` stays outside.

        0 inside; infinite if it never comes (back) to the box.
        """
        below, above = self.lower - p, p - self.upper
        velocity = geometry.from_frame(p, v, passage.twist)
        free = mi.Float(0)
        for i, most in enumerate((passage.turn, passage.turn, passage.rise)):
            # A coordinate that is off the box by g and moves away at speed u is not back as long as
            # g + u t − M t²/2 > 0, where M bounds its acceleration.
            gap = larger(below[i], above[i])
            away = dr.select(above[i] > 0, velocity[i], -velocity[i])
            root = dr.sqrt(larger(dr.fma(away, away, 2 * most * gap), 0))
            leaving = away > 0
            back = dr.select(leaving, away + root, 2 * gap) / dr.select(leaving, most, root - away)
            free = larger(free, dr.select(gap > 0, back, 0))

        # In the mean z moves up (down, if w < 0): away from the box it comes back only by a dip,
        # towards the box it takes so many turns.
        gap = larger(below.z, above.z)
        leaves = (above.z > 0) == passage.upward
        turns = dr.floor(larger(gap - passage.dip, 0) * passage.per_gain)
        free = larger(free, dr.select((gap > 0) & ~leaves, turns * passage.period, 0))
        never = (gap > passage.dip) & (gap > 0) & leaves
        never |= self._beside(passage)
        return dr.select(never, dr.inf, SHORT * free)

    def _beside(self, passage):
        """Whether the circle over which the helix winds lies beside the box, times |k w|: the
        radius is c, and the centre (−2 m, n)/(k w)."""
        rate, c = passage.rate, passage.c
        beside = mi.Bool(False)
        for centre, low, high in (
            (-passage.m2, self.lower.x, self.upper.x),
            (passage.n, self.lower.y, self.upper.y),
        ):
            low, high = rate * low, rate * high
            low, high = smaller(low, high), larger(low, high)
            margin = MARGIN * (1 + dr.abs(centre) + dr.abs(low) + dr.abs(high))
            beside |= (low - (centre + c) > margin) | ((centre - c) - high > margin)
        return beside


class Occupied:
    """A few boxes outside of which there is nothing."""

    def __init__(self, boxes: Iterable[mi.ScalarBoundingBox3f], space: Space):
        """``boxes``: those of a scene's shapes (scene units)."""
        # Kernels of the first pass and of others would differ in where they compute what is not in
        # memory, and be compiled twice
        self.boxes = [
            Box(
                opaque(space.to_cells(opaque(mi.Point3f(box.min)))),
                opaque(space.to_cells(opaque(mi.Point3f(box.max)))),
            )
            for box in gathered(boxes, space.size_number)
        ]
        self.lower = self.boxes[0].lower
        self.upper = self.boxes[0].upper
        for box in self.boxes[1:]:
            self.lower = dr.minimum(self.lower, box.lower)
            self.upper = dr.maximum(self.upper, box.upper)
        dr.make_opaque(self.lower, self.upper)

    def excludes(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies outside of all."""
        return dr.all([box.excludes(p) for box in self.boxes], axis=0)

    def gap(self, p: mi.Point3f) -> mi.Float:
        """`Box.gap` of the nearest one."""
        return dr.min([box.gap(p) for box in self.boxes], axis=0)

    def clearance(self, p: mi.Point3f, v: mi.Vector3f, passage: Passage) -> mi.Float:
        """`Box.clearance`, of whichever box comes first."""
        return dr.min([box.clearance(p, v, passage) for box in self.boxes], axis=0)


def gathered(boxes: Iterable[mi.ScalarBoundingBox3f], size: float) -> list[mi.ScalarBoundingBox3f]:
    """As few boxes as hold all of these without holding much else; ``size`` is that of a cell.

    Rays go by chords of up to a cell inside, so that what counts is a box's volume, a cell wider
    than it is each way. Two boxes become one unless that is more than twice their own volumes.
    """
    found = [box for box in boxes if box.valid()]
    if not found:  # a scene of environment emitters only
        return [mi.ScalarBoundingBox3f([0, 0, 0], [0, 0, 0])]
    if len(found) > MOST_SHAPES:
        return [_around(found)]

    def volume(box):
        return math.prod(extent / size + 1 for extent in box.extents())

    while len(found) > 1:
        pairs = [
            (volume(_around((a, b))) / (volume(a) + volume(b)), i, j)
            for j, b in enumerate(found)
            for i, a in enumerate(found[:j])
        ]
        waste, i, j = min(pairs)
        if waste > 2 and len(found) <= MOST_BOXES:
            break
        found[i] = _around((found[i], found.pop(j)))
    return found


def _around(boxes):
    result = mi.ScalarBoundingBox3f()
    for box in boxes:
        result.expand(box)
    return result
