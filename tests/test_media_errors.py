"""What is said of media that cannot be given a meaning, or of which a part does nothing."""

import math

import mitsuba as mi
import pytest

from benchmarks.studio import film
from test_media_flat import T, centred, fog, grid, rgb_value, smoke

INF = {"max_distance": math.inf}
PLAIN = {"quotient": False}


def around(medium=None, **things):
    sensor = {
        "type": "perspective",
        "film": film(2, 2),
        "to_world": T().look_at([0.5, 0.1, 0.5], [0.5, 0.9, 0.5], [0, 0, 1]),
    }
    return {
        "type": "scene",
        "sensor": sensor | ({"medium": medium} if medium else {}),
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "center": [0.5, 0.6, 0.5], "radius": 0.15},
    } | things


def batch(*media):
    sensors = {
        f"sensor{i}": around(medium)["sensor"] | {"film": film(1, 2)}
        for i, medium in enumerate(media)
    }
    return around() | {"sensor": {"type": "batch", "film": film(2, 2)} | sensors}


def constant(value):
    return {"type": "constvolume", "value": value}


@pytest.mark.parametrize(
    "scene, parameters, said",
    [
        (lambda: around(fog(-1.0)), {}, "negative or no numbers"),
        (lambda: around(fog(albedo=-0.5)), {}, "negative or no numbers"),
        (lambda: around(fog(scale=math.nan)), {}, "negative or no numbers"),
        (lambda: around(smoke(grid(scale=-1.0))), {}, "negative or no numbers"),
        (lambda: around(smoke(constant(1.0), scale=-1.0)), {}, "negative or no numbers"),
        (lambda: around(fog(1.0, albedo=1.0)), INF, "absorbs nothing"),
        (lambda: around(fog(1.0, albedo=rgb_value(1, 0.5, 0.5))), INF, "absorbs nothing"),
        (lambda: around(fog(1e-6)), INF, "is so thin"),
        (lambda: around(fog(rgb_value(0, 1, 1))), INF, "only a homogeneous medium"),
        (lambda: around(smoke(constant(1.0))), INF, "only a homogeneous medium"),
        (lambda: around(), INF, "only a homogeneous medium"),
        (lambda: batch(fog(1.0), fog(2.0)), {}, "different media"),
        (lambda: batch(None, fog(2.0)), {}, "different media"),
        (lambda: batch(fog(2.0), None), {}, "different media"),
    ],
)
def test_media_that_have_no_meaning_are_refused_in_a_sentence(rgb, scene, parameters, said):
    integrator = mi.load_dict({"type": "nil", "max_depth": 2} | parameters)
    with pytest.raises(RuntimeError, match=said):
        integrator.render(mi.load_dict(scene()), spp=1)


def clear(shape, **more):
    move = T().translate([0.5, 0.5, 0.8]).scale(0.1)
    return {"type": shape, "to_world": move, "bsdf": {"type": "null"}, "interior": fog()} | more


@pytest.mark.parametrize(
    "scene, parameters, said",
    [
        (lambda: around(pane=clear("rectangle")), {}, '"pane" is a medium\'s boundary and is not'),
        (lambda: around(box=clear("cube")), {}, None),
        (
            lambda: around(lamp={"type": "point", "position": [0.2, 0.2, 0.2], "medium": fog()}),
            {},
            '"lamp" names a medium that fills nothing',
        ),
        (lambda: around(fog()), PLAIN, "is all around the sensor without end"),
        (lambda: around(fog()), INF, "is all around the sensor without end"),
        (lambda: around(fog()), {}, None),
        # Light from infinity enters their boxes
        (lambda: around(smoke(grid(to_world=centred()))), PLAIN, None),
    ],
)
def test_what_media_do_not_do_is_told_in_a_warning(rgb, capfd, scene, parameters, said):
    scene = mi.load_dict(scene())
    mi.load_dict({"type": "nil", "max_depth": 2} | parameters).render(scene, spp=1)
    out, err = capfd.readouterr()
    warnings = [line for line in (out + err).splitlines() if "WARN" in line]
    assert (said is None and not warnings) or (said and any(said in line for line in warnings))
