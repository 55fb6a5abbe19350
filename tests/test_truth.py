"""The float64 truth itself: against ODEs, straight lines, lattice copies and finer scans."""

import math

import drjit as dr
import mpmath
import pytest
from drjit.llvm import PCG32, Array3f64, Array3i, Float64, Int32, UInt32, UInt64

from benchmarks import truth


def random_unit(rng):
    z = 2 * rng.next_float64() - 1
    sin_phi, cos_phi = dr.sincos(2 * math.pi * rng.next_float64())
    r = dr.sqrt(1 - z * z)
    return Array3f64(r * cos_phi, r * sin_phi, z)


def random_rays(count, center, spread, seed):
    """Starts in a cube of the given width around the centre, directions uniform."""
    rng = PCG32(count, initstate=seed)
    start = Array3f64(*(rng.next_float64() for _ in range(3))) - 0.5
    rays = start * spread + Array3f64(*center), random_unit(rng)
    dr.eval(rays)
    return rays


def ray(p, v):
    return Array3f64(*(Float64(x) for x in p)), Array3f64(*(Float64(x) for x in v))


def components(a):
    return [c[0] for c in a]


def geodesic_by_ode(p, v, t, twist):
    """Hamilton's equations of H = (px² + (py + k x pz)² + pz²)/2, the inverse of the metric."""
    with mpmath.workdps(22):
        k = mpmath.mpf(twist)
        x, y, z = map(mpmath.mpf, p)
        a, b, w = map(mpmath.mpf, v)
        pz, py = w, b - k * x * w  # both conserved: no coefficient depends on y or z

        def equations(_, state):
            x, y, z, px = state
            e2 = py + k * x * pz
            return [px, e2, pz + k * x * e2, -k * pz * e2]

        x, y, z, px = mpmath.odefun(equations, 0, [x, y, z, a])(mpmath.mpf(t))
        return [float(c) for c in (x, y, z)], [float(c) for c in (px, py + k * x * pz, pz)]


@pytest.mark.parametrize(
    "p, v, t, twist",
    [
        ((0.3, -0.7, 0.2), (0.6, 0.48, 0.64), 5.0, 1.0),
        ((0.3, -0.7, 0.2), (0.6, -0.48, -0.64), 12.0, 2.0),
        ((-0.9, 0.4, 0.1), (0.6, 0.8, 0.0), 7.0, 1.0),
        ((0.5, 0.5, 0.5), (0.28, 0.96, 1e-9), 5.0, 3.0),
        ((0.5, 0.5, 0.5), (0.28, 0.96, -1e-2), 6.0, -2.0),
        ((0.1, 0.2, 0.3), (0.0, 0.0, 1.0), 4.0, 2.0),
        ((0.1, 0.2, 0.3), (0.0, -0.6, 0.8), 1.2499999, 1.0),  # u just below the switch at 1
        ((0.1, 0.2, 0.3), (0.0, -0.6, 0.8), 1.2500001, 1.0),  # and just above
        ((0.7, 0.2, 0.3), (0.48, -0.6, 0.64), 9.0, 0.0),
    ],
)
def test_flow_solves_hamiltons_equations(p, v, t, twist):
    position, direction = truth.flow(*ray(p, v), Float64(t), Float64(twist))
    expected_position, expected_direction = geodesic_by_ode(p, v, t, twist)
    assert components(position) == pytest.approx(expected_position, abs=2e-13, rel=2e-14)
    assert components(direction) == pytest.approx(expected_direction, abs=2e-14)


def test_left_division_undoes_the_group_product():
    p, q = random_rays(1000, (0, 0, 0), 4, seed=1)
    back = truth.multiply_inverse(p, truth.multiply(p, q, 1.5), 1.5)
    assert dr.max(dr.norm(back - q))[0] < 1e-14


# -- Straight lines ---------------------------------------------------------------------------


def straight_hits(surface, o, d):
    """Arc lengths of all meetings of o + t d with a surface, by solving for t."""
    if isinstance(surface, truth.Rectangle):
        # Cramer's rule for t d - α u - β v = corner - o
        u, v, r = Array3f64(*surface.u), Array3f64(*surface.v), Array3f64(*surface.corner) - o
        n = dr.cross(u, v)
        t = dr.dot(r, n) / dr.dot(d, n)
        q = t * d - r
        alpha = dr.dot(dr.cross(q, v), n) / dr.squared_norm(n)
        beta = dr.dot(dr.cross(u, q), n) / dr.squared_norm(n)
        inside = (alpha >= 0) & (alpha <= 1) & (beta >= 0) & (beta <= 1)
        return [dr.select(inside, t, math.inf)]

    if isinstance(surface, truth.Sphere):
        across, r = d, o - Array3f64(*surface.center)
    else:
        axis = Array3f64(*surface.p1) - Array3f64(*surface.p0)
        axis /= dr.norm(axis)
        r = o - Array3f64(*surface.p0)
        across, r = d - axis * dr.dot(d, axis), r - axis * dr.dot(r, axis)
    a, b, c = dr.squared_norm(across), dr.dot(across, r), dr.squared_norm(r) - surface.radius**2
    root = dr.sqrt(b * b - a * c)  # NaN without an intersection: fails every comparison
    hits = [(-b - root) / a, (-b + root) / a]
    if isinstance(surface, truth.Cylinder):
        length = math.dist(surface.p0, surface.p1)
        for i, t in enumerate(hits):
            along = dr.dot(o + t * d - Array3f64(*surface.p0), axis)
            hits[i] = dr.select((along >= 0) & (along <= length), t, math.inf)
    return hits


def first_straight_hit(surfaces, o, d, t_max):
    best, label = dr.full(Float64, math.inf, dr.width(o)), Int32(truth.NO_SURFACE)
    for i, surface in enumerate(surfaces):
        for t in straight_hits(surface, o, d):
            closer = (t >= 0) & (t < best) & (t <= t_max)
            best, label = dr.select(closer, t, best), dr.select(closer, i, label)
    return best, label


def assert_same_hits(t, label, expected_t, expected_label):
    hit = expected_label != truth.NO_SURFACE
    assert 0.05 < dr.mean(Float64(hit))[0]
    assert dr.count(label != expected_label)[0] == 0
    # Arc lengths of nearly tangential hits are the square root of a rounded number
    assert dr.max(dr.select(hit, dr.abs(t - expected_t), 0))[0] < 1e-9


def test_rays_are_straight_lines_without_twist():
    o, d = random_rays(100_000, (0, 0, 0), 3, seed=2)
    hit = truth.first_hit(truth.room_scene(), o, d, 4.0, 0, quotient=False)
    t, label = first_straight_hit(truth.room_scene(), o, d, 4.0)
    assert_same_hits(hit.t, hit.label, t, label)


def all_pairs(p, v, cells):
    """Every ray with every lattice element: p, v and g of rays × elements entries."""
    count = dr.width(p)
    pair = dr.arange(UInt32, count * len(cells))
    ray_index, cell_index = pair // len(cells), pair % len(cells)
    p, v = dr.gather(Array3f64, p, ray_index), dr.gather(Array3f64, v, ray_index)
    g = [dr.gather(Int32, Int32([cell[i] for cell in cells]), cell_index) for i in range(3)]
    return p, v, Array3i(*g)


def nearest_image(t, label, g, image_count):
    """First hit among the images of each ray, and the hash of its surface."""
    t_first = dr.block_reduce(dr.ReduceOp.Min, t, image_count)
    ray_index = dr.arange(UInt32, dr.width(t)) // image_count
    is_first = (t == dr.gather(Float64, t_first, ray_index)) & (t < math.inf)
    hashed = dr.select(is_first, truth.surface_hash(label, g), UInt64(0))
    return t_first, dr.block_reduce(dr.ReduceOp.Max, hashed, image_count)


def test_quotient_without_twist_is_a_lattice_of_copies():
    t_max, reach = 2.5, range(-3, 4)
    cells = [(x, y, z) for x in reach for y in reach for z in reach]
    p, v = random_rays(3000, (0.5, 0.5, 0.5), 1, seed=3)
    hit = truth.first_hit(truth.cell_scene(), p, v, t_max, 0, quotient=True)

    o, d, g = all_pairs(p, v, cells)
    t, label = first_straight_hit(truth.cell_scene(), o - Array3f64(g), d, t_max)
    t, hashed = nearest_image(t, label, g, len(cells))
    assert dr.all(hashed == truth.surface_hash(hit.label, hit.g))
    assert dr.max(dr.select(hit.t < math.inf, dr.abs(t - hit.t), 0))[0] < 1e-9


@pytest.mark.parametrize("twist", [1, 2])
def test_quotient_is_all_images_of_the_scene_under_the_lattice(twist):
    # Left translations are isometries: the image g·S is met where S is met from g⁻¹·p. The
    # heights of images reach as far as the ray and the shear k gx y over one cell together.
    t_max = 1.2
    cells = [
        (x, y, z)
        for x in range(-2, 3)
        for y in range(-2, 3)
        for z in range(-3 - 4 * twist, 4 + 4 * twist)
    ]
    p, v = random_rays(1500, (0.5, 0.5, 0.5), 1, seed=4)
    hit = truth.first_hit(truth.cell_scene(), p, v, t_max, twist, quotient=True)

    o, d, g = all_pairs(p, v, cells)
    o = truth.multiply_inverse(Array3f64(g), o, Float64(twist))
    image = truth.first_hit(truth.cell_scene(), o, d, t_max, twist, quotient=False)
    t, hashed = nearest_image(image.t, image.label, g, len(cells))
    assert dr.all(hashed == truth.surface_hash(hit.label, hit.g))
    assert dr.max(dr.select(hit.t < math.inf, dr.abs(t - hit.t), 0))[0] < 1e-9
    assert dr.count((hit.label >= 0) & dr.any(hit.g != 0))[0] > 300


# -- Curved rays ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene, center, twist, quotient",
    [
        (truth.cell_scene, (0.5, 0.5, 0.5), 2, True),
        *(
            pytest.param(*setup, marks=pytest.mark.verify)
            for setup in (
                (truth.cell_scene, (0.5, 0.5, 0.5), 1, True),
                (truth.room_scene, (0, 0, 0), 1, False),
                (truth.room_scene, (0, 0, 0), 2, False),
            )
        ),
    ],
)
def test_a_finer_scan_finds_the_same_hits(scene, center, twist, quotient):
    p, v = random_rays(30_000, center, 1, seed=5)
    coarse = truth.first_hit(scene(), p, v, 12.0, twist, quotient)
    fine = truth.first_hit(scene(), p, v, 12.0, twist, quotient, step=truth.STEP / 4)
    assert dr.all(
        truth.surface_hash(coarse.label, coarse.g) == truth.surface_hash(fine.label, fine.g)
    )
    assert dr.max(dr.select(fine.t < math.inf, dr.abs(coarse.t - fine.t), 0))[0] < 1e-9


@pytest.mark.parametrize("twist", [1, 2])
def test_hits_lie_on_the_surface_in_the_home_cell(twist):
    p, v = random_rays(20_000, (0.5, 0.5, 0.5), 1, seed=6)
    hit = truth.first_hit(truth.cell_scene(), p, v, 12.0, twist, quotient=True)
    for i, surface in enumerate(truth.cell_scene()):
        f = surface.implicit(hit.p_cell, hit.v)[0]
        assert dr.max(dr.select(hit.label == i, dr.abs(f), 0))[0] < 1e-11
    assert dr.all((dr.min(hit.p_cell) >= 0) & (dr.max(hit.p_cell) <= 1))
    assert dr.max(dr.norm(truth.multiply(Array3f64(hit.g), hit.p_cell, twist) - hit.p))[0] < 1e-12


@pytest.mark.parametrize("twist, z, gz", [(1, 0.1, 0), (2, 0.8, -1)])
def test_crossing_the_x_face_shears_the_height(twist, z, gz):
    # The line (0.5 + t, 0.3, 0.4) is a geodesic; at t = 1 it is (0.5, 0.3, 0.4 - 0.3 k) in the
    # cell behind the face, up to a whole number of cells
    sphere = truth.Sphere((0.5, 0.3, z), 0.05)
    hit = truth.first_hit([sphere], *ray((0.5, 0.3, 0.4), (1, 0, 0)), 2.0, twist, quotient=True)
    assert hit.t[0] == pytest.approx(0.95, abs=1e-11)
    assert components(hit.g) == [1, 0, gz]
    assert components(hit.p_cell) == pytest.approx([0.45, 0.3, z], abs=1e-11)
    assert components(hit.p) == pytest.approx([1.45, 0.3, 0.4], abs=1e-11)


def test_a_grazed_sphere_is_hit_within_one_step():
    # The chord is 2 √(r² - (r - 1e-11)²) = 1.3e-6 long, far shorter than a step
    sphere = truth.Sphere((0.5, 0.5, 0.1), 0.02)
    offset = Float64([0.02 - 1e-11, 0.02 + 1e-11])
    p, v = Array3f64(0.5, 0.013, 0.1 + offset), Array3f64(0, 1, 0)
    hit = truth.first_hit([sphere], p, v, 1.0, 0, quotient=False)
    assert list(hit.label) == [0, truth.NO_SURFACE]
    assert hit.t[0] == pytest.approx(0.487, abs=1e-6)


def test_what_lies_outside_the_cube_does_not_exist():
    # A sphere through the face z = 1: from above, its cut-off cap would be seen first
    sphere = truth.Sphere((0.5, 0.5, 1.0), 0.2)
    hit = truth.first_hit([sphere], *ray((0.5, 0.5, 0.5), (0, 0, -1)), 2.0, 1, quotient=True)
    # Down from 0.5 through z = 0 into the cell below, whose half sphere ends at its face z = 1
    assert hit.label[0] == 0
    assert components(hit.g) == [0, 0, -1]
    assert components(hit.p_cell) == pytest.approx([0.5, 0.5, 0.8], abs=1e-11)


@pytest.mark.parametrize("height", [0, 1])
@pytest.mark.parametrize("direction, t", [(1, 0.7), (-1, 0.3)])
def test_a_surface_in_a_face_of_the_cube_is_seen_from_both_sides(height, direction, t):
    floor = truth.Rectangle((0, 0, height), (1, 0, 0), (0, 1, 0))
    hit = truth.first_hit([floor], *ray((0.4, 0.6, 0.3), (0, 0, direction)), 2.0, 1, True)
    assert hit.t[0] == pytest.approx(t, abs=1e-9)
    assert components(hit.g) == [0, 0, (1 if direction > 0 else 0) - height]


def test_rays_along_faces_and_edges_and_through_corners_end():
    starts = [(0, 0.5, 0.5), (0, 0, 0.5), (0, 0, 0), (0.5, 0.5, 0.5), (0.5, 0, 0)]
    r2, r3 = math.sqrt(0.5), math.sqrt(1 / 3)
    ways = [
        (1, 0, 0),
        (0, 1, 0),
        (0, 0, 1),
        (0, 0, -1),
        (r2, r2, 0),
        (0, r2, -r2),
        (r3, r3, r3),
        (-r3, -r3, -r3),
        (0, 1, 1e-17),
        (1e-9, 1e-9, 1),
        (1, -1e-17, 1e-12),
    ]
    rays = [(p, v) for p in starts for v in ways]
    p = Array3f64(*(Float64([r[0][i] for r in rays]) for i in range(3)))
    v = Array3f64(*(Float64([r[1][i] for r in rays]) for i in range(3)))
    for twist in (0, 1, 2):
        hit = truth.first_hit([truth.Sphere((0.3, 0.7, 0.2), 0.01)], p, v, 12.0, twist, True)
        assert dr.all(dr.isfinite(dr.sum(hit.p_cell)) & dr.isfinite(dr.sum(hit.v)))
        assert dr.all((hit.t <= 12) | (hit.label == truth.NO_SURFACE))


# -- Measures ---------------------------------------------------------------------------------


@pytest.mark.parametrize("twist", [0, 1, 2])
def test_error_is_measured_across_the_geodesic_only(twist):
    p, v = random_rays(1000, (0, 0, 0), 2, seed=7)
    t, offset = Float64(6.0), 1e-4
    foot, tangent = truth.flow(p, v, t, Float64(twist))
    across = dr.normalize(dr.cross(tangent, Array3f64(0.3, -0.5, 0.8)))
    q = truth.multiply(foot, across * offset, Float64(twist))
    error = truth.across_error(p, v, t + 0.01, q, twist)
    # The coordinates of a step and its length differ by k² offset³ and k · 0.5 offset²
    assert dr.max(dr.abs(error - offset))[0] < 2e-8
    along = truth.flow(p, v, t + 1e-3, Float64(twist))[0]
    assert dr.max(truth.across_error(p, v, t, along, twist))[0] < 1e-12


def test_pixels_next_to_another_label_are_near_a_silhouette():
    width, height = 6, 4
    labels = UInt64([7 if (x, y) == (4, 1) else 3 for y in range(height) for x in range(width)])
    near = truth.near_silhouette(labels, width, height)
    expected = [abs(x - 4) <= 1 and abs(y - 1) <= 1 for y in range(height) for x in range(width)]
    assert list(near) == expected
    assert not dr.any(truth.near_silhouette(dr.full(UInt64, 5, width * height), width, height))


def test_hashes_tell_surfaces_and_cells_apart_and_misses_are_one():
    g = Array3i(
        Int32([0, 0, 1, 0, -1, 2, -3]), Int32([0, 1, 0, 0, 0, 5, 4]), Int32([0, 0, 0, 1, 0, 1, 0])
    )
    hashes = list(truth.surface_hash(Int32([0, 0, 0, 0, 0, -1, -1]), g))
    assert len(set(hashes[:5])) == 5
    assert hashes[5:] == [0, 0]
    assert truth.surface_hash(Int32(1), Array3i(0))[0] not in hashes


@pytest.mark.parametrize(
    "scene, center", [(truth.cell_scene, (0.5, 0.5, 0.5)), (truth.room_scene, (0, 0, 0))]
)
def test_mitsuba_gets_the_same_surfaces(scene, center):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    shapes = truth.to_mitsuba(scene(), mi)
    loaded = mi.load_dict({"type": "scene", **shapes})
    o, d = random_rays(50_000, center, 1, seed=8)
    seen = loaded.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    t, label = first_straight_hit(scene(), o, d, 10.0)
    index = Int32(truth.NO_SURFACE)
    for shape in loaded.shapes():
        index = dr.select(seen.shape == mi.ShapePtr(shape), int(shape.id()[1:]), index)
    # Mitsuba decides silhouettes in float32
    assert dr.mean(Float64(index != label))[0] < 1e-4
    same = (index == label) & (label >= 0)
    assert dr.count(same)[0] > 5000
    assert dr.mean(dr.select(same, dr.abs(Float64(seen.t) - t), 0))[0] < 1e-6
