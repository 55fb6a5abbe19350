"""What is known of a triangle that was hit is what Mitsuba says of it, and lies on its plane."""

import functools
import math

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film, write_curve, write_obj, write_ply

ROUNDING = 2**-24
# Corners that are off a plane, of which half has no extent in uv
SADDLE = [(0, 0, 0), (1, 0, 0.3), (0, 1, 0.2), (1, 1, -0.4)]
SADDLE_UV = {"apart": [(0, 0), (1, 0), (0, 1), (1, 1)], "alike": [(0.4, 0.3)] * 3 + [(1, 1)]}


def saddle(uv=None, **properties):
    """A mesh of two triangles, made in Python."""
    props = mi.Properties()
    for name, value in properties.items():
        props[name] = value
    mesh = mi.Mesh("saddle", 4, 2, has_vertex_texcoords=uv is not None, props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [c for corner in SADDLE for c in corner]
    parameters["faces"] = [0, 1, 2, 1, 3, 2]
    if uv is not None:
        parameters["vertex_texcoords"] = [c for corner in SADDLE_UV[uv] for c in corner]
    parameters.update()
    return mesh


def things(folder):
    turn = mi.ScalarTransform4f().translate([0.5, 0.45, 0.1]).rotate([0.6, 0.8, 0], 50).scale(0.35)
    obj = {"type": "obj", "filename": write_obj(folder / "a.obj"), "to_world": turn}
    ply = {"type": "ply", "filename": write_ply(folder / "a.ply"), "to_world": turn}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}
    flat, flipped = {"face_normals": True}, {"flip_normals": True}
    mirror = mi.ScalarTransform4f().scale([-1, 1.3, 0.8])
    aside = mi.ScalarTransform4f().translate([0.1, 0.4, -0.2])
    return {
        "vertex normals": {"a": ply},
        "face normals": {"a": ply | flat},
        "flipped": {"a": ply | flipped},
        "flipped face normals": {"a": ply | flat | flipped},
        "uv": {"a": obj},
        "flipped, uv": {"a": obj | flipped},
        "box": {"a": {"type": "cube", "to_world": turn}},
        "mirrored box": {"a": {"type": "cube", "to_world": turn @ mirror}},
        "rectangle": {
            "a": {
                "type": "rectangle",
                "to_world": turn @ mi.ScalarTransform4f().scale([3, 2, 1]),
                "flip_normals": True,
            }
        },
        "no uv": {"a": saddle()},
        "made in Python": {"a": saddle("apart")},
        "triangle without extent in uv": {"a": saddle("alike")},
        "the same, flipped": {"a": saddle("alike", flip_normals=True)},
        "several": {
            "a": ply | flipped,
            "b": obj | {"to_world": aside @ turn},
            "c": {"type": "cube", "to_world": aside @ aside @ turn, "lamp": lamp},
            "d": saddle("alike"),
        },
        "merged": {
            "a": ply | {"bsdf": {"type": "ref", "id": "grey"}},
            "b": ply | {"to_world": aside @ turn, "bsdf": {"type": "ref", "id": "grey"}},
            "grey": {"type": "diffuse", "id": "grey"},
        },
        "other shapes": {
            "a": ply,
            "b": {"type": "sphere", "center": [0.9, 0.9, 0.1], "radius": 0.3, "lamp": lamp},
            "c": {"type": "bsplinecurve", "filename": write_curve(folder / "a.txt")},
            "group": {"type": "shapegroup", "child": ply},
            "d": {
                "type": "instance",
                "group": {"type": "ref", "id": "group"},
                "to_world": aside,
            },
            "e": saddle("alike"),
        },
        "no meshes": {"a": {"type": "sphere", "center": [0.5, 0.45, 0.1], "radius": 0.5}},
    }


KINDS = [
    "vertex normals", "face normals", "flipped", "flipped face normals", "uv", "flipped, uv", "box",
    "mirrored box", "rectangle", "no uv", "made in Python", "triangle without extent in uv",
    "the same, flipped", "several", "merged", "other shapes", "no meshes",
]  # fmt: skip


def tracer_of(scene):
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.tracer import Tracer

    return Tracer(scene, Space(0.0, False, [0.0, 0.0, 0.0], 1.0), math.inf)


def looked_at(scene, rays=4000):
    """What straight rays meet, as this package says and as Mitsuba does."""
    from nil_mitsuba.interaction import surface_interaction
    from nil_mitsuba.tracer import Cone

    tracer = tracer_of(scene)
    rng = mi.PCG32(rays)
    around, within = (
        mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        for _ in range(2)
    )
    p = mi.Point3f(0.5, 0.5, 0.1) + 3 * around
    v = dr.normalize(mi.Point3f(0.5, 0.5, 0.1) + 0.9 * within - p)
    hit = tracer.intersect(p, v, Cone(0, 1e-4), tracer.reach(p, v), mi.Bool(True), mi.Float(0.25))
    pi = mi.PreliminaryIntersection3f(hit.preliminary)
    theirs = pi.compute_surface_interaction(hit.ray, mi.RayFlags.All, hit.valid)
    ours = surface_interaction(hit, v, tracer.space, hit.ray.wavelengths)
    # In one kernel, and not again for each thing that is asked of them
    dr.eval(ours, theirs, hit)
    assert rays / 10 < dr.count(hit.valid)[0] < rays
    return ours, theirs, hit, tracer


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    """``looked_at`` by kind of scene, each traced once for all tests."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("things")
    return functools.cache(lambda kind: looked_at(scene_of(things(folder)[kind])))


def scene_of(shapes):
    return mi.load_dict({"type": "scene"} | shapes)


def difference(a, b, valid):
    """The largest of any component, 0 where both are the same or nothing was hit."""
    return dr.max(dr.select(valid & (a != b), dr.abs(a - b), 0), axis=None)[0]


# ------------------------------------------------------------------ agreement


def assert_agreement(ours, theirs):
    valid = theirs.is_valid()
    for name, roundings in {"p": 16, "n": 4, "uv": 4, "dp_du": 16, "dp_dv": 16}.items():
        off = difference(getattr(ours, name), getattr(theirs, name), valid)
        # Tangents may be long
        long = max(1, dr.max(dr.select(valid, dr.norm(getattr(theirs, name)), 0))[0])
        assert off <= roundings * ROUNDING * long, name
    for name in "stn":
        frames = (getattr(si.sh_frame, name) for si in (ours, theirs))
        assert difference(*frames, valid) <= 16 * ROUNDING, name
    assert dr.all(ours.is_valid() == valid)
    for name in ("shape", "instance"):
        assert dr.all(getattr(ours, name) == getattr(theirs, name)), name
    assert dr.all(~valid | (ours.prim_index == theirs.prim_index))
    assert dr.all(~valid | (ours.time == theirs.time))


@pytest.mark.parametrize("kind", KINDS)
def test_interactions_are_mitsubas_to_rounding(rgb, met, kind):
    ours, theirs, _, _ = met(kind)
    assert_agreement(ours, theirs)


@pytest.mark.parametrize("kind", ["several", "other shapes"])
def test_hits_tell_lights_and_materials(rgb, met, kind):
    ours, theirs, _, tracer = met(kind)
    lit = ours.emitter(tracer.scene)
    assert dr.all(lit == theirs.emitter(tracer.scene))
    assert dr.all(ours.bsdf() == theirs.bsdf())
    assert dr.any(lit != None)  # noqa: E711
    radiance = [si.emitter(tracer.scene).eval(si) for si in (ours, theirs)]
    assert difference(*radiance, ours.is_valid()) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_infinite_comes_from_rays_that_meet_nothing(rgb, met, kind):
    ours, _, _, _ = met(kind)
    frame = ours.sh_frame
    for vector in (ours.p, ours.n, ours.uv, ours.dp_du, ours.dp_dv, ours.wi, frame.n):
        assert dr.all(dr.isfinite(vector), axis=None)


@pytest.mark.parametrize("name", ["vertex_color", "face_color"])
def test_attributes_of_meshes_are_read_at_the_same_point(rgb, met, name):
    ours, theirs, _, _ = met("vertex normals")
    here, there = (si.shape.eval_attribute_3(name, si, si.is_valid()) for si in (ours, theirs))
    assert difference(here, there, ours.is_valid()) < 64 * ROUNDING
    assert dr.max(here.x)[0] - dr.min(dr.select(ours.is_valid(), here.x, 1))[0] > 0.3


def test_interactions_are_mitsubas_in_spectral_variants(tmp_path):
    mi.set_variant("llvm_ad_spectral")
    try:
        ours, theirs, _, _ = looked_at(scene_of(things(tmp_path)["other shapes"]))
        assert_agreement(ours, theirs)
    finally:
        mi.set_variant("llvm_ad_rgb")


# ------------------------------------------------------------------ what a scene pays for


@pytest.mark.parametrize(
    "kind, smooth, uv",
    [
        ("vertex normals", True, False),
        ("face normals", False, False),
        ("box", False, True),
        ("rectangle", False, True),
        ("several", True, True),
    ],
)
def test_a_scene_pays_for_the_normals_and_uv_that_it_has(rgb, met, kind, smooth, uv):
    _, _, hit, _ = met(kind)
    assert (hit.triangle.normals is not None) == smooth
    assert (hit.triangle.uv is not None) == uv


def test_scenes_without_meshes_have_no_table(rgb, met):
    _, _, hit, _ = met("no meshes")
    assert hit.triangle is None


@pytest.mark.parametrize("kind, asked", [("several", 0), ("other shapes", 1)])
def test_mitsuba_is_asked_about_shapes_that_are_no_meshes(rgb, met, monkeypatch, kind, asked):
    from nil_mitsuba.interaction import surface_interaction

    _, _, hit, tracer = met(kind)
    questions = []
    ask = mi.PreliminaryIntersection3f.compute_surface_interaction

    def counted(*arguments):
        questions.append(arguments)
        return ask(*arguments)

    monkeypatch.setattr(mi.PreliminaryIntersection3f, "compute_surface_interaction", counted)
    surface_interaction(hit, mi.Vector3f(0, 0, 1), tracer.space, mi.Color0f())
    assert len(questions) == asked


# ------------------------------------------------------------------ changes of a scene


def changed_and_new(change):
    """Renders of a scene after a change and of one that was loaded so, and one from before."""

    def image(scene):
        nil = mi.load_dict({"type": "nil", "twist": 0.0, "quotient": False, "max_depth": 3})
        return mi.render(scene, integrator=nil, spp=4, seed=3).array

    board = {
        "type": "diffuse",
        "reflectance": {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale(5)},
    }
    scene, new = (
        mi.load_dict(
            {
                "type": "scene",
                "sky": {"type": "constant"},
                "sensor": {
                    "type": "perspective",
                    "film": film(16, 16),
                    "to_world": mi.ScalarTransform4f().look_at([3, 3, 3], [0.5, 0.5, 0], [0, 0, 1]),
                },
                "thing": saddle("apart", face_normals=True, bsdf=mi.load_dict(board)),
                "box": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.2)},
            }
        )
        for _ in range(2)
    )
    before = image(scene)
    for one in (scene, new):
        parameters = mi.traverse(one)
        change(parameters)
        parameters.update()
    return image(scene), image(new), before


@pytest.mark.parametrize("name", ["vertex_positions", "vertex_texcoords"])
def test_a_render_sees_what_has_changed_since_the_last_one(rgb, name):
    def change(parameters):
        parameters[f"thing.{name}"] *= 0.8

    changed, new, before = changed_and_new(change)
    assert dr.all(changed == new)
    assert dr.max(dr.abs(changed - before))[0] > 0.01


# ------------------------------------------------------------------ onto the plane


def geodesics_near_triangles(size, far, slim=1.0, reach=0.05, off=1e-5):
    """Triangles, lines by points of them, and float64's answers.

    Triangles have edges of about ``size``, the second of which may be ``slim``, and lie about
    ``far``. Returns the triangle, the arguments of `onto_plane`, the exact step and its cosine.
    """
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.triangles import Triangle

    rng = mi.PCG32(50_000)

    def direction():
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        return mi.Vector3f(mi.warp.square_to_uniform_sphere(sample))

    e1 = size * direction()
    e2 = dr.fma(slim, size * direction() - e1, e1)
    # Well within: what is off by more than the distance to an edge is not inside
    b1 = dr.fma(0.6, rng.next_float32(), 0.1)
    b2 = dr.fma(0.8 - b1, rng.next_float32(), 0.1)
    p0 = far + 0.5 * mi.Point3f(direction()) - e1 * b1 - e2 * b2
    triangle = Triangle(mi.Bool(True), p0, e1, e2, mi.Float(1), None, None, False)

    space = Space(1.0, False, [far] * 3, 1.0)
    along = dr.fma(0.5, rng.next_float32(), 1) * direction()
    step = reach * dr.fma(2, rng.next_float32(), -1)
    near = double(p0) - far + double(e1) * b1 + double(e2) * b2 - double(along) * step
    near = mi.Point3f(*(mi.Float(c) for c in near))
    n = dr.normalize(dr.cross(double(e1), double(e2)))
    exact = dr.dot(n, double(p0) - far - double(near)) / dr.dot(n, double(along))
    b = mi.Point2f(*(dr.fma(off, dr.fma(2, rng.next_float32(), -1), x) for x in (b1, b2)))
    return triangle, (b, near, along, space), exact, dr.abs(dr.dot(n, dr.normalize(double(along))))


def double(v):
    from drjit.llvm import Array3f64, Float64

    return Array3f64(*(Float64(c) for c in v))


@pytest.mark.parametrize("slim", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("size, far", [(0.01, 0.0), (1.0, 0.0), (1.0, 1000.0), (1e5, 0.0)])
def test_newtons_step_leads_onto_the_plane(rgb, size, far, slim):
    """To a few roundings of the largest coordinate, whatever the triangle and the first guess."""
    triangle, arguments, exact, cosine = geodesics_near_triangles(size, far, slim)
    step, b, good = triangle.onto_plane(*arguments)
    p0, e1, e2 = triangle.p0, triangle.e1, triangle.e2
    largest = dr.max(dr.maximum(dr.abs(p0), dr.maximum(dr.abs(p0 + e1), dr.abs(p0 + e2))))
    rounding = ROUNDING * dr.maximum(largest, 1)
    n = dr.normalize(dr.cross(double(e1), double(e2)))
    p = dr.fma(e1, b.x, dr.fma(e2, b.y, p0))
    straight = good & (cosine > 0.1)
    assert dr.mean(dr.select(good, 1.0, 0.0))[0] > 0.95

    def largest_of(x):
        return dr.max(dr.select(straight, x / rounding, 0))[0]

    assert largest_of(dr.abs(dr.dot(n, double(p) - double(p0)))) < 4
    assert largest_of(dr.abs(step - exact) * cosine) < 4
    # The point is the geodesic's: across the plane by the error of the step, and along it
    _, near, along, _ = arguments
    line = double(near) + double(along) * exact + far
    assert largest_of(dr.norm(line - double(p)) * cosine) < 8


def test_newtons_step_is_good_on_the_triangle_only(rgb):
    from nil_mitsuba.triangles import LONGEST_STEP

    triangle, (b, near, along, space), _, _ = geodesics_near_triangles(1.0, 0.0)
    # To a point of the plane beyond the edge, and back by a step along the line
    beside = mi.Point3f(near + triangle.e1 * 1.5)
    assert not dr.any(triangle.onto_plane(b, beside, along, space)[2])
    behind = mi.Point3f(near - 2.5 * LONGEST_STEP * along)
    assert not dr.any(triangle.onto_plane(b, behind, along, space)[2])
    within = mi.Vector3f(dr.normalize(triangle.e1))
    off = mi.Point3f(near + 0.1 * dr.normalize(dr.cross(triangle.e1, triangle.e2)))
    assert not dr.any(triangle.onto_plane(b, off, within, space)[2])
    triangle.valid = mi.Bool(False)
    assert not dr.any(triangle.onto_plane(b, near, along, space)[2])
