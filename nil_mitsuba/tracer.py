"""Geodesic rays against Mitsuba's scene of straight-ray intersections.

A ray is followed along its geodesic by chords, short enough for the error that the viewer
tolerates, and by leaps where a grid of clearances knows that nothing is near; around a plain scene
it comes to the next box of shapes by exact bounds. The corners lie outside of the curve, at places
that differ from ray to ray, so that the polygon is off to both sides alike: on average a surface is
met as often as it should be. A face of the quotient's cell cuts a chord, and a new one begins
behind it; cut chords of rays that nobody sees are turned to be right in the mean. What a chord has
met tells where to look: the hit is where the geodesic meets the plane of that triangle or, if that
is beside the triangle or the surface is bent, where its tangent line meets the surface. Where the
tangent finds nothing (silhouettes, grazing rays), the chord's hit is taken as it is, since chords
miss as many. The chord is cut and tried again where that is not so: the first one, which runs
beside what the ray leaves, and those behind the first turn, where what one turn has missed is met
by another.
Everything in this file is in cell coordinates, directions in cell axes, too, unless it says
"scene". Directions that come in and go out, frame components, are turned to them at once and back
at last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi

from . import geometry
from .box import Occupied, Passage
from .clearance import Clearance, within
from .geometry import larger, smaller
from .quotient import Space, exit_through_face, into_cell, opaque, through_face
from .shapes import Shapes
from .triangles import Triangle, Triangles

# A chord's sagitta is about this part of the cone's width there: along rays that are seen, and
# along those behind rough bounces or towards lights. The first follows from how many rays name
# another surface near silhouettes (benchmarks/camera_rays.py); the second is what the means and the
# shadows of the bent Cornell box do not show (benchmarks/accuracy.py).
SAGITTA, SOFT_SAGITTA = 0.07, 0.2
# Rays that are seen are allowed at their start what they are at this distance (cells): of the many
# short chords there few meet anything. Beyond a twentieth of a cell that is within the tolerance.
START = 0.4
# Corners lie outside the curve by so many sagittas. A first chord of any part of its length, each
# as likely, is then right in the mean from its start on, to a twentieth of a sagitta: with τ of a
# chord behind, off by 4/3 τ − 2 τ² + 2/3 τ³ + 2/3 τ log τ. A shorter one does not reach that far
# out, or grazing rays would meet what they leave: no farther than chords so many times as long do.
# First chords from a half to three halves of one would save half a query a ray, but the long ones
# start towards what they leave, and that shows in benchmarks/accuracy.py's furnished cell.
CORNER, STEEPEST = 2 / 3, 4
# Near conjugate points on the fibre through its start a ray's chords are at most this part of the
# way to the closest one, or this part of 1/k where that is more; chosen by how many rays from
# surfaces of a small lattice come to the sky (benchmarks/conjugate_points.py).
TO_CONJUGATE, AT_CONJUGATE = 0.5, 0.25
# Leaps are worth it down to this part of a chord: for each query all rays of a packet wait, and its
# empty lanes cost as much. Camera rays of a small lattice take a quarter less time than at 0.25 and
# about the same at 0.05; those of the bent Cornell box take the same at 0.25, too.
LEAST_LEAP = 0.1
# Packets of rays that are seen are of one pixel or of a few. Up to this distance (cells) Embree is
# faster when told that they go the same way, beyond it slower.
TOGETHER = 4


class Cone:
    """How far off a ray may be: ``width`` + ``spread`` · distance (cells), as a pixel's cone.

    Behind a rough bounce a ray is ``soft``: nobody sees where it went, so its hits need not lie
    on the geodesic; they lie on the polygon of chords, whose error has mean zero.
    """

    DRJIT_STRUCT = {"width": mi.Float, "spread": mi.Float, "soft": mi.Bool}

    def __init__(self, width=0.0, spread=0.0, soft=False):
        self.width = mi.Float(width)
        self.spread = mi.Float(spread)
        self.soft = mi.Bool(soft)


@dataclass
class Hit:
    """The first surface along a geodesic.

    ``distance`` (cells) is arc length, ``arrival`` the frame direction there (scene axes), ``cell``
    the deck element of the copy that was hit, ``ray`` (scene) and ``preliminary`` what Mitsuba
    needs to compute its surface interaction, ``triangle`` what else is known if the scene has
    meshes. ``end`` (cells) is where in its cell a ray is that has met nothing within its reach, if
    that was asked for.
    """

    valid: mi.Bool
    distance: mi.Float
    arrival: mi.Vector3f
    cell: mi.Vector3i
    ray: mi.Ray3f
    preliminary: mi.PreliminaryIntersection3f
    triangle: Triangle | None = None
    end: mi.Point3f | None = None


@dataclass
class Foot:
    """The geodesic's ``point`` beside a ray's polygon, its ``direction`` there and what that has
    ``lost`` to rounding."""

    point: mi.Point3f
    direction: mi.Vector3f
    lost: mi.Vector2f

    def moved(self, length: mi.Float, twist: mi.Float) -> Foot:
        """What is a short ``length`` (cells) further."""
        point, direction, lost = geometry.short_flow(
            self.point, self.direction, length, twist, self.lost
        )
        return Foot(point, direction, mi.Vector2f(*lost))


@dataclass
class Front:
    """How far a ray has come: to the geodesic's ``foot`` at arc length ``t``, beside which, at
    ``vertex``, its last chord has ended; ``cell`` is its deck element."""

    vertex: mi.Point3f
    foot: Foot
    t: mi.Float
    cell: mi.Vector3i


@dataclass
class Chord:
    """A chord of the arc's ``length`` (cells), by ``along`` (cells) from where the ray has come."""

    along: mi.Vector3f
    length: mi.Float


def random_of(p: mi.Point3f, v: mi.Vector3f) -> mi.Float:
    """A number in [0, 1) that follows from a ray's bits, the same on every machine."""
    px, py, vx, vy = (dr.reinterpret_array(mi.UInt32, x) for x in (p.x, p.y, v.x, v.y))
    return mi.sample_tea_float32(px ^ vx, py ^ vy)


def line_ray(o: mi.Point3f, d: mi.Vector3f, time: mi.Float, maxt: mi.Float = dr.inf) -> mi.Ray3f:
    """A ray (scene) that Embree can follow."""
    ray = dr.zeros(mi.Ray3f)
    ray.o, ray.d, ray.time, ray.maxt = o, d, time, maxt
    return ray


class Chords:
    """Lengths (cells) of chords whose sagitta keeps within a part, ``sagitta``, of the cone's width
    at their middle.

    The acceleration of the geodesic's point is k (−w b, w a, a b) in frame components, and across
    its direction no longer than g = |k| c √(w² + a² b²) ≤ |k| c √(w² + c⁴/4) = ``across``. The
    sagitta is at most h² g/8, and h² g/8 = width + spread (t + h/2) is solved for h, the cone being
    as wide at its start as elsewhere at the distance ``start``. No chord is shorter than ``least``
    nor longer than 1/k, beyond which it is no parabola.

    After a turn, the arc length 2π/(k |w|), a geodesic is on the fibre through its start again, in
    a conjugate point (`geometry.area_density`), and so are its neighbours of the same w: they all
    meet what stands there, or none does, and errors of the mean zero do not cancel. So it is after
    each further turn, and chords are shorter there.
    """

    def __init__(self, v, twist, cone, sagitta, start, least):
        k = larger(dr.abs(twist), 1e-9)
        c2 = dr.fma(v.x, v.x, v.y * v.y)
        across = k * dr.sqrt(c2 * dr.fma(0.25 * c2, c2, dr.square(v.z)))
        self.across = larger(across, 1e-9)
        self.longest = dr.rcp(k)
        self.at_conjugate = AT_CONJUGATE * self.longest
        self.turns = k * dr.abs(v.z) / dr.two_pi  # per cell
        self.turn = dr.rcp(larger(self.turns, 1e-9))
        self.spread = sagitta * cone.spread
        self.width = dr.fma(self.spread, start, sagitta * cone.width)
        self.scale = 2 * dr.rcp(self.across)
        self.least = least

    def room(self, t: mi.Float) -> mi.Float:
        """The sagitta that is allowed at arc length ``t``."""
        return dr.fma(self.spread, t, self.width)

    def after(self, t: mi.Float, cap: mi.Float = dr.inf) -> mi.Float:
        """The chord that starts at arc length ``t``, no longer than ``cap`` if that can be."""
        h = self.scale * (self.spread + self._root(self.room(t)))
        h = smaller(smaller(h, self.longest), self._near_conjugate(t))
        return larger(smaller(h, cap), self.shortest(t))

    def shortest(self, t: mi.Float) -> mi.Float:
        """At least a few roundings of the arc length, so that every chord moves on."""
        return larger(self.least, 2**-21 * t)

    def _near_conjugate(self, t: mi.Float) -> mi.Float:
        """The longest chord at arc length ``t``, by the closest end of a turn."""
        # From the middle of the shortest one
        middle = dr.fma(0.5, self.at_conjugate, t)
        end = self.turn * larger(dr.round(self.turns * middle), 1)
        return larger(TO_CONJUGATE * dr.abs(end - middle), self.at_conjugate)

    def between(self, t: mi.Float, remaining: mi.Float) -> mi.Float:
        """The chord that starts at ``t`` if the cone narrows again towards ``remaining``.

        Twice as fast as it grew: what is close to a light hides no more of it for being close.
        """
        room = self.room(2 * remaining)
        towards = 4 * room / larger(self._root(room) + self.spread, 1e-20)
        return larger(smaller(self.after(t), towards), self.shortest(t))

    def _root(self, room: mi.Float) -> mi.Float:
        return dr.sqrt(dr.fma(2 * self.across, room, dr.square(self.spread)))


def corner(h: mi.Float) -> mi.Float:
    """By what part of the acceleration there a corner is moved beside chords of the length h."""
    return -0.125 * CORNER * dr.square(h)


class Tracer:
    """Follows geodesics through a scene, in plain Nil or in the quotient."""

    def __init__(
        self,
        scene: mi.Scene,
        space: Space,
        max_distance: float,
        shapes: Shapes | None = None,
        focus: mi.ScalarPoint3f | None = None,
    ):
        self.scene = scene
        self.space = space
        self.max_distance = dr.opaque(mi.Float, max_distance)
        # Shorter chords, and hits that lie closer to the geodesic, are lost in float32's rounding:
        # of the position (slack is 16 roundings of it), and of the formulas that flow along the
        # geodesic, 4e-6 of whose length of 10 cells they are off.
        self.least = opaque(larger(1e-4, 16 * space.slack))
        self.overlap = opaque(2 * space.slack)  # of chords at their joints
        self.exact = opaque(larger(4e-6, 0.25 * space.slack))
        self.shapes = shapes = shapes or Shapes(scene)
        self.triangles = Triangles(shapes)
        self.clearance = None
        if not space.flat:
            clearance = Clearance(space, shapes, focus)
            self.clearance = clearance if clearance.useful else None
        if space.quotient:  # no ray leaves the cell
            return
        self.occupied = Occupied((extent.box for extent in shapes.extents), space)

    # ------------------------------------------------------------------ lengths

    def reach(self, p: mi.Point3f, v: mi.Vector3f, limit: mi.Float | None = None) -> mi.Float:
        """Arc length (cells) past which the geodesic cannot meet the scene's box any more.

        ``v`` is a frame direction (scene axes). At most ``limit``, which is ``max_distance`` if it
        is None.

        With B and H the horizontal and symmetric-vertical extent of the box seen from p, a point
        inside has |Z~| ≤ H and horizontal distance ≤ B, while |Z~| ≥ (|w| + c²/2|w|) t − c B/2|w|
        along the geodesic; hence t ≤ (2 |w| H + c B)/(1 + w²).
        """
        if limit is None:
            limit = self.max_distance
        if self.space.quotient:
            return limit
        far = larger(dr.abs(self.occupied.lower - p), dr.abs(self.occupied.upper - p))
        v = self.space.to_cell_axes(v)
        k = dr.abs(self.space.twist)
        c = dr.hypot(v.x, v.y)
        w = dr.abs(v.z)
        height = far.z + k * far.y * (dr.abs(p.x) + 0.5 * far.x)
        bound = (2 * w * height + c * dr.hypot(far.x, far.y)) / (1 + w * w)
        # One part in a thousand and a little more against rounding; no number for a ray of none
        return smaller(limit, 1.001 * bound + 1e-3)

    @dr.syntax
    def _approach(
        self,
        p: mi.Point3f,
        v: mi.Vector3f,
        chords: Chords,
        unit: mi.Float,
        front: Front,
        reach: mi.Float,
        active: mi.Bool,
        cap: mi.Float = dr.inf,
    ) -> Front:
        """Pass what is empty before the scene's boxes, if the front is outside of them.

        ``p``, ``v``: where the ray started; ``cap`` bounds its next chord. Where it does not come
        (back) to a box before ``reach``, its arc length becomes that.
        """
        leaping = active & self.occupied.excludes(front.vertex)
        # A thin box may lie between the chord's end and the geodesic
        aside = dr.norm(front.vertex - front.foot.point)
        leaping &= (front.t == 0) | (aside <= self.occupied.gap(front.foot.point))
        if leaping:  # a branch: most rays are inside
            passage = Passage(p, v, self.space.twist)
            start = mi.Float(front.t)
            base, direction = mi.Point3f(front.foot.point), mi.Vector3f(front.foot.direction)
            t = mi.Float(front.t)
            while leaping:
                free = self.occupied.clearance(base, direction, passage)
                leaping &= free > chords.after(t)
                t = dr.select(leaping, smaller(t + free, reach), t)
                leaping &= t < reach
                point, arrival = geometry.flow(p, v, t, self.space.twist)
                base = dr.select(leaping, point, base)
                direction = dr.select(leaping, arrival, direction)
            h = chords.after(t, cap)
            # Chords begin where nothing is yet, at a random phase
            back = dr.select(t < reach, smaller(unit * h, t - start), 0)
            foot = Foot(base, direction, mi.Vector2f(0)).moved(-back, self.space.twist)
            t -= back
            # As lifted as after a chord
            lifted = dr.fma(corner(h), self.acceleration(foot), foot.point)
            vertex = dr.select(t > start, lifted, front.vertex)
            front = Front(vertex, foot, t, front.cell)
        return front

    def acceleration(self, foot: Foot) -> mi.Vector3f:
        """Second derivative of the geodesic's coordinates: k (−w b, w a, a b + k x w a)."""
        k, v = self.space.twist, foot.direction
        turn = k * v.z
        y = turn * v.x
        return mi.Vector3f(-turn * v.y, y, dr.fma(k * foot.point.x, y, k * v.x * v.y))

    # ------------------------------------------------------------------ tracing

    def _start(self, vertex: mi.Point3f, p: mi.Point3f, v: mi.Vector3f) -> Front:
        """Where the geodesic from ``p`` along ``v`` begins, and its first chord at ``vertex``."""
        foot = Foot(mi.Point3f(p), mi.Vector3f(v), mi.Vector2f(0))
        return Front(mi.Point3f(vertex), foot, mi.Float(0), mi.Vector3i(0))

    def _ahead(self, front: Front, length: mi.Float, lift: mi.Float) -> tuple[Chord, Foot]:
        """The chord from ``front`` over an arc of that ``length``, its end moved by ``lift`` times
        the acceleration there, and the foot at that end."""
        # The point moves on by as much as the arc length does, after its rounding
        length = (front.t + length) - front.t
        foot = front.foot.moved(length, self.space.twist)
        end = dr.fma(lift, self.acceleration(foot), foot.point)
        return Chord(mi.Vector3f(end - front.vertex), length), foot

    def _ray(
        self, front: Front, chord: Chord, before: mi.Float, last: mi.Float, time: mi.Float
    ) -> mi.Ray3f:
        """The ray (scene) along a chord from ``before`` it to ``last``, in the arc's lengths
        (cells), which are those of the scene but for the chord's own shear and sagitta."""
        d = chord.along / larger(chord.length, 1e-30)
        space = self.space
        o = space.to_scene(dr.fma(-before, d, front.vertex))
        return line_ray(o, space.to_scene_axes(d), time, (before + last) * space.size)

    @dr.syntax
    def _leapt(
        self,
        front: Front,
        chords: Chords,
        unit: mi.Float,
        cap: mi.Float,
        reach: mi.Float,
        leaping: mi.Bool,
    ) -> Front:
        """The front after leaps over what is known to be empty, while those are worth it.

        All rays of a packet leap before any is queried: Embree's time is that of whole packets.
        """
        leaping = leaping & (front.t < reach)
        while leaping:
            h = smaller(chords.after(front.t, cap), reach - front.t)
            least = LEAST_LEAP * h
            free = self._free(front, h)
            leaping &= free > dr.fma(least, unit, least)
            # Not all of what is free, so that the next chord begins at a random phase, too
            length = smaller(smaller(dr.fma(-least, unit, free), chords.longest), reach - front.t)
            leap, foot = self._ahead(front, dr.select(leaping, length, 0), corner(h))
            vertex = dr.select(leaping, front.vertex + leap.along, front.vertex)
            point, cell = foot.point, front.cell
            if dr.hint(self.space.quotient, mode="scalar"):
                vertex, (point,), cell = into_cell(vertex, [point], cell, leaping, self.space)
            foot = Foot(point, foot.direction, foot.lost)
            front = Front(vertex, foot, front.t + leap.length, cell)
            # A short leap far out may be rounded to none
            leaping &= (leap.length > 0) & (front.t < reach)
            if dr.hint(not self.space.quotient, mode="scalar"):
                leaping &= ~self.occupied.excludes(vertex)  # `_approach` goes farther
        return front

    def _free(self, front: Front, h: mi.Float) -> mi.Float:
        """Arc length (cells) that is known to be empty ahead, also around both ends of a leap,
        which are as far off the geodesic as corners beside chords of the length h."""
        foot = front.foot
        aside = dr.abs(front.vertex - foot.point)
        aside = dr.fma(-2 * corner(h), dr.abs(self.acceleration(foot)), aside)
        aside = aside.x + aside.y + aside.z  # no less than its length, without a root
        room = larger(cast(Clearance, self.clearance).at(front.vertex) - aside, 0)
        return within(foot.point, foot.direction, room, self.space.twist)

    def _phased(self, front: Front, h: mi.Float, unit: mi.Float) -> mi.Float:
        """The length h of a chord, of which the first one has the part ``unit`` only."""
        return dr.select(front.t == 0, larger(unit * h, self.least), h)

    def _balanced(self, front, chord, foot, part, face, lift, off, wanted):
        """A chord that a face cuts, turned so that its piece before that is right in the mean.

        The next one begins there, at a phase that is not random any more. Vertices are ``off`` the
        curve by parts of the acceleration: at its end the whole chord by ``lift``, the piece of the
        length u by −u²/6 less what it is off at its start. The end is moved along the face. Returns
        the chord, its part in this cell, and what its end there is off.
        """
        u = part * chord.length
        there = dr.fma(part, lift - off, off) + 0.5 * u * (chord.length - u)
        goal = -dr.square(u) / 6 - off
        acceleration, across = self.acceleration(foot), dr.abs(mi.Vector3f(face))
        rise = goal - there
        slide = rise * dr.dot(across, acceleration) / dr.dot(across, chord.along)
        less = part - slide
        end = dr.fma(rise, acceleration, dr.fma(less, chord.along, front.vertex))
        # Not where it would leave through another face, or go far along a curve that grazes this
        good = wanted & (part < 1) & (dr.abs(slide) < 0.25 * part)
        good &= dr.all((end >= 0) & (end <= mi.Point3f(self.space.periods)))
        along = dr.select(good, mi.Vector3f((end - front.vertex) / less), chord.along)
        off = dr.select(good, goal, there)
        return Chord(along, chord.length), dr.select(good, less, part), off

    def _passed(self, chord, found, before):
        """Arc length from a chord's start to what its ray has found."""
        s = dr.fma(found.t, self.space.cells_per_unit, -before)
        return smaller(larger(s, 0), chord.length)

    def _exit(self, front: Front, chord: Chord) -> tuple[mi.Float, mi.Vector3i]:
        """What part of a chord lies in this cell, and through which face it leaves."""
        if not self.space.quotient:
            return mi.Float(1), mi.Vector3i(0)
        part, face = exit_through_face(front.vertex, chord.along, self.space)
        return smaller(part, 1), dr.select(part < 1, face, 0)

    def _onward(
        self,
        front: Front,
        chord: Chord,
        foot: Foot,
        part: mi.Float,
        s: mi.Float,
        face: mi.Vector3i,
        hit: mi.Bool,
    ) -> Front:
        """The front after a ``part`` of a chord and the arc length ``s``; ``foot`` is at its end.

        Where that has ``hit``, the vertex and the arc length stay those of its start.
        """
        space, cell = self.space, front.cell
        if space.quotient:
            t = front.t + s
            foot = foot.moved((t - front.t) - chord.length, space.twist)
            vertex = dr.fma(chord.along, part, front.vertex)
            face = dr.select(hit, 0, face)
            vertex, (point,), cell = through_face(vertex, [foot.point], cell, face, space)
            foot = Foot(point, foot.direction, foot.lost)
        else:
            t = front.t + chord.length
            vertex = mi.Point3f(front.vertex + chord.along)
        vertex = dr.select(hit, front.vertex, vertex)
        return Front(vertex, foot, dr.select(hit, front.t, t), cell)

    def _halted(self, front: Front, foot: Foot, chord: Chord, s: mi.Float, hit: mi.Bool) -> Front:
        """The front at the arc length ``s`` of a chord that has ``hit``; ``foot`` is at its end."""
        if self.space.quotient:
            at = front.foot.point  # there already
        else:
            at = dr.select(
                hit, foot.moved(s - chord.length, self.space.twist).point, front.foot.point
            )
        foot = Foot(at, front.foot.direction, front.foot.lost)
        return Front(front.vertex, foot, dr.select(hit, front.t + s, front.t), front.cell)

    def intersect(
        self,
        p: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float = 0,
        ends: bool = False,
    ) -> Hit:
        """First hit of the geodesic from ``p`` (cells) in frame direction ``v`` (scene axes) within
        ``reach``; if ``ends``, in the quotient also where those come to that meet nothing.

        In the quotient ``p`` lies in the first cell. A hit of a ray that is seen lies off the
        geodesic by at most 4e-6 cells and 1/250 of the cone; where the geodesic only just misses
        what its chord meets, by the chord's error, about a tenth of the cone.
        """
        v = self.space.to_cell_axes(v)
        if self.space.flat and not self.space.quotient:
            hit = self._straight(p, v, reach, active, time)
        else:
            hit = self._along_chords(p, v, cone, reach, active, time, ends)
        hit.arrival = self.space.to_scene_axes(hit.arrival)
        hit.preliminary = self.shapes.within_splines(hit.preliminary, hit.ray)
        return hit

    def _straight(self, p, v, reach, active, time):
        """`intersect` in Euclidean space."""
        space = self.space
        ray = line_ray(space.to_scene(p), space.to_scene_axes(v), time, reach * space.size)
        found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        valid = found.is_valid()
        distance = dr.select(valid, found.t * space.cells_per_unit, dr.inf)
        triangle = self.triangles.at(found)
        return Hit(valid, distance, mi.Vector3f(v), mi.Vector3i(0), ray, found, triangle)

    @dr.syntax
    def _along_chords(self, p, v, cone, reach, active, time, ends):
        """`intersect` by chords."""
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient
        sagitta = dr.select(cone.soft, SOFT_SAGITTA, SAGITTA)
        chords = Chords(v, k, cone, sagitta, dr.select(cone.soft, 0, START), self.least)
        unit = random_of(p, v)
        front = self._start(p, p, v)
        chord = Chord(mi.Vector3f(0), mi.Float(0))
        found = dr.zeros(mi.PreliminaryIntersection3f)
        active = active & (reach > 0)
        bends_at_faces = quotient and not space.flat
        off = mi.Float(0)  # of the vertex, from the curve, by what part of the acceleration

        # After a failed refinement chords are no longer than ``cap``
        cap = mi.Float(dr.inf)
        valid, distance = mi.Bool(False), mi.Float(0)
        o, d = mi.Point3f(0), mi.Vector3f(0)

        while active:
            if not quotient:
                front = self._approach(p, v, chords, unit, front, reach, active, cap)
            searching = active & (front.t < reach)
            hit = mi.Bool(False)
            while searching:
                if dr.hint(self.clearance is not None, mode="scalar"):
                    front = self._leapt(front, chords, unit, cap, reach, searching & ~cone.soft)
                left = reach - front.t
                h = smaller(chords.after(front.t, cap), left)
                length = self._phased(front, h, unit)
                lift = corner(smaller(h, STEEPEST * length))
                length = smaller(length, left)
                if dr.hint(ends, mode="scalar"):
                    # What is there has to be on the side of all surfaces on which the chord ends
                    lift = dr.select(length >= left, 0, lift)
                chord, foot = self._ahead(front, length, lift)
                part, face = self._exit(front, chord)
                if dr.hint(bends_at_faces, mode="scalar"):
                    chord, part, off = self._balanced(
                        front, chord, foot, part, face, lift, off, cone.soft
                    )
                # Pieces overlap by the rounding of their joint, but none reaches behind the start
                before = dr.select(front.t > 0, self.overlap, 0)
                ray = self._ray(
                    front, chord, before, dr.fma(part, chord.length, self.overlap), time
                )
                coherent = ~cone.soft & (front.t < TOGETHER)
                querying = searching & (left > 0)
                found = scene.ray_intersect_preliminary(ray, coherent=coherent, active=querying)
                hit = found.is_valid()
                s = dr.select(hit, self._passed(chord, found, before), part * chord.length)
                front = self._onward(front, chord, foot, part, s, face, hit)
                cap *= 2
                searching &= ~hit & (front.t < reach)
                if not quotient:
                    searching &= ~self.occupied.excludes(front.vertex)
            there = active & hit
            if there:  # a branch: the last rays of a packet have often left
                before = dr.select(front.t > 0, self.overlap, 0)
                s = self._passed(chord, found, before)
                foot = front.foot
                if not quotient:
                    foot = foot.moved(s - chord.length, k)
                ray = self._ray(front, chord, before, 0, time)
                speed = dr.norm(ray.d)
                o, d, found.t = ray.o, ray.d / speed, found.t * speed
                distance = front.t + s
                failed = mi.Bool(False)
                if dr.hint(not space.flat, mode="scalar"):
                    found, o, d, distance, failed = self._onto_geodesic(
                        found, o, d, foot, distance, chord, cone, chords, reach, time
                    )
                failed &= (front.t == 0) | (distance > chords.turn)
                # A chord that cannot be cut any more is taken as it is
                failed &= chord.length > 2 * chords.shortest(front.t)
                valid = ~failed
                if failed:
                    front.foot = foot.moved(-s, k)
                    # A chord of an eighth has a 64th of the sagitta; a first one has its phase, too
                    cap = 0.125 * chord.length
            active &= ~valid & (front.t < reach)

        found.t = dr.select(valid, found.t, dr.inf)
        arrival = geometry.turned(v, k * v.z * distance)
        distance = dr.select(valid, distance, dr.inf)
        triangle = self.triangles.at(found)
        hit = Hit(valid, distance, arrival, front.cell, line_ray(o, d, time), found, triangle)
        if dr.hint(ends and quotient, mode="scalar"):
            hit.end = front.foot.point
        return hit

    @dr.syntax
    def _onto_geodesic(self, found, o, d, foot, distance, chord, cone, chords, reach, time):
        """Where the geodesic meets the surface that a chord has met.

        ``found`` is what the ray from ``o`` (scene) along ``d`` has met, close to the ``foot`` at
        the arc length ``distance``. Returns the same for the geodesic, and whether that does not
        meet what the chord has met, in which case they are the chord's.
        """
        space, scene, k = self.space, self.scene, self.space.twist
        at = mi.Float(distance)
        # Two steps reach a 250th of what may be seen, one seldom does
        goal = dr.fma(0.004, dr.fma(cone.spread, distance, cone.width), self.exact)
        looking = ~cone.soft
        triangle = self.triangles.at(found)
        if dr.hint(triangle is not None, mode="scalar"):
            near = foot.point
            lead = geometry.from_frame(near, foot.direction, k)
            step, b, good = cast(Triangle, triangle).onto_plane(found.prim_uv, near, lead, space)
            error = 0.5 * chords.across * dr.square(step)
            good &= (distance + step >= 0) & (distance + step <= reach)
            good &= cone.soft | (error <= goal)
            if dr.hint(space.quotient, mode="scalar"):
                # What lies beyond a face is another copy
                end = mi.Point3f(dr.fma(lead, step, near))
                good &= dr.all((end >= 0) & (end <= mi.Point3f(space.periods)))
            found.prim_uv = dr.select(good, b, found.prim_uv)
            at = dr.select(good, distance + step, distance)
            looking &= ~good
        failed = mi.Bool(looking)
        if looking:
            ray = line_ray(o, d, time)
            met = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, looking)
            side = dr.sign(dr.dot(met.n, d))
            window = 0.25 * chord.length
            n = space.to_cell_axes(met.n)
            lead = geometry.from_frame(foot.point, foot.direction, k)
            step = dr.dot(n, space.to_cells(met.p) - foot.point) / dr.dot(n, lead)
            step = dr.select(dr.abs(step) < 0.5 * window, step, 0)
            while looking:
                foot = foot.moved(step, k)
                distance += step
                near = foot.point
                lead = geometry.from_frame(near, foot.direction, k)
                s_first = -smaller(window, distance)
                s_last = smaller(window, reach - distance)
                if space.quotient:
                    s_first = larger(s_first, -exit_through_face(near, -lead, space)[0])
                    s_last = smaller(s_last, exit_through_face(near, lead, space)[0])
                speed = dr.norm(lead)
                line = lead / speed
                # Nothing before the ray's own start, which may be close by its surface
                before = smaller(space.slack, (distance + s_first) * speed)
                start = space.to_scene(dr.fma(lead, s_first, near) - before * line)
                line = space.to_scene_axes(line)
                last = dr.fma(s_last - s_first, speed, before + space.slack)
                ray = line_ray(start, line, time, last * space.size)
                pi = scene.ray_intersect_preliminary(ray, coherent=False, active=looking)
                # A tangent that meets a surface from the other side than the chord did has found
                # where the geodesic comes back, or what lies behind its start.
                met = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, pi.is_valid())
                looking &= pi.is_valid() & (dr.sign(dr.dot(met.n, line)) == side)
                step = s_first + (pi.t * space.cells_per_unit - before) / speed
                error = 0.5 * chords.across * dr.square(step)
                good = looking & (error <= goal)
                # The error falls by its square: what is 256 of the last one away is something else
                window = smaller(0.5 * window, 256 * error)
                at = dr.select(good, distance + step, at)
                o, d = dr.select(good, start, o), dr.select(good, line, d)
                found = dr.select(good, pi, found)
                failed &= ~good
                looking &= ~good
        return found, o, d, at, failed

    def occluded(
        self,
        p: mi.Point3f,
        start: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float = 0,
    ) -> mi.Bool:
        """Whether anything stands in the way of the geodesic from ``p`` (cells) in frame direction
        ``v`` (scene axes) within ``reach`` (cells).

        The first chord begins at ``start``: off the surface on which ``p`` lies, while the last one
        ends where the geodesic does. In the quotient ``start`` lies in the unit cube.
        """
        v = self.space.to_cell_axes(v)
        if self.space.flat and not self.space.quotient:
            ray, _ = self._straight_to_end(p, start, v, reach, time)
            return self.scene.ray_test(ray, coherent=False, active=active & (reach > 0))
        return self._chords_meet(p, start, v, cone, reach, active, time, finds=False)[0]

    def obstacle(
        self,
        p: mi.Point3f,
        start: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float = 0,
    ) -> Hit:
        """What first stands in the way of the geodesic, as of `occluded`; its ``end`` is the point
        of the geodesic itself that is there."""
        space = self.space
        v = space.to_cell_axes(v)
        if space.flat and not space.quotient:
            ray, length = self._straight_to_end(p, start, v, reach, time)
            active = active & (reach > 0)
            found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            valid, part = found.is_valid(), found.t * space.cells_per_unit / length
            distance = dr.select(valid, smaller(part, 1) * reach, dr.inf)
            arrival, cell = mi.Vector3f(v), mi.Vector3i(0)
            end = mi.Point3f(dr.fma(dr.select(valid, distance, 0), v, p))
        else:
            valid, front, ray, found = self._chords_meet(
                p, start, v, cone, reach, active, time, finds=True
            )
            distance = dr.select(valid, front.t, dr.inf)
            arrival = geometry.turned(v, space.twist * v.z * front.t)
            end, cell = front.foot.point, front.cell
        arrival = space.to_scene_axes(arrival)
        found = self.shapes.within_splines(found, ray)
        return Hit(valid, distance, arrival, cell, ray, found, self.triangles.at(found), end)

    def _straight_to_end(self, p, start, v, reach, time):
        """The ray of `occluded` in Euclidean space, and its length (cells)."""
        space = self.space
        along = dr.fma(reach, v, mi.Vector3f(p - start))
        length = dr.norm(along)
        d = space.to_scene_axes(along / length)
        return line_ray(space.to_scene(start), d, time, length * space.size), length

    @dr.syntax
    def _chords_meet(self, p, start, v, cone, reach, active, time, finds):
        """`occluded` by chords, or `obstacle` if it ``finds`` what that is: whether there is one,
        the front there, and the ray that has met it with what that is."""
        space, scene = self.space, self.scene
        quotient = space.quotient
        chords = Chords(v, space.twist, cone, SOFT_SAGITTA, 0, self.least)
        unit = random_of(p, v)
        front = self._start(start, p, v)
        blocked = mi.Bool(False)
        bends_at_faces = quotient and not space.flat
        off = mi.Float(0)  # as in `_along_chords`
        active = active & (reach > 0)
        found, met = dr.zeros(mi.PreliminaryIntersection3f), dr.zeros(mi.Ray3f)

        while active:
            if not quotient:
                front = self._approach(p, v, chords, unit, front, reach, active)
            searching = active & (front.t < reach)
            while searching:
                left = reach - front.t
                h = smaller(chords.between(front.t, left), left)
                length = self._phased(front, h, unit)
                last = length >= left
                length = smaller(length, left)
                # As close to the curve near the light as near the start
                rest = smaller(length, left - length)
                lift = dr.select(last, 0, corner(smaller(h, STEEPEST * rest)))
                chord, foot = self._ahead(front, length, lift)
                part, face = self._exit(front, chord)
                if dr.hint(bends_at_faces, mode="scalar"):
                    chord, part, off = self._balanced(
                        front, chord, foot, part, face, lift, off, True
                    )
                last &= part >= 1
                s = part * chord.length
                before = dr.select(front.t > 0, self.overlap, 0)
                ray = self._ray(front, chord, before, s + dr.select(last, 0, self.overlap), time)
                if dr.hint(finds, mode="scalar"):
                    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=searching)
                    hit = pi.is_valid()
                    found, met = dr.select(hit, pi, found), dr.select(hit, ray, met)
                    s = dr.select(hit, self._passed(chord, pi, before), s)
                else:
                    hit = scene.ray_test(ray, coherent=False, active=searching)
                blocked |= hit
                front = self._onward(front, chord, foot, part, s, face, hit)
                if dr.hint(finds, mode="scalar"):
                    front = self._halted(front, foot, chord, s, hit)
                active &= ~hit & ~last
                searching &= active & (front.t < reach)
                if not quotient:
                    searching &= ~self.occupied.excludes(front.vertex)
            active &= front.t < reach
        return blocked, front, met, found
