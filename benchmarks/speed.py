"""Prints what curvature costs: time against ``path``, compile time, triangles, memory.

Times are ratios from one run, processor time of all threads, because machines are noisy.
"""

import argparse
import math
import os
import pathlib
import resource
import subprocess
import sys
import tempfile
import time
from statistics import NormalDist

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")


def bent_box(width, rfilter="gaussian", **properties):
    """Mitsuba's Cornell box in plain Nil, one cell wide."""
    scene = mi.cornell_box()
    scene["sensor"]["film"]["rfilter"] = {"type": rfilter}
    scene["sensor"]["film"]["width"] = scene["sensor"]["film"]["height"] = width
    scene["integrator"] = {
        "type": "nil",
        "max_depth": 6,
        "quotient": False,
        "cell_size": 2.0,
        "cell_origin": mi.ScalarPoint3f(-1, -1, -1),
    } | properties
    return mi.load_dict(scene)


def seconds(scene, spp, seed):
    """Processor seconds of one warm render and the image's mean."""
    start = time.process_time()
    image = mi.render(scene, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return time.process_time() - start, float(dr.mean(image.array)[0])


def against_path(width, spp, rounds):
    scene = mi.cornell_box()
    scene["sensor"]["film"]["width"] = scene["sensor"]["film"]["height"] = width
    scene["integrator"] = {"type": "path", "max_depth": 6}
    contestants = {
        "path": mi.load_dict(scene),
        "nil, twist 0": bent_box(width, twist=0.0),
        "nil, twist 1": bent_box(width),
        "nil, twist 1, tolerance / 16": bent_box(width, tolerance=0.25 / 16),
    }
    for scene in contestants.values():
        seconds(scene, spp, 0)
    times = {name: [] for name in contestants}
    means = {name: [] for name in contestants}
    for seed in range(1, rounds + 1):
        for name, scene in contestants.items():
            t, mean = seconds(scene, spp, seed)
            times[name].append(t)
            means[name].append(mean)
    print(f"\ncornell box, {width}x{width}, {spp} spp, max_depth 6, {rounds} rounds")
    for name in contestants:
        ratios = sorted(t / p for t, p in zip(times[name], times["path"]))
        mean = sum(means[name]) / rounds
        error = math.sqrt(sum((m - mean) ** 2 for m in means[name]) / max(1, rounds - 1) / rounds)
        print(
            f"{name:30} {ratios[len(ratios) // 2]:6.2f} times path   mean {mean:.5f} ± {error:.5f}"
        )


def first_render():
    """Seconds that a first render takes where no kernel was kept from earlier ones."""
    code = (
        "import time\nfrom benchmarks import speed\nscene = speed.bent_box(64)\n"
        "start = time.perf_counter()\nspeed.seconds(scene, 1, 0)\n"
        "print(time.perf_counter() - start)"
    )
    with tempfile.TemporaryDirectory() as home:  # Dr.Jit keeps its kernels below it
        run = subprocess.run(
            [sys.executable, "-c", code],
            cwd=pathlib.Path(__file__).parents[1],
            env=os.environ | {"HOME": home},
            capture_output=True,
            text=True,
            check=True,
        )
    print(f"first render, compilation included: {float(run.stdout):.1f} s")


def pixels_off(width, spp):
    """Count pixels that differ by more than noise from those at a sixteenth of the tolerance.

    And squares of 4×4 pixels, in which a smaller error of many neighbours shows.
    """
    mi.set_log_level(mi.LogLevel.Error)  # `moment` is fine around nil
    estimates = []
    for seed, tolerance in enumerate((0.25, 0.25 / 16)):
        # Samples of neighbours, as wider filters weigh them, are not in a pixel's variance
        scene = bent_box(width, "box", tolerance=tolerance)
        moment = mi.load_dict({"type": "moment", "of": scene.integrator()})
        image = mi.render(scene, integrator=moment, spp=spp, seed=seed)
        mean, square = (mi.Float(image[:, :, i].array) for i in (-5, -2))  # Y and its square
        estimates.append((mean, (square - dr.square(mean)) / (spp - 1)))
    for size in (1, 4):
        (a, a2), (b, b2) = ([square_sums(x, width, size) for x in pair] for pair in estimates)
        z = (a - b) * dr.rsqrt(dr.maximum(a2 + b2, 1e-12))
        # What one sound image in 20 exceeds with its largest z
        count = dr.width(z)
        limit = NormalDist().inv_cdf(1 - 0.05 / 2 / count)
        off = dr.count(dr.abs(z) > limit)[0]
        print(
            f"squares of {size}x{size} pixels off at {spp} spp: {off} of {count} beyond "
            f"|z| = {limit:.2f}; largest {dr.max(dr.abs(z))[0]:.2f}, "
            f"rms {math.sqrt(dr.mean(z * z)[0]):.3f}",
            flush=True,
        )


def square_sums(values, width, size):
    """Sums over squares of ``size`` × ``size`` pixels of a square image."""
    pixel = dr.arange(mi.UInt32, width * width)
    square = pixel // width // size * (width // size) + pixel % width // size
    sums = dr.zeros(mi.Float, (width // size) ** 2)
    dr.scatter_add(sums, values, square)
    return sums


def bumpy_scene(triangles, **properties):
    """A wavy sphere in the quotient under an even sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "max_depth": 4} | properties,
            "sensor": {
                "type": "perspective",
                "fov": 70,
                "to_world": mi.ScalarTransform4f().look_at(
                    [0.5, 0.05, 0.6], [0.5, 1, 0.4], [0, 0, 1]
                ),
                "film": {"type": "hdrfilm", "width": 128, "height": 128},
            },
            "sky": {"type": "constant"},
            "mesh": bumpy_sphere(round(math.sqrt(triangles / 2))),
        }
    )


def against_triangles(sizes):
    print("\ntriangles   time per path (relative to the first)")
    first = None
    for triangles in sizes:
        scene = bumpy_scene(triangles)
        seconds(scene, 32, 0)
        t = min(seconds(scene, 32, seed)[0] for seed in (1, 2, 3))
        first = first or t
        print(f"{triangles:9,}   {t / first:.2f}", flush=True)


def against_straight(triangles, depths, spp, rounds):
    """What bending costs in the quotient: renders at twist 1 over renders at twist 0.

    Rays end elsewhere at twist 1, so that times are compared over the length that was traced.
    """
    print(f"\nquotient, {triangles:,} triangles: time per traced length, twist 1 : twist 0")
    for depth in depths:
        scenes = {twist: bumpy_scene(triangles, twist=twist, max_depth=depth) for twist in (0, 1)}
        lengths = {twist: traced_length(scene) for twist, scene in scenes.items()}
        ratios = []
        for seed in range(rounds + 1):
            cost = {t: seconds(scene, spp, seed)[0] / lengths[t] for t, scene in scenes.items()}
            ratios.append(cost[1] / cost[0])
        middle = sorted(ratios[1:])[rounds // 2]  # the first one compiles
        print(
            f"max_depth {depth}   {middle:.2f}   mean length of a ray at twist 1: "
            f"{lengths[1]:.2f} cells",
            flush=True,
        )


def traced_length(scene):
    """Mean length (cells) of the rays between vertices in a render of one sample per pixel."""
    from nil_mitsuba.tracer import Tracer

    intersect = Tracer.intersect
    sums = dr.zeros(mi.Float, 2)

    def counted(tracer, p, v, cone, reach, active, time=0):
        hit = intersect(tracer, p, v, cone, reach, active, time)
        length = dr.minimum(hit.distance, reach)
        for i, value in enumerate((length, mi.Float(1))):
            dr.scatter_reduce(dr.ReduceOp.Add, sums, value, mi.UInt32(i), active)
        return hit

    Tracer.intersect = counted
    try:
        mi.render(scene, spp=1)
        dr.eval(sums)
    finally:
        Tracer.intersect = intersect
    return sums[0] / sums[1]


def against_extent(halves, spp, rounds):
    """What the size of a ground costs in plain Nil, under a sky: processor time over ``path``'s."""
    print("\nplain, a ball on a ground: half size of the ground, time over path's")
    look = mi.ScalarTransform4f().look_at([0, -4, 1.5], [0, 0, 0.5], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 64, "height": 64}
    for half in halves:
        ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half)}
        times = {}
        for integrator in ({"type": "path"}, {"type": "nil", "quotient": False}):
            scene = mi.load_dict(
                {
                    "type": "scene",
                    "integrator": integrator,
                    "sky": {"type": "constant"},
                    "sensor": {"type": "perspective", "to_world": look, "film": film},
                    "ground": ground,
                    "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
                }
            )
            times[integrator["type"]] = [seconds(scene, spp, seed)[0] for seed in range(rounds + 1)]
        ratios = sorted(n / p for n, p in zip(times["nil"][1:], times["path"][1:]))
        print(
            f"{half:9,.0f}   {ratios[rounds // 2]:.1f}   "
            f"({1e6 * min(times['nil']) / (64 * 64 * spp):.2f} µs a path)",
            flush=True,
        )


def bumpy_sphere(n):
    """A sphere with waves, of 2 n² triangles, in the middle of the unit cube."""
    index = dr.arange(mi.UInt32, (n + 1) * (n + 1))
    u, v = mi.Float(index % (n + 1)) / n, mi.Float(index // (n + 1)) / n
    radius = 0.3 + 0.02 * dr.sin(40 * dr.pi * u) * dr.sin(20 * dr.pi * v)
    theta, phi = dr.pi * v, 2 * dr.pi * u
    p = mi.Point3f(dr.sin(theta) * dr.cos(phi), dr.sin(theta) * dr.sin(phi), dr.cos(theta))
    face = dr.arange(mi.UInt32, n * n)
    corner = face + face // n
    a = mi.Vector3u(corner, corner + n + 1, corner + 1)
    b = mi.Vector3u(corner + 1, corner + n + 1, corner + n + 2)
    mesh = mi.Mesh("bumps", (n + 1) * (n + 1), 2 * n * n, props=mi.Properties())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = dr.ravel(p * radius + 0.5)
    faces = dr.zeros(mi.UInt32, 6 * n * n)
    for i, triangle in enumerate((a, b)):
        for j in range(3):
            dr.scatter(faces, triangle[j], (2 * face + i) * 3 + j)
    parameters["faces"] = faces
    parameters.update()
    return mesh


def memory(width):
    """Peak memory that a render adds per million pixels, with one sample each."""
    scene = bent_box(width)
    mi.render(bent_box(64), spp=1)
    dr.sync_thread()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds(scene, 1, 0)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    added = (after - before) / 1024 * 1e6 / width**2
    print(
        f"\npeak memory per million pixels of one sample: {added:.0f} MiB "
        f"(process: {after / 1024:.0f} MiB)"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    arguments = parser.parse_args()
    if arguments.quick:
        memory(128)
        first_render()
        against_path(16, 4, 1)
        pixels_off(16, 4)
        against_triangles((1_000,))
        against_straight(1_000, (2,), 1, 1)
        against_extent((1_000,), 1, 1)
    else:
        memory(1024)
        first_render()
        against_path(128, 256, 5)
        pixels_off(128, 1024)
        against_triangles((1_000, 10_000, 100_000, 1_000_000))
        against_straight(240_000, (2, 4, 8), 32, 5)
        against_extent((10, 100, 1_000, 100_000), 256, 5)
