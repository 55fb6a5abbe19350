"""Single rays of the tracer against float64 root finding that shares no code with it."""

import nil_mitsuba  # noqa: F401 - before drjit: it chooses LLVM

# isort: split
import drjit as dr
import pytest
from drjit.llvm import Array3f64, Array3i

import truth

WIDTH = HEIGHT = 512


def camera(mi, twist, quotient, tolerance, scene, origin, target, width=WIDTH, make=None):
    """Primary rays through the pixel centres of a square image, as the integrator starts them,
    and the tracer, the package's unless ``make`` makes another."""
    from nil_mitsuba.camera import Camera
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Tracer

    space = Space(twist, quotient, [0, 0, 0], 1.0)
    tracer = (make or Tracer)(scene, space, 12.0)
    sensor = mi.load_dict({
        "type": "perspective", "fov": 70,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0.01, 0.02, 1]),
        "film": {"type": "hdrfilm", "width": width, "height": width},
    })
    index = dr.arange(mi.UInt32, width * width)
    place = mi.Point2f(index % width + 0.5, index // width + 0.5) / width
    ray, _ = sensor.sample_ray_differential(0, 0.5, place, mi.Point2f(0.5))
    p, v, cone, _ = Camera(sensor, space, tolerance).start(ray, mi.Float(0))
    return tracer, p, v, cone


SETUPS = {
    "quotient": (truth.cell_scene, True, [0.503, 0.021, 0.457], [0.531, 0.613, 0.471]),
    "plain": (truth.room_scene, False, [0.113, -1.871, 0.127], [0.031, 0.213, -0.171]),
}


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
    exact = truth.first_hit(surfaces, *wide, 12.0, twist, quotient)
    g = Array3i(*(truth.Int32(dr.detach(c)) for c in cell))
    label = truth.Int32(dr.detach(label))
    ours = truth.surface_hash(label, dr.select(label < 0, Array3i(0), g))
    theirs = truth.surface_hash(exact.label, exact.g)
    near = truth.near_silhouette(theirs, width, width)
    wrong = ours != theirs

    hit_both = ~wrong & (label >= 0)
    q = truth.multiply(Array3f64(g), Array3f64(*(truth.Float64(dr.detach(c)) for c in found_p)),
                       twist)
    error = truth.across_error(*wide, exact.t, q, twist) / (2e-5 + 2e-6 * exact.t)
    error = dr.select(hit_both, error, 0)
    far = dr.count(wrong & ~near)[0] / max(1, dr.count(~near)[0])
    close = dr.count(wrong & near)[0] / max(1, dr.count(near)[0])
    return far, close, dr.max(error)[0], dict(wrong=wrong, near=near, error=error, exact=exact,
                                              label=label, g=g, p=p, v=v, cone=cone, tracer=tracer)


# Three times what is measured: the share of rays near silhouettes that name another surface, and
# the part of their allowance by which hits are off
LIMITS = {"quotient": (3.6e-3, 0.65), "plain": (1.6e-3, 1.0)}


@pytest.mark.parametrize("kind, twist", [("quotient", 0), ("quotient", 1), ("quotient", 2),
                                         ("plain", 1), ("plain", 2)])
def test_every_ray_names_the_true_surface(rgb, kind, twist):
    far, close, error, _ = compare(rgb, kind, twist, 0.25)
    assert far == 0
    assert close <= LIMITS[kind][0]
    assert error <= LIMITS[kind][1]
    finer = compare(rgb, kind, twist, 0.25 / 4)
    assert twist == 0 or finer[1] < close


def test_shapes_that_mitsuba_merges_keep_their_box(rgb):
    """Mitsuba 3.9.1 merges meshes of one material while loading, but not their bounding boxes."""
    from nil_mitsuba.quotient import Space, scene_box
    from nil_mitsuba.tracer import Cone, Tracer

    mi = rgb
    up = mi.ScalarTransform4f().translate
    grey = {"type": "diffuse"}
    scene = mi.load_dict({"type": "scene", "floor": {"type": "rectangle", "bsdf": grey},
                          "ceiling": {"type": "rectangle", "to_world": up([0, 0, 10]),
                                      "bsdf": grey}})
    assert len(scene.shapes()) == 1
    assert scene_box(scene).max.z == 10
    tracer = Tracer(scene, Space(1.0, False, [0, 0, 0], 1.0), dr.inf)
    p, v = mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, mi.Float([1, -1]))
    hit = tracer.intersect(p, v, Cone(0, 1e-3), tracer.reach(p, v), mi.Bool(True))
    assert dr.allclose(hit.distance, 5)


def check_that_rays_end(mi, p, v, twist):
    """Each ray ends by a hit within the cube or at ``max_distance``, with finite values."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    scene = mi.load_dict({"type": "scene", **truth.to_mitsuba(truth.cell_scene(), mi)})
    tracer = Tracer(scene, Space(twist, True, [0, 0, 0], 1.0), 12.0)
    hit = tracer.intersect(p, v, Cone(0, 3e-4), tracer.reach(p, v), mi.Bool(True))
    si = surface_interaction(hit, v, tracer.space, mi.Color0f())
    dr.eval(hit, si)
    assert dr.all(~hit.valid | ((hit.distance >= 0) & (hit.distance <= 12)))
    assert dr.all(~hit.valid | dr.all((si.p > -1e-4) & (si.p < 1 + 1e-4)))
    assert dr.all(~hit.valid | (dr.abs(dr.norm(hit.arrival) - 1) < 1e-5))
    assert dr.all(~hit.valid | (dr.abs(dr.norm(si.wi) - 1) < 1e-4))
    # Most rays of this scene hit something: an empty result would pass the lines above.
    assert dr.count(hit.valid)[0] > 0.2 * dr.width(p)


@pytest.mark.parametrize("twist", [0, 1, -2])
def test_aimed_rays_end(rgb, twist):
    """Through corners and edges, along faces and edges, horizontal and vertical."""
    mi, count = rgb, 60_000
    random = mi.PCG32(count)

    def number():
        return random.next_float32()

    whole = [mi.Float(dr.floor(5 * number())) - 2 for _ in range(3)]
    p = mi.Point3f(number(), number(), number())
    starts = {
        "corner": (p, mi.Vector3f(mi.Point3f(*whole) - p)),
        "edge": (p, mi.Vector3f(whole[0] - p.x, whole[1] - p.y, number() - 0.5)),
        "along a face": (mi.Point3f(0, p.y, p.z), mi.Vector3f(0, number() - 0.5, number() - 0.5)),
        "along an edge": (mi.Point3f(p.x, 0, 0), mi.Vector3f(dr.sign(number() - 0.5), 0, 0)),
        "horizontal": (p, mi.Vector3f(number() - 0.5, number() - 0.5, 0)),
        "vertical": (p, mi.Vector3f(0, 0, dr.sign(number() - 0.5))),
    }
    p = [dr.concat([mi.Float(start[0][i]) + dr.zeros(mi.Float, count)
                    for start in starts.values()]) for i in range(3)]
    v = [dr.concat([mi.Float(start[1][i]) + dr.zeros(mi.Float, count)
                    for start in starts.values()]) for i in range(3)]
    v = mi.Vector3f(*v)
    v = dr.select(dr.norm(v) > 1e-6, dr.normalize(v), mi.Vector3f(0, 0, 1))
    check_that_rays_end(mi, mi.Point3f(*p), v, twist)


@pytest.mark.verify
@pytest.mark.parametrize("twist", [0, 1, 2, -3])
def test_ten_million_random_rays_end(rgb, twist):
    mi = rgb
    for seed in range(3):
        random = mi.PCG32(1_000_000, seed)
        p = mi.Point3f(*(random.next_float32() for _ in range(3)))
        v = mi.warp.square_to_uniform_sphere(
            mi.Point2f(random.next_float32(), random.next_float32()))
        check_that_rays_end(mi, p, v, twist)


if __name__ == "__main__":
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    print("scene     twist  tolerance  far from silhouettes  near them  error / allowance")
    for kind in SETUPS:
        for twist in (0, 1, 2):
            for tolerance in (1, 0.25, 0.0625):
                far, close, error, _ = compare(mitsuba, kind, twist, tolerance)
                print(f"{kind:9} {twist:5} {tolerance:10g} {far:21.2e} {close:10.2%} {error:8.3g}",
                      flush=True)
