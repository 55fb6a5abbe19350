"""The methods that are compared, the settings of each one's knob, and what they cost."""

import math

import drjit as dr
import mitsuba as mi

from nil_mitsuba.tracer import Tracer

from ..tracing_methods import METHODS, ChordTracer
from .rays import Selection, errors, trace

PACKAGE = "nil_mitsuba"
STEPS = (0.3, 0.1, 0.03, 0.01, 0.003)
KNOBS = {
    "Euler pieces": STEPS,
    "Runge–Kutta 4": STEPS,
    "printed form": STEPS,
    "stable form": STEPS,
    "Dormand–Prince": (1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    PACKAGE: (64, 16, 4, 1, 0.25, 0.0625, 0.015625),
}
DEFAULT = mi.load_dict({"type": "nil"}).tolerance


def tracer_of(method, knob, scene, space, max_distance=math.inf, shapes=None, focus=None):
    """A tracer with one setting of the method's knob; ``focus``: where the camera is."""
    if method == PACKAGE:
        return Tracer(scene, space, max_distance, shapes, focus)
    return ChordTracer(scene, space, max_distance, METHODS[method], knob, shapes)


def timed(run):
    """What ``run()`` makes of Dr.Jit arrays, and the processor time (seconds) of its kernels.

    From the start of each kernel to its end, times the threads, which large kernels keep busy. What
    Python and the compiler take before it starts is a renderer's overhead and not a method's.
    """
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        result = run()
        dr.eval(result)
        dr.sync_thread()
        kernels = dr.kernel_history()
    return result, 1e-3 * sum(kernel["execution_time"] for kernel in kernels) * dr.thread_count()


def chords_expected(method, knob, length):
    """Roughly how many chords a ray of this length takes."""
    if method == PACKAGE:
        return 6 * length / math.sqrt(knob)
    step = 4 * math.sqrt(knob) if method == "Dormand–Prince" else knob
    return length / step


def measure(rays, length, rounds, most):
    """Rows of the table for one setup and length: every method with every setting of its knob.

    All of them trace the same rays. Settings that take more than about ``most`` chords for one are
    left out.
    """
    entries = []
    selection = Selection(rays, rays.indices(length), length)
    for method, knobs in KNOBS.items():
        for knob in knobs:
            if chords_expected(method, knob, length) > most:
                continue
            tolerance = knob if method == PACKAGE else 1.0
            tracer = tracer_of(method, knob, rays.scene, rays.space, focus=rays.setup.origin)
            row = {
                "scene": rays.setup.kind,
                "space": rays.setup.space,
                "length": length,
                "method": method,
                "knob": knob,
                **errors(tracer, selection, tolerance),
            }
            entries.append((row, tracer, tolerance, []))
    for _ in range(rounds):
        for _, tracer, tolerance, times in entries:
            times.append(timed(lambda: trace(tracer, selection, tolerance)[0])[1])
    for row, _, _, times in entries:
        # The fastest round: what else the machine does can only add
        row["microseconds"] = 1e6 * min(times) / row["rays"]
        row["rays per second"] = row["rays"] / min(times)
    return [entry[0] for entry in entries]
