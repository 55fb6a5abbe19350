"""Pictures for who is looking: those of a still, without waiting for a compiler."""

import math

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import geometry, lens, look_at
from nil_mitsuba.layers import GUIDES
from small_stills import description

SIZE = 8  # pixels of a still


def preview_of(scene, guided=False, own=False):
    """A preview of a scene from its own sensor, or from the one that takes its place."""
    from nil_mitsuba.preview import Preview

    nil, sensor = scene.integrator(), scene.sensors()[0]
    to_world = sensor.world_transform()
    sensor, parameters = (sensor, {}) if own else lens.viewing_sensor(sensor, nil)
    preview = Preview(scene, nil, sensor, guided)
    preview.look(to_world, **parameters)
    preview.change()
    return preview


def rendered(preview, passes=1, piece=2**20, size=(SIZE, SIZE)):
    canvas = preview.canvas(*size)
    while canvas.passes < passes:
        preview.render(canvas, piece)
    return canvas


def mean_of(images):
    """Mean of all numbers of pictures that differ by their noise, and its standard error."""
    values = [float(dr.mean(image.array)[0]) for image in images]
    mean = sum(values) / len(values)
    square = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return mean, math.sqrt(square / len(values))


def pictures(preview, count, size):
    for preview.seed in range(100, 100 + count):
        yield rendered(preview, size=size).means()[0]


@pytest.mark.parametrize("twist", [0, 1])
def test_a_preview_has_the_light_of_a_still(rgb, twist):
    """|z| > 4 once in 1,000 sound tests, as of Student's t with 15 degrees of freedom."""
    scene = mi.load_dict(description(SIZE, twist=twist))
    still, error = mean_of(mi.render(scene, spp=256, seed=seed) for seed in range(16))
    mean, other = mean_of(pictures(preview_of(scene), 16, (128, 128)))
    assert abs(mean - still) < 4 * math.hypot(error, other)


def test_pieces_add_up_to_the_picture_that_is_rendered_at_once(rgb):
    preview = preview_of(mi.load_dict(description()))
    whole, pieces = (rendered(preview, 2, piece).means()[0] for piece in (64, 15))
    assert dr.allclose(whole.array, pieces.array, rtol=1e-4, atol=1e-6)


def test_a_lens_without_an_aperture_sees_what_a_pinhole_sees(rgb):
    scene = mi.load_dict(description())
    first, second = (preview_of(scene, own=own) for own in (True, False))
    for x, y in ((0.5, 0.5), (0.03, 0.9), (0.8, 0.2)):
        a, b = first.sight(x, y), second.sight(x, y)
        assert a.direction == pytest.approx(b.direction, abs=2e-6)
        assert a.position == (b.position and pytest.approx(b.position, abs=1e-5))


def kernels(action):
    """Hashes of the kernels that an action runs."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        return {
            entry["hash"]
            for entry in dr.kernel_history([dr.KernelType.JIT])
            if entry["operation_count"] > 500  # others are quick to compile
        }


@pytest.mark.parametrize("quotient", [True, False])
def test_nothing_that_is_dragged_compiles_a_kernel(rgb, quotient):
    preview = preview_of(mi.load_dict(description(quotient=quotient)), guided=True)
    nil, changes = preview.integrator, []
    twists = (0, 2, -1, 1) if quotient else (0.5, 0.01, 0, -0.3, 1)
    changes += [("twist", twist) for twist in twists]
    changes += [("tolerance", 1.0), ("max_depth", 2), ("max_depth", -1), ("max_depth", 6)]

    def change():
        preview.change()
        rendered(preview)

    known = kernels(change)
    assert known

    def drag():
        for name, value in changes:
            setattr(nil, name, value)
            change()
        for changed in ({"x_fov": 20.0}, {"aperture_radius": 0.1}, {"focus_distance": 0.3}):
            preview.look(mi.ScalarTransform4f().translate([0.3, 0.2, 0.1]), **changed)
            rendered(preview)
        for size in ((4, 3), (33, 20), (200, 100)):
            rendered(preview, size=size)

    assert kernels(drag) <= known


def test_a_pixel_looks_where_the_camera_would_be_aimed_at_what_it_shows(rgb):
    """By way of ``connect``, in double precision, which knows no ray."""
    scene = mi.load_dict(description())
    preview = preview_of(scene)
    seen = [preview.sight(x, y) for x in (0.35, 0.5, 0.7) for y in (0.3, 0.5, 0.8)]
    seen = [sight for sight in seen if sight.shape and sight.distance < 1]
    assert len(seen) >= 3
    for sight in seen:
        aim = look_at(scene, [0.1, 0.1, 0.6], sight.position, image=sight.cell)
        matrix = aim.to_world.matrix
        assert [matrix[i, 2] for i in range(3)] == pytest.approx(sight.direction, abs=1e-4)
        assert aim.focus_distance == pytest.approx(sight.distance, abs=1e-4)


def test_the_picture_does_not_change_where_the_camera_passes_a_glued_face(rgb):
    """Seen from the other side of a face, the same rays meet the same things."""
    preview = preview_of(mi.load_dict(description()), guided=True)
    turn = mi.ScalarTransform4f().look_at([0, 0, 0], [0.5, 0.8, -0.2], [0, 0, 1])
    beside = mi.Point3f(0.999, 0.3, 0.4)
    image = geometry.multiply(mi.Point3i(-1, 0, 0), beside, 1)
    seen = []
    for place in (beside, image):
        preview.look(mi.ScalarTransform4f().translate([c[0] for c in place]) @ turn)
        seen.append([plane.array for plane in rendered(preview, size=(64, 64)).means()])
    # Lights are drawn as they are numbered from the cell: the light is the same in the mean
    for one, other in zip(*(planes[1:] for planes in seen)):
        assert dr.mean(dr.abs(one - other))[0] < 0.001
    assert dr.mean(seen[0][0])[0] == pytest.approx(dr.mean(seen[1][0])[0], rel=0.05)


def test_nothing_is_seen_of_a_sky(rgb):
    description_of_sky = {k: v for k, v in description().items() if k not in ("ball", "lamp")}
    sight = preview_of(mi.load_dict(description_of_sky)).sight(0.5, 0.5)
    assert (sight.shape, sight.cell, sight.position, sight.distance) == (None,) * 4


def test_guides_are_those_of_the_layers(rgb):
    scene = mi.load_dict(description(max_depth=2))
    preview = preview_of(scene, guided=True)
    assert preview.layers == GUIDES
    means = rendered(preview, size=(256, 256)).means()
    image = mi.render(scene, spp=1024, seed=1)  # with the layers that the preview has set
    for layer, plane in zip(preview.layers, means[1:]):
        first = 3 + 3 * preview.integrator.layers.index(layer)
        other = image[:, :, first : first + 3]
        assert abs(dr.mean(plane.array)[0] - dr.mean(other.array)[0]) < 0.01


def test_a_picture_becomes_a_jpeg_file(rgb):
    from nil_mitsuba.preview import as_jpeg

    picture = dr.full(mi.TensorXf, 0.18, (20, 30, 3))
    stream = mi.MemoryStream()
    data = as_jpeg(picture, 1.0, False)
    stream.write(data)
    stream.seek(0)
    bitmap = mi.Bitmap(stream)
    assert list(bitmap.size()) == [30, 20]
    linear = mi.TensorXf(bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False))
    assert dr.allclose(linear.array, 0.36, atol=0.01)


@pytest.mark.parametrize("kind", ["radiancemeter", "batch"])
def test_a_sensor_that_cannot_walk_is_refused(rgb, kind):
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    inner = {"inner": {"type": "perspective"}} if kind == "batch" else {}
    sensor = mi.load_dict({"type": kind, "film": film} | inner)
    with pytest.raises(RuntimeError, match="cannot walk.*-s"):
        lens.viewing_sensor(sensor, mi.load_dict({"type": "nil"}))
