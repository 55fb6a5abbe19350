"""Fibres along x or y: a scene whose axes are exchanged along with them gives the same picture.

The exchange is a rotation by whole axes, so that all random numbers keep their meaning and pictures
are equal ray by ray: but for rounding, and for the few rays that rounding sends elsewhere.
"""

import math

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film, gradient, texture
from nil_mitsuba import checkpoint
from nil_mitsuba.layers import RENDERED
from nil_mitsuba.output import metadata_of
from small_stills import description, equal, still_of, sums_of
from ztest import Estimate, assert_same_expectation

# The scene's axes that take the places of x, y and z
AXES = {"x": "yzx", "y": "zxy", "z": "xyz"}


def T():
    return mi.ScalarTransform4f()


def turn(fibres):
    """The rotation of a scene that goes with its fibres from z to another axis."""
    rows = [[float(column == row) for column in AXES[fibres]] for row in "xyz"]
    return mi.ScalarTransform4f([[*row, 0] for row in rows] + [[0, 0, 0, 1]])


def turned_back(fibres, v):
    """The three components that it has made ``v`` of."""
    return [v["xyz".index(axis)] for axis in AXES[fibres]]


def things(M, sphere_lamp=False):
    """Lights and shapes of every kind in the unit cube, turned by M."""
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}

    def at(x, y, z, size=1.0):
        return M @ T().translate([x, y, z]).scale(size)

    def rgb(*values):
        return {"type": "rgb", "value": list(values)}

    lamp = {"type": "area", "radiance": rgb(9, 8, 7)}
    lamps = {
        "lamp": {"type": "cube", "to_world": at(0.35, 0.6, 0.75, 0.12), "light": lamp},
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(gradient(16, 8) * 0.2),
            "to_world": M @ T().rotate([1, 2, 0.5], 40),
        },
        "sun": {
            "type": "directional",
            "direction": M @ mi.ScalarVector3f(0.4, 0.3, -0.8),
            "irradiance": rgb(0.3, 0.25, 0.1),
        },
        "bulb": {
            "type": "point",
            "position": M @ mi.ScalarPoint3f(0.8, 0.2, 0.6),
            "intensity": rgb(0.05, 0.02, 0.02),
        },
        "spot": {
            "type": "spot",
            "cutoff_angle": 35,
            "intensity": rgb(0.1, 0.3, 0.1),
            "to_world": M @ T().look_at([0.2, 0.2, 0.7], [0.6, 0.7, 0.1], [0, 0, 1]),
        },
    }
    if sphere_lamp:  # Mitsuba draws directions and points of these two along the scene's axes
        lamps = {
            "lamp": {"type": "sphere", "to_world": at(0.3, 0.6, 0.8, 0.1), "light": lamp},
            "sky": {"type": "constant", "radiance": rgb(0.1, 0.2, 0.3)},
        }
    return lamps | {
        "floor": {
            "type": "cube",
            "to_world": at(0.5, 0.5, 0.04) @ T().scale([0.47, 0.47, 0.01]),
            "bsdf": {"type": "diffuse", "reflectance": texture()},
        },
        "glass": {
            "type": "sphere",
            "to_world": at(0.62, 0.5, 0.4, 0.1),
            "bsdf": {"type": "dielectric"},
        },
        "brushed": {  # it tells along u from along v
            "type": "rectangle",
            "to_world": at(0.7, 0.85, 0.5) @ T().rotate([1, 0, 0], 70).scale(0.12),
            "bsdf": {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4},
        },
        "group": {
            "type": "shapegroup",
            "cube": {"type": "cube", "bsdf": grey},
            "ball": {"type": "sphere", "center": [2, 0, 0], "bsdf": grey},
        },
        "instance": {
            "type": "instance",
            "to_world": at(0.4, 0.72, 0.27) @ T().rotate([1, 2, 3], 30).scale(0.05),
            "group": {"type": "ref", "id": "group"},
        },
    }


def look(M, near_clip=0.02):
    return {
        "to_world": M @ T().look_at([0.15, 0.1, 0.45], [0.6, 0.6, 0.3], [0, 0, 1]),
        "near_clip": near_clip,
    }


def sensors(M):
    """Two views by a batch, and one through a lens."""
    view = {"type": "perspective", "fov": 70, **look(M)}
    parallel = M @ T().look_at([0.3, 0.15, 0.3], [0.5, 0.6, 0.4], [0, 0, 1]).scale(0.3)
    return {
        "batch": {
            "type": "batch",
            "first": view | {"film": film(16, 16)},
            "second": {
                "type": "orthographic",
                "to_world": parallel,
                "near_clip": 0.01,
                "film": film(16, 16),
            },
            "film": film(32, 16),
        },
        "lens": view
        | {
            "type": "thinlens",
            "aperture_radius": 0.03,
            "focus_distance": 0.5,
            "film": film(24, 24),
        },
    }


def load(fibres, things, sensor, **nil):
    """A turned scene and its integrator."""
    integrator = {
        "type": "nil",
        "max_depth": 4,
        "fibres": fibres,
        "cell_origin": turn(fibres) @ mi.ScalarPoint3f(-0.05, 0.02, -0.02),
        "cell_size": 1.1,
    } | nil
    # Where it merges equal materials, Mitsuba numbers shapes differently from time to time
    scene = mi.load_dict({"type": "scene", **things, "sensor": sensor}, optimize=False)
    return scene, mi.load_dict(integrator)


def photograph(fibres, sensor, **nil):
    """The channels of a picture, layers included."""
    M = turn(fibres)
    nil["aovs"] = ",".join(RENDERED)
    scene, integrator = load(fibres, things(M), sensors(M)[sensor], **nil)
    image = mi.render(scene, integrator=integrator, spp=4, seed=3)
    rows, columns, channels = image.shape
    pixels = dr.arange(mi.UInt32, rows * columns)
    return [dr.gather(mi.Float, image.array, channels * pixels + c) for c in range(channels)]


def unlike(a, b, tolerance):
    """Share of the pixels whose values differ by more."""
    off = dr.abs(a - b) > tolerance * (1 + dr.abs(a))
    return dr.count(off)[0] / dr.width(off)


FAST = ("y", "batch", True)
SETUPS = [(f, s, q) for f in "xy" for s in ("batch", "lens") for q in (False, True)]


@pytest.mark.parametrize(
    "fibres, sensor, quotient",
    [s if s == FAST else pytest.param(*s, marks=pytest.mark.verify) for s in SETUPS],
)
def test_a_scene_turned_along_with_its_fibres_gives_the_same_picture(rgb, fibres, sensor, quotient):
    """Ray by ray, in all layers: "cell" counts along the fibres, as it did."""
    nil = {
        "quotient": quotient,
        "twist": 2.0 if quotient else 1.3,
        "hide_emitters": sensor == "lens",
        # The phase of chords follows from a ray's bits, and so from how numbers were rounded: short
        # ones, so that little depends on it
        "tolerance": 0.005,
    }
    still, moved = photograph("z", sensor, **nil), photograph(fibres, sensor, **nil)
    for first in (4, 7):  # behind three colours and the distance: positions and normals
        vector = slice(first, first + 3)
        moved[vector] = turned_back(fibres, moved[vector])
    assert max(unlike(a, b, 0.01) for a, b in zip(still[:3], moved[:3])) < 0.01
    assert max(unlike(a, b, 1e-3) for a, b in zip(still[3:], moved[3:])) < 0.01


@pytest.mark.verify
@pytest.mark.parametrize("fibres", ["x", "y"])
@pytest.mark.parametrize("quotient", [False, True])
def test_lamps_that_mitsuba_samples_along_its_own_axes_give_the_same_light(rgb, fibres, quotient):
    """A sphere and a constant sky. Fails on equal expectations for one seed in 400."""
    nil = {"quotient": quotient, "twist": 2.0 if quotient else 1.3}
    estimates = []
    for seed, axis in enumerate(("z", fibres)):
        M = turn(axis)
        view = {"type": "perspective", "fov": 70, "film": film(24, 24), **look(M)}
        scene, integrator = load(axis, things(M, sphere_lamp=True), view, **nil)
        estimates.append(Estimate(scene, integrator, 512, seed))
    assert_same_expectation(*estimates, block=8)


def geodesic(fibres, twist, p, v, length, steps=256):
    """Place and velocity after an arc, by Runge and Kutta's method in the scene's own axes.

    The metric is da² + db² + (df − k a db)², f along the fibres: momenta along b and f are kept.
    """
    a, b, f = ("xyz".index(axis) for axis in AXES[fibres])
    k, pf = twist, v[f]
    pb = v[b] - k * p[a] * pf

    def rates(state):
        along_b = pb + k * state[0] * pf
        return state[3], along_b, pf + k * state[0] * along_b, -k * pf * along_b

    def moved(state, rate, h):
        return [x + h * r for x, r in zip(state, rate)]

    state, h = [p[a], p[b], p[f], v[a]], length / steps
    for _ in range(steps):
        k1 = rates(state)
        k2 = rates(moved(state, k1, h / 2))
        k3 = rates(moved(state, k2, h / 2))
        k4 = rates(moved(state, k3, h))
        mean = [(r1 + 2 * r2 + 2 * r3 + r4) / 6 for r1, r2, r3, r4 in zip(k1, k2, k3, k4)]
        state = moved(state, mean, h)
    end, frame = [0.0] * 3, [0.0] * 3
    end[a], end[b], end[f] = state[:3]
    frame[a], frame[b], frame[f] = state[3], pb + k * state[0] * pf, pf
    return end, frame


def frame_normal(fibres, twist, p, n):
    """Unit normal in the scene's frame Ea = ∂a, Eb = ∂b + k a ∂f, Ef = ∂f of a Euclidean one."""
    a, b, f = ("xyz".index(axis) for axis in AXES[fibres])
    n = list(n)
    n[b] += twist * p[a] * n[f]
    return [c / math.hypot(*n) for c in n]


@pytest.mark.parametrize("fibres", ["x", pytest.param("y", marks=pytest.mark.verify)])
def test_rays_are_geodesics_whose_fibres_run_along_an_axis_of_the_scene(rgb, fibres):
    """Against an integration that knows neither the package's formulas nor its axes."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.lights import Lights
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    twist, origin, size, count = 1.3, (0.3, -0.2, 0.1), 2.0, 24
    centre, radius = (0.5, 0.4, -0.3), 4.0
    along = "xyz".index(fibres)
    bulb = [13.0 if axis == along else -0.4 for axis in range(3)]
    beam = dr.normalize(mi.ScalarVector3f(*(-2.0 if axis == along else 1.0 for axis in range(3))))
    aim = T().look_at(bulb, mi.ScalarPoint3f(bulb) + beam, [1, 2, 3])
    scene = mi.load_dict(
        {
            "type": "scene",
            "room": {"type": "sphere", "center": list(centre), "radius": radius},
            "bulb": {"type": "spot", "cutoff_angle": 60, "to_world": aim},
        }
    )
    space = Space(twist, False, list(origin), size, fibres=fibres)
    i = dr.arange(mi.Float, count)
    start = mi.Point3f(dr.sin(i), dr.cos(3 * i), dr.sin(5 * i + 1))
    v = dr.normalize(mi.Vector3f(dr.cos(7 * i), dr.sin(2 * i), dr.cos(11 * i)))
    tracer = Tracer(scene, space, dr.inf)
    p = space.to_cells(start)
    hit = tracer.intersect(p, v, Cone(0, 1e-5), tracer.reach(p, v), mi.Bool(True))
    si = surface_interaction(hit, v, space, mi.Color0f())
    vertex = dr.zeros(mi.SurfaceInteraction3f, count)
    vertex.p = start
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    # Also along further geodesics than the shortest
    light = Lights(scene, space, 12.0).sample(vertex, sampler, mi.Bool(True))
    dr.eval(hit, si, light)
    assert dr.all(hit.valid)

    def in_cells(x):
        return [(c - o) / size for c, o in zip(x, origin)]

    def lane(x, j):
        return [float(c[j]) for c in x]

    for j in range(count):
        o, d = in_cells(lane(start, j)), lane(v, j)
        end, frame = geodesic(fibres, twist, o, d, hit.distance[j])
        place = lane(si.p, j)
        assert math.dist(in_cells(place), end) < 2e-5
        assert math.dist(lane(hit.arrival, j), frame) < 2e-5
        inward = [(c - x) / radius for c, x in zip(centre, place)]
        n = frame_normal(fibres, twist, end, inward)
        assert abs(abs(sum(x * y for x, y in zip(lane(si.n, j), n))) - 1) < 1e-5
        if light.weight[0][j] > 0:
            d, length = lane(light.direction, j), light.reach[j]
            end, frame = geodesic(fibres, twist, o, d, length, steps=1000)
            assert math.dist(end, in_cells(bulb)) < 2e-5 * (1 + length)
            assert -sum(x * y for x, y in zip(frame, beam)) > 0.499  # within the spot's cone
    turns = twist * dr.abs(light.direction[along]) * light.reach
    lit = light.weight[0] > 0
    assert dr.count(lit & (turns > 2 * dr.pi))[0] > 2 < dr.count(lit & (turns < 2 * dr.pi))[0]


@pytest.mark.parametrize("fibres", [pytest.param("x", marks=pytest.mark.verify), "y"])
def test_rays_through_a_lens_and_their_reach_turn_with_the_scene(rgb, fibres):
    from nil_mitsuba.camera import Camera
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Tracer

    count, found = 200, []
    for axis in ("z", fibres):
        M = turn(axis)
        ball = {"type": "sphere", "to_world": M @ T().translate([1, 2, 0.5]).scale(0.3)}
        scene = mi.load_dict({"type": "scene", "lens": sensors(M)["lens"], "ball": ball})
        space = Space(1.3, False, list(M @ mi.ScalarPoint3f(0.1, 0.2, -0.4)), 2.0, fibres=axis)
        random = mi.PCG32(count)
        u, w = (mi.Point2f(random.next_float32(), random.next_float32()) for _ in range(2))
        ray, _ = scene.sensors()[0].sample_ray_differential(0, 0.5, u, w)
        p, v, *_ = Camera(scene.sensors()[0], space, 0.25).start(ray, mi.Float(0))
        reach = Tracer(scene, space, dr.inf).reach(p, v)
        found.append((p, turned_back(axis, v), reach))
    for a, b in zip(*found):
        assert dr.allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("fibres", [pytest.param("x", marks=pytest.mark.verify), "y"])
def test_clearances_turn_with_the_scene(rgb, fibres):
    """In plain Nil, where voxels are as long as the scene's box along each axis."""
    from nil_mitsuba.clearance import Clearance
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.shapes import Shapes

    found = []
    for axis in ("z", fibres):
        M = turn(axis)
        wall = M @ T().translate([0.5, 0, -0.2]).rotate([1, 2, 3], 20).scale([3, 0.5, 1])
        ball = M @ T().translate([1, 2, 0.5]).scale(0.3)
        scene = {
            "wall": {"type": "rectangle", "to_world": wall},
            "ball": {"type": "sphere", "to_world": ball},
        }
        space = Space(1.0, False, list(M @ mi.ScalarPoint3f(0.1, 0.2, -0.4)), 2.0, fibres=axis)
        eye = M @ mi.ScalarPoint3f(-1, 0.5, 0.3)
        clearance = Clearance(space, Shapes(mi.load_dict({"type": "scene", **scene})), eye)
        i = dr.arange(mi.Float, 4000)
        p = mi.Point3f(0.9 * dr.sin(i), dr.cos(3.1 * i), 0.7 * dr.sin(5.3 * i))
        found.append(clearance.at(p))
    still, moved = found
    assert dr.count(still > 0)[0] > 3000
    assert dr.count(dr.abs(still - moved) > 1e-4)[0] < 40  # voxels of which rounding decides


def test_without_a_twist_it_does_not_matter_where_fibres_run(rgb):
    images = [
        mi.render(mi.load_dict(description(twist=0, quotient=False, fibres=fibres)), spp=4)
        for fibres in "zx"
    ]
    assert dr.allclose(*images, rtol=1e-4)


def operations(fibres):
    """How many each kernel of a render has, from the smallest to the largest."""
    scene = mi.load_dict(description(fibres=fibres))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        mi.render(scene, spp=4)
        history = dr.kernel_history([dr.KernelType.JIT])
    return sorted(kernel["operation_count"] for kernel in history)


@pytest.mark.parametrize("fibres", [pytest.param("x", marks=pytest.mark.verify), "y"])
def test_kernels_do_not_grow_where_fibres_run_along_another_axis(rgb, fibres):
    sizes, usual = operations(fibres), operations("z")
    assert usual[-1] > 1000 and len(sizes) == len(usual)
    assert all(size <= other for size, other in zip(sizes, usual))


def test_a_still_with_other_fibres_goes_on_from_its_checkpoint(rgb, tmp_path):
    still = still_of(mi.load_dict(description(fibres="y")), spp=8, pass_spp=4)
    checkpoint.save(tmp_path / "a.sums", sums_of(still, 0))
    resumed = still.start(tmp_path / "a.sums", resume=True)
    assert list(still.todo(resumed, stop=still.count)) == [1]
    resumed = resumed.plus(still.render(1))
    assert equal(still.develop(resumed), still.develop(sums_of(still, 0, 1)))


def test_a_picture_tells_where_its_fibres_run(rgb):
    still = still_of(mi.load_dict(description(fibres="y")))
    assert metadata_of(still.nothing())["fibres"] == "y"
    assert "fibres = y" in str(mi.load_dict({"type": "nil", "fibres": "y"}))
