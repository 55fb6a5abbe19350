"""How much emitter sampling along geodesics is worth, and how well it chooses among images.

Prints, for a small light in the quotient, clear and in fog, and for the bent Cornell box, the
relative MSE of BSDF and phase sampling alone over that with emitter sampling at equal time; what
roulette on shadow rays in fog is worth; and, for several receivers and lights, the variance of the
choice of one image of the light against that of an oracle, which knows the light of every image
within the distance and chooses in proportion to it.
"""

from __future__ import annotations

import argparse
import time
from unittest import mock

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from nil_mitsuba import geometry, volumetric  # noqa: E402 - after the variant is set
from nil_mitsuba.lights import Images  # noqa: E402
from nil_mitsuba.quotient import Space  # noqa: E402

# Pixels darker than this part of the mean count as if they were as bright.
DARK = 0.1


def film(size):
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}


def small_light():
    """Three balls on a floor, lit by a lamp a fiftieth of the cell wide, in the quotient."""
    T = mi.ScalarTransform4f()

    def ball(x, y, z, radius, **bsdf):
        return {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": bsdf}

    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 75,
                "film": film(64),
                "to_world": T.look_at([0.5, 0.05, 0.5], [0.5, 0.9, 0.4], [0, 0, 1]),
            },
            "floor": {
                "type": "rectangle",
                "to_world": T.translate([0.5, 0.5, 0.04]).scale([0.45, 0.45, 1]),
            },
            "a": ball(0.6, 0.6, 0.24, 0.2, type="diffuse"),
            "b": ball(0.25, 0.6, 0.18, 0.12, type="roughplastic", alpha=0.2),
            "c": ball(0.35, 0.35, 0.1, 0.06, type="roughconductor", alpha=0.3),
            "lamp": {
                "type": "sphere",
                "center": [0.4, 0.45, 0.75],
                "radius": 0.01,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [540, 500, 450]}},
            },
        }
    ), {"twist": 1.0, "quotient": True, "max_depth": 6}


def small_light_in_fog():
    """The same with a mean free path of one cell."""
    scene, parameters = small_light()
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.8}
    scene.sensors()[0].set_medium(mi.load_dict(fog))
    return scene, parameters


def bent_cornell_box():
    scene = mi.cornell_box()
    scene["sensor"]["film"] = film(64)
    return mi.load_dict(scene), {
        "twist": 1.0,
        "quotient": False,
        "max_depth": 6,
        "cell_origin": [-1, -1, -1],
        "cell_size": 2.0,
    }


def relative_mse(image, reference):
    square = dr.square(reference) + dr.square(DARK * dr.mean(reference))
    return dr.mean(dr.square(image - reference) / square)[0]


def timed(scene, integrator, spp, seed):
    start = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return image.array, time.perf_counter() - start


def compare_at_equal_time(name, make, goal, quick):
    scene, parameters = make()
    integrators = []
    for sampling in (True, False):
        integrator = mi.load_dict({"type": "nil"} | parameters)
        # Not a parameter: it exists to be compared with.
        integrator.emitter_sampling = sampling
        integrators.append(integrator)
    spp = 2 if quick else 256
    reference = mi.render(scene, integrator=integrators[0], spp=32 * spp, seed=99).array
    results = []
    for integrator in integrators:
        timed(scene, integrator, spp, 0)  # compiles
        runs = [timed(scene, integrator, spp, seed) for seed in (1, 2, 3, 4)]
        errors, seconds = zip(*((relative_mse(image, reference), t) for image, t in runs))
        # The shortest run is the least disturbed one.
        results.append((sum(errors) / len(errors), min(seconds)))
    (sampled, t_sampled), (found, t_found) = results
    # The mean square error goes like one over the time.
    gain = found * t_found / (sampled * t_sampled)
    print(
        f"{name}: {spp} spp with emitter sampling {sampled:.3g} in {t_sampled:.2f} s, without "
        f"{found:.3g} in {t_found:.2f} s: {gain:.1f} times lower at equal time (goal: {goal})",
        flush=True,
    )


def roulette_in_fog(quick):
    """The error times the time, by what part of its light a shadow ray must be able to bring to be
    traced every time; over that of tracing all."""
    scene, parameters = small_light_in_fog()
    integrator = mi.load_dict({"type": "nil"} | parameters)
    spp = 2 if quick else 64
    reference = mi.render(scene, integrator=integrator, spp=24 * spp, seed=99).array
    costs = {}
    for dim in (1e-9, volumetric.DIM):
        with mock.patch.object(volumetric, "DIM", dim):
            timed(scene, integrator, spp, 0)  # compiles
            runs = [timed(scene, integrator, spp, seed) for seed in (1, 2, 3, 4)]
        error = sum(relative_mse(image, reference) for image, _ in runs)
        costs[dim] = error * min(seconds for _, seconds in runs)
    every, some = costs.values()
    print(
        f"roulette on what a shadow ray in fog may bring, below {volumetric.DIM:g}: "
        f"{some / every:.2f} of the error times the time without it",
        flush=True,
    )


# ------------------------------------------------------------------ which image


def all_images(p, q, twist, max_distance):
    """Deck elements of all images that may be nearer than ``max_distance``."""
    reach = int(max_distance) + 2
    height = int(max_distance * (1 + 0.16 * abs(twist) * max_distance)) + 2
    wide, high = 2 * reach + 1, 2 * height + 1
    i = dr.arange(mi.UInt32, wide * wide * high)
    gx = mi.Int32(i % wide) - reach
    gy = mi.Int32(i // wide % wide) - reach
    # Heights are counted from the receiver along the fibre, in the symmetric coordinate.
    dy = gy + (q[1] - p[1])
    rise = twist * (gx * q[1] - p[0] * dy - 0.5 * dy * (gx + (q[0] - p[0])))
    return mi.Vector3i(gx, gy, mi.Int32(i // (wide * wide)) - height - mi.Int32(dr.round(rise)))


def choice_against_oracle(p, n, q, twist, max_distance):
    """Variance of cos θ / (A p_g) with p_g as `Images` chooses, and with p_g ~ 1/A."""
    space = Space(float(twist), True, [0, 0, 0], 1.0)
    g = all_images(p, q, twist, max_distance)
    start, light = mi.Point3f(*p), mi.Point3f(*q)
    way = geometry.connect(
        start, geometry.multiply(mi.Point3f(g), light, float(twist)), float(twist)
    )
    probability = Images(space, max_distance).probability(start, light, g)
    reached = way.distance <= max_distance
    brightness = dr.select(reached, dr.rcp(way.area_density), 0)
    cosine = dr.maximum(dr.dot(mi.Vector3f(*n), mi.Vector3f(way.direction)), 0)
    value = brightness * cosine
    mean = dr.sum(mi.Float64(value))[0]
    ours = dr.sum(mi.Float64(dr.select(reached, dr.square(value) / probability, 0)))[0] - mean**2
    oracle = (
        dr.sum(mi.Float64(brightness))[0] * dr.sum(mi.Float64(brightness * dr.square(cosine)))[0]
        - mean**2
    )
    return dr.count(reached)[0], ours / mean**2, oracle / mean**2


PAIRS = [  # receiver, its normal, light
    ((0.42, 0.44, 0.05), (0, 0, 1), (0.5, 0.5, 0.95)),
    ((0.31, 0.42, 0.17), (0, 0, 1), (0.62, 0.55, 0.71)),
    ((0.31, 0.42, 0.17), (0, -1, 0), (0.62, 0.55, 0.71)),
    ((0.05, 0.93, 0.52), (0.36, -0.48, 0.8), (0.97, 0.11, 0.13)),
    ((0.20, 0.20, 0.20), (0, 0, 1), (0.7, 0.7, 0.7)),
    ((0.55, 0.45, 0.50), (1, 0, 0), (0.62, 0.5, 0.55)),
    ((0.90, 0.10, 0.90), (0, 1, 0), (0.1, 0.9, 0.1)),
    ((0.50, 0.90, 0.30), (0, 0, -1), (0.5, 0.4, 0.6)),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples, shorter distances")
    quick = parser.parse_args().quick

    print("relative MSE")
    compare_at_equal_time("small light in the quotient", small_light, 10, quick)
    compare_at_equal_time("the same in fog", small_light_in_fog, 10, quick)
    roulette_in_fog(quick)
    compare_at_equal_time("bent Cornell box", bent_cornell_box, 3, quick)

    print(
        "choice of an image: variance over squared mean of cos θ / A, drawn as Images does and "
        "in proportion to 1/A, and their ratio (goal: 2)"
    )
    ratios = []
    for max_distance in (5.0,) if quick else (5.0, 12.0):
        for twist in (1,) if quick else (0, 1, 2):
            for p, n, q in PAIRS:
                count, ours, oracle = choice_against_oracle(p, n, q, twist, max_distance)
                ratios.append(ours / oracle)
                print(
                    f"  twist {twist}, {count:6} images within {max_distance:g}: {ours:6.2f} "
                    f"{oracle:6.2f} {ours / oracle:5.2f}",
                    flush=True,
                )
    print(f"median ratio {sorted(ratios)[len(ratios) // 2]:.2f}, worst {max(ratios):.2f}")


if __name__ == "__main__":
    main()
