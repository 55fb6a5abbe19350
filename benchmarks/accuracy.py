"""Prints how far images at the default tolerance are from those at a sixteenth of it, or less.

Of each scene: the mean's relative difference between renders of the same seeds, and its standard
error; the share of paths that bring something else; and at 1,024 samples how many pixels, and how
many squares of 4×4 pixels, in which smaller errors of neighbours add up, differ by more than noise.

Constants are chosen on the Cornell box; the furnished cell has had a say in those of first chords,
of chords that a face has cut and of the longest ones, and single rays of the small lattice in those
near conjugate points. The other two are for stating what was reached. All but the small lattice are
full of contacts, creases and shadows, where errors show.
"""

import argparse
import math
import os
import pathlib
import statistics
import sys
import tempfile
import time
from statistics import NormalDist

import drjit as dr
import mitsuba as mi

from .worker import command
from .workloads import bent_box, camera, small_lattice

mi.set_variant("llvm_ad_rgb")

TOLERANCE = 0.25  # pixels, the default
# Means are compared until their difference is known so well
STANDARD_ERROR = 0.0004
FEWEST = 16  # seeds, for a standard error that can be believed


# --------------------------------------------------------------------- scenes


def at(*position):
    return mi.ScalarTransform4f().translate(list(position))


def lamp(radiance):
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def colour(*rgb):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def walls(materials):
    """The inside of the cube from −1 to 1; materials by outward axis, as "-x"."""
    turns = {
        "-x": ([0, 1, 0], 90),
        "+x": ([0, 1, 0], -90),
        "-y": ([1, 0, 0], -90),
        "+y": ([1, 0, 0], 90),
        "-z": ([1, 0, 0], 0),
        "+z": ([1, 0, 0], 180),
    }
    # A unit square in the plane of x and y looks along z
    return {
        f"wall {face}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate(*turn) @ at(0, 0, -1),
            "bsdf": materials[face],
        }
        for face, turn in turns.items()
    }


def glossy_room(width, tolerance):
    """A closed bent room of metal, glass and plastic, whose things stand on the floor and touch."""
    grey = colour(0.7, 0.7, 0.65)
    brushed = {"type": "roughconductor", "material": "Al", "alpha": 0.25}
    floor = {
        "type": "roughplastic",
        "alpha": 0.2,
        "diffuse_reflectance": {"type": "rgb", "value": 0.4},
    }
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.15}
    red = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.1, 0.1]}}
    faces = {"-x": colour(0.6, 0.2, 0.15), "+x": brushed, "-y": grey, "+y": grey, "+z": grey}
    return {
        "type": "scene",
        "integrator": {
            "type": "nil",
            "quotient": False,
            "max_depth": 7,
            "cell_size": 2.0,
            "cell_origin": mi.ScalarPoint3f(-1, -1, -1),
            "tolerance": tolerance,
        },
        "sensor": camera(width, (0.1, -0.95, 0.1), (-0.3, 0.0, -0.65), 85, "box"),
        "lamp": {
            "type": "rectangle",
            "to_world": at(0, 0.1, 0.98).rotate([1, 0, 0], 180).scale([0.6, 0.5, 1]),
            "emitter": lamp(6.0),
        },
        "gold ball": {
            "type": "sphere",
            "center": [-0.45, 0.35, -0.65],
            "radius": 0.35,
            "bsdf": gold,
        },
        "glass ball": {
            "type": "sphere",
            "center": [0.35, -0.1, -0.75],
            "radius": 0.25,
            "bsdf": {"type": "dielectric"},
        },
        "frosted box": {
            "type": "cube",
            "to_world": at(0.45, 0.55, -0.72).rotate([0, 0, 1], 25).scale([0.2, 0.2, 0.28]),
            "bsdf": {"type": "roughdielectric", "alpha": 0.2},
        },
        "plastic box": {
            "type": "cube",
            "to_world": at(-0.35, -0.25, -0.87).rotate([0, 0, 1], -20).scale([0.2, 0.15, 0.13]),
            "bsdf": red,
        },
        "board against the wall": {
            "type": "cube",
            "to_world": at(-0.86, -0.15, -0.6).rotate([0, 1, 0], 15).scale([0.015, 0.3, 0.42]),
            "bsdf": brushed,
        },
    } | walls(faces | {"-z": floor})


def furnished_cell(width, tolerance):
    """A table under a lamp in the quotient's cell, with a ball and a book on it, under a sky."""
    wood, white = colour(0.5, 0.3, 0.15), colour(0.75, 0.75, 0.75)

    def block(centre, half, bsdf, turn=0.0):
        to_world = at(*centre).rotate([0, 0, 1], turn).scale(list(half))
        return {"type": "cube", "to_world": to_world, "bsdf": bsdf}

    legs = {
        f"leg {i}": block((x, y, 0.275), (0.018, 0.018, 0.125), wood)
        for i, (x, y) in enumerate(((0.34, 0.44), (0.66, 0.44), (0.34, 0.72), (0.66, 0.72)))
    }
    return {
        "type": "scene",
        "integrator": {"type": "nil", "max_depth": 5, "tolerance": tolerance},
        "sensor": camera(width, (0.47, 0.06, 0.62), (0.5, 0.6, 0.36), 75, "box"),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.35, 0.45]}},
        "floor": block((0.5, 0.55, 0.13), (0.4, 0.4, 0.02), white),
        "wall": block((0.5, 0.94, 0.45), (0.4, 0.01, 0.3), colour(0.3, 0.5, 0.4)),
        "top": block((0.5, 0.58, 0.415), (0.2, 0.18, 0.015), wood),
        "ball": {"type": "sphere", "center": [0.42, 0.56, 0.49], "radius": 0.06, "bsdf": white},
        "book": block((0.58, 0.6, 0.445), (0.06, 0.08, 0.015), colour(0.2, 0.3, 0.7), 30),
        "pole": {
            "type": "cylinder",
            "p0": [0.2, 0.8, 0.15],
            "p1": [0.2, 0.8, 0.78],
            "radius": 0.012,
            "bsdf": wood,
        },
        "lamp": {
            "type": "disk",
            "to_world": at(0.45, 0.6, 0.84).rotate([1, 0, 0], 180).scale(0.1),
            "emitter": lamp(8.0),
        },
        "shade": block((0.45, 0.6, 0.86), (0.12, 0.12, 0.01), white),
    } | legs


def meadow(width, tolerance):
    """Blades and wires, balls and instances of a small group on a ground, plain, at twist 2."""
    blades, wires = [], []
    for i in range(60):
        # Irrational steps: neither rows nor heaps
        x, y = 2.4 * (i * math.sqrt(2) % 1) - 1.2, 2.4 * (i * math.sqrt(3) % 1) - 0.9
        lean, turn = 0.25 + 0.1 * math.sin(i), 2.4 * i
        blades.append(
            [
                (x + lean * math.cos(turn) * t * t, y + lean * math.sin(turn) * t * t, t - 0.1, r)
                for t, r in ((-0.1, 0.02), (0.1, 0.02), (0.3, 0.016), (0.5, 0.012), (0.7, 0.006))
            ]
        )
    for i in range(6):
        y = -0.7 + 0.35 * i
        wires.append([(x, y + 0.1 * x, 0.02 + 0.25 * x * x, 0.015) for x in (-1, -0.5, 0, 0.5, 1)])
    ball = {"type": "sphere", "center": [0, 0, 0.12], "radius": 0.12}
    foot = {"type": "cube", "to_world": at(0.15, 0, 0.06).scale([0.1, 0.08, 0.06])}
    places = (-0.8, 0.3, 10), (0.1, -0.45, 120), (0.75, 0.55, 70), (-0.2, 1.1, 200)
    with tempfile.TemporaryDirectory() as folder:

        def curves(kind, lines, bsdf):
            path = pathlib.Path(folder, f"{kind}.txt")
            path.write_text(
                "\n\n".join("\n".join(" ".join(map(str, p)) for p in line) for line in lines)
            )
            return {"type": kind, "filename": str(path), "bsdf": bsdf}

        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {
                    "type": "nil",
                    "quotient": False,
                    "twist": 2.0,
                    "max_depth": 5,
                    "tolerance": tolerance,
                },
                "sensor": camera(width, (0.3, -1.7, 0.9), (-0.7, -0.3, 0.1), 60, "box"),
                "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
                "lamp": {
                    "type": "sphere",
                    "center": [-0.7, -0.3, 1.4],
                    "radius": 0.15,
                    "emitter": lamp(20.0),
                },
                "ground": {
                    "type": "rectangle",
                    "to_world": mi.ScalarTransform4f().scale(1.6),
                    "bsdf": colour(0.5, 0.45, 0.35),
                },
                "blades": curves("bsplinecurve", blades, colour(0.15, 0.5, 0.1)),
                "wires": curves("linearcurve", wires, colour(0.6, 0.6, 0.65)),
                "ball": {"type": "sphere", "center": [0.5, 0, 0.25], "radius": 0.25},
                "group": {"type": "shapegroup", "ball": ball, "foot": foot},
            }
            | {
                f"copy {i}": {
                    "type": "instance",
                    "to_world": at(x, y, 0).rotate([0, 0, 1], turn),
                    "group": {"type": "ref", "id": "group"},
                }
                for i, (x, y, turn) in enumerate(places)
            }
        )


SCENES = {
    # Samples of neighbours, as wider filters weigh them, are not in a pixel's variance
    "bent Cornell box": lambda width, t: bent_box(width, "box", tolerance=t),
    "glossy room": lambda width, t: mi.load_dict(glossy_room(width, t)),
    "furnished cell": lambda width, t: mi.load_dict(furnished_cell(width, t)),
    "meadow of curves": meadow,
    "small lattice": lambda width, t: small_lattice(width, 1, "box", tolerance=t),
}


# ----------------------------------------------------------------- comparison


def means_apart(scenes, spp, first_seed, most):
    """The relative difference of the images' means, its standard error, and how many seeds.

    Each seed is rendered at both tolerances: most paths are the same, and so is most of the noise.
    """
    differences, means = [], []
    for seed in range(first_seed, first_seed + most):
        mean, exact = (dr.mean(mi.render(s, spp=spp, seed=seed).array)[0] for s in scenes)
        differences.append(mean - exact)
        means.append(exact)
        if len(means) < 2:
            continue
        error = statistics.stdev(differences) / math.sqrt(len(means)) / statistics.mean(means)
        if len(means) >= FEWEST and error < STANDARD_ERROR:
            break
    return statistics.mean(differences) / statistics.mean(means), error, len(means)


def paths_changed(scenes, seeds):
    """Share of paths that bring another radiance, by more than what hits' rounding can do."""
    changed, count = 0, 0
    for seed in seeds:
        # A pixel of one sample is a path
        a, b = (mi.render(scene, spp=1, seed=seed) for scene in scenes)
        a, b = (mi.Color3f(*(mi.Float(x[:, :, i].array) for i in range(3))) for x in (a, b))
        changed += dr.count(dr.any(dr.abs(a - b) > 0.01 * dr.maximum(a, b)))[0]
        count += dr.width(a)
    return changed / count


def squares_off(scenes, width, spp, first_seed):
    """Of squares of 1×1 and 4×4 pixels, which differ by more than noise, as lines of text."""
    estimates = []
    for i, scene in enumerate(scenes):
        moment = mi.load_dict({"type": "moment", "of": scene.integrator()})
        image = mi.render(scene, integrator=moment, spp=spp, seed=first_seed + i)
        mean, square = (mi.Float(image[:, :, i].array) for i in (-5, -2))  # Y and its square
        variance = (square - dr.square(mean)) / (spp - 1)
        # Where all samples are alike, sums have roundings
        estimates.append((mean, dr.maximum(variance, dr.square(1e-4 * mean))))
    for size in (1, 4):
        (a, a2), (b, b2) = ([square_sums(x, width, size) for x in pair] for pair in estimates)
        z = (a - b) * dr.rsqrt(dr.maximum(a2 + b2, 1e-12))
        # What one sound image in 20 exceeds with its largest z
        count = dr.width(z)
        limit = NormalDist().inv_cdf(1 - 0.05 / 2 / count)
        off = dr.count(dr.abs(z) > limit)[0]
        yield (
            f"squares of {size}x{size} pixels off at {spp} spp: {off} of {count} beyond "
            f"|z| = {limit:.2f}; largest {dr.max(dr.abs(z))[0]:.2f}, "
            f"rms {math.sqrt(dr.mean(z * z)[0]):.3f}"
        )


def square_sums(values, width, size):
    """Sums over squares of ``size`` × ``size`` pixels of a square image."""
    pixel = dr.arange(mi.UInt32, width * width)
    square = pixel // width // size * (width // size) + pixel % width // size
    sums = dr.zeros(mi.Float, (width // size) ** 2)
    dr.scatter_add(sums, values, square)
    return sums


def main(words):
    parser = argparse.ArgumentParser(prog="benchmarks.accuracy", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument("--of", metavar="FOLDER", help="another checkout, to measure its package")
    parser.add_argument("--only", nargs="+", choices=SCENES, help="scenes (default: all)")
    parser.add_argument("--seed", type=int, default=1000, help="first one (default: 1000)")
    parser.add_argument(
        "--divisor",
        type=float,
        default=16,
        help="the tolerance over this stands for exact (default: 16)",
    )
    arguments = parser.parse_args(words)
    if arguments.of:
        again = [word for word in words if word != arguments.of and word != "--of"]
        code = "from benchmarks.accuracy import main\nmain(sys.argv[3:])"
        os.execv(sys.executable, command(arguments.of, code, *again))

    import nil_mitsuba

    mi.set_log_level(mi.LogLevel.Error)  # `moment` is fine around nil
    width, spp, many, most = (16, 4, 4, 2) if arguments.quick else (128, 16, 1024, 400)
    print(f"package: {pathlib.Path(nil_mitsuba.__file__).parent}")
    for name in arguments.only or SCENES:
        began = time.perf_counter()
        scenes = [SCENES[name](width, TOLERANCE / part) for part in (1, arguments.divisor)]
        difference, error, seeds = means_apart(scenes, spp, arguments.seed, most)
        changed = paths_changed(scenes, range(arguments.seed, arguments.seed + min(16, most)))
        print(
            f"\n{name}\nmean {100 * difference:+.3f} ± {100 * error:.3f} % "
            f"({seeds} seeds of {spp} spp); {100 * changed:.2f} % of paths bring something else",
            flush=True,
        )
        for line in squares_off(scenes, width, many, arguments.seed + most):
            print(line, flush=True)
        print(f"{time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
