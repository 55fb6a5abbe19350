import math

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import geometry
from nil_mitsuba import layers as table

LAYERS = {name: table.LAYERS[name].channels for name in table.RENDERED}

ORIGIN, SIZE = (0.1, 0.15, 0.2), 1.5  # of the cell: neither is the default
CAMERA = (0.3, 0.4, 0.5)
CENTER, RADIUS = (1.0, 0.9, 0.9), 0.25


def description(size=16, spp=1, camera=CAMERA, **integrator):
    """A ball, a wall and a glass bead, seen by a camera whose samples stay in their pixels."""
    return {
        "type": "scene",
        "integrator": {
            "type": "nil",
            "cell_origin": list(ORIGIN),
            "cell_size": SIZE,
            "aovs": ", ".join(LAYERS),
        }
        | integrator,
        "sensor": {
            "type": "perspective",
            "fov": 70.0,
            "near_clip": 1e-5,  # distances begin there
            "to_world": mi.ScalarTransform4f().look_at(camera, CENTER, [0, 0, 1]),
            "sampler": {"type": "independent", "sample_count": spp},
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "component_format": "float32",
            },
        },
        "light": {"type": "point", "position": [0.5, 0.5, 1.0]},
        "ball": {
            "type": "sphere",
            "center": CENTER,
            "radius": RADIUS,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}},
        },
        "wall": {
            "type": "rectangle",
            "bsdf": {"type": "twosided", "nested": {"type": "diffuse"}},
            "to_world": mi.ScalarTransform4f().translate([0.8, 0.8, 1.4]).scale(0.5),
        },
        "bead": {
            "type": "sphere",
            "center": [0.6, 0.8, 0.55],
            "radius": 0.1,
            "bsdf": {"type": "dielectric"},
        },
    }


def render(**arguments):
    """The picture and its layers by name, each a list of one array per channel."""
    scene = mi.load_dict(description(**arguments))
    image = mi.render(scene, seed=1)
    channels = image.shape[2]
    pixel = dr.arange(mi.UInt32, image.shape[0] * image.shape[1])
    planes = [dr.gather(mi.Float, image.array, pixel * channels + c) for c in range(channels)]
    integrator = scene.integrator()
    first = at = channels - len(integrator.aov_names())
    layers = {}
    for layer in integrator.layers:
        layers[layer] = planes[at : at + len(LAYERS[layer])]
        at += len(LAYERS[layer])
    return planes[:first], layers, scene


def in_cells(point):
    return mi.Point3f(*((c - o) / SIZE for c, o in zip(point, ORIGIN)))


@pytest.mark.parametrize(
    "twist, camera", [(0, CAMERA), (1, CAMERA), (-2, CAMERA), (1, (-1.2, 0.4, 2.0))]
)
def test_the_distance_is_that_of_the_geodesic_to_the_seen_image_of_the_position(rgb, twist, camera):
    _, layers, _ = render(twist=twist, camera=camera, size=64)
    seen = layers["shape"][0] >= 0
    assert dr.count(seen)[0] > 1000
    copies = dr.any(mi.Vector3f(*layers["cell"]) != 0) & seen
    assert dr.count(copies)[0] > 100

    image = geometry.multiply(mi.Point3f(*layers["cell"]), in_cells(layers["position"]), twist)
    shortest = geometry.connect(in_cells(camera), image, twist)
    distance = layers["distance"][0] / SIZE
    # Within 2π/|k| there is one geodesic, which is ill-conditioned near that length
    near = seen & (distance < (1.8 * math.pi / abs(twist) if twist else dr.inf))
    assert dr.count(near)[0] > 1000
    error = dr.select(near, dr.abs(shortest.distance - distance), 0)
    # At a silhouette that only a chord meets its hit stays, within a hundredth of a pixel
    assert dr.count(error > 1e-4)[0] <= 1e-3 * dr.count(near)[0]
    assert dr.max(error)[0] < 4e-4
    # No layer is there where nothing is
    for name in ("distance", "position", "normal", "albedo", "cell"):
        assert all(dr.all(seen | (channel == 0)) for channel in layers[name])


@pytest.mark.parametrize("twist", [0, 1])
def test_normals_are_unit_vectors_in_the_frame(rgb, twist):
    _, layers, _ = render(twist=twist, size=64)
    position = layers["position"]
    number = layers["shape"][0]
    ball = number == numbers_of_shapes(render(size=4)[2])["ball"]
    assert dr.count(ball)[0] > 100
    outward = mi.Normal3f(*(p - c for p, c in zip(position, CENTER)))
    expected = dr.normalize(geometry.conormal(in_cells(position), outward, twist))
    error = dr.norm(mi.Vector3f(*layers["normal"]) - expected)
    assert dr.max(dr.select(ball, error, 0))[0] < 1e-4


def test_albedo_is_the_reflectance_and_white_where_things_only_reflect(rgb):
    _, layers, scene = render(size=64)
    number, albedo = layers["shape"][0], layers["albedo"]
    numbers = numbers_of_shapes(scene)
    for name, value in (("ball", (0.7, 0.4, 0.2)), ("wall", (0.5,) * 3), ("bead", (1,) * 3)):
        there = number == numbers[name]
        assert dr.count(there)[0] > 20
        for channel, expected in zip(albedo, value):
            assert dr.all(~there | (dr.abs(channel - expected) < 1e-5))


def numbers_of_shapes(scene):
    return {shape.id(): number for number, shape in enumerate(scene.shapes())}


def test_shapes_are_numbered_in_the_order_of_the_scene(rgb):
    _, layers, scene = render(size=64)
    number = layers["shape"][0]
    numbers = numbers_of_shapes(scene)
    assert set(numbers.values()) == {0, 1, 2}
    # Seen in the own cell only, a sphere is where its centre is
    at_home = dr.all(mi.Vector3f(*layers["cell"]) == 0)
    for name, center, radius in (("ball", CENTER, RADIUS), ("bead", (0.6, 0.8, 0.55), 0.1)):
        there = (number == numbers[name]) & at_home
        away = dr.norm(mi.Point3f(*layers["position"]) - mi.Point3f(center))
        assert dr.count(there)[0] > 20
        assert dr.max(dr.select(there, dr.abs(away - radius), 0))[0] < 1e-5


def test_whole_numbers_are_not_averaged(rgb):
    _, layers, _ = render(size=32, spp=16)
    for channel in (*layers["cell"], *layers["shape"]):
        assert dr.all(channel == dr.round(channel))
    # Positions are: they leave the surface where pixels see two of them
    one = render(size=32, spp=1)[1]
    assert not dr.allclose(one["position"][0], layers["position"][0])


@pytest.mark.parametrize("size, spp", [(8, 5), (8, 64)])
def test_samples_are_counted(rgb, size, spp):
    _, layers, _ = render(size=size, spp=spp)
    assert dr.all(layers["samples"][0] == spp)


def test_layers_do_not_change_the_picture(rgb):
    with_layers, _, _ = render(spp=8)
    without, layers, _ = render(spp=8, aovs="")
    assert layers == {}
    for a, b in zip(with_layers, without):
        assert dr.allclose(a, b, rtol=1e-5)


def test_layers_average_over_a_pixel_as_the_picture_does(rgb):
    from nil_mitsuba.passes import Passes

    scene = mi.load_dict(description(size=8, aovs="distance"))
    passes = Passes(scene.integrator(), scene, 0, 3, 64, 16)
    sums = [passes.render(index) for index in range(4)]
    together = passes.nothing()
    for part in sums:
        together = together.plus(part)
    mean = sum((passes.develop(part) for part in sums[1:]), passes.develop(sums[0])) / 4
    assert dr.allclose(passes.develop(together), mean, rtol=1e-5, atol=1e-6)


def test_paths_are_traced_once_for_all_layers(rgb):
    scene = mi.load_dict(description(size=8))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        mi.render(scene, spp=4)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len([entry for entry in history if entry["operation_count"] > 500]) == 1


def test_layers_are_named_once_and_in_their_order(rgb):
    scene = mi.load_dict(description(aovs="shape,distance , shape"))
    integrator = scene.integrator()
    assert integrator.layers == ("distance", "shape")
    assert integrator.aov_names() == ["depth.Z", "shape.X"]


def test_an_unknown_layer_gets_a_sentence_that_names_the_others(rgb):
    with pytest.raises(RuntimeError, match='"depth".*distance, position'):
        mi.load_dict({"type": "nil", "aovs": "depth"})


def test_layers_go_through_a_wrapper(rgb):
    scene = description(size=8)
    wrapped = mi.load_dict({"type": "moment", "of": scene["integrator"]})
    image = mi.render(mi.load_dict(scene), integrator=wrapped, spp=16, seed=2)
    names = wrapped.aov_names()
    at = {name.rpartition(".")[0] + "." + name[-1]: i for i, name in enumerate(names)}
    assert image.shape[2] == 3 + len(names)
    samples = [i for name, i in at.items() if "samples" in name]
    assert samples and dr.allclose(image[:, :, 3 + samples[0]], 1)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_layers_are_there_in_every_variant(variant):
    mi.set_variant(variant)
    luminance = 0.212671 * 0.7 + 0.715160 * 0.4 + 0.072169 * 0.2
    try:
        _, layers, scene = render(size=32)
        ball = layers["shape"][0] == numbers_of_shapes(scene)["ball"]
        mean = [
            dr.mean(dr.gather(mi.Float, channel, dr.compress(ball)))[0]
            for channel in layers["albedo"]
        ]
        if "mono" in variant:
            assert mean == [pytest.approx(luminance, 0.01)] * 3
        else:
            # One sample of a few wavelengths for each pixel: noisy, and lit by equal energies
            assert mean == pytest.approx([0.82, 0.36, 0.17], abs=0.1)
    finally:
        mi.set_variant("llvm_ad_rgb")
