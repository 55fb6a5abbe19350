"""Geodesic rays against Mitsuba's scene of straight-ray intersections.

A ray is followed along its geodesic by chords, short enough for the error that the viewer
tolerates, and by leaps where a grid of clearances knows that nothing is near. The corners lie
outside of the curve, at places that differ from ray to ray, so that the polygon is off to both
sides alike: on average a surface is met as often as it should be. What a chord has met tells where
to look: the hit is where the geodesic meets the plane of that triangle or, if that is beside the
triangle or the surface is bent, where its tangent line meets the surface. Where the tangent finds
nothing (silhouettes, contacts, grazing rays), the chord is cut and tried again. Everything in this
file is in cell coordinates, directions in cell axes, too, unless it says "scene". Directions that
come in and go out, frame components, are turned to them at once and back at last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi

from . import geometry
from .box import Occupied, Passage
from .clearance import Clearance, within
from .quotient import Space, exit_through_face, into_cell, opaque, through_face
from .shapes import Shapes
from .triangles import Triangle, Triangles

# A chord's sagitta is about this part of the cone's width there: along rays that are seen, behind
# rough bounces, and towards lights. The first follows from how many rays name another surface near
# silhouettes (benchmarks/camera_rays.py); the others are what the means and the shadows of the bent
# Cornell box do not show (benchmarks/accuracy.py).
SAGITTA, SOFT_SAGITTA, SHADOW_SAGITTA = 0.1, 0.4, 0.15
# Rays that are seen are allowed at their start what they are at this distance (cells): of the many
# short chords there few meet anything. Beyond a seventh of a cell that is within the tolerance.
START = 0.4
# Corners lie outside the curve by so many sagittas. A first chord of any part of its length, each
# as likely, is then right in the mean from its start on, to a twentieth of a sagitta: with τ of a
# chord behind, off by 4/3 τ − 2 τ² + 2/3 τ³ + 2/3 τ log τ. A shorter one does not reach that far
# out, or grazing rays would meet what they leave: no farther than chords so many times as long do.
CORNER, STEEPEST = 2 / 3, 4
# Leaps are worth it down to this part of a chord: each takes 8 to 12 ns, where a query takes 50.
LEAST_LEAP = 0.25


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
    meshes.
    """

    valid: mi.Bool
    distance: mi.Float
    arrival: mi.Vector3f
    cell: mi.Vector3i
    ray: mi.Ray3f
    preliminary: mi.PreliminaryIntersection3f
    triangle: Triangle | None = None


@dataclass
class Front:
    """How far a ray has come: to the geodesic's point ``base`` at arc length ``t``, beside which,
    at ``vertex``, its last chord has ended; ``direction`` there and ``cell``, its deck element."""

    vertex: mi.Point3f
    base: mi.Point3f
    direction: mi.Vector3f
    t: mi.Float
    cell: mi.Vector3i


@dataclass
class Place:
    """What the ray from ``o`` (scene) along ``d`` has ``met``, at the geodesic's arc length t."""

    met: mi.PreliminaryIntersection3f
    o: mi.Point3f
    d: mi.Vector3f
    t: mi.Float


@dataclass
class Chord:
    """The chord ``along``, of the arc's ``length`` (cells), of which ``part`` lies in this cell.

    ``face`` is the one through which it leaves, zero if it does not; ``ray`` (scene) runs along it,
    from ``before`` (cells) ahead of it.
    """

    along: mi.Vector3f
    length: mi.Float
    part: mi.Float
    face: mi.Vector3i
    before: mi.Float
    ray: mi.Ray3f
    base: mi.Point3f
    direction: mi.Vector3f

    def arc_at(self, distance: mi.Float) -> mi.Float:
        """Arc length from the chord's start to where its ray has gone ``distance`` (cells)."""
        s = (distance - self.before) * dr.rsqrt(dr.maximum(dr.squared_norm(self.along), 1e-30))
        return dr.clip(s, 0, 1) * self.length


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
    """Lengths (cells) of chords whose sagitta keeps within ``part`` of the cone at their middle.

    The acceleration of the geodesic's point is k (−w b, w a, a b) in frame components, and across
    its direction no longer than g = |k| c √(w² + a² b²) ≤ |k| c √(w² + c⁴/4) = ``across``. The
    sagitta is at most h² g/8, and h² g/8 = width + spread (t + h/2) is solved for h, the cone being
    as wide at its start as elsewhere at the distance ``start``. No chord is shorter than ``least``
    nor longer than 1/k, beyond which it is no parabola.
    """

    def __init__(self, v, twist, cone, part, start, least):
        k = dr.maximum(dr.abs(twist), 1e-9)
        c2 = dr.fma(v.x, v.x, v.y * v.y)
        across = k * dr.sqrt(c2 * dr.fma(0.25 * c2, c2, dr.square(v.z)))
        self.across = dr.maximum(across, 1e-9)
        self.longest = dr.rcp(k)
        self.spread = part * cone.spread
        self.width = dr.fma(self.spread, start, part * cone.width)
        self.scale = 2 * dr.rcp(self.across)
        self.least = least

    def room(self, t: mi.Float) -> mi.Float:
        """The sagitta that is allowed at arc length ``t``."""
        return dr.fma(self.spread, t, self.width)

    def after(self, t: mi.Float) -> mi.Float:
        """The chord that starts at arc length ``t``."""
        root = self._root(self.room(t))
        return dr.clip(self.scale * (self.spread + root), self.shortest(t), self.longest)

    def shortest(self, t: mi.Float) -> mi.Float:
        """At least a few roundings of the arc length, so that every chord moves on."""
        return dr.maximum(self.least, 2**-21 * t)

    def between(self, t: mi.Float, remaining: mi.Float) -> mi.Float:
        """The chord that starts at ``t`` if the cone narrows again towards ``remaining``.

        Twice as fast as it grew: what is close to a light hides no more of it for being close.
        """
        room = self.room(2 * remaining)
        towards = 4 * room / dr.maximum(self._root(room) + self.spread, 1e-20)
        return dr.maximum(dr.minimum(self.after(t), towards), self.shortest(t))

    def _root(self, room: mi.Float) -> mi.Float:
        return dr.sqrt(dr.fma(2 * self.across, room, dr.square(self.spread)))


def sagittas(h: mi.Float) -> mi.Float:
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
        self.least = opaque(dr.maximum(1e-4, 16 * space.slack))
        self.exact = opaque(dr.maximum(4e-6, 0.25 * space.slack))
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
        far = dr.maximum(dr.abs(self.occupied.lower - p), dr.abs(self.occupied.upper - p))
        v = self.space.to_cell_axes(v)
        k = dr.abs(self.space.twist)
        c = dr.hypot(v.x, v.y)
        w = dr.abs(v.z)
        height = far.z + k * far.y * (dr.abs(p.x) + 0.5 * far.x)
        bound = (2 * w * height + c * dr.hypot(far.x, far.y)) / (1 + w * w)
        # one part in a thousand and a little more against rounding
        return dr.minimum(1.001 * bound + 1e-3, limit)

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
        aside = dr.norm(front.vertex - front.base)
        leaping &= (front.t == 0) | (aside <= self.occupied.gap(front.base))
        if leaping:  # a branch: most rays are inside
            passage = Passage(p, v, self.space.twist)
            start = mi.Float(front.t)
            base, direction, t = (
                mi.Point3f(front.base),
                mi.Vector3f(front.direction),
                mi.Float(front.t),
            )
            while leaping:
                free = self.occupied.clearance(base, direction, passage)
                leaping &= free > chords.after(t)
                t = dr.select(leaping, dr.minimum(t + free, reach), t)
                leaping &= t < reach
                point, arrival = geometry.flow(p, v, t, self.space.twist)
                base = dr.select(leaping, point, base)
                direction = dr.select(leaping, arrival, direction)
            h = dr.maximum(dr.minimum(chords.after(t), cap), chords.shortest(t))
            # Chords begin where nothing is yet, at a random phase
            back = dr.select(t < reach, dr.minimum(unit * h, t - start), 0)
            base, direction = geometry.short_flow(base, v, t, -back, self.space.twist)
            t -= back
            # As lifted as after a chord
            lift = sagittas(h)
            lifted = dr.fma(lift, self.acceleration(base, direction), base)
            vertex = dr.select(t > start, lifted, front.vertex)
            front = Front(vertex, base, direction, t, front.cell)
        return front

    def acceleration(self, p: mi.Point3f, v: mi.Vector3f) -> mi.Vector3f:
        """Second derivative of the geodesic's coordinates: k (−w b, w a, a b + k x w a)."""
        k = self.space.twist
        turn = k * v.z
        y = turn * v.x
        return mi.Vector3f(-turn * v.y, y, dr.fma(k * p.x, y, k * v.x * v.y))

    # ------------------------------------------------------------------ tracing

    def _chord(
        self, v: mi.Vector3f, front: Front, length: mi.Float, lift: mi.Float, time: mi.Float
    ) -> Chord:
        """The chord from ``front`` over an arc of that ``length``, its end moved by ``lift``
        times the acceleration there."""
        space = self.space
        # The point moves on by as much as the arc length does, after its rounding
        length = (front.t + length) - front.t
        base, direction = geometry.short_flow(front.base, v, front.t, length, space.twist)
        end = dr.fma(lift, self.acceleration(base, direction), base)
        along = mi.Vector3f(end - front.vertex)
        part, face = mi.Float(1), mi.Vector3i(0)
        if space.quotient:
            part, face = exit_through_face(front.vertex, along, space)
            face = dr.select(part < 1, face, 0)
            part = dr.minimum(part, 1)
        speed2 = dr.squared_norm(along)
        inv_speed = dr.rsqrt(dr.maximum(speed2, 1e-30))
        d = along * inv_speed
        # Pieces overlap by the rounding of their joint, but none reaches behind the start.
        before = dr.select(front.t > 0, space.slack, 0)
        last = dr.fma(part, speed2 * inv_speed, before + space.slack)
        o, d = space.to_scene(front.vertex - before * d), space.to_scene_axes(d)
        ray = line_ray(o, d, time, last * space.size)
        return Chord(along, length, part, face, before, ray, base, direction)

    @dr.syntax
    def _free(self, front: Front, h: mi.Float, seen: mi.Bool) -> mi.Float:
        """Arc length (cells) that is known to be empty ahead of rays that are ``seen``.

        Also around both ends of the leap, which are as far off the geodesic as corners beside
        chords of the length h.
        """
        free = mi.Float(0)
        if dr.hint(self.clearance is not None, mode="scalar"):
            if seen:  # a branch: the others' chords are longer than what is free, as a rule
                aside = dr.norm(front.vertex - front.base)
                bend = dr.norm(self.acceleration(front.base, front.direction))
                aside = dr.fma(-2 * sagittas(h), bend, aside)
                room = cast(Clearance, self.clearance).at(front.vertex) - aside
                room = dr.maximum(room, 0)
                free = within(front.base, front.direction, room, self.space.twist)
        return dr.select(seen, free, 0)

    def _phased(self, front: Front, h: mi.Float, unit: mi.Float) -> mi.Float:
        """The length h of a chord, of which the first one has the part ``unit`` only."""
        return dr.select(front.t == 0, dr.maximum(unit * h, self.least), h)

    def _end_of(
        self,
        v: mi.Vector3f,
        front: Front,
        chord: Chord,
        moving: mi.Bool,
        leaps: mi.Bool | None = None,
    ) -> Front:
        """The front at the end of what of a chord lies in this cell, where it is ``moving``.

        Where it ``leaps``, which may lead out of the cell, all of the arc has been passed.
        """
        space, cell = self.space, front.cell
        vertex = dr.fma(chord.along, chord.part, front.vertex)
        base, direction, part = chord.base, chord.direction, chord.part
        end = front.t + chord.length
        if space.quotient:
            face = dr.select(moving, chord.face, 0)
            if leaps is not None:
                part = dr.select(leaps, 1, part)
                face = dr.select(leaps, 0, face)
                vertex = dr.fma(chord.along, part, front.vertex)
            end = dr.fma(part, chord.length, front.t)
            base, direction = geometry.short_flow(
                front.base, v, front.t, end - front.t, space.twist
            )
            vertex, (base,), cell = through_face(vertex, [base], cell, face, space)
            if leaps is not None:
                vertex, (base,), cell = into_cell(vertex, [base], cell, moving & leaps, space)
        return Front(
            dr.select(moving, vertex, front.vertex),
            dr.select(moving, base, front.base),
            dr.select(moving, direction, front.direction),
            dr.select(moving, end, front.t),
            cell,
        )

    def intersect(
        self,
        p: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float = 0,
    ) -> Hit:
        """First hit of the geodesic from ``p`` (cells) in frame direction ``v`` (scene axes) within
        ``reach``.

        In the quotient ``p`` lies in the unit cube. A hit of a ray that is seen lies off the
        geodesic by at most 1e-5 cells or 1/250 of the cone, whichever is more; where the geodesic
        only just misses what its chord meets, by the chord's error, which keeps within the cone.
        """
        v = self.space.to_cell_axes(v)
        if self.space.flat and not self.space.quotient:
            hit = self._straight(p, v, reach, active, time)
        else:
            hit = self._along_chords(p, v, cone, reach, active, time)
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
    def _along_chords(self, p, v, cone, reach, active, time):
        """`intersect` by chords."""
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient
        part = dr.select(cone.soft, SOFT_SAGITTA, SAGITTA)
        chords = Chords(v, k, cone, part, dr.select(cone.soft, 0, START), self.least)
        unit = random_of(p, v)
        front = Front(mi.Point3f(p), mi.Point3f(p), mi.Vector3f(v), mi.Float(0), mi.Vector3i(0))
        found = dr.zeros(mi.PreliminaryIntersection3f)
        active = active & (reach > 0)

        # After a failed refinement chords are no longer than ``cap``
        cap = mi.Float(dr.inf)
        valid, distance = mi.Bool(False), mi.Float(0)
        met = dr.zeros(mi.PreliminaryIntersection3f)
        o, d = mi.Point3f(0), mi.Vector3f(0)

        def next_chord(front, free, cap):
            h = dr.maximum(dr.minimum(chords.after(front.t), cap), chords.shortest(front.t))
            h = dr.minimum(h, reach - front.t)
            length = self._phased(front, h, unit)
            leaps = free > LEAST_LEAP * (1 + unit) * h
            lift = sagittas(dr.select(leaps, h, dr.minimum(h, STEEPEST * length)))
            # Not all of what is free, so that the next chord begins at a random phase, too
            length = dr.select(leaps, free - LEAST_LEAP * unit * h, length)
            length = dr.minimum(dr.minimum(length, chords.longest), reach - front.t)
            return self._chord(v, front, length, lift, time), leaps

        while active:
            if not quotient:
                front = self._approach(p, v, chords, unit, front, reach, active, cap)
            searching = active & (front.t < reach)
            while searching:
                free = self._free(front, chords.after(front.t), searching & ~cone.soft)
                chord, leaps = next_chord(front, free, cap)
                found = scene.ray_intersect_preliminary(
                    chord.ray, coherent=False, active=searching & ~leaps
                )
                searching &= ~found.is_valid()
                front = self._end_of(v, front, chord, searching, leaps if self.clearance else None)
                cap = dr.select(searching & ~leaps, 2 * cap, cap)
                searching &= front.t < reach
                if not quotient:
                    searching &= ~self.occupied.excludes(front.vertex)
            there = active & found.is_valid()
            chord, _ = next_chord(front, mi.Float(0), cap)
            place = Place(found, mi.Point3f(chord.ray.o), mi.Vector3f(chord.ray.d), front.t)
            failed = mi.Bool(False)
            if dr.hint(not space.flat, mode="scalar"):
                place, failed = self._onto_geodesic(
                    there, v, place, front, chord, cone, chords, reach
                )
            else:
                place.t += chord.arc_at(found.t * space.cells_per_unit)
            # A chord that cannot be cut any more is taken as it is
            failed &= chord.length > 2 * chords.shortest(front.t)
            there &= ~failed
            valid |= there
            distance = dr.select(there, place.t, distance)
            met = dr.select(there, place.met, met)
            o, d = dr.select(there, place.o, o), dr.select(there, place.d, d)
            # A chord of an eighth has a 64th of the sagitta
            cap = dr.select(failed, 0.125 * chord.length, cap)
            active &= ~there & (front.t < reach)

        arrival = geometry.turned(v, k * v.z * distance)
        distance = dr.select(valid, distance, dr.inf)
        triangle = self.triangles.at(met)
        return Hit(valid, distance, arrival, front.cell, line_ray(o, d, time), met, triangle)

    @dr.syntax
    def _onto_geodesic(self, there, v, place, front, chord, cone, chords, reach):
        """Where the geodesic meets the surface that a chord has met.

        ``place``: what the chord's ray has met. Returns that of the geodesic, and whether that
        does not meet what the chord has met, in which case it is the chord's.
        """
        space, scene, k = self.space, self.scene, self.space.twist
        found, o, d = place.met, place.o, place.d
        s = chord.arc_at(found.t * space.cells_per_unit)
        near, arrival = geometry.short_flow(front.base, v, front.t, s, k)
        distance = front.t + s
        at = mi.Float(distance)
        # Two steps reach a 250th of what may be seen, one seldom does
        goal = dr.fma(0.004, dr.fma(cone.spread, distance, cone.width), self.exact)
        looking = there & ~cone.soft
        triangle = self.triangles.at(found)
        if dr.hint(triangle is not None, mode="scalar"):
            lead = geometry.from_frame(near, arrival, k)
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
            time = chord.ray.time
            met = found.compute_surface_interaction(chord.ray, mi.RayFlags.Minimal, looking)
            side = dr.sign(dr.dot(met.n, d))
            window = 0.25 * chord.length
            n = space.to_cell_axes(met.n)
            rate = dr.dot(n, geometry.from_frame(near, arrival, k))
            step = dr.dot(n, space.to_cells(met.p) - near) / rate
            step = dr.select(dr.abs(step) < 0.5 * window, step, 0)
            while looking:
                near, arrival = geometry.short_flow(near, v, distance, step, k)
                distance += step
                lead = geometry.from_frame(near, arrival, k)
                s_first = -dr.minimum(window, distance)
                s_last = dr.minimum(window, reach - distance)
                if space.quotient:
                    s_first = dr.maximum(s_first, -exit_through_face(near, -lead, space)[0])
                    s_last = dr.minimum(s_last, exit_through_face(near, lead, space)[0])
                speed = dr.norm(lead)
                line = lead / speed
                # Nothing before the ray's own start, which may be close by its surface
                before = dr.minimum(space.slack, (distance + s_first) * speed)
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
                window = dr.minimum(0.5 * window, 256 * error)
                at = dr.select(good, distance + step, at)
                o, d = dr.select(good, start, o), dr.select(good, line, d)
                found = dr.select(good, pi, found)
                failed &= ~good
                looking &= ~good
        return Place(found, o, d, at), failed

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
            space = self.space
            along = dr.fma(reach, v, mi.Vector3f(p - start))
            length = dr.norm(along)
            d = space.to_scene_axes(along / length)
            ray = line_ray(space.to_scene(start), d, time, length * space.size)
            return self.scene.ray_test(ray, coherent=False, active=active & (reach > 0))
        return self._chords_meet(p, start, v, cone, reach, active, time)

    @dr.syntax
    def _chords_meet(self, p, start, v, cone, reach, active, time):
        """`occluded` by chords."""
        space, scene = self.space, self.scene
        quotient = space.quotient
        chords = Chords(v, space.twist, cone, SHADOW_SAGITTA, 0, self.least)
        unit = random_of(p, v)
        front = Front(mi.Point3f(start), mi.Point3f(p), mi.Vector3f(v), mi.Float(0), mi.Vector3i(0))
        blocked = mi.Bool(False)
        active = active & (reach > 0)

        while active:
            if not quotient:
                front = self._approach(p, v, chords, unit, front, reach, active)
            searching = active & (front.t < reach)
            while searching:
                left = reach - front.t
                h = dr.minimum(dr.minimum(chords.between(front.t, left), chords.longest), left)
                length = self._phased(front, h, unit)
                last = length >= left
                length = dr.minimum(length, left)
                # As close to the curve near the light as near the start
                rest = dr.minimum(length, left - length)
                lift = dr.select(last, 0, sagittas(dr.minimum(h, STEEPEST * rest)))
                chord = self._chord(v, front, length, lift, time)
                last &= chord.part >= 1
                chord.ray.maxt -= dr.select(last, space.slack * space.size, 0)
                hit = scene.ray_test(chord.ray, coherent=False, active=searching)
                blocked |= searching & hit
                searching &= ~hit
                front = self._end_of(v, front, chord, searching)
                active &= ~hit & ~last
                searching &= active & (front.t < reach)
                if not quotient:
                    searching &= ~self.occupied.excludes(front.vertex)
            active &= front.t < reach
        return blocked
