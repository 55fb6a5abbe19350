"""Media against what is known without the renderer: quadratures in float64, exponentials, energy.

Each statistical comparison says how often it fails on equal expectations for a random seed; the
seeds are fixed.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import pytest
from drjit.llvm import Array3f64, Float64

from benchmarks import media_truth, truth
from benchmarks.studio import film
from ztest import POOLED_Z, sidak


def homogeneous(σ_t, albedo, g=0.0):
    """A medium; ``σ_t`` per scene unit."""
    return {
        "type": "homogeneous",
        "sigma_t": σ_t,
        "albedo": albedo,
        "phase": {"type": "hg", "g": g},
    }


def sensor(medium):
    return {"type": "radiancemeter", "film": film(1, 1), "medium": medium}


class Rays:
    """Paths along geodesics of one's own choice, as the integrator traces them for a camera."""

    def __init__(self, scene, **parameters):
        from nil_mitsuba.tracer import Cone

        self.integrator = mi.load_dict({"type": "nil", "rr_depth": 100_000} | parameters)
        self.scene = mi.load_dict({"type": "scene"} | scene)
        self.view = self.integrator.view(self.scene, sensor=self.scene.sensors()[0])
        self.cone = Cone(0.0, 1e-4)

    def radiance(self, p, v, sampler, wavelengths=None):
        """Radiance by one path for each start (cells) and frame direction."""
        ray = dr.zeros(mi.RayDifferential3f, dr.width(p, v))
        if wavelengths is not None:
            ray.wavelengths = wavelengths
        result, _, _ = self.integrator.trace(
            self.view, sampler, ray, p, v, self.cone, mi.Float(dr.inf), v, mi.Bool(True)
        )
        dr.eval(result)
        return result


def sampler(count, seed):
    result = mi.load_dict({"type": "independent"})
    result.seed(seed, count)
    return result


def mean(values):
    """The mean of float32 values, and the standard error of it."""
    count = len(values)
    values = mi.Float64(values)
    average = dr.sum(values)[0] / count
    variance = dr.sum(dr.square(values - average))[0] / (count - 1)
    return average, math.sqrt(variance / count)


# ------------------------------------------------------------------ single scattering

LANES = 2**20


def compare_single_scattering(
    twist, g, σ, p, v, light, reach, *, boundary=None, quotient=False, count=4, panels=48, size=1.0
):
    """Render what one scattering shows along a geodesic (cells), and integrate it in float64.

    Fails on equal expectations for less than one seed in 370, as the standard error is at most a
    third of what is allowed: 0.3 %.
    """
    medium = media_truth.Medium(σ, 0.8, g)
    where = (p, v, light, float(twist), medium, reach, quotient, boundary)
    true = media_truth.single_scattering(*where, panels)
    assert abs(media_truth.single_scattering(*where, panels // 2) / true - 1) < 5e-4

    fog = homogeneous(σ / size, 0.8, g)
    scene = {
        "sensor": sensor(fog),
        "light": {
            "type": "point",
            "position": [size * x for x in light],
            "intensity": {"type": "rgb", "value": size**2},
        },
    }
    if boundary is not None:
        null = {"bsdf": {"type": "null"}, "interior": fog}
        scene["boundary"] = null | {
            "type": "sphere",
            "center": [size * x for x in boundary.center],
            "radius": size * boundary.radius,
        }
    parameters = {"max_distance": reach} if boundary is None else {}
    rays = Rays(
        scene,
        twist=float(twist),
        quotient=quotient,
        max_depth=2,
        cell_size=size,
        **parameters,
    )
    p, v = mi.Point3f(*p), dr.normalize(mi.Vector3f(*v))
    found, error = 0, 0
    for seed in range(count):
        average, deviation = mean(rays.radiance(p, v, sampler(LANES, seed))[0])
        found, error = found + average / count, math.hypot(error, deviation / count)
    print(
        f"twist {twist} g {g} quotient {quotient}: {true:.6f}, "
        f"off by {100 * (found / true - 1):+.3f} ± {100 * error / true:.3f} %"
    )
    assert error < 0.001 * true
    assert abs(found - true) < 0.003 * true


# Points of these balls are closer to each other than 2π/|k|: one geodesic joins any two
BALLS = {1: truth.Sphere((0.0, 0.0, 0.0), 1.6), 3: truth.Sphere((0.0, 0.0, 0.0), 0.6)}
LIGHTS = {1: (0.5, 0.6, 0.1), 3: (0.3, 0.3, 0.1)}


@pytest.mark.parametrize(
    "twist, g",
    [
        (1, -0.7),
        *(pytest.param(*case, marks=pytest.mark.verify) for case in ((1, 0.9), (3, 0.0), (3, 0.9))),
    ],
)
def test_a_ball_of_fog_shows_a_point_light_by_one_scattering(rgb, twist, g):
    compare_single_scattering(
        twist,
        g,
        1.0,
        (0.0, 0.0, 0.0),
        (1.0, 0.2, 0.3),
        LIGHTS[twist],
        6.0,
        boundary=BALLS[twist],
        count={1: 1, 3: 3}[twist],
    )


@pytest.mark.verify
def test_fog_is_as_thick_in_other_units(rgb):
    """A cell of 40 scene units."""
    compare_single_scattering(
        1,
        0.0,
        1.0,
        (0.1, 0.0, 0.0),
        (1.0, 0.2, -0.3),
        LIGHTS[1],
        6.0,
        boundary=BALLS[1],
        size=40.0,
        count=1,
    )


@pytest.mark.verify
@pytest.mark.parametrize(
    "twist, g, σ, reach", [(1, 0.0, 0.3, 14.0), (3, -0.7, 0.4, 8.0), (3, 0.9, 0.4, 8.0)]
)
def test_fog_without_an_end_shows_a_point_light_along_every_geodesic(rgb, twist, g, σ, reach):
    """Beyond the length 2π/|k| several geodesics join the light and what scatters it."""
    compare_single_scattering(
        twist,
        g,
        σ,
        (0.0, 0.0, 0.0),
        (0.2, 0.3, 1.0),
        {1: (0.6, 0.6, 0.1), 3: (0.3, 0.3, 0.1)}[twist],
        reach,
        panels=4096,  # the integrand has a pole of order 1/2 at each caustic
        count={0.9: 5}.get(g, 3),
    )


@pytest.mark.parametrize(
    "twist, g, σ, reach, v, light, count",
    [
        (2, 0.0, 4.0, 3.0, (1.0, 0.2, 0.3), (0.9, 0.6, 0.66), 2),
        *(
            pytest.param(*case, marks=pytest.mark.verify)
            for case in (
                (1, -0.7, 4.0, 3.0, (1.0, 0.2, 0.3), (0.9, 0.6, 0.7), 18),
                (1, 0.0, 2.5, 3.5, (-0.1, 0.9, 0.2), (0.6, 0.9, 0.6), 8),
                (3, 0.9, 4.0, 2.5, (1.0, -0.2, 0.3), (0.05, 0.45, 0.7), 10),
            )
        ),
    ],
)
def test_fog_in_the_quotient_shows_every_image_of_a_point_light(
    rgb, twist, g, σ, reach, v, light, count
):
    compare_single_scattering(
        twist, g, σ, (0.8, 0.6, 0.5), v, light, reach, quotient=True, count=count
    )


# ------------------------------------------------------------------ absorption alone


def glowing(shape, *radiance):
    return shape | {
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }


def lamps(quotient):
    """Things that glow: in the cell, and across its faces, edges and corners; or about a cell."""
    T = mi.ScalarTransform4f
    if quotient:
        return {
            "ball": glowing({"type": "sphere", "center": [0.3, 0.6, 0.4], "radius": 0.07}, 1, 2, 3),
            "corner": glowing({"type": "sphere", "center": [0, 0, 0], "radius": 0.11}, 4, 2, 1),
            "edge": glowing({"type": "sphere", "center": [0, 1, 0.6], "radius": 0.08}, 2, 5, 2),
            "face": glowing(
                {
                    "type": "cube",
                    "to_world": T().translate([0.7, 0.3, 1]).rotate([1, 1, 0], 30).scale(0.06),
                },
                2,
                2,
                6,
            ),
        }
    return {
        f"ball{i}": glowing({"type": "sphere", "center": list(c), "radius": r}, 1 + i, 2, 3)
        for i, (c, r) in enumerate(
            (((0.5, 2.0, 0.6), 0.5), ((1.5, 3.0, 1.5), 0.8), ((-2.0, 4.0, 0.5), 1.5))
        )
    } | {
        "wall": glowing(
            {
                "type": "cube",
                "to_world": T().translate([0, 6, 0]).rotate([1, 0, 0], 20).scale([4, 0.1, 4]),
            },
            2,
            2,
            2,
        )
    }


@pytest.mark.parametrize(
    "twist, quotient, size, seeds",
    [
        (1, True, 192, 4),
        *(
            pytest.param(*case, 256, 20, marks=pytest.mark.verify)
            for case in ((1, False), (3, False), (0, True), (1, True), (2, True))
        ),
    ],
)
def test_a_medium_that_absorbs_takes_the_exponential_of_each_distance(
    rgb, twist, quotient, size, seeds
):
    """A sample is dark, or as without the medium with the probability e^(−σ d): by blocks, by the
    kind of cell in which its surface is seen, and by distance. Fails on equal expectations for less
    than one seed in 30."""
    σ = 0.25
    T = mi.ScalarTransform4f()
    pictures = []
    for medium in ({}, {"medium": homogeneous(σ, 0.0)}):
        scene = {
            "type": "scene",
            "sensor": medium
            | {
                "type": "perspective",
                "fov": 80,
                "film": film(size, size),
                "to_world": T.look_at([0.45, 0.2, 0.55], [0.55, 0.9, 0.6], [0, 0, 1]),
            },
        }
        nil = {"type": "nil", "twist": float(twist), "quotient": quotient}
        aovs = {} if medium else {"aovs": "distance, cell"}
        pictures.append((mi.load_dict(scene | lamps(quotient)), mi.load_dict(nil | aovs)))

    pixel = dr.arange(mi.UInt32, size * size)
    columns = size // 16
    blocks = (pixel // size // 16) * columns + (pixel % size) // 16
    # What is counted: by block, by how many of a cell's three numbers are not 0, by distance
    counts = (columns * columns, 4, 13)
    excess = [dr.zeros(mi.Float64, n) for n in counts]
    variance = [dr.zeros(mi.Float64, n) for n in counts]
    light = dr.zeros(mi.Float64, 4)
    for seed in range(seeds):
        clear, foggy = (
            mi.render(scene, integrator=integrator, seed=seed, spp=1)
            for scene, integrator in pictures
        )
        channels = clear.shape[2]

        def channel(image, i):
            return dr.gather(mi.Float, image.array, pixel * image.shape[2] + i)

        first = channels - 4
        glow, distance = channel(clear, 0), channel(clear, first)
        cell = [channel(clear, first + 1 + axis) for axis in range(3)]
        passed = dr.exp(-σ * distance)
        seen = channel(foggy, 0)
        # To rounding: nothing else can happen to a sample, but beside silhouettes
        odd = (seen > 0) & (dr.abs(seen - glow) > 1e-5 * glow)
        assert dr.count(odd)[0] <= 2e-3 * size * size
        kind = sum(dr.select(c != 0, mi.UInt32(1), 0) for c in cell)
        groups = blocks, kind, mi.UInt32(dr.minimum(distance, 12))
        for e, s, group in zip(excess, variance, groups):
            dr.scatter_add(e, mi.Float64(seen - glow * passed), group)
            dr.scatter_add(s, mi.Float64(dr.square(glow) * passed * (1 - passed)), group)
        dr.scatter_add(light, mi.Float64(glow * passed), kind)
        dr.eval(excess, variance, light)

    pooled = dr.sum(excess[0])[0] / math.sqrt(dr.sum(variance[0])[0])
    resolved = math.sqrt(dr.sum(variance[0])[0]) / dr.sum(light)[0]
    print(f"twist {twist} quotient {quotient}: z {pooled:.2f}, resolved {100 * resolved:.3f} %")
    assert resolved < 0.01
    assert abs(pooled) < POOLED_Z
    if quotient:
        # Through faces, edges and corners
        assert dr.all(light[1:] > 0.05 * dr.sum(light))
    for e, s in zip(excess, variance):
        z = dr.select(s > 0, e * dr.rsqrt(s), 0)
        assert dr.all(dr.abs(z) < sidak(len(z))), z


# ------------------------------------------------------------------ coloured absorption


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_coloured_extinction_absorbs_by_its_exponential_in_every_channel(variant):
    """What passes shows all channels of a path at once, each e^(−σ d) over the mean of all, and it
    passes with that mean as probability. Fails on equal expectations for one seed in 500."""
    mi.set_variant(variant)
    count = 2**15
    if mi.is_spectral:
        σ_t = {"type": "irregular", "wavelengths": "360, 830", "values": "0.1, 1.04"}
        glow = {"type": "uniform", "value": 2.0}
        u = (mi.Float(dr.arange(mi.UInt32, count)) + 0.5) / count
        wavelengths = mi.Spectrum(
            *(400 + 300 * (u + i / 4 - dr.floor(u + i / 4)) for i in range(4))
        )
        extinction = [0.1 + (λ - 360) * 0.002 for λ in wavelengths]
    else:
        σ_t, glow, wavelengths = (
            {"type": "rgb", "value": [0.1, 0.4, 1.0]},
            {"type": "rgb", "value": [2.0, 2.0, 2.0]},
            None,
        )
        extinction = [mi.Float(σ) for σ in (0.1, 0.4, 1.0)]
    ball = truth.Sphere((0.4, 0.6, 0.45), 0.2)
    volume = {"type": "constvolume", "value": σ_t}
    scene = {
        "sensor": sensor(homogeneous(volume, 0.0)),
        "ball": ball.to_mitsuba(mi)
        | {
            "emitter": {"type": "area", "radiance": glow},
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        },
    }
    rays = Rays(scene, twist=1.0)
    random = sampler(count, 7)
    p, v = mi.Point3f(0.8, 0.1, 0.7), mi.warp.square_to_uniform_sphere(random.next_2d())
    dr.eval(v)
    ray = Array3f64(p), dr.normalize(Array3f64(v))
    hit = truth.first_hit([ball], *ray, 12.0, 1.0, True, step=0.05)
    seen = rays.radiance(p, v, random, wavelengths)

    distance = mi.Float(hit.t)
    met = mi.Bool(hit.label != truth.NO_SURFACE)
    passed = [dr.select(met, dr.exp(-σ * distance), 0) for σ in extinction]
    chance = sum(passed) / len(passed)
    whole = met & (seen[0] > 0)
    zs = []
    for found, part in zip(seen, passed):
        value = dr.select(met, 2 * part / chance, 0)
        near = dr.abs(found - value) < 1e-4 * value
        # All but those that beside a silhouette see something else
        assert dr.count(whole & ~near)[0] < 2e-3 * dr.count(whole)[0]
        variance = dr.sum(mi.Float64(dr.square(value) * chance * (1 - chance)))[0]
        zs.append(dr.sum(mi.Float64(found - 2 * part))[0] / math.sqrt(variance))
    print(variant, "z", [f"{z:.2f}" for z in zs], "passed", dr.count(whole)[0])
    assert max(map(abs, zs)) < POOLED_Z


# ------------------------------------------------------------------ energy

# A point light directly in a medium makes single paths as bright as 1/A: their variance is
# infinite. It hangs in a hollow; that it may be in a medium is what single scattering shows.
HOLLOW = 0.25
# Rays that leave the shell start on this sphere within it
INNER = 1 - 1e-4


def spiral(count):
    """Directions evenly over the sphere."""
    i = dr.arange(Float64, count)
    z = 1 - (2 * i + 1) / count
    s, c = dr.sincos(i * math.pi * (3 - math.sqrt(5)))
    r = dr.sqrt(1 - z * z)
    return Array3f64(r * c, r * s, z)


@pytest.mark.verify
@pytest.mark.parametrize(
    "twist, albedo, g, σ",
    [(0, 0.9, 0.5, 1.5), (1, 0.5, -0.7, 1.5), (2, 0.9, 0.0, 1.0)],
)
def test_what_a_point_light_sends_is_absorbed_by_a_medium_or_its_black_shell(
    rgb, twist, albedo, g, σ
):
    """What arrives at the shell, from points even in coordinate area with the weight |N|, and what
    the medium absorbs add up to 4π I within 0.3 %, four standard errors."""
    light, count = (0.2, -0.3, 0.25), 2**20
    fog = homogeneous(σ, albedo, g)
    shell = truth.Sphere((0.0, 0.0, 0.0), 1.0)
    hollow = truth.Sphere(light, HOLLOW)
    scene = {
        "sensor": sensor(fog),
        "light": {"type": "point", "position": list(light), "intensity": 1.0},
        "shell": shell.to_mitsuba(mi) | {"bsdf": {"type": "diffuse", "reflectance": 0.0}},
        "hollow": hollow.to_mitsuba(mi) | {"bsdf": {"type": "null"}, "exterior": fog},
    }
    rays = Rays(scene, twist=float(twist), quotient=False)

    # No ray finds the point light: what it sends without a scattering is known in float64
    out = Array3f64(*light), spiral(20_000)
    ends = [truth.first_hit([s], *out, 20.0, float(twist), False).t for s in (hollow, shell)]
    straight = dr.mean(dr.exp(-σ * (ends[1] - ends[0])))[0]

    arriving, absorbed, squares, seeds = 0.0, 0.0, 0.0, 2 if twist else 4
    for seed in range(seeds):
        random = sampler(count, 2 * seed)
        outward = mi.warp.square_to_uniform_sphere(random.next_2d())
        p = mi.Point3f(INNER * outward)
        N = -mi.Vector3f(outward.x, outward.y + twist * p.x * outward.z, outward.z)
        stretch = dr.norm(N)
        v = mi.Frame3f(N / stretch).to_world(mi.warp.square_to_cosine_hemisphere(random.next_2d()))
        # Times 4π, the area of a sphere
        flux = math.pi * INNER**2 * stretch * rays.radiance(p, v, random)[0]
        average, error = mean(flux)
        arriving += average / seeds
        squares += (error / seeds) ** 2

        random = sampler(count, 2 * seed + 1)
        radius = dr.cbrt(random.next_1d())
        p = mi.Point3f(radius * mi.warp.square_to_uniform_sphere(random.next_2d()))
        v = mi.warp.square_to_uniform_sphere(random.next_2d())
        fogged = dr.norm(p - mi.Point3f(*light)) > HOLLOW
        density = dr.select(fogged, σ * (1 - albedo) * rays.radiance(p, v, random)[0], 0)
        average, error = mean(4 / 3 * math.pi * density)  # times 4π, all directions
        absorbed += average / seeds
        squares += (error / seeds) ** 2

    total = straight + (1 - albedo) * (1 - straight) + arriving + absorbed
    print(
        f"twist {twist} albedo {albedo} g {g}: straight {straight:.4f}, scattered to the shell "
        f"{arriving:.4f}, absorbed on the way {absorbed:.4f}, in all {total:.5f} "
        f"± {math.sqrt(squares):.5f}"
    )
    assert math.sqrt(squares) < 0.00075
    assert abs(total - 1) < 0.003
