"""Where methods fail: the first crossing of a plane x = c, y = c or z = c."""

import math

import drjit as dr
from drjit.llvm import PCG32, Array3f, Array3f64, Float, Float64

from .. import face_crossing, truth
from ..tracers import KNOBS


def first_crossing(p, v, axis, c, t_max, twist=1):
    """``face_crossing.first_crossing`` in a kernel of its own, one for all twists and planes."""
    value_t = dr.value_t(type(p))
    p, v, c = type(p)(p), type(v)(v), dr.zeros(value_t, dr.width(p)) + c
    dr.eval(p, v, c)
    t = face_crossing.first_crossing(
        p, v, axis, c, dr.opaque(value_t, t_max), dr.opaque(value_t, twist)
    )
    dr.eval(t)
    return t


def random_rays(count, low=-2.0, high=2.0, seed=1):
    """Starts in a cube, directions uniform, and a number in [0, 1), all as float32 holds them."""
    rng = PCG32(count, initstate=seed)
    p = Array3f(*(Float(low + (high - low) * rng.next_float64()) for _ in range(3)))
    w = 2 * rng.next_float64() - 1
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    r = dr.sqrt(1 - w * w)
    v = Array3f(Float(r * c), Float(r * s), Float(w))
    u = Float(rng.next_float64())
    dr.eval(p, v, u)
    return p, v, u


def tangent_rays(count, axis, twist, t_max, seed=2):
    """Rays that touch the plane they are given with, to 1e-2 … 1e-14 of it on either side."""
    rng = PCG32(count, initstate=seed)
    p, v, _ = random_rays(count, seed=seed + 1)
    p, v = Array3f64(p), Array3f64(v)
    # A frame direction without the coordinate component ``axis``
    v = Array3f64(
        0 if axis == 0 else v.x, 0 if axis == 1 else v.y, -twist * p.x * v.y if axis == 2 else v.z
    )
    v /= dr.norm(v)
    clearance = dr.copysign(dr.exp2(-7 - 40 * rng.next_float64()), rng.next_float64() - 0.5)
    c = p[axis] + clearance
    # Half of the way has to lie before the touch, half behind it
    p, v = truth.flow(p, v, -0.5 * t_max * rng.next_float64(), Float64(twist))
    dr.eval(p, v, c)
    return p, v, c


def beyond(t, nearer, farther, slack):
    """Whether t is not between the crossings of a nearer and a farther plane."""
    return ~((t >= nearer - slack) & (t <= farther + slack))


# Crossings are looked for up to this length, and a little further, so that none is lost at its end
LONGEST, FURTHER = 20.0, 20.05


def sign_change(name, p, v, axis, c, t_max):
    """First sign change of the coordinate between chords, and the secant's root."""
    from .. import tracing_methods

    steps = tracing_methods.METHODS[name](dr.opaque(Float, KNOBS[name]), dr.opaque(Float, 1))
    t_max = dr.opaque(Float, t_max)

    def step(t, state, before, found):
        state, h, good = steps.step(state, t_max - t)
        now = state["p"][axis] - c
        crossed = good & (before * now <= 0)
        found = dr.select(crossed, t + h * before / (before - now), found)
        return (
            dr.select(good, dr.select(h < t_max - t, t + h, t_max), t),
            state,
            dr.select(good, now, before),
            found,
        )

    state = (
        dr.zeros(Float, dr.width(p)),
        steps.start(p, v),
        p[axis] - c,
        dr.full(Float, math.inf, dr.width(p)),
    )
    return dr.while_loop(
        state, lambda t, state, before, found: (t < t_max) & (found == math.inf), step
    )[3]


def rays_off(found, exact, allowed=1e-3, longest=LONGEST):
    """Rays whose crossing is off, missed, or none in truth."""
    found = Float64(found)
    found = dr.select(dr.isfinite(found) & (found > 0), found, math.inf)
    judged = dr.minimum(found, exact) <= longest
    return dr.count(judged & ~(dr.abs(found - exact) <= allowed))[0]


def crossings_ahead(vector_t, axis, count=100_000):
    """Rays from the unit cell, the face ahead of each, and where it is crossed in truth."""
    p, v, _ = random_rays(count, 0, 1)
    p, v = vector_t(p), vector_t(v)
    face = dr.select(v[axis] > 0, dr.value_t(vector_t)(1), 0)
    exact = first_crossing(Array3f64(p), Array3f64(v), axis, Float64(face), FURTHER)
    return p, v, face, exact


def crossings_just_reached(count=100_000):
    """Rays, planes z = c that they cross twice within less than a step, touching them to 1e-2 …
    1e-5 cells (closer, rounding decides whether they do), and where they cross them first."""
    p, v, c = tangent_rays(count, 2, 1, 12.0)
    p, v, c = Array3f(p), Array3f(v), Float(c)
    exact, *moved = (
        first_crossing(Array3f64(p), Array3f64(v), 2, Float64(c) + shift, 12.0)
        for shift in (0, -1e-5, 1e-5)
    )
    sure = dr.compress(dr.abs(moved[1] - moved[0]) < 0.01)
    return [dr.gather(type(x), x, sure) for x in (p, v, c, exact)]
