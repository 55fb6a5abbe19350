"""With twist 0 and without the quotient, ``nil`` in media is Mitsuba's ``volpath``: same
expectation, pixel by pixel.

The statistical tests compare two independent renders with `assert_same_expectation`, which fails
on equal expectations with a probability of at most 0.0024 for a random seed; the seeds are fixed.
"""

import math

import mitsuba as mi
import pytest

from benchmarks.studio import film
from test_flat import FLAT, environment, tiles
from ztest import Estimate, assert_same_expectation


def T():
    return mi.ScalarTransform4f()


def compare(scene, spp, block=None, more=1, **parameters):
    """``more``: samples that nil takes for each of volpath's."""
    assert_same_expectation(
        Estimate(scene, {"type": "volpath"} | parameters, spp, seed=1),
        Estimate(scene, FLAT | parameters, spp * more, seed=2),
        block,
    )


def rgb_value(*values):
    return {"type": "rgb", "value": list(values)}


def fog(extinction=4.0, albedo=0.8, phase=None, **more):
    return {
        "type": "homogeneous",
        "sigma_t": extinction,
        "albedo": albedo,
        "phase": phase or {"type": "isotropic"},
    } | more


def smoke(volume, albedo=0.8, phase=None, **more):
    return fog(volume, albedo, phase, **more) | {"type": "heterogeneous"}


def hg(g):
    return {"type": "hg", "g": g}


def grid(channels=1, to_world=None, scale=1.0, **more):
    """4 × 3 × 5 voxels that all differ, in the unit cube moved by ``to_world``."""
    count = 4 * 3 * 5
    values = [
        scale * (0.5 + 0.5 * math.sin(7 * i + 2 * c)) for i in range(count) for c in range(channels)
    ]
    voxels = mi.VolumeGrid(mi.TensorXf(values, shape=(5, 3, 4, channels)))
    volume = {"type": "gridvolume", "grid": voxels, "to_world": to_world or T()}
    return volume | {"raw": channels != 3} | more


def centred(size=2.0):
    """From the unit cube to a cube of the ``size`` around the origin."""
    return T().scale(size).translate([-0.5, -0.5, -0.5])


def ball(medium, bsdf="null", shape="sphere", **more):
    """A tile's shape that holds a medium (or a function of the tile's transform that gives one)."""

    def made(to_world):
        inside = medium(to_world) if callable(medium) else medium
        surface = {"type": bsdf} if isinstance(bsdf, str) else bsdf
        shapes = {"type": shape, "to_world": to_world, "bsdf": surface, "interior": inside}
        return [shapes | more]

    return made


def lamps():
    """Lights of every kind above four rows of tiles at most."""
    return {
        "sky": environment(),
        "point": {"type": "point", "position": [0.5, 1.5, 2.5], "intensity": rgb_value(6, 4, 2)},
        "spot": {
            "type": "spot",
            "intensity": rgb_value(8, 9, 12),
            "cutoff_angle": 40,
            "to_world": T().look_at([2.5, 0.5, 3], [1.5, 1, 0], [0, 1, 0]),
        },
        "sun": {"type": "directional", "direction": [0.5, 0.2, -1], "irradiance": 0.8},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([1.5, 0.5, 4.5]).rotate([1, 0, 0], 180).scale(0.6),
            "light": {"type": "area", "radiance": rgb_value(3, 4, 5)},
        },
    }


# ------------------------------------------------------------------ what media are made of


def grey():
    """Media whose extinction has no colour, of every phase function and volume."""
    tilt = T().rotate([0.6, 0.8, 0], 40)
    angles = [0.1 + 0.3 * i * i for i in range(7)]
    return {
        "isotropic": fog(),
        "forwards": fog(phase=hg(0.7)),
        "backwards": fog(phase=hg(-0.6)),
        "rayleigh": fog(phase={"type": "rayleigh"}),
        "blend": fog(
            phase={"type": "blendphase", "weight": 0.4, "a": hg(0.6), "b": {"type": "rayleigh"}}
        ),
        "table": fog(phase={"type": "tabphase", "values": ", ".join(f"{a:g}" for a in angles)}),
        "coloured albedo": fog(albedo=rgb_value(0.9, 0.6, 0.2), scale=2.0, extinction=3.0),
        "albedo in a grid": lambda to_world: fog(
            albedo=grid(3, to_world @ centred(), scale=0.9), extinction=3.0
        ),
        "grid": lambda to_world: smoke(grid(1, to_world @ centred()), scale=9.0),
        "turned grid": lambda to_world: smoke(
            grid(1, to_world @ tilt @ centred(1.1), filter_type="nearest"), scale=9.0, phase=hg(0.5)
        ),
        "tiled grid": lambda to_world: smoke(
            grid(1, to_world @ T().scale(0.4), wrap_mode="repeat"),
            albedo=grid(3, to_world @ centred(1.5), wrap_mode="mirror", scale=0.9),
            scale=9.0,
        ),
        "constant volume": lambda to_world: smoke(
            {"type": "constvolume", "value": 4.0, "to_world": to_world @ centred(1.2)}
        ),
    }


def test_flat_media_of_every_kind_have_the_expectation_of_volpath(rgb):
    """Fails on equal expectations for one seed in 400."""
    scene = tiles([ball(medium) for medium in grey().values()], 4, **lamps())
    compare(scene, spp=256, block=8, max_depth=6)


def coloured():
    """Media whose extinction differs by channel or wavelength."""
    return {
        "homogeneous": fog(rgb_value(0.3, 0.5, 0.9), scale=9.0, phase=hg(0.3)),
        "white in blue": fog(rgb_value(0.3, 0.2, 0.4), albedo=rgb_value(0.2, 0.5, 0.95), scale=9.0),
        "grid": lambda to_world: smoke(grid(3, to_world @ centred()), scale=9.0),
        "smaller grid": lambda to_world: smoke(
            grid(3, to_world @ T().rotate([0.6, 0.8, 0], 40) @ centred(1.1)), scale=9.0
        ),
        "coarse grid": lambda to_world: smoke(
            grid(3, to_world @ centred(), filter_type="nearest"),
            albedo=grid(3, to_world @ centred(), scale=0.9),
            scale=9.0,
        ),
        "constant volume": lambda to_world: smoke(
            {
                "type": "constvolume",
                "value": rgb_value(0.3, 0.5, 0.9),
                "to_world": to_world @ centred(1.2),
            },
            scale=9.0,
        ),
    }


@pytest.mark.parametrize(
    "variant",
    [
        "llvm_ad_rgb",
        *(pytest.param(v, marks=pytest.mark.verify) for v in ("llvm_mono", "llvm_ad_spectral")),
    ],
)
def test_flat_coloured_media_have_the_expectation_of_volpath(variant):
    """Fails on equal expectations for one seed in 400."""
    if variant not in mi.variants():
        variant = variant.replace("llvm_", "llvm_ad_")
    mi.set_variant(variant)
    scene = tiles([ball(medium) for medium in coloured().values()], 3, **lamps())
    compare(scene, spp=256, block=8, max_depth=6)


def flakes():
    """Flakes and fibres: what they stop depends on the direction of the light."""

    def sggx(*values):
        S = mi.VolumeGrid(mi.TensorXf(list(values) * 8, shape=(2, 2, 2, 6)))
        # Wherever a ray is, Mitsuba asks for what is at the origin
        return {"type": "sggx", "S": {"type": "gridvolume", "grid": S, "raw": True}}

    flat = sggx(0.05, 0.1, 1.0, 0.02, 0.0, 0.1)
    long = sggx(1.0, 0.2, 0.9, 0.0, -0.1, 0.05)
    return {
        "flakes": fog(phase=flat),
        "fibres": fog(phase=long),
        "flakes in a grid": lambda t: smoke(grid(1, t @ centred()), scale=9.0, phase=flat),
        "coloured flakes": fog(rgb_value(0.3, 0.5, 0.9), scale=9.0, phase=flat),
    }


@pytest.mark.verify
def test_flat_microflakes_have_the_expectation_of_volpath(rgb):
    """Fails on equal expectations for one seed in 400."""
    scene = tiles([ball(medium) for medium in flakes().values()], 2, **lamps())
    compare(scene, spp=256, block=8, max_depth=6)


def test_flat_microflakes_around_the_camera_have_the_expectation_of_volpath(rgb):
    """They fill space, however small the grid of their shapes. Fails on equal expectations for one
    seed in 400."""
    # What "sggx" samples and what it evaluates differ, and so would the weights of both
    medium = mi.load_dict(flakes()["flakes"] | {"sigma_t": 0.5, "sample_emitters": False})
    room = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "film": film(16, 16),
            "to_world": T().look_at([3, 0.3, 0.4], [0, 0, 0], [0, 0, 1]),
            "medium": medium,
        },
        "walls": {"type": "sphere", "radius": 4.0, "flip_normals": True},
        "ball": {"type": "sphere", "radius": 0.5},
        "lamp": {
            "type": "sphere",
            "to_world": T().translate([1, 1, 1]).scale(0.3),
            "light": {"type": "area", "radiance": 8.0},
        },
    }
    compare(mi.load_dict(room), spp=256, max_depth=4)


# ------------------------------------------------------------------ where media are


def boundaries():
    """Media behind boundaries of every kind, and things and other media within."""

    def red(to_world):
        return {
            "type": "sphere",
            "to_world": to_world @ T().scale(0.5),
            "bsdf": {"type": "diffuse"},
        }

    def with_a_thing(to_world):
        return [*ball(fog(2.0))(to_world), red(to_world)]

    def with_a_lamp(to_world):
        lamp = {"type": "area", "radiance": rgb_value(2, 1, 0.5)}
        return [*ball(fog(2.0))(to_world), red(to_world) | {"light": lamp}]

    def nested(to_world):
        outer, inner = mi.load_dict(fog(2.0, phase=hg(0.6))), mi.load_dict(fog(9.0, albedo=0.4))
        return [
            *ball(outer)(to_world),
            *ball(inner, exterior=outer, shape="cube")(to_world @ T().scale(0.4)),
        ]

    def bubble(to_world):
        outer = mi.load_dict(fog(5.0))
        hole = {"type": "sphere", "to_world": to_world @ T().scale(0.6), "bsdf": {"type": "null"}}
        return [*ball(outer, shape="cube")(to_world), hole | {"exterior": outer}]

    def two(to_world):
        return [
            *ball(fog(3.0))(to_world @ T().translate([0.3, 0, 0]).scale(0.5)),
            *ball(fog(3.0, albedo=0.1))(to_world @ T().translate([-0.6, 0, 0]).scale(0.3)),
        ]

    def instances(to_world):
        group = mi.load_dict(
            {
                "type": "shapegroup",
                "a": ball(fog(5.0), shape="cube")(T().scale(0.5))[0],
                "b": {"type": "sphere", "radius": 0.2, "bsdf": {"type": "diffuse"}},
            }
        )
        sheared = mi.ScalarTransform4f([[1, 0.4, 0, 0], [0, 0.7, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        return [
            group,
            {"type": "instance", "shapes": group, "to_world": to_world @ sheared},
        ]

    paint = {"type": "diffuse", "reflectance": rgb_value(0.7, 0.4, 0.2)}
    holes = {"type": "checkerboard", "to_uv": T().scale(6)}
    return {
        "glass": ball(fog(3.0, phase=hg(0.5)), "dielectric"),
        "frosted glass": ball(fog(3.0), {"type": "roughdielectric", "alpha": 0.3}),
        "thin glass": ball(fog(3.0), "thindielectric", shape="cube"),
        "veil": ball(fog(3.0), {"type": "mask", "opacity": 0.4, "bsdf": paint}),
        "holes": ball(fog(3.0), {"type": "mask", "opacity": holes, "bsdf": paint}, shape="cube"),
        "grid in glass": ball(lambda t: smoke(grid(1, t @ centred()), scale=5.0), "dielectric"),
        "thing": with_a_thing,
        "lamp": with_a_lamp,
        "nested": nested,
        "bubble": bubble,
        "two": two,
        "instance": instances,
    }


def test_flat_boundaries_of_every_kind_have_the_expectation_of_volpath(rgb):
    """Fails on equal expectations for one seed in 400."""
    compare(tiles(list(boundaries().values()), 4, **lamps()), spp=256, block=8, max_depth=8)


def camera_in(medium):
    return {
        "type": "perspective",
        "fov": 70,
        "film": film(32, 32),
        "to_world": T().look_at([1.6, -1.4, 0.6], [0, 0, 0], [0, 0, 1]),
        "medium": medium,
    }


def fog_room(**lights):
    """A camera in a fog that fills a black room with things and another medium in it."""
    medium = mi.load_dict(fog(0.4, albedo=0.9, phase=hg(0.4)))
    clear = {"bsdf": {"type": "null"}, "exterior": medium}
    white = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera_in(medium),
            "walls": {
                "type": "cube",
                "to_world": T().scale(2),
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
            },
            "floor": {"type": "rectangle", "to_world": T().translate([0, 0, -1]), "bsdf": white},
            "ball": {"type": "sphere", "center": [-0.6, 0.4, -0.5], "radius": 0.4, "bsdf": white},
            "cloud": ball(
                lambda t: smoke(grid(1, t @ centred()), scale=6.0, phase={"type": "rayleigh"}),
                exterior=medium,
            )(T().translate([0.3, 0.5, -0.3]).scale(0.5))[0],
            # Beside a point light in fog the variance is infinite
            "bubble": {"type": "sphere", "center": [-0.5, -0.7, 0.5], "radius": 0.3} | clear,
            "bulb": {
                "type": "point",
                "position": [-0.5, -0.7, 0.5],
                "intensity": rgb_value(2, 1.5, 1),
            },
            "hood": {"type": "sphere", "center": [1.2, 0.8, 1.4], "radius": 0.3} | clear,
            "spot": {
                "type": "spot",
                "cutoff_angle": 35,
                "intensity": rgb_value(4, 6, 8),
                "to_world": T().look_at([1.2, 0.8, 1.4], [0, 0, -0.6], [0, 0, 1]),
            },
            "lamp": {
                "type": "disk",
                "to_world": T().translate([0.4, -0.2, 1.2]).rotate([1, 0, 0], 180).scale(0.3),
                "light": {"type": "area", "radiance": rgb_value(6, 6, 6)},
            },
        }
    )


def test_flat_fog_around_the_camera_has_the_expectation_of_volpath(rgb):
    """Fails on equal expectations for one seed in 400."""
    compare(fog_room(), spp=256, block=8, max_depth=5)


def surrounded():
    """A camera in a medium that a boundary ends, under a sky, and media around other things."""
    medium = mi.load_dict(fog(0.6, albedo=0.7, phase=hg(0.5)))
    inner = mi.load_dict(fog(5.0, albedo=rgb_value(0.9, 0.7, 0.5)))
    outside = {"bsdf": {"type": "null"}, "interior": medium}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera_in(medium),
            "air": {"type": "sphere", "radius": 2.5} | outside,
            "sky": environment(),
            "floor": {"type": "disk", "to_world": T().translate([0, 0, -1]).scale(1.5)},
            "glass": {
                "type": "sphere",
                "center": [0.4, 0.6, -0.5],
                "radius": 0.4,
                "bsdf": {"type": "dielectric"},
                "interior": inner,
                "exterior": medium,
            },
            "lamp": {
                "type": "sphere",
                "center": [-0.7, 0.2, -0.4],
                "radius": 0.25,
                "light": {"type": "area", "radiance": rgb_value(2, 1, 0.5)},
                "exterior": medium,
            },
            # Another medium around the air, to another boundary
            "haze": {
                "type": "cube",
                "to_world": T().scale(3.5),
                "bsdf": {"type": "null"},
                "interior": mi.load_dict(fog(0.15)),
            },
        }
    )


def test_flat_camera_within_nested_media_has_the_expectation_of_volpath(rgb):
    """Fails on equal expectations for one seed in 400."""
    compare(surrounded(), spp=256, block=8, max_depth=6)


# ------------------------------------------------------------------ what the integrator is told


def dim():
    """Media of many and few scatterings, one of which finds lights by its phase function alone."""

    def hidden_lamp(to_world):
        # Beside `volpath`, in which a hidden light in a medium hides what is behind it
        lamp = {"type": "area", "radiance": rgb_value(3, 2, 1)}
        above = T().translate([0, 0, 1]) @ to_world @ T().scale(0.5)
        return [
            *ball(fog(2.0), shape="cube")(to_world),
            {"type": "disk", "to_world": above, "light": lamp},
        ]

    return [
        ball(fog(3.0, albedo=0.95, phase=hg(0.5))),
        ball(fog(3.0, sample_emitters=False)),
        ball(fog(3.0), "dielectric"),
        hidden_lamp,
    ]


@pytest.mark.parametrize(
    "parameters",
    [
        pytest.param(parameters, marks=() if i == 0 else pytest.mark.verify)
        for i, parameters in enumerate(
            [
                {"max_depth": 2},
                {"max_depth": 1},
                {"max_depth": 3},
                {"max_depth": 4, "hide_emitters": True},
                {"max_depth": -1, "rr_depth": 2},
            ]
        )
    ],
    ids=str,
)
def test_flat_media_follow_the_parameters_of_volpath(rgb, parameters):
    """Fails on equal expectations for one seed in 400."""
    scene = tiles(dim(), 2, sky=environment(), sun=lamps()["sun"])
    compare(scene, spp=256, block=8, **parameters)


def test_each_channel_of_a_coloured_medium_is_a_grey_medium(rgb):
    """However much the extinctions differ, and where one is zero. Fails for one seed in 140."""
    extinctions, albedos = (0.0, 0.02, 1.0), (0.5, 0.6, 0.95)
    colours = fog(rgb_value(*extinctions), albedo=rgb_value(*albedos), scale=20.0)
    for i, (extinction, albedo) in enumerate(zip(extinctions, albedos)):
        primary = {"type": "rgb", "value": [float(j == i) for j in range(3)]}
        seen = []
        for medium in (colours, fog(extinction, albedo, scale=20.0)):
            scene = tiles([ball(medium)], 1, sky={"type": "constant", "radiance": primary})
            seen.append(Estimate(scene, FLAT | {"max_depth": 6}, 1024, seed=2 * i + len(seen)))
        assert_same_expectation(*seen, block=4)
