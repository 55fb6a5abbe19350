"""Other ways to trace a geodesic of Nil, to be measured against the package's tracer.

All of them cut the geodesic into chords, search each chord for a surface with Embree, and carry
chords through the glued faces of the cube as the package does; they have its ``intersect`` and
``occluded``. They differ in how the next point of the geodesic is found and how far it is away.
They exist for the chart (``chart``) and the tables of failures (``failures``).
Points are in cells and directions in frame components. Set a Mitsuba variant before this module
is imported.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nil_mitsuba import geometry
from nil_mitsuba.quotient import exit_through_face, through_face
from nil_mitsuba.tracer import Hit, Tracer, line_ray

from . import report_formulas


class Euler:
    """Straight pieces of fixed length; explicit Euler on the geodesic equation.

    In frame components it is a' = −k w b, b' = k w a, w' = 0, with x' = a, y' = b and
    z' = w + k x b. So VISGRAF TR-19-06 draws its pictures.
    """

    def __init__(self, step, twist):
        self.h, self.twist = step, twist

    def start(self, p, v):
        """State of the method at the start of the geodesic: a dictionary with p and v."""
        return {"p": type(p)(p), "v": type(v)(v)}

    def step(self, state, room):
        """The next state, at most ``room`` (cells) further, the arc length, and if it is good."""
        h = dr.minimum(self.h, room)
        p, v = state["p"], state["v"]
        turn = h * self.twist * v.z
        p_next = dr.fma(h, type(p)(geometry.from_frame(p, v, self.twist)), p)
        v_next = type(v)(dr.fma(-turn, v.y, v.x), dr.fma(turn, v.x, v.y), v.z)
        return {"p": p_next, "v": v_next}, h, dr.mask_t(h)(True)

    def behind_face(self, state, crossed):
        """The state after its point was carried through a face of the cube."""
        return state

    def between(self, v0, v1, s, t):
        """Unit direction at the fraction ``s`` and arc length ``t`` of the step from v0 to v1."""
        return dr.normalize(v0)


def geodesic_acceleration(p, velocity, twist):
    """Second derivative −Γ(p)(velocity, velocity) of a geodesic, in coordinates.

    The Christoffel symbols of Nil that do not vanish are, up to symmetry, Γ^x_yy = −k² x,
    Γ^x_yz = k/2, Γ^y_xy = k² x/2, Γ^y_xz = −k/2, Γ^z_xy = (k³ x² − k)/2 and Γ^z_xz = −k² x/2.
    """
    turn = twist * dr.fma(-twist * p.x, velocity.y, velocity.z)
    y = turn * velocity.x
    return type(velocity)(
        -turn * velocity.y, y, dr.fma(twist * p.x, y, twist * velocity.x * velocity.y)
    )


class RungeKutta4(Euler):
    """Chords of fixed length; the classical Runge–Kutta method on x'' = −Γ(x', x')."""

    def step(self, state, room):
        k = self.twist
        h = dr.minimum(self.h, room)
        p, v = state["p"], state["v"]
        v1 = geometry.from_frame(p, v, k)
        a1 = geodesic_acceleration(p, v1, k)
        v2 = dr.fma(0.5 * h, a1, v1)
        a2 = geodesic_acceleration(dr.fma(0.5 * h, type(p)(v1), p), v2, k)
        v3 = dr.fma(0.5 * h, a2, v1)
        a3 = geodesic_acceleration(dr.fma(0.5 * h, type(p)(v2), p), v3, k)
        v4 = dr.fma(h, a3, v1)
        a4 = geodesic_acceleration(dr.fma(h, type(p)(v3), p), v4, k)
        p_next = dr.fma(h / 6, type(p)(v1 + 2 * (v2 + v3) + v4), p)
        velocity = dr.fma(h / 6, a1 + 2 * (a2 + a3) + a4, v1)
        v_next = geometry.to_frame(p_next, velocity, k)
        return {"p": p_next, "v": v_next}, h, dr.mask_t(h)(True)

    def between(self, v0, v1, s, t):
        return dr.normalize(dr.lerp(v0, v1, s))


# Dormand and Prince (1980): weights of the stages, of the solution of order 5, and of the
# difference to the one of order 4
STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
DIFFERENCE = (71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


class DormandPrince(RungeKutta4):
    """Steps and chords as long as a tolerance (cells) allows; the pair of Dormand and Prince.

    The tolerance bounds both the estimated error of a step and the sagitta of its chord, without
    which a pair of order 5 would cut every corner. ``chords=False`` leaves the second bound out,
    for end points alone.
    """

    def __init__(self, tolerance, twist, chords=True):
        self.tolerance, self.twist, self.chords = tolerance, twist, chords

    def start(self, p, v):
        return super().start(p, v) | {"h": dr.full(type(p.x), 0.1, dr.width(p, v))}

    def step(self, state, room):
        k, tolerance = self.twist, self.tolerance
        p, v = state["p"], state["v"]
        h = dr.minimum(state["h"], room)
        point_t = type(p)
        velocities, accelerations = [], []
        velocity = geometry.from_frame(p, v, k)
        for weights in STAGES:
            dp, dv = point_t(0), type(v)(0)
            for weight, stage_v, stage_a in zip(weights, velocities, accelerations):
                if weight:
                    dp = dr.fma(weight, point_t(stage_v), dp)
                    dv = dr.fma(weight, stage_a, dv)
            # The last stage is taken at the solution of order 5
            p_stage, v_stage = dr.fma(h, dp, p), dr.fma(h, dv, velocity)
            velocities.append(v_stage)
            accelerations.append(geodesic_acceleration(p_stage, v_stage, k))
        dp, dv = type(v)(0), type(v)(0)
        for weight, stage_v, stage_a in zip(DIFFERENCE, velocities, accelerations):
            if weight:
                dp, dv = dr.fma(weight, stage_v, dp), dr.fma(weight, stage_a, dv)
        error = h * dr.sqrt(dr.squared_norm(dp) + dr.squared_norm(dv))

        # The usual controller: nine tenths of what the fifth root asks for, within a factor of 5
        factor = 0.9 * dr.power(tolerance / dr.maximum(error, 1e-3 * tolerance), 1 / 5)
        wanted = h * dr.clip(factor, 0.2, 5)
        # Below a ten thousandth of a cell, rounding is all that is left to be seen
        good = (error <= tolerance) | (h <= 1e-4)
        if self.chords:
            bend = dr.norm(accelerations[-1])
            wanted = dr.minimum(wanted, dr.sqrt(8 * tolerance / dr.maximum(bend, 1e-6)))
            # The first step guesses, and what it guessed wrong is done again
            sagitta = 0.125 * dr.square(h) * dr.norm(accelerations[0])
            good &= (sagitta <= 2 * tolerance) | (h <= 1e-4)
        wanted = dr.clip(wanted, 1e-4, 1)
        stepped = {
            "p": dr.select(good, p_stage, p),
            "v": dr.select(good, geometry.to_frame(p_stage, v_stage, k), v),
            "h": dr.select(good & (h < state["h"]), state["h"], wanted),
        }
        return stepped, h, good


def fixed_steps(p, v, length, steps, twist):
    """End points after so many equal steps of the classical Runge–Kutta method."""
    float_t = type(p.x)
    method = RungeKutta4(dr.opaque(float_t, length / steps), dr.opaque(float_t, twist))
    steps = dr.opaque(dr.llvm.UInt32, steps)
    _, state = dr.while_loop(
        (dr.zeros(dr.llvm.UInt32, dr.width(p)), method.start(p, v)),
        lambda i, state: i < steps,
        lambda i, state: (i + 1, method.step(state, dr.inf)[0]),
    )
    return state["p"]


def adaptive_steps(p, v, length, tolerance, twist):
    """End points by the pair of Dormand and Prince, each ray with steps of its own."""
    float_t = type(p.x)
    method = DormandPrince(dr.opaque(float_t, tolerance), dr.opaque(float_t, twist), chords=False)
    length = dr.opaque(float_t, length)

    def step(t, state):
        state, h, good = method.step(state, length - t)
        return dr.select(good, dr.select(h < length - t, t + h, length), t), state

    _, state = dr.while_loop(
        (dr.zeros(float_t, dr.width(p)), method.start(p, v)), lambda t, state: t < length, step
    )
    return state["p"]


class ClosedForm(Euler):
    """Chords of fixed length; ``geometry.flow`` from where the ray started or entered the cell."""

    def start(self, p, v):
        return super().start(p, v) | {
            "base": type(p)(p),
            "v_base": type(v)(v),
            "t": dr.zeros(type(p.x), dr.width(p, v)),
        }

    def formula(self, p, v, t):
        return geometry.flow(p, v, t, self.twist)

    def step(self, state, room):
        h = dr.minimum(self.h, room)
        t = state["t"] + h
        p, v = self.formula(state["base"], state["v_base"], t)
        return state | {"p": p, "v": v, "t": t}, h, dr.mask_t(h)(True)

    def behind_face(self, state, crossed):
        return state | {
            "base": dr.select(crossed, state["p"], state["base"]),
            "v_base": dr.select(crossed, state["v"], state["v_base"]),
            "t": dr.select(crossed, 0, state["t"]),
        }

    def between(self, v0, v1, s, t):
        return geometry.turned(v0, self.twist * v0.z * t * s)


class PrintedForm(ClosedForm):
    """Chords of fixed length; the closed form in the report's form, which divides by w."""

    def formula(self, p, v, t):
        return report_formulas.geodesic(p, v, t, self.twist)


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


class ChordTracer(Tracer):
    """First hits and occlusion on the chords that ``method`` makes of a geodesic.

    ``knob`` is the length of its steps or its tolerance, in cells. What is hit is where the chord
    meets it; the cone that the viewer allows is not used.
    """

    def __init__(self, scene, space, max_distance, method, knob, shapes=None):
        super().__init__(scene, space, max_distance, shapes)
        self.method = method(dr.opaque(mi.Float, knob), space.twist)

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

    def intersect(self, p, v, cone, reach, active, time=0):
        """First hit of the geodesic from ``p`` in frame direction ``v`` within ``reach``."""
        return self._follow(p, v, p, reach, active, time, False)

    def occluded(self, p, start, v, cone, reach, active, time=0):
        """Whether anything stands in the way of the geodesic from ``p`` within ``reach``.

        The first chord begins at ``start``, off the surface on which ``p`` lies. Nothing is
        skipped, however ``far`` rays go.
        """
        return self._follow(p, v, start, reach, active, time, True).valid

    @dr.syntax
    def _follow(
        self,
        p: mi.Point3f,
        v: mi.Vector3f,
        start: mi.Point3f,
        reach: mi.Float,
        active: mi.Bool,
        time: mi.Float,
        any_hit: bool,
    ) -> Hit:
        scene, space, method = self.scene, self.space, self.method
        state = method.start(mi.Point3f(p), mi.Vector3f(v))
        # The chord in work runs from ``vertex`` (at arc length t0) to the state's point (at t1);
        # its step began in direction v0 and was h long.
        vertex, v0 = mi.Point3f(start), mi.Vector3f(v)
        t0, t1, h = mi.Float(0), mi.Float(0), mi.Float(0)
        cell = mi.Vector3i(0)
        valid = mi.Bool(False)
        distance, arrival = mi.Float(dr.inf), mi.Vector3f(v)
        ray_found = dr.zeros(mi.Ray3f)
        found = dr.zeros(mi.PreliminaryIntersection3f)
        active = mi.Bool(active) & (reach > 0)

        while active:
            # ------------------------ The next piece ------------------------
            fresh = t0 >= t1
            stepped, length, good = method.step(state, reach - t0)
            v0 = dr.select(fresh, state["v"], v0)
            h = dr.select(fresh, length, h)
            state = dr.select(fresh, stepped, state)
            good |= ~fresh
            # The end of the last step is the end, whatever was rounded
            last = length >= reach - t0
            t1 = dr.select(fresh & good, dr.select(last, reach, t0 + length), t1)

            piece = self.piece(vertex, state["p"], v0, t0)
            # No piece reaches past the end.
            after = dr.select(piece.leaves | (t1 < reach), space.slack, 0)
            ray = line_ray(
                piece.o,
                piece.d,
                time,
                space.size * (piece.part * piece.length + piece.before + after),
            )

            # --------------------------- What it met ---------------------------
            there = mi.Bool(False)
            if any_hit:
                there = scene.ray_test(ray, coherent=False, active=active & good)
            else:
                pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active & good)
                there = pi.valid
                s = (pi.t / space.size - piece.before) / dr.maximum(piece.length, 1e-20)
                s = dr.clip(s, 0, 1)
                t_hit = dr.fma(s, t1 - t0, t0)
                done = dr.select(h > 0, 1 - (t1 - t_hit) / h, 0)
                distance = dr.select(there, t_hit, distance)
                arrival = dr.select(there, method.between(v0, state["v"], done, h), arrival)
                ray_found = dr.select(there, ray, ray_found)
                found = dr.select(there, pi, found)
            valid |= there

            # ------------------------------ Go on ------------------------------
            leaves = piece.leaves & good & ~there
            s_leave = dr.fma(piece.part, t1 - t0, t0)
            t0 = dr.select(good, dr.select(leaves, s_leave, t1), t0)
            vertex = dr.select(
                good, dr.select(leaves, dr.fma(piece.along, piece.part, vertex), state["p"]), vertex
            )
            if space.quotient:
                face = dr.select(leaves, piece.face, 0)
                vertex, (moved,), cell = through_face(vertex, [state["p"]], cell, face, space)
                state = method.behind_face(state | {"p": moved}, leaves)
            active &= ~there & (t0 < reach)

        return Hit(
            valid=valid,
            distance=distance,
            arrival=arrival,
            cell=cell,
            ray=ray_found,
            preliminary=found,
            triangle=self.triangles.at(found),
        )


METHODS = {
    "Euler pieces": Euler,
    "Runge–Kutta 4": RungeKutta4,
    "Dormand–Prince": DormandPrince,
    "printed form": PrintedForm,
    "stable form": ClosedForm,
}
