"""Surfaces in Nil's orthonormal frame: normals, shading frames, and the next ray's start."""

import functools
import math

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film, place, texture, write_ply
from nil_mitsuba import geometry


def scene_of(thing):
    return mi.load_dict({"type": "scene", "thing": thing})


def surfaces(folder):
    bumps = {"type": "bumpmap", "texture": texture(), "bsdf": {"type": "diffuse"}}
    turn = mi.ScalarTransform4f().translate([1.2, -0.7, 0.4]).rotate([0.6, 0.8, 0], 50)
    return {
        "sphere": {"type": "sphere", "to_world": turn},
        "ply": {"type": "ply", "filename": write_ply(folder / "a.ply"), "to_world": turn},
        "cylinder": {"type": "cylinder", "to_world": turn},
        "mirrored": {
            "type": "cube",
            "bsdf": bumps,
            "to_world": turn @ mi.ScalarTransform4f().scale([-1, 1.3, 0.8]),
        },
        "rectangle": {"type": "rectangle", "to_world": turn},
    }


KINDS = ["sphere", "ply", "cylinder", "mirrored", "rectangle"]


def hits(thing, twist, rays=2000):
    """Interactions of geodesics from all around with a thing, in Nil and as Mitsuba gives them."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    space = Space(twist, False, [0.0, 0.0, 0.0], 1.0)
    scene = scene_of(thing)
    tracer = Tracer(scene, space, math.inf)
    rng = mi.PCG32(rays)
    around = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    centre = mi.Point3f(1.2, -0.7, 0.4)
    p = centre + 3 * around
    within = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    way = geometry.connect(p, mi.Point3f(centre + 0.4 * within), twist)
    v = mi.Vector3f(way.direction)
    p = mi.Point3f(p)
    hit = tracer.intersect(p, v, Cone(0, 1e-4), tracer.reach(p, v), mi.Bool(True))
    si = surface_interaction(hit, v, space, mi.Color0f())
    straight = hit.preliminary.compute_surface_interaction(hit.ray, mi.RayFlags.All, hit.valid)
    # In one kernel, and not again for each thing that is asked of them
    dr.eval(hit, si, straight)
    assert dr.count(hit.valid)[0] > rays / 4
    return hit, si, straight, space, scene


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    """``hits`` by kind of thing, each traced once for all tests."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("things")
    return functools.cache(lambda kind, *arguments: hits(surfaces(folder)[kind], *arguments))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0])
def test_shading_frame_is_orthonormal_and_as_handed_as_mitsubas(rgb, met, kind, twist):
    hit, si, straight, _, _ = met(kind, twist)
    s, t, n = si.sh_frame.s, si.sh_frame.t, si.sh_frame.n
    valid = hit.valid
    for a, b, product in ((s, s, 1), (t, t, 1), (n, n, 1), (s, t, 0), (s, n, 0), (t, n, 0)):
        assert dr.all(~valid | (dr.abs(dr.dot(a, b) - product) < 3e-6))
    handed = dr.dot(dr.cross(s, t), n)
    theirs = dr.dot(dr.cross(straight.sh_frame.s, straight.sh_frame.t), straight.sh_frame.n)
    assert dr.all(~valid | (handed * theirs > 0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("twist", [1.0, 3.0])
def test_normal_is_orthogonal_to_what_the_frame_makes_of_tangents(rgb, met, kind, twist):
    """Tangents are those of the straight scene: a normal carried over as a vector would fail."""
    hit, si, straight, space, _ = met(kind, twist)
    p = space.to_cells(si.p)
    a, b = dr.normalize(straight.dp_du), dr.normalize(straight.dp_dv)
    a, b = (dr.normalize(x - straight.n * dr.dot(straight.n, x)) for x in (a, b))
    for tangent in (a, b):
        image = mi.Vector3f(geometry.to_frame(p, tangent, twist))
        assert dr.all(~hit.valid | (dr.abs(dr.dot(si.n, image)) < 1e-5 * (1 + dr.norm(image))))
    assert dr.all(~hit.valid | (dr.abs(dr.norm(si.n) - 1) < 3e-6))
    # It stays on the same side of the surface.
    outward = mi.Vector3f(geometry.to_frame(p, straight.n, twist))
    assert dr.all(~hit.valid | (dr.dot(si.n, outward) > 0))


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "rectangle"])
def test_shading_normal_of_a_surface_without_interpolation_is_its_normal(rgb, met, kind):
    hit, si, _, _, _ = met(kind, 3.0)
    assert dr.all(~hit.valid | (dr.norm(si.sh_frame.n - si.n) < 1e-5))


@pytest.mark.parametrize("twist", [1.0, 3.0])
def test_normal_is_the_gradient_of_distance_to_the_surface(rgb, twist):
    """On a sphere of coordinates: derivatives of |p − c|² along the frame's own flows."""
    hit, si, _, space, _ = hits({"type": "sphere", "center": [1.2, -0.7, 0.4]}, twist)
    p = space.to_cells(si.p)

    def level(q):
        return dr.squared_norm(q - mi.Point3f(1.2, -0.7, 0.4))

    step = 1e-2
    gradient = mi.Vector3f(
        *(
            level(mi.Point3f(geometry.flow(p, mi.Vector3f(*axis), step, twist)[0]))
            - level(mi.Point3f(geometry.flow(p, mi.Vector3f(*axis), -step, twist)[0]))
            for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        )
    )
    assert dr.all(~hit.valid | (dr.norm(dr.normalize(gradient) - si.n) < 1e-3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0])
def test_interactions_hold_no_nan(rgb, met, kind, twist):
    hit, si, _, _, _ = met(kind, twist)
    for name in ("p", "n", "dp_du", "dp_dv", "uv", "wi"):
        for component in getattr(si, name):
            assert dr.all(~hit.valid | dr.isfinite(component)), name
    assert dr.all(~hit.valid | (dr.abs(dr.norm(si.wi) - 1) < 1e-5))
    assert dr.all(dr.isfinite(si.wi.x + si.wi.y + si.wi.z))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0, -2.0])
def test_hits_are_seen_from_the_side_they_are_hit_from(rgb, met, kind, twist):
    """The traced line and the geodesic's direction agree about the side, grazing hits included."""
    hit, si, straight, _, _ = met(kind, twist, 200_000)
    traced = dr.dot(hit.ray.d, straight.n)
    seen = -dr.dot(si.to_world(si.wi), si.n)
    assert dr.all(~hit.valid | (traced * seen > 0))


@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("cell", [(0.0, 1.0), (-5.0, 10.0), (0.3, 0.1)])
def test_offset_leaves_the_surface_on_the_side_of_the_direction(rgb, twist, cell):
    """By the margin, along the surface's Euclidean normal, but for the rounding of coordinates."""
    from nil_mitsuba.interaction import offset, unit_conormal
    from nil_mitsuba.quotient import Space

    origin, size = cell
    space = Space(twist, False, [origin] * 3, size)
    i = dr.arange(mi.Float, 500)
    n = dr.normalize(mi.Normal3f(dr.sin(i), dr.cos(2 * i), dr.sin(3 * i + 1)))
    p = mi.Point3f(dr.cos(5 * i), dr.sin(7 * i), dr.cos(11 * i)) * 2
    conormal = unit_conormal(space.to_cells(p), n, space)
    for side in (1, -1):
        towards = dr.normalize(mi.Vector3f(dr.sin(13 * i), dr.cos(17 * i), dr.sin(19 * i)))
        towards = dr.mulsign(towards, dr.dot(towards, conormal)) * side
        start = space.to_scene(offset(p, conormal, towards, mi.Float(1e-3), space))
        rounding = 2**-22 * (max(map(abs, cell)) + dr.max(dr.abs(p)))
        assert dr.all(dr.abs(dr.dot(start - p, n) * side - 1e-3) < rounding)
        assert dr.all(dr.norm(start - p) < 1e-3 + 2 * rounding)


# ------------------------------------------------------------------ emission


@pytest.mark.parametrize("twist, quotient", [(1.0, False), (3.0, False), (1.0, True)])
def test_emission_follows_the_texture_of_the_point_that_is_hit(rgb, twist, quotient):
    """A texture whose value is its own u and v, seen along single geodesics."""
    values = [
        c for y in range(64) for x in range(64) for c in ((x + 0.5) / 64, (y + 0.5) / 64, 0.25)
    ]
    ramp = {
        "type": "bitmap",
        "raw": True,
        "wrap_mode": "clamp",
        "data": mi.TensorXf(values, shape=(64, 64, 3)),
    }
    ball = {
        "type": "sphere",
        "center": [0.6, 0.5, 0.4],
        "radius": 0.3,
        "light": {"type": "area", "radiance": ramp},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": ball,
            "sensor": {
                "type": "perspective",
                "fov": 1,
                "film": film(2, 2),
                "near_clip": 1e-3,
                "to_world": mi.ScalarTransform4f().look_at(
                    [0.05, 0.3, 0.4], [0.6, 0.5, 0.4], [0, 0, 1]
                ),
            },
        }
    )
    integrator = mi.load_dict({"type": "nil", "twist": twist, "quotient": quotient, "max_depth": 1})
    image = mi.render(scene, integrator=integrator, spp=64)
    hit, si = look_at(scene, twist, quotient)
    middle = [
        sum(float(image[y, x, c].array[0]) for x in range(2) for y in range(2)) / 4
        for c in range(3)
    ]
    assert middle[0] == pytest.approx(float(si.uv.x[0]), abs=0.02)
    assert middle[1] == pytest.approx(float(si.uv.y[0]), abs=0.02)
    assert middle[2] == pytest.approx(0.25, rel=1e-4)


def look_at(scene, twist, quotient):
    """What the middle ray of the scene's camera meets."""
    from nil_mitsuba.camera import Camera
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Tracer

    space = Space(twist, quotient, [0.0, 0.0, 0.0], 1.0)
    sensor = scene.sensors()[0]
    ray, _ = sensor.sample_ray_differential(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    p, v, cone, *_ = Camera(sensor, space, 0.25).start(ray, mi.Float(0))
    tracer = Tracer(scene, space, 12.0)
    hit = tracer.intersect(mi.Point3f(p), v, cone, tracer.reach(p, v), mi.Bool(True))
    assert hit.valid[0]
    return hit, surface_interaction(hit, v, space, mi.Color0f())


@pytest.mark.parametrize("name", ["vertex_color", "face_color"])
def test_emission_follows_the_attributes_of_a_mesh(rgb, name, tmp_path):
    """Each pixel shows a value between those of the corners that it sees."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "film": film(16, 16),
                "to_world": mi.ScalarTransform4f().look_at([-3, 0, 0], [0, 0, 0], [0, 0, 1]),
            },
            "mesh": {
                "type": "ply",
                "filename": write_ply(tmp_path / "a.ply"),
                "to_world": place(0, 0),
                "light": {"type": "area", "radiance": {"type": "mesh_attribute", "name": name}},
            },
        }
    )
    integrator = mi.load_dict({"type": "nil", "twist": 1.0, "quotient": False, "max_depth": 1})
    image = mi.render(scene, integrator=integrator, spp=16)
    red, green, blue = (image[4:12, 4:12, c].array for c in range(3))
    lit = red > 0
    assert dr.count(lit)[0] > 20
    assert dr.max(red)[0] - dr.min(dr.select(lit, red, 1))[0] > 0.1
    if name == "face_color":
        # Faces of 0.3 and 0.5 in green and blue, or a share of them at the silhouette
        assert dr.all(~lit | (dr.abs(green / 0.3 - blue / 0.5) < 1e-4))


@pytest.mark.parametrize("instanced", [False, True], ids=["alone", "in an instance"])
def test_a_curve_runs_on_to_its_very_end(rgb, tmp_path, instanced):
    """Tangents there are those of its last segment, not of what follows in memory."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Cone, Tracer

    # A coil that starts along y and ends along -x; of many segments, as places on those are rounded
    # so much that not one hit in a million is at the end, but one in a thousand
    points, turns, height, radius = 20_000, 100.25, 3.0, 1e-3
    step = 2 * math.pi * turns / (points - 1)
    file = tmp_path / "coil.txt"
    file.write_text(
        "\n".join(
            f"{math.cos(step * i)} {math.sin(step * i)} {height * i / points} {radius}"
            for i in range(points)
        )
    )
    curve = {"type": "bsplinecurve", "filename": str(file)}
    scene = {"type": "scene", "curve": curve}
    if instanced:
        ball = {"type": "sphere", "center": [5, 0, 0]}
        scene = {
            "type": "scene",
            "group": {"type": "shapegroup", "ball": ball, "curve": curve},
            "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}},
            "other": {"type": "sphere", "center": [-5, 0, 0]},
        }
    scene, space = mi.load_dict(scene), Space(0.0, False, [0.0, 0.0, 0.0], 1.0)
    tracer = Tracer(scene, space, math.inf)
    rng = mi.PCG32(200_000)
    across = math.pi * rng.next_float32()
    v = mi.Vector3f(0, dr.cos(across), -dr.sin(across))
    # From above onto the last segments, three or so
    p = mi.Point3f(4 * step * rng.next_float32(), 1, height) - 0.1 * v
    hit = tracer.intersect(p, v, Cone(0, 1e-4), tracer.reach(p, v), mi.Bool(True))
    # Says so, and reads zeros, where Dr.Jit would read from behind an array
    with dr.scoped_set_flag(dr.JitFlag.Debug, True):
        si = surface_interaction(hit, v, space, mi.Color0f())
        dr.eval(si)
    segments = points - 3
    # Others have passed the end and met turns below
    met = hit.valid & (hit.preliminary.prim_index >= segments - 5)
    last = met & (hit.preliminary.prim_index == segments - 1)
    assert dr.count(last & (hit.preliminary.prim_uv.x > 1 - 2**-21 * segments))[0] > 50
    assert dr.all(~met | (dr.normalize(si.dp_dv).x < -0.9))
