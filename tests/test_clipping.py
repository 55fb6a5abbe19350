"""Clip planes hide and never move what is seen, and a batch tells its sensors apart by the crop."""

import statistics

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film

SIZE = 24
KINDS = ["perspective", "thinlens", "orthographic", "batch"]


def sensor(kind, **clip):
    """A camera of a kind whose picture is four units away; a batch holds two of them."""
    look = mi.ScalarTransform4f().look_at([0.3, -3, 0.2], [0, 0, 0.2], [0, 0, 1])
    lens = {"type": "thinlens", "aperture_radius": 1e-6, "focus_distance": 4.0}
    parallel = {"type": "orthographic", "to_world": look @ mi.ScalarTransform4f().scale([2, 2, 1])}
    one = {
        "perspective": {"type": "perspective", "fov": 40, "to_world": look},
        "thinlens": lens | {"fov": 40, "to_world": look},
        "orthographic": parallel,
    }
    if kind != "batch":
        return one[kind] | clip | {"film": film(SIZE, SIZE)}
    return {
        "type": "batch",
        "a": one["perspective"] | clip,
        "b": one["orthographic"] | clip,
        "film": film(2 * SIZE, SIZE),
    }


def scene(camera):
    return mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "camera": camera,
            "ball": {"type": "sphere", "center": [0, 0.3, 0.2], "radius": 0.5},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f()
                .translate([0, 3, 0])
                .rotate([1, 0, 0], 90)
                .scale(3),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
            },
        }
    )


def seen(camera, layer, twist=1.0, size=1.0, spp=1):
    """A layer of the first surface, by pixel."""
    integrator = mi.load_dict(
        {
            "type": "nil",
            "quotient": False,
            "twist": twist,
            "max_depth": 1,
            "cell_size": size,
            "aovs": layer,
        }
    )
    image = mi.render(scene(camera), integrator=integrator, spp=spp)
    return image[:, :, 3:]


def compare_with_path(camera):
    """By the means of 8 renders of each; |t| > 4 has one sound pair in 760 (14 degrees)"""
    nil = {"type": "nil", "quotient": False, "twist": 0.0, "max_depth": 3}
    world, means = scene(camera), []
    for first, integrator in enumerate(({"type": "path", "max_depth": 3}, nil)):
        integrator = mi.load_dict(integrator)
        images = [
            mi.render(world, integrator=integrator, spp=32, seed=8 * first + i).array
            for i in range(8)
        ]
        means.append((sum(images) / 8, [dr.mean(image)[0] for image in images]))
    (a, first), (b, second) = means
    variance = sum(statistics.variance(m) / 8 for m in (first, second))
    assert abs(statistics.mean(first) - statistics.mean(second)) < 4 * variance**0.5
    # 256 samples at an edge of contrast 1 in each of the two, at 5 deviations
    assert dr.max(dr.abs(a - b))[0] < 5 * 0.5 * (2 / 256) ** 0.5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("twist, size", [(1.0, 4.0), (1.0, 2.0), (-3.0, 8.0)])
def test_near_clip_does_not_move_what_it_does_not_cut(rgb, kind, twist, size):
    """The same samples see the same points, but where rounding or chords move a silhouette: 1e-3
    is a hundredth of a pixel's width there. Applied as a group product it moved them by 0.1 to 1.
    """
    first = seen(sensor(kind, near_clip=1e-2), "position", twist, size)
    for near in (0.3, 2.0):
        other = seen(sensor(kind, near_clip=near), "position", twist, size)
        moved = dr.max(dr.abs(first - other), axis=2).array
        assert dr.count(moved > 1e-3)[0] <= 0.01 * len(moved)
    assert dr.count(first.array != 0)[0] > 0.2 * len(first.array)


@pytest.mark.parametrize("twist", [1.0, 3.0])
def test_a_lens_without_an_aperture_is_a_pinhole(rgb, twist):
    first = seen(sensor("perspective", near_clip=1.0), "position", twist, 4.0)
    other = seen(sensor("thinlens", near_clip=1.0), "position", twist, 4.0)
    # A lens has one sample more: that of the aperture comes after the pixel's own
    moved = dr.max(dr.abs(first - other), axis=2).array
    assert dr.count(moved > 1e-3)[0] <= 0.01 * len(moved)


@pytest.mark.parametrize("kind", KINDS)
def test_far_clip_hides_at_twist_zero_what_path_hides(rgb, kind):
    """The wall is cut away in part."""
    compare_with_path(sensor(kind, near_clip=0.5, far_clip=6.1))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [2.0, 4.0])
def test_far_clip_hides_all_that_is_farther_and_nothing_else(rgb, kind, size):
    """Along the geodesic: with the same samples, what is left is what had a smaller distance."""
    near, far = 0.5, 4.5
    whole = seen(sensor(kind, near_clip=near), "distance", 1.0, size).array
    cut = seen(sensor(kind, near_clip=near, far_clip=far), "distance", 1.0, size).array
    # Planes are met at far/cos θ, which at a corner of this film is 1.12 times the distance
    surely = (whole > 0) & (whole < far - near)
    gone = whole > 1.13 * (far - near)
    assert dr.all(~surely | (dr.abs(cut - whole) < 1e-3))
    assert dr.all(~gone | (cut == 0))
    assert dr.count(surely)[0] > 20 and dr.count(gone)[0] > 20


@pytest.mark.parametrize(
    "crop",
    [
        {"crop_offset_x": 9, "crop_width": 20, "crop_offset_y": 4, "crop_height": 16},
        {"crop_offset_x": 40, "crop_width": 7, "crop_height": 24},
    ],
)
def test_a_cropped_batch_shows_at_twist_zero_what_path_shows(rgb, crop):
    compare_with_path(sensor("batch") | {"film": film(2 * SIZE, SIZE, **crop)})
