"""End points of geodesics alone, without surfaces: time and error of each method."""

import importlib.util
import json
import math
import pathlib
import subprocess
import sys

import drjit as dr
import mitsuba as mi

from nil_mitsuba import geometry

from .. import truth
from ..tracing_methods import adaptive_steps, fixed_steps
from ..truth import Array3f64, Float64
from .methods import PACKAGE, timed
from .scenes import TWIST

# In a process of its own, which imports nothing of this package
HEYOKA = pathlib.Path(__file__).with_name("heyoka_end_points.py")


def random_starts(count, float_t):
    """Starts in the unit cube and directions in all of the sphere, the same for all types."""
    random = mi.PCG32(count)  # stream i is ray i's, whatever their number
    numbers = [dr.llvm.Float(dr.detach(random.next_float32())) for _ in range(5)]
    z, phi = 2 * numbers[3] - 1, 2 * math.pi * numbers[4]
    c = dr.sqrt((1 - z) * (1 + z))
    array_t = {dr.llvm.Float: dr.llvm.Array3f, dr.llvm.Float64: Array3f64}[float_t]
    p, v = numbers[:3], [c * dr.cos(phi), c * dr.sin(phi), z]
    dr.eval(p, v)
    return (array_t(*(float_t(x) for x in y)) for y in (p, v))


def closed_form(p, v, length):
    float_t = type(p.x)
    return geometry.flow(p, v, dr.opaque(float_t, length), dr.opaque(float_t, TWIST))[0]


# End points of each launch, of the ODE methods and, for it to be as long, of the closed form; those
# that heyoka finds; and those that are compared with the truth
ENDS, CLOSED_ENDS, HEYOKA_ENDS, CHECKED = 2**16, 2**18, 2**14, 2**12
# Launches are repeated until they took so long together (seconds of processor time)
LONG_ENOUGH = 0.2


def root_mean_square_error(ends, length):
    """Of the first end points, in cells."""
    p, v = random_starts(CHECKED, Float64)
    exact = truth.flow(p, v, Float64(length), Float64(TWIST))[0]
    first = dr.arange(dr.llvm.UInt32, CHECKED)
    d = dr.gather(Array3f64, ends, first) - exact
    square = d.x**2 + d.y**2 + (d.z - TWIST * exact.x * d.y) ** 2
    return math.sqrt(dr.mean(square)[0])


def end_points(lengths, rounds, quick=False):
    """Time and error of end points alone: rows of method, precision, knob, length.

    Every ODE method may work in float64; settings are a factor of √2 or √10 apart. ``quick`` keeps
    to those that reach an error near 1e-6.
    """
    contestants = []
    for length in lengths:
        for name, float_t in (("float32", dr.llvm.Float), ("float64", dr.llvm.Float64)):
            contestants.append((length, PACKAGE, name, float_t, 0.0, closed_form))
            for i in range(8, 9) if quick else range(4, 13):
                steps = round(length * 2 ** (i / 2))
                contestants.append(
                    (
                        length,
                        "Runge–Kutta 4",
                        name,
                        float_t,
                        length / steps,
                        lambda p, v, length, steps=steps: fixed_steps(p, v, length, steps, TWIST),
                    )
                )
            tightest = 25 if name == "float64" else 15
            for i in range(13, 14) if quick else range(8, tightest):
                tolerance = 10 ** (-i / 2)
                contestants.append(
                    (
                        length,
                        "Dormand–Prince",
                        name,
                        float_t,
                        tolerance,
                        lambda p, v, length, tolerance=tolerance: adaptive_steps(
                            p, v, length, tolerance, TWIST
                        ),
                    )
                )
    starts = {}
    for float_t in (dr.llvm.Float, dr.llvm.Float64):
        for count in (ENDS, CLOSED_ENDS):
            starts[float_t, count] = tuple(random_starts(count, float_t))
    dr.eval(starts)

    rows = []
    for turn in range(rounds):
        for i, (length, method, precision, float_t, knob, run) in enumerate(contestants):
            count = CLOSED_ENDS if method == PACKAGE else ENDS
            p, v = starts[float_t, count]
            times = []
            while sum(times) < LONG_ENOUGH:
                ends, seconds = timed(lambda: run(p, v, length))
                times.append(seconds)
            nanoseconds = 1e9 * min(times) / count
            if turn == 0:
                error = root_mean_square_error(Array3f64(*(Float64(x) for x in ends)), length)
                rows.append(
                    {
                        "length": length,
                        "method": method,
                        "precision": precision,
                        "knob": knob,
                        "error": error,
                        "nanoseconds": nanoseconds,
                    }
                )
            rows[i]["nanoseconds"] = min(rows[i]["nanoseconds"], nanoseconds)
    for row in rows:
        row["per second"] = 1e9 / row["nanoseconds"]
    return rows


def heyoka_rows(lengths):
    """The same of heyoka in a process of its own, or nothing where it is not installed."""
    if importlib.util.find_spec("heyoka") is None:
        return []
    p, v = random_starts(HEYOKA_ENDS, Float64)
    starts = list(zip(*(list(x) for x in (*p, *v))))
    rows = []
    for length in lengths:
        for tolerance in (1e-3, 1e-5, 1e-8, 1e-12):
            task = {"starts": starts, "length": length, "tolerance": tolerance}
            done = subprocess.run(
                [sys.executable, HEYOKA], input=json.dumps(task), capture_output=True, text=True
            )
            if done.returncode:
                raise RuntimeError(f"{HEYOKA.name} failed:\n{done.stderr}")
            result = json.loads(done.stdout)
            ends = Array3f64(*(Float64(x) for x in zip(*result["ends"])))
            nanoseconds = 1e9 * result["seconds"] / len(starts)
            rows.append(
                {
                    "length": length,
                    "method": "heyoka",
                    "precision": "float64",
                    "knob": tolerance,
                    "error": root_mean_square_error(ends, length),
                    "nanoseconds": nanoseconds,
                    "per second": 1e9 / nanoseconds,
                }
            )
    return rows


def throughput_ratio(rows, length, error, precision):
    """How many times faster the closed form is than the fastest ODE setting of that error."""
    rows = [row for row in rows if row["length"] == length and row["error"] <= error]
    ours = [r for r in rows if r["method"] == PACKAGE and r["precision"] == precision]
    best = min((r for r in rows if r["method"] != PACKAGE), key=lambda r: r["nanoseconds"])
    return best["nanoseconds"] / ours[0]["nanoseconds"], ours[0], best
