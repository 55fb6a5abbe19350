"""Empty space around a plain scene is passed in few steps, whatever the size of its box."""

import drjit as dr
import mitsuba as mi
import pytest
from drjit.llvm import Array3f64, Float64, UInt32

from benchmarks.studio import film
from nil_mitsuba import geometry

COUNT = 2_000

# Half sizes of boxes about the identity and elsewhere: a cube, a ground, a wall, a tower, a speck
BOXES = [
    ((0, 0, 0), (1, 1, 1)),
    ((0, 0, 0.5), (10, 10, 0.5)),
    ((0, 0, 0.5), (1000, 1000, 0.5)),
    ((3, 40, 0), (0.1, 60, 5)),
    ((20, -7, 200), (3, 3, 200)),
    ((60, 0, 0), (0.05, 0.05, 0.05)),
]


def box_and_rays(centre, half, seed=3):
    """A box and rays that start about it, near it as often as far from it."""
    from nil_mitsuba.box import Box

    rng = mi.PCG32(COUNT, seed)
    u = [rng.next_float32() for _ in range(6)]
    v = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    # Nearly along a fibre and nearly horizontal ones, too: the ends of the formulas
    tilt = dr.select(u[5] < 0.15, 1e-3, dr.select(u[5] > 0.85, 1e3, mi.Float(1)))
    v = dr.normalize(mi.Vector3f(v.x, v.y, v.z * tilt))
    reach = dr.power(10, 3 * u[4] - 2)
    p = (
        mi.Point3f(centre)
        + mi.Vector3f(half) * (2 * mi.Vector3f(u[2], u[3], u[1]) - 1)
        + reach * mi.warp.square_to_uniform_sphere(mi.Point2f(u[3], u[4]))
    )
    return Box(mi.Point3f(centre) - mi.Vector3f(half), mi.Point3f(centre) + mi.Vector3f(half)), p, v


def entered(box, p, v, length, twist, steps=400):
    """Whether rays come into the box, a little smaller, at one of so many points of a length."""
    p, v, length = (dr.repeat(x, steps) for x in (Array3f64(p), Array3f64(v), Float64(length)))
    part = (Float64(dr.arange(UInt32, COUNT * steps) % steps) + 0.5) / steps
    q, _ = geometry.flow(p, v, length * part, twist)
    # The rounding of float32, of the point that the box was asked for
    slack = 1e-5 * (1 + dr.max(dr.abs(q)))
    return dr.all((q > Array3f64(box.lower) + slack) & (q < Array3f64(box.upper) - slack))


@pytest.mark.parametrize("twist", [1.0, -1.0, 3.0, 0.0, 1e-4])
@pytest.mark.parametrize("centre, half", BOXES)
def test_what_a_box_calls_clear_is_clear(rgb, centre, half, twist):
    """By points of float64 geodesics; those that never come are followed for 300 cells."""
    from nil_mitsuba.box import Passage

    box, p, v = box_and_rays(centre, half)
    free = box.clearance(p, v, Passage(p, v, mi.Float(twist)))
    assert dr.all((free == 0) | box.excludes(p))[0]
    length = dr.select(dr.isfinite(free), free, 300)
    # Those that start in the box are in it
    came = entered(box, p, v, length, twist) & dr.repeat(mi.Bool(free > 0), 400)
    assert not dr.any(came)[0]


def steps_outside(box, p, v, twist):
    """Steps until rays are back at the box, or gone for good, and the share that takes over 200."""
    from nil_mitsuba.box import Passage

    k = mi.Float(twist)
    passage = Passage(p, v, k)
    t, q, d = mi.Float(0), mi.Point3f(p), mi.Vector3f(v)
    steps, outside = dr.zeros(mi.Float, COUNT), mi.Bool(True)
    for _ in range(200):
        free = box.clearance(q, d, passage)
        # From a tenth of a cell on it is left to a chord
        outside &= (free > 0.1) & (t < 1e6)
        t = dr.select(outside, t + free, t)
        steps += dr.select(outside, 1, 0)
        q, d = geometry.flow(p, v, dr.minimum(t, 1e6), k)
        dr.eval(t, q, d, steps, outside)
    return dr.mean(steps)[0], dr.count(outside)[0] / COUNT


@pytest.mark.parametrize("twist", [1.0, -1.0, 3.0])
@pytest.mark.parametrize("centre, half", BOXES)
def test_a_ray_is_back_or_gone_for_good_after_a_few_steps(rgb, centre, half, twist):
    """However many turns lie between: from all about a box, and off its upper face."""
    box, p, v = box_and_rays(centre, half)
    above = mi.Point3f(p.x, p.y, box.upper.z + 1e-4)
    for start in (p, above):
        steps, over = steps_outside(box, start, v, twist)
        assert steps < 20 and over < 0.01, (steps, over)


def mesh(vertices, faces):
    result = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mi.Float([c for vertex in vertices for c in vertex])
    parameters["faces"] = mi.UInt32([i for face in faces for i in face])
    parameters.update()
    return result


TRIANGLES = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0.5)], [(0, 1, 2), (1, 3, 2)]


@pytest.mark.parametrize("far", [1e6, dr.inf, dr.nan])
def test_a_vertex_that_no_triangle_uses_does_not_count(rgb, far):
    from nil_mitsuba.shapes import Shapes

    vertices, faces = TRIANGLES
    shapes = Shapes(mi.load_dict({"type": "scene", "m": mesh([*vertices, (far, 0, far)], faces)}))
    assert (list(shapes.box.min), list(shapes.box.max)) == ([0, 0, 0], [1, 1, 0.5])
    assert shapes.extents[0].lost == ""


@pytest.mark.parametrize("bad", [dr.inf, -dr.inf, dr.nan, 1e30])
@pytest.mark.parametrize("quotient", [False, True])
@pytest.mark.parametrize("twist", [0.0, 1.0])
def test_a_triangle_without_a_place_is_named_and_the_others_are_seen(
    rgb, bad, quotient, twist, capfd
):
    """At twist 0 it made the whole mesh vanish, at twist 1 the render had no end."""
    vertices, faces = TRIANGLES
    spoilt = mesh([*vertices, (0.5, bad, 0.2)], [*faces, (0, 1, 4)])
    pictures = []
    for one in (mesh(vertices, faces), spoilt):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sky": {"type": "constant"},
                "spoilt": one,
                "sensor": {
                    "type": "perspective",
                    "film": {"type": "hdrfilm", "width": 8, "height": 8},
                    "to_world": mi.ScalarTransform4f().look_at(
                        [0.5, 0.3, 0.9], [0.5, 0.5, 0.1], [0, 1, 0]
                    ),
                },
            }
        )
        nil = mi.load_dict(
            {
                "type": "nil",
                "quotient": quotient,
                "twist": twist,
                "max_depth": 1,
                "max_distance": 3.0,
                "aovs": "distance",
            }
        )
        image = mi.render(scene, integrator=nil, spp=1)
        pictures.append(image[:, :, 3].array)
    assert dr.allclose(*pictures, rtol=1e-5) and dr.any(pictures[0] > 0)[0]
    warning = "1 of its 3 triangles have corners that are no numbers up to 1e15"
    assert warning in capfd.readouterr().out


def ground(half):
    """The layers of a ball on a ground of a half size, with the light of an even sky."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "ground": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half)},
            "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
            "sensor": {
                "type": "perspective",
                "film": film(32, 32),
                "to_world": mi.ScalarTransform4f().look_at([0, -4, 1.5], [0, 0, 0.5], [0, 0, 1]),
            },
        }
    )
    nil = mi.load_dict(
        {"type": "nil", "quotient": False, "max_depth": 3, "aovs": "distance, position"}
    )
    return mi.render(scene, integrator=nil, spp=1)


def test_a_larger_ground_shows_the_same_things_near_the_camera(rgb):
    """Rays end on a ground of 100,000 cells, too, and what is near is where it was."""
    small = ground(10.0)
    for half in (1000.0, 1e5):
        large = ground(half)
        assert dr.all(dr.isfinite(large.array))[0]
        # No ray has been beyond the smaller ground in five cells
        near = (small[:, :, 3].array > 0) & (small[:, :, 3].array < 5)
        moved = [dr.abs(small[:, :, i].array - large[:, :, i].array) for i in range(3, 7)]
        assert dr.count(near)[0] > 300
        # Mitsuba's own hits on a rectangle are as exact as its size
        limit = 1e-3 + 2**-22 * half
        assert dr.count(near & (dr.max(mi.Vector4f(*moved)) > limit))[0] <= 0.002 * len(near)


def box(lower, upper):
    return mi.ScalarBoundingBox3f(lower, upper)


def test_far_things_have_boxes_of_their_own(rgb):
    """A tower, or a ball far up, leaves the sky over a ground empty; a room is one box."""
    from nil_mitsuba.box import gathered

    ground, tower = box([-10, -10, 0], [10, 10, 0]), box([1, 1, 0], [2, 2, 1e5])
    ball, far = box([0, 0, 0], [1, 1, 1]), box([0, 0, 1e4], [1, 1, 1e4 + 1])
    assert len(gathered([ground, ball, tower], 1.0)) == 2
    assert len(gathered([ground, ball, far], 1.0)) == 2
    walls = [box([0, 0, 0], [1, 1, 0]), box([0, 0, 0], [0, 1, 1]), box([0, 0, 1], [1, 1, 1])]
    assert len(gathered([*walls, box([0.3, 0.3, 0], [0.6, 0.6, 0.5])], 1.0)) == 1
    # Whatever there is lies in one of them, and they are few
    many = [box([i**3, -i, i], [i**3 + 1, i, i + 2]) for i in range(20)]
    few = gathered(many, 1.0)
    assert len(few) <= 4
    assert all(any(b.contains(one.min) and b.contains(one.max) for b in few) for one in many)
