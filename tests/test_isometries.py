"""Moving scene and camera together by an isometry of Nil, or of its quotient, changes nothing.

Images are compared by `assert_same_expectation`, which fails on equal expectations with a
probability of at most 0.0024 for a random seed; the seeds are fixed.
"""

import math

import drjit as dr
import mitsuba as mi
import pytest
from drjit.llvm import Array3f64

from benchmarks.studio import ICOSAHEDRON, faces, film, write_ply
from nil_mitsuba import geometry
from ztest import Estimate, assert_same_expectation, z_scores


def multiply(h, p, twist):
    return (h[0] + p[0], h[1] + p[1], h[2] + p[2] + twist * h[0] * p[1])


def translation(h, twist):
    """The left translation by ``h``: what it does to points, and to frame components (nothing)."""
    return lambda p: multiply(h, p, twist), lambda v: tuple(v)


def half_turn(axis):
    """About the x, y or z axis through the group's identity; directions turn with it."""
    signs = [1 if i == axis else -1 for i in range(3)]
    turn = lambda p: tuple(s * c for s, c in zip(signs, p))  # noqa: E731
    return turn, turn


def identity():
    return lambda p: tuple(p), lambda v: tuple(v)


def photograph(move, things, camera, integrator, folder, spp, seed):
    """Image of meshes (vertices and triangles, in cells) by a camera, all moved by an isometry."""
    point, direction = move
    origin, frame = camera
    x, y, z = (direction(axis) for axis in frame)
    o = point(origin)
    matrix = [[x[i], y[i], z[i], o[i]] for i in range(3)] + [[0, 0, 0, 1]]
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "film": film(48, 48),
            "near_clip": 0.05,
            "to_world": mi.ScalarTransform4f(matrix),
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.2}},
    }
    for i, (vertices, triangles, shine) in enumerate(things):
        moved = [point(v) for v in vertices]
        if integrator.get("quotient", True):
            # A thing is seen if one of its copies lies in the cube.
            cell = [math.floor(sum(v[j] for v in moved) / len(moved)) for j in range(3)]
            k = integrator["twist"]
            back = (-cell[0], -cell[1], 0)
            moved = [multiply(back, v, k) for v in moved]
            lift = math.floor(sum(v[2] for v in moved) / len(moved))
            moved = [(v[0], v[1], v[2] - lift) for v in moved]
            assert all(0 < c < 1 for v in moved for c in v), "a thing sticks out of the cube"
        # A half-turn keeps the order of a triangle's corners: it is a rotation.
        file = write_ply(folder / f"{seed}_{i}.ply", moved, triangles)
        colour = {"type": "mesh_attribute", "name": "vertex_color"}
        thing = {"type": "ply", "filename": file, "face_normals": True}
        if shine:
            thing["light"] = {"type": "area", "radiance": {"type": "rgb", "value": shine}}
        thing["bsdf"] = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
        scene[f"thing{i}"] = thing
    return Estimate(mi.load_dict(scene), integrator, spp, seed)


def solid(centre, size):
    return [tuple(c + size * x for c, x in zip(centre, v)) for v in ICOSAHEDRON], faces(ICOSAHEDRON)


def look(direction):
    """Right, up and forward of a camera that looks along a horizontal direction and a little up."""
    norm = math.hypot(*direction)
    z = [c / norm for c in direction]
    across = math.hypot(z[0], z[1])
    x = [z[1] / across, -z[0] / across, 0.0]
    y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]]
    # Mitsuba's cameras are left-handed: x to the left.
    return [-c for c in x], y, z


def plain_scene():
    floor = (
        [(-1.0, -1.0, -0.5), (1.0, -1.0, -0.5), (1.0, 1.0, -0.5), (-1.0, 1.0, -0.5)],
        [(0, 1, 2), (0, 2, 3)],
    )
    things = [
        (*solid((0.5, 0.1, 0.2), 0.12), 4),
        (*solid((0.4, -0.5, -0.2), 0.2), 0),
        (*solid((-0.1, 0.4, -0.3), 0.15), 0),
        (*floor, 0),
    ]
    return things, ((-0.7, -0.1, 0.1), look((1.0, 0.1, -0.15)))


def cell_scene():
    # Where each translation below leaves them whole.
    things = [
        (*solid((0.26, 0.22, 0.25), 0.06), 3),
        (*solid((0.65, 0.28, 0.44), 0.05), 0),
        (*solid((0.33, 0.85, 0.53), 0.05), 0),
        (*solid((0.87, 0.91, 0.42), 0.04), 0),
    ]
    return things, ((0.4, 0.5, 0.4), look((0.7, -0.6, 0.1)))


PLAIN = {"type": "nil", "quotient": False, "max_depth": 4}
QUOTIENT = {"type": "nil", "quotient": True, "max_depth": 3, "max_distance": 5.0}


def some(moves, *names):
    """These of the moves, and those that must show; the others with -m verify."""
    return [
        name if name in names or not move[-1] else pytest.param(name, marks=pytest.mark.verify)
        for name, move in moves.items()
    ]


PLAIN_MOVES = {
    "along x": (translation((0.7, 0.0, 0.0), 1.3), True),
    "along y": (translation((0.0, -1.1, 0.0), 1.3), True),
    "along z": (translation((0.0, 0.0, 0.9), 1.3), True),
    "far": (translation((-2.5, 1.5, 0.4), 1.3), True),
    "half-turn about x": (half_turn(0), True),
    "half-turn about y": (half_turn(1), True),
    "half-turn about z": (half_turn(2), True),
    # What is no isometry must show.
    "left translation of another twist": (translation((0.7, 0.0, 0.0), -1.3), False),
}


@pytest.mark.parametrize("name", some(PLAIN_MOVES, "far", "half-turn about x"))
def test_isometries_of_plain_nil_leave_the_image_unchanged(rgb, name, tmp_path):
    """Fails on equal expectations for one seed in 400."""
    move, is_isometry = PLAIN_MOVES[name]
    things, camera = plain_scene()
    integrator = PLAIN | {"twist": 1.3}
    still = photograph(identity(), things, camera, integrator, tmp_path, 192, seed=1)
    moved = photograph(move, things, camera, integrator, tmp_path, 192, seed=2)
    if is_isometry:
        assert_same_expectation(still, moved, block=8)
    else:
        assert max(dr.max(dr.abs(z))[0] for z in z_scores(still, moved, 8)) > 20


QUOTIENT_MOVES = {
    "up at twist 1": (1, (0.0, 0.0, 0.37), True),
    "half a cell along x at twist 2": (2, (0.5, 0.0, 0.3), True),
    "half a cell along y at twist 2": (2, (0.0, 0.5, 0.1), True),
    "half a cell along both at twist 2": (2, (0.5, 0.5, 0.0), True),
    "anywhere at twist 0": (0, (0.23, 0.41, 0.3), True),
    # It does not normalise the group: at twist 1 the quotient looks different from there.
    "half a cell along x at twist 1": (1, (0.5, 0.0, 0.3), False),
}


@pytest.mark.parametrize("name", some(QUOTIENT_MOVES, "half a cell along x at twist 2"))
def test_isometries_of_the_quotient_leave_the_image_unchanged(rgb, name, tmp_path):
    """Fails on equal expectations for one seed in 400."""
    twist, h, is_isometry = QUOTIENT_MOVES[name]
    things, camera = cell_scene()
    integrator = QUOTIENT | {"twist": float(twist)}
    still = photograph(identity(), things, camera, integrator, tmp_path, 192, seed=1)
    moved = photograph(translation(h, twist), things, camera, integrator, tmp_path, 192, seed=2)
    if is_isometry:
        assert_same_expectation(still, moved, block=8)
    else:
        assert max(dr.max(dr.abs(z))[0] for z in z_scores(still, moved, 8)) > 20


def test_small_twist_continues_twist_zero(rgb, tmp_path):
    """The two take different paths through the code. Fails on equal expectations for one seed in
    400; the expectations differ by far less than the noise."""
    things, camera = plain_scene()
    images = [
        photograph(identity(), things, camera, PLAIN | {"twist": twist}, tmp_path, 192, seed)
        for seed, twist in enumerate((0.0, 1e-4, -1e-4))
    ]
    assert_same_expectation(images[0], images[1], block=8)
    assert_same_expectation(images[0], images[2], block=8)


@pytest.mark.parametrize("twist", [1.0, -2.0, 0.3])
def test_rotations_about_a_fibre_carry_geodesics_to_geodesics(twist):
    """In the symmetric height z − k x y/2 they are rotations; frame components turn with them."""

    def to_symmetric(p):
        return Array3f64(p.x, p.y, p.z - 0.5 * twist * p.x * p.y)

    def from_symmetric(p):
        return Array3f64(p.x, p.y, p.z + 0.5 * twist * p.x * p.y)

    def turned(v, angle):
        s, c = math.sin(angle), math.cos(angle)
        return Array3f64(c * v.x - s * v.y, s * v.x + c * v.y, v.z)

    i = dr.arange(dr.llvm.Float64, 200)
    p = Array3f64(dr.sin(i), dr.cos(3 * i), dr.sin(5 * i + 1))
    v = dr.normalize(Array3f64(dr.cos(7 * i), dr.sin(2 * i), dr.cos(11 * i) * dr.sin(i)))
    for angle in (0.4, 2.0, -1.1):
        q, d = geometry.flow(p, v, 3.0, twist)
        start = from_symmetric(turned(to_symmetric(p), angle))
        q2, d2 = geometry.flow(start, turned(v, angle), 3.0, twist)
        assert dr.allclose(q2, from_symmetric(turned(to_symmetric(q), angle)), atol=1e-12, rtol=0)
        assert dr.allclose(d2, turned(d, angle), atol=1e-12, rtol=0)
