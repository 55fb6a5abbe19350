"""Rooms and skies whose radiance is known in every sample: nothing is lost or found twice.

Lights are found by BSDF sampling alone and Russian roulette is off, so there is no noise: each
sample must give the exact value but for float32 rounding.
"""

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import (
    ALBEDO,
    EMISSION,
    ROUNDING,
    cube_room,
    glowing,
    nil,
    sensor,
    write_ply,
)


def sphere_room():
    return {"room": glowing({"type": "sphere", "flip_normals": True})}


def six_walls():
    T = mi.ScalarTransform4f
    turns = [T(), T().rotate([1, 0, 0], 180)]
    turns += [T().rotate(axis, angle) for axis in ([1, 0, 0], [0, 1, 0]) for angle in (90, -90)]
    return {
        f"wall{i}": glowing({"type": "rectangle", "to_world": turn @ T().translate([0, 0, -1])})
        for i, turn in enumerate(turns)
    }


def furnished_room():
    """A room with things in it that glow as its walls do."""
    T = mi.ScalarTransform4f
    return cube_room() | {
        "ball": glowing({"type": "sphere", "center": [-0.5, 0.4, -0.6], "radius": 0.3}),
        "box": glowing(
            {
                "type": "cube",
                "to_world": T().translate([0, -0.6, -0.7]).rotate([0, 0, 1], 20).scale(0.25),
            }
        ),
    }


class Walls:
    """One mesh of quadrangles that all glow towards the room.

    Nothing sticks out behind them: a part of a wall that was hidden in another would be found by
    rays whose error, which a rough bounce allows to grow, takes them round the corner.
    """

    def __init__(self):
        self.vertices, self.triangles = [], []

    def add(self, towards, *corners):
        """A quadrangle whose front is seen from the direction ``towards``."""
        first = len(self.vertices)
        self.vertices += corners
        u, v = ([c - o for c, o in zip(corner, corners[0])] for corner in (corners[1], corners[2]))
        normal = [u[i - 2] * v[i - 1] - u[i - 1] * v[i - 2] for i in range(3)]
        front = sum(n * t for n, t in zip(normal, towards)) > 0
        for i, j in ((1, 2), (2, 3)):
            self.triangles.append(
                (first, first + i, first + j) if front else (first, first + j, first + i)
            )

    def save(self, folder):
        file = write_ply(folder / "walls.ply", self.vertices, self.triangles)
        return {"walls": glowing({"type": "ply", "filename": file, "face_normals": True})}


# The two ends of an axis: what goes beyond the cube does not exist, and leaves no crack at it.
ENDS = ((-0.1, 0.48, -1), (0.52, 1.1, 1))


def room_across_faces(twist, folder):
    """A room around the cell's faces, edges and corner, between walls in the cell's middle.

    Its floor and ceiling z = 1/2 ± 0.005 + k x y, |y| < 1/2, cross the faces x and y without a
    step (a plane z = const does not: the gluing shears it).
    """
    walls = Walls()
    for x0, x1, right in ENDS:
        for y0, y1, back in ENDS:
            far = back > 0
            for side in (1, -1):
                end = 1.1 if side > 0 else -0.1

                def at(x, y):
                    return x, y, 0.5 + side * 0.005 + twist * x * (y - far)

                x, y = x0 if right > 0 else x1, y0 if back > 0 else y1
                walls.add((right, 0, 0), at(x, y0), at(x, y1), (x, y1, end), (x, y0, end))
                walls.add((0, back, 0), at(x0, y), at(x1, y), (x1, y, end), (x0, y, end))
                # It bends between its corners, so they lie on the faces of the cube.
                u0, u1 = max(x0, 0.0), min(x1, 1.0)
                v0, v1 = max(y0, 0.0), min(y1, 1.0)
                walls.add((0, 0, side), at(u0, v0), at(u1, v0), at(u1, v1), at(u0, v1))
    return walls.save(folder)


def room_across_y_and_z(_twist, folder):
    """A room around the faces y and z, with walls before the faces x."""
    walls = Walls()
    for y0, y1, back in ENDS:
        for z0, z1, up in ENDS:
            y, z = y0 if back > 0 else y1, z0 if up > 0 else z1
            for x, right in ((0.02, 1), (0.98, -1)):
                walls.add((right, 0, 0), (x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1))
            walls.add((0, back, 0), (0.02, y, z0), (0.98, y, z0), (0.98, y, z1), (0.02, y, z1))
            walls.add((0, 0, up), (0.02, y0, z), (0.98, y0, z), (0.98, y1, z), (0.02, y1, z))
    ball = glowing({"type": "sphere", "center": [0.4, 0.2, 0.8], "radius": 0.15})
    return {"ball": ball, **walls.save(folder)}


def check_room(scene, integrator, max_depth, spp, seed=0, leaks=0):
    """Each pixel has the exact value, but for at most ``leaks`` of them."""
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    exact = EMISSION * (1 - ALBEDO**max_depth) / (1 - ALBEDO)
    error = dr.abs(image.array / exact - 1)
    wrong = dr.count(error > ROUNDING)[0] // 3
    assert wrong <= leaks, f"{wrong} pixels are wrong, by up to {dr.max(error)[0]:.2g}"


@pytest.mark.parametrize("room", [cube_room, sphere_room, six_walls, furnished_room])
@pytest.mark.parametrize("twist", [0, 1, 3, -1])
def test_closed_room_of_plain_nil_has_the_radiance_of_a_geometric_series(rgb, room, twist):
    """A lost or doubled vertex makes its pixel differ by 1e-4 or more."""
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]), **room()}
    )
    check_room(scene, nil(twist, False, 8), 8, spp=16)


@pytest.mark.parametrize("max_depth", [1, 2, 20])
def test_radiance_of_a_closed_room_follows_the_number_of_bounces(rgb, max_depth):
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]), **cube_room()}
    )
    check_room(scene, nil(1, False, max_depth), max_depth, spp=4)


@pytest.mark.parametrize("cell", [([0.0, 0.0, 0.0], 1.0), ([-3.0, 2.0, 1.0], 2.0)])
def test_closed_room_does_not_depend_on_the_cell(rgb, cell):
    """Where the group's identity lies and how long its unit is bends the rays, not the sum."""
    origin, size = cell
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]), **furnished_room()}
    )
    check_room(
        scene, nil(1, False, 8, cell_origin=mi.ScalarPoint3f(*origin), cell_size=size), 8, spp=16
    )


@pytest.mark.parametrize(
    "room, twist",
    [
        *[(room_across_faces, twist) for twist in (0, 1, -1)],
        *[(room_across_y_and_z, twist) for twist in (0, 1, 2)],
    ],
)
def test_closed_room_of_the_quotient_has_the_radiance_of_a_geometric_series(
    rgb, room, twist, tmp_path
):
    """A lost or doubled vertex makes its pixel differ by 1e-4 or more."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor([0.2, 0.1, 0.9], [0.9, 0.05, 0.95]),
            **room(twist, tmp_path),
        }
    )
    check_room(scene, nil(twist, True, 8), 8, spp=16)


@pytest.mark.parametrize(
    "twist", [0, 3, *(pytest.param(twist, marks=pytest.mark.verify) for twist in (1, 2))]
)
def test_glowing_things_under_an_equally_bright_sky_are_invisible(rgb, twist):
    """In equilibrium each path has the same radiance, wherever it ends and whatever it crosses."""
    things = {
        "a": glowing({"type": "sphere", "center": [0.3, 0.6, 0.4], "radius": 0.25}),
        "b": glowing(
            {
                "type": "cube",
                "to_world": mi.ScalarTransform4f()
                .translate([0.5, 0.15, 0.8])
                .rotate([0, 0, 1], 30)
                .scale(0.1),
            }
        ),
    }
    equilibrium = EMISSION / (1 - ALBEDO)
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor([0.05, 0.05, 0.05], [0.6, 0.5, 0.4]),
            **things,
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": equilibrium}},
        }
    )
    # 0.8^120 is below a unit in the last place
    image = mi.render(scene, integrator=nil(twist, True, 120), spp=16)
    error = dr.max(mi.Color3f(dr.abs(dr.unravel(mi.Color3f, image.array) / equilibrium - 1)))
    # One path in 200,000 is lost (4 of 786,000 were counted): two of an image's 16,384 are in one
    # image of 300. One of a pixel's 16 paths brings at most as much as the rest.
    assert dr.count(error > 3 * ROUNDING)[0] <= 1
    assert dr.all(error <= 1 / 16)


@pytest.mark.verify
@pytest.mark.parametrize("twist, quotient", [(1, False), (3, False), (1, True), (2, True)])
def test_hardly_a_ray_is_lost_at_ten_million_vertices(rgb, twist, quotient, tmp_path):
    """At most one in a million, for rays that hit an edge of the room to the last bit.

    A lost vertex leaves its pixel 1e-4 or more too dark.
    """
    vertices, leaks = 256 * 256 * 16 * 10, 1e-6
    if quotient:
        room = room_across_faces if twist == 1 else room_across_y_and_z
        scene = {"sensor": sensor([0.2, 0.1, 0.9], [0.9, 0.05, 0.95], 256), **room(twist, tmp_path)}
    else:
        scene = {"sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0], 256), **furnished_room()}
    scene = mi.load_dict({"type": "scene", **scene})
    check_room(scene, nil(twist, quotient, 10), 10, spp=16, leaks=leaks * vertices)


# ------------------------------------------------------------------ white things under a white sky
WHITE = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
    "mirror": {"type": "conductor"},
    "glass": {"type": "dielectric"},
    "thin glass": {"type": "thindielectric"},
    "twosided": {
        "type": "twosided",
        "a": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
    },
    "nothing": {"type": "null"},
}


def white_scene(bsdf, quotient):
    things = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}}}
    if quotient:
        things |= {
            "sensor": sensor([0.1, 0.1, 0.1], [0.8, 0.7, 0.6]),
            "a": {"type": "sphere", "center": [0.5, 0.55, 0.5], "radius": 0.2, "bsdf": bsdf},
            "b": {"type": "sphere", "center": [0.05, 0.6, 0.3], "radius": 0.04, "bsdf": bsdf},
        }
    else:
        things |= {
            "sensor": sensor([4, 0, 0], [0, 0, 0]),
            "a": {"type": "sphere", "radius": 1.2, "bsdf": bsdf},
            "b": {"type": "sphere", "center": [0, 1.8, 0.2], "radius": 0.5, "bsdf": bsdf},
            "c": {"type": "sphere", "center": [0.5, -1.5, -0.3], "radius": 0.3, "bsdf": bsdf},
        }
    return mi.load_dict({"type": "scene", **things})


@pytest.mark.parametrize("bsdf", WHITE)
@pytest.mark.parametrize(
    "twist, quotient", [(0, False), (1, False), (3, False), (1, True), (2, True)]
)
def test_white_things_vanish_under_a_white_sky(rgb, bsdf, twist, quotient):
    """Each path brings the sky's radiance, or nothing if ``max_depth`` ends it."""
    scene = white_scene(WHITE[bsdf], quotient)
    max_depth = 40
    # one sample a pixel: no sum hides another
    image = mi.render(scene, integrator=nil(twist, quotient, max_depth), spp=1)
    ended = image.array == 0
    wrong = dr.count(~ended & (dr.abs(image.array / 0.7 - 1) > ROUNDING))[0]
    # Glass, too: of a million geodesics hardly one that grazes it enters or leaves it alone
    assert wrong == 0
    # In the quotient a path is free only after 12 cells without a hit, and one that goes straight
    # through things may meet them again for ever.
    assert dr.count(ended)[0] <= (0.3 if quotient else 0.001) * len(image.array)


def test_sky_behind_the_horizon_is_seen_undimmed(rgb):
    """An empty quotient: each ray reaches ``max_distance`` and meets the sky there."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor([0.5, 0.5, 0.5], [1, 0.7, 0.6]),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}},
        }
    )
    image = mi.render(scene, integrator=nil(1, True, 3), spp=2)
    assert dr.all(dr.abs(image.array / 0.7 - 1) <= ROUNDING)
