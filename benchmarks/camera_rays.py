"""Prints how far camera rays are from the float64 truth, one by one, by tolerance.

By scene and twist: the share of rays that name another surface, away from silhouettes and beside
them, and the largest error across the geodesic of those that do not, in units of its allowance.
"""

import argparse

import drjit as dr
from drjit.llvm import Array3f64, Array3i

from . import truth

WIDTH = HEIGHT = 512


def camera(mi, twist, quotient, tolerance, scene, origin, target, width=WIDTH, make=None):
    """Primary rays through the pixel centres of a square image, as the integrator starts them,
    and the tracer, the package's unless ``make`` makes another."""
    from nil_mitsuba.camera import Camera
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Tracer

    space = Space(twist, quotient, [0, 0, 0], 1.0)
    tracer = make(scene, space, 12.0) if make else Tracer(scene, space, 12.0, focus=origin)
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 70,
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0.01, 0.02, 1]),
            "film": {"type": "hdrfilm", "width": width, "height": width},
        }
    )
    index = dr.arange(mi.UInt32, width * width)
    place = mi.Point2f(index % width + 0.5, index // width + 0.5) / width
    ray, _ = sensor.sample_ray_differential(0, 0.5, place, mi.Point2f(0.5))
    p, v, cone, *_ = Camera(sensor, space, tolerance).start(ray, mi.Float(0))
    return tracer, p, v, cone


SETUPS = {
    "quotient": (truth.cell_scene, True, [0.503, 0.021, 0.457], [0.531, 0.613, 0.471]),
    "plain": (truth.room_scene, False, [0.113, -1.871, 0.127], [0.031, 0.213, -0.171]),
}


# First hits that are known, by setup, twist and width
EXACT = {}


def compare(mi, kind, twist, tolerance, width=WIDTH, make=None):
    """Shares of rays that name another surface, away from silhouettes and near them, and the
    largest error across the geodesic of those that do not, in units of its allowance."""
    from nil_mitsuba.interaction import surface_interaction

    surfaces, quotient, origin, target = SETUPS[kind]
    surfaces = surfaces()
    scene = mi.load_dict({"type": "scene", **truth.to_mitsuba(surfaces, mi)})
    tracer, p, v, cone = camera(mi, twist, quotient, tolerance, scene, origin, target, width, make)
    start = mi.Point3f(p)
    hit = tracer.intersect(start, v, cone, tracer.reach(start, v), mi.Bool(True))
    si = surface_interaction(hit, v, tracer.space, mi.Color0f())
    label = mi.Int32(-1)
    for shape in scene.shapes():
        label = dr.select(hit.valid & (si.shape == mi.ShapePtr(shape)), int(shape.id()[1:]), label)
    found_p, cell = mi.Point3f(si.p), mi.Vector3i(hit.cell)
    dr.eval(hit, found_p, label, cell)

    wide = [Array3f64(*(truth.Float64(dr.detach(c)) for c in x)) for x in (p, v)]
    # The same rays, whatever the tolerance
    if (kind, twist, width) not in EXACT:
        EXACT[kind, twist, width] = truth.first_hit(surfaces, *wide, 12.0, twist, quotient)
        dr.eval(EXACT[kind, twist, width])
    exact = EXACT[kind, twist, width]
    g = Array3i(*(truth.Int32(dr.detach(c)) for c in cell))
    label = truth.Int32(dr.detach(label))
    ours = truth.surface_hash(label, dr.select(label < 0, Array3i(0), g))
    theirs = truth.surface_hash(exact.label, exact.g)
    near = truth.near_silhouette(theirs, width, width)
    wrong = ours != theirs

    hit_both = ~wrong & (label >= 0)
    q = truth.multiply(
        Array3f64(g), Array3f64(*(truth.Float64(dr.detach(c)) for c in found_p)), twist
    )
    # Beside silhouettes hits may be a chord's, which is off by a twentieth of the cone, and on the
    # first cells by a twentieth of what that is after `tracer.START`
    spread = truth.Float64(dr.detach(cone.spread))
    aside = dr.select(near, 0.05 * spread * dr.maximum(exact.t, 0.4), 0)
    allowance = 2e-5 + 2e-6 * exact.t + aside
    error = truth.across_error(*wide, exact.t, q, twist) / allowance
    error = dr.select(hit_both, error, 0)
    far = dr.count(wrong & ~near)[0] / max(1, dr.count(~near)[0])
    close = dr.count(wrong & near)[0] / max(1, dr.count(near)[0])
    return (
        far,
        close,
        dr.max(error)[0],
        dict(
            wrong=wrong,
            near=near,
            error=error,
            exact=exact,
            label=label,
            g=g,
            p=p,
            v=v,
            cone=cone,
            tracer=tracer,
        ),
    )


def main():
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few rays, to see that it runs")
    quick = parser.parse_args().quick
    width = 32 if quick else WIDTH
    twists, tolerances = ((1,), (0.25,)) if quick else ((0, 1, 2), (1, 0.25, 0.0625))
    mi.set_variant("llvm_ad_rgb")
    print("scene     twist  tolerance  far from silhouettes  near them  error / allowance")
    for kind in SETUPS:
        for twist in twists:
            for tolerance in tolerances:
                far, close, error, _ = compare(mi, kind, twist, tolerance, width)
                print(
                    f"{kind:9} {twist:5} {tolerance:10g} {far:21.2e} {close:10.2%} {error:8.3g}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
