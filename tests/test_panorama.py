"""Panoramas, domes and pairs of eyes: where each pixel looks, from where, and what that shows."""

import math
import pickle
import xml.etree.ElementTree as xml

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film, gradient
from nil_mitsuba import geometry, jobs, look_at, stills
from ztest import Estimate, assert_same_expectation

PLAIN = {"type": "nil", "quotient": False, "twist": 1.0, "max_depth": 2}
NARROW = 1e-3  # near clip


def T():
    return mi.ScalarTransform4f()


def pose(x=0.4, y=-0.3, z=0.2):
    """Neither level nor along an axis."""
    return T().translate([x, y, z]) @ T().rotate([2 / 3, 2 / 3, -1 / 3], 50)


def sensor(kind, width=16, height=8, **more):
    extra = {"eye": "both", "interocular_distance": 0.1} if kind == "pair of panoramas" else {}
    extra |= {"interocular_distance": 0.1} if kind == "stereo_perspective" else {}
    kind = "spherical" if kind == "pair of panoramas" else kind
    common = {"type": kind, "to_world": pose(), "near_clip": NARROW, "film": film(width, height)}
    return common | extra | more


KINDS = ("spherical", "pair of panoramas", "fisheye", "stereo_perspective")


def of_kind(kind):
    width, height, more = {
        "spherical": (32, 16, {}),
        "pair of panoramas": (32, 32, {}),
        "fisheye": (24, 16, {"fov": 230.0}),
        "stereo_perspective": (16, 32, {"fov": 80.0}),
    }[kind]
    return sensor(kind, width, height, **more)


def centres(loaded):
    """Places of the middles of a film's pixels within its crop."""
    width, height = loaded.film().crop_size()
    i = dr.arange(mi.UInt32, width * height)
    return mi.Point2f((i % width + 0.5) / width, (i // width + 0.5) / height)


def rays(loaded, place=None):
    place = centres(loaded) if place is None else place
    return loaded.sample_ray_differential(0, 0.5, place, mi.Point2f(0.5))


def starts(loaded, twist=1.0, place=None, fibres="z"):
    """Starts (cells) and frame directions of the rays through the middles of pixels, and cones."""
    from nil_mitsuba.camera import Camera
    from nil_mitsuba.quotient import Space

    place = centres(loaded) if place is None else place
    space = Space(twist, False, [0, 0, 0], 1.0, fibres=fibres)
    p, v, cone, *_ = Camera(loaded, space, 0.25).start(rays(loaded, place)[0], place.x)
    return p, v, cone


def points(array):
    """An array of points or vectors as a list of triples."""
    return list(zip(*(list(c) for c in array)))


def in_world(vector):
    """A vector in the sensor's axes as one in the world's."""
    return points(mi.Vector3f(pose() @ mi.ScalarVector3f(*vector)))[0]


# ------------------------------------------------------------------ directions


@pytest.mark.parametrize(
    "crop",
    [{}, {"crop_offset_x": 5, "crop_offset_y": 2, "crop_width": 6, "crop_height": 5}],
    ids=["whole", "crop"],
)
def test_each_pixel_of_a_panorama_looks_along_its_azimuth_and_elevation(rgb, crop):
    """Azimuth falls from the left of the picture to its right, where x, a camera's left, does."""
    loaded = mi.load_dict(sensor("spherical", film=film(16, 8, **crop)))
    found = points(rays(loaded)[0].d)
    width, height = crop.get("crop_width", 16), crop.get("crop_height", 8)
    for number, d in enumerate(found):
        column = crop.get("crop_offset_x", 0) + number % width
        row = crop.get("crop_offset_y", 0) + number // width
        azimuth = math.pi * (1 - (column + 0.5) / 8)  # from forward to the left
        elevation = math.pi * (0.5 - (row + 0.5) / 8)
        expected = in_world(
            (
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
                math.cos(azimuth) * math.cos(elevation),
            )
        )
        assert d == pytest.approx(expected, abs=2e-6)
    assert len(found) == width * height


@pytest.mark.parametrize("fov", [120.0, 180.0, 360.0])
def test_a_fisheye_spreads_the_angle_from_its_axis_evenly(rgb, fov):
    loaded = mi.load_dict(sensor("fisheye", 17, 13, fov=fov))
    ray, weight = rays(loaded)
    inverse = pose().inverse()
    for number, (d, w) in enumerate(zip(points(ray.d), list(weight[0]))):
        right, down = number % 17 - 8, number // 17 - 6
        x, y, z = inverse @ mi.ScalarVector3f(*d)
        angle = math.radians(fov) * math.hypot(right, down) / 13
        assert w == (1 if math.hypot(right, down) <= 6.5 else 0)
        if w:
            assert math.atan2(math.hypot(x, y), z) == pytest.approx(angle, abs=2e-3)
            assert math.hypot(x, y) == pytest.approx(abs(math.sin(angle)), abs=1e-5)
        if w and 0.01 < angle < 3.1:
            assert (-x * right - y * down) / math.hypot(x, y) == pytest.approx(
                math.hypot(right, down), abs=1e-3
            )


def test_the_middle_of_every_picture_looks_forward(rgb):
    for kind in KINDS:
        whole = of_kind(kind)
        eyes = whole.get("eye") == "both" or kind == "stereo_perspective"
        loaded = mi.load_dict(whole)
        for y in (0.25, 0.75) if eyes else (0.5,):
            d = points(rays(loaded, mi.Point2f(0.5, y))[0].d)[0]
            assert d == pytest.approx(in_world((0, 0, 1)), abs=1e-5)


@pytest.mark.parametrize("kind", ["spherical", "pair of panoramas", "fisheye"])
def test_pixels_are_as_exact_at_the_poles_as_at_the_horizon(rgb, kind):
    """What a pixel's ray may be off by is its height; its width falls to nothing at the poles, and
    at a fisheye's rim."""
    whole = {
        "spherical": sensor(kind, 64, 32),
        "pair of panoramas": sensor(kind, 64, 64),
        "fisheye": sensor(kind, 32, 32, fov=360.0),
    }[kind]
    angle = 2 * math.pi / 32 if kind == "fisheye" else math.pi / 32
    loaded = mi.load_dict(whole)
    cone = starts(loaded)[2]
    assert dr.allclose(cone.spread, 0.25 * 2 * math.sin(angle / 2), rtol=1e-4)
    ray = rays(loaded)[0]
    for d in (ray.d_x, ray.d_y):
        assert dr.allclose(dr.norm(d), 1, atol=1e-6)
        assert dr.allclose(dr.dot(d, ray.d), math.cos(angle), atol=1e-6)
    assert dr.allclose(dr.dot(ray.d_x - ray.d, ray.d_y - ray.d), (1 - math.cos(angle)) ** 2)


def test_differentials_point_to_the_next_pixels(rgb):
    """At the horizon of a panorama, and along the axes of a fisheye's picture."""
    for kind, width, height, places in (
        ("spherical", 64, 32, [(0.3, 0.5), (0.9, 0.5)]),
        ("fisheye", 32, 32, [(0.5, 0.5)]),
    ):
        loaded = mi.load_dict(sensor(kind, width, height))
        for x, y in places:
            ray = rays(loaded, mi.Point2f(x, y))[0]
            right = rays(loaded, mi.Point2f(x + 1 / width, y))[0]
            below = rays(loaded, mi.Point2f(x, y + 1 / height))[0]
            assert dr.allclose(ray.d_x, right.d, atol=1e-5)
            assert dr.allclose(ray.d_y, below.d, atol=1e-5)


# ------------------------------------------------------------------ pictures


def mean_of(lists):
    return sum(lists) / len(lists)


@pytest.mark.parametrize("integrator", ["path", "nil"])
def test_an_environment_map_alone_is_seen_as_it_is(rgb, integrator):
    """By directions from azimuth and elevation: not mirrored, turned or upside down."""
    sky = {
        "type": "envmap",
        "bitmap": mi.Bitmap(gradient(8, 4)),
        "to_world": T().rotate([1, 0, 0], 40),
    }
    scene = mi.load_dict({"type": "scene", "sky": sky, "camera": of_kind("spherical")})
    chosen = PLAIN | {"twist": 2.0} if integrator == "nil" else {"type": "path"}
    picture = mi.render(scene, integrator=mi.load_dict(chosen), spp=1024)
    # A pixel is the mean of its directions
    index, fine = dr.arange(mi.UInt32, 32 * 16), 4
    total = mi.Color3f(0)
    for i in range(fine**2):
        place = mi.Point2f(
            (index % 32 + (i % fine + 0.5) / fine) / 32,
            (index // 32 + (i // fine + 0.5) / fine) / 16,
        )
        si = dr.zeros(mi.SurfaceInteraction3f, 32 * 16)
        azimuth, elevation = math.pi * (1 - 2 * place.x), math.pi * (0.5 - place.y)
        level = dr.cos(elevation)
        d = mi.Vector3f(dr.sin(azimuth) * level, dr.sin(elevation), dr.cos(azimuth) * level)
        si.wi = -(mi.Transform4f(pose()) @ d)
        total += scene.environment().eval(si)
    difference = dr.abs(picture.array - dr.ravel(total / fine**2))
    # Radiance varies by 1 within a pixel at most, by 3 between pixels
    assert dr.max(difference)[0] < 5 * 0.5 / 1024**0.5
    assert dr.max(picture.array)[0] > 2


def furnished(camera, **more):
    """Things to be seen all around, half of them lit by a sky that differs from side to side."""

    def light(*rgb):
        return {"type": "area", "radiance": {"type": "rgb", "value": list(rgb)}}

    return mi.load_dict(
        {
            "type": "scene",
            "camera": camera,
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(gradient(8, 4))},
            "a": {"type": "sphere", "center": [1.4, 0.2, 0.1], "radius": 0.5, "l": light(1, 2, 3)},
            "b": {"type": "sphere", "center": [-0.6, 0.5, 0.5], "radius": 0.4},
            "c": {
                "type": "sphere",
                "center": [0.4, -1.3, -0.6],
                "radius": 0.6,
                "l": light(3, 1, 0),
            },
            "d": {"type": "cube", "to_world": T().translate([0.3, 0, 1.6]).scale(0.5)},
            "e": {"type": "cube", "to_world": T().translate([0, 0.4, -1.5]).scale([0.9, 0.6, 0.2])},
        }
        | more
    )


@pytest.mark.parametrize(
    "kind",
    [  # a single panorama is seen with a pair
        "pair of panoramas",
        "stereo_perspective",
        pytest.param("fisheye", marks=pytest.mark.verify),
    ],
)
def test_path_and_nil_agree_at_twist_zero(rgb, kind):
    """Fails on equal expectations for one seed in 400."""
    scene = furnished(of_kind(kind))
    flat = Estimate(scene, PLAIN | {"twist": 0.0}, 64, 1)
    assert_same_expectation(flat, Estimate(scene, {"type": "path", "max_depth": 2}, 64, 2), block=8)


def test_a_panorama_sees_what_six_cameras_see(rgb):
    """By the flux of each face of the cube around it and its first moments, bent by twist 2."""
    nil = mi.load_dict(PLAIN | {"twist": 2.0, "max_depth": 1})
    sides = [(axis, sign) for axis in range(3) for sign in (1, -1)]
    cameras = {}
    for axis, sign in sides:
        forward = [sign * (i == axis) for i in range(3)]
        turn = T().look_at([0, 0, 0], forward, [0, 0, 1] if axis < 2 else [0, 1, 0])
        cameras[f"side{len(cameras)}"] = {
            "type": "perspective",
            "to_world": pose() @ turn,
            "fov": 90,
            "near_clip": NARROW,
        }
    inverse = mi.Transform4f(pose().inverse())

    def seen(camera, spp):
        """Green, and directions in the panorama's axes."""
        scene = furnished(camera)
        green = mi.render(scene, integrator=nil, spp=spp)[:, :, 1].array
        place = centres(scene.sensors()[0])
        return green, inverse @ rays(scene.sensors()[0], place)[0].d, place

    def moments(green, d, solid_angle, on):
        weight = dr.select(on, solid_angle * green, 0)
        return [dr.sum(weight * f)[0] for f in (1, d.x, d.y, d.z)]

    whole, d, place = seen(sensor("spherical", 192, 96), 16)
    solid_angle = dr.sin(dr.pi * place.y) * (2 * dr.pi / 192) * (dr.pi / 96)
    faces, d_faces, place = seen({"type": "batch", "film": film(6 * 24, 24)} | cameras, 64)
    for i, (axis, sign) in enumerate(sides):
        ahead = sign * d[axis]
        on = (ahead >= dr.abs(d[axis - 1])) & (ahead >= dr.abs(d[axis - 2]))
        part = mi.UInt32(place.x * 6) == i
        solid_angle_of_face = (2 / 24) ** 2 * (sign * d_faces[axis]) ** 3
        expected = moments(faces, d_faces, solid_angle_of_face, part)
        # The steps of the panorama's pixels along the edges of the cube are 1 % of a side's flux
        found = moments(whole, d, solid_angle, on)
        assert found == pytest.approx(expected, abs=0.025 * expected[0])


@pytest.mark.parametrize("integrator", ["path", "nil"])
def test_a_wide_filter_goes_on_across_the_seam_and_the_poles(rgb, integrator):
    """Turned by half a circle a panorama is the same picture, shifted. With a filter that ends at
    the film's edge they differ by 0.13 there."""
    chosen = mi.load_dict(
        {"type": integrator} | ({"quotient": False} if integrator == "nil" else {})
    )
    wide = film(32, 16, rfilter={"type": "gaussian", "stddev": 1.0}, sample_border=True)
    pictures = []
    for turn in (0, 180):
        to_world = pose() @ T().rotate([0, 1, 0], turn)
        sky = {"type": "envmap", "bitmap": mi.Bitmap(gradient(8, 4))}
        camera = sensor("spherical", film=wide, to_world=to_world)
        scene = mi.load_dict({"type": "scene", "sky": sky, "camera": camera})
        pictures.append(mi.render(scene, integrator=chosen, spp=1024, seed=turn))
    for i in (0, 16):
        first, second = pictures[0][:, i : i + 16, :], pictures[1][:, 16 - i : 32 - i, :]
        # Ten times the noise of a pixel within which radiance varies by 0.3
        assert dr.max(dr.abs(first.array - second.array))[0] < 10 * 0.1 * (2 / 1024) ** 0.5


def test_neighbours_across_the_seam_and_the_poles_see_neighbouring_points(rgb):
    """By the points that pixels see of a ball around the camera, at twist 1."""
    around = {"ball": {"type": "sphere", "center": [0.4, -0.3, 0.2], "radius": 1.0}}
    scene = mi.load_dict({"type": "scene", "camera": sensor("spherical", 64, 32)} | around)
    nil = mi.load_dict(PLAIN | {"max_depth": 1, "aovs": "position"})
    seen = mi.render(scene, integrator=nil, spp=256)[:, :, 3:]
    image = seen.array

    def gap(row, column, other_row, other_column):
        a, b = (3 * (64 * (r % 32) + c % 64) for r, c in ((row, column), (other_row, other_column)))
        return math.dist(*([image[i + j] for j in range(3)] for i in (a, b)))

    for row in range(32):
        beside = max(gap(row, 62, row, 63), gap(row, 64, row, 65))
        assert gap(row, 63, row, 64) < 1.3 * beside
    for row, next_row in ((0, 1), (31, 30)):
        for column in range(32):  # half a pixel away from the pole, on either side
            beside = (
                gap(row, column, next_row, column),
                gap(row, column + 32, next_row, column + 32),
            )
            assert 0.02 < gap(row, column, row, column + 32) < 1.3 * max(beside)


def test_hidden_emitters_and_what_is_around_a_dome_are_transparent(rgb):
    picture = film(16, 16, pixel_format="rgba")
    scene = furnished(sensor("fisheye", fov=360.0, film=picture))
    alpha = mi.render(scene, integrator=mi.load_dict(PLAIN), spp=16)[:, :, 3].array
    for number in range(256):
        radius = math.hypot(number % 16 - 7.5, number // 16 - 7.5)
        if radius < 7 or radius > 9:
            assert alpha[number] == (1 if radius < 7 else 0)
    scene = furnished(sensor("spherical", film=picture))
    hidden = [
        mi.render(scene, integrator=mi.load_dict(i | {"hide_emitters": True}), spp=64)
        for i in (PLAIN | {"twist": 0.0}, {"type": "path", "max_depth": 2})
    ]
    assert dr.max(dr.abs(hidden[0].array - hidden[1].array))[0] < 5 * 0.5 * (2 / 64) ** 0.5
    assert 0.1 < dr.mean(hidden[0][:, :, 3].array)[0] < 0.5


def test_clip_distances_are_lengths_along_every_ray(rgb):
    near, far = 0.3, 1.2
    # Rays that graze a ball may come to it from elsewhere, within a tolerance that is small here
    nil = mi.load_dict(PLAIN | {"max_depth": 1, "aovs": "distance", "tolerance": 0.01})
    whole, cut = (
        mi.render(furnished(of_kind("spherical") | clip), integrator=nil, spp=1)[:, :, 3].array
        for clip in ({}, {"near_clip": near, "far_clip": far})
    )
    length = whole + NARROW
    left = (whole > 0) & (length > near) & (length < far)
    assert dr.all(~left | (dr.abs(cut + near - length) < 1e-3))
    assert dr.all((length < far) | (cut == 0))
    assert dr.count(left)[0] > 20 and dr.count(length > far)[0] > 20


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("integrator", ["path", "nil"])
def test_without_a_far_clip_distance_all_is_seen(rgb, kind, integrator):
    """As far as with one that is far enough."""
    chosen = mi.load_dict(PLAIN if integrator == "nil" else {"type": "path", "max_depth": 2})
    first, second = (
        mi.render(furnished(of_kind(kind) | {"far_clip": far}), integrator=chosen, spp=1).array
        for far in (math.inf, 1e4)
    )
    assert dr.all(first == second) and dr.mean(first)[0] > 0


@pytest.mark.parametrize("air", [False, True], ids=["vacuum", "medium"])
@pytest.mark.parametrize("kind", ["spherical", "thinlens"])
def test_a_near_clip_distance_does_not_turn_the_sky(rgb, kind, air):
    """It hides, and moves nothing: on that way geodesics turn by up to 0.6 here."""
    lens = {"aperture_radius": 0.01, "focus_distance": 2.0} if kind == "thinlens" else {}
    ball = {"type": "sphere", "center": [9, 9, 9], "radius": 1e-3, "bsdf": {"type": "null"}}
    balls = {"ball": ball | {"interior": {"type": "homogeneous"}}} if air else {}
    nil = mi.load_dict(PLAIN | {"twist": 2.0, "max_depth": 1})
    pictures = []
    for near in (NARROW, 0.3):
        sky = {"type": "envmap", "bitmap": mi.Bitmap(gradient(8, 4))}
        camera = sensor(kind, 32, 16, near_clip=near) | lens
        scene = mi.load_dict({"type": "scene", "sky": sky, "camera": camera} | balls)
        pictures.append(mi.render(scene, integrator=nil, spp=16, seed=1).array)
    assert dr.max(dr.abs(pictures[0] - pictures[1]))[0] < 1e-3


def test_a_panorama_in_the_quotient_is_carried_into_the_cube(rgb):
    """The view from g·p is the view from p. Fails on equal expectations for one seed in 400."""
    twist, inside, g = 2, mi.Point3f(0.3, 0.4, 0.6), mi.Point3f(3, -2, 1)
    estimates = []
    for seed, p in enumerate((inside, geometry.multiply(g, inside, twist))):
        to_world = pose(*points(p)[0])
        camera = sensor("pair of panoramas", 16, 16, to_world=to_world)
        ball = {"type": "sphere", "center": [0.7, 0.5, 0.5], "radius": 0.2}
        sky = {"type": "envmap", "bitmap": mi.Bitmap(gradient(8, 4))}
        scene = mi.load_dict({"type": "scene", "camera": camera, "ball": ball, "sky": sky})
        nil = {"type": "nil", "twist": 2.0, "max_distance": 3.0, "max_depth": 2}
        estimates.append(Estimate(scene, nil, 64, seed))
    assert_same_expectation(*estimates, block=8)


# ------------------------------------------------------------------ two eyes


def test_the_eyes_of_a_column_stand_beside_each_other(rgb):
    """At twist 3: a group product in the sensor's horizontal plane, less towards the poles."""
    distance, twist = 0.3, 3.0
    pair = mi.load_dict(sensor("pair of panoramas", 16, 16, interocular_distance=distance))
    p, v, _ = starts(pair, twist)
    origin = mi.Point3f(pose() @ mi.ScalarPoint3f(0))
    starting, looking, seen = points(p), points(v), points(rays(pair)[0].d)
    for number in range(0, 256, 7):
        half, row, column = number // 128, number // 16 % 8, number % 16
        azimuth = math.pi * (1 - (column + 0.5) / 8)
        reach = 0.5 * distance * math.cos(math.pi * (0.5 - (row + 0.5) / 8)) * (1 if half else -1)
        # To the right of one who looks along the azimuth, which is measured from z to x
        across = in_world((-reach * math.cos(azimuth), 0, reach * math.sin(azimuth)))
        eye = geometry.multiply(origin, mi.Point3f(*across), twist)
        end = geometry.flow(eye, mi.Vector3f(*seen[number]), mi.Float(NARROW), twist)
        assert starting[number] == pytest.approx(points(end[0])[0], abs=2e-6)
        assert looking[number] == pytest.approx(points(end[1])[0], abs=2e-5)


@pytest.mark.parametrize("kind", ["spherical", "stereo_perspective"])
def test_both_eyes_are_the_left_one_above_the_right_one(rgb, kind):
    extra = {"interocular_distance": 0.2}
    both = mi.load_dict(sensor(kind, 12, 12, **extra, eye="both"))
    p, v, cone = starts(both, 2.0)
    for i, eye in enumerate(("left", "right")):
        one = starts(mi.load_dict(sensor(kind, 12, 6, **extra, eye=eye)), 2.0)
        part = dr.arange(mi.UInt32, 72) + 72 * i
        for mine, theirs in zip((p, v), one):
            assert dr.allclose(dr.gather(type(mine), mine, part), theirs, atol=1e-6)
        assert dr.allclose(dr.gather(mi.Float, cone.spread, part), one[2].spread, rtol=1e-3)


def test_eyes_that_coincide_see_what_one_sees(rgb):
    pair = mi.load_dict(sensor("spherical", 12, 12, eye="both", interocular_distance=0.0))
    one = starts(mi.load_dict(sensor("spherical", 12, 6)))
    for i in (0, 1):
        for mine, theirs in zip(starts(pair), one[:2]):
            part = dr.gather(type(mine), mine, dr.arange(mi.UInt32, 72) + 72 * i)
            assert dr.allclose(part, theirs, atol=1e-6)


@pytest.mark.parametrize("fibres", ["z", "y"])
@pytest.mark.parametrize("lens", [{"fov": 60.0}, {"focal_length": "30mm"}], ids=["fov", "focal"])
def test_a_perspective_pair_is_two_perspective_cameras(rgb, fibres, lens):
    """Each of them moved by a right translation, in coordinates, with its frame as it was."""
    from nil_mitsuba.quotient import Space

    twist, distance = 2.0, 0.4
    lens = lens | {"principal_point_offset_x": 0.1, "near_clip": 0.2}
    pair = mi.load_dict(sensor("stereo_perspective", 10, 12, interocular_distance=distance) | lens)
    p, v, cone = starts(pair, twist, fibres=fibres)
    space = Space(twist, False, [0, 0, 0], 1.0, fibres=fibres)
    origin = mi.Point3f(pose() @ mi.ScalarPoint3f(0))
    for i, side in enumerate((-0.5, 0.5)):
        across = mi.Point3f(*in_world((-side * distance, 0, 0)))
        eye = geometry.multiply(space.to_cells(origin), space.to_cells(across), twist)
        to_world = pose(*points(space.to_scene(eye))[0])
        one = {"type": "perspective", "to_world": to_world, "film": film(10, 6)}
        theirs = starts(mi.load_dict(one | lens), twist, fibres=fibres)
        part = dr.arange(mi.UInt32, 60) + 60 * i
        for mine, other in zip((p, v), theirs):
            assert dr.allclose(dr.gather(type(mine), mine, part), other, atol=3e-6)
        assert dr.allclose(dr.gather(mi.Float, cone.width, part), theirs[2].width, rtol=1e-3)


def test_disparity_of_a_pair_is_that_of_the_geodesics(rgb):
    """A small ball is seen where `connect` from each eye points, by a fifth of a pixel; straight
    lines from the same eyes would have it 10 pixels beside that."""
    twist, distance, size, fov = 2.0, 0.3, 64, 40.0
    origin, target = [0.2, 0.1, -0.3], [0.9, 1.1, 0.3]
    nil = mi.load_dict(PLAIN | {"twist": twist, "max_depth": 1})
    to_world = look_at(nil, origin, target, [0, 0, 1]).to_world
    pair = sensor(
        "stereo_perspective",
        size,
        2 * size,
        to_world=to_world,
        fov=fov,
        interocular_distance=distance,
    )
    lamp = {"type": "sphere", "center": target, "radius": 0.02, "l": {"type": "area"}}
    scene = mi.load_dict({"type": "scene", "camera": pair, "lamp": lamp})
    green = mi.render(scene, integrator=nil, spp=64)[:, :, 1].array
    inverse = to_world.inverse()

    def expected(side, k):
        step = to_world @ mi.ScalarVector3f(-side * distance, 0, 0)
        eye = geometry.multiply(mi.Point3f(origin), mi.Point3f(step), k)
        d = geometry.connect(eye, mi.Point3f(target), k).direction
        x, y, z = inverse @ mi.ScalarVector3f(*points(d)[0])
        scale = 0.5 * size / math.tan(math.radians(fov / 2))
        return 0.5 * size - scale * x / z, 0.5 * size - scale * y / z

    number = dr.arange(mi.UInt32, size * size)
    disparity = 0
    for i, side in enumerate((-0.5, 0.5)):
        light = dr.gather(mi.Float, green, number + i * size * size)
        total = dr.sum(light)
        centre = [
            dr.sum(light * (mi.Float(at) + 0.5))[0] / total[0]
            for at in (number % size, number // size)
        ]
        assert centre == pytest.approx(expected(side, twist), abs=0.2)
        assert math.dist(centre, expected(side, 0)) > 10
        disparity += centre[0] * (-1 if side > 0 else 1)
    assert disparity > 5  # the left eye sees it further to the right


# ------------------------------------------------------------------ as a plugin


@pytest.fixture
def back_to_rgb():
    yield
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize(
    "variant",
    [
        "scalar_rgb",
        *(
            pytest.param(v, marks=pytest.mark.verify)
            for v in ("llvm_ad_spectral", "llvm_ad_mono_polarized")
        ),
    ],
)
def test_path_renders_the_sensors_in_every_variant(rgb, back_to_rgb, variant):
    """Against the picture of the usual variant."""

    def luminance(kind):
        scene = mi.load_dict(
            {
                "type": "scene",
                "camera": of_kind(kind),
                "sky": {"type": "constant"},
                "lamp": {"type": "cube", "to_world": T().translate([1.5, 0, 0]).scale(0.7)},
            }
        )
        image = mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=16)
        values = list(image.array)
        channels = image.shape[2]
        return [values[i + channels // 2] for i in range(0, len(values), channels)]

    expected = {kind: luminance(kind) for kind in KINDS}
    mi.set_variant(variant)
    for kind, values in expected.items():
        found = luminance(kind)
        # 16 samples at an edge of contrast 1, many pixels, and in the mean
        assert max(abs(a - b) for a, b in zip(found, values)) < 0.9
        assert mean_of(found) == pytest.approx(mean_of(values), abs=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sensor_moves_where_its_parameters_say(rgb, kind):
    loaded = mi.load_dict(of_kind(kind))
    moved = T().translate([1, 2, 3]) @ T().rotate([0, 0.6, 0.8], 70)
    parameters = mi.traverse(loaded)
    parameters["to_world"] = moved
    parameters["near_clip"] = 0.5
    parameters.update()
    expected = starts(mi.load_dict(of_kind(kind) | {"to_world": moved, "near_clip": 0.5}))
    for mine, theirs in zip(starts(loaded), expected[:2]):
        assert dr.allclose(mine, theirs, atol=1e-6)
    parameters["to_world"] = T().scale(2)
    with pytest.raises(RuntimeError, match="Scale factors"):
        parameters.update()


@pytest.mark.parametrize(
    "kind, name, value",
    [
        ("pair of panoramas", "interocular_distance", 0.3),
        ("stereo_perspective", "interocular_distance", 0.3),
        ("stereo_perspective", "x_fov", 50.0),
        ("stereo_perspective", "principal_point_offset_y", 0.1),
        ("fisheye", "fov", 90.0),
    ],
)
def test_a_sensors_own_parameters_can_be_changed(rgb, kind, name, value):
    loaded = mi.load_dict(of_kind(kind))
    parameters = mi.traverse(loaded)
    parameters[name] = value
    parameters.update()
    given = {"fov" if name == "x_fov" else name: value}
    expected = starts(mi.load_dict(of_kind(kind) | given))
    before = starts(mi.load_dict(of_kind(kind)))
    for i, mine in enumerate(starts(loaded)[:2]):
        assert dr.allclose(mine, expected[i], atol=1e-6)
    assert not (
        dr.allclose(before[0], expected[0], atol=1e-4)
        and dr.allclose(before[1], expected[1], atol=1e-4)
    )


@pytest.mark.parametrize(
    "kind, given, sentence",
    [
        (
            "spherical",
            {"film": {"type": "hdrfilm"}},
            'seam .* <rfilter type="box".*sample_bord',
        ),
        ("spherical", {"eye": "middle"}, 'left, right or both, and it is "middle"'),
        ("spherical", {"eye": "left"}, '"eye" = left needs "interocular_distance"'),
        ("spherical", {"interocular_distance": 0.1}, '"interocular_distance" goes with "eye"'),
        (
            "spherical",
            {"eye": "left", "interocular_distance": -1.0},
            "must not be negative: it is -1",
        ),
        ("spherical", {"near_clip": 0.0}, "'near_clip' parameter must be greater than zero"),
        ("fisheye", {"far_clip": 0.001}, "must be smaller than 'far_clip'"),
        ("fisheye", {"far_clip": "near"}, "wrong type"),
        ("fisheye", {"fov": 361.0}, "at most 360 degrees, and it is 361"),
        ("fisheye", {"eye": "left"}, 'unreferenced property .*\n.*"eye"'),
        ("fisheye", {"to_world": [1, 2, 1]}, "Scale factors"),
        ("stereo_perspective", {}, '"eye" = both needs "interocular_distance"'),
        ("stereo_perspective", {"interocular_distance": 1.0, "fov": 190.0}, "field of view"),
        (
            "stereo_perspective",
            {"interocular_distance": 1.0, "film": film(8, 7)},
            "height must be even, and it is 7",
        ),
        (
            "stereo_perspective",
            {"interocular_distance": 1.0, "film": {"type": "hdrfilm"}},
            "would mix the pictures of both eyes",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(rgb, kind, given, sentence):
    if "to_world" in given:
        given = {"to_world": T().scale(given["to_world"])}
    with pytest.raises(RuntimeError, match=sentence):
        mi.load_dict({"type": kind, "film": film(8, 8)} | given)


@pytest.mark.parametrize("kind", ["spherical", "stereo_perspective"])
def test_a_height_that_two_eyes_cannot_share_is_refused_whoever_sets_it(rgb, kind):
    """A batch, whose height its sensors get when they are there, or mi.traverse."""
    pair = sensor(kind, 8, 8, eye="both", interocular_distance=0.1)
    with pytest.raises(RuntimeError, match="height must be even, and it is 7"):
        mi.load_dict({"type": "batch", "a": pair, "film": film(8, 7)})
    parameters = mi.traverse(mi.load_dict(pair))
    parameters["film.size"] = [8, 7]
    with pytest.raises(RuntimeError, match="height must be even, and it is 7"):
        parameters.update()


def test_other_sensors_in_python_are_known_by_what_they_offer(rgb):
    """One that shows its near clip and its transform is a camera; of another nothing is known."""
    from nil_mitsuba import sensors

    class Known(sensors.Spherical):
        pass

    class Unknown(sensors.Spherical):
        def traverse(self, callback):
            pass

    for cls in (Known, Unknown):
        mi.register_sensor(cls.__name__.lower(), cls)
    nil = mi.load_dict(PLAIN)
    scenes = [furnished(of_kind("spherical") | {"type": name}) for name in ("known", "unknown")]
    assert dr.mean(mi.render(scenes[0], integrator=nil, spp=1).array)[0] > 0
    with pytest.raises(
        RuntimeError, match='no meaning for the sensor "Unknown": use .*spherical.* mi.traverse'
    ):
        nil.render(scenes[1], spp=1)


def test_a_batch_holds_panoramas(rgb):
    """Side by side with another sensor: each has the rays that it has alone."""
    both = sensor("pair of panoramas", 6, 12)
    other = {"type": "perspective", "to_world": T().translate([1, 2, 3]), "fov": 60}
    batch = mi.load_dict({"type": "batch", "a": both, "b": other, "film": film(12, 12)})
    column = dr.arange(mi.UInt32, 144) % 12
    rest = dr.arange(mi.UInt32, 144) // 12 * 6 + column % 6
    for i, child in enumerate((both, other | {"film": film(6, 12)})):
        alone = starts(mi.load_dict(child), 2.0)
        for mine, theirs in zip(starts(batch, 2.0)[:2], alone):
            apart = dr.norm(mi.Vector3f(mine - dr.gather(type(theirs), theirs, rest)))
            assert dr.all((column // 6 != i) | (apart < 2e-6))


@pytest.mark.parametrize("kind", KINDS)
def test_an_aimed_panoramas_middle_meets_its_target(rgb, kind):
    parameters = {"twist": 2.0, "fibres": "y", "cell_size": 3.0}
    nil = mi.load_dict({"type": "nil"} | parameters)
    aim = look_at(nil, [0.6, 0.3, 2.1], [1.8, 2.4, 1.2], up=[0, 1, 0], image=(1, -1, 0))
    extra = {"interocular_distance": 0.0} if kind == "stereo_perspective" else {}
    extra |= {"interocular_distance": 0.0} if kind == "pair of panoramas" else {}
    loaded = mi.load_dict(of_kind(kind) | {"to_world": aim.to_world} | extra)
    eyes = bool(extra)
    from nil_mitsuba.camera import Camera

    space = nil.space()
    place = mi.Point2f(0.5, 0.25 if eyes else 0.5)
    p, v, *_ = Camera(loaded, space, 0.25).start(rays(loaded, place)[0], mi.Float(0.5))
    way = (aim.focus_distance - NARROW) / 3.0
    end, _ = geometry.flow(p, space.to_cell_axes(v), mi.Float(way), 2.0)
    there, cell = geometry.wrap(end, 2.0)
    assert dr.allclose(space.to_scene(there), mi.Point3f(1.8, 2.4, 1.2), atol=1e-4)
    assert points(cell)[0] == (1, -1, 0)


def test_the_medium_around_a_sensor_is_its_own(rgb):
    for whole in map(of_kind, KINDS):
        assert mi.load_dict(whole).get_medium() is None
        assert mi.load_dict(whole | {"air": {"type": "homogeneous"}}).get_medium() is not None


# ------------------------------------------------------------------ stills


CHANGES = [
    ("pair of panoramas", {"interocular_distance": 0.2}),
    ("pair of panoramas", {"eye": "left"}),
    ("pair of panoramas", {"near_clip": 0.2}),
    ("pair of panoramas", {"shutter_close": 1.0}),
    ("fisheye", {"fov": 200.0}),
    ("stereo_perspective", {"fov": 60.0}),
    ("stereo_perspective", {"principal_point_offset_x": 0.1}),
]


@pytest.mark.parametrize("kind, given", CHANGES)
def test_a_checkpoint_is_of_one_sensor_only(rgb, kind, given):
    """Whether it is the scene's or passed beside it."""
    hashes = {
        stills.hash_of(mi.load_dict(whole))
        for whole in (of_kind(kind), of_kind(kind), of_kind(kind) | given)
    }
    assert len(hashes) == 2
    scenes = {
        stills.hash_of(mi.load_dict({"type": "scene", "camera": whole}))
        for whole in (of_kind(kind), of_kind(kind), of_kind(kind) | given)
    }
    assert len(scenes) == 2


def test_a_batch_is_told_apart_by_what_its_sensors_are(rgb):
    """It describes itself by an address, which tells nothing and differs from load to load."""

    def batch(eye):
        children = {"a": sensor("pair of panoramas", eye=eye), "b": {"type": "perspective"}}
        return mi.load_dict(
            {"type": "scene", "s": {"type": "batch", "film": film(8, 4)} | children}
        )

    scenes = [batch(eye) for eye in ("left", "left", "right")]  # all there at the same time
    first, again, other = map(stills.hash_of, scenes)
    assert first == again != other


SCENE = """
<scene version="3.0.0">
    <integrator type="nil"><float name="max_distance" value="2"/></integrator>
    <sensor type="spherical">
        <string name="eye" value="both"/><float name="interocular_distance" value="0.05"/>
        <transform name="to_world">
            <lookat origin="0.2, 0.2, 0.2" target="1, 1, 1" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="16"/><integer name="height" value="16"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere" id="ball">
        <point name="center" x="0.6" y="0.5" z="0.5"/><float name="radius" value="0.1"/>
    </shape>
</scene>
"""


def test_a_still_of_a_panorama_goes_on_and_comes_in_parts(rgb, tmp_path, fresh_python):
    """Another process, as those of a cluster, renders the same part of the same still."""
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    job = jobs.Job(str(path), spp=8, pass_spp=4)
    still = jobs.open_still(job)
    whole = still.nothing().plus(still.render(0)).plus(still.render(1))
    mine = jobs.render_part(job, 1, 2)
    run = fresh_python(
        "import pickle, sys\n"
        "from nil_mitsuba import jobs\n"
        f"job = pickle.loads({pickle.dumps(job)!r})\n"
        f"open({str(tmp_path / 'part')!r}, 'wb').write(jobs.render_part(job, 1, 2))"
    )
    assert run.returncode == 0, run.stderr
    from nil_mitsuba.checkpoint import Checkpoint

    parts = [Checkpoint.from_bytes(data) for data in (mine, (tmp_path / "part").read_bytes())]
    for part in parts:
        image = still.develop(still.nothing().plus(still.render(0)).plus(part))
        assert dr.allclose(image, still.develop(whole), rtol=1e-4)


def test_the_command_aims_a_panorama(command, folder):
    """It has no focus, and what is printed fits into its place."""
    (folder / "scene.xml").write_text(SCENE)
    status, out, err = command("aim", "scene.xml", "--at", "ball")
    assert status == 0, err
    assert "focus_distance" not in out
    printed = xml.fromstring(out)
    assert printed.tag == "transform" and printed.get("name") == "to_world"
