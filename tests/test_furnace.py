"""Rooms and skies whose radiance is known in every sample: nothing may be lost, gained or found twice.

Lights are found by BSDF sampling alone and Russian roulette is off, so there is no noise: each
sample must give the exact value but for float32 rounding.
"""

import drjit as dr
import mitsuba as mi
import pytest
from studio import film, without_emitter_sampling

ALBEDO, EMISSION = 0.8, 0.5

# Float32 sums of up to 20 terms.
ROUNDING = 1e-5


def nil(twist, quotient, max_depth, **more):
    integrator = {"type": "nil", "twist": float(twist), "quotient": quotient,
                  "max_depth": max_depth, "rr_depth": 100_000} | more
    return without_emitter_sampling(mi.load_dict(integrator))


def glowing(shape):
    """The shape, white as chalk that glows: every path through it has the same radiance."""
    return shape | {
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
        "light": {"type": "area", "radiance": {"type": "rgb", "value": EMISSION}},
    }


def sensor(origin, target, size=32, **more):
    return {"type": "perspective", "fov": 80,
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
            "film": film(size, size, **more)}


def cube_room():
    return {"room": glowing({"type": "cube", "flip_normals": True})}


def sphere_room():
    return {"room": glowing({"type": "sphere", "flip_normals": True})}


def six_walls():
    T = mi.ScalarTransform4f
    turns = [T(), T().rotate([1, 0, 0], 180)]
    turns += [T().rotate(axis, angle) for axis in ([1, 0, 0], [0, 1, 0]) for angle in (90, -90)]
    return {f"wall{i}": glowing({"type": "rectangle", "to_world": turn @ T().translate([0, 0, -1])})
            for i, turn in enumerate(turns)}


def furnished_room():
    """A room with things in it that glow as its walls do."""
    T = mi.ScalarTransform4f
    return cube_room() | {
        "ball": glowing({"type": "sphere", "center": [-0.5, 0.4, -0.6], "radius": 0.3}),
        "pole": glowing({"type": "cylinder", "p0": [0.5, 0.5, -1], "p1": [0.5, 0.5, 1],
                         "radius": 0.1}),
        # Inside the pole nobody looks: the cylinder is open, but both ends touch the room.
        "box": glowing({"type": "cube",
                        "to_world": T().translate([0, -0.6, -0.7]).rotate([0, 0, 1], 20)
                        .scale(0.25)}),
    }


def lattice_room():
    """Walls across the middle of the cell that reach through its faces: what is left open between
    them is a room that lies around the cell's edges and corner, through all six faces."""
    T = mi.ScalarTransform4f
    return {
        f"wall{i}": glowing({
            "type": "cube",
            # Beyond the cube they do not exist.
            "to_world": T().translate([0.5, 0.5, 0.5])
            .scale([0.02 if i == j else 0.6 for j in range(3)]),
        })
        for i in range(3)
    }


def lattice_of_balls_and_floor():
    """Two glowing walls and a ball: no ray goes further than the walls' distance."""
    walls = lattice_room()
    walls["ball"] = glowing({"type": "sphere", "center": [0.98, 0.2, 0.8], "radius": 0.3})
    return walls


def check_room(scene, integrator, max_depth, spp, seed=0):
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    exact = EMISSION * (1 - ALBEDO**max_depth) / (1 - ALBEDO)
    error = dr.max(dr.abs(image.array / exact - 1))[0]
    lost = dr.count(dr.abs(image.array / exact - 1) > ROUNDING)[0] // 3
    assert error <= ROUNDING, f"{lost} pixels are wrong, by up to {error:.2g} of {exact:.4f}"


@pytest.mark.parametrize("room", [cube_room, sphere_room, six_walls, furnished_room])
@pytest.mark.parametrize("twist", [0, 1, 3, -1])
def test_closed_room_of_plain_nil_has_the_radiance_of_a_geometric_series(rgb, room, twist):
    """A lost or doubled vertex makes its pixel differ by 1e-4 or more."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]),
                          **room()})
    check_room(scene, nil(twist, False, 8), 8, spp=16)


@pytest.mark.parametrize("max_depth", [1, 2, 20])
def test_radiance_of_a_closed_room_follows_the_number_of_bounces(rgb, max_depth):
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]),
                          **cube_room()})
    check_room(scene, nil(1, False, max_depth), max_depth, spp=4)


@pytest.mark.parametrize("cell", [([0.0, 0.0, 0.0], 1.0), ([-3.0, 2.0, 1.0], 2.0)])
def test_closed_room_does_not_depend_on_the_cell(rgb, cell):
    """Where the group's identity lies and how long its unit is bends the rays, not the sum."""
    origin, size = cell
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0]),
                          **furnished_room()})
    check_room(scene, nil(1, False, 8, cell_origin=mi.ScalarPoint3f(*origin), cell_size=size), 8,
               spp=16)


@pytest.mark.parametrize("room", [lattice_room, lattice_of_balls_and_floor])
@pytest.mark.parametrize("twist", [0, 1, 2, -1])
def test_closed_room_of_the_quotient_has_the_radiance_of_a_geometric_series(rgb, room, twist):
    """Its rays cross all faces, edges and corners of the cell. A lost or doubled vertex makes its
    pixel differ by 1e-4 or more."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0.2, 0.1, 0.9], [0.9, 0.05, 0.95]),
                          **room()})
    check_room(scene, nil(twist, True, 8), 8, spp=16)


@pytest.mark.verify
@pytest.mark.parametrize("twist, quotient", [(1, False), (3, False), (1, True), (2, True)])
def test_no_ray_is_lost_at_ten_million_vertices(rgb, twist, quotient):
    """A vertex lost in any of 10⁷ leaves its pixel 1e-4 or more too dark."""
    if quotient:
        scene = {"sensor": sensor([0.2, 0.1, 0.9], [0.9, 0.05, 0.95], 256), **lattice_room()}
    else:
        scene = {"sensor": sensor([0.3, -0.2, 0.1], [0.9, 0.5, 0], 256), **furnished_room()}
    scene = mi.load_dict({"type": "scene", **scene})
    check_room(scene, nil(twist, quotient, 10), 10, spp=16)


# ------------------------------------------------------------------ white things under a white sky

WHITE = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
    "mirror": {"type": "conductor"},
    "glass": {"type": "dielectric"},
    "thin glass": {"type": "thindielectric"},
    "twosided": {"type": "twosided",
                 "a": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}},
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
@pytest.mark.parametrize("twist, quotient", [(0, False), (1, False), (3, False), (1, True),
                                             (2, True)])
def test_white_things_vanish_under_a_white_sky(rgb, bsdf, twist, quotient):
    """Each path brings the sky's radiance, or nothing if ``max_depth`` ends it."""
    scene = white_scene(WHITE[bsdf], quotient)
    max_depth = 40
    # one sample a pixel: no sum hides another
    image = mi.render(scene, integrator=nil(twist, quotient, max_depth), spp=1)
    ended = image.array == 0
    assert dr.all(ended | (dr.abs(image.array / 0.7 - 1) <= ROUNDING))
    # In the quotient a path is free after 12 cells without a hit: one bounce in two.
    assert dr.count(ended)[0] <= (0.01 if quotient else 0.001) * len(image.array)


def test_sky_behind_the_horizon_is_seen_undimmed(rgb):
    """An empty quotient: each ray reaches ``max_distance`` and meets the sky there."""
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0.5, 0.5, 0.5], [1, 0.7, 0.6]),
                          "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}}})
    image = mi.render(scene, integrator=nil(1, True, 3), spp=2)
    assert dr.all(dr.abs(image.array / 0.7 - 1) <= ROUNDING)
