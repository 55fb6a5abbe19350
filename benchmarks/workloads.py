"""What ``speed`` measures: for each workload, contestants that all do the same thing.

A contestant has ``run(seed)``, which gives its costs by name, and, if a tracer takes part,
``counts()``. Costs are processor time of all threads, in the contestant's unit:

- ``passes``: whole renders with everything that Python does for them, warm,
- ``kernels``: from the start of each of Dr.Jit's kernels to its end, times the threads.
"""

import inspect
import json
import math
import os
import pathlib
import subprocess
import tempfile
import time
from xml.etree import ElementTree

import drjit as dr
import mitsuba as mi

from .counts import counting

mi.set_variant("llvm_ad_rgb")

ROOT = pathlib.Path(__file__).resolve().parents[1]
LENGTHS = (1, 5, 20)


def costs(work):
    """Processor seconds of ``work()``: of everything, and of kernels."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        start = time.process_time()
        dr.eval(work())
        dr.sync_thread()
        passes = time.process_time() - start
        kernels = sum(kernel["execution_time"] for kernel in dr.kernel_history())
    return {"passes": passes, "kernels": 1e-3 * kernels * dr.thread_count()}


class Render:
    """Renders of a scene, in microseconds a path, or in a unit of which so many are in that."""

    def __init__(self, scene, spp, unit="µs a path", per=1.0):
        self.scene, self.spp, self.unit, self.per = scene, spp, unit, per
        self.paths = dr.prod(scene.sensors()[0].film().crop_size()) * spp

    def run(self, seed):
        found = costs(lambda: mi.render(self.scene, spp=self.spp, seed=seed))
        return {name: 1e6 * x / self.paths / self.per for name, x in found.items()}

    def counts(self):
        """Rays, queries and packet iterations a path; none of Mitsuba's own integrators."""
        if not hasattr(self.scene.integrator(), "twist"):
            return {}
        spp = min(4, self.spp)
        with counting() as counts:
            dr.eval(mi.render(self.scene, spp=spp))
        return counts.each(self.paths / self.spp * spp)


# --------------------------------------------------------------------- scenes


def bent_box(width, rfilter="gaussian", **properties):
    """Mitsuba's Cornell box in plain Nil, one cell wide."""
    nil = {
        "type": "nil",
        "max_depth": 6,
        "quotient": False,
        "cell_size": 2.0,
        "cell_origin": mi.ScalarPoint3f(-1, -1, -1),
    }
    return cornell_box(width, nil | properties, rfilter)


def cornell_box(width, integrator, rfilter="gaussian"):
    scene = mi.cornell_box()
    scene["sensor"]["film"]["rfilter"] = {"type": rfilter}
    scene["sensor"]["film"]["width"] = scene["sensor"]["film"]["height"] = width
    scene["integrator"] = integrator
    return mi.load_dict(scene)


def camera(width, origin, target, fov, rfilter="gaussian"):
    look = mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 0, 1])
    film = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": rfilter}}
    return {"type": "perspective", "fov": fov, "to_world": look, "film": film}


def open_scene(width, integrator):
    """Five balls on a ground of 8 × 8 cells under a sky, which half of the camera's rays meet."""
    balls = (-2, -1), (-0.6, 0.8), (0.5, -1.2), (1.8, 0.4), (0.2, 2.4)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator | {"max_depth": 4},
            "sky": {"type": "constant"},
            "sensor": camera(width, (0.3, -5, 2.2), (0, 0, 1.4), 60),
            "ground": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)},
        }
        | {
            f"ball {i}": {"type": "sphere", "center": [x, y, 0.5], "radius": 0.5}
            for i, (x, y) in enumerate(balls)
        }
    )


def small_lattice(width, twist, rfilter="gaussian", **properties):
    """A ball, a box and a peg in the quotient's cell, under an even sky."""
    at = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "max_depth": 4, "twist": twist} | properties,
            "sky": {"type": "constant"},
            "sensor": camera(width, (0.1, 0.12, 0.6), (0.7, 1, 0.45), 75, rfilter),
            "ball": {"type": "sphere", "center": [0.3, 0.7, 0.3], "radius": 0.09},
            "box": {
                "type": "cube",
                "to_world": at().translate([0.75, 0.65, 0.75]).rotate([0, 0, 1], 30).scale(0.06),
            },
            "peg": {
                "type": "cylinder",
                "p0": [0.72, 0.25, 0.1],
                "p1": [0.72, 0.25, 0.5],
                "radius": 0.025,
            },
        }
    )


def bumpy_scene(triangles, **properties):
    """A wavy sphere in the quotient under an even sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "max_depth": 4} | properties,
            "sensor": camera(128, (0.5, 0.05, 0.6), (0.5, 1, 0.4), 70),
            "sky": {"type": "constant"},
            "mesh": bumpy_sphere(round(math.sqrt(triangles / 2))),
        }
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


def traced_length(scene):
    """Mean length (cells) of the rays between vertices in a render of one sample per pixel."""
    from nil_mitsuba.tracer import Tracer

    intersect = Tracer.intersect
    sums = dr.zeros(mi.Float, 2)

    def counted(tracer, p, v, cone, reach, active, time=0, **options):
        hit = intersect(tracer, p, v, cone, reach, active, time, **options)
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


# ------------------------------------------------------------------ workloads

PLAIN = {"type": "nil", "quotient": False}


def box(quick):
    width, spp = (16, 4) if quick else (128, 256)
    return {
        "path": Render(cornell_box(width, {"type": "path", "max_depth": 6}), spp),
        "twist 0": Render(bent_box(width, twist=0.0), spp),
        "twist 1": Render(bent_box(width), spp),
    }


def in_the_open(quick):
    width, spp = (16, 4) if quick else (128, 256)
    return {
        "path": Render(open_scene(width, {"type": "path"}), spp),
        "twist 0": Render(open_scene(width, PLAIN | {"twist": 0.0}), spp),
        "twist 1": Render(open_scene(width, PLAIN), spp),
    }


def lattice(quick):
    width, spp = (16, 4) if quick else (128, 64)
    return {f"twist {twist}": Render(small_lattice(width, twist), spp) for twist in (0, 1)}


def still(name, medium, distance, size):
    """A scene of the gallery in another medium, or in none, seen up to a distance in cells."""
    folder = ROOT / "scenes"
    root = ElementTree.parse(folder / f"{name}.xml").getroot()
    for sensor in root.iter("sensor"):
        for own in sensor.findall("medium"):
            sensor.remove(own)
    mi.file_resolver().append(str(folder))
    scene = mi.load_string(ElementTree.tostring(root, encoding="unicode"), **size)
    if medium:
        scene.sensors()[0].set_medium(mi.load_dict(medium))
    scene.integrator().max_distance = distance
    return scene


def stills(quick):
    """In a vacuum, which they once were."""
    # Not much smaller than they are shown: chords are as short as pixels are small
    size = {"resx": 32, "resy": 18} if quick else {"resx": 640, "resy": 360}
    return {
        name: Render(still(name, None, 12.0, size), 2 if quick else 4)
        for name in ("lattice", "showcase")
    }


def dense(quick):
    """Rays end elsewhere at twist 1, so that times are those of a cell of traced length."""
    scenes = {
        f"twist {twist}": bumpy_scene(1_000 if quick else 240_000, twist=twist) for twist in (0, 1)
    }
    spp = 1 if quick else 32
    lengths = {name: traced_length(scene) for name, scene in scenes.items()}
    return {name: Render(scenes[name], spp, "µs a cell", lengths[name]) for name in scenes}


def triangles(quick):
    spp, part = (1, 1_000) if quick else (32, 1)
    return {
        f"{count:,}": Render(bumpy_scene(count // part), spp)
        for count in (10_000, 100_000, 1_000_000)
    }


def foggy(width, integrator, **medium):
    """A block of fog over a ground, a ball and a lamp in it, another ball beside it; a sky."""
    at = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator | {"max_depth": 8},
            "sky": {"type": "constant", "radiance": 0.3},
            "lamp": {"type": "point", "position": [0.5, -0.6, 0.7], "intensity": 2.0},
            "sensor": camera(width, (0, -3.5, 0.4), (0, 0, 0), 50),
            "ground": {"type": "rectangle", "to_world": at().translate([0, 0, -1.01]).scale(2)},
            "ball": {"type": "sphere", "center": [0.2, 0, 0], "radius": 0.35},
            "beside": {"type": "sphere", "center": [-1.4, 0, -0.7], "radius": 0.3},
            "block": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        }
    )


def homogeneous():
    return {"type": "homogeneous", "albedo": 0.8, "phase": {"type": "hg", "g": 0.5}}


def heterogeneous():
    at = mi.ScalarTransform4f
    density = mi.TensorXf([0.1, 1, 0.3, 0.5, 0.2, 0.9, 0, 1], (2, 2, 2))
    grid = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(density),
        "to_world": at().translate([-1, -1, -1]).scale(2),
    }
    return {"type": "heterogeneous", "albedo": 0.8, "scale": 3.0, "sigma_t": grid}


def fog(medium):
    def workload(quick):
        width, spp = (4, 1) if quick else (64, 256)
        found = {"volpath": {"type": "volpath"}}
        found |= {f"twist {twist}": PLAIN | {"twist": twist} for twist in (0.0, 1.0)}
        return {
            name.removesuffix(".0"): Render(foggy(width, integrator, **medium()), spp)
            for name, integrator in found.items()
        }

    return workload


def lattice_in_fog(quick):
    """`lattice` with the mean free path of two cells and the albedo ½, as far as rays go."""
    size = {"resx": 16, "resy": 9} if quick else {"resx": 320, "resy": 180}
    fog = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.5}
    return {
        name: Render(
            still("lattice", fog if name != "clear" else None, distance, size), 2 if quick else 16
        )
        for name, distance in (("clear", 12.0), ("foggy", 12.0), ("endless", math.inf))
    }


def grounds(quick):
    """A ball on grounds of half so many cells, most of which is empty, under a sky."""
    width, spp = (16, 4) if quick else (64, 256)

    def scene(half, integrator):
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": integrator,
                "sky": {"type": "constant"},
                "sensor": camera(width, (0, -4, 1.5), (0, 0, 0.5), 40),
                "ground": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half)},
                "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
            }
        )

    return {
        f"{name}, {half:,}": Render(scene(half, integrator), spp)
        for half in (10, 1_000, 100_000)
        for name, integrator in (("path", {"type": "path"}), ("twist 1", PLAIN))
    }


class CameraRays:
    """Camera rays of one of the chart's scenes up to a length, at the default tolerance."""

    unit = "µs a ray"

    def __init__(self, rays, length):
        from nil_mitsuba.tracer import Tracer

        from .chart.rays import Selection

        self.selection = Selection(rays, rays.indices(length), length)
        # An earlier commit's tracer may know nothing of where the camera is
        known = "focus" in inspect.signature(Tracer).parameters
        focus = {"focus": rays.setup.origin} if known else {}
        self.tracer = Tracer(rays.scene, rays.space, math.inf, **focus)
        self.count = dr.width(self.selection.index)

    def hits(self):
        from .chart.methods import DEFAULT
        from .chart.rays import trace

        return trace(self.tracer, self.selection, DEFAULT)[0]

    def run(self, seed):
        return {name: 1e6 * x / self.count for name, x in costs(self.hits).items()}

    def counts(self):
        with counting() as counts:
            dr.eval(self.hits())
        return counts.each(self.count)


def rays_of(quotient):
    def workload(quick):
        from .chart import rays, scenes

        (setup,) = (x for x in scenes.setups() if x.kind == "sparse" and x.quotient == quotient)
        found = rays.CameraRays(setup, 32 if quick else 256)
        return {f"length {length}": CameraRays(found, length) for length in LENGTHS}

    return workload


class FreshProcess:
    """A first render of 64 × 64 pixels, where no kernel was kept from earlier ones.

    And the memory that an image of 1024 × 1024 pixels of one sample adds to it.
    """

    unit = "s"
    CODE = """
import json, resource, time
from benchmarks.workloads import bent_box, costs, mi
width = int(sys.argv[3])
scene = bent_box(64)
found = costs(lambda: mi.render(scene, spp=1))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
costs(lambda: mi.render(bent_box(width), spp=1))
added = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print(json.dumps({"passes": found["passes"], "MiB": added / 1024 * 1e6 / width**2}))
"""

    def __init__(self, width):
        self.width = width

    def run(self, seed):
        import nil_mitsuba

        from .worker import alone, command

        with tempfile.TemporaryDirectory() as home:  # Dr.Jit keeps its kernels below it
            done = subprocess.run(
                alone(
                    command(pathlib.Path(nil_mitsuba.__file__).parents[1], self.CODE, self.width)
                ),
                cwd=ROOT,
                env=os.environ | {"HOME": home},
                capture_output=True,
                text=True,
                check=True,
            )
        return json.loads(done.stdout.splitlines()[-1])

    def counts(self):
        return {}


def fresh(quick):
    return {"first render": FreshProcess(128 if quick else 1024)}


def passes(quick):
    """Renders of so few samples that nearly all is what Python does for a pass."""
    return {"bent box": Render(bent_box(16), 1, "ms a pass", 1e3 / 256)}


WORKLOADS = {
    "box": box,
    "open": in_the_open,
    "lattice": lattice,
    "rays plain": rays_of(False),
    "rays quotient": rays_of(True),
    "stills": stills,
    "dense": dense,
    "triangles": triangles,
    "grounds": grounds,
    "fog": fog(homogeneous),
    "cloud": fog(heterogeneous),
    "lattice in fog": lattice_in_fog,
    "fresh": fresh,
    "passes": passes,
}
