"""The grid of clearances promises no space that a surface takes, and most of the rest."""

import drjit as dr
import mitsuba as mi
import pytest
from drjit.llvm import Array3f64, Float64

from benchmarks import truth
from nil_mitsuba import geometry

POINTS, SAMPLES = 4_000, 20_000
ROUNDING = 2e-6  # of the points that Mitsuba samples on surfaces, in scenes a few units large

TWISTS = [1.0, -1.0, 3.0, 0.0, -6.0]


def transform():
    return mi.ScalarTransform4f()


def lattice():
    """A ball, a rod, a sheet, a tilted disk and a box, some across the faces of the cube."""
    t = transform()
    return {
        "type": "scene",
        "ball": {"type": "sphere", "center": [0.3, 0.4, 0.95], "radius": 0.17},
        "rod": {"type": "cylinder", "p0": [0.7, 0.2, 0.2], "p1": [0.9, 0.35, 1.1], "radius": 0.05},
        "sheet": {
            "type": "rectangle",
            "to_world": t.translate([0.1, 0.8, 0.4]).rotate([1, 1, 0.3], 50).scale([0.2, 0.05, 1]),
        },
        "disk": {
            "type": "disk",
            "to_world": t.translate([0.8, 0.7, 0.7]).rotate([0.2, 1, 0], 70).scale(0.13),
        },
        "box": {
            "type": "cube",
            "to_world": t.translate([0.45, 0.1, 0.4]).rotate([1, 2, 3], 33).scale([0.1, 0.06, 0.1]),
        },
    }


def ground():
    """Balls on a plane in open space."""
    scene = {
        "type": "scene",
        "ground": {"type": "rectangle", "to_world": transform().scale(4)},
    }
    for i, (x, y) in enumerate([(-2, -1), (-0.6, 0.8), (0.5, -1.2), (1.8, 0.4), (0.2, 2.4)]):
        scene[f"ball{i}"] = {"type": "sphere", "center": [x, y, 0.5], "radius": 0.5}
    return scene


def clearance_of(scene, twist=1.0, quotient=True, origin=(0, 0, 0), size=1.0, **grids):
    from nil_mitsuba.clearance import Clearance
    from nil_mitsuba.quotient import Space
    from nil_mitsuba.shapes import Shapes

    space = Space(twist, quotient, list(origin), size)
    return Clearance(space, Shapes(scene), **grids)


def points_in(low, high, seed, count=POINTS):
    rng = mi.PCG32(count, seed)
    u = mi.Point3f([rng.next_float32() for _ in range(3)])
    return mi.Point3f(low) + u * (mi.Vector3f(high) - mi.Vector3f(low))


def points_on(scene, low, high, seed=5, count=SAMPLES):
    """Points (scene units) on the surfaces of a scene: where rays through a box meet them."""
    o, q = (points_in(low, high, seed + i, count) for i in (0, 1))
    ray = mi.Ray3f(o, dr.normalize(q - o))
    si = scene.ray_intersect(ray)
    return mi.Point3f(dr.gather(mi.Point3f, si.p, dr.compress(si.is_valid())))


@dr.syntax
def distances(p, q, space):
    """Least distance (cells) from each p to the points q, and in the quotient to their images."""
    p, q = Array3f64(p), Array3f64(space.to_cells(q))
    twist = Float64(space.twist)
    a, b, c = space.EDGES
    if space.quotient:  # what lies outside of the cell does not exist
        q = Array3f64(dr.select(dr.all((q >= 0) & (q <= Array3f64(a, b, c))), q, 1e9))
    dr.eval(p, q)
    best = dr.full(Float64, 1e18, dr.width(p))
    i, count = dr.uint32_array_t(Float64)(0), dr.width(q)
    while i < count:
        one = dr.gather(Array3f64, q, i)
        for g in (-1, 0, 1) if space.quotient else (0,):
            d = one - p
            if dr.hint(space.quotient, mode="scalar"):
                d = Array3f64(d.x + g * a, d.y, d.z + twist * g * a * one.y)
                d = Array3f64(d.x, d.y - b * dr.round(d.y / b), d.z - c * dr.round(d.z / c))
            best = dr.minimum(best, dr.squared_norm(d))
        i += 1
    return dr.sqrt(best)


def check_distances(scene, clearance, p, lower, upper, least_mean):
    """No surface between ``lower`` and ``upper`` is closer to p than is said, which is not 0."""
    says = clearance.at(p)
    least = distances(p, points_on(scene, lower, upper), clearance.space)
    assert not dr.any(Float64(says) > least + ROUNDING)[0]
    assert dr.mean(says)[0] > least_mean


@pytest.mark.parametrize("twist", TWISTS)
def test_no_surface_and_no_image_of_one_lies_closer_than_a_cell_says(rgb, twist):
    scene = mi.load_dict(lattice())
    clearance = clearance_of(scene, twist)
    check_distances(
        scene, clearance, points_in((0, 0, 0), (1, 1, 1), 1), (0, 0, 0), (1, 1, 1), 0.05
    )


@pytest.mark.parametrize("edges", [(1, 2, 0.5), (0.5, 1, 1.5), (2, 0.75, 0.75)])
def test_cells_of_other_edges_know_their_images(rgb, monkeypatch, edges):
    from nil_mitsuba.quotient import Space

    monkeypatch.setattr(Space, "EDGES", edges)
    a, b, c = edges
    scene = mi.load_dict(lattice())
    clearance = clearance_of(scene, 2 * c / (a * b))
    check_distances(scene, clearance, points_in((0, 0, 0), edges, 1), (0, 0, 0), edges, 0.05)


def test_no_surface_lies_closer_than_a_plain_scene_says(rgb):
    scene = mi.load_dict(ground())
    clearance = clearance_of(scene, quotient=False)
    p = points_in((-6, -6, -1), (6, 6, 3), 2)  # inside of the scene's box and outside
    check_distances(scene, clearance, p, (-4, -4, -0.1), (4, 4, 2), 0.5)


def others(folder):
    """Curves and an instance, in and across the cube."""
    for name, radius in ("thin.txt", 0.01), ("thick.txt", 0.04):
        points = [(0.1, 0.2, 0.3), (0.5, 0.1, 0.6), (0.6, 0.8, 0.3), (1.1, 0.7, 0.8), (0.9, 0, 0)]
        lines = [f"{x} {y} {z} {radius * (1 + 0.1 * i)}" for i, (x, y, z) in enumerate(points)]
        (folder / name).write_text("\n".join(lines))
    return {
        "type": "scene",
        "spline": {"type": "bsplinecurve", "filename": str(folder / "thick.txt")},
        "line": {"type": "linearcurve", "filename": str(folder / "thin.txt")},
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.1}},
        "instance": {
            "type": "instance",
            "to_world": transform().translate([0.2, 0.7, 0.7]).scale([1, 1.5, 0.6]),
            "group": {"type": "ref", "id": "group"},
        },
    }


@pytest.mark.parametrize("twist", [1.0, 0.0, -6.0])
@pytest.mark.parametrize("quotient", [True, False])
def test_each_voxel_that_a_surface_touches_is_marked(rgb, monkeypatch, tmp_path, quotient, twist):
    """Its copies' voxels beside the cube, too: neighbours would hide that one is missing."""
    from nil_mitsuba import clearance as module

    marked = []
    along_axis = module._along_axis
    monkeypatch.setattr(module, "_along_axis", lambda *a: marked.append(a[0]) or along_axis(*a))
    for description in (lattice(), others(tmp_path)):
        scene = mi.load_dict(description)
        marked.clear()
        # Coarse voxels, of which a surface may touch a corner only
        clearance = clearance_of(scene, twist, quotient, voxels=12)
        q = points_on(scene, (0, 0, 0), (1, 1, 1), count=200_000)
        if not quotient:
            assert not dr.any(dr.gather(mi.Float, marked[0], clearance.grid.index(q)) > 0)[0]
            continue
        q = dr.gather(mi.Point3f, q, dr.compress(dr.all((q >= 0) & (q < 1))))
        for g in (-1, 0, 1):
            x, z = q.x + g, q.z + twist * g * q.y
            z -= dr.floor(z)
            # Three voxels on either side, and no points that rounding may put in another one
            voxel = mi.Point3f(12 * x + 3, 12 * q.y, 12 * z)
            sure = dr.all(dr.abs(voxel - dr.round(voxel)) > 1e-4) & (voxel.x > 0) & (voxel.x < 18)
            i = mi.Vector3u(voxel)
            found = dr.gather(mi.Float, marked[0], (i.z * 12 + i.y) * 18 + i.x, sure)
            assert not dr.any(sure & (found > 0))[0]


@pytest.mark.parametrize("quotient", [True, False])
def test_curves_and_instances_keep_their_distance(rgb, tmp_path, quotient):
    scene = mi.load_dict(others(tmp_path))
    clearance = clearance_of(scene, 2.0, quotient)
    check_distances(
        scene, clearance, points_in((0, 0, 0), (1, 1, 1), 1), (0, 0, 0), (1, 1, 1), 0.03
    )


@pytest.mark.parametrize("origin, size", [((0, 0, 0), 1), ((-30, 20, 7), 0.5)])
def test_grids_around_a_camera_promise_more_and_no_surface(rgb, origin, size):
    """Up to far from the camera, wherever the cube lies in the scene."""
    scene = mi.load_dict(ground())
    focus = (0.2, -1.4, 0.9)
    coarse = clearance_of(scene, 1.0, False, origin, size)
    fine = clearance_of(scene, 1.0, False, origin, size, focus=mi.ScalarPoint3f(*focus))
    assert fine.levels > 0
    surfaces = points_on(scene, (-4, -4, -0.1), (4, 4, 2))
    for half in (0.3, 1, 3, 9):
        low, high = ([c + sign * half for c in focus] for sign in (-1, 1))
        p = fine.space.to_cells(points_in(low, high, 3))
        says, least = fine.at(p), distances(p, surfaces, fine.space)
        assert not dr.any(Float64(says) > least + 2e-5)[0]
        assert dr.mean(says)[0] > (1.02 if half < 1 else 0.97) * dr.mean(coarse.at(p))[0]


@pytest.mark.parametrize("quotient", [True, False])
def test_little_of_empty_space_is_lost(rgb, quotient):
    """No more than three diagonals of a voxel of what there is up to the furthest."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.1},
            "corner": {"type": "sphere", "center": [0.05, 0.05, 0.05], "radius": 0.05},
            "opposite": {"type": "sphere", "center": [0.95, 0.95, 0.95], "radius": 0.05},
        }
    )
    clearance = clearance_of(scene, 0.0, quotient)
    p = points_in((0, 0, 0), (1, 1, 1), 1)
    least = distances(p, points_on(scene, (0, 0, 0), (1, 1, 1)), clearance.space)
    lost = dr.minimum(least, clearance.grid.furthest) - Float64(clearance.at(p))
    assert dr.max(lost)[0] < 3 * dr.norm(clearance.grid.edges)[0]


def test_a_leap_ends_before_the_first_hit(rgb):
    """By the truth's float64 geodesics through the copies of two balls and a sheet."""
    from nil_mitsuba.clearance import within

    surfaces = [
        truth.Sphere((0.3, 0.4, 0.9), 0.2),
        truth.Sphere((0.8, 0.7, 0.3), 0.12),
        truth.Rectangle((0.1, 0.8, 0.4), (0.3, 0.1, 0), (0, 0.1, 0.3)),
    ]
    scene = {"type": "scene"} | {str(i): s.to_mitsuba(mi) for i, s in enumerate(surfaces)}
    for twist in (1, -3):
        clearance = clearance_of(mi.load_dict(scene), float(twist))
        rng = mi.PCG32(POINTS, 11)
        v = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        p = points_in((0, 0, 0), (1, 1, 1), 12)
        leap = Float64(within(p, v, clearance.at(p), clearance.space.twist))
        hit = truth.first_hit(surfaces, p, dr.normalize(Array3f64(v)), 0.6, twist, True)
        assert not dr.any(leap > hit.t)[0]
        assert dr.mean(leap)[0] > 0.05


def test_what_lies_far_outside_of_the_cube_takes_nothing(rgb):
    """It does not exist in the quotient, and its coordinates round nothing."""
    far = {"type": "sphere", "center": [1e6, 0, 0], "radius": 2.0}
    near, both = (mi.load_dict(lattice() | more) for more in ({}, {"far": far}))
    p = points_in((0, 0, 0), (1, 1, 1), 1)
    assert dr.all(clearance_of(near).at(p) == clearance_of(both).at(p))[0]


def test_grids_of_other_scenes_compile_nothing_anew(rgb):
    def fill(voxels, twist, origin, size):
        clearance_of(mi.load_dict(lattice()), twist, True, origin, size, voxels=voxels)
        focus = mi.ScalarPoint3f(origin) / 2
        clearance_of(mi.load_dict(ground()), twist, False, origin, size, voxels=voxels, focus=focus)

    fill(40, 1.0, (0, 0, 0), 1.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        fill(28, 3.0, (0.1, 0.2, 0.3), 0.5)
        fill(50, -2.0, (-1, 0, 0), 0.9)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    # Neither now nor in an earlier process
    assert kernels and all(k["cache_hit"] and not k["cache_disk"] for k in kernels)


def test_clearances_follow_what_moves(rgb):
    scene = mi.load_dict(ground())
    here = mi.Point3f(0.2, 2.4, 0.5)
    assert clearance_of(scene, quotient=False).at(here)[0] > 0.3  # in a ball's centre
    parameters = mi.traverse(scene)
    parameters["ball0.to_world"] = mi.Transform4f().translate([0.4, 2.4, 0.5]).scale(0.2)
    parameters.update()
    assert clearance_of(scene, quotient=False).at(here)[0] == 0


def test_a_ball_on_a_ground_of_thousands_of_cells_is_seen_from_nearby(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "ground": {"type": "rectangle", "to_world": transform().scale(1000)},
            "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
        }
    )
    clearance = clearance_of(scene, quotient=False, focus=mi.ScalarPoint3f(0.4, -1.5, 0.8))
    assert clearance.useful
    p = points_in((-2, -2, 0), (2, 2, 1.5), 2)
    true = dr.minimum(dr.abs(p.z), dr.abs(dr.norm(p - mi.Point3f(0, 0, 0.5)) - 0.5))
    says = clearance.at(p)
    # The slack for coordinates of a thousand
    assert not dr.any(says > true + 1e-6)[0]
    assert dr.mean(says)[0] > 0.6 * dr.mean(true)[0]


@pytest.mark.parametrize(
    "shapes, useful",
    [
        ({}, False),
        ({"ground": {"type": "rectangle"}}, False),
        ({"ground": {"type": "rectangle", "to_world": "huge"}}, False),
        ({"ball": {"type": "sphere", "center": [0, 0, 1e5], "radius": 1e-3}}, False),
        ({"ball": {"type": "sphere", "center": [0, 0, float("nan")]}}, False),
        ({"ball": {"type": "sphere", "radius": 1e30}}, False),
    ],
)
def test_odd_scenes_have_clearances_too(rgb, shapes, useful):
    for shape in shapes.values():
        if "to_world" in shape:
            shape["to_world"] = transform().scale(1e12)
    scene = mi.load_dict({"type": "scene"} | shapes)
    for focus in (None, mi.ScalarPoint3f(0.1, 0.2, 0.3)):
        clearance = clearance_of(scene, quotient=False, focus=focus)
        assert clearance.useful == useful
        says = clearance.at(mi.Point3f([0.1, 3, 1e6], [0.2, 1, 1], [0.5, -7, 1]))
        assert dr.all(says >= 0)[0]


@pytest.mark.parametrize("twist", TWISTS)
def test_a_leap_stays_within_the_clearance(rgb, twist):
    """Everywhere along float64 geodesics, also where that is many cells, and makes use of it."""
    from nil_mitsuba.clearance import within

    steps = 16
    rng = mi.PCG32(POINTS, 7)
    v = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    d = dr.repeat(dr.normalize(Array3f64(v)), steps)
    part = (Float64(dr.arange(mi.UInt32, POINTS * steps) % steps) + 1) / steps
    k = dr.opaque(Float64, twist)  # or each is a kernel of its own, as each clearance is
    for far in (0.5, 3, 30):
        p = points_in((-far, -far, -far), (far, far, far), 8)
        q = dr.repeat(Array3f64(p), steps)
        last = mi.Float(0)
        for clearance in (1e-3, 0.02, 0.3, 3, 100, 1e5):
            leap = within(p, v, dr.opaque(mi.Float, clearance), mi.Float(k))
            # A wider one is no shorter leap
            assert dr.all(leap >= last)[0]
            last = leap
            there, _ = geometry.flow(q, d, part * dr.repeat(Float64(leap), steps), k)
            assert dr.all(dr.norm(there - q) <= clearance)[0]
        # Of what has no end a third of the longest chord, the arc of one radian
        if far < 1:
            assert dr.min(last)[0] > (0.3 / abs(twist) if twist else 0.9999e5)
