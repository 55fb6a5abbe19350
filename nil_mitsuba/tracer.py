"""Geodesic rays against Mitsuba's scene of straight-ray intersections.

A ray is followed along its geodesic by chords short enough for the error that the viewer
tolerates. A chord that hits tells where to look; the hit itself is found on a short piece of the
geodesic's tangent line there (Newton's method with Embree as the surface), so that hits lie on the
geodesic and Mitsuba supplies uv, primitive and curvature for every kind of shape. Where the
tangent misses what the chord hit (silhouettes, contacts, grazing rays), the chord is cut and tried
again. Everything in this file is in cell coordinates unless it says "scene".
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import geometry
from .quotient import Space, exit_through_face, opaque, through_face

# Chords keep within this part of the cone. What a chord has missed cannot be found again, while
# what it has met by mistake can, so the error is one-sided: a tenth keeps an image's mean.
SAGITTA = 0.1


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


class Hit:
    """The first surface along a geodesic.

    ``distance`` (cells) is arc length, ``arrival`` the frame direction there, ``cell`` the deck
    element of the copy that was hit, ``ray`` (scene) and ``preliminary`` what Mitsuba needs to
    compute its surface interaction.
    """

    DRJIT_STRUCT = {
        "valid": mi.Bool,
        "distance": mi.Float,
        "arrival": mi.Vector3f,
        "cell": mi.Vector3i,
        "ray": mi.Ray3f,
        "preliminary": mi.PreliminaryIntersection3f,
    }

    def __init__(self, valid=None, distance=None, arrival=None, cell=None, ray=None,
                 preliminary=None):
        self.valid = valid
        self.distance = distance
        self.arrival = arrival
        self.cell = cell
        self.ray = ray
        self.preliminary = preliminary


def turned(v: mi.Vector3f, angle: mi.Float) -> mi.Vector3f:
    """A frame direction after its geodesic has turned by ``angle`` = k w t."""
    s, c = dr.sincos(angle)
    return mi.Vector3f(dr.fma(v.x, c, -v.y * s), dr.fma(v.y, c, v.x * s), v.z)


def hash_to_unit(p: mi.Point3f, v: mi.Vector3f) -> mi.Float:
    """A number in [0, 1) from a ray's bits, the same on every machine."""
    bits = [dr.reinterpret_array(mi.UInt32, x) for x in (v.x, v.y, p.x)]
    mixed = (bits[0] * 0x9E3779B1) ^ (bits[1] * 0x85EBCA77) ^ (bits[2] * 0xC2B2AE3D)
    mixed = (mixed ^ (mixed >> 15)) * 0x2C1B3C6D
    mixed = (mixed ^ (mixed >> 12)) * 0x297A2D39
    return mi.Float(mixed >> 9) * 2**-23


class Tracer:
    """Follows geodesics through a scene, in plain Nil or in the quotient."""

    def __init__(self, scene: mi.Scene, space: Space, max_distance: float):
        self.scene = scene
        self.space = space
        self.max_distance = dr.opaque(mi.Float, max_distance)
        box = scene.bbox()
        if not box.valid():  # a scene of environment emitters only
            box = mi.ScalarBoundingBox3f([0, 0, 0], [0, 0, 0])
        self.lower = space.to_cells(opaque(mi.Point3f(box.min)))
        self.upper = space.to_cells(opaque(mi.Point3f(box.max)))

    # ------------------------------------------------------------------ lengths

    def reach(self, p: mi.Point3f, v: mi.Vector3f, spent: mi.Float = 0) -> mi.Float:
        """Arc length (cells) past which the geodesic cannot meet the scene's box any more.

        At most ``max_distance``, less what is ``spent`` of it.

        With B and H the horizontal and symmetric-vertical extent of the box seen from p, a point
        inside has |Z~| ≤ H and horizontal distance ≤ B, while |Z~| ≥ (|w| + c²/2|w|) t − c B/2|w|
        along the geodesic; hence t ≤ (2 |w| H + c B)/(1 + w²).
        """
        if self.space.quotient:
            return self.max_distance - spent
        far = dr.maximum(dr.abs(self.lower - p), dr.abs(self.upper - p))
        k = dr.abs(self.space.twist)
        c = dr.hypot(v.x, v.y)
        w = dr.abs(v.z)
        height = far.z + k * far.y * (dr.abs(p.x) + 0.5 * far.x)
        bound = (2 * w * height + c * dr.hypot(far.x, far.y)) / (1 + w * w)
        # one part in a thousand and a little more against rounding
        return dr.minimum(1.001 * bound + 1e-3, self.max_distance - spent)

    def outside(self, p: mi.Point3f, v: mi.Vector3f) -> mi.Float:
        """Arc length (cells) that certainly does not meet the scene's box; 0 inside it."""
        k = dr.abs(self.space.twist)
        gap = dr.maximum(dr.maximum(self.lower - p, p - self.upper), 0)
        c = dr.hypot(v.x, v.y)
        # |dz/dt| = |w + k x b| ≤ |w| + k (|x| + c t) c bounds the height gained
        rise = dr.fma(k * dr.abs(p.x), c, dr.abs(v.z))
        root = dr.sqrt(dr.fma(rise, rise, 2 * k * c * c * gap.z))
        climb = 2 * gap.z / dr.maximum(rise + root, 1e-20)
        return dr.maximum(climb, dr.maximum(gap.x, gap.y) / dr.maximum(c, 1e-20))

    def acceleration(self, p: mi.Point3f, v: mi.Vector3f) -> mi.Vector3f:
        """Second derivative of the geodesic's coordinates: k (−w b, w a, a b + k x w a)."""
        k = self.space.twist
        turn = k * v.z
        y = turn * v.x
        return mi.Vector3f(-turn * v.y, y, dr.fma(k * p.x, y, k * v.x * v.y))

    def chord_length(self, v: mi.Vector3f, t: mi.Float, cone: Cone,
                     remaining: mi.Float | None = None) -> mi.Float:
        """Chord from arc length t on whose sagitta keeps within the cone at its middle.

        The geodesic's acceleration is k (−w b, w a, a b) in frame components; across the
        direction its length is |k| c √(w² + a² b²) ≤ g = |k| c √(w² + c⁴/4), so the sagitta is
        at most h² g/8, and h² g/8 = width + spread (t + h/2) is solved for h. Where the length
        that ``remaining`` is given, the cone narrows towards that end as well.
        """
        k = dr.abs(self.space.twist)
        c2 = dr.fma(v.x, v.x, v.y * v.y)
        g = dr.maximum(k * dr.sqrt(c2 * dr.fma(0.25 * c2, c2, v.z * v.z)), 1e-9)
        spread = SAGITTA * cone.spread
        square = dr.fma(spread, spread, 2 * g * SAGITTA * dr.fma(cone.spread, t, cone.width))
        h = 2 * (spread + dr.sqrt(square)) / g
        if remaining is not None:
            room = SAGITTA * dr.fma(cone.spread, remaining, cone.width)
            root = dr.sqrt(dr.fma(spread, spread, 2 * g * room))
            h = dr.minimum(h, 4 * room / dr.maximum(root + spread, 1e-20))
        # Along more than 1/k the chord is no parabola any more; below 1e-4 cells its sagitta is
        # lost in float32's rounding.
        return dr.clip(h, 1e-4, dr.rcp(dr.maximum(k, 1e-9)))

    # ------------------------------------------------------------------ tracing

    @dr.syntax
    def intersect(self, p: mi.Point3f, v: mi.Vector3f, cone: Cone, reach: mi.Float,
                  active: mi.Bool, time: mi.Float = 0) -> Hit:
        """First hit of the geodesic from ``p`` (cells) in frame direction ``v`` within ``reach``.

        In the quotient ``p`` lies in the unit cube. The result's distance errs across the
        geodesic by at most 1e-5 cells or 1/250 of the cone, whichever is more.
        """
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient

        # The chord in work runs from ``vertex`` (at arc length t0, on the last chord) to ``end``
        # (at t1, on the geodesic); ``cap`` shortens chords after a failed refinement.
        vertex, end, base = mi.Point3f(p), mi.Point3f(p), mi.Point3f(p)
        t0, t1 = mi.Float(0), mi.Float(0)
        # ``scale`` is the longer of this chord and the last: both ends may be off by its sagitta.
        length, scale = mi.Float(0), mi.Float(0)
        cap = mi.Float(dr.inf)
        redo = mi.Bool(False)
        # Refinement: the tangent at arc length ``at`` is searched over ± ``window``.
        refining = mi.Bool(False)
        at, window = mi.Float(0), mi.Float(0)
        side = mi.Float(0)
        cell = mi.Vector3i(0)

        valid = mi.Bool(False)
        distance = mi.Float(dr.inf)
        ray_found = dr.zeros(mi.Ray3f)
        found = dr.zeros(mi.PreliminaryIntersection3f)
        active = active & (reach > 0)
        # Where chords join differs from ray to ray, which turns their error into noise.
        stretch = dr.fma(2 / 3, hash_to_unit(p, v), 2 / 3)

        while active:
            # ------------------------ The next piece ------------------------
            v1 = turned(v, k * v.z * t1)
            fresh = ~refining & (redo | (t0 >= t1))
            h = dr.minimum(stretch * self.chord_length(v1, t0, cone), cap)
            empty = mi.Bool(False)
            wanted = mi.Float(h)
            if not quotient:
                skip = self.outside(vertex, v1)
                empty = ~redo & (skip > h)
                h = dr.maximum(h, skip)
            # A second look starts on the geodesic itself: a step sideways leads there.
            h = dr.select(redo, 0, dr.minimum(h, reach - t0))
            target = dr.select(refining, at, dr.select(fresh, t0 + h, t1))
            point, tangent = geometry.flow(base, v1, target - t1, k)

            base = dr.select(fresh, point, base)
            t1 = dr.select(fresh, target, t1)
            # The corners lie outside the curve by 2/3 of the sagitta: the mean error is zero.
            lift = -(2 / 3) * 0.125 * dr.square(dr.select(empty, wanted, h))
            end = dr.select(fresh, dr.fma(lift, self.acceleration(point, tangent), point), end)
            scale = dr.select(fresh, dr.maximum(h, length), scale)
            length = dr.select(fresh, h, length)
            cap = dr.select(fresh & ~redo, 2 * cap, cap)
            empty &= fresh

            # Chord: vertex + s (end − vertex); tangent: point + s tangent
            along = mi.Vector3f(end - vertex)
            s_first, s_last = mi.Float(0), mi.Float(1)
            velocity = geometry.from_frame(point, tangent, k)
            along = dr.select(refining, velocity, along)
            start = dr.select(refining, point, vertex)
            s_first = dr.select(refining, -dr.minimum(window, at), s_first)
            s_last = dr.select(refining, dr.minimum(window, reach - at), s_last)
            leaves = mi.Bool(False)
            face = mi.Vector3i(0)
            if quotient:
                s_face, face = exit_through_face(start, along)
                s_back, _ = exit_through_face(start, -along)
                leaves = ~refining & (s_face < s_last)
                s_last = dr.minimum(s_last, s_face)
                s_first = dr.maximum(s_first, dr.select(refining, -s_back, 0))

            speed = dr.norm(along)
            d = dr.select(speed > 0, along / speed, v1)
            # Pieces overlap by the rounding of their joint, but none reaches behind the start.
            before = dr.select(t0 > 0, space.slack, 0)
            o = space.to_scene(dr.fma(along, s_first, start) - before * d)
            span = (s_last - s_first) * speed + before + space.slack
            ray = dr.zeros(mi.Ray3f)
            ray.o, ray.d, ray.maxt, ray.time = o, d, span * space.size, time
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active & ~empty)

            # --------------------------- What it met ---------------------------
            # A tangent that meets a surface from the other side than the chord did has found where
            # the geodesic comes back, or what lies behind its start.
            met = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, pi.valid & ~cone.soft)
            facing = dr.sign(dr.dot(met.n, d))
            there = pi.valid & (~refining | (facing == side))
            side = dr.select(~refining & pi.valid, facing, side)
            s = s_first + (pi.t / space.size - before) / dr.maximum(speed, 1e-20)
            c = dr.hypot(v.x, v.y)
            bend = dr.abs(k) * c * dr.sqrt(dr.fma(dr.square(v1.x), dr.square(v1.y), v.z * v.z))
            t_hit = dr.select(refining, at + s, dr.fma(dr.clip(s, 0, 1), t1 - t0, t0))
            # A step sideways has no sagitta, but its start was off the geodesic.
            sideways = length == 0
            error = bend * dr.select(refining, 0.5 * dr.square(s), 0.125 * dr.square(scale))
            error = dr.select(sideways & ~refining, dr.inf, error)
            goal = dr.fma(0.004, dr.fma(cone.spread, t_hit, cone.width), 4e-6)
            accept = there & (cone.soft | (error <= goal))
            redo = refining & ~there
            look = there & ~accept
            window = dr.select(
                look,
                dr.select(refining, dr.minimum(0.5 * window, 256 * error),
                          dr.select(sideways, 2 * cap, 0.25 * scale)),
                window,
            )
            at = dr.select(look, t_hit, at)
            missed = ~refining & ~there
            cap = dr.select(redo, 0.125 * scale, cap)

            # What a step sideways has met stays where the tangent there finds nothing better.
            keep = accept | (look & sideways & ~refining)
            distance = dr.select(keep, t_hit, distance)
            ray_found = dr.select(keep, ray, ray_found)
            found = dr.select(keep, pi, found)
            accept |= redo & sideways
            valid |= accept

            # ------------------------------ Go on ------------------------------
            crossing = dr.fma(along, s_last, vertex)
            through = missed & leaves
            t0 = dr.select(missed, dr.select(through, dr.fma(s_last, t1 - t0, t0), t1), t0)
            vertex = dr.select(missed, dr.select(through, crossing, end), vertex)
            if quotient:
                face = dr.select(through, face, 0)
                vertex, (end, base), cell = through_face(vertex, [end, base], cell, face, space)
            refining = look
            active &= ~accept & ~(missed & (t0 >= reach))

        return Hit(valid, distance, turned(v, k * v.z * distance), cell, ray_found, found)

    @dr.syntax
    def occluded(self, p: mi.Point3f, v: mi.Vector3f, cone: Cone, reach: mi.Float,
                 active: mi.Bool, time: mi.Float = 0) -> mi.Bool:
        """Whether anything stands in the way of the geodesic from ``p`` within ``reach`` (cells).

        The chords' corners stay on the geodesic: lifted ones, which are better on average, would
        reach into the wall that a light or its receiver is close to, and no light leaks in turn.
        """
        space, scene = self.space, self.scene
        k = space.twist
        quotient = space.quotient
        vertex, end = mi.Point3f(p), mi.Point3f(p)
        t0, t1 = mi.Float(0), mi.Float(0)
        blocked = mi.Bool(False)
        active = active & (reach > 0)
        stretch = dr.fma(2 / 3, hash_to_unit(p, v), 2 / 3)

        while active:
            v1 = turned(v, k * v.z * t1)
            fresh = t0 >= t1
            h = stretch * self.chord_length(v1, t0, cone, reach - t0)
            empty = mi.Bool(False)
            if not quotient:
                skip = self.outside(vertex, v1)
                empty = fresh & (skip > h)
                h = dr.maximum(h, skip)
            last = h >= reach - t0
            h = dr.select(fresh, dr.minimum(h, reach - t0), 0)
            end = mi.Point3f(geometry.flow(end, v1, h, k)[0])
            t1 += h

            along = mi.Vector3f(end - vertex)
            s_last = mi.Float(1)
            leaves = mi.Bool(False)
            face = mi.Vector3i(0)
            if quotient:
                s_last, face = exit_through_face(vertex, along)
                leaves = s_last < 1
                s_last = dr.minimum(s_last, 1)
            speed = dr.norm(along)
            d = dr.select(speed > 0, along / speed, v1)
            before = dr.select(t0 > 0, space.slack, 0)
            o = space.to_scene(vertex - before * d)
            after = dr.select(leaves | ~last, space.slack, 0)
            ray = dr.zeros(mi.Ray3f)
            ray.o, ray.d, ray.time = o, d, time
            ray.maxt = (s_last * speed + before + after) * space.size
            hit = scene.ray_test(ray, coherent=False, active=active & ~empty)

            blocked |= hit
            t0 = dr.select(leaves, dr.fma(s_last, t1 - t0, t0), t1)
            vertex = dr.select(leaves, dr.fma(along, s_last, vertex), end)
            if quotient:
                face = dr.select(leaves, face, 0)
                vertex, (end,), _ = through_face(vertex, [end], mi.Vector3i(0), face, space)
            active &= ~hit & (t0 < reach)
        return blocked
