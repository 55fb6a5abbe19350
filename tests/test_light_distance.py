"""Point-like lights far from zero and in small units, and lights that move between renders."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from benchmarks.studio import film, gradient

KINDS = ["point", "spot", "projector"]


def turned(place):
    return mi.ScalarTransform4f().translate(list(place)).rotate([0.36, 0.48, 0.8], 70)


def light(kind, place):
    return {
        "point": {"type": "point", "position": list(place)},
        "spot": {
            "type": "spot",
            "to_world": turned(place),
            "cutoff_angle": 30.0,
            "beam_width": 10.0,
        },
        "projector": {
            "type": "projector",
            "to_world": turned(place),
            "fov": 50.0,
            "irradiance": {"type": "bitmap", "data": gradient(8, 8), "raw": True},
        },
    }[kind]


def directions(count):
    """Directions in a cone of 0.6 radians about the axis of a turned light."""
    i = mi.Float(dr.arange(mi.UInt32, count))
    (s, c), (sin_phi, cos_phi) = dr.sincos(0.6 * (i + 0.5) / count), dr.sincos(2.4 * i)
    return mi.Transform4f(turned((0, 0, 0))) @ mi.Vector3f(s * cos_phi, s * sin_phi, c)


class Half:
    """A sampler for lights that leave nothing to chance."""

    def next_1d(self):
        return mi.Float(0.5)

    def next_2d(self):
        return mi.Point2f(0.5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "place, cell",
    [
        ((0.0, 0.0, 0.0), 1.0),
        ((1e5, -2e5, 5e4), 100.0),
        ((1e6, 2e6, -5e5), 1000.0),
        ((-3e6, 4e6, 1e3), 1000.0),
        ((2.0**-13, -(2.0**-14), 2.0**-12), 1e-4),
    ],
)
def test_a_beam_is_the_same_far_from_the_origin_and_in_small_units(rgb, kind, place, cell):
    """Receivers up to a cell away see, along a line, the intensity that a light at the origin has
    in their direction, to 0.1 % but for the edge of its beam."""
    count = 5000
    nil = mi.load_dict(
        {
            "type": "nil",
            "twist": 0.0,
            "quotient": False,
            "cell_size": cell,
            "cell_origin": list(place),
        }
    )
    scene = mi.load_dict({"type": "scene", "lamp": light(kind, place)})
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p = mi.Point3f(*place) + 0.7 * cell * directions(count)
    # What the receivers' own coordinates have lost is no matter of the light
    way = mi.Vector3f(si.p - mi.Point3f(*place))
    dr.eval(si.p, way)
    si.n = mi.Normal3f(-dr.normalize(way))
    si.sh_frame = mi.Frame3f(si.n)
    found = nil.view(scene).lights.sample(si, Half(), mi.Bool(True))
    intensity = found.weight * dr.squared_norm(way)

    at_origin = mi.load_dict(light(kind, (0, 0, 0)))
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(dr.normalize(way))
    ds, expected = at_origin.sample_direction(reference, mi.Point2f(0.5))
    expected = dr.select(ds.pdf > 0, expected, 0)
    off = dr.any(dr.abs(intensity - expected) > 1e-3 * expected + 1e-6 * dr.max(expected))
    assert dr.count(off)[0] <= (0 if kind == "point" else 2e-3 * count)
    assert dr.count(expected[0] > 0)[0] > 0.5 * count


# ------------------------------------------------------------------ between renders


def rendered(how, scene):
    integrator = mi.load_dict({"type": "nil", "quotient": False, "max_depth": 3})
    if how == "mi.render":
        return mi.render(scene, integrator=integrator, spp=16, seed=3)
    return nil_mitsuba.render(scene, integrator=integrator, spp=16, seed=3)


def lamp(kind, place):
    T = mi.ScalarTransform4f()
    size = 0.2 + 0.2 * place[0]
    to_world = T.look_at(list(place), [0.1, 0, 0], [0, 1, 0.1])
    glowing = {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}
    return {
        "point": {"type": "point", "position": list(place)},
        "spot": {"type": "spot", "to_world": to_world, "cutoff_angle": 40.0},
        "projector": {"type": "projector", "to_world": to_world, "fov": 60.0},
        "rectangle": {"type": "rectangle", "to_world": to_world @ T.scale(size), "light": glowing},
        "sphere": {"type": "sphere", "to_world": to_world @ T.scale(size), "light": glowing},
        "cube": {"type": "cube", "to_world": to_world @ T.scale(size), "light": glowing},
    }[kind]


@pytest.mark.parametrize("how", ["mi.render", "nil_mitsuba.render"])
@pytest.mark.parametrize("kind", [*KINDS, "rectangle", "sphere", "cube"])
def test_a_light_moved_between_renders_shines_as_one_that_was_always_there(rgb, how, kind):
    """Its place and its size: that of a point drawn on it follows, too."""

    def scene(place):
        return mi.load_dict(
            {
                "type": "scene",
                "floor": {"type": "rectangle"},
                "lamp": lamp(kind, place),
                "sensor": {
                    "type": "perspective",
                    "film": film(12, 12),
                    "to_world": mi.ScalarTransform4f().look_at(
                        [0.2, -2, 1.5], [0, 0, 0], [0, 0, 1]
                    ),
                },
            }
        )

    here, there = [0.1, 0.2, 1.0], [0.6, -0.3, 1.4]
    moved, target = scene(here), scene(there)
    before = rendered(how, moved)
    parameters, wanted = mi.traverse(moved), mi.traverse(target)
    changed = 0
    for key in parameters.keys():
        if key.startswith("lamp.") and key.endswith(("position", "to_world", "vertex_positions")):
            parameters[key] = wanted[key]
            changed += 1
    parameters.update()
    assert changed == 1
    after, expected = rendered(how, moved), rendered(how, target)
    # Rounding of the new place now and then decides about a sample
    assert dr.mean(dr.abs(after - expected)).array[0] < 1e-3 * dr.mean(expected).array[0]
    assert dr.mean(dr.abs(after - before)).array[0] > 0.1 * dr.mean(expected).array[0]
