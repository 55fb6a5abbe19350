"""Geodesic rays against Mitsuba's scene of straight-ray intersections.

A ray is followed along its geodesic by chords short enough for the error that the viewer
tolerates. A chord that hits tells where to look; the hit itself is found on a short piece of the
geodesic's tangent line there (Newton's method with Embree as the surface), so that hits lie on the
geodesic and Mitsuba supplies uv, primitive and curvature for every kind of shape. Where the
tangent misses what the chord hit (silhouettes, contacts, grazing rays), the chord is cut and tried
again. Everything in this file is in cell coordinates unless it says "scene".
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import geometry
from .box import Occupied, Passage
from .quotient import Space, exit_through_face, opaque, through_face
from .shapes import Shapes
from .triangles import Triangle, Triangles

# A chord's sagitta is about this part of the cone's width there: along rays that are seen, behind
# rough bounces, and towards lights. What a chord has missed cannot be found again, while what it
# has met by mistake can, so the error is one-sided: an image's mean allows less than its edges do.
# On the bent Cornell box (benchmarks/speed.py) twice as much in the place of one of them moves the
# mean by 0.2 %, or squares of 4×4 pixels at contacts by more than the noise of 1,024 samples.
SAGITTA, SOFT_SAGITTA, SHADOW_SAGITTA = 0.15, 0.15, 0.1
# Rays that are seen are allowed at their start what they are at this distance (cells): of the many
# short chords there few meet anything. Beyond a fifteenth of a cell that is within the tolerance.
START = 0.4


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

    ``distance`` (cells) is arc length, ``arrival`` the frame direction there, ``cell`` the deck
    element of the copy that was hit, ``ray`` (scene) and ``preliminary`` what Mitsuba needs to
    compute its surface interaction, ``triangle`` what is known of one without asking Mitsuba.
    """

    valid: mi.Bool
    distance: mi.Float
    arrival: mi.Vector3f
    cell: mi.Vector3i
    ray: mi.Ray3f
    preliminary: mi.PreliminaryIntersection3f
    triangle: Triangle | None = None


def random_of(p: mi.Point3f, v: mi.Vector3f) -> mi.Float:
    """A number in [0, 1) that follows from a ray's bits, the same on every machine."""
    px, py, vx, vy = (dr.reinterpret_array(mi.UInt32, x) for x in (p.x, p.y, v.x, v.y))
    return mi.sample_tea_float32(px ^ vx, py ^ vy)


def line_ray(o: mi.Point3f, d: mi.Vector3f, time: mi.Float, maxt: mi.Float = dr.inf) -> mi.Ray3f:
    """A ray (scene) that Embree can follow."""
    ray = dr.zeros(mi.Ray3f)
    ray.o, ray.d, ray.time, ray.maxt = o, d, time, maxt
    return ray


@dataclass
class Piece:
    """What of a chord lies in one cell.

    ``along`` is the whole chord and ``length`` (cells) its length, ``part`` the fraction of it that
    is inside, and ``face`` the one through which it ``leaves``, if it does. A ray along it starts
    at ``o`` (scene), by ``before`` (cells) ahead of the chord, in direction ``d``.
    """

    along: mi.Vector3f
    length: mi.Float
    part: mi.Float
    leaves: mi.Bool
    face: mi.Vector3i
    o: mi.Point3f
    d: mi.Vector3f
    before: mi.Float


class Bend:
    """How much the geodesic in frame direction ``v`` bends at most, along all of its length.

    ``across`` bounds the acceleration of the point across its direction:
    the acceleration is k (−w b, w a, a b) in frame components, and across the direction its length
    is |k| c √(w² + a² b²) ≤ |k| c √(w² + c⁴/4). ``longest``: beyond 1/k a chord is no parabola.
    """

    def __init__(self, v: mi.Vector3f, twist: mi.Float):
        k = dr.maximum(dr.abs(twist), 1e-9)
        c2 = dr.fma(v.x, v.x, v.y * v.y)
        across = k * dr.sqrt(c2 * dr.fma(0.25 * c2, c2, dr.square(v.z)))
        self.across = dr.maximum(across, 1e-9)
        self.longest = dr.rcp(k)


class Chords:
    """Lengths (cells) of chords whose sagitta keeps within ``part`` of the cone at their middle.

    The sagitta is at most h² g/8 with g = ``bend.across``, and h² g/8 = width + spread (t + h/2)
    is solved for h, the cone being as wide at its start as elsewhere at the distance ``start``.
    None is shorter than ``least``.
    """

    def __init__(self, bend: Bend, cone: Cone, part: mi.Float, start: mi.Float, least: mi.Float):
        self.spread = part * cone.spread
        self.width = dr.fma(self.spread, start, part * cone.width)
        self.across, self.least, self.longest = bend.across, least, bend.longest
        self.scale = 2 * dr.rcp(bend.across)

    def room(self, t: mi.Float) -> mi.Float:
        """The sagitta that is allowed at arc length ``t``."""
        return dr.fma(self.spread, t, self.width)

    def after(self, t: mi.Float) -> mi.Float:
        """The chord that starts at arc length ``t``."""
        root = self._root(self.room(t))
        return dr.clip(self.scale * (self.spread + root), self.least, self.longest)

    def between(self, t: mi.Float, remaining: mi.Float) -> mi.Float:
        """The chord that starts at ``t`` if the cone narrows again towards ``remaining``.

        Twice as fast as it grew: what is close to a light hides no more of it for being close.
        """
        room = self.room(2 * remaining)
        towards = 4 * room / dr.maximum(self._root(room) + self.spread, 1e-20)
        return dr.maximum(dr.minimum(self.after(t), towards), self.least)

    def _root(self, room: mi.Float) -> mi.Float:
        return dr.sqrt(dr.fma(2 * self.across, room, dr.square(self.spread)))


class Tracer:
    """Follows geodesics through a scene, in plain Nil or in the quotient."""

    def __init__(
        self, scene: mi.Scene, space: Space, max_distance: float, shapes: Shapes | None = None
    ):
        self.scene = scene
        self.space = space
        self.max_distance = dr.opaque(mi.Float, max_distance)
        # Shorter chords, and hits that lie closer to the geodesic, are lost in float32's rounding:
        # of the position (slack is 16 roundings of it), and of the formulas that flow along the
        # geodesic, 4e-6 of whose length of 10 cells they are off.
        self.least = opaque(dr.maximum(1e-4, 16 * space.slack))
        self.exact = opaque(dr.maximum(4e-6, 0.25 * space.slack))
        shapes = shapes or Shapes(scene)
        self.triangles = Triangles(shapes)
        if space.quotient:  # no ray leaves the cube
            return
        self.occupied = Occupied((extent.box for extent in shapes.extents), space)

    # ------------------------------------------------------------------ lengths

    def reach(self, p: mi.Point3f, v: mi.Vector3f, limit: mi.Float | None = None) -> mi.Float:
        """Arc length (cells) past which the geodesic cannot meet the scene's box any more.

        At most ``limit``, which is ``max_distance`` if it is None.

        With B and H the horizontal and symmetric-vertical extent of the box seen from p, a point
        inside has |Z~| ≤ H and horizontal distance ≤ B, while |Z~| ≥ (|w| + c²/2|w|) t − c B/2|w|
        along the geodesic; hence t ≤ (2 |w| H + c B)/(1 + w²).
        """
        if limit is None:
            limit = self.max_distance
        if self.space.quotient:
            return limit
        far = dr.maximum(dr.abs(self.occupied.lower - p), dr.abs(self.occupied.upper - p))
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
        stretch: mi.Float,
        vertex: mi.Point3f,
        base: mi.Point3f,
        direction: mi.Vector3f,
        t: mi.Float,
        reach: mi.Float,
        active: mi.Bool,
    ):
        """Pass what is empty before the scene's boxes, if ``vertex`` (at arc length t) is outside.

        Returns the vertex, the geodesic's point and direction there and their arc length (cells),
        which is ``reach`` where the geodesic does not come (back) to a box before.
        """
        leaping = active & self.occupied.excludes(vertex)
        if leaping:  # a branch: most rays are inside
            passage = Passage(p, v, self.space.twist)
            start = mi.Float(t)
            while leaping:
                free = self.occupied.clearance(base, direction, passage)
                leaping &= free > stretch * chords.after(t)
                t = dr.select(leaping, dr.minimum(t + free, reach), t)
                leaping &= t < reach
                point, arrival = geometry.flow(p, v, t, self.space.twist)
                base = dr.select(leaping, point, base)
                direction = dr.select(leaping, arrival, direction)
            # As lifted as after a chord
            lift = self._lift(stretch * chords.after(t))
            lifted = dr.fma(lift, self.acceleration(base, direction), base)
            vertex = dr.select(t > start, lifted, vertex)
        return vertex, base, direction, t

    def _lift(self, h):
        """How far a chord's end is moved by the acceleration there, for chords of length ``h``.

        The corners lie outside the curve by 2/3 of the sagitta: the mean error is zero.
        """
        return -(2 / 3) * 0.125 * dr.square(h)

    def acceleration(self, p: mi.Point3f, v: mi.Vector3f) -> mi.Vector3f:
        """Second derivative of the geodesic's coordinates: k (−w b, w a, a b + k x w a)."""
        k = self.space.twist
        turn = k * v.z
        y = turn * v.x
        return mi.Vector3f(-turn * v.y, y, dr.fma(k * p.x, y, k * v.x * v.y))

    def piece(
        self, vertex: mi.Point3f, end: mi.Point3f, direction: mi.Vector3f, t0: mi.Float
    ) -> Piece:
        """What of the chord from ``vertex`` (at arc length t0) to ``end`` lies in this cell.

        ``direction`` is taken for that of a chord without length.
        """
        along = mi.Vector3f(end - vertex)
        s_last, leaves, face = mi.Float(1), mi.Bool(False), mi.Vector3i(0)
        if self.space.quotient:
            s_last, face = exit_through_face(vertex, along, self.space)
            leaves = s_last < 1
            s_last = dr.minimum(s_last, 1)
        speed2 = dr.squared_norm(along)
        inv_speed = dr.rsqrt(speed2)
        speed = speed2 * inv_speed
        speed = dr.select(speed2 > 0, speed, 0)
        d = dr.select(speed2 > 0, along * inv_speed, direction)
        # Pieces overlap by the rounding of their joint, but none reaches behind the start.
        before = dr.select(t0 > 0, self.space.slack, 0)
        o = self.space.to_scene(vertex - before * d)
        return Piece(along, speed, s_last, leaves, face, o, d, before)

    # ------------------------------------------------------------------ tracing

    @dr.syntax
    def intersect(
        self,
        p: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float = 0,
    ) -> Hit:
        """First hit of the geodesic from ``p`` (cells) in frame direction ``v`` within ``reach``.

        In the quotient ``p`` lies in the unit cube. A hit lies off the geodesic by at most 1e-5
        cells or 1/250 of the cone, whichever is more; by the chord's own error, which keeps within
        the cone, where the geodesic itself only just misses what its chord meets.
        """
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient
        turn = k * v.z
        bend = Bend(v, k)
        chords = Chords(
            bend,
            cone,
            dr.select(cone.soft, SOFT_SAGITTA, SAGITTA),
            dr.select(cone.soft, 0, START),
            self.least,
        )
        # Where chords join differs from ray to ray: edges are off by noise, not by steps.
        stretch = dr.select(cone.soft, 1, dr.fma(2 / 3, random_of(p, v), 2 / 3))

        # The chord in work runs from ``vertex`` (at arc length t0, on the last chord) to ``end``;
        # ``base`` is the geodesic's point at t1, where it has ``direction``. ``cap`` shortens
        # chords after a failed refinement.
        t0, t1 = mi.Float(0), mi.Float(0)
        base, direction = mi.Point3f(p), mi.Vector3f(v)
        vertex, end = mi.Point3f(p), mi.Point3f(p)
        # ``scale`` is the longer of this chord and the last: both ends may be off by its sagitta.
        length, scale = mi.Float(0), mi.Float(0)
        cap = mi.Float(dr.inf)
        redo = mi.Bool(False)
        cell = mi.Vector3i(0)

        valid = mi.Bool(False)
        distance = mi.Float(dr.inf)
        o, d = mi.Point3f(0), mi.Vector3f(0)
        found = dr.zeros(mi.PreliminaryIntersection3f)
        active = active & (reach > 0)

        while active:
            # -------------- Along chords, until one meets something --------------
            searching = mi.Bool(active)
            while searching:
                fresh = redo | (t0 >= t1)
                if not quotient:
                    vertex, base, direction, t0 = self._approach(
                        p,
                        v,
                        chords,
                        stretch,
                        vertex,
                        base,
                        direction,
                        t0,
                        reach,
                        searching & fresh & ~redo,
                    )
                    t1 = dr.select(redo, t1, t0)
                # At least a few roundings of the length, so that every chord moves on
                h = dr.minimum(stretch * chords.after(t0), dr.minimum(cap, bend.longest))
                h = dr.maximum(h, 2**-21 * t0)
                # A second look starts on the geodesic itself: a step sideways leads there.
                h = dr.select(redo, 0, dr.minimum(h, reach - t0))
                ahead = dr.select(fresh, t0 + h - t1, 0)
                base, direction = geometry.short_flow(base, v, t1, ahead, k)
                t1 = dr.select(fresh, t0 + h, t1)
                end = dr.select(
                    fresh, dr.fma(self._lift(h), self.acceleration(base, direction), base), end
                )
                scale = dr.select(fresh, dr.maximum(h, length), scale)
                length = dr.select(fresh, h, length)
                cap = dr.select(fresh & ~redo, 2 * cap, cap)
                redo = mi.Bool(False)

                piece = self.piece(vertex, end, direction, t0)
                last = dr.fma(piece.part, piece.length, piece.before + space.slack)
                ray = line_ray(piece.o, piece.d, time, last * space.size)
                found = scene.ray_intersect_preliminary(
                    ray, coherent=False, active=searching & (t0 < reach)
                )
                there = found.is_valid()
                through = ~there & piece.leaves
                # Where something was met, the chord stays as it is
                t0 = dr.select(there, t0, dr.select(through, dr.fma(piece.part, t1 - t0, t0), t1))
                vertex = dr.select(
                    there, vertex, dr.select(through, dr.fma(piece.along, piece.part, vertex), end)
                )
                if quotient:
                    face = dr.select(through, piece.face, 0)
                    vertex, (end, base), cell = through_face(vertex, [end, base], cell, face, space)
                searching &= ~there & (t0 < reach)

            there = active & found.is_valid()
            piece = self.piece(vertex, end, direction, t0)
            o, d = mi.Point3f(piece.o), mi.Vector3f(piece.d)
            s = (found.t / space.size - piece.before) / dr.maximum(piece.length, 1e-20)
            distance = dr.select(there, dr.fma(dr.clip(s, 0, 1), t1 - t0, t0), distance)

            # ------------- On the geodesic's tangent, where a chord did -------------
            # A step sideways has no sagitta, but its start was off the geodesic.
            sideways = length == 0
            error = dr.select(sideways, dr.inf, bend.across * 0.125 * dr.square(scale))
            # A 250th of what may be seen: two steps of the tangent reach it, one seldom does
            goal = dr.fma(0.004, dr.fma(cone.spread, distance, cone.width), self.exact)
            # A chord that cannot be cut any more is taken as it is.
            looking = there & ~cone.soft & (error > goal) & (sideways | (scale > self.least))
            # What a step sideways has met stays where the tangent there finds nothing better.
            valid = there & (~looking | sideways)
            at = mi.Float(distance)
            # A chord's ends are off by its sagitta at most, which is far less than a quarter of
            # its length; a step sideways comes after a chord of eight caps.
            window = dr.select(sideways, 2 * cap, 0.25 * scale)
            side = mi.Float(0)
            if looking:
                # Newton's step from the chord's hit to the surface's tangent plane there
                ray = line_ray(o, d, time)
                met = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, looking)
                side = dr.sign(dr.dot(met.n, d))
                point, tangent = geometry.flow(base, direction, at - t1, k)
                rate = dr.dot(met.n, geometry.from_frame(point, tangent, k))
                newton = dr.dot(met.n, space.to_cells(met.p) - point) / rate
                at += dr.select(dr.abs(newton) < 0.5 * window, newton, 0)
            while looking:
                point, tangent = geometry.flow(base, direction, at - t1, k)
                along = geometry.from_frame(point, tangent, k)
                s_first, s_last = -dr.minimum(window, at), dr.minimum(window, reach - at)
                if quotient:
                    s_first = dr.maximum(s_first, -exit_through_face(point, -along, space)[0])
                    s_last = dr.minimum(s_last, exit_through_face(point, along, space)[0])
                speed = dr.norm(along)
                line = along / speed
                # Nothing before the ray's own start, which may be close by its surface
                before = dr.minimum(space.slack, (at + s_first) * speed)
                start = space.to_scene(dr.fma(along, s_first, point) - before * line)
                ray = line_ray(
                    start,
                    line,
                    time,
                    dr.fma(s_last - s_first, speed, before + space.slack) * space.size,
                )
                pi = scene.ray_intersect_preliminary(ray, coherent=False, active=looking)
                # A tangent that meets a surface from the other side than the chord did has found
                # where the geodesic comes back, or what lies behind its start.
                met = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, pi.is_valid())
                looking &= pi.is_valid() & (dr.sign(dr.dot(met.n, line)) == side)
                s = s_first + (pi.t / space.size - before) / speed
                at = dr.select(looking, at + s, at)
                error = 0.5 * bend.across * dr.square(s)
                good = looking & (error <= goal)
                # The error falls by its square: what is 256 of the last one away is something else
                window = dr.minimum(0.5 * window, 256 * error)
                valid |= good
                distance = dr.select(good, at, distance)
                o, d, found = (
                    dr.select(good, start, o),
                    dr.select(good, line, d),
                    dr.select(good, pi, found),
                )
                looking &= ~good

            redo = there & ~valid
            # A chord of an eighth has a 64th of the sagitta
            cap = dr.select(redo, 0.125 * scale, cap)
            active = mi.Bool(redo)

        arrival = geometry.turned(v, turn * dr.select(valid, distance, 0))
        found.valid = valid
        return Hit(
            valid,
            dr.select(valid, distance, dr.inf),
            arrival,
            cell,
            line_ray(o, d, time),
            found,
            self.triangles.at(found),
        )

    @dr.syntax
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
        """Whether anything stands in the way of the geodesic from ``p`` within ``reach`` (cells).

        The first chord begins at ``start``: off the surface on which ``p`` lies, while the last one
        ends where the geodesic does. In the quotient ``start`` lies in the unit cube.
        """
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient
        vertex, end, base = mi.Point3f(start), mi.Point3f(p), mi.Point3f(p)
        direction = mi.Vector3f(v)
        t0, t1 = mi.Float(0), mi.Float(0)
        bend = Bend(v, k)
        chords = Chords(bend, cone, SHADOW_SAGITTA, 0, self.least)
        blocked = mi.Bool(False)
        active = active & (reach > 0)

        while active:
            fresh = t0 >= t1
            if not quotient:
                vertex, base, direction, t0 = self._approach(
                    p, v, chords, mi.Float(1), vertex, base, direction, t0, reach, active & fresh
                )
                t1 = mi.Float(t0)
            h = dr.maximum(chords.between(t0, reach - t0), 2**-21 * t0)
            last = h >= reach - t0
            h = dr.select(fresh, dr.minimum(h, reach - t0), 0)
            base, direction = geometry.short_flow(base, v, t1, h, k)
            t1 += h
            # Corners off the curve: secants would meet what is on its inner side, and only that.
            # Two chords whose ends stay on it are right on average with 4/3 of the sagitta. Near
            # the light they keep to the curve, not to reach behind it.
            lift = dr.minimum(
                (4 / 3) * 0.125 * dr.square(h), 0.2 * chords.room(reach - t1) / bend.across
            )
            corner = dr.fma(dr.select(last, 0, -lift), self.acceleration(base, direction), base)
            end = dr.select(fresh, corner, end)

            piece = self.piece(vertex, end, direction, t0)
            after = dr.select(piece.leaves | ~last, space.slack, 0)
            ray = line_ray(
                piece.o,
                piece.d,
                time,
                space.size * dr.fma(piece.part, piece.length, piece.before + after),
            )
            hit = scene.ray_test(ray, coherent=False, active=active & (t0 < reach))

            blocked |= hit
            t0 = dr.select(piece.leaves, dr.fma(piece.part, t1 - t0, t0), t1)
            vertex = dr.select(piece.leaves, dr.fma(piece.along, piece.part, vertex), end)
            if quotient:
                face = dr.select(piece.leaves, piece.face, 0)
                vertex, (end, base), _ = through_face(
                    vertex, [end, base], mi.Vector3i(0), face, space
                )
            active &= ~hit & (t0 < reach)
        return blocked
