"""Where methods fail along a single geodesic: its end, the way back, and connections."""

import math

import drjit as dr
from drjit.llvm import PCG32, Array3f, Array3f64, Array3i, Float, Float64, Int32, UInt32

from nil_mitsuba import geometry

from .. import report_formulas, truth


def random_rays(count, w=None, seed=1):
    """Starts in the unit cell and directions, as float32 holds them; w: the fibre component."""
    rng = PCG32(count, initstate=seed)
    p = Array3f(*(Float(rng.next_float64()) for _ in range(3)))
    w = 2 * rng.next_float64() - 1 if w is None else Float64(w)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    r = dr.sqrt((1 - w) * (1 + w))
    v = Array3f(Float(r * c), Float(r * s), Float(w))
    dr.eval(p, v)
    return p, v


def distance(p, q, twist):
    """Length of the short step from p to q, in the frame."""
    d = truth.multiply_inverse(Array3f64(p), Array3f64(q), Float64(twist))
    return dr.norm(Array3f64(d.x, d.y, d.z - 0.5 * twist * d.x * d.y))


def errors_of_a_way(method, p, v, t, twist):
    """Distance of each ray's end point from the true one; infinite where it is not a number."""
    true, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    error = distance(true, method(p, v, Float(t)), twist)
    return dr.select(dr.isfinite(error), error, math.inf)


# ---------------------------------------------------------------------------
#  Methods
# ---------------------------------------------------------------------------

RK4_STEP, TOLERANCE = 0.05, 1e-6


def runge_kutta(p, v, t, twist):
    from .. import tracing_methods

    return tracing_methods.fixed_steps(p, v, t, math.ceil(t / RK4_STEP), twist)


def dormand_prince(p, v, t, twist):
    from .. import tracing_methods

    return tracing_methods.adaptive_steps(p, v, t, TOLERANCE, twist)


def report(p, v, t, twist):
    return report_formulas.geodesic(p, v, dr.opaque(Float, t), dr.opaque(Float, twist))[0]


def package(p, v, t, twist):
    return geometry.flow(p, v, dr.opaque(Float, t), dr.opaque(Float, twist))[0]


def end_point_errors(method, p, v, t, twist=1):
    return errors_of_a_way(lambda p, v, _: method(p, v, t, twist), p, v, t, twist)


# ---------------------------------------------------------------------------
#  Long ways
# ---------------------------------------------------------------------------

LENGTHS = (1, 5, 20, 100, 500)
STEP = 0.5


@dr.syntax
def walk(p, v, steps: UInt32, length: Float, twist: Float, chained: bool):
    """``steps`` flows of equal length in float32, wrapped into the unit cell after each.

    Each flow starts in the direction of the start, turned by all of the way, as the tracer does;
    or, ``chained``, in the direction that the last one ended in.
    """
    direction, cell = Array3f(v), Array3i(0)
    n = UInt32(0)
    while n < steps:
        p, ended = geometry.flow(p, direction, length, twist)
        p, step = geometry.wrap(p, twist)
        cell = geometry.multiply(cell, step, Int32(twist))
        n += 1
        turned = geometry.turned(v, twist * v.z * length * Float(n))
        direction = ended if chained else turned
    return p, direction, cell


def walked(p, v, t, twist, chained=False):
    end = walk(
        p,
        v,
        dr.opaque(UInt32, round(t / STEP)),
        dr.opaque(Float, STEP),
        dr.opaque(Float, twist),
        chained,
    )
    dr.eval(end)
    return end


def stepped(name, knob):
    """A walk like ``walked`` by a method of ``tracing_methods``, wrapped after each step."""
    from ..tracing_methods import METHODS

    def walked(p, v, t, twist):
        steps = METHODS[name](dr.opaque(Float, knob), dr.opaque(Float, twist))
        length, k = dr.opaque(Float, t), dr.opaque(Int32, twist)

        def step(s, state, cell):
            state, h, good = steps.step(state, length - s)
            p, moved = geometry.wrap(state["p"], steps.twist)
            state = steps.behind_face(state | {"p": p}, dr.any(moved != 0))
            return (
                dr.select(good, dr.select(h < length - s, s + h, length), s),
                state,
                geometry.multiply(cell, moved, k),
            )

        count = dr.width(p)
        _, state, cell = dr.while_loop(
            (dr.zeros(Float, count), steps.start(p, v), dr.zeros(Array3i, count)),
            lambda s, state, cell: s < length,
            step,
        )
        dr.eval(state, cell)
        return state["p"], state["v"], cell

    return walked


def walk_errors(t, twist, count=4000, walked=walked):
    """Errors in cells of a wrapped walk of the length t: (where it ends, back at its start)."""
    p, v = random_rays(count)
    end, _ = truth.flow(Array3f64(p), Array3f64(v), Float64(t), Float64(twist))
    q, u, cell = walked(p, v, t, twist)
    wrapped = distance(truth.multiply_inverse(Array3f64(cell), end, Float64(twist)), q, twist)
    home, _, back = walked(q, -u, t, twist)
    cell = Array3f64(geometry.multiply(cell, back, Int32(twist)))
    returned = distance(p, truth.multiply(cell, Array3f64(home), Float64(twist)), twist)
    wrapped, returned = (dr.select(dr.isfinite(x), x, math.inf) for x in (wrapped, returned))
    dr.eval(wrapped, returned)
    return wrapped, returned


# ---------------------------------------------------------------------------
#  Connections
# ---------------------------------------------------------------------------


def connected(vector_t, x, y, height, twist):
    """(relative miss of ``connect``'s geodesics, connections, arrival by ``flow``) from a point off
    the origin to points at the horizontal place (x, y) and the symmetric height."""
    q = Array3f64(x, y, height + 0.5 * twist * x * y)
    p = vector_t(0.25, -0.5, 0.125)
    q = vector_t(geometry.multiply(Array3f64(p), q, twist))
    way = geometry.connect(p, q, twist)
    end, arrival = geometry.flow(p, way.direction, way.distance, twist)
    return dr.max(dr.abs(end - q)) / (1 + dr.max(dr.abs(q))), way, arrival


def about_the_cut(vector_t, twist, count=50_000):
    rng = PCG32(count, initstate=4)
    radius = dr.exp2(-40 * rng.next_float64()) * (rng.next_float64() > 0.1)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    off = dr.copysign(dr.exp2(-40 * rng.next_float64()), rng.next_float64() - 0.5)
    off *= rng.next_float64() > 0.1
    height = (2 * math.pi + off) / abs(twist)
    return connected(vector_t, radius * c, radius * s, height, twist)


def about_the_switch(vector_t, twist, side, count=50_000):
    """Points where the formula of ``connect`` changes: ζ = π R²/2 + π, the half turn π/2."""
    rng = PCG32(count, initstate=4)
    radius = dr.exp2(4 * rng.next_float64() - 2)
    s, c = dr.sincos(2 * math.pi * rng.next_float64())
    zeta = math.pi * (0.5 * dr.square(0.5 * twist * radius) + 1)
    height = zeta * (1 + side * 64 * dr.epsilon(vector_t)) / twist
    return connected(vector_t, radius * c, radius * s, height, twist)
